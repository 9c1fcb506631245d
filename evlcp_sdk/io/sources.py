"""What every recording, camera and replay is to a receiver: a stream of events, with what it lost."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from evlcp_sdk.errors import StreamError
from evlcp_sdk.values import Events, Triggers

__all__ = ["DEFAULT_MAX_EVENTS", "EventSource", "Loss", "ReplaySource"]

DEFAULT_MAX_EVENTS = 1 << 16
"""Events of a piece unless asked otherwise: under 1 MB, so that it is still in the cache when it is used."""


@dataclass(frozen=True)
class Loss:
    """One kind of data that a source had to skip, drop or doubt.

    Attributes:
        count: How many.
        first: Where the first was: a byte offset, a line or a row (both from 1), as `unit` says.
        unit: `byte`, `line` or `row`.
        meaning: What was lost, for a reader of the summary.

    >>> str(Loss(2, 84, "byte", "words of a reserved type; skipped"))
    '2 words of a reserved type; skipped (first at byte 84)'
    """

    count: int
    first: int
    unit: str
    meaning: str

    def __str__(self) -> str:
        return f"{self.count} {self.meaning} (first at {self.unit} {self.first})"


class EventSource(ABC):
    """A recording or a camera, read once from front to back; a context manager.

    Time never runs backward in what a source gives out: an event or trigger earlier than the one before is
    dropped and counted as the loss `time_backward`. So a clock that leaps ahead for a moment, by a word gone
    wrong, costs all events until it is caught up; the count shows it.

    A source of your own calls `super().__init__` and implements `take` and `close`.

    Args:
        path: The file, or a name for what is not one.
        format: `EVT3`, `EVT2`, `NPZ`, `CSV` or another format's name.
        width: Columns of the sensor, or None where the recording does not say.
        height: Rows of the sensor, or None.
        header: The recording's own header lines, by key.
        size_bytes: Size of the file, or None for a live source.
    """

    def __init__(
        self,
        path: Path,
        format: str,
        width: int | None = None,
        height: int | None = None,
        header: Mapping[str, str] | None = None,
        size_bytes: int | None = None,
    ) -> None:
        self.path = path
        self.format = format
        self.width = width
        self.height = height
        self.header: Mapping[str, str] = header or {}
        self.size_bytes = size_bytes
        self._given = {"events": 0, "triggers": 0}
        self._rest = (Events.empty(), Triggers.empty())

    @abstractmethod
    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """Return the next piece, of about `max_events` events, or None at the end; a camera waits for it.

        The columns are the caller's: nothing overwrites them.

        Raises:
            InputError: The file cannot be read on.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the file or camera; twice does no harm."""

    @property
    def position_bytes(self) -> int:
        """How much of `size_bytes` is done; 0 for a live source."""
        return 0

    @property
    def losses(self) -> dict[str, Loss]:
        """What has been lost so far, by kind; a kind that did not occur is left out."""
        return {}

    @property
    def counts(self) -> dict[str, int]:
        """What has been given out so far, `events` and `triggers`, and what else the format counts."""
        return dict(self._given)

    def stream(self, max_events: int = DEFAULT_MAX_EVENTS) -> Iterator[tuple[Events, Triggers]]:
        """Yield what follows, in pieces of at most `max_events` events and as many triggers.

        A piece belongs to the caller: nothing overwrites it. A second call goes on where the first one
        stopped. Either half of a pair may be empty, not both.

        Raises:
            InputError: The file cannot be read on.
            StreamError: `max_events` is not positive.
        """
        if max_events < 1:
            raise StreamError(f"max_events is {max_events}, expected 1 or more")
        nothing = Events.empty(), Triggers.empty()
        while True:
            events, triggers = self._rest
            if not len(events) and not len(triggers):
                piece = self.take(max_events)
                if piece is None:
                    return
                self._rest = piece
                continue
            if len(events) <= max_events and len(triggers) <= max_events:
                self._rest = nothing
            else:
                self._rest = events[max_events:], _rows(triggers, slice(max_events, None))
                events, triggers = events[:max_events], _rows(triggers, slice(max_events))
            self._given["events"] += len(events)
            self._given["triggers"] += len(triggers)
            yield events, triggers

    def chunks(self, max_events: int = DEFAULT_MAX_EVENTS) -> Iterator[Events]:
        """Yield the events of `stream`; its triggers only count in `counts`.

        Raises:
            InputError: The file cannot be read on.
            StreamError: `max_events` is not positive.
        """
        for events, _ in self.stream(max_events):
            if len(events):
                yield events

    def read(self) -> tuple[Events, Triggers]:
        """Return all that follows at once.

        Raises:
            InputError: The file cannot be read on.
        """
        return self._join(1 << 20)

    def _join(self, max_events: int) -> tuple[Events, Triggers]:
        pieces = list(self.stream(max_events))
        if len(pieces) == 1:
            return pieces[0]
        return Events.concat(e for e, _ in pieces), Triggers.concat(g for _, g in pieces)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _rows(triggers: Triggers, rows: slice) -> Triggers:
    return Triggers(triggers.t_us[rows], triggers.channel[rows], triggers.value[rows])


class ReplaySource(EventSource):
    """A recording given out at the pace of its own clock, as a camera would.

    Args:
        source: The recording; closed with the replay.
        speed: Camera seconds for each second that passes.
        slice_us: Camera time between two pieces, us; each comes when its time is over.
        clock: Gives the time, s.
        sleep: Waits, s.

    Attributes:
        lag_s: How much later than due the last piece was asked for, s; it grows if the receiver is too slow.

    Raises:
        StreamError: `speed` or `slice_us` is not positive.
    """

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
        super().__init__(
            source.path, source.format, source.width, source.height, source.header, source.size_bytes
        )
        self.lag_s = 0.0
        self._source = source
        self._s_per_us = 1e-6 / speed
        self._slice_us = slice_us
        self._clock = clock
        self._sleep = sleep
        self._piece = (Events.empty(), Triggers.empty())
        self._origin: tuple[int, float] | None = (
            None  # camera clock, us, and own clock, s, of the first piece
        )

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """Wait until the next slice of time is over and return its events, at most `max_events`."""
        if not any(len(half) for half in self._piece):
            piece = next(self._source.stream(max_events), None)
            if piece is None:
                return None
            self._piece = piece
        events, triggers = self._piece
        first = min(int(column[0]) for column in (events.t_us, triggers.t_us) if len(column))
        if self._origin is None:
            self._origin = first, self._clock()
        start_us, start_s = self._origin
        end_us = first + self._slice_us - (first - start_us) % self._slice_us
        n, m = (int(np.searchsorted(column, end_us)) for column in (events.t_us, triggers.t_us))
        self._piece = events[n:], _rows(triggers, slice(m, None))

        early_s = start_s + (end_us - start_us) * self._s_per_us - self._clock()
        self.lag_s = max(-early_s, 0.0)
        if early_s > 0:
            self._sleep(early_s)
        return events[:n], _rows(triggers, slice(m))

    def close(self) -> None:
        """Close the recording."""
        self._source.close()

    @property
    def position_bytes(self) -> int:
        """As the recording's."""
        return self._source.position_bytes

    @property
    def losses(self) -> dict[str, Loss]:
        """As the recording's."""
        return self._source.losses

    @property
    def counts(self) -> dict[str, int]:
        """As the recording's, with the events and triggers replayed so far."""
        return self._source.counts | self._given
