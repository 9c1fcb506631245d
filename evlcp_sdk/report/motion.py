"""A frame in slow motion: the events of each chip, the cluster of each pixel, and the sent chips."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.report.colours import cluster_hex
from evlcp_sdk.values import Frame, FrameView, PresenceMap

_MARGIN_PX = 3
_MAX_EVENTS = 4
"""Events of one polarity of a pixel in a chip; more look no brighter."""

_MAX_CELLS = 250_000
"""Chips times pixels of a picture; in a larger one, pixels are binned."""

_NO_CLUSTER = -1

_CLEAR = 0.5
"""Quality of a frame that is preferred to one below."""

_LARGER_RATIO = 1.1
"""Ratio of sizes from which a larger image is preferred."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A frame with the bar held still, cropped to the bar.

    Attributes:
        frame: The decoded frame.
        sums: Positive minus negative events of each pixel in each chip, int8 (chips, rows, columns), within
            +-4.
        clusters: Cluster that each pixel shows, -1 for none, int16 (rows, columns).
    """

    frame: Frame
    sums: NDArray[np.int8]
    clusters: NDArray[np.int16]

    @classmethod
    def of(cls, frame: Frame, view: FrameView) -> "Motion":
        """Crop the view of a frame to a bounded size."""
        clusters = cluster_map(view.presence, view.sums.shape[1:])
        rows, columns = np.nonzero(clusters >= 0)
        if len(rows):
            top, left = max(rows.min() - _MARGIN_PX, 0), max(columns.min() - _MARGIN_PX, 0)
            crop = np.s_[top : rows.max() + _MARGIN_PX + 1, left : columns.max() + _MARGIN_PX + 1]
            clusters, sums = clusters[crop], view.sums[:, *crop]
        else:
            sums = view.sums
        step = int(np.ceil(np.sqrt(sums.size / _MAX_CELLS)))
        if step > 1:
            edges = [np.arange(0, size, step) for size in clusters.shape]
            sums = np.add.reduceat(np.add.reduceat(sums, edges[0], axis=1), edges[1], axis=2)
            clusters = clusters[step // 2 :: step, step // 2 :: step]
            sums = sums[:, : clusters.shape[0], : clusters.shape[1]]
        clipped = np.clip(sums, -_MAX_EVENTS, _MAX_EVENTS).astype(np.int8)
        return cls(frame, clipped, clusters.copy())

    def shows_less_than(self, frame: Frame, view: FrameView) -> bool:
        """Whether another frame of the transmitter is clearer, or as clear and larger in the image."""
        own_quality, quality = self.frame.soft.quality, frame.soft.quality
        area = int(view.presence.selected.any(0).sum()) * view.presence.grid_px**2
        is_larger = area > _LARGER_RATIO * int(np.count_nonzero(self.clusters >= 0))
        return own_quality < _CLEAR <= quality or (quality >= min(_CLEAR, own_quality) and is_larger)

    def to_dict(self, codebook: Codebook, chip_us: float, ms: Callable[[float], float]) -> dict[str, Any]:
        """The frame as JSON values for a page's script; `ms` converts camera time to the time shown."""
        chips, height, width = self.sums.shape
        lit = decode_chips(self.frame, codebook)
        rows = [np.nonzero(self.clusters == k)[0] for k in range(len(lit))]
        seen = [(k, float(r.mean())) for k, r in enumerate(rows) if len(r)]
        return {
            "chips": chips,
            "pilot": codebook.pilots.shape[1],
            "width": width,
            "height": height,
            "chip_ms": chip_us * 1e-3,
            "start_ms": ms(self.frame.t_us),
            "name": f"transmitter {self.frame.transmitter}, packet {self.frame.packet},"
            f" frame {self.frame.frame}",
            # A letter a pixel: e is none, f to i are positive events, d to a negative ones.
            "events": (self.sums + (ord("a") + _MAX_EVENTS)).astype(np.uint8).tobytes().decode("ascii"),
            "clusters": self.clusters.ravel().tolist(),
            "lit": ["".join("?01"[value + 1] for value in row) for row in lit.tolist()],
            "symbols": [s if s >= 0 else None for s in self.frame.soft.symbols.tolist()],
            "colours": cluster_hex(codebook.clusters),
            "upside": len(seen) > 1 and seen[0][1] > seen[-1][1],
        }


def cluster_map(presence: PresenceMap, size: tuple[int, ...]) -> NDArray[np.int16]:
    """Cluster that each pixel shows, int16 (rows, columns) of this size; -1 for none."""
    selected, grid = presence.selected, presence.grid_px
    strongest = np.where(selected, presence.probability, -1.0).argmax(0).astype(np.int16)
    cells = np.where(selected.any(0), strongest, np.int16(_NO_CLUSTER))
    clusters = np.full(size, _NO_CLUSTER, np.int16)
    pixels = cells.repeat(grid, 0).repeat(grid, 1)[: size[0], : size[1]]
    clusters[: pixels.shape[0], : pixels.shape[1]] = pixels
    return clusters


def decode_chips(frame: Frame, codebook: Codebook) -> NDArray[np.int8]:
    """Chips that each cluster sent in a frame with a pilot, by the decoded symbols.

    Returns:
        1 for light, 0 for none, -1 where the symbol is not given; int8 (K, chips).
    """
    symbols = frame.soft.symbols
    info = codebook.codewords[np.maximum(symbols, 0)].astype(np.int8)
    info[symbols < 0] = -1
    return np.concatenate([codebook.pilots.astype(np.int8), info], axis=1)
