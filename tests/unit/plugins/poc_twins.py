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


def correlation(one, other, down, across):
    """Of the phases of whole spectra, in double precision."""
    spectra = np.fft.rfft2(one.astype(float)).conj() * np.fft.rfft2(other.astype(float))
    spectra[:, down + 1 : one.shape[1] - down] = spectra[:, :, across + 1 :] = 0
    size = np.abs(spectra)
    return np.fft.irfft2(np.divide(spectra, size, out=0 * spectra, where=size > 0), one.shape[1:])


def scale(middles, apart, seen):
    """The median, px a metre, of pairs that are half as far apart as the farthest, or more."""
    pairs = [(a, b) for a in seen for b in seen if a < b]
    far = max((apart[pair] for pair in pairs), default=0) / 2
    return np.median(
        [np.hypot(*(middles[a] - middles[b])) / apart[a, b] for a, b in pairs if apart[a, b] >= far]
    )


def jackknife(values, weights, first, second, kept):
    """Sigma of a weighted mean of pairs by leaving out one cluster after another."""
    means = []
    for k in np.union1d(first[kept], second[kept]):
        rest = kept[(first[kept] != k) & (second[kept] != k)]
        means.append(np.average(values[rest], weights=weights[rest]))
    return np.sqrt((len(means) - 1) * np.var(means))


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
