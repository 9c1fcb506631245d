"""Detect pixels that blink in the rhythm of the chips.

The rhythm is judged per pixel, from rise to rise: the times at which it starts to get brighter. In a pair
code rises come two, three or four chips apart, and where events go missing a few chips more, but whole chips
always. So a rise two to four whole chips after the one before raises a pixel's score by two, one after five
to twelve by one; of other codes, up to the longest gap that there is in them, and up to three times that. A
rise off the chips, as of a lamp with pulse width modulation of 4 kHz (two and a half chips) or of a moving
texture, lowers it by three: more than the two that chance, which is on the chips in six cases of ten, would
bring. One after the very same number of chips as before lowers it by two from five chips on: a lamp of 1 or 2
kHz repeats its period, a code with missing events does not. A lamp whose period is near two, three or four
chips is in rhythm, too, as far as the score tells; but its time comes again and again, to half a chip, or
twice or three times as long where it misses a rise, while a code changes to another soon. That is counted as
a likelihood ratio: up by one a repetition, by two from four chips on, down by two where rises may have been
missed, by six for another time. Pixels with some repetitions open no region, and those with more are ignored
before a frame shows where the bar is. Falls are not used: they come later or sooner than rises by the light,
they are the first to go missing, and some cameras send none.

A pixel that a bar has left keeps its score, as it hardly rises any more; but where the camera shakes, the
veil around the bar comes nearer again, and all pixels of the trail rise once, with a chip. So only rises that
come soon after the one before open a region. One pass, four bytes a pixel.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.boxes import Box
from evlcp_sdk.values import Events

_MAX_SCORE = 40
"""Limit of scores, so that a long rhythm is forgotten after so many rises off it."""

_MIN_CHIPS = 1.5
"""Least time between rises in any code; sooner events are of the same rise."""

_MAX_CHIPS = 15
"""Longest time that counts, as does none beyond three times the longest gap of the code: events were
missed."""

_JITTER_CHIPS = 0.3
"""Deviation of rises from whole chips by jitter and latencies that differ from rise to rise."""

_LONGEST_TICKS = 2**15
"""Size of the tables by ticks: a tick is 1 us except for chips slower than 190 a second."""

OPENING_REPEATS, LAMP_REPEATS = 7, 14
"""Repetitions of a time, less the evidence against a lamp, from which on a pixel opens no region, and from
which on it is ignored before a frame shows where the bar is. Pixels that see a random code are so for five
per cent of the time by the first, which a bar can spare, as its other clusters open the region; and for one
by the second, but for nine of the one pilot of sixteen that is two chips throughout. A lamp that misses one
rise in ten is so by both for more than half of the time, one that misses none always. More repetitions would
spare more of a code, and take longer to know a panel, which costs the frames before."""

_LATE, _OFF_CHIPS = 0, 16
"""Kind of a time beyond all of `_TIMES`; and what is added to the kind of one off the chips."""

_TIMES = (1.5, 2.0, 2.5, 3.0, 3.5, 4.0, *map(float, range(5, 14)))
"""Times between rises that are distinguished, chips, by their kinds from 1 on, the last with all beyond.
Short ones by halves: where many pixels switch at once, the readout puts rises off by a quarter of a chip, and
a period of 2.3 chips is now two and now three."""

_FIRST_LONG = 6
"""Kinds from this one on, four chips, count twice where they are repeated: a code does so half as often."""

_LAST_SHORT = 6
"""Neighbours among the kinds up to this one differ by half a chip, and may be the same time. Those of a pair
code are whole chips apart."""


@lru_cache(maxsize=4)
def _build_tables(chip_us: float, gap_chips: int) -> tuple[int, int, NDArray[np.uint8], NDArray[np.uint16]]:
    """How times between rises count, by the length of a chip, us, and the longest such time in the codes.

    Returns:
        Shift (a tick is 2^this us); ticks below which a rise is the same as the one before; kind of a time by
        its ticks, the last for all beyond, uint8 (ticks,); transitions, see `_build_transitions`.
    """
    late_us = (min(3 * gap_chips, _MAX_CHIPS) + 0.5) * chip_us
    shift = max(math.ceil(math.log2(late_us / _LONGEST_TICKS)), 0)
    tick_us = 1 << shift
    run_us = np.arange(int(late_us) // tick_us + 2) * float(tick_us)
    chips = np.floor(run_us / chip_us + 0.5)
    middles = np.array(_TIMES)
    kinds = 1 + np.searchsorted((middles[1:] + middles[:-1]) / 2 * chip_us, run_us, side="right")
    kinds += _OFF_CHIPS * (np.abs(run_us - chips * chip_us) > _JITTER_CHIPS * chip_us)
    kinds[run_us > late_us] = _LATE
    return shift, int(_MIN_CHIPS * chip_us) >> shift, kinds.astype(np.uint8), _build_transitions(gap_chips)


def _build_transitions(gap_chips: int) -> NDArray[np.uint16]:
    """Time and score of a pixel after a rise, by the kind of its time and by time and score before it.

    The bits above are the relation of the two times, see `_relate_times`.
    """
    kind, before, score = np.meshgrid(np.arange(2 * _OFF_CHIPS), np.arange(16), np.arange(64), indexing="ij")
    time = kind % _OFF_CHIPS
    chips = np.array([0.0, *_TIMES])[time]
    change = np.where(chips < gap_chips + 1, 2, np.where(time == before, -2, 1))
    change[kind >= _OFF_CHIPS] = -3
    change[kind == _LATE] = -1
    low = (time << _kernels.TIME_BIT) | np.clip(score + change, 0, _MAX_SCORE)
    return np.asarray((_relate_times()[before, time] << _kernels.REPEATS_BIT) | low, np.uint16).ravel()


def _relate_times() -> NDArray[np.int64]:
    """Relations of two times by their kinds, such as `_kernels.SAME_TIME`.

    One may be two or three times the other, of which rises in between were missed.
    """
    relations = np.full((16, 16), _kernels.OTHER_TIME)
    ends = [_MIN_CHIPS, *((a + b) / 2 for a, b in pairwise(_TIMES)), _TIMES[-1] + 0.5]
    for shorter in range(1, len(_TIMES) + 1):
        same = _kernels.LONG_SAME_TIME if shorter >= _FIRST_LONG else _kernels.SAME_TIME
        for longer in range(shorter, len(_TIMES) + 1):
            relation = _kernels.OTHER_TIME
            if longer == shorter or (longer == shorter + 1 and longer <= _LAST_SHORT):
                relation = same
            elif any(
                times * ends[shorter - 1] < ends[longer] and ends[longer - 1] < times * ends[shorter]
                for times in (2, 3)
            ):
                relation = _kernels.MULTIPLE_TIME
            relations[shorter, longer] = relations[longer, shorter] = relation
    return relations


_MOST_SELECTED = 2**21
"""Events that there is room for in one pass over a step, 27 MB: each box has room for all of the step."""

_SEAM_PX = 2
"""Columns at either side of a box that a bar should leave dark: some of the least seam of a region."""


class BlinkDetector:
    """Scores the pixels of a sensor by the rhythm of their rises; selects events and places by these scores.

    A pixel's state is a uint32, whose bits `_kernels` names. Its clock of 17 bits goes round in an eighth of
    a second. So rows are visited in turn, and rises so long ago that all such times are alike are moved to
    the youngest of these times, soon enough that none looks young.

    Args:
        width: Columns of the sensor.
        height: Its rows.
        chip_us: Nominal length of a chip, us.
        min_score: Score at which a pixel is a candidate; half of it is enough inside a region.
        gap_chips: The longest time from rise to rise in the codes; 4 in pair codes.
        is_shared: Several trackers ask for the same steps: the first answer is kept for the others.
    """

    def __init__(
        self,
        width: int,
        height: int,
        chip_us: float,
        min_score: int,
        gap_chips: int = 4,
        *,
        is_shared: bool = False,
    ) -> None:
        tables = _build_tables(chip_us, gap_chips)
        self._shift, self._least_ticks, self._kinds, self._transitions = tables
        self._min_score = min_score
        self._pixels = np.zeros((height, width), np.uint32)
        # Longer than any time that counts; after so long a gap all rows are visited at once.
        self._turn = _kernels.CLOCK_TICKS // 4
        self._old = self._turn + self._turn // 8
        self._visit_ticks = _kernels.CLOCK_TICKS - self._turn - self._old
        self._next_row = 0
        self._now: int | None = None
        self._step_us, self._done, self._hits = -1, 0, 0
        self._is_shared = is_shared
        # Where events are selected into, box by box.
        self._columns: _kernels.Columns = (np.empty(0),) * 4
        self._answer: tuple[tuple[int, int], int, NDArray[np.int16]] | None = None

    def step(self, start_us: int, events: Events, hits: NDArray[np.int16], cell_shift: int) -> int:
        """Score the rises of a time step; return the number of rises of candidates, and count them in `hits`.

        Args:
            start_us: Start of the step, us.
            events: Those in it, in order; a part of a step comes again with the rest, and counts once.
            hits: Counts by cell of 2^cell_shift px, int16 (rows, columns).
            cell_shift: See `hits`.
        """
        if self._answer is not None and self._answer[0] == (start_us, len(events)):
            hits[:] = self._answer[2]
            return self._answer[1]
        aging = self._next_row, 0, 0, 0, self._old
        if start_us != self._step_us:
            self._step_us, self._done, self._hits = start_us, 0, 0
            # As many rows as the time since the last step asks for, all after a gap.
            now, height = start_us >> self._shift, len(self._pixels)
            ticks = self._turn if self._now is None else now - self._now
            is_gap = ticks >= self._turn
            rows = height if is_gap else -(-height * ticks // self._visit_ticks)
            aging = self._next_row, rows, now, 0 if is_gap else self._old, self._old
            self._next_row, self._now = (self._next_row + rows) % height, now
        first = self._done
        newest = events.t_us[first:], events.x[first:], events.y[first:], events.p[first:]
        limits, shifts = (self._least_ticks, self._min_score, OPENING_REPEATS), (self._shift, cell_shift)
        self._hits += _kernels.score_rises(
            newest, self._pixels, hits, self._kinds, self._transitions, limits, shifts, aging
        )
        self._done = events.t_us.size
        if self._is_shared:
            self._answer = (start_us, len(events)), self._hits, hits.copy()
        return self._hits

    def select(
        self, events: Events, boxes: Sequence[Box], rhythmic: Sequence[bool], most_repeats: int = LAMP_REPEATS
    ) -> list[Events]:
        """Copy the events inside each of some boxes.

        Where leaves move, chance takes a third of their pixels to half of a candidate's score, and a tenth to
        all of it.

        Args:
            events: Those of a step.
            boxes: (left, top, right, bottom) of each.
            rhythmic: Boxes of which only candidates' events are selected that are no lamps.
            most_repeats: Repetitions of a time from which on a candidate is a lamp.
        """
        columns, stride = (events.t_us, events.x, events.y, events.p), events.t_us.size
        most = max(min(_MOST_SELECTED // (stride + 1), _kernels.MAX_BOXES), 1)
        if len(boxes) > most:
            first = self.select(events, boxes[:most], rhythmic[:most], most_repeats)
            return first + self.select(events, boxes[most:], rhythmic[most:], most_repeats)
        room = len(boxes) * stride + 1
        if room > self._columns[0].size:
            room += room // 4
            x, y = np.empty((2, room), np.uint16)
            self._columns = np.empty(room, np.int64), x, y, np.empty(room, np.uint8)
        counts = np.empty(len(boxes), np.int64)
        if len(boxes) == 1 and not rhythmic[0]:
            # Of a bar alone, whole blocks of events.
            counts[0] = _kernels.select_box(columns, boxes[0], self._columns)
        else:
            limits = sum(one << k for k, one in enumerate(rhythmic)), self._min_score, most_repeats
            _kernels.select_boxes(
                columns, np.array(boxes), self._pixels, limits, stride, self._columns, counts
            )
        selected, (t_us, x, y, p) = [], self._columns
        for k, count in enumerate(counts.tolist()):
            part = slice(k * stride, k * stride + count)
            copied = t_us[part].copy(), x[part].copy(), y[part].copy(), p[part].copy()
            selected.append(Events.from_columns(*copied))
        return selected

    def select_rhythmic(self, events: Events) -> Events:
        """Copy the events of candidates that are no lamps."""
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
        """Find where in a box pixels blink that rose in the last `span_us`, see `_kernels.measure_box`.

        `strips` are (expected, near, strips) of `_kernels.measure_strips` for a bar whose light stands in
        strips of columns, None for others.
        """
        # Half the score suffices inside a region: its seam is new to the light as the bar moves.
        awake = end_us >> self._shift, span_us >> self._shift, max(self._min_score // 2, 1)
        if strips is not None:
            return _kernels.measure_strips(self._pixels, box, awake, *strips, rows)
        return _kernels.measure_box(self._pixels, box, awake, _SEAM_PX, reach_px, rows)
