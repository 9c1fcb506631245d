"""LED rows, as a bank of chip masks and an LED record hold them: 12 bytes per chip, LED 0 the first bit."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.errors import ConfigError
from firmware_host.protocol.generated.requests import CLUSTERS, LEDS, ROW_BYTES

BOARD_LEDS: NDArray[np.int64] = np.repeat(np.arange(CLUSTERS), LEDS // CLUSTERS)
"""The cluster of each LED where the board composes packets, int64 (96,)."""

BOARD_LEDS.setflags(write=False)


def rows_of_chips(chips: ArrayLike, led_clusters: NDArray[np.int64] = BOARD_LEDS) -> NDArray[np.uint8]:
    """LED rows of chips, uint8 (chips, 12): from one column per cluster, or one per LED.

    LED 0 is the most significant bit of the first byte; there are 96 at most.

    Raises:
        ConfigError: The chips are not 0 and 1, or there are other columns.

    >>> rows_of_chips([[1] + [0] * 15]).tolist()
    [[252, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]]
    """
    c = np.asarray(chips)
    leds, clusters = len(led_clusters), int(led_clusters.max()) + 1
    if c.ndim != 2 or not c.size or c.shape[1] not in (leds, clusters):
        raise ConfigError(
            f"chips of shape {c.shape}: expected one column for each of {leds} LEDs or {clusters} clusters"
        )
    if c.dtype.kind not in "uib" or not np.isin(c, (0, 1)).all():
        raise ConfigError("chips: expected integers 0 and 1")
    c = c.astype(np.uint8)
    return _rows(c[:, led_clusters] if c.shape[1] == clusters else c)


def masks_of_clusters(led_clusters: NDArray[np.int64]) -> NDArray[np.uint8]:
    """The LED row of each cluster, uint8 (clusters, 12).

    >>> masks_of_clusters(np.array([1, 0, 0]))[:, 0].tolist()
    [96, 128]
    """
    return _rows((led_clusters == np.arange(led_clusters.max() + 1)[:, None]).astype(np.uint8))


def _rows(leds: NDArray[np.uint8]) -> NDArray[np.uint8]:
    rows = np.packbits(leds, axis=1)
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
    stray = np.argwhere(leds[:, len(led_clusters) :])
    if len(stray):
        chip, led = stray[0]
        raise ConfigError(
            f"chip {chip}: LED {len(led_clusters) + led} is lit, the link's bar has {len(led_clusters)}"
        )
    _, first = np.unique(led_clusters, return_index=True)
    chips = np.ascontiguousarray(leds[:, first])
    torn = np.argwhere(leds[:, : len(led_clusters)] != chips[:, led_clusters])
    if len(torn):
        chip, led = torn[0]
        raise ConfigError(
            f"chip {chip}: the LEDs of cluster {led_clusters[led]} differ; take every LED for itself"
            " with --per-led"
        )
    return chips
