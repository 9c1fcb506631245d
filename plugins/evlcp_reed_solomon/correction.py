"""Interleaved Reed-Solomon codewords over bytes, a CRC-24 behind them."""

from dataclasses import dataclass
from math import ceil
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.crc import CRC_BITS, crc24
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Code, Corrected, ErrorCorrection

_MAX_BYTES = 255
_CRC_BYTES = CRC_BITS // 8
_MIN_PARITY = 8
"""Parity bytes of a codeword that are left to correct errors.

With them a codeword of random bytes decodes with a probability of 1 / 4! at most (four errors are corrected),
so that all three attempts together take noise for a message with less than 3 * 2**-24 / 24 < 1e-8.
"""


@dataclass(frozen=True)
class ReedSolomon(ErrorCorrection):
    """Reed-Solomon codewords of at most 255 bytes, interleaved byte by byte (Reed and Solomon 1960).

    The field is GF(256) by x^8 + x^4 + x^3 + x^2 + 1, the generator has the roots 2^0, 2^1, ... A byte is as
    reliable as its least reliable bit. Decoding is tried with more and more of the least reliable bytes
    erased (Forney 1966) until the CRC holds: those not received, half of the parity, all but eight.
    """

    rate: Annotated[float, Field(gt=0, lt=1, description="Message and CRC bytes a coded byte.")] = 0.5

    def compile(self, coded_bits: int) -> Code:
        """Divide the block's bytes.

        Raises:
            ConfigError: There is no room for a byte beside the CRC, or for eight bytes of parity a codeword.
        """
        from reedsolo import RSCodec

        size = coded_bits // 8
        words = max(ceil(size / _MAX_BYTES), 1)
        # The little less keeps (1 - 0.9) * 120 from being 12.000001.
        parity = ceil((1 - self.rate) * size / words - 1e-6)
        data = size - words * parity
        if data <= _CRC_BYTES or parity < _MIN_PARITY:
            raise ConfigError(
                f"error-correction 'reed-solomon': a block of {coded_bits} bits at rate {self.rate:g}:"
                f" expected {_CRC_BYTES + 1} bytes of message and CRC and {_MIN_PARITY} of parity a codeword"
            )
        codec = RSCodec(nsym=parity, nsize=_MAX_BYTES, fcr=0, prim=0x11D, generator=2, c_exp=8)
        return _ReedSolomonCode(8 * (data - _CRC_BYTES), coded_bits, words, data, parity, codec)


@dataclass(frozen=True, eq=False)
class _ReedSolomonCode:
    message_bits: int
    coded_bits: int
    words: int
    data: int
    parity: int
    codec: Any

    def encode(self, bits: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if bits.shape != (self.message_bits,):
            raise ConfigError(f"message of shape {bits.shape}: expected ({self.message_bits},) bits")
        sent = np.zeros(self.data + self.words * self.parity, np.uint8)
        sent[: self.data] = np.packbits(np.concatenate([bits, crc24(bits)]))
        for word in range(self.words):
            codeword = self.codec.encode(sent[word : self.data : self.words].tobytes())
            sent[self.data + word :: self.words] = np.frombuffer(codeword, np.uint8)[-self.parity :]
        coded = np.zeros(self.coded_bits, np.uint8)
        coded[: 8 * len(sent)] = np.unpackbits(sent)
        return coded

    def decode(self, llr: NDArray[np.float32]) -> Corrected:
        if llr.shape != (self.coded_bits,):
            raise ConfigError(f"LLRs of shape {llr.shape}: expected ({self.coded_bits},)")
        size = self.data + self.words * self.parity
        # NaN is an erasure.
        llr = np.where(np.isnan(llr), np.float32(0), llr)
        signs = llr[: 8 * size] < 0
        received = np.packbits(signs)
        weakest = np.abs(llr[: 8 * size]).reshape(size, 8).min(1)
        most = self.parity - _MIN_PARITY
        for erased in sorted({0, min(self.parity // 2, most), most}):
            data = self._correct_words(received, weakest, erased)
            if data is None:
                continue
            bits = np.unpackbits(data)
            message = bits[: self.message_bits].copy()
            if np.array_equal(bits[self.message_bits :], crc24(message)):
                wrong = self.encode(message)[: 8 * size].astype(bool) != signs
                return Corrected(message, True, int(wrong[llr[: 8 * size] != 0].sum()))
        return Corrected(signs[: self.message_bits].astype(np.uint8), False, 0)

    def _correct_words(
        self, received: NDArray[np.uint8], weakest: NDArray[np.float32], erased: int
    ) -> NDArray[np.uint8] | None:
        """Message and CRC bytes with the least reliable of each codeword erased; None if one fails."""
        from reedsolo import ReedSolomonError

        found = np.empty(self.data, np.uint8)
        for word in range(self.words):
            message = np.arange(word, self.data, self.words)
            at = np.concatenate([message, np.arange(self.data + word, len(received), self.words)])
            count = max(erased, int((weakest[at] == 0).sum()))
            if count > self.parity - _MIN_PARITY:
                return None
            erasures = np.argsort(weakest[at], kind="stable")[:count]
            try:
                data = self.codec.decode(received[at].tobytes(), erase_pos=erasures.tolist())[0]
            except ReedSolomonError:
                return None
            found[word :: self.words] = np.frombuffer(data, np.uint8)
        return found
