"""How far a frame's symbols are believed: one measure for every decoding."""

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx import _kernels
from evlcp_sdk.values import PresenceMap, SoftSymbols

_FRAME_WORTH = 6.0
"""LLRs of a cluster that those of all its frame are worth: light and shaking are much the same for all,
while a panel or leaves stand behind some."""

_EXPECTED_SPREAD, _EXPECTED_WORTH = 0.4, 6.0
"""Standard deviation of the sizes of LLRs, in their mean, before any is seen, and how many it is worth."""

_LEAST_SURE = 0.6
"""Probability of being right against its nearest rival below which a symbol is not given: it has others, too,
and of those that are less sure, half or more are wrong in recordings."""

_TOGETHER = 1.7
"""Wrong symbols in a frame that has any: what makes one wrong, light, shaking, what stands behind, is there
for others, too. In `examples/campaigns/road.toml` they are 1.9 to 2.2 by decoding, as `benchmarks/quality.py`
prints; on a Gaussian channel 1 to 1.3, as long as less than half of the frames are wrong."""

_LEAST_EVENTS = 0.5
"""Share of the events due, by the edges of the codeword with the fewest, that may be missing by chance."""


def still_lit(
    sums: NDArray[np.int16], presence: PresenceMap, pilot_chips: int, least_activity: float = 0.5
) -> NDArray[np.bool_]:
    """Which clusters have events in a frame's info segment as they have in its pilot, bool (K,).

    Where a stream has a gap, or a pole passes, silence is not what a cluster says.

    Args:
        sums: Polarity sums of pilot and info segment, int16 (chips, height, width).
        presence: Where the clusters are.
        pilot_chips: Chips of the pilot.
        least_activity: Edges a chip of the codeword with the fewest, over those of a pilot; half of them in
            pair codes.
    """
    over = np.empty(len(presence.probability))
    least = _LEAST_EVENTS * least_activity
    _kernels.info_activity(sums, presence.probability, presence.grid_px, pilot_chips, least, over)
    return over > 0


def calibrate_llr(soft: SoftSymbols, seen: NDArray[np.bool_]) -> SoftSymbols:
    """A frame as a decoding read it, with what can be believed.

    Decoders are surer than they are right, or less, each in its own way: pixels share light and motion.
    Log-likelihood ratios that tell the truth have a variance of twice their mean, whatever the channel, if it
    is near Gaussian: those of a cluster are scaled so that they do, by its own scatter, that of its frame,
    and what is likely. What these are worth lies between what fits 20 000 symbols of `motion-feedback` in
    recordings and in the harder scenes of `examples/campaigns/road.toml`, and what fits a Gaussian channel;
    both are met within a factor of 2 where less than half of the frames are wrong. The nearest rival of a
    symbol, at its least LLR, says how likely it is right; rather wrong ones are not given. `quality` is the
    probability that all that are given are right, of errors that come together.

    Args:
        soft: What a decoding says.
        seen: Clusters that are in sight, bool (K,); nothing is given of the others, and their LLRs are 0.
    """
    symbols, llr = np.empty_like(soft.symbols), np.empty_like(soft.llr)
    expected, sure = (_FRAME_WORTH, _EXPECTED_WORTH, _EXPECTED_SPREAD), (_LEAST_SURE, _TOGETHER)
    quality = _kernels.calibrate_llr(soft.symbols, soft.llr, seen, expected, sure, symbols, llr)
    return SoftSymbols(symbols, llr, quality)
