"""The receiver's kernels once more, in NumPy or plain Python, as slow and plain as it gets."""

import numpy as np


def ordered(t_us, x, y, width, height):
    return bool(np.all(np.diff(t_us) >= 0) and np.all(x < width) and np.all(y < height))


def keep_ordered(t_us, x, y, width, height, last_us):
    keep, off, backward = [], 0, 0
    for t, u, v in zip(t_us.tolist(), x.tolist(), y.tolist(), strict=True):
        late, outside = t < last_us, u >= width or v >= height
        backward += late
        off += outside and not late
        keep.append(not late and not outside)
        last_us = t if keep[-1] else last_us
    return keep, (off, backward, last_us)


def score_pixels(events, shape, start, run_us, min_score, cell_shift):
    """Last change, score and polarity of each pixel, and hits; `start` is the same three before."""
    (changed, score, polarity), hits = (a.copy() for a in start), {}
    for t, u, v, p in events:
        if polarity[v, u] == p:
            continue
        run = t - changed[v, u]
        if run_us[0] <= run < run_us[1]:
            score[v, u] += 2
        elif run >= run_us[2]:
            score[v, u] -= 2
        score[v, u] = sorted((0, score[v, u], 40))[1]
        changed[v, u], polarity[v, u] = t, p
        if score[v, u] >= min_score:
            cell = v >> cell_shift, u >> cell_shift
            hits[cell] = hits.get(cell, 0) + 1
    return (changed, score, polarity), hits


def measure_box(lit, box):
    """What `measure_box` says of a mask of blinking pixels."""
    left, top, right, bottom = box
    rows = np.zeros(len(lit), int)
    rows[top:bottom] = lit[top:bottom, left:right].sum(1)
    if not rows.any():
        return (0, 0.0, 0, 0, 0.0, 0.0), rows[top:bottom]
    columns = left + np.nonzero(lit[top:bottom, left:right])[1]
    first, last = np.flatnonzero(rows)[[0, -1]]
    share = np.minimum(rows / rows[rows > 0].mean(), 1)
    upper, lower = first + 1 - share[first], last + share[last]
    found = (rows.sum(), columns.mean(), columns.min(), columns.max(), upper, lower)
    return found, rows[top:bottom]


def select_box(events, box):
    left, top, right, bottom = box
    return events[(events.x >= left) & (events.x < right) & (events.y >= top) & (events.y < bottom)]


def polarity_sums(events, start_on_us, start_off_us, chip_us, shift_x, shift_y, shape):
    sums = np.zeros(shape, np.int16)
    start = np.where(events.p > 0, start_on_us, start_off_us)
    chip = np.floor((events.t_us - start) / chip_us).astype(int)
    inside = (chip >= 0) & (chip < shape[0])
    chip, events = chip[inside], events[inside]
    u, v = events.x.astype(int) - shift_x[chip], events.y.astype(int) - shift_y[chip]
    seen = (u >= 0) & (u < shape[2]) & (v >= 0) & (v < shape[1])
    np.add.at(sums, (chip[seen], v[seen], u[seen]), np.where(events.p[seen] > 0, 1, -1))
    return sums


def cell_centres(selected):
    cells = [np.argwhere(s)[:, ::-1] for s in selected]
    return [c.mean(0) if len(c) else np.zeros(2) for c in cells], [len(c) for c in cells]


def most_in_place(image, area, layout, spacing, least_spacing):
    """By two-point similarities as real 2x2 matrices."""
    best, half = 0, len(area) // 2
    for i in range(len(area) - half):
        j = i + half
        if i == j or not (area[i] and area[j]):
            continue
        (ax, ay), (bx, by) = layout[j] - layout[i], image[j] - image[i]
        turn = np.array([[ax * bx + ay * by, ay * bx - ax * by], [ax * by - ay * bx, ax * bx + ay * by]])
        turn = turn / (ax * ax + ay * ay)
        px = np.sqrt(abs(np.linalg.det(turn))) * spacing
        if px >= least_spacing:
            off = np.linalg.norm(image[i] + (layout - layout[i]) @ turn.T - image, axis=1)
            best = max(best, int(((off <= px / 2 + 0.5) & (area > 0)).sum()))
    return best
