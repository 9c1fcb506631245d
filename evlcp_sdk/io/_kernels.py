"""Every numba kernel of `evlcp_sdk.io`; imported only when a file is decoded or encoded.

Indices that advance in a loop are `np.uintp`: numba then leaves out its test for negative indices.
"""

import numpy as np
from numba import njit

from evlcp_sdk.io._words import (
    BASE,
    BEFORE_TIME,
    COLUMN,
    COLUMN_UNKNOWN,
    EVT2_CD_ON,
    EVT2_CONTINUED,
    EVT2_EXT_TRIGGER,
    EVT2_OTHERS,
    EVT2_TIME_HIGH,
    EVT3_ADDR_X,
    EVT3_ADDR_Y,
    EVT3_CONTINUED_4,
    EVT3_CONTINUED_12,
    EVT3_EXT_TRIGGER,
    EVT3_OTHERS,
    EVT3_TIME_HIGH,
    EVT3_TIME_LOW,
    EVT3_VECT_8,
    EVT3_VECT_12,
    EVT3_VECT_BASE_X,
    LAST,
    LOW,
    OTHER_WORDS,
    OUTSIDE_SENSOR,
    POLARITY,
    RESERVED,
    ROLLOVERS,
    ROW,
    ROW_UNKNOWN,
    TIME_BACKWARD,
    TIME_GAPS,
    TIME_GLITCH,
    UNKNOWN_COLUMN,
    UNKNOWN_ROW,
    VECTOR_AT,
    VECTOR_CUT,
    VECTOR_LEFT,
)

__all__ = ["decode_evt2", "decode_evt3"]

ONE = np.uintp(1)
COMMON = 1 << EVT3_ADDR_Y | 1 << EVT3_ADDR_X | 1 << EVT3_TIME_LOW


@njit(cache=True, nogil=True)
def _note(tally, row, at):
    if tally[row, 0] == 0:
        tally[row, 1] = at
    tally[row, 0] += 1


@njit(cache=True, nogil=True)
def _next_base(base, high, high_bits, low_bits, at, tally):
    """Return the time of a TIME_HIGH word that differs from the one before, us."""
    before = (base >> low_bits) & ((1 << high_bits) - 1)
    step = high - before
    if step <= -(1 << (high_bits - 1)):
        base += 1 << (high_bits + low_bits)
        step += 1 << high_bits
        _note(tally, ROLLOVERS, at)
    if step < 0:
        _note(tally, TIME_GLITCH, at)
    elif step > 1:
        _note(tally, TIME_GAPS, at)
    return base + ((high - before) << low_bits)


@njit(cache=True, nogil=True)
def _sound(t, x, y, start, stop, width, height, last):
    """Whether all of the events start..stop are on the sensor and none is earlier than the one before."""
    if stop == start:
        return True
    first, end = np.uintp(start), np.uintp(stop)
    right = bottom = np.uint16(0)
    step = t[first] - last
    for k in range(first, end):
        right = max(right, x[k])
    for k in range(first, end):
        bottom = max(bottom, y[k])
    for k in range(first + ONE, end):
        step = min(step, t[k] - t[k - ONE])
    return right < width and bottom < height and step >= 0


@njit(cache=True, nogil=True)
def _sift(words, word, at, t, x, y, p, start, stop, width, height, last, tally):
    """Close up the events start..stop (from words[word] on) over those to drop; return the new end."""
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
            first += 2 * _word_of_event(words, word, k - start)
        _note(tally, row, first)
    return n


@njit(cache=True, nogil=True)
def _word_of_event(words, word, event):
    """Return the index of the word that brings an event, counted from words[word] on."""
    while True:
        w = np.int64(words[word])
        kind = w >> 12
        bits = 0
        if kind == EVT3_ADDR_X:
            bits = 1
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


@njit(cache=True, nogil=True)
def _decode_evt3_run(words, start, stop, at, state, tally, t, x, y, p, n):
    """Decode words start..stop without a check, up to the first that is neither an event nor a time.

    Returns where it stopped and the new number of events. The columns need room for 12 events a word.
    """
    base, low, row = state[BASE], state[LOW], state[ROW]
    column, polarity = state[COLUMN], state[POLARITY]
    left, vector_at = state[VECTOR_LEFT], state[VECTOR_AT]
    i, end, n = np.uintp(start), np.uintp(stop), np.uintp(n)
    while i < end:
        w = np.int64(words[i])
        kind = w >> 12
        if (COMMON >> kind) & 1:
            # Which of the three it is cannot be predicted, so there is no branch on it: every word is
            # written as an event, and only an ADDR_X moves on. Types 0, 2, 6 differ in bits 13 and 14.
            row ^= (row ^ (w & 0x7FF)) & (((w >> 13) & 1) - 1)
            low = w & 0xFFF if w & 0x4000 else low
            t[n] = base + low
            x[n] = w & 0x7FF
            y[n] = row
            p[n] = (w >> 11) & 1
            n += np.uintp((w & 0x6000) == 0x2000)
        elif kind == EVT3_VECT_12 or kind == EVT3_VECT_8:
            size = 12 if kind == EVT3_VECT_12 else 8
            mask = w & ((1 << size) - 1)
            k = column
            while mask:
                t[n] = base + low
                x[n] = k
                y[n] = row
                p[n] = polarity
                n += np.uintp(mask & 1)
                mask >>= 1
                k += 1
            column = min(column + size, UNKNOWN_COLUMN)
            left = max(left - 1, 0) if size == 12 else 0
        elif kind == EVT3_VECT_BASE_X:
            if left:
                _note(tally, VECTOR_CUT, vector_at)
            column = w & 0x7FF
            polarity = (w >> 11) & 1
            left = 3
            vector_at = at + 2 * np.int64(i)
        elif kind == EVT3_TIME_HIGH:
            if (base >> 12) & 0xFFF != w & 0xFFF:
                base = _next_base(base, w & 0xFFF, 12, 12, at + 2 * np.int64(i), tally)
                low = 0
        else:
            break
        i += ONE
    state[BASE], state[LOW], state[ROW] = base, low, row
    state[COLUMN], state[POLARITY] = column, polarity
    state[VECTOR_LEFT], state[VECTOR_AT] = left, vector_at
    return np.int64(i), np.int64(n)


@njit(cache=True, nogil=True)
def decode_evt3(words, at, width, height, state, tally, t, x, y, p, n, trigger_t, channel, value, m):
    """Decode EVT3 words until they or the columns' room run out.

    Args:
        words: uint16 (k,).
        at: Byte offset of words[0] in the file.
        width: Columns of the sensor; events beyond are dropped and counted.
        height: Rows of the sensor; likewise.
        state: int64 (STATE_SLOTS,), carried from call to call.
        tally: int64 (TALLY_ROWS, 2), added to.
        t: Column of events to fill, int64; so x, y (uint16), p (uint8), of one length of 12 or more.
        x: See t.
        y: See t.
        p: See t.
        n: Events already in the columns.
        trigger_t: Column of triggers to fill, int64; so channel, value (uint8).
        channel: See trigger_t.
        value: See trigger_t.
        m: Triggers already in the columns.

    Returns:
        Words used, events and triggers now in the columns.
    """
    i = 0
    if state[BASE] < 0:
        while i < len(words) and words[i] >> 12 != EVT3_TIME_HIGH:
            _note(tally, BEFORE_TIME, at + 2 * i)
            i += 1
        if i < len(words):
            state[BASE] = (np.int64(words[i]) & 0xFFF) << 12
            i += 1
    while i < len(words) and n <= len(t) - 12 and m < len(trigger_t):
        start, first = i, n
        stop = i + min(len(words) - i, (len(t) - n) // 12)
        i, n = _decode_evt3_run(words, start, stop, at, state, tally, t, x, y, p, n)
        if not _sound(t, x, y, first, n, width, height, state[LAST]):
            n = _sift(words, start, at, t, x, y, p, first, n, width, height, state[LAST], tally)
        if n > first:
            state[LAST] = t[n - 1]
        if i == stop:
            continue
        w = np.int64(words[i])
        kind = w >> 12
        if kind == EVT3_EXT_TRIGGER:
            clock = state[BASE] + state[LOW]
            if clock < state[LAST]:
                _note(tally, TIME_BACKWARD, at + 2 * i)
            else:
                trigger_t[m], channel[m], value[m] = clock, (w >> 8) & 0xF, w & 1
                state[LAST] = clock
                m += 1
        elif kind == EVT3_OTHERS or kind == EVT3_CONTINUED_4 or kind == EVT3_CONTINUED_12:
            _note(tally, OTHER_WORDS, at + 2 * i)
        else:
            _note(tally, RESERVED, at + 2 * i)
        i += 1
    return i, n, m


@njit(cache=True, nogil=True)
def decode_evt2(words, at, width, height, state, tally, t, x, y, p, n, trigger_t, channel, value, m):
    """Decode EVT2 words (uint32) until they or the columns' room run out; as `decode_evt3`."""
    base, last = state[BASE], state[LAST]
    i = 0
    while i < len(words) and n < len(t) and m < len(trigger_t):
        w = np.int64(words[i])
        kind = w >> 28
        here = at + 4 * i
        clock = base + ((w >> 22) & 0x3F)
        column = (w >> 11) & 0x7FF
        row = w & 0x7FF
        i += 1
        if kind == EVT2_TIME_HIGH:
            high = w & 0xFFFFFFF
            if base < 0:
                base = high << 6
            elif (base >> 6) & 0xFFFFFFF != high:
                base = _next_base(base, high, 28, 6, here, tally)
        elif base < 0:
            _note(tally, BEFORE_TIME, here)
        elif kind <= EVT2_CD_ON:
            if column >= width or row >= height:
                _note(tally, OUTSIDE_SENSOR, here)
            elif clock < last:
                _note(tally, TIME_BACKWARD, here)
            else:
                t[n], x[n], y[n], p[n] = clock, column, row, kind
                last = clock
                n += 1
        elif kind == EVT2_EXT_TRIGGER:
            if clock < last:
                _note(tally, TIME_BACKWARD, here)
            else:
                trigger_t[m], channel[m], value[m] = clock, (w >> 8) & 0x1F, w & 1
                last = clock
                m += 1
        elif kind == EVT2_OTHERS or kind == EVT2_CONTINUED:
            _note(tally, OTHER_WORDS, here)
        else:
            _note(tally, RESERVED, here)
    state[BASE], state[LAST] = base, last
    return i, n, m
