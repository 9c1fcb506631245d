"""Lists of events as people keep them: times, polarities, perhaps places; as CSV, NPZ, NPY or MAT.

What is not said (which column is what, the unit of the times) is guessed from names and values, and the
source's header says how.
"""

import codecs
import csv
import gzip
import itertools
import math
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import InputError
from evlcp_sdk.io.columns import PIECE_ROWS, WINDOW_US, ColumnSource, Piece, piece_of
from evlcp_sdk.io.fields import (
    Fields,
    Polarities,
    fields_of,
    fields_of_values,
    unit_named,
    unit_of,
)
from evlcp_sdk.io.tables import (
    COLUMNS,
    CSV_HEADER,
    DAMAGE,
    TRIGGER_COLUMNS,
    NpzColumn,
    npy_header,
    said,
    show,
)
from evlcp_sdk.io.urls import flag, split_options
from evlcp_sdk.values import Triggers

PIECE_BYTES: Final = 1 << 20
TRIGGER_ROWS: Final = 1 << 12
LOOKED_AT: Final = 1 << 14
"""Rows at the start from which columns are recognized."""

_COMMENTS: Final = (b"#", b"%", b"//")
_SEPARATORS: Final = (b";", b"\t", b"|", b",")
_DECIMAL_COMMA: Final = re.compile(rb"(?<=\d),(?=\d)")
_UTF_16: Final = (b"\xff\xfe", b"\xfe\xff")
_TITLES: Final = 10
"""Lines that may stand above a table: a title, what recorded it, `sep=;`."""
_TEXT: Final = re.compile(rb"[\t\r\n -~\x80-\xff]+")
_NPY: Final = b"\x93NUMPY"
_MAT: Final = b"MATLAB "
_MAT_VALUE_BYTES: Final = 8
_MOST_MAT_BYTES: Final = 300_000_000
SUFFIXES: Final = (".csv", ".csv.gz", ".tsv", ".txt", ".txt.gz", ".dat", ".npy", ".mat")
"""Of names, where the content alone does not say that it is a list."""


def open_list(url: str) -> "ListSource":
    """Open `list:PATH`, with `?columns=t,p`, `unit=ms` and `inverted=1` where the file does not say so.

    Raises:
        InputError: As for `ListSource`, or an option is wrong.
    """
    name, options = split_options(url, {"columns": _order, "unit": unit_named, "inverted": flag})
    path = name.partition(":")[2]
    if _kind_at(path).startswith(b"MATLAB 7.3"):
        raise InputError(f"{path}: a file of MATLAB 7.3, expected to be named hdf5:{path}")
    return ListSource(
        path, fields=options.get("columns"), unit=options.get("unit"), inverted=options.get("inverted", False)
    )


def _kind_at(path: str) -> bytes:
    try:
        with Path(path).open("rb") as file:
            return file.read(16)
    except OSError:
        return b""


def _order(text: str) -> Fields:
    names = [name.strip().lower() for name in text.split(",")]
    given = [name for name in names if name != "-"]
    if sorted(given) not in (["p", "t"], ["p", "t", "x", "y"]):
        raise ValueError(
            "t and p, or t, x, y and p, in the order of the columns, - for others, such as t,-,p"
        )
    places = (names.index("x"), names.index("y")) if "x" in names else None
    return Fields(names.index("t"), names.index("p"), places)


class ListSource(ColumnSource):
    """A table of times and polarities of events, and of places where it has them.

    An NPZ file of `t_us`, `x`, `y`, `p` may have the numbers `width` and `height`, and external triggers
    in `trigger_t_us`, `trigger_channel`, `trigger_value`, by rising time.

    CSV (`,` `;` `|` tab or blanks, UTF-8 or UTF-16, plain or gzipped, `#` `%` `//` before comments, up to
    ten lines of titles above), NPZ and MAT of arrays, of one structured or (n, 2) or (n, 4) array, and NPY of
    such a one. Columns are known by their names, or else by their values. The unit of the times is the one
    that the name says (`t_us`, `time [ms]`), or a line of units below the names, or else
    guessed, see `time_unit`; `header` says which, and why. Without places every event is of pixel (0, 0).
    Rows may be in any order as far as a million of them go; they are sorted, and counted.

    Args:
        path: The file.
        fields: Which column is what; None: as the file says or shows.
        unit: Of the times, `s`, `ms`, `us` or `ns`; None likewise.
        inverted: The larger polarity is OFF.

    Raises:
        InputError: The file cannot be read, or has no such columns.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        fields: Fields | None = None,
        unit: str | None = None,
        inverted: bool = False,
    ) -> None:
        target = self.path = Path(path)
        self._fields, self._is_ours = fields, False
        self._triggers: list[NpzColumn] = []
        self._size: tuple[int | None, int | None] = (None, None)
        try:
            kind = _kind(target)
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        readers = {"NPZ": self._npz, "NPY": self._npy, "MAT": self._mat, "CSV": self._csv}
        with ExitStack() as stack:
            try:
                pieces = readers[kind](target, stack)
            except (*DAMAGE, zlib.error) as error:
                raise InputError(f"{path}: damaged or closed file: {said(error)}") from error
            super().__init__(
                target,
                kind,
                pieces,
                stack,
                where="line" if kind == "CSV" else "row",
                named=lambda: self._fields.unit if self._fields else None,
                unit=unit,
                inverted=inverted,
                # A table of ours has times as a camera gave them; others may be in any order.
                window_us=WINDOW_US if self._is_ours else math.inf,
                size=self._size,
                triggers=self._trigger_pieces(),
            )
            self._stack = stack.pop_all()

    # -- readers, each an iterator of pieces

    def _csv(self, target: Path, stack: ExitStack) -> Iterator[Piece]:
        raw = stack.enter_context(target.open("rb"))
        zipped = raw.read(2) == b"\x1f\x8b"
        raw.seek(0)
        file: Any = stack.enter_context(gzip.GzipFile(fileobj=raw)) if zipped else raw
        if not zipped and raw.read(2) in _UTF_16:
            file = codecs.EncodedFile(raw, "utf-8", "utf-16", "replace")
        raw.seek(0)
        text = file.read(PIECE_BYTES)
        table = _Text(text, self._fields)
        if table.fields is None:
            raise InputError(
                f"{target}: line {table.line}: found {show(table.heading)}, expected the columns t and p"
                " (or say which they are, as by list:PATH?columns=t,p)"
            )
        self._fields = table.fields
        self._is_ours = table.heading.strip() == CSV_HEADER
        return self._csv_pieces(raw, file, text, table)

    def _csv_pieces(self, raw: Any, file: Any, text: bytes, table: "_Text") -> Iterator[Piece]:
        line = 1
        while True:
            more = file.read(PIECE_BYTES)
            self._position = raw.tell()
            text += more
            whole = text if not more else text[: text.rfind(b"\n") + 1]
            text = text[len(whole) :]
            lines = whole.splitlines()
            last_is_cut = not more and not whole.endswith((b"\n", b"\r"))
            try:
                rows, cut = table.rows(lines, line, last_is_cut)
            except _LineError as error:
                if error.line > line:
                    rows, _ = table.rows(lines[: error.line - line], line, last_is_cut=False)
                    if len(rows[0]):
                        yield (*rows, partial(table.number, lines, line))
                raise InputError(f"{self.path}: line {error.line}: {error}") from error
            self._counts["rows_cut"] += cut
            if len(rows[0]):
                yield (*rows, partial(table.number, lines, line))
            line += len(lines)
            if not more:
                return

    def _npz(self, target: Path, stack: ExitStack) -> Iterator[Piece]:
        try:
            archive = stack.enter_context(zipfile.ZipFile(target))
        except (zipfile.BadZipFile, UnicodeDecodeError, NotImplementedError) as error:
            raise InputError(f"{target}: found no NPZ file, expected one ({error})") from error
        names = [member.removesuffix(".npy") for member in archive.namelist()]
        self._is_ours = self._fields is None and set(COLUMNS) <= set(names)
        fields = self._fields or fields_of(names) or _fields_of_two(target, archive)
        if self._fields is None and (len(names) == 1 or fields is None):
            tables = [name for name in sorted(names, key=len) if _is_table(archive, f"{name}.npy")]
            if not tables:
                raise InputError(f"{target}: found the arrays {', '.join(sorted(names))}, expected t and p")
            return self._table(_Array(target, stack.enter_context(archive.open(f"{tables[0]}.npy"))))
        assert fields is not None
        if max(fields.which) >= len(names):
            raise InputError(f"{target}: found {len(names)} arrays, expected {max(fields.which) + 1}")
        columns = [
            NpzColumn(target, archive, names[k], stack, kinds=kinds)
            for k, kinds in zip(fields.which, ("iuf", "iubfUS", "iuf", "iuf"), strict=False)
        ]
        if any(column.is_scalar for column in columns[2:]) and not self._is_ours:
            # Where the pixels are, not a place of each event.
            fields, columns = replace(fields, places=None), columns[:2]
        self._fields = fields
        if self._is_ours:
            self._take_own(partial(NpzColumn, target, archive, stack=stack), names)
        for group in (columns, self._triggers):
            _check_lengths(target, group)
        return self._npz_pieces(columns, target.stat().st_size)

    def _take_own(self, column: Callable[[str], NpzColumn], names: list[str]) -> None:
        """Take what a file in our own names has beside events."""
        if "trigger_t_us" in names:
            self._triggers = [column(name) for name in TRIGGER_COLUMNS]
        width, height = (column(name).one() if name in names else None for name in ("width", "height"))
        self._size = width, height

    def _npz_pieces(self, columns: list[NpzColumn], size: int) -> Iterator[Piece]:
        time = columns[0]
        while time.row < time.rows:
            row = time.row + 1
            taken = [column.take(PIECE_ROWS) for column in columns]
            self._position = round(size * time.row / time.rows)
            yield piece_of(taken, row)
        self._position = size

    def _trigger_pieces(self) -> Iterator[Triggers]:
        try:
            while self._triggers and self._triggers[0].row < self._triggers[0].rows:
                yield Triggers(*(column.take_bounded(TRIGGER_ROWS) for column in self._triggers))
        except DAMAGE as error:
            raise InputError(f"{self.path}: damaged triggers: {said(error)}") from error

    def _npy(self, target: Path, stack: ExitStack) -> Iterator[Piece]:
        return self._table(_Array(target, stack.enter_context(target.open("rb"))))

    def _table(self, array: "_Array") -> Iterator[Piece]:
        fields = self._fields or array.fields()
        if fields is None:
            raise InputError(
                f"{array.path}: found an array of {array.what}, expected columns of times and polarities"
                " (or say which they are, as by list:PATH?columns=t,p)"
            )
        self._fields = fields
        return self._array_pieces(array, fields)

    def _array_pieces(self, array: "_Array", fields: Fields) -> Iterator[Piece]:
        row = 1
        while len((taken := array.take(PIECE_ROWS))[0]):
            self._position = round(array.path.stat().st_size * array.done)
            yield piece_of([taken[k] for k in fields.which], row)
            row += len(taken[0])

    def _mat(self, target: Path, stack: ExitStack) -> Iterator[Piece]:
        arrays = _mat_arrays(target)
        names = list(arrays)
        if (fields := self._fields or fields_of(names)) is not None and max(fields.which) < len(names):
            columns = [arrays[names[k]].ravel() for k in fields.which]
        else:
            tables = {
                name: array
                for name, array in arrays.items()
                if array.dtype.names or (array.ndim == 2 and 1 < min(array.shape) <= 8)
            }
            found = next(
                (
                    (parts, known)
                    for parts in (_columns_of(array) for array in tables.values())
                    if (known := self._fields or fields_of_values([part[:LOOKED_AT] for part in parts]))
                ),
                None,
            )
            if found is None:
                raise InputError(f"{target}: found {', '.join(sorted(names)) or 'nothing'}, expected t and p")
            parts, fields = found
            columns = [parts[k] for k in fields.which]
        self._fields = fields
        if len({len(column) for column in columns}) > 1:
            lengths = [len(column) for column in columns]
            raise InputError(f"{target}: found columns of the lengths {lengths}, expected one length")
        return self._mat_pieces(columns)

    def _mat_pieces(self, columns: list[NDArray[Any]]) -> Iterator[Piece]:
        for first in range(0, len(columns[0]), PIECE_ROWS):
            last = first + PIECE_ROWS
            self._position = round(self.path.stat().st_size * min(last / len(columns[0]), 1.0))
            yield piece_of([column[first:last] for column in columns], first + 1)


def is_list(path: Path) -> bool:
    """Whether a file is a list of times and polarities.

    Raises:
        OSError: It cannot be read.
    """
    try:
        kind = _kind(path)
        if kind in ("NPZ", "NPY", "MAT"):
            return True
        with path.open("rb") as file:
            start = file.read(1 << 13)
        if start.startswith(b"\x1f\x8b"):
            with gzip.open(path) as zipped:
                start = zipped.read(1 << 13)
    except (*DAMAGE, gzip.BadGzipFile) as error:
        if isinstance(error, OSError) and not isinstance(error, gzip.BadGzipFile):
            raise
        return False
    if start.startswith(_UTF_16):
        start = start[: len(start) // 2 * 2].decode("utf-16", "replace").encode()
    return _TEXT.fullmatch(start) is not None and _Text(start, None).fields is not None


def _fields_of_two(path: Path, archive: zipfile.ZipFile) -> Fields | None:
    """Which of two arrays without telling names are times and polarities, by their values."""
    names = [member.removesuffix(".npy") for member in archive.namelist()]
    if len(names) != 2:
        return None
    try:
        with ExitStack() as stack:
            columns = [NpzColumn(path, archive, name, stack, kinds="iufbUS") for name in names]
            return fields_of_values([column.take(LOOKED_AT) for column in columns])
    except InputError:
        return None


def _is_table(archive: zipfile.ZipFile, name: str) -> bool:
    try:
        with archive.open(name) as member:
            shape, _, dtype = npy_header(member)
    except (ValueError, *DAMAGE):
        return False
    return bool(dtype.names) or (len(shape) == 2 and 1 < min(shape) <= 8)


def _kind(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(b"PK\x03\x04") or path.suffix.lower() == ".npz":
        return "NPZ"
    if start.startswith(_NPY):
        return "NPY"
    return "MAT" if start.startswith(_MAT) or path.suffix.lower() == ".mat" else "CSV"


def _columns_of(array: NDArray[Any]) -> list[NDArray[Any]]:
    if array.dtype.names:
        return [array[name].ravel() for name in array.dtype.names]
    return list(array.T if array.shape[0] >= array.shape[1] else array)


def _mat_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays of a MATLAB file by their names, those inside of structures too."""
    from scipy.io import loadmat, whosmat

    try:
        declared = sum(math.prod(map(int, shape)) for _, shape, _ in whosmat(path)) * _MAT_VALUE_BYTES
        if declared > _MOST_MAT_BYTES:
            raise InputError(
                f"{path}: holds {declared / 1e6:.0f} MB, expected at most {_MOST_MAT_BYTES / 1e6:.0f},"
                " as they are read at once: save them as HDF5 (-v7.3)"
            )
        found = loadmat(path, simplify_cells=True)
    except InputError:
        raise
    except Exception as error:
        # A damaged file makes SciPy fail in any way.
        raise InputError(f"{path}: found no MAT file, expected one ({said(error)})") from error

    arrays: dict[str, NDArray[Any]] = {}

    def collect(inside: Mapping[str, Any]) -> None:
        for name, value in inside.items():
            if isinstance(value, Mapping):
                collect(value)
            elif not name.startswith("__") and isinstance(value, np.ndarray) and value.dtype.kind in "biufU":
                arrays.setdefault(name, value)

    collect(found)
    return arrays


class _Array:
    """A table in one array, structured, (n, k) or (k, n), read from front to back."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self.path = path
        try:
            self._shape, on_end, self._dtype = npy_header(file)
        except ValueError as error:
            raise InputError(f"{path}: {error}") from error
        self.what = f"{self._dtype} {self._shape}"
        many = len(self._shape) == 2 and not self._dtype.names
        if self._dtype.hasobject or not (self._dtype.names or many) or 0 in self._shape:
            raise InputError(
                f"{path}: found an array of {self.what}, expected columns of times and polarities"
            )
        self._file, self._row = file, 0
        self._rows = max(self._shape)
        self._whole: list[NDArray[Any]] | None = None
        on_its_side = many and self._shape[0] < self._shape[1]
        if on_its_side or (many and on_end):
            # Its columns lie one behind the other.
            data = file.read()
            order: Literal["F", "C"] = "F" if on_end else "C"
            if len(data) != self._dtype.itemsize * int(np.prod(self._shape)):
                raise InputError(f"{path}: found {len(data)} bytes, expected an array of {self.what}")
            self._whole = _columns_of(
                np.frombuffer(data, self._dtype).reshape(self._shape[0], self._shape[-1], order=order)
            )
        self._ahead: list[NDArray[Any]] = []

    @property
    def done(self) -> float:
        """Share of the rows that is read."""
        return self._row / self._rows

    def fields(self) -> Fields | None:
        """Which column is what, by their names, or else by the first rows."""
        self._ahead = self._read(LOOKED_AT)
        named = fields_of(self._dtype.names) if self._dtype.names else None
        return named or fields_of_values(self._ahead)

    def take(self, rows: int) -> list[NDArray[Any]]:
        """The next rows of every column."""
        ahead, self._ahead = self._ahead, []
        return ahead or self._read(rows)

    def _read(self, rows: int) -> list[NDArray[Any]]:
        first, last = self._row, min(self._row + rows, self._rows)
        self._row = last
        if self._whole is not None:
            return [column[first:last] for column in self._whole]
        width = 1 if self._dtype.names else self._shape[1]
        size = (last - first) * width * self._dtype.itemsize
        data = self._file.read(size)
        if len(data) < size:
            raise InputError(f"{self.path}: row {first + 1}: the file ends, expected {self._rows} rows")
        values = np.frombuffer(data, self._dtype)
        if self._dtype.names:
            return [values[name] for name in self._dtype.names]
        return list(values.reshape(-1, width).T)


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
        start: The first bytes.
        fields: Which column is what; None: as its heading or its values say.
    """

    def __init__(self, start: bytes, fields: Fields | None) -> None:
        self._mark = start.removeprefix(b"\xef\xbb\xbf") != start
        lines = start.removeprefix(b"\xef\xbb\xbf").splitlines()[:512]
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
        which = self.fields.which
        kept = [line for _, line in self._data(lines, first)]
        if not kept:
            return (np.empty(0, np.int64), np.empty(0, np.int64), None), 0
        if self._separator != b",":
            kept = [_DECIMAL_COMMA.sub(b".", line) for line in kept] if b"," in kept[0] else kept
        if found := self._loaded(kept, which):
            return found, 0
        cut = 0
        if last_is_cut and not self._is_row(kept[-1]):
            # Whoever wrote it was stopped.
            kept, cut = kept[:-1], 1
            if not kept or (found := self._loaded(kept, which)):
                return found or (np.empty(0, np.int64), np.empty(0, np.int64), None), cut
        whole = lines[:-1] if cut else lines
        return _split(np.array([self._cells_of(k, line) for k, line in self._data(whole, first)])), cut

    def _data(self, lines: list[bytes], first: int) -> Iterator[tuple[int, bytes]]:
        """Number and text of those that are rows of the table, from `first` on."""
        return ((k, line) for k, line in enumerate(lines, first) if k >= self.first and _is_data(line))

    def _cells_of(self, number: int, line: bytes) -> list[str]:
        """The cells of a row that count."""
        assert self.fields is not None
        if not self._is_row(line):
            more = ", x and y" if self.fields.places else ""
            raise _LineError(number, f"found {show(line)}, expected a time and a polarity{more}")
        cells = self.cells(line)
        return [cells[k] or "nan" for k in self.fields.which]

    def number(self, lines: list[bytes], first: int, row: int) -> int:
        """In which line the row stands, of these from `first` on, the row from 0."""
        data = (k for k, line in enumerate(lines, first) if k >= self.first and _is_data(line))
        return next(itertools.islice(data, row, None))

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
            return _is_number(cells[self.fields.polarity])
        return True


def _split(cells: NDArray[np.str_]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any] | None]:
    """Times, polarities and places of cells (n, 2 or 4).

    Raises:
        ValueError: A time or a place is no number.
    """
    cells = np.char.strip(cells, " \t\"'")
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


def _check_lengths(target: Path, columns: list[NpzColumn]) -> None:
    """Refuse arrays of other lengths."""
    lengths = {column.name: column.rows for column in columns}
    if any(column.is_scalar for column in columns) or len(set(lengths.values())) > 1:
        raise InputError(f"{target}: found arrays of the lengths {lengths}, expected one length")
