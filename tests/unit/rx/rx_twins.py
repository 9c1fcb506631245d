"""The receiver's kernels once more, in NumPy or plain Python, as slow and plain as it gets."""

from itertools import pairwise

import numpy as np


def score_rises(events, shape, start, chip_us, min_score, cell_shift, most_same=7):
    """Last rise, time before it, how often that again, score of each pixel; and hits. `start`: before.

    Times by number, 0: beyond what counts.
    """
    times = [1.5, 2.0, 2.5, 3.0, 3.5, 4.0, *range(5, 14)]
    (rose, time, same, score), hits = (a.copy() for a in start), {}
    for t, u, v, p in events:
        run = t - rose[v, u]
        if not p or run < int(1.5 * chip_us):
            continue
        number = 0
        if run > 12.5 * chip_us:
            score[v, u] -= 1
        else:
            whole = int(np.floor(run / chip_us + 0.5))
            number = 1 + sum(run >= (a + b) / 2 * chip_us for a, b in pairwise(times))
            if abs(run - whole * chip_us) > 0.3 * chip_us:
                score[v, u] -= 3
            elif whole <= 4:
                score[v, u] += 2
            else:
                score[v, u] += -2 if number == time[v, u] else 1
        score[v, u] = sorted((0, score[v, u], 40))[1]
        apart = abs(number - time[v, u])
        again = apart == 0 or (apart == 1 and min(number, time[v, u]) > 0 and max(number, time[v, u]) <= 6)
        low, high = sorted((number, int(time[v, u])))
        ends = [1.5, *((a + b) / 2 for a, b in pairwise(times)), 13.5]
        missed = low > 0 and any(
            max(many * ends[low - 1], ends[high - 1]) < min(many * ends[low], ends[high]) for many in (2, 3)
        )
        again = again and low > 0
        same[v, u] = (
            min(same[v, u] + (2 if low >= 6 else 1), 31)
            if again
            else max(same[v, u] - (2 if missed else 6), 0)
        )
        rose[v, u], time[v, u] = t, number
        if score[v, u] >= min_score and number and same[v, u] < most_same:
            cell = v >> cell_shift, u >> cell_shift
            hits[cell] = hits.get(cell, 0) + 1
    return (rose, time, same, score), hits


def select_box(events, box):
    left, top, right, bottom = box
    return events[(events.x >= left) & (events.x < right) & (events.y >= top) & (events.y < bottom)]


def polarity_sums(
    events, start_on_us, start_off_us, chip_us, shift_x, shift_y, shape, row_us=0.0, row_px=0.0
):
    sums = np.zeros(shape, np.int16)
    start = np.where(events.p > 0, start_on_us, start_off_us)
    late = row_us * (events.y.astype(float) - row_px)
    chip = np.floor((events.t_us - start - late) / chip_us).astype(int)
    inside = (chip >= 0) & (chip < shape[0])
    chip, events = chip[inside], events[inside]
    u, v = events.x.astype(int) - shift_x[chip], events.y.astype(int) - shift_y[chip]
    seen = (u >= 0) & (u < shape[2]) & (v >= 0) & (v < shape[1])
    np.add.at(sums, (chip[seen], v[seen], u[seen]), np.where(events.p[seen] > 0, 1, -1))
    return sums


def score(at, cluster, cells, layout, s, shift, reach):
    off = np.abs(at - (s * layout[cluster] + shift)) / reach
    return float((cells * np.maximum(1 - off**2, 0)).sum())


def share(off, half, grid):
    """By corners of the cell and of the footprint."""
    low, high = np.maximum(off - grid / 2, -half), np.minimum(off + grid / 2, half)
    return np.maximum(high - low, 0) / grid
