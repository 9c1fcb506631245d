"""What one variant gave on a recording, in a form that adds over recordings."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.study.intervals import proportion_interval

__all__ = ["STAGES", "Measured", "Moments", "median"]

STAGES = ("separation", "decoding", "ranging")
"""The stages that every frame goes through, and whose time is told."""


@dataclass(frozen=True)
class Moments:
    """Number, sum and sum of squares of some values; adds.

    >>> Moments.of(np.array([3.0, -4.0])).rms
    3.5355339059327378
    """

    count: int = 0
    total: float = 0.0
    squares: float = 0.0

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> "Moments":
        """Those of the finite values of an array."""
        values = values[np.isfinite(values)]
        return cls(len(values), float(values.sum()), float((values**2).sum()))

    def __add__(self, other: "Moments") -> "Moments":
        return Moments(self.count + other.count, self.total + other.total, self.squares + other.squares)

    @property
    def mean(self) -> float:
        """Mean; NaN without values."""
        return self.total / self.count if self.count else math.nan

    @property
    def rms(self) -> float:
        """Root mean square; NaN without values."""
        return math.sqrt(self.squares / self.count) if self.count else math.nan


@dataclass(frozen=True)
class Measured:
    """What one variant gave; adds over recordings. A figure that was not measured is NaN.

    Attributes:
        frames: Decoded frames.
        packets: Decoded packets; None where nobody counted.
        frames_sent: Frames that were wholly on air; 0 without truth.
        frames_found: Frames of these that were decoded.
        unmatched: Decoded frames that match no true one.
        bits: Bits of the found frames.
        bit_errors: Wrong ones among them.
        error_m: Distance errors, m.
        gross: Distance errors of half a metre or more.
        filtered_error_m: Errors of the filtered distances, m.
        stated_sigma_m: Standard deviations that the ranging states, m.
        frame_us: Time of every frame in the stages `STAGES` together, us.
        stage_us: The same of each stage.
        recorded_s: Duration of the recordings, s.
        cpu_s: Processor time for reading and receiving them, s.
    """

    frames: int = 0
    packets: int | None = 0
    frames_sent: int = 0
    frames_found: int = 0
    unmatched: int = 0
    bits: int = 0
    bit_errors: int = 0
    error_m: Moments = Moments()
    gross: int = 0
    filtered_error_m: Moments = Moments()
    stated_sigma_m: Moments = Moments()
    frame_us: tuple[float, ...] = ()
    stage_us: Mapping[str, tuple[float, ...]] = field(default_factory=lambda: dict.fromkeys(STAGES, ()))
    recorded_s: float = 0.0
    cpu_s: float = 0.0

    def __add__(self, other: "Measured") -> "Measured":
        sums: dict[str, Any] = {
            f.name: getattr(self, f.name) + getattr(other, f.name)
            for f in fields(self)
            if f.name not in ("packets", "stage_us")
        }
        both = None not in (self.packets, other.packets)
        sums["packets"] = (self.packets or 0) + (other.packets or 0) if both else None
        sums["stage_us"] = {stage: self.stage_us[stage] + other.stage_us[stage] for stage in STAGES}
        return Measured(**sums)

    @property
    def found_share(self) -> float:
        """Share of the sent frames that were decoded."""
        return self.frames_found / self.frames_sent if self.frames_sent else math.nan

    @property
    def ber(self) -> float:
        """Bit error rate of the found frames."""
        return self.bit_errors / self.bits if self.bits else math.nan

    @property
    def ber_interval(self) -> tuple[float, float]:
        """Its 95 % interval (Clopper-Pearson), errors taken as independent."""
        return proportion_interval(self.bit_errors, self.bits) if self.bits else (math.nan, math.nan)

    @property
    def rmse_m(self) -> float:
        """Root mean square error of the distances, m."""
        return self.error_m.rms

    @property
    def bias_m(self) -> float:
        """Mean error of the distances, m."""
        return self.error_m.mean

    @property
    def gross_share(self) -> float:
        """Share of the distances that are half a metre off or more."""
        return self.gross / self.error_m.count if self.error_m.count else math.nan

    @property
    def filtered_rmse_m(self) -> float:
        """Root mean square error of the filtered distances, m."""
        return self.filtered_error_m.rms

    @property
    def sigma_m(self) -> float:
        """Root mean square of the standard deviations that the ranging states, m."""
        return self.stated_sigma_m.rms

    @property
    def us_per_frame(self) -> float:
        """Time of a frame, us: the median, deaf to moments in which the machine did other work."""
        return median(self.frame_us)

    @property
    def times_real_time(self) -> float:
        """Recorded time over the processor time that reading and receiving took."""
        return self.recorded_s / self.cpu_s if self.recorded_s and self.cpu_s else math.nan


def median(values: Sequence[float]) -> float:
    """Median; NaN without values."""
    return float(np.median(values)) if values else math.nan
