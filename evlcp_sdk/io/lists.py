"""Lists of events as people keep them: times, polarities, perhaps places; as CSV, NPZ or NPY.

What is not said (which column is what, the unit of the times) is guessed from names and values, and the
source's header says how.
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
from evlcp_sdk.io.arrays import read_npy, read_npz
from evlcp_sdk.io.columns import WINDOW_US, ColumnSource, EventTable, Piece
from evlcp_sdk.io.fields import Fields, fields_of, fields_of_values, is_polarity, plain, unit_named, unit_of
from evlcp_sdk.io.tables import CSV_HEADER
from evlcp_sdk.io.urls import flag, split_options

PIECE_CHARACTERS: Final = 1 << 20

_COMMENTS: Final = ("#", "%", "//")
_SEPARATORS: Final = (";", "\t", "|", ",")
_DECIMAL_COMMA: Final = re.compile(r"(?<=\d),(?=\d)")
_UTF_16: Final = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_LOOKED_AT: Final = 512
"""Lines at the start from which columns are recognized."""

_TITLES: Final = 10
"""Lines that may stand above a table: a title, what recorded it, `sep=;`."""

_NO_TEXT: Final = re.compile(r"[\0-\x08\x0b-\x1f\x7f]")
SUFFIXES: Final = (".csv", ".csv.gz", ".tsv", ".txt", ".txt.gz", ".dat", ".npy")
"""Of names, where the content alone does not say that it is a list."""

Read = Callable[[Path, ExitStack, Fields | None], EventTable]


def open_list(url: Path | str, read: Read | None = None) -> ColumnSource:
    """A table of times and polarities of events, and of places where it has them; see `ColumnSource`.

    Text, NPZ and NPY are read as `docs/cli.md` says. Without places every event is of pixel (0, 0). An NPZ
    file of `t_us`, `x`, `y`, `p` may have the numbers `width` and `height`, and external triggers in
    `trigger_t_us`, `trigger_channel`, `trigger_value`, by rising time.

    Args:
        url: The file; or `list:PATH`, with `?columns=t,p`, `unit=ms` and `inverted=1` (the larger polarity is
            OFF) where the file does not say so.
        read: What reads it; None: by what it is.

    Raises:
        InputError: The file cannot be read, or has no such columns, or an option is wrong.
    """
    name, options = url, dict[str, Any]()
    if isinstance(url, str) and url.lower().startswith("list:"):
        name, options = split_options(url, {"columns": _order, "unit": unit_named, "inverted": flag})
        name = name.partition(":")[2]
    columns = options.pop("columns", None)

    def opened(path: Path, stack: ExitStack) -> EventTable:
        return (read or _READERS[_kind(path)])(path, stack, columns)

    return ColumnSource(name, opened, **options)


def _order(text: str) -> Fields:
    names = [name.strip().lower() for name in text.split(",")]
    given = [name for name in names if name != "-"]
    if sorted(given) not in (["p", "t"], ["p", "t", "x", "y"]):
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
    if _kind(path) != "CSV":
        return True
    with ExitStack() as stack:
        start = _open_text(path, stack)[1].read(1 << 13)
    return not _NO_TEXT.search(start) and _Text(start.splitlines(), None).fields is not None


def _kind(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(b"PK\x03\x04") or path.suffix.lower() == ".npz":
        return "NPZ"
    return "NPY" if start.startswith(b"\x93NUMPY") else "CSV"


def _open_text(path: Path, stack: ExitStack) -> tuple[IO[bytes], TextIO]:
    """A file, and its text."""
    raw = stack.enter_context(path.open("rb"))
    start = raw.peek(2)[:2]
    file: Any = stack.enter_context(gzip.GzipFile(fileobj=raw)) if start == b"\x1f\x8b" else raw
    encoding = "utf-16" if start in _UTF_16 else "utf-8-sig"
    return raw, stack.enter_context(io.TextIOWrapper(file, encoding, "replace"))


def read_csv(path: Path, stack: ExitStack, fields: Fields | None) -> EventTable:
    """A table of text."""
    raw, file = _open_text(path, stack)
    lines = _read_lines(file)
    table = _Text(lines, fields)
    if table.fields is None:
        raise InputError(
            f"{path}: line {table.first}: found {_show(table.heading)}, expected the columns t and p"
            " (or say which they are, as by list:PATH?columns=t,p)"
        )
    pieces = _csv_pieces(path, raw, file, lines, table, table.fields)
    # A table of ours has times as a camera gave them; others may be in any order.
    window_us = WINDOW_US if table.heading.strip() == CSV_HEADER.decode() else math.inf
    return EventTable("CSV", pieces, table.fields.unit, "line", window_us=window_us)


_READERS: Final[dict[str, Read]] = {"NPZ": read_npz, "NPY": read_npy, "CSV": read_csv}


def _csv_pieces(
    path: Path, raw: IO[bytes], file: TextIO, lines: list[str], table: "_Text", fields: Fields
) -> Iterator[Piece]:
    above = 0
    while lines:
        numbers = [k for k, line in enumerate(lines, above + 1) if k >= table.first and _is_data(line)]
        rows = [lines[k - above - 1] for k in numbers]
        # Whoever wrote it was stopped.
        is_cut = bool(rows) and lines[-1][-1] != "\n" and len(lines[-1]) < PIECE_CHARACTERS
        cut = int(is_cut and not table.is_row(rows[-1], fields))
        good = len(rows) - cut
        columns = table.columns(rows[:good], fields)
        if columns is None:
            good = next(k for k, row in enumerate(rows) if not table.is_row(row, fields))
            columns = table.columns(rows[:good], fields)
        if columns is not None and rows:
            yield Piece(columns, numbers.__getitem__, raw.tell(), cut)
        if good + cut < len(rows):
            what = "a time and a polarity" + (", x and y" if fields.places else "")
            raise InputError(f"{path}: line {numbers[good]}: found {_show(rows[good])}, expected {what}")
        above += len(lines)
        lines = _read_lines(file)


def _read_lines(file: TextIO) -> list[str]:
    """The next lines, whole but for one without an end, which would take all memory."""
    text = file.read(PIECE_CHARACTERS)
    return [*io.StringIO(text + file.readline(PIECE_CHARACTERS))]


def _show(line: str) -> str:
    """The start of a line for a message."""
    text = line.rstrip("\n")
    return repr(text[:60] + ("..." if len(text) > 60 else ""))


class _Text:
    """How the lines of a text are read: what separates cells, and which is what.

    Args:
        lines: The first ones.
        fields: Which column is what; None: as its heading or its values say.

    Attributes:
        fields: The same; None where nothing says it.
        first: Number of the first line that may be a row, or of the one that says nothing.
        heading: The line that has the names, or is the first row.
    """

    def __init__(self, lines: list[str], fields: Fields | None) -> None:
        data = [(k, line) for k, line in enumerate(lines[:_LOOKED_AT], 1) if _is_data(line)]
        self._separator = _separator([line for _, line in data[:256]])
        self.fields = fields
        self.first, self.heading = data[0] if data else (1, lines[0] if lines else "")
        if fields is not None:
            times = ((k, self.cells(line)[fields.time : fields.time + 1]) for k, line in data)
            self.first = next((k for k, cells in times if cells and _is_number(cells[0])), self.first)
            return
        # A heading may stand in a comment, as numpy.savetxt writes it.
        above = [line.strip().lstrip("#%/").strip() for line in lines[: self.first - 1]]
        for top, (number, line) in enumerate(data[:_TITLES]):
            found = self._recognize([line for _, line in data[top:]], above)
            if found is not None:
                self.fields, names = found
                self.first, self.heading = data[top + names - 1][0] + 1 if names else number, line
                break
            # A row as the next one is no title, and not to be passed over.
            following = self.cells(data[top + 1][1]) if top + 1 < len(data) else []
            if len(self.cells(line)) == len(following) and any(map(_is_number, self.cells(line))):
                break

    def _recognize(self, lines: list[str], above: list[str]) -> tuple[Fields, int] | None:
        """Which is what, if a table begins with these lines, and how many of them name columns and units."""
        head = self.cells(lines[0])
        if any(map(_is_number, head)):
            for text in reversed(above):
                for names in (self.cells(text), re.split(r"[,;\s]+", text)):
                    found = fields_of(names)
                    if found is not None and len(names) == len(head):
                        return found, 0
            shown = self._recognize_values(lines[:256])
            return None if shown is None else (shown, 0)
        named = fields_of(head)
        if named is None:
            return None
        second = self.cells(lines[1]) if len(lines) > 1 else []
        unit = unit_of(second[named.time]) if len(second) > max(named.which) else None
        rows = [self.cells(line) for line in lines[1 + bool(unit) : 9]]
        if rows and all(len(row) == len(head) + 1 for row in rows):
            # Without a name for the numbers of rows, as R writes it.
            named = named.of(range(1, len(head) + 1))
        return replace(named, unit=named.unit or unit), 1 + bool(unit)

    def _recognize_values(self, sample: list[str]) -> Fields | None:
        rows = [self.cells(line) for line in sample]
        if len(set(map(len, rows))) != 1:
            # The last one may be cut.
            rows = rows[:-1]
        if len(set(map(len, rows))) != 1:
            return None
        return fields_of_values([_numbers(np.array(cells)) for cells in zip(*rows, strict=True)])

    def cells(self, line: str) -> list[str]:
        """What stands between the separators of a line, decimal commas as points."""
        mark = None if self._separator == " " else self._separator
        cells = line.split(mark)
        if mark and '"' in line:
            # A cell may be longer than `csv` takes.
            with suppress(csv.Error):
                (cells,) = csv.reader([line], delimiter=mark, skipinitialspace=True)
        return [_DECIMAL_COMMA.sub(".", plain(cell)) if "," in cell else plain(cell) for cell in cells]

    def columns(self, rows: list[str], fields: Fields) -> tuple[NDArray[Any], ...] | None:
        """Times, polarities and perhaps x and y of some lines, (n,) each; None where one is no row."""
        which, mark = fields.which, None if self._separator == " " else self._separator
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
            cells = np.array([[cells[k] or "nan" for k in which] for cells in map(self.cells, rows)])
        except IndexError:
            return None
        times, *places = (_numbers(column) for k, column in enumerate(cells.T) if k != 1)
        if any(column.dtype.kind == "U" for column in (times, *places)):
            return None
        return times, cells[:, 1], *places

    def is_row(self, line: str, fields: Fields) -> bool:
        """Whether a line has numbers and a polarity where the columns are."""
        cells = self.cells(line)
        if len(cells) <= max(fields.which):
            return False
        time, polarity, *places = (cells[k] or "nan" for k in fields.which)
        return all(map(_is_number, (time, *places))) and (is_polarity(polarity) or _is_number(polarity))


def _separator(lines: list[str]) -> str:
    """What stands between the cells of most lines."""

    def is_in_most(pattern: str) -> bool:
        return 2 * sum(bool(re.search(pattern, line)) for line in lines) >= len(lines) > 0

    mark = next((mark for mark in _SEPARATORS if is_in_most(re.escape(mark))), " ")
    # A comma for the point, and blanks between.
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


def _numbers(words: NDArray[np.str_]) -> NDArray[Any]:
    """Whole numbers, or numbers, of words; the words where one is none."""
    for kind in (np.int64, np.float64):
        try:
            return words.astype(kind)
        except (ValueError, OverflowError):
            continue
    return words
