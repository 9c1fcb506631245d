"""One self-contained page of a campaign: charts that answer the pointer, tables, configuration, digests.

Needs the extra `report`. The page holds everything it shows, the charting library included, and asks no
network for anything.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.study.campaign.charts import Chart, charts_of, decades
from evlcp_sdk.study.campaign.paper import PAPER_NAME
from evlcp_sdk.study.campaign.plan import digest_of
from evlcp_sdk.study.campaign.summary import PaperComparison, Summary, beside_paper
from evlcp_sdk.study.intervals import INTERVALS, Figure, measure
from evlcp_sdk.study.markup import Markup, details, document, escape, table
from evlcp_sdk.study.tally import SEGMENT_M, Tally

__all__ = ["comparison_rows", "page"]

_INK = "#333333"


def page(summary: Summary) -> str:
    """The page's HTML.

    Raises:
        ConfigError: The extra is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as fault:
        raise ConfigError("a report needs the extra: pip install 'evlcp-sdk[report]'") from fault
    charts = charts_of(summary)
    statistics = [one.statistics for one in summary.series]
    events, seconds = sum(s.events for s in statistics), sum(s.duration_us for s in statistics) * 1e-6
    part = (
        f"{summary.done} of {summary.tasks} tasks"
        if summary.done < summary.tasks
        else f"{summary.done} tasks"
    )
    body = [
        Markup("<h1>{}</h1>").format(summary.name),
        Markup("<p>{}, {} s received, {} million events.</p>").format(
            part, f"{seconds:,.1f}", f"{events / 1e6:,.1f}"
        ),
    ]
    for chart in charts:
        body.append(Markup('<h2>{}</h2><div class="chart" id="{}"></div>').format(chart.title, chart.id))
        body.append(Markup('<p class="note">{}</p>').format(chart.note))
    body += [_paper_table(beside_paper(summary.series)), _figures_table(summary), _configuration(summary)]
    drawn = {chart.id: _plotly(chart) for chart in charts}
    return document(summary.name, body, (get_plotlyjs(), _SCRIPT), {_DATA: drawn})


_DATA = "charts"
_SCRIPT = f"""
const charts = JSON.parse(document.getElementById("{_DATA}").textContent);
// The library would offer to upload a chart.
const config = {{displaylogo: false, responsive: true, showSendToCloud: false, plotlyServerURL: ""}};
for (const [id, c] of Object.entries(charts)) Plotly.newPlot(id, c.data, c.layout, config);
"""


def _plotly(chart: Chart) -> dict[str, Any]:
    """What the library draws; it takes texts for HTML of its own kind, so ours are escaped."""
    data: list[dict[str, Any]] = []
    for line in chart.lines:
        trace: dict[str, Any] = {
            "type": "scatter",
            "name": str(escape(line.name)),
            "x": [round(d.x, 6) for d in line.dots],
            "y": [d.y for d in line.dots],
            "text": [d.text for d in line.dots],
            "hovertemplate": "%{text}<extra></extra>",
            "line": {"color": line.colour, "dash": line.dash, "width": 1.6},
        }
        if chart.steps:
            trace |= {"mode": "lines", "line": trace["line"] | {"shape": "hvh"}}
        else:
            trace |= {
                "mode": "lines+markers",
                "marker": {
                    "size": 8,
                    "symbol": ["triangle-down-open" if d.limit else line.symbol for d in line.dots],
                },
                "error_y": {
                    "type": "data",
                    "symmetric": False,
                    "array": [0 if d.limit else d.high - d.y for d in line.dots],
                    "arrayminus": [0 if d.limit else d.y - d.low for d in line.dots],
                    "thickness": 1.2,
                    "width": 3,
                },
            }
        data.append(trace)
    named: set[str] = set()
    for mark in chart.marks:
        middle = (mark.x0 + mark.x1) / 2
        said = f"{mark.name}<br>{mark.x0:g} to {mark.x1:g} m: {'at most ' if mark.bound else ''}{mark.y:g}"
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": mark.name,
                "legendgroup": mark.name,
                "showlegend": mark.name not in named,
                "x": [mark.x0, middle, mark.x1],
                "y": [mark.y] * 3,
                "text": [said] * 3,
                "hovertemplate": "%{text}<extra></extra>",
                "line": {
                    "color": _INK,
                    "width": 2 if mark.bound else 4,
                    "dash": "dash" if mark.clusters == 2 else "solid",
                },
            }
        )
        named.add(mark.name)
    axis = {"gridcolor": "#e6e6e6", "linecolor": "#999999", "zeroline": False, "ticks": "outside"}
    y_axis = axis | {"title": {"text": chart.y_label}}
    if chart.log_y:
        y_axis |= {"type": "log", "minor": {"showgrid": True, "gridcolor": "#f2f2f2"}}
        narrow = decades(chart) < 2
        y_axis |= {"dtick": "D2", "tickformat": "~g"} if narrow else {"dtick": 1, "exponentformat": "power"}
    else:
        y_axis |= {"rangemode": "tozero"}
    layout = {
        "margin": {"l": 70, "r": 20, "t": 34, "b": 50},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "font": {"color": _INK},
        "hovermode": "closest",
        "xaxis": axis | {"title": {"text": chart.x_label}},
        "yaxis": y_axis,
    }
    return {"data": data, "layout": layout}


def _paper_table(comparisons: Sequence[PaperComparison]) -> Markup:
    if not comparisons:
        return Markup("")
    rows = []
    for cells, one in zip(comparison_rows(comparisons), comparisons, strict=True):
        agrees = Markup('<span class="{}">{}</span>').format("yes" if one.agrees else "no", cells[-1])
        rows.append([*cells[:-1], agrees])
    note = (
        "A bound agrees when the worst segment of 10 m keeps it, a figure when ours lies within 30 % of it."
    )
    return Markup('<h2>{}</h2>{}<p class="note">{}</p>').format(
        f"Beside {PAPER_NAME}",
        table(("figure", "distance", "series", "paper", "here", "95 %", "agrees"), rows),
        note,
    )


_MEASURES = {"ber": "bit error rate", "rmse_m": "distance RMSE, m", "gross_share": "errors of 0.5 m or more"}


def comparison_rows(comparisons: Iterable[PaperComparison]) -> list[tuple[str, ...]]:
    """Figure, distance, series, paper, here, its interval, and whether they agree, as text."""
    rows: list[tuple[str, ...]] = []
    for one in comparisons:
        r, percent = one.reference, one.reference.measure == "gross_share"
        wide = (r.from_m, r.to_m) != (one.from_m, one.to_m)

        def shown(value: float, percent: bool = percent) -> str:
            return f"{value:.2%}" if percent else f"{value:.3g}"

        rows.append(
            (
                _MEASURES[r.measure],
                f"{r.from_m} to {r.to_m} m",
                one.series,
                ("at most " if r.bound else "") + shown(r.value),
                shown(one.ours.value) + (f" at {one.from_m} to {one.to_m} m" if wide else ""),
                one.ours.interval(".2%" if percent else ".3g") or "-",
                "yes" if one.agrees else "no",
            )
        )
    return rows


def _figures_table(summary: Summary) -> Markup:
    messages = any(t.messages_sent for one in summary.series for _, t in one.statistics.segments)
    positions = any(t.fixes or t.fixes_refused for one in summary.series for _, t in one.statistics.segments)
    rows = []
    for one in summary.series:
        for begin, recordings in one.segments:
            tally = Tally.together(recordings)
            rows.append(
                (
                    one.name,
                    f"{begin} to {begin + SEGMENT_M} m",
                    f"{tally.frames_found} of {tally.frames_sent}",
                    f"{tally.bit_errors} of {tally.bits}",
                    _shown(measure(recordings, "ber"), ".2g"),
                    _shown(measure(recordings, "rmse_m"), ".3f"),
                    "-" if math.isnan(tally.bias_m) else f"{tally.bias_m:+.3f}",
                    _shown(measure(recordings, "gross_share"), ".2%"),
                    *((f"{tally.messages_found} of {tally.messages_sent}",) if messages else ()),
                    *((f"{tally.messages_wrong}",) if messages else ()),
                    *(_positions(recordings) if positions else ()),
                )
            )
    head = (
        *("series", "distance", "frames", "bit errors", "BER", "RMSE, m", "bias, m", "0.5 m or more"),
        *(("messages", "read wrong") if messages else ()),
        *(_POSITION_HEAD if positions else ()),
    )
    return Markup('<h2>All figures</h2><p class="note">{}</p>{}').format(INTERVALS, table(head, rows))


_POSITION_HEAD = ("positions", "RMSE in space, m", "half within, m", "95 % within, m", "NEES, ideally 3")


def _positions(recordings: Sequence[Tally]) -> tuple[str, ...]:
    """Positions given of those due, and their errors, as text."""
    tally = Tally.together(recordings)
    if not tally.fixes:
        return (f"0 of {tally.fixes_refused}", *4 * ("-",))
    return (
        f"{tally.fixes} of {tally.fixes + tally.fixes_refused}",
        _shown(measure(recordings, "position_rmse_m"), ".3f"),
        f"{tally.position_quantile_m(0.5):.3f}",
        f"{tally.position_quantile_m(0.95):.3f}",
        f"{tally.position_nees:.2f}",
    )


def _shown(figure: Figure, form: str) -> str:
    if not figure.count:
        return "-"
    return Markup('{} <span class="note">{}</span>').format(f"{figure.value:{form}}", figure.interval(form))


def _configuration(summary: Summary) -> Markup:
    plan, rule = summary.plan, summary.plan.rule
    head = Markup(
        '<h2>Configuration and digests</h2>\n<p class="digest">campaign {}</p>\n'
        "<p>Seeds {} to {}; a point ends at {} or {}.</p>"
    )
    ends = (_limit(rule.max_bits, "bits"), _limit(rule.max_errors, "wrong bits"))
    parts = [
        head.format(summary.digest, plan.seeds[0], plan.seeds[-1], *ends),
        details("code and versions", plan.environment),
    ]
    for kind, cases in (("scene", plan.scenes), ("link", plan.links)):
        for case in cases:
            labels = ", ".join(f"{k} {v}" for k, v in case.labels.items()) or "the only one"
            identity = case.identity
            digest = (
                identity["digest"]
                if isinstance(identity, dict) and "digest" in identity
                else digest_of(identity)
            )
            parts.append(details(f"{kind}: {labels}; SHA-256 {digest}", identity))
    return Markup("\n").join(parts)


def _limit(value: int | None, what: str) -> str:
    return f"any number of {what}" if value is None else f"{value:,} {what}"
