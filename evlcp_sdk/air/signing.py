"""Signed beacons: Ed25519 (RFC 8032), so that no lamp but the operator's can give its position.

Needs the extra `sign` (package `cryptography`) to make keys, to sign, and to verify.
"""

import hashlib
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from evlcp_sdk.air.blocks import Kind, Message
from evlcp_sdk.errors import ConfigError, InputError, import_extra
from evlcp_sdk.files import read_secret, write_secret

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

KEY_NAME_BYTES = 8
"""Bytes that name a public key in a signature: the first of its SHA-256."""

_KEY_BYTES = 32
_MAX_PEM_BYTES = 1 << 16
_DOMAIN = b"EVLCP beacon 1\0"
_SIGNED_HEAD = struct.Struct("<II4s")


def _require_cryptography() -> None:
    import_extra("cryptography", "sign", "signed beacons")


def make_key(path: Path) -> str:
    """Write a new private key as PEM (PKCS #8, readable by its owner alone); return its public key in hex.

    Raises:
        ConfigError: The extra is not installed.
        OutputError: The file exists, or cannot be written.
    """
    _require_cryptography()
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    key = Ed25519PrivateKey.generate()
    text = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    write_secret(text, path)
    return public_key(key)


def read_key(path: Path) -> "Ed25519PrivateKey":
    """The private key of a PEM file.

    Raises:
        ConfigError: The extra is not installed.
        InputError: The file cannot be read, is accessible to others than its owner, or holds no Ed25519 key
            without a password.
    """
    _require_cryptography()
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    text = read_secret(path, _MAX_PEM_BYTES)
    try:
        key = serialization.load_pem_private_key(text, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as fault:
        raise InputError(f"{path}: expected an Ed25519 private key, PEM, without a password") from fault
    if not isinstance(key, Ed25519PrivateKey):
        raise InputError(f"{path}: expected an Ed25519 private key, found {type(key).__name__}")
    return key


def public_key(key: "Ed25519PrivateKey") -> str:
    """The public key of a private one, 64 hex digits, for `messages.trusted_keys`."""
    return key.public_key().public_bytes_raw().hex()


def signature_input(beacon: Message, codebook: bytes) -> bytes:
    """The bytes that a beacon's signature covers, with the first `DIGEST_BYTES` of the codebook's digest."""
    return _DOMAIN + _SIGNED_HEAD.pack(beacon.transmitter_id, beacon.sequence, codebook) + beacon.payload


def sign(beacon: Message, codebook: bytes, key: "Ed25519PrivateKey") -> Message:
    """The signature of a beacon, a message with its transmitter and sequence, by the operator's private key.

    `codebook` are the first `DIGEST_BYTES` bytes of the codebook's digest.
    """
    name = _key_name(key.public_key().public_bytes_raw())
    payload = name + key.sign(signature_input(beacon, codebook))
    return Message(Kind.SIGNATURE, beacon.transmitter_id, beacon.sequence, payload)


@dataclass(frozen=True)
class TrustedKey:
    """A public key that a receiver trusts, and what it may sign: a `[[messages.trusted_keys]]` of a link.

    A key with several of these may sign what any of them allows.

    Raises:
        ConfigError: The key or a time is invalid, the area incomplete, or a range empty.

    >>> TrustedKey("00" * 32, first_id=7, last_id=9, valid_to="2030-01-01").covers_id(8)
    True
    """

    key: Annotated[str, Field(description="The public key, 64 hex digits.")]
    first_id: Annotated[
        int, Field(ge=0, lt=2**32, description="First transmitter id that it may sign for.")
    ] = 0
    last_id: Annotated[
        int, Field(ge=0, lt=2**32, description="Last transmitter id that it may sign for.")
    ] = 2**32 - 1
    latitude_deg: Annotated[
        float | None, Field(ge=-90, le=90, description="Latitude of the centre of its area, WGS-84.")
    ] = None
    longitude_deg: Annotated[float | None, Field(ge=-180, le=180, description="Its longitude.")] = None
    radius_m: Annotated[
        float | None, Field(gt=0, le=2e7, description="Radius of the area; without these three, anywhere.")
    ] = None
    valid_from: Annotated[
        str, Field(description="Time from which it is valid, UTC by default; empty: always.")
    ] = ""
    valid_to: Annotated[str, Field(description="Time until which it is valid, likewise.")] = ""

    def __post_init__(self) -> None:
        _parse_public_key(self.key, "messages.trusted_keys: key")
        begin, end = self._validity
        for name, low, high, shown in (
            ("last_id", self.first_id, self.last_id, f"first_id, {self.first_id}"),
            ("valid_to", begin, end, f"valid_from, {self.valid_from}"),
        ):
            if high < low:
                value = getattr(self, name)
                raise ConfigError(f"messages.trusted_keys: {name} = {value!r}: expected not before {shown}")
        if (self.latitude_deg, self.longitude_deg, self.radius_m).count(None) not in (0, 3):
            raise ConfigError(
                "messages.trusted_keys: latitude_deg, longitude_deg, radius_m of an area: give all or none"
            )

    @property
    def area(self) -> tuple[float, float, float] | None:
        """Latitude and longitude of the centre, degrees, and the radius, m; None: anywhere."""
        if self.latitude_deg is None or self.longitude_deg is None or self.radius_m is None:
            return None
        return self.latitude_deg, self.longitude_deg, self.radius_m

    def covers_id(self, transmitter_id: int) -> bool:
        """Whether the key may sign for a transmitter."""
        return self.first_id <= transmitter_id <= self.last_id

    def is_valid_at(self, time_s: float) -> bool:
        """Whether the key is valid at a time, seconds since 1970."""
        begin, end = self._validity
        return begin <= time_s <= end

    @property
    def _validity(self) -> tuple[float, float]:
        return (
            _parse_time_s(self.valid_from, "valid_from", -math.inf),
            _parse_time_s(self.valid_to, "valid_to", math.inf),
        )


def _parse_time_s(text: str, name: str, default: float) -> float:
    if not text:
        return default
    try:
        time = datetime.fromisoformat(text)
        return (time if time.tzinfo is not None else time.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError) as fault:
        raise ConfigError(
            f"messages.trusted_keys: {name} = {text!r}: expected a time such as 2027-01-01T00:00:00Z"
        ) from fault


def _parse_public_key(text: str, name: str) -> bytes:
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != _KEY_BYTES or len(text) != 2 * _KEY_BYTES:
        raise ConfigError(
            f"{name} = {text!r}: expected a public key of 64 hex digits, as 'evlcp tx keygen' prints it"
        )
    return key


class TrustedKeys:
    """The public keys that a receiver trusts, and those that are revoked.

    Args:
        trusted: Public keys, and what each may sign.
        revoked: Public keys whose beacons count as forged, whenever they were signed; 64 hex digits each.

    Raises:
        ConfigError: A key is invalid, or there are keys and the extra is not installed.
    """

    def __init__(self, trusted: Sequence[TrustedKey], revoked: Sequence[str] = ()) -> None:
        revoked_keys = [_parse_public_key(t, f"messages.revoked_keys[{i}]") for i, t in enumerate(revoked)]
        self._keys = {_key_name(key): key for key in revoked_keys}
        self._grants: dict[bytes, list[TrustedKey]] = {name: [] for name in self._keys}
        for grant in trusted:
            key = bytes.fromhex(grant.key)
            if key not in revoked_keys:
                self._keys[_key_name(key)] = key
                self._grants.setdefault(_key_name(key), []).append(grant)
        if self._keys:
            _require_cryptography()

    def find_grants(self, signature: Message) -> Sequence[TrustedKey]:
        """What the key that a signature names may sign; empty for a revoked key."""
        return self._grants[signature.payload[:KEY_NAME_BYTES]]

    def verify(self, beacon: Message, codebook: bytes, signature: Message) -> bool | None:
        """Whether the signature that came with a beacon is correct; None if it names no known key.

        `codebook` are the first `DIGEST_BYTES` bytes of the codebook's digest.
        """
        name, value = signature.payload[:KEY_NAME_BYTES], signature.payload[KEY_NAME_BYTES:]
        key = self._keys.get(name)
        if key is None:
            return None
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

        try:
            Ed25519PublicKey.from_public_bytes(key).verify(value, signature_input(beacon, codebook))
        except InvalidSignature:
            return False
        return True


def _key_name(key: bytes) -> bytes:
    return hashlib.sha256(key).digest()[:KEY_NAME_BYTES]
