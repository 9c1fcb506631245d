"""What the info segment of each cluster says."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.late import Late
from evlcp_sdk.plugin.roles import Decode, Decoding
from evlcp_sdk.values import PresenceMap, SoftSymbols, plain

if TYPE_CHECKING:
    from evlcp_wh import _kernels
else:
    _kernels = Late("evlcp_wh._kernels")

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
        by_value = np.ascontiguousarray(codebook.codeword_edges.T, np.float64)
        pilot_chips, m = codebook.pilots.shape[1], codebook.bits_per_symbol

        def decode(presence: PresenceMap, sums: NDArray[np.int16]) -> SoftSymbols:
            symbols = np.empty(len(presence.probability), np.int64)
            llr = np.empty((len(symbols), m), np.float32)
            explained = _kernels.transformed(
                plain(sums[pilot_chips:]),
                plain(presence.probability),
                presence.grid_px,
                self.min_weight,
                by_value,
                symbols,
                llr,
            )
            return SoftSymbols(symbols, llr, explained)

        return decode
