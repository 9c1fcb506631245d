"""The facts of a received recording, and the findings in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.readout import ReadoutTally
from evlcp_sdk.diagnosis.tallies import SURE, RunTally
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.source import Loss

if TYPE_CHECKING:
    from evlcp_sdk.diagnosis.light import LightSource
    from evlcp_sdk.diagnosis.probe import Trial

NEAR_RATE = 0.8
"""Share of its largest mean that a source reaches at its own rate, or a multiple of it."""

_MIN_FRAMES = 4
"""Frames of which fewer may be chance."""

_ACCEPTED_SHARE = 0.8
"""Share of the due frames that are accepted, below which something is wrong with all of them."""

_MIN_PRESENT_SHARE = 0.6
"""Share of the frames that fit into a recording, from which on a bar is read whatever happens beside it."""

_MIN_CODE_RISES = 1000
"""Rises of a source that may be a bar: one of 20 x 3 px has them in 5 ms; passing leaves and edges have
some hundred."""

_HALO_SHARE = 0.1
"""Events of a source, relative to the largest, below which it is a lamp's halo rather than a bar."""

_EDGE_PX = 8
"""Margin of the picture: a source in it may continue outside."""


BRIGHTER = (
    "more light: nearer, a wider aperture, brighter LEDs, or a more sensitive sensor (lower bias_diff_on and"
    " bias_diff_off, faster pixels by bias_fo)"
)
"""The next step where there is too little light."""

Verdict = Literal["pass", "note", "doubt", "fail", "skip"]
"""Of a check: passed; a mere statement; wrong, though frames may be read; wrong in any case; not reached."""


@dataclass(frozen=True)
class Diagnostic:
    """A finding of a check: a fault, a mere statement, or the count by which it is passed.

    Attributes:
        code: The fault in a word or two, e.g. `frames-rejected`; the same in every version. Empty for none.
        text: The same in words, with the counts that show it.
        next_step: What to try; empty where there is nothing to do.
        transmitter: Number of the transmitter that it is about; None for the whole recording.
        link: Where there are several links, name of the one that it is about; empty for none of them.
        verdict: Result of the check.
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
        subject = f"link {self.link}: " if self.link else ""
        return (
            f"{subject}{'' if self.transmitter is None else f'transmitter {self.transmitter}: '}{self.text}"
        )

    def to_dict(self) -> dict[str, Any]:
        """The same as JSON values, without verdict and stage."""
        table = {name: getattr(self, name) for name in ("code", "text", "next_step", "transmitter")}
        return table | ({"link": self.link} if self.link else {})


Findings = Iterator[Diagnostic | str]
"""Of a check: its diagnostics, or the counts by which it is passed."""


@dataclass(frozen=True, eq=False)
class Facts:
    """The facts of a recording, or of what one of several links has read of it.

    Attributes:
        link: The link that it was received with.
        tally, counts: Figures of its transmitters, and the receiver's counts.
        first_us, last_us: The recording's first event and its last, camera clock, us.
        lit_us: First and last time at which a transmitter's frames were due and its light was there, us, by
            its number.
        readout: Events in each millisecond.
        losses: Events and words that the source could not use.
        guessed: Missing properties of the recording that were guessed, in words; empty for none.
        step_us: Common divisor of all its times, us; 0 where it was not determined.
        skipped_silences: Silences beside damage that a replay did not wait for, and their time, us.
        late_events: Events of a live run that came too late to be read.
        reads_messages: Messages were decoded.
        other_codewords: Gives the codewords of other modulations by id, uint8 (symbols, chips).
        positions: Figures of the positions; empty where none were computed.
        parts: Where there are several links, the facts of each, by name.
        has_survey: The light was surveyed, as `diagnose` does; the rest is what that found.
        sources: Sources of light, by events.
        restless_box: Box with far more events than elsewhere, px; None for nowhere.
        speed_px_ms: Speed at which light sweeps over the image, px/ms; 0 where it does not.
        trials: Links that were tried, the given one first.
        fits_inverted: The link fits if ON and OFF are exchanged, and no other does.
    """

    link: Link
    tally: RunTally
    counts: Mapping[str, int]
    first_us: float = math.nan
    last_us: float = math.nan
    lit_us: Mapping[int, tuple[float, float]] | None = None
    readout: ReadoutTally = field(default_factory=ReadoutTally)
    losses: Sequence[Loss] = ()
    guessed: str = ""
    step_us: int = 0
    skipped_silences: tuple[int, int] = (0, 0)
    late_events: int = 0
    reads_messages: bool = True
    other_codewords: Callable[[], Mapping[str, NDArray[np.uint8]]] = dict
    positions: Mapping[str, Any] = field(default_factory=dict)
    parts: Mapping[str, Facts] = field(default_factory=dict)
    has_survey: bool = False
    sources: Sequence[LightSource] = ()
    restless_box: tuple[int, int, int, int] | None = None
    speed_px_ms: float = 0.0
    trials: Sequence[Trial] = ()
    fits_inverted: bool = False

    @property
    def duration_us(self) -> float:
        """From the first event to the last; 0 where it is not known."""
        length_us = self.last_us - self.first_us
        return length_us if length_us > 0 else 0.0

    @property
    def blocks_read(self) -> int:
        """Packets with a block that can be decoded, alone or with others."""
        return self.counts.get("blocks_decoded", 0) + self.counts.get("blocks_combined", 0)

    @property
    def positions_tried(self) -> int:
        """Positions of bars, given or refused."""
        return int(self.positions["fixes"] + sum(self.positions["refused"].values())) if self.positions else 0

    @property
    def bar(self) -> LightSource | None:
        """The source that is most likely a bar of the link, by its rate; None where there is none."""
        rate = self.link.packet.chip_rate_hz
        large = [one for one in self.sources if one.rises >= _MIN_CODE_RISES]
        fitting = [one for one in large if one.kind != "lamp" and has_rate(one, rate)]
        codes = [one for one in large if one.kind == "code"]
        # Accepted frames are of a bar, however regular its light looks.
        first = next(iter(fitting or codes or (large if self.has_frames else [])), None)
        if first is None or self.is_read or first.events >= _HALO_SHARE * self.sources[0].events:
            return first
        return None

    @property
    def touches_edge(self) -> bool:
        """Whether the bar's source touches the edge of the picture."""
        # A list without places has a source of one pixel.
        if self.bar is None or self.bar.wide_px * self.bar.high_px <= 1:
            return False
        left, top, right, bottom = self.bar.box_px
        width, height = self.link.camera.width, self.link.camera.height
        return min(left, top) < _EDGE_PX or right > width - _EDGE_PX or bottom > height - _EDGE_PX

    @property
    def is_read(self) -> bool:
        """Whether most frames are accepted."""
        frames, rejected = self.counts.get("frames", 0), self.counts.get("frames_rejected", 0)
        if frames >= _MIN_FRAMES and frames >= _ACCEPTED_SHARE * (frames + rejected):
            return True
        # The rejected frames may be of something else in the picture.
        form = self.link.packet
        sent = form.frames * self.duration_us / form.packet_us
        return any(
            one.frames
            >= max(
                _MIN_FRAMES,
                _ACCEPTED_SHARE * (one.last_frame - one.first_frame + 1),
                _MIN_PRESENT_SHARE * sent,
            )
            for one in self.tally.non_reflections
        )

    @property
    def has_frames(self) -> bool:
        """Whether more frames are accepted than by chance."""
        return self.counts.get("frames", 0) >= _MIN_FRAMES

    @property
    def is_certain(self) -> bool:
        """Whether most frames are accepted, and their symbols are reliable."""
        return self.is_read and self.tally.quality >= SURE

    @property
    def better_trial(self) -> Trial | None:
        """The best trial of another link that fits; None where there is none."""
        fitting = [trial for trial in self.trials if trial.changes and trial.fits and trial.quality >= SURE]
        return max(fitting, key=lambda one: one.rank, default=None)

    def better_value(self, key: str) -> Any:
        """That link's value of a `table.key`; None where it is the same, or there is no such link."""
        return None if self.better_trial is None else dict(self.better_trial.changes).get(key)


def measure_gap_px(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    """Gap between two boxes (left, top, right, bottom), across or down; 0 or less where they meet."""
    return max(one[0] - other[2], other[0] - one[2], one[1] - other[3], other[1] - one[3])


def has_rate(source: LightSource, rate_hz: float) -> bool:
    """Whether a source may have this rate, or a multiple of it."""
    return source.strength_at(rate_hz) >= NEAR_RATE * source.strength


def format_ms(t_us: float) -> str:
    """A time in words, in ms or s."""
    return f"{t_us * 1e-3:.0f} ms" if t_us < 1e7 else f"{t_us * 1e-6:.1f} s"
