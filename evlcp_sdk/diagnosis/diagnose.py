"""Diagnosis of a recording: one pass through receiver and light survey, then trials of other links."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.checks import assess_stages
from evlcp_sdk.diagnosis.facts import Diagnostic, Facts
from evlcp_sdk.diagnosis.light import LightSource, LightSurvey
from evlcp_sdk.diagnosis.probe import (
    MAX_EVENTS,
    Trial,
    find_other_codewords,
    infer_links,
    try_changes,
    try_link,
)
from evlcp_sdk.diagnosis.tallies import RunTally
from evlcp_sdk.io.describe import check_sensor
from evlcp_sdk.io.open import open_source
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.rx.boxes import mask_inside
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.values import Events

_RATE_TOLERANCE = 0.005
"""Of a measured rate: half of it occurs where rows are read late."""

_TRIAL_US, _LIGHT_US = 400_000, 4_000_000
"""Time of the events for trials of other links: some packets; and of a light that is no bar, which may be
slow."""

_MAX_LIGHTS = 3
"""Sources of light that are tried as one LED."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What is in a recording, and why it is read or not.

    Attributes:
        headline: The first fault, or that there is none, in one line.
        checks: Findings of all checks, by stage, in the order in which light passes them.
        sources: Sources of light, most events first.
        trials: Links that were tried, the given one first.
        counts: The receiver's counts.
        frequency_hz: Frequency of each cell of `cell_px`, NaN where it does not blink, float64 (rows,
            columns).
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
    """Find out why a recording is read or not: what blinks in it, and which stage of the receiver fails.

    Args:
        source: What to open, plugins asked first; or an open source, which is read on and closed.
        link: The link that it is expected to be sent with, or a `link.toml`; None for all defaults.
        registry: The plugins; None for all that are installed.
        advance: Called after each piece with the bytes that are read, and of how many if that is known.

    Raises:
        InputError: The source cannot be opened, or read on.
        ConfigError: The file does not describe a link, or the recording's sensor is not the link's.
    """
    registry = Registry.load() if registry is None else registry
    link = link if isinstance(link, Link) else load_link(link, registry=registry)
    name = str(source.path if isinstance(source, EventSource) else source)
    with source if isinstance(source, EventSource) else open_source(source, registry) as source:
        check_sensor(source, name, link.camera)
        recording = _RecordingPass(link)
        for _ in recording.read(source):
            advance(source.position_bytes, source.size_bytes)
    survey, receiver = recording.survey, recording.receiver
    sources, frequency_hz = survey.find_sources()
    facts = Facts(
        link,
        recording.tally,
        receiver.counts,
        survey.first_us,
        survey.last_us,
        receiver.lit_us,
        survey.readout,
        tuple(source.losses.values()),
        guessed=source.guessed,
        step_us=source.step_us,
        reads_messages=link.messages.decode,
        other_codewords=partial(find_other_codewords, link, registry),
        has_survey=True,
        sources=sources,
        restless_box=survey.find_restless_box(),
        speed_px_ms=survey.speed_px_ms(),
    )
    checks = assess_stages(facts)
    trials: tuple[Trial, ...] = ()
    is_wrong = any(one.verdict == "fail" or one.code in ("codewords", "unsure") for one in checks)
    if is_wrong and not facts.touches_edge:
        trials = tuple(recording.try_links(sources, registry))
        start = _cut_trial_events(recording.sample)
        inverted = Events(start.t_us, start.x, start.y, 1 - start.p)
        fits_inverted = not any(one.fits for one in trials) and try_link(link, inverted).fits
        checks = assess_stages(replace(facts, trials=trials, fits_inverted=fits_inverted))
    return Diagnosis(
        name,
        _headline(checks, recording.tally),
        tuple(checks),
        tuple(sources),
        trials,
        receiver.counts,
        survey.cell_px,
        frequency_hz,
        survey.signs,
        facts.duration_us * 1e-6,
    )


def infer_link(source: EventSource, link: Link) -> list[Trial]:
    """Infer links that may have sent a recording, the best first, as `receive --link auto` does.

    Tries chip rates of the light, modulations, frames per packet and frames per pilot; all else is as given.
    Where none of these fits, or packets have no preamble, each framing infers a link from each light.
    Reads the source until some packets have been seen; does not close it.

    Raises:
        InputError: The source cannot be read on.
    """
    recording = _RecordingPass(link)
    for _ in recording.read(source):
        if recording.has_regions and recording.is_full:
            break
    sources, _ = recording.survey.find_sources()
    trials = recording.try_links(sources, Registry.load())
    return sorted(trials, key=lambda one: one.rank, reverse=True)


def _cut_trial_events(sample: Events) -> Events:
    """The start of a sample: some packets of a bar."""
    return sample[: int(np.searchsorted(sample.t_us - sample.t_us[:1], _TRIAL_US))]


class _RecordingPass:
    """One pass of a recording through a survey and a receiver.

    Attributes:
        pieces: Its first events, or those around the receiver's first region.
        has_regions: The receiver has opened a region.
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self.survey = LightSurvey(link.camera.width, link.camera.height)
        self.receiver = Receiver(link)
        self.tally = RunTally(link.packet)
        self.pieces: list[Events] = []
        self.has_regions = False

    def read(self, source: EventSource) -> Iterator[None]:
        """Read a source to its end, piece by piece."""
        for events in source.chunks():
            self.tally.add(*self.receiver.feed(events))
            self.survey.feed(events)
            if self.receiver.counts["regions_opened"] and not self.has_regions:
                # A region's light had begun to blink in the piece before.
                self.has_regions, self.pieces = True, self.pieces[-1:]
            if not self.is_full:
                self.pieces.append(events)
            yield
        self.tally.add(*self.receiver.close())

    @property
    def is_full(self) -> bool:
        """Whether there are enough events for trials of other links."""
        length_us = self.pieces[-1].t_us[-1] - self.pieces[0].t_us[0] if self.pieces else 0
        needed_us = _TRIAL_US if self.has_regions else _LIGHT_US
        return sum(map(len, self.pieces)) >= MAX_EVENTS or bool(length_us > needed_us)

    @property
    def sample(self) -> Events:
        """The events for trials of other links."""
        return Events.concat(self.pieces)[:MAX_EVENTS]

    def try_links(self, sources: Sequence[LightSource], registry: Registry) -> Iterator[Trial]:
        """Try links on a sample of it, the expected one first."""
        sample, fits = self.sample, False
        start = _cut_trial_events(sample)
        # Changes are tried only of links whose packets have a preamble.
        if "preambles" in self.receiver.counts and sources:
            for trial in try_changes(self.link, start, registry, _candidate_rates_hz(sources, self.link)):
                yield trial
                fits |= trial.fits
        else:
            yield try_link(self.link, start)
        if len(sample) and not fits:
            lights = [sample[mask_inside(sample, one.box_px)] for one in sources[:_MAX_LIGHTS]]
            yield from infer_links(self.link, lights or [sample], registry)


def _candidate_rates_hz(sources: Sequence[LightSource], link: Link) -> list[float]:
    """Chip rates that the sources may have, rounded, as people choose them, and not; without the link's."""
    rates: list[float] = []
    own, first = link.packet.chip_rate_hz, sources[0]
    if first.strength_at(own) > 0.9 * first.strength and abs(first.rate_hz / own - 1) < _RATE_TOLERANCE:
        return rates
    for source in [one for one in sources if one.kind != "lamp"][:3]:
        rounded = [float(f"{source.rate_hz:.{digits}g}") for digits in (1, 2, 3)]
        for rate in (*rounded, float(f"{2 * source.rate_hz:.3g}")):
            # Within the error of the measured rate, or of twice that.
            is_near = any(abs(rate / f - 1) < 0.05 for f in (source.rate_hz, 2 * source.rate_hz))
            if is_near and abs(rate / own - 1) > 1e-4 and rate not in rates:
                rates.append(rate)
    return rates


def _headline(checks: Sequence[Diagnostic], tally: RunTally) -> str:
    for one in checks:
        if one.verdict == "fail":
            return f"{one.stage}: {one.text}"
    warning = next((f"; but {one.text}" for one in checks if one.verdict == "doubt"), "")
    return f"it is read: {tally.headline()}{warning}"
