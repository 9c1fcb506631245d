"""Blocks to packets: protection and interleaving, and back from soft bits."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.blocks import DIGEST_BYTES, HEADER_BYTES, XORSHIFT_SEED, iterate_xorshift32
from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat, symbols_of_bits
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Code, Corrected


def packet_bits(codebook: Codebook, packet: PacketFormat) -> int:
    """Bits of a packet on air."""
    return packet.frames * codebook.clusters * codebook.bits_per_symbol


def interleaver_order(bits: int) -> NDArray[np.int64]:
    """Place on air of each coded bit, int64 (bits,): the places 0, 1, ... sorted by random numbers.

    The numbers are those of xorshift32, one a place. A lost cluster or frame then takes bits from the whole
    code. A regular order, such as multiples of the golden ratio, spreads them more evenly, but suits a polar
    code badly, whose own order is as regular.

    >>> interleaver_order(10).tolist()
    [5, 7, 0, 8, 6, 3, 2, 1, 9, 4]
    """
    numbers = np.fromiter(iterate_xorshift32(XORSHIFT_SEED), np.int64, bits)
    return np.argsort(numbers, kind="stable")


class BlockCoder:
    """Encodes one block in each packet, and decodes it from the packet's soft bits.

    Args:
        codebook: The codes that both ends share.
        packet: Lengths of a packet's parts.
        code: The error-correcting code of a packet's bits.
        name_faults: Makes a context that names the code where it fails.

    Raises:
        ConfigError: A packet is too short for a block.
    """

    def __init__(
        self,
        codebook: Codebook,
        packet: PacketFormat,
        code: Code,
        name_faults: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self.codebook = codebook
        self._name_faults = name_faults
        self._frames = packet.frames
        self._code = code
        self.bits = packet_bits(codebook, packet)
        if not isinstance(bits := getattr(code, "message_bits", None), int | np.integer):
            raise TypeError(
                f"gave {type(code).__name__} with message_bits = {bits!r}, expected a whole number"
            )
        self.block_bytes = code.message_bits // 8
        if self.block_bytes <= HEADER_BYTES:
            raise ConfigError(
                f"messages: a packet of {packet.frames} frames has {self.bits} bits on air and carries"
                f" {self.block_bytes} bytes, expected at least {HEADER_BYTES + 1};"
                " raise air.frames_per_packet or the rate of the error correction"
            )
        self._order = interleaver_order(self.bits)

    @cached_property
    def digest(self) -> bytes:
        """The codebook's digest in blocks' headers."""
        return bytes.fromhex(self.codebook.digest)[:DIGEST_BYTES]

    def encode_symbols(self, block: bytes) -> NDArray[np.int64]:
        """Symbols of the packet that carries a block, int64 (frames, clusters)."""
        return symbols_of_bits(self.encode_bits(block), self.codebook.bits_per_symbol, self.codebook.clusters)

    def encode_bits(self, block: bytes) -> NDArray[np.uint8]:
        """Bits of the packet that carries a block of `block_bytes` bytes, uint8 (bits,)."""
        message = np.zeros(self._code.message_bits, np.uint8)
        message[: 8 * self.block_bytes] = np.unpackbits(np.frombuffer(block, np.uint8))
        air = np.empty(self.bits, np.uint8)
        with self._name_faults():
            coded = self._code.encode(message)
            if np.shape(coded) != air.shape or np.max(coded) > 1:
                raise ValueError(f"gave no {self.bits} bits of 0 and 1 at encode()")
            air[self._order] = coded
        return air

    def decode_block(self, llr: NDArray[np.float32]) -> bytes | None:
        """The block of a packet; None if the code's check fails.

        `llr` are the LLRs ln P(bit 0) / P(bit 1) of its bits in the order on air, float32 (bits,); 0 for a
        bit that was not received.
        """
        # Fewer bits than the message has cannot determine it.
        if np.count_nonzero(llr) < self._code.message_bits:
            return None
        bits = self._code.message_bits
        with self._name_faults():
            found = self._code.decode(np.ascontiguousarray(llr[self._order], np.float32))
            if not isinstance(found, Corrected):
                raise TypeError(f"gave {type(found).__name__}, expected Corrected")
            if np.shape(found.bits) != (bits,):
                raise ValueError(f"gave bits of shape {np.shape(found.bits)}, expected {bits}")
            if not found.ok or found.bits[8 * self.block_bytes :].any():
                return None
            return np.packbits(found.bits[: 8 * self.block_bytes]).tobytes()
