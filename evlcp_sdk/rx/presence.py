"""Whether the clusters that a frame shows stand where a bar has them."""

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.types import PresenceMap

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
    clusters = len(centres_m)
    area = presence.selected.sum((1, 2))
    seen = area > 0
    rows, columns = presence.selected.shape[1:]
    with np.errstate(invalid="ignore"):
        down = presence.selected.sum(2) @ np.arange(rows) / area
        right = presence.selected.sum(1) @ np.arange(columns) / area
    image = presence.grid_px * (right + 1j * down)
    layout = centres_m[:, 0] + 1j * centres_m[:, 1]
    first = np.flatnonzero(seen[: clusters - clusters // 2] & seen[clusters // 2 :])
    second = first + clusters // 2
    if not len(first):
        return 0
    scale = (image[second] - image[first]) / (layout[second] - layout[first])
    shift = image[first] - scale * layout[first]
    off = np.abs(image[seen] - (scale[:, None] * layout[seen] + shift[:, None]))
    spacing = np.abs(scale) * np.abs(np.diff(layout)).min()
    room = spacing[:, None] / 2 + presence.grid_px / 2
    # A placement that puts neighbours into one pixel would fit anything.
    fits = (off <= room) & (spacing[:, None] >= 1)
    return int(fits.sum(1).max())
