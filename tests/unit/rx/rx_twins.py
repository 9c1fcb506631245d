"""The receiver's kernels once more, in NumPy or plain Python, as slow and plain as it gets."""

from itertools import pairwise

import numpy as np
from scipy import ndimage


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


def count_rows(t_us, y, p, start_us, step_us, top, block, shape):
    counts = np.zeros(shape)
    step = np.floor((t_us - start_us[p]) / step_us).astype(int)
    row = np.floor((y - top) / block).astype(int)
    inside = (step >= 0) & (step < shape[2]) & (row >= 0) & (row < shape[1])
    np.add.at(counts, (p[inside], row[inside], step[inside]), 1)
    return counts


def blobs(selected):
    """By SciPy: (mean column + row * 1j, cluster, cells), clusters in order, each blob by its first cell."""
    found = []
    for k, s in enumerate(selected):
        labels, n = ndimage.label(s, np.ones((3, 3)))
        for i in range(1, n + 1):
            v, u = np.nonzero(labels == i)
            found.append((u.mean() + 1j * v.mean(), k, len(u)))
    return found


def areas(hits):
    """By SciPy: (left, top, right, bottom) of connected cells with hits, and how many hits those have."""
    labels, n = ndimage.label(hits, np.ones((3, 3)))
    boxes = [(u.start, v.start, u.stop, v.stop) for v, u in ndimage.find_objects(labels)]
    return boxes, [hits[labels == i].sum() for i in range(1, n + 1)]


def score(at, cluster, cells, layout, s, shift, reach):
    off = np.abs(at - (s * layout[cluster] + shift)) / reach
    return float((cells * np.maximum(1 - off**2, 0)).sum())


def best_similarity(at, cluster, cells, proposers, layout, spacing, slack, least, scale):
    best = 0.0
    for i in range(proposers):
        for j in range(proposers):
            if scale == 0 and cluster[i] == cluster[j]:
                continue
            s = scale or (at[j] - at[i]) / (layout[cluster[j]] - layout[cluster[i]])
            if abs(s) * spacing >= least:
                shift = at[i] - s * layout[cluster[i]]
                reach = abs(s) * spacing / 2 + slack
                best = max(best, score(at, cluster, cells, layout, s, shift, reach))
    return best


def refined_similarity(at, cluster, cells, layout, spacing, slack, scale, s, shift):
    """By `lstsq`; the known scale as a difference observed with the weight of all clusters."""
    for _ in range(3):
        near = np.abs(at - s * layout[cluster] - shift) < abs(s) * spacing / 2 + slack
        if not near.any():
            break
        root = np.sqrt(cells[near])
        rows = np.stack([layout[cluster[near]], np.ones(near.sum())], 1) * root[:, None]
        right = at[near] * root
        if scale:
            worth = np.sqrt(cells[near].sum() * np.var(layout))
            rows, right = np.vstack([rows, [worth, 0]]), np.append(right, worth * scale)
        if np.linalg.matrix_rank(rows) < 2:
            break
        s, shift = np.linalg.lstsq(rows, right)[0]
    return s, shift


def offsets(shape, places, unit, grid):
    """Along and across from each place to each cell's middle, (K, rows, columns) each."""
    y, x = np.mgrid[: shape[1], : shape[2]] * grid + (grid - 1) / 2
    off = (x + 1j * y - places[:, None, None]) * np.conj(unit)
    return off.real, off.imag


def share(off, half, grid):
    """By corners of the cell and of the footprint."""
    low, high = np.maximum(off - grid / 2, -half), np.minimum(off + grid / 2, half)
    return np.maximum(high - low, 0) / grid


def across_profile(probability, seen, places, unit, spacing, grid, bins):
    along, across = offsets(probability.shape, places, unit, grid)
    part = share(along, spacing / 2, grid) * seen[:, None, None]
    far = np.abs(places[:, None] - places[None]) > 1.5 * spacing
    others = np.einsum("jk,krc->jrc", far.astype(float), probability)
    value = part * probability - part**2 * others
    which = np.abs(across).astype(int)
    keep = (part > 0) & (np.abs(across) < bins)
    return [np.bincount(which[keep], v[keep], bins) for v in (value, part**2)]


def line_prior(shape, places, unit, spacing, grid, profile):
    along, across = offsets(shape, places, unit, grid)
    which = np.abs(across).astype(int)
    return share(along, spacing / 2, grid) * np.append(profile, 0)[np.minimum(which, len(profile))]


def block_prior(shape, places, unit, spacing, grid):
    along, across = offsets(shape, places, unit, grid)
    return share(along, spacing / 2, grid) * share(across, spacing / 2, grid)


def copy_near(pixels, places, unit, along_px, across_px):
    along, across = offsets(pixels.shape, places, unit, 1)
    return np.where((np.abs(along) <= along_px) & (np.abs(across) <= across_px), pixels, 0)


def pilot_light(sums, codes, every, prior, grid):
    values = np.sign(sums[1::every].astype(int))
    if every == 2:
        values = np.where(values != 0, values, -np.sign(sums[0::2].astype(int)))
    weight = prior.repeat(grid, 1).repeat(grid, 2)
    values = values[:, : weight.shape[1], : weight.shape[2]]
    agree = np.einsum("khw,ihw,ki->k", weight, values, codes)
    place = weight.sum((1, 2))
    edges = np.maximum(np.abs(codes).sum(1), 1)
    return np.where(place > 0, agree / (edges * np.maximum(place, 1e-9)), 0)


def info_activity(sums, weight, grid, pilot_chips, least):
    _, rows, columns = weight.shape
    active = (sums[:, : rows * grid, : columns * grid] != 0).astype(float)
    pilot, info = (
        part.mean(0).reshape(rows, grid, columns, grid).sum((1, 3))
        for part in (active[:pilot_chips], active[pilot_chips:])
    )
    empty, halves = (weight == 0).all(0), np.array_split(sums[pilot_chips:] != 0, 2)
    shown = (weight * pilot).sum() / weight.sum()
    flood = (info - pilot)[empty].mean() / shown if empty.any() else 0.0
    by_half = sorted(half.mean() / (sums[:pilot_chips] != 0).mean() for half in halves)
    return (weight * (info - least * pilot)).sum((1, 2)), flood, *by_half


def calibrate_llr(read, llr, seen, frame_worth, expected_worth, spread, least, together):
    seen = seen & (read >= 0)
    size = np.abs(llr.astype(float))
    if not size[seen].any():
        return np.full_like(read, -1), np.zeros_like(llr), 0.0
    mean = size.mean(1)
    # A cluster's own variance is NaN with one bit, which is worth nothing.
    own = np.nan_to_num(size.var(1, ddof=1)) if size.shape[1] > 1 else np.zeros(len(size))
    parts = [own, np.full(len(size), size[seen].var()), (spread * mean) ** 2]
    variance = np.average(parts, axis=0, weights=[size.shape[1] - 1, frame_worth, expected_worth])
    factor = np.divide(2 * mean, variance, out=np.zeros_like(mean), where=mean > 0)
    scaled = np.where(seen[:, None], llr * factor[:, None], 0)
    sure = 1 / (1 + np.exp(-np.abs(scaled).min(1)))
    given = seen & (sure >= least)
    quality = sure[given].prod() ** (1 / together) if given.any() else 0.0
    return np.where(given, read, -1), scaled, quality


def newest_on_parabola(past, speed_weight, bend_weight, worth, outlier):
    t_s = past[:, 0] - past[-1, 0]
    terms = np.stack([np.ones(len(t_s)), t_s, t_s**2 / 2])
    weight, value = 1 / past[:, 2], past[:, 1] - past[-1, 1]
    scale = 1.0
    for _ in range(2):
        weighted = terms * (weight / scale)
        inverse = np.linalg.inv(weighted @ terms.T + np.diag([0.0, speed_weight, bend_weight]))
        path = inverse @ (weighted @ value)
        left = (value - path @ terms) ** 2 * weight
        free = len(value) - np.trace(inverse @ weighted @ terms.T)
        counted = np.minimum(left, outlier * scale)
        scale = (worth + counted.sum()) / (worth + max(free, 0.0))
    newest = max(scale, left[-1]) if left[-1] > outlier * scale else scale
    return path[1], inverse[1, 1], newest / weight[-1]


def bend_of(place, sums, least, wave, variance):
    """By `lstsq`, weighted."""
    use = sums[0] > least * sums[0].max()
    place, weight = place[use], sums[0, use]
    off, one = (sums[1, use] - wave * sums[2, use]) / weight, sums[2, use] / weight
    terms = np.stack([place**2, np.ones(len(place)), place], 1)
    root = np.sqrt(weight)
    path = np.linalg.lstsq(terms * root[:, None], off * root)[0]
    left = (weight * (off - terms @ path) ** 2).sum() / (len(place) - 5)
    by_wave = np.linalg.lstsq(terms * root[:, None], one * root)[0][0]
    return path[0], np.linalg.inv((terms.T * weight) @ terms)[0, 0] * left + variance * by_wave**2


def wave_of(place, off, weight, wave, least):
    """What is left by `lstsq`, weighted."""
    use = weight > least * weight.max()
    terms, root = np.stack([place**2, np.ones(len(place)), place], 1)[use], np.sqrt(weight[use])
    both = np.stack([wave, off], 1)[use] * root[:, None]
    left = both - (terms * root[:, None]) @ np.linalg.lstsq(terms * root[:, None], both)[0]
    squares = left.T @ left
    return np.array([squares[0, 0], squares[0, 1], squares[1, 1], use.sum() - 3])


def scatter_of(off, weight, least, sums, before):
    use = weight > least * weight.max()
    return (
        (off[use] ** 2).sum(),
        *((sums[1:] / sums[0])[:, use] ** 2).sum(1),
        np.nanmedian(np.abs(off - before)[use]) if len(before) else np.nan,
        sums[0, use].sum() / weight[use].sum(),
    )


def farthest_off(selected, grid, on, turn):
    _, row, column = np.nonzero(selected)
    cells = (column + 1j * row) * grid + (grid - 1) / 2 * (1 + 1j)
    return np.abs(((cells - on) * np.conj(turn)).imag).max(initial=0.0)


def cells_by_place(at, cluster, cells, places, reach, half):
    right = np.abs(at - places[cluster]) <= reach
    off = np.abs(at[:, None] - places)
    wrong = ~right & (off.min(1) <= half)
    return [
        np.bincount(cluster[right], cells[right], len(places)),
        np.bincount(off.argmin(1)[wrong], cells[wrong], len(places)),
    ]


def core_profile(hits, cells, edge):
    some = np.flatnonzero(cells)
    profile = np.interp(np.arange(len(hits)), some, hits[some] / cells[some], right=0.0)
    peak = int(profile.argmax())
    low = np.flatnonzero(profile[peak:] < edge * profile[peak])
    return np.clip(profile[: peak + low[0] if len(low) else None], 0, 1)


def spread_between(sums, codes, places, seen, pairs, half, first, last):
    out = np.zeros((2, 2, 3), int)
    v, u = np.indices(sums.shape[1:])
    for a, b in pairs:
        if not (seen[a] and seen[b]):
            continue
        way = places[b] - places[a]
        off = (u + 1j * v - places[a]) / (way / abs(way))
        share = off.real / abs(way)
        near = (np.abs(off.imag) <= half) & (share >= 0) & (share < 1)
        zones = np.digitize(share, [first, last])
        own, others = np.diff(codes[a]), np.diff(codes[b])
        for i in np.flatnonzero((own == 0) & (others != 0)):
            answers = sums[i + 1] * others[i] > 0
            for zone in range(3):
                here = near & (zones == zone)
                out[1 - codes[a, i], :, zone] += [(answers & here).sum(), here.sum()]
    return out


def spread_across(sums, codes, every, places, seen, way, along, most):
    out = np.zeros((2, 2 * most + 1), int)
    v, u = np.indices(sums.shape[1:])
    for place, code in zip(places[seen], codes[seen], strict=True):
        off = (u + 1j * v - place) / way
        for column in range(-most, most + 1):
            here = (np.abs(off.real) <= along) & (np.floor(off.imag + 0.5) == column)
            edges = np.diff(code)[::every]
            answers = (sums[1::every] * edges[:, None, None] > 0) & here
            out[:, column + most] += [answers.sum(), here.sum() * np.abs(edges).sum()]
    return out


def light_along(heard, code, every, at, unit, spacing, reach):
    """`_kernels.light_along`, over the whole image; None where it has none."""
    light = np.tensordot(code[::every], heard[1 : 1 + len(code) : every].astype(np.int64), 1)
    if abs(unit.imag) < abs(unit.real):
        light, at, unit = light.T, complex(at.imag, at.real), complex(unit.imag, unit.real)
    line, pixel = np.mgrid[: light.shape[0], : light.shape[1]]
    beside = pixel - at.real - unit.real / unit.imag * (line - at.imag)
    sums = (light * np.clip(reach + 0.5 - abs(beside), 0, 1)).sum(1).clip(0)
    half, away = spacing * abs(unit.imag) / 2, abs(line[:, 0] - at.imag)
    sums *= np.clip(half + 2.5 - away, 0, 1)
    middle = sums[away <= max(0.6 * half, 0.5)].mean()
    return (sums / middle) ** 1.5 if middle > 0 else None
