"""Separation of clusters by the correlation of cells with pilots."""

from dataclasses import dataclass
from math import log
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.plugin.roles import Separate, Separation
from evlcp_sdk.values import PresenceMap, to_kernel_array
from evlcp_wh import _kernels

_VALUE_ERROR = 0.1
"""Probability that a cell's value is wrong: of a cell half beside the bar, which is one of four."""

_MIN_VALUES = 4
"""Values with events that a cell needs to show a cluster: half of a pilot excludes most others."""

_MIN_PROBABILITY = 0.5
"""Presence probability that selects a cell: more likely one cluster than any other, or none."""


class CellPosterior:
    """Bayes' rule with equal priors for the pilots of a codebook, int64 (K, values)."""

    def __init__(self, pilots: NDArray[np.int64]) -> None:
        self._pilots = pilots
        clusters, n = pilots.shape
        agree, disagree = log((1 - _VALUE_ERROR) / 0.5), log(_VALUE_ERROR / 0.5)
        self._ratios = np.exp(np.arange(2 * n + 1) * (disagree - agree) / 2)
        seen, best = np.arange(n + 1)[:, None], np.arange(-n, n + 1)
        self._none_ratios = clusters * np.exp(-(agree * (seen + best) + disagree * (seen - best)) / 2)

    def probability(self, sums: NDArray[np.int16], grid_px: int) -> NDArray[np.float32]:
        """Of each cluster in each cell, float32 (K, rows, columns), by polarity sums, pilot first."""
        _, height, width = sums.shape
        out = np.zeros((len(self._pilots), height // grid_px, width // grid_px), np.float32)
        _kernels.estimate_presence(
            sums, self._pilots, grid_px, self._ratios, self._none_ratios, _MIN_VALUES, out
        )
        return out


@dataclass(frozen=True)
class WhCorrelation(Separation):
    """Correlation of each grid cell's values with every pilot, as a probability (arXiv 2510.17203).

    A cell shows one cluster or none. If one, each of its values agrees with that cluster's pilot but for
    an error; if none, values are coin tosses. Bayes' rule with equal priors gives the probabilities.
    """

    grid_px: Annotated[int, Field(ge=2, le=16, description="Side of a grid cell.")] = 2

    def compile(self, codebook: Codebook) -> Separate:
        """Precompute for a codebook's pilots."""
        codebook.require_pairs("separation", "wh-correlation", "edges")
        codes = codebook.pilot_edges.astype(np.int64)
        posterior = CellPosterior(codes)

        def separate(sums: NDArray[np.int16]) -> PresenceMap:
            sums = to_kernel_array(sums)
            probability = posterior.probability(sums, self.grid_px)
            selected, grid = np.empty(probability.shape, np.bool_), self.grid_px
            pixels = np.zeros((len(codes), *sums.shape[1:]), np.float32)
            _kernels.map_pixels(sums, codes, grid, probability, _MIN_PROBABILITY, selected, pixels)
            return PresenceMap(probability, grid, selected, pixels)

        return separate
