"""What the info segment of each cluster says, for codewords of any chips."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook, edges_of_chips
from evlcp_sdk.plugin.roles import Decode, Decoding
from evlcp_sdk.values import PresenceMap, SoftSymbols

__all__ = ["EdgeDecoding"]


@dataclass(frozen=True)
class EdgeDecoding(Decoding):
    """Likelihood of every codeword, by how many events pixels have at a rise, at a fall and where nothing is.

    Pilots are known, so each frame shows how often each polarity sum comes with which edge, and with which
    one in the chip before, whose late events it may hold: histograms over the pixels of all clusters. A
    codeword's log-likelihood is the sum of those of its edges, over its chips and the pixels, weighted by
    presence. The edge before its first chip counts where it is known what was sent before it.
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
        pilot_chips = codebook.pilots.shape[1]
        pilots = edges_of_chips(codebook.pilots)
        words = codebook.codewords.astype(np.int64)
        # Behind what is not known, behind a dark chip and behind a lit one: (3, symbols, chips).
        kinds = np.stack([_kinds(words, before) for before in (-1, 0, 1)])
        most, carried = self.max_events, 2**codebook.bits_per_symbol
        bits = (np.arange(carried)[:, None] >> np.arange(codebook.bits_per_symbol - 1, -1, -1) & 1).astype(
            bool
        )
        chip = np.arange(words.shape[1])

        def decode(
            presence: PresenceMap, sums: NDArray[np.int16], before: NDArray[np.int8] | None = None
        ) -> SoftSymbols:
            presence = presence.informed()
            clipped = np.clip(sums, -most, most).astype(np.int64) + most
            weight = _weights(presence, self.min_weight)
            table = self._learned(weight, clipped[1:pilot_chips], pilots)
            # What each cluster's pixels say of each kind in each chip: (K, chips, kinds).
            said = _weighted(weight, clipped[pilot_chips:], table)
            behind = np.full(len(said), -1) if before is None else before
            fit = np.stack(
                [one[chip, kinds[b + 1]].sum(1) for one, b in zip(said, behind.tolist(), strict=True)]
            )
            fit *= self.independent_pixels
            symbols = fit.argmax(1)
            llr = np.empty((len(fit), bits.shape[1]), np.float32)
            for bit in range(bits.shape[1]):
                one = bits[:, bit]
                llr[:, bit] = fit[:, :carried][:, ~one].max(1) - fit[:, :carried][:, one].max(1)
            best = np.take_along_axis(fit, symbols[:, None], 1)
            odds = np.exp(fit - best).sum(1)
            return SoftSymbols(symbols, llr, float(np.prod(1 / odds)))

        return decode

    def _learned(
        self, weight: "list[_Pixels]", pilot: NDArray[np.int64], edges: NDArray[np.int8]
    ) -> NDArray[np.float64]:
        """Log-likelihood of each polarity sum by its kind, float64 (13, sums)."""
        side = 2 * self.max_events + 1
        # By the edge before, by the edge.
        counts = np.zeros((3, 3, side))
        for pixels, code in zip(weight, edges, strict=True):
            shown = pixels.share > 0.5
            share = pixels.share[shown]
            for chip in range(1, len(code)):
                seen = pilot[chip][pixels.v[shown], pixels.u[shown]]
                counts[code[chip - 1] + 1, code[chip] + 1] += np.bincount(seen, share, side)
        # What comes with all alike is worth the same: each histogram's prior is as large as it is itself.
        prior = self.prior_count * 9 / max(float(counts.sum()), 1e-9)
        of_edge = _log_shares(counts.sum(0), prior)
        of_both = _log_shares(counts.reshape(9, side), prior).reshape(3, 3, side)
        # A kind that no pilot has is like all of its edge.
        of_both = np.where(counts.sum(-1, keepdims=True) > 0, of_both, of_edge)
        return np.concatenate([np.zeros((1, side)), of_edge, of_both.reshape(9, side)])


@dataclass(frozen=True, eq=False)
class _Pixels:
    """A cluster's pixels: rows, columns, and presence probability of each."""

    v: NDArray[np.int64]
    u: NDArray[np.int64]
    share: NDArray[np.float64]


def _log_shares(counts: NDArray[np.float64], prior: float) -> NDArray[np.float64]:
    """Log of each histogram's shares, with a prior in every cell, as a share of the histogram."""
    many = counts.sum(1, keepdims=True)
    each = prior * np.where(many > 0, many, 1.0)
    shares: NDArray[np.float64] = np.log((counts + each) / (many + counts.shape[1] * each))
    return shares


def _kinds(words: NDArray[np.int64], before: int) -> NDArray[np.int64]:
    """Kind of each chip of codewords behind a chip, int64 (symbols, chips).

    0: nothing is known of its edge; 1 to 3: its edge is -1, 0, +1; 4 to 12: the same behind one of -1, 0, +1.
    """
    edges = np.diff(words, axis=1)
    kinds = np.zeros(words.shape, np.int64)
    kinds[:, 1:] = 2 + edges
    kinds[:, 2:] = 4 + 3 * (edges[:, :-1] + 1) + edges[:, 1:] + 1
    if before >= 0:
        first = words[:, 0] - before
        kinds[:, 0] = 2 + first
        if words.shape[1] > 1:
            kinds[:, 1] = 4 + 3 * (first + 1) + edges[:, 0] + 1
    return kinds


def _weights(presence: PresenceMap, least: float) -> list[_Pixels]:
    """The pixels of each cluster."""
    grid = presence.grid_px
    found = []
    for image in presence.probability:
        r, c = np.nonzero(image >= least)
        v = (r[:, None, None] * grid + np.arange(grid)[:, None] + np.zeros(grid, np.int64)).ravel()
        u = (c[:, None, None] * grid + np.zeros(grid, np.int64)[:, None] + np.arange(grid)).ravel()
        found.append(_Pixels(v, u, image[r, c].astype(np.float64).repeat(grid * grid)))
    return found


def _weighted(
    weight: list[_Pixels], sums: NDArray[np.int64], table: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What the table says of each cluster's pixels, (chips, height, width) -> float64 (K, chips, kinds)."""
    side = table.shape[1]
    found = []
    for pixels in weight:
        seen = sums[:, pixels.v, pixels.u]
        counts = np.stack([np.bincount(row, pixels.share, side) for row in seen])
        found.append(counts @ table.T)
    return np.stack(found)
