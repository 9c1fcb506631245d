"""What the info segment of each cluster says, by likelihoods learned from the pilots."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.abc import Decode, Decoding
from evlcp_sdk.codebook import Codebook
from evlcp_sdk.types import PresenceMap, SoftSymbols

__all__ = ["MlSoft"]


@dataclass(frozen=True)
class MlSoft(Decoding):
    """Sum of per-pixel log-likelihood ratios, by how many events of which sign a value's two chips have.

    Pilots are known, so each frame shows how often a value of +1 or -1 comes with which pair of polarity
    sums, missed and late events included: two histograms over the pixels of all clusters. Their
    log ratio says what a pair of sums is worth, in the info segment of the same frame. Where the camera sends
    no negative events, silence in both chips counts for what it is worth, too.
    """

    max_events: Annotated[
        int, Field(ge=1, le=16, description="Polarity sums beyond this many events count as this many.")
    ] = 3
    min_weight: Annotated[
        float, Field(gt=0, lt=1, description="Presence probability below which a cell is passed over.")
    ] = 0.05
    prior_count: Annotated[
        float, Field(gt=0, description="Observations added to every cell of the histograms.")
    ] = 1.0
    independent_pixels: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="Share of the pixels that err by themselves; neighbours share light and motion.",
        ),
    ] = 0.25

    def compile(self, codebook: Codebook) -> Decode:
        """Precompute for a codebook's pilots and codewords."""
        words = codebook.codewords.astype(np.float64)
        pilots = codebook.pilots.astype(np.int64)
        m, pilot_chips = codebook.bits_per_symbol, 2 * pilots.shape[1]
        side = 2 * self.max_events + 1

        def decode(presence: PresenceMap, sums: NDArray[np.int16]) -> SoftSymbols:
            from evlcp_wh import _kernels

            clusters = len(presence.probability)
            pilot, info = sums[:pilot_chips], sums[pilot_chips:]
            counts = np.full((2, side, side), self.prior_count)
            _kernels.count_pairs(
                pilot, pilots, presence.probability, presence.grid_px, self.max_events, counts
            )
            share = counts / counts.sum((1, 2), keepdims=True)
            worth = np.log(share[1] / share[0])
            values = np.zeros((clusters, words.shape[1]))
            _kernels.sum_worth(
                info, presence.probability, presence.grid_px, self.min_weight, self.max_events, worth, values
            )
            fit = values @ words.T / 2 * self.independent_pixels
            zero, one = np.empty((2, clusters, m))
            _kernels.max_log(fit, m, zero, one)
            symbols = fit.argmax(1)
            signs = np.sign(values) * words[symbols]
            size = np.abs(values)
            total = float(size.sum())
            quality = float((size * (signs > 0)).sum()) / total if total else 0.0
            return SoftSymbols(symbols, (zero - one).astype(np.float32), quality)

        return decode
