"""Statistics that add: what a task measured, exact in any order of summation."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

__all__ = [
    "BIN_M",
    "HALF_METRE_M",
    "POSITION_BIN_M",
    "SEGMENT_M",
    "Statistics",
    "Tally",
    "segment_of",
]

SEGMENT_M = 10
"""Length of the segments of distance that figures are told for, m."""

BIN_M = 0.02
"""Width of a bin of the histogram of distance errors, m."""

POSITION_BIN_M = 0.005
"""Width of a bin of the histogram of position errors, m."""

HALF_METRE_M = 0.5
"""Distance error from which on an error counts as gross, m."""

_FARTHEST_BIN = 150
_FARTHEST_POSITION_BIN = 1000
_HISTOGRAMS = ("histogram", "position_histogram")


def segment_of(distance_m: float) -> int:
    """Where the segment of a distance begins, m.

    >>> segment_of(49.9)
    40
    """
    return math.floor(distance_m / SEGMENT_M) * SEGMENT_M


@dataclass(frozen=True)
class Tally:
    """What was counted in one segment of distance. Every field adds; all are integers, so sums are exact.

    Attributes:
        frames_sent: Frames that were sent whole while the recording ran.
        frames_found: Those of them that were decoded.
        bits: Bits of the found frames.
        bit_errors: Wrong bits among them.
        ranged: Found frames with a distance.
        sum_um: Sum of their distance errors, um.
        squares_um2: Sum of the squares of these errors, um^2.
        gross: Errors of half a metre or more.
        messages_sent: Packets with a message that were sent whole while the recording ran.
        messages_found: Those of them whose message was read.
        messages_wrong: Messages that were read and not sent so: undetected errors.
        fixes: Positions that were given.
        fixes_refused: Times at which a bar was in view, and no position was given.
        position_squares_um2: Sum of the squares of the positions' errors in space, um^2.
        position_nees_milli: Sum of these errors squared in their own sigmas, thousandths; 3000 each is ideal.
        histogram: (bin, count) in order of the bin; bin b holds errors from `b * BIN_M` up to the next, the
            outermost ones also everything beyond.
        position_histogram: The same of the positions' errors, in bins of `POSITION_BIN_M` from 0.
    """

    frames_sent: int = 0
    frames_found: int = 0
    bits: int = 0
    bit_errors: int = 0
    ranged: int = 0
    sum_um: int = 0
    squares_um2: int = 0
    gross: int = 0
    messages_sent: int = 0
    messages_found: int = 0
    messages_wrong: int = 0
    fixes: int = 0
    fixes_refused: int = 0
    position_squares_um2: int = 0
    position_nees_milli: int = 0
    histogram: tuple[tuple[int, int], ...] = ()
    position_histogram: tuple[tuple[int, int], ...] = ()

    @classmethod
    def sent(cls) -> Self:
        """One frame that was sent."""
        return cls(frames_sent=1)

    @classmethod
    def found(cls, bits: int, bit_errors: int, error_m: float | None) -> Self:
        """One frame that was decoded; `error_m` is None where it has no distance.

        >>> Tally.found(96, 1, -0.05).histogram
        ((-3, 1),)
        """
        if error_m is None:
            return cls(frames_found=1, bits=bits, bit_errors=bit_errors)
        error_um = round(error_m * 1e6)
        bin = max(-_FARTHEST_BIN, min(_FARTHEST_BIN, error_um // round(BIN_M * 1e6)))
        return cls(
            frames_found=1,
            bits=bits,
            bit_errors=bit_errors,
            ranged=1,
            sum_um=error_um,
            squares_um2=error_um**2,
            gross=int(abs(error_um) >= HALF_METRE_M * 1e6),
            histogram=((bin, 1),),
        )

    @classmethod
    def fix(cls, error_m: float, nees: float) -> Self:
        """One position that was given, its error in space and that squared in its own sigmas.

        >>> Tally.fix(0.012, 2.5).position_histogram
        ((2, 1),)
        """
        error_um = round(error_m * 1e6)
        bin = min(_FARTHEST_POSITION_BIN, error_um // round(POSITION_BIN_M * 1e6))
        return cls(
            fixes=1,
            position_squares_um2=error_um**2,
            # A thousand sigmas are wrong beyond all measure.
            position_nees_milli=round(min(nees, 1e6) * 1000),
            position_histogram=((bin, 1),),
        )

    def __add__(self, other: "Tally") -> "Tally":
        numbers: dict[str, Any] = {
            f.name: getattr(self, f.name) + getattr(other, f.name)
            for f in fields(self)
            if f.name not in _HISTOGRAMS
        }
        for name in _HISTOGRAMS:
            bins = Counter(dict(getattr(self, name)))
            bins.update(dict(getattr(other, name)))
            numbers[name] = tuple(sorted(bins.items()))
        return Tally(**numbers)

    @property
    def ber(self) -> float:
        """Share of wrong bits; NaN without bits."""
        return self.bit_errors / self.bits if self.bits else math.nan

    @property
    def rmse_m(self) -> float:
        """Root mean square of the distance errors, m; NaN without any."""
        return math.sqrt(self.squares_um2 / self.ranged) * 1e-6 if self.ranged else math.nan

    @property
    def bias_m(self) -> float:
        """Mean of the distance errors, m; NaN without any."""
        return self.sum_um / self.ranged * 1e-6 if self.ranged else math.nan

    @property
    def position_rmse_m(self) -> float:
        """Root mean square of the positions' errors in space, m; NaN without any."""
        return math.sqrt(self.position_squares_um2 / self.fixes) * 1e-6 if self.fixes else math.nan

    @property
    def position_nees(self) -> float:
        """Mean of the positions' errors squared in their own sigmas, ideally 3; NaN without any."""
        return self.position_nees_milli / self.fixes / 1000 if self.fixes else math.nan

    def position_quantile_m(self, share: float) -> float:
        """Error in space that a share of the positions stays below, to a bin, m; NaN without any.

        >>> (Tally.fix(0.02, 1) + Tally.fix(0.9, 1)).position_quantile_m(0.5)
        0.025
        """
        seen = 0
        for bin, count in self.position_histogram:
            seen += count
            if seen >= share * self.fixes:
                return (bin + 1) * POSITION_BIN_M
        return math.nan

    @property
    def gross_share(self) -> float:
        """Share of distance errors of half a metre or more; NaN without any."""
        return self.gross / self.ranged if self.ranged else math.nan


@dataclass(frozen=True)
class Statistics:
    """What one task or many measured together.

    Attributes:
        tasks: Number of tasks.
        events: Events that the sensor sent.
        duration_us: Simulated time, us.
        unmatched: Decoded frames that match no sent one.
        segments: (beginning of the segment in m, tally), in order.

    >>> one = Statistics.of(1, 1000, 100_000, 0, [(30, Tally.found(96, 2, 0.1))])
    >>> (one + one).total().bit_errors
    4
    """

    tasks: int = 0
    events: int = 0
    duration_us: int = 0
    unmatched: int = 0
    segments: tuple[tuple[int, Tally], ...] = ()

    @classmethod
    def of(
        cls,
        tasks: int,
        events: int,
        duration_us: int,
        unmatched: int,
        tallies: Iterable[tuple[int, Tally]],
    ) -> Self:
        """Statistics from tallies in any order, several a segment."""
        return cls(tasks, events, duration_us, unmatched, _by_segment(tallies))

    def __add__(self, other: "Statistics") -> "Statistics":
        return Statistics(
            self.tasks + other.tasks,
            self.events + other.events,
            self.duration_us + other.duration_us,
            self.unmatched + other.unmatched,
            _by_segment([*self.segments, *other.segments]),
        )

    def total(self) -> Tally:
        """The tally of all segments."""
        return _sum(tally for _, tally in self.segments)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as for JSON."""
        return {
            "tasks": self.tasks,
            "events": self.events,
            "duration_us": self.duration_us,
            "unmatched": self.unmatched,
            "segments": {
                str(begin): {
                    f.name: getattr(tally, f.name) for f in fields(tally) if f.name not in _HISTOGRAMS
                }
                | {name: {str(b): n for b, n in getattr(tally, name)} for name in _HISTOGRAMS}
                for begin, tally in self.segments
            },
        }

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Self:
        """What `to_dict` gave."""
        tallies = []
        for begin, values in table["segments"].items():
            bins = {
                name: tuple(sorted((int(b), n) for b, n in values.get(name, {}).items()))
                for name in _HISTOGRAMS
            }
            tallies.append((int(begin), Tally(**{**values, **bins})))
        return cls.of(table["tasks"], table["events"], table["duration_us"], table["unmatched"], tallies)


def _sum(tallies: Iterable[Tally]) -> Tally:
    return sum(tallies, Tally())


def _by_segment(tallies: Iterable[tuple[int, Tally]]) -> tuple[tuple[int, Tally], ...]:
    found: dict[int, list[Tally]] = {}
    for begin, tally in tallies:
        found.setdefault(begin, []).append(tally)
    return tuple((begin, _sum(found[begin])) for begin in sorted(found))
