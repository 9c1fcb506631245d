"""Events in each millisecond, and whether the readout was at its limit, counted in constant memory."""

import math

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.values import Events

__all__ = ["ReadoutTally"]

_CAPPED_SHARE = 0.2
"""Share of milliseconds with the very same number of events, to half a percent, above which the readout is
at its limit: chips, and the noise of their number, change it by more."""

_LEAST_MS = 10
"""Milliseconds with events below which chance may be taken for a limit."""

_BIN = 0.005
"""Width of the bins of events in a millisecond, as a share."""

_MOST = 1e9
"""Events of a millisecond that have a bin."""


class ReadoutTally:
    """Counts the milliseconds that had so many events."""

    def __init__(self) -> None:
        self._hist = np.zeros(1 + _bins(np.array([_MOST]))[0], np.int64)
        self._ms = (0, 0)

    def add(self, events: Events) -> None:
        """Count events, in pieces of any size."""
        t_us = events.t_us
        if not len(t_us):
            return
        first, last = int(t_us[0]) // 1000, int(t_us[-1]) // 1000
        if 0 <= last - first < len(t_us) // 8:
            edges = np.searchsorted(t_us, np.arange(first, last + 1) * 1000)
            # Milliseconds without events, and what a restart of the clock leaves out of order.
            edges = np.unique(np.concatenate([[0], edges[edges < len(t_us)]]))
        else:
            ms = t_us // 1000
            edges = np.flatnonzero(np.diff(ms, prepend=ms[0] - 1))
        many = np.diff(edges, append=len(t_us))
        now, before = self._ms
        if first == now:
            many[0] += before
        elif before:
            self._note(np.array([before]))
        self._note(many[:-1])
        self._ms = last, int(many[-1])

    def capped(self) -> tuple[float, float]:
        """Share of the milliseconds with events that are within half a percent of the fullest; its events.

        Light that sends data varies by more from millisecond to millisecond; a readout at its limit does not.
        """
        many = int(self._hist.sum())
        if not many:
            return 0.0, 0.0
        return self.capped_ms / many, float((1 + _BIN) ** self._top)

    @property
    def at_limit(self) -> bool:
        """Whether the readout was at its limit."""
        return int(self._hist.sum()) >= _LEAST_MS and self.capped()[0] >= _CAPPED_SHARE

    @property
    def capped_ms(self) -> int:
        """How many milliseconds these are."""
        return int(self._hist[max(self._top - 1, 0) :].sum())

    @property
    def _top(self) -> int:
        filled = np.flatnonzero(self._hist)
        return int(filled[-1]) if len(filled) else 0

    def _note(self, many: NDArray[np.int64]) -> None:
        np.add.at(self._hist, _bins(many), 1)


def _bins(many: NDArray[np.generic]) -> NDArray[np.int64]:
    size = np.clip(np.asarray(many, np.float64), 1, _MOST)
    return np.round(np.log(size) / math.log1p(_BIN)).astype(np.int64)
