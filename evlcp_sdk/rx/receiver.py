"""The receiver: events in, packets out."""

from datetime import datetime

import pluggy

from evlcp_sdk.errors import StreamError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import Tracker
from evlcp_sdk.rx.detected import DetectedRegions
from evlcp_sdk.rx.detection import RegionFollower
from evlcp_sdk.rx.echoes import Echoes, EchoQueue
from evlcp_sdk.rx.framed import HeardFraming
from evlcp_sdk.rx.framing import PacketFraming
from evlcp_sdk.rx.guard import Guard
from evlcp_sdk.rx.inbox import MessageAssembler
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.rx.steps import Announcer, Steps, on_camera, tracker_of
from evlcp_sdk.rx.timeline import Timeline, TimeStep
from evlcp_sdk.rx.transmitters import LOOKBACK_PACKETS
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog, attitude_source
from evlcp_sdk.values import Events, Packet, Region, changed

__all__ = ["Receiver"]


class Receiver:
    """Decodes a stream of events, whatever pieces it comes in.

    The stream is cut into time steps on a fixed grid, so that any split of it gives the same packets.

    Args:
        link: The resolved configuration.
        hook: Where finished stages are announced (`Registry.hook`); None for nowhere.
        attitude: What is known of the camera's attitude, the same always or over time: how plumb bars lean
            against the sensor. None for nothing.
        clock_zero: UTC of the camera clock's 0, for the age of signed beacons; None if it is not known.
        limits: How much it holds at the most.

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
        link: Link,
        hook: pluggy.HookRelay | None = None,
        *,
        attitude: Attitude | AttitudeLog | None = None,
        clock_zero: datetime | None = None,
        limits: Limits = LIMITS,
    ) -> None:
        self._timeline = Timeline(link.regions.step_us, link.camera.width, link.camera.height, limits)
        self._clock = self._timeline.clock
        self._announcer = Announcer(hook, self._clock.camera_us)
        tracker = tracker_of(link)
        self._regions = _regions_of(link, tracker, limits)
        self._judged = EchoQueue(Echoes(link.packet, len(link.codebook.codewords)))
        guard = Guard(link, "framing", may_refuse=True)
        with guard:
            deframer = link.algorithm("framing").compile(link.codebook, link.packet)
        self._framing: PacketFraming | HeardFraming
        if deframer is None:
            self._framing = PacketFraming(
                link,
                Steps(link, self._announcer, tracker),
                self._regions,
                self._judged,
                self._clock,
                self._announcer,
                attitude_source(attitude),
                limits,
            )
        else:
            self._framing = HeardFraming(link, deframer, self._judged, self._clock, self._announcer)
        self._messages = MessageAssembler.of(link, clock_zero)
        self._closed = False
        self._given = {"frames_reflected": 0, "packets": 0}

    @property
    def lit_us(self) -> dict[int, tuple[float, float]]:
        """Of each transmitter, the newest thousand, by number, when its light was there.

        Starts of the first and the last frame that was due while it was, given or not, camera clock, us.
        """
        return self._framing.lit.by_number

    @property
    def regions(self) -> tuple[Region, ...]:
        """Where the regions that are followed were seen last, on the camera's clock."""
        return tuple(on_camera(one.latest, self._clock.camera_us) for one in self._regions.alive)

    @property
    def ranging_every(self) -> int:
        """The distance of every n-th frame with a pilot is measured, 1: of all; for when time is short."""
        return self._framing.ranging_every

    @ranging_every.setter
    def ranging_every(self, every: int) -> None:
        self._framing.ranging_every = every

    @property
    def counts(self) -> dict[str, int]:
        """What was taken, found and dropped so far."""
        messages = self._messages.counts if self._messages is not None else {}
        dropped = {"dropped_crowded": self._timeline.dropped}
        found = self._regions.counts | self._framing.counts
        return self._clock.counts | dropped | found | self._given | messages

    def feed(self, events: Events) -> list[Packet]:
        """Take the next events of the stream; return the packets that are complete.

        Events before their predecessor in time, off the sensor, or on a clock that no others agree on, are
        dropped and counted.

        Raises:
            StreamError: The stream was closed, or a polarity is neither 0 nor 1.
        """
        if self._closed:
            raise StreamError("the receiver is closed: make a new one for a new stream")
        if len(events) and events.p.max() > 1:
            raise StreamError(f"events with polarity {events.p.max()}, expected 0 or 1")
        steps = self._timeline.feed(events, lambda: bool(self._regions.alive or self._judged))
        return self._read([packet for step in steps for packet in self._run(step)])

    def close(self) -> list[Packet]:
        """End the stream; return the packets that were still incomplete."""
        if self._closed:
            return []
        self._closed = True
        packets = [packet for step in self._timeline.close() for packet in self._run(step)]
        self._framing.close()
        packets = self._read(packets + self._judged.close())
        if self._messages is not None:
            self._messages.close()
        # Whoever draws or writes now needs the room.
        self._regions.close()
        return packets

    def _run(self, step: TimeStep) -> list[Packet]:
        """Follow the regions through a time step; hear, and decode, what they send."""
        if step.after_gap:
            self._regions.skip()
        self._announcer.start()
        regions = self._regions.step(step.start_us, step.events)
        for region in regions:
            self._announcer.lap("regions", region.latest)
        self._framing.step(regions, step)
        return self._judged.step()

    def _read(self, packets: list[Packet]) -> list[Packet]:
        """Read the messages that packets carry."""
        self._given["packets"] += len(packets)
        self._given["frames_reflected"] += sum(len(p.frames) for p in packets if p.echo_of is not None)
        packets = [self._on_camera(packet) for packet in packets]
        if self._messages is None:
            return packets
        read = []
        for packet in packets:
            self._announcer.start()
            read.append(self._messages.add(packet))
            for message in read[-1].messages:
                self._announcer.lap("message", message)
        return read

    def _on_camera(self, packet: Packet) -> Packet:
        """A packet with the times of the camera's clock."""
        frames = tuple(on_camera(frame, self._clock.camera_us) for frame in packet.frames)
        return changed(packet, t_us=self._clock.camera_us(packet.t_us), frames=frames)


def _regions_of(link: Link, tracker: Tracker, limits: Limits) -> RegionFollower | DetectedRegions:
    """What finds and follows the regions of a stream."""
    with Guard(link, "detection", may_refuse=True):
        detector = link.algorithm("detection").compile(link.camera, link.codebook, link.packet)
    if detector is not None:
        return DetectedRegions(link, detector, limits)
    return RegionFollower(
        link.regions,
        link.camera,
        link.packet.chip_us,
        tracker.position,
        LOOKBACK_PACKETS * link.packet.packet_chips * link.packet.chip_us,
        limits,
        link.codebook.longest_gap_chips,
    )
