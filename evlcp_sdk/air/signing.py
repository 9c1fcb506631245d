"""Signed beacons: Ed25519 (RFC 8032), so that no lamp but the operator's can say where it is.

Needs the extra `sign` (package `cryptography`) to make keys, to sign, and to check against trusted keys.
"""

import hashlib
import os
import stat
import struct
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from evlcp_sdk.air.blocks import Kind, Message
from evlcp_sdk.errors import ConfigError, InputError, OutputError
from evlcp_sdk.files import write_new

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

__all__ = ["KEY_NAME_BYTES", "TrustedKeys", "make_key", "public_key", "read_key", "sign", "signed_bytes"]

KEY_NAME_BYTES = 8
"""Bytes that name a public key in a signature: the first of its SHA-256."""

_SIGNATURE_BYTES = 64
_KEY_BYTES = 32
_MOST_PEM_BYTES = 1 << 16
_OTHERS = 0o077
_DOMAIN = b"EVLCP beacon 1\0"
_SIGNED_HEAD = struct.Struct("<II4s")


def _check_installed() -> None:
    if find_spec("cryptography") is None:
        raise ConfigError("signed beacons need the extra: pip install 'evlcp-sdk[sign]'")


def make_key(path: Path) -> str:
    """Make a private key, write it as PEM (PKCS #8, for its owner's eyes only), return its public key in hex.

    Raises:
        ConfigError: The extra is not installed.
        OutputError: The file exists, or cannot be written.
    """
    _check_installed()
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    key = Ed25519PrivateKey.generate()
    text = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    try:
        write_new(text, path)
    except FileExistsError as fault:
        raise OutputError(f"{path}: exists; a key is not overwritten") from fault
    return public_key(key)


def read_key(path: Path) -> "Ed25519PrivateKey":
    """The private key of a PEM file.

    Raises:
        ConfigError: The extra is not installed.
        InputError: The file cannot be read, others than its owner may use it, or it holds no Ed25519 key
            without a password.
    """
    _check_installed()
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    try:
        with path.open("rb") as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            if mode & _OTHERS:
                raise InputError(
                    f"{path}: mode {mode:04o}, expected a private key that its owner alone can use: chmod 600"
                )
            text = file.read(_MOST_PEM_BYTES)
        key = serialization.load_pem_private_key(text, password=None)
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror}") from fault
    except (ValueError, TypeError, UnsupportedAlgorithm) as fault:
        raise InputError(f"{path}: expected an Ed25519 private key, PEM, without a password") from fault
    if not isinstance(key, Ed25519PrivateKey):
        raise InputError(f"{path}: expected an Ed25519 private key, found {type(key).__name__}")
    return key


def public_key(key: "Ed25519PrivateKey") -> str:
    """The public key of a private one, 64 hex digits: what `messages.trusted_keys` takes."""
    return key.public_key().public_bytes_raw().hex()


def signed_bytes(beacon: Message, codebook: bytes) -> bytes:
    """What a signature is over: all that a beacon's blocks say.

    Args:
        beacon: The beacon.
        codebook: First `DIGEST_BYTES` bytes of the codebook's digest.
    """
    return _DOMAIN + _SIGNED_HEAD.pack(beacon.transmitter_id, beacon.sequence, codebook) + beacon.payload


def sign(beacon: Message, codebook: bytes, key: "Ed25519PrivateKey") -> Message:
    """The signature of a beacon, a message with the beacon's own transmitter and sequence.

    Args:
        beacon: The beacon.
        codebook: First `DIGEST_BYTES` bytes of the codebook's digest.
        key: The operator's private key.
    """
    name = _key_name(key.public_key().public_bytes_raw())
    payload = name + key.sign(signed_bytes(beacon, codebook))
    return Message(Kind.SIGNATURE, beacon.transmitter_id, beacon.sequence, payload)


class TrustedKeys:
    """The public keys that a receiver trusts.

    Args:
        keys: Public keys, 64 hex digits each.

    Raises:
        ConfigError: A key is not valid, or there are keys and the extra is not installed.
    """

    def __init__(self, keys: tuple[str, ...]) -> None:
        self._keys: dict[bytes, bytes] = {}
        for i, text in enumerate(keys):
            try:
                key = bytes.fromhex(text)
            except ValueError:
                key = b""
            if len(key) != _KEY_BYTES:
                raise ConfigError(
                    f"messages.trusted_keys[{i}] = {text!r}: expected a public key of 64 hex digits,"
                    " as 'evlcp tx keygen' prints it"
                )
            self._keys[_key_name(key)] = key
        if keys:
            _check_installed()

    def check(self, beacon: Message, codebook: bytes, signature: Message) -> bool | None:
        """Whether a signature is that of a beacon; None if it names no trusted key.

        Args:
            beacon: The beacon.
            codebook: First `DIGEST_BYTES` bytes of the codebook's digest.
            signature: The message of kind SIGNATURE that came with it.
        """
        name, value = signature.payload[:KEY_NAME_BYTES], signature.payload[KEY_NAME_BYTES:]
        key = self._keys.get(name)
        if key is None:
            return None
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

        if len(value) != _SIGNATURE_BYTES:
            return False
        try:
            Ed25519PublicKey.from_public_bytes(key).verify(value, signed_bytes(beacon, codebook))
        except InvalidSignature:
            return False
        return True


def _key_name(key: bytes) -> bytes:
    return hashlib.sha256(key).digest()[:KEY_NAME_BYTES]
