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
from evlcp_sdk.rx.detector import DetectorTracker
from evlcp_sdk.rx.framer import Announcer, Framer, StreamContext, to_camera_time
from evlcp_sdk.rx.framing import PacketFramer
from evlcp_sdk.rx.guard import compile_tracker
from evlcp_sdk.rx.inbox import MessageAssembler
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.rx.multi import FrameReporter, LinkArbiter, share_detectors
from evlcp_sdk.rx.plugin_framing import PluginFramer
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
    several links, each tries every region; a packet is returned by the one that explains most of the light
    there, once each had its time to answer, and names that link.

    Packets are returned when they are complete. A frame is decoded as soon as its last events are there,
    before its time step is over, and reported at once.

    Args:
        link: The resolved configuration, or several of one camera.
        hook: Where finished stages are announced (`Registry.hook`); None for nowhere.
        attitude: The camera's attitude as far as it is known, constant or over time: how plumb bars are
            tilted against the sensor. None for nothing.
        clock_zero: UTC of the camera clock's 0, for the age of signed beacons; None if it is not known.
        limits: How much it holds at the most.
        on_frame: Gets each frame as soon as it is decoded, within `feed` or `close`, in order of a
            transmitter's frames. Its packet has the same later, unless the stream ends before the frame's
            late events can have come, or the transmitter turns out to have been reset before; only `echo_of`
            is by what is known then. Of several links, frames come with their packet until their transmitter
            owns its place; where another link takes that from it, the count `frames_withdrawn` has those
            reported of packets that are not returned. None for nobody.
        workers: Processes at work, this one among them: more than one decode whole bars, with the same
            results; each takes a second or two to start, and a script that asks for them needs the usual
            `if __name__ == "__main__":`. Frames then come some time steps later to `on_frame`.

    Attributes:
        pending_packets: Packets that were complete when an algorithm failed in the last `feed`, which did not
            return them.

    Raises:
        ConfigError: Links that cannot be received together, or nothing tells them apart; several workers with
            a plugin that follows the stages.
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
        first = next(iter(links.values()))
        camera = first.camera
        self._timeline = Timeline(first.regions.step_us, camera.width, camera.height, limits.step_events)
        self._clock = clock = self._timeline.clock
        limits = replace(limits, region_bytes=limits.region_bytes // len(links))
        announcer = Announcer()
        if hook is not None and hook.evlcp_stage_finished.get_hookimpls():
            announcer = Announcer(hook.evlcp_stage_finished, clock.camera_us)
        self._workers = Workers.start(links, workers, has_announcer=not announcer.is_silent)
        bar_decoders = None if self._workers is None else self._workers.bar_decoders
        stream = StreamContext(
            clock, attitude_source(attitude), clock_zero, announcer, limits, bar_decoders=bar_decoders
        )
        self._reporter = FrameReporter(on_frame)
        self._arbiter: LinkArbiter | None = None
        if len(links) == 1:
            self._receivers = [LinkReceiver(first, "", stream, None, on_frame)]
        else:
            detectors, report = share_detectors(links), None if on_frame is None else self._add_frame
            self._receivers = [
                LinkReceiver(one, name, stream, detectors.get(name), report) for name, one in links.items()
            ]
            patience_us = max(one.framing.patience_us for one in self._receivers)
            self._arbiter = LinkArbiter(links.values(), patience_us)
        self._closed = False
        self.pending_packets: list[Packet] = []

    @property
    def lit_us(self) -> dict[int, tuple[float, float]]:
        """When the light of each transmitter was there, by number, of the newest thousand of a link.

        Starts of the first and the last frame that was due meanwhile, decoded or not, camera clock, us.
        """
        return {
            number: span for one in self._receivers for number, span in one.framing.light_spans_us.items()
        }

    @property
    def regions(self) -> tuple[Region, ...]:
        """Where the tracked regions were seen last, on the camera's clock."""
        return tuple(region for one in self._receivers for region in one.regions)

    @property
    def ranging_every(self) -> int:
        """Only every n-th frame with a pilot is ranged, which saves time; 1 for all."""
        return self._receivers[0].framing.ranging_every

    @ranging_every.setter
    def ranging_every(self, every: int) -> None:
        for one in self._receivers:
            one.framing.ranging_every = every

    @property
    def counts(self) -> dict[str, int]:
        """Events, frames and packets received and dropped so far, by all links together."""
        total: Counter[str] = Counter()
        for one in self._receivers:
            total.update(one.counts)
        dropped = {"dropped_crowded": self._timeline.dropped}
        withdrawn = {} if self._arbiter is None else {"frames_withdrawn": self._reporter.withdrawn}
        return self._clock.counts | dropped | dict(total) | withdrawn

    @property
    def link_counts(self) -> dict[str, dict[str, int]]:
        """Frames and packets received and dropped by each of several links, by name; none of a single one."""
        return {one.name: one.counts for one in self._receivers if one.name}

    def feed(self, events: Events) -> list[Packet]:
        """Decode the next events of the stream; return the packets that are complete.

        Events before their predecessor in time, off the sensor, or on a clock that no others agree on, are
        dropped and counted.

        Raises:
            StreamError: The stream was closed, or a polarity is neither 0 nor 1.
            PluginError: An algorithm failed; `pending_packets` were complete by then.
            WorkerError: A worker ended, or does not answer.
        """
        if self._closed:
            raise StreamError("the receiver is closed: make a new one for a new stream")
        if events.p.max(initial=0) > 1:
            raise StreamError(f"events with polarity {events.p.max()}, expected 0 or 1")
        self.pending_packets = []
        for step in self._timeline.feed(events, self._is_waiting, self._due_us):
            self.pending_packets += self._process_step(step)
        packets, self.pending_packets = self.pending_packets, []
        return packets

    def close(self) -> list[Packet]:
        """End the stream; return the packets that were still incomplete."""
        if self._closed:
            return []
        self._closed = True
        for one in self._receivers:
            one.set_stream_end(self._clock.last_us)
        packets = [packet for step in self._timeline.close() for packet in self._process_step(step)]
        last = [one.finish() for one in self._receivers]
        if self._arbiter is None:
            packets += self._receivers[0].read_messages(last[0])
        else:
            for number, candidates in enumerate(last):
                self._arbiter.add(number, {}, candidates, self._clock.last_us)
            packets += self._arbitrate(self._arbiter, math.inf)
        for one in self._receivers:
            one.close()
        self.end_workers()
        return packets

    def end_workers(self) -> None:
        """End the worker processes, of a stream that is not read to its end."""
        if self._workers is not None:
            self._workers.close()

    def _is_waiting(self) -> bool:
        """Whether anything waits for the next time step."""
        return any(self._receivers) or bool(self._arbiter)

    def _due_us(self) -> float:
        """When the next frame can be decoded, us."""
        return min([one.framing.due_us for one in self._receivers])

    def _process_step(self, step: TimeStep) -> list[Packet]:
        """Process a time step by each link; return the packets that are complete, of the links that fit."""
        if not step.is_whole:
            for one in self._receivers:
                one.framing.decode_early(step)
            return []
        arbiter = self._arbiter
        if arbiter is None:
            (one,) = self._receivers
            return one.read_messages(one.step(step))
        for number, one in enumerate(self._receivers):
            packets = one.step(step, arbiter.find_owned_places(number), arbiter.owners)
            arbiter.add(number, one.places, packets, step.end_us)
        return self._arbitrate(arbiter, step.end_us)

    def _arbitrate(self, arbiter: LinkArbiter, now_us: float) -> list[Packet]:
        """Read the packets of several links that fit by now, and count those that do not."""
        packets = []
        for candidate, fits in arbiter.decide(now_us):
            receiver = self._receivers[candidate.link]
            if not fits:
                receiver.reject_packet(candidate.packet)
                self._reporter.reject_packet(candidate.packet)
                continue
            packets += receiver.read_messages([candidate.packet])
            owns_place = candidate.packet.transmitter in arbiter.owners
            self._reporter.accept_packet(packets[-1], owns_place=owns_place)
            for other in self._receivers:
                if other is not receiver:
                    other.discard_misses(arbiter.extend_place(candidate.place))
        return packets

    def _add_frame(self, frame: Frame) -> None:
        """Report a frame of one of several links, or let it wait for its packet."""
        assert self._arbiter is not None
        self._reporter.add_frame(frame, owns_place=frame.transmitter in self._arbiter.owners)


class LinkReceiver:
    """Receives the packets of one link from a stream: tracks its regions, decodes them and reads messages.

    Its frames have the `name` of the link, empty for none, and go to `on_frame` as soon as they are decoded;
    `detector` is that of another link with the same rhythm.
    """

    def __init__(
        self,
        link: Link,
        name: str,
        stream: StreamContext,
        detector: BlinkDetector | None,
        on_frame: Callable[[Frame], None] | None,
    ) -> None:
        self.name = name
        self._clock, self._announcer = stream.clock, stream.announcer
        centre_filter = compile_tracker(link).position
        self._tracker: RegionTracker
        rhythm_tracker: RhythmTracker | None = None
        if link.algorithm("detection").rhythmic:
            self._tracker = rhythm_tracker = RhythmTracker(
                link.regions,
                link.camera,
                link.packet.chip_us,
                centre_filter,
                LOOKBACK_PACKETS * link.packet.packet_us,
                stream.limits,
                link.codebook.longest_gap_chips,
                detector,
            )
        else:
            self._tracker = DetectorTracker(link, stream.limits)
        self._queue = ReflectionQueue(Reflections(link.packet, len(link.codebook.codewords)))
        self.framing: Framer
        if link.algorithm("framing").roles >= STEPS:
            decoder = FrameDecoder(link, self._announcer)
            self.framing = PacketFramer(
                link, name, stream, decoder, self._tracker, rhythm_tracker, self._queue, on_frame
            )
        else:
            self.framing = PluginFramer(link, name, stream, self._queue, on_frame)
        self._messages = MessageAssembler.of(link, stream.clock_zero)
        self._packet_counts = {"frames_reflected": 0, "frames_alike": 0, "packets": 0}
        self._frames_of_others = self._misses_of_others = 0

    @property
    def regions(self) -> list[Region]:
        """Where the tracked regions were seen last, on the camera's clock."""
        return [to_camera_time(one.latest, self._clock.camera_us) for one in self._tracker.alive]

    @property
    def places(self) -> dict[int, Region]:
        """Places of the numbered transmitters that are in sight, by number."""
        numbers = ((self.framing.number_of(one), one.latest) for one in self._tracker.alive)
        return {number: place for number, place in numbers if number is not None}

    @property
    def counts(self) -> dict[str, int]:
        """Frames, packets and messages received and dropped so far."""
        messages = self._messages.counts if self._messages is not None else {}
        counts = self._tracker.counts | self.framing.counts
        counts["frames"] -= self._queue.frames_at_end
        counts["frames_at_end"] = self._queue.frames_at_end
        if self.name:
            counts["frames"] -= self._frames_of_others
            counts["frames_of_others"] = self._frames_of_others + self._misses_of_others
        return counts | self._packet_counts | messages

    def __bool__(self) -> bool:
        """Whether anything waits for the next time step."""
        return bool(self._tracker.alive or self._queue)

    def step(
        self, step: TimeStep, occupied: Sequence[Region] = (), owners: Collection[int] = ()
    ) -> list[Packet]:
        """Track the regions through a time step, decode what they send, and return the packets it completes.

        `occupied` are places that other links own, `owners` the numbers of the transmitters that own theirs.
        """
        if step.after_gap:
            self._tracker.skip_gap()
        if occupied:
            self._drop_regions(occupied, owners)
        if not self._announcer.is_silent:
            self._announcer.start_clock()
        self.framing.apply_pending(step.start_us)
        regions = self._tracker.step(step.start_us, step.events, occupied)
        for region in () if self._announcer.is_silent else regions:
            self._announcer.announce("regions", region.latest)
        self.framing.step(regions, step)
        return self._queue.step()

    def _drop_regions(self, occupied: Sequence[Region], owners: Collection[int]) -> None:
        """Drop the regions in places of other links, except those of transmitters that own theirs."""
        for region in list(self._tracker.alive):
            if self.framing.number_of(region) in owners:
                continue
            if any(is_same_place(region.latest, place) for place in occupied):
                self._tracker.drop(region)
                self.framing.forget_region(region)

    def set_stream_end(self, end_us: float) -> None:
        """Set when the stream ends, us: frames that this cuts are dropped."""
        if self.framing.drops_frames_at_end:
            self._queue.stream_end_us = end_us

    def finish(self) -> list[Packet]:
        """Decode what is left at the end of the stream; return the packets that were still incomplete."""
        self.framing.close()
        return self._queue.close()

    def read_messages(self, packets: list[Packet]) -> list[Packet]:
        """Count packets, and read the messages that they carry."""
        read = []
        for packet in packets:
            self._packet_counts["packets"] += 1
            has_twin = packet.echo_of is None and self._queue.reflections.has_twin(packet.transmitter)
            self._packet_counts["frames_alike"] += len(packet.frames) * has_twin
            self._packet_counts["frames_reflected"] += len(packet.frames) * (packet.echo_of is not None)
            packet = replace_fields(packet, t_us=self._clock.camera_us(packet.t_us))
            self._announcer.start_clock()
            if self._messages is not None:
                packet = self._messages.add(packet)
            for message in packet.messages:
                self._announcer.announce("message", message)
            read.append(packet)
        return read

    def reject_packet(self, packet: Packet) -> None:
        """Count a packet that another link fits better."""
        self._frames_of_others += len(packet.frames)
        self._misses_of_others += self.framing.discard_misses(number=packet.transmitter)

    def discard_misses(self, place: Region) -> None:
        """Count frames that were missed in another link's place as that link's."""
        self._misses_of_others += self.framing.discard_misses(place=place)

    def close(self) -> None:
        """End the stream: what messages still lack counts as missing."""
        if self._messages is not None:
            self._messages.close()
        # Whoever draws or writes now needs the memory.
        self._tracker.close()
