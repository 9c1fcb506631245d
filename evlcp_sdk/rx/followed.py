"""A region that is followed: where it was over time, and its events."""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.values import Events, Region

SAME_PX = 5.0
"""How far apart centres of two regions of one image may be: before lit leaves an end is good to some px."""

_HEIGHTS = 9
"""Measured heights whose median is a region's: a bar ahead grows by a percent in so many steps at 80 km/h."""

_MOST_AHEAD_STEPS = 2
"""Steps beyond the measured centres for which a region goes straight on, before a shaking camera turns."""

_ROOM = 64
"""Places that find room at first; a second of steps does not fit, and is moved once in a while."""

EVENT_BYTES: Final = 13
"""Of an event: its time, column, row and polarity."""

PIECE_BYTES: Final = 768
"""Of four arrays and what holds them, however few events there are."""

Piece = tuple[int, Events]


class Places:
    """Centres and sizes of a region, oldest first, never none.

    Args:
        regions: As they were measured.

    Attributes:
        latest: The newest.

    >>> places = Places([Region(0, 0.0, 5.0, 7.0, 4.0, 9.0), Region(0, 100.0, 6.0, 7.0, 4.0, 9.0)])
    >>> len(places), places.place_at(50.0), places.place_at(1000.0), places.size_at(70.0)
    (2, (5.5, 7.0), (8.0, 7.0), (4.0, 9.0))
    """

    def __init__(self, regions: Iterable[Region]) -> None:
        regions = list(regions)
        self.latest = regions[-1]
        rows = [(p.t_us, p.x_px, p.y_px, p.width_px, p.height_px) for p in regions]
        self._columns = np.empty((5, max(2 * len(rows), _ROOM)))
        self._first, self._end = 0, len(rows)
        self._columns[:, : self._end] = np.transpose(rows)

    def __len__(self) -> int:
        return self._end - self._first

    def __iter__(self) -> Iterator[Region]:
        for row in self._held().T.tolist():
            yield region_of(self.latest.id, *row)

    def append(self, region: Region) -> None:
        """Take the next one."""
        columns, end = self._columns, self._end
        if end == columns.shape[1]:
            held = self._held().copy()
            end = held.shape[1]
            if 2 * end > columns.shape[1]:
                self._columns = columns = np.empty((5, 2 * columns.shape[1]))
            columns[:, :end] = held
            self._first = 0
        columns[:, end] = region.t_us, region.x_px, region.y_px, region.width_px, region.height_px
        self._end = end + 1
        self.latest = region

    def take_back(self) -> None:
        """Drop the newest, as if it had not been taken."""
        self._end -= 1
        self.latest = region_of(self.latest.id, *self._columns[:, self._end - 1].tolist())

    def forget_before(self, t_us: float) -> None:
        """Drop those older than a time but for the newest of them, and two in any case."""
        t = self._columns[0]
        while self._end - self._first > 2 and t[self._first + 1] < t_us:
            self._first += 1

    def moved(
        self,
        id: int,
        right_px: float,
        down_px: float,
        size_px: tuple[float, float],
        *,
        row_px: float = 0.0,
        most_px: float = np.inf,
        grown_us: tuple[float, float] | None = None,
    ) -> "Places":
        """The same elsewhere, all of one size, under a number.

        Where the height was off the new one by more than `most_px`, the middle may be off by half of what is
        more: of those rows, the nearest to `row_px` is taken. Between the times `grown_us` they came to be so
        far off little by little; before the first, they are right.
        """
        other = object.__new__(Places)
        held = self._held()
        many = held.shape[1]
        other._columns = columns = np.empty((5, max(2 * many, _ROOM)))
        other._first, other._end = 0, many
        columns[0, :many] = held[0]
        share = np.ones(many)
        if grown_us is not None and grown_us[1] > grown_us[0]:
            share = np.clip((held[0] - grown_us[0]) / (grown_us[1] - grown_us[0]), 0.0, 1.0)
        columns[1, :many] = held[1] + share * right_px
        columns[2, :many] = held[2] + share * down_px
        if most_px < np.inf:
            slack_px = np.maximum(np.abs(held[4] - size_px[1]) - most_px, 0.0) / 2
            off_px = row_px - columns[2, :many]
            columns[2, :many] += np.minimum(np.maximum(off_px, -slack_px), slack_px)
        columns[3, :many], columns[4, :many] = size_px
        other.latest = region_of(id, *columns[:, many - 1].tolist())
        return other

    def renamed(self, id: int) -> "Places":
        """The same of another region."""
        other = object.__new__(Places)
        last = self.latest
        other._columns, other._first, other._end = self._columns.copy(), self._first, self._end
        other.latest = region_of(id, last.t_us, last.x_px, last.y_px, last.width_px, last.height_px)
        return other

    def expected(self, t_us: float) -> tuple[float, float]:
        """Centre (column, row) at a time soon, if it goes on as between the two newest, px."""
        last = self.latest
        if self._end - self._first < 2:
            return last.x_px, last.y_px
        before_us, x_px, y_px = self._columns[:3, self._end - 2].tolist()
        # Further ahead than that, a shaking camera has turned back.
        ahead = min((t_us - last.t_us) / (last.t_us - before_us), 1.0)
        return last.x_px + ahead * (last.x_px - x_px), last.y_px + ahead * (last.y_px - y_px)

    def at(self, t_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Centre (column, row) at times, float64 (2, n), px: interpolated, straight on for a little."""
        centre = np.empty((2, len(t_us)))
        _kernels.places_at(t_us, self._held(), _MOST_AHEAD_STEPS, centre)
        return centre

    def place_at(self, t_us: float) -> tuple[float, float]:
        """The same as `at` for one time."""
        last = self.latest
        if self._end - self._first == 1:
            return last.x_px, last.y_px
        # The line from the place before a time to the one after it; the outermost ones go on for a little.
        t, right = self._columns[0], self._end - 1
        while right > self._first + 1 and t[right - 1] > t_us:
            right -= 1
        (one_us, other_us), (one_x, other_x), (one_y, other_y) = self._columns[
            :3, right - 1 : right + 1
        ].tolist()
        long_us = other_us - one_us
        late = t_us > other_us
        after_us = t_us - (other_us if late else one_us)
        after_us = min(max(after_us, -_MOST_AHEAD_STEPS * long_us), _MOST_AHEAD_STEPS * long_us)
        x_px = (other_x if late else one_x) + (other_x - one_x) / long_us * after_us
        return x_px, (other_y if late else one_y) + (other_y - one_y) / long_us * after_us

    def size_at(self, t_us: float) -> tuple[float, float]:
        """(width, height) measured nearest to a time, px."""
        t, i = self._columns[0], self._end - 1
        while i > self._first and t[i - 1] >= t_us:
            i -= 1
        if i > self._first and t_us - t[i - 1] < t[i] - t_us:
            i -= 1
        width_px, height_px = self._columns[3:, i].tolist()
        return width_px, height_px

    def _held(self) -> NDArray[np.float64]:
        """Times, columns, rows, widths and heights, float64 (5, n)."""
        return self._columns[:, self._first : self._end]


def region_of(id: int, t_us: float, x_px: float, y_px: float, width_px: float, height_px: float) -> Region:
    """A region, made without the calls that a frozen class makes for each field: there are many a frame."""
    region = object.__new__(Region)
    vars(region).update(id=id, t_us=t_us, x_px=x_px, y_px=y_px, width_px=width_px, height_px=height_px)
    return region


def held_bytes(events: Events) -> int:
    """Bytes that some events take."""
    return PIECE_BYTES + EVENT_BYTES * len(events.t_us)


@dataclass
class Followed:
    """A region followed over time, and its events since the first.

    Attributes:
        id: Number of the region, from 0.
        positions: Where it was measured, oldest first.
        pieces: Its events, one entry a time step: (start of the step, us; events).
        first_us: Start of the first step of which it has events, us.
        filter: State of the filter of its centre, None without one.
        heights: As measured lately, px; of a bar of known size, those of steps in which both ends were seen.
        size_px: (width, height) of the whole bar, by what its frames show, px; None before the first.
        lit_px: Upper and lower edge, from the bar's centre, of the part that its newest frame showed, px;
            None where it showed both ends.
        strips_px: Of a bar whose light stands in strips of columns, (middle from the bar's centre, half the
            width) of each, px, float64 (n, 2); None of others, and before the first frame.
        shown_us: When its newest frame showed its place, us; None before the first.
        outgrown: The region before that, which may have held other bars: (right, down) of its centre from
            this one's, width and height, px, and until when that matters, us.
        released: True once it has faded or was merged into another; it gets no more events.
        opened_us: End of the step in which it was found, us.
        cut_us: Until when its events were forgotten for want of room, us; None where none were.
        held_bytes: What its pieces take.
    """

    id: int
    positions: Places
    first_us: int
    pieces: deque[Piece] = field(default_factory=deque)
    released: bool = False
    filter: Any = None
    heights: deque[float] = field(default_factory=lambda: deque(maxlen=_HEIGHTS))
    size_px: tuple[float, float] | None = None
    lit_px: tuple[float, float] | None = None
    strips_px: NDArray[np.float64] | None = None
    shown_us: float | None = None
    outgrown: tuple[float, float, float, float, float] | None = None
    opened_us: int = 0
    cut_us: int | None = None
    held_bytes: int = 0

    def __post_init__(self) -> None:
        self.hold(self.pieces)

    def hold(self, pieces: deque[Piece]) -> None:
        """Take other events instead of those held."""
        self.pieces = pieces
        self.held_bytes = sum(held_bytes(events) for _, events in pieces)

    def add(self, start_us: int, events: Events) -> None:
        """Take the events of the next step."""
        self.pieces.append((start_us, events))
        self.held_bytes += held_bytes(events)

    def forget(self) -> int:
        """Drop the events of the oldest step; how many they were."""
        _, events = self.pieces.popleft()
        self.held_bytes -= held_bytes(events)
        return len(events)

    def take_back(self) -> None:
        """Drop the newest events, as if they had not been added."""
        self.held_bytes -= held_bytes(self.pieces.pop()[1])

    def events_between(self, from_us: float, until_us: float) -> int:
        """How many of its events there are from one time to before another."""
        return sum(
            int(np.diff(np.searchsorted(events.t_us, (from_us, until_us)))[0])
            for start_us, events in self.pieces
            if start_us < until_us
        )

    @property
    def latest(self) -> Region:
        """The newest position."""
        return self.positions.latest

    def covers(self, t_us: float, point_px: tuple[float, float]) -> bool:
        """Whether a point on the sensor (column, row) is inside the region at a time."""
        (x, y), (width, height) = self.positions.place_at(t_us), self.positions.size_at(t_us)
        return abs(point_px[0] - x) <= width / 2 and abs(point_px[1] - y) <= height / 2

    def holds(self, other: "Followed", t_us: float, same_px: float) -> bool:
        """Whether another region is a part of this bar, or the same bar, its centre so near at a time."""
        mine, its = self.latest, other.latest
        when = t_us if other.size_px is not None else its.t_us
        (x, y), (u, v) = self.positions.place_at(when), other.positions.place_at(when)
        right, down = abs(u - x), abs(v - y)
        if other.size_px is not None:
            return max(right, down) <= same_px
        # Half of it, or more, in each direction.
        return right <= mine.width_px / 2 + same_px and down <= mine.height_px / 2

    def forget_before(self, t_us: float, step_us: int, places_us: float) -> None:
        """Drop events older than a time, and positions older than another: others ask where it was."""
        while self.pieces and self.pieces[0][0] + step_us <= t_us:
            self.forget()
        self.positions.forget_before(places_us)


def make_room(regions: Sequence[Followed], most_bytes: int, step_us: int) -> int:
    """Forget the oldest events of regions where all together take too much; how many they were."""
    spare, dropped = most_bytes, 0
    for followed in regions:
        spare -= followed.held_bytes
    while spare < 0:
        held = [followed for followed in regions if len(followed.pieces) > 1]
        if not held:
            break
        oldest_us = min(followed.pieces[0][0] for followed in held)
        for followed in held:
            if spare < 0 and followed.pieces[0][0] == oldest_us:
                spare += followed.held_bytes
                dropped += followed.forget()
                spare -= followed.held_bytes
                followed.cut_us = followed.first_us = oldest_us + step_us
    return dropped


def same_place(one: Region, other: Region) -> bool:
    """Whether the centre of one of two regions lies in the other."""
    right, down = abs(one.x_px - other.x_px), abs(one.y_px - other.y_px)
    return any(right <= at.width_px / 2 and down <= at.height_px / 2 for at in (one, other))
