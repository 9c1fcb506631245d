"""LED rows, as a bank of chip masks and an LED record hold them: 12 bytes per chip, LED 0 the first bit."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
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


def chips_of_rows(
    rows: NDArray[np.uint8], led_clusters: NDArray[np.int64] | None = BOARD_LEDS
) -> NDArray[np.uint8]:
    """Chips of LED rows, uint8 (chips, clusters).

    Args:
        rows: The rows, uint8 (chips, 12).
        led_clusters: The cluster of each LED; None for a column of every LED of the board.

    Raises:
        ConfigError: LEDs of one cluster differ, or one that is in none is lit.
    """
    leds = np.unpackbits(rows, axis=1)
    if led_clusters is None:
        return leds
    if len(led_clusters) > leds.shape[1]:
        raise ConfigError(f"rows of {leds.shape[1]} LEDs, the link's bar has {len(led_clusters)}")
    _, first = np.unique(led_clusters, return_index=True)
    chips = np.ascontiguousarray(leds[:, first])
    expected = np.zeros_like(leds)
    expected[:, : len(led_clusters)] = chips[:, led_clusters]
    wrong = np.argwhere(leds != expected)
    if len(wrong):
        chip, led = wrong[0]
        if led >= len(led_clusters):
            raise ConfigError(f"chip {chip}: LED {led} is lit, the link's bar has {len(led_clusters)}")
        raise ConfigError(
            f"chip {chip}: the LEDs of cluster {led_clusters[led]} differ; take every LED for itself"
            " with --per-led"
        )
    return chips
