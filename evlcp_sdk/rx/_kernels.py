"""Loops over events, compiled."""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]


@njit(cache=True, nogil=True)
def all_ordered(t_us: Array, x: Array, y: Array, width: int, height: int) -> bool:
    """Whether no event is off the sensor or before its predecessor; without a branch, so that it is quick."""
    bad = 0
    for i in range(1, t_us.size):
        bad += int(t_us[i] < t_us[i - 1])
    for i in range(t_us.size):
        bad += int(x[i] >= width) | int(y[i] >= height)
    return bad == 0


@njit(cache=True, nogil=True)
def keep_ordered(
    t_us: Array, x: Array, y: Array, width: int, height: int, last_us: int, keep: Array
) -> tuple[int, int, int]:
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
def score_pixels(
    t_us: Array,
    x: Array,
    y: Array,
    p: Array,
    pixels: Array,
    hits: Array,
    run_us: tuple[int, int, int],
    min_score: int,
    cell_shift: int,
) -> None:
    """Update each pixel's score of runs at the chip rate; count the runs of candidate pixels in cells.

    `pixels` (height, width) packs a pixel into one number, since memory sets the pace here: the time of its
    last change of polarity in the upper bits, then 7 bits of score, 1 bit of polarity. `run_us` holds the
    bounds of a run's length: below [0] noise, to [1] one chip, to [2] two chips, above: slower than any code
    of the air interface.
    """
    shortest, single, double = run_us
    # Whether an event changes its pixel's polarity is as good as random, so it is found without a branch.
    changes = np.empty(t_us.size + 1, np.int32)
    n = 0
    for i in range(t_us.size):
        u, v = np.uint64(x[i]), np.uint64(y[i])
        change = (pixels[v, u] ^ p[i]) & 1
        pixels[v, u] ^= change
        changes[n] = i
        n += change
    shift = np.uint64(cell_shift)
    for i in changes[:n]:
        u, v = np.uint64(x[i]), np.uint64(y[i])
        state = pixels[v, u]
        run = t_us[i] - (state >> 8)
        score = (state >> 1) & 127
        score += 2 * (np.int64(run >= shortest) & np.int64(run < single)) - 2 * np.int64(run >= double)
        score = min(max(score, 0), 40)
        pixels[v, u] = (t_us[i] << 8) | (score << 1) | (state & 1)
        hits[v >> shift, u >> shift] += np.int32(score >= min_score)


@njit(cache=True, nogil=True)
def score_rises(
    t_us: Array,
    x: Array,
    y: Array,
    pixels: Array,
    hits: Array,
    run_us: tuple[int, int],
    min_score: int,
    cell_shift: int,
) -> None:
    """Do as `score_pixels` for a camera that sends positive events only: runs go from rise to rise.

    `run_us` holds the bounds: below [0] events of one rise, to [1] the codes of the air interface (two to
    four chips), above: slower.
    """
    shortest, longest = run_us
    for i in range(t_us.size):
        u, v = np.int64(x[i]), np.int64(y[i])
        state = pixels[v, u]
        run = t_us[i] - (state >> 8)
        if run < shortest:
            continue
        score = (state >> 1) & 127
        score = min(score + 2, 40) if run < longest else max(score - 2, 0)
        pixels[v, u] = (t_us[i] << 8) | (score << 1) | 1
        if score >= min_score:
            hits[v >> cell_shift, u >> cell_shift] += 1


@njit(cache=True, nogil=True)
def measure_box(
    pixels: Array, box: tuple[int, int, int, int], since_us: int, min_score: int, rows: Array
) -> tuple[int, float, int, int, float, float]:
    """Where in a box pixels blink at the chip rate and changed polarity since `since_us`.

    Returns:
        (pixels, mean column, first column, last column, upper edge, lower edge); an edge row that holds
        fewer pixels than a full one counts by its share.
    """
    left, top, right, bottom = box
    total = 0
    weighted = 0
    first_column, last_column = right, left
    lit = 0
    for v in range(top, bottom):
        n = 0
        for u in range(left, right):
            state = pixels[v, u]
            if (state >> 8) >= since_us and ((state >> 1) & 127) >= min_score:
                n += 1
                weighted += u
                first_column = min(first_column, u)
                last_column = max(last_column, u)
        rows[v - top] = n
        total += n
        lit += n > 0
    if total == 0:
        return 0, 0.0, 0, 0, 0.0, 0.0
    full = total / lit
    v = top
    while rows[v - top] == 0:
        v += 1
    upper = v + 1 - min(rows[v - top] / full, 1.0)
    v = bottom - 1
    while rows[v - top] == 0:
        v -= 1
    lower = v + min(rows[v - top] / full, 1.0)
    return total, weighted / total, first_column, last_column, upper, lower


@njit(cache=True, nogil=True)
def select_boxes(
    t_us: Array,
    x: Array,
    y: Array,
    p: Array,
    boxes: Array,
    out_t: Array,
    out_x: Array,
    out_y: Array,
    out_p: Array,
    taken: Array,
) -> None:
    """Copy the events inside each box (left, top, right, bottom) to that box's row; count them in `taken`."""
    inside = np.empty(t_us.size, np.uint8)
    which = np.empty(t_us.size + 1, np.int32)
    for b in range(boxes.shape[0]):
        left, top = np.uint16(boxes[b, 0]), np.uint16(boxes[b, 1])
        width, height = np.uint16(boxes[b, 2] - boxes[b, 0]), np.uint16(boxes[b, 3] - boxes[b, 1])
        # Without a branch, so that it runs on many events at once; unsigned, one comparison for both edges.
        for i in range(t_us.size):
            inside[i] = np.uint8(np.uint16(x[i] - left) < width) & np.uint8(np.uint16(y[i] - top) < height)
        n = 0
        for i in range(t_us.size):
            # Written always, kept if inside: between two bars, a branch would be a coin toss.
            which[n] = i
            n += inside[i]
        for j in range(n):
            i = which[j]
            out_t[b, j] = t_us[i]
            out_x[b, j] = x[i]
            out_y[b, j] = y[i]
            out_p[b, j] = p[i]
        taken[b] = n


@njit(cache=True, nogil=True)
def add_polarity(
    t_us: Array,
    x: Array,
    y: Array,
    p: Array,
    start_on_us: float,
    start_off_us: float,
    chip_us: float,
    shift_x: Array,
    shift_y: Array,
    sums: Array,
) -> None:
    """Add events to polarity sums (chips, height, width); a shift is the sensor pixel of (0, 0) in a chip."""
    chips, height, width = sums.shape
    first = np.searchsorted(t_us, min(start_on_us, start_off_us))
    # Time never runs backward, so each polarity's chip only moves on.
    chip_on, next_on = -1, start_on_us
    chip_off, next_off = -1, start_off_us
    for i in range(first, t_us.size):
        t = t_us[i]
        while t >= next_on:
            chip_on += 1
            next_on = start_on_us + (chip_on + 1) * chip_us
        while t >= next_off:
            chip_off += 1
            next_off = start_off_us + (chip_off + 1) * chip_us
        # Arithmetic, not a branch: polarity is as good as random.
        on = np.int64(p[i])
        c = chip_off + (chip_on - chip_off) * on
        if c < 0 or c >= chips:
            if min(chip_on, chip_off) >= chips:
                break
            continue
        # Unsigned, a pixel to the left of the image is far to its right: one comparison for both edges.
        u = np.uint64(np.int64(x[i]) - shift_x[c])
        v = np.uint64(np.int64(y[i]) - shift_y[c])
        if u < np.uint64(width) and v < np.uint64(height):
            sums[np.uint64(c), v, u] += np.int16(2 * on - 1)


@njit(cache=True, nogil=True)
def cell_centres(selected: Array, centres: Array, area: Array) -> None:
    """Mean (column, row) and number of each cluster's selected cells; `centres` (K, 2)."""
    clusters, rows, columns = selected.shape
    for k in range(clusters):
        area[k] = 0
        centres[k, :] = 0.0
        for r in range(rows):
            for c in range(columns):
                if selected[k, r, c]:
                    area[k] += 1
                    centres[k, 0] += c
                    centres[k, 1] += r
        if area[k]:
            centres[k, :] /= area[k]


@njit(cache=True, nogil=True)
def most_in_place(image: Array, area: Array, layout: Array, least_spacing: float) -> int:
    """Most clusters that one similarity of the layout brings to within half a spacing of the image's.

    Each pair of seen clusters half the layout apart proposes a similarity (as complex numbers: a turn and
    scale `s`, then a shift); those that bring neighbours nearer than `least_spacing` do not count.
    """
    clusters = area.size
    spacing = np.inf
    for k in range(1, clusters):
        across, down = layout[k, 0] - layout[k - 1, 0], layout[k, 1] - layout[k - 1, 1]
        spacing = min(spacing, max(abs(across), abs(down)))
    best = 0
    for i in range(clusters - clusters // 2):
        j = i + clusters // 2
        if area[i] == 0 or area[j] == 0 or i == j:
            continue
        a = complex(layout[i, 0], layout[i, 1])
        origin = complex(image[i, 0], image[i, 1])
        s = (complex(image[j, 0], image[j, 1]) - origin) / (complex(layout[j, 0], layout[j, 1]) - a)
        if abs(s) * spacing < least_spacing:
            continue
        fits = 0
        for k in range(clusters):
            if area[k] > 0:
                placed = origin + s * (complex(layout[k, 0], layout[k, 1]) - a)
                off = abs(placed - complex(image[k, 0], image[k, 1]))
                fits += int(off <= abs(s) * spacing / 2 + 0.5)
        best = max(best, fits)
    return best


@njit(cache=True, nogil=True)
def _placement(image: Array, seen: Array, layout: Array, spacing: float) -> tuple[complex, complex]:
    """Scale, turn and shift that bring a layout to its image: medians of pairs, robust against outliers."""
    clusters = layout.shape[0]
    re = np.empty(clusters * clusters)
    im = np.empty(clusters * clusters)
    n = 0
    for i in range(clusters):
        for j in range(i + 1, clusters):
            apart = complex(layout[j, 0] - layout[i, 0], layout[j, 1] - layout[i, 1])
            if seen[i] and seen[j] and abs(apart) > 1.5 * spacing:
                s = complex(image[j, 0] - image[i, 0], image[j, 1] - image[i, 1]) / apart
                re[n] = s.real
                im[n] = s.imag
                n += 1
    if n == 0:
        return complex(0.0, 0.0), complex(0.0, 0.0)
    s = complex(np.median(re[:n]), np.median(im[:n]))
    n = 0
    for k in range(clusters):
        if seen[k]:
            z = complex(image[k, 0], image[k, 1]) - s * complex(layout[k, 0], layout[k, 1])
            re[n] = z.real
            im[n] = z.imag
            n += 1
    return s, complex(np.median(re[:n]), np.median(im[:n]))


@njit(cache=True, nogil=True)
def _boundary(pixels: Array, k: int, other: int, a: complex, b: complex, reach: float) -> float:
    """Where clusters `k` and `other`, centred at `a` and `b`, meet: a share of the way between; NaN: unseen.

    Line by line of pixels across the way, the shares of the two clusters say how much of it is the first's.
    """
    _, height, width = pixels.shape
    step = b - a
    # Centres within a pixel have no way between them that its lines could share out.
    if max(abs(step.real), abs(step.imag)) < 1.0:
        return np.nan
    rows = abs(step.imag) >= abs(step.real)
    start, end = (a.imag, b.imag) if rows else (a.real, b.real)
    side, slope = (a.real, step.real / step.imag) if rows else (a.imag, step.imag / step.real)
    sign = 1 if end > start else -1
    first, last = int(np.rint(start)), int(np.rint(end))
    total, lines, empty = 0.0, 0, 0
    for i in range(first, last + sign, sign):
        middle = side + slope * (i - start)
        low, high = int(np.ceil(middle - reach)), int(np.floor(middle + reach))
        mine, its = 0.0, 0.0
        if 0 <= i < (height if rows else width):
            for j in range(max(low, 0), min(high, (width if rows else height) - 1) + 1):
                mine += pixels[k, i, j] if rows else pixels[k, j, i]
                its += pixels[other, i, j] if rows else pixels[other, j, i]
        lines += 1
        if mine + its > 0:
            total += mine / (mine + its)
        else:
            empty += 1
            total += 0.5
    if 2 * empty > lines:
        return np.nan
    return (first + sign * (total - 0.5) - start) / (end - start)


@njit(cache=True, nogil=True)
def place_clusters(
    pixels: Array,
    cells: Array,
    area: Array,
    layout: Array,
    spacing: float,
    neighbours: Array,
    points: Array,
    ends: Array,
) -> float:
    """Centres of the clusters in the image, `points` (K, 2), NaN where unseen; squares left by a similarity.

    `neighbours` (2, K) holds the cluster to the right and the one below, -1 for none; `ends` (K,) becomes 1
    where a cluster has a boundary on one side only, else 0, NaN where unseen.
    """
    clusters, height, width = pixels.shape
    points[:] = np.nan
    ends[:] = np.nan
    s, shift = _placement(cells, area > 0, layout, spacing)
    reach = abs(s) * spacing
    # Placed so that neighbours fall into one pixel, there is nothing to measure.
    if reach < 1.0:
        return 0.0
    window = 0.5 * reach + 1.5
    seen = np.zeros(clusters, np.bool_)
    for k in range(clusters):
        if area[k] == 0:
            continue
        at = s * complex(layout[k, 0], layout[k, 1]) + shift
        sum_w, sum_x, sum_y = 0.0, 0.0, 0.0
        for v in range(max(int(np.ceil(at.imag - window)), 0), min(int(at.imag + window), height - 1) + 1):
            for u in range(max(int(np.ceil(at.real - window)), 0), min(int(at.real + window), width - 1) + 1):
                w = pixels[k, v, u]
                sum_w += w
                sum_x += w * u
                sum_y += w * v
        if sum_w > 0:
            seen[k] = True
            points[k, 0] = sum_x / sum_w
            points[k, 1] = sum_y / sum_w
    if seen.sum() < 3:
        points[:] = np.nan
        return 0.0
    for k in range(clusters):
        if seen[k]:
            ends[k] = 0
    s, shift = _placement(points, seen, layout, spacing)
    mean = points.copy()
    gap = abs(s) * spacing
    for axis in range(2):
        along = s / abs(s) if axis == 0 else s / abs(s) * 1j
        before = np.full(clusters, np.nan)
        after = np.full(clusters, np.nan)
        for k in range(clusters):
            other = neighbours[axis, k]
            if other < 0 or not (seen[k] and seen[other]):
                continue
            a, b = complex(mean[k, 0], mean[k, 1]), complex(mean[other, 0], mean[other, 1])
            share = _boundary(pixels, k, other, a, b, window)
            if -0.5 < share < 1.5:
                z = (a + share * (b - a)) * along.conjugate()
                after[k] = z.real
                before[other] = z.real
        for k in range(clusters):
            if not seen[k]:
                continue
            has_before, has_after = not np.isnan(before[k]), not np.isnan(after[k])
            if has_before and has_after:
                centre = (before[k] + after[k]) / 2
            elif has_before:
                centre = before[k] + gap / 2
            elif has_after:
                centre = after[k] - gap / 2
            else:
                continue
            if has_before != has_after:
                ends[k] = 1
            move = centre - (complex(mean[k, 0], mean[k, 1]) * along.conjugate()).real
            points[k, 0] += move * along.real
            points[k, 1] += move * along.imag
    # The least-squares similarity, as complex numbers.
    n = 0
    image_mean, layout_mean = complex(0.0, 0.0), complex(0.0, 0.0)
    for k in range(clusters):
        if seen[k]:
            n += 1
            image_mean += complex(points[k, 0], points[k, 1])
            layout_mean += complex(layout[k, 0], layout[k, 1])
    image_mean /= n
    layout_mean /= n
    cross, power = complex(0.0, 0.0), 0.0
    for k in range(clusters):
        if seen[k]:
            c = complex(layout[k, 0], layout[k, 1]) - layout_mean
            cross += c.conjugate() * (complex(points[k, 0], points[k, 1]) - image_mean)
            power += abs(c) ** 2
    squares = 0.0
    for k in range(clusters):
        if seen[k]:
            c = complex(layout[k, 0], layout[k, 1]) - layout_mean
            off = abs(complex(points[k, 0], points[k, 1]) - image_mean - cross / power * c)
            squares += off * off
    return squares
