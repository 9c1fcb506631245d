"""How events become words and words events: what EVT2 and EVT3 share, without any file."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.io import _words
from evlcp_sdk.plugin.source import Loss
from evlcp_sdk.values import Events, Triggers

MAX_SIDE = 2048
"""Columns and rows that 11 bits can address."""


NO_TRIGGERS = Triggers.empty()


@dataclass(frozen=True)
class Codec:
    """One encoding of events in words.

    Attributes:
        name: As after `% format`.
        version: As after `% evt`.
        word: Type of a word, little-endian.
        burst: Most events that one word may bring.
        types: The word types that exist; the top 4 bits of a word.
        channels: Trigger inputs that a word can name.
        time_bits: Bits of TIME_HIGH, and of the time below it.
        rollover: Words with which the clock rolls over once and stands at 0, in steps that are believed.
        decoder: Name of its decoding kernel in `evlcp_sdk.io._kernels`.
        encoder: Name of its encoding kernel there.
    """

    name: str
    version: str
    word: np.dtype[Any]
    burst: int
    types: frozenset[int]
    channels: int
    time_bits: tuple[int, int]
    rollover: tuple[int, ...]
    decoder: str
    encoder: str

    def kernel(self, name: str) -> Callable[..., Any]:
        """Return a kernel; compiles it, or loads it from the cache, when first called."""
        kernel: Callable[..., Any] = getattr(importlib.import_module("evlcp_sdk.io._kernels"), name)
        return kernel

    def prelude(self, first_us: int) -> tuple[NDArray[Any], int]:
        """Return the words before a first time, and the number of the TIME_HIGH that they end with."""
        high, low = self.time_bits
        rollovers, step = divmod(first_us >> low, 1 << high)
        # A third of the range at a time: a longer step would look like one back.
        third = len(self.rollover) // 5
        way = self.rollover[: third * (3 * step >> high)] if rollovers else ()
        return np.array(self.rollover * rollovers + way, self.word), (first_us >> low) - 1

    def reserved(self, words: NDArray[Any]) -> NDArray[np.bool_]:
        """Return which of `words` are of a type that does not exist."""
        return np.isin(words >> (8 * self.word.itemsize - 4), list(self.types), invert=True)


class Columns:
    """Room for events and triggers, filled from the front by a decoder."""

    def __init__(self, events: int, triggers: int) -> None:
        self.events = 0
        self.triggers = 0
        self.t_us = np.empty(events, np.int64)
        self.x = np.empty(events, np.uint16)
        self.y = np.empty(events, np.uint16)
        self.p = np.empty(events, np.uint8)
        self.trigger_t_us = np.empty(triggers, np.int64)
        self.channel = np.empty(triggers, np.uint8)
        self.value = np.empty(triggers, np.uint8)

    def taken(self) -> tuple[Events, Triggers]:
        """Return what is filled, as views; as copies where it is little, so as not to hold all the room."""
        n, m = self.events, self.triggers
        columns = self.t_us[:n], self.x[:n], self.y[:n], self.p[:n]
        if 2 * n < len(self.t_us):
            columns = columns[0].copy(), columns[1].copy(), columns[2].copy(), columns[3].copy()
        if not m:
            return Events.as_is(*columns), NO_TRIGGERS
        return Events.as_is(*columns), Triggers(self.trigger_t_us[:m], self.channel[:m], self.value[:m])


class Decoder:
    """The state of decoding one stream of words; the same for every split of the stream.

    Args:
        codec: The encoding.
        width: Columns of the sensor; None accepts all that 11 bits can say.
        height: Rows of the sensor, likewise.
    """

    def __init__(self, codec: Codec, width: int | None, height: int | None) -> None:
        self.codec = codec
        self._bounds = (width or MAX_SIDE, height or MAX_SIDE)
        self._state = np.zeros(_words.STATE_SLOTS, np.int64)
        self._state[_words.BASE] = _words.UNKNOWN_TIME
        self._state[_words.PACKED] = (
            _words.PACKED_TIME << _words.PACKED_LOW | _words.UNKNOWN_ROW << _words.PACKED_ROW
        )
        self._state[_words.COLUMN] = _words.UNKNOWN_COLUMN
        self._tally = np.zeros((_words.TALLY_ROWS, 2), np.int64)
        self._kernel = codec.kernel(codec.decoder)

    @property
    def has_time(self) -> bool:
        """Whether a TIME_HIGH has come by."""
        return bool(self._state[_words.BASE] != _words.UNKNOWN_TIME)

    def decode(self, words: NDArray[Any], at: int, out: Columns, final: bool) -> int:
        """Decode `words`, whose first is at byte `at`, behind what is in `out`; return the bytes used.

        It stops early when `out` has no room for another word's events (`codec.burst`) or trigger; and where
        it takes more words, up to `LOOK_BYTES`, to believe the time, unless these are the `final` ones; and
        where words do not go on behind the last one, but some bytes later, which are used, too.
        """
        used, out.events, out.triggers, askew = self._kernel(
            words,
            (at, final),
            self._bounds,
            self._state,
            self._tally,
            (out.t_us, out.x, out.y, out.p),
            (out.trigger_t_us, out.channel, out.value),
            (out.events, out.triggers),
        )
        return int(used * self.codec.word.itemsize + askew)

    def finish(self, at: int, odd_bytes: int) -> None:
        """Take note of how the stream ends: at byte `at`, with `odd_bytes` that make no word."""
        if odd_bytes:
            self.note(_words.ODD_BYTES, at, odd_bytes)
        if self._state[_words.VECTOR_LEFT]:
            self.note(_words.VECTOR_CUT, int(self._state[_words.VECTOR_AT]))
            self._state[_words.VECTOR_LEFT] = 0

    def note(self, row: int, at: int, count: int = 1) -> None:
        """Count a loss, at byte `at`."""
        if not self._tally[row, 0]:
            self._tally[row, 1] = at
        self._tally[row, 0] += count

    @property
    def losses(self) -> dict[str, Loss]:
        """As `EventSource.losses`."""
        return {
            name: Loss(int(count), int(first), "byte", meaning)
            for name, (row, meaning) in _words.LOSSES.items()
            for count, first in [self._tally[row]]
            if count
        }

    @property
    def counts(self) -> dict[str, int]:
        """The format's own part of `EventSource.counts`."""
        return {name: int(self._tally[row, 0]) for name, (row, _) in _words.COUNTS.items()}
