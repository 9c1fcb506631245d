"""Bars that are followed: regions that are set right by what their frames show."""

import math
from collections import deque
from collections.abc import Collection, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx.boxes import CELL_SHIFT, around, box_of
from evlcp_sdk.rx.regions import MARGIN_PX, STRAY_PX, Followed, RegionFollower, held_bytes
from evlcp_sdk.values import Events

_RESHAPE_PX = 1.0
"""How far a region may be off its bar, in place and in size, before it is set right: a fifth of its seam."""

_LEFT_STEPS = 6
"""Steps in which what is left of a region that turned out to be smaller may become one: it blinks all the
time. What wakes there later is a halo, or leaves that its light falls on."""


class BarFollower(RegionFollower):
    """Follows regions as `RegionFollower` does, and takes their places and sizes from frames, too."""

    def shape(
        self,
        followed: Followed,
        t_us: float,
        centre_px: tuple[float, float],
        size_px: tuple[float, float],
        lit_px: tuple[float, float] | None = None,
        strips_px: NDArray[np.float64] | None = None,
    ) -> float:
        """Set a region right by what a frame showed of its bar; return by how much, px, 0 for nothing.

        It is infinite at the first time. Its events are those of where it was taken to be, until they are
        gathered anew; within half of the seam, they are all there.

        Args:
            followed: The region.
            t_us: When the bar was seen, us.
            centre_px: Centre (column, row) of the whole bar at that time.
            size_px: Its (width, height).
            lit_px: Where it shines, see `Followed.lit_px`.
            strips_px: See `Followed.strips_px`.
        """
        if followed.lit_px != lit_px and abs(_height(followed.lit_px) - _height(lit_px)) > STRAY_PX:
            # Heights of another part.
            followed.heights.clear()
        followed.lit_px, followed.strips_px = lit_px, strips_px
        x, y = followed.positions.place_at(t_us)
        off = centre_px[0] - x, centre_px[1] - y
        known, before_us, followed.shown_us = followed.size_px, followed.shown_us, t_us
        off_px = math.inf
        if known is None:
            followed.heights.clear()
            last = followed.latest
            until_us = last.t_us + _LEFT_STEPS * self._spec.step_us
            followed.outgrown = -off[0], -off[1], last.width_px, last.height_px, until_us
        else:
            wider, higher = size_px[0] - known[0], size_px[1] - known[1]
            off_px = max(abs(off[0]), abs(off[1]), abs(wider), abs(higher))
            if off_px < _RESHAPE_PX:
                return 0.0
        followed.size_px = size_px
        # Where less of the bar was seen, or more than it, its place is not that of what was seen.
        most_px = 2 * MARGIN_PX if known is None else math.inf
        followed.positions = followed.positions.moved(
            followed.id,
            *off,
            size_px,
            row_px=centre_px[1],
            most_px=most_px,
            grown_us=None if known is None or before_us is None else (before_us, t_us),
        )
        followed.filter = self._position.init() if self._position else None
        return off_px

    def unite(self, followed: Followed, other: Followed) -> None:
        """Take another region into one: both are parts of what is not known yet, and the other one goes."""
        one, two = followed.latest, other.latest
        left, top, right, bottom = around([box_of(one), box_of(two)])
        off_x, off_y = (left + right - 1) / 2 - one.x_px, (top + bottom - 1) / 2 - one.y_px
        width_px, height_px = float(right - left - 1), float(bottom - top - 1)
        followed.positions = followed.positions.moved(followed.id, off_x, off_y, (width_px, height_px))
        followed.heights.clear()
        followed.filter = self._position.init() if self._position else None
        since_us = min(part.pieces[0][0] for part in (followed, other) if part.pieces)
        followed.first_us = min(followed.first_us, other.first_us)
        if self._recent[0][0] > since_us:
            followed.cut_us = followed.first_us = self._recent[0][0]
        followed.pieces = deque((start, events) for start, events in self._recent if start >= since_us)
        self.gather(followed)
        followed.hold(deque((start, self._rhythm.of(events)) for start, events in followed.pieces))
        self.drop(other)

    def beside(
        self, like: Followed, t_us: float, centre_px: tuple[float, float], size_px: tuple[float, float]
    ) -> Followed:
        """Open a region for another image of a bar: it moves as the one that showed it does."""
        followed = Followed(
            self._next_id,
            like.positions.moved(self._next_id, 0.0, 0.0),
            like.first_us,
            deque(like.pieces),
            filter=like.filter,
            opened_us=like.opened_us,
        )
        self._next_id += 1
        self.alive.append(followed)
        self.shape(followed, t_us, centre_px, size_px)
        self.gather(followed)
        return followed

    def has_room(self) -> bool:
        """Whether another region may be followed; counts one that may not."""
        room = len(self.alive) < self._limits.regions
        self.counts["regions_left_out"] += not room
        return room

    @contextmanager
    def ahead(self, start_us: int, until_us: int, events: Events, meant: Collection[int]) -> Iterator[None]:
        """Let some regions have what there is so far of a time step, and their places by that.

        They have the events of the whole image, of which a frame takes those in its own: to select them takes
        longer, and they are selected with the whole step. Behind it, all is as if the step had not begun, but
        for what frames showed in the meantime.

        Args:
            start_us: Start of the step, us.
            until_us: Before this all events are there, us.
            events: Those in it, in order; they come again with the whole step.
            meant: Numbers of regions that are alive, of known size.
        """
        seen_us = until_us - self._age_us
        for followed in self.alive:
            if followed.id in meant:
                followed.pieces.append((start_us, events))
        # Nearer to the place before it, another says little of where the region goes.
        if 2 * (until_us - start_us) >= self._spec.step_us:
            self._rhythm.step(start_us, events, self._hits, CELL_SHIFT)
            boxes = self._boxes(start_us + self._spec.step_us / 2, ())
            for followed, own in zip(self.alive, self._own(boxes), strict=True):
                if followed.id not in meant:
                    continue
                heights = followed.heights.copy()
                if (found := self._locate(followed, own, until_us)) is not None:
                    followed.positions.append(found[1])
                followed.heights = heights
        self._recent.append((start_us, events))
        yield
        self._recent.pop()
        for followed in self.alive:
            if followed.pieces and followed.pieces[-1][0] == start_us:
                _, part = followed.pieces.pop()
                # What a frame's look gathered anew was counted; the whole image's events were not.
                followed.held_bytes -= 0 if part is events else held_bytes(part)
            if followed.positions.latest.t_us == seen_us:
                followed.positions.take_back()


def _height(lit_px: tuple[float, float] | None) -> float:
    """Of a part of a bar, px; infinite of the whole."""
    return math.inf if lit_px is None else lit_px[1] - lit_px[0]
