"""Variants of the receiver side by side: what each gave, who is best, and how it is written down."""

import csv
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from markupsafe import Markup

from evlcp_sdk.files import escape_formula
from evlcp_sdk.report.pages import render_page
from evlcp_sdk.stopwatch import times_real_time
from evlcp_sdk.study.intervals import FEWEST_RECORDINGS, Figure, measure, number_text
from evlcp_sdk.study.summary import Series, Summary
from evlcp_sdk.study.tally import Statistics, Tally, known

STAGES = ("separation", "decoding", "ranging")
"""The stages that every frame goes through, and whose time is measured."""


@dataclass(frozen=True)
class Times:
    """What one variant's work took; adds over recordings.

    Attributes:
        frame_us: Time of every frame in the stages `STAGES` together, us; of each stage: `stage_us`.
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
        recordings: By name, what was counted of what shares nothing with the others: a recording, or all of a
            campaign's with one seed. Without truth, nothing but rows and packets.
        times: What it took; nothing where nobody measured.
    """

    recordings: Mapping[str, Statistics] = field(default_factory=dict)
    times: Times = field(default_factory=Times)

    def __add__(self, other: "Measured") -> "Measured":
        together = dict(self.recordings)
        for name, one in other.recordings.items():
            together[name] = together.get(name, Statistics()) + one
        return Measured(together, self.times + other.times)

    @cached_property
    def statistics(self) -> Statistics:
        """All recordings together."""
        return sum(self.recordings.values(), Statistics())

    @cached_property
    def tally(self) -> Tally:
        """The tally of all distances."""
        return self.statistics.total()

    @cached_property
    def ber(self) -> Figure:
        """The bit error rate with its interval over recordings."""
        return measure([one.total() for one in self.recordings.values()], "ber")

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


BOUND_NAME = "Cramer-Rao bound"
"""Name of the reference row."""

MARK = "*"
"""Follows the best figure of a column, where bold type may be lost."""

_LEGEND = {
    "ber": "BER is of the symbols that are given",
    "ber_interval": "its 95 % interval is a bootstrap over recordings, from "
    f"{FEWEST_RECORDINGS} on, and < an upper limit, as if frames were independent",
    "filtered_rmse_m": "filtered is the RMSE after tracking",
    "sigma_m": "sigma is what the ranging itself states, root mean square",
    "us_per_frame": "us/frame is the median processor time of separation, decoding and ranging",
    "times_real_time": "x real time is recorded time over the processor time of reading and receiving",
}
"""What has to be known of a column, by its key."""


@dataclass(frozen=True)
class Column:
    """A column of the table.

    Attributes:
        key: Name of the figure, as in JSON and CSV.
        title: Heading.
        cell: The figure as text; `-` where it was not measured.
        rank: The smallest is the best; None where there is no best.
    """

    key: str
    title: str
    cell: Callable[[Measured], str]
    rank: Callable[[Measured], float] | None


def _frames(m: Measured) -> str:
    tally = m.tally
    return f"{tally.frames_found}/{tally.frames_sent}" if tally.frames_sent else str(m.statistics.rows)


def _ber(m: Measured) -> str:
    return number_text(m.tally.ber, ".1e") if m.tally.bit_errors else "-" if not m.tally.bits else "0"


def _interval(m: Measured) -> str:
    ber = m.ber
    if ber.none:
        return f"< {ber.high:.1e}"
    return ber.interval(".1e") if ber.recordings >= FEWEST_RECORDINGS else "-"


def _some(count: int, of: int) -> str:
    return f"{count / of:.1%}" if count else "-"


def _gross(m: Measured) -> str:
    return f"{m.tally.gross_share:.1%} ({m.tally.gross})" if m.tally.ranged else "-"


COLUMNS = (
    # Who finds none is not the best of those.
    Column("found_share", "frames", _frames, lambda m: -m.tally.found_share or math.nan),
    Column("packets", "packets", lambda m: str(m.statistics.packets), None),
    Column("ber", "BER", _ber, lambda m: m.tally.ber),
    Column("ber_interval", "95 %", _interval, None),
    Column("erased_share", "erased", lambda m: _some(m.tally.erased, m.tally.visible), None),
    Column("claimed_share", "claimed", lambda m: _some(m.tally.claimed, m.tally.hidden), None),
    Column("rmse_m", "RMSE, m", lambda m: number_text(m.tally.rmse_m, ".4f"), lambda m: m.tally.rmse_m),
    Column("bias_m", "bias, m", lambda m: number_text(m.tally.bias_m, "+.4f"), lambda m: abs(m.tally.bias_m)),
    Column("gross_share", ">= 0.5 m", _gross, lambda m: m.tally.gross_share),
    Column(
        "filtered_rmse_m",
        "filtered, m",
        lambda m: number_text(m.tally.filtered_rmse_m, ".4f"),
        lambda m: m.tally.filtered_rmse_m,
    ),
    Column("sigma_m", "sigma, m", lambda m: number_text(m.statistics.sigma_m, ".4f"), None),
    Column(
        "us_per_frame", "us/frame", lambda m: number_text(m.us_per_frame, ".0f"), lambda m: m.us_per_frame
    ),
    Column(
        "times_real_time",
        "x real time",
        lambda m: number_text(m.times_real_time, ".2f"),
        lambda m: -m.times_real_time,
    ),
)
"""The columns, in order; BER's interval decides nothing."""


@dataclass(frozen=True)
class Table:
    """What each variant gave, by its name, on one recording, or on all of the other tables together.

    `bounds_m` are the frames' Cramer-Rao bounds, m.
    """

    name: str
    rows: Mapping[str, Measured]
    bounds_m: tuple[float, ...] = ()
    together: bool = False

    def best(self) -> tuple[frozenset[str], ...]:
        """Of each row, the keys of the columns in which it is the best, or as good as the best.

        Where fewer than two rows have a figure, none is.
        """
        found: list[set[str]] = [set() for _ in self.rows]
        for column in COLUMNS:
            if column.rank is None:
                continue
            ranks = [column.rank(measured) for measured in self.rows.values()]
            known = [rank for rank in ranks if not math.isnan(rank)]
            if len(known) > 1:
                for keys, rank in zip(found, ranks, strict=True):
                    if rank == min(known):
                        keys.add(column.key)
        return tuple(map(frozenset, found))

    def columns(self) -> list["Column"]:
        """Those that have a figure of any row."""
        return [c for c in COLUMNS if any(c.cell(measured) != "-" for measured in self.rows.values())]

    def cells(self) -> tuple[list[str], list[list[tuple[str, bool]]]]:
        """Headings, and of each row the cells as (text, is best); columns without any figure are left out.

        The best have a mark behind; the last row is the bound, if there is one.
        """
        best, columns = self.best(), self.columns()
        lines = []
        for (name, measured), keys in zip(self.rows.items(), best, strict=True):
            line = [(name, False)]
            for column in columns:
                is_best = column.key in keys
                line.append((column.cell(measured) + (MARK if is_best else ""), is_best))
            lines.append(line)
        if self.bounds_m:
            bound = [number_text(rms(self.bounds_m), ".4f") if c.key == "rmse_m" else "" for c in columns]
            lines.append([(text, False) for text in (BOUND_NAME, *bound)])
        return ["variant", *(c.title for c in columns)], lines

    def records(self) -> list[dict[str, Any]]:
        """Every figure of each row as plain values; None where it was not measured."""
        found = []
        for (name, m), keys in zip(self.rows.items(), self.best(), strict=True):
            tally, truth = m.tally, m.tally.frames_sent > 0
            low, high = (m.ber.low, m.ber.high) if _interval(m) != "-" else (math.nan, math.nan)
            values: dict[str, Any] = {
                "recording": self.name,
                "variant": name,
                "frames": m.statistics.rows,
                "frames_sent": tally.frames_sent if truth else None,
                "frames_found": tally.frames_found if truth else None,
                "found_share": tally.found_share,
                "unmatched": m.statistics.unmatched if truth else None,
                "echoes": m.statistics.echoes,
                "packets": m.statistics.packets,
                "bits": tally.bits,
                "bit_errors": tally.bit_errors if tally.bits else None,
                "ber": tally.ber,
                "ber_low": low,
                "ber_high": high,
                "erased_share": tally.erased_share,
                "claimed_share": tally.claimed_share,
                "ranged": tally.ranged,
                "rmse_m": tally.rmse_m,
                "bias_m": tally.bias_m,
                "nees": tally.nees,
                "gross": tally.gross if tally.ranged else None,
                "gross_share": tally.gross_share,
                "filtered_rmse_m": tally.filtered_rmse_m,
                "sigma_m": m.statistics.sigma_m,
                "us_per_frame": m.us_per_frame,
                **{f"{stage}_us": median(m.times.stage_us[stage]) for stage in STAGES},
                "recorded_s": m.times.recorded_s,
                "cpu_s": m.times.cpu_s or None,
                "times_real_time": m.times_real_time,
                "cramer_rao_bound_m": rms(self.bounds_m),
                "best": sorted(keys),
            }
            found.append({key: known(value) for key, value in values.items()})
        return found


@dataclass(frozen=True)
class Comparison:
    """All tables.

    Attributes:
        variants: Name to what sets it apart, with digest and resolved table.
        tables: One per recording; over all, the last, where there are several.
        notes: What a reader must know.
        each: What a table is of, in a word.
    """

    variants: Mapping[str, Mapping[str, Any]]
    tables: tuple[Table, ...]
    notes: tuple[str, ...]
    versions: Mapping[str, Any]
    each: str = "recording"

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON values; what was not measured is null."""
        return {
            "variants": {name: dict(values) for name, values in self.variants.items()},
            "rows": [record for one in self.tables for record in one.records()],
            "notes": list(self.notes),
            "versions": dict(self.versions),
        }

    def to_json(self) -> str:
        """`to_dict` as text."""
        return json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n"

    def to_csv(self) -> str:
        """A line a variant and recording; `best` names its best figures, parted by spaces."""
        records = [record for one in self.tables for record in one.records()]
        out = io.StringIO()
        writer = csv.DictWriter(out, list(records[0]) if records else [], lineterminator="\n")
        writer.writeheader()
        for record in records:
            row = record | {"best": " ".join(record["best"])}
            writer.writerow({k: escape_formula(v) if isinstance(v, str) else v for k, v in row.items()})
        return out.getvalue()

    @property
    def legend(self) -> str:
        """What the columns are that the tables have."""
        present = {column.key for one in self.tables for column in one.columns()}
        notes = [text for key, text in _LEGEND.items() if key in present]
        if any(keys for one in self.tables for keys in one.best()):
            notes.insert(0, f"{MARK} is the best of its column")
        return "; ".join(notes) + "."

    @property
    def title(self) -> str:
        """Which variants are compared, on what."""
        *most, last = self.variants
        names = f"{', '.join(most)} and {last}" if most else last
        each = [one.name for one in self.tables if not one.together]
        return f"{names} on {each[0] if len(each) == 1 else f'{len(each)} {self.each}s'}"

    def to_html(self) -> str:
        """One self-contained page: first the table of all."""
        tables = []
        for one in sorted(self.tables, key=lambda one: not one.together):
            head, lines = one.cells()
            bold = Markup("<b>{}</b>").format
            rows = [[bold(text) if best else text for text, best in row] for row in lines]
            tables.append((one.name, head, rows))
        title = f"Variants compared: {self.title}"
        return render_page("comparison.html", title, comparison=self, tables=tables)


def total_of(tables: Sequence[Table], name: str = "all") -> Table:
    """The table of all recordings together; they have the same variants."""
    rows = {variant: sum((one.rows[variant] for one in tables), Measured()) for variant in tables[0].rows}
    bounds_m = tuple(bound for one in tables for bound in one.bounds_m)
    return Table(name, rows, bounds_m, together=True)


def of_campaign(summary: Summary) -> Comparison:
    """The links of a campaign as variants, with a table per scene.

    Time, which a campaign does not keep, has no column; nor is there a bound, which needs the events.
    """
    links: dict[str, Mapping[str, Any]] = {}
    scenes: dict[str, dict[str, Measured]] = {}
    for series in summary.series:
        scene, link = _part(series, "scene.", "the scene"), _part(series, "link.", "the link")
        labels = {k: v for k, v in series.labels.items() if k.startswith("link.")}
        settings = [f"{k.removeprefix('link.')}={v}" for k, v in labels.items()]
        identity = series.link if isinstance(series.link, Mapping) else {}
        about = {"digest": identity.get("digest", ""), "configuration": identity.get("table", {})}
        links[link] = {"settings": settings, **about}
        recordings = {f"seed {i}": one for i, one in enumerate(series.recordings)}
        rows = scenes.setdefault(scene, {})
        rows[link] = rows.get(link, Measured()) + Measured(recordings)
    tables = [Table(name, rows) for name, rows in scenes.items()]
    notes = [f"campaign {summary.plan.name}, {summary.plan.digest}"]
    if len({tuple(table.rows) for table in tables}) > 1:
        notes.append("not every link receives every scene, so that there is no table of all scenes")
    elif len(tables) > 1:
        tables.append(total_of(tables, "all scenes"))
    if summary.done < summary.tasks:
        notes.append(f"{summary.done} of {summary.tasks} tasks are done")
    return Comparison(links, tuple(tables), tuple(notes), summary.plan.environment, "scene")


def _part(series: Series, prefix: str, otherwise: str) -> str:
    """The name that a series has by the labels of its scene or of its link."""
    labels = {key: value for key, value in series.labels.items() if key.startswith(prefix)}
    return replace(series, labels=labels).name if labels else otherwise
