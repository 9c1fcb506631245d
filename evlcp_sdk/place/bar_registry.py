"""Which bar a transmitter is, and where it stands: by the user's sites, or by its beacons."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evlcp_sdk.air.blocks import Message
from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.place.error_model import chi_square
from evlcp_sdk.scene.sites import BarSite, LocalAxes, site_of_transmitter
from evlcp_sdk.values import Packet, remember_newest

_LENGTH_SHARE = 0.01
"""Share by which a beacon's length may differ from its site's: a lone bar's distance is wrong by as much."""

_MAX_TRANSMITTERS = 1024
"""Transmitters whose beacons are remembered; then the one not received for longest is dropped."""

_ACCEPTED_TRUST = {"none": (), "verified": ("verified",), "any": ("verified", "lapsed", "unverified")}
"""Trust that each setting of `position.beacons` accepts."""


@dataclass
class _BeaconState:
    """What a transmitter's beacons have stated.

    Attributes:
        trust: Of `beacon`, the place that it states; `forged` shuts it out until a verified one comes;
            `lapsed`: it was verified, and its key or its age has run out since.
        verified: The beacon that was verified last.
        link: Name of the link of its packets.
    """

    transmitter_id: int | None = None
    beacon: BarSite | None = None
    trust: str = "unverified"
    verified: Message | None = None
    link: str = ""


class BarRegistry:
    """Where the transmitters of a receiver stand, by sites, or by beacons as far as these are trusted.

    Args:
        sites: Where bars stand.
        spec: Which beacons to accept, and sigmas.
        link: Name of the link of a receiver that has only one; empty for none.

    Attributes:
        forged: Messages so far that were forged.
    """

    def __init__(self, sites: Sequence[BarSite], spec: PositionSpec, link: str = "") -> None:
        self.forged = 0
        self._sites = tuple(sites)
        self._spec = spec
        self._only_link = link
        self._states: dict[int, _BeaconState] = {}

    @property
    def known_sites(self) -> dict[int, BarSite]:
        """Sites of the transmitters whose place is known."""
        found = {number: self.site_of(number) for number in sorted(self._states)}
        return {number: site for number, site in found.items() if site is not None}

    @property
    def ids(self) -> dict[int, int]:
        """Ids by transmitter, of those that sent theirs in a beacon that is not forged."""
        states = self._states.items()
        return {
            n: s.transmitter_id for n, s in states if s.transmitter_id is not None and s.trust != "forged"
        }

    @property
    def unseen_sites(self) -> tuple[BarSite, ...]:
        """The sites without a received transmitter."""
        seen = {id(self._match_site(number)) for number in self._states}
        return tuple(site for site in self._sites if id(site) not in seen)

    @property
    def contradictions(self) -> dict[int, str]:
        """How beacons contradict their sites, by transmitter; these transmitters are not used."""
        found = {number: self.contradiction_of(number) for number in sorted(self._states)}
        return {number: how for number, how in found.items() if how}

    def find_contradictions(self, sites: Sequence[BarSite]) -> dict[int, str]:
        """Find how beacons contradict other sites than the registry's, by id."""
        others = BarRegistry(sites, self._spec, self._only_link)
        others._states = self._states
        return {self.ids[number]: how for number, how in others.contradictions.items() if number in self.ids}

    def add_packet(self, packet: Packet) -> None:
        """Take in a packet's beacons; a reflection's transmitter is dropped."""
        if packet.echo_of is not None:
            self._states.pop(packet.transmitter, None)
            return
        state = self._states.get(packet.transmitter, _BeaconState())
        state.link = packet.link
        remember_newest(self._states, packet.transmitter, state, _MAX_TRANSMITTERS)
        for received in packet.messages:
            if received.trust == "forged":
                self.forged += 1
                state.trust, state.beacon = "forged", None
            if received.beacon is None:
                continue
            if (
                state.trust == "verified"
                and received.trust != "verified"
                and received.message == state.verified
            ):
                state.trust = "lapsed"
            if state.trust in ("forged", "verified", "lapsed") and received.trust != "verified":
                # Once signed or forged, only a signature counts.
                continue
            state.verified = received.message if received.trust == "verified" else None
            beacon = received.beacon
            state.transmitter_id, state.trust = received.message.transmitter_id, received.trust
            state.beacon = BarSite(
                state.transmitter_id, beacon.latitude_deg, beacon.longitude_deg, beacon.height_m,
                beacon.heading_deg % 360, beacon.tilt_deg, beacon.length_m,
                position_sigma_m=self._spec.beacon_sigma_m,
            )  # fmt: skip

    def is_verified(self, number: int) -> bool:
        """Whether the newest beacon that counts was signed by a trusted key."""
        return self._states[number].trust == "verified"

    def site_of(self, number: int) -> BarSite | None:
        """Where a received transmitter stands; None if that is unknown, or not trusted."""
        state = self._states[number]
        if state.trust == "forged" or self.contradiction_of(number):
            return None
        site = self._match_site(number)
        if site is None and state.trust in _ACCEPTED_TRUST[self._spec.beacons]:
            site = state.beacon
        return site

    def contradiction_of(self, number: int) -> str:
        """How a transmitter's own beacon contradicts its site; empty if it does not.

        A lamp away from its site, or two bars exchanged, would move the camera by as much. They disagree
        where their distance is more than both sigmas explain, at the probability of a false alarm.
        """
        site, beacon = self._match_site(number), self._states[number].beacon
        if site is None or beacon is None or self._spec.beacons == "none":
            return ""
        place = (beacon.latitude_deg, beacon.longitude_deg, beacon.height_m)
        distance_m = float(np.linalg.norm(LocalAxes.of([site]).to_enu(*place)))
        sigma = math.hypot(site.position_sigma_m or 0.0, self._spec.beacon_sigma_m)
        if distance_m > max(sigma, 1e-3) * math.sqrt(chi_square(self._spec.false_alarm, 3)):
            return f"transmitter {number} says that it is {distance_m:.2g} m from the site of its id"
        if abs(beacon.length_m - site.length_m) > _LENGTH_SHARE * site.length_m + 4 * site.length_sigma_m:
            lengths = f"{beacon.length_m:g} m long, its site {site.length_m:g} m"
            return f"transmitter {number} says that it is {lengths}"
        return ""

    def _match_site(self, number: int) -> BarSite | None:
        state = self._states[number]
        link = state.link or self._only_link
        sites = [site for site in self._sites if not link or site.link in (None, link)]
        # With several links, a transmitter may be the only one of its own.
        rivals = list(self._states.values())
        if all(site.link is not None for site in sites):
            rivals = [other for other in rivals if other.link == state.link]
        return site_of_transmitter(sites, number, state.transmitter_id, is_only=len(rivals) == 1)

    def link_of(self, number: int) -> str:
        """Name of the link of a transmitter's packets; empty if none was received."""
        state = self._states.get(number)
        return "" if state is None else state.link
