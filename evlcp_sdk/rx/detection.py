"""Finds regions that blink in the rhythm of the chips and follows them while the camera moves."""

import math
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.sections import RegionSpec
from evlcp_sdk.plugin.roles import Filter
from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.followed import (
    SAME_PX,
    Followed,
    Piece,
    Places,
    held_bytes,
    make_room,
    region_of,
    same_place,
)
from evlcp_sdk.rx.framer import RegionTracker
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.rx.rhythm import Rhythm, select
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import Events, Region

MARGIN_PX = 5
"""Seam around a region: how far it may move in a step, 1.5 px/ms and more, and how far it is blurred."""

_LEAST_RISES = 20
"""Rises of candidate pixels in a step that a new region needs: a cluster at 100 m has as many, noise few."""

_CELL_SHIFT = 2
"""Cells of 4 x 4 px: no larger than the gap at which two bars are two, and few enough to label each step."""

_MEASURE_GAPS = 1.5
"""A blinking pixel rises once in the longest time of the code; half of that again allows for a late event."""

_AGE_CHIPS = 5
"""Age of a measured centre. A moving bar's leading end counts once its pixels have risen in rhythm twice,
some six chips late and more where events go missing; its trailing end stays for the six chips of the
measurement. In recordings and simulated scenes the centre is 3 to 8 chips late."""

_STRAY_PX = 2.0
"""How much too long a region may be before what is too much must be strays: an edge is good to a pixel."""

_RESHAPE_PX = 1.0
"""How far a region may be off its bar, in place and in size, before it is set right: a fifth of its seam."""

_LONGEST_US = 200_000
"""How long events of the whole image are kept at the most, to gather those of a region anew: a packet that is
longer than that starts with the frames in reach."""

_BLUR_PX = 2.0
"""How much longer than a bar its blinking pixels are: blur of a pixel at either end; in motion twice that."""

_LEFT_STEPS = 6
"""Steps in which what is left of a region that turned out to be smaller may become one: it blinks all the
time. What wakes there later is a halo, or leaves that its light falls on."""

_SHOWN = 0.5
"""Pixels a row, by those of rows that are lit, from which on rows that were dark are lit again: half."""

_SEAM_PX = 2
"""Columns at either side of a box that a bar should leave dark: some of the least seam of a region."""

_MIN_PIXELS = 4
"""Blinking pixels below which a region has no position: one cluster at 100 m has a dozen."""

_CENTRE_SIGMA_PX = 0.25
"""Error of a measured centre: the edge of a row of pixels, a third of one, at the top and at the bottom."""

BACKFILL_STEPS = 12
"""Steps kept from before a region was found: a pixel needs about 1 ms to score, a region two steps."""

_COUNTS = ("steps_forgotten", "dropped_no_room", "regions_left_out", "regions_gave_way", "areas_left_out")

Box = tuple[int, int, int, int]


class RegionFollower(RegionTracker):
    """Finds what blinks in the rhythm of the chips, and follows it: the tracker of the receiver.

    Args:
        spec: Parameters.
        camera: For the size of the sensor.
        chip_us: Nominal length of a chip, us.
        position: Filter of the centres; None for centres as measured.
        keep_us: How long events of the whole image are kept, so that a region may turn out to be larger than
            it was taken for, us.
        limits: How much is held.
        gap_chips: The longest time from rise to rise in the codes; 4 in pair codes.
        rhythm: Scores of the pixels, of another follower in the same rhythm; None for its own.
    """

    def __init__(
        self,
        spec: RegionSpec,
        camera: CameraModel,
        chip_us: float,
        position: Filter | None = None,
        keep_us: float = 0.0,
        limits: Limits = LIMITS,
        gap_chips: int = 4,
        rhythm: Rhythm | None = None,
    ) -> None:
        self._spec = spec
        self._limits = limits
        self._keep_us = keep_us
        self._position = position
        self._camera = camera
        self._measure_us = round(_MEASURE_GAPS * gap_chips * chip_us)
        self._age_us = _AGE_CHIPS * chip_us
        shape = (camera.height, camera.width)
        self._rhythm = rhythm or Rhythm(camera.width, camera.height, chip_us, spec.min_score, gap_chips)
        self._hits = np.zeros([(n - 1 >> _CELL_SHIFT) + 1 for n in shape], np.int32)
        self._fresh: list[Box] = []
        steps = math.ceil(min(keep_us, _LONGEST_US) / spec.step_us)
        self._recent: deque[Piece] = deque()
        self._most_recent = max(steps, BACKFILL_STEPS)
        self._recent_bytes = 0
        self._next_id = 0
        self.alive: list[Followed] = []
        self.counts = dict.fromkeys(_COUNTS, 0)

    def step(self, start_us: int, events: Events, taken: Sequence[Region] = ()) -> list[Followed]:
        """Take the events of one time step; return the regions that are alive or ended in it."""
        spec = self._spec
        self._remember(start_us, events)
        rises = self._rhythm.step(start_us, events, self._hits, _CELL_SHIFT)
        end_us = start_us + spec.step_us
        boxes = self._boxes(start_us + spec.step_us / 2, taken)
        for followed, box, own in zip(self.alive, boxes, self._own(boxes), strict=True):
            inside = select(events, box)
            # Before a frame shows where in its box a bar is, panels and moving textures around it would drown
            # it: only what blinks in rhythm counts.
            followed.add(start_us, inside if followed.size_px else self._rhythm.of(inside))
            if (found := self._locate(followed, own, end_us)) is not None:
                followed.filter, place = found
                followed.positions.append(place)
        if len(self.alive) > 1:
            self._merge()
        self._make_room()
        for place in taken if rises else ():
            reach = self._reach(place.x_px, place.y_px, place.width_px, place.height_px)
            rises -= _cleared(self._hits, reach)
        self._open(end_us, rises)
        seen = list(self.alive)
        gone = False
        for followed in seen:
            followed.released |= end_us - followed.positions.latest.t_us > spec.fade_us
            gone |= followed.released
        if gone:
            self._let_go()
        return seen

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
            self._rhythm.step(start_us, events, self._hits, _CELL_SHIFT)
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
            if followed.pieces and followed.pieces[-1][1] is events:
                followed.pieces.pop()
            elif followed.pieces and followed.pieces[-1][0] == start_us:
                followed.take_back()
            if followed.positions.latest.t_us == seen_us:
                followed.positions.take_back()

    def _boxes(self, t_us: float, taken: Sequence[Region]) -> list[Box]:
        """Where each region should be in the middle of a step; one of unknown size beside the others."""
        places = []
        for followed in self.alive:
            last = followed.positions.latest
            places.append((*self._expected(followed, t_us), last.width_px, last.height_px))
        boxes = [self._reach(*place) for place in places]
        if None not in [followed.size_px for followed in self.alive]:
            return boxes
        known = [_box_of(place) for place in taken]
        known += [_tight(*place) for place, one in zip(places, self.alive, strict=True) if one.size_px]
        return [
            box if followed.size_px else _clear(box, known)
            for followed, box in zip(self.alive, boxes, strict=True)
        ]

    def _own(self, boxes: list[Box]) -> list[Box]:
        """What of each box shows where its region is: the seam without other bars of known size.

        Rows of a bar below would be as good as its own, so that a region would move on to them.
        """
        if len(boxes) < 2:
            return boxes
        seam = MARGIN_PX
        tight = [
            _grown(box, -seam) if one.size_px else None for box, one in zip(boxes, self.alive, strict=True)
        ]
        bars = [bar for bar in tight if bar is not None]
        if len(bars) < 2:
            return boxes
        return [
            box if bar is None else _cut_off(box, bar, bars) for box, bar in zip(boxes, tight, strict=True)
        ]

    def _let_go(self) -> None:
        """Follow those no more that are released."""
        lost = [followed for followed in self.alive if followed.released and followed.size_px is not None]
        self.alive = [followed for followed in self.alive if not followed.released]
        for followed in self.alive:
            # A bar that was seen in what another was taken for is no halo when it is seen again.
            if any(_lies_in_outgrown(followed, gone.latest) for gone in lost):
                followed.outgrown = None

    def _remember(self, start_us: int, events: Events) -> None:
        """Keep a step's events of the whole image, and as many before it as there is room for."""
        self._recent.append((start_us, events))
        self._recent_bytes += held_bytes(events)
        most_bytes = self._limits.recent_bytes
        while len(self._recent) > self._most_recent or (
            self._recent_bytes > most_bytes and len(self._recent) > 1
        ):
            self.counts["steps_forgotten"] += len(self._recent) <= self._most_recent
            _, forgotten = self._recent.popleft()
            self._recent_bytes -= held_bytes(forgotten)

    def _make_room(self) -> None:
        """Forget the oldest events of regions where all together take too much."""
        most_bytes, step_us = self._limits.region_bytes, self._spec.step_us
        self.counts["dropped_no_room"] += make_room(self.alive, most_bytes, step_us)

    def skip(self) -> None:
        """Pass over a gap in time, with no region alive."""
        self._fresh = []
        self._recent.clear()
        self._recent_bytes = 0

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
        if followed.lit_px != lit_px and abs(_height(followed.lit_px) - _height(lit_px)) > _STRAY_PX:
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

    def gather(self, followed: Followed, from_us: float = -math.inf, until_us: float = math.inf) -> None:
        """Take a region's events once more, from where it is now known to have been.

        Args:
            followed: The region.
            from_us: From the step that holds this time, us.
            until_us: To the step before this time, us.
        """
        oldest_us = followed.pieces[0][0] if followed.pieces else followed.first_us
        step_us = self._spec.step_us
        kept = [
            piece
            for piece in self._recent
            if oldest_us <= piece[0] < until_us and piece[0] + step_us > from_us
        ]
        last = followed.latest
        gathered = {}
        x, y = followed.positions.at(np.array([start + step_us / 2 for start, _ in kept]))
        for (start, events), x_px, y_px in zip(kept, x.tolist(), y.tolist(), strict=True):
            box = self._reach(x_px, y_px, last.width_px, last.height_px)
            gathered[start] = select(events, box)
        followed.hold(deque((start, gathered.get(start, events)) for start, events in followed.pieces))
        self._make_room()

    def unite(self, followed: Followed, other: Followed) -> None:
        """Take another region into one: both are parts of what is not known yet, and the other one goes."""
        one, two = followed.latest, other.latest
        left, top, right, bottom = _around([_box_of(one), _box_of(two)])
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
            like.positions.renamed(self._next_id),
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

    def _expected(self, followed: Followed, t_us: float) -> tuple[float, float]:
        """Where a region's centre should be soon: by its filter, or else straight on."""
        if self._position is None or (expected := self._position.predict(followed.filter, t_us)) is None:
            return followed.positions.expected(t_us)
        return float(expected[0][0]), float(expected[0][1])

    def _whole(self, followed: Followed, measured: Region, top: int, rows: NDArray[np.int64]) -> Region:
        """A region of the height that it lately had; `rows`: its pixels in each row from `top` on.

        Where few pixels are awake, an end is dark; where noise wakes pixels that a fast bar has left, there
        is one too many. Of the places that the edges allow, the nearest to the expected one is taken; of more
        rows than the bar has, those that are likeliest to be its own. Where more of a bar of known size is
        missing, an end is hidden: the one that is nearer to its place counts alone.
        """
        known, lit = followed.size_px, followed.lit_px
        _, expected_px = self._expected(followed, measured.t_us)
        heights = followed.heights
        if lit is not None and known is not None and _shows_again(rows, expected_px - top, known[1], lit):
            # Those before are of the part.
            lit, heights = None, deque()
        whole_px = measured.height_px if known is None else known[1] if lit is None else lit[1] - lit[0]
        # Of a bar with a hidden end, the part that is seen is found, and says where the whole is.
        off_px = 0.0 if lit is None else (lit[0] + lit[1]) / 2
        expected_px += off_px
        if known is None or -_STRAY_PX <= measured.height_px - whole_px <= 2 * _BLUR_PX:
            heights.append(measured.height_px)
        # A part of the bar says nothing of its height, once that is known.
        height_px = _median(heights) if heights else whole_px
        excess_px = measured.height_px - height_px
        if excess_px > _STRAY_PX:
            n = min(round(height_px), len(rows))
            total = np.concatenate([[0], np.cumsum(rows)])
            inside = total[n:] - total[:-n]
            first_px = top + (n - 1) / 2
            # What is not known yet may grow to either side.
            told = 0.0 if known is None else _told(n, int(inside.max()), int(total[-1]), len(rows))
            y_px = first_px + _likeliest(inside, told, expected_px - first_px)
        elif known is not None and excess_px < -2 * MARGIN_PX:
            # By its upper end, and by its lower one.
            ends_px = measured.y_px - excess_px / 2, measured.y_px + excess_px / 2
            y_px = min(ends_px, key=lambda end_px: abs(end_px - expected_px))
            if abs(y_px - expected_px) > MARGIN_PX:
                y_px = followed.latest.y_px + off_px
        else:
            slack_px = abs(excess_px) / 2
            y_px = measured.y_px + min(max(expected_px - measured.y_px, -slack_px), slack_px)
        size_px = known or (measured.width_px, height_px + min(max(excess_px, 0.0), _STRAY_PX))
        return region_of(measured.id, measured.t_us, measured.x_px, y_px - off_px, *size_px)

    def _locate(self, followed: Followed, box: Box, now_us: int) -> tuple[Any, Region] | None:
        """State of a region's filter after it was measured in a box, and its place by it; None if unseen."""
        rows = np.empty(box[3] - box[1], np.int64)
        seen = self._measure(followed, box, now_us, rows)
        if seen is None:
            return None
        measured = self._whole(followed, seen, box[1], rows)
        if self._position is None:
            return followed.filter, measured
        centre = np.array([measured.x_px, measured.y_px])
        state, centre, _ = self._position.step(followed.filter, measured.t_us, centre, _CENTRE_SIGMA_PX)
        x_px, y_px = float(centre[0]), float(centre[1])
        return state, Region(measured.id, measured.t_us, x_px, y_px, measured.width_px, measured.height_px)

    def _reach(self, x_px: float, y_px: float, width_px: float, height_px: float) -> Box:
        """The box in which a region's events lie within the next step; an empty one off the sensor."""
        m = MARGIN_PX
        half_w, half_h = width_px / 2 + m, height_px / 2 + m
        width, height = self._camera.width, self._camera.height
        left, top = int(x_px - half_w), int(y_px - half_h)
        right, bottom = int(x_px + half_w) + 1, int(y_px + half_h) + 1
        if left < 0 or top < 0 or right > width or bottom > height:
            left, right = min(max(left, 0), width), min(max(right, 0), width)
            top, bottom = min(max(top, 0), height), min(max(bottom, 0), height)
        return left, top, right, bottom

    def _measure(
        self, followed: Followed | None, box: Box, end_us: int, rows: NDArray[np.int64] | None = None
    ) -> Region | None:
        """Centre and size of what blinks in a box at the end of a step; `rows`: its pixels in each row.

        Of a bar of known width, rows count no pixels beside it, and of strips none between them.
        """
        width_px, strips = math.inf, None
        if followed is not None and followed.size_px is not None:
            width_px = followed.size_px[0]
        if followed is not None and followed.strips_px is not None:
            expected_px, _ = self._expected(followed, end_us - self._age_us)
            strips = expected_px, float(MARGIN_PX), followed.strips_px
        if rows is None:
            rows = np.empty(box[3] - box[1], np.int64)
        # Half the score suffices inside a region: its seam is new to the light as the bar moves.
        total, column, left, right, upper, lower = self._rhythm.measure(
            box, end_us, self._measure_us, _SEAM_PX, width_px / 2 + 1, rows, strips
        )
        if total < _MIN_PIXELS:
            return None
        id = self._next_id if followed is None else followed.id
        return region_of(
            id, end_us - self._age_us, column, (upper + lower - 1) / 2, right - left + 1.0, lower - upper
        )

    def _open(self, end_us: int, rises: int) -> None:
        """Open a region where something blinks in two steps on end outside those known.

        Args:
            end_us: End of the step, us.
            rises: How many hits there are.
        """
        hits = self._hits
        merge = self._spec.merge_px
        for followed in self.alive:
            if rises < _LEAST_RISES:
                break
            last = followed.positions.latest
            reach = self._reach(last.x_px, last.y_px, last.width_px, last.height_px)
            rises -= _cleared(hits, reach if followed.size_px else _grown(reach, merge))
            if followed.outgrown is not None and end_us > followed.outgrown[4]:
                rises -= _cleared(hits, self._reach(*_outgrown(followed)))
        if rises < _LEAST_RISES:
            self._fresh = []
            if rises:
                hits[:] = 0
            return
        lit = [self._measure(None, area, end_us) for area in self._areas(hits)]
        joined = _joined([_box_of(region) for region in lit if region is not None], merge)
        boxes = [box for box in joined if _inside(hits, box).sum() >= _LEAST_RISES]
        hits[:] = 0
        fresh, self._fresh = self._fresh, []
        for box in boxes:
            if any(_overlap(_grown(box, merge), other) for other in fresh):
                self._start(box, end_us)
            else:
                self._fresh.append(box)

    def _areas(self, hits: NDArray[np.int32]) -> list[Box]:
        """Boxes around connected cells with hits; as many as there may be."""
        # Of 2 x 2 cells, one at the most begins an area.
        rows, columns = hits.shape
        most = ((rows + 1) // 2) * ((columns + 1) // 2)
        boxes, total = np.empty((most, 4), np.int64), np.empty(most, np.int64)
        many = _kernels.areas(hits > 0, hits, boxes, total)
        boxes = boxes[:many]
        if many > self._limits.areas:
            self.counts["areas_left_out"] += many - self._limits.areas
            best = np.sort(np.argsort(-total[:many], kind="stable")[: self._limits.areas])
            boxes = boxes[best]
        size = self._camera.width, self._camera.height
        return [tuple(box) for box in np.minimum(boxes << _CELL_SHIFT, size * 2).tolist()]

    def _start(self, box: Box, end_us: int) -> None:
        region = self._measure(None, box, end_us)
        if region is None:
            return
        reach = self._reach(region.x_px, region.y_px, region.width_px, region.height_px)
        # Lamps whose pixels were not known as such in the step before are now.
        newest = select(self._recent[-1][1], reach)
        if not self._rhythm.may_open(newest) or not self._place_for_one(end_us):
            return
        self._next_id += 1
        for like in self.alive:
            if like.outgrown and region.t_us <= like.outgrown[4] and _lies_in_outgrown(like, region):
                # It was seen as long as the one that it was taken to be a part of.
                right, down = region.x_px - like.latest.x_px, region.y_px - like.latest.y_px
                size_px = region.width_px, region.height_px
                places = like.positions.moved(region.id, right, down, size_px)
                pieces = deque((start, Events.empty()) for start, _ in self._recent)
                followed = Followed(region.id, places, pieces[0][0], pieces, opened_us=end_us)
                followed.filter = self._position.init() if self._position else None
                self.gather(followed)
                self.alive.append(followed)
                return
        recent = list(self._recent)[-BACKFILL_STEPS:]
        pieces = deque((start, self._rhythm.of(select(events, reach))) for start, events in recent)
        state = self._position.init() if self._position else None
        self.alive.append(
            Followed(region.id, Places([region]), pieces[0][0], pieces, filter=state, opened_us=end_us)
        )

    def _place_for_one(self, now_us: int) -> bool:
        """Whether a new region may be followed, maybe in place of one that had its time and shows no bar."""
        followed = [one for one in self.alive if not one.released]
        if len(followed) < self._limits.regions:
            return True
        idle = [one for one in followed if one.size_px is None and one.opened_us + self._keep_us < now_us]
        if not idle:
            self.counts["regions_left_out"] += 1
            return False
        min(idle, key=lambda one: (one.opened_us, one.id)).released = True
        self.counts["regions_gave_way"] += 1
        return True

    def _merge(self) -> None:
        """Keep the older of two regions that have grown together.

        Of bars that frames have shown, each stays as large as it is: where a jolt brings one region over
        another, both are followed, until they follow the same.
        """
        boxes = [_box_of(followed.latest) for followed in self.alive]
        for i, older in enumerate(self.alive):
            for k in range(i + 1, len(boxes)):
                younger = self.alive[k]
                if not _overlap(boxes[i], boxes[k]) or younger.released:
                    continue
                one, other = older.latest, younger.latest
                shown = (older.size_px is not None) + (younger.size_px is not None)
                apart_px = max(abs(one.x_px - other.x_px), abs(one.y_px - other.y_px))
                if shown == 0 or apart_px <= SAME_PX or (shown == 1 and same_place(one, other)):
                    younger.released = True
        # The survivor reaches over both within a few steps, as its seam finds the other's pixels.


def _clear(box: Box, others: list[Box]) -> Box:
    """The largest part of a box, cut straight, that is clear of others."""
    for left, top, right, bottom in others:
        if _overlap(box, (left, top, right, bottom)):
            u, v, w, z = box
            parts = [(u, v, min(w, left), z), (max(u, right), v, w, z)]
            parts += [(u, v, w, min(z, top)), (u, max(v, bottom), w, z)]
            box = max(parts, key=lambda b: max(b[2] - b[0], 0) * max(b[3] - b[1], 0))
            if box[0] >= box[2] or box[1] >= box[3]:
                return u, v, u, v
    return box


def _cut_off(box: Box, bar: Box, others: list[Box]) -> Box:
    """A box around a bar without what belongs to others beside, above or below it.

    Where they seem to overlap, one of them is not where it should be, as two bars do not stand in one place;
    one that reaches over the middle is one in another column or row, which cuts nothing off. Nor is a box cut
    of which others on two sides would leave nothing: most of them are parts of one bar.
    """
    left, top, right, bottom = box
    for other in others:
        if other == bar or not _overlap(box, other):
            continue
        beside = max(other[0] - bar[2], bar[0] - other[2]), (bar[2] - bar[0]) / 2
        below = max(other[1] - bar[3], bar[1] - other[3]), (bar[3] - bar[1]) / 2
        if below[0] >= beside[0] and -below[0] < below[1]:
            if other[1] > bar[1]:
                bottom = min(bottom, other[1])
            else:
                top = max(top, other[3])
        elif beside[0] > below[0] and -beside[0] < beside[1]:
            if other[0] > bar[0]:
                right = min(right, other[0])
            else:
                left = max(left, other[2])
    return (left, top, right, bottom) if left < right and top < bottom else box


def _outgrown(followed: Followed) -> tuple[float, float, float, float]:
    """Column, row, width and height that a region would have now if no frame had shown its size, px."""
    assert followed.outgrown is not None
    right, down, width, height, _ = followed.outgrown
    last = followed.latest
    return last.x_px + right, last.y_px + down, width, height


def _lies_in_outgrown(like: Followed, region: Region) -> bool:
    """Whether a region's centre lies in what another was taken for, at any time."""
    if like.outgrown is None:
        return False
    x_px, y_px, width_px, height_px = _outgrown(like)
    return abs(region.x_px - x_px) <= width_px / 2 and abs(region.y_px - y_px) <= height_px / 2


def _inside(hits: NDArray[np.int32], box: Box) -> NDArray[np.int32]:
    """The cells that a box touches."""
    left, top, right, bottom = box
    return hits[
        top >> _CELL_SHIFT : (bottom - 1 >> _CELL_SHIFT) + 1,
        left >> _CELL_SHIFT : (right - 1 >> _CELL_SHIFT) + 1,
    ]


def _cleared(hits: NDArray[np.int32], box: Box) -> int:
    """Set the cells that a box touches to 0; return what they had."""
    return _kernels.clear_cells(hits, box, _CELL_SHIFT)


def _joined(boxes: list[Box], gap: int) -> list[Box]:
    """Boxes with less than a gap between them as one."""
    done: list[Box] = []
    for box in boxes:
        while near := [b for b in done if _overlap(_grown(box, gap), b)]:
            done = [b for b in done if b not in near]
            box = _around([box, *near])
        done.append(box)
    return done


def _around(boxes: list[Box]) -> Box:
    lefts, tops, rights, bottoms = zip(*boxes, strict=True)
    return min(lefts), min(tops), max(rights), max(bottoms)


def _tight(x_px: float, y_px: float, width_px: float, height_px: float) -> Box:
    return (
        int(x_px - width_px / 2),
        int(y_px - height_px / 2),
        int(x_px + width_px / 2) + 1,
        int(y_px + height_px / 2) + 1,
    )


def _box_of(region: Region) -> Box:
    return _tight(region.x_px, region.y_px, region.width_px, region.height_px)


def _median(values: Iterable[float]) -> float:
    ordered = sorted(values)
    many = len(ordered)
    return ordered[many // 2] if many % 2 else (ordered[many // 2 - 1] + ordered[many // 2]) / 2


def _told(n: int, most: int, total: int, rows: int) -> float:
    """What a pixel more inside says for a place of a bar: the logarithm of the ratio of pixels a row.

    Pixels in the bar's rows and in others are Poisson variables; half a pixel stands for none.

    Args:
        n: Rows of the bar.
        most: Pixels inside where most of them are.
        total: Pixels in all rows.
        rows: How many rows these are.
    """
    lit, other = most / n, (total - most) / max(rows - n, 1)
    return max(math.log((lit + 0.5 / n) / (other + 0.5 / n)), 0.0)


def _likeliest(inside: NDArray[np.int64], told: float, expected: float) -> int:
    """Which place holds a bar: by the pixels inside at each, int64 (places,), and by the expected place.

    Where it is not told what a pixel says, those with the most pixels, and of them the nearest one.
    """
    off = np.arange(len(inside)) - expected
    if told == 0:
        return int(np.where(inside == inside.max(), np.abs(off), np.inf).argmin())
    return int((told * inside - (off / _STRAY_PX) ** 2 / 2).argmax())


def _shows_again(
    rows: NDArray[np.int64], centre: float, height_px: float, lit_px: tuple[float, float]
) -> bool:
    """Whether rows of a bar that were dark in its newest frame hold half as many pixels as the others."""
    edges = centre + np.array([-height_px / 2, *lit_px, height_px / 2])
    first, upper, lower, last = np.clip(np.round(edges).astype(int), 0, len(rows))
    hidden, lit = max(upper - first, 0) + max(last - lower, 0), lower - upper
    if hidden <= 0 or lit <= 0:
        return False
    inside = int(rows[upper:lower].sum())
    outside = int(rows[first:upper].sum()) + int(rows[lower:last].sum())
    return bool(outside * lit > _SHOWN * inside * hidden)


def _height(lit_px: tuple[float, float] | None) -> float:
    """Of a part of a bar, px; infinite of the whole."""
    return math.inf if lit_px is None else lit_px[1] - lit_px[0]


def _grown(box: Box, by: int) -> Box:
    left, top, right, bottom = box
    return max(left - by, 0), max(top - by, 0), right + by, bottom + by


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
