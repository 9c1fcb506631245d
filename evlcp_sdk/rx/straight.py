"""Boundaries between clusters that no straight bar explains: drops, dead LEDs, and what is in the way."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.values import Bend

Floats = NDArray[np.float64]

_ROUGH_PX = 0.125
"""How much a frame's boundaries scatter by noise at the most (sigma): in recordings .03 to .06 px, and .12
where pixels are blind for long or miss most events."""

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

_SMOOTH = 3.0
"""Square of what a bend adds to a scale, in that of what it leaves beside it. Of one to three drops on and
beside a bar, a tenth to half of it wide, it is 0.7 to 2.4, by their width; the more of a bar one drop covers,
the more."""

_MEMORY_S = 0.3
"""Time in which a drop runs on by its width: for a moment it may bend nothing, and add to the scale."""

_WIDE = 1.5
"""Sigma of the errors of boundaries that are off, in that of what all leave about a line through all."""

_DOUBT = 0.5
"""Of the sigma of a line through all boundaries, which is added where most agree: those may be wrong. Without
it, the mean of (error / sigma)^2 is 1.1 to 1.6 where half of them are off."""

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
        whole: The sigma where what bends it bends it as a whole, else 0.
        bent: That of two frames in a row, the less the longer ago.
        t_s: When it was, s.
    """

    longer: float = 0.0
    sigma: float = 0.0
    bent_px: Floats | None = None
    whole: float = 0.0
    bent: float = 0.0
    t_s: float = -math.inf


STRAIGHT = Image()


def judge_image(
    bend: Bend,
    off: Floats,
    sums: Floats,
    scatter: tuple[float, float, float, float, float],
    before: Image,
    t_s: float,
) -> Image:
    """Judge a frame by its boundaries, or, where these scatter no more than any, by the mean of many frames.

    Args:
        bend: Of the frame.
        off: How far its boundaries lie off beyond the lean that is known, float64 (n,), NaN where unseen.
        sums: Their weights over the frames of the last second, and what lies off, weighted, (2 or more, n).
        scatter: Of these, as of `_kernels.wave_of`.
        before: The frame before.
        t_s: When it is, s.
    """
    px, (squares, of_means, of_waves, moved, frames) = bend.one_px, scatter
    if not px > 0:
        return STRAIGHT
    # What two frames differ by has twice the variance, whose median this is.
    noise_px = _ROUGH_PX if math.isnan(moved) else 1.4826 / math.sqrt(2) * moved * px
    found, left_out = None, bend.off * (bend.weight == 0)
    # Most frames are well below what is asked of one.
    if squares * px**2 > max(noise_px, _ROUGH_PX) ** 2 * len(off):
        found = _straight(bend, off, max(noise_px, _ROUGH_PX))
    # Where the image stands still, so does the pixels' wave.
    wave_px = WAVE_PX * px * math.sqrt(of_waves / len(off))
    noise_px = math.hypot(_STANDING_PX, noise_px * math.sqrt(ALIKE / frames), wave_px)
    if found is None and of_means * px**2 > noise_px**2 * len(off):
        found = _straight(bend, np.where(off == off, sums[1] / np.maximum(sums[0], 1e-300), np.nan), noise_px)
    bent = before.bent and before.bent * math.exp((before.t_s - t_s) / _MEMORY_S)
    bent_px = np.where(left_out != 0, left_out, off) * px if found or left_out.any() else None
    if found is None:
        return Image(0.0, bent, bent_px, 0.0, bent, t_s) if bent or bent_px is not None else STRAIGHT
    assert bent_px is not None
    bent_px[off == off] = found.rest_px
    sigma = math.sqrt(found.variance) / bend.spacing_px
    whole = sigma if found.together else 0.0
    bent = max(bent, min(whole, before.whole))
    return Image(found.slope / bend.spacing_px, max(sigma, bent), bent_px, whole, bent, t_s)


def _straight(bend: Bend, off: Floats, noise_px: float) -> Straight | None:
    seen = off == off
    return straighten(bend.place[seen], off[seen] * bend.one_px, noise_px, _STEEPEST * bend.one_px)


def straighten(place: Floats, off_px: Floats, noise_px: float, steepest_px: float) -> Straight | None:
    """The straight bar that most boundaries agree on, None where noise explains what they lie off a scale.

    What bends an image smoothly, a drop, moves neighbours alike, and all of them: what it adds to the scale
    cannot be seen, and is about as large as what it leaves. What moves single boundaries, LEDs that are dark
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
    if squares <= noise_px**2 * (n - 2 + _SIGMAS * math.sqrt(2 * (n - 2))):
        return None
    if err_together(rest):
        return Straight(0.0, _SMOOTH * squares / float(at @ at), rest, together=True)
    one, other = np.triu_indices(n, 1)
    slope = (rest[other] - rest[one]) / (at[other] - at[one])
    left = rest - (rest[one] - slope * at[one])[:, None] - slope[:, None] * at
    wide_px = max(_WIDE * math.sqrt(squares / (n - 2)), 2 * noise_px)
    likely = sum(np.exp(-0.5 * (left / px) ** 2) / px for px in (noise_px, wide_px))
    chance = np.log(np.maximum(likely, 1e-300)).sum(1)
    chance = np.exp(chance - chance.max())
    chance /= chance.sum()
    mean = float(chance @ slope)
    variance = float(chance @ (slope - mean) ** 2) + _DOUBT**2 * squares / (n - 2) / float(at @ at)
    return Straight(float(line[0]) + mean, variance, chance @ left, together=False)


def err_together(off_px: Floats) -> bool:
    """Whether neighbours lie off alike."""
    return float(off_px[1:] @ off_px[:-1]) > _TOGETHER * float(off_px @ off_px)
