"""The loop of a live run: slices in, packets out, results to listeners, in bounded time."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from evlcp_sdk.air.blocks import Kind
from evlcp_sdk.errors import UnpluggedError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.several import name_links
from evlcp_sdk.live.budget import LEVELS, RANGING_EVERY, Budget, Shedder
from evlcp_sdk.live.delays import DelayTally
from evlcp_sdk.live.publisher import Publisher
from evlcp_sdk.live.reader import Reader, Slice
from evlcp_sdk.plugin.source import EventSource, Loss
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.signals import Stopped
from evlcp_sdk.utc import PulseClock
from evlcp_sdk.values import Events, Frame, Packet, ReceivedMessage, Region, span_us

STAGES: Final = ("gather", "queue", "compute", "total")
"""Stages of a frame's delay: from its last chip to the arrival of the slice that completes it; to its
processing; to the decoded frame; and the sum of these."""

_END_TO_END_STAGE: Final = "end_to_end"
"""Of a message `time`: from its content, the time of its first chip, until it was read."""

_STATUS_EVERY_S: Final = 0.2
_IDLE_S: Final = 0.05
_MAX_BATCH_EVENTS: Final = 1 << 16
_MAX_BATCH_US: Final = 8_000
"""Largest batch of waiting slices."""
_BATCH_AFTER_S: Final = 1e-3
"""Time that a slice has waited when later ones join its batch: a slice of a camera that keeps up."""


@dataclass(frozen=True, eq=False)
class LiveStatus:
    """The state of a live run.

    Attributes:
        t_us: Newest event, camera clock, us.
        elapsed_s: Time since the start, s.
        events: Number of events, with those shed.
        events_per_s: Event rate since the last status.
        level: Level of shedding, an index of `LEVELS`.
        shed: Events left out so far, by reason, and frames without a distance.
        delays: Delays of all frames, by stage, and of messages `time` from end to end: count, p50, p99 and
            maximum, ms.
        recent: The same since the last status.
        counts: The receiver's counts.
        losses: The source's losses.
        regions: The receiver's regions.
        health: The camera's report of itself.
    """

    t_us: float
    elapsed_s: float
    events: int
    events_per_s: float
    level: int
    shed: Mapping[str, int]
    delays: Mapping[str, Mapping[str, float | int | None]]
    recent: Mapping[str, Mapping[str, float | int | None]]
    counts: Mapping[str, int]
    losses: Mapping[str, Loss]
    regions: tuple[Region, ...]
    health: Mapping[str, float | int | str]


class LiveLoop:
    """Reads a source in real time, feeds the receiver, and publishes the results.

    The receiver passes each frame to `publish_frame`; `pulses` get the triggers, which give the UTC of the
    camera's clock. The source is not closed.

    Attributes:
        delays: Delays of frames, by stage; `end_to_end` of messages `time`.
    """

    def __init__(
        self,
        source: EventSource,
        receiver: Receiver,
        links: Sequence[Link],
        publisher: Publisher,
        budget: Budget | None = None,
        pulses: PulseClock | None = None,
    ) -> None:
        self._pulses = pulses
        self._source, self._receiver = source, receiver
        self._forms = {name: link.packet for name, link in name_links(links).items()}
        self._publisher = publisher
        self._budget = Budget() if budget is None else budget
        self._reader = Reader(source)
        self._size = source.width or 1280, source.height or 720
        self._shedder = Shedder()
        self.delays = {stage: DelayTally() for stage in (*STAGES, _END_TO_END_STAGE)}
        self._recent = {stage: DelayTally() for stage in self.delays}
        self._level = 0
        self._levels_s = [0.0] * len(LEVELS)
        self._events = 0
        self._last_us = 0.0
        self._arrived_s = self._taken_s = self._start_s = self._status_s = time.monotonic()
        self._status_events = 0

    def run(self, stopped: Stopped) -> Iterator[tuple[Events, list[Packet]]]:
        """Yield the receiver's events and its packets, batch by batch, after publishing its results.

        Ends with the source, all of which is received, or when `stopped`.

        Raises:
            InputError: The source cannot be read on.
        """
        try:
            while not stopped():
                piece = self._reader.take(_IDLE_S)
                if piece is None and self._reader.ended:
                    break
                if piece is not None:
                    yield self._process(piece)
                self._publish_status()
        finally:
            self._reader.stop()
        if self._reader.fault is not None and not stopped():
            raise self._reader.fault

    def close(self) -> list[Packet]:
        """End the stream; return the packets that were still incomplete."""
        self._arrived_s = self._taken_s = float("nan")
        packets = self._receiver.close()
        self._publish_packets(packets)
        self._publish_status(now=True)
        return packets

    def publish_frame(self, frame: Frame) -> None:
        """Publish a frame, and count its delay."""
        now = time.monotonic()
        form = self._forms[frame.link]
        chips = form.frame_chips if form.has_pilot(frame.frame) else form.info_chips
        light_s = self._light_time_s(frame.t_us + chips * form.chip_us)
        late_ms = None
        if self._arrived_s == self._arrived_s:  # not at the end, which has no delay
            parts_s = self._arrived_s - light_s, self._taken_s - self._arrived_s, now - self._taken_s
            late_ms = (now - light_s) * 1e3
            for stage, part_s in zip(STAGES, (*parts_s, now - light_s), strict=True):
                self._count_delay(stage, part_s * 1e3)
        self._publisher.publish("frame", frame.t_us, frame, late_ms)

    def _light_time_s(self, t_us: float) -> float:
        """A time of the camera's clock on the host's, s."""
        host_s = self._source.clock_s(t_us)
        return self._reader.arrivals.to_host_s(t_us) if host_s is None else host_s

    def summary(self) -> dict[str, Any]:
        """Delays by stage, what was shed, and the time at each level, as JSON values."""
        return {
            "delays": {stage: tally.to_dict() for stage, tally in self.delays.items()},
            "shed": self.shed,
            "health": dict(self._source.health),
            "unplugged": isinstance(self._reader.fault, UnpluggedError),
            "levels_s": {text: round(s, 3) for text, s in zip(LEVELS, self._levels_s, strict=True)},
        }

    @property
    def shed(self) -> dict[str, int]:
        """Events left out so far, by reason, and frames without a distance."""
        counts = dict(self._shedder.counts)
        counts["too_late"] += self._reader.dropped
        return counts | {"frames_not_ranged": self._receiver.counts.get("frames_not_ranged", 0)}

    def _process(self, piece: Slice) -> tuple[Events, list[Packet]]:
        """Receive a slice, and a batch of those that wait behind it."""
        taken_s = time.monotonic()
        self._levels_s[self._level] += taken_s - self._taken_s
        self._level = self._budget.choose_level((taken_s - piece.arrived_s) * 1e3, self._level)
        pieces = [piece]
        while self._level == len(LEVELS) - 1 and taken_s - piece.arrived_s > self._budget.waiting_ms * 1e-3:
            # All but the newest are too late.
            newer = self._reader.take(0.0)
            if newer is None:
                break
            self._publish_raw(piece)
            self._shedder.counts["too_late"] += len(piece.events)
            piece, pieces = newer, [newer]
        events = len(piece.events)
        while events < _MAX_BATCH_EVENTS and taken_s - piece.arrived_s > _BATCH_AFTER_S:
            more = self._reader.take(0.0)
            if more is None:
                break
            pieces.append(more)
            events += len(more.events)
            if _span_us(pieces) > _MAX_BATCH_US:
                break
        self._arrived_s, self._taken_s = pieces[-1].arrived_s, taken_s
        regions = self._receiver.regions
        self._receiver.ranging_every = RANGING_EVERY if self._level >= 2 else 1
        for one in pieces:
            self._publish_raw(one)
            self._publisher.pictures.add(one.events, *self._size, regions)
        batch = pieces[0].events if len(pieces) == 1 else Events.concat(one.events for one in pieces)
        if len(batch):
            self._last_us = float(batch.t_us[-1])
        kept = self._shedder.shed(batch, self._level, regions)
        packets = self._receiver.feed(kept)
        self._publish_packets(packets)
        return kept, packets

    def _publish_raw(self, piece: Slice) -> None:
        if self._pulses is not None:
            arrived_s = time.time() - time.monotonic() + piece.arrived_s
            self._pulses.add(piece.triggers, arrived_s, span_us(piece.events, piece.triggers)[1])
        self._events += len(piece.events)
        if len(piece.triggers):
            self._publisher.publish("triggers", float(piece.triggers.t_us[0]), piece.triggers)
        if len(piece.events):
            self._publisher.publish("events", float(piece.events.t_us[0]), piece.events)

    def _publish_packets(self, packets: list[Packet]) -> None:
        for packet in packets:
            self._publisher.publish("packet", packet.t_us, packet)
            for message in packet.messages:
                self._publisher.publish("message", packet.t_us, message, self._end_to_end_ms(message))

    def _end_to_end_ms(self, message: ReceivedMessage) -> float | None:
        """Delay of a message `time` after the time in it, ms; None for others, or at the end.

        By the camera's UTC where that is known; else by the computer's, if the source is no replay.
        """
        if message.message.kind != Kind.TIME or self._arrived_s != self._arrived_s:
            return None
        if message.age_s is not None:
            late_ms = (message.age_s + time.monotonic() - self._light_time_s(message.t_us)) * 1e3
        elif self._source.clock_s(message.t_us) is None and self._source.live:
            late_ms = (time.time() - message.value) * 1e3
        else:
            return None
        self._count_delay(_END_TO_END_STAGE, late_ms)
        return late_ms

    def _count_delay(self, stage: str, delay_ms: float) -> None:
        self.delays[stage].add(delay_ms)
        self._recent[stage].add(delay_ms)

    def _publish_status(self, *, now: bool = False) -> None:
        at_s = time.monotonic()
        since_s = at_s - self._status_s
        if (since_s < _STATUS_EVERY_S and not now) or not self._publisher.has_listeners("status"):
            return
        status = LiveStatus(
            t_us=self._last_us,
            elapsed_s=at_s - self._start_s,
            events=self._events,
            events_per_s=(self._events - self._status_events) / since_s if since_s > 0 else 0.0,
            level=self._level,
            shed=self.shed,
            delays={stage: tally.to_dict() for stage, tally in self.delays.items()},
            recent={stage: tally.to_dict() for stage, tally in self._recent.items()},
            counts=self._receiver.counts,
            losses=self._source.losses,
            regions=self._receiver.regions,
            health=self._source.health,
        )
        self._publisher.publish("status", self._last_us, status)
        self._status_s, self._status_events = at_s, self._events
        self._recent = {stage: DelayTally() for stage in self.delays}


def _span_us(pieces: list[Slice]) -> int:
    times_us = [one.events.t_us for one in pieces if len(one.events)]
    return int(times_us[-1][-1] - times_us[0][0]) if times_us else 0
