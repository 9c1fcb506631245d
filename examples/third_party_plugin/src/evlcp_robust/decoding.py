"""Symbols by the majority of cells."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

import evlcp_sdk as evlcp

__all__ = ["Majority"]


@dataclass(frozen=True)
class Majority(evlcp.Decoding):
    """One vote a cell and value, whatever the number of its events.

    A cell that shows a cluster votes for each of its values: with the sign of the second chip's polarity
    sum, else against that of the first's. The codeword that agrees with most votes wins. How often votes are
    wrong is learned from the pilots, which are known: to the log-likelihood ratios, votes are a binary
    symmetric channel with that probability of error.
    """

    min_presence: Annotated[
        float, Field(ge=0, lt=1, description="Presence probability above which a cell may vote.")
    ] = 0.5

    def compile(self, codebook: evlcp.Codebook) -> evlcp.Decode:
        """Precompute which codewords have a 0 in each bit."""
        codebook.require_pairs("decoding", "robust", "edges")
        words = codebook.codeword_edges.astype(np.int64)
        pilots = codebook.pilot_edges.astype(np.int64)
        m = codebook.bits_per_symbol
        zero = (np.arange(len(words)) >> np.arange(m - 1, -1, -1)[:, None] & 1) == 0

        def decode(presence: evlcp.PresenceMap, sums: NDArray[np.int16]) -> evlcp.SoftSymbols:
            votes = _votes(sums, presence.grid_px)
            voters = (presence.probability > self.min_presence).astype(np.int64)
            count = np.tensordot(voters, votes, ([1, 2], [1, 2]))
            cast = np.tensordot(voters, np.abs(votes), ([1, 2], [1, 2]))
            pilot_sums, value_sums = count[:, : pilots.shape[1]], count[:, pilots.shape[1] :]
            pilot_votes = int(cast[:, : pilots.shape[1]].sum())
            wrong = (pilot_votes - int((pilot_sums * pilots).sum())) / 2
            # Laplace's rule of succession: few votes are not sure, however well they agree.
            error = min((wrong + 1) / (pilot_votes + 2), 0.5)
            fit = value_sums @ words.T
            # ln P(votes | codeword), but for what is common to all: half the votes ahead times the log-odds.
            likelihood = fit[:, None] * (np.log((1 - error) / error) / 2)
            sides = (np.where(z, likelihood, -np.inf) for z in (zero, ~zero))
            llr = np.subtract(*(np.logaddexp.reduce(side, -1) for side in sides))
            total = int(cast[:, pilots.shape[1] :].sum())
            quality = max(int(fit.max(1).sum()), 0) / total if total else 0.0
            return evlcp.SoftSymbols(fit.argmax(1), llr.astype(np.float32), quality)

        return decode


def _votes(sums: NDArray[np.int16], grid_px: int) -> NDArray[np.int64]:
    """Vote of each cell for each value, -1, 0 or 1, int64 (values, rows, columns)."""
    chips, height, width = sums.shape
    rows, columns = height // grid_px, width // grid_px
    cells = sums[:, : rows * grid_px, : columns * grid_px].reshape(chips, rows, grid_px, columns, grid_px)
    sign = np.sign(cells.sum((2, 4), dtype=np.int64))
    first, second = sign[::2], sign[1::2]
    return np.where(second != 0, second, -first)
