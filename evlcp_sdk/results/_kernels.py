"""Every numba kernel of `evlcp_sdk.results`: pictures of events, painted and packed."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

__all__ = ["deflated", "paint"]

_ADLER = 65521
_LITERALS = 256
_LONGEST = 258
"""What deflate repeats at the most at a time, bytes."""


@njit
def paint(rows: NDArray[Any], width: int, x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> None:
    """Mark which polarities each pixel has: bit 0 OFF, bit 1 ON.

    Args:
        rows: Four pixels a byte, the left one highest, behind a byte a row that stays, uint8
            (height, 1 + width / 4); the pixels are changed.
        width: Pixels in a row.
        x: Columns of events; those outside are left out.
        y: Their rows.
        p: Their polarities, 0 or 1.
    """
    height = rows.shape[0]
    for i in range(len(x)):
        row, column = y[i], x[i]
        if row < height and column < width:
            rows[row, 1 + (column >> 2)] |= np.uint8(1 << p[i] << (6 - 2 * (column & 3)))


@njit
def deflated(data: NDArray[Any], end: int, codes: NDArray[Any], bits: NDArray[Any], out: NDArray[Any]) -> int:
    """Write data that is mostly zeros as a stream of zlib, in which runs of zeros alone are packed.

    Args:
        data: uint8, as long as a multiple of 8.
        end: How many bytes of it are meant.
        codes: What deflate writes for each byte, and from 256 on for a run of 0, 1, ... 258 of what came
            before, uint64 (515,), the first bit lowest.
        bits: How long these are, uint8 (515,).
        out: Takes the stream, uint8; 9 bits a byte and 16 bytes are enough.

    Returns:
        Bytes written.
    """
    words = data.view(np.uint64)
    out[0], out[1] = 0x78, 0x01
    at = 2
    held, many = np.uint64(3), 3  # one block, the last one, of the codes that are agreed on
    low, high = np.int64(1), np.int64(0)  # the sums of Adler-32
    i = 0
    while i < end:
        value = data[i]
        held |= codes[value] << np.uint64(many)
        many += bits[value]
        i += 1
        run = 0
        if value:
            low = (low + value) % _ADLER
            high = (high + low) % _ADLER
        else:
            first = i
            while i < end and i & 7 and not data[i]:
                i += 1
            if not i & 7:
                word = i >> 3
                while word < len(words) and not words[word]:
                    word += 1
                i = min(word << 3, end)
                while i < end and not data[i]:
                    i += 1
            run = i - first
            high = (high + (run + 1) * low) % _ADLER
        while True:
            while many >= 8:
                out[at] = held & np.uint64(255)
                held >>= np.uint64(8)
                many -= 8
                at += 1
            if not run:
                break
            # What is too short to be repeated is written out.
            some = min(run, _LONGEST)
            code = _LITERALS + some if some > 2 else 0
            held |= codes[code] << np.uint64(many)
            many += bits[code]
            run -= some if some > 2 else 1
    many += 7  # the end of the block, seven zeros
    while many > 0:
        out[at] = held & np.uint64(255)
        held >>= np.uint64(8)
        many -= 8
        at += 1
    for part in (high >> 8, high, low >> 8, low):
        out[at] = part & 255
        at += 1
    return at
