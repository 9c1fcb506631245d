"""Shifts between images by phase-only correlation."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from evlcp_poc import _kernels

_MIN_AMPLITUDE = 1e-5
"""Amplitude, in the largest of a spectrum, below which there is no phase: that of rounding."""

_BAND_CYCLES = 0.5
"""End of the band that blobs fill, cycles a blob size: half the main lobe of a box's spectrum, where its
amplitude is still 2 / pi of the peak. The noise of a phase is inverse to its amplitude."""

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Images = NDArray[np.float32]


def phase_only_correlation(
    images: Images,
    size: tuple[int, int],
    pairs: tuple[Indices, Indices],
    most: tuple[int, int],
    down: range,
    right: range,
) -> Images:
    """Phase-only correlation of pairs of images, float32 (height, n, width) -> (shifts, pairs, shifts).

    The peak of a pair is where its second image is relative to its first, and has the shape of the Dirichlet
    kernel of the band kept. Images are small, and only few of their shifts, `down` and `right`, are needed:
    products with matrices transform them there and back in a third of the time that fast transforms of all
    take.

    `images` may be the part of all of them, of `size` (height, width), outside of which they are dark; `most`
    are the highest harmonics kept, down and across, at most those of `full_band`.
    """
    height, n, width = images.shape
    there_down, there_across, back_down, back_across = _transforms(*size, most, down, right)
    half = there_down[:, :height] @ images.reshape(height, -1)
    turned = (half.reshape(-1, width) @ there_across[:, :width]).reshape(2, 2, -1, n, most[1] + 1)
    cross = np.empty((2, most[0] + 1, len(pairs[0]), 2, most[1] + 1), np.float32)
    _kernels.cross_spectra(turned, *pairs, _MIN_AMPLITUDE, cross)
    rows = cross.reshape(-1, 2 * (most[1] + 1)) @ back_across
    return (back_down @ rows.reshape(len(half), -1)).reshape(len(down), len(pairs[0]), -1)


@lru_cache(maxsize=64)
def _transforms(
    height: int, width: int, most: tuple[int, int], down: range, right: range
) -> tuple[Images, Images, Images, Images]:
    """Matrices that transform images down and across, and spectra across and down: harmonics from 0 on."""
    harmonics_down, harmonics_across = range(most[0] + 1), range(most[1] + 1)
    there_down = _cosines_and_sines(height, harmonics_down, range(height), 0)
    there_across = _cosines_and_sines(width, range(width), harmonics_across, 0).reshape(2, width, -1)
    # All harmonics but 0 are on both sides; those down are conjugates.
    weight = np.where(harmonics_down, 2, 1) / (height * width)
    back_down = _cosines_and_sines(height, down, harmonics_down, 1) * [*weight, *-weight]
    back_across = _cosines_and_sines(width, harmonics_across, right, 0)
    back_across[0] /= 2
    matrices = there_down, there_across, back_down, back_across
    one, two, three, four = (matrix.astype(np.float32) for matrix in matrices)
    return one, two, three, four


def _cosines_and_sines(size: int, one: range, other: range, axis: int) -> Floats:
    """Of each harmonic at each place out of `size`, joined along an axis."""
    angle = 2 * np.pi / size * (np.outer(one, other) % size)
    return np.concatenate([np.cos(angle), np.sin(angle)], axis)


def measure_shifts(
    images: Images,
    size: tuple[int, int],
    pairs: tuple[Indices, Indices],
    most: tuple[int, int],
    reach: int,
    samples: int,
) -> Floats:
    """Measure the shifts of pairs of images within `reach`, (pairs, 2): down, right, px.

    See `phase_only_correlation`; the Dirichlet kernel is fitted to so many `samples` on each side of a peak.
    """
    down, right = (min(reach, n // 2 - 1) + samples for n in size)
    ways = range(-down, down + 1), range(-right, right + 1)
    correlation = phase_only_correlation(images, size, pairs, most, *ways)
    shifts = np.empty((len(pairs[0]), 2))
    _kernels.fit_peaks(correlation, size, most, samples, shifts)
    return shifts


def full_band(height: int, width: int) -> tuple[int, int]:
    """Highest harmonics, down and across, that have a phase."""
    return (height - 1) // 2, (width - 1) // 2


def blob_size(cuts: Images) -> tuple[float, float]:
    """Height and width of a box with the cuts' mean distance from its middle, px.

    A box of h pixels has a mean distance of h / 4, which a stray pixel moves less than it moves a variance.
    """
    height, _, width = cuts.shape
    rows, columns = cuts.sum((1, 2), dtype=np.float64), cuts.sum((0, 1), dtype=np.float64)
    total = max(float(rows.sum()), 1e-9)
    down, across = np.abs(np.arange(height) - height // 2), np.abs(np.arange(width) - width // 2)
    return 4 * float(rows @ down) / total, 4 * float(columns @ across) / total


def blob_band(cuts: Images, size: tuple[int, int]) -> tuple[int, int]:
    """Highest harmonics, of `size`, that blobs in the middles of cuts fill down and across; not 0."""
    down, across = (
        min(max(round(_BAND_CYCLES * n / max(blob, 1.0)), 1), most)
        for n, blob, most in zip(size, blob_size(cuts), full_band(*size), strict=True)
    )
    return down, across
