"""How light spreads in an image of a bar: which distinguishes the bar from its reflection.

A reflection has less light, and a rough mirror blurs it; none makes it sharper. The number of pixels that
fire shows neither: less light makes it smaller, blur makes it larger. Three lengths together show both, as a
pixel answers ratios of light:

- how far beyond the middle between two clusters the one shows while the other shines on: a ratio of the two
  lights, whatever their amount, so it grows with blur alone, unless the background is as bright;
- the same while the other is dark: down to a share of the background, so it grows with light, too;
- how wide a cluster is across a line of them: the same again, with the lens' wings.

Their expected values follow from the lens, for each blur and each background, as a share of the light. Of two
images, both on one background, the one is the bar if it is sharper and brighter; how likely that is rather
than the opposite is summed over all of these. They are two bars if both are as sharp and as bright.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.placement import Layout, Placement

Floats = NDArray[np.float64]

_AXIS_PX = 0.8
"""Pixels up to this far from the line between two clusters count: one or two side by side."""

_MIXED_FROM, _MIXED_TO = 0.2, 0.75
"""Shares of the way from a cluster to its neighbour between which light of the one gives way to the other's;
before, only noise shows the neighbour, beyond, nothing but the neighbour shows."""

_ACROSS_PX = 8
"""How far from a line its light is sought, px."""

_CONTRAST = 0.25
"""Change of a pixel's light that makes an event."""

_UNIT_PX = 0.26
"""Wavelength times f-number: 630 nm at f/2, on pixels of 4.86 um."""

_REST_PX = 0.36
"""Blur of a lens in focus, in addition to diffraction, px."""

_STRIP_WIDTH = 0.083
"""Width of a line of LEDs in spacings of its clusters: 5 mm of 6 cm."""

_BLURS_PX = np.array([0.0, 0.2, 0.35, 0.5, 0.7, 0.9, 1.2, 1.6, 2.1])
"""What a mirror, or the weather, may add, px."""

_BACKGROUNDS = np.geomspace(0.004, 2.5, 20)
"""Light of the background, in that of the middle of a cluster: with less, a falling edge takes longer than a
chip; with more, nothing is seen."""

_ERRORS_PX = np.array([0.1, 0.15, 0.2])
"""Errors of the three lengths in one frame, px, by the scatter of frames of simulated scenes."""

_CONSTANT_ERRORS_PX = np.array([0.02, 0.05, 0.05])
"""Errors that no number of frames reduces: where the clusters' borders lie in their pixels."""

_COMMON_ERRORS_PX = np.array([0.08, 0.2, 0.4])
"""Errors that both images have: another lens, another strip, a camera in motion."""

_BARS_PX, _BARS_LIGHT = 0.06, 0.15
"""Differences of two bars of one make (sigmas): LEDs not quite in line; and the logarithm of the ratio of
their lights: LEDs age, gather dirt and point elsewhere."""

_ANSWER_ERROR, _ANSWER_SPREAD, _ANSWER_IMAGE_SPREAD = 0.018, 0.02, 0.04
"""Share of edges that the middle of a line answers: its error in a frame, how much two bars differ all the
same, as they lie on their pixels, and a bar and its image (sigmas). Brighter light decays longer, losing more
edges."""

_STEPS_PER_E = 4
"""Steps of the spacing in a factor of e; the expected lengths change little in one."""


@dataclass(frozen=True, eq=False)
class Spread:
    """Answers to the chips of pilots, by place. They add up over frames.

    Attributes:
        between: Of pixels between two clusters, to edges of the second one while the first one [shines on, is
            dark]: [answers, edges] [before `_MIXED_FROM`, up to `_MIXED_TO`, beyond], int64 (2, 2, 3).
        across: Of pixels beside the middle of a cluster of a line, to its edges: [answers, edges] by column
            from its axis, int64 (2, 2 * 8 + 1).
        spacing_px: Sum of the spacings, px.
        frames: How many frames.
    """

    between: NDArray[np.int64]
    across: NDArray[np.int64]
    spacing_px: float
    frames: int = 1

    @classmethod
    def from_pilot(
        cls,
        sums: NDArray[np.int16],
        pilots: NDArray[np.int64],
        every: int,
        layout: Layout,
        pairs: NDArray[np.int64],
        placement: Placement,
    ) -> "Spread":
        """Count the answers of a pilot's pixels, by its polarity sums, int16 (chips, height, width).

        `pilots` are the clusters' chips, int64 (K, chips), with an edge that tells them apart `every` so many
        chips; `pairs` are neighbours, int64 (n, 2).
        """
        between = np.zeros((2, 2, 3), np.int64)
        across = np.zeros((2, 2 * _ACROSS_PX + 1), np.int64)
        spacing_px = abs(placement.scale) * layout.spacing_m
        if spacing_px > 0:
            places, seen = placement.centres_px, placement.seen
            _kernels.count_answers_between(
                sums, pilots, places, seen, pairs, (_AXIS_PX, _MIXED_FROM, _MIXED_TO), between
            )
            if layout.is_line:
                way = placement.scale / abs(placement.scale) * layout.direction
                _kernels.count_answers_across(sums, pilots, every, places, seen, way, spacing_px / 4, across)
        return cls(between, across, spacing_px)

    def __add__(self, other: "Spread") -> "Spread":
        return Spread(
            self.between + other.between,
            self.across + other.across,
            self.spacing_px + other.spacing_px,
            self.frames + other.frames,
        )

    def lengths_px(self) -> Floats | None:
        """The three lengths, px, float64 (3,), the last NaN without a line; None if pixels show none."""
        answers, edges = self.between[:, 0], self.between[:, 1]
        if not edges.all():
            return None
        rate = answers / edges
        noise, highest = rate[:, 0].min(), rate[0, 2]
        if highest <= noise:
            return None
        mixed = (rate[:, 1] - noise) / (highest - noise) * (_MIXED_TO - _MIXED_FROM)
        beyond = (mixed + (1 - _MIXED_TO) - 0.5) * self.spacing_px / self.frames
        return np.array([*beyond, self._width_px()])

    def answer_rate(self) -> float:
        """Share of the edges that the pixels with most answers, those of the line, answer."""
        return float((self.across[0] / np.maximum(self.across[1], 1)).max())

    def _width_px(self) -> float:
        """Columns that answer, weighted by how often they do; beyond a gap is another's light."""
        if not self.across[1].any():
            return math.nan
        rate = self.across[0] / np.maximum(self.across[1], 1)
        peak, highest, width = _ACROSS_PX, float(rate.max()), 0.0
        if highest == 0:
            return math.nan
        for side in (1, -1):
            last = highest
            for value in rate[peak + side :: side].tolist():
                if value > last and last < highest / 2:
                    break
                width += value
                last = value
        return (width + float(rate[peak])) / highest


class LazySpread:
    """A `Spread` from the arguments of `Spread.from_pilot` that is measured when called first."""

    def __init__(self, *pilot: Any) -> None:
        self._pilot = pilot
        self._spread: Spread | None = None

    def __call__(self) -> Spread:
        """Return the spread, the same each time."""
        if self._spread is None:
            self._spread, self._pilot = Spread.from_pilot(*self._pilot), ()
        return self._spread


def neighbour_pairs(layout: Layout) -> NDArray[np.int64]:
    """Pairs of clusters that stand side by side, in both orders, int64 (n, 2).

    >>> from evlcp_sdk.rx.placement import layout_of
    >>> neighbour_pairs(layout_of(np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 2.0]]))).tolist()
    [[0, 1], [1, 0], [1, 2], [2, 1]]
    """
    distances = np.abs(layout.centres_m[:, None] - layout.centres_m[None])
    adjacent = (distances > 0) & (distances < 1.1 * layout.spacing_m)
    return np.argwhere(adjacent).astype(np.int64)


def compare_spreads(one: Spread, other: Spread) -> tuple[float, float] | None:
    """Compare two images of bars with the same data by how light spreads in them; None if that is unknown.

    Log odds of the first being sharper and brighter against the second being so, and of both being alike, as
    two bars are, against the one or the other.
    """
    here, there = one.lengths_px(), other.lengths_px()
    if here is None or there is None:
        return None
    sizes = one.spacing_px / one.frames, other.spacing_px / other.frames
    expected = _lengths_at_step(round(math.log(sum(sizes) / 2) * _STEPS_PER_E))
    error = np.hypot(_ERRORS_PX / math.sqrt(min(one.frames, other.frames)), _CONSTANT_ERRORS_PX)
    likelihoods: Floats = np.zeros((len(expected), len(expected)))
    known = np.flatnonzero(~np.isnan(here + there)).tolist()
    for k in known:
        likelihoods += _log_likelihood(here[k] - expected[:, k, None], there[k] - expected[:, k], k, error[k])
    # For pairs of expected values, whether the second is no sharper than the first and no brighter.
    blur, light = np.indices((len(_BLURS_PX), len(_BACKGROUNDS))).reshape(2, -1)
    first = (blur >= blur[:, None]) & (light >= light[:, None])
    # Clear cases are beyond the smallest number that is not 0: logarithms.
    sums = np.logaddexp.reduce(likelihoods[first]), np.logaddexp.reduce(likelihoods.T[first])
    # A narrow strip's light in a pixel is as its width: of equal bars, the farther one's is less. The mean
    # over what their light may differ by is that of three points of a normal distribution.
    near, far = (_lengths_at_step(round(math.log(size) * _STEPS_PER_E)) for size in sizes)
    steps = np.log(_BACKGROUNDS / _BACKGROUNDS[0])
    ratios = math.log(sizes[0] / sizes[1]) + _BARS_LIGHT * math.sqrt(3) * np.array([-1, 0, 1])
    alike = np.log([[1 / 6], [2 / 3], [1 / 6]]) - math.log(len(expected))
    for k in known:
        rows = far[:, k].reshape(len(_BLURS_PX), -1)
        there_k = [[np.interp(steps + ratio, steps, row) for row in rows] for ratio in ratios]
        spread = math.hypot(error[k], _BARS_PX / math.sqrt(2))
        off = there[k] - np.reshape(there_k, (len(ratios), -1))
        alike = alike + _log_likelihood(here[k] - near[:, k], off, k, spread) + math.log(error[k] / spread)
    evidence = np.logaddexp.reduce(alike, None)
    if 2 in known:
        spread_alike = math.hypot(_ANSWER_ERROR / math.sqrt(min(one.frames, other.frames)), _ANSWER_SPREAD)
        square = (one.answer_rate() - other.answer_rate()) ** 2
        spread = _ANSWER_IMAGE_SPREAD
        evidence += (square / spread**2 - square / spread_alike**2) / 2 + math.log(spread / spread_alike)
    images = np.logaddexp(*sums) - math.log(2 * np.count_nonzero(first))
    return float(sums[0] - sums[1]), float(evidence - images)


def _log_likelihood(here: Floats, there: Floats, length: int, error_px: float) -> Floats:
    """Of two errors of a length: their difference has no common part, their mean all of it."""
    mean = ((here + there) / 2) ** 2 / (_COMMON_ERRORS_PX[length] ** 2 + error_px**2 / 2)
    fit: Floats = -((here - there) ** 2 / (2 * error_px**2) + mean) / 2
    return fit


@lru_cache(maxsize=32)
def _lengths_at_step(steps: int) -> Floats:
    return model_lengths(math.exp(steps / _STEPS_PER_E), _BLURS_PX, _BACKGROUNDS)


def model_lengths(spacing_px: float, blurs_px: Floats, backgrounds: Sequence[float] | Floats) -> Floats:
    """`Spread.lengths_px` as expected for a line of clusters, all of which shine alike.

    For each blur, added to the lens' own, and each background, in the light of the middle of a cluster,
    float64 (blurs * backgrounds, 3).
    """
    from evlcp_sdk.scene.optics import airy_blur, edge_profile

    half = _STRIP_WIDTH * spacing_px / 2
    along, across = np.linspace(-spacing_px / 2, spacing_px / 2, 201), np.linspace(0, _ACROSS_PX, 401)
    lengths = []
    for blur_px in blurs_px:
        blur = airy_blur(_UNIT_PX, math.hypot(_REST_PX, blur_px))
        sigma, share = blur.sigma_px[:, None], blur.share[:, None]
        strip = share * (edge_profile(across + half, sigma) - edge_profile(across - half, sigma))
        line = strip.sum(0) / strip.sum(0)[0]
        core = (
            strip[:, across <= _AXIS_PX].mean(1, keepdims=True) / strip[:, across <= _AXIS_PX].mean(1).sum()
        )
        own = (core * (edge_profile(along, sigma) - edge_profile(along - spacing_px, sigma))).sum(0)
        for background in backgrounds:
            threshold = _CONTRAST * background
            lengths.append(
                (
                    ((own > _CONTRAST * own[::-1] + threshold).mean() - 0.5) * spacing_px,
                    ((own > threshold).mean() - 0.5) * spacing_px,
                    2 * (line > threshold).mean() * _ACROSS_PX,
                )
            )
    return np.array(lengths)
