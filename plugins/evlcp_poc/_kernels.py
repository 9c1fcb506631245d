"""Sub-pixel peak fit, compiled."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def dirichlet(x, size, band):
    """The Dirichlet kernel of `band` (odd) harmonics out of `size`, 1 * band / size at x = 0; and its slope."""
    a = np.pi * x / size
    s = np.sin(a)
    if abs(s) < 1e-9:
        return band / size, 0.0
    n = np.sin(band * a)
    value = n / (size * s)
    slope = np.pi / size * (band * np.cos(band * a) * s - n * np.cos(a)) / (size * s * s)
    return value, slope


@njit(cache=True, nogil=True)
def fit_peak(samples, size, band):
    """Shift of the Dirichlet kernel that fits samples around the middle one best (least squares), px."""
    half = samples.size // 2
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
        mv = 0.0
        for i in range(samples.size):
            m, _slope = dirichlet(i - half - shift, size, band)
            mm += m * m
            mv += m * samples[i]
        gain = mv / mm
        gg = 0.0
        gr = 0.0
        for i in range(samples.size):
            m, slope = dirichlet(i - half - shift, size, band)
            g = -gain * slope
            gg += g * g
            gr += g * (samples[i] - gain * m)
        if gg < 1e-30:
            break
        move = min(max(gr / gg, -0.25), 0.25)
        shift = min(max(shift + move, -1.0), 1.0)
        if abs(move) < 1e-6:
            break
    return shift


@njit(cache=True, nogil=True)
def pair_shifts(correlation, reach, samples, shifts):
    """Peak of each pair's phase-only correlation near zero shift, `shifts` (pairs, 2): down, right, px."""
    pairs, height, width = correlation.shape
    column = np.empty(2 * samples + 1)
    row = np.empty(2 * samples + 1)
    band_y = height - 1 + height % 2
    band_x = width - 1 + width % 2
    for q in range(pairs):
        best = -np.inf
        peak_v = 0
        peak_u = 0
        for v in range(-min(reach, height // 2), min(reach, height // 2) + 1):
            for u in range(-min(reach, width // 2), min(reach, width // 2) + 1):
                if correlation[q, v % height, u % width] > best:
                    best = correlation[q, v % height, u % width]
                    peak_v = v
                    peak_u = u
        for i in range(-samples, samples + 1):
            column[i + samples] = correlation[q, (peak_v + i) % height, peak_u % width]
            row[i + samples] = correlation[q, peak_v % height, (peak_u + i) % width]
        shifts[q, 0] = peak_v + fit_peak(column, height, band_y)
        shifts[q, 1] = peak_u + fit_peak(row, width, band_x)
