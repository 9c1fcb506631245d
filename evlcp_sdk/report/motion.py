"""A frame in slow motion: the events of each chip, which pixels show which cluster, and what was sent."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.report.colours import cluster_hex
from evlcp_sdk.values import Frame, FrameView, PresenceMap

_MARGIN_PX = 3
_MOST_EVENTS = 4
"""Events of one polarity of a pixel in a chip; more look no brighter."""

_MOST_CELLS = 250_000
"""Chips times pixels of a picture; of a larger one, pixels are put together."""

_UNSEEN = -1


@dataclass(frozen=True, eq=False)
class Motion:
    """A frame with the bar held still, cut to the bar.

    Attributes:
        frame: What was decoded.
        sums: Positive minus negative events of each pixel in each chip, int8 (chips, rows, columns), within
            +-4.
        clusters: Cluster that each pixel shows, -1 for none, int16 (rows, columns).
    """

    frame: Frame
    sums: NDArray[np.int8]
    clusters: NDArray[np.int16]

    @classmethod
    def of(cls, frame: Frame, view: FrameView) -> "Motion":
        """What a view of a frame shows, in bounded size."""
        clusters = cluster_map(view.presence, view.sums.shape[1:])
        rows, columns = np.nonzero(clusters >= 0)
        if len(rows):
            top, left = max(rows.min() - _MARGIN_PX, 0), max(columns.min() - _MARGIN_PX, 0)
            cut = np.s_[top : rows.max() + _MARGIN_PX + 1, left : columns.max() + _MARGIN_PX + 1]
            clusters, sums = clusters[cut], view.sums[:, *cut]
        else:
            sums = view.sums
        step = int(np.ceil(np.sqrt(sums.size / _MOST_CELLS)))
        if step > 1:
            across = [np.arange(0, size, step) for size in clusters.shape]
            sums = np.add.reduceat(np.add.reduceat(sums, across[0], axis=1), across[1], axis=2)
            clusters = clusters[step // 2 :: step, step // 2 :: step]
            sums = sums[:, : clusters.shape[0], : clusters.shape[1]]
        clipped = np.clip(sums, -_MOST_EVENTS, _MOST_EVENTS).astype(np.int8)
        return cls(frame, clipped, clusters.copy())

    def to_dict(self, codebook: Codebook, chip_us: float, ms: Callable[[float], float]) -> dict[str, Any]:
        """The frame as JSON values, for a page's script; `ms` gives the time that is shown of the clock's."""
        chips, height, width = self.sums.shape
        lit = sent_chips(self.frame, codebook)
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
            "events": (self.sums + (ord("a") + _MOST_EVENTS)).astype(np.uint8).tobytes().decode("ascii"),
            "clusters": self.clusters.ravel().tolist(),
            "lit": ["".join("?01"[value + 1] for value in row) for row in lit.tolist()],
            "symbols": [s if s >= 0 else None for s in self.frame.soft.symbols.tolist()],
            "colours": cluster_hex(codebook.clusters),
            "upside": len(seen) > 1 and seen[0][1] > seen[-1][1],
        }


class MotionProbe:
    """Keeps the largest frame that is read of some transmitters; listens to the stages.

    Args:
        most: Transmitters of which frames are kept: the first ones.
    """

    def __init__(self, most: int = 3) -> None:
        self._most = most
        self._view: FrameView | None = None
        self._kept: dict[int, Motion] = {}

    @hookimpl
    def evlcp_stage_finished(self, stage: str, value: Any) -> None:
        """Keep a frame that shows more than those before."""
        if stage == "view":
            self._view = value
        elif stage == "frame":
            view, self._view = self._view, None
            # A frame without a pilot has no view, and shows what its pilot's does.
            if view is not None and view.soft.symbols.shape == value.soft.symbols.shape:
                self._keep(value, view)

    def _keep(self, frame: Frame, view: FrameView) -> None:
        last, quality = self._kept.get(frame.transmitter), frame.soft.quality
        if last is None:
            better = len(self._kept) < self._most
        else:
            before = last.frame.soft.quality
            shown = int(view.presence.selected.any(0).sum()) * view.presence.grid_px**2
            larger = shown > _LARGER * int(np.count_nonzero(last.clusters >= 0))
            better = before < _CLEAR <= quality or (quality >= min(_CLEAR, before) and larger)
        if better:
            self._kept[frame.transmitter] = Motion.of(frame, view)

    def motions(self) -> list[Motion]:
        """What is kept, by transmitter."""
        return [self._kept[number] for number in sorted(self._kept)]


_CLEAR = 0.5
"""Quality of a frame that is shown rather than one below."""

_LARGER = 1.1
"""How much larger an image must be to be shown instead."""


def cluster_map(presence: PresenceMap, size: tuple[int, ...]) -> NDArray[np.int16]:
    """Which cluster each pixel shows, int16 (rows, columns) of this size; -1 for none."""
    selected, grid = presence.selected, presence.grid_px
    strongest = np.where(selected, presence.probability, -1.0).argmax(0).astype(np.int16)
    cells = np.where(selected.any(0), strongest, np.int16(_UNSEEN))
    found = np.full(size, _UNSEEN, np.int16)
    pixels = cells.repeat(grid, 0).repeat(grid, 1)[: size[0], : size[1]]
    found[: pixels.shape[0], : pixels.shape[1]] = pixels
    return found


def sent_chips(frame: Frame, codebook: Codebook) -> NDArray[np.int8]:
    """What each cluster sent in a frame with a pilot, by what was decoded.

    Returns:
        1 for light, 0 for none, -1 where the symbol is not given; int8 (K, chips).
    """
    symbols = frame.soft.symbols
    info = codebook.codewords[np.maximum(symbols, 0)].astype(np.int8)
    info[symbols < 0] = -1
    return np.concatenate([codebook.pilots.astype(np.int8), info], axis=1)
