"""What the laws hold an algorithm against: its link, what it compiles to, and one plain task a role."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.blocks import packet_bits
from evlcp_sdk.link.resolve import Link, load_link, resolve
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import ROLES, STEPS
from evlcp_sdk.testing.law import InapplicableLawError, Subject, compile_or_skip
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, random_symbols
from evlcp_sdk.testing.views import ideal_frame, ideal_sums, ideal_view
from evlcp_sdk.values import Events

ONE_CLUSTER = {"rows": 6, "columns": 1, "cluster_rows": 6, "cluster_columns": 1}
"""A bar for what sends with one cluster only."""

FRAME_US = 3200.0
"""Time from measurement to measurement of what tracks."""


def subject_of(role: str, algorithm: Any, link: Link | None = None) -> Subject:
    """An algorithm under test, under the id by which a configuration selects it, if any does."""
    if link is not None and link.algorithms[role] == algorithm:
        return Subject(role, algorithm, link, link.table[role]["id"])
    target = f"{type(algorithm).__module__}:{type(algorithm).__qualname__}"
    ids = (e.algorithm.id for e in Registry.load().list_algorithms(role) if e.algorithm.target == target)
    return Subject(role, algorithm, link, next(ids, None))


@cache
def link_of_one_cluster() -> Link:
    """The default link, with a bar of one cluster."""
    return resolve({"bar": ONE_CLUSTER})


@cache
def _default_link() -> Link:
    return load_link()


def link_of(subject: Subject, **air: Any) -> Link:
    """The link with the subject in its role; `air` overrides values of its table `[air]`.

    Passes over a law where the subject has no code for the link's bar.
    """
    link = _default_link() if subject.link is None else subject.link
    if subject.role == "framing" and subject.link is None:
        try:
            subject.algorithm.codebook(link.bar.clusters)
        except ConfigError:
            link = link_of_one_cluster()
    if subject.role == "pilots":
        compile_or_skip(lambda: subject.algorithm.codes(link.bar.clusters))
    link = link.with_algorithm(subject.role, subject.algorithm, id=subject.id)
    if not link.codebook.is_pair_coded:
        link = _of_chips(link, subject.role)
    return link.with_air(**air) if air else link


def _of_chips(link: Link, kept: str) -> Link:
    """The link with the defaults for codes of any chips where it has those for pair codes."""
    registry = Registry.load()
    for name, role in ROLES.items():
        usual, other = role.default_for(link.bar), role.default_for(link.bar, link.codebook.unpaired_codes)
        if usual != other and name != kept and link.table.get(name, {}).get("id") == usual:
            link = link.with_algorithm(name, registry.load_class(name, other)(), id=other)
    return link


def expect_column(link: Link) -> None:
    """Pass over a law whose ideal images show a bar, two clusters or more, one above the other, of others."""
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


def compile_given(subject: Subject, arguments: tuple[Any, ...]) -> Any:
    """What the subject's `compile` gives; passes over a law of what the receiver does by itself."""
    rhythmic = subject.role == "detection" and subject.algorithm.rhythmic
    if rhythmic or (subject.role == "framing" and subject.algorithm.roles >= STEPS):
        raise InapplicableLawError("the receiver does this by itself")
    return subject.algorithm.compile(*arguments)


def compile_subject(subject: Subject) -> Any:
    """What the subject compiles to on its link, if it does not refuse that; a role that does not, itself."""
    if subject.role not in _ARGUMENTS:
        return subject.algorithm
    arguments = arguments_of(subject)
    return compile_or_skip(lambda: compile_given(subject, arguments))


def pilot_sums(link: Link, missing: float = 0.0, seed: int = 0) -> np.ndarray[Any, np.dtype[np.int16]]:
    """Polarity sums of the pilot of an ideal frame, int16 (pilot chips, height, width)."""
    sums = ideal_sums(link.codebook, symbols_of(link.codebook), missing=missing, seed=seed)
    return sums[: link.packet.pilot_chips]


def symbols_of(codebook: Codebook, seed: int = 0) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Random symbols of one frame that carry bits, int64 (K,)."""
    return np.random.default_rng(seed).integers(0, 2**codebook.bits_per_symbol, codebook.clusters)


def recording_of(link: Link, packets: int, **how: Any) -> tuple[IdealBar, Events]:
    """A bar that sends random symbols, and its events; `how` is of `ideal_events`."""
    bar = IdealBar(random_symbols(link, packets))
    return bar, ideal_events(link, bar, **how)


def filters_of(subject: Subject) -> list[tuple[str, Any, int]]:
    """The filters of a tracking algorithm, if it has any: (name, filter, values of a measurement)."""
    tracker = compile_subject(subject)
    pairs = [("position", tracker.position, 2), ("distance", tracker.distance, 1)]
    found = [entry for entry in pairs if entry[1] is not None]
    if not found:
        raise InapplicableLawError("leaves every quantity as measured")
    return found


def feed_events(
    machine: Any,
    events: Events,
    until_us: Sequence[int],
    keep: Callable[[Any, Events, int], Any] | None = None,
) -> list[Any]:
    """What a framing's machine gives of a recording that is cut at times, and at its end.

    `keep` may change its state before each step, by what is to come.
    """
    state, found, begin = machine.init(), [], 0
    for until in until_us:
        end = int(np.searchsorted(events.t_us, until))
        if keep is not None:
            state = keep(state, events[begin:end], until)
        state, new = machine.step(state, events[begin:end], until)
        found += new
        begin = end
    return [*found, *machine.close(state)[1]]


def run_filter(follow: Any, values: Any, peek: Callable[[Any, float], Any] | None = None) -> list[Any]:
    """What a filter gives of measurements: (filtered, sigma); `peek` may change its state before each."""
    state, out = follow.init(), []
    for i, value in enumerate(values):
        if peek is not None:
            state = peek(state, i * FRAME_US)
        state, filtered, sigma = follow.step(state, i * FRAME_US, value, 0.1)
        out.append((filtered, sigma))
    return out


@dataclass(frozen=True)
class Exercise:
    """A task: values that hold arrays, and what compiles anew and gives a function from them to results."""

    inputs: tuple[Any, ...]
    prepare: Callable[[], Callable[..., Any]]


def exercise_of(subject: Subject) -> Exercise:
    """The task of the subject's role, on its link."""
    inputs, run = _EXERCISES[subject.role]
    return Exercise(inputs(subject), lambda: partial(run, compile_subject(subject)))


def _events(packets: int) -> Callable[[Subject], tuple[Any, ...]]:
    return lambda subject: (recording_of(link_of(subject), packets)[1],)


def _frame_image(subject: Subject) -> tuple[Any, ...]:
    book = link_of(subject).codebook
    # Clusters of which it is not known what follows, that it is dark, that it is lit.
    return ideal_frame(book, symbols_of(book), after=np.arange(book.clusters) % 3 - 1, missing=0.1)


def _view(subject: Subject) -> tuple[Any, ...]:
    book = link_of(subject).codebook
    return (ideal_view(book, symbols_of(book), missing=0.1),)


def _measurements(subject: Subject) -> tuple[Any, ...]:
    rng = np.random.default_rng(0)
    return tuple(rng.normal(50.0, 0.1, (20, n)) for _, _, n in filters_of(subject))


def _filter(tracker: Any, *values: Any) -> Any:
    filters = [follow for follow in (tracker.position, tracker.distance) if follow is not None]
    return [run_filter(follow, v) for follow, v in zip(filters, values, strict=True)]


def _bits_and_llr(subject: Subject) -> tuple[Any, ...]:
    code = compile_subject(subject)
    bits = np.random.default_rng(0).integers(0, 2, code.message_bits).astype(np.uint8)
    llr = (4 * (1 - 2 * code.encode(bits).astype(np.float32))).astype(np.float32)
    llr[::50] = 0
    return bits, llr


def _call(function: Any, *inputs: Any) -> Any:
    return function(*inputs)


_EXERCISES: dict[str, tuple[Callable[[Subject], tuple[Any, ...]], Callable[..., Any]]] = {
    "detection": (_events(1), lambda detector, events: detector.step(detector.init(), 0, events)[1]),
    "framing": (_events(2), lambda made, events: feed_events(made, events, [int(events.t_us[-1]) + 1])),
    "pilots": (lambda _: (), lambda pilots: (pilots.preamble(), pilots.codes(4))),
    "modulation": (lambda _: (), lambda modulation: modulation.codewords()),
    "synchronization": (
        lambda subject: (_events(2)(subject)[0].t_us, _events(2)(subject)[0].p),
        lambda made, t_us, p: made.step(made.init(), t_us, p, int(t_us[-1]) + 1)[1],
    ),
    "separation": (lambda subject: (pilot_sums(link_of(subject), 0.1),), _call),
    "decoding": (_frame_image, _call),
    "ranging": (_view, _call),
    "tracking": (_measurements, _filter),
    "error-correction": (_bits_and_llr, lambda code, bits, llr: (code.encode(bits), code.decode(llr))),
}
"""Role to its inputs, and what is done with them and what the algorithm compiles to."""
