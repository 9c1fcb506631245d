"""Distorted images of bars: boundaries between clusters that no straight bar explains."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.values import Curvature

Floats = NDArray[np.float64]

_MAX_NOISE_PX = 0.125
"""Largest scatter of boundaries in a single frame (sigma): in recordings the noise is .03 to .06 px, and .12
where pixels are blind for long or miss most events."""

_STANDING_PX = 0.04
"""Constant offsets of the boundaries of a straight bar (sigma): up to .04 px in recordings."""

PHASE_BIAS_PX = 0.1
"""Amplitude of the pixel-phase bias of boundaries before it is estimated (sigma): 0 to .14 px in recordings,
more where pixels are blind for long or bars sharp."""

CORRELATED_FRAMES = 4.0
"""Frames with the same errors, as they show the bar in about the same place on the pixels."""

_NOISE_SIGMAS = 4.0
"""Sigmas of the sum of squared residuals, in its normal limit, above which noise is no explanation: by the
chi-square of 13 degrees of freedom 1 of 700 frames, for boundaries that scatter as much as any do."""

_MIN_CORRELATION = 0.2
"""Correlation of neighbours from which on the distortion is smooth: 15 independent offsets reach it in 7 % of
cases, and drops two spacings wide and wider miss it in .5 %."""

_CORRELATION_LENGTHS, _ERROR_SCALES = np.array([1.0, 2.0, 4.0]), np.array([1.0, 2.0, 4.0])
"""Spacings over which the offsets of a smooth distortion are alike, for drops a tenth of a bar wide to half
of it; and their sigma, in that of the residuals of a line."""

_SCALE_SQUARE = 1.0
"""Square of what a smooth distortion may add to a scale beyond that, in squared residuals: a drop may cover
much of a bar."""

_MEMORY_S = 0.3
"""Time in which a drop runs on by its width: for a moment it may bend nothing, but stretch it."""

_AVERAGE_S = 1.0
"""Time over which offsets are averaged: in that, a car nears by a sixth at most."""

_WIDE, _NEAR = 2.0, 0.15
"""Sigmas of the offsets of boundaries that are off, and of others, in that of the residuals of a line through
all: a dark LED moves the boundary beside it by half of its place, and others hardly."""

_EXTRA_SIGMA = 0.35
"""Share of the sigma of a line through all boundaries that is added where most agree: those may be wrong."""

_MAX_TILT_SINE = math.sin(math.radians(5.0))
"""Steepest tilt beyond the known one."""

_MIN_BOUNDARIES = 6
"""Boundaries that it takes to compare them with each other."""


class StraightFit(NamedTuple):
    """A straight bar fitted to boundaries.

    Attributes:
        slope: By how much its spacing exceeds that of the scale that the offsets refer to, px.
        variance: Of the slope, px2; it persists over frames, as what distorts the image does.
        residuals_px: Of the boundaries, float64 (n,).
        is_correlated: Neighbours have similar residuals.
    """

    slope: float
    variance: float
    residuals_px: Floats
    is_correlated: bool


class Distortion(NamedTuple):
    """How the image of a bar deviates from a straight one.

    Attributes:
        stretch: By which share the bar is longer in it than the frame's scale has it.
        sigma: Of the stretch; it persists over frames.
        residuals_px: Offsets of the boundaries from a straight bar, px, float64 (n,), NaN where unseen; None
            where they are no larger than those of a straight bar.
        is_smooth: Neighbouring boundaries are off alike, as behind a drop.
        t_s: Time of the frame, s.
        averages: Of a distorted image, mean offsets of the boundaries from one line, in spacings, and the
            frames that these are worth, float64 (2, n).
        fading_sigma: Sigma of two frames in a row with smooth distortion, the less the longer ago.
    """

    stretch: float = 0.0
    sigma: float = 0.0
    residuals_px: Floats | None = None
    is_smooth: bool = False
    t_s: float = -math.inf
    averages: Floats = np.empty((2, 0))
    fading_sigma: float = 0.0


UNDISTORTED = Distortion()


def assess_distortion(
    curvature: Curvature,
    offset: Floats,
    sums: Floats,
    scatter: Sequence[float],
    before: Distortion,
    t_s: float,
) -> Distortion:
    """Assess the distortion of a frame by its boundaries, and by those of earlier frames that agree with it.

    Args:
        curvature: Of the frame.
        offset: Offsets of its boundaries beyond the known tilt, float64 (n,), NaN where unseen.
        sums: Their weights over the frames of the last second, and their offsets, weighted, (2 or more, n).
        scatter: Of these, as from `_kernels.add_phase_bias`.
        before: Distortion of the frame before.
        t_s: Time of the frame, s.
    """
    px, (squares, mean_squares, bias_squares, moved, frames) = curvature.unit_px, scatter
    if not px * curvature.spacing_px > 0:
        return UNDISTORTED
    # The difference of two frames has twice the variance, whose median this is.
    noise_px = _MAX_NOISE_PX if math.isnan(moved) else 1.4826 / math.sqrt(2) * moved * px
    frame_noise_px = max(noise_px, _MAX_NOISE_PX)
    # Where the image stands still, so does the pixel-phase bias.
    standing_px = math.hypot(_STANDING_PX, PHASE_BIAS_PX * px * math.sqrt(bias_squares / len(offset)))
    mean_px = math.hypot(standing_px, noise_px * math.sqrt(CORRELATED_FRAMES / frames))
    rejected = curvature.offset * (curvature.weight == 0)
    shown_px = np.where(rejected != 0, rejected, offset) * px if rejected.any() else None
    fading = before.fading_sigma and before.fading_sigma * math.exp((before.t_s - t_s) / _MEMORY_S)
    # Most frames, and their means, are well below these limits.
    if squares * px**2 <= frame_noise_px**2 * len(offset) and mean_squares * px**2 <= mean_px**2 * len(
        offset
    ):
        if not fading and shown_px is None:
            return UNDISTORTED
        return Distortion(0.0, fading, shown_px, t_s=t_s, fading_sigma=fading)
    if before.averages.shape[1] != len(offset):
        mean = sums[1] / np.maximum(sums[0], 1e-300) * (px / curvature.spacing_px)
        before = before._replace(t_s=t_s, averages=np.array([mean, frames * (sums[0] > 0)]))
    turn, averages = _average_offsets(curvature, offset, frame_noise_px, before, t_s)
    mean_noise_px = math.hypot(standing_px, noise_px * math.sqrt(CORRELATED_FRAMES / averages[1].max()))
    known, seen = averages[1] > 0.5, offset == offset
    fit = fit_straight(
        curvature.place[known],
        averages[0, known] * curvature.spacing_px,
        min(mean_noise_px, frame_noise_px),
        _MAX_TILT_SINE * px,
    )
    if fit is None:
        return Distortion(0.0, fading, shown_px, False, t_s, averages, fading)
    residuals_px = np.where(rejected != 0, rejected * px, np.nan)
    residuals_px[seen] = fit.residuals_px[seen[known]]
    sigma = math.sqrt(fit.variance) / curvature.spacing_px
    if fit.is_correlated and before.is_smooth:
        fading = max(fading, min(sigma, before.sigma))
    stretch, sigma = turn + fit.slope / curvature.spacing_px, max(sigma, fading)
    return Distortion(stretch, sigma, residuals_px, fit.is_correlated, t_s, averages, fading)


def _average_offsets(
    curvature: Curvature, offset: Floats, noise_px: float, before: Distortion, t_s: float
) -> tuple[float, Floats]:
    """Average a frame's offsets with those before; return how much steeper its line is, and the averages.

    Dark LEDs move with the bar, and boundaries are off alike in all frames. What stands in the image does
    not, and the averages are worth the less, the more a frame differs from them.
    """
    seen = offset == offset
    frame = np.where(seen, offset, 0.0) * (curvature.unit_px / curvature.spacing_px)
    mean, worth = before.averages
    both = seen * (worth > 0)
    n = float(both.sum())
    if n < _MIN_BOUNDARIES:
        return 0.0, np.array([frame, seen])
    lever = curvature.place - both @ curvature.place / n
    change, levers = (frame - mean) * both, float(both @ lever**2)
    level, turn = float(change.sum()) / n, float(change @ lever) / levers
    squares = float(change @ change) - n * level**2 - levers * turn**2
    worth = worth * math.exp((before.t_s - t_s) / _AVERAGE_S)
    worth /= 1 + worth * max(squares * curvature.spacing_px**2 / _noise_limit(noise_px, n) - 1, 0.0)
    share = seen / (worth + 1)
    return turn, np.array([mean + share * (frame - level - turn * lever - mean), worth + seen])


def _noise_limit(noise_px: float, n: float) -> float:
    """Largest sum of squared residuals of a line through n boundaries that noise explains, px2."""
    return noise_px**2 * (n - 2 + _NOISE_SIGMAS * math.sqrt(2 * (n - 2)))


def fit_straight(place: Floats, off_px: Floats, noise_px: float, steepest_px: float) -> StraightFit | None:
    """Fit the straight bar that boundaries agree on; None where noise explains their offsets.

    A smooth distortion, such as a drop's, moves all boundaries, and neighbours alike: the line is fitted by
    generalised least squares with errors the more alike, the nearer boundaries are. Dark or hidden LEDs move
    single boundaries: the lines through any two are weighted by how many others agree with them.

    `place` (n,) are the boundaries' positions, in spacings; `off_px` (n,) their offsets from an even scale,
    with a sigma `noise_px`. A tilt moves them by the square of their place, up to `steepest_px` at place 1.
    """
    n = len(place)
    if n < _MIN_BOUNDARIES:
        return None
    lever = place - place.mean()
    terms = np.stack([lever**2, lever, np.ones(n)], 1)
    curvature = float(np.linalg.lstsq(terms, off_px, rcond=None)[0][0])
    off_px = off_px - min(max(curvature, -steepest_px), steepest_px) * terms[:, 0]
    line = np.linalg.lstsq(terms[:, 1:], off_px, rcond=None)[0]
    residuals = off_px - terms[:, 1:] @ line
    squares = float(residuals @ residuals)
    if squares <= _noise_limit(noise_px, n):
        return None
    sigma_px = math.sqrt(squares / (n - 2))
    if are_correlated(residuals):
        smooth, variance = _fit_smooth(terms[:, 1:], residuals, noise_px, sigma_px)
        variance += _SCALE_SQUARE * squares / float(lever @ lever)
        return StraightFit(float(line[0]) + smooth, variance, residuals, is_correlated=True)
    one, other = np.triu_indices(n, 1)
    slope = (residuals[other] - residuals[one]) / (lever[other] - lever[one])
    residuals_of_lines = residuals - (residuals[one] - slope * lever[one])[:, None] - slope[:, None] * lever
    near_px, wide_px = math.hypot(noise_px, _NEAR * sigma_px), max(_WIDE * sigma_px, 2 * noise_px)
    likely = sum(np.exp(-0.5 * (residuals_of_lines / px) ** 2) / px for px in (near_px, wide_px))
    weights = np.log(np.maximum(likely, 1e-300)).sum(1)
    weights = np.exp(weights - weights.max())
    weights /= weights.sum()
    mean = float(weights @ slope)
    variance = float(weights @ (slope - mean) ** 2) + (_EXTRA_SIGMA * sigma_px) ** 2 / float(lever @ lever)
    return StraightFit(float(line[0]) + mean, variance, weights @ residuals_of_lines, is_correlated=False)


def _fit_smooth(terms: Floats, off_px: Floats, noise_px: float, sigma_px: float) -> tuple[float, float]:
    """Slope of a line with errors that neighbours share, and its variance, by generalised least squares.

    Correlation length and size of the errors are unknown: the mean over what is likely.
    """
    distance = terms[:, 0, None] - terms[:, 0]
    correlation = np.exp(-0.5 * (distance / _CORRELATION_LENGTHS[:, None, None]) ** 2)
    errors = np.concatenate([(height * sigma_px) ** 2 * correlation for height in _ERROR_SCALES])
    weights = np.linalg.inv(errors + noise_px**2 * np.eye(len(distance)))
    spread = np.linalg.inv(terms.T @ weights @ terms)
    line = spread @ (terms.T @ weights @ off_px)[:, :, None]
    residuals = off_px[:, None] - terms @ line
    posterior = (
        np.linalg.slogdet(weights)[1]
        + np.linalg.slogdet(spread)[1]
        - (residuals.swapaxes(1, 2) @ weights @ residuals)[:, 0, 0]
    )
    posterior = np.exp(0.5 * (posterior - posterior.max()))
    posterior /= posterior.sum()
    mean = float(posterior @ line[:, 0, 0])
    return mean, float(posterior @ (spread[:, 0, 0] + (line[:, 0, 0] - mean) ** 2))


def are_correlated(off_px: Floats) -> bool:
    """Whether neighbouring boundaries are off alike."""
    return float(off_px[1:] @ off_px[:-1]) > _MIN_CORRELATION * float(off_px @ off_px)
