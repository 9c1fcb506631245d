"""Which cluster does a part of the image show."""

from dataclasses import dataclass
from math import log
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.late import Late
from evlcp_sdk.plugin.roles import Separate, Separation
from evlcp_sdk.values import PresenceMap, plain

if TYPE_CHECKING:
    from evlcp_wh import _kernels
else:
    _kernels = Late("evlcp_wh._kernels")

__all__ = ["ErrorShare", "MinValues", "WhCorrelation"]

ErrorShare = Annotated[
    float, Field(gt=0, lt=0.5, description="Probability that a cell's value is seen wrong.")
]
MinValues = Annotated[
    int, Field(ge=1, description="Values that must be seen in a cell for it to show a cluster.")
]


@dataclass(frozen=True)
class WhCorrelation(Separation):
    """Correlation of each grid cell's values with every pilot, as a probability (arXiv 2510.17203).

    A cell shows one cluster or none. If one, each of its values agrees with that cluster's pilot but for
    an error; if none, values are coin tosses. Bayes' rule with equal priors gives the probabilities.
    """

    grid_px: Annotated[int, Field(ge=2, le=16, description="Side of a grid cell.")] = 2
    value_error: ErrorShare = 0.1
    min_values: MinValues = 4
    min_probability: Annotated[
        float, Field(gt=0, lt=1, description="Presence probability that selects a cell.")
    ] = 0.5

    def compile(self, codebook: Codebook) -> Separate:
        """Precompute for a codebook's pilots."""
        codebook.require_pairs("separation", "wh-correlation", "edges")
        codes = codebook.pilot_edges.astype(np.int64)
        odds = log((1 - self.value_error) / 0.5), log(self.value_error / 0.5), self.min_values
        least = self.min_probability

        def separate(sums: NDArray[np.int16]) -> PresenceMap:
            _, height, width = sums.shape
            rows, columns = height // self.grid_px, width // self.grid_px
            cells = len(codes), rows, columns
            probability, selected = np.zeros(cells, np.float32), np.empty(cells, np.bool_)
            pixels = np.zeros((len(codes), height, width), np.float32)
            _kernels.separated(plain(sums), codes, self.grid_px, odds, least, probability, selected, pixels)
            return PresenceMap(probability, self.grid_px, selected, pixels)

        return separate
