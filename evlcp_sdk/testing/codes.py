"""Laws of codes: pilots and modulation."""

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import edges_of_chips, is_pair_code
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.testing.exercises import link_of, locate_clusters, pilot_sums
from evlcp_sdk.testing.law import Subject, expect, law
from evlcp_sdk.testing.views import ideal_frame

_COUNTS = (2, 4, 8, 16, 24, 32)
_MAX_ALIKE = 0.25
"""Most normalised correlation of two pilots: 3 of 8 values differ, so that one error is corrected."""
_MAX_SIDELOBE = 0.25
_MAX_EDGES_ALIKE = 0.6
"""The same for the edges of other than pair codes, and for sidelobes of their preamble: pulses of two codes
coincide in half of the cases."""
_NEAR_CHIPS = 3
"""First shift of such a sidelobe: at smaller ones alternating chips are alike."""


def _make_codes(subject: Subject) -> list[NDArray[np.uint8]]:
    """Make the family's codes for each number of clusters that it supports."""
    found = []
    for n in _COUNTS:
        try:
            found.append(subject.algorithm.codes(n))
        except ConfigError:
            break
        expect(len(found[-1]) == n, f"codes({n}) to have {n} rows or raise ConfigError, got {len(found[-1])}")
    expect(found, "codes for 2 clusters at the least")
    return found


def _expect_chips(code: NDArray[np.uint8], dimensions: int, name: str) -> None:
    expect(isinstance(code, np.ndarray) and code.dtype == np.uint8, f"{name} as a uint8 array")
    expect(code.ndim == dimensions and code.size, f"{name} with {dimensions} dimensions, got {code.shape}")
    expect(np.isin(code, (0, 1)).all(), f"{name} of chips 0 and 1 only")


def _select_edges(code: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the edges that distinguish codes: in the middle of pairs, or else all."""
    return edges_of_chips(code)[..., :: 2 if is_pair_code(code) else 1].astype(np.int64)


@law("shapes", "uint8 chips, one code per cluster")
def _check_pilot_shapes(subject: Subject) -> None:
    _expect_chips(subject.algorithm.preamble(), 1, "preamble()")
    for codes in _make_codes(subject):
        _expect_chips(codes, 2, f"codes({len(codes)})")


@law("pilots-apart", "of the edges of any two pilots, no more agree than of 8 values that differ in 3")
def _check_pilot_correlation(subject: Subject) -> None:
    for codes in _make_codes(subject):
        edges = _select_edges(codes)
        many = np.maximum(np.sqrt((edges**2).sum(1)), 1e-9)
        alike = edges @ edges.T / np.outer(many, many)
        np.fill_diagonal(alike, -1)
        i, j = np.unravel_index(alike.argmax(), alike.shape)
        most = _MAX_ALIKE if is_pair_code(codes) else _MAX_EDGES_ALIKE
        expect(
            alike.max() <= most,
            f"two of {len(codes)} pilots to correlate by {most} at most,"
            f" got {alike.max():.2f} for clusters {i} and {j}",
        )


@law("sharp-preamble", "the preamble's sidelobes are a quarter of its peak at the most")
def _check_preamble_sidelobes(subject: Subject) -> None:
    preamble = subject.algorithm.preamble()
    code = _select_edges(preamble)
    most, near = (_MAX_SIDELOBE, 1) if is_pair_code(preamble) else (_MAX_EDGES_ALIKE, _NEAR_CHIPS)
    side = np.abs(np.correlate(code, code, "full")[len(code) - 1 + near :]).max(initial=0) / (code**2).sum()
    expect(side <= most, f"sidelobes of the preamble of {most} at most, got {side:.2f}")


@law("shapes", "uint8 chips, one codeword per symbol")
def _check_codeword_shapes(subject: Subject) -> None:
    words = subject.algorithm.codewords()
    _expect_chips(words, 2, "codewords()")
    expect(len(words) >= 2, f"two codewords or more, got {len(words)}")


@law("codewords-distinct", "the codewords of any two symbols differ in an edge")
def _check_codewords_differ(subject: Subject) -> None:
    words = subject.algorithm.codewords()
    distinct = len(np.unique(edges_of_chips(words), axis=0))
    expect(distinct == len(words), f"{len(words)} codewords of different edges, got {distinct}")


@law("comes-back", "every symbol comes back from an ideal image of its codeword")
def _check_codewords_decode(subject: Subject) -> None:
    link = link_of(subject)
    book = link.codebook
    decode = link.algorithm("decoding").compile(book)
    words, k = 2**book.bits_per_symbol, book.clusters
    for first in range(0, words, k):
        symbols = (first + np.arange(k)) % words
        soft = decode(*ideal_frame(book, symbols))
        wrong = np.flatnonzero(soft.symbols != symbols)
        if wrong.size:
            k = wrong[0]
            expect(False, f"symbol {symbols[k]} from an ideal image of its codeword, got {soft.symbols[k]}")


@law("tells-apart", "the link's separation tells the clusters of an ideal image apart")
def _check_clusters_separate(subject: Subject) -> None:
    link = link_of(subject)
    book = link.codebook
    separate = link.algorithm("separation").compile(book)
    share, placed = locate_clusters(separate, pilot_sums(link), book.clusters)
    least = int(share.argmin())
    edges = int(np.abs(book.pilot_edges[least]).sum())
    expect(
        (share >= 0.5).all(),
        f"half of each cluster found or more, got {share.min():.0%} of cluster {least},"
        f" whose pilot has {edges} edges beside {book.clusters - 1} others: longer pilots tell more",
    )
    expect(placed >= 0.9, f"nine tenths of what is found in its place, got {placed:.0%}")


PILOTS = (_check_pilot_shapes, _check_pilot_correlation, _check_preamble_sidelobes, _check_clusters_separate)
"""Laws of pilots."""

MODULATION = (_check_codeword_shapes, _check_codewords_differ, _check_codewords_decode)
"""Laws of modulation."""
