"""Read lists of events as people keep them: times, polarities, perhaps x and y; as CSV, NPZ or NPY.

What a file does not state (which column is what, the unit of the times) is guessed from names and values, and
the source's header has how.
"""

import codecs
import csv
import gzip
import io
import math
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, Final, TextIO

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import InputError
from evlcp_sdk.formatting import shorten
from evlcp_sdk.io.arrays import read_npy, read_npz
from evlcp_sdk.io.columns import WINDOW_US, ColumnSource, EventTable, Piece
from evlcp_sdk.io.fields import (
    Fields,
    fields_from_names,
    fields_from_values,
    is_polarity,
    parse_unit,
    strip_cell,
    unit_from_name,
)
from evlcp_sdk.io.tables import CSV_HEADER
from evlcp_sdk.io.urls import parse_flag, split_options

PIECE_CHARACTERS: Final = 1 << 20

_COMMENTS: Final = ("#", "%", "//")
_SEPARATORS: Final = (";", "\t", "|", ",")
_DECIMAL_COMMA: Final = re.compile(r"(?<=\d),(?=\d)")
_UTF_16: Final = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_SAMPLE_LINES: Final = 512
"""Lines at the start by which columns are recognized."""

_MAX_TITLE_LINES: Final = 10
"""Most lines above a table: a title, the recorder's name, `sep=;`."""

_CONTROL_CHARACTERS: Final = re.compile(r"[\0-\x08\x0b-\x1f\x7f]")
SUFFIXES: Final = (".csv", ".csv.gz", ".tsv", ".txt", ".txt.gz", ".dat", ".npy")
"""Suffixes of lists whose content alone does not show it."""

TableReader = Callable[[Path, ExitStack, Fields | None], EventTable]


def open_list(url: Path | str, read: TableReader | None = None) -> ColumnSource:
    """Open a table of times and polarities of events, and perhaps of x and y; see `ColumnSource`.

    `docs/cli.md` has how text, NPZ and NPY are read. Without x and y every event is of pixel (0, 0). An NPZ
    file of `t_us`, `x`, `y`, `p` may have the numbers `width` and `height`, and external triggers in
    `trigger_t_us`, `trigger_channel`, `trigger_value`, by rising time.

    Args:
        url: The file; or `list:PATH`, with `?columns=t,p`, `unit=ms` and `inverted=1` (the larger polarity is
            OFF) for what the file does not state.
        read: The reader; None for that of the file's format.

    Raises:
        InputError: The file cannot be read, or has no such columns, or an option is wrong.
    """
    name, options = url, dict[str, Any]()
    if isinstance(url, str) and url.lower().startswith("list:"):
        parsers = {"columns": _parse_order, "unit": parse_unit, "inverted": parse_flag}
        name, options = split_options(url, parsers)
        name = name.partition(":")[2]
    columns = options.pop("columns", None)

    def read_table(path: Path, stack: ExitStack) -> EventTable:
        return (read or _READERS[_detect_format(path)])(path, stack, columns)

    return ColumnSource(name, read_table, **options)


def _parse_order(text: str) -> Fields:
    names = [name.strip().lower() for name in text.split(",")]
    stated = [name for name in names if name != "-"]
    if sorted(stated) not in (["p", "t"], ["p", "t", "x", "y"]):
        raise ValueError(
            "t and p, or t, x, y and p, in the order of the columns, - for others, such as t,-,p"
        )
    places = (names.index("x"), names.index("y")) if "x" in names else None
    return Fields(names.index("t"), names.index("p"), places)


def is_list(path: Path) -> bool:
    """Whether a file is a list of times and polarities.

    Raises:
        OSError: It cannot be read.
    """
    if _detect_format(path) != "CSV":
        return True
    with ExitStack() as stack:
        start = _open_text(path, stack)[1].read(1 << 13)
    return not _CONTROL_CHARACTERS.search(start) and _TextTable(start.splitlines(), None).fields is not None


def _detect_format(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(b"PK\x03\x04") or path.suffix.lower() == ".npz":
        return "NPZ"
    return "NPY" if start.startswith(b"\x93NUMPY") else "CSV"


def _open_text(path: Path, stack: ExitStack) -> tuple[IO[bytes], TextIO]:
    """Open a file, and the text in it, perhaps gzipped."""
    raw = stack.enter_context(path.open("rb"))
    file: Any = stack.enter_context(gzip.GzipFile(fileobj=raw)) if raw.peek(2)[:2] == b"\x1f\x8b" else raw
    encoding = "utf-16" if file.peek(2).startswith(_UTF_16) else "utf-8-sig"
    return raw, stack.enter_context(io.TextIOWrapper(file, encoding, "replace"))


def read_csv(path: Path, stack: ExitStack, fields: Fields | None) -> EventTable:
    """Read a table of text."""
    raw, file = _open_text(path, stack)
    lines = _read_lines(file)
    table = _TextTable(lines, fields)
    if table.fields is None:
        raise InputError(
            f"{path}: line {table.first}: found {_quote_line(table.heading)}, expected the columns t and p"
            " (or say which they are, as by list:PATH?columns=t,p)"
        )
    pieces = _read_pieces(path, raw, file, lines, table, table.fields)
    # Our own tables have a camera's times; others may be in any order.
    window_us = WINDOW_US if table.heading.strip() == CSV_HEADER.decode() else math.inf
    return EventTable("CSV", pieces, table.fields.unit, "line", window_us=window_us)


_READERS: Final[dict[str, TableReader]] = {"NPZ": read_npz, "NPY": read_npy, "CSV": read_csv}


def _read_pieces(
    path: Path, raw: IO[bytes], file: TextIO, lines: list[str], table: "_TextTable", fields: Fields
) -> Iterator[Piece]:
    above = 0
    while lines:
        numbers = [k for k, line in enumerate(lines, above + 1) if k >= table.first and _is_data(line)]
        rows = [lines[k - above - 1] for k in numbers]
        # The writer of the file was stopped.
        is_cut = bool(rows) and lines[-1][-1] != "\n" and len(lines[-1]) < PIECE_CHARACTERS
        cut = int(is_cut and not table.is_row(rows[-1], fields))
        good = len(rows) - cut
        columns = table.parse_columns(rows[:good], fields)
        if columns is None:
            good = next(k for k, row in enumerate(rows) if not table.is_row(row, fields))
            columns = table.parse_columns(rows[:good], fields)
        if columns is not None and rows:
            yield Piece(columns, numbers.__getitem__, raw.tell(), cut)
        if good + cut < len(rows):
            what = "a time and a polarity" + (", x and y" if fields.places else "")
            raise InputError(
                f"{path}: line {numbers[good]}: found {_quote_line(rows[good])}, expected {what}"
            )
        above += len(lines)
        lines = _read_lines(file)


def _read_lines(file: TextIO) -> list[str]:
    """Read the next lines, complete unless one is too long for memory."""
    text = file.read(PIECE_CHARACTERS)
    return [*io.StringIO(text + file.readline(PIECE_CHARACTERS))]


def _quote_line(line: str) -> str:
    return repr(shorten(line.rstrip("\n"), 60))


class _TextTable:
    """The layout of a text by its first lines: what separates cells, and which column is what.

    Attributes:
        fields: Which column is what: as given, or else by the heading or by values; None if not recognized.
        first: Number of the first line that may be a row, or of the one that was not recognized.
        heading: The line that has the names, or is the first row.
    """

    def __init__(self, lines: list[str], fields: Fields | None) -> None:
        data = [(k, line) for k, line in enumerate(lines[:_SAMPLE_LINES], 1) if _is_data(line)]
        self._separator = _find_separator([line for _, line in data[:256]])
        self.fields = fields
        self.first, self.heading = data[0] if data else (1, lines[0] if lines else "")
        if fields is not None:
            times = ((k, self.split_cells(line)[fields.time : fields.time + 1]) for k, line in data)
            self.first = next((k for k, cells in times if cells and _is_number(cells[0])), self.first)
            return
        # A heading may stand in a comment, as numpy.savetxt writes it.
        above = [line.strip().lstrip("#%/").strip() for line in lines[: self.first - 1]]
        for top, (number, line) in enumerate(data[:_MAX_TITLE_LINES]):
            found = self._recognize_columns([line for _, line in data[top:]], above)
            if found is not None:
                self.fields, names = found
                self.first, self.heading = data[top + names - 1][0] + 1 if names else number, line
                break
            # A row like the next one is no title to skip.
            following = self.split_cells(data[top + 1][1]) if top + 1 < len(data) else []
            if len(self.split_cells(line)) == len(following) and any(map(_is_number, self.split_cells(line))):
                break

    def _recognize_columns(self, lines: list[str], above: list[str]) -> tuple[Fields, int] | None:
        """Recognize a table that starts with these lines; return how many name columns and units, too."""
        head = self.split_cells(lines[0])
        if any(map(_is_number, head)):
            for text in reversed(above):
                for names in (self.split_cells(text), re.split(r"[,;\s]+", text)):
                    found = fields_from_names(names)
                    if found is not None and len(names) == len(head):
                        return found, 0
            shown = self._recognize_values(lines[:256])
            return None if shown is None else (shown, 0)
        named = fields_from_names(head)
        if named is None:
            return None
        second = self.split_cells(lines[1]) if len(lines) > 1 else []
        unit = unit_from_name(second[named.time]) if len(second) > max(named.numbers) else None
        rows = [self.split_cells(line) for line in lines[1 + bool(unit) : 9]]
        if rows and all(len(row) == len(head) + 1 for row in rows):
            # R writes no name for the column of row numbers.
            named = fields_from_names(["", *head]) or named
        return replace(named, unit=named.unit or unit), 1 + bool(unit)

    def _recognize_values(self, sample: list[str]) -> Fields | None:
        rows = [self.split_cells(line) for line in sample]
        if len(set(map(len, rows))) != 1:
            # The last row may be cut.
            rows = rows[:-1]
        if len(set(map(len, rows))) != 1:
            return None
        return fields_from_values([_to_numbers(np.array(cells)) for cells in zip(*rows, strict=True)])

    def split_cells(self, line: str) -> list[str]:
        """Split a line at its separators, with decimal commas as points."""
        mark = None if self._separator == " " else self._separator
        cells = line.split(mark)
        if mark and '"' in line:
            # A cell may be too long for `csv`.
            with suppress(csv.Error):
                (cells,) = csv.reader([line], delimiter=mark, skipinitialspace=True)
        return [_DECIMAL_COMMA.sub(".", strip_cell(cell)) for cell in cells]

    def parse_columns(self, rows: list[str], fields: Fields) -> tuple[NDArray[Any], ...] | None:
        """Return times, polarities and perhaps x and y of some lines, (n,) each; None if one is no row."""
        which, mark = fields.numbers, None if self._separator == " " else self._separator
        if not rows:
            return tuple(np.empty((len(which), 0), np.int64))
        decimal = [_DECIMAL_COMMA.sub(".", row) for row in rows] if mark != "," and "," in rows[0] else rows
        for kind in (np.int64, np.float64):
            try:
                found = np.loadtxt(decimal, kind, None, mark, usecols=which, ndmin=2)
            except (ValueError, OverflowError):
                continue
            return tuple(found.T)
        try:
            cells = np.array([[cells[k] or "nan" for k in which] for cells in map(self.split_cells, rows)])
        except IndexError:
            return None
        times, *places = (_to_numbers(column) for k, column in enumerate(cells.T) if k != 1)
        if any(column.dtype.kind == "U" for column in (times, *places)):
            return None
        return times, cells[:, 1], *places

    def is_row(self, line: str, fields: Fields) -> bool:
        """Whether a line has numbers and a polarity where the columns are."""
        cells = self.split_cells(line)
        if len(cells) <= max(fields.numbers):
            return False
        time, polarity, *places = (cells[k] or "nan" for k in fields.numbers)
        return all(map(_is_number, (time, *places))) and (is_polarity(polarity) or _is_number(polarity))


def _find_separator(lines: list[str]) -> str:
    def is_in_most(pattern: str) -> bool:
        return 2 * sum(bool(re.search(pattern, line)) for line in lines) >= len(lines) > 0

    mark = next((mark for mark in _SEPARATORS if is_in_most(re.escape(mark))), " ")
    # The comma may be a decimal one, with blanks between cells.
    return " " if mark == "," and is_in_most(r"^\s*\d+,\d+(\s+[^\s,]+)+\s*$") else mark


def _is_data(line: str) -> bool:
    text = line.strip()
    return bool(text) and not text.startswith(_COMMENTS)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _to_numbers(words: NDArray[np.str_]) -> NDArray[Any]:
    """Convert words to integers, or else to floats; return the words if one is not a number."""
    for kind in (np.int64, np.float64):
        try:
            return words.astype(kind)
        except (ValueError, OverflowError):
            continue
    return words
