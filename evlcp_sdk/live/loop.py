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
from evlcp_sdk.place.navigator import Placed
from evlcp_sdk.plugin.source import EventSource, Loss
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.signals import Stopped
from evlcp_sdk.utc import PulseClock
from evlcp_sdk.values import Events, Frame, Packet, ReceivedMessage, Region, span_us

STAGES: Final = ("gather", "queue", "compute", "total")
"""Of a frame's delay: from its last chip until the slice with which it could be decoded was there; until that
was taken; until the frame was decoded; and all of these."""

_END_TO_END: Final = "end_to_end"
"""Of a message `time`: from what its transmitter says, when its first chip shines, until it was read."""

_STATUS_EVERY_S: Final = 0.2
_IDLE_S: Final = 0.05
_TURN_EVENTS: Final = 1 << 16
_TURN_US: Final = 8_000
"""How much is taken at once where slices wait."""
_WAITED_S: Final = 1e-3
"""How long one has waited before those behind it are taken with it: a slice of a camera that keeps up."""


@dataclass(frozen=True, eq=False)
class LiveStatus:
    """How a live run goes.

    Attributes:
        t_us: Newest event, camera clock, us.
        elapsed_s: Since the start, s.
        events: Events so far, those shed too.
        events_per_s: In the time since the last status.
        level: What is shed, a number of `LEVELS`.
        shed: Events left out so far, by reason, and frames without a distance.
        delays: Of all frames so far, by stage, and of messages `time` from end to end: count, p50, p99 and
            maximum, ms.
        recent: The same since the last status.
        counts: As of the receiver.
        losses: As of the source.
        regions: The regions that are followed.
        health: What the camera says of itself.
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
    """Reads a source in real time, feeds the receiver, and tells listeners what it finds.

    Args:
        source: What is read; not closed.
        receiver: What decodes it; it gives each frame to `frame`.
        links: What it decodes.
        publisher: Where results and pictures go.
        budget: When what is shed.
        pulses: Is told of triggers, which say the UTC of the camera's clock; None for nobody.

    Attributes:
        delays: Of frames, by stage; `end_to_end` of messages `time`.
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
        self._shedder = Shedder(*self._size)
        self.delays = {stage: DelayTally() for stage in (*STAGES, _END_TO_END)}
        self._recent = {stage: DelayTally() for stage in self.delays}
        self._level = 0
        self._levels_s = [0.0] * len(LEVELS)
        self._events = 0
        self._last_us = 0.0
        self._arrived_s = self._taken_s = self._start_s = self._status_s = time.monotonic()
        self._status_events = 0

    def run(self, stopped: Stopped) -> Iterator[tuple[Events, list[Packet]]]:
        """Yield what is received: the events that the receiver got, and its packets.

        The listeners have had the frames, packets and messages by then. Ends where the source ends, or when
        `stopped`; what waits then is still received where the source has ended.

        Raises:
            InputError: The source cannot be read on.
        """
        self._start_s = self._status_s = self._taken_s = time.monotonic()
        self._reader.start()
        try:
            while not stopped():
                piece = self._reader.take(_IDLE_S)
                if piece is None and self._reader.ended:
                    break
                if piece is not None:
                    yield self._turn(piece)
                self._tell_status()
        finally:
            self._reader.stop()
        if self._reader.fault is not None and not stopped():
            raise self._reader.fault

    def close(self) -> list[Packet]:
        """End the stream; return the packets that were still incomplete."""
        self._arrived_s = self._taken_s = float("nan")
        packets = self._receiver.close()
        self._tell(packets)
        self._tell_status(now=True)
        return packets

    def frame(self, frame: Frame) -> None:
        """Tell listeners of a frame, and count how long it took."""
        now = time.monotonic()
        form = self._forms[frame.link]
        chips = form.frame_chips if form.has_pilot(frame.frame) else form.info_chips
        shone_s = self._shone_s(frame.t_us + chips * form.chip_us)
        late_ms = None
        if self._arrived_s == self._arrived_s:  # not at the end, whose time says nothing
            parts_s = self._arrived_s - shone_s, self._taken_s - self._arrived_s, now - self._taken_s
            late_ms = (now - shone_s) * 1e3
            for stage, part_s in zip(STAGES, (*parts_s, now - shone_s), strict=True):
                self._count(stage, part_s * 1e3)
        self._publisher.publish("frame", frame.t_us, frame, late_ms)

    def _shone_s(self, t_us: float) -> float:
        """When a time of the camera's clock was, by our own clock, s."""
        shone_s = self._source.clock_s(t_us)
        return self._reader.arrivals.at_s(t_us) if shone_s is None else shone_s

    def placed(self, placed: Placed) -> None:
        """Tell listeners of a fix."""
        self._publisher.publish("fix", placed.fix.t_us, placed)

    def summary(self) -> dict[str, Any]:
        """Delays by stage, what was shed, and for how long, as JSON values."""
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

    def _turn(self, piece: Slice) -> tuple[Events, list[Packet]]:
        """Take a slice, and those that wait behind it, as far as they are few."""
        taken_s = time.monotonic()
        self._levels_s[self._level] += taken_s - self._taken_s
        self._level = self._budget.level((taken_s - piece.arrived_s) * 1e3, self._level)
        pieces = [piece]
        while self._level == len(LEVELS) - 1 and taken_s - piece.arrived_s > self._budget.waiting_ms * 1e-3:
            # All but the newest is too late.
            newer = self._reader.take(0.0)
            if newer is None:
                break
            self._publish_raw(piece)
            self._shedder.drop(piece.events)
            piece, pieces = newer, [newer]
        events = len(piece.events)
        while events < _TURN_EVENTS and taken_s - piece.arrived_s > _WAITED_S:
            more = self._reader.take(0.0)
            if more is None:
                break
            pieces.append(more)
            events += len(more.events)
            if _span_us(pieces) > _TURN_US:
                break
        self._arrived_s, self._taken_s = pieces[-1].arrived_s, taken_s
        regions = self._receiver.regions
        self._receiver.ranging_every = RANGING_EVERY if self._level >= 2 else 1
        for one in pieces:
            self._publish_raw(one)
            self._publisher.pictures.add(one.events, *self._size, regions)
        whole = pieces[0].events if len(pieces) == 1 else Events.concat(one.events for one in pieces)
        if len(whole):
            self._last_us = float(whole.t_us[-1])
        kept = self._shedder.shed(whole, self._level, regions)
        packets = self._receiver.feed(kept)
        self._tell(packets)
        return kept, packets

    def _publish_raw(self, piece: Slice) -> None:
        if self._pulses is not None:
            came_s = time.time() - time.monotonic() + piece.arrived_s
            self._pulses.add(piece.triggers, came_s, span_us(piece.events, piece.triggers)[1])
        self._events += len(piece.events)
        if len(piece.triggers):
            self._publisher.publish("triggers", float(piece.triggers.t_us[0]), piece.triggers)
        if len(piece.events):
            self._publisher.publish("events", float(piece.events.t_us[0]), piece.events)

    def _tell(self, packets: list[Packet]) -> None:
        for packet in packets:
            self._publisher.publish("packet", packet.t_us, packet)
            for message in packet.messages:
                self._publisher.publish("message", packet.t_us, message, self._end_to_end_ms(message))

    def _end_to_end_ms(self, message: ReceivedMessage) -> float | None:
        """How long after the time that it says a message `time` is read, ms; None for others, or at the end.

        By the camera's UTC where that is known; else by the computer's, of a source that is not a replay.
        """
        if message.message.kind != Kind.TIME or self._arrived_s != self._arrived_s:
            return None
        if message.age_s is not None:
            late_ms = (message.age_s + time.monotonic() - self._shone_s(message.t_us)) * 1e3
        elif self._source.clock_s(message.t_us) is None and self._source.live:
            late_ms = (time.time() - message.value) * 1e3
        else:
            return None
        self._count(_END_TO_END, late_ms)
        return late_ms

    def _count(self, stage: str, delay_ms: float) -> None:
        self.delays[stage].add(delay_ms)
        self._recent[stage].add(delay_ms)

    def _tell_status(self, *, now: bool = False) -> None:
        """Say how it goes, where it is time for that."""
        at_s = time.monotonic()
        since_s = at_s - self._status_s
        if (since_s < _STATUS_EVERY_S and not now) or not self._publisher.wanted("status"):
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
    """From the first event of some slices to their last, us."""
    some = [one.events.t_us for one in pieces if len(one.events)]
    return int(some[-1][-1] - some[0][0]) if some else 0
