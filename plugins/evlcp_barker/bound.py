"""The correlation from which on events are a preamble, by what a codebook's codes make pixels answer."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from evlcp_barker import _kernels
from evlcp_sdk.air.codebook import Codebook, edges_of_chips, is_pair_code
from evlcp_sdk.air.frames import packet_chips

_GOOD_SHARE = 0.5
"""Least share of a preamble's events that agree with it and are its own: what is missing, other light in the
region, its halo and its repeated events take up to the other half."""

_POOR_SHARE = 0.7
"""The share of a preamble that is seen poorly: of pair codes .8 and more, as a rule."""

_PACKETS = 256
"""Packets of random symbols that the reach of other codes is taken from, over the number of clusters: the
fewer these are, the further it is from what is likely to what is possible."""

_RARE_SHARE = 3e-4
"""Share of all chips at which other codes may reach it: in one of ten packets; a better preamble takes over
at once."""

_SIDELOBE_CHIPS = 3
"""Distance up to which a peak is the preamble's own: pair codes have high sidelobes up to two chips away."""


def due_chips(preamble: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Chips of a preamble in which events are due, bool (P,): all of a pair code, else those behind an edge.

    The first may have an edge before it, whatever was sent there.
    """
    due = np.ones(len(preamble), np.bool_)
    if not is_pair_code(preamble):
        due[1:] = edges_of_chips(preamble) != 0
    return due


def preamble_share(preamble: NDArray[np.uint8]) -> float:
    """Share of a preamble's events that carry information on slow pixels: its highest correlation there.

    A pixel answers an edge for as long as its light stays: with a logarithmic receptor (charge Q, irradiance
    I) the signal falls as ln(1 + t I / Q), so that where Q / I is a chip ln(1 + 1 / (k + 1)) events come in
    the k-th chip behind the edge. On slower pixels an edge ends before it reaches the threshold (at 10 000
    chips/s: below .15 W/m2, as in a bright lamp's halo). All that come in a chip without an edge carry no
    information (`_kernels.correlate`), but count as seen. In a pair code, whose light never stays longer than
    two chips, they agree with the chip: its share is 1.

    >>> from evlcp_sdk.air.codebook import BARKER13, chips_of_values
    >>> pairs = chips_of_values(BARKER13)
    >>> [round(preamble_share(np.repeat(pairs, times)), 2) for times in (1, 2, 3)]
    [1.0, 0.55, 0.45]
    """
    chips = np.asarray(preamble)[:, None]
    answers = np.log1p(1 / (_chips_since_edge(chips)[:, 0] + 1))
    return float(answers[due_chips(preamble)].sum() / answers.sum())


@lru_cache(maxsize=64)
def least_correlation(codebook: Codebook, frames: int, pilot_every: int) -> float:
    """Correlation from which on events are a preamble, of packets of so many frames.

    Two bounds come from the preamble, by its `preamble_share`, to which its events correlate at the least but
    for what is missing and what is not its own: half of the share lets all of them pass that are seen at all,
    .7 all but poor ones. Between the two it is what other codes reach, pilots and random symbols in all
    clusters, where pixels answer at once, so that all their events tell: many clusters cancel, one does not.

    A pair code of four clusters or more has .5: its share is 1 and its data reach less. That of one has .7.
    Preambles of doubled and tripled chips, which correlate by .45 and .35 by night, have .28 and .22.

    >>> from evlcp_sdk.air.codebook import BARKER13, hadamard
    >>> rows = hadamard(8)
    >>> [least_correlation(Codebook.of_values("demo", BARKER13, rows[:k], rows), 10, 1) for k in (1, 8)]
    [0.7, 0.5]
    """
    share = preamble_share(codebook.preamble)
    return min(max(_GOOD_SHARE * share, _code_reach(codebook, frames, pilot_every)), _POOR_SHARE * share)


def guard_chips(preamble: NDArray[np.uint8], least: float) -> int:
    """Within how many chips of a preamble what correlates by `least` is not another one, but its own shift.

    Three at the least, and as many for a pair code. Shifts of other codes may agree in many of the edges that
    are left, those of sparse pulses above all: as far as they do, on pixels that answer at once.

    >>> from evlcp_sdk.air.codebook import BARKER13, chips_of_values
    >>> pulses = np.kron(np.array(BARKER13) > 0, [1, 0, 0]).astype(np.uint8)
    >>> guard_chips(chips_of_values(BARKER13), 0.5), guard_chips(pulses, 0.35)
    (3, 30)
    """
    if is_pair_code(preamble):
        return _SIDELOBE_CHIPS
    length = len(preamble)
    dark = np.zeros(length, np.uint8)
    counts = np.zeros((2, 3 * length))
    counts[:, length : 2 * length] = _count_events(np.concatenate([dark[:1], preamble])[:, None])[:, 1:]
    rho = np.empty(2 * length + 1)
    _kernels.correlate(counts, 2.0 * preamble - 1, due_chips(preamble), 1, 0, rho)
    away = np.abs(np.flatnonzero(rho >= least) - length)
    return int(max(away.max(initial=0), _SIDELOBE_CHIPS))


def _code_reach(codebook: Codebook, frames: int, pilot_every: int) -> float:
    """Correlation of pilots and random symbols with the preamble, but for a `_RARE_SHARE` of the chips."""
    rng = np.random.default_rng(0)
    packets = max(_PACKETS // codebook.clusters, 8)
    symbols = rng.integers(0, codebook.data_symbols, (packets, frames, codebook.clusters))
    chips = np.concatenate([packet_chips(one, codebook, pilot_every) for one in symbols])
    packet, length = len(chips) // packets, len(codebook.preamble)
    counts = _count_events(chips)
    rho = np.empty(len(chips) - length + 1)
    signs = 2.0 * codebook.preamble - 1
    _kernels.correlate(counts, signs, due_chips(codebook.preamble), 1, 0, rho)
    at = np.arange(len(rho)) % packet
    others = rho[np.minimum(at, packet - at) > _SIDELOBE_CHIPS]
    return float(np.quantile(others, 1 - _RARE_SHARE)) if len(others) else 0.0


def _count_events(chips: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Negative and positive events in each chip of clusters' chips (n, K), float64 (2, n), each at once."""
    fresh = _chips_since_edge(chips) == 0
    return np.stack([(fresh & (chips == level)).sum(1) for level in (0, 1)]).astype(np.float64)


def _chips_since_edge(chips: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Chips since the last edge, 0 in the one behind it and in the first, int64 (chips, K)."""
    row = np.arange(len(chips))[:, None]
    edge = np.ones(chips.shape, np.bool_)
    edge[1:] = chips[1:] != chips[:-1]
    since: NDArray[np.int64] = row - np.maximum.accumulate(np.where(edge, row, 0), axis=0)
    return since
