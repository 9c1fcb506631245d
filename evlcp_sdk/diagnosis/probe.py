"""Which link fits a recording: the same events received by other settings, ranked."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.tallies import SURE, RunTally, count_missing_codewords
from evlcp_sdk.errors import ConfigError, EvlcpError
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import STEPS
from evlcp_sdk.rx.guard import Guard
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.values import Events

FRAME_COUNTS = (1, 2, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64)
"""Frames per packet that are tried first; then the numbers around the best are, as the share of accepted
frames falls to both sides of the right one."""

PILOT_SPACINGS = (1, 2, 4, 8)
"""Tried values of `air.pilot_every`."""

MAX_EVENTS = 2_000_000
"""Events of a trial: less than a tenth of a second of a bar may have no preamble."""

_MIN_FRAMES = 4
"""Frames that a fitting link must read: chance gives one or two."""

_MIN_GAIN = 0.2
"""Gain in the share of accepted frames by which a change is kept though it does not fit: chance gives .1."""

_WHOLE_SHARE = 0.97
"""Share of accepted frames that counts as all: of packets one frame too long or short, one in ten fails."""

_GOOD_SHARE = 0.8
"""Share of accepted frames from which on a link fits: a bar that enters or leaves the picture loses some."""


_RATE, _CLOCK_TOLERANCE = "air.chip_rate_hz", 0.003
"""The key of the chip rate, and the share by which a clock may be off."""


@dataclass(frozen=True)
class Trial:
    """The result of receiving some events by a link.

    Attributes:
        changes: Its differences to the given link: `table.key` and value.
        frames, rejected: Numbers of accepted and of rejected frames.
        quality: Mean quality of the frames; 0 without any.
        missing_codewords: Codewords that never occur though they should have, by far.
        explanation: How a framing inferred the link from light, or why it did not.
    """

    changes: tuple[tuple[str, Any], ...]
    link: Link
    frames: int
    rejected: int
    quality: float
    missing_codewords: int
    explanation: str = ""

    @property
    def share(self) -> float:
        """Share of the due frames that are accepted."""
        return self.frames / max(self.frames + self.rejected, 1)

    @property
    def accepts_all(self) -> bool:
        """Whether nearly all due frames are accepted, whatever is read from them."""
        return self.frames >= _MIN_FRAMES and self.share >= _WHOLE_SHARE

    @property
    def fits(self) -> bool:
        """Whether frames are read by it, and all codewords occur that should."""
        return self.frames >= _MIN_FRAMES and self.share >= _GOOD_SHARE and not self.missing_codewords

    @property
    def rank(self) -> tuple[bool, bool, float, float, int]:
        """A key to sort trials by; the best has the largest."""
        share, quality = round(self.share, 2), round(self.quality, 1)
        return self.fits, bool(self.explanation), share, quality, -self.link.codebook.data_symbols

    def options(self) -> str:
        """The changes as options of the command line; empty for the given link."""
        return " ".join(
            f"--set {name}={value:g}" if isinstance(value, float) else f"--set {name}={value}"
            for name, value in self.changes
        )


def try_link(link: Link, events: Events, changes: Sequence[tuple[str, Any]] = ()) -> Trial:
    """Receive events, all of them on the link's sensor, and count the frames."""
    receiver, tally = Receiver(link), RunTally(link.packet)
    tally.add(*receiver.feed(events), *receiver.close())
    return Trial(
        tuple(changes),
        link,
        receiver.counts["frames"],
        receiver.counts.get("frames_rejected", 0),
        tally.quality,
        max((count_missing_codewords(one, link) for one in tally.non_reflections), default=0),
    )


def try_changes(
    link: Link, events: Events, registry: Registry, rates_hz: Iterable[float] = ()
) -> Iterator[Trial]:
    """Try changes to a link, one key after another, each on top of the best so far; yield the trials.

    First the link as it is, then chip rates of the light, frames per pilot, frames per packet, and the
    installed modulations. Where a link fits, no further changes are tried. All events have to be on the
    link's sensor.
    """
    best = try_link(link, events)
    yield best
    others, chips = find_other_codewords(link, registry), link.codebook.codewords.shape[-1]
    # Modulations of the same length only differ in what is read from accepted frames.
    alike = [name for name, words in others.items() if words.shape[-1] == chips]
    rest = [name for name in others if name not in alike]

    for name, values, by_frames in (
        (_RATE, rates_hz, True),
        ("modulation.id", rest, True),
        ("air.pilot_every", PILOT_SPACINGS, True),
        ("air.frames_per_packet", FRAME_COUNTS, True),
        ("air.frames_per_packet", None, True),
        ("modulation.id", alike, False),
    ):
        if best.accepts_all if by_frames else best.fits and best.quality >= SURE:
            continue
        if name == "air.frames_per_packet" and not best.frames:
            # Whatever the length of a packet, the first frame after a preamble is accepted.
            continue
        start, counts = best, name == "air.frames_per_packet"
        values = _list_frame_counts(start.link.air.frames_per_packet) if values is None else values
        for trial in _try_values(start, name, values, events, registry):
            yield trial
            gains = trial.share > best.share + _MIN_GAIN or trial.frames >= _MIN_FRAMES > best.frames
            if trial.rank > best.rank and (counts or trial.fits or gains):
                best = trial
            if counts and best.accepts_all:
                break


def infer_links(link: Link, lights: Iterable[Events], registry: Registry) -> Iterator[Trial]:
    """Let each framing infer a link from each light, and try the first one that a framing finds.

    A light is the events of what may be one LED.
    """
    for light, installed in product(lights, registry.list_algorithms("framing")):
        changes: dict[str, Any] = {"framing.id": installed.algorithm.id}
        if link.codebook.clusters > 1:
            changes |= {f"bar.{key}": 1 for key in ("rows", "columns", "cluster_rows", "cluster_columns")}
        if not (light.x.any() or light.y.any()):
            changes["detection.id"] = "whole"
        framing = _change_link(link, changes, registry)
        if framing is None:
            continue
        with Guard(framing, "framing"):
            inferred, explanation = framing.algorithm("framing").infer(light)
        changes |= inferred
        if abs(changes.get(_RATE, 0.0) / link.air.chip_rate_hz - 1) < _CLOCK_TOLERANCE:
            changes[_RATE] = link.air.chip_rate_hz
        other = _change_link(link, changes, registry) if inferred else None
        if other is not None:
            trial = try_link(other, light, () if other == link else tuple(changes.items()))
            yield replace(trial, explanation=explanation)
            return
        if explanation:
            yield Trial((), link, 0, 0, 0.0, 0, explanation)


def find_other_codewords(link: Link, registry: Registry) -> dict[str, NDArray[np.uint8]]:
    """Codewords of the other installed modulations, by id, uint8 (symbols, chips)."""
    if "modulation" not in link.table:
        return {}
    names = {one.algorithm.id for one in registry.list_algorithms("modulation")}
    names.discard(link.table["modulation"]["id"])
    links = {name: _change_link(link, {"modulation.id": name}, registry) for name in sorted(names)}
    return {name: other.codebook.codewords for name, other in links.items() if other is not None}


def _try_values(
    start: Trial, name: str, values: Iterable[Any], events: Events, registry: Registry
) -> Iterator[Trial]:
    """Trials of a link with other values of one of its keys, where these make a link."""
    for value in values:
        other = _change_link(start.link, {name: value}, registry)
        if other is None or other.digest == start.link.digest:
            continue
        try:
            trial = try_link(other, events, tuple({**dict(start.changes), name: value}.items()))
        except ConfigError:
            # Codes that the link's own steps cannot decode.
            continue
        yield trial


def _list_frame_counts(frames: int) -> list[int]:
    """The untried numbers of frames around one that was tried."""
    below = max((n for n in FRAME_COUNTS if n < frames), default=0)
    above = min((n for n in FRAME_COUNTS if n > frames), default=frames + 8)
    return [n for n in range(below + 1, above) if n != frames]


def _change_link(link: Link, changes: Mapping[str, Any], registry: Registry) -> Link | None:
    """The link with other values; None where they make no link."""
    tables = dict(link.table)
    for name, value in changes.items():
        table, key = name.split(".")
        if table == "framing" and key == "id":
            tables = {other: keys for other, keys in tables.items() if other not in STEPS | {"detection"}}
        # Parameters of one algorithm are not those of another.
        keys = {} if key == "id" else tables.get(table, {})
        tables[table] = {**keys, key: value}
    try:
        return resolve(tables, registry)
    except EvlcpError:
        return None
