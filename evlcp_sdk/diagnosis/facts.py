"""What is known of a recording when it has been received, and a finding in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.readout import ReadoutTally
from evlcp_sdk.diagnosis.tallies import SURE, RunTally
from evlcp_sdk.errors import EvlcpError
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.plugin.registry import Registry

if TYPE_CHECKING:
    from evlcp_sdk.diagnosis.light import LightSource
    from evlcp_sdk.diagnosis.probe import Trial

NEAR_RATE = 0.8
"""Share of its largest mean that a source has at the link's rate if that is its rate, or a multiple."""

_FEW = 4
"""Frames of which nothing is said."""

_ACCEPTED_SHARE = 0.8
"""Share of the frames due that are accepted, below which something is wrong with all of them."""

_MOST = 0.6
"""Share of the frames that a recording has room for, from which a bar is read whatever happens beside it."""

_MIN_CODE = 1000
"""Rises from which a source may be a bar: one of 20 x 3 px has them in 5 ms; leaves and edges that pass have
some hundred."""

_BESIDE = 0.1
"""Events of a source, of those of the largest, below which it is the halo of a lamp rather than a bar."""

_ASIDE_M = 1e-9
"""Way from a bar's first cluster to its last, in one direction, below which there is none."""

_EDGE_PX = 8
"""Seam of the picture: a source that comes so near may go on outside."""


@dataclass(frozen=True)
class Diagnostic:
    """Something that looks wrong, or a plain statement of what there was none of.

    Attributes:
        code: What it is, in a word or two, e.g. `frames-rejected`; the same in every version.
        text: The same in words, with the counts that say so.
        next_step: What to try; empty where there is nothing to do.
        transmitter: Number of the transmitter that it is about; None for all of the recording.
        link: Where there are several links, name of the one that it is about; empty for none of them.

    >>> print(Diagnostic("clock", "its clock is 900 ppm off", "try another rate", 0))
    transmitter 0: its clock is 900 ppm off: try another rate
    """

    code: str
    text: str
    next_step: str = ""
    transmitter: int | None = None
    link: str = ""

    def __str__(self) -> str:
        whose = f"link {self.link}: " if self.link else ""
        whose += "" if self.transmitter is None else f"transmitter {self.transmitter}: "
        return f"{whose}{self.text}" + (f": {self.next_step}" if self.next_step else "")

    def to_dict(self) -> dict[str, Any]:
        """The same as JSON values."""
        found = asdict(self)
        return found if self.link else {key: value for key, value in found.items() if key != "link"}


@dataclass(frozen=True, eq=False)
class Facts:
    """What is known of a recording, or of what one of several links has read of it.

    Attributes:
        link: The link that it was received with.
        tally: Figures of its transmitters.
        counts: The receiver's counts.
        first_us: The recording's first event, camera clock, us.
        last_us: Its last, us.
        lit_us: Of each transmitter, from when until when frames of it were due and its light was there, by
            number, us.
        readout: Events in each millisecond; None where they were not counted.
        lost: Events and words that the source could not use.
        guessed: What the recording does not say and was guessed; empty for nothing.
        step_us: What all its times are multiples of, us; 0 where nobody looked.
        skipped: Silences beside damage that a replay did not wait for, and their time, us.
        reads_messages: Whether messages were looked for.
        others: Codewords of other modulations by id, uint8 (symbols, chips); asked where it matters.
        positions: Figures of the positions; empty where none were computed.
        parts: Where there are several links, what is known of each, by name.
        events: How many events there are. This and what follows is what `diagnose` knows beside.
        sources: What blinks, by events.
        restless: Box of where far more happens than elsewhere, px; None for nowhere.
        losses: What the reader skipped, in words.
        trials: Links that were tried, the one given first.
    """

    link: Link
    tally: RunTally
    counts: Mapping[str, int]
    first_us: float = math.nan
    last_us: float = math.nan
    lit_us: Mapping[int, tuple[float, float]] | None = None
    readout: ReadoutTally | None = None
    lost: int = 0
    guessed: str = ""
    step_us: int = 0
    skipped: tuple[int, int] = (0, 0)
    reads_messages: bool = True
    others: Callable[[], Mapping[str, NDArray[np.uint8]]] = dict
    positions: Mapping[str, Any] = field(default_factory=dict)
    parts: Mapping[str, Facts] = field(default_factory=dict)
    events: int = 0
    sources: Sequence[LightSource] = ()
    restless: tuple[int, int, int, int] | None = None
    losses: Sequence[str] = ()
    trials: Sequence[Trial] = ()

    @property
    def duration_us(self) -> float:
        """From the first event to the last; 0 where nothing is known of it."""
        length_us = self.last_us - self.first_us
        return length_us if length_us > 0 else 0.0

    @property
    def peak_mev_s(self) -> float:
        """Events a second in the fullest millisecond, in millions; 0 where they were not counted."""
        return self.readout.capped()[1] / 1e3 if self.readout is not None else 0.0

    @property
    def blocks_read(self) -> int:
        """Packets with a block that can be read, alone or with others."""
        return self.counts.get("blocks_decoded", 0) + self.counts.get("blocks_combined", 0)

    @property
    def bar(self) -> LightSource | None:
        """The source that is most likely to be a bar of the link, by its rhythm; None where there is none."""
        rate = self.link.packet.chip_rate_hz
        large = [one for one in self.sources if one.rises >= _MIN_CODE]
        fit = [one for one in large if one.kind != "lamp" and has_rate(one, rate)]
        codes = [one for one in large if one.kind == "code"]
        # Frames that are accepted are of a bar, however regular its light looks.
        first = next(iter(fit or codes or (large if self.some_frames else [])), None)
        if first is None or self.reads or first.events >= _BESIDE * self.sources[0].events:
            return first
        return None

    @property
    def at_edge(self) -> bool:
        """Whether the bar's source touches the edge of the picture."""
        if self.bar is None:
            return False
        left, top, right, bottom = self.bar.box_px
        width, height = self.link.camera.width, self.link.camera.height
        return min(left, top) < _EDGE_PX or right > width - _EDGE_PX or bottom > height - _EDGE_PX

    @property
    def reads(self) -> bool:
        """Whether most frames are accepted."""
        frames, rejected = self.counts["frames"], self.counts.get("frames_rejected", 0)
        if frames >= _FEW and frames >= _ACCEPTED_SHARE * (frames + rejected):
            return True
        # What is no bar may lose its frames elsewhere in the picture.
        form = self.link.packet
        sent = form.frames / (form.packet_chips * form.chip_us * 1e-6) * self.duration_us * 1e-6
        return any(
            one.frames >= max(_FEW, _ACCEPTED_SHARE * (one.last_frame - one.first_frame + 1), _MOST * sent)
            for one in self.tally.own
        )

    @property
    def some_frames(self) -> bool:
        """Whether some frames are accepted: more than chance gives."""
        return self.counts["frames"] >= _FEW

    @property
    def sure(self) -> bool:
        """Whether most frames are accepted, and their symbols are sure."""
        return self.reads and self.tally.quality >= SURE

    @property
    def better(self) -> Trial | None:
        """Another link that fits, the best of those tried."""
        fit = [trial for trial in self.trials if trial.changes and trial.fits and trial.quality >= SURE]
        return max(fit, key=lambda one: one.rank, default=None)

    @property
    def cluster_px(self) -> float:
        """From cluster to cluster, px: in frames that are read, else by the bar's source; NaN without one."""
        read = [one for one in self.tally.own if one.sized]
        if read:
            one = max(read, key=lambda tally: tally.sized)
            return math.hypot(*one.along_px) / one.sized / self.steps_along
        if self.bar is None:
            return math.nan
        # A source shows the clusters at the ends whole.
        return max(self.bar.wide_px, self.bar.high_px) / (self.steps_along + 1)

    @property
    def steps_along(self) -> float:
        """How many steps from cluster to neighbour it is from the link's first to its last."""
        centres_m = self.link.bar.cluster_centres_m()
        if len(centres_m) < 2:
            return 1.0
        step_m = min(math.dist(centres_m[0], other) for other in centres_m[1:])
        return math.dist(centres_m[0], centres_m[-1]) / step_m

    @property
    def order(self) -> tuple[int, int]:
        """1 where columns, and rows, of clusters grow as in the bar, -1 where they fall, 0 unknown."""
        centres_m = self.link.bar.cluster_centres_m()
        way_m = centres_m[-1] - centres_m[0]
        along_px = np.sum([one.along_px for one in self.tally.own], 0) if self.tally.own else np.zeros(2)
        right, down = np.sign(along_px * np.where(np.abs(way_m) > _ASIDE_M, way_m, 0.0)).astype(int).tolist()
        return right, down


def has_rate(source: LightSource, rate_hz: float) -> bool:
    """Whether a source may have a rate, or a multiple of it."""
    return source.strength_at(rate_hz) >= NEAR_RATE * source.strength


def other_codewords(link: Link, registry: Registry) -> dict[str, NDArray[np.uint8]]:
    """Codewords of the other modulations that are installed, by id, uint8 (symbols, chips)."""
    found: dict[str, NDArray[np.uint8]] = {}
    if "modulation" not in link.table:
        return found
    for installed in registry.installed("modulation"):
        name = installed.algorithm.id
        if name == link.table["modulation"]["id"]:
            continue
        try:
            found[name] = resolve({**link.table, "modulation": {"id": name}}, registry).codebook.codewords
        except EvlcpError:
            continue
    return found
