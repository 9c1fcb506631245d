"""Lists of events as people keep them: times, polarities, perhaps places; as CSV, NPZ or NPY.

What is not said (which column is what, the unit of the times) is guessed from names and values, and the
source's header says how.
"""

import codecs
import csv
import gzip
import itertools
import math
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import InputError
from evlcp_sdk.io.arrays import read_npy, read_npz
from evlcp_sdk.io.columns import WINDOW_US, ColumnSource, EventTable, Piece
from evlcp_sdk.io.fields import Fields, Polarities, fields_of, fields_of_values, unit_named, unit_of
from evlcp_sdk.io.tables import CSV_HEADER
from evlcp_sdk.io.urls import flag, split_options

PIECE_BYTES: Final = 1 << 20

_COMMENTS: Final = (b"#", b"%", b"//")
_SEPARATORS: Final = (b";", b"\t", b"|", b",")
_DECIMAL_COMMA: Final = re.compile(rb"(?<=\d),(?=\d)")
_UTF_16: Final = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_TITLES: Final = 10
"""Lines that may stand above a table: a title, what recorded it, `sep=;`."""
_TEXT: Final = re.compile(rb"[\t\r\n -~\x80-\xff]+")
_NPY: Final = b"\x93NUMPY"
SUFFIXES: Final = (".csv", ".csv.gz", ".tsv", ".txt", ".txt.gz", ".dat", ".npy")
"""Of names, where the content alone does not say that it is a list."""

Read = Callable[[Path, ExitStack, Fields | None], EventTable]


def open_list(url: str, read: Read | None = None) -> ColumnSource:
    """Open `list:PATH`, with `?columns=t,p`, `unit=ms` and `inverted=1` where the file does not say so.

    Raises:
        InputError: As for `read_list`, or an option is wrong.
    """
    name, options = split_options(url, {"columns": _order, "unit": unit_named, "inverted": flag})
    return read_list(name.partition(":")[2], read, **options)


def read_list(
    path: Path | str,
    read: Read | None = None,
    *,
    columns: Fields | None = None,
    unit: str | None = None,
    inverted: bool = False,
) -> ColumnSource:
    """A table of times and polarities of events, and of places where it has them.

    An NPZ file of `t_us`, `x`, `y`, `p` may have the numbers `width` and `height`, and external triggers
    in `trigger_t_us`, `trigger_channel`, `trigger_value`, by rising time.

    CSV (`,` `;` `|` tab or blanks, UTF-8 or UTF-16, plain or gzipped, `#` `%` `//` before comments, up to
    ten lines of titles above), NPZ of arrays, of one structured or (n, 2) or (n, 4) array, and NPY of
    such a one. Columns are known by their names, or else by their values. The unit of the times is the one
    that the name says (`t_us`, `time [ms]`), or a line of units below the names, or else
    guessed, see `time_unit`; `header` says which, and why. Without places every event is of pixel (0, 0).
    Rows may be in any order as far as a million of them go; they are sorted, and counted.

    Args:
        path: The file.
        read: What reads it; None: by what it is.
        columns: Which column is what; None: as the file says or shows.
        unit: Of the times, `s`, `ms`, `us` or `ns`; None likewise.
        inverted: The larger polarity is OFF.

    Raises:
        InputError: The file cannot be read, or has no such columns.
    """

    def opened(path: Path, stack: ExitStack) -> EventTable:
        return (read or _READERS[_kind(path)])(path, stack, columns)

    return ColumnSource(path, opened, unit=unit, inverted=inverted)


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
    with path.open("rb") as file:
        start = file.read(1 << 13)
    if start.startswith(_UTF_16):
        start = start[: len(start) // 2 * 2].decode("utf-16", "replace").encode()
    start = start.removeprefix(codecs.BOM_UTF8)
    return _TEXT.fullmatch(start) is not None and _Text(start, None).fields is not None


def _kind(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(b"PK\x03\x04") or path.suffix.lower() == ".npz":
        return "NPZ"
    return "NPY" if start.startswith(_NPY) else "CSV"


def read_csv(path: Path, stack: ExitStack, fields: Fields | None) -> EventTable:
    """A table of text."""
    raw = stack.enter_context(path.open("rb"))
    start = raw.read(2)
    file: Any = stack.enter_context(gzip.GzipFile(fileobj=raw)) if start == b"\x1f\x8b" else raw
    if start in _UTF_16:
        file = codecs.EncodedFile(raw, "utf-8", "utf-16", "replace")
    raw.seek(0)
    text = file.read(PIECE_BYTES).removeprefix(codecs.BOM_UTF8)
    table = _Text(text, fields)
    if table.fields is None:
        raise InputError(
            f"{path}: line {table.line}: found {_show(table.heading)}, expected the columns t and p"
            " (or say which they are, as by list:PATH?columns=t,p)"
        )
    pieces = _csv_pieces(path, raw, file, text, table)
    # A table of ours has times as a camera gave them; others may be in any order.
    window_us = WINDOW_US if table.heading.strip() == CSV_HEADER else math.inf
    return EventTable("CSV", pieces, table.fields.unit, "line", window_us=window_us)


_READERS: Final[dict[str, Read]] = {"NPZ": read_npz, "NPY": read_npy, "CSV": read_csv}


def _csv_pieces(path: Path, raw: Any, file: Any, text: bytes, table: "_Text") -> Iterator[Piece]:
    line, more = 1, text
    while more:
        more = file.read(PIECE_BYTES)
        text += more
        whole = text if not more else text[: text.rfind(b"\n") + 1]
        text = text[len(whole) :]
        lines = whole.splitlines()
        last_is_cut = not more and not whole.endswith((b"\n", b"\r"))
        number = partial(table.number, lines, line)
        try:
            rows, cut = table.rows(lines, line, last_is_cut)
        except _LineError as error:
            rows, _ = table.rows(lines[: error.line - line], line, last_is_cut=False)
            if len(rows[0]):
                yield Piece(*rows, number, raw.tell())
            raise InputError(f"{path}: line {error.line}: {error}") from error
        if len(rows[0]) or cut:
            yield Piece(*rows, number, raw.tell(), cut)
        line += len(lines)


def _show(line: bytes) -> str:
    """The start of a line for a message."""
    text = line[:60].decode("utf-8", "replace")
    return repr(text + ("..." if len(line) > 60 else ""))


class _LineError(ValueError):
    """A line that is no row of its table.

    Args:
        line: Its number.
        what: What it is, and what was expected.
    """

    def __init__(self, line: int, what: str) -> None:
        super().__init__(what)
        self.line = line


class _Text:
    """How the lines of a text are read: what separates cells, and which is what.

    Args:
        start: The first bytes, behind a byte order mark.
        fields: Which column is what; None: as its heading or its values say.
    """

    def __init__(self, start: bytes, fields: Fields | None) -> None:
        lines = start.splitlines()[:512]
        data = [(k, line) for k, line in enumerate(lines, 1) if _is_data(line)]
        # A heading may stand in a comment, as numpy.savetxt writes it.
        above = [
            line.strip().lstrip(b"#%/").strip()
            for line in lines[: data[0][0] - 1 if data else len(lines)]
            if line.strip()
        ]
        self.line, self.heading = data[0] if data else (1, lines[0] if lines else b"")
        self._separator = _separator([line for _, line in data[:256]])
        self.is_named = False
        self.fields = fields
        if fields is not None and data:
            self.line, _ = _first_number(data, fields.time, self)
        elif data:
            for top in range(min(_TITLES, len(data))):
                found = self._told([line for _, line in data[top:]], above)
                if found is not None:
                    self.fields, self.is_named, units = found
                    self.line, self.heading = data[top + units] if top + units < len(data) else data[top]
                    break
                if top + 1 < len(data) and self._is_like(data[top][1], data[top + 1][1]):
                    break
        self.first = self.line + self.is_named
        self.line = self.first if self.fields is not None else self.line

    def _told(self, lines: list[bytes], above: list[bytes]) -> tuple[Fields, bool, int] | None:
        """Which is what, if a table begins with these lines.

        Returns:
            The columns; whether the first line names them; and how many lines of units follow that.
        """
        head = self.cells(lines[0])
        if not any(_is_number(cell) for cell in head):
            named = fields_of(head)
            if named is None:
                return None
            second = self.cells(lines[1]) if len(lines) > 1 else []
            unit = unit_of(second[named.time]) if len(second) > max(named.which) else None
            units = unit is not None
            if unit:
                named = replace(named, unit=named.unit or unit)
            rows = [self.cells(line) for line in lines[1 + units : 9]]
            if rows and all(len(row) == len(head) + 1 for row in rows):
                # Without a name for the numbers of rows, as R writes it.
                named = named.behind(1)
            return named, True, int(units)
        above_it = next((found for text in above[::-1] if (found := self._said(text, len(head)))), None)
        shown = above_it or self._shown(lines[:256])
        return None if shown is None else (shown, False, 0)

    def _is_like(self, line: bytes, following: bytes) -> bool:
        """Whether a line is a row as the next one is: no title then, and not to be passed over."""
        cells = self.cells(line)
        return len(cells) == len(self.cells(following)) and any(_is_number(cell) for cell in cells)

    def _said(self, text: bytes, many: int) -> Fields | None:
        for cells in (self.cells(text), re.split(r"[,;\s]+", text.decode("utf-8", "replace"))):
            found = fields_of(cells)
            if found is not None and len(cells) == many:
                return found
        return None

    def _shown(self, sample: list[bytes]) -> Fields | None:
        rows = [self.cells(line) for line in sample]
        if len({len(row) for row in rows}) != 1:
            # The last one may be cut.
            rows = rows[:-1]
        if not rows or len({len(row) for row in rows}) != 1:
            return None
        columns: list[NDArray[Any]] = []
        for cells in zip(*rows, strict=True):
            try:
                columns.append(np.array([float(cell) for cell in cells]))
            except ValueError:
                columns.append(np.array(cells))
        return fields_of_values(columns)

    def cells(self, line: bytes) -> list[str]:
        """What stands between the separators of a line."""
        try:
            text = line.decode().strip()
        except UnicodeDecodeError:
            # As older programs write a micro sign.
            text = line.decode("latin-1").strip()
        if self._separator == b" ":
            return [_plain(cell) for cell in text.split()]
        mark = self._separator.decode()
        if '"' in text:
            try:
                cells = next(csv.reader([text], delimiter=mark, skipinitialspace=True))
            except csv.Error:
                # A cell that is no end of, or bytes that are no text.
                cells = text.split(mark)
            return [_plain(cell) for cell in cells]
        return [_plain(cell) for cell in text.split(mark)]

    def rows(
        self, lines: list[bytes], first: int, last_is_cut: bool
    ) -> tuple[tuple[NDArray[Any], NDArray[Any], NDArray[Any] | None], int]:
        """Times, polarities and places of some lines, and how many cut ones at the end are left out.

        Args:
            lines: The lines.
            first: Number of the first.
            last_is_cut: The last one has no end, so it may be cut.

        Raises:
            _LineError: A line is no row of the table.
        """
        assert self.fields is not None
        data = list(self._data(lines, first))
        # Whoever wrote it was stopped.
        cut = int(last_is_cut and bool(data) and not self._is_row(data[-1][1]))
        data = data[: len(data) - cut]
        if not data:
            return (np.empty(0, np.int64), np.empty(0, np.int64), None), cut
        kept = [line for _, line in data]
        if self._separator != b"," and b"," in kept[0]:
            kept = [_DECIMAL_COMMA.sub(b".", line) for line in kept]
        found = self._loaded(kept, self.fields.which)
        return found or _split(np.array([self._cells_of(k, line) for k, line in data])), cut

    def _data(self, lines: list[bytes], first: int) -> Iterator[tuple[int, bytes]]:
        """Number and text of those that are rows of the table, from `first` on."""
        return ((k, line) for k, line in enumerate(lines, first) if k >= self.first and _is_data(line))

    def _cells_of(self, number: int, line: bytes) -> list[str]:
        """The cells of a row that count."""
        assert self.fields is not None
        if not self._is_row(line):
            more = ", x and y" if self.fields.places else ""
            raise _LineError(number, f"found {_show(line)}, expected a time and a polarity{more}")
        cells = self.cells(line)
        return [cells[k] for k in self.fields.which]

    def number(self, lines: list[bytes], first: int, row: int) -> int:
        """In which line the row stands, of these from `first` on, the row from 0."""
        return next(itertools.islice(self._data(lines, first), row, None))[0]

    def _loaded(
        self, lines: list[bytes], which: tuple[int, ...]
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any] | None] | None:
        """The same by NumPy, where all cells are plain numbers; None where they are not."""
        mark = None if self._separator == b" " else self._separator.decode()
        for kind in (np.dtype(np.int64), np.dtype(np.float64)):
            try:
                found = np.loadtxt(lines, kind, None, mark, usecols=which, ndmin=2)
            except (ValueError, OverflowError):
                continue
            return found[:, 0], found[:, 1], found[:, 2:] if len(which) > 2 else None
        try:
            return _split(np.loadtxt(lines, "U32", None, mark, usecols=which, ndmin=2, quotechar='"'))
        except ValueError:
            return None

    def _is_row(self, line: bytes) -> bool:
        assert self.fields is not None
        cells = self.cells(line)
        which = self.fields.which
        if len(cells) <= max(which):
            return False
        if not all(_is_number(cells[k] or "nan") for k in which if k != self.fields.polarity):
            return False
        try:
            Polarities().of(np.array([cells[self.fields.polarity] or "nan"]))
        except ValueError:
            return _is_number(cells[self.fields.polarity] or "nan")
        return True


def _split(cells: NDArray[np.str_]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any] | None]:
    """Times, polarities and places of cells (n, 2 or 4).

    Raises:
        ValueError: A time or a place is no number.
    """
    cells = np.char.strip(cells, " \t\"'")
    cells[cells == ""] = "nan"
    try:
        times: NDArray[Any] = cells[:, 0].astype(np.int64)
    except (ValueError, OverflowError):
        times = cells[:, 0].astype(np.float64)
    return times, cells[:, 1], cells[:, 2:].astype(np.float64) if cells.shape[1] > 2 else None


def _plain(cell: str) -> str:
    """A cell without quotes, and with a point where it has a comma."""
    return re.sub(r"(?<=\d),(?=\d)", ".", cell.strip().strip("\"'").strip())


def _first_number(data: list[tuple[int, bytes]], time: int, text: "_Text") -> tuple[int, bytes]:
    """The first of some lines, with their numbers, that has a number for its time; else the very first."""
    rows = (
        (k, line) for k, line in data if len(cells := text.cells(line)) > time and _is_number(cells[time])
    )
    return next(rows, data[0])


def _separator(lines: list[bytes]) -> bytes:
    """What stands between the cells of most lines."""

    def in_most(found: Callable[[bytes], Any]) -> bool:
        return 2 * sum(bool(found(line)) for line in lines) >= len(lines) > 0

    mark = next((mark for mark in _SEPARATORS if in_most(lambda line, mark=mark: mark in line)), b" ")  # type: ignore[misc]
    if mark == b"," and in_most(lambda line: re.fullmatch(rb"\s*\d+,\d+(\s+[^\s,]+)+\s*", line)):
        # A comma for the point, and blanks between.
        return b" "
    return mark


def _is_data(line: bytes) -> bool:
    plain = line.strip()
    return bool(plain) and not plain.startswith(_COMMENTS)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
