"""Counts events in time, and correlates them with a preamble: compiled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]


_STRIDE = 16
"""Events that are skipped at once in search of a bin's end: a bar has dozens in a bin of 10 us."""


@njit
def count_bins(t_us: Array, p: Array, where: tuple[int, float, int], known: Array, counts: Array) -> None:
    """Add events to `known` counts, by polarity (row) and time (column).

    `where` holds the number of the first column, the length of each, us, and how many known ones are before
    it.
    """
    first_bin, bin_us, skipped = where
    bins = counts.shape[1]
    before = min(known.shape[1] - skipped, bins)
    for row in range(2):
        for b in range(bins):
            counts[row, b] = known[row, skipped + b] if b < before else 0.0
    # Time never runs backward: no event is before the first bin, and each goes on where the last one ended.
    i, start = 0, max(int(t_us[0] / bin_us) - first_bin - 1, 0) if t_us.size else bins
    for b in range(start, bins):
        if i == t_us.size:
            break
        begin, end_us = i, int(np.ceil((first_bin + b + 1) * bin_us))
        while i + _STRIDE <= t_us.size and t_us[i + _STRIDE - 1] < end_us:
            i += _STRIDE
        while i < t_us.size and t_us[i] < end_us:
            i += 1
        # Narrow sums take many events at once.
        part, on = p[begin:i], np.uint32(0)
        for j in range(part.size):
            on = np.uint32(on + part[j])
        counts[0, b] += i - begin - on
        counts[1, b] += on


@njit
def correlate(counts: Array, chips: Array, due: Array, steps: int, min_events: int, rho: Array) -> None:
    """Normalised correlation of signed counts in windows of one chip (`steps` bins) with chips (-1, +1).

    The lesser of two norms: by the number of events, which is small unless all clusters blink in phase, and
    by the length of the vector of chips (a cosine), which is small where few chips hold all events, as in a
    flash. In chips that are not `due` (0, else 1), without an edge, late events agree with the chip and do
    not count; others count against it. Lags with fewer than `min_events` get 0.
    """
    many, lags = 0.0, rho.size
    bins = lags - 1 + steps * chips.size
    sums = np.empty((2, bins + 1))
    signed, total = sums[0], sums[1]
    signed[0], total[0] = 0.0, 0.0
    for b in range(bins):
        signed[b + 1] = signed[b] + counts[1, b] - counts[0, b]
        total[b + 1] = total[b] + counts[1, b] + counts[0, b]
    # Chip by chip for all lags side by side: sums of whole numbers are the same in any order.
    fits = np.zeros((2, lags))
    fit, power = fits[0], fits[1]
    for c in range(chips.size):
        begin, end = signed[steps * c :], signed[steps * (c + 1) :]
        sign, least = chips[c], np.inf if due[c] else 0.0
        many += due[c]
        for lag in range(lags):
            chip = end[lag] - begin[lag]
            fit[lag] += min(sign * chip, least)
            power[lag] += chip * chip
    for lag in range(lags):
        rho[lag] = 0.0
        seen = total[lag + steps * chips.size] - total[lag]
        if seen >= min_events and fit[lag] > 0:
            rho[lag] = min(fit[lag] / seen, fit[lag] / np.sqrt(many * power[lag]))


@njit
def find_peaks(
    rho: Array,
    counts: Array,
    span: int,
    lag: int,
    guard: int,
    past: tuple[float, int, int],
    enough: tuple[float, float],
    peaks: Array,
) -> tuple[float, int, int]:
    """Find lags from one on that correlate enough, and best within `guard` to both sides, first of equals.

    Enough is the second of `enough` in any case, and from half of it the first times the root of the mean
    square of the positive correlations up to each. The newest weigh most: `past` are mean square and number
    before the lag, and the most that count. The threshold is infinite as long as less than half as many are
    known. Where light ends, windows of `span` bins hold fewer events than those of the mean square, which is
    no less than that of as many events of random sign.

    Returns:
        Mean square and number at the end, and how many `peaks` (n,) there are among so many lags.
    """
    power, known, memory = past
    outstands, least = enough
    seen, many = 0.0, 0
    for b in range(lag, lag + span):
        seen += counts[0, b] + counts[1, b]
    for at in range(lag, lag + peaks.size):
        value = rho[at]
        if value > 0:
            known = min(known + 1, memory)
            power += (value**2 - power) / known
        square = max(power if 2 * known >= memory else np.inf, 1 / max(seen, 1.0))
        for kind in range(2):
            seen += counts[kind, at + span] - counts[kind, at]
        if value >= least / 2 and value >= min(outstands * np.sqrt(square), least):
            best = max(at - guard, 0)
            for near in range(best, min(at + guard + 1, rho.size)):
                best = near if rho[near] > rho[best] else best
            if best == at:
                peaks[many] = at
                many += 1
    return power, known, many
