"""Blocks: the bytes of one packet, a header and a part of a message."""

import struct
import zlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import islice

from evlcp_sdk.errors import ConfigError, EvlcpError

FORMAT_VERSION = 1
"""Version of the block format."""

DIGEST_BYTES = 4
"""Bytes of the codebook's digest in a header: those of two codebooks agree by chance once in 2**32."""

MAX_MESSAGE_BYTES = 0xFFFF
"""Longest message that the header's length can express."""

_HEADER = struct.Struct("<BIIHH4s")
_CRC = struct.Struct("<I")

HEADER_BYTES = _HEADER.size
"""Bytes of a block's header."""

XORSHIFT_SEED = 2463534242
"""Marsaglia's seed of xorshift32; also of the whitening if the header's CRC is 0, where that would stay."""

_LARGEST_NUMBER = 0xFFFFFFFF
_MAX_PARTS = 0x10000


class Kind(IntEnum):
    """Numbers of the built-in kinds; `air.kinds` has their meaning."""

    BEACON = 1
    TEXT = 2
    DATA = 3
    SIGNATURE = 4
    TIME = 5
    COUNTDOWN = 6


_KINDS = frozenset(Kind)
_LARGEST_KIND = 15


class BlockError(EvlcpError):
    """Bytes that are not a block of this format."""


@dataclass(frozen=True)
class Message:
    """A message, whole.

    Attributes:
        kind: Number of its kind, which gives the payload its meaning, 1 to 15.
        transmitter_id: Identity of the transmitter, 0 to 2**32 - 1.
        sequence: Number of the message, rising from each to the next of a transmitter, 0 to 2**32 - 1.
        payload: Its bytes.

    Raises:
        ConfigError: A number or the payload's length is out of range.
    """

    kind: int
    transmitter_id: int
    sequence: int
    payload: bytes

    def __post_init__(self) -> None:
        if not 1 <= self.kind <= _LARGEST_KIND:
            raise ConfigError(f"message: kind = {self.kind}, expected 1 to {_LARGEST_KIND}")
        for name in ("transmitter_id", "sequence"):
            value = getattr(self, name)
            if not 0 <= value <= _LARGEST_NUMBER:
                raise ConfigError(f"message: {name} = {value}, expected 0 to {_LARGEST_NUMBER}")
        if not 1 <= len(self.payload) <= MAX_MESSAGE_BYTES:
            raise ConfigError(
                f"message: {len(self.payload)} bytes of {self.kind_name}, expected 1 to {MAX_MESSAGE_BYTES}"
            )

    @property
    def kind_name(self) -> str:
        """Name of a built-in kind, e.g. `text`; of another one `kind 7`."""
        return Kind(self.kind).name.lower() if self.kind in _KINDS else f"kind {self.kind}"

    @property
    def text(self) -> str | None:
        """The payload as text; None if the message is not a text, or not UTF-8."""
        if self.kind != Kind.TEXT:
            return None
        try:
            return self.payload.decode("utf-8")
        except UnicodeDecodeError:
            return None


@dataclass(frozen=True)
class Block:
    """A part of a message with its header.

    Attributes:
        kind: Number of the message's kind.
        transmitter_id: As in `Message`.
        sequence: As in `Message`.
        index: Number of the part, from 0.
        length: Bytes of the whole message, without its CRC, from which the number of parts follows.
        codebook: First `DIGEST_BYTES` bytes of the codebook's digest.
        part: The part's bytes; all parts but the last fill their block.

    >>> block = Block(Kind.TEXT, 7, sequence=1, index=0, length=2, codebook=bytes(4), part=b"Hi")
    >>> Block.unpack(block.pack(24)) == block
    True
    """

    kind: int
    transmitter_id: int
    sequence: int
    index: int
    length: int
    codebook: bytes
    part: bytes

    def pack(self, size: int) -> bytes:
        """The block as `size` bytes, filled up with zeros; all but the header is whitened."""
        head = _HEADER.pack(
            FORMAT_VERSION << 4 | self.kind,
            self.transmitter_id,
            self.sequence,
            self.index,
            self.length,
            self.codebook,
        )
        return head + _whiten(head, self.part.ljust(size - HEADER_BYTES, b"\0"))

    @classmethod
    def unpack(cls, block: bytes, kinds: Collection[int] = _KINDS) -> "Block":
        """A block from its bytes; `kinds` are the numbers of the known kinds.

        Raises:
            BlockError: The version or kind is unknown, no message of that length has such a part, or bytes
                after the part are not zero.
        """
        first, transmitter_id, sequence, index, length, codebook = _HEADER.unpack_from(block)
        version, kind = first >> 4, first & 15
        if version != FORMAT_VERSION:
            raise BlockError(f"block of format version {version}, expected {FORMAT_VERSION}")
        if kind not in kinds:
            raise BlockError(f"block of kind {kind}, expected one of {', '.join(map(str, sorted(kinds)))}")
        room = len(block) - HEADER_BYTES
        total = total_bytes(length, room)
        if not index * room < total:
            raise BlockError(f"part {index} of a message of {length} bytes, {room} in a part")
        body = _whiten(block[:HEADER_BYTES], block[HEADER_BYTES:])
        end = min(room, total - index * room)
        if any(body[end:]):
            raise BlockError(f"bytes {HEADER_BYTES + end} to {len(block) - 1} of the block: expected zeros")
        return cls(
            Kind(kind) if kind in _KINDS else kind,
            transmitter_id,
            sequence,
            index,
            length,
            codebook,
            body[:end],
        )


def _whiten(head: bytes, body: bytes) -> bytes:
    """The bytes after a header, XORed with the numbers of an xorshift32 that starts with the header's CRC-32.

    The numbers are four bytes each, least significant first. So equal bytes do not make equal symbols, a
    light that repeats itself frame by frame; and two blocks with different headers differ in half their bits
    on air, so that a receiver recognises packets of the same one.
    """
    numbers = islice(iterate_xorshift32(zlib.crc32(head) or XORSHIFT_SEED), -(-len(body) // 4))
    stream = b"".join(number.to_bytes(4, "little") for number in numbers)
    return bytes(a ^ b for a, b in zip(body, stream, strict=False))


def iterate_xorshift32(x: int) -> Iterator[int]:
    """The numbers of the generator xorshift32 (Marsaglia 2003, shifts 13, 17, 5) after `x`, without end.

    >>> next(iterate_xorshift32(XORSHIFT_SEED))
    723471715
    """
    while True:
        x ^= x << 13 & 0xFFFFFFFF
        x ^= x >> 17
        x ^= x << 5 & 0xFFFFFFFF
        yield x


def total_bytes(length: int, room: int) -> int:
    """Bytes of all parts, of `room` bytes each, of a message: with a CRC if it does not fit into one.

    >>> total_bytes(40, 40), total_bytes(41, 40)
    (40, 45)
    """
    return length if length <= room else length + _CRC.size


def split_message(message: Message, codebook: bytes, size: int) -> Iterator[Block]:
    """The blocks of a message, of `size` bytes each, with the digest of a codebook (`DIGEST_BYTES` bytes).

    A message of several blocks is followed by its CRC-32 (that of zlib): each block has its own check, but
    parts of two messages with one number would pass for one message.

    Raises:
        ConfigError: There are more parts than a header can number.

    >>> [b.part.hex() for b in split_message(Message(Kind.DATA, 1, 0, b"abcde"), bytes(4), HEADER_BYTES + 3)]
    ['616263', '646565', 'd88785']
    """
    room, length = size - HEADER_BYTES, len(message.payload)
    content = message.payload if length <= room else message.payload + _crc(message.payload)
    if len(content) > room * _MAX_PARTS:
        raise ConfigError(f"message: {length} bytes in parts of {room}, expected at most {_MAX_PARTS} parts")
    for index, begin in enumerate(range(0, len(content), room)):
        yield Block(
            message.kind,
            message.transmitter_id,
            message.sequence,
            index,
            length,
            codebook,
            content[begin : begin + room],
        )


def join_parts(parts: Sequence[bytes], length: int) -> bytes:
    """The payload of a message of `length` bytes from all its parts, in order.

    Raises:
        BlockError: The parts are not those of one message.

    >>> join_parts([bytes.fromhex(part) for part in ("616263", "646565", "d88785")], 5)
    b'abcde'
    """
    content = b"".join(parts)
    payload, check = content[:length], content[length:]
    if check != (_crc(payload) if len(parts) > 1 else b""):
        raise BlockError(f"{len(parts)} parts that are not those of one message of {length} bytes")
    return payload


def _crc(payload: bytes) -> bytes:
    return _CRC.pack(zlib.crc32(payload))
