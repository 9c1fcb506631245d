"""The clock of a file or camera: which events are in order, where the clock leaps, and the time steps on it.

Clocks of cameras restart, and a flipped bit makes one leap. A leap is confirmed once enough events agree on
it; until then they are held. Stream time counts from the first event, with leaps of a few seconds only, so
that no stage notices one and floating point is as fine late on a clock as early.
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
"""The longest pause that needs no confirmation: what was seen before a longer one is forgotten anyway."""

_SETBACK_US = 10_000
"""Events that are earlier by up to this are in disorder; the clock catches up soon."""

_AGREE_EVENTS = 16
_AGREE_US = 10_000
"""Successive events, and the time they span, that confirm a leap: two TIME_HIGH words of EVT3."""

_MAX_HELD = 1 << 20
"""Most events that are held; so many confirm a leap whatever their time."""

_BREAK_US = 4_000_000
"""Pause in stream time at a leap: all that was seen before is forgotten after it."""

_MAX_BREAKS = 64
"""Leaps that are remembered: packets are complete long before so many more, at `_BREAK_US` each."""

_FARTHEST_US = 1 << 62
"""Farthest time from 0 that an event may have."""

_MAX_PIECES, _PIECE_EVENTS = 64, 4096
"""Pieces of a time step that may wait to be joined, and one more for every so many events: small pieces take
more memory than their events."""

_LATER_US = 1 << 62
"""Stands for any time after the open step."""

_GRAINS = 24
"""Differences of times that show how coarse these are: those of finer times are all even in 1e-7 of cases."""

_DROPPED = ("dropped_time_backward", "dropped_off_sensor", "dropped_time_doubtful")
"""Counts of dropped events, by the kernel's verdict on them."""

_KEPT, _HELD = 3, 4
"""The kernel's verdicts on other events."""


class CameraClock:
    """Drops and counts events that are in disorder, off the sensor, or on a clock that no others agree on.

    Args:
        width: Columns of the sensor.
        height: Its rows.
        is_sparse: Pauses may be long, as in a file that somebody wrote: events after a pause are held, and
            given at the end unless others contradict them.

    Attributes:
        last_us: Stream time of the newest event, us; long ago before the first.
        counts: Events fed and dropped, and confirmed leaps forward and back.
        firsts: Number of the first event, from 0, of each count of dropped ones.

    >>> clock = CameraClock(1280, 720)
    >>> [e.t_us.tolist() for e in clock.feed(Events.of([70, 90, 80, 100], [1] * 4, [1] * 4, [1] * 4))]
    [[0, 20, 30]]
    >>> clock.camera_us(30.0), clock.counts["dropped_time_backward"]
    (100.0, 1)
    """

    def __init__(self, width: int, height: int, *, is_sparse: bool = False) -> None:
        self._is_sparse = is_sparse
        self.last_us = -_FARTHEST_US
        self._size = width, height
        self._offset_us = 0
        self._starts_us: deque[int] = deque(maxlen=_MAX_BREAKS)
        self._offsets_us: deque[int] = deque(maxlen=_MAX_BREAKS)
        # Camera clock of the last event kept; of the first and the last held; how many are held.
        self._state = np.zeros(4, np.int64)
        self._held: list[Events] = []
        self._first_held = 0
        self.firsts: dict[str, int] = {}
        self.counts = dict.fromkeys(("events", *_DROPPED, "clock_leaps", "clock_restarts"), 0)

    def camera_us(self, t_us: float) -> float:
        """Convert stream time to the camera's clock, us."""
        if len(self._offsets_us) == 1:
            return t_us + self._offset_us
        number = max(bisect_right(self._starts_us, t_us) - 1, 0)
        return t_us + self._offsets_us[number] if self._offsets_us else t_us

    def feed(self, events: Events) -> list[Events]:
        """Add the next events of the stream; return those that are kept, in stream time."""
        t_us, x, y, p = events.t_us, events.x, events.y, events.p
        self.counts["events"] += t_us.size
        if not t_us.size:
            return []
        if not (t_us.flags.carray and x.flags.carray and y.flags.carray and p.flags.carray):
            # Kernels take them as they are from here on.
            t_us, x, y, p = to_kernel_array(t_us), to_kernel_array(x), to_kernel_array(y), to_kernel_array(p)
            events = Events.from_columns(t_us, x, y, p)
        if not self._starts_us:
            first_us = self._find_first_us(events)
            if first_us is None:
                return []
            self._start_clock(first_us, 0)
        before_us, _, _, held = self._state.tolist()
        if not held and before_us <= int(t_us[0]) and int(t_us[-1]) - before_us <= LEAP_US:
            stream_us = np.empty(t_us.size, np.int64)
            if _kernels.convert_ordered(t_us, x, y, *self._size, self._offset_us, stream_us):
                self._state[0] = t_us[-1]
                self.last_us = int(stream_us[-1])
                return [Events.from_columns(stream_us, x, y, p)]
        return self._sort_events(events)

    def close(self) -> list[Events]:
        """End the stream; return the events still held after a pause that nothing contradicts."""
        if self._is_sparse and self._held and self._state[1] > self._state[0]:
            return [self._confirm_held()]
        self._drop_held()
        self._state[3] = 0
        return []

    def _drop_held(self) -> None:
        if self._held:
            self._count_dropped("dropped_time_doubtful", self._first_held, sum(map(len, self._held)))
        self._held = []

    def _count_dropped(self, name: str, first: int, number: int) -> None:
        self.counts[name] += number
        self.firsts[name] = min(self.firsts.get(name, first), first)

    def _count_dropped_where(self, name: str, mask: NDArray[np.bool_], first: int) -> None:
        """Count dropped events; `first` is the number of the mask's first one."""
        if mask.any():
            self._count_dropped(name, first + int(mask.argmax()), int(np.count_nonzero(mask)))

    def _sort_events(self, events: Events) -> list[Events]:
        """Judge events one by one; return those that are kept, in stream time."""
        held_us = _FARTHEST_US if self._is_sparse else LEAP_US
        limits = (LEAP_US, held_us, _SETBACK_US, _AGREE_EVENTS, _AGREE_US, _MAX_HELD, _FARTHEST_US)
        pieces: list[Events] = []
        while len(events):
            verdicts = np.empty(len(events), np.uint8)
            number, are_lost = _kernels.judge_events(
                events.t_us, events.x, events.y, *self._size, limits, self._state, verdicts
            )
            processed, verdicts = events[:number], verdicts[:number]
            events = events[number:]
            if are_lost:
                self._drop_held()
            first = self.counts["events"] - len(events) - number
            for verdict, name in enumerate(_DROPPED):
                self._count_dropped_where(name, verdicts == verdict, first)
            if (kept := verdicts == _KEPT).any():
                pieces.append(self._to_stream_time(processed[kept]))
            if (held := verdicts == _HELD).any():
                if not self._held:
                    self._first_held = first + int(held.argmax())
                self._held.append(processed[held])
            if self._state[3] < 0:
                # The last one has confirmed those that are held.
                pieces.append(self._confirm_held())
        return pieces

    def _find_first_us(self, events: Events) -> int | None:
        """Time of the first event that has one and is on the sensor; those before it are dropped later."""
        width, height = self._size
        # As a rule, it is the very first.
        for some in (events[:1], events):
            on_sensor = (some.x < width) & (some.y < height)
            good = on_sensor & (some.t_us <= _FARTHEST_US) & (some.t_us >= -_FARTHEST_US)
            if good.any():
                return int(some.t_us[int(good.argmax())])
        first = self.counts["events"] - len(events)
        self._count_dropped_where("dropped_off_sensor", ~on_sensor, first)
        self._count_dropped_where("dropped_time_doubtful", on_sensor, first)
        return None

    def _start_clock(self, camera_us: int, stream_us: int) -> None:
        """Let the camera's clock go on from a time, at this stream time."""
        self._offset_us = camera_us - stream_us
        # The later half of the pause belongs to what comes: a packet begins before its first event.
        self._starts_us.append(stream_us - _BREAK_US // 2)
        self._offsets_us.append(self._offset_us)
        self._state[0] = camera_us

    def _confirm_held(self) -> Events:
        """Let the clock leap to the events that are held; return them in stream time."""
        before_us, first_us, last_us, _ = self._state.tolist()
        self.counts["clock_leaps" if first_us > before_us else "clock_restarts"] += 1
        self._start_clock(first_us, self.last_us + _BREAK_US)
        self._state[0], self._state[3] = last_us, 0
        held, self._held = Events.concat(self._held), []
        return self._to_stream_time(held)

    def _to_stream_time(self, events: Events) -> Events:
        t_us = events.t_us - self._offset_us
        self.last_us = int(t_us[-1])
        return Events(t_us, events.x, events.y, events.p)


class TimeGrain(NamedTuple):
    """How coarse a stream's times are, by the first of their differences.

    Attributes:
        step_us: Greatest common divisor of these, us: 1 except for coarse times.
        seen: Number of these.
        last_us: Time of the last event; None before the first.
        known_us: Time of the last event that was needed; None as long as there are too few.

    >>> TimeGrain().update(np.arange(30) * 200).step_us
    200
    """

    step_us: int = 0
    seen: int = 0
    last_us: int | None = None
    known_us: int | None = None

    def update(self, t_us: NDArray[np.int64]) -> "TimeGrain":
        """The grain with the next times of the stream."""
        if not t_us.size or self.known_us is not None:
            return self
        gaps_us = np.diff(t_us, prepend=t_us[0] if self.last_us is None else self.last_us)
        places = np.flatnonzero(gaps_us)[: _GRAINS - self.seen]
        step_us = math.gcd(self.step_us, int(np.gcd.reduce(gaps_us[places])) if len(places) else 0)
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
        is_whole: It is no part: its events do not come again.
    """

    start_us: int
    end_us: int
    events: Events
    after_gap: bool
    is_whole: bool = True


class Timeline:
    """Cuts a stream into time steps on a fixed grid, whatever pieces it comes in.

    A step is complete once an event after it has been seen. Empty steps are given as long as somebody waits
    for them, and left out in a gap. The part of a step before a time at which something is due is given as
    soon as an event after that has been seen in the step, and again with the whole step. Times are stream
    times, see `CameraClock`.

    Args:
        step_us: Length of a step, us.
        width: Columns of the sensor.
        height: Its rows.
        most_events: Most events of a step.

    Attributes:
        dropped: Events beyond that, of all steps so far.
        clock: Converts times, and counts dropped events.

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
        self._most, self._pending_events = most_events, 0
        self._step_us, self._start_us = step_us, 0
        self._pending: list[Events] = []
        self._after_gap = False
        self._part_us = 0
        self._due_us: int | None = None

    def feed(
        self, events: Events, is_waiting: Callable[[], bool], due_us: Callable[[], float]
    ) -> Iterator[TimeStep]:
        """Add the next events of the stream; yield the steps that they complete.

        Args:
            events: Those that the clock drops are in no step.
            is_waiting: Returns after a step whether the next one matters even if it is empty.
            due_us: Returns after a step, or a part, when something is due next, us; it changes with these
                only.
        """
        for kept in self.clock.feed(events):
            t_us, done = kept.t_us, 0
            for end in (*self._find_bounds(t_us), t_us.size):
                while True:
                    if self._due_us is None:
                        due = due_us()
                        is_in_step = max(self._start_us, self._part_us) < due < self._start_us + self._step_us
                        self._due_us = math.ceil(due) if is_in_step else _LATER_US
                    if not end or t_us[end - 1] < self._due_us:
                        break
                    part = done + int(t_us[done:end].searchsorted(self._due_us))
                    self._part_us, self._due_us = self._due_us, None
                    yield self._make_part(kept[done:part])
                self._add_pending(kept[done:end])
                done = end
                if end < t_us.size:
                    yield self._finish_step()
                    next_us = int(t_us[end]) // self._step_us * self._step_us
                    while self._start_us < next_us and is_waiting():
                        yield self._finish_step()
                    if self._start_us < next_us:
                        self._start_us, self._after_gap = next_us, True

    def close(self) -> Iterator[TimeStep]:
        """End the stream; yield the step that it ends in, if there is one."""
        self.clock.close()
        if self._pending:
            yield self._finish_step(self.clock.last_us)

    def _find_bounds(self, t_us: NDArray[np.int64]) -> list[int]:
        """Where new time steps start among events, which are in order and at least one."""
        start_us, step_us = self._start_us, self._step_us
        first_us = max(int(t_us[0]) // step_us * step_us, start_us)
        last_us = int(t_us[-1])
        if last_us - first_us > step_us * t_us.size:
            # Sparse events: visit each instead of each step.
            step = t_us // step_us
            return np.flatnonzero(np.diff(step, prepend=start_us // step_us) > 0).tolist()
        # Steps before the first of these events are not visited, however many there are.
        next_us = first_us + step_us * (first_us == start_us)
        if next_us > last_us:
            return []
        return sorted(set(t_us.searchsorted(np.arange(next_us, last_us + 1, step_us)).tolist()))

    def _make_part(self, newest: Events) -> TimeStep:
        """The part of the open step that is due: its pending events and the newest ones."""
        if len(self._pending) > 1:
            self._pending = [Events.concat(self._pending)]
        # A view where it is all of one piece: the whole step is one, too.
        newest = newest[: self._most - self._pending_events]
        events = Events.concat([*self._pending, newest]) if self._pending else newest
        return TimeStep(self._start_us, self._part_us, events, self._after_gap, is_whole=False)

    def _add_pending(self, events: Events) -> None:
        """Add events to the open step, as far as it has room."""
        number, room = events.t_us.size, self._most - self._pending_events
        if number > room:
            self.dropped += number - room
            events, number = events[:room], room
        if not number:
            return
        self._pending_events += number
        self._pending.append(events)
        if len(self._pending) > _MAX_PIECES + self._pending_events // _PIECE_EVENTS:
            self._pending = [Events.concat(self._pending)]

    def _finish_step(self, end_us: int | None = None) -> TimeStep:
        """Finish the open step; `end_us` where the stream ends in it."""
        events = self._pending[0] if len(self._pending) == 1 else Events.concat(self._pending)
        start_us, after_gap = self._start_us, self._after_gap
        self._pending, self._pending_events, self._after_gap, self._due_us = [], 0, False, None
        self._start_us += self._step_us
        return TimeStep(start_us, self._start_us if end_us is None else end_us, events, after_gap)
