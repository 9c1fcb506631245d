"""Blocks: the bytes that one packet carries, a header and a part of a message."""

import struct
import zlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum

from evlcp_sdk.errors import ConfigError, EvlcpError

FORMAT_VERSION = 1
"""Version of the block format."""

DIGEST_BYTES = 4
"""Bytes of the codebook's digest in a header: two codebooks agree in them by chance once in 2**32."""

MOST_MESSAGE_BYTES = 0xFFFF
"""Longest message: what the header's length can express."""

_HEADER = struct.Struct("<BIIHH4s")
_CHECK = struct.Struct("<I")

HEADER_BYTES = _HEADER.size
"""Bytes of a block's header."""

_WHITE_SEED = 2463534242
"""Start of the whitening where the header's CRC is 0: xorshift32 would stay there."""

_MOST_NUMBER = 0xFFFFFFFF
_MOST_PARTS = 0x10000


class Kind(IntEnum):
    """Numbers of the kinds that are built in; what they mean is in `air.kinds`."""

    BEACON = 1
    TEXT = 2
    DATA = 3
    SIGNATURE = 4
    TIME = 5
    COUNTDOWN = 6


_KINDS = frozenset(Kind)
_MOST_KIND = 15


class BlockError(EvlcpError):
    """Bytes that are not a block of this format."""


@dataclass(frozen=True)
class Message:
    """A message as its transmitter made it.

    Attributes:
        kind: Number of its kind: what the payload is, 1 to 15.
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
        if not 1 <= self.kind <= _MOST_KIND:
            raise ConfigError(f"message: kind = {self.kind}, expected 1 to {_MOST_KIND}")
        for name in ("transmitter_id", "sequence"):
            value = getattr(self, name)
            if not 0 <= value <= _MOST_NUMBER:
                raise ConfigError(f"message: {name} = {value}, expected 0 to {_MOST_NUMBER}")
        if not 1 <= len(self.payload) <= MOST_MESSAGE_BYTES:
            raise ConfigError(
                f"message: {len(self.payload)} bytes of {self.kind_name}, expected 1 to {MOST_MESSAGE_BYTES}"
            )

    @property
    def kind_name(self) -> str:
        """Name of a built-in kind, e.g. `text`; of another one `kind 7`."""
        return Kind(self.kind).name.lower() if self.kind in _KINDS else f"kind {self.kind}"

    @property
    def text(self) -> str | None:
        """The payload as text; None if it is not UTF-8, or the message is not a text."""
        if self.kind != Kind.TEXT:
            return None
        try:
            return self.payload.decode("utf-8")
        except UnicodeDecodeError:
            return None


@dataclass(frozen=True)
class Block:
    """A part of a message, with the header that every part carries.

    Attributes:
        kind: Number of the message's kind.
        transmitter_id: As in `Message`.
        sequence: As in `Message`.
        index: Number of the part, from 0.
        length: Bytes of the whole message, without its check; with the size of a block it gives the number of
            parts.
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
        """The block as `size` bytes; what the part leaves free is zero, and all but the header whitened."""
        head = _HEADER.pack(
            FORMAT_VERSION << 4 | self.kind,
            self.transmitter_id,
            self.sequence,
            self.index,
            self.length,
            self.codebook,
        )
        return head + _whitened(head, self.part.ljust(size - HEADER_BYTES, b"\0"))

    @classmethod
    def unpack(cls, block: bytes, kinds: Collection[int] = _KINDS) -> "Block":
        """Read what `pack` wrote.

        Args:
            block: The bytes.
            kinds: Numbers of the kinds that are known.

        Raises:
            BlockError: Another version, an unknown kind, a part that no message of that length has, or bytes
                behind the part that are not zero.
        """
        first, transmitter_id, sequence, index, length, codebook = _HEADER.unpack_from(block)
        version, kind = first >> 4, first & 15
        if version != FORMAT_VERSION:
            raise BlockError(f"block of format version {version}, expected {FORMAT_VERSION}")
        if kind not in kinds:
            raise BlockError(f"block of kind {kind}, expected one of {', '.join(map(str, sorted(kinds)))}")
        room = len(block) - HEADER_BYTES
        carried = carried_bytes(length, room)
        if not index * room < carried:
            raise BlockError(f"part {index} of a message of {length} bytes, {room} in a part")
        rest = _whitened(block[:HEADER_BYTES], block[HEADER_BYTES:])
        end = min(room, carried - index * room)
        if any(rest[end:]):
            raise BlockError(f"bytes {HEADER_BYTES + end} to {len(block) - 1} of the block: expected zeros")
        return cls(
            Kind(kind) if kind in _KINDS else kind,
            transmitter_id,
            sequence,
            index,
            length,
            codebook,
            rest[:end],
        )


def _whitened(head: bytes, rest: bytes) -> bytes:
    """The bytes behind a header, added modulo 2 to the numbers of xorshift32 that starts with its CRC-32.

    The numbers are those of Marsaglia 2003 (shifts 13, 17, 5), four bytes each, least significant first.
    Equal bytes so do not make equal symbols, a light that repeats itself frame by frame; and two blocks of
    different headers differ in half their bits on air, so that a receiver can tell which packets carry the
    same one.
    """
    x = zlib.crc32(head) or _WHITE_SEED
    stream = bytearray()
    while len(stream) < len(rest):
        x ^= x << 13 & 0xFFFFFFFF
        x ^= x >> 17
        x ^= x << 5 & 0xFFFFFFFF
        stream += x.to_bytes(4, "little")
    return bytes(a ^ b for a, b in zip(rest, stream, strict=False))


def carried_bytes(length: int, room: int) -> int:
    """Bytes that the parts of a message carry: its own and, where one part does not hold them, its check.

    Args:
        length: Bytes of the message.
        room: Bytes of a part.

    >>> carried_bytes(40, 40), carried_bytes(41, 40)
    (40, 45)
    """
    return length if length <= room else length + _CHECK.size


def split(message: Message, codebook: bytes, size: int) -> Iterator[Block]:
    """The blocks of `size` bytes each that carry a message.

    A message of several blocks is followed by its CRC-32 (that of zlib): each block is sure by itself, but
    two messages under one number would pass for one.

    Args:
        message: The message.
        codebook: First `DIGEST_BYTES` bytes of the codebook's digest.
        size: Bytes of a block.

    Raises:
        ConfigError: Its parts are more than a header can number.

    >>> [b.part.hex() for b in split(Message(Kind.DATA, 1, 0, b"abcde"), bytes(4), HEADER_BYTES + 3)]
    ['616263', '646565', 'd88785']
    """
    room, length = size - HEADER_BYTES, len(message.payload)
    carried = message.payload if length <= room else message.payload + _check(message.payload)
    if len(carried) > room * _MOST_PARTS:
        raise ConfigError(f"message: {length} bytes in parts of {room}, expected at most {_MOST_PARTS} parts")
    for index, begin in enumerate(range(0, len(carried), room)):
        yield Block(
            message.kind,
            message.transmitter_id,
            message.sequence,
            index,
            length,
            codebook,
            carried[begin : begin + room],
        )


def joined(parts: Sequence[bytes], length: int) -> bytes:
    """The payload that the parts of a message carry, all of them and in order.

    Args:
        parts: What `split` made of it.
        length: Bytes of the message.

    Raises:
        BlockError: The parts are not those of one message.

    >>> joined([bytes.fromhex(part) for part in ("616263", "646565", "d88785")], 5)
    b'abcde'
    """
    carried = b"".join(parts)
    payload, check = carried[:length], carried[length:]
    if check != (_check(payload) if len(parts) > 1 else b""):
        raise BlockError(f"{len(parts)} parts that are not those of one message of {length} bytes")
    return payload


def _check(payload: bytes) -> bytes:
    return _CHECK.pack(zlib.crc32(payload))
