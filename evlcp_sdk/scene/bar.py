"""The bar: where a transmitter's LEDs stand, and which cluster each belongs to."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.errors import ConfigError

__all__ = ["BarLayout"]

_MOST_LEDS = 1 << 16


@dataclass(frozen=True)
class BarLayout:
    """LEDs on a grid of rows and columns, top left first, grouped row by row into equal clusters.

    A bar is one column; a panel of many rows and columns is grouped into blocks of
    `cluster_rows` x `cluster_columns` LEDs, numbered row by row from the top left.

    Raises:
        ConfigError: The blocks do not tile the grid, or it has more than 65536 LEDs.

    >>> BarLayout().clusters
    16
    >>> panel = BarLayout(rows=16, columns=16, cluster_rows=4, cluster_columns=4)
    >>> panel.cluster_centres_m()[1].round(3).tolist()
    [-0.02, -0.06]
    """

    rows: Annotated[int, Field(gt=0, le=4096, description="LEDs from top to bottom.")] = 96
    columns: Annotated[int, Field(gt=0, le=4096, description="LEDs from left to right.")] = 1
    led_pitch_m: Annotated[float, Field(ge=1e-6, le=100, description="Spacing of neighbouring LEDs.")] = 0.01
    cluster_rows: Annotated[int, Field(gt=0, description="LED rows of a cluster.")] = 6
    cluster_columns: Annotated[int, Field(gt=0, description="LED columns of a cluster.")] = 1

    def __post_init__(self) -> None:
        if self.rows * self.columns > _MOST_LEDS:
            raise ConfigError(
                f"bar.rows = {self.rows}, bar.columns = {self.columns}: expected at most {_MOST_LEDS} LEDs"
            )
        for name in ("rows", "columns"):
            n, block = getattr(self, name), getattr(self, f"cluster_{name}")
            if n % block:
                raise ConfigError(f"bar.cluster_{name} = {block}: expected a divisor of bar.{name} = {n}")

    @property
    def clusters(self) -> int:
        """Number of clusters K."""
        return (self.rows // self.cluster_rows) * (self.columns // self.cluster_columns)

    @property
    def length_m(self) -> float:
        """From the outer edge of the first row of LEDs to that of the last, m."""
        return self.rows * self.led_pitch_m

    def led_positions_m(self) -> NDArray[np.float64]:
        """LED centres (x right, y down) from the bar's centre, m, float64 (rows * columns, 2)."""
        y, x = np.mgrid[: self.rows, : self.columns]
        xy = np.stack([x - (self.columns - 1) / 2, y - (self.rows - 1) / 2], -1)
        return xy.reshape(-1, 2) * self.led_pitch_m

    def led_clusters(self) -> NDArray[np.int64]:
        """Cluster of each LED, int64 (rows * columns,)."""
        y, x = np.mgrid[: self.rows, : self.columns]
        across = self.columns // self.cluster_columns
        which: NDArray[np.int64] = (y // self.cluster_rows) * across + x // self.cluster_columns
        return which.ravel()

    def cluster_centres_m(self) -> NDArray[np.float64]:
        """Cluster centres (x right, y down) from the bar's centre, m, float64 (K, 2)."""
        which = self.led_clusters()
        count = np.bincount(which)
        led = self.led_positions_m()
        return np.stack([np.bincount(which, led[:, i]) / count for i in (0, 1)], -1)
