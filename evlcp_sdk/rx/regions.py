"""Track image regions that blink in the rhythm of the chips, and keep their events."""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.sections import RegionSpec
from evlcp_sdk.plugin.roles import Filter
from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.boxes import (
    CELL_SHIFT,
    Box,
    bounding_box,
    box_around,
    box_of,
    boxes_overlap,
    clip_box,
    count_hits,
    cut_neighbours,
    find_areas,
    find_likeliest_row,
    grow_box,
    is_lit_again,
    join_boxes,
    subtract_boxes,
)
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.rx.rhythm import OPENING_REPEATS, BlinkDetector
from evlcp_sdk.rx.sweeps import FAST_PX_US, Sweep, find_sweeps, fit_sweep
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import Events, Region

MARGIN_PX = 5
"""Seam around a region: how far it may move in a step, 1.5 px/ms and more, and how far it is blurred."""

STRAY_PX = 2.0
"""Excess height of a region that may be no strays: an edge is good to a pixel."""

STILL = 0.0, 0.0
"""Velocity of a region whose pixels blink."""

BACKFILL_STEPS = 12
"""Steps kept from before a region was found: a pixel needs about 1 ms to score, a region two steps."""

SAME_PX = 5.0
"""Largest distance of two regions of one image, px: before lit leaves an end is good to some px."""

_HEIGHTS = 9
"""Measured heights whose median is a region's: a bar ahead grows by a percent in so many steps at 80 km/h."""

_MAX_AHEAD_STEPS = 2
"""Steps by which a track is extrapolated: then a shaking camera turns."""

_CAPACITY = 64
"""Samples that a track has room for at first; a second of steps needs more."""

EVENT_BYTES: Final = 13
"""Size of an event: its time, column, row and polarity."""

PIECE_BYTES: Final = 768
"""Size of four arrays and of what holds them, however few events there are."""

Piece = tuple[int, Events]
"""Start of a time step, us, and a region's events in it."""


class RegionTrack:
    """Centres and sizes of a region over time, oldest first; never empty.

    Args:
        regions: The measured ones.

    Attributes:
        latest: The newest.
        previous: The one before it; the same where there is no other.

    >>> track = RegionTrack([Region(0, 0.0, 5.0, 7.0, 4.0, 9.0), Region(0, 100.0, 6.0, 7.0, 4.0, 9.0)])
    >>> len(track), track.centre_at(50.0), track.centre_at(1000.0), track.size_at(70.0)
    (2, (5.5, 7.0), (8.0, 7.0), (4.0, 9.0))
    """

    def __init__(self, regions: Sequence[Region]) -> None:
        self.latest = regions[0]
        self._first = self._end = 0
        self._columns = np.empty((5, _CAPACITY))
        for region in regions:
            self.append(region)

    def __len__(self) -> int:
        return self._end - self._first

    def append(self, region: Region) -> None:
        """Add the next one."""
        if self._end == self._columns.shape[1]:
            self._reallocate()
        sample = region.t_us, region.x_px, region.y_px, region.width_px, region.height_px
        self._columns[:, self._end] = sample
        self._end += 1
        self.previous, self.latest = self.latest, region

    def drop_latest(self) -> None:
        """Undo the last `append`."""
        self._end -= 1
        self.latest = self.previous
        self._find_previous()

    def forget_before(self, t_us: float) -> None:
        """Drop those older than a time, except the newest of them; the last two stay."""
        t = self._columns[0]
        while self._end - self._first > 2 and t[self._first + 1] < t_us:
            self._first += 1

    def copy_shifted(
        self,
        id: int,
        right_px: float,
        down_px: float,
        size_px: tuple[float, float] | None = None,
        *,
        row_px: float = 0.0,
        most_px: float = np.inf,
        drift_us: tuple[float, float] | None = None,
    ) -> "RegionTrack":
        """A copy under another number, shifted, and all of one size if `size_px` is given.

        Args:
            id: Its number.
            right_px: Shift to the right.
            down_px: Shift down.
            size_px: (width, height) of all samples.
            row_px: Row to which centres of another height are drawn.
            most_px: Where a height differs by more than this from the new one, its centre may be off by half
                of the excess: the row within that which is nearest to `row_px` is taken.
            drift_us: Times from and to which the shift grows evenly from 0; samples before the first stay.
        """
        track = object.__new__(RegionTrack)
        track._columns, track._first, track._end = self._columns, self._first, self._end
        track._reallocate()
        samples = track._samples()
        share: NDArray[np.float64] | float = 1.0
        if drift_us is not None and drift_us[1] > drift_us[0]:
            share = (samples[0] - drift_us[0]) / (drift_us[1] - drift_us[0])
            share = np.minimum(np.maximum(share, 0.0), 1.0)
        samples[1] += share * right_px
        samples[2] += share * down_px
        if size_px is not None:
            if most_px < np.inf:
                slack_px = np.maximum(np.abs(samples[4] - size_px[1]) - most_px, 0.0) / 2
                samples[2] += np.minimum(np.maximum(row_px - samples[2], -slack_px), slack_px)
            samples[3], samples[4] = size_px
        track.latest = make_region(id, *samples[:, -1].tolist())
        track._find_previous()
        return track

    def centres_at(
        self, times: NDArray[np.float64], start_us: float = 0.0, unit_us: float = 1.0
    ) -> NDArray[np.float64]:
        """Centres (column, row) at `start_us + times * unit_us`, float64 (2, n), px.

        Interpolated; extrapolated for a little.
        """
        centre = np.empty((2, len(times)))
        _kernels.interpolate_centres(times, start_us, unit_us, self._samples(), _MAX_AHEAD_STEPS, centre)
        return centre

    def centre_at(self, t_us: float) -> tuple[float, float]:
        """Centre at one time, as `centres_at`."""
        last = self.latest
        if self._end - self._first == 1:
            return last.x_px, last.y_px
        # On the line from the sample before to the one after it; the outermost lines go on for a little.
        t, right = self._columns[0], self._end - 1
        while right > self._first + 1 and t[right - 1] > t_us:
            right -= 1
        (from_us, to_us), (from_x, to_x), (from_y, to_y) = self._columns[:3, right - 1 : right + 1].tolist()
        span_us = to_us - from_us
        is_late = t_us > to_us
        after_us = t_us - (to_us if is_late else from_us)
        after_us = min(max(after_us, -_MAX_AHEAD_STEPS * span_us), _MAX_AHEAD_STEPS * span_us)
        x_px = (to_x if is_late else from_x) + (to_x - from_x) / span_us * after_us
        return x_px, (to_y if is_late else from_y) + (to_y - from_y) / span_us * after_us

    def size_at(self, t_us: float) -> tuple[float, float]:
        """(width, height) measured nearest to a time, px."""
        t, i = self._columns[0], self._end - 1
        while i > self._first and t[i - 1] >= t_us:
            i -= 1
        if i > self._first and t_us - t[i - 1] < t[i] - t_us:
            i -= 1
        width_px, height_px = self._columns[3:, i].tolist()
        return width_px, height_px

    def _find_previous(self) -> None:
        self.previous = self.latest
        if len(self) > 1:
            self.previous = make_region(self.latest.id, *self._columns[:, self._end - 2].tolist())

    def _samples(self) -> NDArray[np.float64]:
        """Times, columns, rows, widths and heights, float64 (5, n)."""
        return self._columns[:, self._first : self._end]

    def _reallocate(self) -> None:
        """Copy the samples into an array with room for as many more."""
        samples = self._samples()
        count = samples.shape[1]
        self._columns = np.empty((5, max(2 * count, _CAPACITY)))
        self._columns[:, :count] = samples
        self._first, self._end = 0, count


def make_region(id: int, t_us: float, x_px: float, y_px: float, width_px: float, height_px: float) -> Region:
    """Make a region without the calls that a frozen class makes for each field: there are many a frame."""
    region = object.__new__(Region)
    vars(region).update(id=id, t_us=t_us, x_px=x_px, y_px=y_px, width_px=width_px, height_px=height_px)
    return region


def memory_bytes(events: Events) -> int:
    """Size of a piece with these events, bytes."""
    return PIECE_BYTES + EVENT_BYTES * events.t_us.size


class BarPlace(NamedTuple):
    """Where a frame with a pilot shows its bar.

    Attributes:
        t_us: When, us.
        centre_px: Centre (column, row) of the whole bar on the sensor.
        size_px: Its (width, height).
        lit_px: See `TrackedRegion.lit_px`.
        strips_px: See `TrackedRegion.strips_px`.
        others: (centre, size) of other instances of it in the same image, best first.
    """

    t_us: float
    centre_px: tuple[float, float]
    size_px: tuple[float, float]
    lit_px: tuple[float, float] | None = None
    strips_px: NDArray[np.float64] | None = None
    others: tuple[tuple[tuple[float, float], tuple[float, float]], ...] = ()


@dataclass
class TrackedRegion:
    """A region that is tracked over time, with its events.

    Attributes:
        id: Number of the region, from 0.
        track: Its measured centres and sizes.
        pieces: Its events, one entry a time step.
        first_us: Start of the first step of which it has events, us.
        filter: State of the filter of its centre, None without one.
        heights: Measured lately, px; of a bar of known size, in steps that showed both of its ends.
        size_px: (width, height) of the whole bar, px, as its frames show it; None before the first.
        lit_px: Upper and lower edge, from the bar's centre, of the part that its newest frame showed, px;
            None where it showed both ends.
        strips_px: (middle from the bar's centre, half the width) of each strip of columns that a bar's light
            stands in, px, float64 (n, 2); None of other bars, and before the first frame.
        shown_us: When its newest frame showed its place, us; None before the first.
        initial_extent: What it was taken for before the first frame, which may have held other bars: (right,
            down) of that centre from its own, width and height, px, and until when that matters, us.
        released: It has faded or was merged into another, and gets no more events.
        opened_us: End of the step in which it was found, us.
        forgotten_until_us: Its events before this time were dropped for want of room, us; None of none.
        memory_bytes: Size of its pieces.
        calm_us: When the pixels beside its bar were last calm, us.
        velocity_px_us: How fast it sweeps to the right and down; `STILL` of one whose pixels blink.
    """

    id: int
    track: RegionTrack
    first_us: int
    pieces: deque[Piece] = field(default_factory=deque)
    released: bool = False
    filter: Any = None
    heights: deque[float] = field(default_factory=lambda: deque(maxlen=_HEIGHTS))
    size_px: tuple[float, float] | None = None
    lit_px: tuple[float, float] | None = None
    strips_px: NDArray[np.float64] | None = None
    shown_us: float | None = None
    initial_extent: tuple[float, float, float, float, float] | None = None
    opened_us: int = 0
    forgotten_until_us: int | None = None
    memory_bytes: int = 0
    calm_us: int = 0
    velocity_px_us: tuple[float, float] = STILL

    def __post_init__(self) -> None:
        self.replace_pieces(self.pieces)

    def replace_pieces(self, pieces: deque[Piece]) -> None:
        """Hold other events instead of its own."""
        self.pieces = pieces
        self.memory_bytes = sum(memory_bytes(events) for _, events in pieces)

    def add(self, start_us: int, events: Events) -> None:
        """Add the events of the next step."""
        self.pieces.append((start_us, events))
        self.memory_bytes += memory_bytes(events)

    def drop_oldest(self) -> int:
        """Drop the events of the oldest step; return their number."""
        _, events = self.pieces.popleft()
        self.memory_bytes -= memory_bytes(events)
        return events.t_us.size

    def pieces_between(self, from_us: float, until_us: float, step_us: int) -> list[Piece]:
        """The pieces of time steps of `step_us` that overlap a span of time."""
        return [piece for piece in self.pieces if piece[0] < until_us and piece[0] + step_us > from_us]

    def count_events(self, from_us: float, until_us: float) -> int:
        """How many of its events lie in a span of time."""
        return sum(
            int(np.diff(np.searchsorted(events.t_us, (from_us, until_us)))[0])
            for start_us, events in self.pieces
            if start_us < until_us
        )

    @property
    def latest(self) -> Region:
        """The newest position."""
        return self.track.latest

    def deviation_px(self, bar: BarPlace) -> float:
        """How far it is off its bar in place or size, px; infinite while its size is not known."""
        if self.size_px is None:
            return math.inf
        (x, y), (width, height) = self.track.centre_at(bar.t_us), self.size_px
        (bar_x, bar_y), (bar_width, bar_height) = bar.centre_px, bar.size_px
        return max(abs(bar_x - x), abs(bar_y - y), abs(bar_width - width), abs(bar_height - height))

    def covers_point(self, t_us: float, point_px: tuple[float, float]) -> bool:
        """Whether a point on the sensor (column, row) lies in the region at a time."""
        (x, y), (width, height) = self.track.centre_at(t_us), self.track.size_at(t_us)
        return abs(point_px[0] - x) <= width / 2 and abs(point_px[1] - y) <= height / 2

    def includes_region(self, other: "TrackedRegion", t_us: float, same_px: float) -> bool:
        """Whether another region is a part of this bar, or the same bar: their centres within `same_px`."""
        when_us = other.latest.t_us if other.size_px is None else t_us
        (x, y), (u, v) = self.track.centre_at(when_us), other.track.centre_at(when_us)
        right, down = abs(u - x), abs(v - y)
        if other.size_px is not None:
            return max(right, down) <= same_px
        # Half of it, or more, in each direction.
        return right <= self.latest.width_px / 2 + same_px and down <= self.latest.height_px / 2

    def forget_before(self, t_us: float, step_us: int, track_us: float) -> None:
        """Drop events older than `t_us`, and the track before `track_us`: others ask where it was."""
        while self.pieces and self.pieces[0][0] + step_us <= t_us:
            self.drop_oldest()
        self.track.forget_before(track_us)


def is_same_place(one: Region, other: Region) -> bool:
    """Whether the centre of one of two regions lies in the other."""
    right, down = abs(one.x_px - other.x_px), abs(one.y_px - other.y_px)
    return any(right <= at.width_px / 2 and down <= at.height_px / 2 for at in (one, other))


_COUNTS = ("steps_forgotten", "dropped_no_room", "regions_left_out", "regions_gave_way", "areas_left_out")


class RegionTracker(ABC):
    """Tracks the regions of a stream, with their events, from time step to time step.

    Attributes:
        alive: Those that are tracked.
        counts: What was left out for want of room.
    """

    def __init__(self, step_us: int, limits: Limits, most_recent: int) -> None:
        self._step_us, self._limits, self._most_recent = step_us, limits, most_recent
        # The newest steps, with the events of the whole image.
        self._recent: deque[Piece] = deque()
        self._recent_bytes = 0
        self.alive: list[TrackedRegion] = []
        self.counts = dict.fromkeys(_COUNTS, 0)

    @abstractmethod
    def step(self, start_us: int, events: Events, occupied: Sequence[Region] = ()) -> list[TrackedRegion]:
        """Process the events of a time step; return the regions that are alive or ended in it.

        Args:
            start_us: Start of the step, us.
            events: Those in it, in order.
            occupied: Places that belong to other links: no region is opened there, or reaches into them.
        """

    def skip_gap(self) -> None:
        """Forget the events before a gap in time; no region is alive."""
        self._recent.clear()
        self._recent_bytes = 0

    def close(self) -> None:
        """End the stream: forget all events."""
        self.skip_gap()
        self.alive = []

    def drop(self, region: TrackedRegion) -> None:
        """Stop tracking a region at once."""
        region.released = True
        self.alive = [other for other in self.alive if other is not region]

    def _store_step(self, start_us: int, events: Events) -> None:
        """Store a step's events for regions found later, and as many steps before it as there is room for."""
        recent = self._recent
        recent.append((start_us, events))
        self._recent_bytes += memory_bytes(events)
        while (steps := len(recent)) > self._most_recent or (
            self._recent_bytes > self._limits.recent_bytes and steps > 1
        ):
            self.counts["steps_forgotten"] += steps <= self._most_recent
            self._recent_bytes -= memory_bytes(recent.popleft()[1])

    def _limit_memory(self) -> None:
        """Drop the oldest events until those of all regions are within the limit."""
        spare = self._limits.region_bytes - sum([region.memory_bytes for region in self.alive])
        while spare < 0 and (longer := [region for region in self.alive if len(region.pieces) > 1]):
            oldest_us = min(region.pieces[0][0] for region in longer)
            for region in longer:
                if spare < 0 and region.pieces[0][0] == oldest_us:
                    spare += region.memory_bytes
                    self.counts["dropped_no_room"] += region.drop_oldest()
                    spare -= region.memory_bytes
                    region.forgotten_until_us = region.first_us = oldest_us + self._step_us


_MIN_RISES = 20
"""Rises of candidate pixels in a step that a new region needs: a cluster at 100 m has as many, noise few."""

_MEASURE_GAPS = 1.5
"""A blinking pixel rises once in the longest gap of the code; half of that again allows for a late event."""

_LATENCY_CHIPS = 5
"""Age of a measured centre. A moving bar's leading end counts once its pixels have risen in rhythm twice,
some six chips late and more where events go missing; its trailing end stays for the six chips of the
measurement. In recordings and simulated scenes the centre is 3 to 8 chips late."""

_MAX_RECENT_US = 200_000
"""Longest time for which events of the whole image are kept, to gather those of a region again: a packet that
is longer starts with the frames in reach."""

_BLUR_PX = 2.0
"""How much longer than a bar its blinking pixels are: blur of a pixel at either end; in motion twice that."""

_MIN_PIXELS = 4
"""Blinking pixels below which a region has no position: one cluster at 100 m has a dozen."""

_CALM, _FLOODED, _FLOOD_STEPS = 0.25, 0.5, 3
"""Share of the pixels beside a bar that rose lately: up to the first they are calm; from the second on, soon
after that, all light changes, and pixels that the bar has left would drag its region along. That may last so
many steps; what goes on, a halo, is no change. Leaves make 0.45 at the most."""

_MIN_SWEEP_EVENTS, _SWEEP_STEPS = 300, 4
"""Events outside all regions from which on sweeping bars are sought; and steps whose events such a bar has
when it is found: two showed it, and it moved alike before."""

_CENTRE_SIGMA_PX = 0.25
"""Error of a measured centre: the edge of a row of pixels, a third of one, at the top and at the bottom."""

_CORRECTION_PX = 1.0
"""Deviation from its bar, in place or size, from which on a region is corrected: a fifth of its seam."""

_REMNANT_STEPS = 6
"""Steps in which the rest of a region that turned out to be smaller may become one: it blinks all the time.
What wakes there later is a halo, or leaves that its light falls on."""

Place = tuple[float, float, float, float]
"""Column and row of a centre, width and height, px."""


class RhythmTracker(RegionTracker):
    """Finds and tracks what blinks in the rhythm of the chips; frames correct regions to fit their bars.

    Args:
        spec: Parameters.
        camera: For the size of the sensor.
        chip_us: Nominal length of a chip, us.
        centre_filter: Filter of the centres; None for centres as measured.
        keep_us: How long events of the whole image are kept, as a region may turn out to be larger, us.
        limits: How much is held.
        gap_chips: The longest time from rise to rise in the codes; 4 in pair codes.
        detector: That of another tracker with the same rhythm; None for its own.
    """

    def __init__(
        self,
        spec: RegionSpec,
        camera: CameraModel,
        chip_us: float,
        centre_filter: Filter | None = None,
        keep_us: float = 0.0,
        limits: Limits = LIMITS,
        gap_chips: int = 4,
        detector: BlinkDetector | None = None,
    ) -> None:
        most_recent = max(math.ceil(min(keep_us, _MAX_RECENT_US) / spec.step_us), BACKFILL_STEPS)
        super().__init__(spec.step_us, limits, most_recent)
        self._spec = spec
        self._keep_us = keep_us
        self._centre_filter = centre_filter
        self._sensor_px = camera.width, camera.height
        self._measure_us = round(_MEASURE_GAPS * gap_chips * chip_us)
        self._latency_us = _LATENCY_CHIPS * chip_us
        self._chip_us = chip_us
        self._detector = detector or BlinkDetector(
            camera.width, camera.height, chip_us, spec.min_score, gap_chips
        )
        # Emptied once a step: two bytes each.
        self._hits = np.zeros([(n - 1 >> CELL_SHIFT) + 1 for n in (camera.height, camera.width)], np.int16)
        self._new_boxes: list[Box] = []
        self._sweeps: list[Sweep] = []
        self._next_id = 0

    def step(self, start_us: int, events: Events, occupied: Sequence[Region] = ()) -> list[TrackedRegion]:
        """See `RegionTracker`."""
        spec = self._spec
        self._store_step(start_us, events)
        rises = self._detector.step(start_us, events, self._hits, CELL_SHIFT)
        end_us = start_us + spec.step_us
        boxes = self._predict_boxes(start_us + spec.step_us / 2, occupied)
        # Before a frame shows where in its box a bar is, panels and moving textures around it would drown it:
        # only what blinks in rhythm counts.
        unknown = [one.size_px is None and one.velocity_px_us == STILL for one in self.alive]
        selected = self._detector.select(events, boxes, unknown) if boxes else []
        outside = events.t_us.size
        for region, inside, trimmed in zip(self.alive, selected, self._trim_boxes(boxes), strict=True):
            region.add(start_us, inside)
            outside -= inside.t_us.size
            if (found := self._locate_region(region, trimmed, end_us, (start_us + end_us) / 2)) is not None:
                region.filter, place, region.velocity_px_us = found
                region.track.append(place)
        self._merge_overlapping()
        self._limit_memory()
        self._open_regions(end_us, rises, occupied)
        resting = [one for one in self.alive if one.velocity_px_us == STILL and one.size_px is not None]
        if outside >= _MIN_SWEEP_EVENTS and not resting:
            self._open_sweeping(start_us, events, occupied)
        seen, any_released = list(self.alive), False
        for region in seen:
            region.released |= end_us - region.track.latest.t_us > spec.fade_us
            any_released |= region.released
        if any_released:
            self._drop_released()
        return seen

    def _predict_boxes(self, t_us: float, occupied: Sequence[Region]) -> list[Box]:
        """The box of each region in the middle of a step; one of unknown size is kept clear of the others."""
        boxes, others, has_unknown = [], [box_of(place) for place in occupied], False
        for region in self.alive:
            x_px, y_px = self._predict_centre(region, t_us)
            boxes.append(self._search_box(x_px, y_px, *self._swept_size(region)))
            has_unknown |= region.size_px is None
        if not has_unknown:
            return boxes
        for region in self.alive:
            if region.size_px is not None:
                last = region.track.latest
                others.append(box_around(*self._predict_centre(region, t_us), last.width_px, last.height_px))
        return [
            subtract_boxes(box, others) if region.size_px is None else box
            for region, box in zip(self.alive, boxes, strict=True)
        ]

    def _swept_size(self, region: TrackedRegion) -> tuple[float, float]:
        """(width, height) that a region covers in a step, px."""
        last, (right, down), step_us = region.track.latest, region.velocity_px_us, self._spec.step_us
        return last.width_px + abs(right) * step_us, last.height_px + abs(down) * step_us

    def _trim_boxes(self, boxes: list[Box]) -> list[Box]:
        """Cut other bars of known size off each box.

        Rows of a bar below would be as good as its own, so that a region would move on to them.
        """
        if len(boxes) < 2 or not any(boxes_overlap(one, other) for one, other in combinations(boxes, 2)):
            return boxes
        tight = [
            grow_box(box, -MARGIN_PX) if one.size_px else None
            for box, one in zip(boxes, self.alive, strict=True)
        ]
        bars = [bar for bar in tight if bar is not None]
        return [
            box if bar is None else cut_neighbours(box, bar, bars)
            for box, bar in zip(boxes, tight, strict=True)
        ]

    def _drop_released(self) -> None:
        lost = [region for region in self.alive if region.released and region.size_px is not None]
        self.alive = [region for region in self.alive if not region.released]
        for region in self.alive:
            # A bar that was seen in what another was taken for is no halo when it is seen again.
            if any(_is_in_initial_extent(gone.latest, region) for gone in lost):
                region.initial_extent = None

    def skip_gap(self) -> None:
        """See `RegionTracker`."""
        super().skip_gap()
        self._new_boxes = []

    def gather_events(
        self, region: TrackedRegion, from_us: float = -math.inf, until_us: float = math.inf
    ) -> None:
        """Select a region's events again, from where it is now known to have been.

        Args:
            region: The region.
            from_us: From the step that holds this time, us.
            until_us: To the step before this time, us.
        """
        oldest_us = region.pieces[0][0] if region.pieces else region.first_us
        step_us = self._spec.step_us
        kept = [
            piece
            for piece in self._recent
            if oldest_us <= piece[0] < until_us and piece[0] + step_us > from_us
        ]
        size_px, gathered = self._swept_size(region), {}
        x, y = region.track.centres_at(np.array([start + step_us / 2 for start, _ in kept]))
        for (start, events), x_px, y_px in zip(kept, x.tolist(), y.tolist(), strict=True):
            box = self._search_box(x_px, y_px, *size_px)
            gathered[start] = self._detector.select(events, [box], [False])[0]
        region.replace_pieces(deque((start, gathered.get(start, events)) for start, events in region.pieces))
        self._limit_memory()

    def correct_region(self, region: TrackedRegion, bar: BarPlace) -> float:
        """Fit a region to its bar as a frame showed it; return how far it was off, px.

        0 where it was near enough, infinite at the first time. Its events stay those of where it was taken to
        be until they are gathered again; within half of the seam, they are all there.
        """
        t_us, (x_px, y_px), size_px = bar.t_us, bar.centre_px, bar.size_px
        if (
            region.lit_px != bar.lit_px
            and abs(_lit_height_px(region.lit_px) - _lit_height_px(bar.lit_px)) > STRAY_PX
        ):
            # Heights of another part.
            region.heights.clear()
        region.lit_px, region.strips_px = bar.lit_px, bar.strips_px
        x, y = region.track.centre_at(t_us)
        off = x_px - x, y_px - y
        is_first, before_us, region.shown_us = region.size_px is None, region.shown_us, t_us
        off_px = region.deviation_px(bar)
        if is_first:
            region.heights.clear()
            # Beside the bar itself there may be a halo.
            region.calm_us = 0
            last = region.track.latest
            until_us = last.t_us + _REMNANT_STEPS * self._spec.step_us
            region.initial_extent = -off[0], -off[1], last.width_px, last.height_px, until_us
        elif off_px < _CORRECTION_PX:
            return 0.0
        region.size_px = size_px
        # Where less of the bar was seen, or more than it, its place is not that of what was seen.
        most_px = 2 * MARGIN_PX if is_first else math.inf
        drift_us = None if is_first or before_us is None else (before_us, t_us)
        region.track = region.track.copy_shifted(
            region.id, *off, size_px, row_px=y_px, most_px=most_px, drift_us=drift_us
        )
        region.filter = self._init_filter()
        return off_px

    def _init_filter(self) -> Any:
        return self._centre_filter.init() if self._centre_filter else None

    def merge_regions(self, region: TrackedRegion, other: TrackedRegion) -> None:
        """Merge another region into one, while neither's bar is known; the other one is dropped."""
        one, two = region.latest, other.latest
        left, top, right, bottom = bounding_box([box_of(one), box_of(two)])
        off_x, off_y = (left + right - 1) / 2 - one.x_px, (top + bottom - 1) / 2 - one.y_px
        size_px = float(right - left - 1), float(bottom - top - 1)
        region.track = region.track.copy_shifted(region.id, off_x, off_y, size_px)
        region.heights.clear()
        region.filter = self._init_filter()
        since_us = min(part.pieces[0][0] for part in (region, other) if part.pieces)
        region.first_us = min(region.first_us, other.first_us)
        if self._recent[0][0] > since_us:
            region.forgotten_until_us = region.first_us = self._recent[0][0]
        region.pieces = deque((start, events) for start, events in self._recent if start >= since_us)
        self.gather_events(region)
        region.replace_pieces(
            deque((start, self._detector.select_rhythmic(events)) for start, events in region.pieces)
        )
        self.drop(other)

    def open_duplicate(self, original: TrackedRegion, bar: BarPlace) -> TrackedRegion:
        """Open a region for another image of a bar, which moves as the region that showed it does."""
        id, self._next_id = self._next_id, self._next_id + 1
        track, pieces = original.track.copy_shifted(id, 0.0, 0.0), deque(original.pieces)
        region = TrackedRegion(id, track, original.first_us, pieces, filter=original.filter)
        region.opened_us = original.opened_us
        self.alive.append(region)
        self.correct_region(region, bar)
        self.gather_events(region)
        return region

    def has_room(self) -> bool:
        """Whether another region may be tracked; counts one that may not."""
        has_room = len(self.alive) < self._limits.regions
        self.counts["regions_left_out"] += not has_room
        return has_room

    def begin_partial_step(self, start_us: int, until_us: int, events: Events, ids: Collection[int]) -> None:
        """Give some regions the events of a time step so far, and their places by these.

        They get the events of the whole image, of which a frame uses those in its own place: to select them
        would take longer, and they are selected with the whole step.

        Args:
            start_us: Start of the step, us.
            until_us: Time before which all events are there, us.
            events: Those in it, in order; they come again with the whole step.
            ids: Numbers of these regions, which are alive and of known size.
        """
        for region in self.alive:
            if region.id in ids:
                region.pieces.append((start_us, events))
        # Sooner after the place before, another tells little of where the region goes.
        if 2 * (until_us - start_us) >= self._spec.step_us:
            self._detector.step(start_us, events, self._hits, CELL_SHIFT)
            boxes = self._predict_boxes(start_us + self._spec.step_us / 2, ())
            for region, box in zip(self.alive, self._trim_boxes(boxes), strict=True):
                if region.id in ids:
                    heights = region.heights.copy()
                    found = self._locate_region(region, box, until_us, (start_us + until_us) / 2)
                    if found is not None:
                        region.track.append(found[1])
                    region.heights = heights
        self._recent.append((start_us, events))

    def end_partial_step(self, until_us: int) -> None:
        """Undo `begin_partial_step`; what frames showed in that part stays."""
        start_us, events = self._recent.pop()
        for region in self.alive:
            if region.pieces and region.pieces[-1][0] == start_us:
                _, part = region.pieces.pop()
                # Events that were gathered for a frame were counted; those of the whole image were not.
                region.memory_bytes -= 0 if part is events else memory_bytes(part)
            middle_us = (start_us + until_us) / 2 - self._chip_us
            if region.track.latest.t_us in (until_us - self._latency_us, middle_us):
                region.track.drop_latest()

    def _predict_centre(self, region: TrackedRegion, t_us: float) -> tuple[float, float]:
        """Centre (column, row) of a region soon, px, by its filter or its velocity."""
        if self._centre_filter is not None:
            predicted = self._centre_filter.predict(region.filter, t_us)
            if predicted is not None:
                return float(predicted[0][0]), float(predicted[0][1])
        last, before = region.track.latest, region.track.previous
        if region.velocity_px_us != STILL:
            (right, down), after_us = region.velocity_px_us, t_us - last.t_us
            return last.x_px + after_us * right, last.y_px + after_us * down
        if before is last:
            return last.x_px, last.y_px
        # Further ahead, a shaking camera has turned back.
        ahead = min((t_us - last.t_us) / (last.t_us - before.t_us), 1.0)
        return last.x_px + ahead * (last.x_px - before.x_px), last.y_px + ahead * (last.y_px - before.y_px)

    def _place_whole_bar(
        self, region: TrackedRegion, t_us: float, place: Place, top: int, rows: NDArray[np.int64]
    ) -> Region:
        """Place a region of its usual height where pixels blink; `rows` counts these by row from `top` on.

        Where few pixels are awake, an end is dark; where noise wakes pixels that a fast bar has left, there
        is one too many. Of the places that the edges allow, the nearest to the expected one is taken; of more
        rows than the bar has, those that are likeliest to be its own. Where more of a bar of known size is
        missing, an end is hidden: only the one nearer to its place counts.
        """
        x_px, middle_px, width_px, seen_px = place
        known, lit = region.size_px, region.lit_px
        _, expected_px = self._predict_centre(region, t_us)
        heights = region.heights
        if lit is not None and known is not None and is_lit_again(rows, expected_px - top, known[1], lit):
            # Earlier heights are those of the part.
            lit, heights = None, deque()
        whole_px = seen_px if known is None else known[1] if lit is None else lit[1] - lit[0]
        # Of a bar with a hidden end, the visible part is found, and the whole placed by it.
        off_px = 0.0 if lit is None else (lit[0] + lit[1]) / 2
        expected_px += off_px
        if known is None or -STRAY_PX <= seen_px - whole_px <= 2 * _BLUR_PX:
            heights.append(seen_px)
        # Once a bar's height is known, a part of it tells nothing of that.
        height_px = _median(heights) if heights else whole_px
        excess_px = seen_px - height_px
        if excess_px > STRAY_PX:
            # A bar of unknown size may grow to either side.
            is_sized = known is not None
            y_px = find_likeliest_row(rows, top, round(height_px), expected_px, STRAY_PX, is_sized=is_sized)
        elif known is not None and excess_px < -2 * MARGIN_PX:
            # By its upper end, and by its lower one.
            ends_px = middle_px - excess_px / 2, middle_px + excess_px / 2
            y_px = min(ends_px, key=lambda end_px: abs(end_px - expected_px))
            if abs(y_px - expected_px) > MARGIN_PX:
                y_px = region.track.latest.y_px + off_px
        else:
            slack_px = abs(excess_px) / 2
            y_px = middle_px + min(max(expected_px - middle_px, -slack_px), slack_px)
        size_px = known or (width_px, height_px + min(max(excess_px, 0.0), STRAY_PX))
        return make_region(region.id, t_us, x_px, y_px - off_px, *size_px)

    def _locate_region(
        self, region: TrackedRegion, box: Box, now_us: int, middle_us: float
    ) -> tuple[Any, Region, tuple[float, float]] | None:
        """Measure a region in a box: its filter's new state, place and velocity; None if it is not seen."""
        last, before = region.track.latest, region.track.previous
        right, down, gap_us = last.x_px - before.x_px, last.y_px - before.y_px, last.t_us - before.t_us
        sweep = None
        if region.velocity_px_us != STILL or max(abs(right), abs(down)) > FAST_PX_US * gap_us:
            sweep = self._fit_sweep(region, box, middle_us)
        if sweep is not None:
            t_us, rows, velocity_px_us = middle_us - self._chip_us, sweep.rows, sweep.velocity_px_us
            seen: Place | None = sweep[:4]
        else:
            t_us, rows, velocity_px_us = now_us - self._latency_us, np.empty(box[3] - box[1], np.int64), STILL
            seen = self._measure_place(region, box, now_us, rows)
        if seen is None:
            return None
        place = self._place_whole_bar(region, t_us, seen, box[1], rows)
        if self._centre_filter is None:
            return region.filter, place, velocity_px_us
        centre = np.array([place.x_px, place.y_px])
        state, centre, _ = self._centre_filter.step(region.filter, t_us, centre, _CENTRE_SIGMA_PX)
        x_px, y_px = map(float, centre)
        return state, make_region(place.id, t_us, x_px, y_px, place.width_px, place.height_px), velocity_px_us

    def _fit_sweep(self, region: TrackedRegion, box: Box, middle_us: float) -> Sweep | None:
        """Fit a sweep to a region's newest events; None where it is slow enough for its pixels to blink."""
        last, before = region.track.latest, region.track.previous
        upright, gap_us = last.height_px > last.width_px, last.t_us - before.t_us
        along_px_us = region.velocity_px_us[1 if upright else 0]
        if gap_us > 0:
            along_px_us = (last.y_px - before.y_px if upright else last.x_px - before.x_px) / gap_us
        sweep = fit_sweep(region.pieces[-1][1], middle_us, box, along_px_us, FAST_PX_US)
        return sweep if sweep is not None and sweep.is_fast else None

    def _search_box(self, x_px: float, y_px: float, width_px: float, height_px: float) -> Box:
        """The box that a region's events stay in for the next step; an empty one off the sensor."""
        half_w, half_h = width_px / 2 + MARGIN_PX, height_px / 2 + MARGIN_PX
        width, height = self._sensor_px
        left, top = int(x_px - half_w), int(y_px - half_h)
        right, bottom = int(x_px + half_w) + 1, int(y_px + half_h) + 1
        if left < 0 or top < 0 or right > width or bottom > height:
            return clip_box((left, top, right, bottom), self._sensor_px)
        return left, top, right, bottom

    def _measure_place(
        self, region: TrackedRegion | None, box: Box, end_us: int, rows: NDArray[np.int64] | None = None
    ) -> Place | None:
        """Find what blinks in a box at the end of a step; None for nothing. `rows` takes its pixels by row.

        Of a bar of known width, rows count no pixels beside it, and of strips none between them. A region is
        not found while all light changes.
        """
        width_px, strips = math.inf, None
        if region is not None and region.size_px is not None:
            width_px = region.size_px[0]
            if region.strips_px is not None:
                expected_px, _ = self._predict_centre(region, end_us - self._latency_us)
                strips = expected_px, float(MARGIN_PX), region.strips_px
        if rows is None:
            rows = np.empty(box[3] - box[1], np.int64)
        total, column, left, right, upper, lower, seam = self._detector.measure(
            box, end_us, self._measure_us, width_px / 2 + 1, rows, strips
        )
        if region is not None:
            if seam <= _CALM:
                region.calm_us = end_us
            elif seam > _FLOODED and end_us - region.calm_us <= _FLOOD_STEPS * self._spec.step_us:
                return None
        if total < _MIN_PIXELS:
            return None
        return column, (upper + lower - 1) / 2, right - left + 1.0, lower - upper

    def _open_regions(self, end_us: int, rises: int, occupied: Sequence[Region]) -> None:
        """Open a region where something blinks in two successive steps, outside known and occupied places.

        `rises` is the number of hits in the step that ends at `end_us`.
        """
        hits, merge_px = self._hits, self._spec.merge_px
        if rises >= _MIN_RISES and (self.alive or occupied):
            known = [
                self._search_box(place.x_px, place.y_px, place.width_px, place.height_px)
                for place in occupied
            ]
            for region in self.alive:
                last = region.track.latest
                box = self._search_box(last.x_px, last.y_px, last.width_px, last.height_px)
                known.append(box if region.size_px else grow_box(box, merge_px))
                if region.initial_extent is not None and end_us > region.initial_extent[4]:
                    known.append(self._search_box(*_initial_place(region)))
            rises -= _kernels.clear_cells(hits, np.array(known, np.int64), CELL_SHIFT)
        before, self._new_boxes, boxes = self._new_boxes, [], []
        if rises >= _MIN_RISES:
            areas, left_out = find_areas(hits, self._limits.areas, self._sensor_px)
            self.counts["areas_left_out"] += left_out
            places = [self._measure_place(None, area, end_us) for area in areas]
            # The mean column is not in the middle: half of the width to one side may be off the sensor.
            lit = [clip_box(box_around(*place), self._sensor_px) for place in places if place is not None]
            boxes = [box for box in join_boxes(lit, merge_px) if count_hits(hits, box) >= _MIN_RISES]
        if rises:
            hits[:] = 0
        for box in boxes:
            if any(boxes_overlap(grow_box(box, merge_px), other) for other in before):
                self._open_region(box, end_us)
            else:
                self._new_boxes.append(box)

    def _open_region(self, box: Box, end_us: int) -> None:
        place = self._measure_place(None, box, end_us)
        if place is None:
            return
        reach = self._search_box(*place)
        # Lamps whose pixels were not known as such in the step before are now.
        (newest,) = self._detector.select(self._recent[-1][1], [reach], [True], OPENING_REPEATS)
        if not len(newest) or not self._make_room(end_us):
            return
        id, self._next_id = self._next_id, self._next_id + 1
        found = make_region(id, end_us - self._latency_us, *place)
        parents = [
            one
            for one in self.alive
            if one.initial_extent
            and found.t_us <= one.initial_extent[4]
            and _is_in_initial_extent(found, one)
        ]
        if parents:
            # It was seen as long as the one that it was taken to be a part of.
            parent = parents[0].latest
            size_px, right, down = place[2:], found.x_px - parent.x_px, found.y_px - parent.y_px
            track = parents[0].track.copy_shifted(id, right, down, size_px)
            pieces = deque((start, Events.empty()) for start, _ in self._recent)
        else:
            track, recent = RegionTrack([found]), list(self._recent)[-BACKFILL_STEPS:]
            pieces = deque(
                (start, self._detector.select(events, [reach], [True])[0]) for start, events in recent
            )
        filter = self._init_filter()
        region = TrackedRegion(id, track, pieces[0][0], pieces, filter=filter, opened_us=end_us)
        if parents:
            self.gather_events(region)
        self.alive.append(region)

    def _open_sweeping(self, start_us: int, events: Events, occupied: Sequence[Region]) -> None:
        """Open a region where a bar sweeps over the image in two successive steps, and none does so yet.

        Regions of pixels there that seemed to blink are released.
        """
        step_us, merge_px = self._spec.step_us, self._spec.merge_px
        known = [box_of(place) for place in occupied]
        known += [grow_box(box_of(one.latest), merge_px) for one in self.alive if one.velocity_px_us != STILL]
        earlier = self._sweeps
        self._sweeps = find_sweeps(events, start_us, step_us, self._chip_us, known, self._sensor_px)
        for sweep in self._sweeps:
            before = next((one for one in earlier if _is_same_sweep(one, sweep, step_us)), None)
            if before is None:
                continue
            velocity_px_us = (sweep.x_px - before.x_px) / step_us, (sweep.y_px - before.y_px) / step_us
            same = next((other for other in self.alive if _is_on_sweep(other.latest, sweep)), None)
            if same is not None:
                same.velocity_px_us = velocity_px_us
                continue
            if not self._make_room(start_us + step_us):
                continue
            t_us, id = start_us + step_us / 2 - self._chip_us, self._next_id
            track = RegionTrack(
                [make_region(id, t_us - step_us, *before[:4]), make_region(id, t_us, *sweep[:4])]
            )
            pieces = deque((start, Events.empty()) for start, _ in list(self._recent)[-_SWEEP_STEPS:])
            region = TrackedRegion(id, track, pieces[0][0], pieces, filter=self._init_filter())
            region.opened_us, region.velocity_px_us = start_us + step_us, velocity_px_us
            self._next_id += 1
            self.gather_events(region)
            swept = bounding_box([box_of(track.previous), box_of(track.latest)])
            for other in self.alive:
                other.released |= other.velocity_px_us == STILL and boxes_overlap(swept, box_of(other.latest))
            self.alive.append(region)

    def _make_room(self, now_us: int) -> bool:
        """Whether a new region may be tracked; the oldest one that never showed a bar may give way to it."""
        tracked = [one for one in self.alive if not one.released]
        if len(tracked) < self._limits.regions:
            return True
        idle = [one for one in tracked if one.size_px is None and one.opened_us + self._keep_us < now_us]
        if not idle:
            self.counts["regions_left_out"] += 1
            return False
        min(idle, key=lambda one: (one.opened_us, one.id)).released = True
        self.counts["regions_gave_way"] += 1
        return True

    def _merge_overlapping(self) -> None:
        """Release the younger of two regions that have grown together.

        Bars of known size do not grow: where a jolt brings one region over another, both are tracked until
        they show the same bar.
        """
        if len(self.alive) < 2:
            return
        boxed = [(region, box_of(region.latest)) for region in self.alive]
        for (older, box), (younger, other_box) in combinations(boxed, 2):
            if not boxes_overlap(box, other_box) or younger.released:
                continue
            one, other = older.latest, younger.latest
            sized = (older.size_px is not None) + (younger.size_px is not None)
            distance_px = max(abs(one.x_px - other.x_px), abs(one.y_px - other.y_px))
            if sized == 0 or distance_px <= SAME_PX or (sized == 1 and is_same_place(one, other)):
                younger.released = True


def _is_same_sweep(before: Sweep, sweep: Sweep, step_us: int) -> bool:
    """Whether a sweep continues one that was seen a step before."""
    right = sweep.x_px - before.x_px - sweep.velocity_px_us[0] * step_us
    down = sweep.y_px - before.y_px - sweep.velocity_px_us[1] * step_us
    return max(abs(right), abs(down)) <= 2 * MARGIN_PX


def _is_on_sweep(place: Region, sweep: Sweep) -> bool:
    """Whether a region holds most of a bar that sweeps."""
    right, down = abs(place.x_px - sweep.x_px), abs(place.y_px - sweep.y_px)
    long = max(place.width_px, place.height_px) > max(sweep.width_px, sweep.height_px) / 2
    return long and max(right, down) <= 2 * MARGIN_PX


def _initial_place(region: TrackedRegion) -> Place:
    """The place that a region would have now if no frame had shown its size."""
    assert region.initial_extent is not None
    right, down, width, height, _ = region.initial_extent
    last = region.track.latest
    return last.x_px + right, last.y_px + down, width, height


def _is_in_initial_extent(place: Region, region: TrackedRegion) -> bool:
    """Whether a centre lies in what a region was taken for."""
    if region.initial_extent is None:
        return False
    x_px, y_px, width_px, height_px = _initial_place(region)
    return abs(place.x_px - x_px) <= width_px / 2 and abs(place.y_px - y_px) <= height_px / 2


def _median(values: Collection[float]) -> float:
    """The same as `statistics.median`, in a third of the time."""
    ordered = sorted(values)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2


def _lit_height_px(lit_px: tuple[float, float] | None) -> float:
    """Height of the lit part of a bar, px; infinite of a whole one."""
    return math.inf if lit_px is None else lit_px[1] - lit_px[0]
