"""The clock that is believed, of files and cameras: which events are in order, and where a clock leaps.

Clocks of cameras restart, and a flipped bit makes one leap. A leap is believed once enough events agree on
it; until then they are held. Inside, time counts from the stream's first event and leaps are a few seconds
long, so that no stage sees one and floating point is as fine late on a clock as early.
"""

from bisect import bisect_right
from collections import deque

import numpy as np

from evlcp_sdk import _kernels
from evlcp_sdk.values import Events, plain

LEAP_US = 1_000_000
"""The longest pause that is believed at once: what was seen before a longer one is forgotten anyway."""

_SETBACK_US = 10_000
"""Events so much earlier than others are in disorder; the clock catches up soon."""

_AGREE_EVENTS = 16
_AGREE_US = 10_000
"""How many events on end, over how long, make another clock believed: two TIME_HIGH words of EVT3."""

_MOST_HELD = 1 << 20
"""Events that are held; so many are believed whatever their time."""

_BREAK_US = 4_000_000
"""How much later a stream goes on inside after a leap: all that was seen before is forgotten by then."""

_MOST_BREAKS = 64
"""Leaps that are remembered: packets come out long before so many more, at `_BREAK_US` each."""

_FARTHEST_US = 1 << 62
"""No event is further from 0."""

_BACKWARD, _OFF_SENSOR, _DOUBTFUL, _KEPT, _HELD = range(5)
"""Verdicts on an event, as the kernel gives them."""


class CameraClock:
    """Drops and counts events that are in disorder, off the sensor, or on a clock that no others agree on.

    Args:
        width: Columns of the sensor.
        height: Its rows.
        sparse: Pauses may be long, as in a file that somebody wrote: events ahead are held through them, and
            given at the end where none contradicts.

    Attributes:
        last_us: Time of the newest event, inside, us; long ago before the first.
        firsts: Of each count of what is dropped, the number of the first such event, from 0.

    >>> clock = CameraClock(1280, 720)
    >>> [e.t_us.tolist() for e in clock.take(Events.of([70, 90, 80, 100], [1] * 4, [1] * 4, [1] * 4))]
    [[0, 20, 30]]
    >>> clock.camera_us(30.0), clock.counts["dropped_time_backward"]
    (100.0, 1)
    """

    def __init__(self, width: int, height: int, *, sparse: bool = False) -> None:
        self._sparse = sparse
        self.last_us = -_FARTHEST_US
        self._size = width, height
        self._offset_us = 0
        self._starts_us: deque[int] = deque(maxlen=_MOST_BREAKS)
        self._offsets_us: deque[int] = deque(maxlen=_MOST_BREAKS)
        # Camera clock of the last event kept; of the first and the last held; how many are held.
        self._state = np.zeros(4, np.int64)
        self._held: list[Events] = []
        self._held_at = 0
        self.firsts: dict[str, int] = {}
        self._counts = dict.fromkeys(
            (
                "events",
                "dropped_time_backward",
                "dropped_off_sensor",
                "dropped_time_doubtful",
                "clock_leaps",
                "clock_restarts",
            ),
            0,
        )

    @property
    def counts(self) -> dict[str, int]:
        """Events taken and dropped, and leaps forward and back that were believed."""
        return dict(self._counts)

    def camera_us(self, t_us: float) -> float:
        """The camera clock's time of a time inside, us."""
        if len(self._offsets_us) == 1:
            return t_us + self._offset_us
        at = max(bisect_right(self._starts_us, t_us) - 1, 0)
        return t_us + self._offsets_us[at] if self._offsets_us else t_us

    def take(self, events: Events) -> list[Events]:
        """Take the next events of the stream; give those that are kept, with their times inside."""
        self._counts["events"] += len(events)
        if not len(events):
            return []
        # Kernels take them as they are from here on.
        t_us, x, y, p = plain(events.t_us), plain(events.x), plain(events.y), plain(events.p)
        events = Events.as_is(t_us, x, y, p)
        if (
            self._starts_us
            and not self._state[3]
            and int(t_us[0]) - int(self._state[0]) >= 0
            and int(t_us[-1]) - int(self._state[0]) <= LEAP_US
        ):
            inside_us = np.empty(len(t_us), np.int64)
            if _kernels.all_ordered(t_us, x, y, *self._size, self._offset_us, inside_us):
                self._state[0] = t_us[-1]
                self.last_us = int(inside_us[-1])
                return [Events.as_is(inside_us, x, y, p)]
        return self._sorted(events)

    def close(self) -> list[Events]:
        """End the stream: what is still held is dropped, or given where that is sparse and ahead."""
        if self._sparse and self._held and self._state[1] > self._state[0]:
            return [self._leap()]
        self._lose_held()
        self._state[3] = 0
        return []

    def _lose_held(self) -> None:
        """Drop what is held."""
        if self._held:
            self._lose("dropped_time_doubtful", self._held_at, sum(map(len, self._held)))
        self._held = []

    def _lose(self, name: str, first: int, many: int) -> None:
        self._counts[name] += many
        self.firsts[name] = min(self.firsts.get(name, first), first)

    def _sorted(self, events: Events) -> list[Events]:
        """The same, event by event."""
        held_us = _FARTHEST_US if self._sparse else LEAP_US
        limits = (LEAP_US, held_us, _SETBACK_US, _AGREE_EVENTS, _AGREE_US, _MOST_HELD, _FARTHEST_US)
        given: list[Events] = []
        while len(events):
            if not self._starts_us:
                first = self._first(events)
                if first is None:
                    return given
                self._begin(first, 0)
            verdicts = np.empty(len(events), np.uint8)
            many, lost = _kernels.sort_out(
                events.t_us, events.x, events.y, *self._size, limits, self._state, verdicts
            )
            done, verdicts = events[:many], verdicts[:many]
            events = events[many:]
            if lost:
                self._lose_held()
            number = self._counts["events"] - len(events) - many
            for name, verdict in (
                ("dropped_time_backward", _BACKWARD),
                ("dropped_off_sensor", _OFF_SENSOR),
                ("dropped_time_doubtful", _DOUBTFUL),
            ):
                if (found := verdicts == verdict).any():
                    self._lose(name, number + int(found.argmax()), int(np.count_nonzero(found)))
            if (kept := verdicts == _KEPT).any():
                given.append(self._inside(done[kept]))
            if (held := verdicts == _HELD).any():
                if not self._held:
                    self._held_at = number + int(held.argmax())
                self._held.append(done[held])
            if self._state[3] < 0:
                # The last one has made those held believed.
                given.append(self._leap())
        return given

    def _first(self, events: Events) -> int | None:
        """Time of the first event that has one and is on the sensor; those before it are dropped later."""
        width, height = self._size
        seen = (events.x < width) & (events.y < height)
        good = seen & (events.t_us <= _FARTHEST_US) & (events.t_us >= -_FARTHEST_US)
        if good.any():
            return int(events.t_us[int(good.argmax())])
        number = self._counts["events"] - len(events)
        for name, lost in (("dropped_off_sensor", ~seen), ("dropped_time_doubtful", seen)):
            if lost.any():
                self._lose(name, number + int(lost.argmax()), int(np.count_nonzero(lost)))
        return None

    def _begin(self, camera_us: int, inside_us: int) -> None:
        """The camera's clock stands at `camera_us` and goes on from there."""
        self._offset_us = camera_us - inside_us
        # What lies in the gap nearer to what comes is of it: a packet begins before its first event.
        self._starts_us.append(inside_us - _BREAK_US // 2)
        self._offsets_us.append(self._offset_us)
        self._state[0] = camera_us

    def _leap(self) -> Events:
        """Believe those that are held."""
        before_us, first_us, last_us, _ = self._state.tolist()
        self._counts["clock_leaps" if first_us > before_us else "clock_restarts"] += 1
        self._begin(first_us, self.last_us + _BREAK_US)
        self._state[0], self._state[3] = last_us, 0
        held, self._held = Events.concat(self._held), []
        return self._inside(held)

    def _inside(self, events: Events) -> Events:
        t_us = events.t_us - self._offset_us
        self.last_us = int(t_us[-1])
        return Events(t_us, events.x, events.y, events.p)
