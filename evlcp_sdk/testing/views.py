"""Ideal images of a frame, as inputs of separation, decoding and ranging."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.values import FrameView, PresenceMap, SoftSymbols

GRID_PX = 2
"""Side of a grid cell of an ideal presence map, px."""

_MARGIN_PX = 10
_LLR = 20.0


def _draw_clusters(
    clusters: int, cluster_px: int, width_px: int, offset_px: tuple[int, int]
) -> NDArray[np.int64]:
    """Return the cluster of each pixel, -1 for none, int64 (height, width), moved right and down."""
    right, down = offset_px
    shape = (clusters * cluster_px + 2 * _MARGIN_PX, width_px + 2 * _MARGIN_PX)
    shown = np.full(shape, -1, np.int64)
    top, left = _MARGIN_PX + down, _MARGIN_PX + right
    rows = np.repeat(np.arange(clusters), cluster_px)
    shown[top : top + len(rows), left : left + width_px] = rows[:, None]
    return shown


def ideal_sums(
    codebook: Codebook,
    symbols: ArrayLike,
    *,
    after: ArrayLike | None = None,
    cluster_px: int = 8,
    width_px: int = 6,
    offset_px: tuple[int, int] = (0, 0),
    events_per_edge: int = 3,
    missing: float = 0.0,
    seed: int = 0,
) -> NDArray[np.int16]:
    """Return the polarity sums of one frame of a vertical bar at rest, int16 (chips, height, width).

    Args:
        codebook: The codes.
        symbols: Symbols of the clusters, top first, (K,).
        after: The chip of each cluster after the frame, (K,), to be included.
        cluster_px: Spacing of the clusters, px.
        width_px: Width of the bar, px.
        offset_px: Offset of the bar from the image's middle, (right, down), px.
        events_per_edge: Events that a pixel sends for each edge.
        missing: Share of the events that are missing.
        seed: Seed of the missing events.
    """
    words = codebook.codewords[np.asarray(symbols, np.int64)]
    chips = np.concatenate([codebook.pilots, words], axis=1)
    if after is not None:
        chips = np.concatenate([chips, np.asarray(after, np.uint8)[:, None]], axis=1)
    edges = np.diff(chips.astype(np.int16), axis=1, prepend=0)
    # Row K is dark, for pixels of no cluster, -1.
    edges = np.concatenate([edges, np.zeros((1, edges.shape[1]), np.int16)])
    shown = _draw_clusters(codebook.clusters, cluster_px, width_px, offset_px)
    edge = np.moveaxis(edges[shown], -1, 0)
    count = np.random.default_rng(seed).binomial(events_per_edge, 1 - missing, edge.shape)
    return (edge * count).astype(np.int16)


def ideal_presence(
    clusters: int, *, cluster_px: int = 8, width_px: int = 6, offset_px: tuple[int, int] = (0, 0)
) -> PresenceMap:
    """Return the presence map of the same image by perfect separation; lengths are multiples of `GRID_PX`."""
    shown = _draw_clusters(clusters, cluster_px, width_px, offset_px)
    pixels = shown == np.arange(clusters)[:, None, None]
    cells = pixels[:, ::GRID_PX, ::GRID_PX]
    return PresenceMap(cells.astype(np.float32), GRID_PX, cells.copy(), pixels.astype(np.float32))


def ideal_frame(
    codebook: Codebook, symbols: ArrayLike, *, after: ArrayLike = -1, missing: float = 0.0, seed: int = 0
) -> tuple[Any, ...]:
    """Return the inputs of a decoding for one ideal frame: `decode(*ideal_frame(book, symbols))`.

    Arguments are as in `ideal_sums`; `after` may be -1, for an unknown chip, and is for other than pair
    codes.

    Returns:
        The presence and the polarity sums; except for pair codes also the chips before the info segment and
        after it, int8 (K,) each.
    """
    presence = ideal_presence(codebook.clusters)
    if codebook.is_pair_coded:
        return presence, ideal_sums(codebook, symbols, missing=missing, seed=seed)
    before = codebook.pilots[:, -1].astype(np.int8)
    following = np.broadcast_to(np.asarray(after, np.int8), codebook.clusters).copy()
    sums = ideal_sums(codebook, symbols, after=np.maximum(following, 0), missing=missing, seed=seed)
    return presence, sums, before, following


def ideal_soft(codebook: Codebook, symbols: ArrayLike) -> SoftSymbols:
    """Return the result of a perfect decoding of the symbols (K,)."""
    s = np.asarray(symbols, np.int64)
    bits = s[:, None] >> np.arange(codebook.bits_per_symbol - 1, -1, -1) & 1
    return SoftSymbols(s, (_LLR * (1 - 2 * bits)).astype(np.float32), 1.0)


def ideal_view(
    codebook: Codebook,
    symbols: ArrayLike,
    *,
    cluster_px: int = 8,
    offset_px: tuple[int, int] = (0, 0),
    missing: float = 0.0,
) -> FrameView:
    """Return the input of ranging for an ideal frame; arguments as in `ideal_sums` and `ideal_presence`."""
    sums = ideal_sums(codebook, symbols, cluster_px=cluster_px, offset_px=offset_px, missing=missing)
    presence = ideal_presence(codebook.clusters, cluster_px=cluster_px, offset_px=offset_px)
    still = np.zeros((2, len(sums)))
    return FrameView(sums, still, presence, ideal_soft(codebook, symbols))
