"""Survey of the light in a recording: its sources, by the times between the rises of their pixels.

No link is needed. Rises of light that sends chips are two, three, four and more whole chips apart; those of a
lamp always one period. So for a frequency f, the mean of cos(2 pi f tau) over the times tau between a pixel's
rises is near 1 where all of them are whole periods, and near 0, within 1 / sqrt(2 n) of n times, where they
are unrelated. The lowest f that comes near the largest mean is the source's; below 1 / tau of its shortest
times there is none.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

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

_MAX_CELLS = 16_384
"""Cells of 8 px for 1280 x 720, with 33 MB of counts; a larger sensor has larger cells."""

_CALM_US = 400
"""Time without an event after which a positive one is a rise, as negative events may be missing; rises of
one edge follow each other within some 100 us."""

_LOWEST_HZ, _HIGHEST_HZ, _STEPS = 60.0, 25_000.0, 700
"""Range and number of the tried frequencies, less than a percent apart."""

_COARSE_HZ = 1500.0
"""Frequency from which on the wide bins are too wide."""

_MIN_SIGMAS = 6.0
"""Standard deviations of chance above which a cell's mean is significant: of 16 000 cells and 700
frequencies, one in a hundred surveys exceeds it by chance."""

_MIN_MEAN = 0.2
"""Least mean of a source: jitter of 28 us lowers that of 10 kHz to .2."""

_NEAR_MAXIMUM = 0.85
"""Share of the largest mean that a lower frequency must reach to be the source's."""

_CELLS_AT_ONCE = 1024
"""Cells whose means are computed together: 6 MB of them."""

_MIN_RISES = 60
_MIN_SOURCE_RISES = 300
"""Rises that a cell, and a source, must have."""

_LAMP_SHARE = 0.6
"""Share of times of the same number of periods, or of one and two, above which a source may be a lamp: of a
code .4 are of two chips. Times without rhythm reach it by chance, as six in ten of any are within .3 of a
whole number."""

_LAMP_MEAN = 0.5
"""Least mean at a lamp's own rate. A pixel rises once a period only if its light changes by the threshold,
.22 in ln, in half of it at the most. Noise of .03 to .06 then puts a rise off by a
fourteenth to a seventh of a period, and a time between two by 1.4 times that, which leaves .82 to .45 of the
mean, and more of light that changes by more. A pixel that sees few chips of a dim code rises with the longest
ones; the hump of their times gives .2 to .4."""

_RATE_EXCESS = 0.15
"""Relative excess of the measured rate over a lamp's: times that are short by chance let higher frequencies
pass, of which the lowest near the best is taken."""

_MAX_ONE_CHIP, _MIN_MORE_CHIPS = 0.1, 0.04
"""Largest share of times of one chip, and least of two, of three and of four, of a code: it never rises after
one chip, and after two to four in .38, .25 and .14 where nothing is missing."""

_BUSY_FACTOR, _MIN_BUSY_EVENTS, _MIN_BUSY_CELLS, _MAX_BUSY_SHARE = 8.0, 30, 3, 0.05
"""Events of a busy cell, relative to the median and in number; adjacent busy cells that are needed, and the
largest share of busy cells in the picture."""

_WINDOW_US, _EVERY_US, _MAX_WINDOWS = 2_000, 40_000, 12
"""Length, spacing and number of the windows whose positive events are kept to measure sources: in 2 ms a
vibrating camera moves by 3 px at the most."""

_MAX_WINDOW_EVENTS = 200_000
_FINE_TAU_US = np.arange(FINE) * FINE_US + (FINE_US - 1) / 2
_COARSE_TAU_US = FINE_US * FINE + np.arange(COARSE) * COARSE_US + (COARSE_US - 1) / 2
_TAU_US = np.concatenate([_FINE_TAU_US, _COARSE_TAU_US])
"""Middle of each bin of times between rises, us."""

FREQUENCIES_HZ = np.geomspace(_LOWEST_HZ, _HIGHEST_HZ, _STEPS)


@dataclass(frozen=True)
class LightSource:
    """A blinking source of light.

    Attributes:
        kind: `code`: its rises are two and more chips apart; `lamp`: always the same number of periods;
            `unclear`: neither, as of light that is too weak, or of two kinds in one place.
        rate_hz: Its chips, or periods, a second.
        strength: Mean of cos(2 pi f tau) over the times between rises, 0 to 1.
        box_px: Where it was in the recording: left, top, right, bottom, px.
        wide_px, high_px: Its own width and height, the median of short windows, px; 0 where none shows it.
        events: Events of its cells.
        rises: Times between rises.
        negative_share: Share of its events that are negative.
        typical_us: Median time between rises, us.
        blind_us: Time after an event in which its pixel sends no other, us; 0 where it has no sharp end.
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

    def table_cells(self) -> dict[str, str]:
        """Its row of a table, by the heads of the columns."""
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
        return float(comb_mean(self.intervals, np.array([rate_hz]))[0])


class LightSurvey:
    """Finds the sources of light in a stream of events, in constant memory.

    Attributes:
        cell_px: Size of the cells in which the events are counted, px.
        readout: Events in each millisecond.
        signs: Negative and positive events of each cell, int64 (rows, columns, 2).
        first_us, last_us: Times of the first event and the last, camera clock, us; NaN before.
    """

    def __init__(self, width: int, height: int) -> None:
        shift = 3
        while (-(-width >> shift) + 1) * (-(-height >> shift) + 1) > _MAX_CELLS:
            shift += 1
        self.width, self.height, self._shift = width, height, shift
        self.cell_px = 1 << shift
        cells = ((height - 1 >> shift) + 1, (width - 1 >> shift) + 1)
        long_ago = np.iinfo(np.int64).min // 2
        last_us, rise_us = np.full((2, height, width), long_ago)
        self._of_pixels = last_us, np.ones((height, width), np.uint8), rise_us
        self._intervals = np.zeros((*cells, BINS), np.uint32)
        self._gaps = np.zeros((*cells, SHORT), np.uint32)
        self.signs = np.zeros((*cells, 2), np.int64)
        self._windows: list[Events] = []
        self._every_us, self._next_us = _EVERY_US, long_ago
        self._speeds: list[float] = []
        self.readout = ReadoutTally()
        self.first_us = self.last_us = math.nan

    def feed(self, events: Events) -> None:
        """Take the next events; those outside the sensor are left out."""
        inside = (events.x < self.width) & (events.y < self.height)
        events = events if inside.all() else events[inside]
        if not len(events):
            return
        if math.isnan(self.first_us):
            self.first_us = float(events.t_us[0])
        self.last_us = float(events.t_us[-1])
        columns = events.t_us, events.x, events.y, events.p
        counts = self._intervals, self._gaps, self.signs
        _kernels.add_events(columns, self._of_pixels, counts, self._shift, _CALM_US)
        self.readout.add(events)
        self._keep_window(events)

    def find_sources(self) -> tuple[list[LightSource], Floats]:
        """The sources, most events first, and the frequency of each cell.

        The latter is in Hz, NaN where a cell does not blink, float64 (rows, columns).
        """
        frequency, found = self._find_cells()
        # A cell may be missing in between, where the light of several clusters meets.
        labels, _ = ndimage.label(ndimage.binary_dilation(found, np.ones((2, 2), np.bool_)), np.ones((3, 3)))
        sources = []
        places: list[Any] = ndimage.find_objects(labels)
        for label, place in enumerate(places, 1):
            inside = (labels[place] == label) & found[place]
            times = self._intervals[place][inside].sum(0, dtype=np.int64)
            if times.sum() < _MIN_SOURCE_RISES:
                continue
            source = self._measure_source(place, inside, times)
            if source is not None:
                sources.append(source)
        frequency[~found] = np.nan
        return sorted(sources, key=lambda source: -source.events), frequency

    def speed_px_ms(self) -> float:
        """Median speed of light that sweeps over the image, px/ms; 0 where it does not."""
        return 1e3 * float(np.median(self._speeds)) if self._speeds else 0.0

    def find_restless_box(self) -> tuple[int, int, int, int] | None:
        """The box of the largest area of busy cells: left, top, right, bottom, px; None where there is none.

        They have eight times the events of the others. A hot pixel is none, nor half a picture of moving
        trees.
        """
        events = self.signs.sum(-1)
        busy = events >= max(_BUSY_FACTOR * float(np.median(events)), _MIN_BUSY_EVENTS)
        labels, areas = ndimage.label(busy, np.ones((3, 3)))
        if not areas or busy.mean() > _MAX_BUSY_SHARE:
            return None
        largest = 1 + int(np.argmax(ndimage.sum_labels(events, labels, range(1, areas + 1))))
        if (labels == largest).sum() < _MIN_BUSY_CELLS:
            return None
        places: list[Any] = ndimage.find_objects(labels)
        return self._pixel_box(places[largest - 1])

    def _find_cells(self) -> tuple[Floats, NDArray[np.bool_]]:
        """Frequency of each cell, and whether it is significant."""
        rises = self._intervals.sum(-1, dtype=np.int64)
        frequency = np.zeros(rises.shape)
        found = np.zeros(rises.shape, np.bool_)
        rows, columns = np.nonzero(rises >= _MIN_RISES)
        for start in range(0, len(rows), _CELLS_AT_ONCE):
            part = slice(start, start + _CELLS_AT_ONCE)
            mean = _significant_means(self._intervals[rows[part], columns[part]])
            best = mean.max(-1)
            lowest = (mean >= _NEAR_MAXIMUM * best[:, None]).argmax(-1)
            frequency[rows[part], columns[part]] = FREQUENCIES_HZ[lowest]
            found[rows[part], columns[part]] = best >= _MIN_MEAN
        return frequency, found

    def _measure_source(
        self, place: tuple[slice, ...], inside: NDArray[np.bool_], times: NDArray[np.int64]
    ) -> LightSource | None:
        mean = _significant_means(times[None])[0]
        top = mean.max()
        if top < _MIN_MEAN:
            return None
        i = int((mean >= _NEAR_MAXIMUM * top).argmax())
        while i + 1 < len(mean) and mean[i + 1] > mean[i]:
            i += 1
        near = FREQUENCIES_HZ[i] * np.linspace(0.985, 1.015, 301)
        fine = comb_mean(times, near)
        rate_hz, strength = float(near[fine.argmax()]), float(fine.max())
        gaps = self._gaps[place][inside].sum(0, dtype=np.int64)
        signs = self.signs[place][inside].sum(0)
        box = self._pixel_box(place)
        wide, high = self._measure_size(box)
        return LightSource(
            _classify(times, rate_hz),
            rate_hz,
            strength,
            box,
            wide,
            high,
            int(signs.sum()),
            int(times.sum()),
            float(signs[0] / signs.sum()),
            float(np.quantile(_TAU_US, 0.5, weights=times, method="inverted_cdf")),
            _blind_us(gaps),
            times,
        )

    def _pixel_box(self, place: tuple[slice, ...]) -> tuple[int, int, int, int]:
        """(left, top, right, bottom) of cells, px."""
        rows, columns = place
        right, bottom = columns.stop << self._shift, rows.stop << self._shift
        left, top = columns.start << self._shift, rows.start << self._shift
        return left, top, min(right, self.width), min(bottom, self.height)

    def _measure_size(self, box: tuple[int, int, int, int]) -> tuple[float, float]:
        left, top, _, _ = box
        sizes = []
        for window in self._windows:
            within = boxes.mask_inside(window, box)
            if within.sum() >= 40:
                ends = (np.bincount(window.x[within] - left), np.bincount(window.y[within] - top))
                sizes.append([_extent_px(profile) for profile in ends])
        wide, high = np.median(sizes, 0).tolist() if sizes else (0.0, 0.0)
        return wide, high

    def _keep_window(self, events: Events) -> None:
        """Keep the positive events of a short window now and then; drop every second of too many windows."""
        start_us = int(events.t_us[0])
        if start_us < self._next_us:
            return
        part = events[: int(np.searchsorted(events.t_us, start_us + _WINDOW_US))]
        swept = find_sweeps(part, start_us, _WINDOW_US, None, [], (self.width, self.height))
        self._speeds.append(max((math.hypot(*one.velocity_px_us) for one in swept), default=0.0))
        self._windows.append(part[part.p == 1][:_MAX_WINDOW_EVENTS])
        if len(self._windows) > _MAX_WINDOWS:
            self._windows = self._windows[::2]
            self._every_us *= 2
        self._next_us = start_us + self._every_us


def comb_mean(times: NDArray[np.generic], frequencies_hz: Floats) -> Floats:
    """Mean of cos(2 pi f tau) over the times tau between rises, counted (..., BINS), float64 (..., n).

    At high frequencies only the short ones count: the bins of the others are too wide.
    """
    counts = np.asarray(times, np.float64)
    fine = counts[..., :FINE]
    cosine = np.cos(2e-6 * np.pi * frequencies_hz[None, :] * _TAU_US[:, None])
    all_mean = counts @ cosine / np.maximum(counts.sum(-1, keepdims=True), 1)
    fine_mean = fine @ cosine[:FINE] / np.maximum(fine.sum(-1, keepdims=True), 1)
    return np.asarray(np.where(frequencies_hz > _COARSE_HZ, fine_mean, all_mean), np.float64)


def _classify(times: NDArray[np.int64], rate_hz: float) -> Literal["code", "lamp", "unclear"]:
    periods = _TAU_US * rate_hz * 1e-6
    share = [times[np.abs(periods - k) < 0.3].sum() / times.sum() for k in range(1, 9)]
    # Rises that are always k periods apart repeat at a k-th of the rate.
    repeated = [k for k, of_times in enumerate(share, 1) if of_times >= _LAMP_SHARE]
    if share[0] + share[1] >= _LAMP_SHARE:
        repeated.append(1)
    own_hz = np.outer(rate_hz * np.linspace(1 - _RATE_EXCESS, 1, 16), 1 / np.array(repeated)).ravel()
    if repeated and comb_mean(times, own_hz).max() >= _LAMP_MEAN:
        return "lamp"
    return "code" if share[0] <= _MAX_ONE_CHIP and min(share[1:4]) >= _MIN_MORE_CHIPS else "unclear"


def _is_resolvable(times: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Which frequencies have a period as short as the shortest times between rises, bool (n, frequencies)."""
    counts = np.asarray(times, np.float64)
    sums = np.cumsum(counts, -1)
    shortest_us = _TAU_US[(sums < 0.05 * sums[:, -1:]).sum(-1)]
    return np.asarray(FREQUENCIES_HZ[None, :] > 0.9e6 / shortest_us[:, None])


def _significant_means(times: NDArray[np.generic]) -> Floats:
    """Means at all frequencies, -1 where they may be chance, float64 (n, frequencies)."""
    counts = np.asarray(times, np.float64)
    mean = comb_mean(counts, FREQUENCIES_HZ)
    number = np.where(FREQUENCIES_HZ > _COARSE_HZ, counts[:, :FINE].sum(-1)[:, None], counts.sum(-1)[:, None])
    significant = mean > _MIN_SIGMAS / np.sqrt(2 * np.maximum(number, 1))
    return np.asarray(np.where(_is_resolvable(counts) & significant, mean, -1.0))


def _blind_us(gaps: NDArray[np.int64]) -> float:
    """Time after an event in which its pixel sends no other, us; 0 where it has no sharp end.

    A refractory time has one, light that returns late has none: of all times between events, one in 200 and
    one in twenty are within a tenth of each other.
    """
    if not gaps.any():
        return 0.0
    starts = np.arange(SHORT) * FINE_US
    first, early = np.quantile(starts, (0.005, 0.05), weights=gaps, method="inverted_cdf").tolist()
    return early if first >= 0.9 * early else 0.0


def _extent_px(profile: NDArray[np.int64]) -> float:
    """Pixels of a profile from the first to the last with at least a fifth of its bright ones."""
    lit = profile[profile > 0]
    level = 0.2 * np.quantile(lit, 0.9)
    inside = np.flatnonzero(profile >= level)
    return float(inside[-1] - inside[0] + 1)
