"""Corrects a transmitter's distances by those before: for time, tilt, pixel phase, distortion and scatter."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.distortion import (
    CORRELATED_FRAMES,
    PHASE_BIAS_PX,
    UNDISTORTED,
    Distortion,
    assess_distortion,
)
from evlcp_sdk.scene.tilt import LineOfSight
from evlcp_sdk.values import Curvature, Range

_MEMORY_S = 0.3
"""Time over which distances are fitted: a bicycle's swerve or a brake takes longer to change acceleration."""

_SPEED_M_S = 20.0
"""Speeds before any is measured (sigma): 72 km/h."""

_ACCELERATION_M_S2 = 3.0
"""Accelerations (sigma): a hard brake has 8."""

_SCATTER_WORTH = 8.0
"""Frames that the sigmas of a ranging are worth against the scatter of its distances."""

_OUTLIER_SIGMAS = 4.0
"""Sigmas off the others, 1 of 16000 by chance, beyond which a distance's offset becomes its sigma."""

_MIN_SIGMA_SHARE = 1e-6
"""Least sigma, as a share of the distance: ideal images have less, which means nothing."""

_LEVEL_TILT_DEG, _MAX_TILT_DEG, _TILTED_SHARE = 0.7, 5.0, 0.1
"""Prior of a bar's tilt before it is measured: none but for a mount's error and the car's springs (sigma),
and for one camera in ten, whose mount nobody levelled, anything up to the steepest. With more of these,
sigmas of level bars far away are too large; with fewer, those of tilted ones too small for longer."""

_TILT_MEMORY_S = 1.0
"""A car's pitch changes within a second when it brakes."""

_TILT_STEP_DEG = 0.1
"""Grid of tilts: a third of the sigma that the curvature of a second has at 30 m."""

_NOT_PLUMB_SHARE = 6e-5
"""Share of the bars that are not plumb, or seen with a wrong attitude: they may have any tilt up to the
steepest. As rare as an outlier: it adds nothing to other sigmas, but accepts a curvature that contradicts."""

_BIAS_SHARE, _BIAS_REST_PX = 0.6, 0.03
"""Share of the pixel-phase bias that distances have, and its error (sigma), px: rows far off a fit hardly
pull it. 0.35 was found in recordings of an independent generator, and 0.85 in rendered ones with a larger
bias; its error is 0.01 to 0.05 px."""

_MIN_WEIGHT = 0.1
"""Least weight of a boundary, in that of the heaviest."""

Floats = NDArray[np.float64]


class RangeState(NamedTuple):
    """What is remembered of a transmitter's distances.

    Attributes:
        past: Time (s), distance (m) and variance (m2) of each, oldest first, float64 (n, 3).
        boundary_sums: Sums over the boundaries' weights, and, weighted, their offsets beyond the known tilt
            and the pattern of the pixel-phase bias, float64 (3, n); empty without any.
        sums_s: Time of the newest of these, s.
        tilt_known: The attitude gave the tilt then.
        bias_sums: Evidence of the pixel-phase bias, see `_kernels.add_phase_bias`, float64 (4,).
        distortion: Of the bar's image.
        offset: Of the boundaries, as in `Curvature`, beyond the known tilt, in the newest frame, float64
            (n,); NaN if unseen.
    """

    past: Floats = np.empty((0, 3))
    boundary_sums: Floats = np.empty((3, 0))
    sums_s: float = math.nan
    tilt_known: bool = False
    bias_sums: Floats = np.zeros(4)
    distortion: Distortion = UNDISTORTED
    offset: Floats = np.empty(0)


class RangeCorrector:
    """Moves distances to the middle of their pilot, corrects them for the bar's tilt, and calibrates sigmas.

    A distance remains that of its frame; other frames give corrections only. A ranging that uses all of
    a frame measures at the frame's middle: the rate of change takes that to the pilot's. A bar that tilts
    towards or from the camera looks shorter, or beside the image's middle longer; its boundaries are then on
    a parabola, whose curvature is far below a frame's noise and adds up over frames. Where the camera's
    attitude is known, so is the tilt of a plumb bar, to its sigma, and the curvature gives the rest. And
    distances of a moving car are on a smooth line: their scatter about it scales the sigmas of the ranging.

    A boundary that falls between two pixels seems nearer to one of them than it is. This averages out over
    boundaries with different phases; over those of a bar whose clusters are a whole number of pixels apart it
    looks like another spacing, or a curvature. By symmetry, this pixel-phase bias follows the sine of a
    boundary's place on the pixels; its amplitude shows in frames whose boundaries have many phases.
    """

    def __init__(self) -> None:
        # The middles of the grid's cells.
        self._tilt_deg = np.arange(-_MAX_TILT_DEG + _TILT_STEP_DEG / 2, _MAX_TILT_DEG, _TILT_STEP_DEG)
        self._sine = np.sin(np.radians(self._tilt_deg))
        self._prior = self._tilt_prior(_LEVEL_TILT_DEG, _TILTED_SHARE)

    def step(
        self, state: RangeState, t_us: float, chip_us: float, measured: Range, line_of_sight: LineOfSight
    ) -> tuple[RangeState, Range]:
        """Correct a frame's distance by the ranging; return the new state and the distance.

        Without a distance, or a sigma, it is returned as it is. `t_us` is the start of the frame.
        """
        distance_m = measured.distance_m * line_of_sight.magnification
        sigma_m = measured.sigma_m * line_of_sight.magnification
        if not (0 < distance_m < math.inf and 0 <= sigma_m < math.inf):
            return state, measured
        t_s, late_s = t_us * 1e-6, measured.late_chips * chip_us * 1e-6
        past, sums, sums_s, tilt_known, bias_sums, distortion, offset = state
        distortion, bias, bias_sigma_m = UNDISTORTED, (0.0, PHASE_BIAS_PX**2), 0.0
        curvature = measured.curvature
        if curvature is not None:
            faded = math.exp(-max(t_s - sums_s, 0.0) / _TILT_MEMORY_S) if sums.size else 0.0
            known_tilt = (line_of_sight.tilt_sine or 0.0) + line_of_sight.distortion_tilt
            new_sums = _weigh_boundaries(curvature, known_tilt)
            goes_on = sums.shape == new_sums.shape and tilt_known == (line_of_sight.tilt_sine is not None)
            sums, sums_s = new_sums + faded * sums if goes_on else new_sums, t_s
            tilt_known = line_of_sight.tilt_sine is not None
            bias_sums, offset = bias_sums * faded, np.empty(new_sums.shape[1])
            *scatter, alike = _kernels.add_phase_bias(
                curvature.place, new_sums, _MIN_WEIGHT, bias_sums, (sums, state.offset), offset
            )
            evidence = bias_sums.tolist()
            bias = _estimate_bias(evidence, max(alike, CORRELATED_FRAMES))
            distance_m -= _BIAS_SHARE * bias[0] * curvature.phase_bias_m
            # The ranging's sigma is that of boundaries with the bias.
            sigma_m *= math.sqrt(_remaining_scatter(evidence, bias[0]))
            bias_sigma = math.hypot(_BIAS_SHARE * math.sqrt(bias[1]), _BIAS_REST_PX)
            bias_sigma_m = bias_sigma * curvature.phase_bias_m
            distortion = assess_distortion(curvature, offset, sums, scatter, state.distortion, t_s)
            distance_m *= 1 - distortion.stretch
        sigma_m = max(sigma_m, _MIN_SIGMA_SHARE * abs(distance_m))
        while len(past) and past[0, 0] <= t_s - _MEMORY_S:
            past = past[1:]
        past = np.concatenate([past, [(t_s, distance_m, sigma_m**2)]])
        speed_m_s, speed_variance, variance = _kernels.fit_newest(
            past, _SPEED_M_S**-2, _ACCELERATION_M_S2**-2, _SCATTER_WORTH, _OUTLIER_SIGMAS**2
        )
        distance_m -= speed_m_s * late_s
        # The scatter of frames does not show errors that many frames have alike: of the bias, and of what
        # distorts the image.
        standing_m = distance_m * distortion.sigma
        variance += speed_variance * late_s**2 + bias_sigma_m**2
        variance += standing_m**2
        # The curvature of a smoothly distorted image is not the tilt's.
        place = None if distortion.is_smooth or curvature is None else curvature.place
        length, length_variance = self._foreshortening(sums, bias, place, line_of_sight)
        variance = variance * length**2 + distance_m**2 * length_variance
        corrected = Range(
            distance_m * length,
            math.sqrt(variance),
            measured.pairs,
            standing_m=standing_m * length,
            distortion_px=distortion.residuals_px,
        )
        return RangeState(past, sums, sums_s, tilt_known, bias_sums, distortion, offset), corrected

    def _foreshortening(
        self, sums: Floats, bias: tuple[float, float], place: Floats | None, line_of_sight: LineOfSight
    ) -> tuple[float, float]:
        """Mean and variance of the foreshortening, by the prior of the tilt and the boundaries at `place`."""
        prior, sine, known_sine = self._prior, self._sine, 0.0
        if line_of_sight.tilt_sine is not None:
            known_sine, sigma = line_of_sight.tilt_sine, line_of_sight.tilt_sigma
            sine = np.sin(math.asin(known_sine) + np.radians(self._tilt_deg))
            sigma_deg = math.degrees(sigma / math.sqrt(max(1 - known_sine**2, sigma**2)))
            prior = self._tilt_prior(sigma_deg, _NOT_PLUMB_SHARE)
        tilt_sine, sigma = math.nan, 1.0
        if place is not None:
            # Offsets that are alike in all frames are in the scatter about a parabola, too.
            tilt_sine, variance = _kernels.estimate_curvature(place, sums, _MIN_WEIGHT, *bias)
            sigma = 1.0 if math.isnan(tilt_sine) else math.sqrt(max(variance, 1e-12))
        return _kernels.estimate_foreshortening(
            sine, prior, known_sine + tilt_sine, sigma, line_of_sight.along, line_of_sight.across
        )

    def _tilt_prior(self, sigma_deg: float, share: float) -> Floats:
        """Probabilities of the grid's tilts: normal, but for a share of bars with any tilt."""
        # Half a step is the narrowest that the grid resolves.
        sigma_deg = max(sigma_deg, _TILT_STEP_DEG / 2)
        bell = np.exp(-0.5 * np.minimum((self._tilt_deg / sigma_deg) ** 2, 1400.0)) / sigma_deg
        return np.asarray((1 - share) * (bell / math.sqrt(2 * math.pi)) + share / (2 * _MAX_TILT_DEG))


def _weigh_boundaries(curvature: Curvature, tilt_sine: float) -> Floats:
    """Sums of a frame's boundaries, as in `RangeState`, beyond a known tilt."""
    offset = curvature.offset - tilt_sine * curvature.place**2 if tilt_sine else curvature.offset
    sums = np.empty((3, len(offset)))
    sums[0], sums[1] = curvature.weight, curvature.weight * offset
    sums[2] = 0.0 if curvature.phase_bias is None else curvature.weight * curvature.phase_bias
    return sums


def _estimate_bias(bias_sums: list[float], correlated_frames: float) -> tuple[float, float]:
    """Amplitude of the pixel-phase bias, px, and its variance, by the evidence of frames and its prior.

    So many frames have the same errors: of a camera that stands still, all.
    """
    squares, products, residuals, freedom = bias_sums
    if not (squares > 0 and freedom > 1):
        return 0.0, PHASE_BIAS_PX**2
    noise = correlated_frames * max(residuals - products**2 / squares, 1e-12 * squares) / (freedom - 1)
    variance = 1 / (squares / noise + PHASE_BIAS_PX**-2)
    return products / noise * variance, variance


def _remaining_scatter(bias_sums: list[float], bias_px: float) -> float:
    """Share of the boundaries' squared residuals that remains without a bias of this amplitude."""
    squares, products, residuals, _ = bias_sums
    if not residuals > 0:
        return 1.0
    return min(max(1 - bias_px * (2 * products - bias_px * squares) / residuals, 0.0), 1.0)
