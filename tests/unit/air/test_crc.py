"""CRC-24 against published check values, long division, and what it promises to find."""

import numpy as np
import pytest

from evlcp_sdk.air.crc import crc24

NINE = np.unpackbits(np.frombuffer(b"123456789", np.uint8))


def value(bits: np.ndarray) -> int:
    return int("".join(map(str, bits)), 2)


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
    got = value(crc24(NINE, polynomial, start))
    assert got == check, hex(got)


def test_nothing_does_not_pass() -> None:
    for length in range(1, 600):
        assert crc24(np.zeros(length, np.uint8)).any()
