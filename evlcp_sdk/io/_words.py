"""What the words of a RAW file are, and what a decoder remembers and counts about them.

Plain integers, shared by the kernels and by the Python around them. The kernels keep the values they were
compiled with: after a change here touch `_kernels.py`, the only file whose age numba's cache looks at.
"""

from typing import Final

# Word types of EVT3, the top 4 bits of 16. 1, 9, B, C and D are reserved.
EVT3_ADDR_Y: Final = 0x0
EVT3_ADDR_X: Final = 0x2
EVT3_VECT_BASE_X: Final = 0x3
EVT3_VECT_12: Final = 0x4
EVT3_VECT_8: Final = 0x5
EVT3_TIME_LOW: Final = 0x6
EVT3_CONTINUED_4: Final = 0x7
EVT3_TIME_HIGH: Final = 0x8
EVT3_EXT_TRIGGER: Final = 0xA
EVT3_OTHERS: Final = 0xE
EVT3_CONTINUED_12: Final = 0xF
EVT3_TYPES: Final = 0b1100_0101_1111_1101  # bit by bit, from type 0

# Word types of EVT2, the top 4 bits of 32. All others are reserved.
EVT2_CD_OFF: Final = 0x0
EVT2_CD_ON: Final = 0x1
EVT2_TIME_HIGH: Final = 0x8
EVT2_EXT_TRIGGER: Final = 0xA
EVT2_OTHERS: Final = 0xE
EVT2_CONTINUED: Final = 0xF
EVT2_TYPES: Final = 0b1100_0101_0000_0011

# Slots of a decoder's state, int64. All of it; nothing else passes from one call to the next.
BASE: Final = 0  # EVT3: 2^24 a rollover; EVT2: 2^34; UNKNOWN_TIME before the first TIME_HIGH, us
LAST: Final = 1  # time of the last event or trigger given out, us
PACKED: Final = 2  # EVT3 only, as all to VECTOR_AT: the last event with its time and row, see below
COLUMN: Final = 3  # where the next vector word starts, or UNKNOWN_COLUMN or more
POLARITY: Final = 4  # of the last VECT_BASE_X
VECTOR_LEFT: Final = 5  # vector words still to come after the last VECT_BASE_X
VECTOR_AT: Final = 6  # byte offset of that VECT_BASE_X
DOUBT: Final = 7  # both: 1 behind a TIME_HIGH that is not believed
LEVEL: Final = 8  # both: words before this byte offset are known not to stand askew
HIGH: Final = 9  # both: the last TIME_HIGH that is believed
STATE_SLOTS: Final = 10

# A step of TIME_HIGH by more than one is believed unless most of the next `FOLLOWERS` in so many bytes are
# still on the clock before it. One back by up to `NEAR_US` is an early word, not another clock.
FOLLOWERS: Final = 3
LOOK_BYTES: Final = 1 << 18
NEAR_US: Final = 10_000

# Where bytes are missing, all words behind stand askew. Of words as they were sent none is of a reserved
# type, of others a third: so many words tell, if so many of them are reserved, and an eighth as many where
# others are taken for their starts; and if times then follow one another by less than `STRIDE_US`. What is
# found level is not looked at again for `LEVEL_WORDS`, where there is doubt for `SOON_WORDS`; but at any
# TIME_HIGH that does not go on by one.
TELLING_WORDS: Final = 256
TELLING_RESERVED: Final = 8
STRIDE_US: Final = 1_000_000
LEVEL_WORDS: Final = 64
SOON_WORDS: Final = 8

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

LOSSES: Final = {
    "words_before_time": (BEFORE_TIME, "words before the first TIME_HIGH, which have no time; skipped"),
    "time_glitches": (TIME_GLITCH, "TIME_HIGH words that no others agree with, or that are early"),
    "time_doubtful": (
        TIME_DOUBTFUL,
        "events and triggers behind a TIME_HIGH that no others agree with, or before the first one"
        " where words stood askew; dropped",
    ),
    "time_backward": (TIME_BACKWARD, "events and triggers earlier than the one before; dropped"),
    "outside_sensor": (OUTSIDE_SENSOR, "events outside the sensor; dropped"),
    "row_unknown": (ROW_UNKNOWN, "events before the first ADDR_Y, which have no row; dropped"),
    "column_unknown": (
        COLUMN_UNKNOWN,
        "vector events before the first VECT_BASE_X, which have no column; dropped",
    ),
    "vectors_cut": (VECTOR_CUT, "vectors that are not whole (12 + 12 + 8 columns): words are missing"),
    "reserved_words": (RESERVED, "words of a reserved type; skipped"),
    "bytes_askew": (
        REALIGNED,
        "bytes passed over where words stood askew, as bytes are missing there or too many",
    ),
    "odd_bytes": (ODD_BYTES, "bytes at the end of the file that make no whole word; skipped"),
    "header_without_end": (
        HEADER_OPEN,
        "header without '% end'; data taken to start at the first line without '% '",
    ),
}
"""What a RAW file may lose: name -> (row of the tally, meaning)."""

COUNTS: Final = {
    "rollovers": (ROLLOVERS, "rollovers of the camera clock"),
    "time_gaps": (TIME_GAPS, "steps of TIME_HIGH by more than one"),
    "other_words": (OTHER_WORDS, "OTHERS and CONTINUED words, which carry no events"),
}
"""What is worth knowing about a RAW file and is not a loss: name -> (row of the tally, meaning)."""
