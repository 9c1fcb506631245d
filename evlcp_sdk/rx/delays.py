"""How much later the rows of a bar are read than those above, from the events of its preambles.

A sensor reads its rows one after another, 0.1 to 0.35 us each, those without an event in no time. All
clusters of a bar change together at the preamble's edges, as they do in the middle of every value, so that
its rows wait for one another: 20 us from end to end at 50 m, 90 us at 16 m.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.values import Events, SyncLock, changed

_STEPS = 10
"""Steps of a chip in which the response of a block of rows is placed."""

_BLOCK_PX = 8
"""Rows that are looked at together: hundreds of events in a preamble, read within 2 us."""

_FEWEST_BLOCKS = 4
"""Blocks below which a bar is too small to tell, and for a delay by row to matter."""

_TYPICAL_US = 0.2
"""Time a row takes (sigma) before one has been measured."""

LONGEST_ROW_US = 0.35
"""The longest that a sensor takes to read a row, us: of two parts, the lower one may come as much later."""

_WALK_US = 0.01
"""Change of it from packet to packet: with the number of events in a row, as the bar grows."""

_CHANCE_SIGMAS = 4.0
"""Sigmas (the root of the number of events) that a block must fit the preamble by."""

_PLACE_SIGMA_US = 2.0
"""Least error of a block's place, from the steps."""


@dataclass(frozen=True)
class RowDelay:
    """What is known of a bar's rows.

    Attributes:
        row_us: How much later a row's events come than those of the row above, us.
        variance: Of it, us2.
    """

    row_us: float = 0.0
    variance: float = _TYPICAL_US**2

    def measured(self, row_us: float, sigma_us: float) -> "RowDelay":
        """Take a packet's measurement, as a Kalman filter does."""
        variance = self.variance + _WALK_US**2
        gain = variance / (variance + sigma_us**2)
        return RowDelay(self.row_us + gain * (row_us - self.row_us), (1 - gain) * variance)


class RowDelays:
    """Measures the delay by row at each preamble that is detected.

    Args:
        preamble: The code that finds time, chips, uint8 (P,).
    """

    def __init__(self, preamble: NDArray[np.uint8]) -> None:
        self._chips = 2.0 * preamble - 1

    def hear(
        self,
        known: RowDelay,
        lock: SyncLock,
        pieces: Iterable[tuple[int, Events]],
        centre_px: float,
        height_px: float,
    ) -> tuple[RowDelay, SyncLock]:
        """Look at the preamble that a lock was found in; give what is known now, and the lock with it.

        Args:
            known: What was known before.
            lock: As synchronization gave it.
            pieces: Events of the region, (start us, events) a time step, those of the preamble among them.
            centre_px: Row of the bar's centre.
            height_px: Its height.
        """
        row_us, sigma_us = self.measure(lock, pieces, centre_px, height_px)
        if math.isfinite(row_us):
            known = known.measured(row_us, sigma_us)
        return known, changed(lock, row_us=known.row_us, last_row_us=abs(known.row_us) * height_px / 2)

    def measure(
        self, lock: SyncLock, pieces: Iterable[tuple[int, Events]], centre_px: float, height_px: float
    ) -> tuple[float, float]:
        """Delay from one row to the next in a preamble, and its sigma, us; NaN where too few rows show it."""
        blocks = round(height_px / _BLOCK_PX)
        if blocks < _FEWEST_BLOCKS:
            return math.nan, math.nan
        reach = _STEPS + _STEPS // 2
        step_us = float(lock.chip_us) / _STEPS
        top_px = centre_px - (height_px - 1) / 2
        start_us = np.array([lock.delay_off_us, lock.delay_on_us]) + lock.packet_t_us - reach * step_us
        first_us = float(start_us.min())
        counts = np.zeros((2, blocks, len(self._chips) * _STEPS + 2 * reach))
        for _, e in pieces:
            if len(e) and int(e.t_us[-1]) >= first_us:
                _kernels.count_rows(
                    e.t_us, e.y, e.p, start_us, step_us, top_px - 0.5, height_px / blocks, counts
                )
        fit = np.empty((2, blocks, 2 * reach + 1))
        _kernels.fit_rows(counts, self._chips, _STEPS, fit)
        rows_px = (np.arange(blocks) + 0.5) * height_px / blocks
        total, weight = 0.0, 0.0
        for part, seen in zip(fit, counts.sum(2), strict=True):
            lag, sigma = _kernels.slope_of_rows(
                rows_px, part, seen, _FEWEST_BLOCKS, _CHANCE_SIGMAS, _PLACE_SIGMA_US / step_us
            )
            if math.isfinite(lag):
                total += lag * step_us / (sigma * step_us) ** 2
                weight += 1 / (sigma * step_us) ** 2
        return (total / weight, 1 / math.sqrt(weight)) if weight else (math.nan, math.nan)
