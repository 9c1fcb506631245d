"""Boundaries between clusters that no straight bar explains: drops, dead LEDs, and what is in the way."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.values import Curvature

Floats = NDArray[np.float64]

_ROUGH_PX = 0.125
"""How much boundaries of a frame alone scatter at the most (sigma): in recordings by noise .03 to .06 px, and
.12 where pixels are blind for long or miss most events."""

_STANDING_PX = 0.04
"""How far boundaries of a straight bar lie off all the time (sigma): up to .04 px in recordings."""

WAVE_PX = 0.1
"""By how much a boundary that falls between two pixels seems off before it is measured (sigma): 0 to .14 px
in recordings, more where pixels are blind for long or bars sharp."""

ALIKE = 4.0
"""Frames that err alike, as they show the bar in about the same place on the pixels."""

_SIGMAS = 4.0
"""Of the sum of squares of what lies off, by its normal limit, beyond which noise is no reason: by the
chi-square of 13 degrees of freedom 1 of 700 frames, of boundaries that scatter as much as any do."""

_TOGETHER = 0.2
"""Correlation of neighbours from which on something bends the image as a whole: errors of 15 boundaries, each
for itself, reach it in 7 % of cases, and drops two spacings wide and wider miss it in .5 %."""

_REACHES, _HEIGHTS = np.array([1.0, 2.0, 4.0]), np.array([1.0, 2.0, 4.0])
"""Spacings over which errors of a bent image are alike, of drops a tenth of a bar wide to half of it; and
their sigma, in that of what a line leaves."""

_SMOOTH = 1.0
"""Square of what a bend may add to a scale beyond that, in that of what it leaves beside it: one drop may
cover much of a bar."""

_MEMORY_S = 0.3
"""Time in which a drop runs on by its width: for a moment it may bend nothing, and add to the scale."""

_LEARN_S = 1.0
"""Time over which what boundaries lie off is learnt: in that, a car nears by a sixth at the most."""

_WIDE, _NEAR = 2.0, 0.15
"""Sigmas of the errors of boundaries that are off, and of those that are not, in that of what all leave about
a line through all: a dark LED moves the boundary beside it by half of its place, and others hardly."""

_DOUBT = 0.35
"""Of the sigma of a line through all boundaries, which is added where most agree: those may be wrong."""

_STEEPEST = math.sin(math.radians(5.0))
"""Of a lean beyond what is known."""

_FEWEST = 6
"""Boundaries of which fewer say nothing of one another."""


class Straight(NamedTuple):
    """What boundaries say of the straight bar behind them.

    Attributes:
        slope: By how much its spacing is larger than the scale's that they lie off, px.
        variance: Of that, px2: it stays from frame to frame, as what bends the image does.
        rest_px: How far each lies off it, float64 (n,).
        together: Neighbours lie off alike.
    """

    slope: float
    variance: float
    rest_px: Floats
    together: bool


class Image(NamedTuple):
    """How straight the image of a bar is.

    Attributes:
        longer: By how much the bar is longer in it than the frame's scale says, a share.
        sigma: Of that: it stays from frame to frame.
        bent_px: How far boundaries lie off a straight bar, px, float64 (n,), NaN where unseen; None where
            that is no more than those of a straight one do.
        whole: What bends it bends it as a whole.
        t_s: When it was, s.
        learnt: Where it is bent, how far boundaries lie off one line in the frames so far, in spacings, and
            how many frames that is worth, float64 (2, n).
        fading: Sigma of two frames in a row whose images are bent as a whole, the less the longer ago.
    """

    longer: float = 0.0
    sigma: float = 0.0
    bent_px: Floats | None = None
    whole: bool = False
    t_s: float = -math.inf
    learnt: Floats = np.empty((2, 0))
    fading: float = 0.0


STRAIGHT = Image()


def judge_image(
    curvature: Curvature, off: Floats, sums: Floats, scatter: tuple[float, ...], before: Image, t_s: float
) -> Image:
    """Judge a frame by how its boundaries lie off, and did in those before as far as it looks like them.

    Args:
        curvature: Of the frame.
        off: How far its boundaries lie off beyond the lean that is known, float64 (n,), NaN where unseen.
        sums: Their weights over the frames of the last second, and what lies off, weighted, (2 or more, n).
        scatter: Of these, as of `_kernels.add_phase_bias`.
        before: The frame before.
        t_s: When it is, s.
    """
    px, (squares, of_means, of_waves, moved, frames) = curvature.unit_px, scatter
    if not px * curvature.spacing_px > 0:
        return STRAIGHT
    # What two frames differ by has twice the variance, whose median this is.
    noise_px = _ROUGH_PX if math.isnan(moved) else 1.4826 / math.sqrt(2) * moved * px
    alone_px = max(noise_px, _ROUGH_PX)
    # Where the image stands still, so does the pixels' wave.
    standing_px = math.hypot(_STANDING_PX, WAVE_PX * px * math.sqrt(of_waves / len(off)))
    mean_px = math.hypot(standing_px, noise_px * math.sqrt(ALIKE / frames))
    left_out = curvature.offset * (curvature.weight == 0)
    shown_px = np.where(left_out != 0, left_out, off) * px if left_out.any() else None
    fading = before.fading and before.fading * math.exp((before.t_s - t_s) / _MEMORY_S)
    # Most frames, and their means, are well below what is asked of them.
    if squares * px**2 <= alone_px**2 * len(off) and of_means * px**2 <= mean_px**2 * len(off):
        if not fading and shown_px is None:
            return STRAIGHT
        return Image(0.0, fading, shown_px, t_s=t_s, fading=fading)
    if before.learnt.shape[1] != len(off):
        mean = sums[1] / np.maximum(sums[0], 1e-300) * (px / curvature.spacing_px)
        before = before._replace(t_s=t_s, learnt=np.array([mean, frames * (sums[0] > 0)]))
    turn, learnt = _learn(curvature, off, alone_px, before, t_s)
    noise_px = min(math.hypot(standing_px, noise_px * math.sqrt(ALIKE / learnt[1].max())), alone_px)
    known, seen = learnt[1] > 0.5, off == off
    found = straighten(
        curvature.place[known], learnt[0, known] * curvature.spacing_px, noise_px, _STEEPEST * px
    )
    if found is None:
        return Image(0.0, fading, shown_px, False, t_s, learnt, fading)
    bent_px = np.where(left_out != 0, left_out * px, np.nan)
    bent_px[seen] = found.rest_px[seen[known]]
    sigma = math.sqrt(found.variance) / curvature.spacing_px
    if found.together and before.whole:
        fading = max(fading, min(sigma, before.sigma))
    longer, sigma = turn + found.slope / curvature.spacing_px, max(sigma, fading)
    return Image(longer, sigma, bent_px, found.together, t_s, learnt, fading)


def _learn(
    curvature: Curvature, off: Floats, noise_px: float, before: Image, t_s: float
) -> tuple[float, Floats]:
    """Add a frame's boundaries to those before; by how much its line is steeper than theirs, in spacings.

    LEDs that are dark move with the bar, and boundaries lie off alike in all frames. What stands in the image
    does not, and what was learnt is worth the less, the more a frame differs.
    """
    seen = off == off
    frame = np.where(seen, off, 0.0) * (curvature.unit_px / curvature.spacing_px)
    mean, worth = before.learnt
    both = seen * (worth > 0)
    n = float(both.sum())
    if n < _FEWEST:
        return 0.0, np.array([frame, seen])
    at = curvature.place - both @ curvature.place / n
    differs, arms = (frame - mean) * both, float(both @ at**2)
    level, turn = float(differs.sum()) / n, float(differs @ at) / arms
    squares = float(differs @ differs) - n * level**2 - arms * turn**2
    worth = worth * math.exp((before.t_s - t_s) / _LEARN_S)
    worth /= 1 + worth * max(squares * curvature.spacing_px**2 / _most(noise_px, n) - 1, 0.0)
    share = seen / (worth + 1)
    return turn, np.array([mean + share * (frame - level - turn * at - mean), worth + seen])


def _most(noise_px: float, n: float) -> float:
    """Squares of what lies off a line through n boundaries, beyond which noise is no reason, px2."""
    return noise_px**2 * (n - 2 + _SIGMAS * math.sqrt(2 * (n - 2)))


def straighten(place: Floats, off_px: Floats, noise_px: float, steepest_px: float) -> Straight | None:
    """The straight bar that boundaries agree on, None where noise explains what they lie off a scale.

    What bends an image smoothly, a drop, moves neighbours alike, and all of them: a line is fitted as errors
    demand that are the more alike, the nearer to each other. What moves single boundaries, LEDs that are dark
    or hidden, leaves others alone: of the lines through any two, those that many agree with are likely.

    Args:
        place: Where boundaries are, in spacings, float64 (n,).
        off_px: How far they lie off an even scale, float64 (n,).
        noise_px: Their sigma.
        steepest_px: How far a lean may move the boundary at place 1, and others by the square of theirs.
    """
    n = len(place)
    if n < _FEWEST:
        return None
    at = place - place.mean()
    terms = np.stack([at**2, at, np.ones(n)], 1)
    bend = float(np.linalg.lstsq(terms, off_px, rcond=None)[0][0])
    off_px = off_px - min(max(bend, -steepest_px), steepest_px) * terms[:, 0]
    line = np.linalg.lstsq(terms[:, 1:], off_px, rcond=None)[0]
    rest = off_px - terms[:, 1:] @ line
    squares = float(rest @ rest)
    if squares <= _most(noise_px, n):
        return None
    sigma_px = math.sqrt(squares / (n - 2))
    if err_together(rest):
        slope, variance = _smooth(terms[:, 1:], rest, noise_px, sigma_px)
        variance += _SMOOTH * squares / float(at @ at)
        return Straight(float(line[0]) + slope, variance, rest, together=True)
    one, other = np.triu_indices(n, 1)
    slope = (rest[other] - rest[one]) / (at[other] - at[one])
    left = rest - (rest[one] - slope * at[one])[:, None] - slope[:, None] * at
    near_px, wide_px = math.hypot(noise_px, _NEAR * sigma_px), max(_WIDE * sigma_px, 2 * noise_px)
    likely = sum(np.exp(-0.5 * (left / px) ** 2) / px for px in (near_px, wide_px))
    chance = np.log(np.maximum(likely, 1e-300)).sum(1)
    chance = np.exp(chance - chance.max())
    chance /= chance.sum()
    mean = float(chance @ slope)
    variance = float(chance @ (slope - mean) ** 2) + (_DOUBT * sigma_px) ** 2 / float(at @ at)
    return Straight(float(line[0]) + mean, variance, chance @ left, together=False)


def _smooth(terms: Floats, off_px: Floats, noise_px: float, sigma_px: float) -> tuple[float, float]:
    """Slope of a line beside errors that neighbours share, and its variance: by generalised least squares.

    How far errors are alike and how high they are is not known: a mean over what is likely.
    """
    apart = terms[:, 0, None] - terms[:, 0]
    alike = np.exp(-0.5 * (apart / _REACHES[:, None, None]) ** 2)
    errors = np.concatenate([(height * sigma_px) ** 2 * alike for height in _HEIGHTS])
    weights = np.linalg.inv(errors + noise_px**2 * np.eye(len(apart)))
    spread = np.linalg.inv(terms.T @ weights @ terms)
    line = spread @ (terms.T @ weights @ off_px)[:, :, None]
    left = off_px[:, None] - terms @ line
    chance = (
        np.linalg.slogdet(weights)[1]
        + np.linalg.slogdet(spread)[1]
        - (left.swapaxes(1, 2) @ weights @ left)[:, 0, 0]
    )
    chance = np.exp(0.5 * (chance - chance.max()))
    chance /= chance.sum()
    mean = float(chance @ line[:, 0, 0])
    return mean, float(chance @ (spread[:, 0, 0] + (line[:, 0, 0] - mean) ** 2))


def err_together(off_px: Floats) -> bool:
    """Whether neighbours lie off alike."""
    return float(off_px[1:] @ off_px[:-1]) > _TOGETHER * float(off_px @ off_px)
