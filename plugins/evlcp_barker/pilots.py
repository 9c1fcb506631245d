"""Pilots from one Barker word."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import BARKER13
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Pilots

__all__ = ["Barker13Pilots"]


@dataclass(frozen=True)
class Barker13Pilots(Pilots):
    """The 13 cyclic shifts of Barker-13, then the same inverted.

    Two shifts correlate by 1 of 13, so 26 clusters are distinguished with pilots of 26 chips.

    >>> codes = Barker13Pilots().codes(13)
    >>> sorted(set((codes.astype(int) @ codes.T).ravel().tolist()))
    [1, 13]
    """

    def preamble(self) -> NDArray[np.int8]:
        """Barker-13, int8 (13,)."""
        return np.array(BARKER13, np.int8)

    def codes(self, clusters: int) -> NDArray[np.int8]:
        """int8 (clusters, 13).

        Raises:
            ConfigError: More than 26 clusters.
        """
        if clusters > 26:
            raise ConfigError(f"pilots 'barker13': {clusters} clusters, expected at most 26")
        word = np.array(BARKER13, np.int8)
        shifts = np.stack([np.roll(word, k) for k in range(13)])
        return np.concatenate([shifts, -shifts])[:clusters]
