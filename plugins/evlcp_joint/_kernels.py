"""Where a bar's clusters lie, the values of its rows, and the fit of its boundaries: compiled."""

from math import erf, exp, pi, sqrt
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]


@njit(cache=True, nogil=True)
def cell_medians(selected: Array, out: Array) -> None:
    """Median row and column of each cluster's cells, `out` (K, 2); NaN without any.

    A median stays in a bar's image where a few cells are seen elsewhere.
    """
    clusters, rows, columns = selected.shape
    by_row = np.empty(rows, np.int64)
    by_column = np.empty(columns, np.int64)
    for k in range(clusters):
        by_row[:] = 0
        by_column[:] = 0
        for r in range(rows):
            for c in range(columns):
                if selected[k, r, c]:
                    by_row[r] += 1
                    by_column[c] += 1
        out[k, 0] = _middle(by_row)
        out[k, 1] = _middle(by_column)


@njit(cache=True, nogil=True)
def _middle(counts: Array) -> float:
    """Median of the numbers 0, 1, ... that occur `counts` times; NaN of none."""
    half = counts.sum() / 2
    if half == 0:
        return np.nan
    total = 0.0
    for i in range(counts.size):
        if total <= half < total + counts[i]:
            # The numbers of one bin lie evenly in it.
            return float(i - 0.5 + (half - total) / counts[i])
        total += counts[i]
    return float(counts.size - 1)


@njit(cache=True, nogil=True)
def cells_in_place(
    selected: Array,
    line: tuple[float, float, float, float],
    reach: float,
    across: Array,
    out: Array,
) -> None:
    """Mean row and column of each cluster's cells that lie where it is expected, `out` (K, 2), NaN of none.

    `line` is (first, spacing, left, tilt): cluster k is expected in row first + k * spacing, to within
    `reach`, and a row's middle in column left + tilt * row, to within half of `across`, which counts the
    cells by their distance from there. All in cells.
    """
    first, spacing, left, tilt = line
    clusters, rows, columns = selected.shape
    half = across.size // 2
    across[:] = 0
    for k in range(clusters):
        expected = first + k * spacing
        top, bottom = max(int(np.ceil(expected - reach)), 0), min(int(expected + reach), rows - 1)
        n, sum_r, sum_c = 0, 0.0, 0.0
        for r in range(top, bottom + 1):
            for c in range(columns):
                off = int(np.rint(c - left - tilt * r))
                if selected[k, r, c] and -half <= off <= half:
                    across[half + off] += 1
                    n += 1
                    sum_r += r
                    sum_c += c
        out[k, 0] = sum_r / n if n else np.nan
        out[k, 1] = sum_c / n if n else np.nan


@njit(cache=True, nogil=True)
def straight(x: Array, y: Array) -> tuple[float, float]:
    """Slope and intercept of the line through the medians (Theil-Sen), robust against outliers."""
    n = x.size
    slopes = np.empty(n * (n - 1) // 2)
    m = 0
    for i in range(n):
        for j in range(i + 1, n):
            if abs(x[j] - x[i]) > 1e-9:
                slopes[m] = (y[j] - y[i]) / (x[j] - x[i])
                m += 1
    slope = np.median(slopes[:m]) if m else 0.0
    return slope, np.median(y - slope * x)


@njit(cache=True, nogil=True)
def column_light(sums: Array, line: Array, top: int, bottom: int, full: float, out: Array) -> None:
    """Mean size of the clipped sums beside a bar's line, from rows `top` to `bottom`, by pixels from it.

    The middle of `out` is the line, column = line[0] + line[1] * row; of a value, the second chip is taken,
    and a sum of `full` events or more counts as 1.
    """
    chips, _, width = sums.shape
    half = out.size // 2
    out[:] = 0.0
    for i in range(1, chips, 2):
        for v in range(top, bottom + 1):
            centre = int(np.rint(line[0] + line[1] * v))
            for u in range(max(centre - half, 0), min(centre + half, width - 1) + 1):
                out[half + u - centre] += min(abs(sums[i, v, u]) / full, 1.0)
    out /= max((bottom - top + 1) * (chips // 2), 1)


@njit(cache=True, nogil=True)
def row_values(sums: Array, line: Array, weight: Array, full: float, out: Array) -> None:
    """Weighted mean of each row's clipped sums in every value's second chip, `out` (values, rows).

    The middle of `weight` is the bar's line, column = line[0] + line[1] * row; a sum of `full` events or more
    counts as 1.
    """
    values, rows = out.shape
    width = sums.shape[2]
    half = weight.size // 2
    for v in range(rows):
        centre = int(np.rint(line[0] + line[1] * v))
        first, last = max(centre - half, 0), min(centre + half, width - 1)
        mass = 0.0
        for u in range(first, last + 1):
            mass += weight[half + u - centre]
        for i in range(values):
            total = 0.0
            for u in range(first, last + 1):
                total += weight[half + u - centre] * min(max(sums[2 * i + 1, v, u] / full, -1.0), 1.0)
            out[i, v] = total / max(mass, 1e-12)


_PER_SIGMA = 256
_NORMAL = np.array([0.5 * erf(i / _PER_SIGMA / sqrt(2.0)) for i in range(16 * _PER_SIGMA)])
_DENSITY = np.array([exp(-0.5 * (i / _PER_SIGMA) ** 2) / sqrt(2 * pi) for i in range(16 * _PER_SIGMA)])
"""The standard normal distribution above its middle, and its density; straight lines between are good to a
millionth. Far more sigmas than `_REACH` of the wider of two normal ones are cut off."""


@njit(cache=True, nogil=True)
def _from_tables(z: float) -> tuple[float, float]:
    """The standard normal distribution and its density."""
    at = min(abs(z) * _PER_SIGMA, _NORMAL.size - 1.5)
    i = int(at)
    rest = at - i
    half = _NORMAL[i] + rest * (_NORMAL[i + 1] - _NORMAL[i])
    density = _DENSITY[i] + rest * (_DENSITY[i + 1] - _DENSITY[i])
    return 0.5 + half if z > 0 else 0.5 - half, density


@njit(cache=True, nogil=True)
def _across(z: float, core: float, tail: float, share: float) -> tuple[float, float]:
    """Profile of a boundary at `z` px from it, 0 to 1, and its slope: a mixture of two normal ones."""
    first, first_slope = _from_tables(z / core)
    second, second_slope = _from_tables(z / tail)
    slope = share * first_slope / core + (1 - share) * second_slope / tail
    return share * first + (1 - share) * second, slope


_REACH = 4.0
"""Sigmas of the tails beyond which a boundary is not felt: 6 of 100000 are left."""


@njit(cache=True, nogil=True)
def _rows_of(at: float, spacing: float, rows: int) -> tuple[int, int]:
    """The rows that are nearer to a boundary at `at` than to the others, which are too far to be felt through
    the blur: the first, and the one behind the last.
    """
    return max(int(np.ceil(at - spacing / 2)), 0), min(int(np.ceil(at + spacing / 2)), rows)


@njit(cache=True, nogil=True)
def model(
    codes: Array,
    known: Array,
    offset: Array,
    when: Array,
    profile: tuple[float, float, float],
    fit: Array,
    value: Array,
    slope: Array,
    nearest: Array,
) -> None:
    """Expected values of all rows, their slopes, and which boundary each belongs to.

    `fit` is (spacing, centre, drift, gain, width): boundary b between clusters b - 1 and b of K lies at
    spacing * (b - K / 2) from a centre that moves by drift * when[i] in value i. Across a boundary the value
    goes from one code to the next as a mixture of two normal distributions: `profile` holds both sigmas and
    the share of the first, and exp(width) stretches them. `value` and `nearest` are (values, rows), `slope`
    (5, values, rows) holds the derivatives by `fit`. A row does not count, and is NaN, 0 and -1, outside the
    middles of the outer clusters, which have no neighbour to bound them, and where `known` (K + 1, values)
    says that one of the two codes at a boundary is not known.
    """
    clusters, values = codes.shape
    rows = value.shape[1]
    spacing, centre, drift, gain = fit[0], fit[1], fit[2], fit[3]
    stretch = exp(fit[4])
    core, tail, share = profile[0] * stretch, profile[1] * stretch, profile[2]
    reach = _REACH * max(core, tail)
    middle = (rows - 1) / 2
    value[:] = np.nan
    nearest[:] = -1
    slope[:] = 0.0
    for i in range(values):
        moved = middle + offset[i] + centre + drift * when[i]
        for b in range(1, clusters):
            if not known[b, i]:
                continue
            place = b - clusters / 2
            at = moved + spacing * place
            top, bottom = _rows_of(at, spacing, rows)
            above, below = float(codes[b - 1, i]), float(codes[b, i])
            for v in range(top, bottom):
                z = v - at
                level = below if z > 0 else above
                if above != below and abs(z) < reach:
                    share_of, density = _across(z, core, tail, share)
                    level = above + (below - above) * share_of
                    steep = gain * (above - below) * density
                    slope[0, i, v] = steep * place
                    slope[1, i, v] = steep
                    slope[2, i, v] = steep * when[i]
                    slope[4, i, v] = steep * z
                slope[3, i, v] = level
                value[i, v] = gain * level
                nearest[i, v] = b


@njit(cache=True, nogil=True)
def equations(
    codes: Array,
    known: Array,
    offset: Array,
    when: Array,
    profile: tuple[float, float, float],
    huber: float,
    prior: float,
    seen_values: Array,
    fit: Array,
    normal: Array,
    right: Array,
) -> float:
    """Normal equations of a robust least-squares step of `model`, `normal` (5, 5), `right` (5,); the cost.

    Residuals beyond `huber` weigh less, so that a cluster that was decoded wrong does not bend the fit.
    `prior` is the weight of a width of 0.
    """
    clusters, values = codes.shape
    rows = seen_values.shape[1]
    spacing, centre, drift, gain = fit[0], fit[1], fit[2], fit[3]
    stretch = exp(fit[4])
    core, tail, share = profile[0] * stretch, profile[1] * stretch, profile[2]
    reach = _REACH * max(core, tail)
    middle = (rows - 1) / 2
    normal[:] = 0.0
    right[:] = 0.0
    cost = 0.0
    for i in range(values):
        moved = middle + offset[i] + centre + drift * when[i]
        for b in range(1, clusters):
            if not known[b, i]:
                continue
            place = b - clusters / 2
            at = moved + spacing * place
            top, bottom = _rows_of(at, spacing, rows)
            above, below = float(codes[b - 1, i]), float(codes[b, i])
            # Sums over these rows of weighted products: e of the slope by the centre, l of that by the gain,
            # z of the place from the boundary, r of the residual.
            ee = eez = eezz = el = elz = ll = er = erz = lr = 0.0
            for v in range(top, bottom):
                z = v - at
                level = below if z > 0 else above
                steep = 0.0
                if above != below and abs(z) < reach:
                    share_of, density = _across(z, core, tail, share)
                    level = above + (below - above) * share_of
                    steep = gain * (above - below) * density
                residual = seen_values[i, v] - gain * level
                size = abs(residual)
                weight = 1.0
                if size <= huber:
                    cost += residual * residual / 2
                else:
                    weight = huber / size
                    cost += huber * (size - huber / 2)
                ll += weight * level * level
                lr += weight * level * residual
                pull = weight * steep
                ee += pull * steep
                eez += pull * steep * z
                eezz += pull * steep * z * z
                el += pull * level
                elz += pull * level * z
                er += pull * residual
                erz += pull * residual * z
            # All slopes but that by the gain are the one by the centre, times what is alike for these rows.
            t = when[i]
            normal[0, 0] += place * place * ee
            normal[1, 0] += place * ee
            normal[1, 1] += ee
            normal[2, 0] += place * t * ee
            normal[2, 1] += t * ee
            normal[2, 2] += t * t * ee
            normal[3, 0] += place * el
            normal[3, 1] += el
            normal[3, 2] += t * el
            normal[3, 3] += ll
            normal[4, 0] += place * eez
            normal[4, 1] += eez
            normal[4, 2] += t * eez
            normal[4, 3] += elz
            normal[4, 4] += eezz
            right[0] += place * er
            right[1] += er
            right[2] += t * er
            right[3] += lr
            right[4] += erz
    for a in range(5):
        for c in range(a):
            normal[c, a] = normal[a, c]
    normal[4, 4] += prior
    right[4] -= prior * fit[4]
    return float(cost + prior * fit[4] ** 2 / 2)


@njit(cache=True, nogil=True)
def _damped_step(normal: Array, right: Array, damping: float, factor: Array, move: Array) -> bool:
    """Solve (normal + damping * diagonal) move = right by Cholesky; False where that is not positive."""
    n = right.size
    for a in range(n):
        for c in range(a + 1):
            total = normal[a, c]
            if a == c:
                total *= 1 + damping
            for k in range(c):
                total -= factor[a, k] * factor[c, k]
            if a == c:
                # A hundred-millionth of the diagonal is what rounding leaves of it.
                if not total > 1e-8 * normal[a, a]:
                    return False
                factor[a, a] = sqrt(total)
            else:
                factor[a, c] = total / factor[c, c]
    for a in range(n):
        total = right[a]
        for k in range(a):
            total -= factor[a, k] * move[k]
        move[a] = total / factor[a, a]
    for a in range(n - 1, -1, -1):
        total = move[a]
        for k in range(a + 1, n):
            total -= factor[k, a] * move[k]
        move[a] = total / factor[a, a]
    return True


@njit(cache=True, nogil=True)
def solve(
    codes: Array,
    known: Array,
    offset: Array,
    when: Array,
    profile: tuple[float, float, float],
    huber: float,
    prior: float,
    seen_values: Array,
    steps: int,
    tolerance: float,
    fit: Array,
    normal: Array,
) -> bool:
    """Levenberg-Marquardt from `fit`, which is changed; False where there is no fit.

    It ends with a step of the spacing below `tolerance` of it, or after `steps`; `normal` (5, 5) are the
    normal equations there.
    """
    right, new_normal, new_right = np.empty(5), np.empty((5, 5)), np.empty(5)
    factor, move = np.zeros((5, 5)), np.empty(5)
    cost = equations(codes, known, offset, when, profile, huber, prior, seen_values, fit, normal, right)
    damping = 1e-3
    outside = False
    for _ in range(steps):
        if not _damped_step(normal, right, damping, factor, move):
            return False
        new_fit = fit + move
        if not np.all(np.isfinite(new_fit)):
            return False
        # A spacing below a pixel, or a boundary seven times as wide as a lens makes it, is none; a long step
        # may lead there where a shorter one does not.
        outside = new_fit[0] < 1 or abs(new_fit[4]) > 2
        new_cost = np.inf
        if not outside:
            new_cost = equations(
                codes, known, offset, when, profile, huber, prior, seen_values, new_fit, new_normal, new_right
            )
        if new_cost <= cost:
            fit[:] = new_fit
            normal[:] = new_normal
            right[:] = new_right
            cost = new_cost
            damping /= 10
            if abs(move[0]) < tolerance * fit[0]:
                return True
        else:
            damping *= 10
    return not outside


@njit(cache=True, nogil=True)
def row_scores(seen_values: Array, value: Array, slope: Array, huber: float, meat: Array) -> int:
    """Sum over rows of the outer product of each row's score, `meat` (n, n); return the rows that count.

    A row's values share one pixel phase and so one error: they are one observation, not many.
    """
    values, rows = value.shape
    n = meat.shape[0]
    meat[:] = 0.0
    used = 0
    score = np.empty(n)
    for v in range(rows):
        score[:] = 0.0
        some = False
        for i in range(values):
            if np.isnan(value[i, v]):
                continue
            some = True
            residual = seen_values[i, v] - value[i, v]
            residual = min(max(residual, -huber), huber)
            for a in range(n):
                score[a] += slope[a, i, v] * residual
        used += some
        for a in range(n):
            for b in range(n):
                meat[a, b] += score[a] * score[b]
    return used


@njit(cache=True, nogil=True)
def shifts(
    seen_values: Array,
    value: Array,
    slope: Array,
    nearest: Array,
    huber: float,
    by_boundary: Array,
    by_value: Array,
) -> float:
    """What is left of the values, as shifts of the centre: of each boundary and of each value.

    `by_boundary` (2, K + 1) and `by_value` (2, values) take the shift, px, and its information, in units of
    the variance of one value, which is returned.
    """
    values, rows = value.shape
    by_boundary[:] = 0.0
    by_value[:] = 0.0
    squares, n = 0.0, 0
    for i in range(values):
        for v in range(rows):
            b = nearest[i, v]
            if b < 0:
                continue
            residual = min(max(seen_values[i, v] - value[i, v], -huber), huber)
            squares += residual * residual
            n += 1
            steep = slope[1, i, v]
            by_boundary[0, b] += steep * residual
            by_boundary[1, b] += steep * steep
            by_value[0, i] += steep * residual
            by_value[1, i] += steep * steep
    for b in range(by_boundary.shape[1]):
        by_boundary[0, b] /= max(by_boundary[1, b], 1e-12)
    for i in range(values):
        by_value[0, i] /= max(by_value[1, i], 1e-12)
    return squares / max(n, 1)
