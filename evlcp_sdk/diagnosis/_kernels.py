"""The loop over events, compiled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]

FINE_US, FINE = 10, 256
"""Width and number of the bins of short intervals: chips down to 400 a second."""

COARSE_US, COARSE = 100, 256
"""The same of longer ones, to 28 ms: lamps on mains."""

SHORT = 128
"""Bins of `FINE_US` of the times between events of a pixel."""

BINS = FINE + COARSE

MIN_RISE_US = 60
"""Time after a rise in which no other counts, two chips at 30 kHz: events of strong light ring so long."""


@njit
def add_events(
    events: tuple[Array, Array, Array, Array],
    of_pixels: tuple[Array, Array, Array],
    counts: tuple[Array, Array, Array],
    shift: int,
    calm_us: int,
) -> None:
    """Count events, and the times between them, in cells of 2^shift px.

    A rise is a positive event after a negative one of its pixel, or after `calm_us` without any, and not
    within MIN_RISE_US of the one before. `of_pixels` are the time of each pixel's last event, int64, its
    polarity, uint8, and the pixel's last rise, int64, all (height, width). `counts` are the times from rise
    to rise, uint32 (rows, columns, BINS), those from event to event, uint32 (rows, columns, SHORT), and the
    events, int64 (rows, columns, 2).
    """
    t_us, x, y, p = events
    last_us, last_p, rise_us = of_pixels
    intervals, gaps, signs = counts
    for i in range(t_us.size):
        t, row, column, sign = t_us[i], y[i], x[i], p[i]
        r, c = row >> shift, column >> shift
        gap = t - last_us[row, column]
        if 0 <= gap < FINE_US * SHORT:
            gaps[r, c, gap // FINE_US] += np.uint32(1)
        signs[r, c, sign] += 1
        since = t - rise_us[row, column]
        if sign and since >= MIN_RISE_US and (last_p[row, column] == 0 or gap > calm_us):
            if since < FINE_US * FINE:
                intervals[r, c, since // FINE_US] += np.uint32(1)
            elif since < FINE_US * FINE + COARSE_US * COARSE:
                intervals[r, c, FINE + (since - FINE_US * FINE) // COARSE_US] += np.uint32(1)
            rise_us[row, column] = t
        last_us[row, column] = t
        last_p[row, column] = sign
