"""Counting events in time, and the sliding correlation, compiled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]


_STRIDE = 16
"""Events that are passed over at once in search of a bin's end: a bar has dozens in a bin of 10 us."""


@njit(cache=True, nogil=True)
def count_bins(t_us: Array, p: Array, first_bin: int, bin_us: float, known: Array, counts: Array) -> None:
    """Add events to `known` counts: by polarity (row) and time (column, `bin_us` each from `first_bin`)."""
    bins = counts.shape[1]
    before = min(known.shape[1], bins)
    for row in range(2):
        for b in range(bins):
            counts[row, b] = known[row, b] if b < before else 0.0
    first_us = first_bin * bin_us
    i, after = 0, t_us.size
    while i < after:
        middle = (i + after) // 2
        if t_us[middle] < first_us:
            i = middle + 1
        else:
            after = middle
    # Time never runs backward, so each bin goes on where the last one ended.
    for b in range(bins):
        if i == t_us.size:
            break
        begin, end_us = i, int(np.ceil((first_bin + b + 1) * bin_us))
        while i + _STRIDE <= t_us.size and t_us[i + _STRIDE - 1] < end_us:
            i += _STRIDE
        while i < t_us.size and t_us[i] < end_us:
            i += 1
        on = 0
        for j in range(begin, i):
            on += p[j]
        counts[0, b] += i - begin - on
        counts[1, b] += on


@njit(cache=True, nogil=True)
def correlate(counts: Array, chips: Array, due: Array, steps: int, min_events: int, rho: Array) -> float:
    """Normalised correlation of signed counts in windows of one chip (`steps` bins) with chips (-1, +1).

    The lesser of two norms: by the number of events, which is small unless all clusters blink in phase, and
    by the length of the vector of chips (a cosine), which is small where few chips hold all events, as in
    a flash. In chips that are not `due`, without an edge, late events agree with the chip and say nothing;
    others count against it. Lags at which fewer than `min_events` were counted get 0. Returns the largest.
    """
    bins = counts.shape[1]
    top = 0.0
    many = due.sum()
    signed = np.empty(bins + 1)
    total = np.empty(bins + 1)
    signed[0] = 0.0
    total[0] = 0.0
    for b in range(bins):
        signed[b + 1] = signed[b] + counts[1, b] - counts[0, b]
        total[b + 1] = total[b] + counts[1, b] + counts[0, b]
    # Chip by chip for all lags side by side: sums of whole numbers are the same in any order.
    fit, power = np.zeros(rho.size), np.zeros(rho.size)
    for c in range(chips.size):
        begin, end = signed[steps * c :], signed[steps * (c + 1) :]
        sign, least = chips[c], np.inf if due[c] else 0.0
        for lag in range(rho.size):
            chip = end[lag] - begin[lag]
            fit[lag] += min(sign * chip, least)
            power[lag] += chip * chip
    for lag in range(rho.size):
        rho[lag] = 0.0
        seen = total[lag + steps * chips.size] - total[lag]
        if seen >= min_events and fit[lag] > 0:
            rho[lag] = min(fit[lag] / seen, fit[lag] / np.sqrt(many * power[lag]))
            top = max(top, rho[lag])
    return top


@njit(cache=True, nogil=True)
def mean_squares(rho: Array, power: float, known: int, memory: int, out: Array) -> tuple[float, int]:
    """Mean square of the positive correlations up to each, of which `known` came before; the last two.

    The newest `memory` of them weigh most. Infinite as long as less than half as many are known.
    """
    for lag in range(rho.size):
        if rho[lag] > 0:
            known = min(known + 1, memory)
            power += (rho[lag] ** 2 - power) / known
        out[lag] = power if 2 * known >= memory else np.inf
    return power, known


@njit(cache=True, nogil=True)
def listen(
    t_us: Array,
    p: Array,
    bins: tuple[int, float, int, int],
    known: Array,
    chips: Array,
    due: Array,
    steps: int,
    min_events: int,
    past: tuple[float, int, int],
    counts: Array,
    rho: Array,
    enough: Array,
) -> tuple[float, float, int]:
    """Count events, correlate all bins but the last, and follow the mean square of the correlations.

    `bins` are the number of the first, its length, us, and from which to before which lag the mean squares,
    `enough`, are wanted; `past` are `power`, `known` and `memory` of `mean_squares`. `rho` is for all lags.

    Returns:
        The largest correlation, and what `mean_squares` gives.
    """
    count_bins(t_us, p, bins[0], bins[1], known, counts)
    top = correlate(counts[:, : counts.shape[1] - 1], chips, due, steps, min_events, rho)
    power, many = mean_squares(rho[bins[2] : bins[3]], past[0], past[1], past[2], enough)
    return top, power, many
