"""Blocks and beacons, held against struct and hand-made bytes; CRC-24 against its published values."""

import binascii
import math
import struct
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, strategies as st

from evlcp_sdk.air.beacons import BEACON_BYTES, Beacon
from evlcp_sdk.air.blocks import HEADER_BYTES, Block, BlockError, Kind, Message, join_parts, split_message
from evlcp_sdk.air.crc import crc24
from evlcp_sdk.errors import ConfigError

DIGEST = bytes.fromhex("00112233")
BEACON_NAMES = ("latitude_deg", "longitude_deg", "height_m", "heading_deg", "tilt_deg", "length_m")


U32 = st.integers(0, 2**32 - 1)


@given(
    U32, U32, st.binary(min_size=1, max_size=300), st.integers(HEADER_BYTES + 1, 90), st.sampled_from(Kind)
)
def test_a_message_is_the_sum_of_its_blocks(transmitter_id, sequence, payload, size, kind) -> None:
    message = Message(kind, transmitter_id, sequence, payload)
    blocks = list(split_message(message, DIGEST, size))
    # Independent of the module: a message of several blocks is followed by its CRC-32.
    carried = payload
    if len(payload) > size - 17:
        carried += struct.pack("<I", binascii.crc32(payload))
    assert len(blocks) == -(-len(carried) // (size - HEADER_BYTES))
    packed = [b.pack(size) for b in blocks]
    assert {len(p) for p in packed} == {size}
    assert [Block.unpack(p) for p in packed] == blocks
    assert b"".join(b.part for b in blocks) == carried
    assert join_parts([b.part for b in blocks], len(payload)) == payload
    for i, p in enumerate(packed):
        # Independent of the module: the table of docs/messages.md. What follows is whitened: test_vectors.
        head = struct.pack("<BIIHH", 0x10 + kind, transmitter_id, sequence, i, len(payload)) + DIGEST
        assert p[:17] == head


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({0: 0x22}, "format version 2, expected 1"),
        ({0: 0x00}, "format version 0"),
        ({0: 0x1F}, "kind 15, expected one of 1, 2, 3, 4"),
        ({0: 0x10}, "kind 0"),
        ({9: 1}, "part 1 of a message of 2 bytes, 7 in a part"),
        ({11: 0}, "part 0 of a message of 0 bytes"),
        ({23: 1}, "bytes 19 to 23 of the block: expected zeros"),
    ],
)
def test_what_is_no_block_is_reported(change: dict[int, int], expected: str) -> None:
    block = bytearray(Block(Kind.TEXT, 7, 1, 0, 2, DIGEST, b"Hi").pack(24))
    assert Block.unpack(bytes(block)).part == b"Hi"
    for at, value in change.items():
        block[at] = value if at < 17 else block[at] ^ value
    with pytest.raises(BlockError, match=expected):
        Block.unpack(bytes(block))


BEACON = dict.fromkeys(BEACON_NAMES, 1.0)
BEYOND = (90.1, -181.0, math.nan, -1.0, 181.0, 0.0), (-90.1, 181.0, -13e3, 361.0, -1.0, 101.0)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: Message(Kind.TEXT, -1, 0, b"a"), "transmitter_id = -1, expected 0 to 4294967295"),
        (lambda: Message(Kind.TEXT, 0, 2**32, b"a"), "sequence = 4294967296, expected"),
        (lambda: Message(Kind.DATA, 0, 0, b""), "0 bytes of data, expected 1 to 65535"),
        (lambda: Message(Kind.DATA, 0, 0, bytes(65536)), "65536 bytes of data"),
        (lambda: next(split_message(Message(Kind.DATA, 1, 2, bytes(65535)), DIGEST, HEADER_BYTES + 1)),
         "65535 bytes in parts of 1, expected at most 65536 parts"),
        *((partial(Beacon, **(BEACON | {name: value})), f"beacon: {name} = {value}, expected")
          for values in BEYOND for name, value in zip(BEACON_NAMES, values, strict=True)),
        (lambda: Beacon.unpack(bytes(27)), f"beacon of 27 bytes, expected at least {BEACON_BYTES}"),
        (lambda: Beacon.unpack(struct.pack("<qqiHHI", 91 * 10**9, 0, 0, 0, 0, 1)), "latitude_deg"),
    ],
)  # fmt: skip
def test_what_is_no_message_is_reported(make: Callable[[], object], expected: str) -> None:
    with pytest.raises((ConfigError, BlockError), match=expected):
        make()


@given(
    st.integers(-90 * 10**9, 90 * 10**9),
    st.integers(-180 * 10**9, 180 * 10**9),
    st.integers(-12 * 10**6, 20 * 10**6),
    st.integers(0, 35999),
    st.integers(0, 18000),
    st.integers(1, 100_000),
    st.binary(max_size=40),
)
def test_beacons_keep_every_digit(latitude, longitude, height, heading, tilt, length, user) -> None:
    payload = struct.pack("<qqiHHI", latitude, longitude, height, heading, tilt, length) + user
    beacon = Beacon.unpack(payload)
    assert beacon.pack() == payload
    assert beacon.place[:2] == pytest.approx((latitude * 1e-9, longitude * 1e-9), abs=1e-12)
    assert (beacon.height_m, beacon.length_m) == pytest.approx((height * 1e-3, length * 1e-3))
    assert (beacon.heading_deg, beacon.tilt_deg) == pytest.approx((heading / 100, tilt / 100))
    assert beacon.user == user
    # Beyond its digits a heading is that of the next turn.
    assert replace(beacon, heading_deg=359.999).pack() == replace(beacon, heading_deg=0.0).pack()


NINE = np.unpackbits(np.frombuffer(b"123456789", np.uint8))


def divide(bits: np.ndarray, polynomial: int, start: int) -> int:
    """The register after a message, bit by bit."""
    for bit in bits.tolist():
        start = (start << 1 & 0xFFFFFF) ^ (polynomial if start >> 23 ^ bit else 0)
    return start


@pytest.mark.parametrize(
    ("polynomial", "start", "check"),
    [
        (0x864CFB, 0xB704CE, 0x21CF02),
        (0x864CFB, 0, 0xCDE703),
        (0x800063, 0, 0x23EF52),
        (0x328B63, 0xFFFFFF, 0xB4F3E6 ^ 0xFFFFFF),
    ],
    ids=["OpenPGP", "LTE-A", "LTE-B", "Interlaken, which sends it inverted"],
)
def test_published_check_values(polynomial: int, start: int, check: int) -> None:
    assert divide(NINE, polynomial, start) == check


@pytest.mark.parametrize("bits", [*range(1, 18), 72])
def test_a_message_need_not_fill_its_bytes(bits: int) -> None:
    register = divide(NINE[:bits], 0xB2B117, 0xFFFFFF)
    assert "".join(map(str, crc24(NINE[:bits]))) == f"{register:024b}"
