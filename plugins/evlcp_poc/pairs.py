"""Which pairs of clusters are measured, and the mean of what they say."""

import math
from bisect import bisect_left, bisect_right

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


def seen_pairs(
    lit: NDArray[np.bool_], every: Pairs, used: Indices, skip: int, pairs: Pairs, share: float
) -> tuple[Pairs, Pairs]:
    """Pairs that show the scale of all clusters, and those to measure: of clusters that are seen, far apart.

    Args:
        lit: Which clusters are seen, bool (K,).
        every: All pairs of clusters.
        used: Clusters to use, rising.
        skip: How many of those that are seen are left out at each end.
        pairs: The pairs of clusters that may be used.
        share: Least spacing of a pair, as a share of the longest.
    """
    seen = used[lit[used]]
    inner = np.zeros(len(lit), np.bool_)
    inner[seen[skip : max(len(seen) - skip, 0)]] = True
    return taken(every, far_pairs(every, lit, 0.5)), taken(pairs, far_pairs(pairs, inner, share))


def pairs_in_place(
    middles: Indices, wide: Pairs, far: Pairs, neighbour_m: float
) -> tuple[float, Pairs, Indices]:
    """The scale of all clusters, px a metre, 0 where none shows it, and the pairs that lie where it has them.

    Args:
        middles: Of the maps of all clusters, int64 (K, 2).
        wide: Pairs whose median is the scale.
        far: Pairs to choose from.
        neighbour_m: Spacing of neighbours, by how much a pair may be out of place.

    Returns:
        Them, and what lies between the middles of each pair, int64 (pairs, 2).
    """
    between = middles[far[1]] - middles[far[0]]
    if not len(wide[0]):
        return 0.0, far, between
    lengths = np.hypot(*(middles[wide[1]] - middles[wide[0]]).T)
    scale = _quantile(np.sort(lengths / wide[2]).tolist(), 0.5)
    near = np.abs(np.hypot(*between.T) - scale * far[2]) <= scale * neighbour_m
    return (scale, far, between) if near.all() else (scale, taken(far, near), between[near])


def taken(pairs: Pairs, which: NDArray[np.bool_]) -> Pairs:
    """Some of the pairs."""
    first, second, apart_m = pairs
    return first[which], second[which], apart_m[which]


def _quantile(ordered: list[float], share: float) -> float:
    place = share * (len(ordered) - 1)
    below = int(place)
    above = min(below + 1, len(ordered) - 1)
    return (ordered[above] - ordered[below]) * (place - below) + ordered[below]


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
    ordered = values[order].tolist()
    low, high = _quantile(ordered, 0.25), _quantile(ordered, 0.75)
    room = iqr * (high - low)
    begin, end = bisect_left(ordered, low - room), bisect_right(ordered, high + room)
    if begin >= end:
        # Narrow bounds may call all of a few values outliers of one another: keep the middle half then.
        begin, end = bisect_left(ordered, 2 * low - high), bisect_right(ordered, 2 * high - low)
    order = order[begin:end]
    mass, touched = weights[order], np.concatenate([first[order], second[order]])
    weighted = mass * values[order]
    own, own_weighted = (np.bincount(touched, np.concatenate([one, one])) for one in (mass, weighted))
    total, whole = float(weighted.sum()), float(mass.sum())
    left = (own > 0) & (whole - own > 1e-9 * whole)
    without = (total - own_weighted[left]) / (whole - own[left])
    m = len(without)
    off = without - without.sum() / max(m, 1)
    sigma = math.sqrt((m - 1) * (float((off * off).sum()) / m)) if m > 1 else math.nan
    return total / whole, sigma, end - begin
