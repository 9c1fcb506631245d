"""Loops over pixels and grid cells, compiled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk._kernels import correlate_code, pair_values
from evlcp_sdk.kernels import njit

Array = NDArray[Any]

_STEP_PX = 0.3
"""Prior sigma of the change of place from value to value: 1.5 px/ms for 0.2 ms."""

_PLACE_PX = 1.0
"""Prior sigma of the bar's distance from its place."""


@njit
def estimate_presence(
    sums: Array, codes: Array, grid: int, ratios: Array, none_ratios: Array, min_seen: int, out: Array
) -> None:
    """Posterior probability of each cluster in each cell, `out` (K, rows, columns), by the cell's values.

    Values are those of the cells' polarity sums, of `sums` (chips, height, width). A cluster whose fit is d
    below the best is `ratios[d]` times as likely as that, and no cluster `none_ratios[seen, best + n]` times.
    Cells with fewer than `min_seen` of n values are left as they are.
    """
    clusters, length = codes.shape
    _, height, width = sums.shape
    _, rows, columns = out.shape
    size, n = height * width, rows * columns
    flat, into = sums.reshape(len(sums), size), out.reshape(clusters, n)
    # Sums of the square of pixels that begins at each; where it leaves the image, there is no cell.
    square = np.empty((2, 2, size), np.int16)
    by_pixel, values = np.empty(size, np.int8), np.empty((length, n), np.int8)
    seen = np.empty(n, np.int16)
    for j in range(n):
        seen[j] = 0
    for i in range(length):
        for chip in range(2):
            part, most = flat[2 * i + chip], size
            for axis in range(2):
                total, step = square[axis, chip], 1 if axis else width
                most -= (grid - 1) * step
                for j in range(most):
                    total[j] = part[j]
                for away in range(step, grid * step, step):
                    other = part[away:]
                    for j in range(most):
                        total[j] = np.int16(total[j] + other[j])
                part = total
        pair_values(square[1, 0], square[1, 1], by_pixel)
        for r in range(rows):
            for c in range(columns):
                j = r * columns + c
                values[i, j] = by_pixel[(r * width + c) * grid]
                seen[j] = np.int16(seen[j] + abs(values[i, j]))
    # The cells with enough values, side by side.
    which, m = np.empty(n + 1, np.int64), 0
    for j in range(n):
        which[m] = j
        m += int(seen[j] >= min_seen)
    some, fits = np.empty((length, m), np.int8), np.empty((clusters, m), np.int16)
    for i in range(length):
        for j in range(m):
            some[i, j] = values[i, which[j]]
    # A literal 0 would compile the correlation once more.
    best, begin = np.empty(m, np.int16), n - n
    for j in range(m):
        best[j] = -length
    for k in range(clusters):
        correlate_code(codes[k], some, begin, fits[k])
        for j in range(m):
            best[j] = max(best[j], fits[k, j])
    norm = np.empty(m)
    for j in range(m):
        norm[j] = none_ratios[seen[which[j]], best[j] + length]
    for k in range(clusters):
        for j in range(m):
            norm[j] += ratios[np.uint32(best[j] - fits[k, j])]
    for k in range(clusters):
        for j in range(m):
            into[k, which[j]] = ratios[np.uint32(best[j] - fits[k, j])] / norm[j]


@njit
def map_pixels(
    sums: Array, codes: Array, grid: int, probability: Array, least: float, selected: Array, out: Array
) -> None:
    """Correlate pixels in each cluster's selected cells and their neighbours with its pilot, `out` 0 to 1.

    `selected` (K, rows, columns) takes which cells have a probability of `least` or more.
    """
    clusters, length = codes.shape
    _, rows, columns = selected.shape
    _, height, width = sums.shape
    flat = sums.reshape(len(sums), height * width)
    values, fit = np.empty((length, height * width), np.int8), np.empty(height * width, np.int16)
    for i in range(length):
        pair_values(flat[2 * i], flat[2 * i + 1], values[i])
    near = np.empty((rows, columns), np.bool_)
    for k in range(clusters):
        top, bottom = rows, 0
        for r in range(rows):
            some = False
            for c in range(columns):
                selected[k, r, c] = probability[k, r, c] >= least
                some |= selected[k, r, c]
            if some:
                top, bottom = min(top, max(r - 1, 0)), min(r + 2, rows)
        if top >= bottom:
            continue
        begin, end = top * grid * width, bottom * grid * width
        correlate_code(codes[k], values, begin, fit[: end - begin])
        near[top:bottom] = False
        for r in range(top, bottom):
            for c in range(columns):
                if selected[k, r, c]:
                    for a in range(max(r - 1, 0), min(r + 2, rows)):
                        for b in range(max(c - 1, 0), min(c + 2, columns)):
                            near[a, b] = True
        for r in range(top, bottom):
            for c in range(columns):
                if near[r, c]:
                    for v in range(r * grid, (r + 1) * grid):
                        for u in range(c * grid, (c + 1) * grid):
                            out[k, v, u] = max(fit[v * width + u - begin], 0) / length


@njit
def sum_values(sums: Array, probability: Array, grid: int, least: float, out: Array) -> None:
    """Sum the values of the info chips, weighted by presence, `out` (K, values).

    Cells less likely than `least` are left out.
    """
    clusters, rows, columns = probability.shape
    for k in range(clusters):
        for r in range(rows):
            for c in range(columns):
                weight = probability[k, r, c]
                if weight < least:
                    continue
                for i in range(out.shape[1]):
                    value = 0
                    for v in range(r * grid, (r + 1) * grid):
                        for u in range(c * grid, (c + 1) * grid):
                            first, second = sums[2 * i, v, u], sums[2 * i + 1, v, u]
                            value += np.sign(second if second else -first)
                    out[k, i] += weight * value


@njit
def match_words(values: Array, by_value: Array, bits: int) -> tuple[Array, Array, Array, float, float]:
    """Match clusters' values, float64 (K, n), with the nearest of the words, float64 (n, 2**bits or more).

    Returns:
        Their numbers, int64 (K,), and their correlations, float64 (K,); by how much words with a bit 0
        correlate better than those with 1, max-log, of the 2**bits first, float64 (K, bits); the share of the
        values' sizes that agrees with the words, 0 without any; and the least size of a margin.
    """
    clusters, length = values.shape
    symbols, best, margins = np.empty(clusters, np.int64), np.empty(clusters), np.empty((clusters, bits))
    size, agree, least = 0.0, 0.0, np.inf
    fit = np.empty(by_value.shape[1])
    for k in range(clusters):
        for s in range(fit.size):
            fit[s] = 0.0
        for i in range(length):
            for s in range(fit.size):
                fit[s] += values[k, i] * by_value[i, s]
        top = 0
        for s in range(fit.size):
            if fit[s] > fit[top]:
                top = s
        symbols[k], best[k] = top, fit[top]
        half = 1 << bits
        for b in range(bits):
            # A finished bit leaves the better of its two codewords.
            half //= 2
            zero, one = -np.inf, -np.inf
            for s in range(half):
                zero, one = max(zero, fit[s]), max(one, fit[s + half])
                fit[s] = max(fit[s], fit[s + half])
            margins[k, b] = zero - one
            least = min(least, abs(zero - one))
        for i in range(length):
            size += abs(values[k, i])
            if values[k, i] * by_value[i, top] > 0:
                agree += abs(values[k, i])
    return symbols, best, margins, agree / size if size > 0 else 0.0, least


@njit
def learn_pair_llr(
    sums: Array,
    most: int,
    signs: Array,
    probability: Array,
    grid: int,
    prior: float,
    pairs: Array,
    out: Array,
) -> None:
    """Learn the log ratio of how often each pair of sums comes with values of +1 and -1, `out` (pairs,).

    A pixel that more likely shows one cluster than any other, or none, counts for it by its `probability` (K,
    rows, columns), in cells of side `grid`. To each pair `prior` is added, on average of the two values, in
    proportion to their counts, so that a pair that comes with both alike has a ratio of 0. A pilot of one
    value throughout, as that of a lone cluster, does not show the other: that is taken to be the same with
    all signs changed.

    Sums, int16 (chips, height, width), are clipped to -most to most, 7 at most. `signs` are whether the
    pilots' values are +1, uint64 (K, values); `pairs` takes the pair of each value in each pixel, uint8
    (values, pixels).
    """
    clusters, known = signs.shape
    _, rows, columns = probability.shape
    width, size = sums.shape[2], pairs.shape[1]
    flat = sums.reshape(-1, size)
    low, high, side = np.int16(-most), np.int16(most), np.int16(2 * most + 1)
    for i in range(len(pairs)):
        for j in range(size):
            a = np.int16(min(max(flat[2 * i, j], low), high) - low)
            b = np.int16(min(max(flat[2 * i + 1, j], low), high) - low)
            pairs[i, j] = np.uint8(np.int16(a * side) + b)
    counts, total, added = np.zeros((2, out.size)), np.zeros(2), np.empty(2)
    for k in range(clusters):
        for r in range(rows):
            # Most rows of a bar show another cluster.
            some = False
            for c in range(columns):
                some |= probability[k, r, c] > 0.5
            for c in range(columns if some else 0):
                weight = probability[k, r, c]
                if weight <= 0.5:
                    continue
                for v in range(r * grid, (r + 1) * grid):
                    for u in range(c * grid, (c + 1) * grid):
                        for i in range(known):
                            counts[signs[k, i], pairs[i, v * width + u]] += weight
    for value in range(2):
        for pair in range(out.size):
            total[value] += counts[value, pair]
    for value in range(2):
        if total[value] == 0:
            for pair in range(out.size):
                counts[value, pair] = counts[1 - value, out.size - 1 - pair]
            total[value] = total[1 - value]
    for value in range(2):
        added[value] = prior * 2 * total[value] / (total[0] + total[1]) if total[0] > 0 else prior
    first, second = total[0] + added[0] * out.size, total[1] + added[1] * out.size
    for pair in range(out.size):
        out[pair] = np.log((counts[1, pair] + added[1]) / second * first / (counts[0, pair] + added[0]))


@njit
def sum_pair_llr(
    pairs: Array,
    width: int,
    signs: Array,
    probability: Array,
    grid: int,
    pair_llr: Array,
    limits: tuple[float, float],
    out: Array,
) -> None:
    """Sum the log ratios of each pixel's pairs of sums in the values after the pilots, weighted by presence.

    As in `learn_pair_llr`; `out` is (K, values). A pixel is weighted by how likely its pilot makes it that it
    shows the cluster, rather than what comes with both values alike. `limits` are the least probability of
    cells, and the odds against a pixel before its pilot.
    """
    least, odds = limits
    clusters, rows, columns = probability.shape
    length, known = out.shape[1], signs.shape[1]
    # Mean of a pair's likelihoods with a value of -1 and with +1, over that with -1, or with +1.
    unlike = np.empty((2, pair_llr.size))
    for pair in range(pair_llr.size):
        ratio = np.exp(min(max(pair_llr[pair], -50.0), 50.0))
        unlike[0, pair], unlike[1, pair] = (1 + ratio) / 2, (1 + 1 / ratio) / 2
    for k in range(clusters):
        for r in range(rows):
            for c in range(columns):
                weight = probability[k, r, c]
                if weight < least:
                    continue
                for v in range(r * grid, (r + 1) * grid):
                    for u in range(c * grid, (c + 1) * grid):
                        at, against = v * width + u, odds
                        for i in range(known):
                            against *= unlike[signs[k, i], pairs[i, at]]
                        shows = weight / (1 + against)
                        for i in range(length):
                            out[k, i] += shows * pair_llr[pairs[known + i, at]]


@njit
def match_shifts(
    pairs: Array, pair_llr: Array, share: float, maps: Array, prior: Array, grid: int, out: Array
) -> None:
    """Add the evidence of each cluster's pixels for values if the bar is off its place, (K, n, n, values).

    Shifts (down, right) go from -(n // 2) to n // 2 px. `pairs` and `pair_llr` are those of `learn_pair_llr`;
    a `share` of each counts, beyond that of a pixel without events. Pixels count where a cluster may be, by
    the prior of their cell: those of its neighbours are no evidence.
    """
    clusters, rows, columns = prior.shape
    _, height, width = maps.shape
    _, side, _, values = out.shape
    seam = side // 2
    evidence, part = pair_llr.astype(np.float32), np.float32(share)
    silent = evidence[pair_llr.size // 2]
    for pair in range(pair_llr.size):
        evidence[pair] = (evidence[pair] - silent) * part
    # Values lie side by side, and so do those of neighbouring pixels.
    run = side * values
    lines = np.zeros((height + 2 * seam, (width + 2 * seam) * values), np.float32)
    for v in range(height):
        line = lines[seam + v, seam * values :]
        for u in range(width):
            for i in range(values):
                line[u * values + i] = evidence[pairs[i, v * width + u]]
    sums = out.reshape(clusters, side, run)
    for k in range(clusters):
        for r in range(rows):
            for c in range(columns):
                if prior[k, r, c] <= 0:
                    continue
                for v in range(r * grid, (r + 1) * grid):
                    for u in range(c * grid, (c + 1) * grid):
                        weight = maps[k, v, u]
                        if weight > 0:
                            for a in range(side):
                                line = lines[v + a, u * values : u * values + run]
                                total = sums[k, a]
                                for i in range(run):
                                    total[i] += weight * line[i]


@njit
def find_path(matches: Array, known: Array) -> Array:
    """Find the shift (down, right) of the bar from its place in each value (Viterbi), int64 (values, 2), px.

    `matches` are (K, n, n, values), `known` the codes of the first values, (K, ...); of the others, each
    cluster's is the one that fits better. Costs are squares, which add, so the best predecessor is sought
    axis by axis.
    """
    clusters, side, _, values = matches.shape
    # Twice a log-likelihood.
    step_cost, place_cost = 1 / _STEP_PX**2, 1 / _PLACE_PX**2 / values
    first, half = known.shape[1], side // 2
    scores, steps = np.zeros((side, side, values)), np.empty((side, side))
    best, turned, top = np.empty((side, side)), np.empty((side, side)), np.empty(side)
    for a in range(side):
        for b in range(side):
            steps[a, b] = step_cost * ((a - b) * (a - b))
            for k in range(clusters):
                for i in range(first):
                    scores[a, b, i] += known[k, i] * matches[k, a, b, i]
                for i in range(first, values):
                    scores[a, b, i] += abs(matches[k, a, b, i])
            for i in range(values):
                scores[a, b, i] -= place_cost * ((a - half) * (a - half) + (b - half) * (b - half))
            best[a, b] = scores[a, b, 0]
    # From which row the best way comes to a row, in each column; then from which column to a column.
    ways = np.zeros((values, 2, side, side), np.int64)
    for i in range(1, values):
        for axis in range(2):
            for a in range(side):
                came = ways[i, axis, a]
                for b in range(side):
                    top[b] = best[0, b] - steps[a, 0]
                for c in range(1, side):
                    other, step = best[c], steps[a, c]
                    for b in range(side):
                        value = other[b] - step
                        came[b] = c if value > top[b] else came[b]
                        top[b] = max(top[b], value)
                for b in range(side):
                    turned[b, a] = top[b] + (scores[b, a, i] if axis else 0.0)
            best, turned = turned, best
    path = np.empty((values, 2), np.int64)
    a = b = 0
    for c in range(side):
        for d in range(side):
            if best[c, d] > best[a, b]:
                a, b = c, d
    for i in range(values - 1, -1, -1):
        path[i, 0], path[i, 1] = a - half, b - half
        b = ways[i, 1, b, a]
        a = ways[i, 0, a, b]
    return path
