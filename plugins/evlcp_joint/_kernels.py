"""Where a bar's clusters lie, the values of its rows, and the fit of its boundaries: compiled."""

from math import exp, sin, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk._kernels import _median, rooted, substituted
from evlcp_sdk.kernels import njit

Array = NDArray[Any]


@njit
def cell_medians(selected: Array, out: Array) -> None:
    """Median row and column of each cluster's cells, `out` (K, 2); NaN without any.

    A median stays in a bar's image where a few cells are seen elsewhere.
    """
    clusters, rows, columns = selected.shape
    by_row = np.empty(rows, np.int64)
    by_column = np.empty(columns, np.int64)
    for k in range(clusters):
        for r in range(rows):
            by_row[r] = 0
        for c in range(columns):
            by_column[c] = 0
        for r in range(rows):
            row = selected[k, r]
            for c in range(columns):
                by_row[r] += np.int64(row[c])
            if by_row[r]:
                for c in range(columns):
                    by_column[c] += np.int64(row[c])
        out[k, 0] = _middle(by_row)
        out[k, 1] = _middle(by_column)


@njit
def _middle(counts: Array) -> float:
    """Median of the numbers 0, 1, ... that occur `counts` times; NaN of none."""
    many = 0
    for i in range(counts.size):
        many += counts[i]
    half = many / 2
    if half == 0:
        return np.nan
    total = 0.0
    for i in range(counts.size):
        if total <= half < total + counts[i]:
            # The numbers of one bin lie evenly in it.
            return float(i - 0.5 + (half - total) / counts[i])
        total += counts[i]
    return float(counts.size - 1)


@njit
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
    for i in range(across.size):
        across[i] = 0
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


@njit
def straight(x: Array, y: Array) -> tuple[float, float]:
    """Slope and intercept of the line through the medians (Theil-Sen), robust against outliers."""
    n = x.size
    values = np.empty(max(n * (n - 1) // 2, n))
    # A literal 0 would make a median of its own.
    m: Any = np.int64(0)
    for i in range(n):
        for j in range(i + 1, n):
            if abs(x[j] - x[i]) > 1e-9:
                values[m] = (y[j] - y[i]) / (x[j] - x[i])
                m += 1
    slope = _median(values, m) if m else 0.0
    for i in range(n):
        values[i] = y[i] - slope * x[i]
    return slope, _median(values, n)


@njit
def core_of(counts: Array) -> tuple[float, float]:
    """Middle and half the extent of the cells about the fullest that have three tenths of it.

    The middle is given from that of `counts`. Stray cells beside a bar, and the dimmer ones of its
    reflection, are fewer or apart.
    """
    peak = 0
    for i in range(1, counts.size):
        if counts[i] > counts[peak]:
            peak = i
    low, high = peak, peak
    while low > 0 and counts[low - 1] >= 0.3 * counts[peak]:
        low -= 1
    while high + 1 < counts.size and counts[high + 1] >= 0.3 * counts[peak]:
        high += 1
    return (low + high) / 2 - counts.size // 2, (high - low) / 2


@njit
def lies_across(middles: Array) -> bool:
    """Whether middles (row, column) spread over more columns than rows; NaN are passed over."""
    extent_of_rows = 0.0
    for a in range(2):
        low, high = np.inf, -np.inf
        for k in range(len(middles)):
            if not np.isnan(middles[k, a]):
                low = min(low, middles[k, a])
                high = max(high, middles[k, a])
        if a == 0:
            extent_of_rows = high - low
    return bool(high - low > extent_of_rows)


@njit
def line_of_cells(selected: Array, middles: Array, line: Array, seen: Array) -> bool:
    """Line of a bar's cells; False with fewer than three clusters in it.

    `line` (5,) takes the row of the first cluster, the rows to the next, the column in row 0, columns a row,
    and half the width, all in cells. `middles` (K, 2) are medians of each cluster's cells, NaN without any;
    `seen` (K,) says which clusters have cells in their place.
    """
    clusters = len(selected)
    places, by_row, by_column = np.empty(clusters), np.empty(clusters), np.empty(clusters)
    n = _known(middles, places, by_row, by_column)
    if n < 3:
        return False
    spacing, first = straight(places[:n], by_row[:n])
    tilt, left = straight(by_row[:n], by_column[:n])
    # Cells as wide as the bar is long are looked at: it is narrower.
    counts = np.empty(2 * int(abs(spacing) * clusters / 2) + 3, np.int64)
    found = np.empty((clusters, 2))
    # A cluster is as long as the spacing; half of it and a cell of blur.
    reach = abs(spacing) / 2 + 1
    cells_in_place(selected, (first, spacing, left, tilt), reach, counts, found)
    shift, half = core_of(counts)
    counts = np.empty(2 * int(half + 1) + 1, np.int64)
    cells_in_place(selected, (first, spacing, left + shift, tilt), reach, counts, found)
    for k in range(clusters):
        seen[k] = not np.isnan(found[k, 0])
    n = _known(found, places, by_row, by_column)
    if n < 3:
        return False
    line[1], line[0] = straight(places[:n], by_row[:n])
    line[3], line[2] = straight(by_row[:n], by_column[:n])
    line[4] = half
    return True


@njit
def lie_of_cells(selected: Array, line: Array, seen: Array) -> int:
    """Whether a bar's cells lie along the image's rows, 1, across them, 2, or nowhere, 0: `line_of_cells`."""
    middles = np.empty((len(selected), 2))
    cell_medians(selected, middles)
    if not lies_across(middles):
        return 1 if line_of_cells(selected, middles, line, seen) else 0
    clusters, rows, columns = selected.shape
    turned = np.empty((clusters, columns, rows), np.bool_)
    for k in range(clusters):
        middles[k, 0], middles[k, 1] = middles[k, 1], middles[k, 0]
        for c in range(columns):
            for r in range(rows):
                turned[k, c, r] = selected[k, r, c]
    return 2 if line_of_cells(turned, middles, line, seen) else 0


@njit
def _known(middles: Array, places: Array, by_row: Array, by_column: Array) -> int:
    """How many clusters have a middle; which, and its row and column, come first in the others."""
    n = 0
    for k in range(len(middles)):
        if not np.isnan(middles[k, 0]):
            places[n], by_row[n], by_column[n] = k, middles[k, 0], middles[k, 1]
            n += 1
    return n


@njit
def codes_said(pilots: Array, words: Array, symbols: Array, seen: Array, codes: Array, known: Array) -> None:
    """What each cluster says in a frame, `codes` (K, values), and between which it is known, (K + 1, values).

    A boundary lies between clusters that are seen; in info values, those whose symbol is known, too.
    """
    clusters, first = pilots.shape
    boundaries, values = known.shape
    for k in range(boundaries):
        for i in range(values):
            known[k, i] = False
    for k in range(clusters):
        for i in range(first):
            codes[k, i] = pilots[k, i]
        for i in range(first, values):
            codes[k, i] = words[max(symbols[k], 0), i - first]
        if k > 0 and seen[k] and seen[k - 1]:
            said = symbols[k] >= 0 and symbols[k - 1] >= 0
            for i in range(values):
                known[k, i] = i < first or said


@njit
def column_light(sums: Array, line: Array, top: int, bottom: int, full: float, out: Array) -> None:
    """Mean size of the clipped sums beside a bar's line, from rows `top` to `bottom`, by pixels from it.

    The middle of `out` is the line, column = line[0] + line[1] * row; of a value, the second chip is taken,
    and a sum of `full` events or more counts as 1.
    """
    chips, _, width = sums.shape
    half, share = out.size // 2, 1 / full
    for u in range(out.size):
        out[u] = 0.0
    for v in range(top, bottom + 1):
        centre = int(np.rint(line[0] + line[1] * v))
        first, last = max(centre - half, 0), min(centre + half, width - 1)
        if first > last:
            continue
        light = out[half + first - centre :]
        for i in range(1, chips, 2):
            # One index, so that columns go side by side.
            row = sums[i, v, first : last + 1]
            for u in range(row.size):
                light[u] += min(abs(row[u]) * share, 1.0)
    for u in range(out.size):
        out[u] /= max((bottom - top + 1) * (chips // 2), 1)


@njit
def row_values(sums: Array, line: Array, weight: Array, full: float, out: Array) -> None:
    """Weighted mean of each row's clipped sums in every value's second chip, `out` (values, rows).

    The middle of `weight` is the bar's line, column = line[0] + line[1] * row; a sum of `full` events or more
    counts as 1.
    """
    values, rows = out.shape
    width = sums.shape[2]
    half, share = weight.size // 2, 1 / full
    for v in range(rows):
        centre = int(np.rint(line[0] + line[1] * v))
        first, last = max(centre - half, 0), min(centre + half, width - 1)
        # The columns whose weight is not 0, which are few of a bar's seam.
        while first <= last and weight[half + first - centre] == 0:
            first += 1
        while first <= last and weight[half + last - centre] == 0:
            last -= 1
        mass = 0.0
        for u in range(first, last + 1):
            mass += weight[half + u - centre]
        one = 1 / max(mass, 1e-12)
        for i in range(values):
            total = 0.0
            for u in range(first, last + 1):
                total += weight[half + u - centre] * min(max(sums[2 * i + 1, v, u] * share, -1.0), 1.0)
            out[i, v] = total * one


@njit
def bar_values(
    sums: Array,
    line: Array,
    half_width: float,
    one_end: float,
    other_end: float,
    full: float,
    veil: float,
    out: Array,
) -> None:
    """Values of the rows of a bar, `out` (values, rows), columns weighed by their light between its ends.

    What has less than `veil` of the brightest column's light is its veil, or beside it.
    """
    rows = out.shape[1]
    top, bottom = max(int(min(one_end, other_end)), 0), min(int(max(one_end, other_end)), rows - 1)
    light = np.empty(2 * int(half_width) + 3)
    column_light(sums, line, top, bottom, full, light)
    most = light[0]
    for u in range(1, light.size):
        most = max(most, light[u])
    for u in range(light.size):
        light[u] = max(light[u] - veil * most, 0.0)
    row_values(sums, line, light, full, out)


@njit
def dimmer(sums: Array, pilots: Array, seen: Array, place: Array) -> float:
    """How often pixels in clusters' middles answer steps down, as a share of how often they answer steps up.

    A camera may miss more events of one polarity, and boundaries then show values of that sign smaller. Not
    how many events an answer has: a fast step up gives few and a slow one down many, but one of a pixel at a
    boundary, which sees a small part of the step, is one event or none. The half spacing of rows about each
    cluster's middle is asked, in its pilot, which comes first; `place` as of `read_bar`. 1 where nothing is
    known.
    """
    _, rows, columns = sums.shape
    half, reach = int(place[4]), abs(place[1]) / 4
    answers, asked = np.zeros(2), np.zeros(2)
    for k in range(len(pilots)):
        if not seen[k]:
            continue
        middle = place[0] + place[1] * k
        for v in range(max(int(np.ceil(middle - reach)), 0), min(int(middle + reach), rows - 1) + 1):
            centre = int(np.rint(place[2] + place[3] * v))
            for u in range(max(centre - half, 0), min(centre + half, columns - 1) + 1):
                for i in range(pilots.shape[1]):
                    up = int(pilots[k, i] > 0)
                    asked[up] += 1
                    answers[up] += sums[2 * i + 1, v, u] > 0 if up else sums[2 * i + 1, v, u] < 0
    if answers[1] == 0 or asked[0] == 0:
        return 1.0
    return float(answers[0] / asked[0] / (answers[1] / asked[1]))


@njit
def read_bar(
    sums: Array,
    pilots: Array,
    words: Array,
    symbols: Array,
    seen: Array,
    place: Array,
    full: float,
    veil: float,
    codes: Array,
    known: Array,
    moved: Array,
    values: Array,
) -> float:
    """`codes_said`, `bar_values` and `dimmer`; values and motion turned if the bar is upside down.

    `place` (5,) is the row of the first cluster's middle, the rows to the next, less than 0 of a bar upside
    down, the column in row 0, columns a row, and half the width.
    """
    clusters = len(pilots)
    codes_said(pilots, words, symbols, seen, codes, known)
    first, spacing = place[0], place[1]
    one, other = first - 0.5 * spacing, first + (clusters - 0.5) * spacing
    bar_values(sums, place[2:4], place[4], one, other, full, veil, values)
    if spacing < 0:
        # Arrays as a whole take a second and a half to compile.
        rows = values.shape[1]
        for k in range(len(moved)):
            moved[k] = -moved[k]
        for k in range(len(values)):
            for r in range(rows // 2):
                values[k, r], values[k, rows - 1 - r] = values[k, rows - 1 - r], values[k, r]
    return dimmer(sums, pilots, seen, place)


_FITTED = 7
"""What is fitted: spacing, centre, drift, gain, width, and the two shifts of `shifts_of`."""

_ROUNDING = 1e-8
"""Share of a diagonal that rounding may leave of nothing."""

_SHIFTING = (0, 1, 2, 5, 6)
"""Which of these shift a boundary."""

_REACH = 12.0
"""Widths of a boundary's core beyond which it is not felt: 6 of 100000 of tails thrice as wide are left."""


@njit
def rows_felt(
    known: Array, offset: Array, when: Array, reach: float, fit: Array, rows: int, first: Array, last: Array
) -> None:
    """Rows within `reach` px of a boundary in a value, and nearest to it: from `first` to `last` - 1.

    `fit` is (spacing, centre, drift, gain, width, by sign, by repeat): boundary b between clusters b - 1 and
    b of K lies at spacing * (b - K / 2) from a centre that is centre + drift * when[i] + offset[i] from the
    middle row in value i, but for what `shifts_of` says, which is less than a row. `first` and `last` are
    (K + 1, values), and there are none where `known`, the same, says that one of the two codes is not known.
    """
    boundaries, values = known.shape
    spacing, centre, drift = fit[0], fit[1], fit[2]
    half = min(reach, spacing / 2)
    for i in range(values):
        middle = (rows - 1) / 2 + offset[i] + centre + drift * when[i]
        for b in range(boundaries):
            first[b, i] = last[b, i] = 0
            if known[b, i]:
                place = middle + spacing * (b - (boundaries - 1) / 2)
                first[b, i] = min(max(int(np.ceil(place - half)), 0), rows)
                last[b, i] = min(max(int(np.ceil(place + half)), 0), rows)


@njit
def shifts_of(codes: Array, b: int, i: int) -> tuple[float, float]:
    """What shifts boundary b in value i: whether its step is up, and which side repeats its last value.

    Sums of positive and of negative events are not alike, so a step up looks shifted to one side and a step
    down to the other. A cluster that repeats a value had another edge a chip before, whose late events, and
    the pixels that are blind from them, make it look smaller. Nothing is known of what came before a frame.
    """
    side = 1.0 if codes[b, i] > codes[b - 1, i] else -1.0
    if i == 0:
        return side, 0.0
    # Codes are 1 and -1, and differ across the boundary.
    return side, 0.5 * codes[b, i] * (codes[b, i - 1] + codes[b - 1, i - 1])


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
def _steps_of(codes: Array, first: Array, last: Array, offset: Array, when: Array, seen_values: Array) -> Any:
    """All steps across boundaries, where codes differ, that have rows: (blocks, columns), and their values.

    Those are (blocks, rows, `_MANY`), as many rows as the longest has. Steps that are none have no rows.
    """
    clusters, values = codes.shape
    rows, many, longest = seen_values.shape[1], 0, 0
    for i in range(values):
        for b in range(1, clusters):
            if codes[b, i] != codes[b - 1, i] and last[b, i] > first[b, i]:
                many += 1
                longest = max(longest, last[b, i] - first[b, i])
    blocks = -(-many // _MANY)
    steps, seen = np.zeros((blocks, 10 * _MANY)), np.zeros((blocks, longest, _MANY))
    n = 0
    for i in range(values):
        for b in range(1, clusters):
            here = last[b, i] - first[b, i]
            if codes[b, i] == codes[b - 1, i] or here <= 0:
                continue
            column, j = steps[n // _MANY], n % _MANY
            side, again = shifts_of(codes, b, i)
            column[_FIRST + j] = first[b, i] - (rows - 1) / 2 - offset[i]
            column[_PLACE + j] = b - clusters / 2
            column[_WHEN + j] = when[i]
            column[_SIDE + j], column[_AGAIN + j] = side, again
            column[_STEP + j] = 0.5 * (codes[b, i] - codes[b - 1, i])
            column[_ROWS + j] = here
            column[_VALUE + j], column[_BOUNDARY + j], column[_ROW + j] = i, b, first[b, i]
            for r in range(here):
                seen[n // _MANY, r, j] = seen_values[i, first[b, i] + r]
            n += 1
    return steps, seen


@njit(error_model="numpy")
def _begin(column: Array, fit: Array, work: Array) -> None:
    """How far the first row of each step lies beyond its boundary; all sums 0."""
    spacing, centre, drift, side, again = fit[0], fit[1], fit[2], fit[5], fit[6]
    for j in range(_MANY):
        shift = side * column[_SIDE + j] + again * column[_AGAIN + j]
        at = centre + drift * column[_WHEN + j] + spacing * column[_PLACE + j] + shift
        work[_AT + j] = column[_FIRST + j] - at
    for j in range(_COST, _COLUMNS * _MANY):
        work[j] = 0.0


@njit(error_model="numpy")
def _levels(
    column: Array, row: float, scale: float, steepest: float, dim: float, profile: Array, work: Array
) -> None:
    """What each step's boundary makes of a row, counted from its first, for a gain of 1, and the slope there.

    By straight pieces of the profile, `scale` a px; negative levels are `dim` times as large.
    """
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


@njit(error_model="numpy")
def _add_row(column: Array, row: float, seen: Array, gain: float, huber: float, work: Array) -> None:
    """Add what a row of each step has to its sums."""
    for j in range(_MANY):
        z, level, steep = work[_AT + j] + row, work[_LEVEL + j], work[_STEEP + j]
        there = 1.0 if row < column[_ROWS + j] else 0.0
        residual = seen[j] - gain * level
        size = abs(residual)
        weight = there * (1.0 if size <= huber else huber / size)
        cost = residual * residual / 2 if size <= huber else huber * (size - huber / 2)
        pull = weight * steep
        work[_COST + j] += there * cost
        work[_SS + j] += pull * steep
        work[_SL + j] += pull * level
        work[_SZ + j] += pull * steep * z
        work[_LL + j] += weight * level * level
        work[_LZ + j] += pull * z * level
        work[_ZZ + j] += pull * z * steep * z
        work[_S + j] += pull * residual
        work[_BY_LEVEL + j] += weight * level * residual
        work[_BY_Z + j] += pull * z * residual


@njit
def equations(
    codes: Array,
    first: Array,
    last: Array,
    offset: Array,
    when: Array,
    profile: Array,
    blur: float,
    dim: float,
    huber: float,
    prior: Array,
    seen_values: Array,
    fit: Array,
    normal: Array,
    right: Array,
) -> float:
    """Normal equations of a robust least-squares step, `normal` (7, 7), `right` (7,); the cost.

    Across a boundary where codes differ, a value goes from one code times the gain to the next as `profile`
    has it: that and its slope, (2, n), at n steps from 0 to `_REACH` widths; a width is blur * exp(width) px.
    Residuals beyond `huber` weigh less, so that a cluster that was decoded wrong does not bend the fit.
    `prior` (7,) are the weights of each being 0; negative values are `dim` times as large as positive ones.
    """
    steps, seen = _steps_of(codes, first, last, offset, when, seen_values)
    work = np.empty(_COLUMNS * _MANY)
    return _equations(steps, seen, profile, blur, dim, huber, prior, fit, normal, right, work)


@njit
def _equations(
    steps: Array,
    seen: Array,
    profile: Array,
    blur: float,
    dim: float,
    huber: float,
    prior: Array,
    fit: Array,
    normal: Array,
    right: Array,
    work: Array,
) -> float:
    """`equations` of `_steps_of`."""
    gain, width = fit[3], blur * exp(fit[4])
    scale, steepest = (profile.shape[1] - 1) / (_REACH * width), gain / width
    for a in range(_FITTED):
        right[a] = 0.0
        for c in range(_FITTED):
            normal[a, c] = 0.0
    cost = 0.0
    for block in range(len(steps)):
        column = steps[block]
        _begin(column, fit, work)
        for r in range(seen.shape[1]):
            _levels(column, float(r), scale, steepest, dim, profile, work)
            _add_row(column, float(r), seen[block, r], gain, huber, work)
        for j in range(_MANY):
            if column[_ROWS + j] == 0:
                break
            # In a boundary's rows of one value, five of the slopes go together: sums of what they share.
            slope = (
                column[_PLACE + j],
                1.0,
                column[_WHEN + j],
                0.0,
                0.0,
                column[_SIDE + j],
                column[_AGAIN + j],
            )
            for a in _SHIFTING:
                right[a] += slope[a] * work[_S + j]
                normal[3, a] += slope[a] * work[_SL + j]
                normal[4, a] += slope[a] * work[_SZ + j]
                for c in _SHIFTING:
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
    for a in range(_FITTED):
        normal[a, a] += prior[a]
        right[a] -= prior[a] * fit[a]
        cost += prior[a] * fit[a] ** 2 / 2
    return float(cost)


@njit
def leftovers(
    codes: Array,
    first: Array,
    last: Array,
    offset: Array,
    when: Array,
    profile: Array,
    blur: float,
    dim: float,
    huber: float,
    seen_values: Array,
    fit: Array,
    by_boundary: Array,
    by_value: Array,
    scores: Array,
) -> tuple[float, float, float]:
    """What a fit leaves: shifts of each boundary and of each value, and each row's score.

    `by_boundary` (2 or 3, K + 1) and `by_value` (2, values) take the shift of the centre, px, and its
    information, in units of the variance of one value; a third row the sine of the boundary's places on the
    pixels, 0 in the middle of one, mean over its values; `scores` (rows, 7) the slopes times the residuals,
    clipped to `huber`, over a row's values, which share one pixel phase and so one error.

    Returns:
        Mean square of the clipped residuals, sum of the squares of residuals, and of the values.
    """
    clusters, values = codes.shape
    gain, width = fit[3], blur * exp(fit[4])
    scale, steepest = (profile.shape[1] - 1) / (_REACH * width), gain / width
    for b in range(clusters + 1):
        for a in range(len(by_boundary)):
            by_boundary[a, b] = 0.0
    for i in range(values):
        by_value[0, i] = by_value[1, i] = 0.0
    for v in range(seen_values.shape[1]):
        for a in range(_FITTED):
            scores[v, a] = 0.0
    steps, seen = _steps_of(codes, first, last, offset, when, seen_values)
    work, told = np.empty(_COLUMNS * _MANY), np.empty(_MANY)
    noise, spent, all_squares, count = 0.0, 0.0, 0.0, 0
    for block in range(len(steps)):
        column = steps[block]
        _begin(column, fit, work)
        for j in range(_MANY):
            told[j] = 0.0
        for r in range(seen.shape[1]):
            _levels(column, float(r), scale, steepest, dim, profile, work)
            for j in range(_MANY):
                if r >= column[_ROWS + j]:
                    continue
                value, level, steep = seen[block, r, j], work[_LEVEL + j], work[_STEEP + j]
                residual = value - gain * level
                spent += residual * residual
                all_squares += value * value
                residual = min(max(residual, -huber), huber)
                noise += residual * residual
                count += 1
                i, b, v = int(column[_VALUE + j]), int(column[_BOUNDARY + j]), int(column[_ROW + j]) + r
                pull = steep * residual
                by_boundary[0, b] += pull
                by_boundary[1, b] += steep * steep
                by_value[0, i] += pull
                by_value[1, i] += steep * steep
                scores[v, 0] += pull * column[_PLACE + j]
                scores[v, 1] += pull
                scores[v, 2] += pull * column[_WHEN + j]
                scores[v, 3] += level * residual
                scores[v, 4] += pull * (work[_AT + j] + r)
                scores[v, 5] += pull * column[_SIDE + j]
                scores[v, 6] += pull * column[_AGAIN + j]
                told[j] += steep * steep
        if len(by_boundary) > 2:
            for j in range(_MANY):
                if told[j] > 0:
                    turned = told[j] * sin(2 * np.pi * work[_AT + j])
                    by_boundary[2, int(column[_BOUNDARY + j])] -= turned
    for b in range(clusters + 1):
        for a in range(0, len(by_boundary), 2):
            by_boundary[a, b] /= max(by_boundary[1, b], 1e-12)
    for i in range(values):
        by_value[0, i] /= max(by_value[1, i], 1e-12)
    return noise / max(count, 1), spent, all_squares


@njit
def solve(
    codes: Array,
    known: Array,
    offset: Array,
    when: Array,
    profile: Array,
    blur: float,
    dim: float,
    huber: float,
    prior: Array,
    seen_values: Array,
    steps: int,
    tolerance: float,
    fit: Array,
    normal: Array,
    first: Array,
    last: Array,
) -> bool:
    """Levenberg-Marquardt from `fit`, which is changed; False where there is no fit.

    It ends with a step of the spacing below `tolerance` of it, or after `steps`; `normal` (7, 7) are the
    normal equations there, and `first`, `last` (K + 1, values) the rows that count: those that the start's
    boundaries are felt in.
    """
    rows = seen_values.shape[1]
    rows_felt(known, offset, when, _REACH * blur * exp(fit[4]), fit, rows, first, last)
    right, new_normal, new_right = np.empty(_FITTED), np.empty((_FITTED, _FITTED)), np.empty(_FITTED)
    factor, move, new_fit = np.empty((_FITTED, _FITTED)), np.empty(_FITTED), np.empty(_FITTED)
    all_steps, seen = _steps_of(codes, first, last, offset, when, seen_values)
    work = np.empty(_COLUMNS * _MANY)
    cost = _equations(all_steps, seen, profile, blur, dim, huber, prior, fit, normal, right, work)
    scale = np.empty(_FITTED)
    damping = 1e-3
    outside = False
    for _ in range(steps):
        if not rooted(normal, damping, _ROUNDING, scale, factor):
            return False
        substituted(factor, scale, right, move)
        for a in range(_FITTED):
            new_fit[a] = fit[a] + move[a]
            if not np.isfinite(new_fit[a]):
                return False
        # A spacing below a pixel, or a boundary seven times as wide as a lens makes it, is none; a long step
        # may lead there where a shorter one does not.
        outside = new_fit[0] < 1 or abs(new_fit[4]) > 2
        new_cost = np.inf
        if not outside:
            new_cost = _equations(
                all_steps, seen, profile, blur, dim, huber, prior, new_fit, new_normal, new_right, work
            )
        if new_cost <= cost:
            for a in range(_FITTED):
                fit[a], right[a] = new_fit[a], new_right[a]
                for c in range(_FITTED):
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
    Bayes).
    """
    total, sum_shift, sum_when = 0.0, 0.0, 0.0
    for i in range(shift.size):
        weight = max(information[i], 1e-12)
        total += weight
        sum_shift += weight * shift[i]
        sum_when += weight * when[i]
    mean_shift, mean_when = sum_shift / total, sum_when / total
    together, spread = 0.0, 0.0
    for i in range(shift.size):
        weight, lever = max(information[i], 1e-12), when[i] - mean_when
        together += weight * lever * (shift[i] - mean_shift)
        spread += weight * lever * lever
    slope, squares = together / spread, 0.0
    for i in range(shift.size):
        beyond = shift[i] - mean_shift - (when[i] - mean_when) * slope
        squares += max(information[i], 1e-12) * beyond * beyond
    variance = (squares - (shift.size - 2)) / total
    for i in range(shift.size):
        beyond = shift[i] - mean_shift - (when[i] - mean_when) * slope
        noise = 1 / max(information[i], 1e-12)
        out[i] = beyond * variance / (variance + noise) if variance > 0 else 0.0


@njit
def fit_bar(
    codes: Array,
    known: Array,
    offset: Array,
    when: Array,
    profile: Array,
    blur: float,
    dim: float,
    huber: float,
    prior: Array,
    seen_values: Array,
    search: tuple[int, int, float, float],
    limits: tuple[int, float, float, float],
    fit: Array,
    by_boundary: Array,
) -> float:
    """Fit again and again, each time with the motion and without the boundaries that the last one showed.

    `search` are steps of a fit, fits after the first, and tolerances of these and of the last; `limits` are
    the least number of boundaries, how far one may lie off in standard deviations and in any case, px, and
    the share of the values' energy that a fit explains at the least. From `fit`, which is changed;
    `by_boundary` (3, K + 1) takes what `leftovers` says of it.

    Returns:
        Variance of the spacing, px2: mean of that by rows as observations (sandwich estimator) and that by
        the scatter of the boundaries. NaN where there is no fit.
    """
    steps, rounds, close, exact = search
    least, outlier, least_outlier, least_explained = limits
    boundaries, values = known.shape
    counted = np.empty((boundaries, values), np.bool_)
    for b in range(boundaries):
        for i in range(values):
            counted[b, i] = known[b, i]
    sizes, shift, information = np.empty(boundaries), np.empty(values), np.empty(values)
    first, last = np.empty((boundaries, values), np.int64), np.empty((boundaries, values), np.int64)
    by_value, scores = np.empty((2, values)), np.empty((seen_values.shape[1], _FITTED))
    normal = np.empty((_FITTED, _FITTED))
    moved, own = np.empty(values), np.empty(values)
    for i in range(values):
        moved[i], own[i] = offset[i], 0.0
    spent, squares = 0.0, 0.0
    rough = np.empty((2, boundaries))
    for left in range(rounds, -1, -1):
        shifts = rough if left else by_boundary
        tolerance = close if left else exact
        if not solve(
            codes,
            counted,
            moved,
            when,
            profile,
            blur,
            dim,
            huber,
            prior,
            seen_values,
            steps,
            tolerance,
            fit,
            normal,
            first,
            last,
        ):
            return np.nan
        noise, spent, squares = leftovers(
            codes,
            first,
            last,
            moved,
            when,
            profile,
            blur,
            dim,
            huber,
            seen_values,
            fit,
            shifts,
            by_value,
            scores,
        )
        used: Any = np.int64(0)
        for b in range(boundaries):
            if shifts[1, b] > 0:
                sizes[used] = abs(shifts[0, b])
                used += 1
        if used < least:
            return np.nan
        if left:
            most = max(outlier * 1.4826 * _median(sizes, used), least_outlier)
            for b in range(boundaries):
                if abs(shifts[0, b]) > most:
                    for i in range(values):
                        counted[b, i] = False
            for i in range(values):
                shift[i] = by_value[0, i] + own[i]
                information[i] = by_value[1, i] / max(noise, 1e-12)
            own_motion(shift, information, when, own)
            for i in range(values):
                moved[i] = offset[i] + own[i]
    if spent > (1 - least_explained) * squares:
        return np.nan
    # The spacing's row of the inverse: one column of it, as that is symmetric.
    unit, inverse, factor = np.empty(_FITTED), np.empty(_FITTED), np.empty((_FITTED, _FITTED))
    scale = np.empty(_FITTED)
    for a in range(_FITTED):
        unit[a] = 1.0 if a == 0 else 0.0
    if not rooted(normal, 0.0, _ROUNDING, scale, factor):
        return np.nan
    substituted(factor, scale, unit, inverse)
    by_row, rows = 0.0, 0
    for v in range(len(scores)):
        part = 0.0
        for a in range(_FITTED):
            part += scores[v, a] * inverse[a]
        by_row += part * part
        rows += scores[v, 3] != 0
    n, total, mean, spread, left_over = 0, 0.0, 0.0, 0.0, 0.0
    for b in range(boundaries):
        weight = by_boundary[1, b]
        if weight > 0:
            n += 1
            total += weight
            mean += weight * b
            left_over += weight * by_boundary[0, b] ** 2
    mean /= total
    for b in range(boundaries):
        spread += by_boundary[1, b] * (b - mean) ** 2
    if spread <= 0:
        return np.nan
    return (by_row * rows / max(rows - _FITTED, 1) + left_over / max(n - 2, 1) / spread) / 2


@njit
def measure_column(
    selected: Array,
    grid: int,
    sums: Array,
    offset: Array,
    symbols: Array,
    pilots: Array,
    words: Array,
    when: Array,
    profile: Array,
    prior: Array,
    pixels: tuple[float, float, float, float, float],
    search: tuple[int, int, float, float],
    limits: tuple[int, float, float, float],
    by_boundary: Array,
) -> tuple[float, float, float]:
    """Spacing of a bar's clusters in the image along its axis, its standard deviation, px, and columns a row.

    From the cells that are `selected`, of `grid` px, and the sums of a frame (chips, rows, columns), with
    `offset` (2, chips) the place of the bar's centre in each; by `fit_bar` of what `read_bar` finds. `pixels`
    are a boundary's blur, px, events of a full value, the share of a veil, the gain to begin with, and the
    residual beyond which a row weighs less.

    Returns:
        NaN where there are too few cells in line, no fit, or one that leaves the cells.
    """
    line, seen = np.empty(5), np.empty(len(selected), np.bool_)
    way = lie_of_cells(selected, line, seen)
    if way == 0:
        return np.nan, np.nan, np.nan
    middle = (grid - 1) / 2
    line[0] = line[0] * grid + middle
    line[1] *= grid
    line[2] = line[2] * grid + middle - line[3] * middle
    # In whole cells, as wide as the core is.
    line[4] = (line[4] + 0.5) * grid
    fit = np.empty(_FITTED)
    most = grid + 1
    upright = sums
    if way != 1:
        # A bar that lies across the image: rows and columns are exchanged.
        chips, rows, columns = sums.shape
        upright = np.empty((chips, columns, rows), sums.dtype)
        for i in range(chips):
            for c in range(columns):
                for r in range(rows):
                    upright[i, c, r] = sums[i, r, c]
    variance = _measured(
        upright,
        offset[1 if way == 1 else 0],
        line,
        seen,
        symbols,
        pilots,
        words,
        when,
        profile,
        prior,
        pixels,
        search,
        limits,
        most,
        fit,
        by_boundary,
    )
    return fit[0], sqrt(max(variance, 0.0)) if variance == variance else np.nan, line[3]


@njit
def _measured(
    sums: Array,
    offset: Array,
    line: Array,
    seen: Array,
    symbols: Array,
    pilots: Array,
    words: Array,
    when: Array,
    profile: Array,
    prior: Array,
    pixels: tuple[float, float, float, float, float],
    search: tuple[int, int, float, float],
    limits: tuple[int, float, float, float],
    most: float,
    fit: Array,
    by_boundary: Array,
) -> float:
    """Variance of the spacing of a bar that lies along the rows, and its fit; NaN where there is none."""
    blur, full, veil, gain, huber = pixels
    clusters, height, n = len(pilots), sums.shape[1], when.size
    codes, known = np.empty((clusters, n)), np.empty((clusters + 1, n), np.bool_)
    values, moved = np.empty((n, height)), np.empty(n)
    # A value is read from its second chip, whose events follow the edge at its start, half a chip before the
    # middle that an offset is for. Images are held still by whole pixels, so offsets jump by one.
    for i in range(n):
        step = offset[2 * i + 1] - offset[2 * i]
        moved[i] = offset[2 * i + 1] - (step - np.rint(step)) / 2
    dim = read_bar(sums, pilots, words, symbols, seen, line, full, veil, codes, known, moved, values)
    first, spacing = line[0], line[1]
    if spacing < 0:
        # A bar upside down is mirrored.
        spacing, first = -spacing, height - 1 - first
    centre = first + spacing * (clusters - 1) / 2 - (height - 1) / 2
    for a in range(_FITTED):
        fit[a] = 0.0
    fit[0], fit[1], fit[3] = spacing, centre, gain
    variance = fit_bar(
        codes, known, moved, when, profile, blur, dim, huber, prior, values, search, limits, fit, by_boundary
    )
    # From the start, which cells gave, an end moves by the size of a cell and a pixel of blur.
    if abs(fit[0] - spacing) * (clusters - 1) / 2 + abs(fit[1] - centre) > most:
        return np.nan
    return variance
