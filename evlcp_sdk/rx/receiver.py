"""The receiver: events in, packets out."""

import math
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import pluggy

from evlcp_sdk.clock import Timeline, TimeStep
from evlcp_sdk.errors import StreamError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.several import name_links
from evlcp_sdk.plugin.roles import STEPS
from evlcp_sdk.rx.detected import DetectorTracker
from evlcp_sdk.rx.framer import Announcer, Framer, StreamContext, to_camera_time
from evlcp_sdk.rx.framing import PacketFraming
from evlcp_sdk.rx.guard import compile_tracker
from evlcp_sdk.rx.inbox import MessageAssembler
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.rx.multi import EarlyFrames, SeveralLinks, share_detectors
from evlcp_sdk.rx.plugin_framing import PluginFraming
from evlcp_sdk.rx.reading import FrameDecoder
from evlcp_sdk.rx.reflections import ReflectionQueue, Reflections
from evlcp_sdk.rx.regions import RegionTracker, RhythmTracker, is_same_place
from evlcp_sdk.rx.rhythm import BlinkDetector
from evlcp_sdk.rx.transmitters import LOOKBACK_PACKETS
from evlcp_sdk.rx.workers import Workers
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog, attitude_source
from evlcp_sdk.utc import ClockZero
from evlcp_sdk.values import Events, Frame, Packet, Region, replace_fields


class Receiver:
    """Decodes a stream of events, whatever pieces it comes in.

    The stream is cut into time steps on a fixed grid, so that any split of it gives the same packets. Of
    several links, every region is tried by each; a packet is given by the one that explains most of the light
    there, once each had its time to answer, and names it.

    Packets come when they are complete. A frame is decoded as soon as its last events are there, before its
    time step is over, and told at once.

    Args:
        link: The resolved configuration, or several of one camera.
        hook: Where finished stages are announced (`Registry.hook`); None for nowhere.
        attitude: What is known of the camera's attitude, the same always or over time: how plumb bars lean
            against the sensor. None for nothing.
        clock_zero: UTC of the camera clock's 0, for the age of signed beacons; None if it is not known.
        limits: How much it holds at the most.
        on_frame: Gets each frame as soon as it is decoded, within `feed` or `close`, in order of a
            transmitter's frames. Its packet has the same later, unless the stream ends before the frame's
            late events can have come, or the transmitter turns out to have been reset before; only `echo_of`
            is by what is known then. Of several links, frames come with their packet until their transmitter
            holds its place; where another link takes that from it, the count `frames_withdrawn` has those
            told of packets that are not given. None for nobody.
        workers: Processes at work, this one among them: more than one decode whole bars, with the same
            results; each takes a second or two to start, and a script that asks for them needs the usual
            `if __name__ == "__main__":`. Frames then come some time steps later to `on_frame`.

    Attributes:
        left: Packets that were complete when an algorithm failed in the last `feed`, which did not give them.

    Raises:
        ConfigError: Links that cannot be received together, or nothing tells them apart; workers beside a
            plugin that follows the stages.
        WorkerError: A worker does not start.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> receiver = Receiver(load_link())
    >>> receiver.feed(Events.of(t_us=[10, 20], x=[5, 5], y=[7, 7], p=[1, 0]))
    []
    >>> receiver.close()
    []
    >>> receiver.counts["events"]
    2
    """

    def __init__(
        self,
        link: Link | Sequence[Link],
        hook: pluggy.HookRelay | None = None,
        *,
        attitude: Attitude | AttitudeLog | None = None,
        clock_zero: ClockZero = None,
        limits: Limits = LIMITS,
        on_frame: Callable[[Frame], None] | None = None,
        workers: int = 1,
    ) -> None:
        links = name_links(link)
        first, camera = next(iter(links.values())), next(iter(links.values())).camera
        self._timeline = Timeline(first.regions.step_us, camera.width, camera.height, limits.step_events)
        self._clock = clock = self._timeline.clock
        limits = replace(limits, region_bytes=limits.region_bytes // len(links))
        announcer = None
        if hook is not None and hook.evlcp_stage_finished.get_hookimpls():
            announcer = Announcer(hook.evlcp_stage_finished, clock.camera_us)
        self._workers = Workers.beside(links, workers, announced=announcer is not None)
        known = attitude_source(attitude), clock_zero
        bar_decoders = None if self._workers is None else self._workers.bars
        stream = StreamContext(clock, *known, announcer, limits, bar_decoders=bar_decoders)
        self._early = EarlyFrames(on_frame)
        self._several: SeveralLinks | None = None
        if len(links) == 1:
            self._receivers = [LinkReceiver(first, "", stream, None, on_frame)]
        else:
            rhythms, tell = share_detectors(links), None if on_frame is None else self._decoded
            self._receivers = [
                LinkReceiver(one, name, stream, rhythms.get(name), tell) for name, one in links.items()
            ]
            patience_us = max(one.framing.patience_us for one in self._receivers)
            self._several = SeveralLinks(links.values(), patience_us)
        self._closed = False
        self.left: list[Packet] = []

    @property
    def lit_us(self) -> dict[int, tuple[float, float]]:
        """Of each transmitter, the newest thousand of a link, by number, when its light was there.

        Starts of the first and the last frame that was due while it was, given or not, camera clock, us.
        """
        return {number: lit for one in self._receivers for number, lit in one.framing.light_spans_us.items()}

    @property
    def regions(self) -> tuple[Region, ...]:
        """Where the regions that are followed were seen last, on the camera's clock."""
        return tuple(region for one in self._receivers for region in one.regions)

    @property
    def ranging_every(self) -> int:
        """The distance of every n-th frame with a pilot is measured, 1: of all; for when time is short."""
        return self._receivers[0].framing.ranging_every

    @ranging_every.setter
    def ranging_every(self, every: int) -> None:
        for one in self._receivers:
            one.framing.ranging_every = every

    @property
    def counts(self) -> dict[str, int]:
        """What was taken, found and dropped so far, by all links together."""
        total: Counter[str] = Counter()
        for one in self._receivers:
            total.update(one.counts)
        crowded = {"dropped_crowded": self._timeline.dropped}
        withdrawn = {} if self._several is None else {"frames_withdrawn": self._early.withdrawn}
        return self._clock.counts | crowded | dict(total) | withdrawn

    @property
    def link_counts(self) -> dict[str, dict[str, int]]:
        """What each of several links found and dropped so far, by its name; nothing of a single link."""
        return {one.name: one.counts for one in self._receivers if one.name}

    def feed(self, events: Events) -> list[Packet]:
        """Take the next events of the stream; return the packets that are complete.

        Events before their predecessor in time, off the sensor, or on a clock that no others agree on, are
        dropped and counted.

        Raises:
            StreamError: The stream was closed, or a polarity is neither 0 nor 1.
            PluginError: An algorithm failed; `left` has the packets that were complete by then.
            WorkerError: A worker ended, or does not answer.
        """
        if self._closed:
            raise StreamError("the receiver is closed: make a new one for a new stream")
        if events.p.max(initial=0) > 1:
            raise StreamError(f"events with polarity {events.p.max()}, expected 0 or 1")
        self.left = []
        for step in self._timeline.feed(events, self._waits, self._due_us):
            self.left += self._run(step)
        packets, self.left = self.left, []
        return packets

    def close(self) -> list[Packet]:
        """End the stream; return the packets that were still incomplete."""
        if self._closed:
            return []
        self._closed = True
        for one in self._receivers:
            one.end_at(self._clock.last_us)
        packets = [packet for step in self._timeline.close() for packet in self._run(step)]
        left = [one.finish() for one in self._receivers]
        if self._several is None:
            packets += self._receivers[0].read(left[0])
        else:
            for number, found in enumerate(left):
                self._several.add(number, {}, found, self._clock.last_us)
            packets += self._judged(self._several, math.inf)
        for one in self._receivers:
            one.close()
        if self._workers is not None:
            self._workers.close()
        return packets

    def _waits(self) -> bool:
        """Whether anything waits for the next step."""
        return any(self._receivers) or bool(self._several)

    def _due_us(self) -> float:
        """When the next frame can be decoded, us."""
        due_us = math.inf
        for one in self._receivers:
            due_us = min(due_us, one.framing.due_us)
        return due_us

    def _run(self, step: TimeStep) -> list[Packet]:
        """Give each link a time step; give the packets that are complete, of the links that fit."""
        if not step.is_whole:
            for one in self._receivers:
                one.framing.decode_early(step)
            return []
        several = self._several
        if several is None:
            (one,) = self._receivers
            return one.read(one.step(step))
        for number, one in enumerate(self._receivers):
            found = one.step(step, several.taken(number), several.owning)
            several.add(number, one.places, found, step.end_us)
        return self._judged(several, step.end_us)

    def _judged(self, several: SeveralLinks, now_us: float) -> list[Packet]:
        """Read those packets of several links that fit by now, and count what does not."""
        packets = []
        for shown, fits in several.judge(now_us):
            mine = self._receivers[shown.link]
            if not fits:
                mine.refuse(shown.packet)
                self._early.refused(shown.packet)
                continue
            packets += mine.read([shown.packet])
            self._early.given(packets[-1], owns=shown.packet.transmitter in several.owning)
            for other in self._receivers:
                if other is not mine:
                    other.discard_place(several.around(shown.place))
        return packets

    def _decoded(self, frame: Frame) -> None:
        """Take a frame of one of several links."""
        assert self._several is not None
        self._early.decoded(frame, owns=frame.transmitter in self._several.owning)


class LinkReceiver:
    """Follows the regions of a stream by one link, receives and decodes what they send, reads its messages.

    Its frames have the name of the link, empty for none, and come to `on_frame` as soon as they are decoded;
    `rhythm` are the scores of the pixels, of another link in the same rhythm.
    """

    def __init__(
        self,
        link: Link,
        name: str,
        stream: StreamContext,
        rhythm: BlinkDetector | None,
        on_frame: Callable[[Frame], None] | None,
    ) -> None:
        self.name = name
        self._clock, self._announcer = stream.clock, stream.announcer
        tracker = compile_tracker(link)
        self._regions: RegionTracker
        follower: RhythmTracker | None = None
        if link.algorithm("detection").rhythmic:
            self._regions = follower = RhythmTracker(
                link.regions,
                link.camera,
                link.packet.chip_us,
                tracker.position,
                LOOKBACK_PACKETS * link.packet.packet_chips * link.packet.chip_us,
                stream.limits,
                link.codebook.longest_gap_chips,
                rhythm,
            )
        else:
            self._regions = DetectorTracker(link, stream.limits)
        self._queue = ReflectionQueue(Reflections(link.packet, len(link.codebook.codewords)))
        self.framing: Framer
        if link.algorithm("framing").roles >= STEPS:
            decoder = FrameDecoder(link, self._announcer)
            self.framing = PacketFraming(
                link, name, stream, decoder, self._regions, follower, self._queue, on_frame
            )
        else:
            self.framing = PluginFraming(link, name, stream, self._queue, on_frame)
        self._messages = MessageAssembler.of(link, stream.clock_zero)
        self._given = {"frames_reflected": 0, "frames_alike": 0, "packets": 0}
        self._of_others = self._rejected_of_others = 0

    @property
    def regions(self) -> list[Region]:
        """Where the regions that are followed were seen last, on the camera's clock."""
        return [to_camera_time(one.latest, self._clock.camera_us) for one in self._regions.alive]

    @property
    def places(self) -> dict[int, Region]:
        """Where the transmitters are that have a number and are in sight, by number."""
        numbers = ((self.framing.number_of(one), one.latest) for one in self._regions.alive)
        return {number: place for number, place in numbers if number is not None}

    @property
    def counts(self) -> dict[str, int]:
        """What was found so far, and dropped."""
        messages = self._messages.counts if self._messages is not None else {}
        found = self._regions.counts | self.framing.counts
        found["frames"] -= self._queue.frames_cut
        found["frames_at_end"] = self._queue.frames_cut
        if self.name:
            found["frames"] -= self._of_others
            found["frames_of_others"] = self._of_others + self._rejected_of_others
        return found | self._given | messages

    def __bool__(self) -> bool:
        """Whether anything waits for the next step."""
        return bool(self._regions.alive or self._queue)

    def step(
        self, step: TimeStep, occupied: Sequence[Region] = (), owning: Collection[int] = ()
    ) -> list[Packet]:
        """Follow the regions through a time step; receive and decode what they send.

        `taken` are places that other links hold, `owning` the numbers of the transmitters that own theirs.
        """
        if step.after_gap:
            self._regions.skip_gap()
        if occupied:
            self._leave(occupied, owning)
        if self._announcer is not None:
            self._announcer.start_clock()
        self.framing.apply_pending(step.start_us)
        regions = self._regions.step(step.start_us, step.events, occupied)
        if self._announcer is not None:
            for region in regions:
                self._announcer.announce("regions", region.latest)
        self.framing.step(regions, step)
        return self._queue.step()

    def _leave(self, occupied: Sequence[Region], owning: Collection[int]) -> None:
        """Let regions go in places that are others', but for those of transmitters that own theirs."""
        for region in list(self._regions.alive):
            if self.framing.number_of(region) in owning:
                continue
            if any(is_same_place(region.latest, place) for place in occupied):
                self._regions.drop(region)
                self.framing.forget_region(region)

    def end_at(self, end_us: float) -> None:
        """Let the stream end at a time, us: frames that are cut by it are not given."""
        if self.framing.drops_cut_frames:
            self._queue.stream_end_us = end_us

    def finish(self) -> list[Packet]:
        """End the stream's events; give the packets that were still incomplete."""
        self.framing.close()
        return self._queue.close()

    def read(self, packets: list[Packet]) -> list[Packet]:
        """Read the messages that packets carry."""
        read = []
        for packet in packets:
            self._given["packets"] += 1
            alike = packet.echo_of is None and self._queue.reflections.has_twin(packet.transmitter)
            self._given["frames_alike"] += len(packet.frames) * alike
            self._given["frames_reflected"] += len(packet.frames) * (packet.echo_of is not None)
            packet = replace_fields(packet, t_us=self._clock.camera_us(packet.t_us))
            if self._announcer is not None:
                self._announcer.start_clock()
            if self._messages is not None:
                packet = self._messages.add(packet)
            if self._announcer is not None:
                for message in packet.messages:
                    self._announcer.announce("message", message)
            read.append(packet)
        return read

    def refuse(self, packet: Packet) -> None:
        """Count a packet that another link fits better."""
        self._of_others += len(packet.frames)
        self._rejected_of_others += self.framing.discard_misses(number=packet.transmitter)

    def discard_place(self, place: Region) -> None:
        """Count frames that were rejected in another link's place apart from those that no link reads."""
        self._rejected_of_others += self.framing.discard_misses(place=place)

    def close(self) -> None:
        """End the stream: what messages still lack is missing."""
        if self._messages is not None:
            self._messages.close()
        # Whoever draws or writes now needs the room.
        self._regions.close()
