"""What blinks in a recording, and how: sources of light by the times between the rises of their pixels.

No link is needed. Rises of light that sends chips come whole chips apart, two, three and four of them and
more; those of a lamp come one period apart, again and again. So for a frequency f, the mean of
cos(2 pi f tau) over the times tau between a pixel's rises is near 1 where all of them are whole periods,
and near 0, within 1 / sqrt(2 n) of n times, where they have nothing to do with it. The lowest f that comes
near the largest mean is the source's; below 1 / tau of its shortest times there is nothing to find.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from evlcp_sdk.diagnosis import _kernels
from evlcp_sdk.diagnosis._kernels import BINS, COARSE, COARSE_US, FINE, FINE_US, SHORT
from evlcp_sdk.diagnosis.readout import ReadoutTally
from evlcp_sdk.rx import boxes
from evlcp_sdk.rx.sweeps import find_sweeps
from evlcp_sdk.values import Events

Floats = NDArray[np.float64]

_MOST_CELLS = 16_384
"""Cells of the image: those of 8 px of 1280 x 720, with 33 MB of counts; a larger sensor has larger cells."""

_CALM_US = 400
"""Time without an event after which a positive one is a rise whatever came before: negative events may be
missing, and rises of one edge follow each other within some 100 us."""

_LOWEST_HZ, _HIGHEST_HZ, _STEPS = 60.0, 25_000.0, 700
"""Frequencies that are tried, less than a percent apart."""

_COARSE_HZ = 1500.0
"""Frequency above which times that are counted in wide bins say nothing."""

_SURE = 6.0
"""Standard deviations of chance above which a cell's mean is none: of 16 000 cells and 700 frequencies one in
a hundred surveys."""

_LEAST = 0.2
"""Mean below which nothing is made of it: jitter of 28 us takes that of 10 kHz down to .2."""

_NEAR = 0.85
"""Share of the largest mean that a lower frequency must reach to be the one."""

_AT_ONCE = 1024
"""Cells whose means are computed together: 6 MB of them."""

_MIN_RISES = 60
_MIN_SOURCE = 300
"""Rises of a cell, and of a source, below which it is left out."""

_REGULAR = 0.6
"""Share of times that are the same number of periods, or one and two, above which a source repeats itself: of
a code .4 are of two chips. Times that follow no rhythm reach it by chance, as six in ten of any are within .3
of a whole number."""

_FOLLOWED = 0.5
"""Mean at a lamp's own rate from which it repeats itself. A pixel rises once a period only if its light
changes by the threshold, .22 in ln, in half of it at the most. Noise of .03 to .06 then puts a rise off by a
fourteenth to a seventh of a period, and a time between two by 1.4 times that, which leaves .82 to .45 of the
mean, and more of light that changes by more. A pixel that sees few chips of a dim code rises with the longest
ones; the hump of their times gives .2 to .4."""

_TOO_HIGH = 0.15
"""By how much of itself the rate that is measured may be above a lamp's: times that come sooner by chance let
pass higher frequencies, and the lowest that is near the best is taken."""

_NONE, _SOME = 0.1, 0.04
"""Share of times of one chip up to which, and of two, of three and of four from which, a source sends a code:
a code never rises after one chip, and after two to four in .38, .25 and .14 where nothing is missing."""

_BUSY, _MIN_BUSY, _BUSY_CELLS, _MOST_BUSY = 8.0, 30, 3, 0.05
"""How many times the median of a cell's events are many, and at least so many; of so many cells together, and
of no larger share of the picture."""

_WINDOW_US, _EVERY_US, _MOST_WINDOWS = 2_000, 40_000, 12
"""Of how many short windows, and how far apart, the positive events are kept, to measure sources: in 2 ms a
camera that shakes moves by 3 px at the most."""

_MOST_KEPT = 200_000
"""Events of a window that are kept."""

_FINE_TAU_US = np.arange(FINE) * FINE_US + (FINE_US - 1) / 2
_COARSE_TAU_US = FINE_US * FINE + np.arange(COARSE) * COARSE_US + (COARSE_US - 1) / 2
_TAU_US = np.concatenate([_FINE_TAU_US, _COARSE_TAU_US])
"""Middle of each bin of times between rises, which are whole us."""

FREQUENCIES_HZ = np.geomspace(_LOWEST_HZ, _HIGHEST_HZ, _STEPS)


@dataclass(frozen=True)
class LightSource:
    """Something that blinks.

    Attributes:
        kind: `code`: its rises come two chips apart, and other numbers of them; `lamp`: always the same
            number of periods apart; `unclear`: neither, as of light that is too weak, or of two kinds in one
            place.
        rate_hz: Its chips, or periods, a second.
        strength: Mean of cos(2 pi f tau) over the times between rises, 0 to 1.
        box_px: (left, top, right, bottom) of where it was in the recording, px.
        wide_px, high_px: Its own width and height, the median of short windows, px; 0 where none shows it.
        events: Events of its cells.
        rises: Times between rises.
        negative_share: Share of its events that are negative.
        typical_us: Median time between rises, us.
        blind_us: Time after an event in which its pixel sends no other, us; 0 where that has no sharp end.
        intervals: Counts of the times between rises, int64 (BINS,).
    """

    kind: Literal["code", "lamp", "unclear"]
    rate_hz: float
    strength: float
    box_px: tuple[int, int, int, int]
    wide_px: float
    high_px: float
    events: int
    rises: int
    negative_share: float
    typical_us: float
    blind_us: float
    intervals: NDArray[np.int64]

    def cells(self) -> dict[str, str]:
        """What tables show of it, by the heads of their columns."""
        left, top, right, bottom = self.box_px
        return {
            "source": self.kind,
            "rate": f"{self.rate_hz:,.0f} Hz",
            "columns": f"{left} to {right}",
            "rows": f"{top} to {bottom}",
            "size": f"{self.wide_px:.0f} x {self.high_px:.0f} px" if self.wide_px else "-",
            "events": f"{self.events:,}",
            "negative": f"{self.negative_share:.0%}",
        }

    def strength_at(self, rate_hz: float) -> float:
        """The mean of cos(2 pi f tau) at another rate."""
        return float(comb(self.intervals, np.array([rate_hz]))[0])


class LightSurvey:
    """Takes a stream of events of a sensor; says what blinks in it. In constant memory.

    Attributes:
        cell_px: Size of the cells that light is looked for in, px.
        readout: Events in each millisecond.
        signs: Negative and positive events of each cell, int64 (rows, columns, 2).
        first_us: Its first event, camera clock, us; NaN before.
        last_us: Its last, us.
    """

    def __init__(self, width: int, height: int) -> None:
        shift = 3
        while (-(-width >> shift) + 1) * (-(-height >> shift) + 1) > _MOST_CELLS:
            shift += 1
        self.width, self.height, self._shift = width, height, shift
        self.cell_px = 1 << shift
        cells = ((height - 1 >> shift) + 1, (width - 1 >> shift) + 1)
        long_ago = np.iinfo(np.int64).min // 2
        self._last_us = np.full((height, width), long_ago)
        self._rise_us = np.full((height, width), long_ago)
        self._last_p = np.ones((height, width), np.uint8)
        self._intervals = np.zeros((*cells, BINS), np.uint32)
        self._gaps = np.zeros((*cells, SHORT), np.uint32)
        self.signs = np.zeros((*cells, 2), np.int64)
        self._windows: list[Events] = []
        self._every_us, self._next_us = _EVERY_US, long_ago
        self._speeds: list[float] = []
        self.readout = ReadoutTally()
        self.first_us = self.last_us = math.nan

    def feed(self, events: Events) -> None:
        """Take the next events; those outside of the sensor are left out."""
        inside = (events.x < self.width) & (events.y < self.height)
        events = events if inside.all() else events[inside]
        if not len(events):
            return
        if math.isnan(self.first_us):
            self.first_us = float(events.t_us[0])
        self.last_us = float(events.t_us[-1])
        columns = events.t_us, events.x, events.y, events.p
        of_pixels = self._last_us, self._last_p, self._rise_us
        counts = self._intervals, self._gaps, self.signs
        _kernels.add_events(columns, of_pixels, counts, self._shift, _CALM_US)
        self.readout.add(events)
        self._keep(events)

    def found(self) -> tuple[list[LightSource], Floats]:
        """What blinks, by the number of events, most first; and what each cell blinks with.

        The latter in Hz, NaN where it does not, float64 (rows, columns).
        """
        frequency, found = self._cells()
        # A cell more may be missing in between, where the light of several clusters meets.
        labels, _ = ndimage.label(ndimage.binary_dilation(found, np.ones((2, 2), np.bool_)), np.ones((3, 3)))
        sources = []
        for one, place in enumerate(ndimage.find_objects(labels), 1):
            inside = (labels[place] == one) & found[place]
            times = self._intervals[place][inside].sum(0, dtype=np.int64)
            if times.sum() < _MIN_SOURCE:
                continue
            source = self._source(place, inside, times)
            if source is not None:
                sources.append(source)
        frequency[~found] = np.nan
        return sorted(sources, key=lambda source: -source.events), frequency

    def speed_px_ms(self) -> float:
        """How fast light sweeps over the image in most of the windows, px/ms; 0 where it does not."""
        return 1e3 * float(np.median(self._speeds)) if self._speeds else 0.0

    def restless(self) -> tuple[int, int, int, int] | None:
        """Where far more happens than elsewhere: (left, top, right, bottom), px; None for nowhere.

        The largest area of cells with eight times the events of the others; not one of a hot pixel, nor
        half a picture of moving trees.
        """
        many = self.signs.sum(-1)
        busy = many >= max(_BUSY * float(np.median(many)), _MIN_BUSY)
        labels, areas = ndimage.label(busy, np.ones((3, 3)))
        if not areas or busy.mean() > _MOST_BUSY:
            return None
        largest = 1 + int(np.argmax(ndimage.sum_labels(many, labels, range(1, areas + 1))))
        if (labels == largest).sum() < _BUSY_CELLS:
            return None
        return self._box(ndimage.find_objects(labels)[largest - 1])

    def _cells(self) -> tuple[Floats, NDArray[np.bool_]]:
        """Frequency of each cell, and where it is no chance."""
        many = self._intervals.sum(-1, dtype=np.int64)
        frequency = np.zeros(many.shape)
        found = np.zeros(many.shape, np.bool_)
        rows, columns = np.nonzero(many >= _MIN_RISES)
        for start in range(0, len(rows), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            times = self._intervals[rows[part], columns[part]].astype(np.float64)
            mean = _beyond_chance(times)
            best = mean.max(-1)
            lowest = (mean >= _NEAR * best[:, None]).argmax(-1)
            frequency[rows[part], columns[part]] = FREQUENCIES_HZ[lowest]
            found[rows[part], columns[part]] = best >= _LEAST
        return frequency, found

    def _source(
        self, place: tuple[slice, ...], inside: NDArray[np.bool_], times: NDArray[np.int64]
    ) -> LightSource | None:
        mean = _beyond_chance(times[None])[0]
        top = mean.max()
        if top < _LEAST:
            return None
        i = int((mean >= _NEAR * top).argmax())
        while i + 1 < len(mean) and mean[i + 1] > mean[i]:
            i += 1
        near = FREQUENCIES_HZ[i] * np.linspace(0.985, 1.015, 301)
        fine = comb(times, near)
        rate_hz, strength = float(near[fine.argmax()]), float(fine.max())
        gaps = self._gaps[place][inside].sum(0, dtype=np.int64)
        signs = self.signs[place][inside].sum(0)
        box = self._box(place)
        wide, high = self._size(box)
        return LightSource(
            _kind(times, rate_hz),
            rate_hz,
            strength,
            box,
            wide,
            high,
            int(signs.sum()),
            int(times.sum()),
            float(signs[0] / signs.sum()),
            _quantile(times, _TAU_US, 0.5),
            _blind_us(gaps),
            times,
        )

    def _box(self, place: tuple[slice, ...]) -> tuple[int, int, int, int]:
        """(left, top, right, bottom) of cells, px."""
        rows, columns = place
        right, bottom = columns.stop << self._shift, rows.stop << self._shift
        left, top = columns.start << self._shift, rows.start << self._shift
        return left, top, min(right, self.width), min(bottom, self.height)

    def _size(self, box: tuple[int, int, int, int]) -> tuple[float, float]:
        """Width and height of what is in a box, the median of the windows that show it, px."""
        left, top, _, _ = box
        sizes = []
        for window in self._windows:
            within = boxes.mask_inside(window, box)
            if within.sum() >= 40:
                ends = (np.bincount(window.x[within] - left), np.bincount(window.y[within] - top))
                sizes.append([_extent(profile) for profile in ends])
        wide, high = np.median(sizes, 0).tolist() if sizes else (0.0, 0.0)
        return wide, high

    def _keep(self, events: Events) -> None:
        """Keep the positive events of a short window now and then; of too many windows every second one."""
        start_us = int(events.t_us[0])
        if start_us < self._next_us:
            return
        part = events[: int(np.searchsorted(events.t_us, start_us + _WINDOW_US))]
        swept = find_sweeps(part, start_us, _WINDOW_US, None, [], (self.width, self.height))
        self._speeds.append(max((math.hypot(*one.velocity_px_us) for one in swept), default=0.0))
        self._windows.append(part[part.p == 1][:_MOST_KEPT])
        if len(self._windows) > _MOST_WINDOWS:
            self._windows = self._windows[::2]
            self._every_us *= 2
        self._next_us = start_us + self._every_us


def comb(times: NDArray[np.generic], frequencies_hz: Floats) -> Floats:
    """Mean of cos(2 pi f tau) over the times tau between rises, counted (..., BINS), float64 (..., n).

    At high frequencies only over the short ones: those beyond are counted in bins too wide for it.
    """
    counts = np.asarray(times, np.float64)
    short = counts[..., :FINE]
    phase = 2e-6 * np.pi * frequencies_hz[None, :] * _TAU_US[:, None]
    wave = np.cos(phase)
    whole = counts @ wave / np.maximum(counts.sum(-1, keepdims=True), 1)
    part = short @ wave[:FINE] / np.maximum(short.sum(-1, keepdims=True), 1)
    return np.asarray(np.where(frequencies_hz > _COARSE_HZ, part, whole), np.float64)


def _kind(times: NDArray[np.int64], rate_hz: float) -> Literal["code", "lamp", "unclear"]:
    """What sends rises so far apart."""
    periods = _TAU_US * rate_hz * 1e-6
    share = [times[np.abs(periods - k) < 0.3].sum() / times.sum() for k in range(1, 9)]
    # What comes k periods apart again and again repeats itself at a k-th of the rate.
    repeated = [k for k, of_times in enumerate(share, 1) if of_times >= _REGULAR]
    if share[0] + share[1] >= _REGULAR:
        repeated.append(1)
    own_hz = np.outer(rate_hz * np.linspace(1 - _TOO_HIGH, 1, 16), 1 / np.array(repeated)).ravel()
    if repeated and comb(times, own_hz).max() >= _FOLLOWED:
        return "lamp"
    return "code" if share[0] <= _NONE and min(share[1:4]) >= _SOME else "unclear"


def _allowed(times: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Which frequencies have a period that the shortest times between rises reach, (n, frequencies)."""
    counts = np.asarray(times, np.float64)
    sums = np.cumsum(counts, -1)
    shortest_us = _TAU_US[(sums < 0.05 * sums[:, -1:]).sum(-1)]
    return np.asarray(FREQUENCIES_HZ[None, :] > 0.9e6 / shortest_us[:, None])


def _beyond_chance(times: NDArray[np.generic]) -> Floats:
    """Means at all frequencies, -1 where there is nothing to find or chance would do, (n, frequencies)."""
    counts = np.asarray(times, np.float64)
    mean = comb(counts, FREQUENCIES_HZ)
    many = np.where(FREQUENCIES_HZ > _COARSE_HZ, counts[:, :FINE].sum(-1)[:, None], counts.sum(-1)[:, None])
    sure = mean > _SURE / np.sqrt(2 * np.maximum(many, 1))
    return np.asarray(np.where(_allowed(counts) & sure, mean, -1.0))


def _quantile(counts: NDArray[np.int64], at: Floats | NDArray[np.int64], share: float) -> float:
    """The value of a histogram's bin below which a share of its counts is; 0 of an empty one."""
    if not counts.sum():
        return 0.0
    return float(at[int((np.cumsum(counts) < share * counts.sum()).sum())])


def _blind_us(gaps: NDArray[np.int64]) -> float:
    """Time after an event in which its pixel sends no other, us.

    Where it has a sharp end, as a refractory time has, not that of light that comes back late: of all
    times between events, one in 200 and one in twenty are within a tenth of each other.
    """
    starts = np.arange(SHORT) * FINE_US
    first, early = (_quantile(gaps, starts, share) for share in (0.005, 0.05))
    return early if first >= 0.9 * early else 0.0


def _extent(profile: NDArray[np.int64]) -> float:
    """Pixels of a profile from the first to the last with a fifth and more of what its bright ones have."""
    lit = profile[profile > 0]
    level = 0.2 * np.quantile(lit, 0.9)
    inside = np.flatnonzero(profile >= level)
    return float(inside[-1] - inside[0] + 1)
