"""Tables, their columns beside one another as far as the screen is wide."""

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

_PIPE_WIDTH = 10_000
"""A pipe has no width that a table should be cut to."""

_GAP = 2


def print_table(
    out: "Console", head: Sequence[str], rows: Iterable[Sequence[str]], names: int = 1, best: str = "\0"
) -> None:
    """Print a table; of more columns than the screen is wide, the others stand below.

    Args:
        out: Where to.
        head: Of the columns.
        rows: Of each a text a column.
        names: How many of the first columns say what a row is: they stand in front of each part.
        best: What texts in bold type end with.
    """
    from rich.table import Table
    from rich.text import Text

    if not out.is_terminal:
        out.width = _PIPE_WIDTH
    for number, part in enumerate(_parts(list(zip(head, *rows, strict=True)), names, out.width)):
        if number:
            out.print()
        table = Table(box=None, pad_edge=False, header_style="dim")
        for place, (title, *_) in enumerate(part):
            if place < names:
                # A name longer than the screen goes on in the next line; a figure stands whole.
                table.add_column(title, overflow="fold")
            else:
                table.add_column(title, justify="right", no_wrap=True)
        for row in list(zip(*part, strict=True))[1:]:
            table.add_row(*(Text(text, "bold" if text.endswith(best) else "") for text in row))
        out.print(table)


def _parts(columns: Sequence[Sequence[str]], names: int, width: int) -> Iterator[list[Sequence[str]]]:
    """Columns that fit side by side, those of names in front of each."""
    part = list(columns[:names])
    for column in columns[names:]:
        if len(part) > names and _width([*part, column]) > width:
            yield part
            part = list(columns[:names])
        part.append(column)
    yield part


def _width(columns: Iterable[Sequence[str]]) -> int:
    from rich.cells import cell_len

    return sum(max(map(cell_len, column)) + _GAP for column in columns)
