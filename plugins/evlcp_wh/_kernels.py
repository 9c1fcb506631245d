"""Loops over pixels and grid cells, compiled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]


@njit
def _add(into: Array, part: Array) -> None:
    """Long loops over flat arrays run on many pixels at once; those over a bar's few columns do not."""
    for j in range(into.size):
        into[j] = np.int16(into[j] + part[j])


@njit
def _values(first: Array, second: Array, out: Array) -> None:
    """Values of pairs of polarity sums, `out` int8 (n,): the second's sign, else less the first's."""
    for j in range(out.size):
        a, b = first[j], second[j]
        up = np.int8(b > 0) - np.int8(b < 0)
        down = np.int8(a < 0) - np.int8(a > 0)
        out[j] = up + down * np.int8(b == 0)


@njit
def _fit(code: Array, values: Array, out: Array) -> None:
    """How far values (n, many) agree with a code (n,), `out` int16 (many,): those alike less those unlike."""
    out[:] = 0
    for i in range(code.size):
        value = values[i]
        if code[i] > 0:
            for j in range(out.size):
                out[j] = np.int16(out[j] + value[j])
        else:
            for j in range(out.size):
                out[j] = np.int16(out[j] - value[j])


@njit
def _cell_values(sums: Array, grid: int, rows: int, columns: int, out: Array) -> None:
    """Values of the cells' polarity sums, `out` int8 (values, rows * columns)."""
    chips, height, width = sums.shape
    flat = sums.reshape(chips, height * width)
    # Sums of the square of pixels that begins at each; where it leaves the image, there is no cell.
    most = max(height * width - (grid - 1) * (width + 1), 0)
    squares, values = np.empty((2, height * width), np.int16), np.empty(height * width, np.int8)
    for i in range(len(out)):
        squares[:] = 0
        for chip in range(2):
            for down in range(grid):
                for right in range(grid):
                    begin = down * width + right
                    _add(squares[chip, :most], flat[2 * i + chip, begin : begin + most])
        _values(squares[0], squares[1], values)
        value = out[i]
        for r in range(rows):
            line = values[r * grid * width :]
            for c in range(columns):
                value[r * columns + c] = line[c * grid]


@njit
def _raise_to(most: Array, fit: Array) -> None:
    for j in range(most.size):
        most[j] = max(most[j], fit[j])


@njit
def _add_odds(most: Array, fit: Array, beside: Array, out: Array) -> None:
    for j in range(out.size):
        out[j] += beside[np.uint32(most[j] - fit[j])]


@njit
def _share(most: Array, fit: Array, beside: Array, norm: Array, out: Array) -> None:
    for j in range(out.size):
        out[j] = beside[np.uint32(most[j] - fit[j])] / norm[j]


@njit
def presence(
    sums: Array, codes: Array, grid: int, agree: float, disagree: float, min_seen: int, out: Array
) -> None:
    """Posterior probability of each cluster in each cell, `out` (K, rows, columns), against `no cluster`.

    `agree` and `disagree` are the log-likelihood ratios of one value that fits a code or not.
    """
    clusters, length = codes.shape
    _, rows, columns = out.shape
    n = rows * columns
    values = np.empty((length, n), np.int8)
    _cell_values(np.ascontiguousarray(sums[: 2 * length]), grid, rows, columns, values)
    seen = np.zeros(n, np.int64)
    for i in range(length):
        for j in range(n):
            seen[j] += abs(values[i, j])
    # The cells in which enough is seen, side by side.
    which = np.empty(n + 1, np.int64)
    m = 0
    for j in range(n):
        which[m] = j
        m += int(seen[j] >= min_seen)
    some = np.empty((length, m), np.int8)
    for i in range(length):
        for j in range(m):
            some[i, j] = values[i, which[j]]
    fits, most = np.empty((clusters, m), np.int16), np.full(m, -length, np.int16)
    for k in range(clusters):
        _fit(codes[k], some, fits[k])
        _raise_to(most, fits[k])
    # A cluster whose fit is d below the best is `beside[d]` times as likely.
    beside = np.exp(np.arange(2 * length + 1) * (disagree - agree) / 2)
    none = np.empty((length + 1, 2 * length + 1))
    for s in range(length + 1):
        for best in range(-length, length + 1):
            none[s, best + length] = clusters * np.exp(-(agree * (s + best) + disagree * (s - best)) / 2)
    norm, share = np.empty(m), np.empty(m, out.dtype)
    for j in range(m):
        norm[j] = none[seen[which[j]], most[j] + length]
    for k in range(clusters):
        _add_odds(most, fits[k], beside, norm)
    by_cell = out.reshape(clusters, n)
    for k in range(clusters):
        _share(most, fits[k], beside, norm, share)
        for j in range(m):
            by_cell[k, which[j]] = share[j]


@njit
def pixel_maps(sums: Array, codes: Array, grid: int, selected: Array, out: Array) -> None:
    """Pilot correlation of the pixels in each cluster's selected cells and their neighbours, 0 to 1."""
    clusters, length = codes.shape
    _, rows, columns = selected.shape
    _, height, width = sums.shape
    flat = np.ascontiguousarray(sums[: 2 * length]).reshape(2 * length, height * width)
    values = np.empty((length, height * width), np.int8)
    for i in range(length):
        _values(flat[2 * i], flat[2 * i + 1], values[i])
    fit = np.empty(height * width, np.int16)
    near = np.empty((rows, columns), np.bool_)
    for k in range(clusters):
        top, bottom = rows, 0
        for r in range(rows):
            if np.any(selected[k, r]):
                top, bottom = min(top, max(r - 1, 0)), min(r + 2, rows)
        if top >= bottom:
            continue
        begin, end = top * grid * width, bottom * grid * width
        _fit(codes[k], values[:, begin:end], fit[: end - begin])
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
                        line = fit[v * width - begin :]
                        for u in range(c * grid, (c + 1) * grid):
                            out[k, v, u] = max(line[u], 0) / length


@njit
def separated(
    sums: Array,
    codes: Array,
    grid: int,
    odds: tuple[float, float, int],
    least: float,
    probability: Array,
    selected: Array,
    pixels: Array,
) -> None:
    """`presence` by (agree, disagree, min_seen), what is `least` or more of it, and `pixel_maps` of that."""
    presence(sums, codes, grid, odds[0], odds[1], odds[2], probability)
    heard, chosen, enough = probability.reshape(-1), selected.reshape(-1), probability.dtype.type(least)
    for j in range(heard.size):
        chosen[j] = heard[j] >= enough
    pixel_maps(sums, codes, grid, selected, pixels)


@njit
def weighted_values(sums: Array, probability: Array, grid: int, least: float, out: Array) -> None:
    """Presence-weighted sum of the values of the info chips, `out` (K, values)."""
    clusters, rows, columns = probability.shape
    length = out.shape[1]
    _, height, width = sums.shape
    # Of all pixels at once, as they lie in memory; and so what is most of a cell.
    flat = np.ascontiguousarray(sums[: 2 * length]).reshape(2 * length, height * width)
    by_pixel = np.empty((length, height * width), np.int8)
    for i in range(length):
        _values(flat[2 * i], flat[2 * i + 1], by_pixel[i])
    by_cell = np.ascontiguousarray(probability).reshape(clusters, rows * columns)
    top = np.zeros(rows * columns, probability.dtype)
    for k in range(clusters):
        _raise_to(top, by_cell[k])
    values = np.empty(length, np.int64)
    for r in range(rows):
        for c in range(columns):
            cell = r * columns + c
            if top[cell] < least:
                continue
            values[:] = 0
            for i in range(length):
                value = by_pixel[i]
                for v in range(r * grid, (r + 1) * grid):
                    for u in range(c * grid, (c + 1) * grid):
                        values[i] += value[v * width + u]
            for k in range(clusters):
                weight = by_cell[k, cell]
                if weight >= least:
                    for i in range(length):
                        out[k, i] += weight * values[i]


@njit
def _fit_words(values: Array, by_value: Array, fit: Array) -> None:
    """Correlation of values (n,) with every word, `by_value` (n, words), `fit` (words,)."""
    fit[:] = 0.0
    for i in range(values.size):
        value, column = values[i], by_value[i]
        for s in range(fit.size):
            fit[s] += value * column[s]


@njit
def _max_log(fit: Array, scale: float, llr: Array) -> None:
    """Best correlation of the words with each bit 0, less that with 1, times `scale`; `fit` is used up.

    Words beyond the 2^bits first carry no bits.
    """
    half = 2**llr.size
    for b in range(llr.size):
        # A bit that is done leaves the better of the two codewords that it tells apart.
        half //= 2
        zero, one = -np.inf, -np.inf
        for s in range(half):
            zero = max(zero, fit[s])
            one = max(one, fit[s + half])
            fit[s] = max(fit[s], fit[s + half])
        llr[b] = (zero - one) * scale


@njit
def transformed(
    sums: Array, probability: Array, grid: int, least: float, by_value: Array, symbols: Array, llr: Array
) -> float:
    """Words nearest to the `weighted_values` of a frame, `symbols` (K,), and max-log LLRs, `llr` (K, bits).

    All clusters of a frame have one amplitude, the mean, and one noise: eight values are too few for one
    each. A dim cluster, whose correlations are small beside them, is unsure. `by_value` are the words
    (n, words).

    Returns:
        Share of the energy that the words explain; 0 without any.
    """
    length, count = by_value.shape
    clusters = len(probability)
    values = np.zeros((clusters, length))
    weighted_values(sums, probability, grid, least, values)
    fit = np.empty((clusters, count))
    energy, explained, amplitude = 0.0, 0.0, 0.0
    for k in range(clusters):
        _fit_words(values[k], by_value, fit[k])
        best = int(np.argmax(fit[k]))
        symbols[k] = best
        amplitude += fit[k, best] / length / clusters
        explained += fit[k, best] ** 2 / length
        for i in range(length):
            energy += values[k, i] ** 2
    rest = max(energy - explained, 1e-3 * energy, 1e-9)
    scale = max(amplitude, 0.0) * values.size / rest
    for k in range(clusters):
        _max_log(fit[k], scale, llr[k])
    return explained / energy if energy > 0 else 0.0


@njit
def count_pairs(sums: Array, codes: Array, probability: Array, grid: int, most: int, counts: Array) -> None:
    """Histograms of a value's two polarity sums where the value is known, `counts` (value, first, second).

    A pixel that rather shows one cluster than any other, or none, counts for it by its probability.
    """
    clusters, length = codes.shape
    _, rows, columns = probability.shape
    width = sums.shape[2]
    pairs, by_pair = _pairs_of(sums, most, length), counts.reshape(2, -1)
    for k in range(clusters):
        for r in range(rows):
            shown = probability[k, r]
            # Most rows of a bar show another cluster.
            if not _some_above(shown, 0.5):
                continue
            for c in range(columns):
                weight = shown[c]
                if weight <= 0.5:
                    continue
                for v in range(r * grid, (r + 1) * grid):
                    for u in range(c * grid, (c + 1) * grid):
                        for i in range(length):
                            by_pair[(codes[k, i] + 1) // 2, pairs[i, v * width + u]] += weight


@njit
def _pairs_of(sums: Array, most: int, values: int) -> Array:
    """Which pair of sums, clipped to -most to most, each value has in each pixel, uint16 (values, pixels)."""
    chips, height, width = sums.shape
    flat = np.ascontiguousarray(sums).reshape(chips, height * width)
    least, greatest, side = np.int16(-most), np.int16(most), np.int16(2 * most + 1)
    out = np.empty((values, height * width), np.uint16)
    for i in range(values):
        _pair_up(flat[2 * i], flat[2 * i + 1], least, greatest, side, out[i])
    return out


@njit
def _pair_up(
    first: Array, second: Array, least: np.int16, most: np.int16, side: np.int16, out: Array
) -> None:
    for j in range(out.size):
        a = np.int16(min(max(first[j], least), most) - least)
        b = np.int16(min(max(second[j], least), most) - least)
        out[j] = np.uint16(np.int16(a * side) + b)


@njit
def _some_above(values: Array, least: float) -> bool:
    some = False
    for j in range(values.size):
        some |= values[j] > least
    return some


@njit
def log_ratio(counts: Array, prior: float, out: Array) -> None:
    """Log ratio of the second histogram's shares over the first's, `counts` (2, n, m), `prior` in each more.

    That is on average of the two: to each as it has counts, so that what comes with both alike is worth 0.
    """
    first, second = counts[0].sum(), counts[1].sum()
    less, more = prior, prior
    if first > 0 and second > 0:
        less, more = prior * 2 * first / (first + second), prior * 2 * second / (first + second)
    n, m = out.shape
    first += less * n * m
    second += more * n * m
    for a in range(n):
        for b in range(m):
            out[a, b] = np.log((counts[1, a, b] + more) / second * first / (counts[0, a, b] + less))


@njit
def read_words(values: Array, words: Array, scale: float, symbols: Array, llr: Array) -> float:
    """Likeliest codeword of each cluster's values (K, n), `symbols` (K,), and max-log LLRs, `llr` (K, bits).

    `words` are (2^bits or more, n); `scale` is that of their product with the values.

    Returns:
        Share of the values' sizes that agrees with the codewords; 0 without any.
    """
    clusters, length = values.shape
    by_value, fit = np.ascontiguousarray(words.T), np.empty(len(words))
    size, agree = 0.0, 0.0
    for k in range(clusters):
        _fit_words(values[k], by_value, fit)
        best = int(np.argmax(fit))
        symbols[k] = best
        _max_log(fit, scale, llr[k])
        for i in range(length):
            size += abs(values[k, i])
            if values[k, i] * words[best, i] > 0:
                agree += abs(values[k, i])
    return agree / size if size > 0 else 0.0


@njit
def sum_worth(
    sums: Array,
    codes: Array,
    probability: Array,
    grid: int,
    least: float,
    most: int,
    worth: Array,
    odds: float,
    out: Array,
) -> None:
    """Presence-weighted sum of what each pixel's pair of sums is worth in the values after the pilots.

    `sums` begin with those of the pilots, `codes` (K, values); `out` is (K, values). A pixel counts by how
    likely its pilot makes it that it shows the cluster, not what comes with both values alike; before that,
    `odds` are against it.
    """
    clusters, rows, columns = probability.shape
    length, known = out.shape[1], codes.shape[1]
    top = np.zeros((rows, columns), probability.dtype)
    for k in range(clusters):
        _raise_to(top.reshape(-1), np.ascontiguousarray(probability[k]).reshape(-1))
    # Mean of a pair's likelihoods with a value of -1 and with +1, over that with -1, or with +1.
    side = 2 * most + 1
    unlike = np.empty((2, side * side))
    for a in range(side):
        for b in range(side):
            ratio = np.exp(min(max(worth[a, b], -50.0), 50.0))
            unlike[0, a * side + b] = (1 + ratio) / 2
            unlike[1, a * side + b] = (1 + 1 / ratio) / 2
    signs = np.empty((clusters, known), np.uint64)
    for k in range(clusters):
        for i in range(known):
            signs[k, i] = (codes[k, i] + 1) // 2
    flat, width = worth.reshape(-1), sums.shape[2]
    pairs, values = _pairs_of(sums, most, known + length), np.empty(length)
    pilot, which, weights = np.empty(known, np.uint16), np.empty(clusters, np.int64), np.empty(clusters)
    for r in range(rows):
        for c in range(columns):
            if top[r, c] < least:
                continue
            n = 0
            for k in range(clusters):
                if probability[k, r, c] >= least:
                    which[n], weights[n] = k, probability[k, r, c]
                    n += 1
            for v in range(r * grid, (r + 1) * grid):
                for u in range(c * grid, (c + 1) * grid):
                    at = v * width + u
                    for i in range(known):
                        pilot[i] = pairs[i, at]
                    for i in range(length):
                        values[i] = flat[pairs[known + i, at]]
                    for j in range(n):
                        k, against = which[j], odds
                        for i in range(known):
                            against *= unlike[signs[k, i], pilot[i]]
                        shows = weights[j] / (1 + against)
                        for i in range(length):
                            out[k, i] += shows * values[i]


@njit
def learn_worth(
    sums: Array, codes: Array, probability: Array, grid: int, most: int, prior: float, out: Array
) -> None:
    """`log_ratio` of what `count_pairs` finds, `out` (2 most + 1, 2 most + 1).

    A pilot of one value throughout, as that of a lone cluster, says nothing of the other: what comes with it
    is taken to be the same with all signs changed.
    """
    side = 2 * most + 1
    counts = np.zeros((2, side, side))
    count_pairs(sums[: 2 * codes.shape[1]], codes, probability, grid, most, counts)
    for value in range(2):
        if counts[value].sum() == 0:
            for a in range(side):
                for b in range(side):
                    counts[value, a, b] = counts[1 - value, side - 1 - a, side - 1 - b]
    log_ratio(counts, prior, out)


@njit
def read_frame(
    sums: Array,
    codes: Array,
    probability: Array,
    grid: int,
    least: float,
    worth: Array,
    odds: float,
    words: Array,
    scale: float,
    symbols: Array,
    llr: Array,
) -> tuple[float, float]:
    """`read_words` of what `sum_worth` finds: what it gives, and the least size of an LLR."""
    values = np.zeros((len(codes), len(sums) // 2 - codes.shape[1]))
    sum_worth(sums, codes, probability, grid, least, len(worth) // 2, worth, odds, values)
    quality = read_words(values, words, scale, symbols, llr)
    return quality, np.abs(llr).min()


@njit
def worth_images(sums: Array, worth: Array, most: int, seam: int, out: Array) -> None:
    """What each pixel's pair of sums says of each value, in a dark seam.

    `out` is (height + 2 seam, width + 2 seam, values). A pixel without events counts 0: what it is worth adds
    the same wherever the bar is.
    """
    _, height, width = sums.shape
    silent = worth[most, most]
    out[:] = 0.0
    for i in range(out.shape[2]):
        for v in range(height):
            for u in range(width):
                first, second = sums[2 * i, v, u], sums[2 * i + 1, v, u]
                if first != 0 or second != 0:
                    first = min(max(first, -most), most) + most
                    second = min(max(second, -most), most) + most
                    out[v + seam, u + seam, i] = worth[first, second] - silent


@njit
def cluster_matches(maps: Array, prior: Array, grid: int, images: Array, out: Array) -> None:
    """What the pixels of each cluster say of each value if the bar is off its place, `out` (K, n, n, values).

    Shifts (down, right) go from -(n // 2) to n // 2 px, the seam of the images. Pixels count where a cluster
    may be, by the prior of their cell: those of its neighbours tell nothing.
    """
    clusters, rows, columns = prior.shape
    _, side, _, values = out.shape
    # Values lie side by side, and so do those of neighbouring pixels.
    run = side * values
    lines = images.reshape(images.shape[0], images.shape[1] * values)
    sums = out.reshape(clusters, side, run)
    out[:] = 0.0
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
def path_scores(matches: Array, known: Array, out: Array) -> None:
    """Twice what all clusters say of a shift in each value, `out` (n, n, values).

    `known` are the codes of the first values, (K, m); of the others, each cluster's is what fits better.
    """
    clusters, side, _, values = matches.shape
    first = known.shape[1]
    out[:] = 0.0
    for k in range(clusters):
        for a in range(side):
            for b in range(side):
                for i in range(first):
                    out[a, b, i] += known[k, i] * matches[k, a, b, i]
                for i in range(first, values):
                    out[a, b, i] += abs(matches[k, a, b, i])


@njit
def smooth_path(scores: Array, step_cost: float, place_cost: float, path: Array) -> None:
    """Shifts (down, right) of all values that score best together (Viterbi), `path` (values, 2), px.

    `scores` are (n, n, values). A shift costs its square times `place_cost`, a change from value to value its
    square times `step_cost`. Squares add, so the best predecessor is sought along one axis, then along the
    other.
    """
    side, _, values = scores.shape
    reach = side // 2
    best = np.zeros((side, side))
    half = np.empty((side, side))
    come_a = np.zeros((values, side, side), np.int64)
    come_b = np.zeros((values, side, side), np.int64)
    for i in range(values):
        if i > 0:
            for a in range(side):
                for d in range(side):
                    half[a, d] = -np.inf
                    for c in range(side):
                        total = best[c, d] - step_cost * (a - c) ** 2
                        if total > half[a, d]:
                            half[a, d] = total
                            come_a[i, a, d] = c
            for a in range(side):
                for b in range(side):
                    best[a, b] = -np.inf
                    for d in range(side):
                        total = half[a, d] - step_cost * (b - d) ** 2
                        if total > best[a, b]:
                            best[a, b] = total
                            come_b[i, a, b] = d
        for a in range(side):
            for b in range(side):
                best[a, b] += scores[a, b, i] - place_cost * ((a - reach) ** 2 + (b - reach) ** 2)
    a, b = reach, reach
    for c in range(side):
        for d in range(side):
            if best[c, d] > best[a, b]:
                a, b = c, d
    for i in range(values - 1, -1, -1):
        path[i, 0], path[i, 1] = a - reach, b - reach
        d = come_b[i, a, b]
        a, b = come_a[i, a, d], d


@njit
def take_back(sums: Array, path: Array, out: Array) -> None:
    """Polarity sums with each value's shift (down, right) taken back; 0 where there was no pixel."""
    chips, height, width = sums.shape
    size = height * width
    for c in range(chips):
        down, right = path[c // 2, 0], path[c // 2, 1]
        there, here = sums[c].reshape(-1), out[c].reshape(-1)
        # As one long row, but for what that brings from the end of a row into the next, and back.
        by = down * width + right
        first, last = min(max(-by, 0), size), max(min(size - by, size), 0)
        here[:first] = 0
        if last > first:
            _copy(there[first + by : last + by], here[first:last])
        here[max(last, first) :] = 0
        for v in range(height):
            for u in range(max(width - right, 0), width):
                here[v * width + u] = 0
            for u in range(min(-right, width)):
                here[v * width + u] = 0


@njit
def _copy(values: Array, out: Array) -> None:
    for j in range(out.size):
        out[j] = values[j]
