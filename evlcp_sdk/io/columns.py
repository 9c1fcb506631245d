"""Columns of times, polarities and places, as any table has them, to events: units, wraps, order."""

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

from evlcp_sdk.errors import InputError
from evlcp_sdk.io._sieve import Sieve
from evlcp_sdk.io.fields import Polarities, RowError, TimeUnit, time_unit
from evlcp_sdk.plugin.source import EventSource, Loss
from evlcp_sdk.plugin.writer import LAST_TIME_US
from evlcp_sdk.values import Events, Triggers

PIECE_ROWS: Final = 1 << 16

MOST_WAITING: Final = 1 << 20
"""Rows that wait for earlier ones: a table of fewer may be in any order."""

WINDOW_US: Final = 10_000
"""How late an event of a camera may come to be sorted in, us."""

_PLACES: Final = 1 << 16

_COARSE_US: Final = 20
"""Steps of times that are said, us: a fifth of a chip of 100 us; slower lights allow for more."""

_COUNTERS: Final = ((0, 1 << 32, 1 << 26), (-(1 << 31), 1 << 31, 1 << 26), (0, 1 << 24, 1 << 17))
"""Counters that times are kept in: first value, end, and how near to both one was if it went round.

For 32 bits of microseconds that is 67 s; for 24, which are full after 17 s, 131 ms.
"""

DAMAGE: Final = (OSError, EOFError, ValueError, RuntimeError, zlib.error, lzma.LZMAError, zipfile.BadZipFile)
"""What reading a damaged file raises; RuntimeError: a ZIP file's member is encrypted."""


@dataclass(frozen=True)
class Piece:
    """Some rows of a table.

    Attributes:
        columns: Their times, int64 or float64 (n,), polarities, numbers or words (n,), and x and y (n,),
            where there are any.
        number: In which line or row of the file the k-th of them stands.
        done: How much of the file is read behind them, bytes.
        cut: Rows at the end that are left out, as they are not whole.
    """

    columns: tuple[NDArray[Any], ...]
    number: Callable[[int], int]
    done: int
    cut: int = 0


@dataclass(frozen=True)
class EventTable:
    """What a file of columns holds.

    Attributes:
        format: Its name.
        pieces: Its rows.
        unit: The unit that the name of the times says; None where it says none.
        where: What rows are called: `line` or `row`.
        size: Columns and rows of the sensor, or None.
        triggers: External ones, by time, where it has some.
        window_us: How much earlier than those before a row may be to be sorted in, us; beyond that the
            camera's clock has leapt, or it is dropped.
    """

    format: str
    pieces: Iterator[Piece]
    unit: str | None = None
    where: str = "row"
    size: tuple[int | None, int | None] = (None, None)
    triggers: Iterator[Triggers] | None = None
    window_us: float = math.inf


class ColumnSource(EventSource):
    """A table of times and polarities, and of places where it has them, read piece by piece.

    The unit of the times is the one that is named, or else guessed, see `time_unit`; `header` says which, and
    why. Times of 32 or 24 bits may go round. Rows may be in any order as far as a million of them go; they
    are sorted, and counted. Rows whose time, polarity or place is no number are dropped, and counted.

    Args:
        path: The file.
        read: Opens it on a stack that closes it.
        unit: The unit that the caller says, whatever the file does.
        inverted: The larger polarity is OFF.

    Raises:
        InputError: It cannot be opened, or its first piece not be read.
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
                raise InputError(f"{path}: {what or f'damaged or closed file: {one_line(error)}'}") from error
            self._begin(table, size_bytes, unit, inverted)
            self._stack = stack.pop_all()

    def _begin(self, table: EventTable, size_bytes: int, unit: str | None, inverted: bool) -> None:
        """Read the first piece, and see in which unit its times are."""
        self._pieces, self._position, self._end = table.pieces, 0, size_bytes
        self._counts = {"rows_out_of_order": 0, "rows_cut": 0, "times_gone_round": 0}
        self._where, self._inverted, self._window_us = table.where, inverted, table.window_us
        self._dropped = Loss(0, 0, table.where, "rows whose time, polarity or place is no number; dropped")
        first = self._next_piece()
        times = np.empty(0, np.int64) if first is None else _unwrap(first.columns[0], None, 0)[0]
        if first is not None:
            self._pieces = itertools.chain((first,), table.pieces)
        share = min(self._position / max(size_bytes, 1), 1.0)
        placed = first is not None and len(first.columns) > 2
        self._unit = TimeUnit(unit or "", "as told", sure=True)
        if not unit:
            self._unit = time_unit(times, table.unit, share, placed=placed)
        self._polarities = Polarities()
        self._sieve = Sieve(table.where, *table.size)
        self._row = first.number(0) if first is not None and len(times) else 1
        self._fault: InputError | None = None
        self._merged = _with_triggers(self._sorted(), table.triggers or iter(()))
        header = {
            "pixels": "as its columns x and y say" if placed else "none given: x = y = 0",
            "time": f"in {self._unit.name}, {self._unit.why}",
        }
        self.step_us = _step_us(self._unit, times)
        if self.step_us >= _COARSE_US:
            header["step"] = f"times are rounded to {_in_words(self.step_us)}"
        super().__init__(self.path, table.format, *table.size, header, size_bytes)
        self.guessed = "; ".join(filter(None, (self._unit.guess, header.get("step"))))

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """As `EventSource.take`; where a row is none of a time and a polarity, an InputError."""
        if self._fault is not None:
            raise self._fault
        try:
            return next(self._merged, None)
        except InputError as fault:
            self._fault = fault
            raise

    def _sorted(self) -> Iterator[Events]:
        """All events by time. What comes before a fault is given first."""
        pieces, waiting, fault, more = self._events(), list[Events](), None, True
        while more:
            try:
                while more and sum(map(len, waiting)) < MOST_WAITING:
                    events = next(pieces, None)
                    more = events is not None
                    waiting += [] if events is None else [events]
            except InputError as wrong:
                fault, more = wrong, False
            events = _in_order(Events.concat(waiting), self._window_us)
            # What may still be earlier waits, unless all is read.
            due = len(events) // 2 if more else len(events)
            waiting = [events[due:]]
            yield self._sieve.sift(events[:due], self._row)
            self._row += due
        yield self._sieve.close()
        if fault is not None:
            raise fault

    def _next_piece(self) -> Piece | None:
        try:
            piece = next(self._pieces, None)
        except DAMAGE as error:
            raise InputError(f"{self.path}: damaged or closed file: {one_line(error)}") from error
        self._position = self._end if piece is None else piece.done
        return piece

    def _events(self) -> Iterator[Events]:
        """The events of each piece, in its order; those before a row that is wrong, too."""
        before: int | None = None
        latest_us: int | None = None
        gone_round = 0
        while (found := self._next_piece()) is not None:
            self._counts["rows_cut"] += found.cut
            piece = self._numbers_of(found)
            counted, polarities, *places = piece.columns
            times, turns, gone_round = _unwrap(counted, before, gone_round)
            before = int(counted[-1]) if len(counted) and math.isfinite(counted[-1]) else before
            if turns > 0 and not self._counts["times_gone_round"]:
                self.guessed = "; ".join(filter(None, (self.guessed, "the counter of times went round")))
            self._counts["times_gone_round"] += max(turns, 0)
            rows, wrong = len(times), None
            while True:
                try:
                    t_us, p = self._unit.us(times[:rows]), self._polarities.of(polarities[:rows])
                    x, y = (_whole(c[:rows]) for c in places or np.zeros((2, rows), np.uint16))
                    break
                except RowError as error:
                    rows = error.row
                    wrong = InputError(f"{self.path}: {self._where} {piece.number(rows)}: {error}")
            if len(t_us):
                start_us = t_us[0] if latest_us is None else np.int64(latest_us)
                latest = np.maximum.accumulate(np.concatenate([[start_us], t_us]))
                self._counts["rows_out_of_order"] += int((t_us < latest[:-1]).sum())
                latest_us = int(latest[-1])
            yield Events(t_us, x, y, 1 - p if self._inverted else p)
            if wrong is not None:
                raise wrong

    def _numbers_of(self, piece: Piece) -> Piece:
        """A piece without the rows in which something is no number; they are counted."""
        good = np.logical_and.reduce([_is_given(column) for column in piece.columns])
        if good.all():
            return piece
        kept = np.flatnonzero(good)
        self._dropped = self._dropped.more(len(good) - len(kept), piece.number(int((~good).argmax())))
        columns = tuple(column[kept] for column in piece.columns)
        return replace(piece, columns=columns, number=lambda row: piece.number(int(kept[row])))

    @property
    def counts(self) -> dict[str, int]:
        """As `EventSource.counts`, with rows out of order or cut, and times gone round, if there were any."""
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


def _with_triggers(
    pieces: Iterator[Events], triggers: Iterator[Triggers]
) -> Iterator[tuple[Events, Triggers]]:
    """Events with the triggers up to the last of each piece; those of a long file are never all at hand."""
    ahead = next(triggers, None)
    for events in pieces:
        rest = events
        while ahead is not None and len(rest):
            due = int(np.searchsorted(ahead.t_us, rest.t_us[-1], "right"))
            if due < len(ahead):
                break
            n = int(np.searchsorted(rest.t_us, ahead.t_us[-1], "right"))
            yield rest[:n], ahead
            rest, ahead = rest[n:], next(triggers, None)
        due = 0 if ahead is None or not len(rest) else due
        yield rest, Triggers.empty() if ahead is None else ahead[:due]
        ahead = None if ahead is None else ahead[due:]
    while ahead is not None:
        yield Events.empty(), ahead
        ahead = next(triggers, None)


def _unwrap(times: NDArray[Any], before: int | None, gone_round: int) -> tuple[NDArray[Any], int, int]:
    """Times of a counter that goes round, as if it did not; how often it has, and by how much in all.

    Args:
        times: The next ones; of other counters they stay.
        before: The one before them; None for none.
        gone_round: By how much it had gone round until then.
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
    whole = times.astype(np.float64 if times.dtype.kind == "f" else np.int64)
    last = int(turns[-1]) if len(turns) else 0
    return whole + (turns * size + gone_round), last, last * size + gone_round


def _in_order(events: Events, window_us: float) -> Events:
    """Events sorted by time, as far as each is no more than a window earlier than those before it."""
    t_us = events.t_us
    if not (np.diff(t_us) < 0).any():
        return events
    begins = [0]
    while (rest := t_us[begins[-1] :]).size:
        leaps = rest < np.maximum.accumulate(rest) - window_us
        if not leaps.any():
            break
        begins.append(begins[-1] + int(leaps.argmax()))
    order = np.concatenate(
        [a + np.argsort(t_us[a:b], kind="stable") for a, b in itertools.pairwise([*begins, len(t_us)])]
    )
    return Events(t_us[order], events.x[order], events.y[order], events.p[order])


def _step_us(unit: TimeUnit, times: NDArray[Any]) -> int:
    """What all times are multiples of, us, but for the first; 0 where there are too few to tell."""
    finite = times[np.isfinite(times)]
    with np.errstate(over="ignore"):
        steps = np.diff(np.unique(finite)) * unit.factor
    if len(finite) < 1000:
        return 0
    if not len(steps):
        # A thousand events at one time.
        return 1_000_000
    if times.dtype.kind == "f" and times.dtype.itemsize == 8:
        digits = np.spacing(np.abs(finite).max()) * unit.factor
        steps = steps[steps > 4 * digits] if digits > 0.01 else steps
    sure = np.rint(steps[(steps >= 0.5) & (steps < LAST_TIME_US)]).astype(np.int64)
    return math.gcd(*sure.tolist())


def _in_words(step_us: int) -> str:
    if step_us < 1000:
        return f"{step_us} us"
    return f"{step_us / 1000:g} ms" if step_us < 1_000_000 else f"{step_us / 1e6:g} s"


def _is_given(column: NDArray[Any]) -> Any:
    """Where a column has a number, or a word, bool (n,)."""
    if column.dtype.kind in "US":
        return ~np.isin(np.char.lower(column), np.array(["nan", ""]).astype(column.dtype.kind))
    return np.isfinite(column)


def _whole(places: NDArray[Any]) -> NDArray[np.uint16]:
    wrong = ~((places >= 0) & (places < _PLACES) & (places == np.rint(places)))
    if wrong.any():
        row = int(wrong.argmax())
        raise RowError(row, f"place {places[row]}, expected whole numbers from 0 to {_PLACES - 1}")
    return places.astype(np.uint16)


def one_line(error: Exception) -> str:
    """What an error says, in one line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 200 else f"{text[:200]}..."
