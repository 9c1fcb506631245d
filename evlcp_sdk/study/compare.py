"""Recordings with their truth beside them, received with every variant: one comparison of all.

A recording is read once; each piece of its events goes through one `Receiver.feed` after the other, so that
all see the same and time is measured in one run. What comes out is counted as the road score of `evlcp score`
counts.
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
from evlcp_sdk.study.comparison import STAGES, Comparison, Measured, Table, Times, total_of
from evlcp_sdk.study.frames import FrameRow, frames_of
from evlcp_sdk.study.match import check_link
from evlcp_sdk.study.measure import statistics_of, without_truth
from evlcp_sdk.values import Events, FrameView, Range

_KEY = r"[\w-]+\s*\.\s*[\w-]+\s*(?:\.\s*[\w-]+\s*)?="
_SETTING = re.compile(rf"{_KEY}.*", re.DOTALL)
_AT_SETTING = re.compile(rf",(?=\s*{_KEY})")
"""A comma is part of a value, as in `[1, 14]`, unless another setting follows it."""


@dataclass(frozen=True, eq=False)
class Variant:
    """A configuration with a name, the settings that set it apart, and its resolved links by their names."""

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
    registry: Registry | None = None,
) -> tuple[Variant, ...]:
    """Resolve variants, each `NAME:TABLE.KEY=VALUE,TABLE.KEY=VALUE`; `NAME:` is the link as it is.

    They share the `link.toml`, or several, None for all defaults; `overrides`, what `--set` takes, hold for
    all, and yield to a variant's own settings.

    Raises:
        ConfigError: All faults, one line each.

    >>> [v.settings for v in load_variants(["a:", "b:ranging.id=poc,ranging.clusters=[1, 14]"])]
    [(), ('ranging.id=poc', 'ranging.clusters=[1, 14]')]
    """
    registry = Registry.load() if registry is None else registry
    found: list[Variant] = []
    faults: list[str] = []
    for text in texts:
        name, colon, rest = text.partition(":")
        name = name.strip()
        settings = tuple(part.strip() for part in _AT_SETTING.split(rest)) if rest.strip() else ()
        odd = [s for s in settings if not _SETTING.fullmatch(s)]
        if not colon or not name or odd:
            what = f" ('{odd[0]}')" if odd else ""
            expected = "expected NAME:TABLE.KEY=VALUE,..., e.g. mine:ranging.id=poc"
            faults.append(f"--variant {text}{what}: {expected}")
            continue
        if name in [v.name for v in found]:
            faults.append(f"--variant {text}: the name '{name}' is taken by another variant")
            continue
        try:
            links = load_links(path, [*overrides, *settings], registry)
            found.append(Variant(name, settings, name_links(links)))
        except ConfigError as fault:
            lines = str(fault).splitlines()
            faults += [f"--variant {name}: {line.removeprefix('--set: ')}" for line in lines]
    if faults:
        raise ConfigError("\n".join(faults))
    return tuple(found)


_WARM_PACKETS = 2
"""Packets that a variant decodes beforehand: one may be cut, so that a whole one loads every kernel."""


class _Watch:
    """Notes the processor time of the stages of each frame, us, and what it shows, until it is taken.

    A stage's time is what passed since the stage before finished, on the clock of the thread's processor, or
    on that of the wall where that is less: between two frames, work of other stages lies before the first.
    """

    def __init__(self) -> None:
        self.stage_us: dict[str, list[float]] = {stage: [] for stage in STAGES}
        self.frame_us: list[float] = []
        self.views: list[FrameView] = []
        self._frame: dict[str, float] = {}
        self._finished_s = time.thread_time()

    @hookimpl
    def evlcp_stage_finished(self, stage: str, value: Any, elapsed_s: float) -> None:
        spent_s = min(elapsed_s, time.thread_time() - self._finished_s)
        if stage in STAGES:
            self._frame[stage] = spent_s * 1e6
        elif stage == "frame":
            for name, us in self._frame.items():
                self.stage_us[name].append(us)
            self.frame_us.append(sum(self._frame.values()))
            self._frame = {}
        elif stage == "view":
            self.views.append(value)
        self._finished_s = time.thread_time()


class _Lane:
    """One variant's receiver, its frames and its time."""

    def __init__(self, links: Mapping[str, Link]) -> None:
        self.watch = _Watch()
        self.links = links
        self.receiver = Receiver([*links.values()], Registry.load(self.watch).hook)
        self.frames: list[FrameRow] = []
        self.packets = 0
        self.spent = Stopwatch()

    def feed(self, events: Events | None) -> None:
        """Take events; None ends the stream."""
        with self.spent.measure():
            packets = self.receiver.close() if events is None else self.receiver.feed(events)
        self.packets += len(packets)
        self.frames += frames_of(packets)

    def measured(self, name: str, truth: Truth | None, recorded_s: float, reading_s: float) -> Measured:
        """What it gave on a recording of that name, beside the truth if it is known."""
        times = Times(
            frame_us=tuple(self.watch.frame_us),
            stage_us={stage: tuple(us) for stage, us in self.watch.stage_us.items()},
            recorded_s=recorded_s,
            cpu_s=reading_s + self.spent.processor_s,
        )
        if truth is None:
            return Measured({name: without_truth(self.frames, self.packets)}, times)
        several = self.links if len(self.links) > 1 else None
        counted = statistics_of(self.frames, truth, packets=self.packets, links=several)
        return Measured({name: counted}, times)


def compare_recording(
    url: str,
    variants: Sequence[Variant],
    advance: Callable[[int, int | None], None] = lambda _done, _of: None,
) -> Table:
    """Receive a recording with every variant, and score it where its truth lies beside it.

    Its first packets are read and received once before, so that no kernel is loaded or compiled while time
    runs. The bound is of the frames as the first variant decodes them; several links have none. `advance` is
    called after every piece with the bytes that are done, and of how many if that is known.

    Raises:
        ConfigError: Its sensor, or the link it was sent with, is not that of a variant.
        InputError: The recording or its truth cannot be read.
    """
    registry = Registry.load()
    path = truth_path(url)
    truth = read_truth(path, registry) if path.exists() else None
    if truth is not None:
        for variant in variants:
            check_link(truth, variant.links, f"{url}: --variant {variant.name}")
    with open_source(url, registry) as source:
        for link in (link for variant in variants for link in variant.links.values()):
            check_sensor(source, url, link.camera)
        _warm(source, variants)
    bound = _bound_of(variants[0].links)
    lanes = [_Lane(variant.links) for variant in variants]
    first_us, last_us = math.inf, -math.inf
    reading = Stopwatch()
    bounds_m: list[float] = []
    with open_source(url, registry) as source:
        for number, events in enumerate(_timed(source.chunks(), reading)):
            if events is not None:
                first_us, last_us = min(first_us, events.t_us[0]), events.t_us[-1]
            # Who comes first brings the events into the cache: each in turn.
            turn = number % len(lanes)
            for lane in lanes[turn:] + lanes[:turn]:
                lane.feed(events)
            # Bounds are computed while no receiver's time runs.
            if bound is not None:
                bounds_m += [bound(view).sigma_m for view in lanes[0].watch.views]
            for lane in lanes:
                lane.watch.views.clear()
            advance(source.position_bytes, source.size_bytes)
    recorded_s = max(float(last_us - first_us), 0.0) * 1e-6
    rows = {
        variant.name: lane.measured(url, truth, recorded_s, reading.processor_s)
        for variant, lane in zip(variants, lanes, strict=True)
    }
    return Table(url, rows, tuple(filter(math.isfinite, bounds_m)))


def _timed(pieces: Iterator[Events], watch: Stopwatch) -> Iterator[Events | None]:
    """The same pieces, and None at the end; the time that it takes to get them counted."""
    piece: Events | None = Events.empty()
    while piece is not None:
        with watch.measure():
            piece = next(pieces, None)
        yield piece


def _warm(source: EventSource, variants: Sequence[Variant]) -> None:
    """Receive the first packets with every variant."""
    lanes = [_Lane(variant.links) for variant in variants]
    packets = [link.packet for variant in variants for link in variant.links.values()]
    enough_us = _WARM_PACKETS * max(packet.packet_chips * packet.chip_us for packet in packets)
    first_us = None
    for events in source.chunks():
        first_us = int(events.t_us[0]) if first_us is None else first_us
        for lane in lanes:
            lane.feed(events)
        if events.t_us[-1] - first_us >= enough_us:
            break
    for lane in lanes:
        lane.feed(None)


def _bound_of(links: Mapping[str, Link]) -> Callable[[FrameView], Range] | None:
    """What gives the bound of each frame; None where the bound's model does not hold, or not for all."""
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
    """The tables of recordings, with one of them all behind where there are several."""
    notes = []
    for table in tables:
        beside = truth_path(table.name)
        if not beside.exists():
            notes.append(f"{table.name}: no {beside.name} beside it, so no BER and no distance error")
    for variant in variants:
        counted = [one.rows[variant.name].statistics for one in tables]
        if ghosts := sum(one.unmatched for one in counted):
            notes.append(f"{variant.name}: {ghosts} frame{'s' * (ghosts != 1)} without a true one")
        if echoes := sum(one.echoes for one in counted):
            notes.append(f"{variant.name}: {echoes} frame{'s' * (echoes != 1)} of reflections, left out")
    all_of = (total_of(tables),) if len(tables) > 1 else ()
    about = {v.name: v.to_dict() for v in variants}
    return Comparison(about, (*tables, *all_of), tuple(notes), dict(versions))
