"""Links and compiled algorithms for laws, and one simple task a role."""

from collections.abc import Callable, Sequence
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
from evlcp_sdk.testing.recordings import IdealBar, bar_in_sight, ideal_events, random_symbols
from evlcp_sdk.testing.views import ideal_frame, ideal_presence, ideal_sums, ideal_view
from evlcp_sdk.values import Events

ONE_CLUSTER = {"rows": 6, "columns": 1, "cluster_rows": 6, "cluster_columns": 1}
"""A bar of one cluster."""

FRAME_US = 3200.0
"""Time between the measurements of a tracking."""


def subject_of(role: str, algorithm: Any, link: Link | None = None) -> Subject:
    """Return the subject of an algorithm, with the id that selects it in a configuration, if there is one."""
    if link is not None and link.algorithms[role] == algorithm:
        return Subject(role, algorithm, link, link.table[role]["id"])
    target = f"{type(algorithm).__module__}:{type(algorithm).__qualname__}"
    ids = (e.algorithm.id for e in Registry.load().list_algorithms(role) if e.algorithm.target == target)
    return Subject(role, algorithm, link, next(ids, None))


@cache
def single_cluster_link(link: Link | None = None) -> Link:
    """Return the default link with a bar of one cluster, on the sensor and at the rate of another link."""
    table = {} if link is None else {name: link.table[name] for name in ("camera", "air")}
    return resolve({**table, "bar": ONE_CLUSTER})


@cache
def _default_link() -> Link:
    return load_link()


def link_of(subject: Subject, **air: Any) -> Link:
    """Return the link with the subject in its role; `air` overrides values of its table `[air]`.

    Raises:
        InapplicableLawError: The subject has no code for the link's bar.
    """
    link = _default_link() if subject.link is None else subject.link
    if subject.role == "framing" and subject.link is None:
        try:
            subject.algorithm.codebook(link.bar.clusters)
        except ConfigError:
            link = single_cluster_link()
    if subject.role == "pilots":
        compile_or_skip(lambda: subject.algorithm.codes(link.bar.clusters))
    link = link.with_algorithm(subject.role, subject.algorithm, id=subject.id)
    if not link.codebook.is_pair_coded:
        link = _set_chip_defaults(link, subject.role)
    return link.with_air(**air) if air else link


def _set_chip_defaults(link: Link, kept: str) -> Link:
    """Replace the default algorithms for pair codes by those for codes of any chips."""
    registry = Registry.load()
    for name, role in ROLES.items():
        usual, other = role.default_for(link.bar), role.default_for(link.bar, link.codebook.unpaired_codes)
        if usual != other and name != kept and link.table.get(name, {}).get("id") == usual:
            link = link.with_algorithm(name, registry.load_class(name, other)(), id=other)
    return link


def require_column(link: Link) -> None:
    """Raise an InapplicableLawError unless the bar is a column of two clusters or more."""
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


def compile_on(subject: Subject, link: Link) -> Any:
    """Compile the subject on a link; raise an InapplicableLawError if the receiver does its work itself."""
    rhythmic = subject.role == "detection" and subject.algorithm.rhythmic
    if rhythmic or (subject.role == "framing" and subject.algorithm.roles >= STEPS):
        raise InapplicableLawError("the receiver does this by itself")
    return subject.algorithm.compile(*_ARGUMENTS[subject.role](link))


def compile_subject(subject: Subject) -> Any:
    """Compile the subject on its link if it accepts that; a role without `compile` returns itself."""
    if subject.role not in _ARGUMENTS:
        return subject.algorithm
    link = link_of(subject)
    return compile_or_skip(lambda: compile_on(subject, link))


def pilot_sums(link: Link, missing: float = 0.0, seed: int = 0) -> np.ndarray[Any, np.dtype[np.int16]]:
    """Return the polarity sums of the pilot of an ideal frame, int16 (pilot chips, height, width)."""
    sums = ideal_sums(link.codebook, symbols_of(link.codebook), missing=missing, seed=seed)
    return sums[: link.packet.pilot_chips]


def locate_clusters(separate: Any, sums: np.ndarray[Any, Any], clusters: int) -> tuple[Any, float]:
    """Return the share of each cluster's pixels that is selected, and that of the selected ones in place."""
    found, shown = separate(sums), ideal_presence(clusters).pixels > 0
    cells = found.selected.repeat(found.grid_px, 1).repeat(found.grid_px, 2)
    inside = cells & shown[:, : cells.shape[1], : cells.shape[2]]
    return inside.sum((1, 2)) / shown.sum((1, 2)), inside.sum() / max(cells.sum(), 1)


def symbols_of(codebook: Codebook, seed: int = 0) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return random symbols of one frame that carry bits, int64 (K,)."""
    return np.random.default_rng(seed).integers(0, 2**codebook.bits_per_symbol, codebook.clusters)


def make_recording(link: Link, packets: int, **how: Any) -> tuple[IdealBar, Events]:
    """Return a bar that sends random symbols, and its events; `how` has arguments of `ideal_events`."""
    bar = bar_in_sight(link, random_symbols(link, packets))
    return bar, ideal_events(link, bar, **how)


def filters_of(subject: Subject) -> list[tuple[str, Any, int]]:
    """Return the filters of a tracking algorithm: (name, filter, values of a measurement).

    Raises:
        InapplicableLawError: It has none.
    """
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
    """Feed a recording, cut at some times, to a framing, and close it; return its results.

    `keep` may change the state before each step.
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
    """Return a filter's (filtered, sigma) of each measurement; `peek` may change the state before each."""
    state, out = follow.init(), []
    for i, value in enumerate(values):
        if peek is not None:
            state = peek(state, i * FRAME_US)
        state, filtered, sigma = follow.step(state, i * FRAME_US, value, 0.1)
        out.append((filtered, sigma))
    return out


def make_exercise(subject: Subject) -> tuple[tuple[Any, ...], Callable[[], Callable[..., Any]]]:
    """Return inputs of the subject's role, and what compiles it again, on its link, to a function of them."""
    inputs, run = _EXERCISES[subject.role]
    return inputs(subject), lambda: partial(run, compile_subject(subject))


def _draw_events(packets: int) -> Callable[[Subject], tuple[Any, ...]]:
    return lambda subject: (make_recording(link_of(subject), packets)[1],)


def _make_frame(subject: Subject) -> tuple[Any, ...]:
    book = link_of(subject).codebook
    # The chip after the frame is unknown, dark, or lit.
    return ideal_frame(book, symbols_of(book), after=np.arange(book.clusters) % 3 - 1, missing=0.1)


def _make_view(subject: Subject) -> tuple[Any, ...]:
    book = link_of(subject).codebook
    return (ideal_view(book, symbols_of(book), missing=0.1),)


def _draw_measurements(subject: Subject) -> tuple[Any, ...]:
    rng = np.random.default_rng(0)
    return tuple(rng.normal(50.0, 0.1, (20, n)) for _, _, n in filters_of(subject))


def _run_filters(tracker: Any, *values: Any) -> Any:
    filters = [follow for follow in (tracker.position, tracker.distance) if follow is not None]
    return [run_filter(follow, v) for follow, v in zip(filters, values, strict=True)]


def _draw_block(subject: Subject) -> tuple[Any, ...]:
    code = compile_subject(subject)
    bits = np.random.default_rng(0).integers(0, 2, code.message_bits).astype(np.uint8)
    llr = (4 * (1 - 2 * code.encode(bits).astype(np.float32))).astype(np.float32)
    llr[::50] = 0
    return bits, llr


def _call(function: Any, *inputs: Any) -> Any:
    return function(*inputs)


_EXERCISES: dict[str, tuple[Callable[[Subject], tuple[Any, ...]], Callable[..., Any]]] = {
    "detection": (_draw_events(1), lambda detector, events: detector.step(detector.init(), 0, events)[1]),
    "framing": (_draw_events(2), lambda made, events: feed_events(made, events, [int(events.t_us[-1]) + 1])),
    "pilots": (lambda _: (), lambda pilots: (pilots.preamble(), pilots.codes(4))),
    "modulation": (lambda _: (), lambda modulation: modulation.codewords()),
    "synchronization": (
        lambda subject: (_draw_events(2)(subject)[0].t_us, _draw_events(2)(subject)[0].p),
        lambda made, t_us, p: made.step(made.init(), t_us, p, int(t_us[-1]) + 1)[1],
    ),
    "separation": (lambda subject: (pilot_sums(link_of(subject), 0.1),), _call),
    "decoding": (_make_frame, _call),
    "ranging": (_make_view, _call),
    "tracking": (_draw_measurements, _run_filters),
    "error-correction": (_draw_block, lambda code, bits, llr: (code.encode(bits), code.decode(llr))),
}
"""Inputs by role, and the function of the compiled algorithm and these."""
