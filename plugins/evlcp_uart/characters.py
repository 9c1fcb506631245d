"""The format of characters: their bits on air, and the likelihood of each by the evidence of its bits."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evlcp_uart.light import BEFORE, Floats, Ticks

Parity = Literal["none", "even", "odd"]
BitOrder = Literal["lowest", "highest"]


@dataclass(frozen=True)
class Characters:
    """The format of a character: a start bit, data bits, parity, stop bits.

    Data start with the least significant bit, as of a serial port, or with the most significant one.

    >>> Characters(7, "even", 2).levels()[0x43].tolist()
    [0, 1, 1, 0, 0, 0, 0, 1, 1, 1, 1]
    >>> Characters(7, "even", 2, "highest").levels()[0x43].tolist()
    [0, 1, 0, 0, 0, 0, 1, 1, 1, 1, 1]
    """

    data_bits: int = 8
    parity: Parity = "none"
    stop_bits: int = 1
    first: BitOrder = "lowest"

    @property
    def bits(self) -> int:
        """Bits on air of a character, start and stop bits included."""
        return 1 + self.data_bits + (self.parity != "none") + self.stop_bits

    def levels(self) -> NDArray[np.uint8]:
        """Return the bits of every character, 1 for mark, uint8 (2**data_bits, bits)."""
        values = np.arange(1 << self.data_bits)
        shifts = np.arange(self.data_bits)
        data = (values[:, None] >> (shifts if self.first == "lowest" else shifts[::-1])) & 1
        found = np.ones((len(values), self.bits), np.uint8)
        found[:, 0] = 0
        found[:, 1 : 1 + self.data_bits] = data
        if self.parity != "none":
            found[:, 1 + self.data_bits] = (data.sum(1) + (self.parity == "odd")) % 2
        return found

    @cached_property
    def contexts(self) -> Ticks:
        """Context of each bit of every character after a mark, int64 (2**data_bits, bits)."""
        return _find_contexts(self.levels())

    def likelihoods(self, evidence: Floats) -> Floats:
        """Return the log-likelihood of every character, float64 (n, 2**data_bits).

        Args:
            evidence: Log-likelihood of each context at each bit, float64 (n, bits, C).
        """
        return _sum_evidence(evidence, self.contexts)

    def has_wrong_parity(self, evidence: Floats) -> NDArray[np.bool_]:
        """Return whether the likeliest bits without the parity have the wrong one, bool (n,)."""
        if self.parity == "none":
            return np.zeros(len(evidence), np.bool_)
        other = self.levels()
        other[:, 1 + self.data_bits] ^= 1
        right = self.likelihoods(evidence).max(1)
        wrong: NDArray[np.bool_] = _sum_evidence(evidence, _find_contexts(other)).max(1) > right
        return wrong

    def frame_evidence(self, evidence: Floats) -> Floats:
        """Return the log-likelihood ratio of any character and of free bits, nats, float64 (n,).

        Perfect evidence gives ln 2 for each start, parity and stop bit.
        """
        many, bits, contexts = evidence.shape
        states = np.full((many, contexts // 2), -np.inf)
        states[:, -1] = 0.0
        for bit in range(bits):
            grown = np.repeat(states, 2, 1) + evidence[:, bit]
            # Sum over the oldest bit.
            states = np.logaddexp(grown[:, : contexts // 2], grown[:, contexts // 2 :])
        any_bits = np.logaddexp.reduce(states, 1) - bits * np.log(2)
        words = np.logaddexp.reduce(self.likelihoods(evidence), 1) - self.data_bits * np.log(2)
        found: Floats = words - any_bits
        return found

    def clearness(self, evidence: Floats) -> float:
        """Return how clear the data bits of characters are, 0 to 1."""
        likelihoods = self.likelihoods(evidence)
        logs = likelihoods - np.logaddexp.reduce(likelihoods, 1)[:, None]
        unknown = -(np.exp(logs) * logs).sum() / np.log(2)
        return float(1 - unknown / (self.data_bits * len(evidence)))

    def decide(self, likelihoods: Floats) -> tuple[Ticks, NDArray[np.float32], Floats]:
        """Decide on characters by the log-likelihoods of all of them, (n, 2**data_bits).

        Returns:
            The likeliest characters, int64 (n,); LLRs ln P(0) / P(1) of their data bits, most significant
            first, float32 (n, data_bits); and the probability that the character is right, float64 (n,).
        """
        top = likelihoods.max(1, keepdims=True)
        weights = np.exp(likelihoods - top)
        total = weights.sum(1)
        ones = (np.arange(1 << self.data_bits)[:, None] >> np.arange(self.data_bits - 1, -1, -1)) & 1
        of_one = weights @ ones
        least = 1e-30
        llr = np.log(np.maximum(total[:, None] - of_one, least)) - np.log(np.maximum(of_one, least))
        best = likelihoods.argmax(1)
        return best, llr.astype(np.float32), 1 / total


def _find_contexts(levels: NDArray[np.uint8]) -> Ticks:
    known = np.pad(levels.astype(np.int64), ((0, 0), (BEFORE, 0)), constant_values=1)
    bits = levels.shape[1]
    found = np.zeros(levels.shape, np.int64)
    for k in range(BEFORE + 1):
        found = 2 * found + known[:, k : k + bits]
    return found


def _sum_evidence(evidence: Floats, contexts: Ticks) -> Floats:
    bits = np.arange(contexts.shape[1])
    found: Floats = evidence[:, bits, contexts].sum(2)
    return found
