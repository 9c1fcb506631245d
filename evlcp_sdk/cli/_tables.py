"""Tables of figures, beside one another as far as the screen is wide."""

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_Column = Sequence[tuple[str, bool]]

_PIPE_WIDTH = 10_000
"""A pipe has no width that a table should be cut to."""

_GAP = 2


def print_table(
    out: "Console", head: Sequence[str], rows: Iterable[Sequence[tuple[str, bool]]], names: int = 1
) -> None:
    """Print a table; of more columns than the screen is wide, the others stand below.

    Args:
        out: Where to.
        head: Of the columns.
        rows: Of each column a text, and whether it is the best one, which is in bold type.
        names: How many of the first columns say what a row is: they stand in front of each part.
    """
    if not out.is_terminal:
        out.width = _PIPE_WIDTH
    columns = list(zip([(title, False) for title in head], *rows, strict=True))
    for number, part in enumerate(_parts(columns, names, out.width)):
        if number:
            out.print()
        out.print(_grid(part, names))


def _parts(columns: Sequence[_Column], names: int, width: int) -> Iterator[list[_Column]]:
    """Columns that fit side by side, those of names in front of each."""
    part = list(columns[:names])
    for column in columns[names:]:
        if len(part) > names and _width([*part, column]) > width:
            yield part
            part = list(columns[:names])
        part.append(column)
    yield part


def _width(columns: Iterable[_Column]) -> int:
    from rich.cells import cell_len

    return sum(max(cell_len(text) for text, _ in column) + _GAP for column in columns)


def _grid(columns: Sequence[_Column], names: int) -> "Table":
    from rich.table import Table
    from rich.text import Text

    grid = Table(box=None, pad_edge=False, header_style="dim")
    for number, column in enumerate(columns):
        if number < names:
            # A name longer than the screen goes on in the next line; a figure stands whole.
            grid.add_column(column[0][0], overflow="fold")
        else:
            grid.add_column(column[0][0], justify="right", no_wrap=True)
    for row in zip(*(column[1:] for column in columns), strict=True):
        grid.add_row(*(Text(text, "bold" if best else "") for text, best in row))
    return grid
