"""Walsh-Hadamard codes that are lit for less than half of the time."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import BARKER13, pilot_values, wh4x2_values
from evlcp_sdk.plugin.roles import Modulation, Pilots

Slots = Annotated[
    int,
    Field(
        ge=4,
        le=16,
        multiple_of=2,
        description="Chips of a value, one of them lit; 4: a quarter of the light.",
    ),
]


def pulse_chips(values: ArrayLike, slots: int) -> NDArray[np.uint8]:
    """Chips of bipolar values along the last axis, one of `slots` lit each.

    It is the last of all for +1, the last of the first half for -1: every value starts dark, so that the rise
    of its pulse is its own. Two slots are a pair code.

    >>> pulse_chips([1, -1], 4).tolist()
    [0, 0, 0, 1, 0, 1, 0, 0]
    """
    v = np.asarray(values)
    chips = np.zeros((*v.shape, slots), np.uint8)
    chips[..., slots - 1] = v > 0
    chips[..., slots // 2 - 1] = v < 0
    return chips.reshape(*v.shape[:-1], -1)


@dataclass(frozen=True)
class DimmedPilots(Pilots):
    """Rows of a Hadamard matrix and the same inverted, each value a pulse in one half of its time.

    >>> DimmedPilots().codes(2).shape, float(DimmedPilots().codes(2).mean())
    ((2, 32), 0.25)
    """

    slots: Slots = 4

    def preamble(self) -> NDArray[np.uint8]:
        """Barker-13 of pulses, uint8 (13 * slots,)."""
        return pulse_chips(BARKER13, self.slots)

    def codes(self, clusters: int) -> NDArray[np.uint8]:
        """uint8 (clusters, N), N = 8 * slots for up to 16 clusters."""
        return pulse_chips(pilot_values(clusters), self.slots)


@dataclass(frozen=True)
class DimmedWh4x2(Modulation):
    """Two words of H_4, 3 bits each, each value a pulse in one half of its time: 6 bits a symbol."""

    slots: Slots = 4

    def codewords(self) -> NDArray[np.uint8]:
        """uint8 (64, 8 * slots)."""
        return pulse_chips(wh4x2_values(), self.slots)
