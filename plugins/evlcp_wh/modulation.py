"""The three info-segment profiles of air interface 1."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import chips_of_values, signed_hadamard, wh4x2_values
from evlcp_sdk.plugin.roles import Modulation


@dataclass(frozen=True)
class Wh4x2(Modulation):
    """Two words of H_4, 3 bits (sign, row) each: 6 bits a symbol.

    >>> Wh4x2().codewords()[0b100_011].tolist()
    [1, 0, 1, 0, 1, 0, 1, 0, 0, 1, 1, 0, 1, 0, 0, 1]
    """

    def codewords(self) -> NDArray[np.uint8]:
        """uint8 (64, 16)."""
        return chips_of_values(wh4x2_values())


@dataclass(frozen=True)
class Wh8(Modulation):
    """One word of H_8: 4 bits (sign, row) a symbol; the robust profile."""

    def codewords(self) -> NDArray[np.uint8]:
        """uint8 (16, 16)."""
        return chips_of_values(signed_hadamard(8))


@dataclass(frozen=True)
class Raw8(Modulation):
    """Eight plain values: 8 bits a symbol; the fast profile.

    >>> Raw8().codewords()[0b10000001].tolist()
    [0, 1, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 0, 1]
    """

    def codewords(self) -> NDArray[np.uint8]:
        """uint8 (256, 16)."""
        bits = np.arange(256)[:, None] >> np.arange(7, -1, -1) & 1
        return chips_of_values(2 * bits - 1)
