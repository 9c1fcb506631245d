"""Pictures of events, drawn on request."""

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.results.picture import paint_events
from evlcp_sdk.values import Events, Region

WINDOW_US = 10_000
"""Length of the time that a picture shows."""


@dataclass(frozen=True, eq=False)
class Picture:
    """The events of `WINDOW_US`, and the receiver's regions in them, of a sensor of this size.

    Attributes:
        t_us: Its end on the camera's clock, us.
        pieces: Its events; the first piece may begin with older ones.
        number: Its number, from 0.
    """

    t_us: int
    pieces: tuple[Events, ...]
    width: int
    height: int
    regions: tuple[Region, ...]
    number: int

    def paint(self) -> NDArray[np.uint8]:
        """The polarities that each pixel showed, by the caller's thread rather than the receiver's."""
        cells = np.zeros((self.height, self.width), np.uint8)
        # Every piece has events of the window.
        oldest = self.pieces[0]
        first = int(np.searchsorted(oldest.t_us, self.t_us - WINDOW_US, "right"))
        for piece in (oldest[first:], *self.pieces[1:]):
            paint_events(cells, piece)
        return cells


class PictureSlot:
    """Holds the newest picture, drawn only on request."""

    def __init__(self) -> None:
        self._recent: deque[Events] = deque()
        self._requested = False
        self._picture: Picture | None = None
        self._drawn = threading.Condition()
        self._number = 0
        self._closed = False

    def request(self) -> None:
        """Request a picture, drawn with the next slice."""
        self._requested = True

    def wait(self, timeout_s: float | None = None) -> Picture | None:
        """Request a picture and wait for it; None after the time-out, or when the run is over."""
        with self._drawn:
            self._picture = None
            self._requested = True
            self._drawn.wait_for(lambda: self._picture is not None or self._closed, timeout_s)
            return self._picture

    @property
    def newest(self) -> Picture | None:
        """The last picture that was drawn."""
        return self._picture

    def add(self, events: Events, width: int, height: int, regions: Sequence[Region]) -> None:
        """Add the next slice, and draw a picture if one was requested. Called by the loop."""
        if not len(events):
            return
        self._recent.append(events)
        end_us = int(events.t_us[-1])
        # Later ones are from before a restart of the camera's clock.
        while not end_us - WINDOW_US < int(self._recent[0].t_us[-1]) <= end_us:
            self._recent.popleft()
        if not self._requested:
            return
        self._requested = False
        picture = Picture(end_us, tuple(self._recent), width, height, tuple(regions), self._number)
        self._number += 1
        with self._drawn:
            self._picture = picture
            self._drawn.notify_all()

    def close(self) -> None:
        """End the drawing."""
        with self._drawn:
            self._closed = True
            self._recent.clear()
            self._drawn.notify_all()
