"""Laws of codes: pilots and modulation."""

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import bits_of_symbols, symbols_of_bits
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.testing.exercises import base_link_of, link_of
from evlcp_sdk.testing.law import InapplicableLawError, Law, Subject, expect
from evlcp_sdk.testing.views import ideal_presence, ideal_sums

__all__ = ["MODULATION", "PILOTS"]

_COUNTS = (2, 4, 8, 16, 24, 32)
_MOST_ALIKE = 0.25
"""Correlation of two pilots, normalised: 3 of 8 values differ, so that one seen wrong is put right."""
_MOST_SIDELOBE = 0.25


def _families(subject: Subject) -> list[NDArray[np.int8]]:
    """Codes for as many clusters as the family has them for."""
    found = []
    for n in _COUNTS:
        try:
            found.append(subject.algorithm.codes(n))
        except ConfigError:
            break
        expect(len(found[-1]) == n, f"codes({n}) to have {n} rows or raise ConfigError, got {len(found[-1])}")
    expect(found, "codes for 2 clusters at the least")
    return found


def _bipolar(code: NDArray[np.int8], dimensions: int, name: str) -> None:
    expect(isinstance(code, np.ndarray) and code.dtype == np.int8, f"{name} as an int8 array")
    expect(code.ndim == dimensions and code.size, f"{name} with {dimensions} dimensions, got {code.shape}")
    expect(np.isin(code, (-1, 1)).all(), f"{name} of -1 and +1 only")


def pilots_shapes(subject: Subject) -> None:
    """Hold the law."""
    _bipolar(subject.algorithm.preamble(), 1, "preamble()")
    for codes in _families(subject):
        _bipolar(codes, 2, f"codes({len(codes)})")


def pilots_apart(subject: Subject) -> None:
    """Hold the law."""
    for codes in _families(subject):
        alike = codes.astype(np.int64) @ codes.T / codes.shape[1]
        np.fill_diagonal(alike, -1)
        i, j = np.unravel_index(alike.argmax(), alike.shape)
        expect(
            alike.max() <= _MOST_ALIKE,
            f"two of {len(codes)} pilots to correlate by {_MOST_ALIKE} at most,"
            f" got {alike.max():.2f} for clusters {i} and {j}",
        )


def sharp_preamble(subject: Subject) -> None:
    """Hold the law."""
    code = subject.algorithm.preamble().astype(np.int64)
    side = np.abs(np.correlate(code, code, "full")[len(code) :]).max(initial=0) / len(code)
    expect(side <= _MOST_SIDELOBE, f"sidelobes of the preamble of {_MOST_SIDELOBE} at most, got {side:.2f}")


def codewords_shapes(subject: Subject) -> None:
    """Hold the law."""
    words = subject.algorithm.codewords()
    _bipolar(words, 2, "codewords()")
    n = len(words)
    expect(n >= 2 and n & (n - 1) == 0, f"2**m codewords, got {n}")


def codewords_distinct(subject: Subject) -> None:
    """Hold the law."""
    words = subject.algorithm.codewords()
    distinct = len(np.unique(words, axis=0))
    expect(distinct == len(words), f"{len(words)} different codewords, got {distinct}")


def codewords_come_back(subject: Subject) -> None:
    """Hold the law."""
    link = link_of(subject)
    book = link.codebook
    decode = link.algorithm("decoding").compile(book)
    presence = ideal_presence(book.clusters)
    words, k = len(book.codewords), book.clusters
    for first in range(0, words, k):
        symbols = (first + np.arange(k)) % words
        bits = bits_of_symbols(symbols[None], book.bits_per_symbol)
        back = symbols_of_bits(bits, book.bits_per_symbol, book.clusters)[0]
        expect((back == symbols).all(), f"symbols {symbols.tolist()} from their bits, got {back.tolist()}")
        soft = decode(presence, ideal_sums(book, symbols))
        wrong = np.flatnonzero(soft.symbols != symbols)
        if wrong.size:
            k = wrong[0]
            expect(False, f"symbol {symbols[k]} from an ideal image of its codeword, got {soft.symbols[k]}")


def default_clusters(subject: Subject) -> None:
    """Hold the law."""
    link = base_link_of(subject)
    try:
        subject.algorithm.codes(link.bar.clusters)
    except ConfigError as few:
        raise InapplicableLawError(str(few)) from few
    book = link_of(subject).codebook
    presence = link.algorithm("separation").compile(book)(
        ideal_sums(book, np.zeros(book.clusters, np.int64))[: 2 * book.pilots.shape[1]]
    )
    shown = ideal_presence(book.clusters).selected
    right = presence.selected & shown
    share = right.sum((1, 2)) / shown.sum((1, 2))
    expect(
        (share >= 0.5).all(),
        f"half of each cluster's cells found or more, got {share.min():.0%} of cluster {share.argmin()}",
    )
    placed = right.sum() / presence.selected.sum()
    expect(placed >= 0.9, f"nine tenths of the found cells in their place, got {placed:.0%}")


PILOTS = (
    Law("shapes", "int8 codes of -1 and +1, one per cluster", pilots_shapes),
    Law("pilots-apart", "any two pilots differ in 3 of 8 values at the least", pilots_apart),
    Law("sharp-preamble", "the preamble's sidelobes are a quarter of its peak at the most", sharp_preamble),
    Law("tells-apart", "the link's separation tells the clusters of an ideal image apart", default_clusters),
)
"""Laws of pilots."""

MODULATION = (
    Law("shapes", "int8 codewords of -1 and +1, a power of two of them", codewords_shapes),
    Law("codewords-distinct", "no two symbols have one codeword", codewords_distinct),
    Law("comes-back", "every symbol comes back from an ideal image of its codeword", codewords_come_back),
)
"""Laws of modulation."""
