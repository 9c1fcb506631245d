"""Finds a bar's clusters, reads the values of its rows, and fits its boundaries: compiled."""

from math import exp, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk._kernels import factor_cholesky, median, solve_cholesky
from evlcp_sdk.kernels import njit

Array = NDArray[Any]

_FULL_EVENTS = 3.0
"""Events of a pixel in a chip that count as a full value: only a pixel that is too sensitive has more."""

_VEIL_SHARE = 0.3
"""Share of the brightest column's events that do not count: a dirty lens veils a bar with as much."""

PARAMETERS = 7
"""Parameters of the fit: spacing, centre, drift, gain, width, and the shifts by sign and by repetition."""

_SHIFT_PARAMETERS = (0, 1, 2, 5, 6)
"""Those of them that shift a boundary."""

_NOISE = 0.25
"""Sigma of a row's values, in full values, by which they are weighted."""

_WIDTH_SIGMA = 0.3
"""Prior sigma of the log of a boundary's width, about that of `blur_px`."""

_SHIFT_SIGMA_PX = 0.1
"""Prior sigma of the shifts of boundaries by the sign of their step, and by repeated values."""

PRIOR = (
    *(0.0, 0.0, 0.0, 0.0, (_NOISE / _WIDTH_SIGMA) ** 2),
    *((_NOISE / _SHIFT_SIGMA_PX) ** 2, (_NOISE / _SHIFT_SIGMA_PX) ** 2),
)
"""Weights of width and shifts being 0, relative to those of a row's values."""

HUBER_LIMIT = 0.5
"""Residual, in full values, beyond which a row weighs less: so that wrong symbols do not distort the fit."""

PROFILE_REACH = 12.0
"""Widths of a boundary's core up to which it has an effect: 6 of 100000 of tails are beyond."""

ROUNDING_SHARE = 1e-8
"""Share of a diagonal that rounding may leave of 0."""

_MAX_STEPS = 12
"""Newton steps at most; from a start within a tenth of a spacing, four suffice."""

_ROUNDS = 2
"""Fits after the first, each with the motion and without the outliers that the one before showed."""

CLOSE, EXACT = 1e-3, 1e-5
"""Last step of the spacing, as a share of it, of a fit that others follow, and of the last one."""

_OUTLIER_SIGMAS = 4.0
"""Standard deviations, by the median, beyond which a boundary is an outlier: 1 of 16000 by chance."""

_MIN_OUTLIER_PX = 0.25
"""Offset up to which a boundary is no outlier: pixels that miss events cause as much now and then."""

_MIN_EXPLAINED = 0.3
"""Least share of the values' energy that a fit explains: fits of noise reach a tenth, and dim bars in a
bright scene three quarters."""


@njit
def read_rows(sums: Array, line: Array, clusters: int, out: Array) -> None:
    """Read the values of the rows of a bar, `out` (values, rows): of a value, the second chip's sums count.

    `line` (5,) has the row of the first cluster, rows to the next, the column in row 0, columns a row, and
    half the width, px. Columns are weighted by their light between the bar's ends; less than `_VEIL_SHARE` of
    the brightest column's is a veil, or not the bar's.
    """
    chips, rows, width = sums.shape
    one, other = line[0] - 0.5 * line[1], line[0] + (clusters - 0.5) * line[1]
    top, bottom = max(int(min(one, other)), 0), min(int(max(one, other)), rows - 1)
    half, share = int(line[4]) + 1, 1 / _FULL_EVENTS
    light = np.zeros(2 * half + 1)
    for v in range(top, bottom + 1):
        centre = int(np.rint(line[2] + line[3] * v))
        first, last = max(centre - half, 0), min(centre + half, width - 1)
        if first > last:
            continue
        beside = light[half + first - centre :]
        for i in range(1, chips, 2):
            # One index, so that columns go side by side.
            row = sums[i, v, first : last + 1]
            for u in range(row.size):
                beside[u] += min(abs(row[u]) * share, 1.0)
    most, many = 0.0, max((bottom - top + 1) * (chips // 2), 1)
    for u in range(light.size):
        light[u] /= many
        most = max(most, light[u])
    for u in range(light.size):
        light[u] = max(light[u] - _VEIL_SHARE * most, 0.0)
    for v in range(rows):
        centre = int(np.rint(line[2] + line[3] * v))
        first, last = max(centre - half, 0), min(centre + half, width - 1)
        # The columns whose weight is not 0, which are few of a bar's seam.
        while first <= last and light[half + first - centre] == 0:
            first += 1
        while first <= last and light[half + last - centre] == 0:
            last -= 1
        weight, mass = light[half + first - centre :], 0.0
        for u in range(last + 1 - first):
            mass += weight[u]
        by_mass = 1 / max(mass, 1e-12)
        for i in range(len(out)):
            total = 0.0
            row = sums[2 * i + 1, v, first : last + 1]
            for u in range(row.size):
                total += weight[u] * min(max(row[u] * share, -1.0), 1.0)
            out[i, v] = total * by_mass


@njit
def measure_polarity_ratio(sums: Array, pilots: Array, seen: Array, line: Array) -> float:
    """How often pixels in clusters' middles answer steps down, as a share of how often they answer steps up.

    A camera may miss more events of one polarity, and boundaries then show values of that sign smaller. The
    number of events does not count: a fast step up gives few and a slow one down many, but a pixel at a
    boundary, which sees a small part of the step, gives one or none. The half spacing of rows about each
    cluster's middle counts, in its pilot, which comes first; `line` is as for `read_rows`. 1 if unknown.
    """
    _, rows, columns = sums.shape
    half, reach = int(line[4]), abs(line[1]) / 4
    answers, asked = np.zeros(2), np.zeros(2)
    for k in range(len(pilots)):
        if not seen[k]:
            continue
        middle = line[0] + line[1] * k
        for v in range(max(int(np.ceil(middle - reach)), 0), min(int(middle + reach), rows - 1) + 1):
            centre = int(np.rint(line[2] + line[3] * v))
            for u in range(max(centre - half, 0), min(centre + half, columns - 1) + 1):
                for i in range(pilots.shape[1]):
                    up = int(pilots[k, i] > 0)
                    asked[up] += 1
                    answers[up] += sums[2 * i + 1, v, u] > 0 if up else sums[2 * i + 1, v, u] < 0
    if answers[1] == 0 or asked[0] == 0:
        return 1.0
    return float(answers[0] / asked[0] / (answers[1] / asked[1]))


_BLOCK = 128
"""Steps across boundaries that are computed together: columns of so many, in one array one after the other,
so that the compiler sees that none overlaps another and takes several at a time."""

_FIRST, _PLACE, _TIME, _SIDE, _REPEAT, _STEP, _ROWS, _VALUE, _BOUNDARY, _ROW = [_BLOCK * n for n in range(10)]
"""Columns of a step: its first row from the middle of the bar, its boundary from there in spacings, its time,
what shifts it, its size, how many rows it has; its value, its boundary, and its first row in the image."""

_AT, _PART, _LEVEL, _STEEP, _LEFT, _COST = [_BLOCK * n for n in range(6)]
_SS, _SL, _SZ, _LL, _LZ, _ZZ, _S, _BY_LEVEL, _BY_Z = [_BLOCK * n for n in range(6, 15)]
"""Columns of what is computed for steps: the first six for a row, then sums over rows."""

_COLUMNS = 15


@njit
def list_steps(codes: Array, known: Array, motion: Array, reach: float, fit: Array, values: Array) -> Any:
    """List all steps across boundaries, where codes differ, that have rows: (blocks, columns), and values.

    `fit` is (spacing, centre, drift, gain, width, by sign, by repeat): boundary b between clusters b - 1 and
    b of K is at spacing * (b - K / 2) from a centre that is centre + drift * time + offset from the middle
    row in a value, by `motion` (offset and time, values). Its rows are those within `reach` px, and nearest
    to it; there are none where `known` (K + 1, values) has one of the two codes as unknown.

    Sums of positive and of negative events are not alike, so a step up looks shifted to one side and a step
    down to the other. A cluster that repeats a value had another edge a chip before, whose late events, and
    the pixels that are blind from them, make it look smaller; nothing is known of what came before a frame.

    Returns:
        Steps, and their values (blocks, rows, `_BLOCK`), as many rows as the longest has; others have fewer.
    """
    clusters, n = codes.shape
    rows, half = values.shape[1], min(reach, fit[0] / 2)
    first, last = np.zeros((n, clusters), np.int64), np.zeros((n, clusters), np.int64)
    many, longest = 0, 0
    for i in range(n):
        middle = (rows - 1) / 2 + motion[0, i] + fit[1] + fit[2] * motion[1, i]
        for b in range(1, clusters):
            if known[b, i] and codes[b, i] != codes[b - 1, i]:
                place = middle + fit[0] * (b - clusters / 2)
                first[i, b] = min(max(int(np.ceil(place - half)), 0), rows)
                last[i, b] = min(max(int(np.ceil(place + half)), 0), rows)
                many += int(last[i, b] > first[i, b])
                longest = max(longest, last[i, b] - first[i, b])
    blocks = -(-many // _BLOCK)
    steps, seen = np.zeros((blocks, 10 * _BLOCK)), np.zeros((blocks, longest, _BLOCK))
    step = 0
    for i in range(n):
        for b in range(1, clusters):
            here = last[i, b] - first[i, b]
            if here <= 0:
                continue
            block, j = step // _BLOCK, step % _BLOCK
            steps[block, _FIRST + j] = first[i, b] - (rows - 1) / 2 - motion[0, i]
            steps[block, _PLACE + j] = b - clusters / 2
            steps[block, _TIME + j] = motion[1, i]
            steps[block, _SIDE + j] = 1.0 if codes[b, i] > codes[b - 1, i] else -1.0
            # Codes are 1 and -1, and differ across the boundary.
            steps[block, _REPEAT + j] = (
                0.5 * codes[b, i] * (codes[b, i - 1] + codes[b - 1, i - 1]) if i else 0
            )
            steps[block, _STEP + j] = 0.5 * (codes[b, i] - codes[b - 1, i])
            steps[block, _ROWS + j], steps[block, _ROW + j] = here, first[i, b]
            steps[block, _VALUE + j], steps[block, _BOUNDARY + j] = i, b
            for r in range(here):
                seen[block, r, j] = values[i, first[i, b] + r]
            step += 1
    return steps, seen


@njit
def _model_levels(
    column: Array, fit: Array, row: int, lens: tuple[float, float], profile: Array, work: Array
) -> None:
    """Levels of each step in a row, counted from its first, for a gain of 1, and their slopes.

    In the first row it sets how far that is beyond the boundary; `lens` is as for `fit_bar`.
    """
    if row == 0:
        for j in range(_BLOCK):
            shift = fit[5] * column[_SIDE + j] + fit[6] * column[_REPEAT + j]
            at = fit[1] + fit[2] * column[_TIME + j] + fit[0] * column[_PLACE + j] + shift
            work[_AT + j] = column[_FIRST + j] - at
    width, negative_share = lens[0] * exp(fit[4]), lens[1]
    scale, steepest = (profile.shape[1] - 1) / (PROFILE_REACH * width), fit[3] / width
    most = profile.shape[1] - 1 - 1e-9
    which = np.empty(_BLOCK, np.int32)
    for j in range(_BLOCK):
        at = min(abs(work[_AT + j] + row) * scale, most)
        which[j] = np.int32(at)
        work[_PART + j] = at - which[j]
    beyond, density = profile[0], profile[1]
    for j in range(_BLOCK):
        n, part = np.uint32(which[j]), work[_PART + j]
        after = n + np.uint32(1)
        work[_LEVEL + j] = beyond[n] + part * (beyond[after] - beyond[n])
        work[_STEEP + j] = density[n] + part * (density[after] - density[n])
    for j in range(_BLOCK):
        step = column[_STEP + j]
        # Codes are 1 and -1, and differ: their mean is 0.
        level = (step if work[_AT + j] + row > 0 else -step) * work[_LEVEL + j]
        factor = negative_share if level < 0 else 1.0
        work[_LEVEL + j] = level * factor
        work[_STEEP + j] = -steepest * step * work[_STEEP + j] * factor


@njit
def build_equations(
    steps: Array, seen: Array, profile: Array, lens: tuple[float, float], fit: Array
) -> tuple[float, Array, Array]:
    """Cost and normal equations of a robust least-squares step, (7, 7) and their right side, (7,).

    Of `list_steps`, with the weights of `PRIOR`. Across a boundary where codes differ, a value goes from one
    code times the gain to the next by `profile`. Residuals beyond `HUBER_LIMIT` weigh less.
    """
    gain, cost, work = fit[3], 0.0, np.empty(_COLUMNS * _BLOCK)
    normal, right = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    for a in range(PARAMETERS):
        right[a] = -PRIOR[a] * fit[a]
        cost += PRIOR[a] * fit[a] ** 2 / 2
        for c in range(PARAMETERS):
            normal[a, c] = PRIOR[a] if a == c else 0.0
    for block in range(len(steps)):
        column = steps[block]
        for j in range(_COST, _COLUMNS * _BLOCK):
            work[j] = 0.0
        for r in range(seen.shape[1]):
            value = seen[block, r]
            _model_levels(column, fit, r, lens, profile, work)
            for j in range(_BLOCK):
                z, level, steep = work[_AT + j] + r, work[_LEVEL + j], work[_STEEP + j]
                there = 1.0 if r < column[_ROWS + j] else 0.0
                residual = value[j] - gain * level
                size = abs(residual)
                weight = there * (1.0 if size <= HUBER_LIMIT else HUBER_LIMIT / size)
                loss = (
                    residual * residual / 2 if size <= HUBER_LIMIT else HUBER_LIMIT * (size - HUBER_LIMIT / 2)
                )
                pull = weight * steep
                work[_COST + j] += there * loss
                work[_SS + j] += pull * steep
                work[_SL + j] += pull * level
                work[_SZ + j] += pull * steep * z
                work[_LL + j] += weight * level * level
                work[_LZ + j] += pull * z * level
                work[_ZZ + j] += pull * z * steep * z
                work[_S + j] += pull * residual
                work[_BY_LEVEL + j] += weight * level * residual
                work[_BY_Z + j] += pull * z * residual
        for j in range(_BLOCK):
            if column[_ROWS + j] == 0:
                break
            # In a boundary's rows of one value, five of the slopes go together: sums of what they share.
            place, when = column[_PLACE + j], column[_TIME + j]
            side, again = column[_SIDE + j], column[_REPEAT + j]
            slope = (place, 1.0, when, 0.0, 0.0, side, again)
            for a in _SHIFT_PARAMETERS:
                right[a] += slope[a] * work[_S + j]
                normal[3, a] += slope[a] * work[_SL + j]
                normal[4, a] += slope[a] * work[_SZ + j]
                for c in _SHIFT_PARAMETERS:
                    if c > a:
                        break
                    normal[a, c] += slope[a] * slope[c] * work[_SS + j]
            right[3] += work[_BY_LEVEL + j]
            right[4] += work[_BY_Z + j]
            normal[3, 3] += work[_LL + j]
            normal[4, 3] += work[_LZ + j]
            normal[4, 4] += work[_ZZ + j]
            cost += work[_COST + j]
    normal[3, 4] = normal[4, 3]
    for a in _SHIFT_PARAMETERS:
        normal[a, 3], normal[a, 4] = normal[3, a], normal[4, a]
        for c in _SHIFT_PARAMETERS:
            normal[min(a, c), max(a, c)] = normal[max(a, c), min(a, c)]
    return cost, normal, right


@njit
def measure_residuals(
    steps: Array,
    seen: Array,
    profile: Array,
    lens: tuple[float, float],
    fit: Array,
    by_boundary: Array,
    by_value: Array,
    scores: Array,
) -> tuple[float, float, float]:
    """Measure what a fit leaves: shifts of each boundary and of each value, and each row's score.

    `by_boundary` (3, K + 1) and `by_value` (2, values) take the shift of the centre, px, and its information,
    in units of the variance of one value; the third row is the sine of the boundary's places on the pixels, 0
    in the middle of one, mean over its values; `scores` (rows, 7) the slopes times the residuals, clipped to
    `HUBER_LIMIT`, over a row's values, which share one pixel phase and so one error. With no rows of scores,
    neither of these two is computed.

    Returns:
        Mean square of the clipped residuals, sum of the squares of residuals, and of the values.
    """
    by_boundary[:], by_value[:], scores[:] = 0.0, 0.0, 0.0
    work, information = np.empty(_COLUMNS * _BLOCK), np.empty(_BLOCK)
    noise, residual_squares, all_squares, count = 0.0, 0.0, 0.0, 0
    for block in range(len(steps)):
        column = steps[block]
        for j in range(_BLOCK):
            information[j] = 0.0
        for r in range(seen.shape[1]):
            _model_levels(column, fit, r, lens, profile, work)
            for j in range(_BLOCK):
                if r >= column[_ROWS + j]:
                    continue
                value, level, steep = seen[block, r, j], work[_LEVEL + j], work[_STEEP + j]
                residual = value - fit[3] * level
                residual_squares += residual * residual
                all_squares += value * value
                residual = min(max(residual, -HUBER_LIMIT), HUBER_LIMIT)
                noise += residual * residual
                count += 1
                i, b, v = int(column[_VALUE + j]), int(column[_BOUNDARY + j]), int(column[_ROW + j]) + r
                pull = steep * residual
                by_boundary[0, b] += pull
                by_value[0, i] += pull
                by_value[1, i] += steep * steep
                information[j] += steep * steep
                if len(scores) == 0:
                    continue
                scores[v, 0] += pull * column[_PLACE + j]
                scores[v, 1] += pull
                scores[v, 2] += pull * column[_TIME + j]
                scores[v, 3] += level * residual
                scores[v, 4] += pull * (work[_AT + j] + r)
                scores[v, 5] += pull * column[_SIDE + j]
                scores[v, 6] += pull * column[_REPEAT + j]
        for j in range(_BLOCK):
            if information[j] > 0:
                b = int(column[_BOUNDARY + j])
                by_boundary[1, b] += information[j]
                if len(scores):
                    by_boundary[2, b] -= information[j] * sin(2 * np.pi * work[_AT + j])
    for b in range(by_boundary.shape[1]):
        by_boundary[0, b] /= max(by_boundary[1, b], 1e-12)
        by_boundary[2, b] /= max(by_boundary[1, b], 1e-12)
    for i in range(by_value.shape[1]):
        by_value[0, i] /= max(by_value[1, i], 1e-12)
    return noise / max(count, 1), residual_squares, all_squares


@njit
def solve_fit(
    steps: Array, seen: Array, profile: Array, lens: tuple[float, float], tolerance: float, fit: Array
) -> tuple[bool, Array]:
    """Levenberg-Marquardt from `fit`, which is changed; returns whether it fits, and the normal equations.

    It ends with a step of the spacing below `tolerance` of it, or after `_MAX_STEPS`.
    """
    factor, scale = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    move, new_fit = np.empty(PARAMETERS), np.empty(PARAMETERS)
    cost, normal, right = build_equations(steps, seen, profile, lens, fit)
    damping = 1e-3
    for _ in range(_MAX_STEPS):
        if not factor_cholesky(normal, damping, ROUNDING_SHARE, scale, factor):
            return False, normal
        solve_cholesky(factor, scale, right, move)
        for a in range(PARAMETERS):
            new_fit[a] = fit[a] + move[a]
            if not np.isfinite(new_fit[a]):
                return False, normal
        # A spacing below a pixel, or a boundary seven times as wide as a lens makes it, is none; a long step
        # may lead there where a shorter one does not.
        outside = new_fit[0] < 1 or abs(new_fit[4]) > 2
        new_cost, new_normal, new_right = np.inf, normal, right
        if not outside:
            new_cost, new_normal, new_right = build_equations(steps, seen, profile, lens, new_fit)
        if new_cost <= cost:
            cost, normal, right = new_cost, new_normal, new_right
            for a in range(PARAMETERS):
                fit[a] = new_fit[a]
            damping /= 10
            if abs(move[0]) < tolerance * fit[0]:
                return True, normal
        else:
            damping *= 10
    return not outside, normal


@njit
def estimate_motion(shift: Array, information: Array, when: Array) -> None:
    """Turn each value's `shift` into the motion beyond a steady drift, as far as it exceeds noise.

    The shifts' variance beyond that of noise weighs each (empirical Bayes).
    """
    total, sum_shift, sum_when = 0.0, 0.0, 0.0
    for i in range(shift.size):
        total += information[i]
        sum_shift += information[i] * shift[i]
        sum_when += information[i] * when[i]
    mean_shift, mean_when = sum_shift / total, sum_when / total
    together, spread, squares = 0.0, 0.0, 0.0
    for i in range(shift.size):
        lever = when[i] - mean_when
        together += information[i] * lever * (shift[i] - mean_shift)
        spread += information[i] * lever * lever
    for i in range(shift.size):
        shift[i] = shift[i] - mean_shift - (when[i] - mean_when) * together / spread
        squares += information[i] * shift[i] * shift[i]
    variance = (squares - (shift.size - 2)) / total
    for i in range(shift.size):
        shift[i] = shift[i] * variance / (variance + 1 / information[i]) if variance > 0 else 0.0


@njit
def assess_fit(by_boundary: Array, scores: Array, normal: Array) -> tuple[float, int, float]:
    """Variance of the spacing, px2, by `measure_residuals`; NaN where the normal equations are singular.

    It is the mean of two: by rows as observations (sandwich estimator), and by the scatter of the boundaries.

    Returns:
        The variance; the number of boundaries; and what a pixel-phase bias of 1 px adds to the spacing, px.
    """
    inverse, scale, unit = np.empty(PARAMETERS), np.empty(PARAMETERS), np.zeros(PARAMETERS)
    factor = np.empty((PARAMETERS, PARAMETERS))
    if not factor_cholesky(normal, 0.0, ROUNDING_SHARE, scale, factor):
        return np.nan, 0, 0.0
    # The spacing's row of the inverse: one column of it, as that is symmetric.
    unit[0] = 1.0
    solve_cholesky(factor, scale, unit, inverse)
    by_row, rows = 0.0, 0
    for v in range(len(scores)):
        part = 0.0
        for a in range(PARAMETERS):
            part += scores[v, a] * inverse[a]
        by_row += part * part
        rows += scores[v, 3] != 0
    n, total, mean, spread, squares, bias = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    for b in range(by_boundary.shape[1]):
        weight = by_boundary[1, b]
        n += weight > 0
        total += weight
        mean += weight * b
        squares += weight * by_boundary[0, b] ** 2
    mean /= total
    for b in range(by_boundary.shape[1]):
        pull = by_boundary[1, b] * (b - mean)
        spread += pull * (b - mean)
        bias += pull * by_boundary[2, b]
    if spread <= 0:
        return np.nan, n, 0.0
    variance = (by_row * rows / max(rows - PARAMETERS, 1) + squares / max(n - 2, 1) / spread) / 2
    return variance, n, bias / spread


_NO_FIT = (np.nan, 0, 0.0)
"""As from `assess_fit`, without boundaries."""


@njit
def fit_bar(
    decoded: tuple[Array, Array, Array, Array],
    offset_px: Array,
    values: Array,
    profile: Array,
    lens: tuple[float, float],
    least: int,
    fit: Array,
) -> tuple[tuple[float, int, float], Array]:
    """Fit again and again, each time with the motion and without the outliers that the last fit showed.

    Args:
        decoded: Pilots (K, values) and words (symbols, values), their values -1 and 1; the symbol of each
            cluster, int64 (K,), -1 if not known, so that the pilot counts alone; which are seen (K,).
        offset_px: Of the centre in each chip, rows, (chips,), two for a value. Images are held still by whole
            pixels, so these jump by one.
        values: Of each row, (values, rows).
        profile: To one side of a boundary, -1 to 1, and its slope, (2, n), from 0 to `PROFILE_REACH` widths.
        lens: A boundary's width, px, of which `fit` has the logarithm of the excess; and the size of negative
            values, as a share of positive ones.
        least: Boundaries that a fit needs.
        fit: The start; changed.

    Returns:
        As from `assess_fit`, NaN without a fit; and `by_boundary` of `measure_residuals`, with the shifts of
        rejected boundaries, too, without information.
    """
    pilots, words, symbols, seen = decoded
    clusters, n = len(pilots), len(values)
    codes, known = np.empty((clusters, n)), np.zeros((clusters + 1, n), np.bool_)
    for k in range(clusters):
        for i in range(n):
            of_pilot = i < pilots.shape[1]
            codes[k, i] = pilots[k, i] if of_pilot else words[symbols[k], i - pilots.shape[1]]
            read = of_pilot | (min(symbols[k - 1], symbols[k]) >= 0)
            known[k, i] = (k > 0) & seen[k - 1] & seen[k] & read
    motion = np.empty((2, n))
    for i in range(n):
        # A value is read from its second chip, whose events follow the edge at its start, half a chip before
        # the middle that an offset is for.
        second = offset_px[2 * i + 1]
        step = second - offset_px[2 * i]
        motion[0, i], motion[1, i] = second - (step - np.rint(step)) / 2, (i + 0.5) / n - 0.5
    by_boundary, rejected = np.empty((3, clusters + 1)), np.zeros(clusters + 1)
    by_value, scores = np.empty((2, n)), np.empty((values.shape[1], PARAMETERS))
    motion_so_far, own_motion, sizes = motion.copy(), np.zeros(n), np.empty(clusters + 1)
    for rounds_left in range(_ROUNDS, -1, -1):
        reach = PROFILE_REACH * lens[0] * exp(fit[4])
        steps, rows = list_steps(codes, known, motion_so_far, reach, fit, values)
        found, normal = solve_fit(steps, rows, profile, lens, CLOSE if rounds_left else EXACT, fit)
        if not found:
            return _NO_FIT, by_boundary
        score_rows = scores[: 0 if rounds_left else len(scores)]
        noise, residual_squares, squares = measure_residuals(
            steps, rows, profile, lens, fit, by_boundary, by_value, score_rows
        )
        used: Any = np.int64(0)
        for b in range(clusters + 1):
            if by_boundary[1, b] > 0:
                sizes[used] = abs(by_boundary[0, b])
                used += 1
        if used < least:
            return _NO_FIT, by_boundary
        if rounds_left:
            most = max(_OUTLIER_SIGMAS * 1.4826 * median(sizes, used), _MIN_OUTLIER_PX)
            for b in range(clusters + 1):
                if abs(by_boundary[0, b]) > most:
                    known[b] = False
                    rejected[b] = by_boundary[0, b]
            for i in range(n):
                own_motion[i] += by_value[0, i]
                by_value[1, i] = max(by_value[1, i] / max(noise, 1e-12), 1e-12)
            estimate_motion(own_motion, by_value[1], motion[1])
            for i in range(n):
                motion_so_far[0, i] = motion[0, i] + own_motion[i]
    for b in range(clusters + 1):
        by_boundary[0, b] += rejected[b]
    explained = residual_squares <= (1 - _MIN_EXPLAINED) * squares
    return assess_fit(by_boundary, scores, normal) if explained else _NO_FIT, by_boundary
