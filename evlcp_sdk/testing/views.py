"""Ideal images of a frame: what separation, decoding and ranging are given."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.values import FrameView, PresenceMap, SoftSymbols

GRID_PX = 2
"""Side of a grid cell of an ideal presence map, px."""

_MARGIN_PX = 10
_CONFIDENT = 20.0


def _clusters(clusters: int, cluster_px: int, width_px: int, offset_px: tuple[int, int]) -> NDArray[np.int64]:
    """Cluster that each pixel shows, -1 for none, int64 (height, width); `offset_px` moves it right, down."""
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
    """Polarity sums of one frame of an upright bar that stands still, int16 (chips, height, width).

    Args:
        codebook: The codes.
        symbols: What the clusters say, top first, (K,).
        after: The chip that each cluster sends after the frame, (K,); the sums then have it, too.
        cluster_px: Spacing of the clusters, px.
        width_px: Width of the bar, px.
        offset_px: Where the bar stands off the image's middle, (right, down), px.
        events_per_edge: Events that a pixel sends for each edge.
        missing: Share of the events that are missing.
        seed: Of the missing events.
    """
    words = codebook.codewords[np.asarray(symbols, np.int64)]
    chips = np.concatenate([codebook.pilots, words], axis=1)
    if after is not None:
        chips = np.concatenate([chips, np.asarray(after, np.uint8)[:, None]], axis=1)
    edges = np.diff(chips.astype(np.int16), axis=1, prepend=0)
    # Row K is dark: what pixels of no cluster, -1, show.
    edges = np.concatenate([edges, np.zeros((1, edges.shape[1]), np.int16)])
    shown = _clusters(codebook.clusters, cluster_px, width_px, offset_px)
    edge = np.moveaxis(edges[shown], -1, 0)
    count = np.random.default_rng(seed).binomial(events_per_edge, 1 - missing, edge.shape)
    return (edge * count).astype(np.int16)


def ideal_presence(
    clusters: int, *, cluster_px: int = 8, width_px: int = 6, offset_px: tuple[int, int] = (0, 0)
) -> PresenceMap:
    """The presence map of the same image, as if by a perfect separation.

    Args:
        clusters: Number of clusters.
        cluster_px: Spacing of the clusters, a multiple of the grid, px.
        width_px: Width of the bar, a multiple of the grid, px.
        offset_px: As for `ideal_sums`, multiples of the grid.
    """
    shown = _clusters(clusters, cluster_px, width_px, offset_px)
    pixels = shown == np.arange(clusters)[:, None, None]
    cells = pixels[:, ::GRID_PX, ::GRID_PX]
    return PresenceMap(cells.astype(np.float32), GRID_PX, cells.copy(), pixels.astype(np.float32))


def ideal_frame(
    codebook: Codebook, symbols: ArrayLike, *, after: ArrayLike = -1, missing: float = 0.0, seed: int = 0
) -> tuple[Any, ...]:
    """What the receiver gives a decoding for one ideal frame: `decode(*ideal_frame(book, symbols))`.

    Args:
        codebook: The codes.
        symbols: What the clusters say, top first, (K,).
        after: The chip that each cluster sends after the frame, (K,) or one for all, -1 where it is not
            known; of codes that are no pair codes only.
        missing: Share of the events that are missing.
        seed: Of the missing events.

    Returns:
        The presence and the polarity sums; of codes that are no pair codes also the chips before the info
        segment and after it, int8 (K,) each.
    """
    presence = ideal_presence(codebook.clusters)
    if codebook.is_pair_coded:
        return presence, ideal_sums(codebook, symbols, missing=missing, seed=seed)
    before = codebook.pilots[:, -1].astype(np.int8)
    behind = np.broadcast_to(np.asarray(after, np.int8), codebook.clusters).copy()
    sums = ideal_sums(codebook, symbols, after=np.maximum(behind, 0), missing=missing, seed=seed)
    return presence, sums, before, behind


def ideal_soft(codebook: Codebook, symbols: ArrayLike) -> SoftSymbols:
    """What a perfect decoding gives for the symbols (K,)."""
    s = np.asarray(symbols, np.int64)
    bits = s[:, None] >> np.arange(codebook.bits_per_symbol - 1, -1, -1) & 1
    return SoftSymbols(s, (_CONFIDENT * (1 - 2 * bits)).astype(np.float32), 1.0)


def ideal_view(
    codebook: Codebook,
    symbols: ArrayLike,
    *,
    cluster_px: int = 8,
    offset_px: tuple[int, int] = (0, 0),
    missing: float = 0.0,
) -> FrameView:
    """All that ranging may use of one ideal frame; arguments as for `ideal_sums` and `ideal_presence`."""
    sums = ideal_sums(codebook, symbols, cluster_px=cluster_px, offset_px=offset_px, missing=missing)
    presence = ideal_presence(codebook.clusters, cluster_px=cluster_px, offset_px=offset_px)
    still = np.zeros((2, len(sums)))
    return FrameView(sums, still, presence, ideal_soft(codebook, symbols))
