"""Replay a recording at the speed of its own clock, once or in a loop."""

import math
import time
from collections.abc import Callable

import numpy as np

from evlcp_sdk.errors import StreamError
from evlcp_sdk.plugin.source import EventSource, Loss
from evlcp_sdk.values import Events, Triggers, span_us

LOOP_GAP_US = 500_000
"""Pause between two passes of a recording: a receiver forgets what it saw, but sees no clock leap."""

DAMAGE_US = 100_000
"""A longer silence next to damage is damage too: a wrong TIME_HIGH steps the clock by up to 2^24 us, while
the noise of its pixels keeps a sensor from being silent for so long."""


class WrappingSource(EventSource):
    """A source that passes on what another one gives, and closes it."""

    def __init__(self, source: EventSource, size_bytes: int | None = None) -> None:
        super().__init__(source.path, source.format, source.width, source.height, source.header, size_bytes)
        self.guessed, self.step_us = source.guessed, source.step_us
        self._source = source
        self._past_losses: dict[str, Loss] = {}

    def _reopen(self, opener: Callable[[], EventSource]) -> None:
        """Replace the source by one newly opened; past losses stay counted."""
        self._source.close()
        source = opener()
        self._past_losses, self._source = self.losses, source

    def clock_s(self, t_us: float) -> float | None:
        """As `EventSource.clock_s`, of the wrapped source."""
        return self._source.clock_s(t_us)

    @property
    def losses(self) -> dict[str, Loss]:
        """The losses of the source since it was first opened."""
        return Loss.merge(self._past_losses, self._source.losses)

    def close(self) -> None:
        """Close the source."""
        self._source.close()


class LoopSource(WrappingSource):
    """A recording in a loop, its clock going on; the loop ends with the pass that reaches `for_us`."""

    def __init__(self, opener: Callable[[], EventSource], for_us: float = math.inf) -> None:
        super().__init__(opener())
        self.live = self._source.live
        self._opener, self._for_us = opener, for_us
        self._shift_us = 0
        self._start_us: int | None = None
        self._last_us = 0

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """As `EventSource.take`, with the times of this pass."""
        is_first = False
        while (piece := next(self._source.stream(max_events), None)) is None:
            if self._start_us is None or self._last_us - self._start_us >= self._for_us:
                return None  # It is empty, or over.
            self._reopen(self._opener)
            is_first = True
        events, triggers = piece
        first_us, last_us = span_us(events, triggers)
        if self._start_us is None:
            self._start_us = first_us
        elif is_first:
            self._shift_us = self._last_us + LOOP_GAP_US - first_us
        self._last_us = last_us + self._shift_us
        return (
            Events(events.t_us + self._shift_us, events.x, events.y, events.p),
            Triggers(triggers.t_us + self._shift_us, triggers.channel, triggers.value),
        )


class ReplaySource(WrappingSource):
    """A recording replayed at the speed of its own clock, as a camera would send it.

    Silences last as long as they did, except those over `DAMAGE_US` in or next to a piece of the recording
    with losses, where its clock has leapt. `counts` has their number as `silences_skipped`, and their time as
    `silences_skipped_us`.

    Args:
        source: The recording; closed with the replay.
        speed: Camera seconds per second.
        slice_us: Camera time of a piece, us; it comes when that time is over.
        clock: Returns the time, s.
        sleep: Waits so many seconds.

    Raises:
        StreamError: `speed` or `slice_us` is not positive.
    """

    live = True

    def __init__(
        self,
        source: EventSource,
        speed: float = 1.0,
        slice_us: int = 1000,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if not speed > 0 or slice_us < 1:
            raise StreamError(f"replay at speed {speed} in slices of {slice_us} us, expected both positive")
        super().__init__(source, source.size_bytes)
        self._s_per_us = 1e-6 / speed
        self._slice_us = slice_us
        self._clock = clock
        self._sleep = sleep
        self._piece = (Events.empty(), Triggers.empty())
        self._last_us: int | None = None  # the last time that was replayed
        self._past_damage = 0
        self._is_damaged = False  # this piece of the recording
        # Camera clock, us, and own clock, s, of the first piece and of each after a skipped silence or a
        # restart of the clock.
        self._origins: list[tuple[int, float]] = []
        self._skipped = {"silences_skipped": 0, "silences_skipped_us": 0}

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """Wait until the next slice of time is over and return its events, at most `max_events`."""
        damaged = self._is_damaged
        if not any(len(half) for half in self._piece):
            piece = next(self._source.stream(max_events), None)
            if piece is None:
                return None
            self._piece = piece
            lost = sum(loss.count for loss in self._source.losses.values())
            self._is_damaged, self._past_damage = lost > self._past_damage, lost
            damaged |= self._is_damaged
        events, triggers = self._piece
        first, _ = span_us(events, triggers)
        if self._last_us is None:
            self._origins.append((first, self._clock()))
        elif first < self._last_us or (damaged and first - self._last_us > DAMAGE_US):
            self._skipped["silences_skipped"] += first > self._last_us
            self._skipped["silences_skipped_us"] += max(first - self._last_us, 0)
            start_us, start_s = self._origins[-1]
            self._origins.append((first, start_s + (self._last_us - start_us) * self._s_per_us))
        start_us, start_s = self._origins[-1]
        end_us = first + self._slice_us - (first - start_us) % self._slice_us
        n, m = (int(np.searchsorted(column, end_us)) for column in (events.t_us, triggers.t_us))
        self._piece = events[n:], triggers[m:]
        _, self._last_us = span_us(events[:n], triggers[:m])
        early_s = start_s + (end_us - start_us) * self._s_per_us - self._clock()
        if early_s > 0:
            self._sleep(early_s)
        return events[:n], triggers[:m]

    def clock_s(self, t_us: float) -> float | None:
        """Return when a time of the recording is due, by `clock`; None before the first piece."""
        if not self._origins:
            return None
        earlier = (origin for origin in reversed(self._origins) if origin[0] <= t_us)
        start_us, start_s = next(earlier, self._origins[0])
        return start_s + (t_us - start_us) * self._s_per_us

    @property
    def position_bytes(self) -> int:
        """How much of the recording is read."""
        return self._source.position_bytes

    @property
    def counts(self) -> dict[str, int]:
        """The recording's counts, with the events and triggers replayed and the silences skipped so far."""
        skipped = self._skipped if self._skipped["silences_skipped"] else {}
        return self._source.counts | self._given | skipped
