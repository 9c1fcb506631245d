"""Pictures of events, two bits a pixel."""

import io
from typing import Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.values import Events

_PALETTE: Final = bytes([16, 16, 20, 70, 150, 255, 255, 205, 70, 235, 235, 235])
"""Colours of no event, OFF, ON and both, as in the film and the report."""


def paint_events(cells: NDArray[np.uint8], events: Events) -> None:
    """Mark the polarities that pixels showed, uint8 (height, width): 0 none, 1 OFF, 2 ON, 3 both.

    Events outside the sensor are left out.
    """
    height, width = cells.shape
    inside = (events.x < width) & (events.y < height)
    if not inside.all():
        events = events[inside]
    np.bitwise_or.at(cells, (events.y, events.x), events.p + np.uint8(1))


def encode_png(cells: NDArray[np.uint8]) -> bytes:
    """Marked pixels as a PNG file of two bits a pixel, quick to make rather than small."""
    from PIL import Image

    height, width = cells.shape
    picture = Image.frombuffer("P", (width, height), cells, "raw", "P", 0, 1)
    picture.putpalette(_PALETTE)
    data = io.BytesIO()
    picture.save(data, "PNG", compress_level=1, bits=2)
    return data.getvalue()
