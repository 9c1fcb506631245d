"""What the info segment of each cluster says."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.plugin.roles import Decode, Decoding
from evlcp_sdk.values import PresenceMap, SoftSymbols

__all__ = ["WhTransform"]


@dataclass(frozen=True)
class WhTransform(Decoding):
    """Presence-weighted sum of the info values, correlated with every codeword (arXiv 2510.17203).

    For the WH profiles that correlation is a Walsh-Hadamard transform. Log-likelihood ratios are those of
    the best codewords (max-log) on a Gaussian channel whose amplitude and noise are taken from the frame.
    """

    min_weight: Annotated[
        float, Field(gt=0, lt=1, description="Presence probability below which a cell is passed over.")
    ] = 0.01

    def compile(self, codebook: Codebook) -> Decode:
        """Precompute for a codebook's codewords."""
        codebook.require_pairs("decoding", "wh-transform", "edges")
        words = np.ascontiguousarray(codebook.codeword_edges.T, np.float64)
        pilot_chips = codebook.pilots.shape[1]
        length, m = len(words), codebook.bits_per_symbol

        def decode(presence: PresenceMap, sums: NDArray[np.int16]) -> SoftSymbols:
            from evlcp_wh import _kernels

            values = np.zeros((len(presence.probability), length))
            info = sums[pilot_chips:]
            _kernels.weighted_values(info, presence.probability, presence.grid_px, self.min_weight, values)
            fit = values @ words
            symbols = fit.argmax(1)
            energy = float(np.vdot(values, values))
            amplitude = fit.max(1) / length
            explained = float(np.vdot(amplitude, amplitude)) * length
            # One amplitude and one noise for all clusters of a frame: eight values are too few for one each.
            # A dim cluster, whose correlations are small beside them, is unsure.
            rest = max(energy - explained, 1e-3 * energy, 1e-9)
            scale = max(float(amplitude.mean()), 0.0) * values.size / rest
            zero, one = np.empty((2, len(values), m))
            _kernels.max_log(fit, m, zero, one)
            llr = ((zero - one) * scale).astype(np.float32)
            return SoftSymbols(symbols, llr, explained / energy if energy else 0.0)

        return decode
