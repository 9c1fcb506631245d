"""What is known of a recording when it has been received, and a finding in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.readout import ReadoutTally
from evlcp_sdk.diagnosis.tallies import SURE, RunTally
from evlcp_sdk.errors import EvlcpError
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.source import Loss

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

_EDGE_PX = 8
"""Seam of the picture: a source that comes so near may go on outside."""


BRIGHTER = (
    "more light: nearer, a wider aperture, brighter LEDs, or a more sensitive sensor (lower bias_diff_on and"
    " bias_diff_off, faster pixels by bias_fo)"
)
"""What to try where there is too little light."""

Verdict = Literal["pass", "note", "doubt", "fail", "skip"]
"""Of a check: passed; a plain statement; wrong, though frames may be read; wrong in any case; not reached."""


@dataclass(frozen=True)
class Diagnostic:
    """What a check finds: something that looks wrong, a plain statement, or the count by which it is passed.

    Attributes:
        code: What is wrong, in a word or two, e.g. `frames-rejected`; the same in every version. Empty for
            nothing.
        text: The same in words, with the counts that say so.
        next_step: What to try; empty where there is nothing to do.
        transmitter: Number of the transmitter that it is about; None for all of the recording.
        link: Where there are several links, name of the one that it is about; empty for none of them.
        verdict: What became of the check.
        stage: The stage of the receiver that it belongs to.

    >>> print(Diagnostic("clock", "its clock is 900 ppm off", "try another rate", 0))
    transmitter 0: its clock is 900 ppm off: try another rate
    """

    code: str
    text: str
    next_step: str = ""
    transmitter: int | None = None
    link: str = ""
    verdict: Verdict = "doubt"
    stage: str = ""

    def __str__(self) -> str:
        return f"{self.statement}: {self.next_step}" if self.next_step else self.statement

    @property
    def statement(self) -> str:
        """The text, and what it is about."""
        whose = f"link {self.link}: " if self.link else ""
        return f"{whose}{'' if self.transmitter is None else f'transmitter {self.transmitter}: '}{self.text}"

    def to_dict(self) -> dict[str, Any]:
        """The same as JSON values, without verdict and stage."""
        found = {name: getattr(self, name) for name in ("code", "text", "next_step", "transmitter")}
        return found | ({"link": self.link} if self.link else {})


Found = Iterator[Diagnostic | str]
"""What a check gives: what it finds wrong, or the count by which it is passed."""


@dataclass(frozen=True, eq=False)
class Facts:
    """What is known of a recording, or of what one of several links has read of it.

    Attributes:
        link: The link that it was received with.
        tally, counts: Figures of its transmitters, and the receiver's counts.
        first_us, last_us: The recording's first event and its last, camera clock, us.
        lit_us: Of each transmitter, from when until when frames of it were due and its light was there, by
            number, us.
        readout: Events in each millisecond; None where they were not counted.
        losses: Events and words that the source could not use.
        guessed: What the recording does not say and was guessed; empty for nothing.
        step_us: What all its times are multiples of, us; 0 where nobody looked.
        skipped: Silences beside damage that a replay did not wait for, and their time, us.
        late_events: Events of a live run that came too late to be read.
        reads_messages: Whether messages were looked for.
        others: Codewords of other modulations by id, uint8 (symbols, chips); asked where it matters.
        positions: Figures of the positions; empty where none were computed.
        parts: Where there are several links, what is known of each, by name.
        surveyed: Whether somebody looked for what blinks, as `diagnose` does; the rest is what that found.
        sources: What blinks, by events.
        restless: Box of where far more happens than elsewhere, px; None for nowhere.
        speed_px_ms: How fast light sweeps over the image, px/ms; 0 where it does not.
        trials: Links that were tried, the one given first.
        inverted: Whether the link fits if ON and OFF are exchanged, and no other does.
    """

    link: Link
    tally: RunTally
    counts: Mapping[str, int]
    first_us: float = math.nan
    last_us: float = math.nan
    lit_us: Mapping[int, tuple[float, float]] | None = None
    readout: ReadoutTally | None = None
    losses: Sequence[Loss] = ()
    guessed: str = ""
    step_us: int = 0
    skipped: tuple[int, int] = (0, 0)
    late_events: int = 0
    reads_messages: bool = True
    others: Callable[[], Mapping[str, NDArray[np.uint8]]] = dict
    positions: Mapping[str, Any] = field(default_factory=dict)
    parts: Mapping[str, Facts] = field(default_factory=dict)
    surveyed: bool = False
    sources: Sequence[LightSource] = ()
    restless: tuple[int, int, int, int] | None = None
    speed_px_ms: float = 0.0
    trials: Sequence[Trial] = ()
    inverted: bool = False

    @property
    def duration_us(self) -> float:
        """From the first event to the last; 0 where nothing is known of it."""
        length_us = self.last_us - self.first_us
        return length_us if length_us > 0 else 0.0

    @property
    def blocks_read(self) -> int:
        """Packets with a block that can be read, alone or with others."""
        return self.counts.get("blocks_decoded", 0) + self.counts.get("blocks_combined", 0)

    @property
    def positions_tried(self) -> int:
        """Positions of bars, given or refused."""
        return int(self.positions["fixes"] + sum(self.positions["refused"].values())) if self.positions else 0

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
        # That of a list without places is one pixel.
        if self.bar is None or self.bar.wide_px * self.bar.high_px <= 1:
            return False
        left, top, right, bottom = self.bar.box_px
        width, height = self.link.camera.width, self.link.camera.height
        return min(left, top) < _EDGE_PX or right > width - _EDGE_PX or bottom > height - _EDGE_PX

    @property
    def reads(self) -> bool:
        """Whether most frames are accepted."""
        frames, rejected = self.counts.get("frames", 0), self.counts.get("frames_rejected", 0)
        if frames >= _FEW and frames >= _ACCEPTED_SHARE * (frames + rejected):
            return True
        # What is no bar may lose its frames elsewhere in the picture.
        form = self.link.packet
        sent = form.frames * self.duration_us / form.packet_us
        return any(
            one.frames >= max(_FEW, _ACCEPTED_SHARE * (one.last_frame - one.first_frame + 1), _MOST * sent)
            for one in self.tally.own
        )

    @property
    def some_frames(self) -> bool:
        """Whether some frames are accepted: more than chance gives."""
        return self.counts.get("frames", 0) >= _FEW

    @property
    def sure(self) -> bool:
        """Whether most frames are accepted, and their symbols are sure."""
        return self.reads and self.tally.quality >= SURE

    @property
    def better(self) -> Trial | None:
        """Another link that fits, the best of those tried."""
        fit = [trial for trial in self.trials if trial.changes and trial.fits and trial.quality >= SURE]
        return max(fit, key=lambda one: one.rank, default=None)

    def better_value(self, key: str) -> Any:
        """What that link has other in a `table.key`; None where it does not, or there is none."""
        return None if self.better is None else dict(self.better.changes).get(key)


def has_rate(source: LightSource, rate_hz: float) -> bool:
    """Whether a source may have a rate, or a multiple of it."""
    return source.strength_at(rate_hz) >= NEAR_RATE * source.strength


def other_codewords(link: Link, registry: Registry) -> dict[str, NDArray[np.uint8]]:
    """Codewords of the other modulations that are installed, by id, uint8 (symbols, chips)."""
    found: dict[str, NDArray[np.uint8]] = {}
    if "modulation" not in link.table:
        return found
    for installed in registry.list_algorithms("modulation"):
        name = installed.algorithm.id
        if name == link.table["modulation"]["id"]:
            continue
        try:
            found[name] = resolve({**link.table, "modulation": {"id": name}}, registry).codebook.codewords
        except EvlcpError:
            continue
    return found


def in_ms(t_us: float) -> str:
    """A time, in words."""
    return f"{t_us * 1e-3:.0f} ms" if t_us < 1e7 else f"{t_us * 1e-6:.1f} s"
