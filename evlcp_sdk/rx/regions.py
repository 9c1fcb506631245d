"""Regions that blink in the rhythm of the chips: which pixels do, what is one region, and where it goes."""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
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
    around,
    box_around,
    box_of,
    clear_of,
    cut_off,
    find_areas,
    grown,
    hits_in,
    joined,
    likeliest_row,
    overlap,
    shows_again,
)
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.rx.rhythm import SAME, Rhythm
from evlcp_sdk.rx.sweeps import FAST_PX_US, Sweep, find_sweeps, fit_sweep
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import Events, Region

MARGIN_PX = 5
"""Seam around a region: how far it may move in a step, 1.5 px/ms and more, and how far it is blurred."""

STRAY_PX = 2.0
"""How much too long a region may be before what is too much must be strays: an edge is good to a pixel."""

STILL = 0.0, 0.0
"""Speed of a region whose pixels blink."""

BACKFILL_STEPS = 12
"""Steps kept from before a region was found: a pixel needs about 1 ms to score, a region two steps."""

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
        before: The one before it; the same where there is no other.

    >>> places = Places([Region(0, 0.0, 5.0, 7.0, 4.0, 9.0), Region(0, 100.0, 6.0, 7.0, 4.0, 9.0)])
    >>> len(places), places.place_at(50.0), places.place_at(1000.0), places.size_at(70.0)
    (2, (5.5, 7.0), (8.0, 7.0), (4.0, 9.0))
    """

    def __init__(self, regions: Iterable[Region]) -> None:
        regions = list(regions)
        self.before, self.latest = [regions[0], *regions][-2:]
        self._first, self._end = 0, len(regions)
        self._columns = np.empty((5, max(2 * len(regions), _ROOM)))
        for column, p in zip(self._columns.T, regions, strict=False):
            column[:] = p.t_us, p.x_px, p.y_px, p.width_px, p.height_px

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
        self.before, self.latest = self.latest, region

    def take_back(self) -> None:
        """Drop the newest, as if it had not been taken."""
        self._end -= 1
        self.latest = self.before
        self._set_before()

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
        size_px: tuple[float, float] | None = None,
        *,
        row_px: float = 0.0,
        most_px: float = np.inf,
        grown_us: tuple[float, float] | None = None,
    ) -> "Places":
        """The same elsewhere, under a number, all of one size if one is given.

        Where the height was off the new one by more than `most_px`, the middle may be off by half of what is
        more: of those rows, the nearest to `row_px` is taken. Between the times `grown_us` they came to be so
        far off little by little; before the first, they are right.
        """
        other = object.__new__(Places)
        held = self._held()
        many = held.shape[1]
        other._columns = columns = np.empty((5, max(2 * many, _ROOM)))
        other._first, other._end = 0, many
        columns[:, :many] = held
        share: NDArray[np.float64] | float = 1.0
        if grown_us is not None and grown_us[1] > grown_us[0]:
            share = (held[0] - grown_us[0]) / (grown_us[1] - grown_us[0])
            share = np.minimum(np.maximum(share, 0.0), 1.0)
        columns[1, :many] += share * right_px
        columns[2, :many] += share * down_px
        if size_px is not None and most_px < np.inf:
            slack_px = np.maximum(np.abs(held[4] - size_px[1]) - most_px, 0.0) / 2
            off_px = row_px - columns[2, :many]
            columns[2, :many] += np.minimum(np.maximum(off_px, -slack_px), slack_px)
        if size_px is not None:
            columns[3, :many], columns[4, :many] = size_px
        other.latest = region_of(id, *columns[:, many - 1].tolist())
        other._set_before()
        return other

    def at(
        self, times: NDArray[np.float64], start_us: float = 0.0, unit_us: float = 1.0
    ) -> NDArray[np.float64]:
        """Centre (column, row) at times, float64 (2, n), px: interpolated, straight on for a little.

        Times are in units of so many us, from a start on.
        """
        centre = np.empty((2, len(times)))
        _kernels.places_at(times, start_us, unit_us, self._held(), _MOST_AHEAD_STEPS, centre)
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

    def _set_before(self) -> None:
        """Find the one before the newest."""
        if self._end - self._first > 1:
            self.before = region_of(self.latest.id, *self._columns[:, self._end - 2].tolist())
        else:
            self.before = self.latest

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
    return PIECE_BYTES + EVENT_BYTES * events.t_us.size


class ShownPlace(NamedTuple):
    """Where a frame with a pilot showed its bar.

    Attributes:
        t_us: When, us.
        centre_px: Centre (column, row) of the whole bar on the sensor.
        size_px: Its (width, height).
        lit_px: Where it shines, see `Followed.lit_px`.
        strips_px: See `Followed.strips_px`.
        others: (centre, size) of other instances of it in the same image, best first.
    """

    t_us: float
    centre_px: tuple[float, float]
    size_px: tuple[float, float]
    lit_px: tuple[float, float] | None = None
    strips_px: NDArray[np.float64] | None = None
    others: tuple[tuple[tuple[float, float], tuple[float, float]], ...] = ()


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
        calm_us: When the pixels beside its bar were seen to be calm, us.
        speed: How fast it sweeps to the right and down, px/us; `STILL` of one whose pixels blink.
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
    calm_us: int = 0
    speed: tuple[float, float] = STILL

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
        return events.t_us.size

    def pieces_between(self, from_us: float, until_us: float, step_us: int) -> list[Piece]:
        """Its pieces, of steps of some length, that reach from one time to before another."""
        return [piece for piece in self.pieces if piece[0] < until_us and piece[0] + step_us > from_us]

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

    def off_px(self, shown: ShownPlace) -> float:
        """How far it is off a bar that a frame showed, in place or size, px."""
        if self.size_px is None:
            return math.inf
        (x, y), (at_x, at_y), (width, height) = (
            self.positions.place_at(shown.t_us),
            shown.centre_px,
            shown.size_px,
        )
        return max(abs(at_x - x), abs(at_y - y), abs(width - self.size_px[0]), abs(height - self.size_px[1]))

    def covers(self, t_us: float, point_px: tuple[float, float]) -> bool:
        """Whether a point on the sensor (column, row) is inside the region at a time."""
        (x, y), (width, height) = self.positions.place_at(t_us), self.positions.size_at(t_us)
        return abs(point_px[0] - x) <= width / 2 and abs(point_px[1] - y) <= height / 2

    def holds(self, other: "Followed", t_us: float, same_px: float) -> bool:
        """Whether another region is a part of this bar, or the same bar, its centre so near at a time."""
        mine, when = self.latest, other.latest.t_us if other.size_px is None else t_us
        (x, y), (u, v) = self.positions.place_at(when), other.positions.place_at(when)
        right, down = abs(u - x), abs(v - y)
        if other.size_px is not None:
            return max(right, down) <= same_px
        # Half of it, or more, in each direction.
        return right <= mine.width_px / 2 + same_px and down <= mine.height_px / 2

    def forget_before(self, t_us: float, step_us: int, places_us: float) -> None:
        """Drop events older than a time, and positions older than another: others ask where it was."""
        pieces = self.pieces
        while pieces and pieces[0][0] + step_us <= t_us:
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


class RegionTracker(ABC):
    """Regions of a stream with their events, followed from time step to time step.

    Attributes:
        alive: Those that are followed.
        counts: What was left out for want of room.
    """

    alive: list[Followed]
    counts: dict[str, int]

    @abstractmethod
    def step(self, start_us: int, events: Events, taken: Sequence[Region] = ()) -> list[Followed]:
        """Take the events of a time step; give the regions that are alive or ended in it.

        Args:
            start_us: Start of the step, us.
            events: Those in it, in order.
            taken: Places that are others': no region is opened there, nor reaches into them.
        """

    @abstractmethod
    def skip(self) -> None:
        """Pass over a gap in time, with no region alive."""

    def close(self) -> None:
        """End the stream: forget all events."""
        self.skip()
        self.alive = []

    def drop(self, followed: Followed) -> None:
        """Let a region go at once."""
        followed.released = True
        self.alive = [other for other in self.alive if other is not followed]


_LEAST_RISES = 20
"""Rises of candidate pixels in a step that a new region needs: a cluster at 100 m has as many, noise few."""

_MEASURE_GAPS = 1.5
"""A blinking pixel rises once in the longest time of the code; half of that again allows for a late event."""

_AGE_CHIPS = 5
"""Age of a measured centre. A moving bar's leading end counts once its pixels have risen in rhythm twice,
some six chips late and more where events go missing; its trailing end stays for the six chips of the
measurement. In recordings and simulated scenes the centre is 3 to 8 chips late."""

_LONGEST_US = 200_000
"""How long events of the whole image are kept at the most, to gather those of a region anew: a packet that is
longer than that starts with the frames in reach."""

_BLUR_PX = 2.0
"""How much longer than a bar its blinking pixels are: blur of a pixel at either end; in motion twice that."""

_MIN_PIXELS = 4
"""Blinking pixels below which a region has no position: one cluster at 100 m has a dozen."""

_CALM, _FLOODED, _FLOOD_STEPS = 0.25, 0.5, 3
"""Share of the pixels beside a bar that rose lately up to which they are calm; from which on, soon after
that, the light of all changes: pixels that the bar has left show as it does, and would drag its region along.
And steps that this may last; what goes on, a halo, is no change. Leaves make 0.45 at the most."""

_LEAST_SWEPT, _SWEPT_STEPS = 300, 4
"""Events beside all regions from which on it is looked for a bar that sweeps; and steps whose events it has
when it is found: it was seen in two of them, and was in the same motion before."""

_CENTRE_SIGMA_PX = 0.25
"""Error of a measured centre: the edge of a row of pixels, a third of one, at the top and at the bottom."""

_COUNTS = ("steps_forgotten", "dropped_no_room", "regions_left_out", "regions_gave_way", "areas_left_out")

_RESHAPE_PX = 1.0
"""How far a region may be off its bar, in place and in size, before it is set right: a fifth of its seam."""

_LEFT_STEPS = 6
"""Steps in which what is left of a region that turned out to be smaller may become one: it blinks all the
time. What wakes there later is a halo, or leaves that its light falls on."""

Place = tuple[float, float, float, float]
"""Column and row of a centre, width and height, px."""


class RegionFollower(RegionTracker):
    """Finds what blinks in the rhythm of the chips, and follows it: the tracker of the receiver.

    Frames set regions right by what they show of their bars.

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
        self._sensor_px = camera.width, camera.height
        self._measure_us = round(_MEASURE_GAPS * gap_chips * chip_us)
        self._age_us = _AGE_CHIPS * chip_us
        self._chip_us = chip_us
        shape = (camera.height, camera.width)
        self._rhythm = rhythm or Rhythm(camera.width, camera.height, chip_us, spec.min_score, gap_chips)
        # Emptied once a step: two bytes each.
        self._hits = np.zeros([(n - 1 >> CELL_SHIFT) + 1 for n in shape], np.int16)
        self._fresh: list[Box] = []
        self._swept: list[Sweep] = []
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
        rises = self._rhythm.step(start_us, events, self._hits, CELL_SHIFT)
        end_us, held = start_us + spec.step_us, 0
        boxes = self._boxes(start_us + spec.step_us / 2, taken)
        # Before a frame shows where in its box a bar is, panels and moving textures around it would drown it:
        # only what blinks in rhythm counts.
        unknown = [one.size_px is None and one.speed == STILL for one in self.alive]
        selected = self._rhythm.select(events, boxes, unknown) if boxes else []
        beside = events.t_us.size
        for followed, inside, own in zip(self.alive, selected, self._own(boxes), strict=True):
            followed.add(start_us, inside)
            beside -= inside.t_us.size
            if (found := self._locate(followed, own, end_us, (start_us + end_us) / 2)) is not None:
                followed.filter, place, followed.speed = found
                followed.positions.append(place)
            held += followed.held_bytes
        if len(self.alive) > 1:
            self._merge()
        if held > self._limits.region_bytes:
            self.counts["dropped_no_room"] += make_room(self.alive, self._limits.region_bytes, spec.step_us)
        self._open(end_us, rises, taken)
        if beside >= _LEAST_SWEPT and all(one.speed != STILL or one.size_px is None for one in self.alive):
            self._open_swept(start_us, events, taken)
        seen = list(self.alive)
        gone = False
        for followed in seen:
            followed.released |= end_us - followed.positions.latest.t_us > spec.fade_us
            gone |= followed.released
        if gone:
            self._let_go()
        return seen

    def _boxes(self, t_us: float, taken: Sequence[Region]) -> list[Box]:
        """Where each region should be in the middle of a step; one of unknown size beside the others."""
        boxes, unknown, step_us = [], [], self._spec.step_us
        for followed in self.alive:
            last = followed.positions.latest
            x_px, y_px = self._expected(followed, t_us)
            right_px = last.width_px + abs(followed.speed[0]) * step_us
            boxes.append(self._reach(x_px, y_px, right_px, last.height_px + abs(followed.speed[1]) * step_us))
            if followed.size_px is None:
                unknown.append(len(boxes) - 1)
        if unknown:
            others = [box_of(place) for place in taken]
            for followed in self.alive:
                if followed.size_px is not None:
                    last = followed.positions.latest
                    x_px, y_px = self._expected(followed, t_us)
                    others.append(box_around(x_px, y_px, last.width_px, last.height_px))
            for number in unknown:
                boxes[number] = clear_of(boxes[number], others)
        return boxes

    def _own(self, boxes: list[Box]) -> list[Box]:
        """What of each box shows where its region is: the seam without other bars of known size.

        Rows of a bar below would be as good as its own, so that a region would move on to them.
        """
        if len(boxes) < 2 or not any(overlap(one, other) for one, other in combinations(boxes, 2)):
            return boxes
        tight = [
            grown(box, -MARGIN_PX) if one.size_px else None
            for box, one in zip(boxes, self.alive, strict=True)
        ]
        bars = [bar for bar in tight if bar is not None]
        return [
            box if bar is None else cut_off(box, bar, bars) for box, bar in zip(boxes, tight, strict=True)
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
        recent = self._recent
        recent.append((start_us, events))
        self._recent_bytes += held_bytes(events)
        while (many := len(recent)) > self._most_recent or (
            self._recent_bytes > self._limits.recent_bytes and many > 1
        ):
            self.counts["steps_forgotten"] += many <= self._most_recent
            self._recent_bytes -= held_bytes(recent.popleft()[1])

    def skip(self) -> None:
        """Pass over a gap in time, with no region alive."""
        self._fresh = []
        self._recent.clear()
        self._recent_bytes = 0

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
        last, (right, down) = followed.latest, followed.speed
        width_px, height_px = last.width_px + abs(right) * step_us, last.height_px + abs(down) * step_us
        gathered = {}
        x, y = followed.positions.at(np.array([start + step_us / 2 for start, _ in kept]))
        for (start, events), x_px, y_px in zip(kept, x.tolist(), y.tolist(), strict=True):
            box = self._reach(x_px, y_px, width_px, height_px)
            gathered[start] = self._rhythm.select(events, [box], [False])[0]
        followed.hold(deque((start, gathered.get(start, events)) for start, events in followed.pieces))
        self.counts["dropped_no_room"] += make_room(self.alive, self._limits.region_bytes, step_us)

    def shape(self, followed: Followed, shown: ShownPlace) -> float:
        """Set a region right by what a frame showed of its bar; return by how much, px, 0 for nothing.

        It is infinite at the first time. Its events are those of where it was taken to be, until they are
        gathered anew; within half of the seam, they are all there.
        """
        t_us, (x_px, y_px), size_px = shown.t_us, shown.centre_px, shown.size_px
        if (
            followed.lit_px != shown.lit_px
            and abs(_height(followed.lit_px) - _height(shown.lit_px)) > STRAY_PX
        ):
            # Heights of another part.
            followed.heights.clear()
        followed.lit_px, followed.strips_px = shown.lit_px, shown.strips_px
        x, y = followed.positions.place_at(t_us)
        off = x_px - x, y_px - y
        known, before_us, followed.shown_us = followed.size_px, followed.shown_us, t_us
        off_px = followed.off_px(shown)
        if known is None:
            followed.heights.clear()
            # Beside the bar itself there may be a halo.
            followed.calm_us = 0
            last = followed.latest
            until_us = last.t_us + _LEFT_STEPS * self._spec.step_us
            followed.outgrown = -off[0], -off[1], last.width_px, last.height_px, until_us
        elif off_px < _RESHAPE_PX:
            return 0.0
        followed.size_px = size_px
        # Where less of the bar was seen, or more than it, its place is not that of what was seen.
        most_px = 2 * MARGIN_PX if known is None else math.inf
        grown_us = None if known is None or before_us is None else (before_us, t_us)
        followed.positions = followed.positions.moved(
            followed.id, *off, size_px, row_px=y_px, most_px=most_px, grown_us=grown_us
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
        self.shape(followed, ShownPlace(t_us, centre_px, size_px))
        self.gather(followed)
        return followed

    def has_room(self) -> bool:
        """Whether another region may be followed; counts one that may not."""
        room = len(self.alive) < self._limits.regions
        self.counts["regions_left_out"] += not room
        return room

    def begin_part(self, start_us: int, until_us: int, events: Events, meant: Collection[int]) -> None:
        """Let some regions have what there is so far of a time step, and their places by that.

        They have the events of the whole image, of which a frame takes those in its own: to select them takes
        longer, and they are selected with the whole step.

        Args:
            start_us: Start of the step, us.
            until_us: Before this all events are there, us.
            events: Those in it, in order; they come again with the whole step.
            meant: Numbers of regions that are alive, of known size.
        """
        for followed in self.alive:
            if followed.id in meant:
                followed.pieces.append((start_us, events))
        # Nearer to the place before it, another says little of where the region goes.
        if 2 * (until_us - start_us) >= self._spec.step_us:
            self._rhythm.step(start_us, events, self._hits, CELL_SHIFT)
            boxes = self._boxes(start_us + self._spec.step_us / 2, ())
            for followed, own in zip(self.alive, self._own(boxes), strict=True):
                if followed.id in meant:
                    heights = followed.heights.copy()
                    if (
                        found := self._locate(followed, own, until_us, (start_us + until_us) / 2)
                    ) is not None:
                        followed.positions.append(found[1])
                    followed.heights = heights
        self._recent.append((start_us, events))

    def end_part(self, until_us: int) -> None:
        """Let all be as if the step had not begun, but for what frames showed in its part until a time."""
        start_us, events = self._recent.pop()
        for followed in self.alive:
            if followed.pieces and followed.pieces[-1][0] == start_us:
                _, part = followed.pieces.pop()
                # What a frame's look gathered anew was counted; the whole image's events were not.
                followed.held_bytes -= 0 if part is events else held_bytes(part)
            middle_us = (start_us + until_us) / 2 - self._chip_us
            if followed.positions.latest.t_us in (until_us - self._age_us, middle_us):
                followed.positions.take_back()

    def _expected(self, followed: Followed, t_us: float) -> tuple[float, float]:
        """Centre (column, row) of a region soon, px: by its filter, or as between its two newest places."""
        if self._position is not None:
            predicted = self._position.predict(followed.filter, t_us)
            if predicted is not None:
                return float(predicted[0][0]), float(predicted[0][1])
        last, before = followed.positions.latest, followed.positions.before
        if followed.speed != STILL:
            after_us = t_us - last.t_us
            return last.x_px + after_us * followed.speed[0], last.y_px + after_us * followed.speed[1]
        if before is last:
            return last.x_px, last.y_px
        # Further ahead than that, a shaking camera has turned back.
        ahead = min((t_us - last.t_us) / (last.t_us - before.t_us), 1.0)
        return last.x_px + ahead * (last.x_px - before.x_px), last.y_px + ahead * (last.y_px - before.y_px)

    def _whole(
        self, followed: Followed, t_us: float, place: Place, top: int, rows: NDArray[np.int64]
    ) -> Region:
        """A region of the height that it lately had; `rows`: its pixels in each row from `top` on.

        Where few pixels are awake, an end is dark; where noise wakes pixels that a fast bar has left, there
        is one too many. Of the places that the edges allow, the nearest to the expected one is taken; of more
        rows than the bar has, those that are likeliest to be its own. Where more of a bar of known size is
        missing, an end is hidden: the one that is nearer to its place counts alone.
        """
        x_px, middle_px, width_px, seen_px = place
        known, lit = followed.size_px, followed.lit_px
        _, expected_px = self._expected(followed, t_us)
        heights = followed.heights
        if lit is not None and known is not None and shows_again(rows, expected_px - top, known[1], lit):
            # Those before are of the part.
            lit, heights = None, deque()
        whole_px = seen_px if known is None else known[1] if lit is None else lit[1] - lit[0]
        # Of a bar with a hidden end, the part that is seen is found, and says where the whole is.
        off_px = 0.0 if lit is None else (lit[0] + lit[1]) / 2
        expected_px += off_px
        if known is None or -STRAY_PX <= seen_px - whole_px <= 2 * _BLUR_PX:
            heights.append(seen_px)
        # A part of the bar says nothing of its height, once that is known.
        height_px = _median(heights) if heights else whole_px
        excess_px = seen_px - height_px
        if excess_px > STRAY_PX:
            # What is not known yet may grow to either side.
            sized = known is not None
            y_px = likeliest_row(rows, top, round(height_px), expected_px, STRAY_PX, sized=sized)
        elif known is not None and excess_px < -2 * MARGIN_PX:
            # By its upper end, and by its lower one.
            ends_px = middle_px - excess_px / 2, middle_px + excess_px / 2
            y_px = min(ends_px, key=lambda end_px: abs(end_px - expected_px))
            if abs(y_px - expected_px) > MARGIN_PX:
                y_px = followed.latest.y_px + off_px
        else:
            slack_px = abs(excess_px) / 2
            y_px = middle_px + min(max(expected_px - middle_px, -slack_px), slack_px)
        size_px = known or (width_px, height_px + min(max(excess_px, 0.0), STRAY_PX))
        return region_of(followed.id, t_us, x_px, y_px - off_px, *size_px)

    def _locate(
        self, followed: Followed, box: Box, now_us: int, middle_us: float
    ) -> tuple[Any, Region, tuple[float, float]] | None:
        """State of a region's filter after it was measured in a box, its place and speed; None if unseen."""
        last, before = followed.positions.latest, followed.positions.before
        right, down, apart_us = last.x_px - before.x_px, last.y_px - before.y_px, last.t_us - before.t_us
        sweep = None
        if followed.speed != STILL or max(abs(right), abs(down)) > FAST_PX_US * apart_us:
            sweep = self._sweep(followed, box, middle_us)
        if sweep is not None:
            t_us, rows, speed = middle_us - self._chip_us, sweep.rows, sweep.speed
            seen: Place | None = sweep[:4]
        else:
            t_us, rows, speed = now_us - self._age_us, np.empty(box[3] - box[1], np.int64), STILL
            seen = self._measure(followed, box, now_us, rows)
        if seen is None:
            return None
        measured = self._whole(followed, t_us, seen, box[1], rows)
        if self._position is None:
            return followed.filter, measured, speed
        centre = np.array([measured.x_px, measured.y_px])
        state, centre, _ = self._position.step(followed.filter, measured.t_us, centre, _CENTRE_SIGMA_PX)
        x_px, y_px = float(centre[0]), float(centre[1])
        place = Region(measured.id, measured.t_us, x_px, y_px, measured.width_px, measured.height_px)
        return state, place, speed

    def _sweep(self, followed: Followed, box: Box, middle_us: float) -> Sweep | None:
        """What a region's newest events say of it where it is too fast for its pixels to blink, else None."""
        last, before = followed.positions.latest, followed.positions.before
        upright, apart_us = last.height_px > last.width_px, last.t_us - before.t_us
        along = followed.speed[1 if upright else 0]
        if apart_us > 0:
            along = (last.y_px - before.y_px if upright else last.x_px - before.x_px) / apart_us
        sweep = fit_sweep(followed.pieces[-1][1], middle_us, box, along, FAST_PX_US)
        return sweep if sweep is not None and sweep.is_fast else None

    def _reach(self, x_px: float, y_px: float, width_px: float, height_px: float) -> Box:
        """The box in which a region's events lie within the next step; an empty one off the sensor."""
        m = MARGIN_PX
        half_w, half_h = width_px / 2 + m, height_px / 2 + m
        width, height = self._sensor_px
        left, top = int(x_px - half_w), int(y_px - half_h)
        right, bottom = int(x_px + half_w) + 1, int(y_px + half_h) + 1
        if left < 0 or top < 0 or right > width or bottom > height:
            left, right = min(max(left, 0), width), min(max(right, 0), width)
            top, bottom = min(max(top, 0), height), min(max(bottom, 0), height)
        return left, top, right, bottom

    def _measure(
        self, followed: Followed | None, box: Box, end_us: int, rows: NDArray[np.int64] | None = None
    ) -> Place | None:
        """Where something blinks in a box at the end of a step; `rows`: its pixels in each row.

        Of a bar of known width, rows count no pixels beside it, and of strips none between them; it is
        nowhere as long as the light of all changes.
        """
        width_px, strips = math.inf, None
        if followed is not None and followed.size_px is not None:
            width_px = followed.size_px[0]
            if followed.strips_px is not None:
                expected_px, _ = self._expected(followed, end_us - self._age_us)
                strips = expected_px, float(MARGIN_PX), followed.strips_px
        if rows is None:
            rows = np.empty(box[3] - box[1], np.int64)
        total, column, left, right, upper, lower, seam = self._rhythm.measure(
            box, end_us, self._measure_us, width_px / 2 + 1, rows, strips
        )
        if followed is not None:
            if seam <= _CALM:
                followed.calm_us = end_us
            elif seam > _FLOODED and end_us - followed.calm_us <= _FLOOD_STEPS * self._spec.step_us:
                return None
        if total < _MIN_PIXELS:
            return None
        return column, (upper + lower - 1) / 2, right - left + 1.0, lower - upper

    def _open(self, end_us: int, rises: int, taken: Sequence[Region]) -> None:
        """Open a region where something blinks in two steps on end outside those known, and `taken` places.

        `rises` are how many hits there are; `end_us` is the end of the step.
        """
        hits, merge_px = self._hits, self._spec.merge_px
        if rises >= _LEAST_RISES and (self.alive or taken):
            known = [self._reach(place.x_px, place.y_px, place.width_px, place.height_px) for place in taken]
            for followed in self.alive:
                last = followed.positions.latest
                reach = self._reach(last.x_px, last.y_px, last.width_px, last.height_px)
                known.append(reach if followed.size_px else grown(reach, merge_px))
                if followed.outgrown is not None and end_us > followed.outgrown[4]:
                    known.append(self._reach(*_outgrown(followed)))
            rises -= _kernels.clear_cells(hits, np.array(known, np.int64), CELL_SHIFT)
        fresh, self._fresh = self._fresh, []
        if rises >= _LEAST_RISES:
            areas, left_out = find_areas(hits, self._limits.areas, self._sensor_px)
            self.counts["areas_left_out"] += left_out
            lit = [box_around(*at) for area in areas if (at := self._measure(None, area, end_us)) is not None]
            boxes = [box for box in joined(lit, merge_px) if hits_in(hits, box) >= _LEAST_RISES]
        else:
            boxes = []
        if rises:
            hits[:] = 0
        for box in boxes:
            if any(overlap(grown(box, merge_px), other) for other in fresh):
                self._start(box, end_us)
            else:
                self._fresh.append(box)

    def _start(self, box: Box, end_us: int) -> None:
        place = self._measure(None, box, end_us)
        if place is None:
            return
        region = region_of(self._next_id, end_us - self._age_us, *place)
        reach = self._reach(*place)
        # Lamps whose pixels were not known as such in the step before are now.
        (newest,) = self._rhythm.select(self._recent[-1][1], [reach], [True], SAME)
        if not len(newest) or not self._place_for_one(end_us):
            return
        self._next_id += 1
        outgrown = [
            one
            for one in self.alive
            if one.outgrown and region.t_us <= one.outgrown[4] and _lies_in_outgrown(one, region)
        ]
        if outgrown:
            # It was seen as long as the one that it was taken to be a part of.
            right, down = region.x_px - outgrown[0].latest.x_px, region.y_px - outgrown[0].latest.y_px
            size_px = region.width_px, region.height_px
            places = outgrown[0].positions.moved(region.id, right, down, size_px)
            pieces = deque((start, Events.empty()) for start, _ in self._recent)
        else:
            places, recent = Places([region]), list(self._recent)[-BACKFILL_STEPS:]
            pieces = deque(
                (start, self._rhythm.select(events, [reach], [True])[0]) for start, events in recent
            )
        followed = Followed(region.id, places, pieces[0][0], pieces, opened_us=end_us)
        followed.filter = self._position.init() if self._position else None
        if outgrown:
            self.gather(followed)
        self.alive.append(followed)

    def _open_swept(self, start_us: int, events: Events, taken: Sequence[Region]) -> None:
        """Open a region where a bar sweeps over the image in two steps on end, where none does yet.

        What was taken for a region there, as some pixels of it seemed to blink, goes.
        """
        step_us, merge_px = self._spec.step_us, self._spec.merge_px
        known = [box_of(place) for place in taken]
        known += [grown(box_of(one.latest), merge_px) for one in self.alive if one.speed != STILL]
        before, self._swept = (
            self._swept,
            find_sweeps(events, start_us, step_us, self._chip_us, known, self._sensor_px),
        )
        for sweep in self._swept:
            one = next((one for one in before if _goes_on(one, sweep, step_us)), None)
            if one is None:
                continue
            speed = (sweep.x_px - one.x_px) / step_us, (sweep.y_px - one.y_px) / step_us
            same = next((other for other in self.alive if _is_swept(other.latest, sweep)), None)
            if same is not None:
                same.speed = speed
                continue
            if not self._place_for_one(start_us + step_us):
                continue
            t_us, id = start_us + step_us / 2 - self._chip_us, self._next_id
            places = Places([region_of(id, t_us - step_us, *one[:4]), region_of(id, t_us, *sweep[:4])])
            pieces = deque((start, Events.empty()) for start, _ in list(self._recent)[-_SWEPT_STEPS:])
            followed = Followed(id, places, pieces[0][0], pieces, opened_us=start_us + step_us, speed=speed)
            followed.filter = self._position.init() if self._position else None
            self._next_id += 1
            self.gather(followed)
            swept = around([box_of(places.before), box_of(places.latest)])
            for other in self.alive:
                other.released |= other.speed == STILL and overlap(swept, box_of(other.latest))
            self.alive.append(followed)

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
        boxes = [box_of(followed.latest) for followed in self.alive]
        for i, older in enumerate(self.alive):
            for k in range(i + 1, len(boxes)):
                younger = self.alive[k]
                if not overlap(boxes[i], boxes[k]) or younger.released:
                    continue
                one, other = older.latest, younger.latest
                shown = (older.size_px is not None) + (younger.size_px is not None)
                apart_px = max(abs(one.x_px - other.x_px), abs(one.y_px - other.y_px))
                if shown == 0 or apart_px <= SAME_PX or (shown == 1 and same_place(one, other)):
                    younger.released = True


def _goes_on(before: Sweep, sweep: Sweep, step_us: int) -> bool:
    """Whether a sweep may be what was seen a step before."""
    right = sweep.x_px - before.x_px - sweep.speed[0] * step_us
    down = sweep.y_px - before.y_px - sweep.speed[1] * step_us
    return max(abs(right), abs(down)) <= 2 * MARGIN_PX


def _is_swept(place: Region, sweep: Sweep) -> bool:
    """Whether a region shows most of a bar that sweeps."""
    right, down = abs(place.x_px - sweep.x_px), abs(place.y_px - sweep.y_px)
    long = max(place.width_px, place.height_px) > max(sweep.width_px, sweep.height_px) / 2
    return long and max(right, down) <= 2 * MARGIN_PX


def _outgrown(followed: Followed) -> Place:
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


def _median(values: Collection[float]) -> float:
    """That of `statistics`, in a third of the time."""
    ordered = sorted(values)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2


def _height(lit_px: tuple[float, float] | None) -> float:
    """Of a part of a bar, px; infinite of the whole."""
    return math.inf if lit_px is None else lit_px[1] - lit_px[0]
