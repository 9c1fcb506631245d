"""Characters on air: their bits, their chips, and how likely each is by the edges that are seen."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

__all__ = ["Characters", "Parity"]

Parity = Literal["none", "even", "odd"]


@dataclass(frozen=True)
class Characters:
    """The format of a character: a start bit, data bits from the least significant on, parity, stop bits.

    >>> Characters(7, "even", 2).levels()[0x41].tolist()
    [0, 1, 0, 0, 0, 0, 0, 1, 0, 1, 1]
    """

    data_bits: int = 8
    parity: Parity = "none"
    stop_bits: int = 1

    @property
    def bits(self) -> int:
        """Bits on air of a character, start and stop bits included."""
        return 1 + self.data_bits + (self.parity != "none") + self.stop_bits

    @property
    def edges(self) -> int:
        """Places at which a character may have an edge: before every bit up to the first stop bit."""
        return self.bits - self.stop_bits + 1

    def levels(self) -> NDArray[np.uint8]:
        """Every character, 1 for mark, uint8 (2**data_bits, bits)."""
        values = np.arange(1 << self.data_bits)
        data = (values[:, None] >> np.arange(self.data_bits)) & 1
        found = np.ones((len(values), self.bits), np.uint8)
        found[:, 0] = 0
        found[:, 1 : 1 + self.data_bits] = data
        if self.parity != "none":
            found[:, 1 + self.data_bits] = (data.sum(1) + (self.parity == "odd")) % 2
        return found

    @cached_property
    def falling(self) -> NDArray[np.float64]:
        """1 where each character falls from mark to space, float64 (2**data_bits, edges)."""
        return self._edges(self.levels())[0]

    @cached_property
    def rising(self) -> NDArray[np.float64]:
        """1 where each rises from space to mark, float64 (2**data_bits, edges)."""
        return self._edges(self.levels())[1]

    def _edges(self, levels: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        steps = np.diff(np.pad(levels[:, : self.edges], ((0, 0), (1, 0)), constant_values=1).astype(np.int64))
        return (steps < 0).astype(np.float64), (steps > 0).astype(np.float64)

    def likelihoods(self, falls: NDArray[np.float64], rises: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log-likelihood of every character against no edge, float64 (n, 2**data_bits).

        Args:
            falls: Evidence of a fall at each of its places, float64 (n, edges).
            rises: The same of a rise.
        """
        found: NDArray[np.float64] = falls @ self.falling.T + rises @ self.rising.T
        return found

    def wrong_parity(self, falls: NDArray[np.float64], rises: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether the bits that are likeliest by themselves have the wrong parity, bool (n,)."""
        if self.parity == "none":
            return np.zeros(len(falls), np.bool_)
        other = self.levels()
        other[:, 1 + self.data_bits] ^= 1
        fell, rose = self._edges(other)
        right = self.likelihoods(falls, rises).max(1, initial=-np.inf)
        wrong: NDArray[np.bool_] = (falls @ fell.T + rises @ rose.T).max(1, initial=-np.inf) > right
        return wrong

    def soft(
        self, likelihoods: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float64]]:
        """What is said, with how sure, from log-likelihoods of every character, (n, 2**data_bits).

        Returns:
            The likeliest characters, int64 (n,); LLRs ln P(0) / P(1) of their data bits, most significant
            first, float32 (n, data_bits); and the probability that the character is right, float64 (n,).
        """
        top = likelihoods.max(1, initial=-np.inf, keepdims=True)
        weights = np.exp(likelihoods - top)
        total = weights.sum(1)
        ones = (np.arange(1 << self.data_bits)[:, None] >> np.arange(self.data_bits - 1, -1, -1)) & 1
        of_one = weights @ ones
        least = 1e-30
        llr = np.log(np.maximum(total[:, None] - of_one, least)) - np.log(np.maximum(of_one, least))
        best = likelihoods.argmax(1)
        return best, llr.astype(np.float32), 1 / total
