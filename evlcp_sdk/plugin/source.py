"""Event sources, such as recordings, cameras and replays: streams of events with their losses."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, Self

import numpy as np

from evlcp_sdk.errors import PluginError, StreamError, blame_class
from evlcp_sdk.values import Events, Triggers

DEFAULT_MAX_EVENTS = 1 << 18
"""Default number of events in a piece: under 4 MB, so that it stays in the cache until it is used, and four
times a time step's events of four bars, as a step in two pieces has to be joined."""


@dataclass(frozen=True)
class Loss:
    """Data of one kind that a source skipped, dropped or found suspect.

    Attributes:
        count: Number of items.
        first: Place of the first one in `unit`: a byte offset, a line or a row (both from 1).
        unit: `byte`, `line` or `row`.
        meaning: What was lost, for a reader of the summary.

    >>> str(Loss(2, 84, "byte", "words of a reserved type; skipped"))
    '2 words of a reserved type; skipped (first at byte 84)'
    """

    count: int
    first: int
    unit: str
    meaning: str

    @staticmethod
    def merge(before: "Mapping[str, Loss]", after: "Mapping[str, Loss]") -> "dict[str, Loss]":
        """Losses of two parts of a stream together, by kind; the first place is the earlier part's."""
        out = dict(before)
        for kind, loss in after.items():
            out[kind] = replace(out[kind], count=out[kind].count + loss.count) if kind in out else loss
        return out

    def add(self, count: int, first: int) -> "Loss":
        """The loss with `count` items more, of which the first is at `first`."""
        return replace(self, count=self.count + count, first=self.first if self.count else first)

    def __str__(self) -> str:
        return f"{self.count} {self.meaning} (first at {self.unit} {self.first})"


class Ledger(Protocol):
    """A decoder or checker of a source's events that counts what it drops."""

    @property
    def losses(self) -> dict[str, Loss]:
        """The losses so far, by kind."""

    @property
    def counts(self) -> dict[str, int]:
        """Its other counts, by name."""


class EventSource(ABC):
    """A recording or a camera, read once from front to back; a context manager.

    An event or trigger earlier than the one before is dropped and counted as the loss `time_backward`, one
    whose time no others confirm as `time_doubtful`. Times go backward only where the camera's clock has
    restarted, which several events in a row confirm; a receiver applies the same rule.

    A source of your own calls `super().__init__` and implements `take` and `close`.

    Args:
        path: The file, or the name of another source.
        format: `EVT3`, `EVT21`, `EVT2`, `NPZ`, `CSV` or another format's name.
        width: Columns of the sensor, or None if unknown.
        height: Rows of the sensor, or None.
        header: The recording's own header lines, by key.
        size_bytes: Size of the file, or None for a live source.
        ledger: Has this source's losses and counts; None if nothing is ever lost.
    """

    live = False
    """Whether its time goes on by itself, as a camera's, so that events not taken soon are late."""

    guessed = ""
    """Properties of the recording that were guessed, in words; empty for none."""

    step_us = 0
    """Step of which all times are multiples, us; 0 if unknown."""

    _gives_bits = False
    """Whether polarities are single bits in the recording, so that none can be invalid."""

    def __init__(
        self,
        path: Path | str,
        format: str,
        width: int | None = None,
        height: int | None = None,
        header: Mapping[str, str] | None = None,
        size_bytes: int | None = None,
        ledger: Ledger | None = None,
    ) -> None:
        self.path = path
        self.format = format
        self.width = width
        self.height = height
        self.header: Mapping[str, str] = header or {}
        self.size_bytes = size_bytes
        self._ledger = ledger
        self._given = {"events": 0, "triggers": 0}
        self._pending = (Events.empty(), Triggers.empty())

    @abstractmethod
    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """Return the next piece, of about `max_events` events, or None at the end; a camera waits for it.

        The columns belong to the caller: nothing overwrites them.

        Raises:
            InputError: The file cannot be read on.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the file or camera; twice does no harm."""

    @property
    def position_bytes(self) -> int:
        """Bytes read, of `size_bytes`; 0 for a live source."""
        return 0

    def clock_s(self, t_us: float) -> float | None:
        """The `time.monotonic()` at a time of the camera's clock, s; None if unknown."""
        return None

    @property
    def health(self) -> Mapping[str, float | int | str]:
        """A camera's own measurements, such as `temperature_c`, by name; empty for most sources."""
        return {}

    @property
    def losses(self) -> dict[str, Loss]:
        """The losses so far, by kind, for kinds that occurred."""
        return {} if self._ledger is None else self._ledger.losses

    @property
    def counts(self) -> dict[str, int]:
        """`events` and `triggers` given out so far, and the format's other counts."""
        return self._given | ({} if self._ledger is None else self._ledger.counts)

    def stream(self, max_events: int = DEFAULT_MAX_EVENTS) -> Iterator[tuple[Events, Triggers]]:
        """Yield the following events and triggers, in pieces of at most `max_events` of each.

        A piece belongs to the caller: nothing overwrites it. A second call goes on where the first one
        stopped. Either half of a pair may be empty, not both.

        Raises:
            InputError: The file cannot be read on.
            PluginError: A plugin's source fails, or breaks the contract of `take`.
            StreamError: `max_events` is not positive.
        """
        if max_events < 1:
            raise StreamError(f"max_events is {max_events}, expected 1 or more")
        nothing = Events.empty(), Triggers.empty()
        while True:
            events, triggers = self._pending
            if not len(events) and not len(triggers):
                piece = self._take_checked(max_events)
                if piece is None:
                    return
                self._pending = piece
                continue
            n, m = len(events), len(triggers)
            # What comes first in time comes in the first piece.
            if n > max_events:
                n, m = max_events, int(np.searchsorted(triggers.t_us, events.t_us[max_events], "right"))
            if m > max_events:
                n, m = min(n, int(np.searchsorted(events.t_us, triggers.t_us[max_events]))), max_events
            self._pending = nothing if n == len(events) and m == len(triggers) else (events[n:], triggers[m:])
            events, triggers = events[:n], triggers[:m]
            self._given["events"] += len(events)
            self._given["triggers"] += len(triggers)
            yield events, triggers

    def _take_checked(self, max_events: int) -> tuple[Events, Triggers] | None:
        with blame_class(self, f"{self.path}: source"):
            piece: object = self.take(max_events)
        if piece is None:
            return None
        if not isinstance(piece, tuple) or tuple(map(type, piece)) != (Events, Triggers):
            gave = ", ".join(type(one).__name__ for one in piece) if isinstance(piece, tuple) else None
            raise self._plugin_error(f"gave ({gave or type(piece).__name__}), expected (Events, Triggers)")
        events, triggers = piece
        if not self._gives_bits and len(events) and events.p.max() > 1:
            raise self._plugin_error(f"gave polarity {events.p.max()}, expected 0 or 1")
        return events, triggers

    def _plugin_error(self, what: str) -> PluginError:
        return PluginError(f"{self.path}: source {type(self).__name__}: {what}")

    def chunks(self, max_events: int = DEFAULT_MAX_EVENTS) -> Iterator[Events]:
        """Yield the events of `stream`; its triggers only count in `counts`. Errors are those of `stream`."""
        for events, _ in self.stream(max_events):
            if len(events):
                yield events

    def read(self) -> tuple[Events, Triggers]:
        """Return all following events and triggers at once; errors are those of `stream`."""
        pieces = list(self.stream(1 << 20))
        return Events.concat(e for e, _ in pieces), Triggers.concat(g for _, g in pieces)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        # An earlier error matters more than a failure to close after it.
        with (
            nullcontext() if error is None else suppress(PluginError),
            blame_class(self, f"{self.path}: source"),
        ):
            self.close()
