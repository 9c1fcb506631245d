"""Several links at once, and which of them a packet is of: what explains most of the light in its place.

A region is tried by each link, and where codes or layouts are akin, more than one may read something there:
a bar by half of its clusters, symbols of another modulation, characters in what is none. So packets wait
until every link had its time to answer. What a packet explains of the light is the time of its clusters whose
symbols are right, by their LLRs: seconds of light are the same for all links, however many bits their symbols
have. A transmitter that explains half of its light holds its place: other links let their regions there go.
"""

from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.rx.regions import is_same_place
from evlcp_sdk.rx.rhythm import BlinkDetector
from evlcp_sdk.values import Frame, Packet, Region, replace_fields

_CLEARLY = 1.25
"""How many times more light one link explains than another before nothing else matters."""

_HELD = 2.0
"""What light counts of a link that holds the place: what wavers by less changes nothing."""

_OWNS = 0.5
"""Share of the light that a packet explains by which its transmitter holds its place."""

_MOST_KNOWN = 1024
"""Transmitters of which is known where they were last."""

_MOST_FRAMES = 4096
"""Frames that wait at a time; of more, the oldest are judged by what is known."""


def explained_us(packet: Packet, form: PacketFormat) -> float:
    """The light that a packet explains: the time of each cluster in which its symbols are right, us."""
    total = 0.0
    for frame in packet.frames:
        chips = form.info_chips + form.has_pilot(frame.frame) * form.pilot_chips
        right = np.exp(-np.logaddexp(0.0, -np.abs(frame.soft.llr.astype(np.float64))).sum(1))
        total += float(right[frame.soft.symbols >= 0].sum()) * chips * packet.chip_us
    return total


@dataclass(frozen=True, eq=False)
class Shown:
    """A packet that was decoded, and what it explains.

    Attributes:
        link: Number of its link; of two that fit alike, the one with fewer codewords counts, or the first.
        packet: The packet.
        place: Where its transmitter was when it was complete.
        from_us: Its start, us.
        until_us: Its end, us.
        leaves_us: When it is judged, us.
        light_us: What it explains, us.
        whole_us: All there is to explain, us.
    """

    link: int
    packet: Packet
    place: Region
    from_us: float
    until_us: float
    leaves_us: float
    light_us: float
    whole_us: float


class SeveralLinks:
    """Lets packets of several links wait until the slowest has answered, and says which fit their place best.

    Attributes:
        owning: Numbers of the transmitters that hold their places.
    """

    def __init__(self, links: Collection[Link], patience_us: float) -> None:
        self._links = tuple(links)
        self._gap_px = max(link.regions.merge_px for link in links)
        self._wait_us = patience_us + self._links[0].regions.step_us
        self._longest_us = max(link.packet.packet_chips * link.packet.chip_us for link in links)
        self._waiting: deque[Shown] = deque()
        self._judged: deque[Shown] = deque()
        self._frames = 0
        self._places: list[Mapping[int, Region]] = [{} for _ in links]
        self._known: dict[int, Region] = {}
        self.owning: set[int] = set()

    def __bool__(self) -> bool:
        """Whether anything waits."""
        return bool(self._waiting)

    def taken(self, link: int) -> list[Region]:
        """Places that transmitters of other links hold, with the gap below which areas are one."""
        return [
            self.around(place)
            for other, places in enumerate(self._places)
            if other != link
            for number, place in places.items()
            if number in self.owning
        ]

    def around(self, place: Region) -> Region:
        """A place with the gap below which areas are one."""
        return _grown(place, 2 * self._gap_px)

    def add(self, link: int, places: Mapping[int, Region], packets: Iterable[Packet], now_us: float) -> None:
        """Take where a link's transmitters are now, by their numbers, and the packets that it has decoded."""
        self._places[link] = places
        for number, place in places.items():
            self._known.pop(number, None)
            self._known[number] = place
        while len(self._known) > _MOST_KNOWN:
            number = next(iter(self._known))
            del self._known[number]
            self.owning.discard(number)
        form, clusters = self._links[link].packet, self._links[link].codebook.clusters
        for packet in packets:
            newest = packet.frames[-1]
            seen = self._known.get(packet.transmitter)
            size = (seen.width_px, seen.height_px) if seen is not None else (0.0, 0.0)
            place = Region(packet.transmitter, now_us, newest.x_px, newest.y_px, *size)
            long_us = form.packet_chips * packet.chip_us
            times = packet.t_us, packet.t_us + long_us, now_us + self._wait_us
            light_us = explained_us(packet, form)
            self._waiting.append(Shown(link, packet, place, *times, light_us, long_us * clusters))
            self._frames += len(packet.frames)

    def judge(self, now_us: float) -> Iterator[tuple[Shown, bool]]:
        """Give the packets that have waited long enough, and whether they fit."""
        while self._waiting and (self._waiting[0].leaves_us <= now_us or self._frames > _MOST_FRAMES):
            shown = self._waiting[0]
            fits = self._winner(shown) == shown.link
            self._frames -= len(shown.packet.frames)
            self._judged.append(self._waiting.popleft())
            owns = fits and shown.light_us >= _OWNS * shown.whole_us
            (self.owning.add if owns else self.owning.discard)(shown.packet.transmitter)
            yield shown, fits
        oldest_us = now_us - 2 * self._wait_us - self._longest_us
        while self._judged and (self._judged[0].leaves_us < oldest_us or len(self._judged) > _MOST_FRAMES):
            self._judged.popleft()

    def _winner(self, shown: Shown) -> int:
        """The link that explains most of the light in a packet's place about its time."""
        about = [
            other
            for other in (*self._judged, *self._waiting)
            if max(other.from_us - shown.until_us, shown.from_us - other.until_us) <= self._wait_us
        ]
        mine = [other for other in about if other.packet.transmitter == shown.packet.transmitter]
        rivals = {shown.packet.transmitter}
        rivals.update(
            other.packet.transmitter
            for other in about
            if other.link != shown.link and any(self._overlap(one, other) for one in mine)
        )
        light, whole = dict.fromkeys((shown.link,), 0.0), dict.fromkeys((shown.link,), 0.0)
        for other in about:
            if (number := other.packet.transmitter) in rivals:
                held = _HELD if number in self.owning else 1.0
                light[other.link] = light.get(other.link, 0.0) + held * other.light_us
                whole[other.link] = whole.get(other.link, 0.0) + other.whole_us
        best, *others = sorted(light)
        for one in others:
            if self._fits_better(one, best, light, whole):
                best = one
        return best

    def _fits_better(
        self, one: int, than: int, light: Mapping[int, float], whole: Mapping[int, float]
    ) -> bool:
        """Whether a link fits better: by the light that it explains, and by its share of all there is."""
        pairs = (
            (light[one], light[than]),
            (light[one] / whole[one], light[than] / whole[than]),
        )
        for mine, its in pairs:
            if mine > _CLEARLY * its:
                return True
            if its > _CLEARLY * mine:
                return False
        return len(self._links[one].codebook.codewords) < len(self._links[than].codebook.codewords)

    def _overlap(self, one: Shown, other: Shown) -> bool:
        """Whether two packets were in one place at one time: by their frames that are nearest in time."""
        if max(other.from_us - one.until_us, one.from_us - other.until_us) > 0:
            return False
        a, b = min(
            ((a, b) for a in one.packet.frames for b in other.packet.frames),
            key=lambda pair: abs(pair[0].t_us - pair[1].t_us),
        )
        here = _grown(replace_fields(one.place, x_px=a.x_px, y_px=a.y_px), self._gap_px)
        there = _grown(replace_fields(other.place, x_px=b.x_px, y_px=b.y_px), self._gap_px)
        return is_same_place(here, there)


def _grown(place: Region, by_px: float) -> Region:
    """A place that is wider and higher."""
    return replace_fields(place, width_px=place.width_px + by_px, height_px=place.height_px + by_px)


class EarlyFrames:
    """Tells frames in order: those of a transmitter that holds its place at once, others with their packet.

    Args:
        tell: Gets each frame once; None for nobody.

    Attributes:
        withdrawn: Frames that were told, of packets that another link took later.
    """

    def __init__(self, tell: Callable[[Frame], None] | None) -> None:
        self._tell = tell
        # By transmitter, by number of packet and frame; None for one that was told.
        self._known: OrderedDict[int, OrderedDict[tuple[int, int], Frame | None]] = OrderedDict()
        self.withdrawn = 0

    def decoded(self, frame: Frame, *, owns: bool) -> None:
        """Take a frame, in order of its transmitter's, which owns its place now or not."""
        known = self._known.setdefault(frame.transmitter, OrderedDict())
        known[frame.packet, frame.frame] = frame
        if len(known) > _MOST_FRAMES:
            known.popitem(last=False)
        self._known.move_to_end(frame.transmitter)
        if len(self._known) > _MOST_KNOWN:
            self._known.popitem(last=False)
        if owns:
            self._tell_waiting(frame.transmitter)

    def given(self, packet: Packet, *, owns: bool) -> None:
        """Take a packet that is given: tell those of its frames that were not; all that wait if it holds."""
        if self._tell is None:
            return
        told = self._forget(packet)
        for frame in packet.frames:
            if (frame.packet, frame.frame) not in told:
                self._tell(frame)
        if owns:
            self._tell_waiting(packet.transmitter)

    def refused(self, packet: Packet) -> None:
        """Take a packet that is not given: its frames are not told any more."""
        self.withdrawn += len(self._forget(packet))

    def _tell_waiting(self, number: int) -> None:
        assert self._tell is not None
        known = self._known.get(number, OrderedDict())
        for key, frame in known.items():
            if frame is not None:
                known[key] = None
                self._tell(frame)

    def _forget(self, packet: Packet) -> set[tuple[int, int]]:
        """Let go what is known of a packet's frames, and of earlier ones; give those of it that were told."""
        known = self._known.get(packet.transmitter, OrderedDict())
        over = {key: known.pop(key) for key in list(known) if key[0] <= packet.packet}
        return {key for key, frame in over.items() if key[0] == packet.packet and frame is None}


def share_detectors(links: Mapping[str, Link]) -> dict[str, BlinkDetector]:
    """One detector for all links with the same rhythm, by the name of each; none for others."""
    rhythms = {
        name: (link.packet.chip_us, link.regions.min_score, link.codebook.longest_gap_chips)
        for name, link in links.items()
    }
    camera = next(iter(links.values())).camera
    detectors = {
        rhythm: BlinkDetector(camera.width, camera.height, *rhythm, is_shared=True)
        for rhythm, number in Counter(rhythms.values()).items()
        if number > 1
    }
    return {name: detectors[rhythm] for name, rhythm in rhythms.items() if rhythm in detectors}
