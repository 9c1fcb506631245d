"""Pictures of events, made when somebody asks for one."""

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evlcp_sdk.results.picture import EventImage
from evlcp_sdk.values import Events, Region

WINDOW_US = 10_000
"""How much time a picture shows."""


@dataclass(frozen=True, eq=False)
class Picture:
    """The events of `WINDOW_US`, and the regions in it.

    Attributes:
        t_us: Its end on the camera's clock, us.
        pieces: Its events; older ones may stand before them in the first piece.
        width: Of the sensor, px.
        height: The same.
        regions: The regions that are followed.
        number: Counted from 0.
    """

    t_us: int
    pieces: tuple[Events, ...]
    width: int
    height: int
    regions: tuple[Region, ...]
    number: int

    def image(self) -> EventImage:
        """The events, painted: by whoever looks, not by the receiver."""
        image = EventImage(self.width, self.height)
        # Pieces follow one another, and each reaches into the window.
        oldest = self.pieces[0]
        first = int(np.searchsorted(oldest.t_us, self.t_us - WINDOW_US, "right"))
        for piece in (oldest[first:], *self.pieces[1:]):
            image.paint(piece)
        return image


class PictureSlot:
    """Holds the newest picture, drawn only when it was asked for."""

    def __init__(self) -> None:
        self._recent: deque[Events] = deque()
        self._asked = False
        self._picture: Picture | None = None
        self._drawn = threading.Condition()
        self._number = 0
        self._over = False

    def ask(self) -> None:
        """Have a picture drawn with the next slice."""
        self._asked = True

    def take(self, timeout_s: float | None = None) -> Picture | None:
        """Ask for a picture, and wait for it; None after the time-out, or when the run is over."""
        with self._drawn:
            self._picture = None
            self._asked = True
            self._drawn.wait_for(lambda: self._picture is not None or self._over, timeout_s)
            return self._picture

    @property
    def newest(self) -> Picture | None:
        """The last picture that was drawn."""
        return self._picture

    def add(self, events: Events, width: int, height: int, regions: Sequence[Region]) -> None:
        """Take the next slice; draw where a picture was asked for. Called by the loop."""
        if not len(events):
            return
        self._recent.append(events)
        end_us = int(events.t_us[-1])
        while int(self._recent[0].t_us[-1]) <= end_us - WINDOW_US:
            self._recent.popleft()
        if not self._asked:
            return
        self._asked = False
        pieces = tuple(self._recent)
        picture = Picture(end_us, pieces, width, height, tuple(regions), self._number)
        self._number += 1
        with self._drawn:
            self._picture = picture
            self._drawn.notify_all()

    def close(self) -> None:
        """Draw nothing more."""
        with self._drawn:
            self._over = True
            self._recent.clear()
            self._drawn.notify_all()
