"""One link's part of a receiver: the regions that it follows, what they send, and its messages."""

from collections.abc import Callable, Collection, Sequence

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import STEPS
from evlcp_sdk.rx.detected import DetectedRegions
from evlcp_sdk.rx.detection import RegionFollower
from evlcp_sdk.rx.followed import same_place
from evlcp_sdk.rx.framer import Framer, RegionTracker, StreamContext
from evlcp_sdk.rx.framing import PacketFraming
from evlcp_sdk.rx.inbox import MessageAssembler
from evlcp_sdk.rx.plugin_framing import PluginFraming
from evlcp_sdk.rx.reflections import ReflectionQueue, Reflections
from evlcp_sdk.rx.rhythm import Rhythm
from evlcp_sdk.rx.steps import Announcer, Steps, on_camera, tracker_of
from evlcp_sdk.rx.timeline import TimeStep
from evlcp_sdk.rx.transmitters import LOOKBACK_PACKETS
from evlcp_sdk.values import Frame, Packet, Region, changed


class LinkReceiver:
    """Follows the regions of a stream by one link, receives and decodes what they send, reads its messages.

    Args:
        link: The resolved configuration.
        name: Name of the link, that its frames have; empty for none.
        stream: What it is a part of.
        rhythm: Scores of the pixels, of another link in the same rhythm; None for its own.
        on_frame: Gets each frame as soon as it is decoded; None for nobody.

    Attributes:
        framing: What reads its frames.
    """

    def __init__(
        self,
        link: Link,
        name: str,
        stream: StreamContext,
        rhythm: Rhythm | None = None,
        on_frame: Callable[[Frame], None] | None = None,
    ) -> None:
        self.link, self.name = link, name
        self._clock = stream.clock
        self._announcer = Announcer(stream.hook, stream.clock.camera_us, on_frame)
        tracker = tracker_of(link)
        self._regions: RegionTracker
        follower: RegionFollower | None = None
        if link.algorithm("detection").rhythmic:
            self._regions = follower = RegionFollower(
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
            self._regions = DetectedRegions(link, stream.limits)
        self._queue = ReflectionQueue(Reflections(link.packet, len(link.codebook.codewords)))
        self.framing: Framer
        if link.algorithm("framing").roles >= STEPS:
            steps = Steps(link, self._announcer, tracker)
            self.framing = PacketFraming(
                link, name, stream, steps, self._regions, follower, self._queue, self._announcer
            )
        else:
            self.framing = PluginFraming(link, name, stream, self._queue, self._announcer)
        self._messages = MessageAssembler.of(link, stream.clock_zero)
        self._given = {"frames_reflected": 0, "packets": 0}
        self._of_others = self._rejected_of_others = 0

    @property
    def regions(self) -> list[Region]:
        """Where the regions that are followed were seen last, on the camera's clock."""
        return [on_camera(one.latest, self._clock.camera_us) for one in self._regions.alive]

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
        found["frames"] -= self._queue.cut
        found["frames_at_end"] = self._queue.cut
        if self.name:
            found["frames"] -= self._of_others
            found["frames_of_others"] = self._of_others + self._rejected_of_others
        return found | self._given | messages

    def __bool__(self) -> bool:
        """Whether anything waits for the next step."""
        return bool(self._regions.alive or self._queue)

    def step(
        self, step: TimeStep, taken: Sequence[Region] = (), owning: Collection[int] = ()
    ) -> list[Packet]:
        """Follow the regions through a time step; receive and decode what they send.

        Args:
            step: The events.
            taken: Places that other links hold.
            owning: Numbers of the transmitters that own theirs.
        """
        if step.after_gap:
            self._regions.skip()
        if taken:
            self._leave(taken, owning)
        self._announcer.start()
        regions = self._regions.step(step.start_us, step.events, taken)
        for region in regions:
            self._announcer.lap("regions", region.latest)
        self.framing.step(regions, step)
        return self._queue.step()

    def _leave(self, taken: Sequence[Region], owning: Collection[int]) -> None:
        """Let regions go in places that are others', but for those of transmitters that own theirs."""
        for region in list(self._regions.alive):
            if self.framing.number_of(region) in owning:
                continue
            if any(same_place(region.latest, place) for place in taken):
                self._regions.drop(region)
                self.framing.let_go(region)

    def end_at(self, end_us: float) -> None:
        """Let the stream end at a time, us: frames that are cut by it are not given."""
        if self.framing.cut_by_the_end:
            self._queue.ends_us = end_us

    def finish(self) -> list[Packet]:
        """End the stream's events; give the packets that were still incomplete."""
        self.framing.close()
        return self._queue.close()

    def read(self, packets: list[Packet]) -> list[Packet]:
        """Read the messages that packets carry."""
        self._given["packets"] += len(packets)
        self._given["frames_reflected"] += sum(len(p.frames) for p in packets if p.echo_of is not None)
        packets = [changed(packet, t_us=self._clock.camera_us(packet.t_us)) for packet in packets]
        if self._messages is None:
            return packets
        read = []
        for packet in packets:
            self._announcer.start()
            read.append(self._messages.add(packet))
            for message in read[-1].messages:
                self._announcer.lap("message", message)
        return read

    def refuse(self, packet: Packet) -> None:
        """Count a packet that another link fits better."""
        self._of_others += len(packet.frames)
        self._rejected_of_others += self.framing.discard(number=packet.transmitter)

    def discard_place(self, place: Region) -> None:
        """Count frames that were rejected in another link's place apart from those that no link reads."""
        self._rejected_of_others += self.framing.discard(place=place)

    def close(self) -> None:
        """End the stream: what messages still lack is missing."""
        if self._messages is not None:
            self._messages.close()
        # Whoever draws or writes now needs the room.
        self._regions.close()
