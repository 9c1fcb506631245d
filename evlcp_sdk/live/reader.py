"""Reads a source in a thread of its own, so that waiting slices can be dropped."""

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Final

from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.values import Events, Triggers

_MAX_EVENTS: Final = 1 << 24
"""Events that may wait, half a second of a camera at its limit; beyond, the oldest are dropped."""

_OFFSET_DRIFT: Final = 1e-3
"""By which the least delay grows, a second: ten times the drift of clocks."""

_LEAP_S: Final = 1.0


@dataclass(frozen=True, eq=False)
class Slice:
    """A piece of the stream, and the time of its arrival, s."""

    events: Events
    triggers: Triggers
    arrived_s: float


class ArrivalClock:
    """Converts camera times to the host's clock, by the slices with the least delay after their last event.

    The least delay counts as none, as that of camera and cable is unknown. It is forgotten slowly, as clocks
    drift, and at once where the camera's clock leaps.

    >>> clock = ArrivalClock()
    >>> clock.add_arrival(1_000, 7.0021)
    >>> clock.add_arrival(2_000, 7.0030)
    >>> round(clock.to_host_s(3_000), 6)
    7.004
    """

    def __init__(self) -> None:
        self._offset_s = self._arrived_s = 0.0

    def add_arrival(self, t_us: float, arrived_s: float) -> None:
        """Add the last time of a slice, and the time of its arrival."""
        offset_s = arrived_s - t_us * 1e-6
        least_s = self._offset_s + _OFFSET_DRIFT * (arrived_s - self._arrived_s)
        self._offset_s = offset_s if offset_s > least_s + _LEAP_S else min(offset_s, least_s)
        self._arrived_s = arrived_s

    def to_host_s(self, t_us: float) -> float:
        """A camera time on the host's clock, s."""
        return t_us * 1e-6 + self._offset_s


class Reader:
    """The slices of a source, read ahead by a thread from now on; the source is not closed.

    Beyond `_MAX_EVENTS`, the oldest of a live source are dropped; any other source waits.

    Attributes:
        arrivals: The arrivals of its slices.
        dropped: Number of dropped events.
        fault: The exception that ended the reading; None for none.
    """

    def __init__(self, source: EventSource) -> None:
        self._source = source
        self._waiting: deque[Slice] = deque()
        self._events = 0
        self._changed = threading.Condition()
        self._finished = self._stopped = False
        self.arrivals = ArrivalClock()
        self.dropped = 0
        self.fault: BaseException | None = None
        self._thread = threading.Thread(target=self._read, name="evlcp-reader", daemon=True)
        self._thread.start()

    @property
    def ended(self) -> bool:
        """Whether nothing more will come, and nothing waits."""
        return self._finished and not self._waiting

    def take(self, timeout_s: float) -> Slice | None:
        """Remove and return the next slice; None after the time-out, or at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._finished, timeout_s)
            if not self._waiting:
                return None
            piece = self._waiting.popleft()
            self._events -= len(piece.events)
            self._changed.notify_all()
            return piece

    def stop(self) -> None:
        """Stop reading; the thread of a source that waits for a camera may go on."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._thread.join(1.0)

    def _read(self) -> None:
        try:
            for events, triggers in self._source.stream():
                if not self._enqueue(Slice(events, triggers, time.monotonic())):
                    break
        except BaseException as fault:
            self.fault = fault
        with self._changed:
            self._finished = True
            self._changed.notify_all()

    def _enqueue(self, piece: Slice) -> bool:
        if len(piece.events):
            self.arrivals.add_arrival(float(piece.events.t_us[-1]), piece.arrived_s)
        with self._changed:
            if not self._source.live:
                self._changed.wait_for(lambda: self._events < _MAX_EVENTS or self._stopped)
            self._waiting.append(piece)
            self._events += len(piece.events)
            while self._source.live and self._events > _MAX_EVENTS and len(self._waiting) > 1:
                old = self._waiting.popleft()
                self._events -= len(old.events)
                self.dropped += len(old.events)
            self._changed.notify_all()
            return not self._stopped
