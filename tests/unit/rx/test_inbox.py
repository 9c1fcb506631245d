"""Packets to messages: parts in any order, repetitions added, beacons verified or found out."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from evlcp_sdk.air import signing
from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Block, Kind, Message, split
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.link.sections import MessageSpec
from evlcp_sdk.rx.inbox import MessageAssembler
from evlcp_sdk.values import Frame, Packet, Range, ReceivedMessage, SoftSymbols

CODER = load_link().block_coder()
PLACE = Beacon(35.1, 136.9, 52.0, 10.0, 0.0, 0.96, b"lane 2")


def packet_of(llr: np.ndarray, number: int, transmitter: int = 0, lost: Iterable[int] = ()) -> Packet:
    """A packet whose frames have these LLRs, float (960,); lost frames are missing."""
    frames = tuple(
        Frame(
            transmitter=transmitter,
            packet=number,
            frame=f,
            t_us=34600.0 * number + 3200.0 * f,
            soft=SoftSymbols(np.zeros(16, np.int64), part.astype(np.float32), 1.0),
            range=Range(float("nan"), float("nan"), 0),
            filtered=None,
            x_px=0.0,
            y_px=0.0,
        )
        for f, part in enumerate(llr.reshape(10, 16, 6))
        if f not in set(lost)
    )
    return Packet(transmitter, number, 34600.0 * number, 100.0, frames, 10)


def noisy(block: bytes, ber: float, rng: np.random.Generator) -> np.ndarray:
    sigma = 1 / norm.isf(ber)
    air = CODER.air_bits(block)
    return 2 * (1 - 2.0 * air + rng.normal(0, sigma, air.size)) / sigma**2


def blocks_of(*messages: Message, digest: bytes = CODER.digest) -> list[bytes]:
    return [b.pack(CODER.block_bytes) for m in messages for b in split(m, digest, CODER.block_bytes)]


class Feed:
    """An assembler that is fed with blocks."""

    def __init__(self, **spec: object) -> None:
        self.assembler = MessageAssembler(CODER, replace(MessageSpec(), **spec))  # type: ignore[arg-type]
        self.number = 0
        self.rng = np.random.default_rng(5)

    def __call__(
        self, blocks: Iterable[bytes], ber: float = 1e-4, transmitter: int = 0
    ) -> list[ReceivedMessage]:
        found: list[ReceivedMessage] = []
        for block in blocks:
            packet = packet_of(noisy(block, ber, self.rng), self.number, transmitter)
            found += self.assembler.add(packet).messages
            self.number += 1
        return found

    @property
    def counts(self) -> dict[str, int]:
        return {k: v for k, v in self.assembler.counts.items() if v}


def test_a_long_message_in_any_order_with_duplicates() -> None:
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


def test_a_lost_part_is_counted() -> None:
    blocks = blocks_of(Message(Kind.DATA, 7, 3, bytes(200)))
    feed = Feed()
    assert not feed(blocks[:2] + blocks[3:])
    assert "parts_missing" not in feed.counts
    feed.assembler.close()
    assert feed.counts["parts_missing"] == 1


def test_state_is_bounded() -> None:
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


def test_two_transmitters_do_not_mix() -> None:
    one, two = (blocks_of(Message(Kind.DATA, 7, 3, bytes([v]) * 80)) for v in (1, 2))
    feed = Feed()
    assert not feed(one[:1], transmitter=0)
    assert not feed(two[1:], transmitter=1)
    assert feed(one[1:], transmitter=0)[0].message.payload == bytes([1]) * 80
    assert feed(two[:1], transmitter=1)[0].message.payload == bytes([2]) * 80


def test_another_message_under_the_same_number_replaces_it() -> None:
    feed = Feed()
    one, two = (blocks_of(Message(Kind.DATA, 7, 3, bytes([v]) * 80)) for v in (1, 2))
    assert not feed(one[:1])
    assert feed(two)[0].message.payload == bytes([2]) * 80
    assert feed.counts["parts_conflicting"] == 1
    longer = blocks_of(Message(Kind.DATA, 7, 3, bytes(100)))
    assert feed(longer)[0].message.payload == bytes(100)


@pytest.mark.parametrize("length", [80, 100])
def test_parts_of_two_messages_under_one_number_are_not_one_message(length: int) -> None:
    """A transmitter that starts anew with another message, and the first part of the new one is lost."""
    feed = Feed()
    one, two = (blocks_of(Message(Kind.DATA, 7, 3, bytes([v]) * length)) for v in (1, 2))
    assert len(one) == 3
    assert not feed(one[:1] + two[1:])
    assert feed.counts["messages_mixed"] == 1
    assert "messages" not in feed.counts
    # What comes again is of the new one.
    found = feed(two)
    assert [m.message.payload for m in found] == [bytes([2]) * length]


def test_repetitions_are_added_until_they_decode() -> None:
    # At this bit error rate no packet decodes by itself: half the bits are message, capacity is 0.53 (soft).
    blocks = blocks_of(Message(Kind.DATA, 7, 3, bytes(range(100))))
    assert len(blocks) == 3
    feed = Feed()
    found = feed(blocks * 5, ber=0.16)
    assert [m.message.payload for m in found] == [bytes(range(100))]
    assert feed.counts["blocks_combined"] >= 3
    assert "blocks_decoded" not in feed.counts
    alone = Feed(combine_packets=0)
    assert not alone(blocks * 5, ber=0.16)
    assert alone.counts == {"blocks_tried": 15, "blocks_failed": 15}


def test_different_blocks_are_not_added() -> None:
    # Blocks of one message, alike in header and payload but for their number.
    blocks = blocks_of(Message(Kind.DATA, 7, 3, bytes(40 * 40)))
    feed = Feed(combine_packets=64)
    feed(blocks, ber=0.2)
    sums = feed.assembler._inboxes[0].sums
    assert len(sums) == len(blocks)
    assert {s.packets for s in sums} == {1}


@pytest.mark.parametrize("lost", [range(3), range(4, 7), range(7, 10)])
def test_lost_frames_count_as_unknown(lost: range) -> None:
    block = blocks_of(Message(Kind.TEXT, 1, 0, b"Hello"))[0]
    assembler = MessageAssembler(CODER, MessageSpec())
    packet = assembler.add(packet_of(noisy(block, 0.01, np.random.default_rng(3)), 0, lost=lost))
    assert [m.message.text for m in packet.messages] == ["Hello"]
    assert packet.block == Block.unpack(block)
    assert packet.block_packets == 1


@pytest.mark.parametrize("hidden", [[4, 5, 6, 12], range(10, 16), [0, 1, 7, 8, 14, 15]])
def test_hidden_clusters_count_as_unknown(hidden: Iterable[int]) -> None:
    """Clusters that are not given have LLR 0, and the error correction carries the message over them."""
    block = blocks_of(Message(Kind.TEXT, 1, 0, b"Hello"))[0]
    llr = noisy(block, 0.01, np.random.default_rng(3)).reshape(10, 16, 6)
    llr[:, list(hidden)] = 0
    assembler = MessageAssembler(CODER, MessageSpec())
    packet = assembler.add(packet_of(llr, 0))
    assert [m.message.text for m in packet.messages] == ["Hello"]
    assert (packet.block, packet.block_packets) == (Block.unpack(block), 1)


def test_a_reflection_says_nothing_new() -> None:
    blocks = blocks_of(Message(Kind.TEXT, 1, 0, b"Hello"))
    packet = packet_of(noisy(blocks[0], 0.01, np.random.default_rng(3)), 0, transmitter=1)
    echo = replace(packet, frames=tuple(replace(f, echo_of=0) for f in packet.frames))
    assembler = MessageAssembler(CODER, MessageSpec())
    assert assembler.add(echo) is echo
    assert {k: n for k, n in assembler.counts.items() if n} == {"blocks_reflected": 1}
    assert assembler.add(packet).messages


def test_another_codebook_is_told() -> None:
    feed = Feed()
    assert not feed(blocks_of(Message(Kind.TEXT, 1, 0, b"Hi"), digest=b"\0\0\0\0"))
    assert feed.counts == {"blocks_tried": 1, "blocks_decoded": 1, "blocks_other_codebook": 1}


def test_bytes_that_mean_nothing_are_counted() -> None:
    feed = Feed()
    assert not feed([b"\x33".ljust(CODER.block_bytes, b"\0")])
    assert feed.counts["blocks_malformed"] == 1
    for kind in (Kind.TEXT, Kind.BEACON):
        assert not feed(blocks_of(Message(kind, 1, 0, b"\xff")) * 2)
    assert feed.counts["messages_undecodable"] == 2
    assert "messages" not in feed.counts


class Signed:
    """An operator's key and what it signs."""

    def __init__(self, folder: Path) -> None:
        pytest.importorskip("cryptography", reason="the extra sign is not installed")
        self.public = signing.make_key(folder / "k.pem")
        self.trusted = (signing.TrustedKey(self.public),)
        self.key = signing.read_key(folder / "k.pem")

    def __call__(self, sequence: int, beacon: Beacon = PLACE, transmitter_id: int = 7) -> list[Message]:
        message = Message(Kind.BEACON, transmitter_id, sequence, beacon.pack())
        return [message, signing.sign(message, CODER.digest, self.key)]


@pytest.fixture(scope="module")
def signed(tmp_path_factory: pytest.TempPathFactory) -> Signed:
    return Signed(tmp_path_factory.mktemp("keys"))


def trusts(found: list[ReceivedMessage]) -> list[str]:
    return [m.trust for m in found]


def test_a_signed_beacon_is_verified_once_its_signature_is_there(signed: Signed) -> None:
    feed = Feed(trusted_keys=signed.trusted)
    blocks = blocks_of(*signed(5))
    assert len(blocks) == 3
    found = feed(blocks * 3)
    assert trusts(found) == ["unverified", "verified"]
    unknown = "signed 1970-01-01 00:00:05 UTC; when it was received is not known"
    assert (found[0].reason, found[1].reason) == ("no signature yet", unknown)
    assert found[1].beacon == PLACE
    # The signature may come first.
    assert trusts(Feed(trusted_keys=signed.trusted)(blocks[1:] + blocks[:1])) == ["verified"]
    # A newer beacon of another place is believed with its signature only.
    moved = replace(PLACE, latitude_deg=35.2)
    found = feed(blocks_of(*signed(6, moved)))
    assert trusts(found) == ["forged", "verified"]
    assert "another place than the verified beacon of sequence 5" in found[0].reason
    assert feed.counts["beacons_verified"] == 2


def test_without_a_trusted_key_nothing_is_verified(signed: Signed) -> None:
    blocks = blocks_of(*signed(5))
    found = Feed()(blocks)
    assert trusts(found) == ["unverified", "unverified"]
    assert found[1].reason == "signed by a key that is not trusted"


def test_an_old_beacon_is_replayed(signed: Signed) -> None:
    feed = Feed(trusted_keys=signed.trusted, oldest_sequence=3)
    assert trusts(feed(blocks_of(*signed(2)))) == ["unverified", "forged"]
    feed = Feed(trusted_keys=signed.trusted)
    assert trusts(feed(blocks_of(*signed(9)))) == ["unverified", "verified"]
    found = feed(blocks_of(*signed(8, replace(PLACE, latitude_deg=35.3))), transmitter=1)
    assert trusts(found) == ["forged"]
    assert found[0].reason == "replayed: sequence 8 is older than verified 9"
    found = feed(blocks_of(*signed(9, replace(PLACE, height_m=53.0))), transmitter=2)
    assert trusts(found) == ["forged"]
    assert found[0].reason == "differs from the verified beacon of sequence 9"
    # Another transmitter's number is its own.
    other = signed(1, replace(PLACE, latitude_deg=35.4), transmitter_id=8)
    assert trusts(feed(blocks_of(*other))) == ["unverified", "verified"]


def test_every_forgery_of_ten_thousand_is_found_out(signed: Signed, tmp_path: Path) -> None:
    """A lamp beside the honest one shows tampered, unsigned, replayed or wrongly signed beacons."""
    rng = np.random.default_rng(11)
    other = Signed(tmp_path)
    assembler = MessageAssembler(CODER, replace(MessageSpec(), trusted_keys=signed.trusted))

    def show(messages: list[Message], transmitter: int) -> list[ReceivedMessage]:
        """Hand blocks over as if decoded: forgery is of bytes, not of light."""
        found: list[ReceivedMessage] = []
        inbox = assembler._inboxes.setdefault(transmitter, type(assembler._inboxes[0])())
        packet = Packet(transmitter, 0, 0.0, 100.0, (), 10)
        for message in messages:
            for block in split(message, CODER.digest, CODER.block_bytes):
                found += assembler._take(inbox, block, packet)
        return found

    assembler.add(packet_of(np.zeros(960), 0))
    assert trusts(show(signed(1000), 0)) == ["unverified", "verified"]
    flagged = 0
    for trial in range(10_000):
        assembler._inboxes.pop(1, None)
        way = trial % 5
        sequence = 1000 + int(rng.integers(0, 5))
        beacon, signature = honest = signed(sequence if way != 3 else int(rng.integers(0, 1000)))
        if way == 0:  # a bit of the beacon
            payload = bytearray(beacon.payload)
            at = int(rng.integers(0, 8 * len(payload)))
            payload[at // 8] ^= 1 << at % 8
            shown = [replace(beacon, payload=bytes(payload)), signature]
        elif way == 1:  # a newer number for the beacon and its signature
            newer = sequence + 1 + int(rng.integers(0, 100))
            shown = [replace(m, sequence=newer) for m in honest]
        elif way == 2:  # a bit of the signature, of a beacon that moved
            moved = signed(sequence + 1, replace(PLACE, latitude_deg=35.1 + float(rng.uniform(1e-6, 1))))
            payload = bytearray(moved[1].payload)
            at = 64 + int(rng.integers(0, 512))
            payload[at // 8] ^= 1 << at % 8
            shown = [moved[0], replace(moved[1], payload=bytes(payload))]
        elif way == 3:  # an old one of another place, rightly signed
            shown = signed(
                int(rng.integers(0, 1000)), replace(PLACE, longitude_deg=float(rng.uniform(-180, 180)))
            )
        else:  # a moved one, signed by another key
            moved_beacon = Message(Kind.BEACON, 7, sequence + 1, replace(PLACE, height_m=0.0).pack())
            shown = [moved_beacon, signing.sign(moved_beacon, CODER.digest, other.key)]
        told = show(shown, 1)
        calibrate_llr = [m for m in told if m.trust == "verified"]
        flagged += bool(told) and told[-1].trust == "forged" and not calibrate_llr
    # Some tampered bytes are a place that cannot be: counted, and never handed on.
    assert flagged + assembler.counts["messages_undecodable"] == 10_000
    assert flagged > 9_000
    assert assembler._beacons._verified[7].message.sequence == 1000
