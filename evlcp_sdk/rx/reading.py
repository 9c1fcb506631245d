"""What a frame says: its symbols, its distance, its points. Nothing of it moves regions."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import edges_of_chips
from evlcp_sdk.air.frames import chips_behind
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.rx.alignment import AlignedFrame, DueFrame, FrameAligner
from evlcp_sdk.rx.llr_calibration import calibrate_llr, still_lit
from evlcp_sdk.rx.placement import layout_of
from evlcp_sdk.rx.points import points_finder
from evlcp_sdk.rx.spread import Spread, neighbours
from evlcp_sdk.rx.steps import Steps
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.lean import BarSight, magnification_of, sight_of
from evlcp_sdk.values import FrameView, Range, SoftSymbols

_NO_RANGE = Range(math.nan, math.nan, 0)
_NO_POINTS = np.empty((0, 2)), np.empty(0), math.nan


@dataclass(frozen=True, eq=False)
class Reading:
    """What a frame says.

    Attributes:
        symbols: As the decoding read them, int64 (K,).
        soft: What can be believed.
        distance: As the ranging gave it; its values are NaN where none was asked for.
        points_px: Column and row of each cluster's centre on the sensor, px, float64 (K, 2), NaN where
            unseen; empty of a frame without a pilot, as the sigmas are.
        sigma_px: Their standard deviations, px, float64 (K,).
        flank_px: See `Frame.points_flank_px`.
        centre_px: Column and row of the bar's centre on the sensor, px.
        sight: Where its bar is seen, and what the attitude says of its lean; the default one of a panel,
            which has no direction.
        spread: Measures how light spreads in it; None of a frame without a pilot.
    """

    symbols: NDArray[np.int64]
    soft: SoftSymbols
    distance: Range
    points_px: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    flank_px: float
    centre_px: tuple[float, float]
    sight: BarSight
    spread: Callable[[], Spread] | None


class FrameReader:
    """Reads one frame after the other; it keeps no state of a stream.

    Args:
        link: The resolved configuration.
        steps: Its algorithms.
        aligner: What the frames were aligned by.
    """

    def __init__(self, link: Link, steps: Steps, aligner: FrameAligner) -> None:
        centres_m, book = link.bar.cluster_centres_m(), link.codebook
        self._camera = link.camera
        self._is_column = float(np.ptp(centres_m[:, 0])) < 1e-9
        self._pilot_chips = link.packet.pilot_chips
        self._least_activity = book.least_activity
        self._steps, self._aligner = steps, aligner
        self._layout = layout_of(centres_m)
        self._pairs = neighbours(self._layout)
        self._pilots, self._every = book.pilots.astype(np.int64), book.edge_every
        edges = edges_of_chips(book.pilots).astype(np.int64)
        self._find_points = points_finder(self._layout, edges, book.edge_every)
        self._behind = [chips_behind(book, link.packet, n) for n in range(link.packet.frames)]
        for chips in self._behind:
            chips.setflags(write=False)

    def read(
        self,
        aligned: AlignedFrame,
        due: DueFrame,
        before: NDArray[np.int8],
        attitude: Attitude | None,
        *,
        ranged: bool,
    ) -> Reading:
        """What a frame that shows its clusters says; one without a pilot has no distance and no points.

        Args:
            aligned: What it shows.
            due: Which frame it is.
            before: The chip that each cluster sent before its info segment, int8 (K,); -1 if not known.
            attitude: The camera's, as far as it is known.
            ranged: Its distance is asked for.

        Raises:
            PluginError: The decoding or the ranging fails, or gives what it may not.
        """
        sums, presence, placement = aligned.sums, aligned.pilot.presence, aligned.pilot.placement
        soft = self._steps.decode(presence, aligned.sums_and_next, before, self._behind[due.index])
        lit = still_lit(sums, presence, self._pilot_chips, self._least_activity)
        given = calibrate_llr(soft, placement.seen & lit)
        if not due.has_pilot:
            # Another distance of the same pilot, or other points, would say nothing new.
            return Reading(
                soft.symbols, given, _NO_RANGE, *_NO_POINTS, aligned.centre_px, BarSight(), spread=None
            )
        distance = _NO_RANGE
        if ranged:
            whole = self._aligner.whole(aligned)
            distance = self._steps.measure(FrameView(sums, aligned.offset_px, whole, soft))
        heard = sums[: self._pilot_chips]
        points_px, sigma_px, flank_px = self._find_points(presence, placement, heard)
        points_px = points_px + aligned.corner_px
        centre_px = self._aligner.centre(aligned, points_px)
        sight = BarSight()
        if self._is_column:
            sight = sight_of(self._camera, points_px, sigma_px, attitude)
        elif not self._camera.is_pinhole:
            sight = BarSight(magnification=magnification_of(self._camera, points_px))
        # Only of two images at one time it is asked; the pilot alone is kept for that, not the whole frame.
        how = heard.copy(), self._pilots, self._every, self._layout, self._pairs, placement
        spread = cache(partial(Spread.of, *how))
        return Reading(soft.symbols, given, distance, points_px, sigma_px, flank_px, centre_px, sight, spread)
