"""Decodes one frame at a time by the link's algorithms, and calibrates how sure its symbols are."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import edges_of_chips
from evlcp_sdk.air.frames import chips_after_frame
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import Tracker
from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.alignment import AlignedFrame, DueFrame, FrameAligner, Pilot
from evlcp_sdk.rx.framer import Announcer
from evlcp_sdk.rx.guard import Guard, compile_algorithm, compile_tracker
from evlcp_sdk.rx.placement import layout_of
from evlcp_sdk.rx.points import compile_finder
from evlcp_sdk.rx.ranges import RangeCorrector, RangeState
from evlcp_sdk.rx.regions import MARGIN_PX, BarPlace, TrackedRegion
from evlcp_sdk.rx.spread import LazySpread, Spread, neighbour_pairs
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.tilt import LineOfSight, line_of_sight, magnification_of
from evlcp_sdk.values import NO_RANGE, FrameView, PresenceMap, Range, SoftSymbols

_FRAME_WORTH = 6.0
"""LLRs of a cluster that those of all its frame are worth: light and vibration are much the same for all,
while some have a panel or leaves behind them."""

_EXPECTED_SPREAD, _EXPECTED_WORTH = 0.4, 6.0
"""Standard deviation of the sizes of LLRs, in their mean, before any is known, and its worth in LLRs."""

_MIN_PROBABILITY = 0.6
"""Probability of being right against its nearest rival below which a symbol is not given: it has other
rivals, too, and of less sure symbols half or more are wrong in recordings."""

_ERRORS_TOGETHER = 1.7
"""Wrong symbols in a frame that has any: what makes one wrong, light, vibration, background, affects others,
too. In `examples/campaigns/road.toml` they are 1.9 to 2.2 by decoding, as `benchmarks/quality.py` prints; on
a Gaussian channel 1 to 1.3, as long as less than half of the frames are wrong."""

_MIN_EVENT_SHARE = 0.5
"""Share of the expected events, by the codeword with the fewest edges, that chance may take."""

_FLOODED_SHARE, _FLOODED_RATIO, _DIMMED_SHARE = 0.2, 1.25, 0.45
"""A frame is flooded, its light changes everywhere and nothing that the pilot showed holds, if in pixels
without a cluster info events exceed the pilot's by more than this share of a cluster's while half of the info
segment has so many times the pilot's events or more; or if half of it has less than that share of the
pilot's. What moves, shines or blinks beside a bar makes 0.14 and 0.65 at most in recordings, steps of light
0.28 and 0.38; a bar that leaves its place has no more events than before. In pair codes every symbol has half
of the pilot's edges; in others some have none for long."""

_SURE_QUALITY = 0.98
"""Quality of a frame from which on its symbols hold, however the light changes: where they are wrong, it is
less. A halo and a jolt look like a step of light now and then."""

_NO_LINE_OF_SIGHT = LineOfSight()

_NO_POINTS = np.empty((0, 2)), np.empty(0), math.nan


class FrameAlgorithms:
    """The algorithms that decode a frame, checked and announced; it keeps no state of a stream."""

    def __init__(self, link: Link, announcer: Announcer, tracker: Tracker) -> None:
        self._codebook = book = link.codebook
        self._corrector = RangeCorrector()
        self._announcer = announcer
        self._guards = {role: Guard(link, role) for role in ("separation", "decoding", "ranging")}
        self._separate = compile_algorithm(link, "separation", book)
        self._decode: Callable[..., SoftSymbols] = compile_algorithm(link, "decoding", book)
        self._measure = compile_algorithm(link, "ranging", link.camera, link.bar, book)
        self._distance = tracker.distance

    def init_distance(self) -> tuple[RangeState, Any]:
        """State of a transmitter's distance before its first frame."""
        return RangeState(), None if self._distance is None else self._distance.init()

    def separate(self, sums: NDArray[np.int16]) -> PresenceMap:
        """Find the clusters in a pilot's polarity sums, int16 (chips, height, width)."""
        guard = self._guards["separation"]
        with guard:
            presence: PresenceMap = self._separate(sums)
        if guard.checks:
            guard.expect_presence(presence, self._codebook.clusters, *sums.shape[1:])
        self._announcer.announce("separation", presence)
        return presence

    def decode(
        self,
        presence: PresenceMap,
        sums: NDArray[np.int16],
        before: NDArray[np.int8],
        after: NDArray[np.int8],
    ) -> SoftSymbols:
        """Decode the clusters' symbols from polarity sums of pilot and info, int16 (chips, height, width).

        For codes that are no pair codes the chips sent before and after the info segment matter, and the sums
        have the chip after it.
        """
        guard = self._guards["decoding"]
        more = () if self._codebook.is_pair_coded else (before, after)
        with guard:
            soft = self._decode(presence, sums, *more)
        if guard.checks:
            guard.expect_symbols(soft, self._codebook)
        self._announcer.announce("decoding", soft)
        return soft

    def measure(self, view: FrameView) -> Range:
        """Measure the distance of the bar."""
        guard = self._guards["ranging"]
        self._announcer.announce("view", view)
        with guard:
            distance: Range = self._measure(view)
        if guard.checks:
            guard.expect_range(distance)
        self._announcer.announce("ranging", distance)
        return distance

    def track_distance(
        self,
        state: tuple[RangeState, Any],
        t_us: float,
        chip_us: float,
        measured: Range,
        line_of_sight: LineOfSight,
    ) -> tuple[tuple[RangeState, Any], Range, Range | None]:
        """Correct and filter a frame's distance; return the new state, the distance, and the filtered one.

        The filtered distance is the prediction where a frame allows none, and None without tracking.
        """
        ranges, distance = self._corrector.step(state[0], t_us, chip_us, measured, line_of_sight)
        filter_state, filtered = self._filter_distance(state[1], t_us, distance)
        return (ranges, filter_state), distance, filtered

    def _filter_distance(self, state: Any, t_us: float, measured: Range) -> tuple[Any, Range | None]:
        if self._distance is None:
            return state, None
        if not (math.isfinite(measured.distance_m) and math.isfinite(measured.sigma_m)):
            expected = self._distance.predict(state, t_us)
            return state, None if expected is None else Range(float(expected[0][0]), expected[1], 0)
        value, standing_m = np.array([measured.distance_m]), measured.standing_m
        # What stays over frames cannot be filtered out.
        new_m = math.sqrt(max(measured.sigma_m**2 - standing_m**2, 0.0))
        state, value, sigma = self._distance.step(state, t_us, value, new_m)
        return state, Range(float(value[0]), math.hypot(sigma, standing_m), measured.pairs)


class BarState(NamedTuple):
    """What the frames of a bar leave for the next one.

    Attributes:
        pilot: The newest pilot; None where it showed no bar, and before the first.
        frame: Number of the newest decoded frame on the packet grid; -1 before the first.
        symbols: Its symbols, int64 (K,).
        distance: State of its distance, see `FrameAlgorithms.track_distance`.
    """

    pilot: Pilot | None
    frame: int
    symbols: NDArray[np.int64]
    distance: tuple[RangeState, Any]


class FrameResult(NamedTuple):
    """What was decoded and measured in a frame.

    Attributes:
        soft: Its symbols, calibrated, see `calibrate_llr`.
        distance: As corrected by those before; its values are NaN where none was asked for.
        filtered: The filtered distance; None without tracking.
        points_px: Column and row of each cluster's centre on the sensor, px, float64 (K, 2), NaN where
            unseen; empty without a pilot, as the sigmas are.
        sigma_px: Their standard deviations, px, float64 (K,).
        flank_px: See `Frame.points_flank_px`.
        centre_px: Column and row of the bar's centre on the sensor, px.
        askew: See `LineOfSight`.
        flooded: Light changes everywhere in it, so that no symbol is given.
        cells: Grid cells that show a cluster, on average.
        seen: Clusters that are seen.
        mirrored: The order of the clusters is the opposite of the layout's.
        spread: Measures how light spreads in it; None without a pilot.
        is_readable: It has a symbol, or, of a known transmitter, a distance.
        shown: Where it showed the bar, if it was decoded by itself; None without a pilot.
    """

    soft: SoftSymbols
    distance: Range
    filtered: Range | None
    points_px: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    flank_px: float
    centre_px: tuple[float, float]
    askew: bool
    flooded: bool
    cells: float
    seen: int
    mirrored: bool
    spread: Callable[[], Spread] | None
    is_readable: bool
    shown: BarPlace | None = None


class FrameJob(NamedTuple):
    """A frame to decode, with what is not in its bar's state.

    Attributes:
        region: Where the bar is, with the events of the frame.
        due: Which frame.
        attitude: The camera's attitude in its pilot, as far as it is known.
        ranged: Its distance is measured.
    """

    region: TrackedRegion
    due: DueFrame
    attitude: Attitude | None
    ranged: bool


class FrameDecoder:
    """Aligns and reads one frame after the other; it keeps no state of a stream.

    Attributes:
        aligner: Aligns frames.
        algorithms: Those of the link.
    """

    def __init__(self, link: Link, announcer: Announcer | None = None) -> None:
        centres_m, book = link.bar.cluster_centres_m(), link.codebook
        self.algorithms = FrameAlgorithms(link, announcer or Announcer(), compile_tracker(link))
        self.aligner = FrameAligner(link, self.algorithms.separate)
        self._camera, self._codebook = link.camera, book
        self._is_column = float(np.ptp(centres_m[:, 0])) < 1e-9
        self._pilot_chips = link.packet.pilot_chips
        self._least_lit = _MIN_EVENT_SHARE * book.least_edge_ratio
        self._least_half = _DIMMED_SHARE if book.is_pair_coded else 0.0
        self._layout = layout_of(centres_m)
        self._pairs = neighbour_pairs(self._layout)
        self._pilots, self._every = book.pilots.astype(np.int64), book.edge_spacing_chips
        edges = edges_of_chips(book.pilots).astype(np.int64)
        self._find_points = compile_finder(self._layout, edges, book.edge_spacing_chips)
        self._behind = [chips_after_frame(book, link.packet, n) for n in range(link.packet.frames)]
        self._unknown = np.full(book.clusters, -1, np.int8)
        for chips in (*self._behind, self._unknown):
            chips.setflags(write=False)

    def init_state(self) -> BarState:
        """State before a transmitter's first frame."""
        return BarState(None, -1, np.empty(0, np.int64), self.algorithms.init_distance())

    def decode(self, job: FrameJob, state: BarState) -> tuple[FrameResult, BarState] | None:
        """Decode a frame of a known bar, see `read`; None if the region's events are not enough.

        Such a frame shows no bar, or not where the region has it, or no symbol: it is to be decoded again
        with what surrounds the region.
        """
        region, due = job.region, job.due
        aligned = self.aligner.align(region, due, state.pilot)
        if aligned is None:
            return None
        shown = self.aligner.locate_bar(aligned) if due.has_pilot else None
        # Within half of the seam no events are missing.
        if shown is not None and region.deviation_px(shown) > MARGIN_PX / 2:
            return None
        found, state = self.read(aligned, job, state)
        return (found._replace(shown=shown), state) if found.is_readable else None

    def read(
        self, aligned: AlignedFrame, job: FrameJob, state: BarState, *, known: bool = True
    ) -> tuple[FrameResult, BarState]:
        """Read an aligned frame, of a known transmitter or not; return it with the state for the next.

        One without a pilot has no distance and no points.
        """
        due, pilot, sums = job.due, aligned.pilot, aligned.sums
        presence, placement = pilot.presence, pilot.placement
        soft = self.algorithms.decode(
            presence, aligned.sums_and_trailing, self._last_chips(state, due), self._behind[due.index]
        )
        calibrated, flooded = self._calibrate(soft, sums, pilot)
        distance, line, spread = NO_RANGE, _NO_LINE_OF_SIGHT, None
        image = *_NO_POINTS, aligned.centre_px
        # Another distance or other points by the same pilot would be nothing new.
        if due.has_pilot:
            if job.ranged:
                whole = self.aligner.drop_cut_clusters(aligned)
                distance = self.algorithms.measure(FrameView(sums, aligned.offset_px, whole, soft))
            pilot_sums = sums[: self._pilot_chips]
            image = self._find_points(presence, placement, pilot_sums, aligned.corner_px)
            # It is needed for two images at one time only; so the pilot alone is kept, not the whole frame.
            spread = LazySpread(
                pilot_sums.copy(), self._pilots, self._every, self._layout, self._pairs, placement
            )
            line = self._line_of_sight(*image[:2], job.attitude)
        is_readable = max(calibrated.symbols.tolist()) >= 0
        # The distance alone is of use only if the transmitter is known.
        is_readable |= known and math.isfinite(distance.distance_m)
        tracked, filtered = state.distance, None
        if is_readable:
            tracked, distance, filtered = self.algorithms.track_distance(
                tracked, due.start_us, due.lock.chip_us, distance, line
            )
        seen = max(sum(placement.seen.tolist()), 1)
        light = placement.cells / seen, seen, placement.mirrored
        found = FrameResult(
            calibrated, distance, filtered, *image, line.askew, flooded, *light, spread, is_readable
        )
        return found, BarState(pilot, due.number, soft.symbols, tracked)

    def _calibrate(
        self, soft: SoftSymbols, sums: NDArray[np.int16], pilot: Pilot
    ) -> tuple[SoftSymbols, bool]:
        """Calibrate a frame's symbols by its polarity sums; whether light changes everywhere in it."""
        presence, seen = pilot.presence, pilot.placement.seen
        lit, images = np.empty_like(seen), (sums, presence.probability, presence.grid_px)
        # In a gap of the stream, or behind a passing pole, silence is no symbol.
        outside, darkest, brightest = _kernels.find_lit_clusters(
            *images, self._pilot_chips, self._least_lit, seen, lit
        )
        calibrated = calibrate_llr(soft, lit)
        brightens = outside > _FLOODED_SHARE and brightest > _FLOODED_RATIO
        changes = brightens or darkest < self._least_half
        if flooded := changes and calibrated.quality < _SURE_QUALITY:
            calibrated = calibrate_llr(soft, np.zeros_like(lit))
        return calibrated, flooded

    def _line_of_sight(
        self, points_px: NDArray[np.float64], sigma_px: NDArray[np.float64], attitude: Attitude | None
    ) -> LineOfSight:
        if self._is_column:
            return line_of_sight(self._camera, points_px, sigma_px, attitude)
        if self._camera.is_pinhole:
            return _NO_LINE_OF_SIGHT
        return LineOfSight(magnification=magnification_of(self._camera, points_px))

    def _last_chips(self, state: BarState, due: DueFrame) -> NDArray[np.int8]:
        """The chip that each cluster sent before a frame's info segment, int8 (K,); -1 if not known.

        It does not matter to pair codes, and is not known there.
        """
        book = self._codebook
        if book.is_pair_coded:
            return self._unknown
        if due.has_pilot:
            return book.pilots[:, -1].astype(np.int8)
        if state.frame != due.number - 1 or due.index == 0:
            return self._unknown
        symbols = state.symbols
        return np.where(symbols >= 0, book.codewords[symbols, -1].astype(np.int8), np.int8(-1))


class BarDecoder:
    """Decodes the frames of bars, each by what its bar's earlier frames left; bars go by numbers.

    After a frame that it cannot decode, none of the bar's is decoded until its state is put here again.

    Attributes:
        is_immediate: Results are known when frames are submitted, as in this process.
    """

    is_immediate = True

    def __init__(self, decoder: FrameDecoder) -> None:
        self._decoder = decoder
        self._states: dict[int, BarState] = {}
        self._stopped: set[int] = set()

    def __len__(self) -> int:
        """How many bars it decodes."""
        return len(self._states)

    def put_state(self, bar: int, state: BarState) -> None:
        """Decode a bar's frames here from now on."""
        self._states[bar] = state
        self._stopped.discard(bar)

    def take_state(self, bar: int) -> BarState:
        """Give a bar's state back: its frames are decoded elsewhere."""
        return self._states.pop(bar)

    def decode(self, bar: int, job: FrameJob) -> Callable[[], FrameResult | None]:
        """Decode a bar's next frame, see `FrameDecoder.decode`; return what fetches the result."""
        found = None if bar in self._stopped else self._decoder.decode(job, self._states[bar])
        if found is None:
            self._stopped.add(bar)
            return lambda: None
        result, self._states[bar] = found
        return lambda: result


def calibrate_llr(soft: SoftSymbols, seen: NDArray[np.bool_]) -> SoftSymbols:
    """Calibrate the LLRs of a decoded frame, and keep the symbols that are sure.

    Decoders are surer than they are right, or less, each in its own way: pixels share light and motion. The
    variance of true log-likelihood ratios is twice their mean, whatever the channel, if it is near Gaussian:
    those of a cluster are scaled so, by their own scatter, that of the frame, and an expected one. The
    weights of these lie between what fits 20 000 symbols of `motion-feedback` in recordings and in the harder
    scenes of `examples/campaigns/road.toml`, and what fits a Gaussian channel; both are met within a factor
    of 2 where less than half of the frames are wrong. The nearest rival of a symbol, at its least LLR, gives
    the probability that the symbol is right; those that are rather wrong are not given, nor are those of
    clusters that are not `seen`, bool (K,), whose LLRs are 0. `quality` is the probability that all given
    ones are right, as errors come together.
    """
    symbols, llr = np.empty_like(soft.symbols), np.empty_like(soft.llr)
    expected, sure = (_FRAME_WORTH, _EXPECTED_WORTH, _EXPECTED_SPREAD), (_MIN_PROBABILITY, _ERRORS_TOGETHER)
    quality = _kernels.calibrate_llr(soft.symbols, soft.llr, seen, expected, sure, symbols, llr)
    return SoftSymbols(symbols, llr, quality)
