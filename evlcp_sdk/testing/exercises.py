"""One plain task a role: what the laws of form give an algorithm to do."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.testing.law import InapplicableLawError, Subject, compiled
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, random_symbols
from evlcp_sdk.testing.views import ideal_presence, ideal_sums, ideal_view

__all__ = ["Exercise", "coded_bits_of", "exercise_of", "filters_of", "link_of", "symbols_of"]


@dataclass(frozen=True)
class Exercise:
    """A task.

    Attributes:
        inputs: Values that hold arrays; empty where a role takes none.
        prepare: Compiles anew and gives a function from the inputs to the results.
    """

    inputs: tuple[Any, ...]
    prepare: Callable[[], Callable[[tuple[Any, ...]], Any]]


def link_of(subject: Subject, overrides: Sequence[str] = ()) -> Link:
    """The default link, but for what is overridden, with the subject in its role.

    Raises:
        InapplicableLawError: The subject has no code for the default bar.
    """
    link = load_link(overrides=overrides)
    algorithms = {**link.algorithms, subject.role: subject.algorithm}
    codebook = link.codebook
    if subject.role in ("pilots", "modulation"):
        pilots, modulation = algorithms["pilots"], algorithms["modulation"]
        codes = compiled(lambda: pilots.codes(link.bar.clusters))
        codebook = Codebook("conformance", pilots.preamble(), codes, modulation.codewords())
    air = link.air
    packet = PacketFormat.of(codebook, air.frames_per_packet, air.chip_rate_hz, air.pilot_every)
    return replace(link, algorithms=algorithms, codebook=codebook, packet=packet, digest="conformance")


def coded_bits_of(link: Link) -> int:
    """Bits of a link's packet."""
    return link.packet.frames * link.codebook.clusters * link.codebook.bits_per_symbol


def symbols_of(codebook: Codebook, seed: int = 0) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Random symbols of one frame, int64 (K,)."""
    return np.random.default_rng(seed).integers(0, len(codebook.codewords), codebook.clusters)


def filters_of(subject: Subject) -> list[tuple[str, Any, int]]:
    """The filters of a tracking algorithm: (name, filter, values of a measurement).

    Raises:
        InapplicableLawError: It leaves everything as measured.
    """
    tracker = compiled(subject.algorithm.compile)
    pairs = [("position", tracker.position, 2), ("distance", tracker.distance, 1)]
    found = [entry for entry in pairs if entry[1] is not None]
    if not found:
        raise InapplicableLawError("leaves every quantity as measured")
    return found


def exercise_of(subject: Subject) -> Exercise:
    """The task of the subject's role, on the default link."""
    algorithm = subject.algorithm
    if subject.role == "pilots":
        return Exercise((), lambda: lambda _: (algorithm.preamble(), algorithm.codes(4)))
    if subject.role == "modulation":
        return Exercise((), lambda: lambda _: algorithm.codewords())
    link = link_of(subject)
    book = link.codebook
    symbols = symbols_of(book)
    if subject.role == "separation":
        pilot = ideal_sums(book, symbols, missing=0.1)[: link.packet.pilot_chips]
        return Exercise((pilot,), lambda: _spread(compiled(lambda: algorithm.compile(book))))
    if subject.role == "decoding":
        inputs = (ideal_presence(book.clusters), ideal_sums(book, symbols, missing=0.1))
        return Exercise(inputs, lambda: _spread(compiled(lambda: algorithm.compile(book))))
    if subject.role == "ranging":
        view = ideal_view(book, symbols, missing=0.1)
        return Exercise(
            (view,), lambda: _spread(compiled(lambda: algorithm.compile(link.camera, link.bar, book)))
        )
    if subject.role == "synchronization":
        events = ideal_events(link, IdealBar(random_symbols(link, 2)))
        until_us = int(events.t_us[-1]) + 1

        def synchronize() -> Callable[[tuple[Any, ...]], Any]:
            synchronizer = compiled(lambda: algorithm.compile(book, link.packet))
            return lambda given: synchronizer.step(synchronizer.init(), *given, until_us)[1]

        return Exercise((events.t_us, events.p), synchronize)
    rng = np.random.default_rng(0)
    if subject.role == "error-correction":
        code = compiled(lambda: algorithm.compile(coded_bits_of(link)))
        bits = rng.integers(0, 2, code.message_bits).astype(np.uint8)
        llr = (4 * (1 - 2 * code.encode(bits).astype(np.float32))).astype(np.float32)
        llr[::50] = 0

        def correct() -> Callable[[tuple[Any, ...]], Any]:
            again = compiled(lambda: algorithm.compile(coded_bits_of(link)))
            return lambda given: (again.encode(given[0]), again.decode(given[1]))

        return Exercise((bits, llr), correct)
    values = tuple(rng.normal(50.0, 0.1, (20, n)) for _, _, n in filters_of(subject))

    def track() -> Callable[[tuple[Any, ...]], Any]:
        filters = [f for _, f, _ in filters_of(subject)]
        return lambda given: [_filtered(f, v) for f, v in zip(filters, given, strict=True)]

    return Exercise(values, track)


def _spread(function: Callable[..., Any]) -> Callable[[tuple[Any, ...]], Any]:
    return lambda given: function(*given)


def _filtered(follow: Any, values: Any) -> list[Any]:
    state, out = follow.init(), []
    for i, value in enumerate(values):
        state, filtered, sigma = follow.step(state, 3200.0 * i, value, 0.1)
        out.append((filtered, sigma))
    return out
