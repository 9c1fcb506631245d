"""Figures of recordings with their confidence intervals.

Wrong bits come in bursts, and distance errors of neighbouring frames share the vibration of the same moment,
so that errors within a recording are not independent. Recordings are, and intervals resample these.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from evlcp_sdk.study.tally import Ratio, Tally

FEWEST_RECORDINGS = 5
"""With fewer recordings there is no interval: their tails are guessed more than measured. With five, nine of
ten intervals hold the true value where rates differ by a factor of e."""

INTERVALS = (
    f"95 % intervals: bootstrap over recordings (seeds), from {FEWEST_RECORDINGS} on; of fewer their range,"
    " in round brackets. Without any error: an upper limit, as if frames were independent."
)
"""Note on the intervals of `measure_figure`, for readers."""

_MAX_TAILS = 2.0
_RESAMPLES = 2000
_SEED = 20_251_020


@dataclass(frozen=True)
class Figure:
    """A measured figure with its interval; NaN where nothing was measured.

    Attributes:
        value: The figure.
        low: Lower end of the 95 % interval; with fewer than `FEWEST_RECORDINGS` recordings the smallest
            figure of one; NaN with a single one.
        high: The upper end of the same. Without a single error, an upper limit.
        count: Bits, distances or frames it was measured on.
        recordings: Recordings it was measured on.
    """

    value: float
    low: float
    high: float
    count: int
    recordings: int

    @property
    def is_zero(self) -> bool:
        """Whether something was counted, without a single error."""
        return bool(self.count) and self.value == 0

    def interval(self, form: str) -> str:
        """Format the interval: [low, high]; (low, high) for a range of few recordings; empty without any.

        >>> Figure(0.5, 0.4, 0.7, 100, 8).interval(".1f")
        '[0.4, 0.7]'
        """
        if math.isnan(self.high):
            return ""
        first, last = "[]" if self.recordings >= FEWEST_RECORDINGS or self.is_zero else "()"
        return f"{first}{self.low:{form}}, {self.high:{form}}{last}"


def format_number(value: float, form: str) -> str:
    """Format a number; `-` for NaN."""
    return "-" if math.isnan(value) else format(value, form)


def measure_figure(recordings: Sequence[Tally], kind: str) -> Figure:
    """Measure a figure of independent recordings, by its name in `Tally`.

    >>> round(measure_figure([Tally(frames_found=10, bits=1000)] * 10, "ber").high, 4)
    0.0362
    """
    ratio: Ratio = getattr(Tally, kind)
    is_share = not ratio.root
    tallies = [tally for tally in recordings if getattr(tally, ratio.denominator)]
    parts = [getattr(tally, ratio.numerator) for tally in tallies]
    wholes = [getattr(tally, ratio.denominator) for tally in tallies]
    part, whole = sum(parts), sum(wholes)
    if not whole:
        return Figure(math.nan, math.nan, math.nan, 0, 0)
    if is_share and part in (0, whole):
        # SciPy's statistics take half a second to load.
        from scipy.stats import binomtest

        trials = sum(getattr(tally, ratio.independent or ratio.denominator) for tally in tallies)
        low, high = binomtest(trials if part else 0, trials).proportion_ci() if trials else (0.0, 1.0)
    elif len(tallies) == 1:
        low = high = math.nan
    elif len(tallies) < FEWEST_RECORDINGS:
        ratios = [a / b for a, b in zip(parts, wholes, strict=True)]
        low, high = min(ratios), max(ratios)
    elif is_share and 2 * part > whole:
        # The interval is of the rarer event, whose logarithm varies more.
        low, high = (1 - v for v in ratio_interval(np.subtract(wholes, parts), wholes)[::-1])
    else:
        low, high = ratio_interval(parts, wholes)
        high = min(high, 1.0) if is_share else high
    value, low, high = map(ratio.scale_ratio, (part / whole, low, high))
    return Figure(value, low, high, whole, len(tallies))


def ratio_interval(
    parts: Sequence[int] | NDArray[np.int64],
    wholes: Sequence[int] | NDArray[np.int64],
    confidence: float = 0.95,
) -> tuple[float, float]:
    """Interval of sum(parts) / sum(wholes) over independent recordings: studentized bootstrap of its log.

    Recordings are drawn with replacement; each draw's deviation from the ratio is measured in its own
    standard error, from the differences of its recordings (SciPy's bootstraps do not do so, and with five
    recordings hold the true ratio in 7 of 10 cases). With few recordings the draws show the tails too little:
    their quantiles are at least those of Student's t, and at most twice these, as draws of nearly equal
    recordings have errors near 0.
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
        deviations = np.log(ratio[1:] / ratio[0]) / error[1:]
    deviations = deviations[np.isfinite(deviations)]
    tail = (1 - confidence) / 2
    least = -float(special.stdtrit(n - 1, tail))
    quantiles = np.quantile(deviations, [1 - tail, tail]) if len(deviations) else (0.0, 0.0)
    down, up = (
        min(max(end, least), _MAX_TAILS * least) for end in (float(quantiles[0]), -float(quantiles[1]))
    )
    return float(ratio[0] * math.exp(-down * error[0])), float(ratio[0] * math.exp(up * error[0]))
