"""How far beacons are believed: what keys may sign, when, and what a verified one says of others."""

import calendar
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.air import signing
from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Kind, Message
from evlcp_sdk.air.signing import TrustedKey
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.link.sections import MessageSpec
from evlcp_sdk.rx.inbox import MessageAssembler
from evlcp_sdk.rx.trust import BeaconJudge, Standing
from tests.unit.rx.test_inbox import CODER, blocks_of, noisy, packet_of

PLACE = Beacon(35.1, 136.9, 52.0, 10.0, 0.0, 0.96, b"lane 2")
SIGNED_S = calendar.timegm((2026, 3, 1, 12, 0, 0))
DIGEST = bytes(4)
METRE_DEG = 1 / 111_000


class Operator:
    """A key and what it signs."""

    def __init__(self, path: Path) -> None:
        pytest.importorskip("cryptography", reason="the extra sign is not installed")
        self.public = signing.make_key(path)
        self._key = signing.read_key(path)

    def sign(self, message: Message, digest: bytes = DIGEST) -> Message:
        return signing.sign(message, digest, self._key)


@pytest.fixture(scope="module")
def operator(tmp_path_factory: pytest.TempPathFactory) -> Operator:
    return Operator(tmp_path_factory.mktemp("keys") / "k.pem")


def beacon_message(beacon: Beacon = PLACE, sequence: int = SIGNED_S, transmitter_id: int = 7) -> Message:
    return Message(Kind.BEACON, transmitter_id, sequence, beacon.pack())


def judged(
    operator: Operator, now_s: float | None = None, sequence: int = SIGNED_S, **may: object
) -> Standing:
    """What is thought of the operator's beacon, whose key may sign so much."""
    spec: dict[str, object] = {name: may.pop(name) for name in ("max_age_s", "revoked_keys") if name in may}
    trusted = TrustedKey(operator.public, **may)  # type: ignore[arg-type]
    judge = BeaconJudge(MessageSpec(trusted_keys=(trusted,), **spec), DIGEST)  # type: ignore[arg-type]
    message = beacon_message(sequence=sequence)
    return judge.judge(message, PLACE, operator.sign(message), now_s)


@pytest.mark.parametrize(
    ("first", "last", "trust"),
    [(0, 6, "forged"), (0, 7, "verified"), (7, 7, "verified"), (7, 9, "verified"), (8, 9, "forged")],
)
def test_a_key_is_for_its_transmitter_ids(operator: Operator, first: int, last: int, trust: str) -> None:
    found = judged(operator, first_id=first, last_id=last)
    assert found.trust == trust
    assert found.why == ("" if trust == "verified" else "signed by a key that is not for transmitter 7")


@pytest.mark.parametrize(
    ("north_m", "east_m", "radius_m", "trust"),
    [
        (0, 0, 1, "verified"),
        (99, 0, 100, "verified"),
        (101, 0, 100, "forged"),
        (70, 70, 100, "verified"),
        (0, 101, 100, "forged"),
        (-99_000, 0, 100_000, "verified"),
    ],
)
def test_a_key_is_for_its_area(
    operator: Operator, north_m: float, east_m: float, radius_m: float, trust: str
) -> None:
    # A metre of the sphere, good to a few parts in a thousand here.
    centre = (35.1 + north_m / 110_940, 136.9 + east_m / (111_412 * np.cos(np.radians(35.1))))
    found = judged(operator, latitude_deg=centre[0], longitude_deg=centre[1], radius_m=radius_m)
    assert found.trust == trust
    assert found.why == ("" if trust == "verified" else "signed by a key that is not for this place")


def test_several_entries_of_a_key_are_one_or_the_other(operator: Operator) -> None:
    far = TrustedKey(operator.public, latitude_deg=0.0, longitude_deg=0.0, radius_m=10.0)
    others = TrustedKey(operator.public, first_id=8)
    near = TrustedKey(operator.public, latitude_deg=35.1, longitude_deg=136.9, radius_m=10.0)
    message = beacon_message()
    for keys, trust in (((far, others), "forged"), ((far, others, near), "verified")):
        judge = BeaconJudge(MessageSpec(trusted_keys=keys), DIGEST)
        assert judge.judge(message, PLACE, operator.sign(message), None).trust == trust


@pytest.mark.parametrize(
    ("valid_from", "valid_to", "now_days", "why"),
    [
        ("2026-03-01", "2026-03-02", None, ""),
        ("2026-03-01", "2026-03-02", 0.4, ""),
        ("2026-03-01", "2026-03-02", 0.6, "received when its key was not valid any more"),
        ("2026-03-02", "", None, "when its key was not valid"),
        ("", "2026-03-01T11:59:59Z", None, "when its key was not valid"),
        ("", "2026-03-01T21:00:01+09:00", None, ""),
        ("", "", 365, ""),
        ("", "", -1, "after it was received"),
        ("", "", -0.001, ""),
    ],
)
def test_a_key_is_valid_from_and_to(
    operator: Operator, valid_from: str, valid_to: str, now_days: float | None, why: str
) -> None:
    now_s = None if now_days is None else SIGNED_S + 86400 * now_days
    found = judged(operator, now_s, valid_from=valid_from, valid_to=valid_to)
    assert found.trust == ("unverified" if why else "verified")
    assert found.why.endswith(why)
    assert found.why.startswith("signed 2026-03-01 12:00:00 UTC" if why else "")


def test_a_revoked_key_signs_nothing(operator: Operator) -> None:
    assert judged(operator, revoked_keys=(operator.public,)) == (
        "forged",
        "signed by a key that is revoked",
    )
    # Revoked only, and trusted never.
    judge, message = BeaconJudge(MessageSpec(revoked_keys=(operator.public,)), DIGEST), beacon_message()
    assert judge.judge(message, PLACE, operator.sign(message), None).trust == "forged"


@pytest.mark.parametrize(
    ("age_s", "why"),
    [
        (99.0, ""),
        (101.0, "longer ago than messages.max_age_s = 100"),
        (None, "; when it was received is not known, and messages.max_age_s = 100"),
    ],
)
def test_a_beacon_older_than_the_receiver_asks_for(operator: Operator, age_s: float | None, why: str) -> None:
    found = judged(operator, None if age_s is None else SIGNED_S + age_s, max_age_s=100.0)
    assert found.trust == ("unverified" if why else "verified")
    assert found.why.endswith(why)


@pytest.mark.parametrize(
    ("change", "transmitter_id", "signed_for", "how"),
    [
        ({"height_m": 52.001}, 7, None, "another place than the verified beacon of sequence"),
        ({"heading_deg": 11.0}, 7, None, "another attitude or length than the verified beacon"),
        ({"tilt_deg": 3.0}, 7, None, "another attitude or length than the verified beacon"),
        ({"length_m": 1.92}, 7, None, "another attitude or length than the verified beacon"),
        ({}, 9, None, "at the place of transmitter 7, whose beacon is verified; no signature yet"),
        ({"latitude_deg": 35.1 + 0.3 * METRE_DEG}, 9, None, "at the place of transmitter 7"),
        ({"latitude_deg": 35.1 + 0.3 * METRE_DEG}, 9, "stranger", "; signed by a key that is not trusted"),
        ({"latitude_deg": 35.1 + 0.6 * METRE_DEG}, 9, None, ""),
        ({"height_m": 53.0}, 9, None, ""),
        ({"user": b"lane 3"}, 7, None, ""),
    ],
)
def test_an_unsigned_beacon_that_contradicts_a_verified_one_is_forged(
    operator: Operator, tmp_path: Path, change: dict[str, float], transmitter_id: int,
    signed_for: str | None, how: str,
) -> None:  # fmt: skip
    judge = BeaconJudge(MessageSpec(trusted_keys=(TrustedKey(operator.public),)), DIGEST)
    message, liar = beacon_message(), replace(PLACE, **change)  # type: ignore[arg-type]
    claim = beacon_message(liar, SIGNED_S + 1, transmitter_id)
    signature = Operator(tmp_path / "stranger.pem").sign(claim) if signed_for else None
    assert judge.judge(claim, liar, signature, None).trust == "unverified"
    assert judge.judge(message, PLACE, operator.sign(message), None) == ("verified", "")
    found = judge.judge(claim, liar, signature, None)
    assert found.trust == ("forged" if how else "unverified")
    assert how in found.why
    # With a signature it is a bar that was moved, or a second one.
    assert judge.judge(claim, liar, operator.sign(claim), None) == ("verified", "")


def test_a_fresh_receiver_says_how_old_an_old_recording_is(operator: Operator) -> None:
    """A recording of March, received in whatever way: never just `verified`."""
    message = beacon_message()
    blocks = blocks_of(message, operator.sign(message, CODER.digest))
    spec = replace(load_link().messages, trusted_keys=(TrustedKey(operator.public),))
    signed = datetime.fromtimestamp(SIGNED_S, UTC)
    for zero, reason, age_s in (
        (None, "signed 2026-03-01 12:00:00 UTC; when it was received is not known", None),
        (
            signed + timedelta(days=265),
            "signed 2026-03-01 12:00:00 UTC, 265 days before it was received",
            265 * 86400 + 69e-3,
        ),
        (signed + timedelta(seconds=40), "signed 2026-03-01 12:00:00 UTC, 40.1 s before", 40.0692),
    ):
        assembler = MessageAssembler(CODER, spec, clock_zero=zero)
        rng = np.random.default_rng(1)
        found = []
        for number, block in enumerate(blocks * 2):
            found += assembler.add(packet_of(noisy(block, 1e-4, rng), number)).messages
        assert [m.trust for m in found] == ["unverified", "verified"]
        assert found[1].reason.startswith(reason)
        assert found[1].age_s == (None if age_s is None else pytest.approx(age_s, abs=1e-3))
        assert assembler.counts["beacons_undated"] == (zero is None)


def test_a_key_that_ends_while_the_receiver_runs(operator: Operator) -> None:
    key = TrustedKey(operator.public, valid_to="2026-03-02")
    judge = BeaconJudge(MessageSpec(trusted_keys=(key,)), DIGEST)
    message = beacon_message()
    signature = operator.sign(message)
    assert judge.judge(message, PLACE, signature, SIGNED_S + 10.0).trust == "verified"
    assert judge.judge(message, PLACE, signature, SIGNED_S + 43_201.0).trust == "unverified"
