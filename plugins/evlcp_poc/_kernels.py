"""Cuts of maps, cross-spectra, sub-pixel peak fit, robust mean: compiled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]


@njit
def dirichlet(start: float, size: int, band: int, values: Array, slopes: Array) -> None:
    """The Dirichlet kernel of `band` (odd) harmonics out of `size`, and its slope, at start, start + 1, ...

    It is band / size at 0. The sines of the steps follow from those of the start by rotation.
    """
    step = np.pi / size
    s, c = np.sin(start * step), np.cos(start * step)
    sb, cb = np.sin(band * start * step), np.cos(band * start * step)
    ds, dc = np.sin(step), np.cos(step)
    dsb, dcb = np.sin(band * step), np.cos(band * step)
    for i in range(values.size):
        if abs(s) < 1e-9:
            values[i] = band / size
            slopes[i] = 0.0
        else:
            values[i] = sb / (size * s)
            slopes[i] = step * (band * cb * s - sb * c) / (size * s * s)
        s, c = s * dc + c * ds, c * dc - s * ds
        sb, cb = sb * dcb + cb * dsb, cb * dcb - sb * dsb


@njit
def fit_peak(samples: Array, size: int, band: int) -> float:
    """Shift of the Dirichlet kernel that fits samples around the middle one best (least squares), px.

    The gain that fits best follows from the shift, so Gauss-Newton steps run over the shift alone
    (variable projection).
    """
    half = samples.size // 2
    values = np.empty(samples.size)
    slopes = np.empty(samples.size)
    left, middle, right = samples[half - 1], samples[half], samples[half + 1]
    # For a kernel between two samples, the neighbours' ratio is that of their distances.
    side = right if right > left else left
    shift = 0.0
    if middle > 0 and side > 0:
        shift = side / (middle + side)
        if left > right:
            shift = -shift
    for _ in range(12):
        mm = 0.0
        ms = 0.0
        ss = 0.0
        mv = 0.0
        sv = 0.0
        dirichlet(-half - shift, size, band, values, slopes)
        for i in range(samples.size):
            m, slope = values[i], slopes[i]
            mm += m * m
            ms += m * slope
            ss += slope * slope
            mv += m * samples[i]
            sv += slope * samples[i]
        gain = mv / mm
        # The slope with its part along the kernel removed: what the gain cannot explain.
        curvature = gain * (ss - ms * ms / mm)
        if gain <= 0 or curvature < 1e-30:
            break
        move = -(sv - gain * ms) / curvature
        move = min(max(move, -0.25), 0.25)
        shift = min(max(shift + move, -1.0), 1.0)
        # Steps shrink quadratically: the next one would be some 1e-6 px.
        if abs(move) < 1e-3:
            break
    return shift


@njit
def pair_shifts(
    correlation: Array, most_y: int, most_x: int, reach: int, samples: int, shifts: Array
) -> None:
    """Peak of each pair's phase-only correlation near zero shift, `shifts` (pairs, 2): down, right, px.

    The correlation holds the harmonics up to `most_y` down and `most_x` across.
    """
    pairs, height, width = correlation.shape
    column = np.empty(2 * samples + 1)
    row = np.empty(2 * samples + 1)
    band_y = 2 * most_y + 1
    band_x = 2 * most_x + 1
    reach_y = min(reach, height // 2 - 1)
    reach_x = min(reach, width // 2 - 1)
    for q in range(pairs):
        best = correlation[q, 0, 0]
        peak_v = 0
        peak_u = 0
        for v in range(-reach_y, reach_y + 1):
            vv = v if v >= 0 else v + height
            for u in range(-reach_x, reach_x + 1):
                uu = u if u >= 0 else u + width
                if correlation[q, vv, uu] > best:
                    best = correlation[q, vv, uu]
                    peak_v = v
                    peak_u = u
        for i in range(-samples, samples + 1):
            column[i + samples] = correlation[q, (peak_v + i) % height, peak_u % width]
            row[i + samples] = correlation[q, peak_v % height, (peak_u + i) % width]
        shifts[q, 0] = peak_v + fit_peak(column, height, band_y)
        shifts[q, 1] = peak_u + fit_peak(row, width, band_x)


@njit
def middles(maps: Array, used: Array, min_pixels: int, out: Array) -> None:
    """Weighted median (row, column) of the maps used, -1 where a map has too few lit pixels.

    Unlike the mean, the median is robust against stray pixels.
    """
    _, height, width = maps.shape
    rows = np.empty(height)
    columns = np.empty(width)
    for n in range(used.size):
        k = used[n]
        rows[:] = 0.0
        columns[:] = 0.0
        lit = 0
        for v in range(height):
            some = False
            for u in range(width):
                some |= maps[k, v, u] > 0
            # Most rows are dark, and that is seen of many pixels at a time.
            for u in range(width if some else 0):
                w = maps[k, v, u]
                if w > 0:
                    rows[v] += w
                    columns[u] += w
                    lit += 1
        out[n, 0] = -1
        out[n, 1] = -1
        if lit < min_pixels:
            continue
        half = rows.sum() / 2
        total = 0.0
        for v in range(height):
            total += rows[v]
            if total >= half:
                out[n, 0] = v
                break
        total = 0.0
        for u in range(width):
            total += columns[u]
            if total >= half:
                out[n, 1] = u
                break


@njit
def cut_maps(maps: Array, used: Array, middle: Array, out: Array) -> None:
    """Windows of the maps around their middles, zero outside a map, `out` (used, height, width)."""
    _, height, width = maps.shape
    _, rows, columns = out.shape
    for n in range(used.size):
        if middle[n, 0] < 0:
            continue
        top = middle[n, 0] - rows // 2
        left = middle[n, 1] - columns // 2
        first, end = max(left, 0), min(left + columns, width)
        for v in range(max(top, 0), min(top + rows, height)):
            into, line = out[n, v - top, first - left :], maps[used[n], v, first:]
            for u in range(end - first):
                into[u] = line[u]


@njit
def _turns(size: int, most: int) -> Array:
    """Cosine and sine of the turn of each place by each harmonic, float32 (2, size, most + 1)."""
    out = np.empty((2, size, most + 1), np.float32)
    angle = np.arange(size) * (2 * np.pi / size)
    cosine, sine = np.cos(angle), np.sin(angle)
    for i in range(size):
        at = 0
        for k in range(most + 1):
            out[0, i, k], out[1, i, k] = cosine[at], sine[at]
            at += i
            at -= size if at >= size else 0
    return out


@njit
def _add_turned(part: Array, cosine: float, sine: float, turned: Array) -> None:
    """Add numbers (n,) by a cosine and a sine, `turned` (2, n)."""
    by_cosine, by_sine = turned[0], turned[1]
    for j in range(part.size):
        by_cosine[j] += cosine * part[j]
        by_sine[j] += sine * part[j]


@njit
def _both_ways(turned: Array, back: Array, forth: Array) -> None:
    """Complex numbers turned back, and forth, by what `_add_turned` made; real parts come first."""
    by_cosine, by_sine = turned[0], turned[1]
    n = by_sine.size // 2
    for j in range(n):
        back[j], forth[j] = by_cosine[j] + by_sine[n + j], by_cosine[j] - by_sine[n + j]
    for j in range(n, 2 * n):
        back[j], forth[j] = by_cosine[j] - by_sine[j - n], by_cosine[j] + by_sine[j - n]


@njit
def unit_spectra(images: Array, most_y: int, most_x: int, out: Array) -> None:
    """Spectra of images (n, height, width) over their size, up to a harmonic down and one across.

    `out` is float32 (2 most_y + 1, 2, most_x + 1, n): from the harmonic -most_y down on, real and imaginary
    parts. What is far below an image's largest has no phase and becomes 0. Most rows of a cut are dark: those
    are passed over, and harmonics up and down come of the same sums.
    """
    n, height, width = images.shape
    down, across = _turns(height, most_y), _turns(width, most_x)
    half = (most_x + 1) * n
    lines, pixels = np.zeros((height, 2 * half), np.float32), np.empty((width, n), np.float32)
    lit = np.zeros(height, np.bool_)
    for v in range(height):
        some = False
        for k in range(n):
            line = images[k, v]
            for u in range(width):
                some |= line[u] != 0
        lit[v] = some
        for k in range(n if some else 0):
            for u in range(width):
                pixels[u, k] = images[k, v, u]
        for x in range(most_x + 1 if some else 0):
            real, imaginary = lines[v, x * n : (x + 1) * n], lines[v, half + x * n : half + (x + 1) * n]
            for u in range(width):
                pixel, cosine, sine = pixels[u], across[0, u, x], across[1, u, x]
                for k in range(n):
                    real[k] += cosine * pixel[k]
                    imaginary[k] -= sine * pixel[k]
    turned, by_harmonic = np.empty((2, 2 * half), np.float32), out.reshape(len(out), 2 * half)
    for y in range(most_y + 1):
        turned[:] = 0
        for v in range(height):
            if lit[v]:
                _add_turned(lines[v], down[0, v, y], down[1, v, y], turned)
        _both_ways(turned, by_harmonic[most_y + y], by_harmonic[most_y - y])
    top = np.zeros(n, np.float32)
    for y in range(len(out)):
        for x in range(most_x + 1):
            real, imaginary = out[y, 0, x], out[y, 1, x]
            for k in range(n):
                top[k] = max(top[k], real[k] * real[k] + imaginary[k] * imaginary[k])
    for y in range(len(out)):
        for x in range(most_x + 1):
            real, imaginary = out[y, 0, x], out[y, 1, x]
            for k in range(n):
                power = real[k] * real[k] + imaginary[k] * imaginary[k]
                # The operator would look for a 0 below, one number at a time.
                over = np.divide(np.float32(power > _NO_PHASE * top[k]), np.sqrt(max(power, _TINY)))
                real[k] *= over
                imaginary[k] *= over


_NO_PHASE = np.float32(1e-10)
"""Power, in the largest of a spectrum, below which there is no phase: that of rounding."""

_TINY = np.float32(1e-37)
"""Takes the place of a power of 0, whose root is divided by before it is known to have no phase."""


@njit
def correlations(spectra: Array, first: Array, second: Array, far_y: int, far_x: int, out: Array) -> None:
    """Transform conj(first) * second of pairs of `unit_spectra` back, `out` float32 (pairs, height, width).

    Shifts up to `far_y` down and up, and `far_x` to each side, are written, others are left.
    """
    pairs, height, width = out.shape
    most_y, most_x = len(spectra) // 2, spectra.shape[2] - 1
    down, across = _turns(height, most_y), _turns(width, most_x)
    half = (most_x + 1) * pairs
    cross = np.empty((len(spectra), 2 * half), np.float32)
    for y in range(len(spectra)):
        for x in range(most_x + 1):
            real, imaginary = spectra[y, 0, x], spectra[y, 1, x]
            # Those across but the first stand for two, of which the other is the conjugate.
            weight = np.float32((2 if x else 1) / (height * width))
            for q in range(pairs):
                # Unsigned, as indices below 0 would count from the end.
                i, k = np.uint64(first[q]), np.uint64(second[q])
                a, b, c, d = real[i], imaginary[i], real[k], imaginary[k]
                cross[y, x * pairs + q] = weight * (a * c + b * d)
                cross[y, half + x * pairs + q] = weight * (a * d - b * c)
    turned, rows = np.empty((2, 2 * half), np.float32), np.empty((2, 2 * half), np.float32)
    even, odd = np.empty((2, far_x + 1, pairs), np.float32)
    for v in range(far_y + 1):
        turned[:] = 0
        for y in range(-most_y, most_y + 1):
            sine = down[1, v, abs(y)]
            _add_turned(cross[most_y + y], down[0, v, abs(y)], sine if y >= 0 else -sine, turned)
        _both_ways(turned, rows[1], rows[0])
        for way in range(2):
            at = (height - v) % height if way else v
            even[:] = 0
            odd[:] = 0
            for x in range(most_x + 1):
                real = rows[way, x * pairs : (x + 1) * pairs]
                imaginary = rows[way, half + x * pairs : half + (x + 1) * pairs]
                for u in range(far_x + 1):
                    cosine, sine, of_cosine, of_sine = across[0, u, x], across[1, u, x], even[u], odd[u]
                    for q in range(pairs):
                        of_cosine[q] += cosine * real[q]
                        of_sine[q] += sine * imaginary[q]
            for u in range(far_x + 1):
                for q in range(pairs):
                    out[q, at, u] = even[u, q] - odd[u, q]
                    out[q, at, (width - u) % width] = even[u, q] + odd[u, q]


@njit
def blob_size(cuts: Array, size: Array) -> None:
    """Height and width, `size` (2,), of the box with the mean distance from its middle that cuts have, px.

    The middle of a cut of n pixels is n // 2. A box of h pixels has a mean distance of h / 4, which a stray
    pixel moves less than it moves a variance.
    """
    total = 0.0
    size[:] = 0.0
    n, height, width = cuts.shape
    for k in range(n):
        for v in range(height):
            for u in range(width):
                w = cuts[k, v, u]
                total += w
                size[0] += w * abs(v - height // 2)
                size[1] += w * abs(u - width // 2)
    for axis in range(2):
        size[axis] = 4 * size[axis] / total if total > 0 else 0.0


@njit
def _quantile(ordered: Array, share: float) -> float:
    at = share * (ordered.size - 1)
    low = int(at)
    high = min(low + 1, ordered.size - 1)
    return float(ordered[low] + (at - low) * (ordered[high] - ordered[low]))


@njit
def median_scale(middle: Array, first: Array, second: Array, apart_m: Array) -> float:
    """Median over pairs of what lies between their middles, px a metre; 0 without a pair that has both."""
    scale = np.empty(first.size)
    n = 0
    for q in range(first.size):
        a, b = middle[first[q]], middle[second[q]]
        if a[0] >= 0 and b[0] >= 0:
            scale[n] = np.hypot(b[0] - a[0], b[1] - a[1]) / apart_m[q]
            n += 1
    return _quantile(np.sort(scale[:n]), 0.5) if n else 0.0


@njit
def pairs_in_place(
    middle: Array,
    first: Array,
    second: Array,
    apart_m: Array,
    px_per_m: float,
    most_off_px: float,
    which: Array,
    shifts: Array,
) -> int:
    """Which pairs have middles as far apart as the scale says, and their whole-pixel shifts; how many."""
    n = 0
    for q in range(first.size):
        a, b = middle[first[q]], middle[second[q]]
        down, right = b[0] - a[0], b[1] - a[1]
        off_px = np.hypot(down, right) - px_per_m * apart_m[q]
        if a[0] >= 0 and b[0] >= 0 and abs(off_px) <= most_off_px:
            which[n] = q
            shifts[n, 0], shifts[n, 1] = down, right
            n += 1
    return n


@njit
def far_pairs(counts: Array, first: Array, second: Array, apart_m: Array, share: float) -> Array:
    """Which pairs, both of whose clusters count, lie a share of the longest such spacing apart, or more."""
    longest = 0.0
    for q in range(first.size):
        if counts[first[q]] and counts[second[q]]:
            longest = max(longest, apart_m[q])
    far = np.zeros(first.size, np.bool_)
    for q in range(first.size):
        both = counts[first[q]] and counts[second[q]]
        far[q] = both and apart_m[q] >= share * longest - 1e-12
    return far


@njit
def chosen_pairs(
    maps: Array,
    min_pixels: int,
    every: tuple[Array, Array, Array],
    used: Array,
    skip: int,
    pairs: tuple[Array, Array, Array],
    share: float,
    neighbour_m: float,
    middle: Array,
    which: Array,
    shifts: Array,
) -> tuple[float, int]:
    """The pairs to measure: of clusters that are seen, far apart, and where the scale of all has them.

    Args:
        maps: Maps of all clusters.
        min_pixels: Lit pixels that a map needs to be used.
        every: First and second cluster, and spacing, of all pairs of clusters.
        used: Clusters to use, rising.
        skip: How many of those that are seen are left out at each end.
        pairs: First and second cluster, and spacing, of the pairs of clusters that may be used.
        share: Least spacing of a pair, as a share of the longest.
        neighbour_m: Spacing of neighbours, by how much a pair may be out of place.
        middle: Gets the middles of the maps, (clusters, 2).
        which: Gets the numbers of the pairs chosen.
        shifts: Gets their whole-pixel shifts.

    Returns:
        Scale, px a metre, 0 if there is none; and how many pairs are chosen.
    """
    middles(maps, np.arange(len(maps)), min_pixels, middle)
    lit = middle[:, 0] >= 0
    i, j, apart_m = every
    wide = far_pairs(lit, i, j, apart_m, 0.5)
    px_per_m = median_scale(middle, i[wide], j[wide], apart_m[wide])
    if px_per_m <= 0:
        return 0.0, 0
    seen = used[lit[used]]
    inner = np.zeros(len(maps), np.bool_)
    inner[seen[skip : max(len(seen) - skip, 0)]] = True
    first, second, spacing_m = pairs
    far = np.flatnonzero(far_pairs(inner, first, second, spacing_m, share))
    n = pairs_in_place(
        middle, first[far], second[far], spacing_m[far], px_per_m, px_per_m * neighbour_m, which, shifts
    )
    which[:n] = far[which[:n]]
    return px_per_m, n


@njit
def robust_mean(
    values: Array, weights: Array, first: Array, second: Array, clusters: int, drop: int, iqr: float
) -> tuple[float, float, int]:
    """Weighted mean of pair values without extremes and outliers, and its delete-one-cluster jackknife sigma.

    Returns:
        (mean, sigma, values kept); sigma is NaN when fewer than two clusters can be left out.
    """
    n = values.size
    order = np.argsort(values)
    begin, end = 0, n
    if n > 2 * drop + 1:
        begin, end = drop, n - drop
    ordered = values[order[begin:end]]
    low = _quantile(ordered, 0.25)
    high = _quantile(ordered, 0.75)
    # Narrow bounds may call all of a few values outliers of one another: keep the middle half then.
    room = iqr * (high - low)
    if ordered[np.searchsorted(ordered, low - room) :][0] > high + room:
        room = high - low
    total = 0.0
    mass = 0.0
    kept = 0
    by_mass = np.zeros(clusters)
    by_total = np.zeros(clusters)
    for i in range(begin, end):
        q = order[i]
        if low - room <= values[q] <= high + room:
            kept += 1
            w = weights[q]
            mass += w
            total += w * values[q]
            for k in (first[q], second[q]):
                by_mass[k] += w
                by_total[k] += w * values[q]
    m = 0
    mean = 0.0
    square = 0.0
    for k in range(clusters):
        if by_mass[k] > 0 and mass - by_mass[k] > 1e-9 * mass:
            left = (total - by_total[k]) / (mass - by_mass[k])
            m += 1
            step = left - mean
            mean += step / m
            square += step * (left - mean)
    sigma = np.sqrt((m - 1) / m * square) if m > 1 else np.nan
    return total / mass, sigma, kept


@njit
def paired_distance(
    cuts: Array,
    band: tuple[int, int],
    reach: int,
    samples: int,
    which: Array,
    whole_px: Array,
    pairs: tuple[Array, Array, Array],
    focal_px: float,
    power: float,
    drop: int,
    iqr: float,
) -> tuple[float, float, int, float]:
    """Distance by pairs of cuts of clusters, and their whole-pixel shifts: as `robust_mean` returns it, m.

    `pairs` are first and second cluster, and spacing, m, of all, of which those of the numbers `which` (n,)
    count; correlations hold harmonics up to those of `band`, and are looked at within `reach`. The mean
    spacing comes last.
    """
    clusters, height, width = cuts.shape
    first, second, apart_m = pairs[0][which], pairs[1][which], pairs[2][which]
    spectra = np.empty((2 * band[0] + 1, 2, band[1] + 1, clusters), np.float32)
    unit_spectra(cuts, band[0], band[1], spectra)
    correlation = np.empty((which.size, height, width), np.float32)
    far_y, far_x = min(reach + samples, height // 2), min(reach + samples, width // 2)
    correlations(spectra, first, second, far_y, far_x, correlation)
    beyond_px = np.empty((which.size, 2))
    pair_shifts(correlation, band[0], band[1], reach, samples, beyond_px)
    apart_px = whole_px + beyond_px
    length_px = np.hypot(apart_px[:, 0], apart_px[:, 1])
    distance_m = focal_px * apart_m / np.maximum(length_px, 1e-9)
    mean, sigma, kept = robust_mean(distance_m, apart_m**power, first, second, clusters, drop, iqr)
    return mean, sigma, kept, apart_m.mean()
