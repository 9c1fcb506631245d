"""Distance from the shifts between clusters in the image."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_poc import _kernels
from evlcp_poc.correlation import blob_band, full_band, measure_shifts
from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import ROLES, Measure, Ranging
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import NO_RANGE, FrameView, Range, to_kernel_array

_RIM_PX = 0.2
"""Error that the shift of two clusters of a panel has in all frames alike: the halo around it has fewer rows
and columns of clusters between it and them than in a long bar."""


@dataclass(frozen=True)
class PocRanging(Ranging):
    """Phase-only correlation between the maps of cluster pairs, L = f S / (l' a) (arXiv 2510.17203).

    Pairs are of clusters that have neighbours on the same sides: to any other side a cluster looks larger
    than it is, which shifts the end of a bar by a third of a pixel, and the rim of a panel by one.
    Of a bar with hidden ends, the clusters that are seen count as if they were all.
    A pair whose clusters lie a spacing off the scale that all clusters agree on is left out first.
    The shift of each pair comes from the Dirichlet kernel that fits the correlation's peak best. A shift
    has the same error whatever its length, so a pair's distance is the better the farther apart its clusters:
    the variance falls with the spacing squared, which gives the weights. The spread over clusters (delete-one
    jackknife, since pairs share clusters) gives sigma.

    The paper's method; the default is `joint-scale`, so choose this by `ranging.id = "poc"`.

    The spectrum of a map falls off beyond half a cycle a blob size, and the phases there are the noise's, but
    count as much in the paper's method, `band = "full"`. With `band = "blob"` only the frequencies that the
    blobs fill are correlated: on ideal blobs in noise, the error of a shift is 1.3 to 2.5 times the
    Cramer-Rao bound instead of 5 to 7.
    """

    band: Annotated[
        Literal["full", "blob"],
        Field(description="Frequencies correlated: all, as in the paper, or up to half a cycle a blob size."),
    ] = "full"
    clusters: Annotated[
        tuple[int, ...], Field(description="Clusters to use; empty for all but the outermost.")
    ] = ()
    skip_outer: Annotated[
        int,
        Field(
            ge=0,
            description="Seen clusters left out at each end of a line: edges have no neighbour. With 0, all"
            " clusters are compared, whatever sides their neighbours are on.",
        ),
    ] = 1
    min_spacing: Annotated[
        float,
        Field(ge=0, le=1, description="Least spacing of a pair, as a share of the longest that is seen."),
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
    min_pairs: Annotated[
        int,
        Field(
            ge=1,
            description="Pairs that a distance needs, or all of a smaller layout: of seven, five are left"
            " without the extremes, and outvote two wrong ones.",
        ),
    ] = 7
    min_pixels: Annotated[
        int, Field(ge=1, description="Lit pixels that a cluster's map needs to be used.")
    ] = 4

    def compile(self, camera: CameraModel, bar: BarLayout, codebook: Codebook) -> Measure:
        """Precompute the pairs of a bar.

        Raises:
            ConfigError: Fewer than two clusters are left to pair, or clusters are not alike.
        """
        selected = self._select_clusters(bar.clusters)
        if not self.clusters:
            # The outermost are those of the clusters that are seen.
            selected = np.arange(bar.clusters)
        all_count = bool(self.clusters) or self.skip_outer == 0
        skip = self._clusters_to_skip(bar.clusters) if bar.is_even_line and not all_count else 0
        centres = bar.cluster_centres_m()
        a, b = np.triu_indices(len(selected), 1)
        if not all_count:
            same = bar.lit_sides[selected[a]] == bar.lit_sides[selected[b]]
            a, b = a[same], b[same]
        a, b = selected[a], selected[b]
        apart = np.hypot(*(centres[:, None] - centres).T)
        instead = ROLES["ranging"].suggest_for(bar, codebook.unpaired_codes)
        if not (bar.has_equal_clusters and bar.has_distinct_centres):
            raise ConfigError(
                f"ranging 'poc' compares images of clusters, which have to be alike and apart: {instead}"
            )
        if not len(a):
            raise ConfigError(
                "ranging 'poc' compares clusters that have neighbours on the same sides, as an edge without"
                f" one looks further out; here no two are: {instead}"
            )
        neighbour = float(apart[apart > 0].min())

        rim_px = _RIM_PX if (bar.lit_sides & 3).any() and (bar.lit_sides & 12).any() else 0.0
        rules = self.weight_power, self.drop_extremes, self.outlier_iqr

        @lru_cache(maxsize=256)
        def select_pairs(lit: bytes) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
            """Pairs of seen clusters that are far apart, and their spacing: the same in most frames."""
            seen = selected[np.frombuffer(lit, np.bool_)[selected]]
            inner = seen[skip : max(len(seen) - skip, 0)]
            both = np.isin(a, inner) & np.isin(b, inner)
            far = both & (apart[a, b] >= self.min_spacing * (apart[a, b] * both).max() - 1e-12)
            return a[far], b[far], apart[a, b][far]

        least = min(self.min_pairs, max(len(select_pairs(b"\1" * bar.clusters)[0]), 1))

        def measure(view: FrameView) -> Range:
            maps, middles = to_kernel_array(view.presence.pixels), np.empty((bar.clusters, 2), np.int64)
            px_per_m, *lit_px = _kernels.find_middles(maps, apart, self.min_pixels, middles)
            far = select_pairs((middles[:, 0] >= 0).tobytes())
            if len(far[0]) < least or px_per_m <= 0:
                return NO_RANGE
            # A cut of two spacings and a seam holds a cluster's blob with its blur, wherever it sits in it.
            neighbour_px = px_per_m * neighbour
            height = cut_size(2 * neighbour_px + 8)
            size = height, min(height, cut_size(maps.shape[2]))
            rows, columns = (min(2 * far_px + 1, n) for far_px, n in zip(lit_px, size, strict=True))
            cuts = np.empty((rows, bar.clusters, columns), np.float32)
            _kernels.cut_maps(maps, middles, cuts)
            most = full_band(*size) if self.band == "full" else blob_band(cuts, size)
            # Two medians of blobs of one spacing are wrong by half a spacing at the most.
            reach = max(int(neighbour_px / 2), 2)
            beyond_px = measure_shifts(cuts, size, far[:2], most, reach, self.peak_samples)
            places = px_per_m, neighbour, least
            mean, sigma, kept = _kernels.mean_distance(
                middles, beyond_px, far, camera.focal_px, places, rules
            )
            rim = mean * (rim_px / (px_per_m * float(far[2].mean()))) if rim_px else 0.0
            return Range(mean, math.hypot(sigma, rim), kept)

        return measure

    def _clusters_to_skip(self, clusters: int) -> int:
        """Clusters left out at each end: of three or fewer, none could be."""
        return self.skip_outer if clusters > 3 else 0

    def _select_clusters(self, clusters: int) -> NDArray[np.int64]:
        skip = self._clusters_to_skip(clusters)
        selected = np.array(self.clusters or range(skip, clusters - skip), np.int64)
        if clusters < 2:
            raise ConfigError(
                "ranging 'poc' needs two clusters; no ranging measures the distance of one: use 'none' for"
                " this layout"
            )
        if not self.clusters and len(selected) < 2:
            raise ConfigError(
                f"ranging.skip_outer = {self.skip_outer}: leaves {len(selected)} of {clusters} clusters,"
                f" expected two or more; set ranging.skip_outer = {(clusters - 2) // 2}"
            )
        if (
            len(selected) < 2
            or selected.min() < 0
            or selected.max() >= clusters
            or len(set(selected)) != len(selected)
        ):
            raise ConfigError(
                f"ranging.clusters = {list(self.clusters)}:"
                f" expected two or more different clusters of 0 to {clusters - 1}"
            )
        return np.sort(selected)


def cut_size(least: float) -> int:
    """The next even length whose half has no factors but 2, 3 and 5, as of the paper's cuts."""
    half = math.ceil(least / 2)
    # All such numbers of less than 17 factors divide this one, and no other does.
    while 30**16 % half:
        half += 1
    return 2 * half
