"""Events and rows in each millisecond, and whether the readout was at its limit, in constant memory."""

import math
from collections import Counter
from itertools import pairwise

import numpy as np

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


class Milliseconds:
    """How many milliseconds had so many of something."""

    def __init__(self, least: int) -> None:
        self._least = least
        self._bins = Counter[int]()

    def add(self, many: int) -> None:
        """Count a millisecond, by what it had."""
        self._bins[round(math.log(max(many, 1)) / math.log1p(_BIN))] += 1

    def capped(self) -> tuple[float, float]:
        """Share of those with any that are within half a percent of the fullest, and what that had.

        Light that sends data varies by more from millisecond to millisecond; a readout at its limit does not.
        """
        if not self._bins:
            return 0.0, 0.0
        return self.capped_ms / self._bins.total(), (1 + _BIN) ** max(self._bins)

    @property
    def at_limit(self) -> bool:
        """Whether the readout was at its limit."""
        share, most = self.capped()
        return self._bins.total() >= _LEAST_MS and most >= self._least and share >= _CAPPED_SHARE

    @property
    def capped_ms(self) -> int:
        """How many milliseconds these are."""
        top = max(self._bins, default=0)
        return self._bins[top] + self._bins[top - 1]


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
            # Few in a long time, or a restart of the clock.
            edges = 1 + np.flatnonzero(np.diff(t_us // 1000))
        for begin, end in pairwise(sorted({0, *edges.tolist(), len(t_us)})):
            ms = int(t_us[begin]) // 1000
            if ms != self._ms:
                if self._events:
                    self.events.add(self._events)
                    if not self._ms % _LOOKED_AT:
                        self.rows.add(self._rows)
                self._ms, self._events, self._rows = ms, 0, 0
            self._events += end - begin
            if not self._ms % _LOOKED_AT:
                # Rows are read one after another, and after the lowest one that waits the highest.
                y = np.append(self._row, events.y[begin:end]).astype(np.int64)
                read = int(np.count_nonzero(y[1:] != y[:-1]))
                self._passes += int(np.count_nonzero(y[1:] < y[:-1]))
                self._read += read
                self._rows += read
            self._row = int(events.y[end - 1])

    def round_us(self) -> tuple[float, float]:
        """How long a row takes to read, and until the sensor comes to it again, us; 0 where it ever rests."""
        if not (self.rows.at_limit and self._passes):
            return 0.0, 0.0
        row_us = 1000 / self.rows.capped()[1]
        return row_us, row_us * self._read / self._passes
