"""The worked values, computed again from the tables of docs/messages.md with nothing of the SDK."""

import binascii
import json
import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

VECTORS = json.loads((Path(__file__).parents[2] / "vectors" / "messages.json").read_text())
PACKETS = VECTORS["packets"]
KINDS = {"beacon": 1, "text": 2, "data": 3, "signature": 4}
BITS = {"wh4x2": 6, "wh8": 4, "raw8": 8}


def xorshift32(x: int) -> Iterator[int]:
    while True:
        x = (x ^ (x << 13)) % 2**32
        x = x ^ (x >> 17)
        x = (x ^ (x << 5)) % 2**32
        yield x


def block_of(p: dict[str, Any]) -> bytes:
    size = len(p["block"]) // 2
    head = struct.pack(
        "<BIIHH", 1 << 4 | KINDS[p["kind"]], p["transmitter_id"], p["sequence"], p["index"], p["length"]
    ) + bytes.fromhex(p["codebook"])
    rest = bytes.fromhex(p["part"]).ljust(size - 17, b"\0")
    stream = b"".join(struct.pack("<I", x) for x in islice(xorshift32(binascii.crc32(head)), size))
    return head + bytes(a ^ b for a, b in zip(rest, stream, strict=False))


def crc24(bits: str) -> str:
    """Long division by x^24 + x^23 + x^21 + ... (CRC24C of 3GPP TS 38.212), ones before the message."""
    powers = (24, 23, 21, 20, 17, 15, 13, 12, 8, 4, 2, 1, 0)
    rest = [int(b) for b in bits] + [0] * 24
    for i in range(24):
        rest[i] ^= 1
    for i in range(len(bits)):
        if rest[i]:
            for power in powers:
                rest[i + 24 - power] ^= 1
    return "".join(map(str, rest[-24:]))


def order(bits: int) -> list[int]:
    numbers = list(islice(xorshift32(2463534242), bits))
    return sorted(range(bits), key=numbers.__getitem__)


def test_the_interleaver() -> None:
    assert VECTORS["interleaver_960"] == order(960)


@pytest.mark.parametrize(
    "p", PACKETS, ids=lambda p: f"{p['profile']}-{p['error_correction']}-{p['kind']}{p['index']}"
)
def test_blocks_and_unprotected_packets(p: dict[str, Any]) -> None:
    assert block_of(p).hex() == p["block"]
    if p["error_correction"] != "none":
        return
    m = BITS[p["profile"]]
    n = 160 * m
    message = "".join(f"{byte:08b}" for byte in bytes.fromhex(p["block"])).ljust((n - 24) // 8 * 8, "0")
    coded = (message + crc24(message)).ljust(n, "0")
    air = [""] * n
    for bit, place in zip(coded, order(n), strict=True):
        air[place] = bit
    symbols = [int("".join(air[i : i + m]), 2) for i in range(0, n, m)]
    assert bytes(symbols).hex() == p["symbols"]


def test_the_file_is_what_the_command_prints() -> None:
    """Protected packets, too: their code has its own tests."""
    scope: dict[str, Any] = {"__name__": "vectors"}
    path = Path(__file__).parents[2] / "vectors" / "messages.py"
    exec(compile(path.read_text(), str(path), "exec"), scope)
    assert json.loads(json.dumps(scope["vectors"]())) == VECTORS
