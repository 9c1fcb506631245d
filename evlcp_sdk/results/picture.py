"""Pictures of events, two bits a pixel."""

import struct
import zlib
from typing import Final

import numpy as np

from evlcp_sdk.values import Events

_PALETTE: Final = bytes([16, 16, 20, 70, 150, 255, 255, 205, 70, 235, 235, 235])
"""Nothing, OFF, ON, both: the colours of the film and the report."""


class EventImage:
    """Which polarities each pixel of a sensor showed, as PNG of two bits a pixel.

    Args:
        width: Of the sensor, px.
        height: The same.

    Attributes:
        cells: What each pixel showed, uint8 (height, width): 0 nothing, 1 OFF, 2 ON, 3 both.
    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.cells = np.zeros((height, width), np.uint8)

    def paint(self, events: Events) -> None:
        """Mark pixels that have events; those outside of the sensor are left out."""
        inside = (events.x < self.width) & (events.y < self.height)
        if not inside.all():
            events = events[inside]
        np.bitwise_or.at(self.cells, (events.y, events.x), events.p + np.uint8(1))

    def clear(self) -> None:
        """Begin again."""
        self.cells[:] = 0

    def png(self) -> bytes:
        """The picture as a PNG file; made quickly rather than small."""
        four = np.pad(self.cells, ((0, 0), (0, -self.width % 4))).reshape(self.height, -1, 4)
        packed = four[..., 0] << 6 | four[..., 1] << 4 | four[..., 2] << 2 | four[..., 3]
        # A row of a PNG begins with its filter, 0 for none.
        data = zlib.compress(np.pad(packed, ((0, 0), (1, 0))).tobytes(), level=1)
        head = struct.pack(">IIBBBBB", self.width, self.height, 2, 3, 0, 0, 0)
        chunks = ((b"IHDR", head), (b"PLTE", _PALETTE), (b"IDAT", data), (b"IEND", b""))
        return b"\x89PNG\r\n\x1a\n" + b"".join(
            struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
            for name, body in chunks
        )
