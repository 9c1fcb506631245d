"""Decoding of the info segment of each cluster after the bar's motion within the frame is removed."""

from dataclasses import dataclass
from itertools import groupby
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.plugin.roles import Decode, Decoding
from evlcp_sdk.values import PresenceMap, SoftSymbols, replace_fields, to_kernel_array
from evlcp_wh import _kernels
from evlcp_wh.decoding import INDEPENDENT_PIXELS, MlDecoder
from evlcp_wh.separation import CellPosterior

_UNSURE_LLR = 2.0
"""Log-likelihood ratio of a bit below which motion is sought farther: one such bit in eight is wrong."""

_SURE_LLR = 20.0
"""Log-likelihood ratio of every bit from which on a frame is decoded once only."""


@dataclass(frozen=True)
class MotionFeedback(Decoding):
    """Find from the chips where the bar was, remove the motion, and decode again.

    The clusters' pixel maps and the values that they send make the image that each value should give; its
    match with the events, pixel by pixel in log-likelihood ratios as `ml-soft` learns them, shows how likely
    the bar was so many pixels off its place then. The pilot's values are known, and each info value of a
    cluster is the one that fits better. The likeliest smooth path over all values (Viterbi) is removed from
    the sums, the clusters are separated again by their pilots, and their info segments decoded. A frame whose
    path stays at 0 is decoded as by `ml-soft`; one whose path comes within a pixel of the border of what is
    searched, or leaves a bit unsure, is sought farther.

    A path from decisions would confirm a wrong one: a bar off by the spacing of its clusters decodes to its
    neighbours' symbols without a fault.
    """

    reach_px: Annotated[
        int, Field(ge=1, le=8, description="Farthest that the bar may be off its place in a frame.")
    ] = 4
    far_px: Annotated[
        int, Field(ge=1, le=16, description="Farthest where that does not do; without effect if it is less.")
    ] = 8

    def compile(self, codebook: Codebook) -> Decode:
        """Precompute for a codebook's pilots and codewords."""
        codebook.require_pairs("decoding", "motion-feedback", "edges")
        decoder, posterior = MlDecoder(codebook), CellPosterior(codebook.pilot_edges.astype(np.int64))
        pilots = to_kernel_array(codebook.pilot_edges)

        def decode(presence: PresenceMap, sums: NDArray[np.int16]) -> SoftSymbols:
            presence, sums = presence.apply_prior(), to_kernel_array(sums)
            soft, least, pairs, pair_llr = decoder.decode(presence, sums)
            if least >= _SURE_LLR:
                return soft
            matches = match_shifts(presence, pairs, pair_llr, self.reach_px)
            refined, beyond = refine(presence, sums, soft, matches)
            if beyond and self.far_px > self.reach_px:
                matches = match_shifts(presence, pairs, pair_llr, self.far_px)
                refined, _ = refine(presence, sums, soft, matches)
            return refined

        def refine(
            presence: PresenceMap, sums: NDArray[np.int16], soft: SoftSymbols, matches: NDArray[np.float32]
        ) -> tuple[SoftSymbols, bool]:
            """Decode with the motion removed; return whether the motion may be beyond the shifts searched.

            The best path may go on beyond the border. Where it does not come there, it may have switched to
            the same clusters a spacing back: what it passed on the way contradicts the symbols, and leaves a
            bit unsure. What was decoded until then does not count.
            """
            path, reach_px = _kernels.find_path(matches, pilots).tolist(), matches.shape[1] // 2
            farthest_px = max(abs(px) for at in path for px in at)
            if reach_px < self.far_px and farthest_px >= reach_px - 1:
                return soft, True
            if farthest_px == 0:
                return soft, False
            still = remove_motion(sums, path)
            probability = posterior.probability(still, presence.grid_px)
            presence = replace_fields(presence, probability=probability).apply_prior()
            soft, least, *_ = decoder.decode(presence, still)
            return soft, least < _UNSURE_LLR

        return decode


def match_shifts(
    presence: PresenceMap, pairs: NDArray[np.uint8], pair_llr: NDArray[np.float64], reach_px: int
) -> NDArray[np.float32]:
    """Log-likelihood ratio of each value of each cluster, by the shift of the bar from its place.

    A pixel without events counts 0: its evidence adds the same wherever the bar is.

    Returns:
        float32 (K, n, n, values), from `reach_px` up and left to as much down and right.
    """
    prior = presence.probability if presence.prior is None else presence.prior
    side = 2 * reach_px + 1
    out = np.zeros((len(prior), side, side, len(pairs)), np.float32)
    maps, grid = to_kernel_array(presence.pixels), presence.grid_px
    _kernels.match_shifts(pairs, pair_llr, INDEPENDENT_PIXELS, maps, to_kernel_array(prior), grid, out)
    return out


def remove_motion(sums: NDArray[np.int16], path: list[list[int]]) -> NDArray[np.int16]:
    """Shift polarity sums back by each value's (down, right); pixels from outside the image are 0."""
    _, height, width = sums.shape
    out, first = np.zeros_like(sums), 0
    # Neighbouring values mostly share a shift.
    for (down, right), alike in groupby(path):
        last = first + 2 * sum(1 for _ in alike)
        top, bottom = max(-down, 0), max(min(height - down, height), 0)
        left, end = max(-right, 0), max(min(width - right, width), 0)
        if bottom > top and end > left:
            there = sums[first:last, top + down : bottom + down, left + right : end + right]
            out[first:last, top:bottom, left:end] = there
        first = last
    return out
