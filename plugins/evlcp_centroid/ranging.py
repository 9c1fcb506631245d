"""Distance from the clusters' centres of gravity, and none: for one cluster, or where bearings are enough."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import ROLES, Measure, Ranging
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import NO_RANGE, FrameView, Range


@dataclass(frozen=True)
class CentroidRanging(Ranging):
    """Similarity (shift, turn, scale) that maps the layout best to the centres of gravity.

    Each cluster's centre is the mean of its map, whatever its LEDs. To a side where it has no neighbour it
    looks larger than it is: those count that have neighbours on the same sides as most have. From a start by
    medians, clusters far from the fit, by more than three times the median, are left out. Sigma is that of
    the fit.
    """

    skip_outer: Annotated[
        int,
        Field(
            ge=0,
            description="Seen clusters left out at each end of a line: an outer edge has no neighbour. With"
            " 0, all clusters of other layouts count, too.",
        ),
    ] = 1
    min_clusters: Annotated[
        int, Field(ge=3, description="Clusters that must be seen, or all of a smaller layout.")
    ] = 5

    def compile(self, camera: CameraModel, bar: BarLayout, codebook: Codebook) -> Measure:
        """Precompute the layout as complex numbers, right + 1j * down.

        Raises:
            ConfigError: Fewer clusters are left than a distance needs.
        """
        centres = bar.cluster_centres_m()
        in_line = np.linalg.matrix_rank(centres - centres.mean(0), tol=1e-9) < 2
        skip = self.skip_outer if in_line else 0
        same = bar.has_usual_sides if self.skip_outer and not in_line else np.ones(bar.clusters, np.bool_)
        left = int(same.sum()) - 2 * skip
        least = max(min(self.min_clusters, left), 3)
        if left < least:
            raise ConfigError(
                f"ranging 'centroid' uses {max(left, 0)} of {bar.clusters} clusters (skip_outer ="
                f" {skip}), expected at least min_clusters = {least};"
                f" {ROLES['ranging'].suggest_for(bar, codebook.unpaired_codes)}"
            )
        if not bar.has_distinct_centres:
            raise ConfigError("ranging 'centroid' needs clusters apart: use 'none' for this layout")
        layout = centres[:, 0] + 1j * centres[:, 1]

        def measure(view: FrameView) -> Range:
            maps = view.presence.pixels.astype(np.float64)
            weight = maps.sum((1, 2))
            # The outermost that are seen may be partly hidden.
            seen = np.flatnonzero((weight > 0) & same)
            seen = seen[skip : len(seen) - skip]
            if len(seen) < least:
                return NO_RANGE
            down = maps.sum(2)[seen] @ np.arange(maps.shape[1]) / weight[seen]
            right = maps.sum(1)[seen] @ np.arange(maps.shape[2]) / weight[seen]
            image, place = right + 1j * down, layout[seen]
            # The start is robust: medians of distant pairs, and of the residuals.
            apart = place - place[:, None]
            far = np.abs(apart) >= 0.5 * np.abs(apart).max()
            step = (image - image[:, None])[far] / apart[far]
            scale = complex(np.median(step.real), np.median(step.imag))
            rest = image - scale * place
            shift = complex(np.median(rest.real), np.median(rest.imag))
            for _ in range(2):
                off = np.abs(image - shift - scale * place)
                keep = off <= 3 * np.median(off) + 1e-9
                if keep.sum() < least:
                    return NO_RANGE
                spread = place[keep] - place[keep].mean()
                power = float((np.abs(spread) ** 2).sum())
                scale = complex(np.conj(spread) @ image[keep]) / power
                shift = complex(image[keep].mean() - scale * place[keep].mean())
            off = np.abs(image[keep] - shift - scale * place[keep])
            kept = int(keep.sum())
            variance = float((off**2).sum()) / max(2 * kept - 4, 1)
            size = abs(scale)
            if not size > 0:
                return NO_RANGE
            distance = camera.focal_px / size
            return Range(distance, distance * float(np.sqrt(variance / power)) / size, kept)

        return measure


@dataclass(frozen=True)
class NoRanging(Ranging):
    """Gives no distance; takes every layout."""

    measures: ClassVar[bool] = False

    def compile(self, camera: CameraModel, bar: BarLayout, codebook: Codebook) -> Measure:
        """Nothing to precompute."""
        return lambda _: NO_RANGE
