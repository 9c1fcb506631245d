"""What a campaign found: one series a combination of what it varies, one row a segment of distance."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from evlcp_sdk.study.campaign.collect import Counted
from evlcp_sdk.study.campaign.paper import PAPER, Measure, Reference
from evlcp_sdk.study.campaign.plan import StopRule
from evlcp_sdk.study.campaign.store import Store
from evlcp_sdk.study.intervals import proportion_interval, rms_interval
from evlcp_sdk.study.tally import SEGMENT_M, Statistics, Tally

__all__ = ["Figure", "PaperComparison", "Series", "Summary", "beside_paper", "measure", "summarize"]


@dataclass(frozen=True)
class Figure:
    """A measured figure with its 95 % interval; NaN where nothing was measured.

    Attributes:
        value: The figure.
        low: Lower end of the interval.
        high: Its upper end.
        count: Bits, distances or frames it was measured on.
    """

    value: float
    low: float
    high: float
    count: int


def measure(tally: Tally, kind: str) -> Figure:
    """A figure of a tally.

    Args:
        tally: What was counted.
        kind: `ber`, `rmse_m`, `gross_share`, `found_share`, `lost_share` (messages that were not read),
            `wrong_share` (messages that were read wrong, of those that were read) or `position_rmse_m`.

    >>> round(measure(Tally(bits=1000), "ber").high, 4)
    0.0037
    """
    if kind == "rmse_m":
        return Figure(tally.rmse_m, *rms_interval(tally.rmse_m, tally.ranged), tally.ranged)
    if kind == "position_rmse_m":
        # An error in space has three parts.
        interval = rms_interval(tally.position_rmse_m, 3 * tally.fixes)
        return Figure(tally.position_rmse_m, *interval, tally.fixes)
    hits, trials = {
        "ber": (tally.bit_errors, tally.bits),
        "gross_share": (tally.gross, tally.ranged),
        "found_share": (tally.frames_found, tally.frames_sent),
        "lost_share": (tally.messages_sent - tally.messages_found, tally.messages_sent),
        "wrong_share": (tally.messages_wrong, tally.messages_found + tally.messages_wrong),
    }[kind]
    if not trials:
        return Figure(math.nan, math.nan, math.nan, 0)
    return Figure(hits / trials, *proportion_interval(hits, trials), trials)


@dataclass(frozen=True)
class Series:
    """Points that differ in nothing but what the campaign merges.

    Attributes:
        labels: What sets it apart from the other series.
        scene: Identity of its first scene.
        link: Identity of its link.
        statistics: What counts of its points, added up.
    """

    labels: Mapping[str, Any]
    scene: Any
    link: Any
    statistics: Statistics

    @property
    def name(self) -> str:
        """What sets it apart, in words."""
        parts = []
        for key, value in self.labels.items():
            word = key.rpartition(".")[2]
            stem, _, unit = word.rpartition("_")
            if word in ("variant", "base", "id"):
                parts.append(str(value))
            elif unit in _UNITS:
                parts.append(
                    f"{value:g} {_UNITS[unit]}" if stem == "speed" else f"{stem} {value:g} {_UNITS[unit]}"
                )
            else:
                parts.append(f"{word} {value}")
        return ", ".join(parts) or "simulated"

    @property
    def clusters(self) -> int | None:
        """Clusters that its distances are measured from; None where the link does not say."""
        try:
            table = self.link["table"]
            chosen, bar = table["ranging"].get("clusters"), table["bar"]
            rows = bar["rows"] // bar["cluster_rows"]
            return len(chosen) if chosen else int(rows * (bar["columns"] // bar["cluster_columns"]))
        except (TypeError, KeyError):
            return None

    @property
    def speed_kmh(self) -> float | None:
        """Speed of the camera, km/h; None where the scene does not say."""
        return _speed_kmh(self.scene)

    def between(self, from_m: int, to_m: int) -> Tally:
        """The tally of the segments that lie between two distances."""
        return Tally.together(t for at, t in self.statistics.segments if from_m <= at < to_m)


_UNITS = {"kmh": "km/h", "mps": "m/s", "m": "m", "us": "us", "s": "s", "hz": "Hz", "mm": "mm", "px": "px"}


def _speed_kmh(scene: Any) -> float | None:
    if isinstance(scene, Mapping):
        for key, value in scene.items():
            if key == "speed_kmh" and isinstance(value, int | float):
                return float(value)
            if key == "speed_mps" and isinstance(value, int | float):
                return round(value * 3.6, 1)
        for value in scene.values():
            if (found := _speed_kmh(value)) is not None:
                return found
    return None


@dataclass(frozen=True)
class Summary:
    """A campaign's outcome.

    Attributes:
        name: The campaign.
        digest: SHA-256 of all its tasks.
        tasks: Tasks that count or would.
        done: Those that are finished.
        series: In the order of the campaign.
        plan: The plan as the store keeps it.
    """

    name: str
    digest: str
    tasks: int
    done: int
    series: tuple[Series, ...]
    plan: Mapping[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Every figure as JSON values; what was not measured is null."""
        return {
            "campaign": self.name,
            "digest": self.digest,
            "environment": self.plan["environment"],
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
                        {"from_m": at, "to_m": at + SEGMENT_M} | _figures(tally)
                        for at, tally in s.statistics.segments
                    ],
                }
                for s in self.series
            ],
            "paper": [
                asdict(c.reference)
                | {"series": c.series, "ours": _plain(asdict(c.ours)), "ours_at_m": [c.from_m, c.to_m]}
                | {"agrees": c.agrees}
                for c in beside_paper(self.series)
            ],
        }


def _figures(tally: Tally) -> dict[str, Any]:
    kinds = ("ber", "rmse_m", "gross_share", "found_share", "lost_share", "wrong_share", "position_rmse_m")
    names = (
        *("frames_sent", "frames_found", "bits", "bit_errors", "ranged", "gross"),
        *("messages_sent", "messages_found", "messages_wrong", "fixes", "fixes_refused"),
    )
    counts = {name: getattr(tally, name) for name in names}
    others = {
        "erased_share": tally.erased_share,
        "claimed_share": tally.claimed_share,
        "bias_m": tally.bias_m,
        "worst_m": tally.worst_m,
        "nees": tally.nees,
        "filtered_rmse_m": tally.filtered_rmse_m,
        "position_median_m": tally.position_quantile_m(0.5),
        "position_95_m": tally.position_quantile_m(0.95),
        "position_nees": tally.position_nees,
    }
    return _plain(counts | others) | {kind: _plain(asdict(measure(tally, kind))) for kind in kinds}


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


def summarize(store: Store) -> Summary:
    """Add up what counts in a store.

    Raises:
        InputError: No campaign has started in it.
    """
    plan = store.plan()
    results = store.results()
    rule = StopRule(**plan["rule"])
    merged = set(plan["merge"])
    found: dict[str, Series] = {}
    tasks = done = 0
    for point in plan["points"]:
        counted = Counted(point["tasks"], rule, results)
        tasks += counted.seeds if counted.complete else len(counted.tasks)
        done += counted.done
        labels = {k: v for k, v in point["labels"].items() if k not in merged}
        key = json.dumps(labels)
        before = found.get(key)
        if before is None:
            scene = plan["scenes"][point["scene"]]["identity"]
            link = plan["links"][point["link"]]["identity"]
            found[key] = Series(labels, scene, link, counted.total)
        else:
            together = before.statistics + counted.total
            found[key] = Series(before.labels, before.scene, before.link, together)
    return Summary(plan["name"], plan["digest"], tasks, done, tuple(found.values()), plan)


@dataclass(frozen=True)
class PaperComparison:
    """A figure of the paper beside ours.

    Attributes:
        reference: The paper's.
        series: Name of the series that it is held against.
        ours: The measured one; where the paper gives a bound, that of the worst segment.
        from_m: Start of the distances that ours was measured at, m.
        to_m: Their end, m.
        agrees: Ours keeps the paper's bound, or lies within 30 % of its figure.
    """

    reference: Reference
    series: str
    ours: Figure
    from_m: int
    to_m: int
    agrees: bool


AGREEMENT = 0.3


def beside_paper(series: Iterable[Series], references: Iterable[Reference] = PAPER) -> list[PaperComparison]:
    """Hold series against the paper, each figure beside every series that it speaks of and that has data."""
    series = list(series)
    found = []
    for reference in references:
        for one in series:
            if reference.clusters is not None and one.clusters != reference.clusters:
                continue
            if reference.speed_kmh is not None and one.speed_kmh != reference.speed_kmh:
                continue
            tally, at = one.between(reference.from_m, reference.to_m), (reference.from_m, reference.to_m)
            if reference.bound:
                tally, at = _worst(one, reference)
            ours = measure(tally, reference.measure)
            if ours.count:
                ratio = ours.value / reference.value
                agrees = ratio <= 1 if reference.bound else abs(ratio - 1) <= AGREEMENT
                found.append(PaperComparison(reference, one.name, ours, *at, agrees))
    return found


def _worst(series: Series, reference: Reference) -> tuple[Tally, tuple[int, int]]:
    """The segment within a reference's distances whose figure is largest, and where it lies."""
    worst, at = Tally(), (reference.from_m, reference.to_m)
    for begin in range(reference.from_m, reference.to_m, SEGMENT_M):
        tally = series.between(begin, begin + SEGMENT_M)
        value, most = (measure(t, reference.measure) for t in (tally, worst))
        if value.count and (not most.count or value.value > most.value):
            worst, at = tally, (begin, begin + SEGMENT_M)
    return worst, at


def reference_marks(kind: Measure) -> list[Reference]:
    """The paper's figures of one measure."""
    return [reference for reference in PAPER if reference.measure == kind]
