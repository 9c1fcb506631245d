"""Addable statistics: counts of decoded frames, exact in any order of summation."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Annotated, Any, Self, overload

from pydantic import Field

from evlcp_sdk.specs import build_spec
from evlcp_sdk.values import find_quantile_bin

SEGMENT_M = 10
"""Length of the segments of distance that figures are given for, m."""

BIN_M = 0.02
"""Width of a bin of the histogram of distance errors, m."""

POSITION_BIN_M = 0.005
"""Width of a bin of the histogram of position errors, m."""

HALF_METRE_M = 0.5
"""Distance error from which on an error counts as gross, m."""

SILENT_NEES = 14.156
"""NEES that is exceeded once in 370 fixes by chance: chi-square of three, 99.73 %."""

_FARTHEST_BIN = 150
_FARTHEST_POSITION_BIN = 1000
_HISTOGRAMS = ("histogram", "position_histogram")
_MOST = 10**40
"""Above any sum: all nanometres squared of all frames of a year are 1e30."""

Count = Annotated[int, Field(ge=0, lt=2**53)]
Sum = Annotated[int, Field(ge=0, le=_MOST)]
Histogram = dict[Annotated[int, Field(ge=-_FARTHEST_POSITION_BIN, le=_FARTHEST_POSITION_BIN)], Count]
_LARGEST = ("worst_nm",)
_MAX_SIGMAS = 1e6
"""Largest error that is counted, in sigmas; also for a sigma of 0."""


def segment_of(distance_m: float) -> int:
    """Start of the segment of a distance, m.

    >>> segment_of(49.9)
    40
    """
    return math.floor(distance_m / SEGMENT_M) * SEGMENT_M


def to_nm(length_m: float) -> int:
    """Convert a length to a whole number of nanometres, so that sums are exact.

    >>> to_nm(-0.05)
    -50000000
    """
    return round(length_m * 1e9)


@dataclass(frozen=True)
class Ratio:
    """A figure of a tally: the ratio of two of its sums, NaN of nothing.

    Attributes:
        numerator: Name of the sum above the line.
        denominator: Name of the sum below it.
        scale: Factor of the ratio, or of its root.
        root: Whether it is a root mean square.
        independent: Name of the count that is independent at best, for a limit where `numerator` is 0; empty
            for `denominator`.
    """

    numerator: str
    denominator: str
    scale: float = 1.0
    root: bool = False
    independent: str = ""

    @overload
    def __get__(self, tally: None, owner: type) -> Self: ...
    @overload
    def __get__(self, tally: object, owner: type) -> float: ...
    def __get__(self, tally: object | None, owner: type) -> Self | float:
        if tally is None:
            return self
        below = getattr(tally, self.denominator)
        return self.scale_ratio(getattr(tally, self.numerator) / below) if below else math.nan

    def scale_ratio(self, ratio: float) -> float:
        """The figure of a ratio."""
        return (math.sqrt(ratio) if self.root else ratio) * self.scale


@dataclass(frozen=True)
class Tally:
    """Counts in one segment of distance. Every field adds; all are integers, so that sums are exact.

    A found frame has for each visible cluster a symbol that is given or erased (`-`); a symbol given for a
    hidden one is claimed. A cluster that was visible for a part of the frame does not count.

    Attributes:
        frames_sent: Frames that were sent whole while the recording ran.
        frames_found: Those of them that were decoded.
        bits: Bits of the symbols that are given, of visible clusters.
        bit_errors: Wrong bits among them.
        visible: Symbols of visible clusters.
        erased: Those of them not given.
        erased_bits: Their bits.
        hidden: Symbols of hidden clusters.
        claimed: Those of them that are given.
        ranged: Found frames with a distance.
        sum_nm: Sum of their distance errors, nm.
        squares_nm2: Sum of the squares of these errors, nm^2.
        gross: Errors of half a metre or more.
        worst_nm: The largest size of an error, nm; of a sum, the larger one.
        with_sigma: Distances that come with a standard deviation.
        nees_micro: Sum of (error / sigma)^2 of these, millionths.
        filtered: Found frames with a filtered distance.
        filtered_squares_nm2: Sum of the squares of the errors of these, nm^2.
        messages_sent: Packets with a message that were sent whole while the recording ran.
        messages_found: Those of them whose message was read.
        messages_wrong: Messages that were read and not sent so: undetected errors.
        fixes: Positions that were given.
        fixes_refused: Times at which a bar was in view, and no position was given.
        fixes_contradicted: Those of them at which parts contradicted one another; at others, the view does
            not determine a position.
        fixes_excluded: Positions given without a part that the rest contradicts.
        fixes_protected: Those with both protection levels.
        fixes_beyond: Those of these whose error is beyond one of them.
        fixes_silent: Positions whose error is beyond the 99.73 % bound of their own covariance.
        fixes_uncovered: Those of them that have no protection level, or are beyond it.
        track: Points of the track, one a position that was given.
        position_squares_nm2, track_squares_nm2, smoothed_squares_nm2: Sums of the squares of errors in space,
            nm^2: of positions, and of points of the track as filtered and as smoothed.
        position_nees_micro, track_nees_micro, smoothed_nees_micro: Sums of these errors squared in their own
            sigmas, millionths; 3 each is ideal.
        histogram: Bin to count, in order of the bin; bin b holds errors from `b * BIN_M` up to the next, the
            outermost ones also everything beyond.
        position_histogram: The same of the positions' errors, in bins of `POSITION_BIN_M` from 0.
    """

    frames_sent: Count = 0
    frames_found: Count = 0
    bits: Count = 0
    bit_errors: Count = 0
    visible: Count = 0
    erased: Count = 0
    erased_bits: Count = 0
    hidden: Count = 0
    claimed: Count = 0
    ranged: Count = 0
    sum_nm: Annotated[int, Field(ge=-_MOST, le=_MOST)] = 0
    squares_nm2: Sum = 0
    gross: Count = 0
    worst_nm: Sum = 0
    with_sigma: Count = 0
    nees_micro: Sum = 0
    filtered: Count = 0
    filtered_squares_nm2: Sum = 0
    messages_sent: Count = 0
    messages_found: Count = 0
    messages_wrong: Count = 0
    fixes: Count = 0
    fixes_refused: Count = 0
    fixes_contradicted: Count = 0
    fixes_excluded: Count = 0
    fixes_protected: Count = 0
    fixes_beyond: Count = 0
    fixes_silent: Count = 0
    fixes_uncovered: Count = 0
    position_squares_nm2: Sum = 0
    position_nees_micro: Sum = 0
    track: Count = 0
    track_squares_nm2: Sum = 0
    track_nees_micro: Sum = 0
    smoothed_squares_nm2: Sum = 0
    smoothed_nees_micro: Sum = 0
    histogram: Histogram = field(default_factory=dict)
    position_histogram: Histogram = field(default_factory=dict)

    @classmethod
    def of_distance(cls, error_m: float, sigma_m: float = math.nan) -> Self:
        """One distance; its sigma is NaN for none.

        >>> Tally.of_distance(-0.05).histogram
        {-3: 1}
        """
        error_nm = to_nm(error_m)
        sigmas = min(abs(error_m / sigma_m), _MAX_SIGMAS) if sigma_m else _MAX_SIGMAS
        bin = max(-_FARTHEST_BIN, min(_FARTHEST_BIN, error_nm // to_nm(BIN_M)))
        return cls(
            ranged=1,
            sum_nm=error_nm,
            squares_nm2=error_nm**2,
            gross=int(abs(error_m) >= HALF_METRE_M),
            worst_nm=abs(error_nm),
            with_sigma=int(not math.isnan(sigma_m)),
            nees_micro=0 if math.isnan(sigma_m) else _nees_micro(sigmas**2),
            histogram={bin: 1},
        )

    @classmethod
    def of_fix(
        cls,
        error_m: float,
        nees: float,
        *,
        excluded: bool = False,
        protected: bool = False,
        beyond: bool = False,
    ) -> Self:
        """One given position; its NEES is its error in space squared in its own sigmas.

        >>> Tally.of_fix(0.012, 2.5).position_histogram
        {2: 1}
        """
        error_nm = to_nm(error_m)
        bin = min(_FARTHEST_POSITION_BIN, error_nm // to_nm(POSITION_BIN_M))
        return cls(
            fixes=1,
            fixes_excluded=int(excluded),
            fixes_protected=int(protected),
            fixes_beyond=int(protected and beyond),
            fixes_silent=int(nees > SILENT_NEES),
            fixes_uncovered=int(nees > SILENT_NEES and (beyond or not protected)),
            position_squares_nm2=error_nm**2,
            position_nees_micro=_nees_micro(nees),
            position_histogram={bin: 1},
        )

    @classmethod
    def of_track_point(cls, filtered_m: float, nees: float, smoothed_m: float, smoothed_nees: float) -> Self:
        """One point of the track: its errors in space, m, and these squared in their own sigmas."""
        return cls(
            track=1,
            track_squares_nm2=to_nm(filtered_m) ** 2,
            track_nees_micro=_nees_micro(nees),
            smoothed_squares_nm2=to_nm(smoothed_m) ** 2,
            smoothed_nees_micro=_nees_micro(smoothed_nees),
        )

    @classmethod
    def sum(cls, tallies: Iterable["Tally"]) -> "Tally":
        """Sum of tallies."""
        tallies = list(tallies)
        numbers: dict[str, Any] = {}
        for name in (f.name for f in fields(cls)):
            column = [getattr(tally, name) for tally in tallies]
            if name in _HISTOGRAMS:
                bins: Counter[int] = Counter()
                for histogram in column:
                    bins.update(histogram)
                numbers[name] = dict(sorted(bins.items()))
            else:
                numbers[name] = max(column, default=0) if name in _LARGEST else sum(column)
        return cls(**numbers)

    def __add__(self, other: "Tally") -> "Tally":
        return Tally.sum((self, other))

    ber = Ratio("bit_errors", "bits", independent="frames_found")
    """Share of wrong bits among those given; wrong bits come in wrong frames, which are fewer."""

    erased_share = Ratio("erased", "visible")
    claimed_share = Ratio("claimed", "hidden")
    """Share of the visible clusters' symbols not given, and of the hidden ones' given."""

    found_share = Ratio("frames_found", "frames_sent")
    """Share of the sent frames that were decoded."""

    rmse_m = Ratio("squares_nm2", "ranged", 1e-9, root=True)
    bias_m = Ratio("sum_nm", "ranged", 1e-9)
    nees = Ratio("nees_micro", "with_sigma", 1e-6)
    gross_share = Ratio("gross", "ranged")
    """Of the distance errors: root mean square and mean, m; mean of (error / sigma)^2, ideally 1; share of
    those of half a metre or more."""

    filtered_rmse_m = Ratio("filtered_squares_nm2", "filtered", 1e-9, root=True)
    """Root mean square of the filtered distances' errors, m."""

    lost_share = Ratio("messages_lost", "messages_sent")
    wrong_share = Ratio("messages_wrong", "messages_read")
    """Share of the messages that were sent and not read, and of those that were read and are wrong."""

    kept_share = Ratio("fixes", "fixes_determined")
    """Share of the positions determined by the view that are given."""

    position_rmse_m = Ratio("position_squares_nm2", "fixes", 1e-9, root=True)
    position_nees = Ratio("position_nees_micro", "fixes", 1e-6)
    track_rmse_m = Ratio("track_squares_nm2", "track", 1e-9, root=True)
    track_nees = Ratio("track_nees_micro", "track", 1e-6)
    smoothed_rmse_m = Ratio("smoothed_squares_nm2", "track", 1e-9, root=True)
    smoothed_nees = Ratio("smoothed_nees_micro", "track", 1e-6)
    """Of positions, of the filtered track and of the smoothed one: root mean square of the errors in space,
    m, and mean of these squared in their own sigmas, ideally 3."""

    @property
    def worst_m(self) -> float:
        """Size of the largest distance error, m; NaN without any."""
        return self.worst_nm * 1e-9 if self.ranged else math.nan

    @property
    def messages_lost(self) -> int:
        """Messages that were sent and not read."""
        return self.messages_sent - self.messages_found

    @property
    def messages_read(self) -> int:
        """Messages that were read, right or wrong."""
        return self.messages_found + self.messages_wrong

    @property
    def fixes_determined(self) -> int:
        """Positions determined by the view, given or not."""
        return self.fixes + self.fixes_contradicted

    @property
    def position_median_m(self) -> float:
        """Error in space that half of the positions stay below, to a bin, m; NaN without any."""
        return self.position_quantile_m(0.5)

    @property
    def position_95_m(self) -> float:
        """The same of 95 % of them."""
        return self.position_quantile_m(0.95)

    def position_quantile_m(self, share: float) -> float:
        """Error in space that a share of the positions stays below, to a bin, m; NaN without any.

        >>> (Tally.of_fix(0.02, 1) + Tally.of_fix(0.9, 1)).position_quantile_m(0.5)
        0.025
        """
        bin = find_quantile_bin(self.position_histogram, share)
        return math.nan if bin is None else (bin + 1) * POSITION_BIN_M


def _nees_micro(nees: float) -> int:
    return round(min(nees, _MAX_SIGMAS**2) * 1e6)


@dataclass(frozen=True)
class Statistics:
    """Counts of one task or of many together.

    Attributes:
        tasks: Number of tasks.
        events: Events of the sensor.
        duration_us: Simulated time, us.
        packets: Decoded packets.
        rows: Decoded frames.
        echoes: Those of them that are declared reflections; they count nowhere else.
        unmatched: Those of them that match no sent one.
        stated: Distances with a standard deviation, of matched frames and others.
        sigma_squares_nm2: Sum of the squares of these standard deviations, nm^2.
        segments: Start of the segment in m to its tally, in order.

    >>> one = Statistics(rows=3, segments={30: Tally(bits=96, bit_errors=2)})
    >>> (one + one).total().bit_errors
    4
    """

    tasks: Count = 0
    events: Count = 0
    duration_us: Count = 0
    packets: Count = 0
    rows: Count = 0
    echoes: Count = 0
    unmatched: Count = 0
    stated: Count = 0
    sigma_squares_nm2: Sum = 0
    segments: dict[int, Tally] = field(default_factory=dict)

    @classmethod
    def of(cls, tallies: Iterable[tuple[int, Tally]], **counts: int) -> Self:
        """Statistics of tallies in any order, several a segment."""
        by_segment: dict[int, list[Tally]] = {}
        for start, tally in tallies:
            by_segment.setdefault(start, []).append(tally)
        return cls(**counts, segments={start: Tally.sum(by_segment[start]) for start in sorted(by_segment)})

    def __add__(self, other: "Statistics") -> "Statistics":
        names = (f.name for f in fields(self) if f.name != "segments")
        counts = {name: getattr(self, name) + getattr(other, name) for name in names}
        return Statistics.of([*self.segments.items(), *other.segments.items()], **counts)

    def total(self) -> Tally:
        """Sum of all segments."""
        return Tally.sum(self.segments.values())

    sigma_m = Ratio("sigma_squares_nm2", "stated", 1e-9, root=True)
    """Root mean square of the distances' standard deviations, m."""

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Self:
        """Statistics from `to_dict`, also by way of JSON.

        Raises:
            ConfigError: It is something else.
        """
        found = build_spec(cls, table)
        return replace(found, segments=dict(sorted(found.segments.items())))
