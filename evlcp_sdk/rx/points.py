"""Where each cluster of a frame is seen, to a fraction of a pixel: what a position is computed from."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.values import PresenceMap

__all__ = ["FindPoints", "points_finder"]

FindPoints = Callable[
    [PresenceMap, NDArray[np.float64], tuple[float, float]], tuple[NDArray[np.float64], NDArray[np.float64]]
]
"""Presence of a pilot, rest of the motion in the chips that it was read from (2, n), and column and row of
the bar's centre in the middle of these -> points (K, 2) and sigmas (K,), px; NaN where unseen."""

_SIGMA_PX = 0.12
"""Error expected before any is seen: a boundary inside a pixel, found from a few columns of correlations of
eight values each, of which a fifth of the negative events is missing."""

_EXPECTED_WORTH = 8.0
"""Residuals that this expectation is worth; the 28 of a whole bar outweigh it."""

_OUTER = 1.5
"""Sigma of a cluster with a boundary on one side only, in those of one between two: two errors over two, and
a spacing's beside, against one over the root of two."""


def points_finder(centres_m: NDArray[np.float64]) -> FindPoints:
    """Precompute for a layout; the function that is returned is pure.

    A cluster's centre along the layout lies midway between its boundaries with its neighbours, where the
    shares of both in a row of pixels balance; across it, it is the mean of its pixels. An outer edge, which
    light without a neighbour moves outward by a third of a pixel, is not used: beyond the last boundary the
    spacing of the others counts. Cells out of place do not, as a window about the layout's placement by
    medians leaves them out.

    Sigma is the scatter of the points about their best similarity with the layout, pooled with what is
    expected, and larger at the ends.

    Args:
        centres_m: Cluster centres (x right, y down), m, float64 (K, 2).
    """
    clusters = len(centres_m)
    gaps = np.abs(centres_m[:, None] - centres_m[None]).max(-1)
    spacing_m = float(gaps[gaps > 1e-9].min()) if clusters > 1 else 0.0
    neighbours = np.full((2, clusters), -1, np.int64)
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = spacing_m
        for k, centre in enumerate(centres_m):
            beside = np.flatnonzero(np.abs(centres_m - centre - step).max(1) < 0.1 * spacing_m)
            if len(beside):
                neighbours[axis, k] = beside[0]
    layout = np.ascontiguousarray(centres_m)

    def find(
        presence: PresenceMap, offset_px: NDArray[np.float64], centre_px: tuple[float, float]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        from evlcp_sdk.rx import _kernels

        cells, area = np.empty((clusters, 2)), np.empty(clusters, np.int64)
        _kernels.cell_centres(presence.selected, cells, area)
        if np.count_nonzero(area) < 3 or not spacing_m:
            return np.full((clusters, 2), np.nan), np.full(clusters, np.nan)
        cells = cells * presence.grid_px + (presence.grid_px - 1) / 2
        points, ends = np.empty((clusters, 2)), np.empty(clusters)
        squares = _kernels.place_clusters(
            presence.pixels, cells, area, layout, spacing_m, neighbours, points, ends
        )
        seen = clusters - int(np.count_nonzero(np.isnan(ends)))
        freedom = max(2 * seen - 4, 0)
        variance = (_EXPECTED_WORTH * _SIGMA_PX**2 + squares) / (_EXPECTED_WORTH + freedom)
        height, width = presence.pixels.shape[1:]
        # The image shows the pilot's mean; the bar's centre at the instant is that of its region.
        points -= ((width - 1) / 2, (height - 1) / 2) + offset_px.sum(1) / offset_px.shape[1]
        points += centre_px
        return points, variance**0.5 * (1 + (_OUTER - 1) * ends)

    return find
