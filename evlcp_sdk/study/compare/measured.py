"""What one variant gave on a recording, in a form that adds over recordings."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from evlcp_sdk.stopwatch import times_real_time
from evlcp_sdk.study.intervals import Figure, measure
from evlcp_sdk.study.tally import Statistics, Tally

__all__ = ["STAGES", "Measured", "Times", "median", "rms"]

STAGES = ("separation", "decoding", "ranging")
"""The stages that every frame goes through, and whose time is measured."""


@dataclass(frozen=True)
class Times:
    """What one variant's work took; adds over recordings.

    Attributes:
        frame_us: Time of every frame in the stages `STAGES` together, us.
        stage_us: The same of each stage.
        recorded_s: Duration of the recordings, s.
        cpu_s: Processor time for reading and receiving them, as `Stopwatch` counts it, s.
    """

    frame_us: tuple[float, ...] = ()
    stage_us: Mapping[str, tuple[float, ...]] = field(default_factory=lambda: dict.fromkeys(STAGES, ()))
    recorded_s: float = 0.0
    cpu_s: float = 0.0

    def __add__(self, other: "Times") -> "Times":
        return Times(
            self.frame_us + other.frame_us,
            {stage: self.stage_us[stage] + other.stage_us[stage] for stage in STAGES},
            self.recorded_s + other.recorded_s,
            self.cpu_s + other.cpu_s,
        )


@dataclass(frozen=True)
class Measured:
    """What one variant gave: what was counted and what it took; adds over recordings.

    Attributes:
        statistics: What was counted; without truth, nothing but rows and packets.
        times: What it took; nothing where nobody measured.
        recordings: By name, the tally of what shares nothing with the others: a recording, or all of a
            campaign's with one seed.
    """

    statistics: Statistics = field(default_factory=Statistics)
    times: Times = field(default_factory=Times)
    recordings: Mapping[str, Tally] = field(default_factory=dict)

    def __add__(self, other: "Measured") -> "Measured":
        ours, theirs = self.recordings, other.recordings
        together = {name: ours.get(name, Tally()) + theirs.get(name, Tally()) for name in {**ours, **theirs}}
        return Measured(self.statistics + other.statistics, self.times + other.times, together)

    @cached_property
    def tally(self) -> Tally:
        """The tally of all distances."""
        return self.statistics.total()

    @property
    def found_share(self) -> float:
        """Share of the sent frames that were decoded; NaN without truth."""
        return self.tally.frames_found / self.tally.frames_sent if self.tally.frames_sent else math.nan

    @cached_property
    def ber(self) -> Figure:
        """The bit error rate with its interval over recordings."""
        return measure(tuple(self.recordings.values()), "ber")

    @property
    def us_per_frame(self) -> float:
        """Time of a frame, us: the median, robust against moments in which the machine did other work."""
        return median(self.times.frame_us)

    @property
    def times_real_time(self) -> float:
        """Recorded time over the processor time that reading and receiving took."""
        return times_real_time(self.times.recorded_s, self.times.cpu_s)


def median(values: Sequence[float]) -> float:
    """Median; NaN without values."""
    return float(np.median(values)) if values else math.nan


def rms(values: Sequence[float]) -> float:
    """Root mean square; NaN without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if values else math.nan
