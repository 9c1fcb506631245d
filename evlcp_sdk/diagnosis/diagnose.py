"""Diagnosis of a recording: one pass through the receiver and past it, then what may be wrong is tried."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.checks import Check, checks_of
from evlcp_sdk.diagnosis.facts import Diagnostic, Facts, other_codewords
from evlcp_sdk.diagnosis.light import LightSource, LightSurvey
from evlcp_sdk.diagnosis.probe import MOST_EVENTS, Trial, better_links, try_link
from evlcp_sdk.diagnosis.tallies import RunTally
from evlcp_sdk.diagnosis.warnings import find_warnings
from evlcp_sdk.io.open import open_source
from evlcp_sdk.io.sensor import check_sensor
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.values import Events

_RATE_SHARE = 0.005
"""How far a measured rate may be off: half of that is seen where rows are read late."""

_TRIAL_US = 400_000
"""Time of the events that other links are tried on: some packets."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What is in a recording, and what becomes of it.

    Attributes:
        recording: Its name.
        headline: What is wrong first of all, or that nothing is, in one line.
        checks: The stages in the order in which light passes them.
        sources: What blinks, most events first.
        trials: Links that were tried, the one given first.
        warnings: What `receive` would warn of.
        counts: The receiver's counts.
        cell_px: Size of the cells of the maps, px.
        frequency_hz: What each cell blinks with, NaN where it does not, float64 (rows, columns).
        events_map: Negative and positive events of each cell, int64 (rows, columns, 2).
        duration_s: From the first event to the last, s.
    """

    recording: str
    headline: str
    checks: tuple[Check, ...]
    sources: tuple[LightSource, ...]
    trials: tuple[Trial, ...]
    warnings: tuple[Diagnostic, ...]
    counts: dict[str, int]
    cell_px: int
    frequency_hz: NDArray[np.float64]
    events_map: NDArray[np.int64]
    duration_s: float

    def to_dict(self) -> dict[str, Any]:
        """The diagnosis as JSON values, without the maps."""
        return {
            "recording": self.recording,
            "headline": self.headline,
            "checks": [asdict(one) for one in self.checks],
            "sources": [
                {
                    "kind": one.kind,
                    "rate_hz": round(one.rate_hz, 1),
                    "strength": round(one.strength, 3),
                    "box_px": list(one.box_px),
                    "size_px": [one.wide_px, one.high_px],
                    "events": one.events,
                    "negative_share": round(one.negative_share, 4),
                }
                for one in self.sources
            ],
            "tried": [
                {
                    "changes": dict(one.changes),
                    "frames": one.frames,
                    "rejected": one.rejected,
                    "fits": one.fits,
                }
                for one in self.trials
            ],
            "warnings": [warning.to_dict() for warning in self.warnings],
            "counts": self.counts,
            "duration_s": self.duration_s,
        }


def diagnose(
    source: EventSource | str | Path,
    link: Link | Path | str | None = None,
    *,
    registry: Registry | None = None,
    advance: Callable[[int, int | None], None] = lambda _done, _of: None,
) -> Diagnosis:
    """Say why a recording is read, or is not: what blinks in it, and which stage of the receiver stops it.

    Args:
        source: What to open, plugins asked first; or a source that is open, which is read on and closed.
        link: The link that it is expected to have been sent with, or a `link.toml`; None for all defaults.
        registry: The plugins; None for all that are installed.
        advance: Says how far the reading is.

    Raises:
        InputError: The source cannot be opened, or read on.
        ConfigError: The file does not describe a link, or the recording's sensor is not the link's.
    """
    registry = Registry.load() if registry is None else registry
    link = link if isinstance(link, Link) else load_link(link, registry=registry)
    name = str(source.path if isinstance(source, EventSource) else source)
    survey, receiver, sample = LightSurvey(link.camera.width, link.camera.height), Receiver(link), _Sample()
    tally = RunTally(link.packet)
    with source if isinstance(source, EventSource) else open_source(source, registry) as source:
        check_sensor(source, name, link.camera)
        for events in source.chunks():
            for packet in receiver.feed(events):
                tally.add(packet)
            survey.feed(events)
            sample.feed(events, seen=receiver.counts["regions_opened"] > 0)
            advance(source.position_bytes, source.size_bytes)
    for packet in receiver.close():
        tally.add(packet)
    sources, frequency_hz = survey.found()
    facts = Facts(
        link,
        tally,
        receiver.counts,
        survey.first_us,
        survey.last_us,
        receiver.lit_us,
        survey.readout,
        sum(loss.count for loss in source.losses.values()),
        reads_messages=link.messages.decode,
        others=partial(other_codewords, link, registry),
        events=source.counts["events"],
        sources=sources,
        restless=survey.restless(),
        losses=[str(loss) for loss in source.losses.values()],
    )
    checks = checks_of(facts)
    trials: tuple[Trial, ...] = ()
    failed = any(one.verdict == "fail" for one in checks)
    if failed and sources and not facts.at_edge and _has_preambles(receiver):
        trials = tuple(better_links(link, sample.events(), registry, _rates(sources, link)))
        checks = checks_of(replace(facts, trials=trials))
    return Diagnosis(
        name,
        _headline(checks, tally),
        tuple(checks),
        tuple(sources),
        trials,
        tuple(find_warnings(facts)),
        receiver.counts,
        survey.cell_px,
        frequency_hz,
        survey.signs,
        facts.duration_us * 1e-6,
    )


def infer_link(source: EventSource, link: Link, registry: Registry | None = None) -> list[Trial]:
    """Links that may have sent a recording, the best first: what `receive --link auto` takes.

    Tried are chip rates of what blinks, modulations, frames per packet and frames per pilot; all else is as
    given. A link whose framing has no preamble is taken as it is. Reads until some packets have been seen.

    Args:
        source: What is read; not closed.
        link: What is given, one of those tried.
        registry: Where other modulations are found; None for all that are installed.

    Raises:
        InputError: The source cannot be read on.
    """
    registry = Registry.load() if registry is None else registry
    survey, receiver, sample = LightSurvey(link.camera.width, link.camera.height), Receiver(link), _Sample()
    for events in source.chunks():
        receiver.feed(events)
        survey.feed(events)
        sample.feed(events, seen=receiver.counts["regions_opened"] > 0)
        if sample.full and sample.seen:
            break
    sources, _ = survey.found()
    if not _has_preambles(receiver):
        return [try_link(link, sample.events())]
    trials = better_links(link, sample.events(), registry, _rates(sources, link))
    return sorted(trials, key=lambda one: one.rank, reverse=True)


def _has_preambles(receiver: Receiver) -> bool:
    """Whether packets begin with a preamble: what else a link may be is tried of those only."""
    return "preambles" in receiver.counts


class _Sample:
    """The first events of a recording, or those from where the receiver first finds something."""

    def __init__(self) -> None:
        self._pieces: list[Events] = []
        self._many = 0
        self.seen = False

    @property
    def full(self) -> bool:
        first = self._pieces[0].t_us[0] if self._pieces else 0
        last = self._pieces[-1].t_us[-1] if self._pieces else 0
        return self._many >= MOST_EVENTS or bool(last - first > _TRIAL_US)

    def feed(self, events: Events, *, seen: bool) -> None:
        if seen and not self.seen:
            self.seen = True
            # What was found had begun to blink in the piece before.
            self._pieces = self._pieces[-1:]
            self._many = sum(map(len, self._pieces))
        if not self.full:
            self._pieces.append(events)
            self._many += len(events)

    def events(self) -> Events:
        return Events.concat(self._pieces)[:MOST_EVENTS]


def _rates(sources: Sequence[LightSource], link: Link) -> list[float]:
    """Chip rates that what blinks may have, rounded, as people choose them, and not; not the link's own."""
    rates: list[float] = []
    own = link.packet.chip_rate_hz
    if any(
        one.strength_at(own) > 0.9 * one.strength and abs(one.rate_hz / own - 1) < _RATE_SHARE
        for one in sources[:1]
    ):
        return rates
    for source in [one for one in sources if one.kind != "lamp"][:3]:
        rounded = [float(f"{source.rate_hz:.{digits}g}") for digits in (1, 2, 3)]
        for rate in (*rounded, float(f"{2 * source.rate_hz:.3g}")):
            # None further off than what is measured may be, or half of it.
            near = any(abs(rate / f - 1) < 0.05 for f in (source.rate_hz, 2 * source.rate_hz))
            if near and abs(rate / own - 1) > 1e-4 and rate not in rates:
                rates.append(rate)
    return rates


def _headline(checks: list[Check], tally: RunTally) -> str:
    wrong = next((one for one in checks if one.verdict == "fail"), None)
    if wrong is None:
        doubts = [one for one in checks if one.verdict == "doubt"]
        but = f"; but {doubts[0].said}" if doubts else ""
        return f"it is read: {tally.headline()}{but}"
    return f"{wrong.stage}: {wrong.said}"
