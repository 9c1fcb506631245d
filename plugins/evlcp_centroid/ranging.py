"""Distance from the clusters' centres of gravity."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Measure, Ranging
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import FrameView, Range

__all__ = ["CentroidRanging"]

_NONE = Range(float("nan"), float("nan"), 0)


@dataclass(frozen=True)
class CentroidRanging(Ranging):
    """Similarity (shift, turn, scale) that brings the layout to the centres of gravity best.

    Each cluster's centre is the mean of its map; clusters far from the fit, by more than three times the
    median, are left out and the fit is made again. Sigma is that of the least squares.
    """

    skip_outer: Annotated[
        int, Field(ge=0, description="Clusters left out at each end: an outer edge has no neighbour.")
    ] = 1
    min_clusters: Annotated[int, Field(ge=3, description="Clusters that must be seen.")] = 5

    def compile(self, camera: CameraModel, bar: BarLayout, codebook: Codebook) -> Measure:
        """Precompute the layout as complex numbers, right + 1j * down.

        Raises:
            ConfigError: Fewer clusters are left than a distance needs.
        """
        centres = bar.cluster_centres_m()
        used = np.arange(self.skip_outer, bar.clusters - self.skip_outer)
        if len(used) < self.min_clusters:
            raise ConfigError(
                f"ranging 'centroid' uses {len(used)} of {bar.clusters} clusters (skip_outer ="
                f" {self.skip_outer}), expected at least min_clusters = {self.min_clusters}"
            )
        layout = centres[used, 0] + 1j * centres[used, 1]

        def measure(view: FrameView) -> Range:
            maps = view.presence.pixels[used].astype(np.float64)
            weight = maps.sum((1, 2))
            seen = weight > 0
            if seen.sum() < self.min_clusters:
                return _NONE
            down = maps.sum(2)[seen] @ np.arange(maps.shape[1]) / weight[seen]
            right = maps.sum(1)[seen] @ np.arange(maps.shape[2]) / weight[seen]
            image, place = right + 1j * down, layout[seen]
            keep = np.ones(len(image), bool)
            for _ in range(2):
                middle = place[keep].mean()
                spread = place - middle
                power = float((np.abs(spread[keep]) ** 2).sum())
                scale = (np.conj(spread[keep]) @ image[keep]) / power
                off = np.abs(image - image[keep].mean() - scale * spread)
                variance = float((off[keep] ** 2).sum()) / max(2 * int(keep.sum()) - 4, 1)
                kept, keep = keep, off <= 3 * np.median(off) + 1e-9
                if keep.sum() < self.min_clusters:
                    break
            size = float(np.abs(scale))
            if not size > 0:
                return _NONE
            distance = camera.focal_px / size
            return Range(distance, distance * float(np.sqrt(variance / power)) / size, int(kept.sum()))

        return measure
