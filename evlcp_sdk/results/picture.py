"""Pictures of events, two bits a pixel."""

import struct
import zlib
from functools import cache
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.late import Late
from evlcp_sdk.values import Events

if TYPE_CHECKING:
    from evlcp_sdk.results import _kernels
else:
    _kernels = Late("evlcp_sdk.results._kernels")

__all__ = ["EventImage"]

_PALETTE: Final = bytes([16, 16, 20, 70, 150, 255, 255, 205, 70, 235, 235, 235])
"""Nothing, OFF, ON, both: the colours of the film and the report."""

_TOGETHER: Final = 8
"""Bytes that are looked at together for whether anything is there."""


class EventImage:
    """Which polarities each pixel of a sensor showed, as PNG of two bits a pixel.

    Args:
        width: Of the sensor, px.
        height: The same.
    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        # A row of a PNG begins with its filter, 0 for none.
        self._row = 1 + -(-width // 4)
        self._bytes = np.zeros(-(-height * self._row // _TOGETHER) * _TOGETHER, np.uint8)
        # Of new memory, for each picture, each page would have to be given to the process.
        self._packed = np.empty(len(self._bytes) * 9 // 8 + 16, np.uint8)

    @property
    def _rows(self) -> NDArray[np.uint8]:
        return self._bytes[: self.height * self._row].reshape(self.height, self._row)

    @property
    def cells(self) -> NDArray[np.uint8]:
        """What each pixel showed, uint8 (height, width): 0 nothing, 1 OFF, 2 ON, 3 both."""
        rows = self._rows[:, 1:]
        cells = np.empty((*rows.shape, 4), np.uint8)
        for place in range(4):
            cells[..., place] = rows >> (6 - 2 * place) & 3
        return cells.reshape(self.height, -1)[:, : self.width]

    def paint(self, events: Events) -> None:
        """Mark pixels that have events; those outside of the sensor are left out."""
        _kernels.paint(self._rows, self.width, events.x, events.y, events.p)

    def clear(self) -> None:
        """Begin again."""
        self._bytes[:] = 0

    def png(self) -> bytes:
        """The picture as a PNG file; made quickly rather than small, quickest where little happens."""
        codes, bits = _fixed_codes()
        size = self.height * self._row
        data = self._packed[: _kernels.deflated(self._bytes, size, codes, bits, self._packed)].tobytes()
        head = struct.pack(">IIBBBBB", self.width, self.height, 2, 3, 0, 0, 0)
        chunks = ((b"IHDR", head), (b"PLTE", _PALETTE), (b"IDAT", data), (b"IEND", b""))
        return b"\x89PNG\r\n\x1a\n" + b"".join(
            struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
            for name, body in chunks
        )


@cache
def _fixed_codes() -> tuple[NDArray[np.uint64], NDArray[np.uint8]]:
    """What `deflated` writes, and how many bits: the codes that RFC 1951 has agreed on (3.2.5 and 3.2.6)."""
    codes, bits = np.zeros(515, np.uint64), np.zeros(515, np.uint8)

    def put(at: int, code: int, size: int, more: int = 0, more_bits: int = 0) -> None:
        # Of a code the first bit is its highest one, of a number its lowest.
        codes[at] = int(f"{code:0{size}b}"[::-1], 2) | more << size
        bits[at] = size + more_bits

    for byte in range(256):
        put(byte, *((0x30 + byte, 8) if byte < 144 else (0x190 + byte - 144, 9)))
    least = 3
    for symbol in range(257, 286):
        extra = 0 if symbol < 265 or symbol == 285 else (symbol - 261) // 4
        least = 258 if symbol == 285 else least
        code, size = (symbol - 256, 7) if symbol < 280 else (0xC0 + symbol - 280, 8)
        for length in range(least, least + (1 << extra)):
            # The distance, one byte back, is five zeros.
            put(256 + length, code, size, length - least, extra + 5)
        least += 1 << extra
    return codes, bits
