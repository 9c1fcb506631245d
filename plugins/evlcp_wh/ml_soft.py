"""What the info segment of each cluster says, by likelihoods learned from the pilots."""

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

__all__ = [
    "IndependentPixels",
    "MaxEvents",
    "MinWeight",
    "MlSoft",
    "PixelShare",
    "PriorCount",
    "learned_worth",
    "soft_symbols",
]


MaxEvents = Annotated[
    int, Field(ge=1, le=16, description="Polarity sums beyond this many events count as this many.")
]
MinWeight = Annotated[
    float, Field(gt=0, lt=1, description="Presence probability below which a cell is passed over.")
]
PriorCount = Annotated[float, Field(gt=0, description="Observations added to every cell of the histograms.")]
IndependentPixels = Annotated[
    float,
    Field(
        gt=0,
        le=1,
        description="Share of the pixels that err by themselves; neighbours share light and motion.",
    ),
]

PixelShare = Annotated[
    float,
    Field(
        gt=0,
        lt=1,
        description="Share of the pixels in a cluster's place that show it, before their pilots speak.",
    ),
]


@dataclass(frozen=True)
class MlSoft(Decoding):
    """Sum of per-pixel log-likelihood ratios, by how many events of which sign a value's two chips have.

    Pilots are known, so each frame shows how often a value of +1 or -1 comes with which pair of polarity
    sums, missed and late events included: two histograms over the pixels of all clusters. Their
    log ratio says what a pair of sums is worth, in the info segment of the same frame. Where the camera sends
    no negative events, silence in both chips counts for what it is worth, too.

    A pixel whose pilot does not fit its cluster shows something else, too, a panel or leaves, and one that is
    dark shows nothing: each counts by the probability that it shows the cluster, by Bayes' rule.
    """

    max_events: MaxEvents = 3
    min_weight: MinWeight = 0.05
    prior_count: PriorCount = 1.0
    independent_pixels: IndependentPixels = 0.25
    pixel_share: PixelShare = 0.05

    def compile(self, codebook: Codebook) -> Decode:
        """Precompute for a codebook's pilots and codewords."""
        codebook.require_pairs("decoding", "ml-soft", "edges")
        words = codebook.codeword_edges.astype(np.float64)
        pilots = codebook.pilot_edges.astype(np.int64)

        def decode(presence: PresenceMap, sums: NDArray[np.int16]) -> SoftSymbols:
            presence = presence.informed()
            worth = learned_worth(presence, sums, pilots, self.max_events, self.prior_count)
            weights = self.min_weight, self.pixel_share, self.independent_pixels
            return soft_symbols(presence, sums, pilots, words, worth, *weights)[0]

        return decode


def learned_worth(
    presence: PresenceMap,
    sums: NDArray[np.int16],
    pilots: NDArray[np.int64],
    max_events: int,
    prior_count: float,
) -> NDArray[np.float64]:
    """Log-likelihood ratio of a value of +1 against -1, by its chips' polarity sums of -n to n events.

    Args:
        presence: Of the frame.
        sums: The frame's polarity sums, pilot first, int16 (chips, height, width).
        pilots: The codes, int64 (K, values).
        max_events: n; sums beyond count as this many.
        prior_count: Observations added to every cell of the two histograms, on average of the two: to each as
            its value is frequent, so that what comes with both alike is worth nothing.

    Returns:
        float64 (2 n + 1, 2 n + 1), by the first chip's sum and the second's.
    """
    worth = np.empty((2 * max_events + 1, 2 * max_events + 1))
    grid = presence.grid_px
    seen = plain(presence.probability)
    _kernels.learn_worth(plain(sums), pilots, seen, grid, max_events, prior_count, worth)
    return worth


def soft_symbols(
    presence: PresenceMap,
    sums: NDArray[np.int16],
    pilots: NDArray[np.int64],
    words: NDArray[np.float64],
    worth: NDArray[np.float64],
    min_weight: float,
    pixel_share: float,
    independent_pixels: float,
) -> tuple[SoftSymbols, float]:
    """The likeliest codewords by what all pixels that show a cluster say; the least size of an LLR.

    Args:
        presence: Of the frame.
        sums: The frame's polarity sums, pilot first, int16 (chips, height, width).
        pilots: The codes, int64 (K, values).
        words: The codewords, float64 (2**m or more, values).
        worth: As from `learned_worth`.
        min_weight: Presence probability below which a cell is passed over.
        pixel_share: Share of the pixels in a cluster's place that show it.
        independent_pixels: Share of the pixels that err by themselves.
    """
    clusters, bits = len(pilots), len(words).bit_length() - 1
    symbols, llr = np.empty(clusters, np.int64), np.empty((clusters, bits), np.float32)
    quality, least = _kernels.read_frame(
        plain(sums),
        pilots,
        plain(presence.probability),
        presence.grid_px,
        min_weight,
        worth,
        (1 - pixel_share) / pixel_share,
        words,
        independent_pixels / 2,
        symbols,
        llr,
    )
    return SoftSymbols(symbols, llr, quality), least
