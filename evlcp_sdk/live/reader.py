"""Reads a source in a thread of its own, so that what waits is seen, and can be left out."""

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Final

from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.values import Events, Triggers

_MOST_EVENTS: Final = 1 << 24
"""Events that wait at the most, half a second of the most that a camera gives: the oldest go."""

_FORGOTTEN: Final = 1e-3
"""Of the least delay, a second: ten times as much as clocks drift."""

_LEAP_S: Final = 1.0


@dataclass(frozen=True, eq=False)
class Slice:
    """A piece of the stream as it came.

    Attributes:
        events: Its events.
        triggers: Its triggers.
        arrived_s: When it was there, s.
    """

    events: Events
    triggers: Triggers
    arrived_s: float


class ArrivalClock:
    """When a camera time was on our own clock, by the slices that came soonest after their last event.

    The least delay counts as none: what camera and cable take cannot be seen. It is forgotten slowly, as
    clocks drift, and at once where the camera's clock leaps.

    >>> clock = ArrivalClock()
    >>> clock.arrived(1_000, 7.0021)
    >>> clock.arrived(2_000, 7.0030)
    >>> round(clock.at_s(3_000), 6)
    7.004
    """

    def __init__(self) -> None:
        self._offset_s = self._arrived_s = 0.0

    def arrived(self, t_us: float, arrived_s: float) -> None:
        """Take a slice's last time and when it was there."""
        offset_s = arrived_s - t_us * 1e-6
        least_s = self._offset_s + _FORGOTTEN * (arrived_s - self._arrived_s)
        self._offset_s = offset_s if offset_s > least_s + _LEAP_S else min(offset_s, least_s)
        self._arrived_s = arrived_s

    def at_s(self, t_us: float) -> float:
        """When a camera time was, s."""
        return t_us * 1e-6 + self._offset_s


class Reader:
    """The slices of a source, read ahead by a thread.

    Of a live source what is not taken in time is dropped, the oldest first, beyond `_MOST_EVENTS`; any other
    waits.

    Args:
        source: What is read; not closed.

    Attributes:
        dropped: Events that were dropped so, so far.
        fault: What ended the reading, where that was a fault.
    """

    def __init__(self, source: EventSource) -> None:
        self._source = source
        self._waiting: deque[Slice] = deque()
        self._events = 0
        self._changed = threading.Condition()
        self._over = self._left = False
        self.arrivals = ArrivalClock()
        self.dropped = 0
        self.fault: BaseException | None = None
        self._thread = threading.Thread(target=self._read, name="evlcp-reader", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    @property
    def ended(self) -> bool:
        """Nothing more will come, and nothing waits."""
        return self._over and not self._waiting

    def take(self, timeout_s: float) -> Slice | None:
        """The next slice; None after the time-out, or at the end."""
        with self._changed:
            if (
                not self._changed.wait_for(lambda: self._waiting or self._over, timeout_s)
                or not self._waiting
            ):
                return None
            piece = self._waiting.popleft()
            self._events -= len(piece.events)
            if not self._source.live:
                self._changed.notify_all()
            return piece

    def stop(self) -> None:
        """Read no more; the thread of a source that waits for a camera may go on."""
        with self._changed:
            self._left = True
            self._changed.notify_all()
        self._thread.join(1.0)

    def _read(self) -> None:
        try:
            for events, triggers in self._source.stream():
                if not self._put(Slice(events, triggers, time.monotonic())):
                    break
        except BaseException as fault:
            self.fault = fault
        with self._changed:
            self._over = True
            self._changed.notify_all()

    def _put(self, piece: Slice) -> bool:
        if len(piece.events):
            self.arrivals.arrived(float(piece.events.t_us[-1]), piece.arrived_s)
        with self._changed:
            if not self._source.live:
                self._changed.wait_for(lambda: self._events < _MOST_EVENTS or self._left)
            self._waiting.append(piece)
            self._events += len(piece.events)
            while self._source.live and self._events > _MOST_EVENTS and len(self._waiting) > 1:
                old = self._waiting.popleft()
                self._events -= len(old.events)
                self.dropped += len(old.events)
            self._changed.notify_all()
            return not self._left
