"""Lists of events without coordinates: time and polarity of one group of pixels, as CSV or NPZ."""

import gzip
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import InputError
from evlcp_sdk.io._sieve import Sieve
from evlcp_sdk.io.tables import DAMAGE, NpzColumn, said, show
from evlcp_sdk.io.writers import LAST_TIME_US
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.values import Events, Triggers

__all__ = ["ListColumns", "ListSource", "TimeUnit", "columns_of", "is_list", "time_unit"]

UNITS_US: Final = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
_TIME: Final = re.compile(r"(?:t|ts|time|timestamp)[ _]?[(\[]?(s|ms|us|µs|ns)?[)\]]?")
_POLARITY: Final = ("p", "pol", "polarity")
_PLACE: Final = ("x", "y")
_WORDS: Final = ((b"true", b"1"), (b"false", b"0"))

PIECE_BYTES: Final = 1 << 20
LOOKED_AT: Final = 1 << 14
"""Times at the start from which the unit is recognized."""

LEAST_RATE_HZ: Final = 20.0
MOST_RATE_HZ: Final = 5e7
"""Events a second of pixels that see a blinking light: with fewer, or more, the unit is another."""


@dataclass(frozen=True)
class TimeUnit:
    """What the times of a list count.

    Attributes:
        name: `s`, `ms`, `us` or `ns`.
        why: How that is known, for `evlcp info`.
    """

    name: str
    why: str

    def us(self, times: NDArray[Any]) -> NDArray[np.int64]:
        """Times in us, int64 (n,), rounded down."""
        if times.dtype.kind == "f":
            # To a thousandth before that: 0.000057 s times 1e6 is a little less than 57.
            scaled = np.round(times * UNITS_US[self.name], 3)
            if not np.isfinite(scaled).all() or np.abs(scaled).max(initial=0.0) > LAST_TIME_US:
                raise ValueError("a time that is no number or too large")
            return np.floor(scaled).astype(np.int64)
        if self.name == "ns":
            return times // 1000
        factor = round(UNITS_US[self.name])
        if len(times) and max(int(times.max()), -int(times.min())) > LAST_TIME_US // factor:
            raise ValueError("a time that is too large")
        return times * factor


@dataclass(frozen=True)
class ListColumns:
    """Which columns of a table are time and polarity.

    Attributes:
        time: Number of the column of times.
        polarity: Number of the column of polarities.
        unit: The unit that the name of the first one says; None where it says none.
    """

    time: int
    polarity: int
    unit: str | None


def columns_of(names: Sequence[str]) -> ListColumns | None:
    """The columns of a list of events by their names; None where it has no time or polarity, or has places.

    >>> columns_of(["p", "t_ms"])
    ListColumns(time=1, polarity=0, unit='ms')
    >>> columns_of(["t", "x", "y", "p"]) is None
    True
    """
    plain = [name.strip().strip('"').lower() for name in names]
    times = [(k, match) for k, name in enumerate(plain) if (match := _TIME.fullmatch(name))]
    polarities = [k for k, name in enumerate(plain) if name in _POLARITY]
    if len(times) != 1 or len(polarities) != 1 or any(name in _PLACE for name in plain):
        return None
    (time, match), (polarity,) = times[0], polarities
    unit = match[1]
    return ListColumns(time, polarity, "us" if unit == "µs" else unit)


def time_unit(times: NDArray[Any], named: str | None) -> TimeUnit:
    """The unit of times: the one that their column's name says, or else what cameras do.

    A camera counts microseconds, whole ones: nanoseconds of one are multiples of 1000, milliseconds have
    three decimals, seconds six. A unit by which less than 20 or more than 50 million events come a second is
    another one.

    Args:
        times: The first ones, in any order, int64 or float64 (n,).
        named: The unit of the name; None for none.

    >>> time_unit(np.array([0.000125, 0.000893, 0.00131]), None).name
    's'
    >>> time_unit(np.array([125, 893, 1310]), None).name
    'us'
    """
    if named is not None:
        return TimeUnit(named, "as its column says")
    inside = np.sort(times)
    span = float(inside[-1] - inside[0]) if len(inside) > 1 else 0.0

    def rate_hz(unit: str) -> float:
        return (len(inside) - 1) / (span * UNITS_US[unit] * 1e-6) if span > 0 else LEAST_RATE_HZ

    if times.dtype.kind != "f" or (times == np.round(times)).all():
        whole = inside - inside[:1]
        if span > 0 and (whole % 1000 == 0).all() and rate_hz("ns") <= MOST_RATE_HZ:
            return TimeUnit("ns", "guessed: whole numbers, all multiples of 1000")
        if rate_hz("us") > MOST_RATE_HZ:
            return TimeUnit("ns", "guessed: whole numbers, too close for us")
        return TimeUnit("us", "guessed: whole numbers")
    decimals = 3 if np.abs(times * 1e3 - np.round(times * 1e3)).max() < 1e-4 else 6
    likely = ("ms", "us") if decimals == 3 else ("s", "ms", "us")
    for unit in likely:
        if rate_hz(unit) >= LEAST_RATE_HZ:
            return TimeUnit(unit, f"guessed: {decimals} decimals or more, {rate_hz(unit):.3g} events/s")
    return TimeUnit("us", "guessed: too far apart for ms")


def _polarities(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Polarities of 0 and 1, or -1 and 1, uint8 (n,)."""
    wrong = ~np.isin(values, (-1, 0, 1))
    if wrong.any():
        raise ValueError(f"polarity {values[int(wrong.argmax())]}, expected 0 or 1, or -1 or 1")
    return (values > 0).astype(np.uint8)


Piece = tuple[NDArray[Any], NDArray[Any], int]
"""Times, polarities, and the line or row of the first."""


class ListSource(EventSource):
    """A table of times and polarities of events, without places: every event is of pixel (0, 0).

    A CSV file, plain or gzipped, with columns named `t` (or `time`, `timestamp`) and `p` (or `polarity`), or
    of two columns without names; or an NPZ file of such arrays. The unit of the times is the one that the
    name says (`t_us`, `t_ms`, `t_s`, `t_ns`), or else guessed, see `time_unit`; `header` says which, and why.

    Args:
        path: The file.

    Raises:
        InputError: The file cannot be read, or has no such columns.
    """

    def __init__(self, path: Path | str) -> None:
        target = Path(path)
        self.path, self._position = target, 0
        try:
            size = target.stat().st_size
            is_npz = zipfile.is_zipfile(target)
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        with ExitStack() as stack:
            self._unit_of: str | None = None
            self._pieces = self._npz(target, stack) if is_npz else self._csv(target, stack)
            self._where = "row" if is_npz else "line"
            self._sieve = Sieve(self._where, None, None)
            try:
                first = next(self._pieces, None)
            except (*DAMAGE, zlib.error) as error:
                raise InputError(f"{path}: {said(error)}") from error
            self._first = first
            times = np.empty(0, np.int64) if first is None else first[0][:LOOKED_AT]
            self._unit = time_unit(times, self._unit_of)
            header = {"pixels": "none given: x = y = 0", "time": f"in {self._unit.name}, {self._unit.why}"}
            kind = "NPZ" if is_npz else "CSV"
            super().__init__(target, kind, header=header, size_bytes=size, ledger=self._sieve)
            self._stack = stack.pop_all()

    def _csv(self, target: Path, stack: ExitStack) -> Iterator[Piece]:
        raw = stack.enter_context(target.open("rb"))
        zipped = raw.read(2) == b"\x1f\x8b"
        raw.seek(0)
        file: Any = stack.enter_context(gzip.GzipFile(fileobj=raw)) if zipped else raw
        text = file.read(PIECE_BYTES).removeprefix(b"\xef\xbb\xbf")
        head, _, rest = text.partition(b"\n")
        columns, separator, named = _heading(head)
        if columns is None:
            raise InputError(f"{target}: line 1: found {show(head)}, expected the columns t and p")
        line, rest = (2, rest) if named else (1, text)
        self._unit_of = columns.unit
        return self._csv_pieces(raw, file, rest, separator, columns, line)

    def _csv_pieces(
        self, raw: Any, file: Any, text: bytes, separator: bytes, columns: ListColumns, line: int
    ) -> Iterator[Piece]:
        while True:
            more = file.read(PIECE_BYTES)
            self._position = raw.tell()
            text += more
            whole = text if not more else text[: text.rfind(b"\n") + 1]
            text = text[len(whole) :]
            lines = whole.splitlines()
            if any(map(bytes.strip, lines)):
                yield (*_numbers(self._fault, lines, separator, columns, line), line)
            line += len(lines)
            if not more:
                return

    def _npz(self, target: Path, stack: ExitStack) -> Iterator[Piece]:
        archive = stack.enter_context(zipfile.ZipFile(target))
        names = [member.removesuffix(".npy") for member in archive.namelist()]
        columns = columns_of(names)
        if columns is None:
            raise InputError(f"{target}: found the arrays {', '.join(sorted(names))}, expected t and p")
        self._unit_of = columns.unit
        of_time, of_polarity = (
            NpzColumn(target, archive, names[k], stack, kinds=kinds, bounded=False)
            for k, kinds in ((columns.time, "iuf"), (columns.polarity, "iubf"))
        )
        if of_time.rows != of_polarity.rows:
            raise InputError(
                f"{target}: found {of_time.rows} times and {of_polarity.rows} polarities, expected one length"
            )
        return self._npz_pieces(of_time, of_polarity)

    def _npz_pieces(self, of_time: NpzColumn, of_polarity: NpzColumn) -> Iterator[Piece]:
        size = self._size_of(of_time)
        while of_time.row < of_time.rows:
            row = of_time.row + 1
            times, polarities = of_time.take(1 << 16), of_polarity.take(1 << 16)
            self._position = round(size * of_time.row / of_time.rows)
            yield (times if times.dtype.kind == "f" else times.astype(np.int64)), polarities, row

    def _size_of(self, column: NpzColumn) -> int:
        return column.rows * column.dtype.itemsize

    def _fault(self, line: int, what: str) -> InputError:
        return InputError(f"{self.path}: line {line}: {what}")

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """As `EventSource.take`.

        Raises:
            InputError: The file cannot be read on, or a row is none of a time and a polarity.
        """
        piece, self._first = self._first, None
        try:
            piece = next(self._pieces, None) if piece is None else piece
        except (*DAMAGE, zlib.error) as error:
            raise InputError(f"{self.path}: damaged or closed file: {said(error)}") from error
        if piece is None:
            events = self._sieve.close()
            return (events, Triggers.empty()) if len(events) else None
        times, polarities, first = piece
        try:
            t_us, p = self._unit.us(times), _polarities(polarities)
        except ValueError as error:
            raise InputError(f"{self.path}: from {self._where} {first} on: {error}") from error
        nowhere = np.zeros(len(t_us), np.uint16)
        return self._sieve.sift(Events(t_us, nowhere, nowhere.copy(), p), first), Triggers.empty()

    @property
    def position_bytes(self) -> int:
        """How much of the file is read."""
        return min(self._position, self.size_bytes or 0)

    def close(self) -> None:
        """Close the file."""
        self._stack.close()


def is_list(path: Path) -> bool:
    """Whether a file is a CSV or NPZ file of times and polarities without places.

    Raises:
        OSError: It cannot be read.
    """
    if zipfile.is_zipfile(path):
        try:
            with zipfile.ZipFile(path) as archive:
                return columns_of([name.removesuffix(".npy") for name in archive.namelist()]) is not None
        except DAMAGE:
            return False
    try:
        with path.open("rb") as file:
            start = file.read(512)
        if start.startswith(b"\x1f\x8b"):
            with gzip.open(path) as zipped:
                start = zipped.read(512)
    except (EOFError, zlib.error, gzip.BadGzipFile):
        return False
    return _heading(start.removeprefix(b"\xef\xbb\xbf").partition(b"\n")[0])[0] is not None


def _heading(line: bytes) -> tuple[ListColumns | None, bytes, bool]:
    """What the first line of a CSV file says: its columns, what separates them, whether it names them."""
    separator = next((mark for mark in (b",", b";", b"\t") if mark in line), b" ")
    cells = line.decode("utf-8", "replace").strip().split(separator.decode())
    columns = columns_of(cells)
    if columns is None and len(cells) == 2 and all(map(_is_number, cells)):
        return ListColumns(0, 1, None), separator, False
    return columns, separator, True


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _numbers(
    fault: Callable[[int, str], InputError],
    lines: list[bytes],
    separator: bytes,
    columns: ListColumns,
    first: int,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Times and polarities of lines of text, int64 where all times are whole numbers, else float64."""
    kept = [line for line in lines if line.strip()]
    mark = None if separator == b" " else separator.decode()
    if any(word in line.lower() for line in kept[:2] for word, _ in _WORDS):
        for word, digit in _WORDS:
            kept = [line.lower().replace(word, digit) for line in kept]
    which = (columns.time, columns.polarity)
    for kind in (np.dtype(np.int64), np.dtype(np.float64)):
        try:
            found = np.loadtxt(kept, kind, None, mark, usecols=which, ndmin=2)
        except (ValueError, OverflowError):
            continue
        return found[:, 0], found[:, 1]
    for number, line in enumerate(lines, first):
        cells = line.decode("utf-8", "replace").split(mark)
        if line.strip() and not (len(cells) > max(which) and all(_is_number(cells[k]) for k in which)):
            raise fault(number, f"found {show(line)}, expected a time and a polarity")
    raise fault(first, "found something else than times and polarities")
