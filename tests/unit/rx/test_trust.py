"""How far beacons are believed: what keys may sign, when, and what a verified one says of others."""

import calendar
from dataclasses import replace

import numpy as np
import pytest
from rx_messages import CODER, PLACE, Operator, operator

from evlcp_sdk.air.signing import TrustedKey
from evlcp_sdk.link.sections import MessageSpec
from evlcp_sdk.rx.trust import BeaconJudge

SIGNED_S = calendar.timegm((2026, 3, 1, 12, 0, 0))
METRE_DEG = 1 / 111_000


def judge_of(*keys, **spec):
    return BeaconJudge(MessageSpec(trusted_keys=keys, **spec), CODER.digest)


def judged(now_s=None, *, keys=(), **may):
    """What is thought of the operator's beacon, whose key may sign so much."""
    spec = {name: may.pop(name) for name in ("max_age_s", "revoked_keys", "oldest_sequence") if name in may}
    keys = keys or (TrustedKey(operator().public, **may),)
    message, signature = operator().beacon(SIGNED_S)
    return judge_of(*keys, **spec).judge(message, PLACE, signature, now_s)


@pytest.mark.parametrize(
    ("first", "last", "good"), [(0, 6, False), (0, 7, True), (7, 7, True), (7, 9, True), (8, 9, False)]
)
def test_a_key_is_for_its_transmitter_ids(first, last, good):
    wrong = "forged", "signed by a key that is not for transmitter 7"
    assert judged(first_id=first, last_id=last) == (("verified", "") if good else wrong)


@pytest.mark.parametrize(
    ("north_m", "east_m", "radius_m", "good"),
    [
        (0, 0, 1, True),
        (99, 0, 100, True),
        (101, 0, 100, False),
        (70, 70, 100, True),
        (0, 101, 100, False),
        (-99_000, 0, 100_000, True),
    ],
)
def test_a_key_is_for_its_area(north_m, east_m, radius_m, good):
    # A metre of the sphere, good to a few parts in a thousand here.
    centre = 35.1 + north_m / 110_940, 136.9 + east_m / (111_412 * np.cos(np.radians(35.1)))
    found = judged(latitude_deg=centre[0], longitude_deg=centre[1], radius_m=radius_m)
    assert found == (("verified", "") if good else ("forged", "signed by a key that is not for this place"))


def test_several_entries_of_a_key_are_one_or_the_other():
    far = TrustedKey(operator().public, latitude_deg=0.0, longitude_deg=0.0, radius_m=10.0)
    others = TrustedKey(operator().public, first_id=8)
    near = TrustedKey(operator().public, latitude_deg=35.1, longitude_deg=136.9, radius_m=10.0)
    assert judged(keys=(far, others)).trust == "forged"
    assert judged(keys=(far, others, near)).trust == "verified"


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
def test_a_key_is_valid_from_and_to(valid_from, valid_to, now_days, why):
    now_s = None if now_days is None else SIGNED_S + 86400 * now_days
    found = judged(now_s, valid_from=valid_from, valid_to=valid_to)
    assert found.trust == ("unverified" if why else "verified")
    assert found.why.endswith(why)
    assert found.why.startswith("signed 2026-03-01 12:00:00 UTC" if why else "")


def test_a_revoked_key_signs_nothing():
    revoked = "forged", "signed by a key that is revoked"
    assert judged(revoked_keys=(operator().public,)) == revoked
    # Revoked only, and trusted never.
    message, signature = operator().beacon(SIGNED_S)
    judge = judge_of(revoked_keys=(operator().public,))
    assert judge.judge(message, PLACE, signature, None) == revoked


@pytest.mark.parametrize(
    ("age_s", "why"),
    [
        (99.0, ""),
        (101.0, "longer ago than messages.max_age_s = 100"),
        (None, "; when it was received is not known, and messages.max_age_s = 100"),
    ],
)
def test_a_beacon_older_than_the_receiver_asks_for(age_s, why):
    found = judged(None if age_s is None else SIGNED_S + age_s, max_age_s=100.0)
    assert found.trust == ("unverified" if why else "verified")
    assert found.why.endswith(why)


@pytest.mark.parametrize(
    ("change", "transmitter_id", "signed_by", "how"),
    [
        ({"height_m": 52.001}, 7, None, "another place than the verified beacon of sequence"),
        ({"heading_deg": 11.0}, 7, None, "another attitude or length than the verified beacon"),
        ({"tilt_deg": 3.0}, 7, None, "another attitude or length than the verified beacon"),
        ({"length_m": 1.92}, 7, None, "another attitude or length than the verified beacon"),
        ({}, 9, None, "at the place of transmitter 7, whose beacon is verified; no signature yet"),
        ({"latitude_deg": 35.1 + 0.3 * METRE_DEG}, 9, None, "at the place of transmitter 7"),
        ({"latitude_deg": 35.1 + 0.3 * METRE_DEG}, 9, Operator(), "; signed by a key that is not trusted"),
        ({"latitude_deg": 35.1 + 0.6 * METRE_DEG}, 9, None, ""),
        ({"height_m": 53.0}, 9, None, ""),
        ({"latitude_deg": 35.2}, 9, None, ""),
        ({"user": b"lane 3"}, 7, None, ""),
    ],
)
def test_an_unsigned_beacon_that_contradicts_a_verified_one_is_forged(change, transmitter_id, signed_by, how):
    judge, liar = judge_of(*operator().trusted), replace(PLACE, **change)
    claim, right = operator().beacon(SIGNED_S + 1, liar, transmitter_id)
    signature = signed_by.sign(claim) if signed_by else None
    assert judge.judge(claim, liar, signature, None).trust == "unverified"
    message, good = operator().beacon(SIGNED_S)
    assert judge.judge(message, PLACE, good, None) == ("verified", "")
    found = judge.judge(claim, liar, signature, None)
    assert found.trust == ("forged" if how else "unverified")
    assert how in found.why
    # With a signature it is a bar that was moved, or a second one.
    assert judge.judge(claim, liar, right, None) == ("verified", "")


def test_an_old_beacon_is_replayed():
    reason = f"replayed: sequence {SIGNED_S} is older than messages.oldest_sequence {SIGNED_S + 1}"
    assert judged(oldest_sequence=SIGNED_S + 1) == ("forged", reason)
    judge = judge_of(*operator().trusted)

    def shown(sequence, place, transmitter_id=7):
        message, signature = operator().beacon(sequence, place, transmitter_id)
        return judge.judge(message, place, signature, None)

    assert shown(9, PLACE).trust == "verified"
    found = shown(8, replace(PLACE, latitude_deg=35.3))
    assert found == ("forged", "replayed: sequence 8 is older than verified 9")
    found = shown(9, replace(PLACE, height_m=53.0))
    assert found == ("forged", "differs from the verified beacon of sequence 9")
    # Another transmitter's number is its own.
    assert shown(1, replace(PLACE, latitude_deg=35.4), 8).trust == "verified"
