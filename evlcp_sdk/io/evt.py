"""Events as words: EVT2, 32 bits an event; EVT2.1, 64 for 32 columns; EVT3, 16 a change."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.io import _kernels
from evlcp_sdk.plugin.source import Loss
from evlcp_sdk.values import Events, Triggers

MAX_SIDE = 2048
"""Columns and rows that 11 bits can address."""

NO_TRIGGERS = Triggers.empty()

LOSSES: Final = {
    "words_before_time": (
        _kernels.BEFORE_TIME,
        "words before the first TIME_HIGH, which have no time; skipped",
    ),
    "time_glitches": (_kernels.TIME_GLITCH, "TIME_HIGH words that no others agree with, or that are early"),
    "time_doubtful": (
        _kernels.TIME_DOUBTFUL,
        "events and triggers behind a TIME_HIGH that no others agree with, or before the first one"
        " where words stood askew; dropped",
    ),
    "time_backward": (_kernels.TIME_BACKWARD, "events and triggers earlier than the one before; dropped"),
    "outside_sensor": (_kernels.OUTSIDE_SENSOR, "events outside the sensor; dropped"),
    "row_unknown": (_kernels.ROW_UNKNOWN, "events before the first ADDR_Y, which have no row; dropped"),
    "column_unknown": (
        _kernels.COLUMN_UNKNOWN,
        "vector events before the first VECT_BASE_X, which have no column; dropped",
    ),
    "vectors_cut": (
        _kernels.VECTOR_CUT,
        "vectors that are not whole (12 + 12 + 8 columns): words are missing",
    ),
    "reserved_words": (_kernels.RESERVED, "words of a reserved type; skipped"),
    "bytes_askew": (
        _kernels.REALIGNED,
        "bytes passed over where words stood askew, as bytes are missing there or too many",
    ),
    "odd_bytes": (_kernels.ODD_BYTES, "bytes at the end of the file that make no whole word; skipped"),
    "header_without_end": (
        _kernels.HEADER_OPEN,
        "header without '% end'; data taken to start at the first line without '% '",
    ),
}
"""Losses of a RAW file: name -> (row of the tally, meaning)."""

COUNTS: Final = {
    "rollovers": _kernels.ROLLOVERS,
    "time_gaps": _kernels.TIME_GAPS,
    "other_words": _kernels.OTHER_WORDS,
}
"""Counts that are no losses: rollovers of the clock, its steps by more than one, words without events."""


@dataclass(frozen=True)
class Codec:
    """One encoding of events in words.

    Attributes:
        name: Name after `% format`.
        version: Version after `% evt`.
        word: Type of a word, little-endian.
        stride: Words that go together: 2 in EVT2.1, else 1.
        head: Which of these has the type.
        burst: Room for events without which decoding stops: at least those of one word.
        types: Bit mask of the word types that exist; a type is the top 4 bits of a word.
        channels: Trigger inputs that a word can name.
        time_bits: Bits of TIME_HIGH, and of the time below it.
        rollover: Words that roll the clock over once, to 0, in steps that a decoder accepts.
        decoder: The decoding kernel.
        encoder: The encoding kernel; of EVT2.1 it encodes to EVT2.
    """

    name: str
    version: str
    word: np.dtype[Any]
    burst: int
    types: int
    channels: int
    time_bits: tuple[int, int]
    rollover: tuple[int, ...]
    decoder: Callable[..., Any]
    encoder: Callable[..., Any]
    stride: int = 1
    head: int = 0

    @property
    def size_bytes(self) -> int:
        """Bytes of the words that go together."""
        return self.word.itemsize * self.stride

    def encode_prelude(self, first_us: int) -> tuple[NDArray[Any], int]:
        """Return the words that set the clock before a first time, and the TIME_HIGH that they end with."""
        high, low = self.time_bits
        rollovers, step = divmod(first_us >> low, 1 << high)
        # A third of the range at a time: a longer step would read as one back.
        third = len(self.rollover) // 5
        partial = self.rollover[: third * (3 * step >> high)] if rollovers else ()
        return np.array(self.rollover * rollovers + partial, self.word), (first_us >> low) - 1


def encode_evt2(
    words: NDArray[np.uint32],
    state: NDArray[np.int64],
    events: _kernels.EventColumns,
    i: int,
    triggers: _kernels.TriggerColumns,
    j: int,
) -> tuple[int, int, int]:
    """Encode to EVT2 words as `encode_evt3` does; the state is only the last TIME_HIGH."""
    most = len(words) // 4
    t, x, y, p = (column[i : i + most].astype(np.int64) for column in events)
    trigger_t, channel, value = (column[j : j + most].astype(np.int64) for column in triggers)
    kinds = np.concatenate([_kernels.EVT2_EXT_TRIGGER << 28 | channel << 8 | value, p << 28 | x << 11 | y])
    times = np.concatenate([trigger_t, t])
    order = np.argsort(times, kind="stable")[:most]
    steps, low = np.divmod(times[order], 64)
    before = np.concatenate([state[:1], steps[:-1]])
    # After a longer step a rollover would read as a glitch.
    highs = np.where(before < 0, steps > before, -((before - steps) >> 26))
    ends = np.cumsum(highs + 1)
    rows = int(np.searchsorted(ends, len(words), "right"))
    n = int(ends[rows - 1])
    row = np.repeat(np.arange(rows), highs[:rows] + 1)
    nth = np.arange(n) - (ends - highs - 1)[row] + 1
    step = np.where(before[row] < 0, steps[row], np.minimum(before[row] + (nth << 26), steps[row]))
    words[:n] = _kernels.EVT2_TIME_HIGH << 28 | step & 0xFFFFFFF
    words[ends[:rows] - 1] = kinds[order[:rows]] | low[:rows] << 22
    state[0] = steps[rows - 1]
    done = int(np.count_nonzero(order[:rows] < len(trigger_t)))
    return n, i + rows - done, j + done


def add_columns(words: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return words of EVT2 as EVT2.1 of an IMX636, uint32 (n, 2): behind each its column's bit of 32."""
    is_event = words >> 28 <= _kernels.EVT2_CD_ON
    first = np.where(is_event, words & ~np.uint32(0x1F << 11), words)
    return np.stack([first, np.where(is_event, np.uint32(1) << (words >> 11 & 0x1F), np.uint32(0))], 1)


EVT2: Final = Codec(
    name="EVT2",
    version="2.0",
    word=np.dtype("<u4"),
    burst=_kernels.VECTOR_COLUMNS,
    types=_kernels.EVT2_TYPES,
    channels=32,
    time_bits=(28, 6),
    rollover=(0x85555555, 0x8AAAAAAA, 0x8FFFFFFF, 0x80000000, 0x80000000),
    decoder=_kernels.decode_evt2,
    encoder=encode_evt2,
)
"""t = rollovers * 2^34 + TIME_HIGH * 2^6 + the event's own 6 bits, us."""

EVT21: Final = replace(EVT2, name="EVT21", version="2.1", stride=2)
"""EVT2.1 as an IMX636 sends it: behind each word of EVT2 one with a bit for each column from there on."""

EVT21_LITTLE: Final = replace(EVT21, head=1)
"""EVT2.1 as a GenX320 sends it, one word of 64 bits: the columns come first. It is read only."""

EVT3: Final = Codec(
    name="EVT3",
    version="3.0",
    word=np.dtype("<u2"),
    burst=12,
    types=_kernels.EVT3_TYPES,
    channels=16,
    time_bits=(12, 12),
    rollover=(0x8555, 0x6000, 0x8AAA, 0x6000, 0x8FFF, 0x6000, 0x8000, 0x6000, 0x8000, 0x6000),
    decoder=_kernels.decode_evt3,
    encoder=_kernels.encode_evt3,
)
"""t = rollovers * 2^24 + TIME_HIGH * 2^12 + TIME_LOW, us."""


class EventBuffer:
    """Columns of events and triggers that a decoder fills from the front."""

    def __init__(self, events: int, triggers: int) -> None:
        self.events = self.triggers = 0
        self.room, self.trigger_room = events, triggers
        self.event_columns = tuple(np.empty(events, kind) for kind in ("i8", "u2", "u2", "u1"))
        self.trigger_columns = tuple(np.empty(triggers, kind) for kind in ("i8", "u1", "u1"))

    def get_filled(self) -> tuple[Events, Triggers]:
        """Return the events and triggers so far: views, or copies if they fill less than half of the room."""
        columns: Iterator[Any] = (column[: self.events] for column in self.event_columns)
        if 2 * self.events < self.room:
            columns = (column.copy() for column in columns)
        edges: Iterator[Any] = (column[: self.triggers] for column in self.trigger_columns)
        return Events.from_columns(*columns), Triggers(*edges) if self.triggers else NO_TRIGGERS


class Decoder:
    """Decodes one stream of words, however it is split.

    Args:
        codec: The encoding.
        width: Columns of the sensor; None accepts all that 11 bits can address.
        height: Rows of the sensor, likewise.
    """

    def __init__(self, codec: Codec, width: int | None, height: int | None) -> None:
        self.codec = codec
        self._bounds = (width or MAX_SIDE, height or MAX_SIDE)
        self._state = np.zeros(_kernels.STATE_SLOTS, np.int64)
        self._state[_kernels.BASE] = _kernels.UNKNOWN_TIME
        self._state[_kernels.PACKED] = _kernels.PACKED_TIME << _kernels.PACKED_LOW
        self._forget_position()
        self._tally = np.zeros((_kernels.TALLY_ROWS, 2), np.int64)

    def _forget_position(self) -> None:
        """Forget the row and column of the next event, which EVT3 has in earlier words."""
        packed = int(self._state[_kernels.PACKED]) & ~(0xFFFF << _kernels.PACKED_ROW)
        self._state[_kernels.PACKED] = packed | _kernels.UNKNOWN_ROW << _kernels.PACKED_ROW
        self._state[_kernels.COLUMN], self._state[_kernels.VECTOR_LEFT] = _kernels.UNKNOWN_COLUMN, 0

    @property
    def has_time(self) -> bool:
        """Whether a TIME_HIGH has been decoded."""
        return bool(self._state[_kernels.BASE] != _kernels.UNKNOWN_TIME)

    def decode(self, words: NDArray[Any], at: int, out: EventBuffer, final: bool) -> int:
        """Decode `words`, the first of which is at byte `at`, append to `out`, and return the bytes used.

        Decoding stops early where `out` has no room for another word's events (`codec.burst`) or trigger;
        where more words, up to `LOOKAHEAD_BYTES`, are needed to confirm the time, unless these are the
        `final` ones; and where words are misaligned: the bytes to skip then count as used.
        """
        used, out.events, out.triggers, askew = self.codec.decoder(
            words,
            (at, final, self.codec.stride, self.codec.head),
            self._bounds,
            self._state,
            self._tally,
            out.event_columns,
            out.trigger_columns,
            (out.events, out.triggers),
        )
        used = int(used) * self.codec.word.itemsize
        if askew:
            # Before the next TIME_HIGH there is no time.
            self.count_loss(_kernels.REALIGNED, at + used, int(askew))
            self._state[_kernels.UNCONFIRMED], self._state[_kernels.ALIGNED_UNTIL] = 1, at + used + askew
            self._forget_position()
        return used + int(askew)

    def finish(self, at: int, odd_bytes: int) -> None:
        """Count what is lost at the end of the stream, byte `at`, with `odd_bytes` that make no word."""
        if odd_bytes:
            self.count_loss(_kernels.ODD_BYTES, at, odd_bytes)
        if self._state[_kernels.VECTOR_LEFT]:
            self.count_loss(_kernels.VECTOR_CUT, int(self._state[_kernels.VECTOR_AT]))
            self._state[_kernels.VECTOR_LEFT] = 0

    def count_loss(self, row: int, at: int, count: int = 1) -> None:
        """Count a loss at byte `at`."""
        if not self._tally[row, 0]:
            self._tally[row, 1] = at
        self._tally[row, 0] += count

    @property
    def losses(self) -> dict[str, Loss]:
        """As `EventSource.losses`."""
        return {
            name: Loss(int(count), int(first), "byte", meaning)
            for name, (row, meaning) in LOSSES.items()
            for count, first in [self._tally[row]]
            if count
        }

    @property
    def counts(self) -> dict[str, int]:
        """The format's part of `EventSource.counts`."""
        return {name: int(self._tally[row, 0]) for name, row in COUNTS.items()}
