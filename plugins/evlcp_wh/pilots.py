"""Walsh-Hadamard pilots."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import BARKER13, chips_of_values, pilot_values
from evlcp_sdk.plugin.roles import Pilots


@dataclass(frozen=True)
class WhPilots(Pilots):
    """Rows of a Hadamard matrix, then the same rows inverted (air interface 1, Codes).

    The order is 8, as on air, for up to 16 clusters; above, the next power of two that is long enough.

    >>> WhPilots().codes(16)[9].tolist()
    [1, 0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1]
    """

    def preamble(self) -> NDArray[np.uint8]:
        """Barker-13 in pairs of chips, uint8 (26,)."""
        return chips_of_values(BARKER13)

    def codes(self, clusters: int) -> NDArray[np.uint8]:
        """uint8 (clusters, N), N = 16 for up to 16 clusters."""
        return chips_of_values(pilot_values(clusters))
