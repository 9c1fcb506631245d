"""What the info segment of each cluster says, after the bar's motion within the frame is taken out."""

from dataclasses import dataclass, replace
from math import inf, log
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.late import Late
from evlcp_sdk.plugin.roles import Decode, Decoding
from evlcp_sdk.values import PresenceMap, SoftSymbols
from evlcp_wh.ml_soft import (
    IndependentPixels,
    MaxEvents,
    MinWeight,
    PixelShare,
    PriorCount,
    learned_worth,
    soft_symbols,
)
from evlcp_wh.separation import ErrorShare, MinValues

if TYPE_CHECKING:
    from evlcp_wh import _kernels
else:
    _kernels = Late("evlcp_wh._kernels")

__all__ = ["MotionFeedback"]


@dataclass(frozen=True)
class MotionFeedback(Decoding):
    """Decision feedback of motion: find from the chips where the bar was, take it back, decode, again.

    The clusters' pixel maps and the values that they send make the image that each value should give; its
    match with the events, pixel by pixel in log-likelihood ratios as `ml-soft` learns them, shows how
    likely the bar was so many pixels off its place then. In the first round the pilot's values are known,
    and each info value of a cluster is the one that fits better; in the second all are known from the
    decision. The likeliest smooth path over all values (Viterbi) is taken back from the sums, the clusters
    are separated again by their pilots, and their info segments decoded. A frame whose path stays at 0 is
    decoded as by `ml-soft`; one whose path comes within a pixel of the border of what is searched, or leaves
    a bit unsure, is searched farther.

    A path that started from decisions alone would confirm a wrong one: a bar off by the spacing of its
    clusters says its neighbours' symbols without a fault.
    """

    reach_px: Annotated[
        int, Field(ge=1, le=8, description="Farthest that the bar may be off its place in a frame.")
    ] = 4
    far_px: Annotated[
        int, Field(ge=1, le=16, description="Farthest where that does not do; without effect if it is less.")
    ] = 8
    unsure_llr: Annotated[
        float,
        Field(
            ge=0,
            description="Log-likelihood ratio of a bit below which a bar that moved is sought to `far_px`: "
            "at 2, one such bit in eight is wrong.",
        ),
    ] = 2.0
    step_px: Annotated[
        float,
        Field(gt=0, description="Likely change of place (sigma) from value to value: 1.5 px/ms for 0.2 ms."),
    ] = 0.3
    place_px: Annotated[
        float, Field(gt=0, description="Likely distance (sigma) of the bar from its place.")
    ] = 1.0
    rounds: Annotated[int, Field(ge=1, le=4, description="How often motion and symbols are found anew.")] = 2
    max_events: MaxEvents = 3
    min_weight: MinWeight = 0.05
    prior_count: PriorCount = 1.0
    independent_pixels: IndependentPixels = 0.25
    pixel_share: PixelShare = 0.05
    value_error: ErrorShare = 0.1
    min_values: MinValues = 4
    sure_llr: Annotated[
        float,
        Field(ge=0, description="Log-likelihood ratio of every bit from which on a frame is read once only."),
    ] = 20.0

    def compile(self, codebook: Codebook) -> Decode:
        """Precompute for a codebook's pilots and codewords."""
        codebook.require_pairs("decoding", "motion-feedback", "edges")
        words = codebook.codeword_edges.astype(np.float64)
        pilots = codebook.pilot_edges.astype(np.int64)

        def decode(presence: PresenceMap, sums: NDArray[np.int16]) -> SoftSymbols:
            presence = presence.informed()
            worth = learned_worth(presence, sums, pilots, self.max_events, self.prior_count)
            soft, least = self._decided(presence, sums, pilots, words, worth)
            if least >= self.sure_llr:
                return soft
            read, beyond = self._fed_back(presence, sums, worth, soft, pilots, words, self.reach_px)
            if beyond and self.far_px > self.reach_px:
                read, _ = self._fed_back(presence, sums, worth, soft, pilots, words, self.far_px)
            return read

        return decode

    def _fed_back(
        self,
        presence: PresenceMap,
        sums: NDArray[np.int16],
        worth: NDArray[np.float64],
        soft: SoftSymbols,
        pilots: NDArray[np.int64],
        words: NDArray[np.float64],
        reach_px: int,
    ) -> tuple[SoftSymbols, bool]:
        """What is read with the path taken back, and whether the path may lie beyond `reach_px`.

        The best path may go on beyond the border. Where it does not come there, it may have gone over to the
        same clusters a spacing back: what it passed on the way contradicts what it reads, and leaves a bit
        unsure. What was read until then does not count.
        """
        matches = self._matches(presence, sums, worth, reach_px)
        known, least = pilots, inf
        done = np.zeros((len(sums) // 2, 2), np.int64)
        for _ in range(self.rounds):
            path = self._path(matches, known)
            if reach_px < self.far_px and np.abs(path).max() >= reach_px - 1:
                return soft, True
            if (path == done).all():
                break
            aligned, done = _taken_back(sums, path), path
            presence = self._separated(aligned, presence, pilots)
            worth = learned_worth(presence, aligned, pilots, self.max_events, self.prior_count)
            soft, least = self._decided(presence, aligned, pilots, words, worth)
            known = np.concatenate([pilots, words[soft.symbols].astype(np.int64)], axis=1)
        return soft, least < self.unsure_llr

    def _decided(
        self,
        presence: PresenceMap,
        sums: NDArray[np.int16],
        pilots: NDArray[np.int64],
        words: NDArray[np.float64],
        worth: NDArray[np.float64],
    ) -> tuple[SoftSymbols, float]:
        weights = self.min_weight, self.pixel_share, self.independent_pixels
        return soft_symbols(presence, sums, pilots, words, worth, *weights)

    def _matches(
        self, presence: PresenceMap, sums: NDArray[np.int16], worth: NDArray[np.float64], reach_px: int
    ) -> NDArray[np.float32]:
        """Log-likelihood ratio of each value of each cluster, by the shift of the bar from its place.

        float32 (K, n, n, values), from `reach_px` up and left to as much down and right.
        """
        _, height, width = sums.shape
        values, seam, side = len(sums) // 2, reach_px, 2 * reach_px + 1
        images = np.empty((height + 2 * seam, width + 2 * seam, values), np.float32)
        _kernels.worth_images(sums, worth.astype(np.float32), len(worth) // 2, seam, images)
        prior = presence.probability if presence.prior is None else presence.prior
        out = np.empty((len(prior), side, side, values), np.float32)
        _kernels.cluster_matches(presence.pixels, prior, presence.grid_px, images, out)
        out *= self.independent_pixels
        return out

    def _path(self, matches: NDArray[np.float32], known: NDArray[np.int64]) -> NDArray[np.int64]:
        """Shift (down, right) of the bar from its place in each value, int64 (values, 2), px.

        `known` are the codes of the first n values, int64 (K, n); of the others, each cluster's is what fits.
        """
        values = matches.shape[3]
        scores = np.empty(matches.shape[1:], np.float64)
        _kernels.path_scores(matches, known, scores)
        # What is scored is twice a log-likelihood, and so are the costs.
        path = np.empty((values, 2), np.int64)
        _kernels.smooth_path(scores, 1 / self.step_px**2, 1 / self.place_px**2 / values, path)
        return path

    def _separated(
        self, sums: NDArray[np.int16], before: PresenceMap, pilots: NDArray[np.int64]
    ) -> PresenceMap:
        """Presence by Bayes' rule of sums in which the bar stands still."""
        agree, disagree = log((1 - self.value_error) / 0.5), log(self.value_error / 0.5)
        probability = np.zeros_like(before.probability)
        pilot = sums[: 2 * pilots.shape[1]]
        _kernels.presence(pilot, pilots, before.grid_px, agree, disagree, self.min_values, probability)
        return replace(before, probability=probability).informed()


def _taken_back(sums: NDArray[np.int16], path: NDArray[np.int64]) -> NDArray[np.int16]:
    out = np.empty_like(sums)
    _kernels.take_back(sums, path, out)
    return out
