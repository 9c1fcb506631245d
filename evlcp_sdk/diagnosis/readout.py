"""Events and rows per millisecond, and whether the readout was at its limit, in constant memory."""

import math
from collections import Counter
from itertools import pairwise

import numpy as np

from evlcp_sdk.clock import TimeGrain
from evlcp_sdk.values import Events

_CAPPED_SHARE = 0.2
"""Share of milliseconds with the same number of events, to half a percent, from which on the readout is at
its limit: chips, and the noise of their number, vary by more."""

_MIN_MS = 10
"""Milliseconds with events that are needed to tell a limit from chance."""

_MIN_EVENTS = 1000
"""Events of a millisecond that can be a limit: no sensor's readout is as slow as 1 Mev/s, and a few lights
that blink evenly send the same number in each."""

_ROWS_EVERY_MS = 8
"""Rows are counted in one millisecond of so many."""

_MIN_ROWS = 100
"""The same of rows: none takes 10 us to read."""

_BIN = 0.005
"""Relative width of the histogram's bins."""


class MillisecondHistogram:
    """A histogram of the number of something in a millisecond, in logarithmic bins."""

    def __init__(self, min_limit: int) -> None:
        self._min_limit = min_limit
        self._bins = Counter[int]()

    def add(self, number: int) -> None:
        """Add a millisecond with this number."""
        self._bins[round(math.log(max(number, 1)) / math.log1p(_BIN))] += 1

    def measure_cap(self) -> tuple[float, float]:
        """Share of the milliseconds within half a percent of the fullest, and the number in that.

        Light that sends data varies by more from millisecond to millisecond; a readout at its limit does not.
        """
        if not self._bins:
            return 0.0, 0.0
        return self.capped_ms / self._bins.total(), (1 + _BIN) ** max(self._bins)

    @property
    def at_limit(self) -> bool:
        """Whether the readout was at its limit."""
        share, peak = self.measure_cap()
        return self._bins.total() >= _MIN_MS and peak >= self._min_limit and share >= _CAPPED_SHARE

    @property
    def capped_ms(self) -> int:
        """Number of milliseconds within half a percent of the fullest."""
        top = max(self._bins, default=0)
        return self._bins[top] + self._bins[top - 1]


class ReadoutTally:
    """Histograms of the events in a millisecond, and of the rows read in some; and the grain of the times."""

    def __init__(self) -> None:
        self.grain = TimeGrain()
        self.events, self.rows = MillisecondHistogram(_MIN_EVENTS), MillisecondHistogram(_MIN_ROWS)
        self._ms, self._events, self._rows, self._row = -1, 0, 0, 0
        self._read = self._passes = 0

    def add(self, events: Events) -> None:
        """Count events, in pieces of any size."""
        if not len(events):
            return
        self.grain = self.grain.update(events.t_us)
        t_us = events.t_us
        first, last = int(t_us[0]) // 1000, int(t_us[-1]) // 1000
        if 0 <= last - first < len(t_us) // 8:
            edges = np.searchsorted(t_us, np.arange(first + 1, last + 1) * 1000)
        else:
            # Few events in a long time, or a restart of the clock.
            edges = 1 + np.flatnonzero(np.diff(t_us // 1000))
        for begin, end in pairwise(sorted({0, *edges.tolist(), len(t_us)})):
            ms = int(t_us[begin]) // 1000
            if ms != self._ms:
                if self._events:
                    self.events.add(self._events)
                    if not self._ms % _ROWS_EVERY_MS:
                        self.rows.add(self._rows)
                self._ms, self._events, self._rows = ms, 0, 0
            self._events += end - begin
            if not self._ms % _ROWS_EVERY_MS:
                # Rows are read one after another; after the lowest waiting one comes the highest.
                y = np.append(self._row, events.y[begin:end]).astype(np.int64)
                read = int(np.count_nonzero(y[1:] != y[:-1]))
                self._passes += int(np.count_nonzero(y[1:] < y[:-1]))
                self._read += read
                self._rows += read
            self._row = int(events.y[end - 1])

    def round_us(self) -> tuple[float, float]:
        """Time to read a row, and until it is read again, us; 0 where the readout ever rests."""
        if not (self.rows.at_limit and self._passes):
            return 0.0, 0.0
        row_us = 1000 / self.rows.measure_cap()[1]
        return row_us, row_us * self._read / self._passes
