"""Decoding of the info segment of each cluster: correlation with codewords, and likelihoods."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.plugin.roles import Decode, Decoding
from evlcp_sdk.values import PresenceMap, SoftSymbols, to_kernel_array
from evlcp_wh import _kernels

_MIN_WEIGHT, _MIN_SOFT_WEIGHT = 0.01, 0.05
"""Presence probability below which a cell is left out by `wh-transform`, and by others: it only adds time."""

MAX_EVENTS = 3
"""Polarity sums beyond this many events count as this many: more are too rare to learn."""

_PRIOR_COUNT = 1.0
"""Observations added to every pair of sums: those seen once or twice by chance mean little."""

INDEPENDENT_PIXELS = 0.25
"""Share of the pixels that err by themselves; neighbours share light and motion."""

_PIXEL_SHARE = 0.05
"""Prior share of the pixels in a cluster's place that show it, before their pilots: a bar is narrow."""


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
            probability = to_kernel_array(presence.probability)
            values = np.zeros((len(probability), length))
            info = to_kernel_array(sums[pilot_chips:])
            _kernels.sum_values(info, probability, presence.grid_px, _MIN_WEIGHT, values)
            symbols, best, margins, _, _ = _kernels.match_words(values, by_value, codebook.bits_per_symbol)
            energy, explained = float(np.vdot(values, values)), float(best @ best) / length
            rest = max(energy - explained, 1e-3 * energy, 1e-9)
            scale = max(float(best.sum()) / best.size / length, 0.0) * values.size / rest
            quality = explained / energy if energy > 0 else 0.0
            return SoftSymbols(symbols, (margins * scale).astype(np.float32), quality)

        return decode


@dataclass(frozen=True)
class MlSoft(Decoding):
    """Sum of per-pixel log-likelihood ratios, by how many events of which sign a value's two chips have.

    Pilots are known, so each frame shows how often a value of +1 or -1 comes with which pair of polarity
    sums, missed and late events included: two histograms over the pixels of all clusters. Their log ratio is
    the evidence of a pair of sums in the info segment of the same frame. Where the camera sends no negative
    events, silence in both chips is evidence, too.

    A pixel whose pilot does not fit its cluster shows something else, too, a panel or leaves, and one that is
    dark shows nothing: each is weighted by the probability that it shows the cluster, by Bayes' rule.
    """

    def compile(self, codebook: Codebook) -> Decode:
        """Precompute for a codebook's pilots and codewords."""
        codebook.require_pairs("decoding", "ml-soft", "edges")
        decoder = MlDecoder(codebook)

        def decode(presence: PresenceMap, sums: NDArray[np.int16]) -> SoftSymbols:
            return decoder.decode(presence.apply_prior(), sums)[0]

        return decode


class MlDecoder:
    """`MlSoft` for the pilots and codewords of a codebook of pair codes."""

    def __init__(self, codebook: Codebook) -> None:
        # Scaled as LLRs are by the matching.
        words = np.ascontiguousarray(codebook.codeword_edges.T, np.float64)
        self._by_value = words * (INDEPENDENT_PIXELS / 2)
        # Unsigned, as indices below 0 would count from the end.
        self._signs = (codebook.pilot_edges > 0).astype(np.uint64)
        self._bits = codebook.bits_per_symbol

    def decode(
        self, presence: PresenceMap, sums: NDArray[np.int16]
    ) -> tuple[SoftSymbols, float, NDArray[np.uint8], NDArray[np.float64]]:
        """Decode the likeliest codewords by all pixels that show a cluster; sums begin with the pilot.

        Returns:
            The symbols; the least size of an LLR; the pair of its chips' polarity sums of -n to n events that
            each value has in each pixel, uint8 (values, pixels), (first + n) * (2 n + 1) + second + n; and
            the log-likelihood ratio of a value of +1 against -1 by its pair, float64 ((2 n + 1)^2,).
        """
        pairs = np.empty((len(sums) // 2, sums[0].size), np.uint8)
        seen, width, grid = to_kernel_array(presence.probability), sums.shape[2], presence.grid_px
        pair_llr = np.empty((2 * MAX_EVENTS + 1) ** 2)
        _kernels.learn_pair_llr(
            to_kernel_array(sums), MAX_EVENTS, self._signs, seen, grid, _PRIOR_COUNT, pairs, pair_llr
        )
        values = np.zeros((len(seen), len(pairs) - self._signs.shape[1]))
        odds = (1 - _PIXEL_SHARE) / _PIXEL_SHARE
        _kernels.sum_pair_llr(
            pairs, width, self._signs, seen, grid, pair_llr, (_MIN_SOFT_WEIGHT, odds), values
        )
        symbols, _, margins, agreement, least = _kernels.match_words(values, self._by_value, self._bits)
        return SoftSymbols(symbols, margins.astype(np.float32), agreement), least, pairs, pair_llr
