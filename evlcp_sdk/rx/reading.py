"""What a frame says, as the link's algorithms read it, and how far that is believed."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import edges_of_chips
from evlcp_sdk.air.frames import chips_behind
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import Tracker
from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.alignment import AlignedFrame, DueFrame, FrameAligner, Pilot
from evlcp_sdk.rx.framer import Announcer
from evlcp_sdk.rx.guard import Guard, compiled, tracker_of
from evlcp_sdk.rx.placement import layout_of
from evlcp_sdk.rx.points import points_finder
from evlcp_sdk.rx.ranges import RangeKeeper, Ranges
from evlcp_sdk.rx.regions import MARGIN_PX, Followed, ShownPlace
from evlcp_sdk.rx.spread import LateSpread, Spread, neighbours
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.tilt import LineOfSight, line_of_sight, magnification_of
from evlcp_sdk.values import FrameView, PresenceMap, Range, SoftSymbols

_FRAME_WORTH = 6.0
"""LLRs of a cluster that those of all its frame are worth: light and shaking are much the same for all,
while a panel or leaves stand behind some."""

_EXPECTED_SPREAD, _EXPECTED_WORTH = 0.4, 6.0
"""Standard deviation of the sizes of LLRs, in their mean, before any is seen, and how many it is worth."""

_LEAST_SURE = 0.6
"""Probability of being right against its nearest rival below which a symbol is not given: it has others, too,
and of those that are less sure, half or more are wrong in recordings."""

_TOGETHER = 1.7
"""Wrong symbols in a frame that has any: what makes one wrong, light, shaking, what stands behind, is there
for others, too. In `examples/campaigns/road.toml` they are 1.9 to 2.2 by decoding, as `benchmarks/quality.py`
prints; on a Gaussian channel 1 to 1.3, as long as less than half of the frames are wrong."""

_LEAST_EVENTS = 0.5
"""Share of the events due, by the edges of the codeword with the fewest, that may be missing by chance."""

_FLOODED, _MORE, _DIMMED = 0.2, 1.25, 0.45
"""Share of a cluster's events that come, more than in the pilot, where no cluster is, while half of the info
has so many times the pilot's or more; and share of the pilot's that half of it has: the light of all changes,
and nothing that the pilot showed holds. What moves, shines or blinks beside a bar makes 0.14 and 0.65 at the
most in recordings, steps of light 0.28 and 0.38; a bar that leaves its place has no more events than before.
In pair codes every symbol has half of the pilot's edges; in others some have none for long."""

_SURE = 0.98
"""Quality of a frame from which on its symbols hold, whatever the light of all does: where they are wrong, it
is less. A halo and a jolt look like a step of light now and then."""

_NO_RANGE, _NO_SIGHT = Range(math.nan, math.nan, 0), LineOfSight()

_NO_POINTS = np.empty((0, 2)), np.empty(0), math.nan


class Steps:
    """The roles that read a frame; it keeps no state of a stream."""

    def __init__(self, link: Link, announcer: Announcer | None, tracker: Tracker) -> None:
        self._codebook = link.codebook
        self._keeper = RangeKeeper()
        self._announcer = announcer
        self._guards = {role: Guard(link, role) for role in ("separation", "decoding", "ranging")}
        book = link.codebook
        self._separate = compiled(link, "separation", book)
        self._decode: Callable[..., SoftSymbols] = compiled(link, "decoding", book)
        self._measure = compiled(link, "ranging", link.camera, link.bar, book)
        self._distance = tracker.distance

    def distance_init(self) -> tuple[Ranges, Any]:
        """What is known of a transmitter's distance before its first frame."""
        return Ranges(), None if self._distance is None else self._distance.init()

    def separate(self, sums: NDArray[np.int16]) -> PresenceMap:
        """Where the clusters are, from a pilot's polarity sums, int16 (chips, height, width)."""
        guard = self._guards["separation"]
        with guard:
            presence: PresenceMap = self._separate(sums)
        if guard.checks:
            guard.expect_presence(presence, self._codebook.clusters, *sums.shape[1:])
        if self._announcer is not None:
            self._announcer.lap("separation", presence)
        return presence

    def decode(
        self,
        presence: PresenceMap,
        sums: NDArray[np.int16],
        before: NDArray[np.int8],
        after: NDArray[np.int8],
    ) -> SoftSymbols:
        """What the clusters say, from the polarity sums of pilot and info, int16 (chips, height, width).

        To codes that are no pair codes the chips sent before and after the info segment matter, and the sums
        have the one after it, too.
        """
        guard = self._guards["decoding"]
        more = () if self._codebook.pairs else (before, after)
        with guard:
            soft = self._decode(presence, sums, *more)
        if guard.checks:
            guard.expect_symbols(soft, self._codebook)
        if self._announcer is not None:
            self._announcer.lap("decoding", soft)
        return soft

    def measure(self, view: FrameView) -> Range:
        """How far the bar is."""
        guard = self._guards["ranging"]
        if self._announcer is not None:
            self._announcer.lap("view", view)
        with guard:
            distance: Range = self._measure(view)
        if guard.checks:
            guard.expect_range(distance)
        if self._announcer is not None:
            self._announcer.lap("ranging", distance)
        return distance

    def follow(
        self, state: tuple[Ranges, Any], t_us: float, chip_us: float, measured: Range, sight: LineOfSight
    ) -> tuple[tuple[Ranges, Any], Range, Range | None]:
        """Take a frame's distance as the ranging gave it; the new state, the distance, and that filtered.

        The sight says where its bar is seen, and what the attitude says of its lean. The filtered one is
        the prediction where a frame allows no distance, None without tracking.
        """
        ranges, distance = self._keeper.step(state[0], t_us, chip_us, measured, sight)
        filter_state, filtered = self._filter(state[1], t_us, distance)
        return (ranges, filter_state), distance, filtered

    def _filter(self, state: Any, t_us: float, measured: Range) -> tuple[Any, Range | None]:
        if self._distance is None:
            return state, None
        if not (math.isfinite(measured.distance_m) and math.isfinite(measured.sigma_m)):
            expected = self._distance.predict(state, t_us)
            return state, None if expected is None else Range(float(expected[0][0]), expected[1], 0)
        value, standing_m = np.array([measured.distance_m]), measured.standing_m
        # What stays over frames is not filtered out.
        new_m = math.sqrt(max(measured.sigma_m**2 - standing_m**2, 0.0))
        state, value, sigma = self._distance.step(state, t_us, value, new_m)
        return state, Range(float(value[0]), math.hypot(sigma, standing_m), measured.pairs)


class Reading(NamedTuple):
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
        flooded: Whether the light of all changes in it, so that no symbol is given.
    """

    symbols: NDArray[np.int64]
    soft: SoftSymbols
    distance: Range
    points_px: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    flank_px: float
    centre_px: tuple[float, float]
    sight: LineOfSight
    spread: Callable[[], Spread] | None
    flooded: bool


class BarState(NamedTuple):
    """What the frames of a bar leave for the next one.

    Attributes:
        pilot: The newest pilot; None where it showed no bar, and before the first.
        frame: Number of the newest frame that was decoded, on the packet grid; -1 before the first.
        symbols: Its symbols, int64 (K,).
        distance: What is known of the distance.
    """

    pilot: Pilot | None
    frame: int
    symbols: NDArray[np.int64]
    distance: tuple[Ranges, Any]


class FrameResult(NamedTuple):
    """A frame as it was decoded.

    Attributes:
        reading: What it says; its distance as it holds together with those before.
        filtered: The distance filtered; None without tracking.
        cells: Grid cells that show a cluster, on average.
        seen: Clusters that are seen.
        mirrored: The order of the clusters is the opposite of the layout's.
        given: It says something: a symbol, or of a known transmitter its distance.
        shown: Where it showed the bar, of one that was decoded by itself; None without a pilot.
    """

    reading: Reading
    filtered: Range | None
    cells: float
    seen: int
    mirrored: bool
    given: bool
    shown: ShownPlace | None = None


class FrameJob(NamedTuple):
    """A frame to decode, with what its bar's earlier frames do not say.

    Attributes:
        region: Where the bar is, with the events of the frame.
        due: Which frame.
        attitude: What is known of the camera's attitude in its pilot.
        ranged: Its distance is measured.
    """

    region: Followed
    due: DueFrame
    attitude: Attitude | None
    ranged: bool


class FrameReader:
    """Reads one frame after the other, as the aligner aligned it; it keeps no state of a stream."""

    def __init__(self, link: Link, steps: Steps, aligner: FrameAligner) -> None:
        centres_m, book = link.bar.cluster_centres_m(), link.codebook
        self._camera = link.camera
        self._is_column = float(np.ptp(centres_m[:, 0])) < 1e-9
        self._pilot_chips = link.packet.pilot_chips
        self._least_lit = _LEAST_EVENTS * book.least_activity
        self._least_half = _DIMMED if book.pairs else 0.0
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

        `before` is the chip that each cluster sent before its info segment, int8 (K,), -1 if not known; the
        distance is asked for where it is `ranged`.
        """
        sums, presence, placement = aligned.sums, aligned.pilot.presence, aligned.pilot.placement
        soft = self._steps.decode(presence, aligned.sums_and_next, before, self._behind[due.index])
        lit, images = np.empty_like(placement.seen), (sums, presence.probability, presence.grid_px)
        # Where a stream has a gap, or a pole passes, silence is not what a cluster says.
        beside, dim, most = _kernels.find_lit_clusters(
            *images, self._pilot_chips, self._least_lit, placement.seen, lit
        )
        given = calibrate_llr(soft, lit)
        changed = (beside > _FLOODED and most > _MORE) or dim < self._least_half
        if flooded := changed and given.quality < _SURE:
            given = calibrate_llr(soft, np.zeros_like(lit))
        if not due.has_pilot:
            # Another distance of the same pilot, or other points, would say nothing new.
            return Reading(
                soft.symbols,
                given,
                _NO_RANGE,
                *_NO_POINTS,
                aligned.centre_px,
                _NO_SIGHT,
                spread=None,
                flooded=flooded,
            )
        distance = _NO_RANGE
        if ranged:
            whole = self._aligner.whole(aligned)
            distance = self._steps.measure(FrameView(sums, aligned.offset_px, whole, soft))
        heard = sums[: self._pilot_chips]
        points_px, sigma_px, flank_px, centre_px = self._find_points(
            presence, placement, heard, aligned.corner_px
        )
        sight = _NO_SIGHT
        if self._is_column:
            sight = line_of_sight(self._camera, points_px, sigma_px, attitude)
        elif not self._camera.is_pinhole:
            sight = LineOfSight(magnification=magnification_of(self._camera, points_px))
        # Only of two images at one time it is asked; the pilot alone is kept for that, not the whole frame.
        spread = LateSpread(heard.copy(), self._pilots, self._every, self._layout, self._pairs, placement)
        image = points_px, sigma_px, flank_px, centre_px
        return Reading(soft.symbols, given, distance, *image, sight, spread, flooded)


class FrameDecoder:
    """Decodes one frame after the other: aligns and reads it; it keeps no state of a stream.

    Attributes:
        aligner: Holds frames still.
        steps: The link's roles.
    """

    def __init__(self, link: Link, announcer: Announcer | None = None) -> None:
        self.steps = Steps(link, announcer, tracker_of(link))
        self.aligner = FrameAligner(
            link.packet,
            link.regions,
            link.bar.cluster_centres_m(),
            link.codebook,
            self.steps.separate,
            (link.camera.width, link.camera.height),
        )
        self._reader = FrameReader(link, self.steps, self.aligner)
        self._codebook = link.codebook
        self._unknown = np.full(link.codebook.clusters, -1, np.int8)
        self._unknown.setflags(write=False)

    def first_state(self) -> BarState:
        """Before a transmitter's first frame."""
        return BarState(None, -1, np.empty(0, np.int64), self.steps.distance_init())

    def decode(self, job: FrameJob, state: BarState) -> tuple[FrameResult, BarState] | None:
        """Decode a frame of a known bar, see `read`; None where it takes more than its events to do so.

        It shows no bar, or not where the region has it, or no symbol: then it is to be looked at again with
        what is around.
        """
        region, due = job.region, job.due
        aligned = self.aligner.align(region, due, state.pilot)
        if aligned is None:
            return None
        shown = self.shown_place(aligned) if due.has_pilot else None
        # Within half of the seam, all events are there.
        if shown is not None and region.off_px(shown) > MARGIN_PX / 2:
            return None
        found, state = self.read(aligned, due, state, job.attitude, ranged=job.ranged)
        return (found._replace(shown=shown), state) if found.given else None

    def shown_place(self, aligned: AlignedFrame) -> ShownPlace:
        """Where a frame with a pilot shows its bar."""
        aligner, pilot = self.aligner, aligned.pilot
        box = aligner.box(aligned, pilot.placement)
        others = tuple(aligner.box(aligned, other) for other in pilot.others)
        return ShownPlace(aligned.middle_us, *box, aligner.lit_rows(aligned), aligner.strips(aligned), others)

    def read(
        self,
        aligned: AlignedFrame,
        due: DueFrame,
        state: BarState,
        attitude: Attitude | None,
        *,
        ranged: bool,
        known: bool = True,
    ) -> tuple[FrameResult, BarState]:
        """Read an aligned frame, of a transmitter that is known or not; what it leaves for the next."""
        reading = self._reader.read(aligned, due, self._before(state, due), attitude, ranged=ranged)
        distance, filtered = state.distance, None
        given = max(reading.soft.symbols.tolist()) >= 0
        # What says nothing is no transmitter, and of one that is known its distance may still be of use.
        given |= known and math.isfinite(reading.distance.distance_m)
        if given:
            distance, holds, filtered = self.steps.follow(
                distance, due.start_us, due.lock.chip_us, reading.distance, reading.sight
            )
            reading = reading._replace(distance=holds)
        placed = aligned.pilot.placement
        seen = max(sum(placed.seen.tolist()), 1)
        state = BarState(aligned.pilot, due.number, reading.symbols, distance)
        image = placed.cells / seen, seen, placed.mirrored
        return FrameResult(reading, filtered, *image, given), state

    def _before(self, state: BarState, due: DueFrame) -> NDArray[np.int8]:
        """The chip that each cluster sent before a frame's info segment, int8 (K,); -1 if not known.

        In a pair code it says nothing new, and is not looked up.
        """
        book = self._codebook
        if book.pairs:
            return self._unknown
        if due.has_pilot:
            return book.pilots[:, -1].astype(np.int8)
        if state.frame != due.number - 1 or due.index == 0:
            return self._unknown
        symbols = state.symbols
        return np.where(symbols >= 0, book.codewords[symbols, -1].astype(np.int8), np.int8(-1))


class Bars(Protocol):
    """Decodes the frames of known bars, each by what its bar's earlier ones left; bars go by numbers.

    After one that it cannot decode, a bar's frames are not, until its state is put there again.

    Attributes:
        at_once: Answers are known when they are asked for.
    """

    at_once: bool

    def __len__(self) -> int:
        """How many bars there are."""
        ...

    def put(self, bar: int, state: BarState) -> None:
        """Have a bar's frames decoded here from now on."""
        ...

    def take(self, bar: int) -> BarState:
        """Give a bar's state back: its frames are decoded elsewhere."""
        ...

    def decode(self, bar: int, job: FrameJob) -> Callable[[], FrameResult | None]:
        """Have a bar's next frame decoded, see `FrameDecoder.decode`; gives what to call for the answer."""
        ...


class BarDecoder:
    """`Bars` that are decoded in this process."""

    at_once = True

    def __init__(self, decoder: FrameDecoder) -> None:
        self._decoder = decoder
        self._states: dict[int, BarState] = {}
        self._stopped: set[int] = set()

    def __len__(self) -> int:
        return len(self._states)

    def put(self, bar: int, state: BarState) -> None:
        """See `Bars`."""
        self._states[bar] = state
        self._stopped.discard(bar)

    def take(self, bar: int) -> BarState:
        """See `Bars`."""
        return self._states.pop(bar)

    def decode(self, bar: int, job: FrameJob) -> Callable[[], FrameResult | None]:
        """See `Bars`."""
        found = None if bar in self._stopped else self._decoder.decode(job, self._states[bar])
        if found is None:
            self._stopped.add(bar)
            return lambda: None
        result, self._states[bar] = found
        return lambda: result


def calibrate_llr(soft: SoftSymbols, seen: NDArray[np.bool_]) -> SoftSymbols:
    """A frame as a decoding read it, with what can be believed.

    Decoders are surer than they are right, or less, each in its own way: pixels share light and motion.
    Log-likelihood ratios that tell the truth have a variance of twice their mean, whatever the channel, if it
    is near Gaussian: those of a cluster are scaled so that they do, by its own scatter, that of its frame,
    and what is likely. What these are worth lies between what fits 20 000 symbols of `motion-feedback` in
    recordings and in the harder scenes of `examples/campaigns/road.toml`, and what fits a Gaussian channel;
    both are met within a factor of 2 where less than half of the frames are wrong. The nearest rival of a
    symbol, at its least LLR, says how likely it is right; rather wrong ones are not given. `quality` is the
    probability that all that are given are right, of errors that come together.

    Args:
        soft: What a decoding says.
        seen: Clusters that are in sight, bool (K,); nothing is given of the others, and their LLRs are 0.
    """
    symbols, llr = np.empty_like(soft.symbols), np.empty_like(soft.llr)
    expected, sure = (_FRAME_WORTH, _EXPECTED_WORTH, _EXPECTED_SPREAD), (_LEAST_SURE, _TOGETHER)
    quality = _kernels.calibrate_llr(soft.symbols, soft.llr, seen, expected, sure, symbols, llr)
    return SoftSymbols(symbols, llr, quality)
