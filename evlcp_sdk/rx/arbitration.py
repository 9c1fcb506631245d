"""Which of several links a packet is of: the one that explains most of the light in its place.

A region is tried by each link, and where codes or layouts are akin, more than one may read something there:
a bar by half of its clusters, symbols of another modulation, characters in what is none. So packets wait
until every link had its time to answer. What a packet explains of the light is the time of its clusters whose
symbols are right, by their LLRs: seconds of light are the same for all links, however many bits their symbols
have. A transmitter that explains half of its light holds its place: other links let their regions there go.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.rx.followed import same_place
from evlcp_sdk.values import Packet, Region, changed

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
    """How much of the light a packet explains: the time of each cluster in which its symbols are right, us.

    Args:
        packet: As it was decoded.
        form: Lengths of its parts.
    """
    total = 0.0
    for frame in packet.frames:
        chips = form.info_chips + form.has_pilot(frame.frame) * form.pilot_chips
        right = np.exp(-np.logaddexp(0.0, -np.abs(frame.soft.llr.astype(np.float64))).sum(1))
        total += float(right[frame.soft.symbols >= 0].sum()) * chips * packet.chip_us
    return total


@dataclass(frozen=True, eq=False)
class ArbitratedPacket:
    """A packet, and whether it is given.

    Attributes:
        link: Number of its link.
        packet: The packet.
        place: Where it is from, with the gap below which areas are one.
        fits: No other link explains more of the light there.
    """

    link: int
    packet: Packet
    place: Region
    fits: bool


@dataclass(frozen=True, eq=False)
class _Shown:
    """A packet that was decoded, and what it explains.

    Attributes:
        link: Number of its link.
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


class LinkArbiter:
    """Lets packets wait, and gives those of the link that fits their place.

    Args:
        links: The links; of two that fit alike, the one with fewer codewords counts, or the first.
        wait_us: How long a packet waits: until the slowest link has answered, us.
        step_us: Length of a time step, us.
    """

    def __init__(self, links: Sequence[Link], wait_us: float, step_us: int) -> None:
        self._forms = [link.packet for link in links]
        self._clusters = [link.codebook.clusters for link in links]
        self._codewords = [len(link.codebook.codewords) for link in links]
        self._gap_px = max(link.regions.merge_px for link in links)
        self._wait_us = wait_us + step_us
        self._longest_us = max(form.packet_chips * form.chip_us for form in self._forms)
        self._waiting: deque[_Shown] = deque()
        self._judged: deque[_Shown] = deque()
        self._frames = 0
        self._places: list[Mapping[int, Region]] = [{} for _ in links]
        self._known: dict[int, Region] = {}
        self._owning: set[int] = set()

    def __bool__(self) -> bool:
        """Whether anything waits."""
        return bool(self._waiting)

    @property
    def owning(self) -> set[int]:
        """Numbers of the transmitters that hold their places."""
        return self._owning

    def taken(self, link: int) -> list[Region]:
        """Places that transmitters of other links hold, with the gap below which areas are one."""
        return [
            _grown(place, 2 * self._gap_px)
            for other, places in enumerate(self._places)
            if other != link
            for number, place in places.items()
            if number in self._owning
        ]

    def see(self, link: int, places: Mapping[int, Region]) -> None:
        """Take where the transmitters of a link are now, by their numbers."""
        self._places[link] = places
        for number, place in places.items():
            self._known.pop(number, None)
            self._known[number] = place
        while len(self._known) > _MOST_KNOWN:
            number = next(iter(self._known))
            del self._known[number]
            self._owning.discard(number)

    def add(self, link: int, packets: Sequence[Packet], now_us: float) -> None:
        """Take packets that a link has decoded by now."""
        form = self._forms[link]
        for packet in packets:
            newest = packet.frames[-1]
            seen = self._known.get(packet.transmitter)
            size = (seen.width_px, seen.height_px) if seen is not None else (0.0, 0.0)
            place = Region(packet.transmitter, now_us, newest.x_px, newest.y_px, *size)
            long_us = form.packet_chips * packet.chip_us
            light_us, whole_us = explained_us(packet, form), long_us * self._clusters[link]
            times = packet.t_us, packet.t_us + long_us, now_us + self._wait_us
            self._waiting.append(_Shown(link, packet, place, *times, light_us, whole_us))
            self._frames += len(packet.frames)

    def step(self, now_us: float) -> list[ArbitratedPacket]:
        """Judge the packets that have waited long enough."""
        judged = []
        while self._waiting and (self._waiting[0].leaves_us <= now_us or self._frames > _MOST_FRAMES):
            shown = self._waiting[0]
            fits = self._winner(shown) == shown.link
            self._frames -= len(shown.packet.frames)
            self._judged.append(self._waiting.popleft())
            number = shown.packet.transmitter
            if fits and shown.light_us >= _OWNS * shown.whole_us:
                self._owning.add(number)
            else:
                self._owning.discard(number)
            judged.append(
                ArbitratedPacket(shown.link, shown.packet, _grown(shown.place, 2 * self._gap_px), fits)
            )
        oldest_us = now_us - 2 * self._wait_us - self._longest_us
        while self._judged and (self._judged[0].leaves_us < oldest_us or len(self._judged) > _MOST_FRAMES):
            self._judged.popleft()
        return judged

    def close(self) -> list[ArbitratedPacket]:
        """End the stream: judge all that waits."""
        return self.step(float("inf"))

    def _winner(self, shown: _Shown) -> int:
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
                held = _HELD if number in self._owning else 1.0
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
        return self._codewords[one] < self._codewords[than]

    def _overlap(self, one: _Shown, other: _Shown) -> bool:
        """Whether two packets were in one place at one time: by their frames that are nearest in time."""
        if max(other.from_us - one.until_us, one.from_us - other.until_us) > 0:
            return False
        a, b = min(
            ((a, b) for a in one.packet.frames for b in other.packet.frames),
            key=lambda pair: abs(pair[0].t_us - pair[1].t_us),
        )
        here = _grown(changed(one.place, x_px=a.x_px, y_px=a.y_px), self._gap_px)
        there = _grown(changed(other.place, x_px=b.x_px, y_px=b.y_px), self._gap_px)
        return same_place(here, there)


def _grown(place: Region, by_px: float) -> Region:
    """A place that is wider and higher."""
    return changed(place, width_px=place.width_px + by_px, height_px=place.height_px + by_px)
