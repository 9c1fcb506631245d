"""The clock that is believed, of files and cameras: which events are in order, where it leaps, and its steps.

Clocks of cameras restart, and a flipped bit makes one leap. A leap is believed once enough events agree on
it; until then they are held. Inside, time counts from the stream's first event and leaps are a few seconds
long, so that no stage sees one and floating point is as fine late on a clock as early.
"""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk import _kernels
from evlcp_sdk.values import Events, to_kernel_array

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

_MOST_PIECES = 64
"""Pieces of a time step that wait to be put together, but for one more in `_WHOLE_EVENTS`: small ones take
more memory than their events."""

_WHOLE_EVENTS = 4096

_LATER_US = 1 << 62
"""When what is due later than in the open step is due."""

_GRAINS = 24
"""Differences of times that show how coarse these are: those of finer ones are all even in 1e-7 of cases."""

_DROPPED = ("dropped_time_backward", "dropped_off_sensor", "dropped_time_doubtful")
"""What events are counted as that are dropped, by the kernel's verdict on them."""

_KEPT, _HELD = 3, 4
"""Its verdicts on others."""


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
        self._counts = dict.fromkeys(("events", *_DROPPED, "clock_leaps", "clock_restarts"), 0)

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
        t_us, x, y, p = events.t_us, events.x, events.y, events.p
        self._counts["events"] += t_us.size
        if not t_us.size:
            return []
        if not (t_us.flags.carray and x.flags.carray and y.flags.carray and p.flags.carray):
            # Kernels take them as they are from here on.
            t_us, x, y, p = to_kernel_array(t_us), to_kernel_array(x), to_kernel_array(y), to_kernel_array(p)
            events = Events.from_columns(t_us, x, y, p)
        if not self._starts_us:
            first_us = self._first(events)
            if first_us is None:
                return []
            self._begin(first_us, 0)
        before_us, _, _, held = self._state.tolist()
        if not held and before_us <= int(t_us[0]) and int(t_us[-1]) - before_us <= LEAP_US:
            inside_us = np.empty(t_us.size, np.int64)
            if _kernels.all_ordered(t_us, x, y, *self._size, self._offset_us, inside_us):
                self._state[0] = t_us[-1]
                self.last_us = int(inside_us[-1])
                return [Events.from_columns(inside_us, x, y, p)]
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
            verdicts = np.empty(len(events), np.uint8)
            many, lost = _kernels.sort_out(
                events.t_us, events.x, events.y, *self._size, limits, self._state, verdicts
            )
            done, verdicts = events[:many], verdicts[:many]
            events = events[many:]
            if lost:
                self._lose_held()
            number = self._counts["events"] - len(events) - many
            for verdict, name in enumerate(_DROPPED):
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
        # As a rule, it is the very first.
        for some in (events[:1], events):
            seen = (some.x < width) & (some.y < height)
            good = seen & (some.t_us <= _FARTHEST_US) & (some.t_us >= -_FARTHEST_US)
            if good.any():
                return int(some.t_us[int(good.argmax())])
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


class TimeGrain(NamedTuple):
    """How coarse a stream's times are, by the first of their differences.

    Attributes:
        step_us: Greatest common divisor of these, us: 1 but for coarse times.
        seen: How many these are.
        last_us: Time of the last event that was looked at; None before the first.
        known_us: Time of the last that was needed; None as long as there are too few.

    >>> TimeGrain().after(np.arange(30) * 200).step_us
    200
    """

    step_us: int = 0
    seen: int = 0
    last_us: int | None = None
    known_us: int | None = None

    def after(self, t_us: NDArray[np.int64]) -> "TimeGrain":
        """With the next times of the stream."""
        if not t_us.size or self.known_us is not None:
            return self
        apart = np.diff(t_us, prepend=t_us[0] if self.last_us is None else self.last_us)
        places = np.flatnonzero(apart)[: _GRAINS - self.seen]
        step_us = math.gcd(self.step_us, int(np.gcd.reduce(apart[places])) if len(places) else 0)
        seen = self.seen + len(places)
        return TimeGrain(step_us, seen, int(t_us[-1]), int(t_us[places[-1]]) if seen == _GRAINS else None)


class TimeStep(NamedTuple):
    """The events of one time step, or of its part so far.

    Attributes:
        start_us: A multiple of the step's length after the stream's first event, us.
        end_us: Start of the next step, or the last event of a stream that ends in this one, us; of a part,
            the time before which all of its events are.
        events: Those in it, in order.
        after_gap: Steps in which nothing could happen were left out before it.
        whole: It is no part: its events do not come again.
    """

    start_us: int
    end_us: int
    events: Events
    after_gap: bool
    whole: bool = True


class Timeline:
    """Cuts a stream into time steps on a fixed grid, whatever pieces it comes in.

    A step is given once an event after it has been seen. Empty steps are given as long as somebody waits for
    them, and left out in a gap. The part of a step before a time at which something is due is given as soon
    as an event after that has been seen in the step, and once more with the whole step. Times are those
    inside: see `CameraClock`.

    Args:
        step_us: Length of a step, us.
        width: Columns of the sensor.
        height: Its rows.
        most_events: How many events a step may have.

    Attributes:
        dropped: Events beyond that, of all steps so far.
        clock: What time it is, and which events are dropped.

    >>> timeline = Timeline(1000, 1280, 720, most_events=100)
    >>> events = Events.of([100, 2500, 2600], x=[5, 5, 5], y=[7, 7, 7], p=[1, 0, 1])
    >>> [(s.start_us, len(s.events)) for s in timeline.feed(events, lambda: True, lambda: math.inf)]
    [(0, 1), (1000, 0)]
    >>> [(s.start_us, s.end_us, len(s.events)) for s in timeline.close()]
    [(2000, 2500, 2)]
    """

    def __init__(self, step_us: int, width: int, height: int, most_events: int) -> None:
        self.clock = CameraClock(width, height)
        self.dropped = 0
        self._most, self._waiting = most_events, 0
        self._step_us, self._start_us = step_us, 0
        self._pending: list[Events] = []
        self._after_gap = False
        self._part_us = 0
        self._due_us: int | None = None

    def feed(
        self, events: Events, waiting: Callable[[], bool], due_us: Callable[[], float]
    ) -> Iterator[TimeStep]:
        """Take the next events of the stream; give the steps that they complete.

        Args:
            events: Those that the clock drops are in no step.
            waiting: Says after a step whether the next one matters even if it is empty.
            due_us: Says after a step, or a part, when something is due next, us; what it says changes with
                these only.
        """
        for kept in self.clock.take(events):
            t_us, done = kept.t_us, 0
            for end in (*self._bounds(t_us), t_us.size):
                while True:
                    if self._due_us is None:
                        due = due_us()
                        within = max(self._start_us, self._part_us) < due < self._start_us + self._step_us
                        self._due_us = math.ceil(due) if within else _LATER_US
                    if not end or t_us[end - 1] < self._due_us:
                        break
                    part = done + int(t_us[done:end].searchsorted(self._due_us))
                    self._part_us, self._due_us = self._due_us, None
                    yield self._so_far(kept[done:part])
                self._keep(kept[done:end])
                done = end
                if end < t_us.size:
                    yield self._next()
                    next_us = int(t_us[end]) // self._step_us * self._step_us
                    while self._start_us < next_us and waiting():
                        yield self._next()
                    if self._start_us < next_us:
                        self._start_us, self._after_gap = next_us, True

    def close(self) -> Iterator[TimeStep]:
        """End the stream; give the step that it ends in, if there is one."""
        self.clock.close()
        if self._pending:
            yield self._next(self.clock.last_us)

    def _bounds(self, t_us: NDArray[np.int64]) -> list[int]:
        """Where each new time step starts among events, which are in order and not none."""
        start_us, step_us = self._start_us, self._step_us
        first_us = max(int(t_us[0]) // step_us * step_us, start_us)
        last_us = int(t_us[-1])
        if last_us - first_us > step_us * t_us.size:
            # Sparse events: look at each instead of at each step.
            step = t_us // step_us
            return np.flatnonzero(np.diff(step, prepend=start_us // step_us) > 0).tolist()
        # Steps before the first event of these are not looked at, however many there are.
        next_us = first_us + step_us * (first_us == start_us)
        if next_us > last_us:
            return []
        return sorted(set(t_us.searchsorted(np.arange(next_us, last_us + 1, step_us)).tolist()))

    def _so_far(self, newest: Events) -> TimeStep:
        """The part of the open step whose end is due: what is kept of it, and what is not yet."""
        if len(self._pending) > 1:
            self._pending = [Events.concat(self._pending)]
        # A view where it is all of one piece: the whole step is one, too.
        newest = newest[: self._most - self._waiting]
        events = Events.concat([*self._pending, newest]) if self._pending else newest
        return TimeStep(self._start_us, self._part_us, events, self._after_gap, whole=False)

    def _keep(self, events: Events) -> None:
        """Add events to the step that is open, as far as it has room."""
        many, room = events.t_us.size, self._most - self._waiting
        if many > room:
            self.dropped += many - room
            events, many = events[:room], room
        if not many:
            return
        self._waiting += many
        self._pending.append(events)
        if len(self._pending) > _MOST_PIECES + self._waiting // _WHOLE_EVENTS:
            self._pending = [Events.concat(self._pending)]

    def _next(self, end_us: int | None = None) -> TimeStep:
        """The step whose events are pending; `end_us` where the stream ends inside it."""
        events = self._pending[0] if len(self._pending) == 1 else Events.concat(self._pending)
        start_us, after_gap = self._start_us, self._after_gap
        self._pending, self._waiting, self._after_gap, self._due_us = [], 0, False, None
        self._start_us += self._step_us
        return TimeStep(start_us, self._start_us if end_us is None else end_us, events, after_gap)
