"""Aligned frames: the image of a moving bar held still, chip by chip, and its clusters."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.placement import (
    Placement,
    drop_clusters,
    drop_hidden_clusters,
    find_placements,
    layout_of,
    mask_presence,
)
from evlcp_sdk.rx.regions import MARGIN_PX, BarPlace, TrackedRegion
from evlcp_sdk.values import Events, PresenceMap, SyncLock

_MIN_CLUSTER_SHARE = 0.5
"""Least share of the clusters in their place in a frame: fewer may be another bar's."""

_EVEN_TOLERANCE = 0.01
"""Steps from cluster to cluster are a spacing if they are longer by this share at most, of rounding."""


@dataclass(frozen=True, eq=False)
class DueFrame:
    """The next frame of a grid of packets, and when its events are all there.

    Attributes:
        number: Counted from the first frame of the grid's packet 0.
        packet: Number of its packet on the grid.
        index: Its number in the packet.
        chips: Its length, with its pilot if it has one.
        has_pilot: Whether it has one.
        packet_us: Start of its packet's preamble, us.
        start_us: Start of its first chip, us.
        end_us: When the events of its last edge end, us.
        lock: The lock that gives these times.
        read_us: When all events that its decoding needs are there, us.
        middle_us: See `AlignedFrame`.
    """

    number: int
    packet: int
    index: int
    chips: int
    has_pilot: bool
    packet_us: float
    start_us: float
    end_us: float
    lock: SyncLock
    read_us: float
    middle_us: float


class Pilot(NamedTuple):
    """The newest pilot, by which the frames up to the next one are read.

    Attributes:
        frame: Number of its frame on the packet grid.
        size_px: (width, height) of the image, px.
        sums: Its polarity sums, int16 (chips, height, width).
        offset_px: The rest of the motion in it, float64 (2, chips), px.
        presence: Of the clusters; the bar is held still, so that it holds in the frames after it.
        placement: Of the layout.
        others: Other instances in the same image, best first: mirror images, and bars in step with it.
    """

    frame: int
    size_px: tuple[int, int]
    sums: NDArray[np.int16]
    offset_px: NDArray[np.float64]
    presence: PresenceMap
    placement: Placement
    others: tuple[Placement, ...]


class AlignedFrame(NamedTuple):
    """A frame with the bar held still.

    Attributes:
        pilot: The newest pilot, its own if it has one.
        sums_and_trailing: Polarity sums of pilot and info segment, and of the chips after the frame
            (`Codebook.trailing_chips`), int16 (chips, height, width).
        offset_px: The rest of the motion in pilot and info segment, float64 (2, chips), px.
        corner_px: Column and row on the sensor of the image's pixel (0, 0) in the chip that starts at
            `middle_us`.
        middle_us: Middle of the pilot, or of the info segment of a frame without one, where a chip starts: a
            chip's events show the image at its first edge.
    """

    pilot: Pilot
    sums_and_trailing: NDArray[np.int16]
    offset_px: NDArray[np.float64]
    corner_px: tuple[float, float]
    middle_us: float

    @property
    def sums(self) -> NDArray[np.int16]:
        """Polarity sums of pilot and info segment, int16 (chips, height, width)."""
        return self.sums_and_trailing[: self.offset_px.shape[1]]

    @property
    def centre_px(self) -> tuple[float, float]:
        """Column and row on the sensor of the bar's centre at that time, whatever part of it is seen."""
        centre = self.pilot.placement.shift + complex(*self.corner_px)
        return centre.real, centre.imag


class FrameAligner:
    """Aligns one frame after the other; the newest pilot is passed in with each.

    Args:
        link: Whose frames.
        separate: From a pilot's polarity sums to the presence of the clusters.
    """

    def __init__(self, link: Link, separate: Callable[[NDArray[np.int16]], PresenceMap]) -> None:
        self._packet, self._step_us, codebook = link.packet, link.regions.step_us, link.codebook
        # No image is larger, but for the seam.
        self._sensor_px = link.camera.width, link.camera.height
        centres_m = link.bar.cluster_centres_m()
        self._layout = layout_of(centres_m)
        # Clusters in an even grid are one strip, however near it is.
        across_m = np.diff(np.sort(centres_m[:, 0]))
        self._has_columns = bool((across_m > (1 + _EVEN_TOLERANCE) * self._layout.spacing_m).any())
        self._edges = codebook.pilot_edges.astype(np.int64)
        self._every = codebook.edge_spacing_chips
        self._code_chips = slice(1, self._packet.pilot_chips, self._every)
        self._after = codebook.trailing_chips
        self._separate = separate
        self._chip_middles: NDArray[np.float64] = (
            np.arange(self._packet.frame_chips + self._after, dtype=np.float64) + 0.5
        )

    def align(self, region: TrackedRegion, due: DueFrame, pilot: Pilot | None) -> AlignedFrame | None:
        """Hold a frame's image still and find its clusters, by the newest pilot; None if it shows none."""
        lock, packet = due.lock, self._packet
        start_us, chip_us = float(due.start_us), float(lock.chip_us)
        centre_px = region.track.centres_at(self._chip_middles[: due.chips + self._after], start_us, chip_us)
        middle = min(due.chips, packet.pilot_chips) // 2
        seen_us = due.middle_us + chip_us / 2
        if due.has_pilot:
            size = self._image_size(*region.track.size_at(seen_us))
        elif pilot is None or pilot.frame != due.number - due.index % packet.pilot_every:
            return None
        else:
            size = pilot.size_px
        pieces = region.pieces_between(due.start_us, due.read_us, self._step_us)
        sums, offset_px = polarity_sums((e for _, e in pieces), lock, due.start_us, centre_px, size)
        if due.has_pilot:
            pilot_sums, pilot_offset_px = sums[: packet.pilot_chips], offset_px[:, : packet.pilot_chips]
            presence = self._separate(pilot_sums)
            before = pilot.placement if pilot is not None else None
            found = find_placements(presence, self._layout, before, _MIN_CLUSTER_SHARE)
            if not found:
                return None
            presence = mask_presence(presence, self._layout, found[0])
            presence, placement = drop_hidden_clusters(
                pilot_sums, self._edges, self._every, presence, found[0]
            )
            if True not in placement.seen.tolist():
                return None
            pilot = Pilot(
                due.number, size, pilot_sums, pilot_offset_px, presence, placement, tuple(found[1:])
            )
        else:
            assert pilot is not None
            sums = np.concatenate([pilot.sums, sums])
            offset_px = np.concatenate([pilot.offset_px, offset_px], axis=1)
        chips = len(sums) - self._after
        # The image is the pilot's mean over the chips behind edges that tell codes apart: it is where these
        # were sought on average, however much the region's track trembles between chips.
        rests_x, rests_y = pilot.offset_px[:, self._code_chips].tolist()
        count = len(rests_x)
        if due.has_pilot:
            total_x, total_y = np.add.reduce(centre_px[:, self._code_chips], 1).tolist()
            centre_x, centre_y = total_x / count, total_y / count
        else:
            centre_x, centre_y = centre_px[:, middle].tolist()
        corner_px = (
            centre_x - (size[0] - 1) / 2 - sum(rests_x) / count,
            centre_y - (size[1] - 1) / 2 - sum(rests_y) / count,
        )
        return AlignedFrame(pilot, sums, offset_px[:, :chips], corner_px, due.middle_us)

    def locate_bar(self, aligned: AlignedFrame) -> BarPlace:
        """Where a frame with a pilot shows its bar; other instances of it are taken to be as wide."""
        pilot, corner_px = aligned.pilot, aligned.corner_px
        places, right_px, down_px = self._cluster_extents(aligned, pilot.placement)
        lit_px = strips_px = None
        if pilot.placement.scale != 0:
            lit_px = _visible_rows(places.imag, pilot.placement.seen, down_px)
            strips_px = _light_strips(places.real, right_px) if self._has_columns else None
        others = (self._cluster_extents(aligned, other) for other in pilot.others)
        boxes = tuple(_bound_bar(corner_px, *other) for other in others)
        box = _bound_bar(corner_px, places, right_px, down_px)
        return BarPlace(aligned.middle_us, *box, lit_px, strips_px, boxes)

    def drop_cut_clusters(self, aligned: AlignedFrame) -> PresenceMap:
        """Presence in a frame without the clusters that the edge of the sensor cuts.

        They would be measured by what is left of them, nearer to the others than they are: those whose middle
        is nearer to the edge than half a spacing. A line of clusters stays as it is.
        """
        presence, placement = aligned.pilot.presence, aligned.pilot.placement
        if self._layout.is_line or placement.scale == 0:
            return presence
        places, right_px, down_px = self._cluster_extents(aligned, placement)
        x, y = places.real + aligned.corner_px[0], places.imag + aligned.corner_px[1]
        width, height = self._sensor_px
        cut = (x < right_px) | (x > width - 1 - right_px) | (y < down_px) | (y > height - 1 - down_px)
        return drop_clusters(presence, cut) if cut.any() else presence

    def _cluster_extents(
        self, aligned: AlignedFrame, placement: Placement
    ) -> tuple[NDArray[np.complex128], float, float]:
        """Where an instance's clusters are in the image, and how far each reaches right and down, px."""
        selected, grid = aligned.pilot.presence.selected, aligned.pilot.presence.grid_px
        own, layout = aligned.pilot.placement, self._layout
        if own.scale == 0:
            row, column = np.nonzero(selected.any(0))
            places = (column + 1j * row) * grid + (grid - 1) / 2 * (1 + 1j)
            right_px = down_px = grid / 2
        else:
            along_px = across_px = abs(own.scale) * layout.spacing_m / 2
            direction = placement.scale / abs(placement.scale)
            if layout.is_line:
                # The layout has no width of a line: that of its cells counts.
                turn = own.scale / abs(own.scale) * layout.direction
                across_px = _kernels.farthest_offset_px(selected, grid, own.shift, turn) + grid / 2
                direction *= layout.direction
            places = placement.centres_px
            right_px = along_px * abs(direction.real) + across_px * abs(direction.imag)
            down_px = along_px * abs(direction.imag) + across_px * abs(direction.real)
        return places, right_px, down_px

    def _image_size(self, width_px: float, height_px: float) -> tuple[int, int]:
        seam_px = 2 * MARGIN_PX
        width_px, height_px = min(width_px, self._sensor_px[0]), min(height_px, self._sensor_px[1])
        # Twice an odd number: a bar of one or two columns stands in the middle of a cell of 2 px, not on the
        # edge of two, each of which would see half of it.
        return 2 * (2 * math.ceil((width_px + seam_px - 2) / 4) + 1), 2 * math.ceil((height_px + seam_px) / 2)


def _bound_bar(
    corner_px: tuple[float, float], places: NDArray[np.complex128], right_px: float, down_px: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Centre (column, row) and (width, height) of a whole bar on the sensor, hidden parts too, px."""
    columns, rows = places.real.tolist(), places.imag.tolist()
    left, right = min(columns) - right_px, max(columns) + right_px
    top, bottom = min(rows) - down_px, max(rows) + down_px
    x, y = corner_px
    return (x + (left + right) / 2, y + (top + bottom) / 2), (right - left, bottom - top)


def _visible_rows(
    rows: NDArray[np.float64], seen: NDArray[np.bool_], down_px: float
) -> tuple[float, float] | None:
    """Upper and lower edge of the clusters that are seen, from the whole bar's centre, px.

    None where both ends are.
    """
    if False not in seen.tolist():
        return None
    shown = rows[seen].tolist()
    top, bottom, first, last = float(rows.min()), float(rows.max()), min(shown), max(shown)
    centre = (top + bottom) / 2
    if first <= top and last >= bottom:
        return None
    return first - down_px - centre, last + down_px - centre


def _light_strips(columns: NDArray[np.float64], right_px: float) -> NDArray[np.float64] | None:
    """Columns of a bar's light: (middle from the bar's centre, half of the width), px, float64 (n, 2).

    None for one strip, or without a dark one between two that is wider than a bar may move in a step.
    """
    across = np.sort(columns)
    ends = np.flatnonzero(np.diff(across) > 2 * (right_px + MARGIN_PX))
    if not len(ends):
        return None
    first, last = across[[0, *(ends + 1)]], across[[*ends, len(across) - 1]]
    centre = (across[0] + across[-1]) / 2
    return np.stack([(first + last) / 2 - centre, (last - first) / 2 + right_px], 1)


def polarity_sums(
    events: Iterable[Events],
    lock: SyncLock,
    start_us: float,
    centre_px: NDArray[np.float64],
    size_px: tuple[int, int],
) -> tuple[NDArray[np.int16], NDArray[np.float64]]:
    """Sum polarities (+1, -1) by chip and pixel, with the bar held still to within half a pixel.

    `events` are pieces of the stream that hold the chips, the first of which begins at `start_us`, with the
    chip length and delays of `lock`; `centre_px` is column and row of the bar's centre in each, float64 (2,
    chips); `size_px` is (width, height) of the image.

    Returns:
        The sums, int16 (chips, height, width); and the rest of the motion, (right, down) of the bar's centre
        from the middle of the image in each chip, float64 (2, chips), px.
    """
    width, height = size_px
    chips = centre_px.shape[1]
    # Delays by row are relative to the bar's row.
    row_px = sum(centre_px[1].tolist()) / chips
    sums, offset_px = np.zeros((chips, height, width), np.int16), np.zeros((2, chips))
    # A synchronization may give any kind of number.
    on_us, off_us = float(start_us + lock.delay_on_us), float(start_us + lock.delay_off_us)
    chip_us, row_us = float(lock.chip_us), float(lock.row_us)
    for e in events:
        columns = e.t_us, e.x, e.y, e.p
        _kernels.add_polarities(
            columns, (on_us, off_us), chip_us, (row_us, row_px), centre_px, offset_px, sums
        )
    return sums, offset_px
