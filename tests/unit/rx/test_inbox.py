"""Packets to messages: parts in any order, repetitions added, beacons with their signatures."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from rx_messages import CODER, PLACE, Operator, blocks_of, noisy, operator, packet_of

from evlcp_sdk.air.blocks import Block, Kind, Message
from evlcp_sdk.link.sections import MessageSpec
from evlcp_sdk.rx.inbox import MessageAssembler


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
    blocks = blocks_of(Message(Kind.TEXT, 7, 3, text.encode()))
    order = np.random.default_rng(1).permutation(np.repeat(np.arange(len(blocks)), 2))
    feed = Feed()
    found = feed(blocks[i] for i in order)
    assert [m.message.text for m in found] == [text]
    assert (found[0].trust, found[0].reason) == ("unverified", "not signed")
    complete = max(np.flatnonzero(order == i)[0] for i in range(len(blocks)))
    assert (found[0].transmitter, found[0].packet, found[0].t_us) == (0, complete, 34600.0 * complete)
    assert feed.counts == {
        "blocks_tried": 2 * len(blocks),
        "blocks_decoded": 2 * len(blocks),
        "parts_repeated": len(blocks),
        "messages": 1,
    }


def test_state_is_bounded():
    feed = Feed(combine_packets=4)
    for sequence in range(40):
        feed(blocks_of(Message(Kind.DATA, 1, sequence, bytes(41)))[:1], transmitter=sequence % 20)
    for _ in range(20):
        feed.assembler.add(packet_of(feed.rng.normal(0, 3, 960), 0))
    inboxes = feed.assembler._inboxes
    assert len(inboxes) == 16
    assert all(len(i.open) <= 8 and len(i.done) <= 8 and len(i.sums) <= 4 for i in inboxes.values())
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


def test_another_codebook_is_told():
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


@pytest.mark.parametrize(
    ("later", "reason", "age_s"),
    [
        (None, "; when it was received is not known", None),
        (timedelta(days=265), ", 265 days before it was received", 265 * 86400 + 69e-3),
        (timedelta(seconds=40), ", 40.1 s before", 40.0692),
    ],
)
def test_a_fresh_receiver_says_how_old_an_old_recording_is(later, reason, age_s):
    """A recording of March, received in whatever way: never just `verified`."""
    feed = Feed(None if later is None else SIGNED + later, trusted_keys=operator().trusted)
    found = feed(blocks_of(*operator().beacon(int(SIGNED.timestamp()))))
    assert trusts(found) == ["unverified", "verified"]
    assert found[1].reason.startswith(f"signed 2026-03-01 12:00:00 UTC{reason}")
    assert found[1].age_s == (None if age_s is None else pytest.approx(age_s, abs=1e-3))
    assert feed.assembler.counts["beacons_undated"] == (later is None)


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
        told = trusts(feed(blocks_of(*shown), transmitter=1 + trial))
        flagged += told[-1:] == ["forged"] and "verified" not in told
    # Some tampered bytes are a place that cannot be: counted, and never handed on.
    assert flagged + feed.counts["messages_undecodable"] == 400
    assert flagged > 360
