"""Load shedding: what is left out, in which order, when the receiver cannot keep up."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.rx.boxes import box_of, grow_box, mask_inside
from evlcp_sdk.values import Events, Region

LEVELS: Final = (
    "all",
    "rows outside of regions are shed",
    "and distances of most frames",
    "and all outside of regions",
    "and the oldest slices whole",
)
"""The levels of shedding, in words."""

RANGING_EVERY: Final = 4
"""From the second level on, distances are measured of one frame of so many."""

_MARGIN_PX: Final = 16
"""Around a region, which moves, and may be smaller than its bar."""

_WIDEST_PX: Final = 1 << 16
"""Columns of any sensor."""

_SEARCH_PERIOD_US: Final = 100_000
_SEARCH_US: Final = 20_000
"""At the first levels, so much of each period is not shed, so that new bars are found."""


@dataclass(frozen=True)
class Budget:
    """How long slices may wait before something is shed.

    Attributes:
        waiting_ms: Wait of the oldest slice from which on rows outside of regions are shed; from twice that
            on distances are, from four times on all outside of regions.
        most_ms: Wait from which on the oldest slices are dropped whole: no result is later by more.

    Raises:
        ConfigError: A value is not positive, or `most_ms` is less than four times `waiting_ms`.
    """

    waiting_ms: float = 20.0
    most_ms: float = 200.0

    def __post_init__(self) -> None:
        if not self.waiting_ms > 0 or not self.most_ms >= 4 * self.waiting_ms:
            raise ConfigError(
                f"a budget of {self.waiting_ms:g} ms, {self.most_ms:g} ms at the most: expected both"
                " positive, the most at least four times the first"
            )

    def choose_level(self, waiting_ms: float, previous: int) -> int:
        """The level for the wait of the oldest slice; it falls only at half of the limit that raised it.

        >>> [Budget().choose_level(ms, 0) for ms in (1, 25, 45, 90, 300)], Budget().choose_level(25, 2)
        ([0, 1, 2, 3, 4], 2)
        """
        limits_ms = (self.waiting_ms, 2 * self.waiting_ms, 4 * self.waiting_ms, self.most_ms)
        level = sum(waiting_ms > limit_ms for limit_ms in limits_ms)
        while level < previous and waiting_ms > limits_ms[level] / 2:
            level += 1
        return level


class Shedder:
    """Leaves events out by the level of shedding.

    Attributes:
        counts: Events left out: of `rows_outside_regions`, of `empty_areas`, and `too_late`.
    """

    def __init__(self) -> None:
        self.counts = {"rows_outside_regions": 0, "empty_areas": 0, "too_late": 0}

    def shed(self, events: Events, level: int, regions: Sequence[Region]) -> Events:
        """The remaining events; all of them without a region, as one must be found first."""
        if not level or not regions or not len(events):
            return events
        rows_only = level < 3
        if rows_only and int(events.t_us[0]) % _SEARCH_PERIOD_US < _SEARCH_US:
            return events
        kept = np.zeros(len(events), np.bool_)
        for region in regions:
            left, top, right, bottom = grow_box(box_of(region), _MARGIN_PX)
            kept |= mask_inside(
                events, (0, top, _WIDEST_PX, bottom) if rows_only else (left, top, right, bottom)
            )
        name = "rows_outside_regions" if rows_only else "empty_areas"
        self.counts[name] += len(events) - int(np.count_nonzero(kept))
        return events[kept]
