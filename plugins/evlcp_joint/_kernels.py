"""Where a bar's clusters lie, the values of its rows, and the fit of its boundaries: compiled."""

from math import exp, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk._kernels import factor_cholesky, median, solve_cholesky
from evlcp_sdk.kernels import njit

Array = NDArray[Any]

_FULL_EVENTS = 3.0
"""Events of a pixel in a chip that count as a full value: more come of a pixel that is too sensitive."""

_VEIL = 0.3
"""Share of the brightest column's events that do not count: a dirty lens veils a bar with as much."""

FITTED = 7
"""What is fitted: spacing, centre, drift, gain, width, and the shifts by sign and by repetition."""

_SHIFTING = (0, 1, 2, 5, 6)
"""Which of these shift a boundary."""

_NOISE = 0.25
"""Of a row's values, in full values, when that is weighed."""

_WIDTH_SIGMA = 0.3
"""How far the log of a boundary's width may lie from that of `blur_px` before data must speak for it."""

_SHIFT_SIGMA_PX = 0.1
"""How far boundaries are likely to be shifted by the sign of their step, and by values that are repeated."""

PRIOR = (
    *(0.0, 0.0, 0.0, 0.0, (_NOISE / _WIDTH_SIGMA) ** 2),
    *((_NOISE / _SHIFT_SIGMA_PX) ** 2, (_NOISE / _SHIFT_SIGMA_PX) ** 2),
)
"""Weights with which width and shifts are 0, beside those of a row's values."""

HUBER = 0.5
"""Residual, in full values, beyond which a row weighs less: a cluster decoded wrong does not bend the fit."""

REACH = 12.0
"""Widths of a boundary's core beyond which it is not felt: 6 of 100000 of tails thrice as wide are left."""

ROUNDING = 1e-8
"""Share of a diagonal that rounding may leave of nothing."""

_STEPS = 12
"""Newton steps at the most; from a start within a tenth of a spacing, four suffice."""

_ROUNDS = 2
"""Fits after the first, each with the motion and without the boundaries that the one before it showed."""

CLOSE, EXACT = 1e-3, 1e-5
"""Last step of the spacing, as a share of it, of a fit that others follow, and of the last one."""

_OUTLIER = 4.0
"""Standard deviations, by the median, beyond which a boundary is out of line: 1 of 16000 by chance."""

_LEAST_OUTLIER_PX = 0.25
"""What pixels that miss events do to a boundary now and then; less is never out of line."""

_LEAST_EXPLAINED = 0.3
"""Share of the values' energy that a fit explains at the least: fits of noise reach a tenth, and dim bars
in a bright scene three quarters."""


@njit
def find_middles(selected: Array, out: Array) -> bool:
    """Median row and column of each cluster's cells, `out` (K, 2), NaN without any.

    A median stays in a bar's image where a few cells are seen elsewhere.

    Returns:
        Whether they spread over more columns than rows.
    """
    clusters, rows, columns = selected.shape
    counts, extent = np.empty((2, max(rows, columns)), np.int64), np.zeros(2)
    for k in range(clusters):
        for i in range(counts.shape[1]):
            counts[0, i] = counts[1, i] = 0
        many = 0
        for r in range(rows):
            here = 0
            for c in range(columns):
                here += int(selected[k, r, c])
            counts[0, r] = here
            many += here
            if here:
                for c in range(columns):
                    counts[1, c] += int(selected[k, r, c])
        half = many / 2
        for axis in range(2):
            out[k, axis] = np.nan
            total = 0.0
            for i in range(counts.shape[1]):
                if total <= half < total + counts[axis, i]:
                    # The numbers of one bin lie evenly in it.
                    out[k, axis] = i - 0.5 + (half - total) / counts[axis, i]
                total += counts[axis, i]
    for axis in range(2):
        low, high = np.inf, -np.inf
        for k in range(clusters):
            if out[k, axis] == out[k, axis]:
                low, high = min(low, out[k, axis]), max(high, out[k, axis])
        extent[axis] = high - low
    return bool(extent[1] > extent[0])


@njit
def fit_line(middles: Array, line: Array) -> bool:
    """Robust line through clusters' middles (row, column), NaN of those not seen; False of fewer than three.

    `line` takes the row of the first cluster, the rows to the next, the column in row 0, and columns a row:
    lines through medians (Theil-Sen), of rows by clusters, and of columns by rows.
    """
    clusters = len(middles)
    points, values = np.empty((3, clusters)), np.empty(max(clusters * (clusters - 1) // 2, clusters))
    # A literal 0 would make a median of its own.
    n: Any = np.int64(0)
    for k in range(clusters):
        if middles[k, 0] == middles[k, 0]:
            points[0, n], points[1, n], points[2, n] = k, middles[k, 0], middles[k, 1]
            n += 1
    if n < 3:
        return False
    for axis in range(2):
        m: Any = np.int64(0)
        for i in range(n):
            for j in range(i + 1, n):
                apart = points[axis, j] - points[axis, i]
                if abs(apart) > 1e-9:
                    values[m] = (points[axis + 1, j] - points[axis + 1, i]) / apart
                    m += 1
        slope = median(values, m) if m else 0.0
        for i in range(n):
            values[i] = points[axis + 1, i] - slope * points[axis, i]
        line[2 * axis], line[2 * axis + 1] = median(values, n), slope
    return True


@njit
def find_line(selected: Array, grid: int, middles: Array, line: Array, seen: Array) -> bool:
    """Line of a bar along the rows of cells, `line` (5,) as `read_rows` takes it; False of fewer than three.

    `middles` (K, 2) are as of `find_middles`; they become those of each cluster's cells that lie where it is
    expected. `seen` (K,) takes which clusters have any.
    """
    if not fit_line(middles, line):
        return False
    clusters, rows, columns = selected.shape
    # A cluster is as long as the spacing; half of it and a cell of blur. Cells as wide as the bar is long are
    # looked at first: it is narrower.
    reach, half, wide = abs(line[1]) / 2 + 1, int(abs(line[1]) * clusters / 2) + 1, 0.0
    for again in range(2):
        across = np.zeros(2 * half + 1, np.int64)
        for k in range(clusters):
            expected = line[0] + k * line[1]
            n, sum_r, sum_c = 0, 0.0, 0.0
            for r in range(max(int(np.ceil(expected - reach)), 0), min(int(expected + reach), rows - 1) + 1):
                for c in range(columns):
                    if selected[k, r, c]:
                        off = int(np.rint(c - line[2] - line[3] * r))
                        if -half <= off <= half:
                            across[half + off] += 1
                            n += 1
                            sum_r += r
                            sum_c += c
            seen[k] = n > 0
            middles[k, 0] = sum_r / n if n else np.nan
            middles[k, 1] = sum_c / n if n else np.nan
        if not again:
            # The cells about the fullest that have three tenths of it: stray cells beside a bar, and the
            # dimmer ones of its reflection, are fewer or apart.
            fullest = 0
            for i in range(across.size):
                fullest = i if across[i] > across[fullest] else fullest
            low, high, least = fullest, fullest, 0.3 * across[fullest]
            while low > 0 and across[low - 1] >= least:
                low -= 1
            while high + 1 < across.size and across[high + 1] >= least:
                high += 1
            line[2] += (low + high) / 2 - half
            wide = (high - low) / 2
            half = int(wide + 1)
    if not fit_line(middles, line):
        return False
    # In pixels; in whole cells, as wide as the core is.
    middle = (grid - 1) / 2
    line[0], line[1] = line[0] * grid + middle, line[1] * grid
    line[2], line[4] = line[2] * grid + middle - line[3] * middle, (wide + 0.5) * grid
    return True


@njit
def read_rows(sums: Array, line: Array, clusters: int, out: Array) -> None:
    """Values of the rows of a bar, `out` (values, rows): of each value, the second chip's sums are taken.

    `line` (5,) is as of `fit_line`, in pixels, and half the width. Columns weigh by their light between the
    bar's ends; what has less than `_VEIL` of the brightest column's is its veil, or beside it.
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
        light[u] = max(light[u] - _VEIL * most, 0.0)
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
def measure_dim(sums: Array, pilots: Array, seen: Array, line: Array) -> float:
    """How often pixels in clusters' middles answer steps down, as a share of how often they answer steps up.

    A camera may miss more events of one polarity, and boundaries then show values of that sign smaller. Not
    how many events an answer has: a fast step up gives few and a slow one down many, but one of a pixel at a
    boundary, which sees a small part of the step, is one event or none. The half spacing of rows about each
    cluster's middle is asked, in its pilot, which comes first; `line` as of `read_rows`. 1 where nothing is
    known.
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


_MANY = 128
"""Steps across boundaries that are looked at together: columns of so many, in one array one after the other,
so that the compiler sees that none overlaps another and takes several at a time."""

_FIRST, _PLACE, _WHEN, _SIDE, _AGAIN, _STEP, _ROWS, _VALUE, _BOUNDARY, _ROW = [_MANY * n for n in range(10)]
"""Columns of a step: its first row from the middle of the bar, its boundary from there in spacings, its time,
what shifts it, its size, how many rows it has; its value, its boundary, and its first row in the image."""

_AT, _PART, _LEVEL, _STEEP, _LEFT, _COST = [_MANY * n for n in range(6)]
_SS, _SL, _SZ, _LL, _LZ, _ZZ, _S, _BY_LEVEL, _BY_Z = [_MANY * n for n in range(6, 15)]
"""Columns of what is computed of steps: the first six of a row, then sums over rows."""

_COLUMNS = 15


@njit
def list_steps(codes: Array, known: Array, motion: Array, reach: float, fit: Array, values: Array) -> Any:
    """All steps across boundaries, where codes differ, that have rows: (blocks, columns), and their values.

    `fit` is (spacing, centre, drift, gain, width, by sign, by repeat): boundary b between clusters b - 1 and
    b of K lies at spacing * (b - K / 2) from a centre that is centre + drift * when + offset from the middle
    row in a value, by `motion` (offset and when, values). Its rows are those within `reach` px, and nearest
    to it; there are none where `known` (K + 1, values) says that one of the two codes is not known.

    Sums of positive and of negative events are not alike, so a step up looks shifted to one side and a step
    down to the other. A cluster that repeats a value had another edge a chip before, whose late events, and
    the pixels that are blind from them, make it look smaller; nothing is known of what came before a frame.

    Returns:
        Steps, and their values (blocks, rows, `_MANY`), as many rows as the longest has. Steps that are none
        have no rows.
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
    blocks = -(-many // _MANY)
    steps, seen = np.zeros((blocks, 10 * _MANY)), np.zeros((blocks, longest, _MANY))
    step = 0
    for i in range(n):
        for b in range(1, clusters):
            here = last[i, b] - first[i, b]
            if here <= 0:
                continue
            block, j = step // _MANY, step % _MANY
            steps[block, _FIRST + j] = first[i, b] - (rows - 1) / 2 - motion[0, i]
            steps[block, _PLACE + j] = b - clusters / 2
            steps[block, _WHEN + j] = motion[1, i]
            steps[block, _SIDE + j] = 1.0 if codes[b, i] > codes[b - 1, i] else -1.0
            # Codes are 1 and -1, and differ across the boundary.
            steps[block, _AGAIN + j] = 0.5 * codes[b, i] * (codes[b, i - 1] + codes[b - 1, i - 1]) if i else 0
            steps[block, _STEP + j] = 0.5 * (codes[b, i] - codes[b - 1, i])
            steps[block, _ROWS + j], steps[block, _ROW + j] = here, first[i, b]
            steps[block, _VALUE + j], steps[block, _BOUNDARY + j] = i, b
            for r in range(here):
                seen[block, r, j] = values[i, first[i, b] + r]
            step += 1
    return steps, seen


@njit
def _levels(
    column: Array, fit: Array, row: int, lens: tuple[float, float], profile: Array, work: Array
) -> None:
    """What each step's boundary makes of a row, counted from its first, for a gain of 1, and the slope there.

    With the first row, how far that lies beyond the boundary. By straight pieces of the profile; `lens` as of
    `fit_bar`.
    """
    if row == 0:
        for j in range(_MANY):
            shift = fit[5] * column[_SIDE + j] + fit[6] * column[_AGAIN + j]
            at = fit[1] + fit[2] * column[_WHEN + j] + fit[0] * column[_PLACE + j] + shift
            work[_AT + j] = column[_FIRST + j] - at
    width, dim = lens[0] * exp(fit[4]), lens[1]
    scale, steepest = (profile.shape[1] - 1) / (REACH * width), fit[3] / width
    most = profile.shape[1] - 1 - 1e-9
    which = np.empty(_MANY, np.int32)
    for j in range(_MANY):
        at = min(abs(work[_AT + j] + row) * scale, most)
        which[j] = np.int32(at)
        work[_PART + j] = at - which[j]
    beyond, density = profile[0], profile[1]
    for j in range(_MANY):
        n, part = np.uint32(which[j]), work[_PART + j]
        after = n + np.uint32(1)
        work[_LEVEL + j] = beyond[n] + part * (beyond[after] - beyond[n])
        work[_STEEP + j] = density[n] + part * (density[after] - density[n])
    for j in range(_MANY):
        step = column[_STEP + j]
        # Codes are 1 and -1, and differ: their mean is 0.
        level = (step if work[_AT + j] + row > 0 else -step) * work[_LEVEL + j]
        less = dim if level < 0 else 1.0
        work[_LEVEL + j] = level * less
        work[_STEEP + j] = -steepest * step * work[_STEEP + j] * less


@njit
def equations(
    steps: Array,
    seen: Array,
    profile: Array,
    lens: tuple[float, float],
    fit: Array,
    normal: Array,
    right: Array,
) -> float:
    """Normal equations of a robust least-squares step, `normal` (7, 7), `right` (7,); the cost.

    Of `list_steps`, with the weights of `PRIOR`. Across a boundary where codes differ, a value goes from one
    code times the gain to the next as `profile` has it. Residuals beyond `HUBER` weigh less.
    """
    gain, cost, work = fit[3], 0.0, np.empty(_COLUMNS * _MANY)
    for a in range(FITTED):
        right[a] = -PRIOR[a] * fit[a]
        cost += PRIOR[a] * fit[a] ** 2 / 2
        for c in range(FITTED):
            normal[a, c] = PRIOR[a] if a == c else 0.0
    for block in range(len(steps)):
        column = steps[block]
        for j in range(_COST, _COLUMNS * _MANY):
            work[j] = 0.0
        for r in range(seen.shape[1]):
            value = seen[block, r]
            _levels(column, fit, r, lens, profile, work)
            for j in range(_MANY):
                z, level, steep = work[_AT + j] + r, work[_LEVEL + j], work[_STEEP + j]
                there = 1.0 if r < column[_ROWS + j] else 0.0
                residual = value[j] - gain * level
                size = abs(residual)
                weight = there * (1.0 if size <= HUBER else HUBER / size)
                loss = residual * residual / 2 if size <= HUBER else HUBER * (size - HUBER / 2)
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
        for j in range(_MANY):
            if column[_ROWS + j] == 0:
                break
            # In a boundary's rows of one value, five of the slopes go together: sums of what they share.
            place, when = column[_PLACE + j], column[_WHEN + j]
            side, again = column[_SIDE + j], column[_AGAIN + j]
            slope = (place, 1.0, when, 0.0, 0.0, side, again)
            for a in _SHIFTING:
                right[a] += slope[a] * work[_S + j]
                normal[3, a] += slope[a] * work[_SL + j]
                normal[4, a] += slope[a] * work[_SZ + j]
                for c in _SHIFTING:
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
    for a in _SHIFTING:
        normal[a, 3], normal[a, 4] = normal[3, a], normal[4, a]
        for c in _SHIFTING:
            normal[min(a, c), max(a, c)] = normal[max(a, c), min(a, c)]
    return cost


@njit
def leftovers(
    steps: Array,
    seen: Array,
    profile: Array,
    lens: tuple[float, float],
    fit: Array,
    by_boundary: Array,
    by_value: Array,
    scores: Array,
) -> tuple[float, float, float]:
    """What a fit leaves: shifts of each boundary and of each value, and each row's score.

    `by_boundary` (3, K + 1) and `by_value` (2, values) take the shift of the centre, px, and its information,
    in units of the variance of one value; the third row the sine of the boundary's places on the pixels, 0 in
    the middle of one, mean over its values; `scores` (rows, 7) the slopes times the residuals, clipped to
    `HUBER`, over a row's values, which share one pixel phase and so one error. Scores of no row ask for
    neither of these two.

    Returns:
        Mean square of the clipped residuals, sum of the squares of residuals, and of the values.
    """
    by_boundary[:], by_value[:], scores[:] = 0.0, 0.0, 0.0
    work, information = np.empty(_COLUMNS * _MANY), np.empty(_MANY)
    noise, spent, all_squares, count = 0.0, 0.0, 0.0, 0
    for block in range(len(steps)):
        column = steps[block]
        for j in range(_MANY):
            information[j] = 0.0
        for r in range(seen.shape[1]):
            _levels(column, fit, r, lens, profile, work)
            for j in range(_MANY):
                if r >= column[_ROWS + j]:
                    continue
                value, level, steep = seen[block, r, j], work[_LEVEL + j], work[_STEEP + j]
                residual = value - fit[3] * level
                spent += residual * residual
                all_squares += value * value
                residual = min(max(residual, -HUBER), HUBER)
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
                scores[v, 2] += pull * column[_WHEN + j]
                scores[v, 3] += level * residual
                scores[v, 4] += pull * (work[_AT + j] + r)
                scores[v, 5] += pull * column[_SIDE + j]
                scores[v, 6] += pull * column[_AGAIN + j]
        for j in range(_MANY):
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
    return noise / max(count, 1), spent, all_squares


@njit
def solve(
    steps: Array,
    seen: Array,
    profile: Array,
    lens: tuple[float, float],
    tolerance: float,
    fit: Array,
    normal: Array,
) -> bool:
    """Levenberg-Marquardt from `fit`, which is changed; False where there is no fit.

    It ends with a step of the spacing below `tolerance` of it, or after `_STEPS`; `normal` (7, 7) are the
    normal equations there.
    """
    right, new_normal, new_right = np.empty(FITTED), np.empty((FITTED, FITTED)), np.empty(FITTED)
    factor, scale = np.empty((FITTED, FITTED)), np.empty(FITTED)
    move, new_fit = np.empty(FITTED), np.empty(FITTED)
    cost = equations(steps, seen, profile, lens, fit, normal, right)
    damping = 1e-3
    outside = False
    for _ in range(_STEPS):
        if not factor_cholesky(normal, damping, ROUNDING, scale, factor):
            return False
        solve_cholesky(factor, scale, right, move)
        for a in range(FITTED):
            new_fit[a] = fit[a] + move[a]
            if not np.isfinite(new_fit[a]):
                return False
        # A spacing below a pixel, or a boundary seven times as wide as a lens makes it, is none; a long step
        # may lead there where a shorter one does not.
        outside = new_fit[0] < 1 or abs(new_fit[4]) > 2
        new_cost = np.inf
        if not outside:
            new_cost = equations(steps, seen, profile, lens, new_fit, new_normal, new_right)
        if new_cost <= cost:
            for a in range(FITTED):
                fit[a], right[a] = new_fit[a], new_right[a]
                for c in range(FITTED):
                    normal[a, c] = new_normal[a, c]
            cost = new_cost
            damping /= 10
            if abs(move[0]) < tolerance * fit[0]:
                return True
        else:
            damping *= 10
    return not outside


@njit
def own_motion(shift: Array, information: Array, when: Array, out: Array) -> None:
    """What each value's shift says of motion that is not a steady drift, as far as it is more than noise.

    The shifts' variance beyond that of noise weighs each against the expectation of no motion (empirical
    Bayes). `out` may be `shift`.
    """
    total, sum_shift, sum_when = 0.0, 0.0, 0.0
    for i in range(shift.size):
        weight = max(information[i], 1e-12)
        total += weight
        sum_shift += weight * shift[i]
        sum_when += weight * when[i]
    mean_shift, mean_when = sum_shift / total, sum_when / total
    together, spread, squares = 0.0, 0.0, 0.0
    for i in range(shift.size):
        weight, lever = max(information[i], 1e-12), when[i] - mean_when
        together += weight * lever * (shift[i] - mean_shift)
        spread += weight * lever * lever
    for i in range(shift.size):
        out[i] = shift[i] - mean_shift - (when[i] - mean_when) * together / spread
        squares += max(information[i], 1e-12) * out[i] * out[i]
    variance = (squares - (shift.size - 2)) / total
    for i in range(shift.size):
        noise = 1 / max(information[i], 1e-12)
        out[i] = out[i] * variance / (variance + noise) if variance > 0 else 0.0


@njit
def assess_fit(by_boundary: Array, scores: Array, normal: Array) -> tuple[float, int, float]:
    """Variance of the spacing, px2, of `leftovers`; NaN where the normal equations have no root.

    The mean of that by rows as observations (sandwich estimator) and that by the scatter of the boundaries.

    Returns:
        It; how many boundaries there are; and how much larger a wave in their places on the pixels, 1 px
        high, makes the spacing, px.
    """
    inverse, scale, unit = np.empty(FITTED), np.empty(FITTED), np.zeros(FITTED)
    factor = np.empty((FITTED, FITTED))
    if not factor_cholesky(normal, 0.0, ROUNDING, scale, factor):
        return np.nan, 0, 0.0
    # The spacing's row of the inverse: one column of it, as that is symmetric.
    unit[0] = 1.0
    solve_cholesky(factor, scale, unit, inverse)
    by_row, rows = 0.0, 0
    for v in range(len(scores)):
        part = 0.0
        for a in range(FITTED):
            part += scores[v, a] * inverse[a]
        by_row += part * part
        rows += scores[v, 3] != 0
    n, total, mean, spread, left_over, wave = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    for b in range(by_boundary.shape[1]):
        weight = by_boundary[1, b]
        n += weight > 0
        total += weight
        mean += weight * b
        left_over += weight * by_boundary[0, b] ** 2
    mean /= total
    for b in range(by_boundary.shape[1]):
        pull = by_boundary[1, b] * (b - mean)
        spread += pull * (b - mean)
        wave += pull * by_boundary[2, b]
    if spread <= 0:
        return np.nan, n, 0.0
    variance = (by_row * rows / max(rows - FITTED, 1) + left_over / max(n - 2, 1) / spread) / 2
    return variance, n, wave / spread


_NO_FIT = (np.nan, 0, 0.0)
"""As `assess_fit` has it, of no boundaries."""


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
    """Fit again and again, each time with the motion and without the boundaries that the last one showed.

    Args:
        decoded: Pilots (K, values) and words (symbols, values), their values -1 and 1; the symbol of each
            cluster, int64 (K,), -1 of those not known, of which the pilot counts alone; which are seen (K,).
        offset_px: Of the centre in each chip, rows, (chips,), two of a value. Images are held still by whole
            pixels, so these jump by one.
        values: Of each row, (values, rows).
        profile: To one side of a boundary, -1 to 1, and its slope, (2, n), from 0 to `REACH` widths.
        lens: A boundary's width, px, of which `fit` has the logarithm of what it is more; and how large
            negative values are, as a share of positive ones.
        least: Boundaries that a fit needs.
        fit: What it begins with; changed.

    Returns:
        As `assess_fit`, NaN without a fit; and `by_boundary` of `leftovers`, with the shifts of boundaries
        that are left out, too, without information.
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
    by_boundary, by_value = np.empty((3, clusters + 1)), np.empty((2, n))
    scores, normal = np.empty((values.shape[1], FITTED)), np.empty((FITTED, FITTED))
    moved, own, sizes = motion.copy(), np.zeros(n), np.empty(clusters + 1)
    left_out = np.zeros(clusters + 1)
    spent, squares = 0.0, 0.0
    for left in range(_ROUNDS, -1, -1):
        reach = REACH * lens[0] * exp(fit[4])
        steps, rows = list_steps(codes, known, moved, reach, fit, values)
        if not solve(steps, rows, profile, lens, CLOSE if left else EXACT, fit, normal):
            return _NO_FIT, by_boundary
        asked = scores[: 0 if left else len(scores)]
        noise, spent, squares = leftovers(steps, rows, profile, lens, fit, by_boundary, by_value, asked)
        used: Any = np.int64(0)
        for b in range(clusters + 1):
            if by_boundary[1, b] > 0:
                sizes[used] = abs(by_boundary[0, b])
                used += 1
        if used < least:
            return _NO_FIT, by_boundary
        if left:
            most = max(_OUTLIER * 1.4826 * median(sizes, used), _LEAST_OUTLIER_PX)
            for b in range(clusters + 1):
                if abs(by_boundary[0, b]) > most:
                    known[b] = False
                    left_out[b] = by_boundary[0, b]
            for i in range(n):
                own[i] += by_value[0, i]
                by_value[1, i] /= max(noise, 1e-12)
            own_motion(own, by_value[1], motion[1], own)
            for i in range(n):
                moved[0, i] = motion[0, i] + own[i]
    for b in range(clusters + 1):
        by_boundary[0, b] += left_out[b]
    explained = spent <= (1 - _LEAST_EXPLAINED) * squares
    return assess_fit(by_boundary, scores, normal) if explained else _NO_FIT, by_boundary
