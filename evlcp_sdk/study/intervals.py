"""Figures of recordings with their confidence intervals.

Wrong bits come in bursts, and distance errors of neighbouring frames share the vibration of the same moment:
the errors of one recording do not stand for as many independent ones. Recordings do, and intervals resample
these.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from evlcp_sdk.study.tally import Ratio, Tally

FEWEST_RECORDINGS = 5
"""With fewer recordings than this there is no interval: what is known of the tails is guessed more than
measured. At five, nine of ten intervals hold the true value where rates differ by a factor of e."""

INTERVALS = (
    f"95 % intervals: bootstrap over recordings (seeds), from {FEWEST_RECORDINGS} on; of fewer their range,"
    " in round brackets. Without any error: an upper limit, as if frames were independent."
)
"""What a reader must know of the intervals of `measure`."""

_MOST_TAILS = 2.0
_RESAMPLES = 2000
_SEED = 20_251_020


@dataclass(frozen=True)
class Figure:
    """A measured figure with its interval; NaN where nothing was measured.

    Attributes:
        value: The figure.
        low: Lower end of the 95 % interval; of fewer than `FEWEST_RECORDINGS` recordings the smallest figure
            of one; NaN of a single one.
        high: The upper end of the same. Where there was not one error, an upper limit.
        count: Bits, distances or frames it was measured on.
        recordings: Recordings it was measured on.
    """

    value: float
    low: float
    high: float
    count: int
    recordings: int

    @property
    def none(self) -> bool:
        """There was something to count, and not one error in it."""
        return bool(self.count) and self.value == 0

    def interval(self, form: str) -> str:
        """The interval as text: [low, high]; (low, high) for a range of few recordings; nothing without any.

        >>> Figure(0.5, 0.4, 0.7, 100, 8).interval(".1f")
        '[0.4, 0.7]'
        """
        if math.isnan(self.high):
            return ""
        first, last = "[]" if self.recordings >= FEWEST_RECORDINGS or self.none else "()"
        return f"{first}{self.low:{form}}, {self.high:{form}}{last}"


def number_text(value: float, form: str) -> str:
    """A number as text; `-` for NaN."""
    return "-" if math.isnan(value) else format(value, form)


def measure(recordings: Sequence[Tally], kind: str) -> Figure:
    """A figure of independent recordings, by its name in `Tally`.

    >>> round(measure([Tally(frames_found=10, bits=1000)] * 10, "ber").high, 4)
    0.0362
    """
    ratio: Ratio = getattr(Tally, kind)
    share = not ratio.root
    some = [tally for tally in recordings if getattr(tally, ratio.below)]
    parts, wholes = ([getattr(tally, name) for tally in some] for name in (ratio.above, ratio.below))
    part, whole = sum(parts), sum(wholes)
    if not whole:
        return Figure(math.nan, math.nan, math.nan, 0, 0)
    if share and part in (0, whole):
        # SciPy's statistics take half a second to load.
        from scipy.stats import binomtest

        trials = sum(getattr(tally, ratio.of or ratio.below) for tally in some)
        low, high = binomtest(trials if part else 0, trials).proportion_ci() if trials else (0.0, 1.0)
    elif len(some) == 1:
        low = high = math.nan
    elif len(some) < FEWEST_RECORDINGS:
        each = [a / b for a, b in zip(parts, wholes, strict=True)]
        low, high = min(each), max(each)
    elif share and 2 * part > whole:
        # Of the rarer of both, whose logarithm shows more.
        low, high = (1 - v for v in ratio_interval(np.subtract(wholes, parts), wholes)[::-1])
    else:
        low, high = ratio_interval(parts, wholes)
        high = min(high, 1.0) if share else high
    value, low, high = map(ratio.value, (part / whole, low, high))
    return Figure(value, low, high, whole, len(some))


def ratio_interval(
    parts: Sequence[int] | NDArray[np.int64],
    wholes: Sequence[int] | NDArray[np.int64],
    confidence: float = 0.95,
) -> tuple[float, float]:
    """Interval of sum(parts) / sum(wholes) over independent recordings: studentized bootstrap of its log.

    Recordings are drawn with replacement; each draw's deviation from the ratio is measured in its own
    standard error, which follows from how much its recordings differ (SciPy's bootstraps do not, and of five
    recordings hold the true ratio in 7 of 10 cases). Of few recordings the draws know the tails too little:
    their quantiles are not taken for less than those of Student's t, nor for more than twice these, as draws
    of nearly equal recordings have errors near 0.
    """
    above, below = np.array(parts, np.float64), np.array(wholes, np.float64)
    n = len(above)
    rng = np.random.default_rng(_SEED)
    weights = np.vstack([np.ones(n), rng.multinomial(n, np.full(n, 1 / n), _RESAMPLES)])
    ratio = (weights @ above) / (weights @ below)
    squares = weights @ above**2 - 2 * ratio * (weights @ (above * below)) + ratio**2 * (weights @ below**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Standard error of the ratio's logarithm.
        error = np.sqrt(np.maximum(squares, 0) * n / (n - 1)) / (weights @ above)
        away = np.log(ratio[1:] / ratio[0]) / error[1:]
    away = away[np.isfinite(away)]
    tail = (1 - confidence) / 2
    least = -float(special.stdtrit(n - 1, tail))
    ends = np.quantile(away, [1 - tail, tail]) if len(away) else (0.0, 0.0)
    down, up = (min(max(end, least), _MOST_TAILS * least) for end in (float(ends[0]), -float(ends[1])))
    return float(ratio[0] * math.exp(-down * error[0])), float(ratio[0] * math.exp(up * error[0]))
