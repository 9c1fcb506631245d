"""Pictures of events, two bits a pixel."""

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

__all__ = ["png"]

_TOGETHER = np.uint32(1 << 30 | 1 << 20 | 1 << 10 | 1)

_PALETTE = bytes([16, 16, 20, 70, 150, 255, 255, 205, 70, 235, 235, 235])
"""Nothing, OFF, ON, both: the colours of the film and the report."""


def png(cells: NDArray[np.uint8]) -> bytes:
    """A picture of two bits a pixel as PNG; made quickly rather than small.

    Args:
        cells: 0 nothing, 1 OFF, 2 ON, 3 both, uint8 (height, width).
    """
    height, width = cells.shape
    if width % 4:
        cells = np.pad(cells, ((0, 0), (0, -width % 4)))
    four = np.ascontiguousarray(cells).view("<u4")
    rows = np.zeros((height, 1 + four.shape[1]), np.uint8)  # a row begins with its filter, none
    # Four pixels of a byte each come together in the highest byte, two bits each, the first one highest.
    rows[:, 1:] = four * _TOGETHER >> 24
    packer = zlib.compressobj(1, zlib.DEFLATED, 15, 9, zlib.Z_RLE)
    data = packer.compress(rows.tobytes()) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 2, 3, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"PLTE", _PALETTE), (b"IDAT", data), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in chunks
    )
