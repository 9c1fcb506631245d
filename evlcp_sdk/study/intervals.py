"""Confidence intervals of proportions and of root mean squares."""

import math

from scipy import stats

__all__ = ["proportion_interval", "rms_interval"]


def proportion_interval(hits: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Clopper and Pearson's exact interval of a proportion; (0, 1) without trials.

    >>> low, high = proportion_interval(0, 1000)
    >>> low, round(high, 5)
    (0.0, 0.00368)
    """
    if not trials:
        return 0.0, 1.0
    tail = (1 - confidence) / 2
    low = float(stats.beta.ppf(tail, hits, trials - hits + 1)) if hits else 0.0
    high = float(stats.beta.isf(tail, hits + 1, trials - hits)) if hits < trials else 1.0
    return low, high


def rms_interval(rms: float, count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of the root mean square of `count` independent normal errors (chi-square); NaN without any.

    >>> [round(v, 3) for v in rms_interval(0.1, 50)]
    [0.084, 0.124]
    """
    if not count:
        return math.nan, math.nan
    tail = (1 - confidence) / 2
    squares = count * rms**2
    return (
        math.sqrt(squares / float(stats.chi2.isf(tail, count))),
        math.sqrt(squares / float(stats.chi2.ppf(tail, count))),
    )
