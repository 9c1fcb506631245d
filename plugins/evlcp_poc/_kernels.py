"""Weighted medians of maps, and the sub-pixel peak fit: compiled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]


@njit
def find_middles(maps: Array, min_pixels: int, out: Array) -> None:
    """Weighted median (row, column) of maps, -1 where one has too few lit pixels.

    Unlike the mean, the median is robust against stray pixels.
    """
    clusters, height, width = maps.shape
    light, lengths = np.empty((2, max(height, width))), (height, width)
    for k in range(clusters):
        lit, total = 0, 0.0
        for i in range(light.shape[1]):
            light[0, i] = light[1, i] = 0.0
        for v in range(height):
            some = False
            for u in range(width):
                some |= maps[k, v, u] > 0
            # Most rows are dark, and that is seen of many pixels at a time.
            for u in range(width if some else 0):
                w = maps[k, v, u]
                if w > 0:
                    light[0, v] += w
                    light[1, u] += w
                    lit += 1
            total += light[0, v]
        for axis in range(2):
            place, upto = -1, 0.0
            while lit >= min_pixels and place < lengths[axis] - 1 and (place < 0 or upto < total / 2):
                place += 1
                upto += light[axis, place]
            out[k, axis] = place


@njit
def fit_peaks(
    correlation: Array, size: tuple[int, int], most: tuple[int, int], samples: int, shifts: Array
) -> None:
    """Peaks of correlations (pairs, 2 n + 1, 2 m + 1), `shifts` (pairs, 2): down and right of the middle, px.

    A peak is sought where there are so many `samples` to each side; these, of its row and its column, are
    fitted (least squares) by the Dirichlet kernel of their band: the sum of 2 `most` + 1 harmonics out of
    `size`. The gain that fits best follows from the shift, so Gauss-Newton steps run over the shift alone
    (variable projection). The sines of the samples follow from those of the first by rotation.
    """
    pairs, rows, columns = correlation.shape
    v0, u0, many, seen = rows // 2, columns // 2, 2 * samples + 1, np.empty(2 * samples + 1)
    peaks = np.empty((pairs, 2), np.int64)
    for q in range(pairs):
        # Where nothing is seen, all are alike, and there is no shift.
        peaks[q, 0], peaks[q, 1] = v0, u0
        for v in range(samples, rows - samples):
            for u in range(samples, columns - samples):
                if correlation[q, v, u] > correlation[q, peaks[q, 0], peaks[q, 1]]:
                    peaks[q, 0], peaks[q, 1] = v, u
    for axis in range(2):
        turn, band = np.pi / size[axis], 2 * most[axis] + 1
        ds, dc, dsb, dcb = np.sin(turn), np.cos(turn), np.sin(band * turn), np.cos(band * turn)
        for q in range(pairs):
            v, u = peaks[q, 0], peaks[q, 1]
            for i in range(-samples, samples + 1):
                seen[samples + i] = correlation[q, v, u + i] if axis else correlation[q, v + i, u]
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
