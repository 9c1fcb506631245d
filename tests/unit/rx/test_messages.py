"""Packets to messages, parts in any order, repetitions added; what keys may sign, what a beacon is worth."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache
from math import nan

import numpy as np
import pytest
from scipy.stats import norm

from evlcp_sdk.air import signing
from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Block, Kind, Message, split_message
from evlcp_sdk.air.signing import TrustedKey
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.link.sections import MessageSpec
from evlcp_sdk.rx.inbox import MessageAssembler
from evlcp_sdk.rx.trust import BeaconVerifier
from evlcp_sdk.values import Frame, Packet, Range, SoftSymbols

CODER = load_link().block_coder()
PLACE = Beacon(35.1, 136.9, 52.0, 10.0, 0.0, 0.96, b"lane 2")


def packet_of(llr, number, transmitter=0, lost=()):
    """A packet whose frames have these LLRs, float (960,); lost frames are missing."""
    soft = [SoftSymbols(np.zeros(16, int), one.astype(np.float32), 1.0) for one in llr.reshape(10, 16, 6)]
    at_us, rest = 34600.0 * number, (Range(nan, nan, 0), None, 0.0, 0.0)
    whole = [Frame(transmitter, number, f, at_us + 3200.0 * f, soft[f], *rest) for f in range(10)]
    return Packet(transmitter, number, at_us, 100.0, tuple(f for f in whole if f.frame not in lost), 10)


def noisy(block, ber, rng):
    sigma = 1 / norm.isf(ber)
    air = CODER.encode_bits(block)
    return 2 * (1 - 2.0 * air + rng.normal(0, sigma, air.size)) / sigma**2


def blocks_of(*messages, digest=CODER.digest):
    return [b.pack(CODER.block_bytes) for m in messages for b in split_message(m, digest, CODER.block_bytes)]


class Operator:
    """A key and what it signs."""

    def __init__(self):
        pytest.importorskip("cryptography", reason="the extra sign is not installed")
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        self._key = Ed25519PrivateKey.generate()
        self.public = signing.public_key(self._key)
        self.trusted = (signing.TrustedKey(self.public),)

    def sign(self, message):
        return signing.sign(message, CODER.digest, self._key)

    def beacon(self, sequence, place=PLACE, transmitter_id=7):
        """A beacon and its signature."""
        message = Message(Kind.BEACON, transmitter_id, sequence, place.pack())
        return [message, self.sign(message)]


@cache
def operator():
    return Operator()


class Feed:
    """An assembler that is fed with blocks."""

    def __init__(self, zero=None, **spec):
        self.assembler = MessageAssembler(CODER, replace(MessageSpec(), **spec), clock_zero=zero)
        self.number, self.rng = 0, np.random.default_rng(5)

    def __call__(self, blocks, ber=1e-4, transmitter=0):
        found = []
        for block in blocks:
            packet = packet_of(noisy(block, ber, self.rng), self.number, transmitter)
            found += self.assembler.add(packet).messages
            self.number += 1
        return found

    @property
    def counts(self):
        return {k: v for k, v in self.assembler.counts.items() if v}


def data(payload):
    """Blocks of a message under one number."""
    return blocks_of(Message(Kind.DATA, 7, 3, payload))


def test_a_long_message_in_any_order_with_duplicates():
    text = "Baustelle nach 300 m, rechter Fahrstreifen gesperrt, bitte 60. " * 8
    blocks, feed = blocks_of(Message(Kind.TEXT, 7, 3, text.encode())), Feed()
    many = len(blocks)
    order = np.random.default_rng(1).permutation(np.repeat(np.arange(many), 2))
    (found,) = feed(blocks[i] for i in order)
    assert (found.message.text, found.trust, found.reason) == (text, "unverified", "not signed")
    complete = np.unique(order, return_index=True)[1].max()
    assert (found.transmitter, found.packet, found.t_us) == (0, complete, 34600.0 * complete)
    tried = {"blocks_tried": 2 * many, "blocks_decoded": 2 * many}
    assert feed.counts == {**tried, "parts_repeated": many, "messages": 1}


def test_state_is_bounded():
    feed = Feed(combine_packets=4)
    for sequence in range(40):
        feed(blocks_of(Message(Kind.DATA, 1, sequence, bytes(41)))[:1], transmitter=sequence % 20)
    for _ in range(20):
        feed.assembler.add(packet_of(feed.rng.normal(0, 3, 960), 0))
    inboxes = feed.assembler._inboxes
    assert len(inboxes) == 16
    assert all(len(i.incomplete) <= 8 and len(i.complete) <= 8 and len(i.sums) <= 4 for i in inboxes.values())
    feed.assembler.close()
    assert feed.counts["parts_missing"] == 40


def test_another_message_under_the_same_number_replaces_it():
    feed = Feed()
    assert not feed(data(bytes(80))[:1])
    for number, payload in enumerate((bytes([2]) * 80, bytes(100)), 1):
        assert feed(data(payload))[0].message.payload == payload
        assert feed.counts["parts_conflicting"] == number


@pytest.mark.parametrize("length", [80, 100])
def test_parts_of_two_messages_under_one_number_are_not_one_message(length):
    """A transmitter that starts anew with another message, and the first part of the new one is lost."""
    feed = Feed()
    one, two = (data(bytes([v]) * length) for v in (1, 2))
    assert len(one) == 3
    assert not feed(one[:1] + two[1:])
    assert feed.counts["messages_mixed"] == 1
    assert "messages" not in feed.counts
    # The newest part is of the new one, and so is what comes again.
    found = feed(two[:2])
    assert [m.message.payload for m in found] == [bytes([2]) * length]


def test_repetitions_are_added_until_they_decode():
    # At this bit error rate no packet decodes by itself: half the bits are message, capacity is 0.53 (soft).
    blocks = data(bytes(range(100)))
    assert len(blocks) == 3
    feed = Feed()
    found = feed(blocks * 5, ber=0.16)
    assert [m.message.payload for m in found] == [bytes(range(100))]
    assert feed.counts["blocks_combined"] >= 3
    assert "blocks_decoded" not in feed.counts
    alone = Feed(combine_packets=0)
    assert not alone(blocks * 5, ber=0.16)
    assert alone.counts == {"blocks_tried": 15, "blocks_failed": 15}
    noise = [packet_of(noisy(blocks[0], 0.16, feed.rng), number) for number in range(8)]
    first = next(packet for packet in map(Feed().assembler.add, noise) if packet.block)
    assert first.block_packets == first.packet + 1 > 1


def test_different_blocks_are_not_added():
    # Blocks of one message, alike in header and payload but for their number.
    blocks, feed = data(bytes(40 * 40)), Feed(combine_packets=64)
    feed(blocks, ber=0.2)
    sums = feed.assembler._inboxes[0].sums
    assert len(sums) == len(blocks)
    assert {s.packets for s in sums} == {1}


@pytest.mark.parametrize(
    ("lost", "hidden"),
    [(range(3), []), (range(4, 7), []), (range(7, 10), []), ([], [4, 5, 6, 12]), ([], [0, 1, 7, 8, 14, 15])],
)
def test_lost_frames_and_hidden_clusters_count_as_unknown(lost, hidden):
    """Clusters that are not given have LLR 0, and the error correction carries the message over them."""
    block = blocks_of(Message(Kind.TEXT, 1, 0, b"Hello"))[0]
    llr = noisy(block, 0.01, np.random.default_rng(3)).reshape(10, 16, 6)
    llr[:, hidden] = 0
    packet = Feed().assembler.add(packet_of(llr, 0, lost=lost))
    assert [m.message.text for m in packet.messages] == ["Hello"]
    assert (packet.block, packet.block_packets) == (Block.unpack(block), 1)


def test_a_reflection_says_nothing_new():
    blocks = blocks_of(Message(Kind.TEXT, 1, 0, b"Hello"))
    packet = packet_of(noisy(blocks[0], 0.01, np.random.default_rng(3)), 0, transmitter=1)
    echo = replace(packet, frames=tuple(replace(f, echo_of=0) for f in packet.frames))
    assembler = Feed().assembler
    assert assembler.add(echo) is echo
    assert {k: n for k, n in assembler.counts.items() if n} == {"blocks_reflected": 1}
    assert assembler.add(packet).messages


def test_another_codebook_is_reported():
    feed = Feed()
    assert not feed(blocks_of(Message(Kind.TEXT, 1, 0, b"Hi"), digest=b"\0\0\0\0"))
    assert feed.counts == {"blocks_tried": 1, "blocks_decoded": 1, "blocks_other_codebook": 1}


def test_bytes_that_mean_nothing_are_counted():
    feed = Feed()
    assert not feed([b"\x33".ljust(CODER.block_bytes, b"\0")])
    assert feed.counts["blocks_malformed"] == 1
    for kind in (Kind.TEXT, Kind.BEACON):
        assert not feed(blocks_of(Message(kind, 1, 0, b"\xff")) * 2)
    assert feed.counts["messages_undecodable"] == 2
    assert "messages" not in feed.counts


def trusts(found):
    return [m.trust for m in found]


def test_a_signed_beacon_is_verified_once_its_signature_is_there():
    feed = Feed(trusted_keys=operator().trusted)
    blocks = blocks_of(*operator().beacon(5))
    assert len(blocks) == 3
    found = feed(blocks * 3)
    assert trusts(found) == ["unverified", "verified"]
    assert found[0].reason == "no signature yet"
    assert found[1].beacon == PLACE
    # The signature may come first.
    assert trusts(Feed(trusted_keys=operator().trusted)(blocks[1:] + blocks[:1])) == ["verified"]
    # A newer beacon of another place is believed with its signature only.
    found = feed(blocks_of(*operator().beacon(6, replace(PLACE, latitude_deg=35.2))))
    assert trusts(found) == ["forged", "verified"]
    assert "another place than the verified beacon of sequence 5" in found[0].reason
    assert feed.counts["beacons_verified"] == 2
    found = Feed()(blocks)
    assert trusts(found) == ["unverified", "unverified"]
    assert found[1].reason == "signed by a key that is not trusted"


SIGNED = datetime(2026, 3, 1, 12, tzinfo=UTC)
SIGNED_S = int(SIGNED.timestamp())


@pytest.mark.parametrize(
    ("later_s", "reason", "age_s"),
    [
        (None, "; when it was received is not known", None),
        (265 * 86400, ", 265 days before it was received", 265 * 86400 + 69e-3),
        (40, ", 40.1 s before", 40.0692),
    ],
)
def test_a_fresh_receiver_says_how_old_an_old_recording_is(later_s, reason, age_s):
    """A recording of March, received in whatever way: never just `verified`."""
    zero = None if later_s is None else SIGNED + timedelta(seconds=later_s)
    feed = Feed(zero, trusted_keys=operator().trusted)
    found = feed(blocks_of(*operator().beacon(SIGNED_S)))
    assert trusts(found) == ["unverified", "verified"]
    assert found[1].reason.startswith(f"signed 2026-03-01 12:00:00 UTC{reason}")
    assert found[1].age_s == (age_s and pytest.approx(age_s, abs=1e-3))
    assert feed.assembler.counts["beacons_undated"] == (later_s is None)


def test_every_forgery_is_found_out():
    """A lamp beside the honest one shows tampered, unsigned, replayed or wrongly signed beacons."""
    rng, other = np.random.default_rng(11), Operator()
    feed = Feed(trusted_keys=operator().trusted)

    def tampered(message, first_bit):
        payload = bytearray(message.payload)
        at = int(rng.integers(first_bit, 8 * len(payload)))
        payload[at // 8] ^= 1 << at % 8
        return replace(message, payload=bytes(payload))

    assert trusts(feed(blocks_of(*operator().beacon(1000)))) == ["unverified", "verified"]
    flagged = 0
    for trial in range(400):
        sequence = 1000 + int(rng.integers(0, 5))
        beacon, signature = honest = operator().beacon(sequence)
        elsewhere = replace(PLACE, longitude_deg=float(rng.uniform(-180, 180)))
        match trial % 5:
            case 0:
                shown = [tampered(beacon, 0), signature]
            case 1:  # a newer number for the beacon and its signature
                newer = sequence + 1 + int(rng.integers(0, 100))
                shown = [replace(m, sequence=newer) for m in honest]
            case 2:  # a bit of the signature, of a beacon that moved
                beacon, signature = operator().beacon(sequence + 1, elsewhere)
                shown = [beacon, tampered(signature, 64)]
            case 3:  # an old one of another place, rightly signed
                shown = operator().beacon(int(rng.integers(0, 1000)), elsewhere)
            case _:  # a moved one, signed by another key
                shown = other.beacon(sequence + 1, replace(PLACE, height_m=0.0))
        reported = trusts(feed(blocks_of(*shown), transmitter=1 + trial))
        flagged += reported[-1:] == ["forged"] and "verified" not in reported
    # Some tampered bytes are a place that cannot be: counted, and never handed on.
    assert flagged + feed.counts["messages_undecodable"] == 400
    assert flagged > 360


METRE_DEG = 1 / 111_000


def verifier_of(*keys, **spec):
    return BeaconVerifier(MessageSpec(trusted_keys=keys, **spec), CODER.digest)


def judge_beacon(now_s=None, *, keys=(), **may):
    """What is thought of the operator's beacon, whose key may sign so much."""
    spec = {name: may.pop(name) for name in ("max_age_s", "revoked_keys", "oldest_sequence") if name in may}
    keys = keys or (TrustedKey(operator().public, **may),)
    message, signature = operator().beacon(SIGNED_S)
    return verifier_of(*keys, **spec).verify(message, PLACE, signature, now_s)


def area_around(north_m, east_m, radius_m):
    """An area about a place beside the beacon's; a metre of the sphere, good to a few parts in a thousand."""
    east_deg = east_m / (111_412 * np.cos(np.radians(35.1)))
    return {
        "latitude_deg": 35.1 + north_m / 110_940,
        "longitude_deg": 136.9 + east_deg,
        "radius_m": radius_m,
    }


@pytest.mark.parametrize(
    ("may", "why"),
    [
        ({"last_id": 6}, "transmitter 7"),
        ({"first_id": 7, "last_id": 7}, ""),
        ({"first_id": 8, "last_id": 9}, "transmitter 7"),
        (area_around(99, 0, 100), ""),
        (area_around(101, 0, 100), "this place"),
        (area_around(0, 101, 100), "this place"),
    ],
)
def test_a_key_is_for_its_transmitter_ids_and_area(may, why):
    wrong = "forged", f"signed by a key that is not for {why}"
    assert judge_beacon(**may) == (wrong if why else ("verified", ""))


def test_several_entries_of_a_key_are_one_or_the_other():
    limits = area_around(-4_000_000, 0, 10.0), {"first_id": 8}, area_around(0, 0, 10.0)
    keys = tuple(TrustedKey(operator().public, **may) for may in limits)
    assert judge_beacon(keys=keys[:2]).trust == "forged"
    assert judge_beacon(keys=keys).trust == "verified"


DAY, OLD = {"valid_from": "2026-03-01", "valid_to": "2026-03-02"}, {"max_age_s": 100.0}


@pytest.mark.parametrize(
    ("may", "later_s", "why"),
    [
        (DAY, None, ""),
        (DAY, 34_560, ""),
        (DAY, 51_840, "received when its key was not valid any more"),
        ({"valid_from": "2026-03-02"}, None, "when its key was not valid"),
        ({"valid_to": "2026-03-01T11:59:59Z"}, None, "when its key was not valid"),
        ({"valid_to": "2026-03-01T21:00:01+09:00"}, None, ""),
        ({}, 365 * 86_400, ""),
        ({}, -86_400, "after it was received"),
        ({}, -86.4, ""),
        (OLD, 99.0, ""),
        (OLD, 101.0, "longer ago than messages.max_age_s = 100"),
        (OLD, None, "; when it was received is not known, and messages.max_age_s = 100"),
    ],
)
def test_a_key_is_valid_from_and_to_and_a_beacon_as_old_as_the_receiver_asks_for(may, later_s, why):
    found = judge_beacon(None if later_s is None else SIGNED_S + later_s, **may)
    assert found.trust == ("unverified" if why else "verified")
    assert found.reason.endswith(why)
    assert found.reason.startswith("signed 2026-03-01 12:00:00 UTC" if why else "")


def test_a_revoked_key_signs_nothing():
    revoked = "forged", "signed by a key that is revoked"
    assert judge_beacon(revoked_keys=(operator().public,)) == revoked
    # Revoked only, and trusted never.
    message, signature = operator().beacon(SIGNED_S)
    verifier = verifier_of(revoked_keys=(operator().public,))
    assert verifier.verify(message, PLACE, signature, None) == revoked


@pytest.mark.parametrize(
    ("change", "transmitter_id", "signed_by", "how"),
    [
        ({"height_m": 52.001}, 7, None, "another place than the verified beacon of sequence"),
        ({"heading_deg": 11.0}, 7, None, "another attitude or length than the verified beacon"),
        ({"length_m": 1.92}, 7, None, "another attitude or length than the verified beacon"),
        ({"latitude_deg": 35.1 + 0.3 * METRE_DEG}, 9, None, "at the place of transmitter 7"),
        ({"latitude_deg": 35.1 + 0.3 * METRE_DEG}, 9, Operator(), "; signed by a key that is not trusted"),
        ({"latitude_deg": 35.1 + 0.6 * METRE_DEG}, 9, None, ""),
        ({"height_m": 53.0}, 9, None, ""),
        ({"user": b"lane 3"}, 7, None, ""),
    ],
)
def test_an_unsigned_beacon_that_contradicts_a_verified_one_is_forged(change, transmitter_id, signed_by, how):
    verifier, liar = verifier_of(*operator().trusted), replace(PLACE, **change)
    claim, right = operator().beacon(SIGNED_S + 1, liar, transmitter_id)
    signature = signed_by.sign(claim) if signed_by else None
    assert verifier.verify(claim, liar, signature, None).trust == "unverified"
    message, good = operator().beacon(SIGNED_S)
    assert verifier.verify(message, PLACE, good, None) == ("verified", "")
    found = verifier.verify(claim, liar, signature, None)
    assert found.trust == ("forged" if how else "unverified")
    assert how in found.reason
    # With a signature it is a bar that was moved, or a second one.
    assert verifier.verify(claim, liar, right, None) == ("verified", "")


def test_an_old_beacon_is_replayed():
    reason = f"replayed: sequence {SIGNED_S} is older than messages.oldest_sequence {SIGNED_S + 1}"
    assert judge_beacon(oldest_sequence=SIGNED_S + 1) == ("forged", reason)
    verifier = verifier_of(*operator().trusted)

    def shown(sequence, place, transmitter_id=7):
        message, signature = operator().beacon(sequence, place, transmitter_id)
        return verifier.verify(message, place, signature, None)

    assert shown(9, PLACE).trust == "verified"
    elsewhere = replace(PLACE, latitude_deg=35.3)
    assert shown(8, elsewhere) == ("forged", "replayed: sequence 8 is older than verified 9")
    assert shown(9, elsewhere) == ("forged", "differs from the verified beacon of sequence 9")
    # Another transmitter's number is its own.
    assert shown(1, elsewhere, 8).trust == "verified"
