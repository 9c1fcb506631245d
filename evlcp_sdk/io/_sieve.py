"""Hold back what no receiver may see, for the formats that are not decoded word by word."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.plugin.source import Loss
from evlcp_sdk.values import Events

__all__ = ["Sieve"]

MEANINGS: Final = {
    "outside_sensor": "events outside the sensor; dropped",
    "time_backward": "events earlier than the one before; dropped",
}


class Sieve:
    """Drops and counts events outside the sensor and events earlier than the one before.

    Args:
        unit: What `losses` count positions in: `line` or `row`.
        width: Columns of the sensor, or None if unknown.
        height: Rows of the sensor, or None.
    """

    def __init__(self, unit: str, width: int | None, height: int | None) -> None:
        self._unit = unit
        self._width = width or 1 << 16
        self._height = height or 1 << 16
        self._last_us = np.iinfo(np.int64).min
        self._counts: dict[str, int] = {}
        self._firsts: dict[str, int] = {}

    def sift(self, events: Events, first: int) -> Events:
        """Return the events to keep; the first of `events` is line or row `first`."""
        if not len(events):
            return events
        outside = (events.x >= self._width) | (events.y >= self._height)
        # An event outside does not set the time that later ones are held against.
        times = np.where(outside, self._last_us, events.t_us)
        latest = np.maximum(np.maximum.accumulate(times), self._last_us)
        backward = ~outside & (events.t_us < latest)
        self._last_us = latest[-1]
        for name, found in (("outside_sensor", outside), ("time_backward", backward)):
            self._note(name, found, first)
        drop = outside | backward
        return events[~drop] if drop.any() else events

    def _note(self, name: str, found: NDArray[np.bool_], first: int) -> None:
        count = int(np.count_nonzero(found))
        if count:
            self._firsts.setdefault(name, first + int(found.argmax()))
            self._counts[name] = self._counts.get(name, 0) + count

    @property
    def losses(self) -> dict[str, Loss]:
        """As `EventSource.losses`."""
        return {
            name: Loss(count, self._firsts[name], self._unit, MEANINGS[name])
            for name, count in self._counts.items()
        }
