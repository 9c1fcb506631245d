"""Variants of the receiver side by side: what each gave, which is best, and tables of it."""

import csv
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from markupsafe import Markup

from evlcp_sdk.files import escape_formula
from evlcp_sdk.formatting import value_or_none
from evlcp_sdk.report.pages import render_page
from evlcp_sdk.stopwatch import times_real_time
from evlcp_sdk.study.intervals import FEWEST_RECORDINGS, Figure, format_number, measure_figure
from evlcp_sdk.study.summary import Series, Summary
from evlcp_sdk.study.tally import Statistics, Tally

STAGES = ("separation", "decoding", "ranging")
"""The stages of every frame whose time is measured."""


@dataclass(frozen=True)
class Measurement:
    """Counts and times of one variant; adds over recordings.

    Attributes:
        recordings: Counts by the name of what is independent: a recording, or all of a campaign's with one
            seed. Without truth, only rows and packets.
        frames_us: Time of every frame in each of the stages `STAGES` that it went through, us.
        recorded_s: Duration of the recordings whose time was measured, s.
        cpu_s: Processor time for reading and receiving them, as of `Stopwatch`, s.
    """

    recordings: Mapping[str, Statistics] = field(default_factory=dict)
    frames_us: tuple[Mapping[str, float], ...] = ()
    recorded_s: float = 0.0
    cpu_s: float = 0.0

    def __add__(self, other: "Measurement") -> "Measurement":
        recordings = dict(self.recordings)
        for name, one in other.recordings.items():
            recordings[name] = recordings.get(name, Statistics()) + one
        return Measurement(
            recordings,
            self.frames_us + other.frames_us,
            self.recorded_s + other.recorded_s,
            self.cpu_s + other.cpu_s,
        )

    @cached_property
    def statistics(self) -> Statistics:
        """Sum of all recordings."""
        return sum(self.recordings.values(), Statistics())

    @cached_property
    def tally(self) -> Tally:
        """Tally of all distances."""
        return self.statistics.total()

    @cached_property
    def ber(self) -> Figure:
        """The bit error rate with its interval over recordings."""
        return measure_figure([one.total() for one in self.recordings.values()], "ber")

    @cached_property
    def figures(self) -> dict[str, Any]:
        """Every figure by its name in JSON and CSV; NaN or None where it was not measured."""
        tally, truth = self.tally, self.tally.frames_sent > 0
        has_interval = _interval_cell(self) != "-"
        return {
            "frames": self.statistics.rows,
            "frames_sent": tally.frames_sent if truth else None,
            "frames_found": tally.frames_found if truth else None,
            "found_share": tally.found_share,
            "unmatched": self.statistics.unmatched if truth else None,
            "echoes": self.statistics.echoes,
            "packets": self.statistics.packets,
            "bits": tally.bits,
            "bit_errors": tally.bit_errors if tally.bits else None,
            "ber": tally.ber,
            "ber_low": self.ber.low if has_interval else None,
            "ber_high": self.ber.high if has_interval else None,
            "erased_share": tally.erased_share,
            "claimed_share": tally.claimed_share,
            "ranged": tally.ranged,
            "rmse_m": tally.rmse_m,
            "bias_m": tally.bias_m,
            "nees": tally.nees,
            "gross": tally.gross if tally.ranged else None,
            "gross_share": tally.gross_share,
            "filtered_rmse_m": tally.filtered_rmse_m,
            "sigma_m": self.statistics.sigma_m,
            # Other work of the machine hardly changes a median.
            "us_per_frame": median([sum(frame.values()) for frame in self.frames_us]),
            **{f"{s}_us": median([frame[s] for frame in self.frames_us if s in frame]) for s in STAGES},
            "recorded_s": self.recorded_s,
            "cpu_s": self.cpu_s or None,
            "times_real_time": times_real_time(self.recorded_s, self.cpu_s),
        }


def median(values: Sequence[float]) -> float:
    """Median; NaN without values."""
    return float(np.median(values)) if values else math.nan


def rms(values: Sequence[float]) -> float:
    """Root mean square; NaN without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if values else math.nan


BOUND_NAME = "Cramer-Rao bound"
"""Name of the reference row."""

MARK = "*"
"""Marks the best figure of a column, where bold type may be lost."""

_LEGEND = {
    "ber": "BER is of the symbols that are given",
    "ber_interval": "its 95 % interval is a bootstrap over recordings, from "
    f"{FEWEST_RECORDINGS} on, and < an upper limit, as if frames were independent",
    "filtered_rmse_m": "filtered is the RMSE after tracking",
    "sigma_m": "sigma is what the ranging itself states, root mean square",
    "us_per_frame": "us/frame is the median processor time of separation, decoding and ranging",
    "times_real_time": "x real time is recorded time over the processor time of reading and receiving",
}
"""Explanations of columns, by key."""


@dataclass(frozen=True)
class Column:
    """A column of the table.

    Attributes:
        key: Name of the figure, as in JSON and CSV.
        title: Heading.
        form: Format of the figure, or what formats it.
        best: The smallest size of the figure is the best, or the largest; None for a column without a best.
    """

    key: str
    title: str
    form: str | Callable[[Measurement], str]
    best: Literal["least", "most"] | None = None

    def cell(self, measured: Measurement) -> str:
        """The text of a row; `-` where nothing was measured."""
        if callable(self.form):
            return self.form(measured)
        return format_number(measured.figures[self.key], self.form)

    def rank(self, measured: Measurement) -> float:
        """Rank of a row: the smallest is the best, NaN is not."""
        size = float(abs(measured.figures[self.key]))
        # A variant that finds none is not the best.
        return size if self.best == "least" else -size or math.nan


def _frames_cell(m: Measurement) -> str:
    tally = m.tally
    return f"{tally.frames_found}/{tally.frames_sent}" if tally.frames_sent else str(m.statistics.rows)


def _interval_cell(m: Measurement) -> str:
    ber = m.ber
    if ber.is_zero:
        return f"< {ber.high:.1e}"
    return ber.interval(".1e") if ber.recordings >= FEWEST_RECORDINGS else "-"


COLUMNS = (
    Column("found_share", "frames", _frames_cell, "most"),
    Column("packets", "packets", "d"),
    Column("ber", "BER", lambda m: "0" if m.ber.is_zero else format_number(m.ber.value, ".1e"), "least"),
    Column("ber_interval", "95 %", _interval_cell),
    Column("erased_share", "erased", lambda m: f"{m.tally.erased_share:.1%}" if m.tally.erased else "-"),
    Column("claimed_share", "claimed", lambda m: f"{m.tally.claimed_share:.1%}" if m.tally.claimed else "-"),
    Column("rmse_m", "RMSE, m", ".4f", "least"),
    Column("bias_m", "bias, m", "+.4f", "least"),
    Column(
        "gross_share",
        ">= 0.5 m",
        lambda m: f"{m.tally.gross_share:.1%} ({m.tally.gross})" if m.tally.ranged else "-",
        "least",
    ),
    Column("filtered_rmse_m", "filtered, m", ".4f", "least"),
    Column("sigma_m", "sigma, m", ".4f"),
    Column("us_per_frame", "us/frame", ".0f", "least"),
    Column("times_real_time", "x real time", ".2f", "most"),
)
"""The columns, in order."""


@dataclass(frozen=True)
class Table:
    """What each variant gave, by name, on one recording, or on all of the other tables together.

    `bounds_m` are the frames' Cramer-Rao bounds, m.
    """

    name: str
    rows: Mapping[str, Measurement]
    bounds_m: tuple[float, ...] = ()
    is_total: bool = False

    def find_best(self) -> tuple[frozenset[str], ...]:
        """Find the keys of the columns in which each row is the best, also jointly.

        A column in which fewer than two rows have a figure has no best.
        """
        ranked = [column for column in COLUMNS if column.best is not None]
        ranks = np.array([[column.rank(measured) for column in ranked] for measured in self.rows.values()])
        is_best = (ranks == np.fmin.reduce(ranks)) & (np.isfinite(ranks).sum(0) > 1)
        return tuple(frozenset(c.key for c, best in zip(ranked, row, strict=True) if best) for row in is_best)

    def list_columns(self) -> list["Column"]:
        """List the columns in which any row has a figure."""
        return [c for c in COLUMNS if any(c.cell(measured) != "-" for measured in self.rows.values())]

    def format_rows(self) -> tuple[list[str], list[list[tuple[str, bool]]]]:
        """Headings, and of each row the cells as (text, is best); columns without any figure are left out.

        The best are marked; the last row is the bound, if there is one.
        """
        best, columns = self.find_best(), self.list_columns()
        lines = []
        for (name, measured), keys in zip(self.rows.items(), best, strict=True):
            line = [(name, False)]
            for column in columns:
                is_best = column.key in keys
                line.append((column.cell(measured) + (MARK if is_best else ""), is_best))
            lines.append(line)
        if self.bounds_m:
            bound = [format_number(rms(self.bounds_m), ".4f") if c.key == "rmse_m" else "" for c in columns]
            lines.append([(text, False) for text in (BOUND_NAME, *bound)])
        return ["variant", *(c.title for c in columns)], lines

    def to_records(self) -> list[dict[str, Any]]:
        """Every figure of each row as plain values; None where it was not measured."""
        records = []
        for (name, m), keys in zip(self.rows.items(), self.find_best(), strict=True):
            values: dict[str, Any] = {
                "recording": self.name,
                "variant": name,
                **m.figures,
                "cramer_rao_bound_m": rms(self.bounds_m),
                "best": sorted(keys),
            }
            records.append({key: value_or_none(value) for key, value in values.items()})
        return records


@dataclass(frozen=True)
class Comparison:
    """All tables.

    Attributes:
        variants: Settings of each variant by name, with digest and resolved table.
        tables: One per recording; if there are several, the last is of all.
        notes: For the reader.
        table_kind: What a table is of, in a word.
    """

    variants: Mapping[str, Mapping[str, Any]]
    tables: tuple[Table, ...]
    notes: tuple[str, ...]
    versions: Mapping[str, Any]
    table_kind: str = "recording"

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON values; what was not measured is null."""
        return {
            "variants": {name: dict(values) for name, values in self.variants.items()},
            "rows": [record for one in self.tables for record in one.to_records()],
            "notes": list(self.notes),
            "versions": dict(self.versions),
        }

    def to_json(self) -> str:
        """`to_dict` as text."""
        return json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n"

    def to_csv(self) -> str:
        """One line per variant and recording; `best` names its best figures, separated by spaces."""
        records = [record for one in self.tables for record in one.to_records()]
        out = io.StringIO()
        writer = csv.DictWriter(out, list(records[0]) if records else [], lineterminator="\n")
        writer.writeheader()
        for record in records:
            row = record | {"best": " ".join(record["best"])}
            writer.writerow({k: escape_formula(v) if isinstance(v, str) else v for k, v in row.items()})
        return out.getvalue()

    @property
    def legend(self) -> str:
        """Explanations of the columns that the tables have."""
        present = {column.key for one in self.tables for column in one.list_columns()}
        notes = [text for key, text in _LEGEND.items() if key in present]
        if any(keys for one in self.tables for keys in one.find_best()):
            notes.insert(0, f"{MARK} is the best of its column")
        return "; ".join(notes) + "."

    @property
    def title(self) -> str:
        """The variants, and what they are compared on."""
        *most, last = self.variants
        names = f"{', '.join(most)} and {last}" if most else last
        each = [one.name for one in self.tables if not one.is_total]
        return f"{names} on {each[0] if len(each) == 1 else f'{len(each)} {self.table_kind}s'}"

    def to_html(self) -> str:
        """One self-contained page; the table of all comes first."""
        tables = []
        for one in sorted(self.tables, key=lambda one: not one.is_total):
            head, lines = one.format_rows()
            bold = Markup("<b>{}</b>").format
            rows = [[bold(text) if best else text for text, best in row] for row in lines]
            tables.append((one.name, head, rows))
        title = f"Variants compared: {self.title}"
        return render_page("comparison.html", title, comparison=self, tables=tables)


def total_of(tables: Sequence[Table], name: str = "all") -> Table:
    """Sum of tables with the same variants."""
    rows = {variant: sum((one.rows[variant] for one in tables), Measurement()) for variant in tables[0].rows}
    bounds_m = tuple(bound for one in tables for bound in one.bounds_m)
    return Table(name, rows, bounds_m, is_total=True)


def compare_links(summary: Summary) -> Comparison:
    """Compare the links of a campaign as variants, with a table per scene.

    Times and bounds, which a campaign does not keep, have no column.
    """
    links: dict[str, Mapping[str, Any]] = {}
    scenes: dict[str, dict[str, Measurement]] = {}
    for series in summary.series:
        scene, link = _name_part(series, "scene.", "the scene"), _name_part(series, "link.", "the link")
        labels = {k: v for k, v in series.labels.items() if k.startswith("link.")}
        settings = [f"{k.removeprefix('link.')}={v}" for k, v in labels.items()]
        identity = series.link if isinstance(series.link, Mapping) else {}
        resolved = {"digest": identity.get("digest", ""), "configuration": identity.get("table", {})}
        links[link] = {"settings": settings} | resolved
        recordings = {f"seed {i}": one for i, one in enumerate(series.recordings)}
        rows = scenes.setdefault(scene, {})
        rows[link] = rows.get(link, Measurement()) + Measurement(recordings)
    tables = [Table(name, rows) for name, rows in scenes.items()]
    notes = [f"campaign {summary.plan.name}, {summary.plan.digest}"]
    received = {tuple(link for link, row in one.rows.items() if row.statistics.tasks) for one in tables}
    if len(received - {()}) > 1:
        notes.append("not every link receives every scene, so that there is no table of all scenes")
    elif len(tables) > 1:
        tables.append(total_of(tables, "all scenes"))
    if summary.done < summary.tasks:
        notes.append(f"{summary.done} of {summary.tasks} tasks are done")
    return Comparison(links, tuple(tables), tuple(notes), summary.plan.environment, "scene")


def _name_part(series: Series, prefix: str, default: str) -> str:
    """Name of a series by the labels of its scene or of its link alone."""
    labels = {key: value for key, value in series.labels.items() if key.startswith(prefix)}
    return replace(series, labels=labels).name if labels else default
