"""Tables, split into parts that fit the width of the screen."""

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

_PIPE_WIDTH = 10_000
"""Of a pipe, where no table is split."""

_GAP = 2


def print_table(
    out: "Console", head: Sequence[str], rows: Iterable[Sequence[str]], names: int = 1, best: str = "\0"
) -> None:
    """Print a table; columns beyond the screen's width follow below, after the first `names` columns again.

    Texts that end with `best` are printed in bold type.
    """
    from rich.table import Table
    from rich.text import Text

    if not out.is_terminal:
        out.width = _PIPE_WIDTH
    for number, part in enumerate(_split_columns(list(zip(head, *rows, strict=True)), names, out.width)):
        if number:
            out.print()
        table = Table(box=None, pad_edge=False, header_style="dim")
        for place, (title, *_) in enumerate(part):
            if place < names:
                # A name may wrap; a figure may not.
                table.add_column(title, overflow="fold")
            else:
                table.add_column(title, justify="right", no_wrap=True)
        for row in list(zip(*part, strict=True))[1:]:
            table.add_row(*(Text(text, "bold" if text.endswith(best) else "") for text in row))
        out.print(table)


def _split_columns(columns: Sequence[Sequence[str]], names: int, width: int) -> Iterator[list[Sequence[str]]]:
    part = list(columns[:names])
    for column in columns[names:]:
        if len(part) > names and _total_width([*part, column]) > width:
            yield part
            part = list(columns[:names])
        part.append(column)
    yield part


def _total_width(columns: Iterable[Sequence[str]]) -> int:
    from rich.cells import cell_len

    return sum(max(map(cell_len, column)) + _GAP for column in columns)
