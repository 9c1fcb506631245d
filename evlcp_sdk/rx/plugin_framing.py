"""Runs an algorithm of the role `framing`: from the events of regions to the frames of the receiver."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from evlcp_sdk.clock import TimeStep
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import Deframer
from evlcp_sdk.rx.framer import Framer, StreamContext, record_light
from evlcp_sdk.rx.guard import Guard, compile_algorithm
from evlcp_sdk.rx.reflections import FrameDetection, PacketAssembler, ReflectionQueue
from evlcp_sdk.rx.regions import TrackedRegion
from evlcp_sdk.values import NO_RANGE, DecodedFrame, Frame

_COUNTS = "events_in_regions", "events_in_regions_on", "regions_opened", "regions_released", "frames"

_TAKEN_COUNTS = (*_COUNTS, "events", "packets")

_LOOKBACK_FRAMES = 96
"""Frames for which the places of a region are kept: a framing may give a frame so late."""


@dataclass
class _DeframedRegion:
    """A region that a framing decodes.

    Attributes:
        region: Where it is, and its events.
        state: Of the framing.
        assembler: Collects its frames.
        number: Transmitter number, None before the first frame.
        counts: The framing's counts when it was asked last.
        events: Events of the region since its last frame.
        last: Packet and number of that frame.
    """

    region: TrackedRegion
    state: Any
    assembler: PacketAssembler
    number: int | None = None
    counts: dict[str, int] | None = None
    events: int = 0
    last: tuple[int, int] = (-1, -1)


class PluginFramer(Framer):
    """Decodes the regions of a stream by a plugin's framing."""

    drops_frames_at_end = False

    def __init__(
        self,
        link: Link,
        name: str,
        stream: StreamContext,
        queue: ReflectionQueue,
        on_frame: Callable[[Frame], None] | None,
    ) -> None:
        super().__init__(link, name, stream, queue, on_frame, _COUNTS)
        self._guard = Guard(link, "framing")
        self._deframer: Deframer = compile_algorithm(
            link, "framing", link.codebook, link.packet, methods=("init", "step", "close", "counts")
        )
        self._codebook = link.codebook
        self._deframed: dict[int, _DeframedRegion] = {}
        frames_us = _LOOKBACK_FRAMES * link.packet.info_chips * link.packet.chip_us
        self.patience_us = max(2 * link.packet.packet_us, frames_us)

    def step(self, regions: list[TrackedRegion], step: TimeStep) -> None:
        """Decode what the regions of a time step send."""
        for region in regions:
            deframed = self._deframed.get(region.id)
            pieces = [region.pieces[-1]] if deframed is not None and region.pieces else list(region.pieces)
            if deframed is None:
                self.counts["regions_opened"] += 1
                with self._guard:
                    state = self._deframer.init()
                deframed = _DeframedRegion(region, state, PacketAssembler(self._packet.frames))
                self._deframed[region.id] = deframed
            for start_us, events in pieces:
                self.counts["events_in_regions"] += len(events)
                self.counts["events_in_regions_on"] += int(events.p.sum(dtype=np.int64))
                deframed.events += len(events)
                until_us = min(start_us + self._step_us, step.end_us)
                with self._guard:
                    given = self._deframer.step(deframed.state, events, until_us)
                deframed.state, frames = self._guard.expect_step(given, "step()")
                self._queue_frames(deframed, frames)
            region.forget_before(math.inf, self._step_us, step.end_us - self.patience_us)
            if region.released:
                self.counts["regions_released"] += 1
                self._end_region(deframed)
                del self._deframed[region.id]

    def number_of(self, region: TrackedRegion) -> int | None:
        """Number of a region's transmitter; None before its first frame."""
        deframed = self._deframed.get(region.id)
        return None if deframed is None else deframed.number

    def forget_region(self, region: TrackedRegion) -> None:
        """Forget a region whose place is another's."""
        deframed = self._deframed.pop(region.id, None)
        if deframed is not None:
            self.counts["regions_released"] += 1
            self._queue.add(deframed.assembler, None)

    def close(self) -> None:
        """End the stream: give what the regions still hold."""
        for deframed in self._deframed.values():
            self._end_region(deframed)
        self._deframed = {}

    def _end_region(self, deframed: _DeframedRegion) -> None:
        with self._guard:
            given = self._deframer.close(deframed.state)
        deframed.state, frames = self._guard.expect_step(given, "close()")
        self._queue_frames(deframed, frames)
        self._queue.add(deframed.assembler, None)

    def _queue_frames(self, deframed: _DeframedRegion, decoded_frames: list[DecodedFrame]) -> None:
        self._add_counts(deframed)
        for decoded in decoded_frames:
            self._check_frame(decoded, deframed.last)
            deframed.last = decoded.packet, decoded.frame
            if deframed.number is None:
                deframed.number = next(self._numbers)
            chips = self._packet.info_chips + self._packet.has_pilot(decoded.frame) * self._packet.pilot_chips
            end_us = decoded.t_us + chips * decoded.chip_us
            x, y = deframed.region.track.centres_at(np.array([(decoded.t_us + end_us) / 2]))
            frame = Frame(
                transmitter=deframed.number,
                packet=decoded.packet,
                frame=decoded.frame,
                t_us=self._clock.camera_us(decoded.t_us),
                soft=decoded.soft,
                range=NO_RANGE,
                filtered=None,
                x_px=float(x[0]),
                y_px=float(y[0]),
                echo_of=self._queue.reflections.echo_of(deframed.number),
                link=self._name,
            )
            self.counts["frames"] += 1
            if self._on_frame is not None:
                self._on_frame(frame)
            self._announcer.announce_frame(frame)
            record_light(self.light_spans_us, deframed.number, frame.t_us, frame.t_us)
            times, light = (decoded.t_us, end_us, decoded.packet_t_us, decoded.chip_us), deframed.events
            detection = FrameDetection(
                frame, *times, light / len(decoded_frames), self._codebook.clusters, False
            )
            self._queue.add(deframed.assembler, detection)
        if decoded_frames:
            deframed.events = 0

    def _check_frame(self, decoded: DecodedFrame, last: tuple[int, int]) -> None:
        guard, chip_us = self._guard, self._packet.chip_us
        guard.expect(decoded, DecodedFrame)
        guard.expect_symbols(decoded.soft, self._codebook)
        guard.expect_number(decoded.frame, "frame", 0, self._packet.frames - 1)
        for name in ("t_us", "packet_t_us"):
            guard.expect_number(getattr(decoded, name), name, -1e18, 1e18)
        guard.expect_number(decoded.chip_us, "chip_us", chip_us / 2, chip_us * 2)
        if (decoded.packet, decoded.frame) <= last:
            guard.refuse(
                f"frame {decoded.frame} of packet {decoded.packet} behind frame {last[1]} of packet"
                f" {last[0]}",
                "frames in order",
            )

    def _add_counts(self, deframed: _DeframedRegion) -> None:
        with self._guard:
            found = self._deframer.counts(deframed.state)
        self._guard.expect(found, Mapping)
        now = dict(found)
        for name, count in now.items():
            self._guard.expect(name, str)
            if not isinstance(count, int | np.integer):
                self._guard.refuse(f"{type(count).__name__} for '{name}' at counts()", "whole numbers")
            if name in _TAKEN_COUNTS:
                self._guard.refuse(f"'{name}' at counts()", "another name, as the receiver counts these")
        before = deframed.counts or {}
        for name, count in now.items():
            self.counts[name] = self.counts.get(name, 0) + count - before.get(name, 0)
        deframed.counts = now
