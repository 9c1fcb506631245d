"""Track the regions that an algorithm of the role `detection` finds."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import Detector
from evlcp_sdk.rx.guard import Guard, compile_algorithm
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.rx.regions import (
    BACKFILL_STEPS,
    RegionTrack,
    RegionTracker,
    TrackedRegion,
    is_same_place,
)
from evlcp_sdk.values import Events, Region

_BACKFILL_FRAMES = 2
"""Frames kept from before a region was found, where these are longer than the steps of the receiver's own
tracker: a slow light is known after its first character. Not more, as their events are sought where the light
is when it is found, and a shaking camera has seen it elsewhere before."""


class DetectorTracker(RegionTracker):
    """Holds the events of the regions that a detector finds, at the places that it gives."""

    def __init__(self, link: Link, limits: Limits = LIMITS) -> None:
        self._guard = Guard(link, "detection")
        self._detector: Detector = compile_algorithm(
            link, "detection", link.camera, link.codebook, link.packet, methods=("init", "step")
        )
        step_us = link.regions.step_us
        frames_us = _BACKFILL_FRAMES * link.packet.frame_chips * link.packet.chip_us
        most_recent = max(BACKFILL_STEPS, math.ceil(frames_us / step_us))
        super().__init__(step_us, limits, most_recent)
        with self._guard:
            self._state: Any = self._detector.init()
        self._dropped: frozenset[int] = frozenset()

    def step(self, start_us: int, events: Events, occupied: Sequence[Region] = ()) -> list[TrackedRegion]:
        """See `RegionTracker`."""
        with self._guard:
            result = self._detector.step(self._state, start_us, events)
        self._state, found = self._guard.expect_step(result, "step()")
        places: dict[int, Region] = {}
        for place in found:
            self._guard.expect(place, Region)
            for name in ("x_px", "y_px", "width_px", "height_px"):
                self._guard.expect_number(getattr(place, name), name, -1e6, 1e6)
            if not any(is_same_place(place, other) for other in occupied):
                places[place.id] = replace(place, t_us=start_us + self._step_us / 2)
        # A dropped region is not tracked again as long as the detector finds it.
        found_ids = {place.id for place in found}
        self._dropped = (self._dropped & found_ids) | (found_ids - set(places))
        places = {id: place for id, place in places.items() if id not in self._dropped}
        known = {region.id: region for region in self.alive}
        for region in self.alive:
            region.released |= region.id not in places
        for id, place in places.items():
            if id in known:
                known[id].track.append(place)
            elif len(self.alive) < self._limits.regions:
                pieces = deque((begun_us, _select_inside(before, place)) for begun_us, before in self._recent)
                first_us = pieces[0][0] if pieces else start_us
                self.alive.append(TrackedRegion(id, RegionTrack([place]), first_us, pieces))
            else:
                self.counts["regions_left_out"] += 1
        for region in self.alive:
            region.add(start_us, _select_inside(events, region.latest))
        self._store_step(start_us, events)
        self._limit_memory()
        seen = list(self.alive)
        self.alive = [region for region in self.alive if not region.released]
        return seen

    def drop(self, region: TrackedRegion) -> None:
        """See `RegionTracker`."""
        super().drop(region)
        self._dropped |= {region.id}


def _select_inside(events: Events, region: Region) -> Events:
    across = np.abs(events.x.astype(np.float64) - region.x_px) <= region.width_px / 2
    return events[across & (np.abs(events.y.astype(np.float64) - region.y_px) <= region.height_px / 2)]
