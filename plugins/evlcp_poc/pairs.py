"""Which pairs of clusters are measured, and the mean of what they say."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Pairs = tuple[Indices, Indices, Floats]
"""First and second cluster, and their spacing, m."""


def far_pairs(pairs: Pairs, counts: NDArray[np.bool_], share: float) -> NDArray[np.bool_]:
    """Which pairs, both of whose clusters count, lie a share of the longest such spacing apart, or more."""
    first, second, apart_m = pairs
    both = counts[first] & counts[second]
    far: NDArray[np.bool_] = apart_m >= share * (apart_m * both).max(initial=0.0) - 1e-12
    return both & far


def choose_pairs(
    middles: Indices,
    every: Pairs,
    used: Indices,
    skip: int,
    pairs: Pairs,
    share: float,
    neighbour_m: float,
) -> tuple[float, Indices]:
    """The pairs to measure: of clusters that are seen, far apart, and where the scale of all has them.

    Args:
        middles: Of the maps of all clusters, int64 (K, 2), -1 of those not seen.
        every: All pairs of clusters.
        used: Clusters to use, rising.
        skip: How many of those that are seen are left out at each end.
        pairs: The pairs of clusters that may be used.
        share: Least spacing of a pair, as a share of the longest.
        neighbour_m: Spacing of neighbours, by how much a pair may be out of place.

    Returns:
        Scale, px a metre, the median over all pairs that are seen, 0 without any; numbers of those chosen.
    """
    lit = middles[:, 0] >= 0
    wide = far_pairs(every, lit, 0.5)
    if not wide.any():
        return 0.0, np.empty(0, np.int64)
    first, second, apart_m = every
    scale = _quantile(np.sort(_lengths(middles, first[wide], second[wide]) / apart_m[wide]), 0.5)
    seen = used[lit[used]]
    inner = np.zeros(len(lit), np.bool_)
    inner[seen[skip : max(len(seen) - skip, 0)]] = True
    first, second, apart_m = pairs
    off_px = np.abs(_lengths(middles, first, second) - scale * apart_m)
    return scale, np.flatnonzero(far_pairs(pairs, inner, share) & (off_px <= scale * neighbour_m))


def _lengths(middles: Indices, first: Indices, second: Indices) -> Floats:
    """Distances between middles, px."""
    down, right = (middles[second] - middles[first]).T
    found: Floats = np.hypot(down, right)
    return found


def _quantile(ordered: Floats, share: float) -> float:
    return float(np.interp(share * (len(ordered) - 1), np.arange(len(ordered)), ordered))


def robust_mean(
    values: Floats, weights: Floats, first: Indices, second: Indices, drop: int, iqr: float
) -> tuple[float, float, int]:
    """Weighted mean of pair values without extremes and outliers, and its delete-one-cluster jackknife sigma.

    Returns:
        (mean, sigma, values kept); sigma is NaN when fewer than two clusters can be left out.
    """
    order = np.argsort(values)
    if len(values) > 2 * drop + 1:
        order = order[drop : len(values) - drop]
    ordered = values[order]
    low, high = _quantile(ordered, 0.25), _quantile(ordered, 0.75)
    room = iqr * (high - low)
    inside = (ordered >= low - room) & (ordered <= high + room)
    if not inside.any():
        # Narrow bounds may call all of a few values outliers of one another: keep the middle half then.
        inside = (ordered >= 2 * low - high) & (ordered <= 2 * high - low)
    order = order[inside]
    mass, weighted = weights[order], weights[order] * values[order]
    sums = []
    for one in (mass, weighted):
        touched = np.concatenate([first[order], second[order]])
        sums.append(np.bincount(touched, np.concatenate([one, one])))
    total, whole = float(weighted.sum()), float(mass.sum())
    left = (sums[0] > 0) & (whole - sums[0] > 1e-9 * whole)
    without = (total - sums[1][left]) / (whole - sums[0][left])
    m = len(without)
    return total / whole, float(np.sqrt((m - 1) * without.var())) if m > 1 else np.nan, len(order)
