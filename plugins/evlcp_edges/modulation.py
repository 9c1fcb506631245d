"""Codewords that are no pair codes: pulse position, and balanced words without return to zero."""

from dataclasses import dataclass
from itertools import product
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import edges_of_chips
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Modulation


@dataclass(frozen=True)
class Ppm(Modulation):
    """Pulse position modulation: in each pulse's time one chip is lit, by the data.

    `positions` chips a pulse; of `positions ** pulses` symbols, the first power of two carry bits.

    >>> Ppm(positions=4, pulses=1).codewords().tolist()
    [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    """

    positions: Annotated[int, Field(ge=2, le=16, description="Chips of a pulse's time, one of them lit.")] = 4
    pulses: Annotated[int, Field(ge=1, le=8, description="Pulses of a symbol.")] = 3

    def __post_init__(self) -> None:
        if self.positions**self.pulses > 4096:
            raise ConfigError(
                f"modulation.pulses = {self.pulses}: {self.positions}^{self.pulses} symbols, expected 4096"
                " at most"
            )

    def codewords(self) -> NDArray[np.uint8]:
        """uint8 (positions ** pulses, positions * pulses)."""
        lit = np.eye(self.positions, dtype=np.uint8)
        places = np.array(list(product(range(self.positions), repeat=self.pulses)))
        words: NDArray[np.uint8] = lit[places].reshape(len(places), -1)
        return words


@dataclass(frozen=True)
class Nrz(Modulation):
    """Words without return to zero: as many chips lit as dark, but for a few, and no long runs.

    As in 8b/10b (Widmer and Franaszek 1983), without its running disparity: of all words of so many chips,
    those are taken that are within `disparity` of balance and have no run of more than `longest_run` chips,
    the most balanced with the most edges first, `2 ** bits` of them. A run may go on in the next word.

    >>> Nrz(chips=4, bits=2, disparity=0, longest_run=2).codewords().tolist()
    [[0, 1, 0, 1], [1, 0, 1, 0], [0, 1, 1, 0], [1, 0, 0, 1]]
    """

    chips: Annotated[int, Field(ge=4, le=16, description="Chips of a word.")] = 10
    bits: Annotated[int, Field(ge=1, le=12, description="Bits that it carries.")] = 8
    disparity: Annotated[
        int, Field(ge=0, le=4, description="Most lit chips more than dark ones, or less.")
    ] = 2
    longest_run: Annotated[int, Field(ge=1, le=8, description="Most chips alike in a row.")] = 4

    def codewords(self) -> NDArray[np.uint8]:
        """uint8 (2 ** bits, chips).

        Raises:
            ConfigError: There are fewer such words.
        """
        words = (np.arange(2**self.chips)[:, None] >> np.arange(self.chips - 1, -1, -1) & 1).astype(np.uint8)
        off = np.abs(2 * words.sum(1, dtype=np.int64) - self.chips)
        edges = np.abs(edges_of_chips(words)).sum(1, dtype=np.int64)
        windows = np.lib.stride_tricks.sliding_window_view(
            words, min(self.longest_run + 1, self.chips), axis=1
        )
        even = (windows != windows[..., :1]).any(-1).all(1)
        fit = np.flatnonzero(even & (off <= self.disparity) & (edges > 0))
        if len(fit) < 2**self.bits:
            raise ConfigError(
                f"modulation.bits = {self.bits}: expected at most {max(len(fit), 1).bit_length() - 1}, as"
                f" {len(fit)} words of {self.chips} chips are balanced to {self.disparity} with no run over"
                f" {self.longest_run}"
            )
        best = fit[np.lexsort((fit, -edges[fit], off[fit]))]
        return words[best[: 2**self.bits]]
