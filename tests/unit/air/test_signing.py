"""Signatures, held against `cryptography` itself; faults are one line."""

import hashlib
import stat
import struct
from pathlib import Path

import pytest

from evlcp_sdk.air import signing
from evlcp_sdk.air.blocks import Kind, Message
from evlcp_sdk.errors import ConfigError, InputError, OutputError

ed25519 = pytest.importorskip(
    "cryptography.hazmat.primitives.asymmetric.ed25519", reason="the extra sign is not installed"
)

DIGEST = bytes.fromhex("a1b2c3d4")
BEACON = Message(Kind.BEACON, 7, 42, bytes(range(30)))


def test_a_signature_is_that_of_the_documented_bytes(tmp_path: Path) -> None:
    public = signing.make_key(tmp_path / "k.pem")
    key = signing.read_key(tmp_path / "k.pem")
    signature = signing.sign(BEACON, DIGEST, key)
    assert (signature.kind, signature.transmitter_id, signature.sequence) == (Kind.SIGNATURE, 7, 42)
    assert len(signature.payload) == 72
    assert signature.payload[:8] == hashlib.sha256(bytes.fromhex(public)).digest()[:8]
    signed = b"EVLCP beacon 1\0" + struct.pack("<II", 7, 42) + DIGEST + bytes(range(30))
    ed25519.Ed25519PublicKey.from_public_bytes(bytes.fromhex(public)).verify(signature.payload[8:], signed)
    trusted = signing.TrustedKeys((public,))
    assert trusted.check(BEACON, DIGEST, signature) is True
    assert trusted.check(BEACON, b"xxxx", signature) is False
    assert trusted.check(Message(Kind.BEACON, 8, 42, BEACON.payload), DIGEST, signature) is False
    assert trusted.check(Message(Kind.BEACON, 7, 43, BEACON.payload), DIGEST, signature) is False
    short = Message(Kind.SIGNATURE, 7, 42, signature.payload[:-1])
    assert trusted.check(BEACON, DIGEST, short) is False
    assert signing.TrustedKeys(()).check(BEACON, DIGEST, signature) is None
    other = signing.make_key(tmp_path / "other.pem")
    assert signing.TrustedKeys((other,)).check(BEACON, DIGEST, signature) is None


def test_a_key_is_its_owners_and_stays(tmp_path: Path) -> None:
    path = tmp_path / "k.pem"
    signing.make_key(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    before = path.read_bytes()
    with pytest.raises(OutputError, match="exists; a key is not overwritten"):
        signing.make_key(path)
    assert path.read_bytes() == before
    with pytest.raises(OutputError, match="cannot be written"):
        signing.make_key(tmp_path / "no" / "k.pem")


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o620, 0o601])
def test_a_key_that_others_can_use_is_refused(mode: int, tmp_path: Path) -> None:
    path = tmp_path / "k.pem"
    signing.make_key(path)
    path.chmod(mode)
    with pytest.raises(InputError, match=rf"k.pem: mode {mode:04o}, expected .*its owner alone.*chmod 600"):
        signing.read_key(path)
    path.chmod(0o400)
    signing.read_key(path)


def test_what_is_no_key_is_told(tmp_path: Path) -> None:
    path = tmp_path / "k.pem"
    with pytest.raises(InputError, match="cannot be read"):
        signing.read_key(path)
    path.write_text("no key")
    path.chmod(0o600)
    with pytest.raises(InputError, match="expected an Ed25519 private key, PEM"):
        signing.read_key(path)
    for text in ("abc", "zz" * 32, "00" * 31):
        with pytest.raises(ConfigError, match=r"messages.trusted_keys\[0\] = .* 64 hex digits"):
            signing.TrustedKeys((text,))


def test_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signing, "find_spec", lambda name: None)
    for call in (
        lambda: signing.make_key(tmp_path / "k.pem"),
        lambda: signing.read_key(tmp_path / "k.pem"),
        lambda: signing.TrustedKeys(("00" * 32,)),
    ):
        with pytest.raises(ConfigError, match=r"pip install 'evlcp-sdk\[sign\]'"):
            call()
    # Who trusts no key needs no extra.
    assert signing.TrustedKeys(()).check(BEACON, DIGEST, Message(Kind.SIGNATURE, 7, 42, bytes(72))) is None
