"""Which pixels blink in the rhythm of the chips.

The rhythm is judged per pixel, from rise to rise: the times at which it starts to get brighter. In a pair
code rises come two, three or four chips apart, and where events go missing a few chips more, but whole
chips always. So a rise two to four whole chips after the one before raises a pixel's score by two, one after
five to twelve by one; of other codes, up to the longest time that there is in them, and up to three times
that. A rise off the chips, as of a lamp with pulse width modulation of 4 kHz (two and a half chips) or of a
moving texture, lowers it by three: more than the two that chance, which is on the chips in six cases of ten,
would bring. One after the very same number of chips as before lowers it by two from five chips on: a lamp of
1 or 2 kHz repeats its period, a code with missing events does not.
A lamp whose period is near two, three or four chips is in rhythm, too, as far as a score tells; but its time
comes again and again, to half a chip, or twice or three times as long where it misses a rise, while a code
changes to another soon. That is counted as a likelihood ratio: up by one a repetition, by two from four chips
on, down by two where rises may have been missed, by six for another time. Pixels with some of that open no
region, and with more, before a frame shows where the bar is, they are not listened to. Falls are not looked
at: they come later or sooner than rises by the light, they are the first to go missing, and some cameras send
none.

A pixel that a bar has left keeps its score, as it hardly rises any more; but where the camera shakes, the
veil around the bar comes nearer again, and all pixels of the trail rise once, with a chip. So a region is
opened by rises only that come soon after the one before. One pass, four bytes a pixel.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels

_MOST_SCORE = 40
"""Scores rise no further: what has blinked in rhythm for long is forgotten after so many rises off it."""

_SOON_CHIPS = 1.5
"""Rises come no sooner in any code; what does is more events of the same rise."""

_MOST_CHIPS = 15
"""A longer time says nothing, nor one of three times the longest of the code: events were missed."""

_STRAY_CHIPS = 0.3
"""Jitter and latencies that differ from rise to rise put one off the chips by so much."""

_LONGEST_TICKS = 2**15
"""Of what is looked up by its length: a tick is 1 us but for chips slower than 190 a second."""

SAME, LAMP = 7, 14
"""Repetitions of a time, less what speaks against a lamp, from which on a pixel opens no region, and from
which on it is not listened to before a frame shows where the bar is. Pixels that see a random code are so
for five per cent of the time by the first, which a bar can spare, as its other clusters open the region; and
for one by the second, but for nine of the one pilot of sixteen that is two chips throughout. A lamp that
misses one rise in ten is so by both for more than half of the time, one that misses none always. More
repetitions would spare more of a code, and take longer to know a panel, which costs the frames before."""

_LATE, _OFF = 0, 16
"""Kind of a time between rises: see `_TIMES`, or 0 beyond; so much more where it is off the chips."""

_TIMES = (1.5, 2.0, 2.5, 3.0, 3.5, 4.0, *map(float, range(5, 14)))
"""Times between rises that are told apart, by their kinds from 1 on, chips, the last with all beyond. Short
ones by halves: where many pixels switch at once, the readout puts rises off by a quarter of a chip, and a
period of 2.3 chips is now two and now three."""

_LONG = 6
"""Kinds from this one on, four chips, count twice where they are repeated: a code does so half as often."""

_SHORT = 6
"""Kinds up to this one are next to each other where they differ by half a chip: the same time, maybe. Those
of a pair code are whole chips apart."""


@dataclass(frozen=True, eq=False)
class RhythmTables:
    """What the times between rises of some chips say, looked up by a time's ticks.

    Attributes:
        tick_shift: A tick is 2^this us.
        soon: Ticks before which a rise is the same.
        kinds: Kind of a time, the last for all beyond, uint8 (ticks,).
        lows: See `_lows`.
    """

    tick_shift: int
    soon: int
    kinds: NDArray[np.uint8]
    lows: NDArray[np.uint16]

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, chip_us: float, gap_chips: int) -> "RhythmTables":
        """By the length of a chip, us, and the longest time from rise to rise in the codes, chips."""
        late_us = (min(3 * gap_chips, _MOST_CHIPS) + 0.5) * chip_us
        shift = max(math.ceil(math.log2(late_us / _LONGEST_TICKS)), 0)
        tick_us = 1 << shift
        run_us = np.arange(int(late_us) // tick_us + 2) * float(tick_us)
        chips = np.floor(run_us / chip_us + 0.5)
        middles = np.array(_TIMES)
        kinds = 1 + np.searchsorted((middles[1:] + middles[:-1]) / 2 * chip_us, run_us, side="right")
        kinds += _OFF * (np.abs(run_us - chips * chip_us) > _STRAY_CHIPS * chip_us)
        kinds[run_us > late_us] = _LATE
        return cls(shift, int(_SOON_CHIPS * chip_us) >> shift, kinds.astype(np.uint8), _lows(gap_chips))


def _lows(gap_chips: int) -> NDArray[np.uint16]:
    """Time and score of a pixel after a rise, by the kind of its time and by time and score before it.

    The bits above say whether it is the same time again, or rises may have been missed in one of the two.
    """
    kind, before, score = np.meshgrid(np.arange(2 * _OFF), np.arange(16), np.arange(64), indexing="ij")
    time = kind % _OFF
    chips = np.array([0.0, *_TIMES])[time]
    change = np.where(chips < gap_chips + 1, 2, np.where(time == before, -2, 1))
    change[kind >= _OFF] = -3
    change[kind == _LATE] = -1
    said = _repeats()[before, time]
    return np.asarray((said << 10) | (time << 6) | np.clip(score + change, 0, _MOST_SCORE), np.uint16).ravel()


def _repeats() -> NDArray[np.int64]:
    """What a time says after another, by the kinds of both: `_kernels.AGAIN`, `LONG`, `MISSED` or `OTHER`.

    One of them may be two or three of the other, of which rises in between were missed.
    """
    said = np.full((16, 16), _kernels.OTHER)
    ends = [_SOON_CHIPS, *((a + b) / 2 for a, b in pairwise(_TIMES)), _TIMES[-1] + 0.5]
    for shorter in range(1, len(_TIMES) + 1):
        for longer in range(shorter, len(_TIMES) + 1):
            same = longer == shorter or (longer == shorter + 1 and longer <= _SHORT)
            multiple = any(
                many * ends[shorter - 1] < ends[longer] and ends[longer - 1] < many * ends[shorter]
                for many in (2, 3)
            )
            again = _kernels.LONG if shorter >= _LONG else _kernels.AGAIN
            what = again if same else _kernels.MISSED if multiple else _kernels.OTHER
            said[shorter, longer] = said[longer, shorter] = what
    return said
