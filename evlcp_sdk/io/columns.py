"""Convert the columns of any table to events: units, wraps of counters, order."""

import itertools
import lzma
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import InputError, short_message
from evlcp_sdk.io._sieve import Sieve
from evlcp_sdk.io.fields import Polarities, RowError, TimeUnit, infer_time_unit
from evlcp_sdk.plugin.source import EventSource, Loss
from evlcp_sdk.plugin.writer import LAST_TIME_US
from evlcp_sdk.values import Events, Triggers

PIECE_ROWS: Final = 1 << 16

MAX_WAITING_ROWS: Final = 1 << 20
"""Rows that wait for earlier ones; a table of fewer rows may be in any order."""

WINDOW_US: Final = 10_000
"""How late an event of a camera may come and still be sorted in, us."""

_MAX_SIDE: Final = 1 << 16

_COARSE_US: Final = 20
"""Least step of times to report, us: a fifth of a chip of 100 us; slower lights allow more."""

_COUNTERS: Final = ((0, 1 << 32, 1 << 26), (-(1 << 31), 1 << 31, 1 << 26), (0, 1 << 24, 1 << 17))
"""Counters of times: first value, end, and how close to these a wrap starts and ends.

That is 67 s for 32 bits of microseconds, and 131 ms for 24, which are full after 17 s.
"""

DAMAGE: Final = (OSError, EOFError, ValueError, RuntimeError, zlib.error, lzma.LZMAError, zipfile.BadZipFile)
"""Errors of reading a damaged file; a RuntimeError is that of an encrypted member of a ZIP file."""


@dataclass(frozen=True)
class Piece:
    """Some rows of a table.

    Attributes:
        columns: Times, int64 or float64 (n,), polarities, numbers or words (n,), and perhaps x and y (n,).
        row_number: Returns the line or row of the file of the k-th of them.
        end_bytes: How much of the file is read after them.
        cut_rows: Incomplete rows at the end, which are left out.
    """

    columns: tuple[NDArray[Any], ...]
    row_number: Callable[[int], int]
    end_bytes: int
    cut_rows: int = 0


@dataclass(frozen=True)
class EventTable:
    """The contents of a file of columns.

    Attributes:
        format: Name of the format.
        pieces: The rows.
        unit: The unit in the name of the times; None without one.
        row_name: `line` or `row`.
        size: Columns and rows of the sensor, or None.
        triggers: External triggers, by time, if there are any.
        window_us: How much earlier than those before a row may be and still be sorted in, us; beyond that the
            camera's clock has leapt, or the row is dropped.
    """

    format: str
    pieces: Iterator[Piece]
    unit: str | None = None
    row_name: str = "row"
    size: tuple[int | None, int | None] = (None, None)
    triggers: Iterator[Triggers] | None = None
    window_us: float = math.inf


class ColumnSource(EventSource):
    """Reads a table of times and polarities, and perhaps of x and y, piece by piece.

    The unit of the times is stated, or else guessed by `infer_time_unit`; `header` has it, and why. Times of
    32 or 24 bits may wrap. Rows may be in any order within a million of them; they are sorted, and counted.
    Rows with a time, polarity, x or y that is not a number are dropped, and counted.

    Args:
        path: The file.
        read: Opens it on a stack that closes it.
        unit: The unit that the caller states, whatever the file does.
        inverted: Whether the larger polarity is OFF.

    Raises:
        InputError: It cannot be opened, or its first piece cannot be read.
    """

    def __init__(
        self,
        path: Path | str,
        read: Callable[[Path, ExitStack], EventTable],
        *,
        unit: str | None = None,
        inverted: bool = False,
    ) -> None:
        self.path = Path(path)
        with ExitStack() as stack:
            try:
                table = read(self.path, stack)
                size_bytes = self.path.stat().st_size
            except DAMAGE as error:
                what = error.strerror if isinstance(error, OSError) else None
                raise InputError(
                    f"{path}: {what or f'damaged or closed file: {short_message(error)}'}"
                ) from error
            self._read_first_piece(table, size_bytes, unit, inverted)
            self._stack = stack.pop_all()

    def _read_first_piece(self, table: EventTable, size_bytes: int, unit: str | None, inverted: bool) -> None:
        """Read the first piece and find the unit of its times."""
        self._pieces, self._position, self._end = table.pieces, 0, size_bytes
        self._counts = {"rows_out_of_order": 0, "rows_cut": 0, "times_gone_round": 0}
        self._row_name, self._inverted, self._window_us = table.row_name, inverted, table.window_us
        self._dropped = Loss(0, 0, table.row_name, "rows whose time, polarity or place is no number; dropped")
        first = self._next_piece()
        times = np.empty(0, np.int64) if first is None else _unwrap_times(first.columns[0], None, 0)[0]
        if first is not None:
            self._pieces = itertools.chain((first,), table.pieces)
        share = min(self._position / max(size_bytes, 1), 1.0)
        has_pixels = first is not None and len(first.columns) > 2
        self._unit = TimeUnit(unit or "", "as stated", sure=True)
        if not unit:
            self._unit = infer_time_unit(times, table.unit, share, has_pixels=has_pixels)
        self._polarities = Polarities()
        row = first.row_number(0) if first is not None and len(times) else 1
        self._sieve = Sieve(table.row_name, row, *table.size)
        self._fault: InputError | None = None
        self._merged = _merge_triggers(self._sort_events(), table.triggers or iter(()))
        header = {
            "pixels": "as its columns x and y say" if has_pixels else "none given: x = y = 0",
            "time": f"in {self._unit.name}, {self._unit.why}",
        }
        self.step_us = _common_step_us(self._unit, times)
        if self.step_us >= _COARSE_US:
            scales = ((1_000_000, "s"), (1000, "ms"), (1, "us"))
            size, name = next(one for one in scales if self.step_us >= one[0])
            header["step"] = f"times are rounded to {self.step_us / size:g} {name}"
        super().__init__(self.path, table.format, *table.size, header, size_bytes)
        self.guessed = "; ".join(filter(None, (self._unit.guess, header.get("step"))))

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """As `EventSource.take`; a row without a time and a polarity raises an InputError."""
        if self._fault is not None:
            raise self._fault
        try:
            return next(self._merged, None)
        except InputError as fault:
            self._fault = fault
            raise

    def _sort_events(self) -> Iterator[Events]:
        """Yield all events by time, those before a fault first."""
        pieces, waiting, fault, has_more = self._convert_pieces(), list[Events](), None, True
        while has_more:
            try:
                while has_more and sum(map(len, waiting)) < MAX_WAITING_ROWS:
                    events = next(pieces, None)
                    has_more = events is not None
                    waiting += [] if events is None else [events]
            except InputError as wrong:
                fault, has_more = wrong, False
            events = _sort_by_time(Events.concat(waiting), self._window_us)
            # Unless all is read, the later half waits for events that may be earlier.
            due = len(events) // 2 if has_more else len(events)
            waiting = [events[due:]]
            yield from self._sieve.sift(events[:due])
        yield from self._sieve.close()
        if fault is not None:
            raise fault

    def _next_piece(self) -> Piece | None:
        try:
            piece = next(self._pieces, None)
        except DAMAGE as error:
            raise InputError(f"{self.path}: damaged or closed file: {short_message(error)}") from error
        self._position = self._end if piece is None else piece.end_bytes
        return piece

    def _convert_pieces(self) -> Iterator[Events]:
        """Yield the events of each piece, in its order, and those before a wrong row."""
        before: int | None = None
        latest_us: int | None = None
        gone_round = 0
        while (found := self._next_piece()) is not None:
            self._counts["rows_cut"] += found.cut_rows
            piece = self._drop_incomplete(found)
            counted, polarities, *places = piece.columns
            times, turns, gone_round = _unwrap_times(counted, before, gone_round)
            before = int(counted[-1]) if len(counted) and math.isfinite(counted[-1]) else before
            if turns > 0 and not self._counts["times_gone_round"]:
                self.guessed = "; ".join(filter(None, (self.guessed, "the counter of times went round")))
            self._counts["times_gone_round"] += max(turns, 0)
            rows, wrong = len(times), None
            while True:
                try:
                    t_us, p = self._unit.to_us(times[:rows]), self._polarities.decode(polarities[:rows])
                    x, y = (_to_pixels(c[:rows]) for c in places or np.zeros((2, rows), np.uint16))
                    break
                except RowError as error:
                    rows = error.row
                    wrong = InputError(f"{self.path}: {self._row_name} {piece.row_number(rows)}: {error}")
            if len(t_us):
                start_us = t_us[0] if latest_us is None else np.int64(latest_us)
                latest = np.maximum.accumulate(np.concatenate([[start_us], t_us]))
                self._counts["rows_out_of_order"] += int((t_us < latest[:-1]).sum())
                latest_us = int(latest[-1])
            yield Events(t_us, x, y, 1 - p if self._inverted else p)
            if wrong is not None:
                raise wrong

    def _drop_incomplete(self, piece: Piece) -> Piece:
        """Drop and count the rows of a piece in which something is not a number."""
        good = np.logical_and.reduce([_find_present(column) for column in piece.columns])
        if good.all():
            return piece
        kept = np.flatnonzero(good)
        self._dropped = self._dropped.add(len(good) - len(kept), piece.row_number(int((~good).argmax())))
        columns = tuple(column[kept] for column in piece.columns)
        return replace(piece, columns=columns, row_number=lambda row: piece.row_number(int(kept[row])))

    @property
    def counts(self) -> dict[str, int]:
        """As `EventSource.counts`, with rows out of order or cut, and wraps of times, if there were any."""
        return self._given | self._sieve.counts | {name: n for name, n in self._counts.items() if n}

    @property
    def losses(self) -> dict[str, Loss]:
        """As `EventSource.losses`, with `rows_dropped`."""
        dropped = {"rows_dropped": self._dropped} if self._dropped.count else {}
        return self._sieve.losses | dropped

    @property
    def position_bytes(self) -> int:
        """How much of the file is read."""
        return min(self._position, self.size_bytes or 0)

    def close(self) -> None:
        """Close the file."""
        self._fault = self._fault or InputError(f"{self.path}: closed file")
        self._stack.close()


def _merge_triggers(
    pieces: Iterator[Events], triggers: Iterator[Triggers]
) -> Iterator[tuple[Events, Triggers]]:
    """Yield each piece with the triggers up to its last event; triggers are read as they are needed."""
    coming = next(triggers, None)
    for events in pieces:
        rest = events
        while coming is not None and len(rest):
            due = int(np.searchsorted(coming.t_us, rest.t_us[-1], "right"))
            if due < len(coming):
                break
            n = int(np.searchsorted(rest.t_us, coming.t_us[-1], "right"))
            yield rest[:n], coming
            rest, coming = rest[n:], next(triggers, None)
        due = 0 if coming is None or not len(rest) else due
        yield rest, Triggers.empty() if coming is None else coming[:due]
        coming = None if coming is None else coming[due:]
    while coming is not None:
        yield Events.empty(), coming
        coming = next(triggers, None)


def _unwrap_times(times: NDArray[Any], before: int | None, gone_round: int) -> tuple[NDArray[Any], int, int]:
    """Unwrap the times of a counter of 32 or 24 bits that wrapped by `gone_round` before.

    Returns:
        The times, how often they wrapped, and by how much the counter has wrapped in all.
    """
    follow = np.concatenate([times[:1] if before is None else [before], times])
    if not gone_round and not (follow[1:] < follow[:-1]).any():
        return times, 0, 0
    finite = follow[np.isfinite(follow)]
    turns = np.zeros(len(times), np.int64)
    size = 0
    for first, end, near in _COUNTERS:
        if not len(finite) or finite.min() < first or finite.max() >= end:
            continue
        falls = (follow[:-1] >= end - near) & (follow[1:] < first + near)
        rises = (follow[:-1] < first + near) & (follow[1:] >= end - near)
        rises &= np.cumsum(falls) + gone_round > 0
        if falls.any() or rises.any():
            turns, size = np.cumsum(falls.astype(np.int64) - rises), end - first
            break
    if not gone_round and not size:
        return times, 0, 0
    values = times.astype(np.float64 if times.dtype.kind == "f" else np.int64)
    last = int(turns[-1]) if len(turns) else 0
    return values + (turns * size + gone_round), last, last * size + gone_round


def _sort_by_time(events: Events, window_us: float) -> Events:
    """Sort events by time; one that is more than a window earlier than those before it starts anew."""
    t_us = events.t_us
    if not (np.diff(t_us) < 0).any():
        return events
    starts = [0]
    while (rest := t_us[starts[-1] :]).size:
        leaps = rest < np.maximum.accumulate(rest) - window_us
        if not leaps.any():
            break
        starts.append(starts[-1] + int(leaps.argmax()))
    order = np.concatenate(
        [a + np.argsort(t_us[a:b], kind="stable") for a, b in itertools.pairwise([*starts, len(t_us)])]
    )
    return Events(t_us[order], events.x[order], events.y[order], events.p[order])


def _common_step_us(unit: TimeUnit, times: NDArray[Any]) -> int:
    """Return the greatest common divisor of the steps between times, us; 0 for too few times to tell."""
    finite = times[np.isfinite(times)]
    with np.errstate(over="ignore"):
        steps = np.diff(np.unique(finite)) * unit.length_us
    if len(finite) < 1000:
        return 0
    if not len(steps):
        # A thousand events at one time.
        return 1_000_000
    if times.dtype.kind == "f" and times.dtype.itemsize == 8:
        digits = np.spacing(np.abs(finite).max()) * unit.length_us
        steps = steps[steps > 4 * digits]
    steps_us = np.rint(steps[(steps >= 0.5) & (steps < LAST_TIME_US)]).astype(np.int64)
    return math.gcd(*steps_us.tolist())


def _find_present(column: NDArray[Any]) -> Any:
    """Return which values of a column are a number or a word, bool (n,)."""
    if column.dtype.kind in "US":
        return ~np.isin(np.char.lower(column), np.array(["nan", ""]).astype(column.dtype.kind))
    return np.isfinite(column)


def _to_pixels(places: NDArray[Any]) -> NDArray[np.uint16]:
    wrong = ~((places >= 0) & (places < _MAX_SIDE) & (places == np.rint(places)))
    if wrong.any():
        row = int(wrong.argmax())
        raise RowError(row, f"place {places[row]}, expected whole numbers from 0 to {_MAX_SIDE - 1}")
    return places.astype(np.uint16)
