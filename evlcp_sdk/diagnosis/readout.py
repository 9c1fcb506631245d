"""Events in each millisecond, and whether the readout was at its limit, counted in constant memory."""

import math
from collections.abc import Sequence
from itertools import pairwise

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

_BIN = 0.005
"""Width of the bins of events in a millisecond, as a share."""

_MOST = 1e9
"""Events of a millisecond that have a bin."""

_TOGETHER = 1000
"""Milliseconds that are put into bins together."""


class ReadoutTally:
    """Counts the milliseconds that had so many events.

    Attributes:
        grain: How coarse the times are.
    """

    def __init__(self) -> None:
        self.grain = TimeGrain()
        self._hist = np.zeros(1 + _bins([_MOST])[0], np.int64)
        self._new: list[int] = []
        self._ms = (0, 0)

    def add(self, events: Events) -> None:
        """Count events, in pieces of any size."""
        t_us = events.t_us
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
        many = [after - begin for begin, after in pairwise([*edges, len(t_us)])]
        now, before = self._ms
        if first == now:
            many[0] += before
        elif before:
            self._new.append(before)
        self._ms = last, many.pop()
        self._new += many
        if len(self._new) >= _TOGETHER:
            self._note()

    def capped(self) -> tuple[float, float]:
        """Share of the milliseconds with events that are within half a percent of the fullest; its events.

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
        share, events = self.capped()
        several = int(self._hist.sum()) >= _LEAST_MS and events >= _LEAST_EVENTS
        return several and share >= _CAPPED_SHARE

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


def _bins(many: Sequence[float]) -> NDArray[np.int64]:
    size = np.clip(np.asarray(many, np.float64), 1, _MOST)
    return np.round(np.log(size) / math.log1p(_BIN)).astype(np.int64)
