"""Loops over events, compiled."""

from math import exp, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk._kernels import correlate_code, invert_matrix, median, pair_values
from evlcp_sdk.kernels import njit

Array = NDArray[Any]

Columns = tuple[Array, Array, Array, Array]
"""Of events: t_us, x, y and p."""

# A pixel's state, uint32, from the lowest bit on: score, kind of its newest time, repetitions, clock.
TIME_BIT, REPEATS_BIT, CLOCK_BIT = 6, 10, 15

SCORE_MASK, MAX_REPEATS = 63, 31

CLOCK_TICKS = 1 << 32 - CLOCK_BIT
"""Ticks after which the clock of 17 bits goes round."""

OTHER_TIME, SAME_TIME, MULTIPLE_TIME, LONG_SAME_TIME = 0, 1, 2, 3
"""A time between rises: another than the one before; the same; as if one missed rises; the same, and long."""

_CLOCK_SHIFT, _TICK_MASK = np.uint32(CLOCK_BIT), np.uint32(CLOCK_TICKS - 1)
_CLOCK_MASK = np.uint32((1 << 32) - (1 << CLOCK_BIT))
_BELOW_CLOCK, _BELOW_REPEATS = np.uint32((1 << CLOCK_BIT) - 1), np.uint32((1 << REPEATS_BIT) - 1)

_REPEATS = (
    np.add.outer([-6, 1, -2, 2], np.arange(MAX_REPEATS + 1)).clip(0, MAX_REPEATS).astype(np.uint32).ravel()
)
"""Repetitions after each kind of time and number of them before. A kind counts by the logarithm of how much
likelier it is of a lamp that misses one rise in ten than of the code of a cluster whose pilot repeats itself,
in units of that of a repetition, a third."""

_BLOCK = 32
"""Events that are compared together: of a bar alone in the dark, every other block has no stray in it."""

_MAX_HITS = np.int16(2**15 - 1)
"""Hits of a cell, two bytes, count no further: with chips below 3 us there may be more in a step."""


@njit
def score_rises(
    events: Columns,
    pixels: Array,
    hits: Array,
    kinds: Array,
    transitions: Array,
    limits: tuple[int, int, int],
    shifts: tuple[int, int],
    aging: tuple[int, int, int, int, int],
) -> int:
    """Score each pixel by the rhythm of its rises; count those of candidates, by cell in `hits`.

    Args:
        events: Those of a step, in order.
        pixels: States, uint32 (height, width), see `BlinkDetector`.
        hits: By cell, int16 (rows, columns).
        kinds: Kind of a time by its ticks, the last, 0, for all beyond.
        transitions: New time and score of a pixel, and in the bits above whether its time came again.
        limits: (ticks below which a rise is the same as the one before; the least score of a hit; repetitions
            of a time from which on a rise is no hit).
        shifts: A tick is 2^first us, a cell 2^second px wide.
        aging: What is old grows no older: (first row; number of rows from there on, cyclic; ticks now; ticks
            after which a rise is old; its age then).
    """
    first_row, row_count, now, old_ticks, age = aging
    then = np.uint32((np.uint32(now) - np.uint32(age)) << _CLOCK_SHIFT)
    today, oldest = np.uint32(now), np.uint32(old_ticks)
    for row in range(first_row, first_row + row_count):
        line = pixels[row % len(pixels)]
        for u in range(line.size):
            state = line[u]
            ago = np.uint32(np.uint32(today - np.uint32(state >> _CLOCK_SHIFT)) & _TICK_MASK)
            line[u] = np.uint32(then | np.uint32(state & _BELOW_CLOCK)) if ago >= oldest else state
    t_us, x, y, p = events
    least_ticks, min_score, most_repeats = limits
    tick_shift, cell_shift = shifts
    width, columns = np.uint32(pixels.shape[1]), np.uint32(hits.shape[1])
    states, cells = pixels.reshape(-1), hits.reshape(-1)
    longest, least = np.uint32(kinds.size - 1), np.uint32(min_score)
    first, shift, ticks = np.uint32(least_ticks), np.uint32(cell_shift), np.uint64(tick_shift)
    lamp = np.uint32(most_repeats)
    # What counts is as good as random at each stage, so there is no branch; indices are unsigned, as those
    # below 0 would count from the end.
    where, runs = np.empty(t_us.size + 1, np.uint32), np.empty(t_us.size + 1, np.uint32)
    n = np.uint64(0)
    for i in range(t_us.size):
        where[n] = np.uint32(y[i]) * width + np.uint32(x[i])
        runs[n] = np.uint32(np.uint64(t_us[i]) >> ticks)
        n += np.uint64(p[i])
    # All states are fetched before one is changed, many at a time: those of noise may be far away.
    fetched = np.empty(n, np.uint32)
    for i in range(n):
        fetched[i] = states[where[i]]
    new = np.uint64(0)
    for i in range(n):
        at, tick = where[i], runs[i]
        state = states[at]
        run = (tick - (state >> _CLOCK_SHIFT)) & _TICK_MASK
        fresh = run >= first
        states[at] = (tick << _CLOCK_SHIFT) | (state & _BELOW_CLOCK) if fresh else state
        where[new] = at
        runs[new] = min(run, longest)
        new += np.uint64(fresh)
    candidates = 0
    for i in range(new):
        at = where[i]
        state = states[at]
        kind = np.uint32(kinds[runs[i]])
        low = np.uint32(transitions[(kind << np.uint32(REPEATS_BIT)) | (state & _BELOW_REPEATS)])
        same = (state >> np.uint32(REPEATS_BIT)) & np.uint32(MAX_REPEATS)
        same = _REPEATS[(low >> np.uint32(REPEATS_BIT) << np.uint32(CLOCK_BIT - REPEATS_BIT)) | same]
        states[at] = (state & _CLOCK_MASK) | (same << np.uint32(REPEATS_BIT)) | (low & _BELOW_REPEATS)
        # A rise after a long time is no blinking yet, however a pixel blinked when a bar was there.
        if (low & np.uint32(SCORE_MASK)) >= least and kind != np.uint32(0) and same < lamp:
            row = at // width
            cell = (row >> shift) * columns + ((at - row * width) >> shift)
            cells[cell] += np.int16(cells[cell] < _MAX_HITS)
            candidates += 1
    return candidates


@njit
def _is_blinking(state: int, now: int, span: int, least: int) -> bool:
    """Whether a pixel rose in the last `span` ticks and scores `least` or more."""
    age = (np.uint32(now) - (np.uint32(state) >> _CLOCK_SHIFT)) & _TICK_MASK
    return bool(age <= np.uint32(span)) and bool(
        (np.uint32(state) & np.uint32(SCORE_MASK)) >= np.uint32(least)
    )


@njit
def measure_box(
    pixels: Array,
    box: tuple[int, int, int, int],
    awake: tuple[int, int, int],
    seam: int,
    reach: float,
    rows: Array,
) -> tuple[int, float, int, int, float, float, float]:
    """Find where in a box pixels blink in the rhythm of the chips, and rose lately.

    Columns count by their excess over the `seam` outermost ones on the darker side, which see a halo, or lit
    leaves. Those that hold most within twice `reach` give the mean column; rows count their pixels within
    `reach` of it. An edge row that holds fewer pixels than a full one counts by its share.

    `awake` are (ticks now; ticks within which a pixel must have risen; its least score), `rows` takes the
    pixels by row.

    Returns:
        (pixels, mean column, first column, last column, upper edge, lower edge, share of the pixels
        in every second row of the seam that rose lately, in rhythm or not, on its calmer side).
    """
    now, span, min_score = awake
    left, top, right, bottom = box
    calm = 1.0
    for first in (left, right - seam):
        many, cells = 0, 0
        for v in range(top, bottom, 2):
            for u in range(max(first, left), min(first + seam, right)):
                many += _is_blinking(pixels[v, u], now, span, 0)
                cells += 1
        calm = min(calm, many / max(cells, 1))
    blinks, counts = np.empty((bottom - top, right - left), np.uint8), np.zeros(right - left, np.int32)
    for v in range(top, bottom):
        line, row = pixels[v, left:right], blinks[v - top]
        # Many pixels at a time, in one loop: rows are short.
        for u in range(line.size):
            blink = _is_blinking(line[u], now, span, min_score)
            row[u] = blink
            counts[u] += np.int32(blink)
    columns, first_column, last_column = np.empty(counts.size), right, left
    for u in range(left, right):
        columns[u - left] = counts[u - left]
        if counts[u - left]:
            first_column, last_column = min(first_column, u), u
    rows[:] = 0
    if last_column < first_column:
        return 0, 0.0, 0, 0, 0.0, 0.0, calm
    outside = min(columns[:seam].sum(), columns[-seam:].sum()) / seam if columns.size > 2 * seam else 0.0
    for i in range(columns.size):
        columns[i] = max(columns[i] - outside, 0.0)
    wide = int(min(2 * reach, columns.size))
    start, best, inside = 0, 0.0, 0.0
    for i in range(columns.size):
        inside += columns[i] - (columns[i - wide] if i >= wide else 0.0)
        if i >= wide - 1 and inside > best + 1e-9:
            start, best = i - wide + 1, inside
    column = (first_column + last_column) / 2
    if best > 0:
        weighted = 0.0
        for i in range(start, start + wide):
            weighted += columns[i] * (left + i)
        column = weighted / best
    total, lit = 0, 0
    near, far = left, right
    while near < far and abs(near - column) > reach:
        near += 1
    while near < far and abs(far - 1 - column) > reach:
        far -= 1
    for v in range(top, bottom):
        n = 0
        for u in range(near - left, far - left):
            n += blinks[v - top, u]
        rows[v - top] = n
        total += n
        lit += n > 0
    if total == 0:
        return 0, 0.0, 0, 0, 0.0, 0.0, calm
    upper, lower = _find_edges(rows, top, bottom, total / lit)
    return total, column, first_column, last_column, upper, lower, calm


@njit
def measure_strips(
    pixels: Array,
    box: tuple[int, int, int, int],
    awake: tuple[int, int, int],
    expected: float,
    near: float,
    strips: Array,
    rows: Array,
) -> tuple[int, float, int, int, float, float, float]:
    """Find where in a box pixels blink, as `measure_box`, of a bar whose light stands in strips of columns.

    `strips` (n, 2) are the middle of each from the bar's centre, and half its width, px. Each pixel counts by
    its distance from the middle of its own strip: unlike the mean column, this does not depend on how many
    pixels of each strip are awake. They count within `near` of the strips about the `expected` column first,
    then within a pixel of the strips about the column found; columns between strips never count.
    """
    now, span, min_score = awake
    left, top, right, bottom = box
    columns, number = np.zeros(right - left), np.empty(right - left, np.int64)
    for v in range(top, bottom):
        for u in range(left, right):
            columns[u - left] += _is_blinking(pixels[v, u], now, span, min_score)
    column, total = expected, 0.0
    for turn in range(3):
        more = near if turn == 0 else 1.0
        off, total = 0.0, 0.0
        number[:] = -1
        for k in range(len(strips)):
            middle, reach = column + strips[k, 0], strips[k, 1] + more
            for i in range(columns.size):
                if abs(left + i - middle) <= reach and number[i] < 0:
                    number[i] = k
                    total += columns[i]
                    off += columns[i] * (left + i - middle)
        if total == 0:
            break
        column += off / total
    rows[:] = 0
    if total == 0:
        return 0, 0.0, 0, 0, 0.0, 0.0, 0.0
    first_column, last_column = right, left
    for u in range(left, right):
        if number[u - left] >= 0 and columns[u - left] > 0:
            first_column, last_column = min(first_column, u), max(last_column, u)
    many, lit = 0, 0
    for v in range(top, bottom):
        n = 0
        for u in range(left, right):
            n += number[u - left] >= 0 and _is_blinking(pixels[v, u], now, span, min_score)
        rows[v - top] = n
        many += n
        lit += n > 0
    upper, lower = _find_edges(rows, top, bottom, many / lit)
    return many, column, first_column, last_column, upper, lower, 0.0


@njit
def _find_edges(rows: Array, top: int, bottom: int, full: float) -> tuple[float, float]:
    """Upper and lower edge of the rows (n,) with pixels: an edge row counts by its share of a full one."""
    v = top
    while rows[v - top] == 0:
        v += 1
    upper = v + 1 - min(rows[v - top] / full, 1.0)
    v = bottom - 1
    while rows[v - top] == 0:
        v -= 1
    return upper, v + min(rows[v - top] / full, 1.0)


@njit
def select_box(events: Columns, box: tuple[int, int, int, int], out: Columns) -> int:
    """Copy the events inside a box to `out`, which has room for one more than all; return their number."""
    t_us, x, y, p = events
    out_t, out_x, out_y, out_p = out
    left, top = np.uint16(box[0]), np.uint16(box[1])
    width, height = np.uint16(box[2] - box[0]), np.uint16(box[3] - box[1])
    which = np.empty(_BLOCK + 1, np.uint8)
    n = np.uint64(0)
    size = t_us.size
    whole = size - size % _BLOCK
    for first in range(0, whole, _BLOCK):
        many = np.uint16(0)
        for i in range(first, first + _BLOCK):
            # Unsigned, one comparison does for both edges.
            many += np.uint16(np.uint16(x[i] - left) < width) & np.uint16(np.uint16(y[i] - top) < height)
        if many == _BLOCK:
            for i in range(_BLOCK):
                out_t[n + np.uint64(i)] = t_us[first + i]
            for i in range(_BLOCK):
                out_x[n + np.uint64(i)] = x[first + i]
            for i in range(_BLOCK):
                out_y[n + np.uint64(i)] = y[first + i]
            for i in range(_BLOCK):
                out_p[n + np.uint64(i)] = p[first + i]
            n += np.uint64(_BLOCK)
        elif many:
            # Which is written always, kept if inside: between two bars, a branch would be a coin toss.
            k = np.uint64(0)
            for i in range(_BLOCK):
                which[k] = i
                u, v = np.uint16(x[first + i] - left), np.uint16(y[first + i] - top)
                k += np.uint64(u < width) & np.uint64(v < height)
            for j in range(many):
                i = first + which[j]
                out_t[n] = t_us[i]
                out_x[n] = x[i]
                out_y[n] = y[i]
                out_p[n] = p[i]
                n += np.uint64(1)
    for i in range(whole, size):
        out_t[n] = t_us[i]
        out_x[n] = x[i]
        out_y[n] = y[i]
        out_p[n] = p[i]
        n += np.uint64(np.uint16(x[i] - left) < width) & np.uint64(np.uint16(y[i] - top) < height)
    return int(np.int64(n))


MAX_BOXES = 16
"""Boxes that are served in one pass: a bit each."""

_LOWEST = np.array([8, *((n & -n).bit_length() - 1 for n in range(1, 1 << 8))], np.uint8)
"""Number of the lowest of eight bits that is set; of none, one beyond."""


@njit
def select_boxes(
    events: Columns,
    boxes: Array,
    pixels: Array,
    rhythmic: tuple[int, int, int],
    stride: int,
    out: Columns,
    counts: Array,
) -> None:
    """Copy the events inside each of some boxes.

    Args:
        events: Those of a step.
        boxes: (left, top, right, bottom), int64 (n, 4), `MAX_BOXES` at the most.
        pixels: States, uint32 (height, width).
        rhythmic: (boxes of which only pixels in rhythm count, a bit each; the least score of these;
            repetitions of a time from which on they do not count).
        stride: The events of each box begin so many behind where those of the one before do.
        out: Takes the events; it has room for one more than all.
        counts: Takes the number of events by box, int64 (n,).
    """
    t_us, x, y, p = events
    out_t, out_x, out_y, out_p = out
    # A column's and a row's bits name the boxes, in the same time however many there are.
    columns, rows = np.zeros(pixels.shape[1], np.uint16), np.zeros(pixels.shape[0], np.uint16)
    filtered, least, most_repeats = np.uint16(rhythmic[0]), np.uint32(rhythmic[1]), np.uint32(rhythmic[2])
    for k in range(len(boxes)):
        left, top, right, bottom = boxes[k]
        for u in range(left, right):
            columns[u] |= np.uint16(1 << k)
        for v in range(top, bottom):
            rows[v] |= np.uint16(1 << k)
    ends = np.empty(MAX_BOXES + 1, np.int64)
    for k in range(ends.size):
        ends[k] = min(k, len(boxes)) * stride
    for i in range(t_us.size):
        inside = columns[x[i]] & rows[y[i]]
        if inside & filtered:
            state = pixels[y[i], x[i]]
            same = (state >> np.uint32(REPEATS_BIT)) & np.uint32(MAX_REPEATS)
            is_rhythmic = ((state & np.uint32(SCORE_MASK)) >= least) & (same < most_repeats)
            inside = inside if is_rhythmic else np.uint16(inside & ~filtered)
        while True:
            # Written always, kept if inside; of two boxes that overlap, in both.
            box = _LOWEST[inside & np.uint16(255)]
            if box == 8:
                box += _LOWEST[inside >> np.uint16(8)]
            n = np.uint64(ends[box])
            out_t[n] = t_us[i]
            out_x[n] = x[i]
            out_y[n] = y[i]
            out_p[n] = p[i]
            ends[box] += inside != 0
            inside &= np.uint16(inside - 1)
            if not inside:
                break
    for k in range(len(boxes)):
        counts[k] = ends[k] - k * stride


@njit
def add_polarities(
    events: Columns,
    starts_us: tuple[float, float],
    chip_us: float,
    row: tuple[float, float],
    centre: Array,
    offset: Array,
    sums: Array,
) -> None:
    """Add events to polarity sums (chips, height, width), with the image held still at `centre` (2, chips).

    `offset` (2, chips) takes the rest, right and down, as images move by whole pixels. `starts_us`, of
    positive and of negative events, hold in one row of the sensor; each row below is later: `row` is by how
    much, us, and which row that is.
    """
    t_us, x, y, p = events
    start_on_us, start_off_us = starts_us
    row_us, row_px = row
    chips, height, width = sums.shape
    shift_x, shift_y = np.empty(chips), np.empty(chips)
    for i in range(chips):
        # The image's pixel (0, 0) on the sensor.
        left, top = centre[0, i] - (width - 1) / 2, centre[1, i] - (height - 1) / 2
        shift_x[i], shift_y[i] = np.rint(left), np.rint(top)
        offset[0, i], offset[1, i] = left - shift_x[i], top - shift_y[i]
    highest, lowest = shift_y[0], shift_y[0]
    for i in range(chips):
        highest, lowest = min(highest, shift_y[i]), max(lowest, shift_y[i])
    upper, lower = row_us * (highest - row_px), row_us * (lowest + height - row_px)
    first = np.searchsorted(t_us, min(start_on_us, start_off_us) + min(upper, lower))
    end = max(start_on_us, start_off_us) + max(upper, lower) + chips * chip_us
    last = np.searchsorted(t_us, end)
    origin = start_off_us - row_us * row_px
    apart = start_on_us - start_off_us
    rate = 1 / chip_us
    # Which chip, many events at a time; then into its pixel, one by one.
    which, where, flat = np.empty(_MANY, np.int32), np.empty(_MANY, np.uint32), sums.reshape(-1)
    columns, rows, many = np.uint32(width), np.uint32(height), np.uint32(chips)
    for begin in range(first, last, _MANY):
        n = min(_MANY, last - begin)
        t, line, column, sign = t_us[begin:], y[begin:], x[begin:], p[begin:]
        for i in range(n):
            late = t[i] - origin - row_us * line[i] - apart * sign[i]
            chip = np.int32(min(late * rate, 1e9))
            which[i] = np.int32(-1) if late < 0 else chip
        # The first and the last chip of these events.
        low, high = _NOWHERE, np.uint32(0)
        for i in range(n):
            c = np.uint32(which[i])
            low = min(low, c)
            high = max(high, c if c < many else np.uint32(0))
        still = low < many
        for k in range(low + 1, high + 1):
            still &= shift_x[k] == shift_x[low] and shift_y[k] == shift_y[low]
        if still:
            # In the chips of so few events, the image seldom moves by a pixel.
            left, top = np.int32(shift_x[low]), np.int32(shift_y[low])
            for i in range(n):
                c = np.uint32(which[i])
                u, v = np.uint32(np.int32(column[i]) - left), np.uint32(np.int32(line[i]) - top)
                inside = (c < many) & (u < columns) & (v < rows)
                # Products of 64 bits would be computed half as many at a time.
                line_at = np.uint32(np.uint32(c * rows) + v)
                where[i] = np.uint32(np.uint32(line_at * columns) + u) if inside else _NOWHERE
            for i in range(n):
                if where[i] != _NOWHERE:
                    flat[where[i]] += np.int16(2 * np.int16(sign[i]) - 1)
            continue
        for i in range(n):
            c = np.uint32(which[i])
            if c >= many:
                continue
            # Unsigned, a pixel to the left of the image is far to its right: one comparison for both edges.
            u = np.uint32(np.int32(column[i]) - np.int32(shift_x[c]))
            v = np.uint32(np.int32(line[i]) - np.int32(shift_y[c]))
            if u < columns and v < rows:
                # Arithmetic, not a branch: polarity is as good as random.
                sums[c, v, u] += np.int16(2 * np.int16(sign[i]) - 1)


_ROUNDING = 1e-13
"""Share of a diagonal that rounding may leave of nothing."""

_MANY = 512
"""Events whose chips are found together: they stay in the fastest cache."""

_NOWHERE = np.uint32((1 << 32) - 1)
"""Number of no pixel."""


@njit
def count_rows(
    t_us: Array, y: Array, p: Array, start_us: Array, step_us: float, top: float, block: float, counts: Array
) -> None:
    """Add events to counts (polarity, blocks of rows, steps), from `start_us` (2,) and the edge `top` on."""
    _, blocks, steps = counts.shape
    first = np.searchsorted(t_us, min(start_us[0], start_us[1]))
    last = np.searchsorted(t_us, max(start_us[0], start_us[1]) + steps * step_us)
    for i in range(first, last):
        s = int(np.floor((t_us[i] - start_us[p[i]]) / step_us))
        b = int(np.floor((y[i] - top) / block))
        if 0 <= s < steps and 0 <= b < blocks:
            counts[p[i], b, s] += 1


@njit
def _collect_connected(selected: Array, done: Array, cells: Array, row: int, column: int) -> int:
    """List the selected cells that are connected (8 neighbours) with one; return their number."""
    rows, columns = selected.shape
    done[row, column] = True
    cells[0, 0], cells[0, 1] = row, column
    at, many = 0, 1
    while at < many:
        a, b = cells[at, 0], cells[at, 1]
        at += 1
        for v in range(max(a - 1, 0), min(a + 2, rows)):
            for u in range(max(b - 1, 0), min(b + 2, columns)):
                if selected[v, u] and not done[v, u]:
                    done[v, u] = True
                    cells[many, 0], cells[many, 1] = v, u
                    many += 1
    return many


@njit
def bound_areas(selected: Array, hits: Array, boxes: Array, total: Array) -> int:
    """Bound connected cells (8 neighbours) by `boxes` (left, top, right, bottom), with their `total` hits.

    They are in the order of their first cells, by rows and columns. Returns their number.
    """
    rows, columns = selected.shape
    done = np.zeros((rows, columns), np.bool_)
    cells = np.empty((rows * columns, 2), np.int64)
    n = 0
    for r in range(rows):
        for c in range(columns):
            if not selected[r, c] or done[r, c]:
                continue
            many = _collect_connected(selected, done, cells, r, c)
            left, right, bottom, total[n] = c, c, r, 0
            for i in range(many):
                total[n] += hits[cells[i, 0], cells[i, 1]]
                left, right = min(left, cells[i, 1]), max(right, cells[i, 1])
                bottom = max(bottom, cells[i, 0])
            boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3] = left, r, right + 1, bottom + 1
            n += 1
    return n


@njit
def find_blobs(selected: Array, grid: int) -> tuple[Array, Array, Array]:
    """Connected cells (8 neighbours) of each cluster, largest first: mean column + row * 1j, cluster, cells.

    Means are in pixels, `grid` to a cell's side. Blobs of one size are in the order of clusters and rows.
    """
    clusters, rows, columns = selected.shape
    # Of 2 x 2 cells, one at the most begins a blob.
    room = clusters * ((rows + 1) // 2) * ((columns + 1) // 2)
    some, of = np.empty(room, np.complex128), np.empty((2, room), np.int64)
    done = np.empty((rows, columns), np.bool_)
    found = np.empty((rows * columns, 2), np.int64)
    n, most = 0, 0
    for k in range(clusters):
        first, last = find_rows(selected[k])
        done[first:last] = False
        for r in range(first, last):
            for c in range(columns):
                if not selected[k, r, c] or done[r, c]:
                    continue
                count = _collect_connected(selected[k], done, found, r, c)
                down, right = 0, 0
                for i in range(count):
                    down += found[i, 0]
                    right += found[i, 1]
                some[n] = complex(right / count * grid + (grid - 1) / 2, down / count * grid + (grid - 1) / 2)
                of[0, n], of[1, n] = k, count
                most = max(most, count)
                n += 1
    # Where blobs of each size begin, behind larger ones.
    begin = np.zeros(most + 2, np.int64)
    for i in range(n):
        begin[most - of[1, i] + 1] += 1
    for size in range(most):
        begin[size + 1] += begin[size]
    at, cluster, cells = np.empty(n, np.complex128), np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        place = begin[most - of[1, i]]
        begin[most - of[1, i]] += 1
        at[place], cluster[place], cells[place] = some[i], of[0, i], of[1, i]
    return at, cluster, cells


@njit
def find_similarity(
    blobs: tuple[Array, Array, Array],
    proposers: int,
    layout: Array,
    spacing: float,
    slack: float,
    least_spacing: float,
    scale: complex,
) -> tuple[float, complex, complex]:
    """Score, scale and shift of the similarity that puts most cells of all blobs into their places.

    The first `proposers` of the blobs (place, cluster, cells) propose: each pair of different clusters, or,
    if `scale` is not 0, each blob with that scale. A place reaches half a spacing and `slack` around; cells
    off its middle count less by the square; scales that put neighbours nearer than `least_spacing` do not
    count. Of equal scores the first is taken.
    """
    at, cluster, cells = blobs
    best, best_s, best_shift = 0.0, complex(0.0, 0.0), complex(0.0, 0.0)
    known = abs(scale) > 0
    for i in range(proposers):
        for j in range(i, i + 1 if known else proposers):
            s = scale
            if not known:
                if cluster[i] == cluster[j] or layout[cluster[i]] == layout[cluster[j]]:
                    continue
                s = (at[j] - at[i]) / (layout[cluster[j]] - layout[cluster[i]])
            gap = abs(s) * spacing
            if gap < least_spacing:
                continue
            shift, reach, score = at[i] - s * layout[cluster[i]], gap / 2 + slack, 0.0
            for k in range(at.size):
                off = at[k] - (s * layout[cluster[k]] + shift)
                square = (off.real * off.real + off.imag * off.imag) / (reach * reach)
                if square < 1:
                    score += cells[k] * (1 - square)
            if score > best:
                best, best_s, best_shift = score, s, shift
    return best, best_s, best_shift


@njit
def refine_similarity(
    blobs: tuple[Array, Array, Array],
    layout: Array,
    spacing: float,
    slack: float,
    scale: complex,
    s: complex,
    shift: complex,
) -> tuple[complex, complex]:
    """Fit a similarity by least squares to the blobs within reach, three times; return scale and shift.

    A `scale` known before counts as if every cluster of the layout had been seen with it, with as many cells
    as those seen have on average.
    """
    at, cluster, cells = blobs
    for _ in range(3):
        reach = abs(s) * spacing / 2 + slack
        total = 0.0
        image_mean, layout_mean = complex(0.0, 0.0), complex(0.0, 0.0)
        for i in range(at.size):
            c = layout[cluster[i]]
            if abs(at[i] - s * c - shift) < reach:
                total += cells[i]
                image_mean += cells[i] * at[i]
                layout_mean += cells[i] * c
        if total == 0:
            return s, shift
        image_mean /= total
        layout_mean /= total
        cross, power = complex(0.0, 0.0), 0.0
        for i in range(at.size):
            c = layout[cluster[i]]
            if abs(at[i] - s * c - shift) < reach:
                d = c - layout_mean
                cross += cells[i] * d.conjugate() * (at[i] - image_mean)
                power += cells[i] * (d.real * d.real + d.imag * d.imag)
        if abs(scale) > 0:
            middle = layout.sum() / layout.size
            full = 0.0
            for c in layout:
                full += abs(c - middle) ** 2
            full *= total / layout.size
            cross += full * scale
            power += full
        if power <= 0:
            return s, shift
        s = cross / power
        shift = image_mean - s * layout_mean
    return s, shift


@njit
def _overlap_share(off: float, half: float, grid: float) -> float:
    """Share of a cell, `off` from the middle of a footprint, that the footprint covers."""
    return max(min(off + grid / 2, half) - max(off - grid / 2, -half), 0.0) / grid


@njit
def _strip_extent(unit: complex, along: float, across: float) -> tuple[float, float]:
    """How far right and down a strip of length `along` and width `across` reaches."""
    right, down = abs(unit.real), abs(unit.imag)
    return along * right + across * down + 1e-6, along * down + across * right + 1e-6


@njit
def measure_core_profile(
    probability: Array,
    seen: Array,
    places: Array,
    unit: complex,
    spacing: float,
    grid: int,
    edge: float,
    out: Array,
) -> int:
    """Measure the presence of clusters, less that of others, by distance from their line: `out`, 0 to 1.

    A cell, in bins of 1 px, belongs to the seen cluster whose half spacing to both sides holds its middle;
    that cluster's two neighbours may show in it, too. Distances without cells, between rows along the line,
    are interpolated linearly; those before the first have its value.

    Returns:
        Number of distances that belong to the line: up to presence of less than `edge` of its peak.
    """
    _, rows, columns = probability.shape
    hits, cells = np.zeros(out.size), np.zeros(out.size)
    near, many = np.empty((places.size, places.size), np.int64), np.zeros(places.size, np.int64)
    for k in range(places.size):
        for other in range(places.size):
            if abs(places[other] - places[k]) <= 1.5 * spacing:
                near[k, many[k]] = other
                many[k] += 1
    every = np.zeros(rows * columns)
    for k in range(places.size):
        cells_of = np.ascontiguousarray(probability[k]).reshape(-1)
        for j in range(every.size):
            every[j] += cells_of[j]
    half = spacing / 2 + grid
    wide, high = _strip_extent(unit, half, float(hits.size))
    for k in range(places.size):
        if not seen[k]:
            continue
        x, y = places[k].real, places[k].imag
        for r in range(max(int((y - high) / grid), 0), min(int((y + high) / grid) + 1, rows)):
            for c in range(max(int((x - wide) / grid), 0), min(int((x + wide) / grid) + 1, columns)):
                off = complex(c * grid + (grid - 1) / 2, r * grid + (grid - 1) / 2) - places[k]
                off *= unit.conjugate()
                share = _overlap_share(off.real, spacing / 2, grid)
                if share > 0 and abs(off.imag) < hits.size:
                    i = int(abs(off.imag))
                    cells[i] += share * share
                    far = every[r * columns + c]
                    for i_near in range(many[k]):
                        far -= probability[near[k, i_near], r, c]
                    hits[i] += share * probability[k, r, c] - share * share * far
    before = -1
    out[:] = 0.0
    for i in range(cells.size):
        if cells[i] > 0:
            value = hits[i] / cells[i]
            for j in range(before + 1, i):
                part = (j - before) / (i - before)
                out[j] = out[before] + part * (value - out[before]) if before >= 0 else value
            out[i] = value
            before = i
    n = 0
    for i in range(out.size):
        n = i if out[i] > out[n] else n
    highest = out[n]
    while n < out.size and not out[n] < edge * highest:
        n += 1
    for i in range(n):
        out[i] = min(max(out[i], 0.0), 1.0)
    return n


@njit
def measure_pilot_light(
    sums: Array,
    codes: Array,
    every: int,
    prior: Array,
    grid: int,
    seen: Array,
    least: float,
    light: tuple[Array, Array],
) -> bool:
    """Measure how well pixels in each cluster's place follow its pilot: `light` (K,), -1 to 1, 0 without any.

    The second array of `light` (K,) takes which do at all, and `least` as well as the median of those `seen`
    (K,); it returns whether all do.

    `codes` are edges (K, n), one every `every` chips. A pixel's value is the sign of its sum in the chip
    behind an edge, or 0; for edges inside pairs it is else the opposite of the chip before.
    """
    (clusters, _, columns), (out, lit) = prior.shape, light
    length = codes.shape[1]
    _, height, width = sums.shape
    flat = np.ascontiguousarray(sums).reshape(len(sums), height * width)
    values, agree = np.empty((length, height * width), np.int8), np.empty(height * width, np.int16)
    alone = np.zeros(height * width, np.int16)
    for i in range(length):
        pair_values(flat[every * i] if every > 1 else alone, flat[every * i + 1], values[i])
    for k in range(clusters):
        edges = 0
        for i in range(length):
            edges += abs(codes[k, i])
        top, bottom = find_rows(prior[k] != 0)
        if edges == 0 or top >= bottom:
            out[k] = 0.0
            continue
        begin, end = top * grid * width, bottom * grid * width
        correlate_code(codes[k], values, begin, agree[begin:end])
        total, place = 0.0, 0.0
        for r in range(top, bottom):
            for c in range(columns):
                weight = prior[k, r, c]
                if weight == 0:
                    continue
                place += weight * grid * grid
                both = 0
                for v in range(r * grid, (r + 1) * grid):
                    for u in range(c * grid, (c + 1) * grid):
                        both += agree[v * width + u]
                total += weight * both
        out[k] = total / (edges * place) if place > 0 else 0.0
    among = np.empty(clusters)
    # A literal 0 would compile another median.
    many: Any = np.int64(0)
    for k in range(clusters):
        among[many] = out[k]
        many += int(seen[k])
    dim, every_one = max(least * median(among, many), 1e-9) if many else 1e-9, True
    for k in range(clusters):
        lit[k] = out[k] >= dim
        every_one &= lit[k]
    return every_one


@njit
def find_rows(image: Array) -> tuple[int, int]:
    """First row that is not all False, and the one after the last; (0, 0) without any."""
    top, bottom = 0, 0
    for r in range(len(image)):
        some, row = False, image[r]
        for c in range(row.size):
            some |= row[c]
        if some:
            top = r if bottom == 0 else top
            bottom = r + 1
    return top, bottom


@njit
def count_answers_between(
    sums: Array,
    codes: Array,
    places: Array,
    seen: Array,
    pairs: Array,
    zones: tuple[float, float, float],
    out: Array,
) -> None:
    """Count how pixels on the way from a cluster to its neighbour answer the neighbour's edges.

    Only edges during which the cluster itself stays as it is count. `codes` are chips. `out` (2, 2, 3):
    cluster on or off; answers and edges; before the first share of the way, up to the second, beyond. `zones`
    are how far beside the way pixels count, px, and the two shares.
    """
    half, first, last = zones
    chips = codes.shape[1]
    _, height, width = sums.shape
    # Chips behind the neighbour's edges, first those in which the cluster stays on, and the edges' signs.
    behind, edge = np.empty(chips, np.int64), np.empty(chips, np.int64)
    for pair in range(len(pairs)):
        a, b = pairs[pair]
        way = places[b] - places[a]
        length = abs(way)
        if not (seen[a] and seen[b]) or length == 0:
            continue
        edges, lit = 0, 0
        for on in (1, 0):
            for i in range(1, chips):
                if codes[b, i] != codes[b, i - 1] and codes[a, i] == codes[a, i - 1] == on:
                    behind[edges], edge[edges] = i, codes[b, i] - codes[b, i - 1]
                    edges += 1
            lit = edges if on else lit
        left, right = min(places[a].real, places[b].real) - half, max(places[a].real, places[b].real) + half
        top, bottom = min(places[a].imag, places[b].imag) - half, max(places[a].imag, places[b].imag) + half
        for v in range(max(int(top), 0), min(int(bottom) + 2, height)):
            for u in range(max(int(left), 0), min(int(right) + 2, width)):
                off = (complex(u, v) - places[a]) * way.conjugate() / length
                if abs(off.imag) > half or off.real < 0 or off.real >= length:
                    continue
                zone = int(off.real >= first * length) + int(off.real >= last * length)
                for dark in range(2):
                    begin, end = (lit, edges) if dark else (0, lit)
                    answers = 0
                    for i in range(begin, end):
                        answers += int(sums[behind[i], v, u] * edge[i] > 0)
                    out[dark, 0, zone] += answers
                    out[dark, 1, zone] += end - begin


@njit
def count_answers_across(
    sums: Array, codes: Array, every: int, places: Array, seen: Array, way: complex, along: float, out: Array
) -> None:
    """Count how pixels beside the middle of clusters answer the edges that tell clusters apart.

    `codes` are chips, with an edge behind the first and every `every` chips; `way` is the direction of the
    line, of size 1; pixels within `along` of a middle count. `out` (2, 2 n + 1): answers and edges, by
    column.
    """
    chips = codes.shape[1]
    _, height, width = sums.shape
    most = out.shape[1] // 2
    wide, high = _strip_extent(way, along, most + 1.0)
    edge = np.empty(chips, np.int64)
    for k in range(len(places)):
        if not seen[k]:
            continue
        edges = 0
        for i in range(1, chips, every):
            edge[i] = codes[k, i] - codes[k, i - 1]
            edges += abs(edge[i])
        x, y = places[k].real, places[k].imag
        for v in range(max(int(y - high), 0), min(int(y + high) + 2, height)):
            for u in range(max(int(x - wide), 0), min(int(x + wide) + 2, width)):
                off = (complex(u, v) - places[k]) * way.conjugate()
                if abs(off.real) > along:
                    continue
                column = int(np.floor(off.imag + 0.5)) + most
                if column < 0 or column > 2 * most:
                    continue
                answers = 0
                for i in range(1, chips, every):
                    answers += int(sums[i, v, u] * edge[i] > 0)
                out[0, column] += answers
                out[1, column] += edges


@njit
def mask_presence(
    presence: tuple[Array, Array, Array],
    seen: Array,
    place: tuple[Array, complex, float, int],
    bins: int,
    edge: float,
    out: tuple[Array, Array, Array, Array],
) -> None:
    """Copy presence where a layout's place is into zeros, `out`, with the prior of each cluster in each cell.

    A line's width shows within `bins` px from its axis, and ends at `edge` of its peak; without bins the
    layout is of squares. `place` are the clusters' places, a direction, spacing and grid. A cluster's prior
    in a cell is its share of it; its pixels are those within a spacing of its place.
    """
    (likely, selected, pixels), (prior, probability, chosen, near) = presence, out
    places, unit, spacing, grid = place
    across, wide = spacing, 0
    profile = np.empty(bins)
    if bins:
        wide = measure_core_profile(likely, seen, places, unit, spacing, grid, edge, profile)
        across = float(wide)
        if wide == 0:
            # A width of 0 would mean a panel; the line shows nowhere.
            wide, profile[0] = 1, 0.0
    (clusters, rows, columns), (_, height, width) = prior.shape, pixels.shape
    half = spacing / 2 + grid
    cells_right, cells_down = _strip_extent(unit, half, float(wide) if bins else half)
    right, down = _strip_extent(unit, spacing, across)
    for k in range(clusters):
        x, y = places[k].real, places[k].imag
        for r in range(max(int((y - cells_down) / grid), 0), min(int((y + cells_down) / grid) + 1, rows)):
            left = max(int((x - cells_right) / grid), 0)
            for c in range(left, min(int((x + cells_right) / grid) + 1, columns)):
                off = complex(c * grid + (grid - 1) / 2, r * grid + (grid - 1) / 2) - places[k]
                off *= unit.conjugate()
                share = _overlap_share(off.real, spacing / 2, grid)
                if not bins:
                    share *= _overlap_share(off.imag, spacing / 2, grid)
                else:
                    share *= profile[int(abs(off.imag))] if abs(off.imag) < wide else 0.0
                if share > 0:
                    prior[k, r, c] = share
                    probability[k, r, c], chosen[k, r, c] = likely[k, r, c], selected[k, r, c]
        for v in range(max(int(y - down), 0), min(int(y + down) + 2, height)):
            for u in range(max(int(x - right), 0), min(int(x + right) + 2, width)):
                off = (complex(u, v) - places[k]) * unit.conjugate()
                if abs(off.real) <= spacing and abs(off.imag) <= across:
                    near[k, v, u] = pixels[k, v, u]


_BEYOND_PX = 2.0
"""How far beyond its end a cluster's light counts, px: so far a lens and pixels spread it. Farther away is
that of others, by which events between theirs make its code look present."""

_SHARPER = 1.5
"""Power of the light that clusters share a line by: mirror images balance where they meet by any. What
others' events leave in lines that are wholly one's counts less with it than by 1; by 2 the few lines that are
shared count alone. At rest and turning, simulated points are off the least by this.
"""

_INNER = 0.3
"""Half of the middle part of a cluster, in spacings, in which all light is its own."""


@njit
def measure_light(
    pilot_sums: Array,
    code: Array,
    every: int,
    at: complex,
    unit: complex,
    spacing: float,
    reach: float,
    out: Array,
) -> bool:
    """Measure the light of a cluster at `at` in each line of pixels across the direction `unit`: `out`.

    Lines are rows, or columns where `unit` lies flat. A line's light is the sum of the events within `reach`
    of the way that are in step with every `every`-th edge of `code`; `out` is this over the middle's, to the
    power of `_SHARPER`. Events that a moving image makes between edges are of opposite signs to both sides of
    its middle, and some codes mark all edges by one sign: only sums over lines cancel these. Negative sums
    are 0.

    Returns:
        False if the middle has no light.
    """
    _, height, width = pilot_sums.shape
    rows = abs(unit.imag) >= abs(unit.real)
    place, side = (at.imag, at.real) if rows else (at.real, at.imag)
    slope = unit.real / unit.imag if rows else unit.imag / unit.real
    lines, across = (height, width) if rows else (width, height)
    half = 0.5 * spacing * max(abs(unit.real), abs(unit.imag))
    far = half + _BEYOND_PX + 0.5
    out[:] = 0
    inner, many = 0.0, 0
    first, last = max(int(np.ceil(place - far)), 0), min(int(place + far), lines - 1)
    # Whole rows of pixels are summed faster than single ones.
    top, bottom = first, last
    if not rows:
        margin = abs(slope) * far + reach + 0.5
        top, bottom = max(int(side - margin), 0), min(int(side + margin), height - 1)
    answers = np.zeros((max(bottom - top + 1, 0), width), np.int32)
    sums = answers.reshape(-1)
    for j in range(0, code.size, every):
        sign, line = np.int32(code[j]), pilot_sums[1 + j, top : bottom + 1].reshape(-1)
        for u in range(sums.size):
            sums[u] = np.int32(sums[u] + np.int32(sign * line[u]))
    for i in range(first, last + 1):
        middle = side + slope * (i - place)
        total = 0.0
        for u in range(
            max(int(np.ceil(middle - reach - 0.5)), 0), min(int(middle + reach + 0.5), across - 1) + 1
        ):
            answer = answers[i - top, u] if rows else answers[u - top, i]
            total += min(reach + 0.5 - abs(u - middle), 1.0) * answer
        away = abs(i - place)
        out[i] = max(total, 0.0) * min(far - away, 1.0)
        if away <= max(2 * _INNER * half, 0.5):
            inner += out[i]
            many += 1
    if inner <= 0:
        return False
    for i in range(first, last + 1):
        out[i] = (out[i] * many / inner) ** _SHARPER
    return True


@njit
def find_boundary(mine: Array, its: Array, start: float, end: float) -> float:
    """Where two clusters meet, as a share of the way between their centres' lines; NaN if unseen.

    In each line from `start` to `end`, the light of both (`measure_light`) gives the first's share.
    """
    # Centres within a pixel have no lines between them.
    if abs(end - start) < 1.0:
        return np.nan
    sign = 1 if end > start else -1
    first, last = int(np.rint(start)), int(np.rint(end))
    total, lines, empty = 0.0, 0, 0
    for i in range(first, last + sign, sign):
        one, other = (mine[i], its[i]) if 0 <= i < mine.size else (0.0, 0.0)
        lines += 1
        if one + other > 0:
            total += one / (one + other)
        else:
            empty += 1
            total += 0.5
    if 2 * empty > lines:
        return np.nan
    return (first + sign * (total - 0.5) - start) / (end - start)


_ROUNDS_ACROSS = 4
"""Each brings the window nearer to the middle by the share of the light that it holds: half a cell to .01
px."""


_TOP = 0.7
"""Share of the most events that counts as all of them: the brightest pixels, kept busy, give fewer."""


@njit
def find_offset_across(
    pilot_sums: Array,
    edges: Array,
    x: float,
    y: float,
    unit: complex,
    along: float,
    across: float,
    profile: Array,
) -> float:
    """How far beside (x, y) the middle of a cluster's light is, across a line of direction `unit`, px.

    It is the mean of the events in step with the cluster's own edges (n,), within `along` of the place and
    within `across` of the middle itself: a window about any other place, such as that of whole cells, would
    hold more of one side's light. Rising and falling edges weigh alike, however many of either a code has:
    events follow a moving image between edges, so that rising ones show it ahead of where it was, and falling
    ones behind. `profile` takes these events by columns where the line stands upright, else by rows.
    """
    _, height, width = pilot_sums.shape
    off = 0.0
    wide, high = _strip_extent(unit, along, across + 1.0)
    top, bottom = max(int(np.ceil(y - high)), 0), min(int(y + high), height - 1)
    left, right = max(int(np.ceil(x - wide)), 0), min(int(x + wide), width - 1)
    if top > bottom or left > right:
        return 0.0
    wide = right - left + 1
    light = np.zeros((bottom - top + 1, wide))
    ups, downs = 0, 0
    for edge in edges:
        ups, downs = ups + int(edge > 0), downs + int(edge < 0)
    for j in range(edges.size):
        if edges[j] != 0:
            weight, image = edges[j] / (ups if edges[j] > 0 else downs), pilot_sums[1 + j]
            for v in range(top, bottom + 1):
                into, line = light[v - top], image[v, left:]
                for u in range(wide):
                    into[u] += weight * line[u]
    # Pixels within `along`: light, distance to the side, and place in the profile, for all rounds.
    lit, aside, at = np.empty(light.size), np.empty(light.size), np.empty(light.size, np.int64)
    upright, many = abs(unit.imag) >= abs(unit.real), 0
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            away = complex(u - x, v - y) * unit.conjugate()
            if abs(away.real) <= along:
                lit[many], aside[many], at[many] = light[v - top, u - left], away.imag, u if upright else v
                many += 1
    for _ in range(_ROUNDS_ACROSS):
        total, moment = 0.0, 0.0
        for i in range(many):
            beside = aside[i] - off
            share = min(max(across + 0.5 - abs(beside), 0.0), 1.0)
            if share > 0:
                total += share * lit[i]
                moment += share * lit[i] * beside
        if total <= 0:
            return 0.0
        off += min(max(moment / total, -1.0), 1.0)
    for i in range(many):
        profile[at[i]] += min(max(across + 0.5 - abs(aside[i] - off), 0.0), 1.0) * lit[i]
    return off


@njit
def flank_width_px(profile: Array) -> float:
    """Over how many pixels a line's image fades out to each side, by the events of columns; NaN if unseen.

    For a flank that falls evenly over w pixels, the sum of r (1 - r), r the share of all events, is w / 6 on
    average over where in a pixel it begins; two flanks have twice that. What exceeds `_TOP` counts as full.
    """
    first = second = 0.0
    for value in profile:
        first, second = max(first, value), max(second, min(first, value))
    top = _TOP * (first + second) / 2
    if top <= 0:
        return np.nan
    total = 0.0
    for value in profile:
        share = min(value / top, 1.0)
        total += share * (1 - share)
    return max(3 * total, 0.0)


@njit
def find_clusters(
    pixels: Array,
    shown: Array,
    places: Array,
    reach: float,
    pilot_sums: Array,
    edges: Array,
    line: tuple[complex, float],
    found: tuple[Array, Array],
) -> tuple[int, float]:
    """Find the mean places of the clusters' pixels about where they should be: `found` (K, 2), NaN if unseen.

    `shown` (K,) selects the clusters, sought about their `places` within half of `reach`, their spacing, and
    1.5 px. `pilot_sums` are the polarity sums of a pilot, `edges` those of the codes (K, n), the first into
    chip 1. For a `line` (its direction in the image, and how far across it light counts, px, 0 for none), the
    middles across it are those of `find_offset_across`. The second array of `found` (K,) is 1, NaN if unseen.

    Returns:
        How many are seen; the width of a line's flanks, px, see `flank_width_px`, NaN without a line.
    """
    clusters, height, width = pixels.shape
    (unit, across), (points, wider) = line, found
    window = 0.5 * reach + 1.5
    profile, seen = np.zeros(max(height, width)), 0
    for k in range(clusters):
        points[k, 0] = points[k, 1] = wider[k] = np.nan
        if not shown[k]:
            continue
        x, y = places[k].real, places[k].imag
        sum_w, sum_x, sum_y = 0.0, 0.0, 0.0
        for v in range(max(int(np.ceil(y - window)), 0), min(int(y + window), height - 1) + 1):
            for u in range(max(int(np.ceil(x - window)), 0), min(int(x + window), width - 1) + 1):
                w = pixels[k, v, u]
                sum_w += w
                sum_x += w * u
                sum_y += w * v
        if sum_w > 0:
            seen, wider[k] = seen + 1, 1.0
            points[k, 0], points[k, 1] = sum_x / sum_w, sum_y / sum_w
            if across > 0:
                x, y = points[k, 0], points[k, 1]
                off = find_offset_across(pilot_sums, edges[k], x, y, unit, 0.5 * reach, across, profile)
                points[k, 0] -= off * unit.imag
                points[k, 1] += off * unit.real
    return seen, flank_width_px(profile)


@njit
def centre_between_boundaries(
    mean: Array,
    places: Array,
    neighbours: Array,
    way: tuple[complex, float],
    pilot: tuple[Array, Array, int],
    points: Array,
    one_sided: float,
    wider: Array,
) -> None:
    """Move clusters along an axis to midway between their boundaries with their neighbours: `points` (K, 2).

    `mean` (K, 2) are the middles of their pixels, NaN if unseen, `places` where they should be, and
    `neighbours` (K,) the next cluster along the axis of `way` (direction, spacing in px), -1 for none.
    `wider` (K,) becomes `one_sided` where a cluster has a boundary on one side only. `pilot` holds sums and
    edges as for `find_clusters`, and the chips from one edge that tells clusters apart to the next.
    """
    clusters = len(mean)
    along, reach = way
    pilot_sums, edges, every = pilot
    rows = abs(along.imag) >= abs(along.real)
    lines = pilot_sums.shape[1] if rows else pilot_sums.shape[2]
    lights, lit = np.empty((clusters, lines)), np.empty(clusters, np.bool_)
    centres = np.empty(clusters, np.complex128)
    before, after = np.empty(clusters), np.empty(clusters)
    for k in range(clusters):
        lit[k], before[k], after[k] = False, np.nan, np.nan
        if not np.isnan(mean[k, 0]):
            off = (complex(mean[k, 0], mean[k, 1]) - places[k]) * along.conjugate()
            centres[k] = places[k] + along * complex(0.0, off.imag)
            window = 0.5 * reach + 1.5
            lit[k] = measure_light(pilot_sums, edges[k], every, centres[k], along, reach, window, lights[k])
    for k in range(clusters):
        other = neighbours[k]
        if other < 0 or not (lit[k] and lit[other]):
            continue
        a, b = centres[k], centres[other]
        start, end = (a.imag, b.imag) if rows else (a.real, b.real)
        share = find_boundary(lights[k], lights[other], start, end)
        if -0.5 < share < 1.5:
            after[k] = before[other] = ((a + share * (b - a)) * along.conjugate()).real
    gap, both = 0.0, 0
    for k in range(clusters):
        if not np.isnan(before[k] + after[k]):
            gap += after[k] - before[k]
            both += 1
    gap = gap / both if both else reach
    for k in range(clusters):
        has_before, has_after = not np.isnan(before[k]), not np.isnan(after[k])
        if not (has_before or has_after):
            continue
        centre = before[k] + gap / 2 if has_before else after[k] - gap / 2
        if has_before and has_after:
            centre = (before[k] + after[k]) / 2
        else:
            wider[k] = one_sided
        move = centre - (complex(mean[k, 0], mean[k, 1]) * along.conjugate()).real
        points[k, 0] += move * along.real
        points[k, 1] += move * along.imag


@njit
def move_to_sensor(
    points: Array, layout: Array, places: Array, corner: tuple[float, float]
) -> tuple[float, float, float]:
    """Move points (K, 2) from an image to the sensor, on which the image's `corner` is; NaN ones stay NaN.

    Returns:
        Sum of squared residuals of the best similarity, px2; mean offset, right and down, of the points on
        the sensor from their places (K,) in the image.
    """
    n = 0
    image_mean, layout_mean = complex(0.0, 0.0), complex(0.0, 0.0)
    for k in range(layout.size):
        if not np.isnan(points[k, 0]):
            n += 1
            image_mean += complex(points[k, 0], points[k, 1])
            layout_mean += layout[k]
    image_mean /= n
    layout_mean /= n
    cross, power, squares = complex(0.0, 0.0), 0.0, 0.0
    for k in range(layout.size):
        if not np.isnan(points[k, 0]):
            c = layout[k] - layout_mean
            cross += c.conjugate() * (complex(points[k, 0], points[k, 1]) - image_mean)
            power += abs(c) ** 2
    for k in range(layout.size):
        if not np.isnan(points[k, 0]):
            off = complex(points[k, 0], points[k, 1]) - image_mean - cross / power * (layout[k] - layout_mean)
            squares += abs(off) * abs(off)
    right, down = 0.0, 0.0
    for k in range(layout.size):
        points[k, 0] += corner[0]
        points[k, 1] += corner[1]
        if not np.isnan(points[k, 0]):
            right += points[k, 0] - places[k].real
            down += points[k, 1] - places[k].imag
    return squares, right / n, down / n


@njit
def find_lit_clusters(
    sums: Array, weight: Array, grid: int, pilot_chips: int, least: float, seen: Array, out: Array
) -> tuple[float, float, float]:
    """Find which of the clusters `seen` (K,) still have events in the info segment: `out` (K,).

    They need more than `least` of the pilot's rate, by the share of chips with events, summed over pixels
    with the cells' `weight` (K, rows, columns).

    Returns:
        By how much the rate of info events in pixels without a cluster exceeds that of the pilot, over the
        pilot's rate in pixels of clusters; and the events a chip, over the pilot's, of the darker and of the
        brighter half of the info segment.
    """
    chips, height, width = sums.shape
    clusters, rows, columns = weight.shape
    flat = np.ascontiguousarray(sums).reshape(chips, height * width)
    # Of the pilot, and of the first and the second half of the info.
    half = (chips - pilot_chips) // 2
    events, many = np.zeros((3, height * width), np.int16), np.zeros(3)
    for c in range(chips):
        part = int(c >= pilot_chips) + int(c >= pilot_chips + half)
        line, some = flat[c], events[part]
        for j in range(line.size):
            some[j] = np.int16(some[j] + np.int16(line[j] != 0))
    for part in range(3):
        total_of, some = np.int32(0), events[part]
        for j in range(some.size):
            total_of = np.int32(total_of + some[j])
        many[part] = total_of
    shares = np.zeros((2, rows, columns))
    by = (1 / pilot_chips, 1 / max(chips - pilot_chips, 1))
    for r in range(rows):
        for v in range(r * grid, (r + 1) * grid):
            pilot, first, second = events[0, v * width :], events[1, v * width :], events[2, v * width :]
            for c in range(columns):
                for u in range(c * grid, (c + 1) * grid):
                    shares[0, r, c] += pilot[u] * by[0]
                    shares[1, r, c] += (first[u] + second[u]) * by[1]
    empty, shown, heavy = np.ones((rows, columns), np.bool_), 0.0, 0.0
    for k in range(clusters):
        total = 0.0
        for r in range(rows):
            for c in range(columns):
                if weight[k, r, c] != 0:
                    total += weight[k, r, c] * (shares[1, r, c] - least * shares[0, r, c])
                    shown += weight[k, r, c] * shares[0, r, c]
                    heavy += weight[k, r, c]
                    empty[r, c] = False
        out[k] = seen[k] and total > 0
    more, cells = 0.0, 0
    for r in range(rows):
        for c in range(columns):
            if empty[r, c]:
                more += shares[1, r, c] - shares[0, r, c]
                cells += 1
    more *= heavy / (cells * shown) if cells and shown > 0 else 0.0
    chip = max(many[0] * by[0], 1e-9)
    one, other = many[1] / max(half, 1) / chip, many[2] / max(chips - pilot_chips - half, 1) / chip
    return more, min(one, other), max(one, other)


@njit
def calibrate_llr(
    read: Array,
    llr: Array,
    seen: Array,
    expected: tuple[float, float, float],
    sure: tuple[float, float],
    symbols: Array,
    scaled: Array,
) -> float:
    """Scale LLRs (K, bits) so that their sizes' variance is twice the mean; keep the symbols that are sure.

    A cluster's variance is pooled with that of all sizes of the frame and an expected one, a share of its
    mean squared; `expected` is what the first and the second are worth, in sizes, and the share. Clusters
    unseen, or with a symbol of -1, get LLRs of 0 and a symbol of -1; those whose probability is below the
    first of `sure` get a symbol of -1 only. The second of `sure` is how many errors come together.

    Returns:
        Probability that all symbols given are right; 0 if none is.
    """
    frame_worth, expected_worth, spread = expected
    least, together = sure
    clusters, bits = llr.shape
    symbols[:] = -1
    scaled[:] = 0
    n, total, squares = 0, 0.0, 0.0
    for k in range(clusters):
        if seen[k] and read[k] >= 0:
            for b in range(bits):
                n += 1
                total += abs(np.float64(llr[k, b]))
    if total == 0:
        return 0.0
    mean = total / n
    for k in range(clusters):
        if seen[k] and read[k] >= 0:
            for b in range(bits):
                squares += (abs(np.float64(llr[k, b])) - mean) ** 2
    given, right = 0, 1.0
    for k in range(clusters):
        if seen[k] and read[k] >= 0:
            own, off, nearest = 0.0, 0.0, np.inf
            for b in range(bits):
                own += abs(np.float64(llr[k, b])) / bits
            for b in range(bits):
                off += (abs(np.float64(llr[k, b])) - own) ** 2
            off += frame_worth * squares / n + expected_worth * (spread * own) ** 2
            # The mean takes one degree of freedom.
            scale = 2 * own * (bits - 1 + frame_worth + expected_worth) / off if own > 0 else 0.0
            for b in range(bits):
                scaled[k, b] = llr[k, b] * scale
                nearest = min(nearest, abs(llr[k, b] * scale))
            chance = 1 / (1 + np.exp(-nearest))
            if chance >= least:
                symbols[k] = read[k]
                right *= chance
                given += 1
    return right ** (1 / together) if given else 0.0


@njit
def fit_newest(
    past: Array, speed_weight: float, curvature_weight: float, worth: float, outlier: float
) -> tuple[float, float, float]:
    """Fit all measurements: rate of change at the newest and its variance, and the variance of the newest.

    `past` (n, 3) holds times, values and variances. Values follow a parabola whose rate and curvature have
    priors of these weights. Squared residuals over the expected ones, with `worth` expected ones added, scale
    the variances; residuals beyond `outlier` are clipped, and the newest, if it is one, counts by its own.
    """
    n = len(past)
    terms, normal, right = np.empty(3), np.empty((3, 3)), np.empty(3)
    likely, inverse, path = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    left = np.empty(n)
    scale = 1.0
    # The scale weighs the priors against the values, and hardly changes after the first round.
    for _ in range(2):
        normal[:] = 0.0
        right[:] = 0.0
        for i in range(n):
            t = past[i, 0] - past[n - 1, 0]
            terms[0], terms[1], terms[2] = 1.0, t, t * t / 2
            weight = 1 / (past[i, 2] * scale)
            for a in range(3):
                right[a] += weight * terms[a] * (past[i, 1] - past[n - 1, 1])
                for b in range(3):
                    normal[a, b] += weight * terms[a] * terms[b]
        for a in range(3):
            for b in range(3):
                likely[a, b] = normal[a, b]
        likely[1, 1] += speed_weight
        likely[2, 2] += curvature_weight
        invert_matrix(likely, _ROUNDING, inverse)
        free, counted = float(n), 0.0
        for a in range(3):
            path[a] = 0.0
            for b in range(3):
                path[a] += inverse[a, b] * right[b]
                free -= inverse[a, b] * normal[a, b]
        for i in range(n):
            t = past[i, 0] - past[n - 1, 0]
            off = past[i, 1] - past[n - 1, 1] - path[0] - path[1] * t - path[2] * t * t / 2
            left[i] = off * off / past[i, 2]
            counted += min(left[i], outlier * scale)
        scale = (worth + counted) / (worth + max(free, 0.0))
    newest = max(scale, left[n - 1]) if left[n - 1] > outlier * scale else scale
    return path[1], inverse[1, 1], newest * past[n - 1, 2]


@njit
def _solve_parabola(
    place: Array, weight: Array, off: Array, least: float, right: Array, inverse: Array
) -> tuple[int, float]:
    """Weighted least squares of a parabola: right sides (k, 3) for offsets (k, n), and the inverse.

    `off` is weighted. Boundaries of less than `least` of the heaviest weight are left out. Returns how many
    are used, 0 where they are too few or lie on one place, and that least weight.
    """
    lightest, n = 0.0, 0
    for i in range(place.size):
        lightest = max(lightest, least * weight[i])
    normal = np.zeros((3, 3))
    right[:] = 0.0
    for i in range(place.size):
        if weight[i] > lightest:
            terms = place[i] ** 2, 1.0, place[i]
            n += 1
            for a in range(3):
                for k in range(len(off)):
                    right[k, a] += terms[a] * off[k, i]
                for b in range(3):
                    normal[a, b] += weight[i] * terms[a] * terms[b]
    return (n if n > 3 and invert_matrix(normal, _ROUNDING, inverse) else 0), lightest


@njit
def estimate_curvature(
    place: Array, sums: Array, least: float, bias: float, bias_variance: float
) -> tuple[float, float]:
    """Curvature of a parabola through boundaries, and its variance by their scatter about it; NaN of too few.

    `place` (n,) are where they are; `sums` (3, n) their weights, and weighted, their offsets and those of a
    pixel- phase bias of 1; those of less than `least` of the heaviest are left out. The phase bias is `bias`.
    """
    right, inverse = np.empty((2, 3)), np.empty((3, 3))
    weight = sums[0]
    n, lightest = _solve_parabola(place, weight, sums[1:], least, right, inverse)
    # The variance of a normal variable over an estimated sigma is finite from three degrees of freedom on.
    if n - 3 < 3:
        return np.nan, np.nan
    path, by_bias = np.zeros(3), 0.0
    for b in range(3):
        by_bias += inverse[0, b] * right[1, b]
        for a in range(3):
            path[a] += inverse[a, b] * (right[0, b] - bias * right[1, b])
    left = 0.0
    for i in range(place.size):
        if weight[i] > lightest:
            off = (sums[1, i] - bias * sums[2, i]) / weight[i]
            off -= path[0] * place[i] ** 2 + path[1] + path[2] * place[i]
            left += weight[i] * off * off
    return path[0], inverse[0, 0] * left / (n - 3 - 2) + bias_variance * by_bias * by_bias


@njit
def add_phase_bias(
    place: Array, sums: Array, least: float, out: Array, known: tuple[Array, Array], off: Array
) -> tuple[float, float, float, float, float, float]:
    """Add a frame's evidence of a pixel-phase bias, beyond any parabola, to `out` (4,).

    That is, of the residuals about the best parabola, weighted: the sum of squares of the bias' pattern, of
    its products with the offsets, of squares of the offsets, and the degrees of freedom. `place`, `sums` and
    `least` are as in `estimate_curvature`.

    `off` (n,) takes the offsets, NaN where left out; `known` are sums (3, n) of this frame and those before,
    and the offsets of the one before, or none.

    Returns:
        Sums of squares of the offsets, of their means and of the mean patterns over all frames; the median
        change of the offsets since the frame before, NaN of none; how many frames weigh as much as all; and
        how many of them show the same errors, as they have the same pattern.
    """
    right, inverse = np.empty((2, 3)), np.empty((3, 3))
    weight, moved = sums[0], np.empty(place.size)
    # A literal 0 would compile another median.
    many: Any = np.int64(0)
    n, lightest = _solve_parabola(place, weight, sums[1:], least, right, inverse)
    squares, mean_squares, pattern_squares, light, all_light = 0.0, 0.0, 0.0, 0.0, 0.0
    own_squares = 1e-300
    for i in range(place.size):
        off[i] = np.nan
        if weight[i] > lightest:
            off[i] = sums[1, i] / weight[i]
            squares += off[i] * off[i]
            mean_squares += (known[0][1, i] / known[0][0, i]) ** 2
            pattern_squares += (known[0][2, i] / known[0][0, i]) ** 2
            own_squares += (sums[2, i] / weight[i]) ** 2
            light += weight[i]
            all_light += known[0][0, i]
            if known[1].size == place.size and known[1][i] == known[1][i]:
                moved[many] = abs(off[i] - known[1][i])
                many += 1
            if n:
                out[0] += sums[2, i] * sums[2, i] / weight[i]
                out[1] += sums[2, i] * sums[1, i] / weight[i]
                out[2] += sums[1, i] * sums[1, i] / weight[i]
    if n:
        for a in range(3):
            for b in range(3):
                out[0] -= right[1, a] * inverse[a, b] * right[1, b]
                out[1] -= right[1, a] * inverse[a, b] * right[0, b]
                out[2] -= right[0, a] * inverse[a, b] * right[0, b]
        out[3] += n - 3
    frames = all_light / max(light, 1e-300)
    alike = frames * min(pattern_squares / own_squares, 1.0)
    return squares, mean_squares, pattern_squares, median(moved, many) if many else np.nan, frames, alike


@njit
def estimate_foreshortening(
    sine: Array, likely: Array, seen: float, sigma: float, along: float, across: float
) -> tuple[float, float]:
    """Mean and variance of a tilted bar's foreshortening, by the prior of its sines and the one measured.

    That is its length over that of a bar parallel to the sensor at the same depth: exact, for a pinhole. A
    bar whose direction has the part -sine along the optical axis, and whose middle is seen at tangents
    (along, across) of the axis, looks sqrt(1 - sine^2 (1 + across^2)) + along sine times as long: cos(tilt)
    in the middle of the image, elsewhere about `along` times the tilt more or less, which is of first order.

    `sine` (n,) are sines of tilts, `likely` (n,) their priors; `seen` with `sigma` is the one measured, or
    NaN.
    """
    chance = likely
    if not np.isnan(seen):
        chance = np.empty(sine.size)
        for i in range(sine.size):
            off = (sine[i] - seen) / sigma
            chance[i] = likely[i] * exp(-0.5 * min(off * off, 1400.0))
        if not chance.sum() > 0:
            # A curvature that no tilt makes is no evidence of one.
            chance = likely
    total, mean, square = 0.0, 0.0, 0.0
    for i in range(sine.size):
        flat = max(1 - sine[i] * sine[i] * (1 + across * across), 0.0)
        length = sqrt(flat) + along * sine[i]
        total += chance[i]
        mean += chance[i] * length
        square += chance[i] * length * length
    mean /= total
    return mean, max(square / total - mean * mean, 0.0)


@njit
def farthest_offset_px(selected: Array, grid: int, on: complex, turn: complex) -> float:
    """Farthest distance of the middle of any selected cell from the line through `on` along `turn`, px."""
    clusters, _, columns = selected.shape
    most = 0.0
    for k in range(clusters):
        top, bottom = find_rows(selected[k])
        for r in range(top, bottom):
            for c in range(columns):
                if selected[k, r, c]:
                    off = complex(c * grid + (grid - 1) / 2, r * grid + (grid - 1) / 2) - on
                    most = max(most, abs((off * turn.conjugate()).imag))
    return most


@njit
def assign_cells(
    at: Array, cluster: Array, cells: Array, places: Array, reach: float, half: float, seen: Array
) -> tuple[int, int, float, int]:
    """Find which clusters are `seen` in their place (K,): by more cells than others have there.

    A blob's cells are in place within `reach` of their cluster's place; others to the nearest within `half`.

    Returns:
        Places that show cells; those in which their cluster is seen; the cells of these; and the cells
        farther than `reach` from every place.
    """
    in_place, out_of_place, left = np.zeros(places.size), np.zeros(places.size), 0
    for i in range(at.size):
        if abs(at[i] - places[cluster[i]]) <= reach:
            in_place[cluster[i]] += cells[i]
            continue
        nearest, least = 0, np.inf
        for k in range(places.size):
            off = abs(at[i] - places[k])
            if off < least:
                nearest, least = k, off
        if least <= half:
            out_of_place[nearest] += cells[i]
        if least > reach:
            left += cells[i]
    shown, many, total = 0, 0, 0.0
    for k in range(places.size):
        seen[k] = in_place[k] > out_of_place[k]
        shown += in_place[k] + out_of_place[k] > 0
        if seen[k]:
            many += 1
            total += in_place[k]
    return shown, many, total, left


@njit
def interpolate_centres(
    times: Array, start_us: float, unit_us: float, samples: Array, ahead: float, centre: Array
) -> None:
    """Interpolate the `centre` (2, m) at `start_us + times * unit_us` (m,) on straight lines between samples.

    `samples` (5, n) are times, columns, rows, ... Beyond the first and the last one the line goes on for
    `ahead` times the time to their neighbour.
    """
    t_us, n = samples[0], samples.shape[1]
    for a in range(2):
        at = samples[a + 1]
        j = 0
        for i in range(times.size):
            if n == 1:
                centre[a, i] = at[0]
                continue
            t = start_us + times[i] * unit_us
            while j > 0 and t_us[j] > t:
                j -= 1
            while j < n - 2 and t_us[j + 1] <= t:
                j += 1
            span_us, known = t_us[j + 1] - t_us[j], j + int(t > t_us[j + 1])
            after_us = min(max(t - t_us[known], -ahead * span_us), ahead * span_us)
            centre[a, i] = (at[j + 1] - at[j]) / span_us * after_us + at[known]


@njit
def clear_cells(hits: Array, boxes: Array, cell_shift: int) -> int:
    """Set the cells that boxes of pixels (n, 4) touch to 0; return the hits that they had."""
    cleared = 0
    for left, top, right, bottom in boxes:
        for v in range(top >> cell_shift, min((bottom - 1 >> cell_shift) + 1, hits.shape[0])):
            for u in range(left >> cell_shift, min((right - 1 >> cell_shift) + 1, hits.shape[1])):
                cleared += hits[v, u]
                hits[v, u] = 0
    return cleared


@njit
def fit_row_slope(
    rows: Array, fit: Array, seen: Array, fewest: int, chance: float, least: float
) -> tuple[float, float]:
    """Slope of the best lag over rows, lags a row, and its sigma; NaN of too few blocks.

    `rows` (blocks,) are the blocks' middles, `fit` (blocks, lags) how well each fits, `seen` its events. A
    block beside the light, or hidden, has few events, or fits by chance: less than a quarter of the median,
    or than `chance` sigmas of its events. `least` is the least error of a place.
    """
    blocks, lags = fit.shape
    top = np.empty(blocks)
    for b in range(blocks):
        top[b] = fit[b, 0]
        for lag in range(1, lags):
            top[b] = max(top[b], fit[b, lag])
    middle = median(top.copy(), blocks) if blocks else 0.0
    at, place = np.empty(blocks), np.empty(blocks)
    # A literal 0 would compile another median.
    n: Any = np.int64(0)
    for b in range(blocks):
        if top[b] > max(middle / 4, chance * np.sqrt(seen[b])):
            # The top is flat where a window holds all events of an edge: its middle is the best window.
            weight, total = 0.0, 0.0
            for lag in range(lags):
                over = max(fit[b, lag] - 0.9 * top[b], 0.0)
                weight += over
                total += over * lag
            at[n], place[n] = rows[b], total / weight
            n += 1
    if n < fewest:
        return np.nan, np.nan
    # A median of pairs: blocks with a part of the bar hidden, or another's light, are outliers.
    slopes = np.empty(n * n)
    pairs: Any = np.int64(0)
    for i in range(n):
        for j in range(i + 1, n):
            if at[j] - at[i] > (at[n - 1] - at[0]) / 3:
                slopes[pairs] = (place[j] - place[i]) / (at[j] - at[i])
                pairs += 1
    if not pairs:
        return np.nan, np.nan
    slope = median(slopes, pairs)
    rest, mean, squares = np.empty(n), at[:n].sum() / n, 0.0
    for i in range(n):
        rest[i] = place[i] - slope * at[i]
        squares += (at[i] - mean) ** 2
    middle = median(rest, n)
    for i in range(n):
        rest[i] = abs(rest[i] - middle)
    spread = max(1.48 * median(rest, n), least)
    return slope, spread / np.sqrt(squares)


@njit
def fit_row_delay(
    counts: Array,
    chips: Array,
    chip_steps: int,
    step_us: float,
    rows: Array,
    limits: tuple[int, float, float],
) -> tuple[float, float]:
    """Delay from row to row by both polarities together, and its sigma, us; NaN where neither shows it.

    `counts` are those of `count_rows`, in steps of `step_us`; `rows` and `limits` are as in `fit_row_slope`.
    """
    fewest, chance, least = limits
    _, blocks, steps = counts.shape
    fit = np.empty((blocks, steps - chips.size * chip_steps + 1))
    running, seen, total, weight = np.zeros(steps + 1), np.empty(blocks), 0.0, 0.0
    for polarity in range(2):
        # How well each block fits at each lag: positive events are where chips are +1, negative ones at -1.
        sign = 1 if polarity else -1
        for b in range(blocks):
            for s in range(steps):
                running[s + 1] = running[s] + counts[polarity, b, s]
            seen[b] = running[steps]
            for lag in range(fit.shape[1]):
                fit[b, lag] = 0.0
                for c in range(chips.size):
                    at = lag + c * chip_steps
                    fit[b, lag] += sign * chips[c] * (running[at + chip_steps] - running[at])
        slope, sigma = fit_row_slope(rows, fit, seen, fewest, chance, least)
        if np.isfinite(slope):
            total += slope * step_us / (sigma * step_us) ** 2
            weight += 1 / (sigma * step_us) ** 2
    return (total / weight, 1 / np.sqrt(weight)) if weight else (np.nan, np.nan)
