"""The clock's side of a stream: its grid of time steps, its gaps."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from evlcp_sdk.clock import CameraClock
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.values import Events

_MOST_PIECES = 64
"""Pieces of a time step that wait to be put together, but for one more in `_WHOLE_EVENTS`: small ones take
more memory than their events."""

_WHOLE_EVENTS = 4096


_LATER_US = 1 << 62
"""When what is due later than in the open step is due."""


@dataclass(frozen=True, eq=False)
class TimeStep:
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


def _never() -> float:
    return math.inf


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
        limits: How many events a step may have.

    Attributes:
        dropped: Events beyond that, of all steps so far.
        clock: What time it is, and which events are dropped.

    >>> timeline = Timeline(1000, 1280, 720)
    >>> events = Events.of([100, 2500, 2600], x=[5, 5, 5], y=[7, 7, 7], p=[1, 0, 1])
    >>> [(s.start_us, len(s.events)) for s in timeline.feed(events, lambda: True)]
    [(0, 1), (1000, 0)]
    >>> [(s.start_us, s.end_us, len(s.events)) for s in timeline.close()]
    [(2000, 2500, 2)]
    """

    def __init__(self, step_us: int, width: int, height: int, limits: Limits = LIMITS) -> None:
        self.clock = CameraClock(width, height)
        self.dropped = 0
        self._most = limits.step_events
        self._waiting = 0
        self._step_us = step_us
        self._start_us = 0
        self._pending: list[Events] = []
        self._after_gap = False
        self._part_us = 0
        self._due_us: int | None = None

    def feed(
        self, events: Events, waiting: Callable[[], bool], due_us: Callable[[], float] = _never
    ) -> Iterator[TimeStep]:
        """Take the next events of the stream; give the steps that they complete.

        Args:
            events: Those that the clock drops are in no step.
            waiting: Says after a step whether the next one matters even if it is empty.
            due_us: Says after a step, or a part, when something is due next, us; what it says changes with
                these only.
        """
        for kept in self.clock.take(events):
            yield from self._cut(kept, waiting, due_us)

    def _cut(
        self, events: Events, waiting: Callable[[], bool], due_us: Callable[[], float]
    ) -> Iterator[TimeStep]:
        """Cut events that are in order and not none."""
        done = 0
        for end in self._bounds(events):
            yield from self._parts(events, done, end, due_us)
            self._keep(events[done:end])
            done = end
            yield self._next()
            next_us = self._grid_us(int(events.t_us[end]))
            while self._start_us < next_us and waiting():
                yield self._next()
            if self._start_us < next_us:
                self._start_us, self._after_gap = next_us, True
        yield from self._parts(events, done, events.t_us.size, due_us)
        self._keep(events[done:])

    def _parts(self, events: Events, begin: int, end: int, due_us: Callable[[], float]) -> Iterator[TimeStep]:
        """The parts of the open step that end among the next events of it, which are not kept yet."""
        t_us = events.t_us[:end]
        while True:
            if self._due_us is None:
                due = due_us()
                within = max(self._start_us, self._part_us) < due < self._start_us + self._step_us
                self._due_us = math.ceil(due) if within else _LATER_US
            if self._due_us == _LATER_US or not end or t_us[-1] < self._due_us:
                return
            part = begin + int(t_us[begin:].searchsorted(self._due_us))
            self._part_us, self._due_us = self._due_us, None
            yield self._so_far(events[begin:part])

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
        many, room = len(events.t_us), self._most - self._waiting
        if many > room:
            self.dropped += many - room
            events, many = events[:room], room
        if not many:
            return
        self._waiting += many
        self._pending.append(events)
        if len(self._pending) > _MOST_PIECES + self._waiting // _WHOLE_EVENTS:
            self._pending = [Events.concat(self._pending)]

    def close(self) -> Iterator[TimeStep]:
        """End the stream; give the step that it ends in, if there is one."""
        self.clock.close()
        if self._pending:
            yield self._next(self.clock.last_us)

    def _grid_us(self, t_us: int) -> int:
        return t_us // self._step_us * self._step_us

    def _next(self, end_us: int | None = None) -> TimeStep:
        """The step whose events are pending; `end_us` where the stream ends inside it."""
        events = self._pending[0] if len(self._pending) == 1 else Events.concat(self._pending)
        start_us, after_gap = self._start_us, self._after_gap
        self._pending, self._waiting, self._after_gap, self._due_us = [], 0, False, None
        self._start_us += self._step_us
        return TimeStep(start_us, self._start_us if end_us is None else end_us, events, after_gap)

    def _bounds(self, events: Events) -> list[int]:
        """Where each new time step starts among the events."""
        t_us, start_us, step_us = events.t_us, self._start_us, self._step_us
        first_us = max(self._grid_us(int(t_us[0])), start_us)
        if int(t_us[-1]) - first_us > step_us * t_us.size:
            # Sparse events: look at each instead of at each step.
            step = t_us // step_us
            before = np.concatenate([[start_us // step_us], step[:-1]])
            return [int(i) for i in np.flatnonzero(step > before)]
        # Steps before the first event of these are not looked at, however many there are.
        next_us, last_us = first_us + step_us * (first_us == start_us), int(t_us[-1])
        if next_us > last_us:
            return []
        return sorted(set(t_us.searchsorted(np.arange(next_us, last_us + 1, step_us)).tolist()))
