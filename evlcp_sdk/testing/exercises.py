"""One plain task a role: what the laws of form give an algorithm to do."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.blocks import packet_bits
from evlcp_sdk.link.resolve import Link, load_link, resolve
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import ROLES
from evlcp_sdk.testing.law import InapplicableLawError, Subject, compiled
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, random_symbols
from evlcp_sdk.testing.views import ideal_frame, ideal_sums, ideal_view
from evlcp_sdk.values import Events, Heard

__all__ = [
    "ONE_CLUSTER",
    "Exercise",
    "arguments_of",
    "base_link_of",
    "compiled_subject",
    "exercise_of",
    "expect_column",
    "filters_of",
    "heard_of",
    "link_of",
    "link_of_one_cluster",
    "subject_of",
    "symbols_of",
]


ONE_CLUSTER = {"rows": 6, "columns": 1, "cluster_rows": 6, "cluster_columns": 1}
"""A bar for what sends with one cluster only."""


@dataclass(frozen=True)
class Exercise:
    """A task.

    Attributes:
        inputs: Values that hold arrays; empty where a role takes none.
        prepare: Compiles anew and gives a function from the inputs to the results.
    """

    inputs: tuple[Any, ...]
    prepare: Callable[[], Callable[[tuple[Any, ...]], Any]]


def subject_of(role: str, algorithm: Any, link: Link | None = None) -> Subject:
    """An algorithm under test, under the id by which a configuration selects it, if any does.

    Args:
        role: The role that it fills.
        algorithm: The algorithm.
        link: What the rest of the link is; None for the default.
    """
    if link is not None and link.algorithms[role] == algorithm:
        return Subject(role, algorithm, link, link.table[role]["id"])
    cls = type(algorithm)
    target = f"{cls.__module__}:{cls.__qualname__}"
    for entry in Registry.load().installed(role):
        if entry.algorithm.target == target:
            return Subject(role, algorithm, link, entry.algorithm.id)
    return Subject(role, algorithm, link)


@cache
def link_of_one_cluster() -> Link:
    """The default link, with a bar of one cluster."""
    return resolve({"bar": ONE_CLUSTER})


@cache
def _default_link() -> Link:
    return load_link()


def base_link_of(subject: Subject) -> Link:
    """The link that the subject is tested on, without it."""
    return _default_link() if subject.link is None else subject.link


def link_of(subject: Subject, **air: Any) -> Link:
    """The link with the subject in its role; `air` overrides values of its table `[air]`.

    Raises:
        InapplicableLawError: The subject has no code for the link's bar.
    """
    link = base_link_of(subject)
    if subject.role == "framing" and subject.link is None:
        try:
            subject.algorithm.codebook(link.bar.clusters)
        except ConfigError:
            link = link_of_one_cluster()
    if subject.role == "pilots":
        compiled(lambda: subject.algorithm.codes(link.bar.clusters))
    link = link.with_algorithm(subject.role, subject.algorithm, id=subject.id)
    if not link.codebook.pairs:
        link = _of_chips(link, subject.role)
    return link.with_air(**air) if air else link


def _of_chips(link: Link, kept: str) -> Link:
    """The link with the defaults for codes of any chips where it has those for pair codes."""
    registry = Registry.load()
    for name, role in ROLES.items():
        usual, other = role.default_for(link.bar), role.default_for(link.bar, link.codebook.of_chips)
        if usual != other and name != kept and link.table.get(name, {}).get("id") == usual:
            link = link.with_algorithm(name, registry.load_class(name, other)(), id=other)
    return link


def expect_column(link: Link) -> None:
    """Pass over a law whose ideal images show a bar: two clusters or more, one above the other.

    Raises:
        InapplicableLawError: The link's bar is another.
    """
    if link.bar.clusters < 2 or np.ptp(link.bar.cluster_centres_m()[:, 0]) > 1e-9:
        raise InapplicableLawError("the ideal images of this law show one column of two clusters or more")


_ARGUMENTS: dict[str, Callable[[Link], tuple[Any, ...]]] = {
    "detection": lambda link: (link.camera, link.codebook, link.packet),
    "framing": lambda link: (link.codebook, link.packet),
    "synchronization": lambda link: (link.codebook, link.packet),
    "separation": lambda link: (link.codebook,),
    "decoding": lambda link: (link.codebook,),
    "ranging": lambda link: (link.camera, link.bar, link.codebook),
    "tracking": lambda _: (),
    "error-correction": lambda link: (packet_bits(link.codebook, link.packet),),
}


def arguments_of(subject: Subject) -> tuple[Any, ...]:
    """What the subject's `compile` is given."""
    return _ARGUMENTS[subject.role](link_of(subject))


def compiled_subject(subject: Subject) -> Any:
    """What the subject compiles to on its link.

    Raises:
        InapplicableLawError: It refuses the link.
    """
    arguments = arguments_of(subject)
    return compiled(lambda: subject.algorithm.compile(*arguments))


def symbols_of(codebook: Codebook, seed: int = 0) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Random symbols of one frame that carry bits, int64 (K,)."""
    return np.random.default_rng(seed).integers(0, 2**codebook.bits_per_symbol, codebook.clusters)


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
    """The task of the subject's role, on its link."""
    return _EXERCISES[subject.role](subject)


def _detection(subject: Subject) -> Exercise:
    link = link_of(subject)
    events = ideal_events(link, IdealBar(random_symbols(link, 1)))

    def detect() -> Callable[[tuple[Any, ...]], Any]:
        detector = compiled_subject(subject)
        if detector is None:
            return lambda _: ()
        return lambda given: detector.step(detector.init(), 0, given[0])[1]

    return Exercise((events,), detect)


def _framing(subject: Subject) -> Exercise:
    link = link_of(subject)
    events = ideal_events(link, IdealBar(random_symbols(link, 2)))
    until_us = int(events.t_us[-1]) + 1

    def frame() -> Callable[[tuple[Any, ...]], Any]:
        deframer = compiled_subject(subject)
        if deframer is None:
            return lambda _: ()
        return lambda given: heard_of(deframer, given[0], [until_us])

    return Exercise((events,), frame)


def heard_of(deframer: Any, events: Events, until_us: Sequence[int]) -> list[Heard]:
    """Frames of a recording that is cut at times, those at its end, too."""
    state = deframer.init()
    heard: list[Heard] = []
    begin = 0
    for until in until_us:
        end = int(np.searchsorted(events.t_us, until))
        state, found = deframer.step(state, events[begin:end], until)
        heard += found
        begin = end
    heard += deframer.close(state)[1]
    return heard


def _pilots(subject: Subject) -> Exercise:
    algorithm = subject.algorithm
    return Exercise((), lambda: lambda _: (algorithm.preamble(), algorithm.codes(4)))


def _modulation(subject: Subject) -> Exercise:
    return Exercise((), lambda: lambda _: subject.algorithm.codewords())


def _synchronization(subject: Subject) -> Exercise:
    link = link_of(subject)
    events = ideal_events(link, IdealBar(random_symbols(link, 2)))
    until_us = int(events.t_us[-1]) + 1

    def synchronize() -> Callable[[tuple[Any, ...]], Any]:
        synchronizer = compiled_subject(subject)
        return lambda given: synchronizer.step(synchronizer.init(), *given, until_us)[1]

    return Exercise((events.t_us, events.p), synchronize)


def _separation(subject: Subject) -> Exercise:
    link = link_of(subject)
    sums = ideal_sums(link.codebook, symbols_of(link.codebook), missing=0.1)
    return Exercise((sums[: link.packet.pilot_chips],), lambda: _spread(compiled_subject(subject)))


def _decoding(subject: Subject) -> Exercise:
    book = link_of(subject).codebook
    # Clusters of which it is not known what follows, that it is dark, that it is lit.
    after = np.arange(book.clusters) % 3 - 1
    inputs = ideal_frame(book, symbols_of(book), after=after, missing=0.1)
    return Exercise(inputs, lambda: _spread(compiled_subject(subject)))


def _ranging(subject: Subject) -> Exercise:
    book = link_of(subject).codebook
    view = ideal_view(book, symbols_of(book), missing=0.1)
    return Exercise((view,), lambda: _spread(compiled_subject(subject)))


def _tracking(subject: Subject) -> Exercise:
    rng = np.random.default_rng(0)
    values = tuple(rng.normal(50.0, 0.1, (20, n)) for _, _, n in filters_of(subject))

    def track() -> Callable[[tuple[Any, ...]], Any]:
        filters = [f for _, f, _ in filters_of(subject)]
        return lambda given: [_filtered(f, v) for f, v in zip(filters, given, strict=True)]

    return Exercise(values, track)


def _error_correction(subject: Subject) -> Exercise:
    code = compiled_subject(subject)
    bits = np.random.default_rng(0).integers(0, 2, code.message_bits).astype(np.uint8)
    llr = (4 * (1 - 2 * code.encode(bits).astype(np.float32))).astype(np.float32)
    llr[::50] = 0

    def correct() -> Callable[[tuple[Any, ...]], Any]:
        again = compiled_subject(subject)
        return lambda given: (again.encode(given[0]), again.decode(given[1]))

    return Exercise((bits, llr), correct)


_EXERCISES: dict[str, Callable[[Subject], Exercise]] = {
    "detection": _detection,
    "framing": _framing,
    "pilots": _pilots,
    "modulation": _modulation,
    "synchronization": _synchronization,
    "separation": _separation,
    "decoding": _decoding,
    "ranging": _ranging,
    "tracking": _tracking,
    "error-correction": _error_correction,
}


def _spread(function: Callable[..., Any]) -> Callable[[tuple[Any, ...]], Any]:
    return lambda given: function(*given)


def _filtered(follow: Any, values: Any) -> list[Any]:
    state, out = follow.init(), []
    for i, value in enumerate(values):
        state, filtered, sigma = follow.step(state, 3200.0 * i, value, 0.1)
        out.append((filtered, sigma))
    return out
