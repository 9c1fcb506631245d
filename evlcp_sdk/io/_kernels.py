"""Every kernel of `evlcp_sdk.io`; the words of a RAW file, the state of a decoder, and what it counts.

Indices that advance in a loop are `uintp`: numba then leaves out its test for negative indices. A word has
`size` bytes, and its type in the top 4 bits, which is 8 for TIME_HIGH in every encoding; `at` is the byte
offset of words[0]. In EVT2.1 `stride` words, two, go together, else one. If words are not `final`, a result
of -1 asks for more of them.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

# Word types of EVT3, the top 4 bits of 16: those with events or times, then all that exist; 1, 9, B, C and D
# are reserved.
EVT3_ADDR_Y: Final = 0x0
EVT3_ADDR_X: Final = 0x2
EVT3_VECT_BASE_X: Final = 0x3
EVT3_VECT_12: Final = 0x4
EVT3_VECT_8: Final = 0x5
EVT3_TIME_LOW: Final = 0x6
EVT3_TIME_HIGH: Final = 0x8
EVT3_EXT_TRIGGER: Final = 0xA
EVT3_TYPES: Final = 0b1100_0101_1111_1101  # bit by bit, from type 0

# Word types of EVT2, the top 4 bits of 32, likewise: 0, 1, 8, A, E and F exist.
EVT2_CD_ON: Final = 0x1
EVT2_TIME_HIGH: Final = 0x8
EVT2_EXT_TRIGGER: Final = 0xA
EVT2_TYPES: Final = 0b1100_0101_0000_0011

# Slots of a decoder's whole state, int64.
BASE: Final = 0  # EVT3: 2^24 a rollover; EVT2: 2^34; UNKNOWN_TIME before the first TIME_HIGH, us
LAST: Final = 1  # time of the last event or trigger decoded, us
PACKED: Final = 2  # EVT3 only, as all to VECTOR_AT: the last event with its time and row, see below
COLUMN: Final = 3  # where the next vector word starts, or UNKNOWN_COLUMN or more
POLARITY: Final = 4  # of the last VECT_BASE_X
VECTOR_LEFT: Final = 5  # vector words still to come after the last VECT_BASE_X
VECTOR_AT: Final = 6  # byte offset of that VECT_BASE_X
UNCONFIRMED: Final = 7  # both: 1 after a TIME_HIGH that is not confirmed
ALIGNED_UNTIL: Final = 8  # both: words before this byte offset are known to be aligned
HIGH: Final = 9  # both: the last confirmed TIME_HIGH
STATE_SLOTS: Final = 10

# A step of TIME_HIGH by more than one is confirmed unless most of the next `FOLLOWERS` in so many bytes are
# still on the clock before it. A step back by up to `NEAR_US` is an early word, not another clock; one by up
# to `REPEAT_US` that is confirmed starts a block that comes twice, unless the clock restarts near 0.
FOLLOWERS: Final = 3
LOOKAHEAD_BYTES: Final = 1 << 18
NEAR_US: Final = 10_000
REPEAT_US: Final = 100_000

# After missing bytes all words are misaligned. Of aligned words none is of a reserved type, of others a
# third. Of `ALIGNMENT_WORDS` at least `ALIGNMENT_RESERVED` have to be reserved, eight times as many as from
# another first byte on, from which times have to step by less than `MAX_STEP_US`. Aligned words are checked
# again after `ALIGNED_WORDS`, uncertain ones after `RECHECK_WORDS`, and at any TIME_HIGH that does not step
# by one.
ALIGNMENT_WORDS: Final = 256
ALIGNMENT_RESERVED: Final = 8
MAX_STEP_US: Final = 1_000_000
ALIGNED_WORDS: Final = 64
RECHECK_WORDS: Final = 8

UNKNOWN_TIME: Final = -1
UNKNOWN_ROW: Final = 0x8000
UNKNOWN_COLUMN: Final = 0x7000

# An EVT3 event in one integer: the words that it comes from side by side, types and all, so that a word is
# put in its place as it is. What of a vector's column exceeds 11 bits is in place of the type, with the type.
PACKED_COLUMN: Final = 0  # ADDR_X: 11 bits, then the polarity, then the type
PACKED_POLARITY: Final = 11
PACKED_CARRY: Final = 12
PACKED_ROW: Final = 16  # ADDR_Y, of which bit 11 means nothing; its type is 0, with UNKNOWN_ROW 8
PACKED_LOW: Final = 32  # TIME_LOW
PACKED_TIME: Final = EVT3_TIME_LOW << 12  # what its type adds to the time

# Rows of a decoder's tally, int64 (rows, 2): how many, and the byte offset of the first.
BEFORE_TIME: Final = 0
TIME_GLITCH: Final = 1
TIME_BACKWARD: Final = 2
OUTSIDE_SENSOR: Final = 3
ROW_UNKNOWN: Final = 4
COLUMN_UNKNOWN: Final = 5
VECTOR_CUT: Final = 6
RESERVED: Final = 7
ODD_BYTES: Final = 8
HEADER_OPEN: Final = 9
ROLLOVERS: Final = 10
TIME_GAPS: Final = 11
OTHER_WORDS: Final = 12
TIME_DOUBTFUL: Final = 13
REALIGNED: Final = 14
TALLY_ROWS: Final = 15

Column = NDArray[Any]
EventColumns = tuple[Column, Column, Column, Column]
"""t (int64), x and y (uint16), p (uint8), of one length."""
TriggerColumns = tuple[Column, Column, Column]
"""Times (int64), channels and values (uint8), of one length."""
Integer = Any  # int to Python, int64 to numba
int64: Any = np.int64
uint16: Any = np.uint16
uint32: Any = np.uint32
uintp: Any = np.uintp
ONE = uintp(1)

# By the bytes of a word: how many bits of the time are below TIME_HIGH, and the types that exist.
LOW_BITS = np.array([0, 0, 12, 0, 6])
TYPES = np.array([0, 0, EVT3_TYPES, 0, EVT2_TYPES])

BLOCK_WORDS = 4096
BURST = 12
RUN_WORDS = uintp(32)
VECTOR_WORDS = uintp(4)
VECTOR_COLUMNS = 32

# How a word of the three types that make up most of a file changes the packed event: what to keep and where
# to put it.
COMMON = 1 << EVT3_ADDR_Y | 1 << EVT3_ADDR_X | 1 << EVT3_TIME_LOW
KEEP = np.full(16, -1)
SHIFT = np.zeros(16, np.uint8)
EVENTS = np.zeros(16, np.uint8)
EVENTS[EVT3_ADDR_X] = 1
KEEP[EVT3_ADDR_Y], SHIFT[EVT3_ADDR_Y] = ~(0xFFFF << PACKED_ROW), PACKED_ROW
KEEP[EVT3_ADDR_X], SHIFT[EVT3_ADDR_X] = ~(0xFFFF << PACKED_COLUMN), PACKED_COLUMN
KEEP[EVT3_TIME_LOW], SHIFT[EVT3_TIME_LOW] = ~(0xFFFF << PACKED_LOW), PACKED_LOW

# Which bits of a byte are set, then which are not, and how many are.
BITS = np.argsort(1 - (np.arange(256)[:, None] >> np.arange(8) & 1), axis=1, kind="stable").astype(np.uint8)
BIT_COUNT = (np.arange(256)[:, None] >> np.arange(8) & 1).sum(axis=1).astype(np.uint8)


@njit
def _count_loss(tally: Column, row: Integer, at: Integer) -> None:
    if tally[row, 0] == 0:
        tally[row, 1] = at
    tally[row, 0] += 1


@njit
def _find_loss(is_doubtful: Any, is_outside: Any, is_backward: Any) -> Integer:
    """Return the row of the tally for an event or trigger that is dropped, or -1."""
    if is_doubtful:
        return int64(TIME_DOUBTFUL)
    if is_outside:
        return int64(OUTSIDE_SENSOR)
    return int64(TIME_BACKWARD) if is_backward else int64(-1)


@njit
def _confirm_time(
    words: Column, i: Integer, size: Integer, stride: Integer, before: Integer, final: Any
) -> Integer:
    """Check words[i], a TIME_HIGH that comes after `before`, by those that follow it.

    Returns 2 for early or repeated, 1 for confirmed, 0 for not, -1.
    """
    shift, low_bits = 8 * size - 4, LOW_BITS[size]
    ring = (int64(1) << shift) - 1
    high = int64(words[i]) & ring
    step = (high - before) & ring
    if step <= 1:
        return int64(1)
    back_us = (ring + 1 - step) << low_bits
    if back_us <= NEAR_US:
        return int64(2)
    # After a short step the next but one is past it in any case.
    most = FOLLOWERS if step > FOLLOWERS else 1
    agree = against = 0
    end = i + 1 + LOOKAHEAD_BYTES // size
    for k in range(i + stride, min(end, len(words)), stride):
        w = int64(words[k])
        if w >> shift != 8:
            continue
        if ((w & ring) - before) & ring < step:
            against += 1
        else:
            agree += 1
        if 2 * max(agree, against) > most:
            break
    else:
        if not final and end > len(words):
            return int64(-1)
    if agree < against:
        return int64(0)
    return int64(2) if back_us <= REPEAT_US and high << low_bits > NEAR_US else int64(1)


@njit
def _read_word_at(words: Column, i: Integer, size: Integer, shift: Integer) -> Integer:
    """Return the word that starts `shift` bytes after the start of words[i]."""
    i, shift = i + shift // size, shift % size
    word = int64(words[i]) >> (8 * shift)
    if shift:
        word |= (int64(words[i + 1]) << (8 * (size - shift))) & ((int64(1) << (8 * size)) - 1)
    return word


@njit
def _find_misalignment(
    words: Column, i: Integer, at: Integer, size: Integer, stride: Integer, state: Column, final: Any
) -> Integer:
    """Return how many bytes after words[i], an unexpected one, aligned words start.

    Returns 0 if the words are aligned, or it cannot be told; or -1.
    """
    if at + size * i < state[ALIGNED_UNTIL] and int64(words[i]) >> (8 * size - 4) != 8:
        return int64(0)
    # One word more, as a word may start in one and end in the next.
    checked = stride * (ALIGNMENT_WORDS + 1)
    if i + checked > len(words):
        return int64(0) if final else int64(-1)
    top = 8 * size - 4
    low_bits, types = LOW_BITS[size], TYPES[size]
    shift, fewest, most, here = int64(0), int64(ALIGNMENT_WORDS), int64(0), int64(0)
    for s in range(size * stride):
        reserved = times = int64(0)
        for k in range(i, i + checked - stride, stride):
            kind = _read_word_at(words, k, size, s) >> top
            reserved += 1 - ((types >> kind) & 1)
            times += kind == 8
        if s == 0:
            here = reserved
        elif reserved < fewest or (reserved == fewest and times > most):
            # In EVT2.1 the lowest bits of a column are 0, as is a type that exists.
            shift, fewest, most = int64(s), reserved, times
    if here >= ALIGNMENT_RESERVED and 8 * fewest < here:
        ring = (int64(1) << top) - 1
        before = int64(-1)
        stop = i + LOOKAHEAD_BYTES // size
        for k in range(i, min(stop, len(words) - stride), stride):
            word = _read_word_at(words, k, size, shift)
            if word >> top != 8:
                continue
            if before >= 0:
                if ((word - before) & ring) << low_bits <= MAX_STEP_US:
                    return shift
                break
            before = word & ring
        else:
            if stop <= len(words) - stride or final:
                return shift
            return int64(-1)
    # The first words may be aligned, and bytes be missing soon.
    until = i + stride * (RECHECK_WORDS if here >= ALIGNMENT_RESERVED else ALIGNED_WORDS)
    state[ALIGNED_UNTIL] = at + size * until
    return int64(0)


@njit
def _pack_evt3(
    words: Column,
    start: Integer,
    stop: Integer,
    at: Integer,
    state: Column,
    tally: Column,
    packed: Column,
    first: Integer,
) -> tuple[Integer, Integer]:
    """Decode words start..stop to packed events, unchecked, while they are events or times below TIME_HIGH.

    A TIME_HIGH may only repeat the last one, if that is confirmed. Decoding stops also where `packed`, filled
    from `first` on, may have no room for another word's events; after the last one it has garbage. Returns
    where decoding stopped and where the events end.
    """
    event, column, polarity = state[PACKED], state[COLUMN], state[POLARITY]
    high = int64(-1) if state[UNCONFIRMED] else state[HIGH]
    left, vector_at = state[VECTOR_LEFT], state[VECTOR_AT]
    i, end, n, room = uintp(start), uintp(stop), uintp(first), uintp(len(packed))
    odd_until = i
    while i < end and n + uintp(BURST) <= room:
        if i >= odd_until and i + RUN_WORDS <= end and n + RUN_WORDS <= room:
            # Which of the three types comes cannot be predicted, so nothing branches on it: each word changes
            # the packed event and writes it, and only an ADDR_X moves on.
            odd = uint16(0)
            for k in range(RUN_WORDS):
                w = words[i + k]
                # Types 0, 2 and 6 are those below 8 that are even and not 4.
                odd = max(odd, uint16((w >> 12) & 9), uint16((w >> 13) & 3 == 2))
            if odd == 0:
                for k in range(RUN_WORDS):
                    w = int64(words[i + k])
                    kind = uintp(w >> 12)
                    event = (event & KEEP[kind]) | (w << SHIFT[kind])
                    packed[n] = event
                    n += uintp(EVENTS[kind])
                i += RUN_WORDS
                continue
            odd_until = i + RUN_WORDS
        w = int64(words[i])
        kind = uintp(w >> 12)
        if (COMMON >> kind) & 1:
            event = (event & KEEP[kind]) | (w << SHIFT[kind])
            packed[n] = event
            n += uintp(EVENTS[kind])
        elif kind == EVT3_VECT_BASE_X:
            if left:
                _count_loss(tally, int64(VECTOR_CUT), vector_at)
            column = w & 0x7FF
            polarity = (w >> 11) & 1
            left = 3
            vector_at = at + 2 * int64(i)
            if (
                column + VECTOR_COLUMNS <= 0x800
                and i + VECTOR_WORDS <= end
                and n + uintp(VECTOR_COLUMNS + 8) <= room
                and words[i + ONE] >> 12 == EVT3_VECT_12
                and words[i + ONE + ONE] >> 12 == EVT3_VECT_12
                and words[i + ONE + ONE + ONE] >> 12 == EVT3_VECT_8
            ):
                # A whole vector, a byte at a time: eight events are written, only set bits move on.
                mask = int64(words[i + ONE]) & 0xFFF
                mask |= (int64(words[i + ONE + ONE]) & 0xFFF) << 12
                mask |= (int64(words[i + ONE + ONE + ONE]) & 0xFF) << 24
                rest = (event & KEEP[EVT3_ADDR_X]) | EVT3_ADDR_X << PACKED_CARRY | (w & 0xFFF)
                for _ in range(4):
                    byte = uintp(mask & 0xFF)
                    for k in range(uintp(8)):
                        packed[n + k] = rest + int64(BITS[byte, k])
                    n += uintp(BIT_COUNT[byte])
                    rest += 8
                    mask >>= 8
                column += VECTOR_COLUMNS
                left = 0
                i += VECTOR_WORDS
                continue
        elif kind in (EVT3_VECT_12, EVT3_VECT_8):
            size = 12 if kind == EVT3_VECT_12 else 8
            mask = w & ((1 << size) - 1)
            rest = (event & KEEP[EVT3_ADDR_X]) | polarity << PACKED_POLARITY
            k = column
            while mask:
                packed[n] = rest | (k & 0x7FF) | (k >> 11 ^ EVT3_ADDR_X) << PACKED_CARRY
                n += uintp(mask & 1)
                mask >>= 1
                k += 1
            column = min(column + size, UNKNOWN_COLUMN)
            left = max(left - 1, 0) if size == 12 else 0
        elif kind != EVT3_TIME_HIGH or w & 0xFFF != high:
            break
        i += ONE
    state[PACKED], state[COLUMN], state[POLARITY] = event, column, polarity
    state[VECTOR_LEFT], state[VECTOR_AT] = left, vector_at
    return int64(i), int64(n)


@njit
def _unpack_evt3(
    base: Integer, events: EventColumns, part: tuple[Integer, Integer], size_px: Any, last: Integer
) -> Any:
    """Unpack a part of the events, packed in their column of times; TIME_LOW counts from `base`.

    Returns whether all of them are on the sensor and none is earlier than the one before.
    """
    t, x, y, p = events
    width, height = size_px
    start, end = uintp(part[0]), uintp(part[1])
    origin = base - PACKED_TIME
    for k in range(start, end):
        e = t[k]
        t[k] = origin + (e >> PACKED_LOW)
        y[k] = uint16(e >> PACKED_ROW) & uint16(0x87FF)
        x[k] = uint16(e)
    # Short loops over small numbers become vector instructions.
    for k in range(start, end):
        w = x[k] ^ uint16(EVT3_ADDR_X << PACKED_CARRY)
        p[k] = (w >> PACKED_POLARITY) & 1
        x[k] = uint16((w & uint16(0x7FF)) | ((w >> 1) & uint16(0x7800)))
    right = bottom = uint16(0)
    for k in range(start, end):
        right = max(right, x[k])
    for k in range(start, end):
        bottom = max(bottom, y[k])
    back = t[start] - last if start < end else int64(0)
    for k in range(start + ONE, end):
        # Any step back sets the sign.
        back |= t[k] - t[k - ONE]
    return (right < width and bottom < height and back >= 0) or start == end


@njit
def _drop_invalid(
    words: Column,
    word: Integer,
    at: Integer,
    events: EventColumns,
    part: tuple[Integer, Integer],
    size_px: Any,
    last: Integer,
    tally: Column,
) -> Integer:
    """Drop and count invalid events of a part, which starts at words[word]; return the new end."""
    t, x, y, p = events
    width, height = size_px
    start, stop = part
    n = start
    for k in range(start, stop):
        if y[k] == UNKNOWN_ROW:
            row = ROW_UNKNOWN
        elif x[k] >= UNKNOWN_COLUMN:
            row = COLUMN_UNKNOWN
        elif x[k] >= width or y[k] >= height:
            row = OUTSIDE_SENSOR
        elif t[k] < last:
            row = TIME_BACKWARD
        else:
            t[n], x[n], y[n], p[n] = t[k], x[k], y[k], p[k]
            last = t[k]
            n += 1
            continue
        first = at
        if tally[row, 0] == 0:
            first += 2 * _find_event_word(words, word, k - start)
        _count_loss(tally, int64(row), int64(first))
    return n


@njit
def _find_event_word(words: Column, word: Integer, event: Integer) -> Integer:
    """Return the index of the word of the `event`-th event from words[word] on."""
    while True:
        w = int64(words[word])
        kind = w >> 12
        bits = int64(0)
        if kind == EVT3_ADDR_X:
            bits = int64(1)
        elif kind == EVT3_VECT_12:
            bits = w & 0xFFF
        elif kind == EVT3_VECT_8:
            bits = w & 0xFF
        while bits:
            event -= bits & 1
            bits >>= 1
        if event < 0:
            return word
        word += 1


@njit
def _advance_time(
    words: Column,
    i: Integer,
    at: Integer,
    size: Integer,
    stride: Integer,
    state: Column,
    tally: Column,
    final: Any,
) -> Integer:
    """Advance the clock by words[i], a TIME_HIGH, if those that follow it confirm it.

    Returns 0; or how many bytes after it aligned words start, if these are not; or -1.
    """
    low_bits = LOW_BITS[size]
    ring = (int64(1) << (8 * size - 4)) - 1
    high, before, here = int64(words[i]) & ring, state[HIGH], at + size * i
    step = (high - before) & ring
    if step > 1:
        askew = _find_misalignment(words, i, at, size, stride, state, final)
        if askew:
            return askew
    verdict = _confirm_time(words, i, size, stride, before, final)
    if verdict < 0:
        return int64(-1)
    state[UNCONFIRMED] = int64(verdict == 0)
    if verdict != 1:
        _count_loss(tally, int64(TIME_GLITCH), here)
    if verdict == 1 and high < before:
        _count_loss(tally, int64(ROLLOVERS), here)
        state[BASE] += (ring + 1) << low_bits
    if verdict == 1 and step > 1 and size == 2:
        # EVT2 needs no TIME_HIGH without events.
        _count_loss(tally, int64(TIME_GAPS), here)
    if verdict == 2 and high > before:
        state[BASE] -= (ring + 1) << low_bits
    if verdict:
        state[HIGH] = high
    return int64(0)


@njit
def decode_evt3(
    words: Column,
    place: tuple[Integer, Any, Integer, Integer],
    size_px: tuple[Integer, Integer],
    state: Column,
    tally: Column,
    events: EventColumns,
    triggers: TriggerColumns,
    filled: tuple[Integer, Integer],
) -> tuple[Integer, Integer, Integer, Integer]:
    """Decode EVT3 words until they run out, or the columns' room for 12 events or for a trigger does.

    Args:
        words: uint16 (k,).
        place: Byte offset of words[0] in the file, and whether these are the last words. If not, decoding may
            stop before a TIME_HIGH that the next `LOOKAHEAD_BYTES` have to confirm. Then `Codec.stride` and
            `Codec.head`.
        size_px: Columns and rows of the sensor; events beyond are dropped and counted.
        state: int64 (STATE_SLOTS,), passed from call to call.
        tally: int64 (TALLY_ROWS, 2), added to.
        events: Columns to fill, of 12 or more.
        triggers: Columns to fill.
        filled: Events and triggers already in the columns.

    Returns:
        Words used, events and triggers now in the columns, and how many bytes to skip to aligned words.
    """
    at, final = place[0], place[1]
    t, trigger_t, channel, value = events[0], triggers[0], triggers[1], triggers[2]
    n, m = filled
    i = 0
    if state[BASE] < 0:
        while i < len(words) and words[i] >> 12 != EVT3_TIME_HIGH:
            _count_loss(tally, int64(BEFORE_TIME), at + 2 * i)
            i += 1
        if i < len(words):
            state[BASE] = 0
            state[HIGH] = int64(words[i]) & 0xFFF
            i += 1
    askew = int64(0)
    while i < len(words) and n <= len(t) - BURST and m < len(trigger_t):
        start, first = i, n
        stop = i + min(len(words) - i, BLOCK_WORDS)
        i, n = _pack_evt3(words, start, stop, at, state, tally, t, n)
        is_full = n > len(t) - BURST
        base = state[BASE] + (state[HIGH] << 12)
        if state[UNCONFIRMED]:
            # These events have no time.
            if n > first and tally[TIME_DOUBTFUL, 0] == 0:
                tally[TIME_DOUBTFUL, 1] = at + 2 * _find_event_word(words, start, int64(0))
            tally[TIME_DOUBTFUL, 0] += n - first
            n = first
        elif not _unpack_evt3(base, events, (first, n), size_px, state[LAST]):
            n = _drop_invalid(words, start, at, events, (first, n), size_px, state[LAST], tally)
        if n > first:
            state[LAST] = t[n - 1]
        if i == stop or is_full:
            continue
        w = int64(words[i])
        kind = w >> 12
        if kind == EVT3_TIME_HIGH:
            before = state[HIGH]
            askew = _advance_time(words, i, at, int64(2), int64(1), state, tally, final)
            if askew:
                break
            if state[HIGH] != before:
                state[PACKED] = (state[PACKED] & KEEP[EVT3_TIME_LOW]) | PACKED_TIME << PACKED_LOW
        elif kind == EVT3_EXT_TRIGGER:
            clock = base - PACKED_TIME + (state[PACKED] >> PACKED_LOW)
            loss = _find_loss(state[UNCONFIRMED], False, clock < state[LAST])
            if loss >= 0:
                _count_loss(tally, loss, at + 2 * i)
            else:
                trigger_t[m], channel[m], value[m] = clock, (w >> 8) & 0xF, w & 1
                state[LAST] = clock
                m += 1
        elif (EVT3_TYPES >> kind) & 1:
            _count_loss(tally, int64(OTHER_WORDS), at + 2 * i)
        else:
            askew = _find_misalignment(words, i, at, int64(2), int64(1), state, final)
            if askew:
                break
            _count_loss(tally, int64(RESERVED), at + 2 * i)
        i += 1
    return i, n, m, max(askew, int64(0))


@njit
def decode_evt2(
    words: Column,
    place: tuple[Integer, Any, Integer, Integer],
    size_px: tuple[Integer, Integer],
    state: Column,
    tally: Column,
    events: EventColumns,
    triggers: TriggerColumns,
    filled: tuple[Integer, Integer],
) -> tuple[Integer, Integer, Integer, Integer]:
    """Decode words of EVT2 or EVT2.1 (uint32) until they or the columns' room run out; as `decode_evt3`.

    In EVT2.1 each word has a second one, whose bits mean events in this column and the next 31.
    """
    at, final, stride, head = place
    width, height = size_px
    t, x, y, p = events
    trigger_t, channel, value = triggers
    n, m = filled
    base, last, unconfirmed = state[BASE] + (state[HIGH] << 6), state[LAST], state[UNCONFIRMED]
    askew = int64(0)
    i = head
    while i + stride - head <= len(words) and n + VECTOR_COLUMNS <= len(t) and m < len(trigger_t):
        w = int64(words[i])
        kind = w >> 28
        here = at + 4 * i
        clock = base + ((w >> 22) & 0x3F)
        column = (w >> 11) & 0x7FF
        row = w & 0x7FF
        if kind == EVT2_TIME_HIGH:
            if state[BASE] < 0:
                state[BASE], state[HIGH] = 0, w & 0xFFFFFFF
            else:
                askew = _advance_time(words, i, at, int64(4), stride, state, tally, final)
                if askew:
                    break
            base, unconfirmed = state[BASE] + (state[HIGH] << 6), state[UNCONFIRMED]
        elif state[BASE] < 0:
            _count_loss(tally, int64(BEFORE_TIME), here)
        elif kind <= EVT2_CD_ON or kind == EVT2_EXT_TRIGGER:
            is_event = kind <= EVT2_CD_ON
            mask = int64(words[i + 1 - 2 * head]) if stride == 2 and is_event else int64(1)
            while mask:
                is_outside = is_event and (column >= width or row >= height)
                loss = _find_loss(unconfirmed, is_outside, clock < last)
                if not mask & 1:
                    pass
                elif loss >= 0:
                    _count_loss(tally, loss, here)
                elif is_event:
                    t[n], x[n], y[n], p[n] = clock, column, row, kind
                    last = clock
                    n += 1
                else:
                    trigger_t[m], channel[m], value[m] = clock, (w >> 8) & 0x1F, w & 1
                    last = clock
                    m += 1
                mask >>= 1
                column += 1
        elif (EVT2_TYPES >> kind) & 1:
            _count_loss(tally, int64(OTHER_WORDS), here)
        else:
            askew = _find_misalignment(words, i, at, int64(4), stride, state, final)
            if askew:
                break
            _count_loss(tally, int64(RESERVED), here)
        i += stride
    state[LAST] = last
    return i - head, n, m, max(askew, int64(0))


@njit
def encode_evt3(
    words: Column,
    state: Column,
    events: EventColumns,
    i: Integer,
    triggers: TriggerColumns,
    j: Integer,
) -> tuple[Integer, Integer, Integer]:
    """Encode the events from i and the triggers from j on, by time, until they or `words` run out.

    Args:
        words: uint16 (k,) to fill; k >= 4.
        state: int64 (3,), passed from call to call: the number of the last TIME_HIGH, the last TIME_LOW
            and the last ADDR_Y, each -1 if there was none.
        events: Their columns, sorted by time.
        i: First event to encode.
        triggers: Their columns, likewise.
        j: First trigger to encode.

    Returns:
        Words written, the events and the triggers done.
    """
    t, x, y, p = events
    trigger_t, channel, value = triggers
    step, low, row = state[0], state[1], state[2]
    n = 0
    while (i < len(t) or j < len(trigger_t)) and n <= len(words) - 4:
        is_trigger = j < len(trigger_t) and (i == len(t) or trigger_t[j] <= t[i])
        clock = trigger_t[j] if is_trigger else t[i]
        stepped = step < clock >> 12
        if stepped:
            step += 1
            words[n] = EVT3_TIME_HIGH << 12 | (step & 0xFFF)
            n += 1
        due = clock & 0xFFF if step == clock >> 12 else 0
        if stepped or low != due:
            low = due
            row = -1
            words[n] = EVT3_TIME_LOW << 12 | low
            n += 1
        if step < clock >> 12:
            continue
        if is_trigger:
            words[n] = EVT3_EXT_TRIGGER << 12 | int64(channel[j]) << 8 | value[j]
            n += 1
            j += 1
            continue
        if row != y[i]:
            row = int64(y[i])
            words[n] = EVT3_ADDR_Y << 12 | row
            n += 1
        words[n] = EVT3_ADDR_X << 12 | int64(p[i]) << 11 | x[i]
        n += 1
        i += 1
    state[0], state[1], state[2] = step, low, row
    return n, i, j
