"""Counting events in time, and the sliding correlation, compiled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]


_STRIDE = 16
"""Events that are passed over at once in search of a bin's end: a bar has dozens in a bin of 10 us."""


@njit
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


@njit
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


@njit
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


@njit
def raise_to_chance(counts: Array, span: int, first: int, squares: Array) -> None:
    """Raise mean squares of correlations, from a lag on, to that of as many events of random sign, 1 / n.

    Where light ends, windows of `span` bins hold fewer events than those that the mean squares are of.
    """
    seen = counts[:, first : first + span].sum()
    for i in range(squares.size):
        squares[i] = max(squares[i], 1 / max(seen, 1.0))
        if first + i + span < counts.shape[1]:
            for kind in range(2):
                seen += counts[kind, first + i + span] - counts[kind, first + i]


@njit
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
    `enough`, are wanted, which are no less than chance; `past` are `power`, `known` and `memory` of
    `mean_squares`. `rho` is for all lags.

    Returns:
        The largest correlation, and what `mean_squares` gives.
    """
    count_bins(t_us, p, bins[0], bins[1], known, counts)
    top = correlate(counts[:, : counts.shape[1] - 1], chips, due, steps, min_events, rho)
    power, many = mean_squares(rho[bins[2] : bins[3]], past[0], past[1], past[2], enough)
    raise_to_chance(counts, steps * chips.size, bins[2], enough)
    return top, power, many


@njit
def peaks(
    rho: Array, first: int, guard: int, enough: Array, outstands: float, least: float, found: Array
) -> int:
    """Lags from the first on that correlate enough, best within `guard` on both sides, `found`; how many.

    The first of equals. `enough` are the mean squares up to each; what is `outstands` times their root is
    enough, from half of `least`, and `least` is in any case.
    """
    n = 0
    for i in range(enough.size):
        lag = first + i
        if rho[lag] < least and not rho[lag] >= max(outstands * np.sqrt(enough[i]), least / 2):
            continue
        best = True
        for other in range(max(lag - guard, 0), lag):
            best &= rho[other] < rho[lag]
        for other in range(lag + 1, min(lag + guard + 1, rho.size)):
            best &= rho[other] <= rho[lag]
        if best:
            found[n] = lag
            n += 1
    return n


@njit
def refine(
    counts: Array, lag: int, chips: Array, steps: int, pair: int, rising: Array
) -> tuple[float, float, float, float, float, float]:
    """Times of a preamble found at a lag, in steps, and their variances by the jackknife.

    Where positive events fit best, and negative ones, NaN where none do; and where positive ones first reach
    half of their most, over what comes all the time, after the chips that are `rising`. `pair` chips, a pair
    of pair codes, are left out together to see how sure the first two are.
    """
    first, last = max(lag - steps, 0), min(lag + steps + 1, counts.shape[1] - steps * chips.size + 1)
    on, on_noise = _centre(counts[1], 1.0, first, last, chips, steps, pair)
    off, off_noise = _centre(counts[0], -1.0, first, last, chips, steps, pair)
    onset, onset_noise = _onset(counts[1], lag, steps, rising)
    return on, on_noise, off, off_noise, onset, onset_noise


@njit
def _centre(
    count: Array, sign: float, first: int, last: int, chips: Array, steps: int, pair: int
) -> tuple[float, float]:
    """Where counts fit chips best, of the lags from the first to before the last, and its variance."""
    lags, groups = last - first, chips.size // pair
    running = np.empty(lags + steps * chips.size)
    running[0] = 0.0
    for b in range(running.size - 1):
        running[b + 1] = running[b] + count[first + b]
    values, whole = np.zeros((groups, lags)), np.zeros(lags)
    for c in range(chips.size):
        begin, end, part = running[steps * c :], running[steps * (c + 1) :], values[c // pair]
        weight = sign * chips[c]
        for i in range(lags):
            value = weight * (end[i] - begin[i])
            part[i] += value
            whole[i] += value
    found, without = np.empty(groups), np.empty(lags)
    for g in range(groups):
        for i in range(lags):
            without[i] = whole[i] - values[g, i]
        found[g] = _middle(without)
    return first + _middle(whole), _jackknife(found)


@njit
def _middle(fit: Array) -> float:
    """Where a correlation is best; NaN where it is positive nowhere.

    The top is flat where a window holds all events of an edge: its middle is the best window.
    """
    top = fit[0]
    for i in range(1, fit.size):
        top = max(top, fit[i])
    if not top > 0:
        return np.nan
    total, at = 0.0, 0.0
    for i in range(fit.size):
        weight = max(fit[i] - 0.9 * top, 0.0)
        total += weight
        at += weight * i
    return at / total


@njit
def _onset(count: Array, lag: int, steps: int, rising: Array) -> tuple[float, float]:
    """Where counts first reach half of their most, averaged over chips that rise, and its variance."""
    edges, many = rising.size, 2 * steps
    response, whole = np.empty((edges, many)), np.zeros(many)
    for e in range(edges):
        for i in range(many):
            at = min(max(lag + steps * rising[e] + i - steps, 0), count.size - 1)
            response[e, i] = count[at]
            whole[i] += count[at]
    found, without = np.empty(edges), np.empty(many)
    for e in range(edges):
        for i in range(many):
            without[i] = whole[i] - response[e, i]
        found[e] = _reached(without)
    return lag - steps + _reached(whole), _jackknife(found)


@njit
def _reached(response: Array) -> float:
    """Where counts first reach half of their most, over what comes all the time: their lower quartile."""
    ordered = response.copy()
    for i in range(1, ordered.size):
        value, j = ordered[i], i
        while j > 0 and ordered[j - 1] > value:
            ordered[j] = ordered[j - 1]
            j -= 1
        ordered[j] = value
    half = (ordered[ordered.size // 4] + ordered[ordered.size - 1]) / 2
    k = 0
    while response[k] < half:
        k += 1
    below = response[k - 1] if k > 0 else 0.0
    return k - 0.5 + ((half - below) / (response[k] - below) if response[k] > below else 0.0)


@njit
def _jackknife(without: Array) -> float:
    """Variance of what was found of all, by what is found without each; those that say nothing left out."""
    n, mean, squares = 0, 0.0, 0.0
    for value in without:
        if np.isfinite(value):
            n += 1
            mean += value
    for value in without:
        if np.isfinite(value):
            squares += (value - mean / n) ** 2
    return (n - 1) * squares / n if n else 0.0
