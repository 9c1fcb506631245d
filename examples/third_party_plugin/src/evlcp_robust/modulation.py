"""Return to zero: a pulse for a one, none for a zero."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

import evlcp_sdk as evlcp

__all__ = ["ReturnToZero"]


@dataclass(frozen=True)
class ReturnToZero(evlcp.Modulation):
    """Each bit has two chips, the first of them lit for a one; a pulse before them keeps time.

    >>> ReturnToZero(bits=2).codewords().tolist()
    [[1, 0, 0, 0, 0, 0], [1, 0, 0, 0, 1, 0], [1, 0, 1, 0, 0, 0], [1, 0, 1, 0, 1, 0]]
    """

    bits: Annotated[int, Field(ge=1, le=6, description="Bits of a symbol.")] = 5

    def codewords(self) -> NDArray[np.uint8]:
        """uint8 (2 ** bits, 2 + 2 * bits)."""
        bits = np.arange(2**self.bits)[:, None] >> np.arange(self.bits - 1, -1, -1) & 1
        words = np.zeros((len(bits), 2 + 2 * self.bits), np.uint8)
        words[:, 0] = 1
        words[:, 2::2] = bits
        return words
