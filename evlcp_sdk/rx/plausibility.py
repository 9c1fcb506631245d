"""Whether the clusters that a frame shows stand where a bar has them."""

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.values import PresenceMap

__all__ = ["clusters_in_place"]


def clusters_in_place(presence: PresenceMap, centres_m: NDArray[np.float64]) -> int:
    """Count the clusters that one shift, turn and scale of the layout brings to where the image shows them.

    Sixteen pilots of eight values are half of what chance can say, so that a frame read at a wrong time shows
    clusters, too; but not in their order. Each pair of clusters half the layout apart proposes a
    placement of the layout; the one that fits most clusters to within half a spacing counts.

    Args:
        presence: Of one frame.
        centres_m: Cluster centres of the layout, m, float64 (K, 2).
    """
    from evlcp_sdk.rx import _kernels

    image = np.empty((len(centres_m), 2))
    area = np.empty(len(centres_m), np.int64)
    _kernels.cell_centres(presence.selected, image, area)
    # A placement that puts neighbours into one pixel would fit anything.
    return int(_kernels.most_in_place(image, area, centres_m, 1 / presence.grid_px))
