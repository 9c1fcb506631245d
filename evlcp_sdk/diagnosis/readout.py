"""Events and rows in each millisecond, and whether the readout was at its limit, in constant memory."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.clock import TimeGrain
from evlcp_sdk.values import Events

_CAPPED_SHARE = 0.2
"""Share of milliseconds with the very same number of events, to half a percent, above which the readout is
at its limit: chips, and the noise of their number, change it by more."""

_LEAST_MS = 10
"""Milliseconds with events below which chance may be taken for a limit."""

_LEAST_EVENTS = 1000
"""Events of a millisecond below which none is a limit: no sensor's readout is as slow as 1 Mev/s, and a few
lights that blink evenly send the same number in each."""

_LOOKED_AT = 8
"""One millisecond of so many is looked at by rows."""

_LEAST_ROWS = 100
"""The same of rows: none takes 10 us to read."""

_BIN = 0.005
"""Width of the bins of what a millisecond has, as a share."""

_MOST = 1e9
"""What has a bin."""

_TOGETHER = 1000
"""Milliseconds that are put into bins together."""


class Milliseconds:
    """How many milliseconds had so many of something."""

    def __init__(self, least: int) -> None:
        self._least = least
        self._hist = np.zeros(1 + _bins([_MOST])[0], np.int64)
        self._new: list[int] = []

    def add(self, many: Sequence[int]) -> None:
        """Count milliseconds, by what each of them had."""
        self._new += many
        if len(self._new) >= _TOGETHER:
            self._note()

    def capped(self) -> tuple[float, float]:
        """Share of those with any that are within half a percent of the fullest, and what that had.

        Light that sends data varies by more from millisecond to millisecond; a readout at its limit does not.
        """
        self._note()
        many = int(self._hist.sum())
        if not many:
            return 0.0, 0.0
        return self.capped_ms / many, float((1 + _BIN) ** self._top)

    @property
    def at_limit(self) -> bool:
        """Whether the readout was at its limit."""
        share, most = self.capped()
        return int(self._hist.sum()) >= _LEAST_MS and most >= self._least and share >= _CAPPED_SHARE

    @property
    def capped_ms(self) -> int:
        """How many milliseconds these are."""
        self._note()
        return int(self._hist[max(self._top - 1, 0) :].sum())

    @property
    def _top(self) -> int:
        filled = np.flatnonzero(self._hist)
        return int(filled[-1]) if len(filled) else 0

    def _note(self) -> None:
        """Put what is new into bins."""
        np.add.at(self._hist, _bins(self._new), 1)
        self._new = []


class ReadoutTally:
    """Counts the milliseconds that had so many events, and in which so many rows were read.

    Attributes:
        grain: How coarse the times are.
        events: Of milliseconds with events, the events.
        rows: Of some of these, by the rows that were read.
    """

    def __init__(self) -> None:
        self.grain = TimeGrain()
        self.events, self.rows = Milliseconds(_LEAST_EVENTS), Milliseconds(_LEAST_ROWS)
        self._ms, self._row = (-1, 0, 0), 0
        self._read = self._passes = 0

    def add(self, events: Events) -> None:
        """Count events, in pieces of any size."""
        t_us, y = events.t_us, events.y
        if not len(t_us):
            return
        self.grain = self.grain.after(t_us)
        first, last = int(t_us[0]) // 1000, int(t_us[-1]) // 1000
        if 0 <= last - first < len(t_us) // 8:
            found = np.searchsorted(t_us, np.arange(first, last + 1) * 1000).tolist()
            # Milliseconds without events, and what a restart of the clock leaves out of order.
            edges = sorted({0, *found} - {len(t_us)})
        else:
            ms = t_us // 1000
            edges = np.flatnonzero(np.diff(ms, prepend=ms[0] - 1)).tolist()
        ends = [*edges[1:], len(t_us)]
        many = [after - begin for begin, after in zip(edges, ends, strict=True)]
        now, before, rows = self._ms
        if first == now:
            many[0] += before
        elif before:
            self.events.add([before])
        for begin, after in zip(edges, ends, strict=True):
            here = int(t_us[begin]) // 1000
            if here != now and not now % _LOOKED_AT:
                self.rows.add([rows])
            if not here % _LOOKED_AT:
                # Rows are read one after another, and after the lowest one that waits the highest.
                part = y[max(begin - 1, 0) : after]
                other, higher = (int(y[0]) != self._row, int(y[0]) < self._row) if begin == 0 else (0, 0)
                read = int(np.count_nonzero(part[1:] != part[:-1])) + other
                self._passes += int(np.count_nonzero(part[1:] < part[:-1])) + higher
                self._read += read
                rows = (rows if here == now else 0) + read
            now = here
        self._ms, self._row = (now, many.pop(), rows), int(y[-1])
        self.events.add(many)

    def round_us(self) -> tuple[float, float]:
        """How long a row takes to read, and until the sensor comes to it again, us; 0 where it ever rests."""
        if not (self.rows.at_limit and self._passes):
            return 0.0, 0.0
        row_us = 1000 / self.rows.capped()[1]
        return row_us, row_us * self._read / self._passes


def _bins(many: Sequence[float]) -> NDArray[np.int64]:
    size = np.clip(np.asarray(many, np.float64), 1, _MOST)
    return np.round(np.log(size) / math.log1p(_BIN)).astype(np.int64)
