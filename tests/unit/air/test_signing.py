"""Signatures, held against `cryptography` itself; faults are one line."""

import hashlib
import struct
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest

from evlcp_sdk.air import signing
from evlcp_sdk.air.blocks import Kind, Message
from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.link.text import to_toml
from evlcp_sdk.plugin.registry import Registry

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
    trusted = signing.TrustedKeys([signing.TrustedKey(public)])
    assert trusted.verify(BEACON, DIGEST, signature) is True
    assert trusted.verify(BEACON, b"xxxx", signature) is False
    assert trusted.verify(Message(Kind.BEACON, 8, 42, BEACON.payload), DIGEST, signature) is False
    assert trusted.verify(Message(Kind.BEACON, 7, 43, BEACON.payload), DIGEST, signature) is False
    short = Message(Kind.SIGNATURE, 7, 42, signature.payload[:-1])
    assert trusted.verify(BEACON, DIGEST, short) is False
    assert signing.TrustedKeys(()).verify(BEACON, DIGEST, signature) is None
    other = signing.make_key(tmp_path / "other.pem")
    assert signing.TrustedKeys([signing.TrustedKey(other)]).verify(BEACON, DIGEST, signature) is None


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o620, 0o601])
def test_a_key_that_others_can_use_is_refused(mode: int, tmp_path: Path) -> None:
    path = tmp_path / "k.pem"
    signing.make_key(path)
    path.chmod(mode)
    with pytest.raises(InputError, match=rf"k.pem: mode {mode:04o}, expected .*its owner alone.*chmod 600"):
        signing.read_key(path)
    path.chmod(0o400)
    signing.read_key(path)


def test_what_is_no_key_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "k.pem"
    with pytest.raises(InputError, match="cannot be read"):
        signing.read_key(path)
    path.write_text("no key")
    path.chmod(0o600)
    with pytest.raises(InputError, match="expected an Ed25519 private key, PEM"):
        signing.read_key(path)
    for text in ("abc", "zz" * 32, "00" * 31, " ".join(["00"] * 32)):
        with pytest.raises(ConfigError, match=r"messages.trusted_keys: key = .* 64 hex digits"):
            signing.TrustedKey(text)
        with pytest.raises(ConfigError, match=r"messages.revoked_keys\[1\] = .* 64 hex digits"):
            signing.TrustedKeys((), ["00" * 32, text])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("key = 'ab'", "key = 'ab': expected a public key of 64 hex digits, as 'evlcp tx keygen'"),
        ("first_id = 9\nlast_id = 7", "last_id = 7: expected not before first_id, 9"),
        ("valid_from = 'noon'", "valid_from = 'noon': expected a time such as 2027-01-01T00:00:00Z"),
        ("valid_from = 2027-01-01\nvalid_to = 2026-12-31", "valid_to = '2026-12-31': expected not before"),
        ("latitude_deg = 35.0", "radius_m of an area: give all or none"),
    ],
)
def test_faults_of_trusted_keys_are_one_line(given: str, message: str, tmp_path: Path) -> None:
    key = "" if given.startswith("key") else f"key = '{'00' * 32}'\n"
    path = tmp_path / "link.toml"
    path.write_text(f"[[messages.trusted_keys]]\n{key}{given}\n")
    with pytest.raises(ConfigError) as refused:
        load_link(path)
    assert message in str(refused.value)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


def test_a_link_with_trusted_keys_is_written_and_read_back(tmp_path: Path) -> None:
    path = tmp_path / "link.toml"
    path.write_text(
        f"[messages]\nrevoked_keys = ['{'11' * 32}']\n[[messages.trusted_keys]]\nkey = '{'00' * 32}'\n"
        "valid_to = 2027-01-01T00:00:00+09:00\n"
        f"[[messages.trusted_keys]]\nkey = '{'22' * 32}'\nfirst_id = 7\nlast_id = 9\n"
        "latitude_deg = 35.0\nlongitude_deg = 137\nradius_m = 500.0\n"
    )
    link = load_link(path)
    first, second = link.messages.trusted_keys
    end_s = datetime(2026, 12, 31, 15, tzinfo=UTC).timestamp()
    assert [first.is_valid_at(end_s + s) for s in (-1e9, 0, 1)] == [True, True, False]
    assert [first.covers_id(i) for i in (0, 2**32 - 1)] == [True, True]
    assert [second.covers_id(i) for i in (6, 7, 9, 10)] == [False, True, True, False]
    assert (first.area, second.area) == (None, (35.0, 137.0, 500.0))
    again = tmp_path / "again.toml"
    again.write_text(to_toml(link, Registry.load()))
    assert load_link(again) == link


def test_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cryptography", None)
    for call in (
        lambda: signing.make_key(tmp_path / "k.pem"),
        lambda: signing.read_key(tmp_path / "k.pem"),
        lambda: signing.TrustedKeys([signing.TrustedKey("00" * 32)]),
        lambda: signing.TrustedKeys((), ["00" * 32]),
    ):
        with pytest.raises(ConfigError, match=r"pip install 'evlcp-sdk\[sign\]'"):
            call()
    # Who trusts no key needs no extra.
    assert signing.TrustedKeys(()).verify(BEACON, DIGEST, Message(Kind.SIGNATURE, 7, 42, bytes(72))) is None
