"""Diagnosis of a recording: one pass through the receiver and past it, then what may be wrong is tried."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.checks import find_stages
from evlcp_sdk.diagnosis.facts import Diagnostic, Facts, other_codewords
from evlcp_sdk.diagnosis.light import LightSource, LightSurvey
from evlcp_sdk.diagnosis.probe import MOST_EVENTS, Trial, better_links, infer_links, try_link
from evlcp_sdk.diagnosis.tallies import RunTally
from evlcp_sdk.io.describe import check_sensor
from evlcp_sdk.io.open import open_source
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.rx.boxes import mask_inside
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.values import Events

_RATE_SHARE = 0.005
"""How far a measured rate may be off: half of that is seen where rows are read late."""

_TRIAL_US, _LIGHT_US = 400_000, 4_000_000
"""Time of the events that other links are tried on, some packets, and of a light that is no bar, as it may be
slow."""

_LIGHTS = 3
"""Lights that may be one LED, of what blinks."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What is in a recording, and what becomes of it.

    Attributes:
        headline: What is wrong first of all, or that nothing is, in one line.
        checks: What each check found, by stage, in the order in which light passes them.
        sources: What blinks, most events first.
        trials: Links that were tried, the one given first.
        counts: The receiver's counts.
        frequency_hz: What each cell of `cell_px` blinks with, NaN where it does not, float64 (rows, columns).
        events_map: Negative and positive events of each cell, int64 (rows, columns, 2).
        duration_s: From the first event to the last, s.
    """

    recording: str
    headline: str
    checks: tuple[Diagnostic, ...]
    sources: tuple[LightSource, ...]
    trials: tuple[Trial, ...]
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
            "checks": [{"stage": one.stage, "verdict": one.verdict} | one.to_dict() for one in self.checks],
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
    with source if isinstance(source, EventSource) else open_source(source, registry) as source:
        check_sensor(source, name, link.camera)
        seen = _Pass(link)
        for _ in seen.over(source):
            advance(source.position_bytes, source.size_bytes)
    survey, receiver = seen.survey, seen.receiver
    sources, frequency_hz = survey.found()
    facts = Facts(
        link,
        seen.tally,
        receiver.counts,
        survey.first_us,
        survey.last_us,
        receiver.lit_us,
        survey.readout,
        tuple(source.losses.values()),
        guessed=source.guessed,
        step_us=source.step_us,
        reads_messages=link.messages.decode,
        others=partial(other_codewords, link, registry),
        surveyed=True,
        sources=sources,
        restless=survey.restless(),
        speed_px_ms=survey.speed_px_ms(),
    )
    checks = find_stages(facts)
    trials: tuple[Trial, ...] = ()
    wrong = any(one.verdict == "fail" or one.code in ("codewords", "unsure") for one in checks)
    if wrong and not facts.at_edge:
        sample = seen.sample
        trials = tuple(_trials(seen, sample, sources, link, registry))
        inverted = not any(one.fits for one in trials) and try_link(link, _inverted(_short(sample))).fits
        checks = find_stages(replace(facts, trials=trials, inverted=inverted))
    return Diagnosis(
        name,
        _headline(checks, seen.tally),
        tuple(checks),
        tuple(sources),
        trials,
        receiver.counts,
        survey.cell_px,
        frequency_hz,
        survey.signs,
        facts.duration_us * 1e-6,
    )


def infer_link(source: EventSource, link: Link, registry: Registry | None = None) -> list[Trial]:
    """Links that may have sent a recording, the best first: what `receive --link auto` takes.

    Tried are chip rates of what blinks, modulations, frames per packet and frames per pilot; all else is as
    given. Where none of these fits, or packets have no preamble, framings say what they take each light for.
    Reads the source until some packets have been seen; does not close it.

    Raises:
        InputError: The source cannot be read on.
    """
    registry = Registry.load() if registry is None else registry
    seen = _Pass(link)
    for _ in seen.over(source):
        if seen.begun and seen.full:
            break
    sources, _ = seen.survey.found()
    return sorted(_trials(seen, seen.sample, sources, link, registry), key=lambda one: one.rank, reverse=True)


def _trials(
    seen: "_Pass", sample: Events, sources: Sequence[LightSource], link: Link, registry: Registry
) -> Iterator[Trial]:
    """What links make of a recording, by a sample of it; the one given first."""
    short, fits = _short(sample), False
    # What else a link may be is tried of packets that begin with a preamble only.
    if "preambles" in seen.receiver.counts and sources:
        for trial in better_links(link, short, registry, _rates(sources, link)):
            yield trial
            fits |= trial.fits
    else:
        yield try_link(link, short)
    if len(sample) and not fits:
        lights = [sample[mask_inside(sample, one.box_px)] for one in sources[:_LIGHTS]]
        yield from infer_links(link, lights or [sample], registry)


def _short(sample: Events) -> Events:
    """The start of a sample, some packets of a bar."""
    return sample[: int(np.searchsorted(sample.t_us - sample.t_us[:1], _TRIAL_US))]


def _inverted(events: Events) -> Events:
    """Events with their polarities exchanged."""
    return Events(events.t_us, events.x, events.y, 1 - events.p)


class _Pass:
    """A recording on its way through a survey and a receiver.

    Attributes:
        survey: What blinks.
        receiver: What the link reads.
        tally: Figures of its transmitters.
        pieces: Its first events, or those from where the receiver first finds something.
        begun: Whether that was so.
    """

    def __init__(self, link: Link) -> None:
        self.survey = LightSurvey(link.camera.width, link.camera.height)
        self.receiver = Receiver(link)
        self.tally = RunTally(link.packet)
        self.pieces: list[Events] = []
        self.begun = False

    def over(self, source: EventSource) -> Iterator[None]:
        """Take a source's events piece by piece."""
        for events in source.chunks():
            self.tally.add(*self.receiver.feed(events))
            self.survey.feed(events)
            if self.receiver.counts["regions_opened"] and not self.begun:
                # What was found had begun to blink in the piece before.
                self.begun, self.pieces = True, self.pieces[-1:]
            if not self.full:
                self.pieces.append(events)
            yield
        self.tally.add(*self.receiver.close())

    @property
    def full(self) -> bool:
        """Whether there are enough first events to try other links on."""
        long_us = self.pieces[-1].t_us[-1] - self.pieces[0].t_us[0] if self.pieces else 0
        long_enough_us = _TRIAL_US if self.begun else _LIGHT_US
        return sum(map(len, self.pieces)) >= MOST_EVENTS or bool(long_us > long_enough_us)

    @property
    def sample(self) -> Events:
        """The events that other links are tried on."""
        return Events.concat(self.pieces)[:MOST_EVENTS]


def _rates(sources: Sequence[LightSource], link: Link) -> list[float]:
    """Chip rates that what blinks may have, rounded, as people choose them, and not; not the link's own."""
    rates: list[float] = []
    own, first = link.packet.chip_rate_hz, sources[0]
    if first.strength_at(own) > 0.9 * first.strength and abs(first.rate_hz / own - 1) < _RATE_SHARE:
        return rates
    for source in [one for one in sources if one.kind != "lamp"][:3]:
        rounded = [float(f"{source.rate_hz:.{digits}g}") for digits in (1, 2, 3)]
        for rate in (*rounded, float(f"{2 * source.rate_hz:.3g}")):
            # None further off than what is measured may be, or half of it.
            near = any(abs(rate / f - 1) < 0.05 for f in (source.rate_hz, 2 * source.rate_hz))
            if near and abs(rate / own - 1) > 1e-4 and rate not in rates:
                rates.append(rate)
    return rates


def _headline(checks: Sequence[Diagnostic], tally: RunTally) -> str:
    for one in checks:
        if one.verdict == "fail":
            return f"{one.stage}: {one.text}"
    but = next((f"; but {one.text}" for one in checks if one.verdict == "doubt"), "")
    return f"it is read: {tally.headline()}{but}"
