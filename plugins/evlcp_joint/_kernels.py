"""Row values of a bar, and the fit of its boundaries: compiled."""

from math import erf, exp, pi, sqrt
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]


@njit(cache=True, nogil=True)
def row_values(sums: Array, line: Array, half_width: float, full: float, out: Array) -> None:
    """Mean of each row's clipped sums in every value's second chip, `out` (values, rows).

    A row takes the pixels within `half_width` of the bar's line, column = line[0] + line[1] * row; a sum of
    `full` events or more counts as 1.
    """
    values, rows = out.shape
    width = sums.shape[2]
    for v in range(rows):
        centre = line[0] + line[1] * v
        first = max(int(np.ceil(centre - half_width)), 0)
        last = min(int(np.floor(centre + half_width)), width - 1)
        for i in range(values):
            total = 0.0
            for u in range(first, last + 1):
                total += min(max(sums[2 * i + 1, v, u] / full, -1.0), 1.0)
            out[i, v] = total / max(last - first + 1, 1)


@njit(cache=True, nogil=True)
def _normal(z: float) -> float:
    """Standard normal distribution function."""
    return 0.5 * (1.0 + erf(z / sqrt(2.0)))


@njit(cache=True, nogil=True)
def model(
    codes: Array, seen: Array, offset: Array, when: Array, blur: float, fit: Array, value: Array, slope: Array
) -> None:
    """Expected values of all rows, their slopes, and which rows count: `value`, (values, rows).

    `fit` is (spacing, centre, drift, gain): boundary b between clusters b - 1 and b of K lies at
    spacing * (b - K / 2) from a centre that moves by drift * when[i] in value i. Across a boundary the value
    goes from one code to the next as a normal distribution of `blur`. `slope` (4, values, rows) holds the
    derivatives by `fit`; it is 0 where a row does not count: outside the middles of the outer clusters, which
    have no neighbour to bound them, and where a neighbouring cluster is not seen.
    """
    clusters, values = codes.shape
    rows = value.shape[1]
    spacing, centre, drift, gain = fit[0], fit[1], fit[2], fit[3]
    middle = (rows - 1) / 2
    for i in range(values):
        for v in range(rows):
            at = v - middle - offset[i] - centre - drift * when[i]
            place = at / spacing + clusters / 2
            # The nearest boundary; the others are too far to be felt through the blur.
            b = int(np.floor(place + 0.5))
            if b < 1 or b > clusters - 1 or not (seen[b - 1] and seen[b]):
                value[i, v] = np.nan
                for a in range(4):
                    slope[a, i, v] = 0.0
                continue
            z = (at - spacing * (b - clusters / 2)) / blur
            step = float(codes[b, i] - codes[b - 1, i])
            level = float(codes[b, i] if z > 0 else codes[b - 1, i])
            steep = 0.0
            # Six sigmas away, or between equal codes, the boundary is not felt.
            if step != 0 and abs(z) < 6:
                level = codes[b - 1, i] + step * _normal(z)
                steep = gain * step * exp(-z * z / 2) / sqrt(2 * pi) / blur
            value[i, v] = gain * level
            slope[0, i, v] = -steep * (b - clusters / 2)
            slope[1, i, v] = -steep
            slope[2, i, v] = -steep * when[i]
            slope[3, i, v] = level


@njit(cache=True, nogil=True)
def step_of(
    seen_values: Array, value: Array, slope: Array, huber: float, normal: Array, right: Array
) -> float:
    """Normal equations of a robust least-squares step, `normal` (4, 4), `right` (4,); return the cost.

    Residuals beyond `huber` weigh less, so that a cluster that was decoded wrong does not bend the fit.
    """
    values, rows = value.shape
    normal[:] = 0.0
    right[:] = 0.0
    cost = 0.0
    for i in range(values):
        for v in range(rows):
            if np.isnan(value[i, v]):
                continue
            residual = seen_values[i, v] - value[i, v]
            size = abs(residual)
            weight = 1.0 if size <= huber else huber / size
            cost += residual * residual / 2 if size <= huber else huber * (size - huber / 2)
            # Away from boundaries, where most rows are, the value depends on the gain alone.
            first = 0 if slope[1, i, v] != 0 else 3
            for a in range(first, 4):
                weighted = weight * slope[a, i, v]
                right[a] += weighted * residual
                for b in range(a, 4):
                    normal[a, b] += weighted * slope[b, i, v]
    for a in range(4):
        for b in range(a):
            normal[a, b] = normal[b, a]
    return cost


@njit(cache=True, nogil=True)
def row_scores(seen_values: Array, value: Array, slope: Array, huber: float, meat: Array) -> int:
    """Sum over rows of the outer product of each row's score, `meat` (4, 4); return the rows that count.

    A row's values share one pixel phase and so one error: they are one observation, not many.
    """
    values, rows = value.shape
    meat[:] = 0.0
    used = 0
    score = np.empty(4)
    for v in range(rows):
        score[:] = 0.0
        some = False
        for i in range(values):
            if np.isnan(value[i, v]):
                continue
            some = True
            residual = seen_values[i, v] - value[i, v]
            residual = min(max(residual, -huber), huber)
            for a in range(4):
                score[a] += slope[a, i, v] * residual
        used += some
        for a in range(4):
            for b in range(4):
                meat[a, b] += score[a] * score[b]
    return used
