"""The receiver: events in, packets out."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import pluggy

from evlcp_sdk.errors import StreamError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.several import named_links
from evlcp_sdk.rx.framer import StreamContext
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.rx.link_receiver import LinkReceiver
from evlcp_sdk.rx.multi import SeveralLinks
from evlcp_sdk.rx.timeline import Timeline, TimeStep
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog, attitude_source
from evlcp_sdk.utc import ClockZero
from evlcp_sdk.values import Events, Frame, Packet, Region


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
            late events can have come; only `echo_of` is by what is known then. Of several links, frames come
            with their packet until their transmitter holds its place; where another link takes that from it,
            the count `frames_withdrawn` has those told of packets that are not given. None for nobody.

    Attributes:
        left: Packets that were complete when an algorithm failed in the last `feed`, which did not give them.

    Raises:
        ConfigError: Links that cannot be received together, or nothing tells them apart.

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
    ) -> None:
        links = named_links(link)
        first = next(iter(links.values()))
        self._timeline = Timeline(first.regions.step_us, first.camera.width, first.camera.height, limits)
        self._clock = self._timeline.clock
        if len(links) > 1:
            limits = replace(limits, region_bytes=limits.region_bytes // len(links))
        stream = StreamContext(self._clock, attitude_source(attitude), clock_zero, hook, limits)
        self._several = SeveralLinks(links, stream, on_frame) if len(links) > 1 else None
        if self._several is None:
            self._receivers = [LinkReceiver(first, "", stream, on_frame=on_frame)]
        else:
            self._receivers = self._several.receivers
        self._closed = False
        self.left: list[Packet] = []

    @property
    def lit_us(self) -> dict[int, tuple[float, float]]:
        """Of each transmitter, the newest thousand of a link, by number, when its light was there.

        Starts of the first and the last frame that was due while it was, given or not, camera clock, us.
        """
        return {number: lit for one in self._receivers for number, lit in one.framing.lit.by_number.items()}

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
        withdrawn = {} if self._several is None else {"frames_withdrawn": self._several.early.withdrawn}
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
        if self._several is None:
            packets += self._receivers[0].read(self._receivers[0].finish())
        else:
            packets += self._several.close(self._clock.last_us)
        for one in self._receivers:
            one.close()
        return packets

    def _waits(self) -> bool:
        """Whether anything waits for the next step."""
        return any(self._receivers) or bool(self._several)

    def _due_us(self) -> float:
        """When the next frame can be decoded, us."""
        return min(one.framing.due_us for one in self._receivers)

    def _run(self, step: TimeStep) -> list[Packet]:
        """Give each link a time step; give the packets that are complete, of the links that fit."""
        if not step.whole:
            for one in self._receivers:
                one.framing.ahead(step)
            return []
        if self._several is not None:
            return self._several.step(step)
        (one,) = self._receivers
        return one.read(one.step(step))
