"""Pilots from one Barker word."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import BARKER13, chips_of_values
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Pilots


@dataclass(frozen=True)
class Barker13Pilots(Pilots):
    """The 13 cyclic shifts of Barker-13, then the same inverted.

    Two shifts correlate by 1 of 13, so 26 clusters are distinguished with pilots of 26 chips.

    >>> values = Barker13Pilots().codes(13)[:, 1::2].astype(int) * 2 - 1
    >>> sorted(set((values @ values.T).ravel().tolist()))
    [1, 13]
    """

    def preamble(self) -> NDArray[np.uint8]:
        """Barker-13 in pairs of chips, uint8 (26,)."""
        return chips_of_values(BARKER13)

    def codes(self, clusters: int) -> NDArray[np.uint8]:
        """uint8 (clusters, 26).

        Raises:
            ConfigError: More than 26 clusters.
        """
        if clusters > 26:
            raise ConfigError(f"pilots 'barker13': {clusters} clusters, expected at most 26")
        word = np.array(BARKER13, np.int8)
        shifts = np.stack([np.roll(word, k) for k in range(13)])
        return chips_of_values(np.concatenate([shifts, -shifts])[:clusters])
