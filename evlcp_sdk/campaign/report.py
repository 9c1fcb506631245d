"""One self-contained page of a campaign: charts that answer the pointer, tables, configuration, digests.

Needs the extra `report`. The page holds everything it shows, the charting library included, and asks no
network for anything.
"""

import html
import json
import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from evlcp_sdk.campaign.charts import Chart, charts_of, decades
from evlcp_sdk.campaign.paper import PAPER_NAME
from evlcp_sdk.campaign.plan import digest_of
from evlcp_sdk.campaign.statistics import SEGMENT_M
from evlcp_sdk.campaign.summary import Comparison, Figure, Summary, compare, measure
from evlcp_sdk.errors import ConfigError, EvlcpError

__all__ = ["comparison_rows", "page", "save_page"]

_INK = "#333333"
_CSS = """
body { font: 15px/1.5 system-ui, sans-serif; color: #333; max-width: 70rem; margin: 2rem auto;
  padding: 0 1rem }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin: 2.5rem 0 0.3rem }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.87rem; margin: 0.6rem 0 }
th, td { padding: 0.15rem 0.7rem; text-align: right; border-bottom: 1px solid #e6e6e6; white-space: nowrap }
th { color: #666; font-weight: 600 } td:first-child, th:first-child { text-align: left }
.chart { height: 430px } .note, .digest { color: #666; font-size: 0.87rem }
.digest { overflow-wrap: anywhere }
.yes { color: #00694b } .no { color: #a03c00; font-weight: 600 } .wide { overflow-x: auto }
pre { background: #f6f6f6; padding: 0.7rem; overflow-x: auto; font-size: 0.8rem } summary { cursor: pointer }
"""


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
        f"<h1>{html.escape(summary.name)}</h1>",
        f"<p>{part}, {seconds:,.1f} s received, {events / 1e6:,.1f} million events.</p>",
    ]
    for chart in charts:
        body.append(f'<h2>{html.escape(chart.title)}</h2><div class="chart" id="{chart.id}"></div>')
        body.append(f'<p class="note">{html.escape(chart.note)}</p>')
    body += [_paper_table(compare(summary.series)), _figures_table(summary), _configuration(summary)]
    drawn = {chart.id: _plotly(chart) for chart in charts}
    # "</" would end the script element.
    data = json.dumps(drawn, allow_nan=False).replace("</", "<\\/")
    script = (
        f"const charts = {data};\n"
        # The library would offer to upload a chart.
        "const config = {displaylogo: false, responsive: true,"
        " showSendToCloud: false, plotlyServerURL: ''};\n"
        "for (const [id, c] of Object.entries(charts)) Plotly.newPlot(id, c.data, c.layout, config);"
    )
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<link rel="icon" href="data:,">',
            f"<title>{html.escape(summary.name)}</title>\n<style>{_CSS}</style>",
            f"<script>{get_plotlyjs()}</script>\n</head>\n<body>",
            *body,
            f"<script>\n{script}\n</script>\n</body>\n</html>\n",
        ]
    )


def save_page(summary: Summary, path: Path) -> None:
    """Write the page; an earlier one stays until the new one is complete.

    Raises:
        ConfigError: The extra is not installed.
        EvlcpError: The file cannot be written.
    """
    text = page(summary)
    part = path.parent / f".{path.name}.{os.getpid()}.part"
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as fault:
        raise EvlcpError(f"{path}: cannot be written: {fault.strerror}") from fault
    finally:
        part.unlink(missing_ok=True)


def _plotly(chart: Chart) -> dict[str, Any]:
    data: list[dict[str, Any]] = []
    for line in chart.lines:
        trace: dict[str, Any] = {
            "type": "scatter",
            "name": line.name,
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


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    def cells(tag: str, values: Sequence[str]) -> str:
        return "".join(f"<{tag}>{v}</{tag}>" for v in values)

    lines = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{cells("th", head)}</tr>\n{lines}</table></div>'


def _paper_table(comparisons: Sequence[Comparison]) -> str:
    if not comparisons:
        return ""
    rows = []
    for cells, one in zip(comparison_rows(comparisons), comparisons, strict=True):
        kind = "yes" if one.agrees else "no"
        rows.append([*map(html.escape, cells[:-1]), f'<span class="{kind}">{html.escape(cells[-1])}</span>'])
    return (
        f"<h2>Beside {PAPER_NAME}</h2>"
        + _table(("figure", "distance", "series", "paper", "here", "95 %", "agrees"), rows)
        + '<p class="note">A bound agrees when the worst segment of 10 m keeps it, a figure when ours lies'
        " within 30 % of it.</p>"
    )


_MEASURES = {"ber": "bit error rate", "rmse_m": "distance RMSE, m", "gross_share": "errors of 0.5 m or more"}


def comparison_rows(comparisons: Iterable[Comparison]) -> list[tuple[str, ...]]:
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
                f"{shown(one.ours.low)} to {shown(one.ours.high)}",
                "yes" if one.agrees else "no",
            )
        )
    return rows


def _figures_table(summary: Summary) -> str:
    rows = []
    for one in summary.series:
        for begin, tally in one.statistics.segments:
            rows.append(
                (
                    html.escape(one.name),
                    f"{begin} to {begin + SEGMENT_M} m",
                    f"{tally.frames_found} of {tally.frames_sent}",
                    f"{tally.bit_errors} of {tally.bits}",
                    _shown(measure(tally, "ber"), "{:.2g}"),
                    _shown(measure(tally, "rmse_m"), "{:.3f}"),
                    "-" if math.isnan(tally.bias_m) else f"{tally.bias_m:+.3f}",
                    _shown(measure(tally, "gross_share"), "{:.2%}"),
                )
            )
    head = ("series", "distance", "frames", "bit errors", "BER", "RMSE, m", "bias, m", "0.5 m or more")
    return f"<h2>All figures</h2>{_table(head, rows)}"


def _shown(figure: Figure, form: str) -> str:
    if not figure.count:
        return "-"
    low, high = form.format(figure.low), form.format(figure.high)
    return f'{form.format(figure.value)} <span class="note">[{low}, {high}]</span>'


def _configuration(summary: Summary) -> str:
    plan, rule = summary.plan, summary.plan["rule"]
    parts = [
        "<h2>Configuration and digests</h2>",
        f'<p class="digest">campaign {summary.digest}</p>',
        f"<p>Seeds {plan['seeds'][0]} to {plan['seeds'][-1]}; a point ends at"
        f" {_limit(rule['max_bits'], 'bits')} or {_limit(rule['max_errors'], 'wrong bits')}.</p>",
        _details("code and versions", plan["environment"]),
    ]
    for kind, cases in (("scene", plan["scenes"]), ("link", plan["links"])):
        for case in cases:
            labels = ", ".join(f"{k} {v}" for k, v in case["labels"].items()) or "the only one"
            identity = case["identity"]
            digest = (
                identity["digest"]
                if isinstance(identity, dict) and "digest" in identity
                else digest_of(identity)
            )
            parts.append(_details(f"{kind}: {labels}; SHA-256 {digest}", identity))
    return "\n".join(parts)


def _limit(value: int | None, what: str) -> str:
    return f"any number of {what}" if value is None else f"{value:,} {what}"


def _details(title: str, table: Any) -> str:
    text = html.escape(json.dumps(table, indent=1, sort_keys=True))
    return f'<details><summary class="digest">{html.escape(title)}</summary><pre>{text}</pre></details>'
