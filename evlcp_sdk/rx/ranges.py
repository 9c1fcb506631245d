"""A transmitter's distances together: when they hold, how the bar leans, and how much they scatter."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.straight import ALIKE, STRAIGHT, WAVE_PX, Image, judge_image
from evlcp_sdk.scene.tilt import LineOfSight
from evlcp_sdk.values import Curvature, Range

_MEMORY_S = 0.3
"""Distances that are looked back on: a bicycle's swerve or a brake changes the acceleration in no less."""

_SPEED_M_S = 20.0
"""Speeds at which distances change before any is measured (sigma): 72 km/h."""

_ACCELERATION_M_S2 = 3.0
"""Accelerations (sigma): a hard brake has 8."""

_SCATTER_WORTH = 8.0
"""Frames that the sigmas of a ranging are worth against the scatter of its distances."""

_OUTLIER = 4.0
"""Sigmas from the others, 1 of 16000 by chance, beyond which how far off a distance is becomes its sigma."""

_LEAST_SIGMA = 1e-6
"""Of the distance: ideal images have less, which says nothing of anything."""

_LEVEL_DEG, _LEANING_DEG, _LEANING_SHARE = 0.7, 5.0, 0.1
"""What is likely of a bar's lean before it is measured: none but for a mount's error and the car's springs
(sigma), and of one camera in ten, whose mount nobody levelled, anything up to the steepest. With more of
these, sigmas of level bars far away are too large; with fewer, those of leaning ones too small for longer."""

_TILT_MEMORY_S = 1.0
"""A car's pitch changes within a second when it brakes."""

_STEP_DEG = 0.1
"""Grid of leans that are weighed: a third of the sigma that the bends of a second have at 30 m."""

_SLANTED_SHARE = 6e-5
"""Of the bars that a camera with a known attitude sees: not plumb all the same, or the attitude is wrong;
then anything up to the steepest, more or less. As seldom as an outlier, so that it costs the others no sigma,
and enough that a bend which contradicts is believed."""

_WAVE_SHARE, _WAVE_REST_PX = 0.6, 0.03
"""Share of the wave that distances have, and by how much that is off (sigma): rows far off a fit hardly pull
it. 0.35 were found in recordings of an independent generator, and 0.85 in rendered ones where the wave is
higher; off by 0.01 to 0.05 px."""

_LEAST_WEIGHT = 0.1
"""Of the heaviest boundary: below, one is not seen."""

Floats = NDArray[np.float64]


class Ranges(NamedTuple):
    """What is remembered of a transmitter's distances.

    Attributes:
        past: Time (s), distance (m) and variance (m2) of each, oldest first, float64 (n, 3).
        bend: Sum of the boundaries' weights, of their bends, beyond what the attitude explains, and of what
            the pixels' wave would make of them, both weighted, float64 (3, n); empty without any.
        bend_s: When that was, s.
        told: The attitude gave how the bar leans then.
        wave: Sums that say how high the pixels' wave is, of `_kernels.add_phase_bias`, float64 (4,).
        image: How straight the bar's image is.
        off: How far boundaries lie off, as in `Curvature`, beyond the known lean, in the newest frame, NaN
            where unseen, float64 (n,).
    """

    past: Floats = np.empty((0, 3))
    bend: Floats = np.empty((3, 0))
    bend_s: float = math.nan
    told: bool = False
    wave: Floats = np.zeros(4)
    image: Image = STRAIGHT
    off: Floats = np.empty(0)


class RangeKeeper:
    """Brings distances to the middle of their pilot, corrects for the bar's lean, and makes sigmas true.

    A distance itself stays that of its frame: the others say three things about it only. A ranging that reads
    all of a frame measures at the frame's middle; how fast distances change takes that to the pilot's. A bar
    that leans towards or from the camera looks shorter, or beside the image's middle longer; its boundaries
    then lie on a parabola, whose bend is far below a frame's noise and adds up over frames. Where the
    camera's attitude is known, a plumb bar's lean is, too, to its sigma, and the bend tells the rest.
    And distances of a moving car lie on a smooth line: their scatter about it, against the sigmas that the
    ranging gave, says what these are worth.

    A boundary that falls between two pixels seems nearer to one of them than it is. Over boundaries that lie
    differently this averages out; over those of a bar whose clusters are a whole number of pixels apart it
    looks like another spacing, or a bend. How far they seem off follows the sine of their place on the
    pixels, by symmetry; how high that wave is shows in frames whose boundaries lie in many ways on them.
    """

    def __init__(self) -> None:
        # The middles of the grid's cells.
        self._lean_deg = np.arange(-_LEANING_DEG + _STEP_DEG / 2, _LEANING_DEG, _STEP_DEG)
        self._sine = np.sin(np.radians(self._lean_deg))
        self._likely = self._mixture(_LEVEL_DEG, _LEANING_SHARE)

    def step(
        self, state: Ranges, t_us: float, chip_us: float, measured: Range, sight: LineOfSight
    ) -> tuple[Ranges, Range]:
        """Take a frame's distance; give the new state and the distance as it should be.

        Args:
            state: What is remembered; not changed.
            t_us: Start of the frame, us.
            chip_us: Length of a chip, us.
            measured: As the ranging gave it; without a distance, or a sigma, it is given back.
            sight: Where the bar is seen, and what the attitude says of its lean.
        """
        distance_m, sigma_m = (
            measured.distance_m * sight.magnification,
            measured.sigma_m * sight.magnification,
        )
        if not (0 < distance_m < math.inf and 0 <= sigma_m < math.inf):
            return state, measured
        t_s, late_s = t_us * 1e-6, measured.late_chips * chip_us * 1e-6
        bend, bend_s, told, wave, image = state.bend, state.bend_s, state.told, state.wave, STRAIGHT
        height, unsure_m, off = (0.0, WAVE_PX**2), 0.0, state.off
        if measured.curvature is not None:
            faded = math.exp(-max(t_s - bend_s, 0.0) / _TILT_MEMORY_S) if bend.size else 0.0
            new = _weighed(measured.curvature, (sight.tilt_sine or 0.0) + sight.distortion_tilt)
            goes_on = bend.shape == new.shape and told == (sight.tilt_sine is not None)
            bend, bend_s, told = new + faded * bend if goes_on else new, t_s, sight.tilt_sine is not None
            wave, off, known = wave * faded, np.empty(new.shape[1]), (bend, state.off)
            scatter = _kernels.add_phase_bias(measured.curvature.place, new, _LEAST_WEIGHT, wave, known, off)
            sums = wave.tolist()
            height = _height(sums)
            distance_m -= _WAVE_SHARE * height[0] * measured.curvature.phase_bias_m
            # The ranging's sigma is of boundaries with the wave.
            sigma_m *= math.sqrt(_left_over(sums, height[0]))
            unsure_m = (
                math.hypot(_WAVE_SHARE * math.sqrt(height[1]), _WAVE_REST_PX)
                * measured.curvature.phase_bias_m
            )
            image = judge_image(measured.curvature, off, bend, scatter, state.image, t_s)
            distance_m *= 1 - image.longer
        sigma_m = max(sigma_m, _LEAST_SIGMA * abs(distance_m))
        old = state.past
        while len(old) and old[0, 0] <= t_s - _MEMORY_S:
            old = old[1:]
        past = np.empty((len(old) + 1, 3))
        past[:-1], past[-1] = old, (t_s, distance_m, sigma_m**2)
        # They follow a parabola whose speed and acceleration are likely as above; the squares of what is
        # left, in those that the sigmas expect, scale the variances.
        speed_m_s, speed_variance, variance = _kernels.fit_newest(
            past, _SPEED_M_S**-2, _ACCELERATION_M_S2**-2, _SCATTER_WORTH, _OUTLIER**2
        )
        distance_m -= speed_m_s * late_s
        # What is not known of the wave is alike in many frames: their scatter does not show it.
        variance += speed_variance * late_s**2 + unsure_m**2
        # Nor does it show what bends the image.
        standing_m = distance_m * image.sigma
        variance += standing_m**2
        # A bend that no lean makes says nothing of one.
        newest = None if image.whole else measured.curvature
        length, length_variance = self._leaning(bend, height, newest, sight)
        variance = variance * length**2 + distance_m**2 * length_variance
        found = Range(
            distance_m * length,
            math.sqrt(variance),
            measured.pairs,
            standing_m=standing_m * length,
            distortion_px=image.bent_px,
        )
        return Ranges(past, bend, bend_s, told, wave, image, off), found

    def _leaning(
        self, sums: Floats, wave: tuple[float, float], newest: Curvature | None, sight: LineOfSight
    ) -> tuple[float, float]:
        """Mean and variance of the foreshortening, by what is likely and by what was seen."""
        likely, sine, told = self._likely, self._sine, 0.0
        if sight.tilt_sine is not None:
            told = sight.tilt_sine
            sine = np.sin(math.asin(told) + np.radians(self._lean_deg))
            sigma_deg = math.degrees(sight.tilt_sigma / math.sqrt(max(1 - told**2, sight.tilt_sigma**2)))
            likely = self._mixture(sigma_deg, _SLANTED_SHARE)
        off, sigma = math.nan, 1.0
        if newest is not None:
            # What puts the boundaries of every frame off alike is in their scatter about a parabola, too.
            off, variance = _kernels.estimate_curvature(newest.place, sums, _LEAST_WEIGHT, *wave)
            sigma = 1.0 if math.isnan(off) else math.sqrt(max(variance, 1e-12))
        return _kernels.estimate_foreshortening(sine, likely, told + off, sigma, sight.along, sight.across)

    def _mixture(self, sigma_deg: float, share: float) -> Floats:
        """Chances of the leans of the grid: as surely as said, but for a share of which nothing is known."""
        # Half a step is as narrow as a grid shows it.
        sigma_deg = max(sigma_deg, _STEP_DEG / 2)
        bell = np.exp(-0.5 * np.minimum((self._lean_deg / sigma_deg) ** 2, 1400.0)) / sigma_deg
        return np.asarray((1 - share) * (bell / math.sqrt(2 * math.pi)) + share / (2 * _LEANING_DEG))


def _weighed(curvature: Curvature, sine: float) -> Floats:
    """Weights of a frame's boundaries, and what lies off and the wave by these, without the known lean."""
    off = curvature.offset - sine * curvature.place**2 if sine else curvature.offset
    sums = np.empty((3, len(off)))
    sums[0], sums[1] = curvature.weight, curvature.weight * off
    sums[2] = 0.0 if curvature.phase_bias is None else curvature.weight * curvature.phase_bias
    return sums


def _height(wave: list[float]) -> tuple[float, float]:
    """How high the pixels' wave is, px, and the variance of that, by what frames show and what is likely."""
    squares, products, left, freedom = wave
    if not (squares > 0 and freedom > 1):
        return 0.0, WAVE_PX**2
    noise = ALIKE * max(left - products**2 / squares, 1e-12 * squares) / (freedom - 1)
    variance = 1 / (squares / noise + WAVE_PX**-2)
    return products / noise * variance, variance


def _left_over(wave: list[float], height_px: float) -> float:
    """Share of the boundaries' scatter that is left when a wave of that height is taken out."""
    squares, products, left, _ = wave
    if not left > 0:
        return 1.0
    return min(max(1 - height_px * (2 * products - height_px * squares) / left, 0.0), 1.0)
