"""A region that is followed, with its events."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx.limits import held_bytes
from evlcp_sdk.rx.places import Places
from evlcp_sdk.values import Events, Region

SAME_PX = 5.0
"""How far apart centres of two regions of one image may be: before lit leaves an end is good to some px."""

_HEIGHTS = 9
"""Measured heights whose median is a region's: a bar ahead grows by a percent in so many steps at 80 km/h."""

Piece = tuple[int, Events]


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
