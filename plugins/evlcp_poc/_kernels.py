"""Middles and cuts of maps, cross spectra, the sub-pixel fit of peaks, and a robust mean: compiled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk._kernels import median
from evlcp_sdk.kernels import njit

Array = NDArray[Any]


@njit
def find_middles(maps: Array, apart_m: Array, min_pixels: int, out: Array) -> tuple[float, int, int]:
    """Weighted median (row, column) of maps, -1 with too few lit pixels, `out` (K, 2).

    Unlike the mean, the median is robust against stray pixels.

    Returns:
        The scale that all clusters agree on, px a metre, by their distances `apart_m` (K, K): the median of
        the farther half of pairs, 0 without any; how far from their middles maps are lit, vertically and to a
        side.
    """
    clusters, height, width = maps.shape
    many, seen, reach = 0, np.empty(clusters + 1, np.int64), np.zeros(2, np.int64)
    lengths = height, width
    for k in range(clusters):
        light, lit, total = np.zeros((2, max(height, width))), 0, 0.0
        for v in range(height):
            some = False
            for u in range(width):
                some |= maps[k, v, u] > 0
            # Most rows are dark, which is tested many pixels at a time.
            for u in range(width if some else 0):
                w = maps[k, v, u]
                if w > 0:
                    light[0, v] += w
                    light[1, u] += w
                    lit += 1
            total += light[0, v]
        seen[many] = k
        many += int(lit >= min_pixels)
        for axis in range(2):
            place, upto = -1, 0.0
            while lit >= min_pixels and place < lengths[axis] - 1 and upto < total / 2:
                place += 1
                upto += light[axis, place]
            out[k, axis] = place
            for i in range(lengths[axis]):
                if place >= 0 and light[axis, i] > 0:
                    reach[axis] = max(reach[axis], abs(i - place))
    longest, n, scales = 0.0, 0, np.empty(clusters * clusters)
    for i in range(many):
        for k in range(i):
            longest = max(longest, apart_m[seen[i], seen[k]])
    for i in range(many):
        for k in range(i):
            one, other, apart = out[seen[i]], out[seen[k]], apart_m[seen[i], seen[k]]
            if apart >= longest / 2 - 1e-12:
                scales[n] = np.hypot(float(one[0] - other[0]), float(one[1] - other[1])) / apart
                n += 1
    return median(scales, n) if n > 0 else 0.0, reach[0], reach[1]


@njit
def cut_maps(maps: Array, middles: Array, out: Array) -> None:
    """Cut windows of maps around their middles, `out` (height, n, width): dark outside, or without one."""
    n, height, width = maps.shape
    rows, _, columns = out.shape
    for k in range(n):
        top, left = middles[k, 0] - rows // 2, middles[k, 1] - columns // 2
        for v in range(rows):
            for u in range(columns):
                y, x = top + v, left + u
                inside = middles[k, 0] >= 0 and 0 <= y < height and 0 <= x < width
                out[v, k, u] = maps[k, y, x] if inside else 0.0


@njit
def cross_spectra(turned: Array, first: Array, second: Array, no_phase: float, out: Array) -> None:
    """Phases of pairs of images, conj(first) * second, in their harmonics (down, images, across).

    `turned` (2, 2, down, images, across) are images multiplied across by cosine and sine, after being
    multiplied down by cosine and sine; `out` (2, down, pairs, 2, across) gives real and imaginary parts when
    it is multiplied back across by cosine and sine: it has harmonics to both sides. What is less than
    `no_phase` of the largest of a spectrum has no phase, and becomes 0. `turned` is overwritten.
    """
    _, _, down, n, across = turned.shape
    many, unit = n * across, turned.reshape(4, down, n * across)
    top = np.zeros(many, np.float32)
    for y in range(down):
        for j in range(many):
            # Real and imaginary part of a harmonic to the right, and of that to the left.
            a, b = unit[0, y, j] - unit[3, y, j], -unit[1, y, j] - unit[2, y, j]
            c, d = unit[0, y, j] + unit[3, y, j], unit[2, y, j] - unit[1, y, j]
            unit[0, y, j], unit[1, y, j], unit[2, y, j], unit[3, y, j] = a, b, c, d
            top[j] = max(top[j], a * a + b * b, c * c + d * d)
    for k in range(n):
        of_image, most = top[k * across : (k + 1) * across], np.float32(0)
        for x in range(across):
            most = max(most, of_image[x])
        for x in range(across):
            of_image[x] = np.float32(no_phase * no_phase) * most
    for y in range(down):
        for way in range(2):
            for j in range(many):
                a, b = unit[2 * way, y, j], unit[2 * way + 1, y, j]
                by = np.float32(a * a + b * b > top[j]) / np.sqrt(max(a * a + b * b, np.float32(1e-37)))
                unit[2 * way, y, j], unit[2 * way + 1, y, j] = a * by, b * by
        for q in range(first.size):
            # Unsigned, as indices below 0 would count from the end.
            begin, start = np.uint64(across * first[q]), np.uint64(across * second[q])
            for x in range(np.uint64(across)):
                one, other = begin + x, start + x
                a = unit[0, y, one] * unit[0, y, other] + unit[1, y, one] * unit[1, y, other]
                b = unit[0, y, one] * unit[1, y, other] - unit[1, y, one] * unit[0, y, other]
                c = unit[2, y, one] * unit[2, y, other] + unit[3, y, one] * unit[3, y, other]
                d = unit[2, y, one] * unit[3, y, other] - unit[3, y, one] * unit[2, y, other]
                out[0, y, q, 0, x], out[0, y, q, 1, x] = a + c, d - b
                out[1, y, q, 0, x], out[1, y, q, 1, x] = b + d, a - c


@njit
def fit_peaks(
    correlation: Array, size: tuple[int, int], most: tuple[int, int], samples: int, shifts: Array
) -> None:
    """Find peaks of correlations (2 n + 1, pairs, 2 m + 1), `shifts` (pairs, 2): down, right of the middle.

    A peak is sought at least `samples` from the edges; the samples around it, of its row and its column, are
    fitted (least squares) by the Dirichlet kernel of their band: the sum of 2 `most` + 1 harmonics out of
    `size`. The best gain follows from the shift, so that Gauss-Newton steps run over the shift alone
    (variable projection). The sines of the samples follow from those of the first by rotation.
    """
    rows, pairs, columns = correlation.shape
    v0, u0, many, seen = rows // 2, columns // 2, 2 * samples + 1, np.empty(2 * samples + 1)
    peaks = np.empty((pairs, 2), np.int64)
    for q in range(pairs):
        # Without light all are equal, and there is no shift.
        peaks[q, 0], peaks[q, 1] = v0, u0
        for v in range(samples, rows - samples):
            for u in range(samples, columns - samples):
                if correlation[v, q, u] > correlation[peaks[q, 0], q, peaks[q, 1]]:
                    peaks[q, 0], peaks[q, 1] = v, u
    for axis in range(2):
        turn, band = np.pi / size[axis], 2 * most[axis] + 1
        ds, dc, dsb, dcb = np.sin(turn), np.cos(turn), np.sin(band * turn), np.cos(band * turn)
        for q in range(pairs):
            v, u = peaks[q, 0], peaks[q, 1]
            for i in range(-samples, samples + 1):
                seen[samples + i] = correlation[v, q, u + i] if axis else correlation[v + i, q, u]
            left, middle, right = seen[samples - 1], seen[samples], seen[samples + 1]
            # For a kernel between two samples, the neighbours' ratio is that of their distances.
            side = right if right > left else left
            shift = 0.0
            if middle > 0 and side > 0:
                shift = (1 if right >= left else -1) * side / (middle + side)
            for _ in range(12):
                mm, ms, ss, mv, sv = 0.0, 0.0, 0.0, 0.0, 0.0
                start = (-samples - shift) * turn
                s, c, sb, cb = np.sin(start), np.cos(start), np.sin(band * start), np.cos(band * start)
                for i in range(many):
                    value, slope = band / size[axis], 0.0
                    if abs(s) >= 1e-9:
                        value = sb / (size[axis] * s)
                        slope = turn * (band * cb * s - sb * c) / (size[axis] * s * s)
                    mm += value * value
                    ms += value * slope
                    ss += slope * slope
                    mv += value * seen[i]
                    sv += slope * seen[i]
                    s, c = s * dc + c * ds, c * dc - s * ds
                    sb, cb = sb * dcb + cb * dsb, cb * dcb - sb * dsb
                gain = mv / mm
                # The slope with its part along the kernel removed: what the gain cannot explain.
                curvature = gain * (ss - ms * ms / mm)
                if gain <= 0 or curvature < 1e-30:
                    break
                move = min(max(-(sv - gain * ms) / curvature, -0.25), 0.25)
                shift = min(max(shift + move, -1.0), 1.0)
                # Steps shrink quadratically: the next one would be some 1e-6 px.
                if abs(move) < 1e-3:
                    break
            shifts[q, axis] = (u - u0 if axis else v - v0) + shift


@njit
def mean_distance(
    middles: Array,
    beyond_px: Array,
    pairs: tuple[Array, Array, Array],
    focal_px: float,
    places: tuple[float, float, int],
    rules: tuple[float, int, float],
) -> tuple[float, float, int]:
    """Weighted mean of pairs' distances, m, without extremes and outliers, and its delete-one-cluster sigma.

    `pairs` are first and second cluster, and spacing, m; images are as far apart as middles (K, 2) of maps,
    and `beyond_px` (pairs, 2). `places` are the scale of all clusters, px a metre; by how much, m, pairs may
    differ from the distance that it gives; and how many must not. `rules` are the power of a spacing that
    weights it, how many are dropped at each end, and the outliers' interquartile ranges.

    Returns:
        (mean, sigma, values kept), NaN and 0 of too few; sigma is NaN if no two clusters can be left out.
    """
    first, second, apart_m = pairs
    scale, seam_m, least = places
    power, drop, iqr = rules
    n, clusters = 0, len(middles)
    values, order = np.empty(first.size), np.empty(first.size, np.int64)
    for q in range(first.size):
        down = float(middles[second[q], 0] - middles[first[q], 0])
        right = float(middles[second[q], 1] - middles[first[q], 1])
        if abs(np.hypot(down, right) - scale * apart_m[q]) > scale * seam_m:
            continue
        length_px = np.hypot(down + beyond_px[q, 0], right + beyond_px[q, 1])
        values[q] = focal_px * apart_m[q] / max(length_px, 1e-9)
        i = n
        while i > 0 and values[order[i - 1]] > values[q]:
            order[i] = order[i - 1]
            i -= 1
        order[i] = q
        n += 1
    if n < least:
        return np.nan, np.nan, 0
    begin, end = (drop, n - drop) if n > 2 * drop + 1 else (0, n)
    quartiles = np.empty(2)
    for i in range(2):
        place = begin + (0.25 + 0.5 * i) * (end - begin - 1)
        below, above = values[order[int(place)]], values[order[min(int(place) + 1, end - 1)]]
        quartiles[i] = (above - below) * (place - int(place)) + below
    low, high = quartiles
    room, kept, total, weighted = iqr * (high - low), 0, 0.0, 0.0
    own_weight, own_sum = np.zeros(clusters), np.zeros(clusters)
    for _ in range(2):
        for i in range(begin, end):
            q = order[i]
            if low - room <= values[q] <= high + room:
                weight = apart_m[q] ** power
                kept, total, weighted = kept + 1, total + weight, weighted + weight * values[q]
                for k in (first[q], second[q]):
                    own_weight[k] += weight
                    own_sum[k] += weight * values[q]
        if kept > 0:
            break
        # Narrow bounds may call all of a few values outliers of one another: keep the middle half then.
        room = high - low
    m, mean, squares = 0, 0.0, 0.0
    for k in range(clusters):
        if own_weight[k] > 0 and total - own_weight[k] > 1e-9 * total:
            mean_without = (weighted - own_sum[k]) / (total - own_weight[k])
            m += 1
            squares += (mean_without - mean) ** 2 * (m - 1) / m
            mean += (mean_without - mean) / m
    return weighted / total, np.sqrt((m - 1) / m * squares) if m > 1 else np.nan, kept
