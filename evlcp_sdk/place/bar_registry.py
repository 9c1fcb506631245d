"""Which bar a transmitter is, and where it stands: by the user's sites, and by what beacons say."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evlcp_sdk.air.blocks import Message
from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.place.error_model import chi_square
from evlcp_sdk.scene.sites import BarSite, LocalAxes, site_of_transmitter
from evlcp_sdk.values import Packet

_LENGTH_SHARE = 0.01
"""Share by which a beacon's length may differ from its site's: a lone bar's distance is wrong by as much."""

_MOST_TRANSMITTERS = 1024
"""Transmitters whose beacons are remembered; the one not received for longest makes way."""

_BELIEVED = {"none": (), "verified": ("verified",), "any": ("verified", "lapsed", "unverified")}
"""Trust that `position.beacons` asks for."""


@dataclass
class _Sent:
    """What a transmitter's beacons said.

    Attributes:
        trust: How far `beacon`, its place by its own word, is believed; `forged` shuts it out until a
            verified one comes; `lapsed`: it was verified, and its key or its age has run out since.
        verified: The beacon that was verified last.
        link: Name of the link that its packets have.
    """

    transmitter_id: int | None = None
    beacon: BarSite | None = None
    trust: str = "unverified"
    verified: Message | None = None
    link: str = ""


class BarRegistry:
    """Where the transmitters of a receiver stand, by sites, or by beacons as far as they are believed.

    Args:
        link: Name of the link of a receiver that has one only; empty for none.

    Attributes:
        forged: Messages so far that were forged.
    """

    def __init__(self, sites: Sequence[BarSite], spec: PositionSpec, link: str = "") -> None:
        self.forged = 0
        self._sites = tuple(sites)
        self._spec = spec
        self._alone = link
        self._sent: dict[int, _Sent] = {}

    @property
    def stands_at(self) -> dict[int, BarSite]:
        """Where the transmitters stand of which that is known."""
        found = {number: self.site(number) for number in sorted(self._sent)}
        return {number: site for number, site in found.items() if site is not None}

    @property
    def ids(self) -> dict[int, int]:
        """Ids of the transmitters that said theirs and were not forged."""
        sent = self._sent.items()
        return {n: s.transmitter_id for n, s in sent if s.transmitter_id is not None and s.trust != "forged"}

    @property
    def unseen(self) -> tuple[BarSite, ...]:
        """The sites that no transmitter was received of."""
        seen = {id(self._listed(number)) for number in self._sent}
        return tuple(site for site in self._sites if id(site) not in seen)

    @property
    def contradicted(self) -> dict[int, str]:
        """Transmitters that are left out as their beacons contradict their sites, and how."""
        found = {number: self.contradiction(number) for number in sorted(self._sent)}
        return {number: how for number, how in found.items() if how}

    def contradicted_by(self, sites: Sequence[BarSite]) -> dict[int, str]:
        """How beacons contradict other sites than these here, by their ids."""
        others = BarRegistry(sites, self._spec, self._alone)
        others._sent = self._sent
        return {self.ids[number]: how for number, how in others.contradicted.items() if number in self.ids}

    def add_packet(self, packet: Packet) -> None:
        """Take what a packet's beacons say of its transmitter; a reflection is left out."""
        if packet.echo_of is not None:
            self._sent.pop(packet.transmitter, None)
            return
        sent = self._sent[packet.transmitter] = self._sent.pop(packet.transmitter, _Sent())
        sent.link = packet.link
        if len(self._sent) > _MOST_TRANSMITTERS:
            del self._sent[next(iter(self._sent))]
        for news in packet.messages:
            if news.trust == "forged":
                self.forged += 1
                sent.trust, sent.beacon = "forged", None
            if news.beacon is None or news.trust == "forged":
                continue
            if sent.trust == "verified" and news.trust != "verified" and news.message == sent.verified:
                sent.trust = "lapsed"
            if sent.trust in ("forged", "verified", "lapsed") and news.trust != "verified":
                # Once signed, or once forged, only a signature counts.
                continue
            sent.verified = news.message if news.trust == "verified" else None
            b = news.beacon
            sent.transmitter_id, sent.trust = news.message.transmitter_id, news.trust
            sent.beacon = BarSite(
                news.message.transmitter_id, b.latitude_deg, b.longitude_deg, b.height_m,
                b.heading_deg % 360, b.tilt_deg, b.length_m, position_sigma_m=self._spec.beacon_sigma_m,
            )  # fmt: skip

    def verified(self, number: int) -> bool:
        """Whether the newest beacon that counts was signed by a trusted key."""
        return self._sent[number].trust == "verified"

    def site(self, number: int) -> BarSite | None:
        """Where a transmitter that was received stands; None if that is not known, or not believed."""
        sent = self._sent[number]
        if sent.trust == "forged" or self.contradiction(number):
            return None
        site = self._listed(number)
        if site is None and sent.trust in _BELIEVED[self._spec.beacons]:
            site = sent.beacon
        return site

    def contradiction(self, number: int) -> str:
        """How a transmitter's own beacon contradicts its site; empty where it does not.

        A lamp that is not where its site is would move the camera by as much, and so would two bars that are
        mixed up. Beyond what the sigmas of both explain, with the chance of a false alarm, they disagree.
        """
        site, beacon = self._listed(number), self._sent[number].beacon
        if site is None or beacon is None or self._spec.beacons == "none":
            return ""
        place = (beacon.latitude_deg, beacon.longitude_deg, beacon.height_m)
        apart = float(np.linalg.norm(LocalAxes.of([site]).to_enu(*place)))
        sigma = math.hypot(site.position_sigma_m or 0.0, self._spec.beacon_sigma_m)
        if apart > max(sigma, 1e-3) * math.sqrt(chi_square(self._spec.false_alarm, 3)):
            return f"transmitter {number} says that it is {apart:.2g} m from the site of its id"
        if abs(beacon.length_m - site.length_m) > _LENGTH_SHARE * site.length_m + 4 * site.length_sigma_m:
            long = f"{beacon.length_m:g} m long, its site {site.length_m:g} m"
            return f"transmitter {number} says that it is {long}"
        return ""

    def _listed(self, number: int) -> BarSite | None:
        """The site of the list that a transmitter stands at."""
        sent = self._sent[number]
        link = sent.link or self._alone
        sites = [site for site in self._sites if not link or site.link in (None, link)]
        # Of several links, one may be the only one of its own.
        rivals = list(self._sent.values())
        if all(site.link is not None for site in sites):
            rivals = [other for other in rivals if other.link == sent.link]
        alone = len(rivals) == 1
        return site_of_transmitter(sites, number, sent.transmitter_id, is_only=alone)

    def link_of(self, number: int) -> str:
        """Name of the link that a transmitter's packets have; empty if none was received."""
        sent = self._sent.get(number)
        return "" if sent is None else sent.link
