"""What every recording, camera and replay is to a receiver: a stream of events, with what it lost."""

import traceback
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, Self

from evlcp_sdk.errors import EvlcpError, PluginError, StreamError
from evlcp_sdk.values import Events, Triggers

DEFAULT_MAX_EVENTS = 1 << 18
"""Events of a piece unless asked otherwise: under 4 MB, so that it is still in the cache when it is used, and
four times what four bars give in a time step, as a step that lies in two pieces has to be put together."""


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

    @staticmethod
    def added(before: "Mapping[str, Loss]", after: "Mapping[str, Loss]") -> "dict[str, Loss]":
        """Losses of two parts of a stream together; the first place is the earlier part's."""
        out = dict(before)
        for kind, loss in after.items():
            out[kind] = replace(out[kind], count=out[kind].count + loss.count) if kind in out else loss
        return out

    def more(self, count: int, first: int) -> "Loss":
        """So many more, the first of which was there."""
        return replace(self, count=self.count + count, first=self.first if self.count else first)

    def __str__(self) -> str:
        return f"{self.count} {self.meaning} (first at {self.unit} {self.first})"


class Ledger(Protocol):
    """What decodes or checks a source's events, and counts what it drops."""

    @property
    def losses(self) -> dict[str, Loss]:
        """What has been lost so far, by kind."""

    @property
    def counts(self) -> dict[str, int]:
        """What else it counts, by name."""


class EventSource(ABC):
    """A recording or a camera, read once from front to back; a context manager.

    An event or trigger earlier than the one before is dropped and counted as the loss `time_backward`, one at
    a time that no others agree with as `time_doubtful`. Time runs backward in what a source gives out only
    where a camera's clock has restarted, as some events on end agree; a receiver judges by the same rule.

    A source of your own calls `super().__init__` and implements `take` and `close`.

    Args:
        path: The file, or a name for what is not one.
        format: `EVT3`, `EVT2`, `NPZ`, `CSV` or another format's name.
        width: Columns of the sensor, or None where the recording does not say.
        height: Rows of the sensor, or None.
        header: The recording's own header lines, by key.
        size_bytes: Size of the file, or None for a live source.
        ledger: Whose losses and counts are this source's; None where nothing is ever lost.
    """

    live = False
    """Whether its time goes on by itself, as a camera's: what is not taken soon is late."""

    guessed = ""
    """What the recording does not say and was guessed, in words; empty for nothing."""

    step_us = 0
    """What all times are seen to be multiples of, us; 0 where nobody looked."""

    _gives_bits = False
    """Whether a polarity is a single bit of what it reads, so that none can be wrong."""

    def __init__(
        self,
        path: Path,
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

    def clock_s(self, t_us: float) -> float | None:
        """When a time of the camera's clock was, by `time.monotonic()`, s; None if it is not known."""
        return None

    @property
    def health(self) -> Mapping[str, float | int | str]:
        """What a camera says of itself, such as `temperature_c`, by name; nothing of most sources."""
        return {}

    @property
    def losses(self) -> dict[str, Loss]:
        """What has been lost so far, by kind; a kind that did not occur is left out."""
        return {} if self._ledger is None else self._ledger.losses

    @property
    def counts(self) -> dict[str, int]:
        """What has been given out so far, `events` and `triggers`, and what else the format counts."""
        return self._given | ({} if self._ledger is None else self._ledger.counts)

    def stream(self, max_events: int = DEFAULT_MAX_EVENTS) -> Iterator[tuple[Events, Triggers]]:
        """Yield what follows, in pieces of at most `max_events` events and as many triggers.

        A piece belongs to the caller: nothing overwrites it. A second call goes on where the first one
        stopped. Either half of a pair may be empty, not both.

        Raises:
            InputError: The file cannot be read on.
            PluginError: A plugin's source fails, or gives something else than `take` says.
            StreamError: `max_events` is not positive.
        """
        if max_events < 1:
            raise StreamError(f"max_events is {max_events}, expected 1 or more")
        nothing = Events.empty(), Triggers.empty()
        while True:
            events, triggers = self._rest
            if not len(events) and not len(triggers):
                piece = self._taken(max_events)
                if piece is None:
                    return
                self._rest = piece
                continue
            if len(events) <= max_events and len(triggers) <= max_events:
                self._rest = nothing
            else:
                self._rest = events[max_events:], triggers[max_events:]
                events, triggers = events[:max_events], triggers[:max_events]
            self._given["events"] += len(events)
            self._given["triggers"] += len(triggers)
            yield events, triggers

    def _taken(self, max_events: int) -> tuple[Events, Triggers] | None:
        """What `take` gives, checked: kernels trust it."""
        with self._guarded():
            piece: object = self.take(max_events)
        if piece is None:
            return None
        if not isinstance(piece, tuple) or tuple(map(type, piece)) != (Events, Triggers):
            gave = ", ".join(type(one).__name__ for one in piece) if isinstance(piece, tuple) else None
            raise self._refused(f"gave ({gave or type(piece).__name__}), expected (Events, Triggers)")
        events, triggers = piece
        if not self._gives_bits and len(events) and events.p.max() > 1:
            raise self._refused(f"gave polarity {events.p.max()}, expected 0 or 1")
        return events, triggers

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """A plugin's source that fails is named; a fault of the SDK's own stays what it is."""
        try:
            yield
        except EvlcpError:
            raise
        except (Exception, SystemExit) as fault:
            if type(self).__module__.startswith("evlcp_sdk."):
                raise
            last = traceback.extract_tb(fault.__traceback__)[-1]
            what = f"{type(fault).__name__}: {fault}".splitlines()[0]
            raise self._refused(f"{what} ({Path(last.filename).name}, line {last.lineno})") from fault

    def _refused(self, what: str) -> PluginError:
        return PluginError(f"{self.path}: source {type(self).__name__}: {what}")

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
        pieces = list(self.stream(1 << 20))
        return Events.concat(e for e, _ in pieces), Triggers.concat(g for _, g in pieces)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        # What went wrong before says more than a source that cannot be closed after it.
        with nullcontext() if error is None else suppress(PluginError), self._guarded():
            self.close()
