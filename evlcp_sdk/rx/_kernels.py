"""Loops over events, compiled."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def keep_ordered(t_us, x, y, width, height, last_us, keep):
    """Mark events inside the sensor and not before their predecessor; count the others.

    Returns:
        (events off the sensor, events before their predecessor, time of the last kept event).
    """
    off = 0
    backward = 0
    for i in range(t_us.size):
        good = True
        if t_us[i] < last_us:
            backward += 1
            good = False
        elif x[i] >= width or y[i] >= height:
            off += 1
            good = False
        keep[i] = good
        if good:
            last_us = t_us[i]
    return off, backward, last_us


@njit(cache=True, nogil=True)
def score_pixels(t_us, x, y, p, flip_us, state, hits, run_us, min_score, cell_shift):
    """Update each pixel's score of runs at the chip rate; count candidate events in cells.

    `state` packs score and last polarity: 2 * score + polarity. `run_us` holds the bounds of a run's length:
    below [0] noise, to [1] one chip, to [2] two chips, above: slower than any code of the air interface.
    """
    shortest, single, double = run_us
    for i in range(t_us.size):
        s = state[y[i], x[i]]
        if (s & 1) != p[i]:
            run = t_us[i] - flip_us[y[i], x[i]]
            score = s >> 1
            if run >= double:
                score = max(score - 3, 0)
            elif shortest <= run < single:
                score = min(score + 2, 40)
            flip_us[y[i], x[i]] = t_us[i]
            s = (score << 1) | p[i]
            state[y[i], x[i]] = s
        if (s >> 1) >= min_score:
            hits[y[i] >> cell_shift, x[i] >> cell_shift] += 1


@njit(cache=True, nogil=True)
def active_profile(flip_us, state, box, since_us, min_score, rows, columns):
    """Count pixels of a box that blink at the chip rate and flipped since `since_us`, by row and column."""
    left, top, right, bottom = box
    rows[:] = 0
    columns[:] = 0
    for v in range(top, bottom):
        for u in range(left, right):
            if flip_us[v, u] >= since_us and (state[v, u] >> 1) >= min_score:
                rows[v - top] += 1
                columns[u - left] += 1


@njit(cache=True, nogil=True)
def select_box(t_us, x, y, p, box, out_t, out_x, out_y, out_p):
    """Copy the events inside a box (left, top, right, bottom); return how many."""
    left, top, right, bottom = box
    n = 0
    for i in range(t_us.size):
        if left <= x[i] < right and top <= y[i] < bottom:
            out_t[n] = t_us[i]
            out_x[n] = x[i]
            out_y[n] = y[i]
            out_p[n] = p[i]
            n += 1
    return n


@njit(cache=True, nogil=True)
def add_polarity(t_us, x, y, p, start_on_us, start_off_us, chip_us, shift_x, shift_y, sums):
    """Add events to polarity sums (chips, height, width); pixel (0, 0) of chip c is (shift_x[c], shift_y[c])."""
    chips, height, width = sums.shape
    rate = 1.0 / chip_us
    for i in range(t_us.size):
        since = t_us[i] - (start_on_us if p[i] else start_off_us)
        if since < 0:
            continue
        c = int(since * rate)
        if c >= chips:
            continue
        u = np.int64(x[i]) - shift_x[c]
        v = np.int64(y[i]) - shift_y[c]
        if 0 <= u < width and 0 <= v < height:
            sums[c, v, u] += 2 * np.int16(p[i]) - 1
