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
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.boxes import Box
from evlcp_sdk.values import Events

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


_SEAM_PX = 2
"""Columns at either side of a box that a bar should leave dark: some of the least seam of a region."""


class Rhythm:
    """Scores of a sensor's pixels, one uint32 each, whose bits `_kernels` names.

    Their clock of 17 bits goes round in an eighth of a second. Rows are looked at in turn, where rises so
    long ago that all such times are alike become the youngest of these; and so soon that none looks young.

    Args:
        width: Columns of the sensor.
        height: Its rows.
        chip_us: Nominal length of a chip, us.
        min_score: Score at which a pixel is a candidate; half of it is enough inside a region.
        gap_chips: The longest time from rise to rise in the codes; 4 in pair codes.
        shared: Several followers ask for the same steps; the first one's answer is kept for the others.
    """

    def __init__(
        self,
        width: int,
        height: int,
        chip_us: float,
        min_score: int,
        gap_chips: int = 4,
        *,
        shared: bool = False,
    ) -> None:
        self._tables = RhythmTables.of(chip_us, gap_chips)
        self._shift = self._tables.tick_shift
        self._min_score = min_score
        self._pixels = np.zeros((height, width), np.uint32)
        # No time that is looked up is longer; nor are rows looked at one by one after so long a gap.
        self._turn = _kernels.CLOCK_ROUND // 4
        self._old = self._turn + self._turn // 8
        self._every = _kernels.CLOCK_ROUND - self._turn - self._old
        self._row = 0
        self._seen: int | None = None
        self._open_us, self._taken, self._rises = -1, 0, 0
        self._shared = shared
        # Where events are selected into, box by box.
        self._columns: _kernels.Columns = (np.empty(0),) * 4
        self._kept: tuple[tuple[int, int], int, NDArray[np.int16]] | None = None

    def step(self, start_us: int, events: Events, hits: NDArray[np.int16], cell_shift: int) -> int:
        """Take the events of a time step; add the rises of candidates to their cell's `hits`; how many.

        Args:
            start_us: Start of the step, us.
            events: Those in it, in order; a part of a step comes again with the rest, and counts once.
            hits: Of cells of 2^cell_shift px, int16 (rows, columns).
            cell_shift: See there.
        """
        if self._kept is not None and self._kept[0] == (start_us, len(events)):
            hits[:] = self._kept[2]
            return self._kept[1]
        old = self._row, 0, 0, 0, self._old
        if start_us != self._open_us:
            self._open_us, self._taken, self._rises = start_us, 0, 0
            # As many rows as the time since the last step asks for, all after a gap.
            now, height = start_us >> self._shift, len(self._pixels)
            passed = self._turn if self._seen is None else now - self._seen
            whole = passed >= self._turn
            many = height if whole else -(-height * passed // self._every)
            old = self._row, many, now, 0 if whole else self._old, self._old
            self._row, self._seen = (self._row + many) % height, now
        first, tables = self._taken, self._tables
        newest = events.t_us[first:], events.x[first:], events.y[first:], events.p[first:]
        limits, shifts = (tables.soon, self._min_score, SAME), (self._shift, cell_shift)
        self._rises += _kernels.score_rises(
            newest, self._pixels, hits, tables.kinds, tables.lows, limits, shifts, old
        )
        self._taken = events.t_us.size
        if self._shared:
            self._kept = (start_us, len(events)), self._rises, hits.copy()
        return self._rises

    def select(
        self, events: Events, boxes: Sequence[Box], rhythmic: Sequence[bool], most_same: int = LAMP
    ) -> list[Events]:
        """Those inside each of some boxes (left, top, right, bottom), copied.

        Where leaves move, chance takes a third of their pixels to half of a candidate's score, and a tenth to
        all of it.

        Args:
            events: Those of a step.
            boxes: Which boxes.
            rhythmic: Of which of them only those of candidates are meant that are no lamps.
            most_same: How often a candidate's time must not have come again.
        """
        most = _kernels.MOST_BOXES
        if len(boxes) > most:
            first = self.select(events, boxes[:most], rhythmic[:most], most_same)
            return first + self.select(events, boxes[most:], rhythmic[most:], most_same)
        columns, apart = (events.t_us, events.x, events.y, events.p), events.t_us.size
        room = len(boxes) * apart + 1
        if room > self._columns[0].size:
            room += room // 4
            into = np.empty(room, np.int64), *np.empty((2, room), np.uint16), np.empty(room, np.uint8)
            self._columns = into
        if len(boxes) == 1 and not rhythmic[0]:
            # Of a bar alone, whole blocks of events.
            ends = [_kernels.select_box(columns, boxes[0], self._columns)]
        else:
            filtered = sum(one << k for k, one in enumerate(rhythmic)), self._min_score, most_same
            numbers = np.empty(len(boxes), np.int64)
            _kernels.select_boxes(
                columns, np.array(boxes), self._pixels, filtered, apart, self._columns, numbers
            )
            ends = numbers.tolist()
        t_us, x, y, p = self._columns
        begin, found = 0, []
        for many in ends:
            end = begin + many
            inside = t_us[begin:end].copy(), x[begin:end].copy(), y[begin:end].copy(), p[begin:end].copy()
            found.append(Events.from_columns(*inside))
            begin += apart
        return found

    def of(self, events: Events) -> Events:
        """Those of candidates that are no lamps."""
        height, width = self._pixels.shape
        return self.select(events, [(0, 0, width, height)], [True])[0]

    def measure(
        self,
        box: Box,
        end_us: int,
        span_us: int,
        reach_px: float,
        rows: NDArray[np.int64],
        strips: tuple[float, float, NDArray[np.float64]] | None,
    ) -> tuple[int, float, int, int, float, float, float]:
        """Where in a box pixels blink that rose in the last `span_us`, see `_kernels.measure_box`.

        `strips` are (expected, near, strips) of `_kernels.measure_strips` for a bar whose light stands in
        strips of columns, None for others.
        """
        # Half the score suffices inside a region: its seam is new to the light as the bar moves.
        awake = end_us >> self._shift, span_us >> self._shift, max(self._min_score // 2, 1)
        if strips is not None:
            return _kernels.measure_strips(self._pixels, box, awake, *strips, rows)
        return _kernels.measure_box(self._pixels, box, awake, _SEAM_PX, reach_px, rows)
