"""CRC-24 of a message's bits, by which an error-correction algorithm verifies what it decoded.

Polynomial CRC24C of 3GPP TS 38.212, 5.1: x^24 + x^23 + x^21 + x^20 + x^17 + x^15 + x^13 + x^12 + x^8 + x^4 +
x^2 + x + 1. The register starts with ones, so that a block of zeros, of which nothing was received, does not
pass; bits enter first bit first, and the register is sent highest power first; neither is inverted.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

CRC_BITS = 24
"""Bits of the check."""

_CRC24C = 0xB2B117
"""The polynomial without its x^24, highest power in the highest bit."""

_ONES = 0xFFFFFF


def crc24(bits: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The 24 check bits of a message, uint8 (24,), in the order in which they are sent.

    `bits` is the message, uint8 (n,), 0 or 1, in the order in which it is sent.

    >>> "".join(map(str, crc24(np.ones(8, np.uint8))))
    '111111111111111100000000'
    """
    register, odd = _ONES, len(bits) % 8
    for bit in bits[:odd].tolist():
        register = _shift(register ^ bit << 23)
    by_byte = _remainders()
    for byte in np.packbits(bits[odd:]).tolist():
        register = (register << 8 & _ONES) ^ by_byte[register >> 16 ^ byte]
    return np.array([register >> i & 1 for i in range(CRC_BITS - 1, -1, -1)], np.uint8)


def _shift(register: int) -> int:
    return (register << 1 & _ONES) ^ (_CRC24C if register >> 23 else 0)


@cache
def _remainders() -> list[int]:
    """The register after each byte, from a register of zeros."""
    registers = [byte << 16 for byte in range(256)]
    for _ in range(8):
        registers = [_shift(register) for register in registers]
    return registers
