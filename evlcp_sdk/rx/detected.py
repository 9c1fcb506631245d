"""Regions that an algorithm of the role `detection` gives, followed as the receiver's own are."""

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
    drop_oldest_events,
    is_same_place,
    memory_bytes,
)
from evlcp_sdk.values import Events, Region

_BACKFILL_FRAMES = 2
"""Frames kept from before a region was found, where these are longer than the steps of the receiver's own
tracker: a slow light is known after its first character. Not more, as they are looked for where the light is
when it is found, and a shaking camera has seen it elsewhere before."""


class DetectorTracker(RegionTracker):
    """Holds the events of the regions that a detector gives; they stay where it has them."""

    def __init__(self, link: Link, limits: Limits = LIMITS) -> None:
        self._guard = Guard(link, "detection")
        self._detector: Detector = compile_algorithm(
            link, "detection", link.camera, link.codebook, link.packet, methods=("init", "step")
        )
        self._limits = limits
        self._step_us = link.regions.step_us
        frames_us = _BACKFILL_FRAMES * link.packet.frame_chips * link.packet.chip_us
        self._most_recent = max(BACKFILL_STEPS, math.ceil(frames_us / self._step_us))
        with self._guard:
            self._state: Any = self._detector.init()
        self._recent: deque[tuple[int, Events]] = deque(maxlen=self._most_recent)
        self._left: frozenset[int] = frozenset()
        self.alive: list[TrackedRegion] = []
        self.counts = {"regions_left_out": 0, "dropped_no_room": 0}

    def step(self, start_us: int, events: Events, occupied: Sequence[Region] = ()) -> list[TrackedRegion]:
        """Take the events of one time step; return the regions that are alive or ended in it."""
        with self._guard:
            given = self._detector.step(self._state, start_us, events)
        self._state, found = self._guard.expect_step(given, "step()")
        places: dict[int, Region] = {}
        for region in found:
            self._guard.expect(region, Region)
            for name in ("x_px", "y_px", "width_px", "height_px"):
                self._guard.expect_number(getattr(region, name), name, -1e6, 1e6)
            if not any(is_same_place(region, place) for place in occupied):
                places[region.id] = replace(region, t_us=start_us + self._step_us / 2)
        # What was let go is not taken up again as long as the detector gives it.
        self._left &= {region.id for region in found}
        self._left |= {region.id for region in found} - set(places)
        places = {id: place for id, place in places.items() if id not in self._left}
        known = {followed.id: followed for followed in self.alive}
        for followed in self.alive:
            followed.released |= followed.id not in places
        for id, place in places.items():
            if id in known:
                known[id].track.append(place)
            elif len(self.alive) < self._limits.regions:
                pieces = deque((begun, _inside(before, place)) for begun, before in self._recent)
                first_us = pieces[0][0] if pieces else start_us
                end_us = start_us + self._step_us
                known[id] = TrackedRegion(id, RegionTrack([place]), first_us, pieces, opened_us=end_us)
                self.alive.append(known[id])
            else:
                self.counts["regions_left_out"] += 1
        for followed in self.alive:
            followed.add(start_us, _inside(events, followed.latest))
        self._store_step(start_us, events)
        self.counts["dropped_no_room"] += drop_oldest_events(
            self.alive, self._limits.region_bytes, self._step_us
        )
        seen = list(self.alive)
        self.alive = [followed for followed in self.alive if not followed.released]
        return seen

    def _store_step(self, start_us: int, events: Events) -> None:
        """Keep a step's events, for regions that are found later, and what is before it within the limits."""
        while self._recent and self._recent[0][0] <= start_us - self._most_recent * self._step_us:
            self._recent.popleft()
        self._recent.append((start_us, events))
        while sum(memory_bytes(held) for _, held in self._recent) > self._limits.recent_bytes:
            self._recent.popleft()

    def skip_gap(self) -> None:
        """Pass over a gap in time, with no region alive."""
        self._recent.clear()

    def drop(self, followed: TrackedRegion) -> None:
        """Let a region go at once."""
        super().drop(followed)
        self._left |= {followed.id}


def _inside(events: Events, region: Region) -> Events:
    """The events inside a region."""
    across = np.abs(events.x.astype(np.float64) - region.x_px) <= region.width_px / 2
    return events[across & (np.abs(events.y.astype(np.float64) - region.y_px) <= region.height_px / 2)]
