"""Pictures of events, two bits a pixel."""

import io
from typing import Final

import numpy as np

from evlcp_sdk.values import Events

_PALETTE: Final = bytes([16, 16, 20, 70, 150, 255, 255, 205, 70, 235, 235, 235])
"""Colours of no event, OFF, ON and both, as in the film and the report."""


class EventImage:
    """Which polarities the pixels of a sensor of this size showed, as a PNG picture of two bits a pixel.

    Attributes:
        cells: Polarities of each pixel, uint8 (height, width): 0 none, 1 OFF, 2 ON, 3 both.
    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.cells = np.zeros((height, width), np.uint8)

    def paint(self, events: Events) -> None:
        """Mark the pixels that have events; those outside the sensor are left out."""
        inside = (events.x < self.width) & (events.y < self.height)
        if not inside.all():
            events = events[inside]
        np.bitwise_or.at(self.cells, (events.y, events.x), events.p + np.uint8(1))

    def clear(self) -> None:
        """Remove all marks."""
        self.cells[:] = 0

    def to_png(self) -> bytes:
        """The picture as a PNG file, quick to make rather than small."""
        from PIL import Image

        picture = Image.frombuffer("P", (self.width, self.height), self.cells, "raw", "P", 0, 1)
        picture.putpalette(_PALETTE)
        data = io.BytesIO()
        picture.save(data, "PNG", compress_level=1, bits=2)
        return data.getvalue()
