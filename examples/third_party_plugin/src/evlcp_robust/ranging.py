"""Distance by the median over pairs of clusters."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

import evlcp_sdk as evlcp

__all__ = ["MedianPairs"]

_NONE = evlcp.Range(float("nan"), float("nan"), 0)

_SIGMA_OF_MAD = 1.4826
"""Standard deviation of a Gaussian whose median absolute deviation is 1."""

_EFFICIENCY = 3 / np.pi
"""Variance of least squares to that of the median slope, Gaussian errors, even spacing (Sen 1968)."""


@dataclass(frozen=True)
class MedianPairs(evlcp.Ranging):
    """Median of the image scale over all pairs of clusters that are far apart (Theil 1950, Sen 1968).

    A cluster stands where its map's centre of gravity is. Up to a quarter of the clusters may stand anywhere
    without moving the median far. Sigma is that of least squares with the residuals' median absolute
    deviation for their standard deviation, and the median's efficiency.
    """

    min_spacing: Annotated[
        float, Field(gt=0, lt=1, description="Spacing of a pair, as a share of the widest.")
    ] = 0.25
    min_clusters: Annotated[int, Field(ge=3, description="Clusters that must be seen.")] = 5

    def compile(
        self, camera: evlcp.CameraModel, bar: evlcp.BarLayout, codebook: evlcp.Codebook
    ) -> evlcp.Measure:
        """Precompute the pairs.

        Raises:
            ConfigError: The bar has fewer clusters than must be seen.
        """
        if bar.clusters < self.min_clusters:
            raise evlcp.ConfigError(
                f"ranging.min_clusters = {self.min_clusters}: expected at most the bar's {bar.clusters}"
            )
        centres = bar.cluster_centres_m()
        place = centres[:, 0] + 1j * centres[:, 1]
        first, second = np.triu_indices(len(place), 1)
        apart = np.abs(place[second] - place[first])
        far = apart >= self.min_spacing * apart.max()
        first, second, apart = first[far], second[far], apart[far]

        def measure(view: evlcp.FrameView) -> evlcp.Range:
            maps = view.presence.pixels.astype(np.float64)
            weight = maps.sum((1, 2))
            seen = weight > 0
            pairs = seen[first] & seen[second]
            if seen.sum() < self.min_clusters or not pairs.any():
                return _NONE
            total = np.where(seen, weight, 1.0)
            right = maps.sum(1) @ np.arange(maps.shape[2]) / total
            down = maps.sum(2) @ np.arange(maps.shape[1]) / total
            image = right + 1j * down
            i, j = first[pairs], second[pairs]
            across = image[j] - image[i]
            scale = float(np.median(np.abs(across) / apart[pairs]))
            if not scale > 0:
                return _NONE
            turn = np.median(np.angle(across * np.conj(place[j] - place[i])))
            spread = place[seen] - place[seen].mean()
            off = image[seen] * np.exp(-1j * turn) - scale * spread
            error_px = max(_robust_sigma(off.real), _robust_sigma(off.imag))
            power = float((np.abs(spread) ** 2).sum())
            sigma = error_px / np.sqrt(power * _EFFICIENCY)
            distance = camera.distance_m(1.0, scale)
            return evlcp.Range(distance, distance * float(sigma) / scale, int(pairs.sum()))

        return measure


def _robust_sigma(values: np.ndarray) -> float:
    return _SIGMA_OF_MAD * float(np.median(np.abs(values - np.median(values))))
