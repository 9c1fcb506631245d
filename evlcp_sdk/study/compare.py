"""Recordings with their truth, received with every variant in one comparison.

A recording is read once; each piece of its events goes through one `Receiver.feed` after the other, so that
all see the same and time is measured in one run. Frames are counted as in the road score of `evlcp score`.
"""

import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.io import EventSource, open_source
from evlcp_sdk.io.describe import check_sensor
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.several import load_links, name_links
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.sim.truth import Truth, read_truth, truth_path
from evlcp_sdk.stopwatch import Stopwatch
from evlcp_sdk.study.bound import frame_bound
from evlcp_sdk.study.comparison import STAGES, Comparison, Measurement, Table, total_of
from evlcp_sdk.study.frames import FrameRow, frames_of
from evlcp_sdk.study.match import check_link
from evlcp_sdk.study.measure import count_without_truth, statistics_of
from evlcp_sdk.values import Events, FrameView, Range

_KEY_PATTERN = r"[\w-]+\s*\.\s*[\w-]+\s*(?:\.\s*[\w-]+\s*)?="
_SETTING_PATTERN = re.compile(rf"{_KEY_PATTERN}.*", re.DOTALL)
_SEPARATOR_PATTERN = re.compile(rf",(?=\s*{_KEY_PATTERN})")
"""A comma is part of a value, as in `[1, 14]`, unless another setting follows it."""


@dataclass(frozen=True, eq=False)
class Variant:
    """A named configuration: the settings that distinguish it, and its resolved links by name."""

    name: str
    settings: tuple[str, ...]
    links: Mapping[str, Link]

    def to_dict(self) -> dict[str, Any]:
        """Settings, digest and resolved table as JSON values; of several links under `links`, by name."""
        described = {
            name: {
                "digest": link.digest,
                "configuration": {section: dict(keys) for section, keys in link.table.items()},
            }
            for name, link in self.links.items()
        }
        return {"settings": list(self.settings)} | described.get("", {"links": described})


def load_variants(
    texts: Sequence[str],
    path: Path | str | Sequence[Path | str] | None = None,
    overrides: Sequence[str] = (),
) -> tuple[Variant, ...]:
    """Resolve variants, each `NAME:TABLE.KEY=VALUE,TABLE.KEY=VALUE`; `NAME:` is the link as it is.

    They share one or several `link.toml`, None for all defaults; `overrides`, as of `--set`, apply to all,
    below a variant's own settings.

    Raises:
        ConfigError: All faults, one line each.

    >>> [v.settings for v in load_variants(["a:", "b:ranging.id=poc,ranging.clusters=[1, 14]"])]
    [(), ('ranging.id=poc', 'ranging.clusters=[1, 14]')]
    """
    variants: list[Variant] = []
    faults: list[str] = []
    for text in texts:
        name, colon, rest = text.partition(":")
        name = name.strip()
        settings = tuple(part.strip() for part in _SEPARATOR_PATTERN.split(rest)) if rest.strip() else ()
        invalid = [s for s in settings if not _SETTING_PATTERN.fullmatch(s)]
        if not colon or not name or invalid:
            which = f" ('{invalid[0]}')" if invalid else ""
            expected = "expected NAME:TABLE.KEY=VALUE,..., e.g. mine:ranging.id=poc"
            faults.append(f"--variant {text}{which}: {expected}")
            continue
        if name in [v.name for v in variants]:
            faults.append(f"--variant {text}: the name '{name}' is taken by another variant")
            continue
        try:
            links = load_links(path, [*overrides, *settings])
            variants.append(Variant(name, settings, name_links(links)))
        except ConfigError as fault:
            lines = str(fault).splitlines()
            faults += [f"--variant {name}: {line.removeprefix('--set: ')}" for line in lines]
    if faults:
        raise ConfigError("\n".join(faults))
    return tuple(variants)


_WARM_PACKETS = 2
"""Packets that a variant decodes beforehand: with two, one is whole, so that every kernel is loaded."""


class _VariantRun:
    """Receives with a variant, as the plugin that collects views, and the processor time of stages, us.

    A stage's time is that since the stage before finished, on the clock of the thread's processor, or on the
    wall clock where that is less: between two frames, work of other stages precedes the first.
    """

    def __init__(self, links: Mapping[str, Link]) -> None:
        self.frames_us: list[dict[str, float]] = []
        self.views: list[FrameView] = []
        self._frame: dict[str, float] = {}
        self._finished_s = time.thread_time()
        self.links = links
        self.receiver = Receiver([*links.values()], Registry.load(self).hook)
        self.frames: list[FrameRow] = []
        self.packets = 0
        self.spent = Stopwatch()

    @hookimpl
    def evlcp_stage_finished(self, stage: str, value: Any, elapsed_s: float) -> None:
        spent_s = min(elapsed_s, time.thread_time() - self._finished_s)
        if stage in STAGES:
            self._frame[stage] = spent_s * 1e6
        elif stage == "frame":
            self.frames_us.append(self._frame)
            self._frame = {}
        elif stage == "view":
            self.views.append(value)
        self._finished_s = time.thread_time()

    def feed(self, events: Events | None) -> None:
        """Receive events; None ends the stream."""
        with self.spent.measure():
            packets = self.receiver.close() if events is None else self.receiver.feed(events)
        self.packets += len(packets)
        self.frames += frames_of(packets)

    def measure(self, name: str, truth: Truth | None, recorded_s: float, reading_s: float) -> Measurement:
        """Counts and times of its run on a recording, with the truth if it is known."""
        if truth is None:
            counted = count_without_truth(self.frames, self.packets)
        else:
            several = self.links if len(self.links) > 1 else None
            counted = statistics_of(self.frames, truth, packets=self.packets, links=several)
        cpu_s = reading_s + self.spent.processor_s
        return Measurement({name: counted}, tuple(self.frames_us), recorded_s, cpu_s)


def compare_recording(
    url: str,
    variants: Sequence[Variant],
    advance: Callable[[int, int | None], None] = lambda _done, _of: None,
) -> Table:
    """Receive a recording with every variant, and score it where its truth lies beside it.

    Its first packets are received once before, so that no kernel is loaded or compiled while time runs. The
    bound is of the frames as the first variant decodes them; several links have none. `advance` is called
    after every piece with the bytes that are done, and of how many if that is known.

    Raises:
        ConfigError: Its sensor, or the link it was sent with, is not that of a variant.
        InputError: The recording or its truth cannot be read.
    """
    path = truth_path(url)
    truth = read_truth(path) if path.exists() else None
    if truth is not None:
        for variant in variants:
            check_link(truth, variant.links, f"{url}: --variant {variant.name}")
    with open_source(url) as source:
        for link in (link for variant in variants for link in variant.links.values()):
            check_sensor(source, url, link.camera)
        _warm_up(source, variants)
    bound = _link_bound(variants[0].links)
    runs = [_VariantRun(variant.links) for variant in variants]
    first_us, last_us = math.inf, -math.inf
    reading = Stopwatch()
    bounds_m: list[float] = []
    with open_source(url) as source:
        for number, events in enumerate(_time_chunks(source.chunks(), reading)):
            if events is not None:
                first_us, last_us = min(first_us, events.t_us[0]), events.t_us[-1]
            # The first to run brings the events into the cache: each in turn.
            turn = number % len(runs)
            for run in runs[turn:] + runs[:turn]:
                run.feed(events)
            # Bounds are computed while no receiver's time runs.
            if bound is not None:
                bounds_m += [bound(view).sigma_m for view in runs[0].views]
            for run in runs:
                run.views.clear()
            advance(source.position_bytes, source.size_bytes)
    recorded_s = max(float(last_us - first_us), 0.0) * 1e-6
    rows = {
        variant.name: run.measure(url, truth, recorded_s, reading.processor_s)
        for variant, run in zip(variants, runs, strict=True)
    }
    return Table(url, rows, tuple(filter(math.isfinite, bounds_m)))


def _time_chunks(chunks: Iterator[Events], stopwatch: Stopwatch) -> Iterator[Events | None]:
    """Yield the chunks, and None at the end; time is counted while one is read."""
    chunk: Events | None = Events.empty()
    while chunk is not None:
        with stopwatch.measure():
            chunk = next(chunks, None)
        yield chunk


def _warm_up(source: EventSource, variants: Sequence[Variant]) -> None:
    runs = [_VariantRun(variant.links) for variant in variants]
    packets = [link.packet for variant in variants for link in variant.links.values()]
    enough_us = _WARM_PACKETS * max(packet.packet_us for packet in packets)
    first_us = None
    for events in source.chunks():
        first_us = int(events.t_us[0]) if first_us is None else first_us
        for run in runs:
            run.feed(events)
        if events.t_us[-1] - first_us >= enough_us:
            break
    for run in runs:
        run.feed(None)


def _link_bound(links: Mapping[str, Link]) -> Callable[[FrameView], Range] | None:
    """The frame bound of a link; None where its model does not hold, or with several links."""
    if len(links) > 1:
        return None
    (link,) = links.values()
    try:
        return frame_bound(link)
    except ConfigError:
        return None


def comparison_of(
    tables: Sequence[Table], variants: Sequence[Variant], versions: Mapping[str, str]
) -> Comparison:
    """Join the tables of recordings to a comparison, with one of all of them if there are several."""
    notes = []
    for table in tables:
        path = truth_path(table.name)
        if not path.exists():
            notes.append(f"{table.name}: no {path.name} beside it, so no BER and no distance error")
    for variant in variants:
        statistics = [table.rows[variant.name].statistics for table in tables]
        if unmatched := sum(one.unmatched for one in statistics):
            notes.append(f"{variant.name}: {unmatched} frame{'s' * (unmatched != 1)} without a true one")
        if echoes := sum(one.echoes for one in statistics):
            notes.append(f"{variant.name}: {echoes} frame{'s' * (echoes != 1)} of reflections, left out")
    total = (total_of(tables),) if len(tables) > 1 else ()
    described = {variant.name: variant.to_dict() for variant in variants}
    return Comparison(described, (*tables, *total), tuple(notes), dict(versions))
