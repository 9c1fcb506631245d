"""LED rows, as a bank of chip masks and an LED record hold them: 12 bytes per chip, LED 0 the first bit."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.errors import ConfigError
from firmware_host.protocol.requests import CLUSTERS, LEDS

__all__ = ["chips_of_rows", "rows_of_chips"]


def rows_of_chips(chips: ArrayLike) -> NDArray[np.uint8]:
    """LED rows of chips, uint8 (chips, 12): from one column per LED, or one per cluster of equal size.

    LED 0 is the most significant bit of the first byte.

    Raises:
        ConfigError: The chips are not 0 and 1, or the columns do not divide the 96 LEDs.

    >>> rows_of_chips([[1] + [0] * 15]).tolist()
    [[252, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]]
    """
    c = np.asarray(chips)
    if c.ndim != 2 or not c.size or LEDS % c.shape[1]:
        raise ConfigError(
            f"chips of shape {c.shape}: expected one column for each of {LEDS} LEDs or {CLUSTERS} clusters"
        )
    if c.dtype.kind not in "uib" or not np.isin(c, (0, 1)).all():
        raise ConfigError("chips: expected integers 0 and 1")
    return np.packbits(np.repeat(c.astype(np.uint8), LEDS // c.shape[1], axis=1), axis=1)


def chips_of_rows(rows: NDArray[np.uint8], clusters: int = CLUSTERS) -> NDArray[np.uint8]:
    """Chips of LED rows, uint8 (chips, clusters); `clusters` 96 gives every LED.

    Raises:
        ConfigError: LEDs of one cluster differ.
    """
    leds = np.unpackbits(rows, axis=1)
    chips = leds.reshape(len(rows), clusters, LEDS // clusters)
    torn = np.argwhere((chips != chips[:, :, :1]).any(2))
    if len(torn):
        chip, cluster = torn[0]
        raise ConfigError(
            f"chip {chip}: the LEDs of cluster {cluster} differ; take every LED for itself with --per-led"
        )
    return np.ascontiguousarray(chips[:, :, 0])
