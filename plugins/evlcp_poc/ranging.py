"""Distance from the shifts between clusters in the image."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import fft

from evlcp_sdk.abc import Measure, Ranging
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.geometry import BarLayout, CameraModel
from evlcp_sdk.types import Range

__all__ = ["PocRanging", "phase_only_correlation"]

_NONE = Range(float("nan"), float("nan"), 0)


def phase_only_correlation(spectra_a: NDArray[np.complex128], spectra_b: NDArray[np.complex128], width: int) -> NDArray[np.float64]:
    """Phase-only correlation of images given by `rfft2`, float64 (..., height, width).

    Its peak lies where image b lies relative to image a (down, right), and has the shape of the Dirichlet
    kernel of the band kept; the Nyquist frequency, which has no phase, is left out.
    """
    height = spectra_a.shape[-2]
    cross = spectra_b * np.conj(spectra_a)
    size = np.abs(cross)
    cross = np.where(size > 1e-9 * size.max(initial=1e-30), cross / np.maximum(size, 1e-30), 0)
    if height % 2 == 0:
        cross[..., height // 2, :] = 0
    if width % 2 == 0:
        cross[..., :, width // 2] = 0
    out: NDArray[np.float64] = fft.irfft2(cross, (height, width))
    return out


@dataclass(frozen=True)
class PocRanging(Ranging):
    """Phase-only correlation between the maps of cluster pairs, L = f S / (l' a) (arXiv 2510.17203).

    The shift of each pair comes from the Dirichlet kernel that fits the correlation's peak best. A shift
    has the same error whatever its length, so a pair's distance is the better the farther apart its clusters:
    the variance falls with the spacing squared, which gives the weights. The spread over clusters (delete-one
    jackknife, since pairs share clusters) gives sigma.
    """

    clusters: Annotated[
        tuple[int, ...], Field(description="Clusters to use; empty for all but the outermost.")
    ] = ()
    skip_outer: Annotated[
        int,
        Field(ge=0, description="Clusters left out at each end: an outer edge has no neighbour to bound it."),
    ] = 1
    min_spacing: Annotated[
        float,
        Field(ge=0, le=1, description="Least spacing of a pair, as a share of the longest."),
    ] = 0.5
    drop_extremes: Annotated[
        int, Field(ge=0, description="Pairs dropped at each end of the sorted distances.")
    ] = 1
    outlier_iqr: Annotated[
        float, Field(gt=0, description="Interquartile ranges beyond the quartiles that make an outlier.")
    ] = 1.5
    weight_power: Annotated[
        float, Field(ge=0, le=4, description="Weight of a pair: its spacing to this power.")
    ] = 2.0
    peak_samples: Annotated[
        int, Field(ge=1, le=8, description="Samples on each side of the peak that the kernel is fitted to.")
    ] = 2
    min_pixels: Annotated[
        int, Field(ge=1, description="Lit pixels that a cluster's map needs to be used.")
    ] = 4

    def compile(self, camera: CameraModel, bar: BarLayout) -> Measure:
        """Precompute the pairs of a bar.

        Raises:
            ConfigError: Fewer than two clusters are left to pair.
        """
        used = self._used(bar.clusters)
        centres = bar.cluster_centres_m()
        i, j = np.triu_indices(len(used), 1)
        spacing = np.hypot(*(centres[used[j]] - centres[used[i]]).T)
        far = spacing >= self.min_spacing * spacing.max() - 1e-12
        first, second, spacing = used[i[far]], used[j[far]], spacing[far]
        neighbour = float(np.min(np.hypot(*(centres[1:] - centres[:-1]).T)))

        def measure(maps: NDArray[np.float32]) -> Range:
            usable = np.flatnonzero((maps[used] > 0).sum((1, 2)) >= self.min_pixels)
            if len(usable) < 2:
                return _NONE
            middle = np.full((len(maps), 2), -1)
            middle[used[usable]] = _middles(maps[used[usable]])
            known = (middle[first, 0] >= 0) & (middle[second, 0] >= 0)
            if not known.any():
                return _NONE
            a, b, apart_m = first[known], second[known], spacing[known]
            apart_px = (middle[b] - middle[a]).astype(np.float64)
            scale = float(np.median(np.hypot(*apart_px.T) / apart_m))
            if scale <= 0:
                return _NONE
            apart_px += self._residuals(maps, middle, a, b, scale * neighbour)
            distance = camera.focal_px * apart_m / np.maximum(np.hypot(*apart_px.T), 1e-9)
            keep = self._keep(distance)
            weight = np.where(keep, apart_m**self.weight_power, 0.0)
            estimate = float(weight @ distance / weight.sum())
            return Range(estimate, _jackknife(distance, weight, a, b), int(keep.sum()))

        return measure

    def _used(self, clusters: int) -> NDArray[np.int64]:
        used = np.array(self.clusters or range(self.skip_outer, clusters - self.skip_outer), np.int64)
        if len(used) < 2 or used.min() < 0 or used.max() >= clusters or len(set(used)) != len(used):
            raise ConfigError(
                f"ranging.clusters = {list(self.clusters)}, skip_outer = {self.skip_outer}:"
                f" expected two or more different clusters of 0 to {clusters - 1}"
            )
        return np.sort(used)

    def _residuals(
        self,
        maps: NDArray[np.float32],
        middle: NDArray[np.int64],
        a: NDArray[np.int64],
        b: NDArray[np.int64],
        neighbour_px: float,
    ) -> NDArray[np.float64]:
        """Shifts (down, right) of each pair beyond that of the middles, px."""
        from evlcp_poc import _kernels

        # A cut of three spacings holds a cluster's blob with its blur, and half its neighbours' room.
        height = _cut_size(3 * neighbour_px)
        width = min(height, _cut_size(maps.shape[2]))
        which = np.unique(np.concatenate([a, b]))
        cuts = np.stack([_cut(maps[k], middle[k], height, width) for k in which])
        spectra = fft.rfft2(cuts)
        index = np.full(len(maps), -1)
        index[which] = np.arange(len(which))
        correlation = phase_only_correlation(spectra[index[a]], spectra[index[b]], width)
        shifts = np.empty((len(a), 2))
        reach = max(int(neighbour_px / 2), 2)
        _kernels.pair_shifts(correlation, reach, self.peak_samples, shifts)
        return shifts

    def _keep(self, distance: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Pairs that remain after the extremes and the outliers are dropped."""
        keep = np.ones(len(distance), bool)
        d = self.drop_extremes
        if d and len(distance) > 2 * d + 1:
            order = np.argsort(distance, kind="stable")
            keep[order[:d]] = keep[order[-d:]] = False
        low, high = np.percentile(distance[keep], (25, 75))
        room = self.outlier_iqr * (high - low)
        return keep & (distance >= low - room) & (distance <= high + room)


def _cut_size(least: float) -> int:
    size = 16
    while size < least:
        size *= 2
    return size


def _middles(maps: NDArray[np.float32]) -> NDArray[np.int64]:
    """Weighted median (row, column) of each map: unlike the mean, deaf to stray pixels."""
    out = []
    for axis in (2, 1):
        total = np.cumsum(maps.sum(axis), 1)
        out.append((total >= total[:, -1:] / 2).argmax(1))
    return np.stack(out, 1)


def _cut(map_: NDArray[np.float32], middle: NDArray[np.int64], height: int, width: int) -> NDArray[np.float32]:
    """A window of a map around its middle, zero outside."""
    out = np.zeros((height, width), np.float32)
    top, left = middle[0] - height // 2, middle[1] - width // 2
    v0, v1 = max(top, 0), min(top + height, map_.shape[0])
    u0, u1 = max(left, 0), min(left + width, map_.shape[1])
    out[v0 - top : v1 - top, u0 - left : u1 - left] = map_[v0:v1, u0:u1]
    return out


def _jackknife(
    distance: NDArray[np.float64], weight: NDArray[np.float64], a: NDArray[np.int64], b: NDArray[np.int64]
) -> float:
    """Standard deviation of the weighted mean when one cluster at a time, with its pairs, is left out."""
    names = np.unique(np.concatenate([a[weight > 0], b[weight > 0]]))
    left = [weight * ((a != k) & (b != k)) for k in names]
    means = np.array([w @ distance / w.sum() for w in left if w.sum() > 0])
    n = len(means)
    return float(np.sqrt((n - 1) / n * ((means - means.mean()) ** 2).sum())) if n > 1 else float("nan")
