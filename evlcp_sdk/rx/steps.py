"""A link's algorithms as the receiver calls them: compiled once, guarded, checked, announced."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import Filter, Tracker
from evlcp_sdk.rx.framer import Announcer
from evlcp_sdk.rx.guard import Guard, compiled
from evlcp_sdk.rx.ranges import RangeKeeper, Ranges
from evlcp_sdk.scene.lean import BarSight
from evlcp_sdk.values import FrameView, PresenceMap, Range, SoftSymbols


def tracker_of(link: Link) -> Tracker:
    """The filters of a link's tracking, whose faults are named."""
    guard = Guard(link, "tracking", may_refuse=True)
    with guard:
        tracker: Tracker = link.algorithm("tracking").compile()
        guard.expect(tracker, Tracker)
        for filter_ in (tracker.position, tracker.distance):
            if filter_ is not None:
                guard.expect_compiled(filter_, ("init", "step", "predict"))
    guard = Guard(link, "tracking")
    filters = tracker.position, tracker.distance
    return Tracker(*(None if one is None else _GuardedFilter(one, guard) for one in filters))


class Steps:
    """The roles that read a frame; it keeps no state of a stream.

    Args:
        link: The resolved configuration.
        announcer: Gets every result but the filters'; None for nobody.
        tracker: The filters of its tracking, as `tracker_of` gives them.
    """

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
        self, state: tuple[Ranges, Any], t_us: float, chip_us: float, measured: Range, sight: BarSight
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
        value = np.array([measured.distance_m])
        state, value, sigma = self._distance.step(state, t_us, value, measured.sigma_m)
        return state, Range(float(value[0]), sigma, measured.pairs)


class _GuardedFilter(Filter):
    """A filter of tracking whose faults are named."""

    def __init__(self, filter_: Filter, guard: Guard) -> None:
        self._filter = filter_
        self._guard = guard

    def init(self) -> Any:
        with self._guard:
            return self._filter.init()

    def predict(self, state: Any, t_us: float) -> tuple[NDArray[np.float64], float] | None:
        with self._guard:
            found = self._filter.predict(state, t_us)
            if found is not None:
                values, sigma = found
                self._guard.expect_filtered(values, sigma, np.shape(values)[:1])
        return found

    def step(
        self, state: Any, t_us: float, value: NDArray[np.float64], sigma: float
    ) -> tuple[Any, NDArray[np.float64], float]:
        with self._guard:
            state, values, sigma = self._filter.step(state, t_us, value, sigma)
            self._guard.expect_filtered(values, sigma, value.shape)
        return state, values, sigma
