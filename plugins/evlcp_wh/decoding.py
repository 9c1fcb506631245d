"""What the info segment of each cluster says."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.plugin.roles import Decode, Decoding
from evlcp_sdk.values import PresenceMap, SoftSymbols, plain
from evlcp_wh import _kernels

_MIN_WEIGHT = 0.01
"""Presence probability below which a cell is passed over: it adds nothing that is seen, but takes time."""


class WordMatch(NamedTuple):
    """Nearest words of a frame's values.

    Attributes:
        symbols: Of each cluster, int64 (K,).
        best: Their correlations, float64 (K,).
        margins: By how much words with a bit 0 correlate better than those with 1, max-log, float64
            (K, bits).
        agreement: Share of the values' sizes that agrees with the words.
        least: The least size of a margin.
    """

    symbols: NDArray[np.int64]
    best: NDArray[np.float64]
    margins: NDArray[np.float64]
    agreement: float
    least: float


def match_words(values: NDArray[np.float64], by_value: NDArray[np.float64], bits: int) -> WordMatch:
    """Nearest words of values, float64 (K, n).

    Args:
        values: Of each cluster.
        by_value: The words, float64 (n, 2**bits or more); those beyond 2**bits carry no bits.
        bits: Of a symbol.
    """
    symbols, best = np.empty(len(values), np.int64), np.empty(len(values))
    margins = np.empty((len(values), bits))
    agreement, least = _kernels.match_words(values, by_value, symbols, best, margins)
    return WordMatch(symbols, best, margins, agreement, least)


@dataclass(frozen=True)
class WhTransform(Decoding):
    """Presence-weighted sum of the info values, correlated with every codeword (arXiv 2510.17203).

    For the WH profiles that correlation is a Walsh-Hadamard transform. Log-likelihood ratios are those of
    the best codewords (max-log) on a Gaussian channel whose amplitude and noise are taken from the frame:
    all clusters have one amplitude, the mean, and one noise, as eight values are too few for one each. A dim
    cluster, whose correlations are small beside them, is unsure.
    """

    def compile(self, codebook: Codebook) -> Decode:
        """Precompute for a codebook's codewords."""
        codebook.require_pairs("decoding", "wh-transform", "edges")
        by_value = np.ascontiguousarray(codebook.codeword_edges.T, np.float64)
        pilot_chips, length = codebook.pilots.shape[1], len(by_value)

        def decode(presence: PresenceMap, sums: NDArray[np.int16]) -> SoftSymbols:
            probability = plain(presence.probability)
            values = np.zeros((len(probability), length))
            info = plain(sums[pilot_chips:])
            _kernels.weighted_values(info, probability, presence.grid_px, _MIN_WEIGHT, values)
            symbols, best, margins, _, _ = match_words(values, by_value, codebook.bits_per_symbol)
            energy, explained = float(np.vdot(values, values)), float(best @ best) / length
            rest = max(energy - explained, 1e-3 * energy, 1e-9)
            scale = max(float(best.sum()) / best.size / length, 0.0) * values.size / rest
            quality = explained / energy if energy > 0 else 0.0
            return SoftSymbols(symbols, (margins * scale).astype(np.float32), quality)

        return decode
