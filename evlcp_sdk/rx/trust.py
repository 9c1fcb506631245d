"""Verify beacons: by their signatures, what these keys may sign, and the beacons verified before."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Message
from evlcp_sdk.air.signing import TrustedKey, TrustedKeys
from evlcp_sdk.link.sections import MessageSpec
from evlcp_sdk.scene.sites import LocalAxes
from evlcp_sdk.values import Trust, remember_newest

_MAX_VERIFIED = 4096
"""Transmitter ids whose last verified beacon is remembered: those received last."""

_CLOCK_TOLERANCE_S = 300.0
"""How far the clocks of a transmitter and of a receiver may differ."""

_NEAR_DEG = 0.001
"""Bars whose latitudes differ by more are farther apart than any is long."""

_MINUTE_S, _HOUR_S, _DAY_S = 60, 3600, 86400


class TrustVerdict(NamedTuple):
    """How far a beacon can be trusted, and why it is not verified; empty where it is."""

    trust: Trust
    reason: str


@dataclass(frozen=True)
class _Verified:
    message: Message
    beacon: Beacon
    grants: Sequence[TrustedKey]


class BeaconVerifier:
    """Verifies beacons, and remembers the last verified one of each transmitter id.

    Args:
        spec: The trusted keys, and how old a beacon may be.
        codebook: First `DIGEST_BYTES` bytes of the codebook's digest.

    Raises:
        ConfigError: A key is not valid, or there are keys and the extra `sign` is not installed.
    """

    def __init__(self, spec: MessageSpec, codebook: bytes) -> None:
        self._spec = spec
        self._codebook = codebook
        self._keys = TrustedKeys(spec.trusted_keys, spec.revoked_keys)
        self._verified: dict[int, _Verified] = {}

    def verify(
        self, message: Message, beacon: Beacon, signature: Message | None, now_s: float | None
    ) -> TrustVerdict:
        """Verify a beacon, and remember it if it is verified.

        Args:
            message: The beacon as it was received.
            beacon: Its content.
            signature: The signature that came with it; None if there is none yet.
            now_s: When it was received, seconds since 1970; None if that is not known.
        """
        last = self._verified.get(message.transmitter_id)
        if last is not None and last.message == message:
            remember_newest(self._verified, message.transmitter_id, last, _MAX_VERIFIED)
            return self._check_time(message, last.grants, now_s)
        if last is not None and message.sequence < last.message.sequence:
            newer = last.message.sequence
            return TrustVerdict(
                "forged", f"replayed: sequence {message.sequence} is older than verified {newer}"
            )
        if last is not None and message.sequence == last.message.sequence:
            return TrustVerdict("forged", f"differs from the verified beacon of sequence {message.sequence}")
        verdict = self._check_signature(message, beacon, signature, now_s)
        if verdict.trust == "unverified":
            contradiction = self._find_contradiction(message, beacon)
            return TrustVerdict("forged", f"{contradiction}; {verdict.reason}") if contradiction else verdict
        return verdict

    def _check_signature(
        self, message: Message, beacon: Beacon, signature: Message | None, now_s: float | None
    ) -> TrustVerdict:
        """Verify a beacon by its signature alone."""
        if signature is None:
            return TrustVerdict("unverified", "no signature yet")
        is_good = self._keys.verify(message, self._codebook, signature)
        if is_good is None:
            return TrustVerdict("unverified", "signed by a key that is not trusted")
        if not is_good:
            return TrustVerdict("forged", "the signature is not that of this beacon")
        granted = self._keys.find_grants(signature)
        if not granted:
            return TrustVerdict("forged", "signed by a key that is revoked")
        grants = [one for one in granted if one.covers_id(message.transmitter_id)]
        if not grants:
            return TrustVerdict(
                "forged", f"signed by a key that is not for transmitter {message.transmitter_id}"
            )
        grants = [grant for grant in grants if _covers_place(grant, beacon)]
        if not grants:
            return TrustVerdict("forged", "signed by a key that is not for this place")
        if message.sequence < self._spec.oldest_sequence:
            oldest = f"messages.oldest_sequence {self._spec.oldest_sequence}"
            return TrustVerdict("forged", f"replayed: sequence {message.sequence} is older than {oldest}")
        verdict = self._check_time(message, grants, now_s)
        if verdict.trust == "verified":
            verified = _Verified(message, beacon, grants)
            remember_newest(self._verified, message.transmitter_id, verified, _MAX_VERIFIED)
        return verdict

    def _check_time(
        self, message: Message, grants: Sequence[TrustedKey], now_s: float | None
    ) -> TrustVerdict:
        """Verify the age of a good signature; the reasons do not change as time goes by."""
        signed_s, oldest_s = message.sequence, self._spec.max_age_s
        signed = f"signed {_format_utc(signed_s)}"
        grants = [grant for grant in grants if grant.is_valid_at(signed_s)]
        if not grants:
            return TrustVerdict("unverified", f"{signed}, when its key was not valid")
        if now_s is None:
            if oldest_s:
                unknown = "when it was received is not known"
                return TrustVerdict(
                    "unverified", f"{signed}; {unknown}, and messages.max_age_s = {oldest_s:g}"
                )
            return TrustVerdict("verified", "")
        if now_s < signed_s - _CLOCK_TOLERANCE_S:
            return TrustVerdict("unverified", f"{signed}, after it was received")
        if not any(grant.is_valid_at(max(now_s, signed_s)) for grant in grants):
            return TrustVerdict("unverified", f"{signed}; received when its key was not valid any more")
        if oldest_s and now_s - signed_s > oldest_s:
            return TrustVerdict("unverified", f"{signed}, longer ago than messages.max_age_s = {oldest_s:g}")
        return TrustVerdict("verified", "")

    def _find_contradiction(self, message: Message, beacon: Beacon) -> str:
        """How a beacon contradicts verified ones; empty where it does not."""
        last = self._verified.get(message.transmitter_id)
        if last is not None:
            known, number = last.beacon, last.message.sequence
            if known.place != beacon.place:
                return f"another place than the verified beacon of sequence {number}"
            if _attitude(known) != _attitude(beacon):
                return f"another attitude or length than the verified beacon of sequence {number}"
        for transmitter_id, other in self._verified.items():
            if transmitter_id != message.transmitter_id and _bars_overlap(other.beacon, beacon):
                return f"at the place of transmitter {transmitter_id}, whose beacon is verified"
        return ""


def describe_signature(message: Message, now_s: float | None) -> tuple[str, float | None]:
    """When a verified beacon was signed, in words, and how long before it was received, s; None if unknown.

    >>> from evlcp_sdk.air.blocks import Kind
    >>> describe_signature(Message(Kind.BEACON, 7, 1_800_000_000, b"1"), 1_800_007_200.0)
    ('signed 2027-01-15 08:00:00 UTC, 2 hours before it was received', 7200.0)
    """
    signed = f"signed {_format_utc(message.sequence)}"
    if now_s is None:
        return f"{signed}; when it was received is not known", None
    age_s = max(now_s - message.sequence, 0.0)
    return f"{signed}, {_format_span(age_s)} before it was received", age_s


def _format_utc(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(seconds))


def _format_span(seconds: float) -> str:
    for name, size in (("day", _DAY_S), ("hour", _HOUR_S), ("minute", _MINUTE_S)):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {name}s"
    return f"{seconds:.3g} s"


def _attitude(beacon: Beacon) -> tuple[float, float, float]:
    return beacon.heading_deg, beacon.tilt_deg, beacon.length_m


def _distance_m(place: tuple[float, float, float], other: tuple[float, float, float]) -> float:
    return float(np.linalg.norm(LocalAxes(*place).to_enu(*other)))


def _covers_place(grant: TrustedKey, beacon: Beacon) -> bool:
    area = grant.area
    if area is None:
        return True
    latitude_deg, longitude_deg, radius_m = area
    return _distance_m((latitude_deg, longitude_deg, beacon.height_m), beacon.place) <= radius_m


def _bars_overlap(verified: Beacon, other: Beacon) -> bool:
    """Whether two bars cannot both be there: their centres are within half the verified one's length."""
    if abs(verified.latitude_deg - other.latitude_deg) > _NEAR_DEG:
        return False
    return _distance_m(verified.place, other.place) < verified.length_m / 2
