"""Phase-only correlation and robust mean once more in NumPy, exact shifts, and ideal images of clusters."""

import numpy as np
from scipy.special import erf


def dirichlet(shift, size, band):
    """The kernel and its slope as the sums of cosines and sines that they are."""
    k = np.arange(-(band // 2), band // 2 + 1)
    angle = 2 * np.pi * np.outer(shift, k) / size
    return np.cos(angle).sum(1) / size, -(2 * np.pi * k / size * np.sin(angle)).sum(1) / size


def peak_shift(samples, size, band):
    """Least squares over shift and gain by brute force: a fine grid, then a finer one."""
    at = np.arange(len(samples)) - len(samples) // 2

    def rest(shift):
        m, _ = dirichlet(at - shift, size, band)
        return ((samples - m * max(m @ samples / (m @ m), 0)) ** 2).sum()

    best, width = 0.0, 1.0
    for _ in range(5):
        grid = best + np.linspace(-width, width, 81)
        best, width = min(grid, key=rest), width / 20
    return best


def band_limited(rng, height, width):
    """A random image without its Nyquist frequencies, which no shift keeps real, and its spectrum."""
    spectrum = np.fft.rfft2(rng.normal(size=(height, width)))
    spectrum[height // 2] *= height % 2
    spectrum[:, -1] *= width % 2
    return spectrum


def shifted(spectrum, shape, down, right):
    v = np.fft.fftfreq(shape[0])[:, None]
    u = np.fft.rfftfreq(shape[1])
    return np.fft.irfft2(spectrum * np.exp(-2j * np.pi * (down * v + right * u)), shape).astype(np.float32)


def harmonics(size):
    """Number of each frequency of a transform, without its sign."""
    return np.abs(np.fft.fftfreq(size, 1 / size))


def phase_only_correlation(a, b, most=None):
    """All by complex transforms of double precision; harmonics above `most`, or Nyquist's, left out."""
    if most is None:
        most = [(n - 1) // 2 for n in a.shape]
    fa, fb = np.fft.fft2(a.astype(float)), np.fft.fft2(b.astype(float))
    cross = fb * fa.conj()
    with np.errstate(invalid="ignore", divide="ignore"):
        cross = np.where(np.abs(cross) > 0, cross / np.abs(cross), 0)
    cross[harmonics(a.shape[0]) > most[0]] = 0
    cross[:, harmonics(a.shape[1]) > most[1]] = 0
    return np.fft.ifft2(cross).real


def middle(image, min_pixels):
    """Weighted median (row, column): every lit pixel at its place, as often as it weighs."""
    if (image > 0).sum() < min_pixels:
        return [-1, -1]
    return [
        int(np.searchsorted(np.cumsum(image.sum(axis, dtype=float)), image.sum(dtype=float) / 2))
        for axis in (1, 0)
    ]


def cut(image, at, rows, columns):
    if at[0] < 0:
        return np.zeros((rows, columns), image.dtype)
    padded = np.pad(image, ((rows, rows), (columns, columns)))
    top, left = at[0] + rows - rows // 2, at[1] + columns - columns // 2
    return padded[top : top + rows, left : left + columns]


def pairs_of(clusters, at_m):
    """All pairs of clusters, and their spacing."""
    first, second = np.triu_indices(len(clusters), 1)
    first, second = clusters[first], clusters[second]
    return first, second, np.abs(at_m[second] - at_m[first])


def far(counts, pairs, share):
    """Numbers of the pairs that count and are far apart."""
    both = [q for q, (a, b, _) in enumerate(zip(*pairs, strict=True)) if {a, b} <= counts]
    longest = max((pairs[2][q] for q in both), default=0)
    return [q for q in both if pairs[2][q] >= share * longest - 1e-12]


def chosen_pairs(maps, min_pixels, every, used, skip, pairs, share, neighbour_m):
    """The scale of all that is lit, and the far pairs of what is left without the outermost, in place."""
    at = np.array([middle(image, min_pixels) for image in maps])
    lit = {k for k in range(len(maps)) if at[k][0] >= 0}

    def length(these, q):
        return np.linalg.norm(at[these[1][q]] - at[these[0][q]])

    wide = far(lit, every, 0.5)
    scale = np.median([length(every, q) / every[2][q] for q in wide]) if wide else 0.0
    seen = [k for k in used.tolist() if k in lit]
    inner = set(seen[skip : len(seen) - skip])
    off = {q: abs(length(pairs, q) - scale * pairs[2][q]) for q in far(inner, pairs, share)}
    return scale, [q for q, px in off.items() if px <= scale * neighbour_m]


def robust_mean(values, weights, first, second, clusters, drop, iqr):
    """Plain means over masks; the sigma by leaving out one cluster after the other."""
    keep = np.ones(len(values), bool)
    if len(values) > 2 * drop + 1:
        order = np.argsort(values)
        keep[order[:drop]] = keep[order[len(values) - drop :]] = False
    low, high = np.quantile(values[keep], [0.25, 0.75])
    keep &= (values >= low - iqr * (high - low)) & (values <= high + iqr * (high - low))
    without = []
    for k in range(clusters):
        touched = keep & ((first == k) | (second == k))
        if touched.any() and (keep & ~touched).any():
            without.append(np.average(values[keep & ~touched], weights=weights[keep & ~touched]))
    m = len(without)
    sigma = np.sqrt((m - 1) * np.var(without)) if m > 1 else np.nan
    return np.average(values[keep], weights=weights[keep]), sigma, keep.sum()


def gaussian(centre, sigma, size):
    """A Gaussian's integral over each pixel of a line; pixel n reaches from n - 1/2 to n + 1/2."""
    return np.diff(erf((np.arange(size + 1) - 0.5 - centre) / (np.sqrt(2) * sigma))) / 2


def box(centre, width, size):
    """The part of each pixel of a line that a box covers."""
    edges = np.clip(np.arange(size + 1) - 0.5, centre - width / 2, centre + width / 2)
    return np.diff(edges)


def soft_box(centre, width, blur, size):
    """A box blurred by a Gaussian, the mean over each pixel of a line by 16 samples; and its slope."""
    x = (np.arange(16 * size) + 0.5) / 16 - 0.5 - centre

    def edge(at):
        return erf((x - at) / (np.sqrt(2) * blur)) / 2

    def bell(at):
        return np.exp(-((x - at) ** 2) / (2 * blur**2)) / (np.sqrt(2 * np.pi) * blur)

    value = edge(-width / 2) - edge(width / 2)
    slope = bell(width / 2) - bell(-width / 2)
    return value.reshape(size, 16).mean(1), slope.reshape(size, 16).mean(1)
