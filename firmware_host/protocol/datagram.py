"""Datagrams on the wire: header, payload and CRC-32 in COBS, ended by a zero byte. No I/O.

```
COBS( type u8 | status u8 | sequence u16 | session u16 | payload | CRC-32/ISO-HDLC u32 ) 0x00
```
"""

import contextlib
import struct
import zlib
from dataclasses import dataclass, field

from cobs import cobs

from firmware_host.errors import DatagramError
from firmware_host.protocol.generated.requests import CRC_BYTES, HEADER_BYTES, MAX_PAYLOAD

_HEADER = struct.Struct("<BBHH")

MAX_WIRE_BYTES = HEADER_BYTES + MAX_PAYLOAD + CRC_BYTES + 3 + 1
"""Longest datagram on the wire, COBS overhead and delimiter included."""


@dataclass(frozen=True, slots=True)
class Datagram:
    """One request or reply.

    Attributes:
        type: Request type; bit 7 is set in a reply.
        status: 0 in a request, the result in a reply.
        sequence: Number of the request, 0 to 65535.
        session: The session, from HELLO.
        payload: Bytes of the message.

    >>> Datagram.decode(Datagram(0x0C, 0, 7, 1, b"").encode()[:-1]).sequence
    7
    """

    type: int
    status: int
    sequence: int
    session: int
    payload: bytes

    def encode(self) -> bytes:
        """The datagram on the wire, with its delimiter.

        Raises:
            DatagramError: The payload is longer than the protocol allows.
        """
        if len(self.payload) > MAX_PAYLOAD:
            raise DatagramError(f"payload of {len(self.payload)} bytes, at most {MAX_PAYLOAD}")
        body = _HEADER.pack(self.type, self.status, self.sequence, self.session) + self.payload
        return bytes(cobs.encode(body + zlib.crc32(body).to_bytes(4, "little"))) + b"\0"

    @classmethod
    def decode(cls, wire: bytes) -> "Datagram":
        """A datagram from the bytes between two delimiters.

        Raises:
            DatagramError: COBS, length or CRC is wrong.
        """
        try:
            body = cobs.decode(wire)
        except cobs.DecodeError as fault:
            raise DatagramError(f"no COBS: {fault}") from fault
        head, crc = body[:-CRC_BYTES], int.from_bytes(body[-CRC_BYTES:], "little")
        if not HEADER_BYTES <= len(head) <= HEADER_BYTES + MAX_PAYLOAD or zlib.crc32(head) != crc:
            raise DatagramError(f"{len(body)} bytes that are no datagram: length or CRC is wrong")
        type_, status, sequence, session = _HEADER.unpack(head[:HEADER_BYTES])
        return cls(type_, status, sequence, session, head[HEADER_BYTES:])


@dataclass(slots=True)
class DatagramDecoder:
    """Decodes datagrams from bytes in any portions; invalid ones are dropped, as their requests are repeated.

    >>> wire = Datagram(0x0C, 0, 7, 1, b"").encode()
    >>> decoder = DatagramDecoder()
    >>> decoder.feed(b"noise" + wire[:3])
    []
    >>> decoder.feed(wire[3:] + wire)  # doctest: +ELLIPSIS
    [Datagram(type=12, ...)]
    """

    _partial: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> list[Datagram]:
        """Take bytes from the wire; return the datagrams that they complete."""
        found = []
        *ended, rest = data.split(b"\0")
        for part in ended:
            self._partial += part
            with contextlib.suppress(DatagramError):
                found.append(Datagram.decode(bytes(self._partial)))
            self._partial.clear()
        self._partial += rest
        # No datagram is so long, whatever else comes.
        del self._partial[:-MAX_WIRE_BYTES]
        return found
