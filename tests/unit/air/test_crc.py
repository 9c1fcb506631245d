"""CRC-24 against published check values, long division, and what it promises to find."""

import numpy as np
import pytest

from evlcp_sdk.air.crc import CRC24C, CRC_BITS, crc24

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


@pytest.mark.parametrize("length", [1, 23, 24, 25, 104, 456])
def test_against_long_division(length: int) -> None:
    """The rest of (24 ones over the first bits + message * x^24) divided by the polynomial, by integers."""
    message = np.random.default_rng(length).integers(0, 2, length).astype(np.uint8)
    rest = (value(message) << CRC_BITS) ^ (((1 << CRC_BITS) - 1) << length)
    generator = 1 << CRC_BITS | CRC24C
    for shift in range(length + CRC_BITS, CRC_BITS - 1, -1):
        if rest >> shift & 1:
            rest ^= generator << (shift - CRC_BITS)
    assert value(crc24(message)) == rest


def test_nothing_does_not_pass() -> None:
    for length in range(1, 600):
        assert crc24(np.zeros(length, np.uint8)).any()


def test_the_polynomial_is_that_of_the_standard() -> None:
    powers = (23, 21, 20, 17, 15, 13, 12, 8, 4, 2, 1, 0)
    assert sum(1 << p for p in powers) == CRC24C
