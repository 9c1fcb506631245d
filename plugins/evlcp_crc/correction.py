"""No correction: the message followed by its CRC-24."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.crc import CRC_BITS, crc24
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Code, Corrected, ErrorCorrection


@dataclass(frozen=True)
class NoCorrection(ErrorCorrection):
    """Errors are detected, none is corrected: whole bytes of message, their CRC-24, then zeros.

    A block of random bits passes with a probability of 2**-24.
    """

    def compile(self, coded_bits: int) -> Code:
        """Message of the whole bytes that fit before the CRC.

        Raises:
            ConfigError: Not one byte fits.
        """
        message_bits = (coded_bits - CRC_BITS) // 8 * 8
        if message_bits < 8:
            raise ConfigError(
                f"error-correction 'none': a block of {coded_bits} bits, expected at least {CRC_BITS + 8}"
            )
        return _CrcCode(message_bits, coded_bits)


@dataclass(frozen=True)
class _CrcCode:
    message_bits: int
    coded_bits: int

    def encode(self, bits: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if bits.shape != (self.message_bits,):
            raise ConfigError(f"message of shape {bits.shape}: expected ({self.message_bits},) bits")
        coded = np.zeros(self.coded_bits, np.uint8)
        coded[: self.message_bits] = bits
        coded[self.message_bits : self.message_bits + CRC_BITS] = crc24(bits)
        return coded

    def decode(self, llr: NDArray[np.float32]) -> Corrected:
        if llr.shape != (self.coded_bits,):
            raise ConfigError(f"LLRs of shape {llr.shape}: expected ({self.coded_bits},)")
        coded = (llr < 0).astype(np.uint8)
        bits = coded[: self.message_bits]
        return Corrected(bits.copy(), bool(np.array_equal(self.encode(bits), coded)), 0)
