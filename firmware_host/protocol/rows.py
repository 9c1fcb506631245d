"""LED rows, as a bank of chip masks and an LED record hold them: 12 bytes per chip, LED 0 the first bit."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_host.protocol.generated.requests import CLUSTERS, LEDS, ROW_BYTES

BOARD_LEDS: NDArray[np.int64] = np.repeat(np.arange(CLUSTERS), LEDS // CLUSTERS)
"""The cluster of each LED where the board composes packets, int64 (96,)."""

BOARD_LEDS.setflags(write=False)


def rows_of_leds(leds: NDArray[Any]) -> NDArray[np.uint8]:
    """Rows, uint8 (n, 12), of LEDs that are 0 or 1, (n, LEDs): 96 at most.

    >>> rows_of_leds(np.array([[0, 1, 1]])).tolist()
    [[96, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]]
    """
    rows = np.packbits(leds.astype(np.uint8), axis=1)
    return np.pad(rows, ((0, 0), (0, max(0, ROW_BYTES - rows.shape[1]))))
