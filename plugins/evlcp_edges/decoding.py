"""Decoding of the info segment of each cluster, for codewords of any chips."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.plugin.roles import Decode, Decoding
from evlcp_sdk.values import PresenceMap, SoftSymbols

_SURE_ODDS = 5.0
"""Log odds of a codeword from which on its cluster teaches the others: one of 150 such is wrong."""


@dataclass(frozen=True)
class EdgeDecoding(Decoding):
    """Likelihood of every codeword, by how many events pixels have behind each pair and triple of chips.

    Pilots are known, so each frame shows how often each polarity sum comes in a chip, by what was sent in it
    and in the two before, whose late events it may hold: histograms over the pixels of all clusters. A
    codeword's log-likelihood is the sum over its chips and the pixels, weighted by presence. The edges before
    its first chip and after its last count where the chips there are known. Then all clusters are decoded
    once more: one that was decoded surely teaches the others what its codeword's chips look like, which
    pilots need not hold and which are as near in time as can be.
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
    pair_count: Annotated[
        float,
        Field(
            gt=0,
            description="Pixels of which a pair of chips speaks for each triple that ends in it: of the"
            " hundreds behind a triple, few err by themselves.",
        ),
    ] = 300.0
    independent_pixels: Annotated[
        float,
        Field(
            gt=0, le=1, description="Share of the pixels that err by themselves, not with their neighbours."
        ),
    ] = 0.25

    def compile(self, codebook: Codebook) -> Decode:
        """Precompute for a codebook's pilots and codewords."""
        pilot_chips = codebook.pilots.shape[1]
        pilots = _classify_chips(codebook.pilots, -1, -1)[:, :-1]
        # Between an unknown chip, a dark and a lit one: (3, 3, symbols, chips and the one after).
        ends = (-1, 0, 1)
        words = np.array(
            [[_classify_chips(codebook.codewords, before, after) for after in ends] for before in ends]
        )
        most, data_symbols = self.max_events, 2**codebook.bits_per_symbol
        bits = (
            np.arange(data_symbols)[:, None] >> np.arange(codebook.bits_per_symbol - 1, -1, -1) & 1
        ).astype(bool)

        def decode(
            presence: PresenceMap,
            sums: NDArray[np.int16],
            before: NDArray[np.int8] | None = None,
            after: NDArray[np.int8] | None = None,
        ) -> SoftSymbols:
            clipped = np.clip(sums, -most, most).astype(np.int64) + most
            shown, seen = _count_polarity_sums(
                presence.apply_prior(), clipped, 2 * most + 1, self.min_weight, pilot_chips
            )
            unknown = np.full(len(seen), -1, np.int8)
            chips_before, chips_after = (unknown if sent is None else sent for sent in (before, after))
            # Of each cluster's codewords, (K, symbols, info chips).
            kinds = words[chips_before + 1, chips_after + 1, :, : seen.shape[1]]
            taught_counts = _sum_by_kind(pilots, shown[:, :pilot_chips])
            fit = self._log_likelihoods(seen, kinds, taught_counts.sum(0, keepdims=True))
            if len(fit) > 1:
                second, first = np.partition(fit, -2, axis=1)[:, -2:].T
                decided = np.take_along_axis(kinds, fit.argmax(1)[:, None, None], 1)[:, 0]
                decided[first - second < _SURE_ODDS] = 0
                own_counts = _sum_by_kind(decided, shown[:, pilot_chips:])
                # No cluster is taught by itself, which would confirm its codeword.
                fit = self._log_likelihoods(seen, kinds, (taught_counts + own_counts).sum(0) - own_counts)
            symbols = fit.argmax(1)
            llr = np.empty((len(fit), bits.shape[1]), np.float32)
            for bit in range(bits.shape[1]):
                one = bits[:, bit]
                llr[:, bit] = fit[:, :data_symbols][:, ~one].max(1) - fit[:, :data_symbols][:, one].max(1)
            best = np.take_along_axis(fit, symbols[:, None], 1)
            odds = np.exp(fit - best).sum(1)
            return SoftSymbols(symbols, llr, float(np.prod(1 / odds)))

        return decode

    def _log_likelihoods(
        self, seen: NDArray[np.float64], kinds: NDArray[np.int64], counts: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Log-likelihood of each codeword of each cluster, float64 (K, symbols).

        By histograms of each cluster's pixels by chip, `seen` (K, chips, sums), the kind of each chip of its
        codewords, `kinds` (K, symbols, chips), and histograms by kind, for each cluster or for all, `counts`
        (K or 1, 13, sums).
        """
        # Of each kind in each chip, by each cluster's pixels: (K, chips, kinds).
        logs = seen @ self._kind_likelihoods(counts).transpose(0, 2, 1)
        each = np.take_along_axis(logs[:, None], kinds[..., None], 3)
        fit: NDArray[np.float64] = each.sum((2, 3)) * self.independent_pixels
        return fit

    def _kind_likelihoods(self, counts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log-likelihood of each polarity sum by its kind, from histograms, float64 (n, 13, sums)."""
        triples = counts[:, 5:].reshape(len(counts), 2, 4, -1)
        pairs = counts[:, 1:5] + triples.sum(1)
        of_all = _to_shares(pairs.sum(1, keepdims=True), 1 / pairs.shape[-1])
        of_pair = _to_shares(pairs, of_all)[:, None]
        of_triple = _to_shares(triples + self.pair_count * of_pair, of_pair)
        shares = np.concatenate([of_pair[:, 0], of_triple.reshape(len(counts), 8, -1)], 1)
        # The prior grows with the histogram, so that equal rates have equal likelihoods.
        prior = self.prior_count * 9 / np.maximum(pairs.sum((1, 2)), 1e-9)[:, None, None]
        logs = np.log((shares + prior) / (1 + shares.shape[-1] * prior))
        return np.concatenate([np.zeros_like(logs[:, :1]), logs], 1)


def _to_shares(counts: NDArray[np.float64], default: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Histograms as shares; an empty one takes those of `default`."""
    many = counts.sum(-1, keepdims=True)
    found: NDArray[np.float64] = np.where(many > 0, counts / np.where(many > 0, many, 1.0), default)
    return found


def _classify_chips(words: NDArray[np.uint8], before: int, after: int) -> NDArray[np.int64]:
    """Kind of each chip of codewords and of the one after them, int64 (symbols, chips + 1).

    0: it or the chip before it is not known; 1 to 4: both are, 00, 01, 10, 11; 5 to 12: so is the one before
    these, 000 to 111. The chips before and after the codewords are 0, 1, or -1 if not known.
    """
    sent = np.pad(words.astype(np.int64), ((0, 0), (2, 1)), constant_values=-1)
    sent[:, 1], sent[:, -1] = before, after
    oldest, older, newest = sent[:, :-2], sent[:, 1:-1], sent[:, 2:]
    pair, triple = 1 + 2 * older + newest, 5 + 4 * oldest + 2 * older + newest
    return np.where((older < 0) | (newest < 0), 0, np.where(oldest < 0, pair, triple))


def _sum_by_kind(kinds: NDArray[np.int64], histograms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum histograms, float64 (K, chips, sums), by the kind of their chips: float64 (K, 13, sums)."""
    counts = np.zeros((len(kinds), 13, histograms.shape[-1]))
    np.add.at(counts, (np.arange(len(kinds))[:, None], kinds), histograms)
    counts[:, 0] = 0
    return counts


def _count_polarity_sums(
    presence: PresenceMap, sums: NDArray[np.int64], side: int, least: float, pilot_chips: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Count how often each polarity sum comes in each chip, weighted by presence.

    Returns:
        Over the pixels that more likely show a cluster than not, in all chips, float64 (K, chips, side); and
        over all from the least presence on, in the chips behind the pilot.
    """
    grid = presence.grid_px
    clusters, chips = len(presence.probability), len(sums)
    shown, seen = np.empty((clusters, chips, side)), np.empty((clusters, chips - pilot_chips, side))
    for k, image in enumerate(presence.probability):
        r, c = np.nonzero(image >= least)
        v = (r[:, None, None] * grid + np.arange(grid)[:, None] + np.zeros(grid, np.int64)).ravel()
        u = (c[:, None, None] * grid + np.zeros(grid, np.int64)[:, None] + np.arange(grid)).ravel()
        share = image[r, c].astype(np.float64).repeat(grid * grid)
        values = sums[:, v, u]
        shown[k] = _chip_histograms(values[:, share > 0.5], share[share > 0.5], side)
        seen[k] = _chip_histograms(values[pilot_chips:], share, side)
    return shown, seen


def _chip_histograms(values: NDArray[np.int64], share: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Weighted histogram of each row of values, int64 (chips, n): float64 (chips, side)."""
    rows = values + side * np.arange(len(values))[:, None]
    many = np.bincount(rows.ravel(), np.tile(share, len(values)), side * len(values))
    return many.astype(np.float64).reshape(len(values), side)
