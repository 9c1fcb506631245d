"""Frames of an algorithm of the role `framing`, from the events of regions to the frames of the receiver."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from evlcp_sdk.clock import TimeStep
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import Deframer
from evlcp_sdk.rx.framer import Framer, StreamContext, note_lit
from evlcp_sdk.rx.guard import Guard, compiled
from evlcp_sdk.rx.reflections import FrameDetection, PacketAssembler, ReflectionQueue
from evlcp_sdk.rx.regions import Followed
from evlcp_sdk.values import DecodedFrame, Frame, Range

_COUNTED = "events_in_regions", "events_in_regions_on", "regions_opened", "regions_released", "frames"

_NO_RANGE = Range(math.nan, math.nan, 0)

_LOOKBACK_FRAMES = 96
"""Frames for which the places of a region are kept: a framing may give a frame so late."""


@dataclass
class _Listener:
    """What is known of one region.

    Attributes:
        region: Where it is, and its events.
        state: Of the framing.
        packets: Collects its frames.
        number: Transmitter number, None before the first frame.
        counts: What the framing counted so far.
        events: Events of the region since its last frame.
        last: Packet and frame of that.
    """

    region: Followed
    state: Any
    packets: PacketAssembler
    number: int | None = None
    counts: dict[str, int] | None = None
    events: int = 0
    last: tuple[int, int] = (-1, -1)


class PluginFraming(Framer):
    """Lets a plugin's framing listen to the regions of a stream, and puts its frames on the way of all."""

    cut_by_the_end = False

    def __init__(
        self,
        link: Link,
        name: str,
        stream: StreamContext,
        queue: ReflectionQueue,
        on_frame: Callable[[Frame], None] | None,
    ) -> None:
        self._guard = Guard(link, "framing")
        self._deframer: Deframer = compiled(
            link, "framing", link.codebook, link.packet, methods=("init", "step", "close", "counts")
        )
        self._codebook, self._packet = link.codebook, link.packet
        self._step_us = link.regions.step_us
        self._queue = queue
        self._reflections = queue.reflections
        self._camera_us: Callable[[float], float] = stream.clock.camera_us
        self._announcer, self._on_frame = stream.announcer, on_frame
        self._listeners: dict[int, _Listener] = {}
        self._name = name
        self._numbers = stream.numbers
        frames_us = _LOOKBACK_FRAMES * link.packet.info_chips * link.packet.chip_us
        self.patience_us = max(2 * link.packet.packet_chips * link.packet.chip_us, frames_us)
        self.counts = dict.fromkeys(_COUNTED, 0)
        self.lit: dict[int, tuple[float, float]] = {}
        self.ranging_every = 1

    def step(self, regions: list[Followed], step: TimeStep) -> None:
        """Receive what the regions of a time step send."""
        for region in regions:
            listener = self._listeners.get(region.id)
            pieces = [region.pieces[-1]] if listener is not None and region.pieces else list(region.pieces)
            if listener is None:
                self.counts["regions_opened"] += 1
                with self._guard:
                    state = self._deframer.init()
                listener = _Listener(region, state, PacketAssembler(self._packet.frames))
                self._listeners[region.id] = listener
            for start_us, events in pieces:
                self.counts["events_in_regions"] += len(events)
                self.counts["events_in_regions_on"] += int(events.p.sum(dtype=np.int64))
                listener.events += len(events)
                until_us = min(start_us + self._step_us, step.end_us)
                with self._guard:
                    given = self._deframer.step(listener.state, events, until_us)
                listener.state, heard = self._guard.expect_step(given, "step()")
                self._take(listener, heard)
            region.forget_before(math.inf, self._step_us, step.end_us - self.patience_us)
            if region.released:
                self.counts["regions_released"] += 1
                self._end(listener)
                del self._listeners[region.id]

    def number_of(self, region: Followed) -> int | None:
        """Number of a region's transmitter; None before its first frame."""
        listener = self._listeners.get(region.id)
        return None if listener is None else listener.number

    def let_go(self, region: Followed) -> None:
        """Forget a region whose place is another's."""
        listener = self._listeners.pop(region.id, None)
        if listener is not None:
            self.counts["regions_released"] += 1
            self._queue.add(listener.packets, None)

    def close(self) -> None:
        """End the stream: give what the regions still say."""
        for listener in self._listeners.values():
            self._end(listener)
        self._listeners = {}

    def _end(self, listener: _Listener) -> None:
        with self._guard:
            given = self._deframer.close(listener.state)
        listener.state, heard = self._guard.expect_step(given, "close()")
        self._take(listener, heard)
        self._queue.add(listener.packets, None)

    def _take(self, listener: _Listener, heard: list[DecodedFrame]) -> None:
        """Number a region's frames, say where they were seen, and hand them on."""
        self._count(listener)
        for one in heard:
            self._guard.expect(one, DecodedFrame)
            self._guard.expect_symbols(one.soft, self._codebook)
            self._guard.expect_number(one.frame, "frame", 0, self._packet.frames - 1)
            for name in ("t_us", "packet_t_us"):
                self._guard.expect_number(getattr(one, name), name, -1e18, 1e18)
            self._guard.expect_number(
                one.chip_us, "chip_us", self._packet.chip_us / 2, self._packet.chip_us * 2
            )
            if (one.packet, one.frame) <= listener.last:
                self._guard.refuse(
                    f"frame {one.frame} of packet {one.packet} behind frame {listener.last[1]} of packet"
                    f" {listener.last[0]}",
                    "frames in order",
                )
            listener.last = one.packet, one.frame
            if listener.number is None:
                listener.number = next(self._numbers)
            chips = self._packet.info_chips + self._packet.has_pilot(one.frame) * self._packet.pilot_chips
            end_us = one.t_us + chips * one.chip_us
            x, y = listener.region.positions.at(np.array([(one.t_us + end_us) / 2]))
            frame = Frame(
                transmitter=listener.number,
                packet=one.packet,
                frame=one.frame,
                t_us=self._camera_us(one.t_us),
                soft=one.soft,
                range=_NO_RANGE,
                filtered=None,
                x_px=float(x[0]),
                y_px=float(y[0]),
                echo_of=self._reflections.echo_of(listener.number),
                link=self._name,
            )
            self.counts["frames"] += 1
            if self._on_frame is not None:
                self._on_frame(frame)
            if self._announcer is not None:
                self._announcer.frame(frame)
            note_lit(self.lit, listener.number, frame.t_us, frame.t_us)
            times, light = (one.t_us, end_us, one.packet_t_us, one.chip_us), listener.events / len(heard)
            self._queue.add(
                listener.packets, FrameDetection(frame, *times, light, self._codebook.clusters, False)
            )
        if heard:
            listener.events = 0

    def _count(self, listener: _Listener) -> None:
        """Add what a framing has counted since it was asked last."""
        with self._guard:
            found = self._deframer.counts(listener.state)
        self._guard.expect(found, Mapping)
        now = dict(found)
        for name, many in now.items():
            self._guard.expect(name, str)
            if not isinstance(many, int | np.integer):
                self._guard.refuse(f"{type(many).__name__} for '{name}' at counts()", "whole numbers")
        before = listener.counts or {}
        for name, many in now.items():
            self.counts[name] = self.counts.get(name, 0) + many - before.get(name, 0)
        listener.counts = now
