"""Shifts between images by phase-only correlation."""

from functools import lru_cache

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
    images: Images, first: Indices, second: Indices, most: tuple[int, int], down: range, right: range
) -> Images:
    """Phase-only correlation of pairs of images, float32 (n, height, width) -> (pairs, shifts, shifts).

    The peak of a pair lies where its second image lies relative to its first, and has the shape of the
    Dirichlet kernel of the band kept. Images are small, and of their shifts only few are asked for: products
    with matrices transform them there and back in a third of the time that fast transforms of all take.

    Args:
        images: The images.
        first: First image of each pair.
        second: Second image of each pair.
        most: Highest harmonics kept, down and across; at the most those of `full_band`.
        down: Shifts down.
        right: Shifts to the right.
    """
    n, *shape = images.shape
    (turn_down, turn_across), (back_down, back_across) = _turns(*shape, most, down, right)
    half = (turn_down @ images).reshape(n, most[0] + 1, -1)
    spectra = (half @ turn_across).view(np.complex64)
    size = np.abs(spectra)
    has_phase = size > _NO_PHASE * size.max((1, 2), keepdims=True)
    unit = spectra * (1 / np.where(has_phase, size, np.float32(np.inf)))
    cross = unit.conj()[first] * unit[second]
    rows: Images = cross.view(np.float32) @ back_across
    return back_down @ rows.reshape(len(first), -1, len(right))


@lru_cache(maxsize=64)
def _turns(
    height: int, width: int, most: tuple[int, int], down: range, right: range
) -> tuple[tuple[Images, Images], tuple[Images, Images]]:
    """What transforms images, real numbers, down and then across, and what transforms spectra back.

    Of harmonics down those from 0 on are computed: the others are their conjugates. Where real and imaginary
    parts go, the middle axes say.
    """
    harmonics = range(most[0] + 1), range(-most[1], most[1] + 1)
    cosine, sine = _cosine_and_sine(height, harmonics[0], range(height))
    there_down = np.stack([cosine, -sine], 1).reshape(-1, height)
    cosine, sine = _cosine_and_sine(width, range(width), harmonics[1])
    there_across = np.array([[cosine, -sine], [sine, cosine]]).transpose(0, 2, 3, 1).reshape(2 * width, -1)
    cosine, sine = _cosine_and_sine(width, harmonics[1], right)
    back_across = np.array([[cosine, sine], [-sine, cosine]]).transpose(2, 0, 1, 3)
    cosine, sine = _cosine_and_sine(height, down, harmonics[0])
    weight = np.where(np.arange(most[0] + 1), 2, 1) / (height * width)
    back_down = np.stack([weight * cosine, -weight * sine], 2).reshape(len(down), -1)
    turns = there_down, there_across, back_down, back_across.reshape(-1, 2 * len(right))
    one, two, three, four = (np.ascontiguousarray(turn, np.float32) for turn in turns)
    return (one, two), (three, four)


def _cosine_and_sine(size: int, one: range, other: range) -> tuple[Floats, Floats]:
    """Of the turn that each harmonic makes at each place of so many."""
    angle = 2 * np.pi / size * (np.outer(one, other) % size)
    return np.cos(angle), np.sin(angle)


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
    shape = images.shape[1:]
    far = [min(reach, size // 2 - 1) + samples for size in shape]
    down, right = (range(-n, n + 1) for n in far)
    correlation = phase_only_correlation(images, first, second, most, down, right)
    shifts = np.empty((len(first), 2))
    _kernels.fit_peaks(correlation, shape, most, samples, shifts)
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
