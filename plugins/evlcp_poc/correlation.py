"""Shifts between images by phase-only correlation."""

import numpy as np
from numpy.typing import NDArray

from evlcp_poc import _kernels

_NO_PHASE = 1e-5
"""Amplitude, in the largest of a spectrum, below which there is no phase: that of rounding."""

_CYCLES = 0.5
"""End of the band that blobs fill, cycles a blob size: half the main lobe of a box's spectrum, where its
amplitude is still 2 / pi of the peak. The noise of a phase is inverse to the amplitude, and all phases weigh
the same."""

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Images = NDArray[np.float32]


def phase_only_correlation(
    images: Images,
    first: Indices,
    second: Indices,
    most: tuple[int, int] | None = None,
    rows: Indices | None = None,
) -> NDArray[np.floating]:
    """Phase-only correlation of pairs of images, float32 (n, height, width) -> (pairs, height, width).

    The peak of a pair lies where its second image lies relative to its first (down, right), and has the shape
    of the Dirichlet kernel of the band kept.

    Args:
        images: The images.
        first: First image of each pair.
        second: Second image of each pair.
        most: Highest harmonics kept, down and across; None for all but Nyquist's, which have no phase.
        rows: Which rows to give; None for all.
    """
    _, height, width = images.shape
    down, across = most or full_band(height, width)
    # Columns side by side, which are transformed in two thirds of the time.
    spectra = np.fft.fft(np.fft.rfft(images)[:, :, : across + 1].swapaxes(1, 2).copy())
    spectra[:, :, down + 1 : height - down] = 0
    size = np.abs(spectra)
    has_phase = size > _NO_PHASE * size.max((1, 2), keepdims=True)
    unit = spectra * (1 / np.where(has_phase, size, np.float32(np.inf)))
    columns = np.fft.ifft(unit.conj()[first] * unit[second]).swapaxes(1, 2)
    return np.fft.irfft(columns if rows is None else columns.take(rows, 1), width)


def pair_shifts(
    images: Images, first: Indices, second: Indices, most: tuple[int, int], reach: int, samples: int
) -> Floats:
    """Shifts of pairs of images within `reach`, (pairs, 2): down, right, px.

    Args:
        images: The images.
        first: First image of each pair.
        second: Second image of each pair.
        most: The highest harmonics to correlate, down and across.
        reach: How far a peak may be.
        samples: On each side of a peak, to which the Dirichlet kernel is fitted.
    """
    _, height, width = images.shape
    far = min(reach, height // 2 - 1), min(reach, width // 2 - 1)
    rows = np.arange(-far[0] - samples, far[0] + samples + 1) % height
    correlation = phase_only_correlation(images, first, second, most, rows)
    shifts = np.empty((len(first), 2))
    _kernels.fit_peaks(correlation, (height, width), most, far, samples, shifts)
    return shifts


def cut_maps(maps: Images, middles: Indices, height: int, width: int) -> Images:
    """Windows of maps around their middles, 0 outside a map and where a middle is -1, (n, height, width)."""
    out = np.zeros((len(maps), height, width), np.float32)
    for k, (v, u) in enumerate(middles.tolist()):
        if v >= 0:
            top, left = v - height // 2, u - width // 2
            row, column = max(top, 0), max(left, 0)
            part = maps[k, row : top + height, column : left + width]
            rows, columns = part.shape
            out[k, row - top : row - top + rows, column - left : column - left + columns] = part
    return out


def full_band(height: int, width: int) -> tuple[int, int]:
    """Highest harmonics, down and across, that have a phase."""
    return (height - 1) // 2, (width - 1) // 2


def blob_size(cuts: Images) -> tuple[float, float]:
    """Height and width of the box with the mean distance from its middle that cuts have, px.

    A box of h pixels has a mean distance of h / 4, which a stray pixel moves less than it moves a variance.
    """
    _, height, width = cuts.shape
    rows, columns = cuts.sum((0, 2), dtype=np.float64), cuts.sum((0, 1), dtype=np.float64)
    total = max(float(rows.sum()), 1e-9)
    down, across = np.abs(np.arange(height) - height // 2), np.abs(np.arange(width) - width // 2)
    return 4 * float(rows @ down) / total, 4 * float(columns @ across) / total


def blob_band(cuts: Images) -> tuple[int, int]:
    """Highest harmonics, down and across, that blobs in the middles of cuts fill; one at the least."""
    down, across = (
        min(max(round(_CYCLES * n / max(size, 1.0)), 1), most)
        for n, size, most in zip(cuts.shape[1:], blob_size(cuts), full_band(*cuts.shape[1:]), strict=True)
    )
    return down, across
