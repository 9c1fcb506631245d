"""Which link fits a recording: the same events received with other settings, ranked."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

from evlcp_sdk.diagnosis.tallies import SURE, RunTally, count_missing_codewords
from evlcp_sdk.errors import ConfigError, EvlcpError
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import STEPS
from evlcp_sdk.rx.guard import Guard
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.values import Events

FRAME_COUNTS = (1, 2, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64)
"""Frames per packet that are tried first, and then those beside the best: the share of frames accepted falls
to both sides of the right number."""

PILOT_SPACINGS = (1, 2, 4, 8)
"""Values of `air.pilot_every` that are tried."""

MOST_EVENTS = 2_000_000
"""Events of a trial: with fewer of a bar than a tenth of a second has, there may be no preamble in them."""

_FEW_FRAMES = 4
"""Frames below which a link that was tried is no find: chance gives one or two."""

_GAIN = 0.2
"""How much more of the frames a change must bring to be kept though it does not fit: chance brings .1."""

_WHOLE_SHARE = 0.97
"""Frames accepted, of those due, that are all: of packets one frame too long or short, one in ten fails."""

_GOOD_SHARE = 0.8
"""Frames accepted, of those due, from which on a link fits: a bar that enters or leaves the picture loses
some."""


_RATE, _SAME_CLOCK = "air.chip_rate_hz", 0.003
"""The key of a rate, and share by which a clock is off without a word."""


@dataclass(frozen=True)
class Trial:
    """What a link makes of some events.

    Attributes:
        changes: What it has other than the link that was given: `table.key` to value.
        frames: Frames accepted; others: `rejected`.
        quality: Mean quality of the frames; 0 without any.
        never: Codewords that never occur though they should have, by far.
        said: What a framing says of the light by which it was inferred, or why it was not.
    """

    changes: tuple[tuple[str, Any], ...]
    link: Link
    frames: int
    rejected: int
    quality: float
    never: int
    said: str = ""

    @property
    def share(self) -> float:
        """Share of the frames due that are accepted."""
        return self.frames / max(self.frames + self.rejected, 1)

    @property
    def whole(self) -> bool:
        """Whether nearly all frames due are accepted, whatever is read from them."""
        return self.frames >= _FEW_FRAMES and self.share >= _WHOLE_SHARE

    @property
    def fits(self) -> bool:
        """Whether frames are read with it, and all codewords occur that should."""
        return self.frames >= _FEW_FRAMES and self.share >= _GOOD_SHARE and not self.never

    @property
    def rank(self) -> tuple[bool, bool, float, float, int]:
        """What trials are sorted by, the best largest."""
        share, quality = round(self.share, 2), round(self.quality, 1)
        return self.fits, bool(self.said), share, quality, -self.link.codebook.data_symbols

    def options(self) -> str:
        """The changes as options of the command line; empty for the link as it was given."""
        return " ".join(
            f"--set {name}={value:g}" if isinstance(value, float) else f"--set {name}={value}"
            for name, value in self.changes
        )


def try_link(link: Link, events: Events, changes: Sequence[tuple[str, Any]] = ()) -> Trial:
    """Receive events, all of them on its sensor, with a link, and count."""
    receiver, tally = Receiver(link), RunTally(link.packet)
    tally.add(*receiver.feed(events), *receiver.close())
    return Trial(
        tuple(changes),
        link,
        receiver.counts["frames"],
        receiver.counts.get("frames_rejected", 0),
        tally.quality,
        max((count_missing_codewords(one, link) for one in tally.own), default=0),
    )


def better_links(
    link: Link, events: Events, registry: Registry, rates_hz: Iterable[float] = ()
) -> Iterator[Trial]:
    """Try what may be wrong in a link, one thing at a time and then on top of the best; yield what was tried.

    First the link as it is, then the chip rates that light was seen to have, frames a pilot, frames a packet,
    and the modulations that are installed. Of what fits already nothing else is tried. All events have to be
    on the link's sensor.
    """
    best = try_link(link, events)
    yield best
    others = [one.algorithm.id for one in registry.list_algorithms("modulation")]
    # Modulations of the same length only differ in what is read from frames that are accepted.
    alike = [one for one in others if _chips(_with(link, {"modulation.id": one}, registry)) == _chips(link)]
    rest = [one for one in others if one not in alike]

    for name, values, by_frames in (
        (_RATE, rates_hz, True),
        ("modulation.id", rest, True),
        ("air.pilot_every", PILOT_SPACINGS, True),
        ("air.frames_per_packet", FRAME_COUNTS, True),
        ("air.frames_per_packet", None, True),
        ("modulation.id", alike, False),
    ):
        if best.whole if by_frames else best.fits and best.quality >= SURE:
            continue
        if name == "air.frames_per_packet" and not best.frames:
            # Whatever the length of a packet, the first frame behind a preamble is accepted.
            continue
        start, counts = best, name == "air.frames_per_packet"
        values = _beside(start.link.air.frames_per_packet) if values is None else values
        for trial in _tried(start, name, values, events, registry):
            yield trial
            first = trial.frames >= _FEW_FRAMES > best.frames
            if trial.rank > best.rank and (counts or trial.fits or first or trial.share > best.share + _GAIN):
                best = trial
            if counts and best.whole:
                break


def infer_links(link: Link, lights: Iterable[Events], registry: Registry) -> Iterator[Trial]:
    """Let each framing say what it takes one of some lights for, up to the first that it knows, and try that.

    A light is the events of what may be one LED.
    """
    for light, installed in product(lights, registry.list_algorithms("framing")):
        changes: dict[str, Any] = {"framing.id": installed.algorithm.id}
        if link.codebook.clusters > 1:
            changes |= {f"bar.{key}": 1 for key in ("rows", "columns", "cluster_rows", "cluster_columns")}
        if not (light.x.any() or light.y.any()):
            changes["detection.id"] = "whole"
        framing = _with(link, changes, registry)
        if framing is None:
            continue
        with Guard(framing, "framing"):
            inferred, said = framing.algorithm("framing").infer(light)
        changes |= inferred
        if abs(changes.get(_RATE, 0.0) / link.air.chip_rate_hz - 1) < _SAME_CLOCK:
            changes[_RATE] = link.air.chip_rate_hz
        other = _with(link, changes, registry) if inferred else None
        if other is not None:
            yield replace(try_link(other, light, () if other == link else tuple(changes.items())), said=said)
            return
        if said:
            yield Trial((), link, 0, 0, 0.0, 0, said)


def _tried(
    start: Trial, name: str, values: Iterable[Any], events: Events, registry: Registry
) -> Iterator[Trial]:
    """What a link is with other values of one of its keys, where it can be read at all."""
    for value in values:
        other = _with(start.link, {name: value}, registry)
        if other is None or other.digest == start.link.digest:
            continue
        try:
            trial = try_link(other, events, tuple({**dict(start.changes), name: value}.items()))
        except ConfigError:
            # Codes that the link's own steps do not read.
            continue
        yield trial


def _chips(link: Link | None) -> int:
    """Chips of a codeword."""
    return link.codebook.codewords.shape[-1] if link is not None else 0


def _beside(frames: int) -> list[int]:
    """Numbers of frames between the neighbours of one in those that were tried."""
    below = max((n for n in FRAME_COUNTS if n < frames), default=0)
    above = min((n for n in FRAME_COUNTS if n > frames), default=frames + 8)
    return [n for n in range(below + 1, above) if n != frames]


def _with(link: Link, changes: Mapping[str, Any], registry: Registry) -> Link | None:
    """The link with other values; None where that is no link."""
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
