"""LED rows of chip masks and LED records: 12 bytes a chip, LED 0 in the first bit."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_host.protocol.generated.requests import CLUSTERS, LEDS, ROW_BYTES

BOARD_LEDS: NDArray[np.int64] = np.repeat(np.arange(CLUSTERS), LEDS // CLUSTERS)
"""The cluster of each LED where the board composes packets, int64 (96,)."""

BOARD_LEDS.setflags(write=False)


def pack_led_rows(leds: NDArray[Any]) -> NDArray[np.uint8]:
    """Rows, uint8 (n, 12), of at most 96 LEDs that are 0 or 1, (n, LEDs).

    >>> pack_led_rows(np.array([[0, 1, 1]])).tolist()
    [[96, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]]
    """
    rows = np.packbits(leds.astype(np.uint8), axis=1)
    return np.pad(rows, ((0, 0), (0, max(0, ROW_BYTES - rows.shape[1]))))
