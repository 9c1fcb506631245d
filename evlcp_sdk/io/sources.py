"""What every recording, camera and replay looks like to a receiver: a stream of events with its losses."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import ClassVar, Self

import numpy as np

from evlcp_sdk.errors import StreamError
from evlcp_sdk.types import Events, Triggers

__all__ = ["DEFAULT_MAX_EVENTS", "EventSource", "Loss", "ReplaySource"]

DEFAULT_MAX_EVENTS = 1 << 17
"""Events of a chunk unless asked otherwise: 1.7 MB, so that a chunk is still in the cache when it is used."""


@dataclass(frozen=True)
class Loss:
    """One kind of data that a source had to skip, drop or doubt.

    Attributes:
        count: How many.
        first: Where the first was: a byte offset, a line or a row, as `unit` says.
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

    Time never runs backward in what a source gives out: an event earlier than the one before is dropped
    and counted as the loss `time_backward`.

    Attributes:
        path: The file, or a name for what is not one.
        format: `EVT3`, `EVT2`, `NPZ`, `CSV` or another format's name.
        width: Columns of the sensor, or None where the recording does not say.
        height: Rows of the sensor, or None.
        header: The recording's own header lines, by key.
        size_bytes: Size of the file, or None for a live source.
    """

    path: Path
    format: str
    width: int | None
    height: int | None
    header: Mapping[str, str]
    size_bytes: int | None

    @abstractmethod
    def stream(self, max_events: int = DEFAULT_MAX_EVENTS) -> Iterator[tuple[Events, Triggers]]:
        """Yield what follows, in pieces of at most `max_events` events and as many triggers.

        A piece belongs to the caller: no later one overwrites it. A second call goes on where the first
        one stopped. Either half of a pair may be empty, not both.

        Raises:
            InputError: The file cannot be read on.
            StreamError: `max_events` is not positive.
        """

    @property
    @abstractmethod
    def position_bytes(self) -> int:
        """How much of `size_bytes` is done; 0 for a live source."""

    @property
    @abstractmethod
    def losses(self) -> dict[str, Loss]:
        """What has been lost so far, by kind; a kind that did not occur is left out."""

    @property
    @abstractmethod
    def counts(self) -> dict[str, int]:
        """What has been read so far: `events`, `triggers` and what else the format counts."""

    @abstractmethod
    def close(self) -> None:
        """Release the file; once is enough, twice does no harm."""

    def chunks(self, max_events: int = DEFAULT_MAX_EVENTS) -> Iterator[Events]:
        """Yield the events of `stream` without the triggers (these still count in `counts`)."""
        for events, _ in self.stream(max_events):
            if len(events):
                yield events

    def read(self) -> tuple[Events, Triggers]:
        """Return all that follows at once."""
        pieces = list(self.stream(1 << 20))
        if len(pieces) == 1:
            return pieces[0]
        return Events.concat(e for e, _ in pieces), Triggers.concat(g for _, g in pieces)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def check_max_events(max_events: int) -> None:
    """Raise StreamError unless `max_events` is positive."""
    if max_events < 1:
        raise StreamError(f"max_events is {max_events}, expected 1 or more")
