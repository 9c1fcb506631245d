"""Arbitrate between several links: which of them a packet belongs to.

A region is tried by each link, and where codes or layouts are akin, more than one may read something there:
a bar by half of its clusters, symbols of another modulation, characters in what is none. So packets wait
until every link had its time to answer. The link that explains most of the light in a place wins. A packet
explains the time of its clusters whose symbols are right, by their LLRs: seconds of light are the same for
all links, however many bits their symbols have. A transmitter that explains half of its light owns its place:
other links drop their regions there.
"""

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.rx.regions import is_same_place
from evlcp_sdk.rx.rhythm import BlinkDetector
from evlcp_sdk.values import Frame, Packet, Region, remember_newest, replace_fields

_CLEARLY = 1.25
"""How many times more light one link explains than another before nothing else matters."""

_OWNER_WEIGHT = 2.0
"""Weight of the light of a link that owns the place: what wavers by less changes nothing."""

_OWNER_SHARE = 0.5
"""Share of the light that a packet explains from which on its transmitter owns its place."""

_MAX_TRANSMITTERS = 1024
"""Transmitters whose last places are known."""

_MAX_FRAMES = 4096
"""Frames that wait at a time; of more, the oldest are decided early."""


def light_explained_us(packet: Packet, form: PacketFormat) -> float:
    """The light that a packet explains: the time of each cluster in which its symbols are right, us."""
    total = 0.0
    for frame in packet.frames:
        chips = form.info_chips + form.has_pilot(frame.frame) * form.pilot_chips
        right = np.exp(-np.logaddexp(0.0, -np.abs(frame.soft.llr.astype(np.float64))).sum(1))
        total += float(right[frame.soft.symbols >= 0].sum()) * chips * packet.chip_us
    return total


@dataclass(frozen=True, eq=False)
class PacketCandidate:
    """A decoded packet of one link, and the light that it explains.

    Attributes:
        link: Number of its link; of two that fit alike, the one with fewer codewords counts, or the first.
        packet: The packet.
        place: Where its transmitter was when it was complete.
        start_us: Its start, us.
        end_us: Its end, us.
        decide_us: When it is decided whether it fits, us.
        light_us: The light that it explains, us.
        total_light_us: All light that there is to explain, us.
    """

    link: int
    packet: Packet
    place: Region
    start_us: float
    end_us: float
    decide_us: float
    light_us: float
    total_light_us: float


class LinkArbiter:
    """Holds packets of several links until the slowest has answered, and decides which fit their place best.

    Attributes:
        owners: Numbers of the transmitters that own their places.
    """

    def __init__(self, links: Collection[Link], patience_us: float) -> None:
        self._links = tuple(links)
        self._gap_px = max(link.regions.merge_px for link in links)
        self._wait_us = patience_us + self._links[0].regions.step_us
        self._longest_us = max(link.packet.packet_us for link in links)
        self._waiting: deque[PacketCandidate] = deque()
        self._decided: deque[PacketCandidate] = deque()
        self._frames = 0
        self._places: list[Mapping[int, Region]] = [{} for _ in links]
        self._last_places: dict[int, Region] = {}
        self.owners: set[int] = set()

    def __bool__(self) -> bool:
        """Whether any packet waits."""
        return bool(self._waiting)

    def find_owned_places(self, link: int) -> list[Region]:
        """Places that transmitters of other links own, extended as by `extend_place`."""
        return [
            self.extend_place(place)
            for other, places in enumerate(self._places)
            if other != link
            for number, place in places.items()
            if number in self.owners
        ]

    def extend_place(self, place: Region) -> Region:
        """A place with a seam of the gap below which areas are one."""
        return _extend_region(place, 2 * self._gap_px)

    def add(self, link: int, places: Mapping[int, Region], packets: Iterable[Packet], now_us: float) -> None:
        """Add the packets that a link has decoded, and where its transmitters are now, by their numbers."""
        self._places[link] = places
        for number, place in places.items():
            dropped = remember_newest(self._last_places, number, place, _MAX_TRANSMITTERS)
            self.owners.difference_update(dropped)
        form, clusters = self._links[link].packet, self._links[link].codebook.clusters
        for packet in packets:
            newest = packet.frames[-1]
            seen = self._last_places.get(packet.transmitter)
            size = (seen.width_px, seen.height_px) if seen is not None else (0.0, 0.0)
            place = Region(packet.transmitter, now_us, newest.x_px, newest.y_px, *size)
            long_us = form.packet_chips * packet.chip_us
            times = packet.t_us, packet.t_us + long_us, now_us + self._wait_us
            light_us = light_explained_us(packet, form)
            self._waiting.append(PacketCandidate(link, packet, place, *times, light_us, long_us * clusters))
            self._frames += len(packet.frames)

    def decide(self, now_us: float) -> Iterator[tuple[PacketCandidate, bool]]:
        """Yield the packets that have waited long enough, and whether they fit."""
        while self._waiting and (self._waiting[0].decide_us <= now_us or self._frames > _MAX_FRAMES):
            candidate = self._waiting[0]
            fits = self._find_best_link(candidate) == candidate.link
            self._frames -= len(candidate.packet.frames)
            self._decided.append(self._waiting.popleft())
            owns = fits and candidate.light_us >= _OWNER_SHARE * candidate.total_light_us
            (self.owners.add if owns else self.owners.discard)(candidate.packet.transmitter)
            yield candidate, fits
        oldest_us = now_us - 2 * self._wait_us - self._longest_us
        while self._decided and (self._decided[0].decide_us < oldest_us or len(self._decided) > _MAX_FRAMES):
            self._decided.popleft()

    def _find_best_link(self, candidate: PacketCandidate) -> int:
        """The link that explains most of the light in a packet's place around its time."""
        nearby = [
            other
            for other in (*self._decided, *self._waiting)
            if max(other.start_us - candidate.end_us, candidate.start_us - other.end_us) <= self._wait_us
        ]
        number = candidate.packet.transmitter
        mine = [other for other in nearby if other.packet.transmitter == number]
        rivals = {number} | {
            other.packet.transmitter
            for other in nearby
            if other.link != candidate.link and any(self._packets_overlap(one, other) for one in mine)
        }
        light, total = {candidate.link: 0.0}, {candidate.link: 0.0}
        for other in nearby:
            if (number := other.packet.transmitter) in rivals:
                weight = _OWNER_WEIGHT if number in self.owners else 1.0
                light[other.link] = light.get(other.link, 0.0) + weight * other.light_us
                total[other.link] = total.get(other.link, 0.0) + other.total_light_us
        best, *others = sorted(light)
        for link in others:
            if self._fits_better(link, best, light, total):
                best = link
        return best

    def _fits_better(
        self, link: int, other: int, light: Mapping[int, float], total: Mapping[int, float]
    ) -> bool:
        """Whether a link fits better than another: by the light that it explains, or its share of all."""
        for mine, its in (
            (light[link], light[other]),
            (light[link] / total[link], light[other] / total[other]),
        ):
            if mine > _CLEARLY * its:
                return True
            if its > _CLEARLY * mine:
                return False
        return len(self._links[link].codebook.codewords) < len(self._links[other].codebook.codewords)

    def _packets_overlap(self, one: PacketCandidate, other: PacketCandidate) -> bool:
        """Whether two packets were in one place at one time, by their frames that are nearest in time."""
        if max(other.start_us - one.end_us, one.start_us - other.end_us) > 0:
            return False
        a, b = min(
            ((a, b) for a in one.packet.frames for b in other.packet.frames),
            key=lambda pair: abs(pair[0].t_us - pair[1].t_us),
        )
        here = _extend_region(replace_fields(one.place, x_px=a.x_px, y_px=a.y_px), self._gap_px)
        there = _extend_region(replace_fields(other.place, x_px=b.x_px, y_px=b.y_px), self._gap_px)
        return is_same_place(here, there)


def _extend_region(place: Region, by_px: float) -> Region:
    return replace_fields(place, width_px=place.width_px + by_px, height_px=place.height_px + by_px)


class FrameReporter:
    """Reports frames in order: those of a transmitter that owns its place at once, others with their packet.

    Args:
        report: Gets each frame once; None for nobody.

    Attributes:
        withdrawn: Reported frames of packets that another link took later.
    """

    def __init__(self, report: Callable[[Frame], None] | None) -> None:
        self._report = report
        # By transmitter, then by number of packet and frame; None for a frame that was reported.
        self._frames: dict[int, dict[tuple[int, int], Frame | None]] = {}
        self.withdrawn = 0

    def add_frame(self, frame: Frame, *, owns_place: bool) -> None:
        """Add the next frame of a transmitter, which owns its place now or not."""
        frames = self._frames.get(frame.transmitter, {})
        remember_newest(frames, (frame.packet, frame.frame), frame, _MAX_FRAMES)
        remember_newest(self._frames, frame.transmitter, frames, _MAX_TRANSMITTERS)
        if owns_place:
            self._report_waiting(frame.transmitter)

    def accept_packet(self, packet: Packet, *, owns_place: bool) -> None:
        """Report the rest of a packet's frames; if its transmitter owns its place, all that wait, too."""
        if self._report is None:
            return
        reported = self._forget_packet(packet)
        for frame in packet.frames:
            if (frame.packet, frame.frame) not in reported:
                self._report(frame)
        if owns_place:
            self._report_waiting(packet.transmitter)

    def reject_packet(self, packet: Packet) -> None:
        """Report no more frames of a packet, which belongs to another link."""
        self.withdrawn += len(self._forget_packet(packet))

    def _report_waiting(self, number: int) -> None:
        assert self._report is not None
        frames = self._frames.get(number, {})
        for key, frame in frames.items():
            if frame is not None:
                frames[key] = None
                self._report(frame)

    def _forget_packet(self, packet: Packet) -> set[tuple[int, int]]:
        """Forget a packet's frames, and those of earlier ones; return which of its frames were reported."""
        frames = self._frames.get(packet.transmitter, {})
        past = {key: frames.pop(key) for key in list(frames) if key[0] <= packet.packet}
        return {key for key, frame in past.items() if key[0] == packet.packet and frame is None}


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
