"""Finds the clusters of a frame to a fraction of a pixel, from which positions are computed."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.placement import Layout, Placement, orient_centres
from evlcp_sdk.values import PresenceMap

FindPoints = Callable[
    [PresenceMap, Placement, NDArray[np.int16], tuple[float, float]],
    tuple[NDArray[np.float64], NDArray[np.float64], float, tuple[float, float]],
]
"""Presence of a pilot, where it shows the layout, its polarity sums (chips, rows, columns), and where on the
sensor the image begins -> points (K, 2) on the sensor and sigmas (K,), px, NaN where unseen; over how many
pixels a line's image fades out across it, NaN without a line; the bar's centre on the sensor, px."""

_SIGMA_PX = 0.08
"""Prior sigma: of a boundary inside a pixel, found from the events of a few columns in sixteen edges, of
which a fifth of the negative ones is missing."""

_EXPECTED_WORTH = 8.0
"""Residuals that this prior is worth; the 28 of a whole bar outweigh it."""

_ACROSS_PX = 5.0
"""Least distance from a line's middle up to which its light counts, px: a thin bar lights three pixels to
each side, by the lens's blur and wings; more is darkness. Nearer bars are wider, and clusters longer."""

_ONE_SIDED = 1.5
"""Sigma of a cluster with a boundary on one side only, relative to that of one between two: two errors over
two, and a spacing's in addition, against one over the root of two."""


def compile_finder(layout: Layout, edges: NDArray[np.int64], every: int) -> FindPoints:
    """Precompute for a layout; the function returned is pure.

    A cluster's centre along the layout is midway between its boundaries with its neighbours, where the shares
    of both in the light of a row of pixels balance; across it, it is the mean of its pixels, across a line
    that of their events in a window that reaches equally far to both sides. An outer edge, which light
    without a neighbour moves outward by a third of a pixel, is not used: beyond the last boundary the spacing
    of the others counts. Pixels out of place are outside of the window about the cluster's place.

    The bar's centre is that of the points, which are finer than the cells, or without any, of these.

    `edges` are those of the clusters' pilots, from each chip to the next, int64 (K, n); `every` is the number
    of chips from one of those that tell clusters apart to the next, the first of which is that into chip 1.

    Sigma is the scatter of the points about their best similarity, pooled with the prior, larger at the ends.
    """
    clusters, spacing_m = len(layout.centres_m), layout.spacing_m
    neighbours = np.full((2, clusters), -1, np.int64)
    for axis, step in enumerate((spacing_m, 1j * spacing_m)):
        for k, centre in enumerate(layout.centres_m):
            next_to = np.flatnonzero(np.abs(layout.centres_m - centre - step) < 0.1 * spacing_m)
            if len(next_to):
                neighbours[axis, k] = next_to[0]

    axes = [(axis, direction) for axis, direction in enumerate((1 + 0j, 1j)) if neighbours[axis].max() >= 0]

    def find_points(
        presence: PresenceMap,
        placement: Placement,
        pilot_sums: NDArray[np.int16],
        corner_px: tuple[float, float],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float, tuple[float, float]]:
        # A single cluster has no direction.
        unit = placement.scale / (abs(placement.scale) or 1.0)
        reach_px, places = abs(placement.scale) * spacing_m, placement.centres_px
        at_m = orient_centres(layout, placement.mirrored)
        across_px = max(_ACROSS_PX, reach_px / 2) if layout.is_line else 0.0
        mean, wider = np.empty((clusters, 2)), np.empty(clusters)
        line = unit * layout.direction, across_px
        seen, flank_px = _kernels.find_clusters(
            presence.pixels, placement.seen, places, reach_px, pilot_sums, edges, line, (mean, wider)
        )
        x, y = placement.shift.real, placement.shift.imag
        if seen < 3:
            centre_px = x + corner_px[0], y + corner_px[1]
            return np.full((clusters, 2), np.nan), np.full(clusters, np.nan), math.nan, centre_px
        points = mean.copy()
        for axis, direction in axes:
            to_next = unit * (direction if at_m is layout.centres_m else direction.conjugate())
            along, pilot = (to_next, reach_px), (pilot_sums, edges, every)
            _kernels.centre_between_boundaries(
                mean, places, neighbours[axis], along, pilot, points, _ONE_SIDED, wider
            )
        squares, right_px, down_px = _kernels.move_to_sensor(points, at_m, places, corner_px)
        freedom = max(2 * seen - 4, 0)
        variance = (_EXPECTED_WORTH * _SIGMA_PX**2 + squares) / (_EXPECTED_WORTH + freedom)
        return points, variance**0.5 * wider, flank_px, (x + right_px, y + down_px)

    return find_points
