"""Chip-aligned polarity sums: the image of a moving bar, chip by chip, with the bar held still."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.values import Events, SyncLock

__all__ = ["polarity_sums"]


def polarity_sums(
    events: Iterable[Events],
    lock: SyncLock,
    start_us: float,
    centre_px: tuple[NDArray[np.float64], NDArray[np.float64]],
    size_px: tuple[int, int],
) -> tuple[NDArray[np.int16], NDArray[np.float64]]:
    """Sum polarities (+1, -1) by chip and pixel, the bar held still in the middle to within half a pixel.

    Returns:
        The sums, int16 (chips, height, width); and the rest of the motion, (right, down) of the bar's centre
        from the middle of the image in each chip, float64 (2, chips), px.

    Args:
        events: Pieces of the stream that hold the chips; events outside them are passed over.
        lock: Length of a chip, and the delays of positive and negative events.
        start_us: Start of the first chip, us.
        centre_px: Column and row of the bar's centre in each chip, float64 (chips,) each, px.
        size_px: (width, height) of the image, px.
    """
    from evlcp_sdk.rx import _kernels

    width, height = size_px
    corner_px = np.array(centre_px)
    corner_px[0] -= (width - 1) / 2
    corner_px[1] -= (height - 1) / 2
    whole_px = np.rint(corner_px)
    shift_x, shift_y = whole_px.astype(np.int64)
    sums = np.zeros((len(shift_x), height, width), np.int16)
    for e in events:
        _kernels.add_polarity(
            e.t_us,
            e.x,
            e.y,
            e.p,
            start_us + lock.delay_on_us,
            start_us + lock.delay_off_us,
            lock.chip_us,
            shift_x,
            shift_y,
            sums,
        )
    return sums, corner_px - whole_px
