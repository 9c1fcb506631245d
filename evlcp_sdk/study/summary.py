"""Results of a campaign: one series for each combination of what it varies, with segments of distance.

Recordings with the same seed have the same vibration, at whatever distance: a seed counts as one recording.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import zip_longest
from typing import Any, Literal

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.formatting import value_or_none
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.study.collect import PointProgress
from evlcp_sdk.study.intervals import Figure, measure_figure
from evlcp_sdk.study.plan import Plan
from evlcp_sdk.study.store import Store
from evlcp_sdk.study.tally import SEGMENT_M, Statistics, Tally


@dataclass(frozen=True)
class Series:
    """Points that differ only in what the campaign merges.

    Attributes:
        labels: What distinguishes it from other series.
        scene, link: Identities of its first scene and of its link; other versions' may lack anything.
        recordings: Statistics of its points, added up seed by seed.
    """

    labels: Mapping[str, Any]
    scene: Any
    link: Any
    recordings: tuple[Statistics, ...]

    @cached_property
    def statistics(self) -> Statistics:
        """Sum of all recordings."""
        return sum(self.recordings, Statistics())

    @cached_property
    def segments(self) -> tuple[tuple[int, tuple[Tally, ...]], ...]:
        """(Start of the segment in m, the tally of each recording), in order."""
        return tuple((at, self.tallies_between(at, at + SEGMENT_M)) for at in self.statistics.segments)

    @property
    def name(self) -> str:
        """Its labels in words."""
        parts = []
        for key, value in self.labels.items():
            word = key.rpartition(".")[2]
            stem, _, unit = word.rpartition("_")
            if word in ("variant", "base", "id"):
                parts.append(str(value))
            elif unit in _UNITS and isinstance(value, int | float):
                what = "" if stem == "speed" else f"{stem} "
                parts.append(f"{what}{value:g} {_UNITS[unit]}")
            else:
                parts.append(f"{word} {value}")
        name = ", ".join(parts) or "simulated"
        return "".join(c if c.isprintable() else "\ufffd" for c in name)

    @property
    def clusters(self) -> int | None:
        """Number of clusters that its distances are measured from; None if unknown."""
        try:
            table = self.link["table"]
            chosen = table.get("ranging", {}).get("clusters")
            return len(chosen) if chosen else BarLayout.of_table(table["bar"]).clusters
        except (TypeError, KeyError, AttributeError, ValueError, ConfigError):
            return None

    @property
    def speed_kmh(self) -> float | None:
        """Speed of the camera, km/h; None if unknown."""
        try:
            return round(float(self.scene["motion"]["speed_mps"]) * 3.6, 1)
        except (TypeError, KeyError, ValueError):
            return None

    def tallies_between(self, from_m: int, to_m: int) -> tuple[Tally, ...]:
        """The tally of each recording over the segments between two distances."""
        return tuple(
            Tally.sum(t for at, t in one.segments.items() if from_m <= at < to_m) for one in self.recordings
        )


_UNITS = {"kmh": "km/h", "mps": "m/s", "m": "m", "us": "us", "s": "s", "hz": "Hz", "mm": "mm", "px": "px"}


@dataclass(frozen=True)
class Summary:
    """A campaign's outcome: how many tasks count or may, and are done; its series in order; its plan."""

    tasks: int
    done: int
    series: tuple[Series, ...]
    plan: Plan

    def to_dict(self) -> dict[str, Any]:
        """Every figure as JSON values; what was not measured is null."""
        return {
            "campaign": self.plan.name,
            "digest": self.plan.digest,
            "environment": self.plan.environment,
            "tasks": self.tasks,
            "done": self.done,
            "series": [
                {
                    "name": s.name,
                    "labels": dict(s.labels),
                    "tasks": s.statistics.tasks,
                    "simulated_s": s.statistics.duration_us * 1e-6,
                    "events": s.statistics.events,
                    "packets": s.statistics.packets,
                    "frames": s.statistics.rows,
                    "unmatched": s.statistics.unmatched,
                    "echoes": s.statistics.echoes,
                    "sigma_m": s.statistics.sigma_m if s.statistics.stated else None,
                    "segments": [
                        {"from_m": at, "to_m": at + SEGMENT_M} | _segment_figures(tallies)
                        for at, tallies in s.segments
                    ],
                }
                for s in self.series
            ],
            "paper": [
                asdict(c.reference)
                | {"series": c.series, "ours": _figure_values(c.ours), "ours_at_m": [c.from_m, c.to_m]}
                | {"verdict": c.verdict}
                for c in compare_with_paper(self.series)
            ],
        }


def _segment_figures(recordings: Sequence[Tally]) -> dict[str, Any]:
    tally = Tally.sum(recordings)
    kinds = ("ber", "rmse_m", "gross_share", "found_share", "lost_share", "wrong_share", "position_rmse_m")
    names = (
        *("frames_sent", "frames_found", "bits", "bit_errors", "ranged", "gross"),
        *("messages_sent", "messages_found", "messages_wrong", "fixes", "fixes_refused", "track"),
        *("fixes_contradicted", "fixes_excluded", "fixes_protected", "fixes_beyond", "fixes_silent"),
        "fixes_uncovered",
    )
    figures = (
        *("erased_share", "claimed_share", "bias_m", "worst_m", "nees", "filtered_rmse_m"),
        *("position_median_m", "position_95_m", "position_nees"),
        *("kept_share", "track_rmse_m", "track_nees", "smoothed_rmse_m", "smoothed_nees"),
    )
    found = {name: value_or_none(getattr(tally, name)) for name in (*names, *figures)}
    return found | {kind: _figure_values(measure_figure(recordings, kind)) for kind in kinds}


def _figure_values(figure: Figure) -> dict[str, Any]:
    return {name: value_or_none(value) for name, value in asdict(figure).items()}


def summarize(store: Store) -> Summary:
    """Add up the results that count in a store.

    Raises:
        InputError: No campaign has started in it.
    """
    plan = store.read_plan()
    results = store.read_results()
    merged = set(plan.merge)
    all_series: dict[str, Series] = {}
    tasks = done = 0
    for point in plan.points:
        progress = PointProgress(point.tasks, plan.rule, results)
        tasks += progress.needed
        done += progress.done
        labels = {k: v for k, v in point.labels.items() if k not in merged}
        key = json.dumps(labels)
        series = all_series.get(key)
        if series is None:
            all_series[key] = Series(labels, point.scene.identity, point.link.identity, progress.recordings)
        else:
            pairs = zip_longest(series.recordings, progress.recordings, fillvalue=Statistics())
            all_series[key] = replace(series, recordings=tuple(a + b for a, b in pairs))
    return Summary(tasks, done, tuple(all_series.values()), plan)


PAPER_NAME = "arXiv 2510.17203"

Measure = Literal["ber", "rmse_m", "gross_share"]


@dataclass(frozen=True)
class Reference:
    """A figure of the paper, measured on real drives past a bar 1.5 m aside.

    Attributes:
        measure: Bit error rate, distance RMSE in m, or share of distance errors of half a metre or more.
        clusters: Clusters that the distance is measured from: 16, or the 2 of the method it compares with;
            None for any.
        speed_kmh: Speed of the car; None for 20, 30 and 40 km/h together.
        from_m: Start of its range of distance, m.
        to_m: Its end, m.
        value: The figure.
        bound: The paper gives it as an upper bound.
    """

    measure: Measure
    clusters: int | None
    speed_kmh: float | None
    from_m: int
    to_m: int
    value: float
    bound: bool = False


PAPER = (
    Reference("ber", 16, None, 30, 100, 0.01, bound=True),
    Reference("rmse_m", 16, 30.0, 30, 40, 0.0702),
    Reference("rmse_m", 16, 30.0, 40, 50, 0.1216),
    Reference("rmse_m", 16, 30.0, 50, 60, 0.20, bound=True),
    Reference("rmse_m", 16, 30.0, 60, 100, 0.75, bound=True),
    Reference("rmse_m", 2, 30.0, 30, 40, 0.2819),
    Reference("rmse_m", 2, 30.0, 40, 50, 0.4182),
    Reference("gross_share", 16, 30.0, 30, 60, 0.004),
)
"""Every figure of the paper that a simulated drive can be compared with."""


@dataclass(frozen=True)
class PaperComparison:
    """A figure of the paper with ours.

    Attributes:
        reference: The paper's.
        series: Name of the series of ours.
        ours: The measured one; where the paper gives a bound, that of the worst segment.
        from_m, to_m: The distances that ours was measured at, m.
    """

    reference: Reference
    series: str
    ours: Figure
    from_m: int
    to_m: int

    @property
    def verdict(self) -> "Verdict":
        """The verdict by `verdict_of`."""
        return verdict_of(self.ours, self.reference)


Verdict = Literal["better", "agrees", "worse", "too few"]

AGREEMENT = 0.3
"""Largest share by which two figures that agree differ."""


def verdict_of(ours: Figure, reference: Reference) -> Verdict:
    """Compare a figure with the paper's; the smaller one is better.

    A bound is kept, which agrees, or not, which is worse: how far the paper stays below it is unknown.
    Without a single error, there are too few data if they would not show fewer errors than the paper's.
    """
    if ours.is_zero and ours.high > reference.value:
        return "too few"
    ratio = ours.value / reference.value
    if ratio > 1 + (0 if reference.bound else AGREEMENT):
        return "worse"
    return "agrees" if reference.bound or ratio >= 1 - AGREEMENT else "better"


def compare_with_paper(
    series: Sequence[Series], references: Iterable[Reference] = PAPER
) -> list[PaperComparison]:
    """Compare each figure of the paper with every series that it applies to and that has data."""
    comparisons = []
    for reference in references:
        for one in series:
            if reference.clusters is not None and one.clusters != reference.clusters:
                continue
            if reference.speed_kmh is not None and one.speed_kmh != reference.speed_kmh:
                continue
            # A bound is compared with the largest figure of a segment.
            span = reference.from_m, reference.to_m
            spans = [(m, m + SEGMENT_M) for m in range(*span, SEGMENT_M)] if reference.bound else [span]
            figures = [(measure_figure(one.tallies_between(*s), reference.measure), s) for s in spans]
            if nonempty := [pair for pair in figures if pair[0].count]:
                ours, span = max(nonempty, key=lambda pair: pair[0].value)
                comparisons.append(PaperComparison(reference, one.name, ours, *span))
    return comparisons
