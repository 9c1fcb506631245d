"""How far a beacon may be believed: signatures, what their keys may sign, and what was known before."""

import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Message
from evlcp_sdk.air.signing import TrustedKey, TrustedKeys
from evlcp_sdk.link.sections import MessageSpec
from evlcp_sdk.scene.sites import LocalAxes
from evlcp_sdk.values import Trust

_MOST_VERIFIED = 4096
"""Transmitter ids whose last verified beacon is remembered; the one not received for longest makes way."""

_CLOCKS_APART_S = 300.0
"""How far the clocks of a transmitter and of a receiver may be apart."""

_NEAR_DEG = 0.001
"""Latitudes that are further apart are of bars that are further apart than any is long."""

_MINUTE_S, _HOUR_S, _DAY_S = 60, 3600, 86400


class Standing(NamedTuple):
    """How far a beacon may be believed, and why it is not verified; empty where it is."""

    trust: Trust
    why: str


@dataclass(frozen=True)
class _Verified:
    message: Message
    beacon: Beacon
    grants: Sequence[TrustedKey]


class BeaconJudge:
    """Judges beacons, and remembers the last verified one of each transmitter id.

    Args:
        spec: The keys that are trusted, and how old a beacon may be.
        codebook: First `DIGEST_BYTES` bytes of the codebook's digest.

    Raises:
        ConfigError: A key is not valid, or there are keys and the extra `sign` is not installed.
    """

    def __init__(self, spec: MessageSpec, codebook: bytes) -> None:
        self._spec = spec
        self._codebook = codebook
        self._keys = TrustedKeys(spec.trusted_keys, spec.revoked_keys)
        self._verified: OrderedDict[int, _Verified] = OrderedDict()

    def judge(
        self, message: Message, beacon: Beacon, signature: Message | None, now_s: float | None
    ) -> Standing:
        """How far a beacon may be believed; remembers it if it is verified.

        Args:
            message: The beacon as it was received.
            beacon: What it says.
            signature: The signature that came with it; None if there is none yet.
            now_s: When it was received, seconds since 1970; None if that is not known.
        """
        last = self._verified.get(message.transmitter_id)
        if last is not None and last.message == message:
            self._verified.move_to_end(message.transmitter_id)
            return self._in_time(message, last.grants, now_s)
        if last is not None and message.sequence < last.message.sequence:
            newer = last.message.sequence
            return Standing("forged", f"replayed: sequence {message.sequence} is older than verified {newer}")
        if last is not None and message.sequence == last.message.sequence:
            return Standing("forged", f"differs from the verified beacon of sequence {message.sequence}")
        found = self._signed(message, beacon, signature, now_s)
        if found.trust == "unverified":
            how = self._contradicts(message, beacon)
            return Standing("forged", f"{how}; {found.why}") if how else found
        return found

    def _signed(
        self, message: Message, beacon: Beacon, signature: Message | None, now_s: float | None
    ) -> Standing:
        """What a beacon's signature is worth, whatever was known before."""
        if signature is None:
            return Standing("unverified", "no signature yet")
        good = self._keys.verify(message, self._codebook, signature)
        if good is None:
            return Standing("unverified", "signed by a key that is not trusted")
        if not good:
            return Standing("forged", "the signature is not that of this beacon")
        if self._keys.is_revoked(signature):
            return Standing("forged", "signed by a key that is revoked")
        grants = [one for one in self._keys.find_grants(signature) if one.covers_id(message.transmitter_id)]
        if not grants:
            return Standing("forged", f"signed by a key that is not for transmitter {message.transmitter_id}")
        grants = [grant for grant in grants if _for_place(grant, beacon)]
        if not grants:
            return Standing("forged", "signed by a key that is not for this place")
        if message.sequence < self._spec.oldest_sequence:
            oldest = f"messages.oldest_sequence {self._spec.oldest_sequence}"
            return Standing("forged", f"replayed: sequence {message.sequence} is older than {oldest}")
        found = self._in_time(message, grants, now_s)
        if found.trust == "verified":
            self._verified[message.transmitter_id] = _Verified(message, beacon, grants)
            self._verified.move_to_end(message.transmitter_id)
            while len(self._verified) > _MOST_VERIFIED:
                self._verified.popitem(last=False)
        return found

    def _in_time(self, message: Message, grants: Sequence[TrustedKey], now_s: float | None) -> Standing:
        """What a good signature is worth at a time; the reasons do not change as time goes by."""
        signed_s, oldest_s = message.sequence, self._spec.max_age_s
        signed = f"signed {_utc(signed_s)}"
        grants = [grant for grant in grants if grant.is_valid_at(signed_s)]
        if not grants:
            return Standing("unverified", f"{signed}, when its key was not valid")
        if now_s is None:
            if oldest_s:
                unknown = "when it was received is not known"
                return Standing("unverified", f"{signed}; {unknown}, and messages.max_age_s = {oldest_s:g}")
            return Standing("verified", "")
        if now_s < signed_s - _CLOCKS_APART_S:
            return Standing("unverified", f"{signed}, after it was received")
        if not any(grant.is_valid_at(max(now_s, signed_s)) for grant in grants):
            return Standing("unverified", f"{signed}; received when its key was not valid any more")
        if oldest_s and now_s - signed_s > oldest_s:
            return Standing("unverified", f"{signed}, longer ago than messages.max_age_s = {oldest_s:g}")
        return Standing("verified", "")

    def _contradicts(self, message: Message, beacon: Beacon) -> str:
        """How a beacon contradicts what is verified; empty where it does not."""
        last = self._verified.get(message.transmitter_id)
        if last is not None:
            before, number = last.beacon, last.message.sequence
            if before.place != beacon.place:
                return f"another place than the verified beacon of sequence {number}"
            if _attitude(before) != _attitude(beacon):
                return f"another attitude or length than the verified beacon of sequence {number}"
        for transmitter_id, known in self._verified.items():
            if transmitter_id != message.transmitter_id and _overlap(known.beacon, beacon):
                return f"at the place of transmitter {transmitter_id}, whose beacon is verified"
        return ""


def signed_text(message: Message, now_s: float | None) -> tuple[str, float | None]:
    """When a verified beacon was signed, in words, and how long before it was received, s, if that is known.

    >>> from evlcp_sdk.air.blocks import Kind
    >>> signed_text(Message(Kind.BEACON, 7, 1_800_000_000, b"1"), 1_800_007_200.0)
    ('signed 2027-01-15 08:00:00 UTC, 2 hours before it was received', 7200.0)
    """
    signed = f"signed {_utc(message.sequence)}"
    if now_s is None:
        return f"{signed}; when it was received is not known", None
    age_s = max(now_s - message.sequence, 0.0)
    return f"{signed}, {_span(age_s)} before it was received", age_s


def _utc(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(seconds))


def _span(seconds: float) -> str:
    for name, size in (("day", _DAY_S), ("hour", _HOUR_S), ("minute", _MINUTE_S)):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {name}s"
    return f"{seconds:.3g} s"


def _attitude(beacon: Beacon) -> tuple[float, float, float]:
    return beacon.heading_deg, beacon.tilt_deg, beacon.length_m


def _apart_m(place: tuple[float, float, float], other: tuple[float, float, float]) -> float:
    return float(np.linalg.norm(LocalAxes(*place).to_enu(*other)))


def _for_place(grant: TrustedKey, beacon: Beacon) -> bool:
    area = grant.area
    if area is None:
        return True
    latitude_deg, longitude_deg, radius_m = area
    return _apart_m((latitude_deg, longitude_deg, beacon.height_m), beacon.place) <= radius_m


def _overlap(verified: Beacon, other: Beacon) -> bool:
    """Whether two bars cannot both be there: their centres are nearer than half the verified one's length."""
    if abs(verified.latitude_deg - other.latitude_deg) > _NEAR_DEG:
        return False
    return _apart_m(verified.place, other.place) < verified.length_m / 2
