"""One self-contained page of a campaign: charts that answer the pointer, tables, configuration, digests.

Needs the extra `report`. The page holds everything it shows, the charting library included, and asks no
network for anything.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from markupsafe import Markup, escape

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.report.pages import render_page
from evlcp_sdk.spelling import counted
from evlcp_sdk.study.campaign.charts import Chart, charts_of, decades
from evlcp_sdk.study.intervals import INTERVALS, Figure, measure
from evlcp_sdk.study.paper import PAPER_NAME
from evlcp_sdk.study.plan import digest_of
from evlcp_sdk.study.summary import AGREEMENT, PaperComparison, Series, Summary, beside_paper
from evlcp_sdk.study.tally import SEGMENT_M, Tally


def page(summary: Summary) -> str:
    """The page's HTML.

    Raises:
        ConfigError: The extra is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as fault:
        raise ConfigError("a report needs the extra: pip install 'evlcp-sdk[report]'") from fault
    charts, beside = charts_of(summary), beside_paper(summary.series)
    rule = summary.plan.rule
    return render_page(
        "campaign.html",
        title_of(summary),
        (get_plotlyjs(), _SCRIPT),
        {_DATA: {chart.id: _plotly(chart) for chart in charts}},
        summary=summary,
        about=_about(summary),
        figures=_headlines(summary, beside),
        charts=[(chart, _keys(chart)) for chart in charts],
        beside=_paper_rows(beside),
        paper=PAPER_NAME,
        agreement=AGREEMENT,
        segment_m=SEGMENT_M,
        positions=position_rows(summary),
        position_head=POSITION_HEAD,
        intervals=INTERVALS,
        all_figures=_all_figures(summary),
        ends=(_limit(rule.max_bits, "bits"), _limit(rule.max_errors, "wrong bits")),
        cases=_cases(summary),
    )


def title_of(summary: Summary) -> str:
    """What was measured, at which distances, and the campaign's name."""
    tallies = [tally for one in summary.series for tally in one.statistics.segments.values()]
    begins = [begin for one in summary.series for begin in one.statistics.segments]
    if not begins:
        return f"{summary.name}: nothing measured yet"
    what = ["bit errors", "distance errors"]
    what += ["messages"] * any(t.messages_sent for t in tallies)
    what += ["positions"] * any(t.fixes or t.fixes_refused for t in tallies)
    said = f"{', '.join(what[:-1])} and {what[-1]}"
    return f"{summary.name}: {said}, {min(begins)} to {max(begins) + SEGMENT_M} m"


def _about(summary: Summary) -> list[str]:
    """How much was done, and what the series differ in."""
    few = summary.done < summary.tasks
    done = f"{summary.done} of {summary.tasks} tasks" if few else counted(summary.done, "task")
    statistics = [one.statistics for one in summary.series]
    events, seconds = sum(s.events for s in statistics), sum(s.duration_us for s in statistics) * 1e-6
    told = [f"{done}, {seconds:,.1f} s received, {events / 1e6:,.1f} million events."]
    if len(summary.series) > 1:
        told.append(f"{len(summary.series)} series: {'; '.join(_varied(summary.series))}.")
    return told


def _varied(series: Sequence[Series]) -> list[str]:
    """Each thing that series differ in, and its values."""
    found = []
    for key in dict.fromkeys(key for one in series for key in one.labels):
        values = dict.fromkeys(
            replace(one, labels={key: one.labels[key]}).name for one in series if key in one.labels
        )
        if len(values) > 1:
            *most, last = values
            found.append(f"{', '.join(most)} or {last}")
    return found


def _headlines(summary: Summary, beside: Sequence[PaperComparison]) -> list[tuple[str, str, str]]:
    """The figures that a reader looks for first: of all distances, from the best series to the worst."""
    everything = [(one, one.statistics.total()) for one in summary.series]
    total = Tally.together(tally for _, tally in everything)
    several = f"all distances, {len(everything)} series" if len(everything) > 1 else "all distances"
    shown = []

    def figures(kind: str, form: str, unit: str = "") -> str:
        found = [measure(tuple(r.total() for r in one.recordings), kind) for one, _ in everything]
        known = sorted((f for f in found if f.count), key=lambda figure: figure.value)
        if not known:
            return ""
        ends = [f"below {f.high:{form}}" if f.none else f"{f.value:{form}}" for f in (known[0], known[-1])]
        return " to ".join(dict.fromkeys(ends)) + unit

    if total.frames_sent:
        share = f"{total.frames_found / total.frames_sent:.1%} of frames sent"
        shown.append(("frames found", f"{total.frames_found:,} of {total.frames_sent:,}", share))
    for what, kind, form, unit in (
        ("bit error rate", "ber", ".2g", ""),
        ("distance RMSE", "rmse_m", ".3f", " m"),
        ("errors of 0.5 m or more", "gross_share", ".2%", ""),
        ("position RMSE in space", "position_rmse_m", ".3f", " m"),
    ):
        if value := figures(kind, form, unit):
            shown.append((what, value, several))
    if total.messages_sent:
        wrong = f"{total.messages_wrong} read wrong"
        shown.append(("messages read", f"{total.messages_found:,} of {total.messages_sent:,}", wrong))
    if beside:
        counts = {v: sum(one.verdict == v for one in beside) for v in ("better", "agrees", "worse")}
        said = ", ".join(f"{n} {_SAID[verdict]}" for verdict, n in counts.items() if n)
        shown.append(("beside the paper", said, f"of {len(beside)} figures of {PAPER_NAME}"))
    return shown


_SAID = {"better": "better", "agrees": "agree", "worse": "worse"}

_SWATCHES = {
    "circle": '<circle cx="17" cy="6" r="4"/>',
    "diamond": '<path d="M17 1l5 5-5 5-5-5z"/>',
    "square": '<path d="M13 2h8v8h-8z"/>',
    "cross": '<path d="M15 2h4v2h2v4h-2v2h-4v-2h-2v-4h2z"/>',
}
_DASHES = {"solid": "none", "dash": "8 4", "dot": "2 3", "dashdot": "8 3 2 3"}


def _keys(chart: Chart) -> Iterator[tuple[Sequence[int], str, float, str, str, str]]:
    """What each line is, below the chart: each shows or hides its own, whose numbers it has."""
    for number, line in enumerate(chart.lines):
        symbol = "" if chart.steps else _SWATCHES[line.symbol]
        yield [number], line.colour, 1.6, _DASHES[line.dash], Markup(symbol), line.name
    marks: dict[str, list[int]] = {}
    for number, mark in enumerate(chart.marks, len(chart.lines)):
        marks.setdefault(mark.name, []).append(number)
    for name, numbers in marks.items():
        mark = chart.marks[numbers[0] - len(chart.lines)]
        yield numbers, "inherit", 3, "8 4" if mark.clusters == 2 else "none", "", name


_DATA = "charts"
_SCRIPT = f"""
const charts = JSON.parse(document.getElementById("{_DATA}").textContent);
// The library would offer to upload a chart.
const config = {{displaylogo: false, responsive: true, showSendToCloud: false, plotlyServerURL: ""}};
const dark = matchMedia("(prefers-color-scheme: dark)");
const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const look = c => {{
  const [ink, line, dim] = ["--ink", "--line", "--dim"].map(colour);
  const axis = a => ({{[a + ".gridcolor"]: line, [a + ".linecolor"]: dim, [a + ".tickcolor"]: dim,
    ...(c.layout[a].minor ? {{[a + ".minor.gridcolor"]: line}} : {{}})}});
  return {{"font.color": ink, "modebar.color": dim, "modebar.activecolor": ink,
    "modebar.bgcolor": "rgba(0,0,0,0)", ...axis("xaxis"), ...axis("yaxis")}};
}};
const dressed = (id, c) => Plotly.relayout(id, look(c)).then(
  () => c.ink.length && Plotly.restyle(id, {{"line.color": colour("--ink")}}, c.ink));
for (const [id, c] of Object.entries(charts))
  Plotly.newPlot(id, c.data, c.layout, config).then(() => dressed(id, c));
dark.addEventListener("change", () => Object.entries(charts).forEach(([id, c]) => dressed(id, c)));
for (const key of document.querySelectorAll(".key")) key.addEventListener("click", event => {{
  const button = event.target.closest("button");
  if (!button) return;
  const shown = button.getAttribute("aria-pressed") !== "true";
  button.setAttribute("aria-pressed", shown);
  Plotly.restyle(key.dataset.chart, {{visible: shown}}, button.dataset.lines.split(" ").map(Number));
}});
"""
"""Colours are those of the page: a browser says which scheme holds, and when it changes."""


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
    for mark in chart.marks:
        middle = (mark.x0 + mark.x1) / 2
        said = f"{mark.name}<br>{mark.x0:g} to {mark.x1:g} m: {'at most ' if mark.bound else ''}{mark.y:g}"
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": mark.name,
                "x": [mark.x0, middle, mark.x1],
                "y": [mark.y] * 3,
                "text": [said] * 3,
                "hovertemplate": "%{text}<extra></extra>",
                "line": {
                    "width": 2 if mark.bound else 4,
                    "dash": "dash" if mark.clusters == 2 else "solid",
                },
            }
        )
    axis = {"zeroline": False, "ticks": "outside", "automargin": True}
    y_axis = axis | {"title": {"text": chart.y_label, "standoff": 8}}
    if chart.log_y:
        y_axis |= {"type": "log", "minor": {"showgrid": True, "griddash": "dot"}}
        narrow = decades(chart) < 2
        y_axis |= {"dtick": "D2", "tickformat": "~g"} if narrow else {"dtick": 1, "exponentformat": "power"}
    else:
        y_axis |= {"rangemode": "tozero"}
    layout = {
        "margin": {"l": 10, "r": 10, "t": 34, "b": 10},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "hovermode": "closest",
        "showlegend": False,
        "xaxis": axis | {"title": {"text": chart.x_label, "standoff": 8}},
        "yaxis": y_axis,
    }
    first = len(chart.lines)
    return {"data": data, "layout": layout, "ink": list(range(first, first + len(chart.marks)))}


def _paper_rows(comparisons: Sequence[PaperComparison]) -> list[list[str]]:
    rows = []
    for cells, one in zip(comparison_rows(comparisons), comparisons, strict=True):
        verdict = Markup('<span class="{}">{}</span>').format(_MARKED[one.verdict], cells[-1])
        rows.append([*cells[:-1], verdict])
    return rows


_MARKED = {"better": "yes", "agrees": "", "worse": "no"}
_MEASURES = {"ber": "bit error rate", "rmse_m": "distance RMSE, m", "gross_share": "errors of 0.5 m or more"}


def comparison_rows(comparisons: Iterable[PaperComparison]) -> list[tuple[str, ...]]:
    """Figure, distance, series, paper, here, its interval, and the verdict, as text."""
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
                one.verdict,
            )
        )
    return rows


POSITION_HEAD = (
    *("series", "positions", "contradicted", "kept", "left out", "half, 95 % within, m", "NEES"),
    *("silent", "not covered", "protected", "beyond", "track, m", "NEES", "smoothed, m", "NEES"),
)


def position_rows(summary: Summary) -> list[tuple[str, ...]]:
    """What became of positions and tracks, a row a series, all distances together, as text."""
    rows: list[tuple[str, ...]] = []
    for one in summary.series:
        t = one.statistics.total()
        if not t.fixes + t.fixes_refused:
            continue
        given = (
            (
                f"{t.kept_share:.1%}",
                f"{t.fixes_excluded}",
                f"{t.position_quantile_m(0.5):.3f}, {t.position_quantile_m(0.95):.3f}",
                f"{t.position_nees:.3g}",
                f"{t.fixes_silent}",
                f"{t.fixes_uncovered}",
                f"{t.fixes_protected}",
                f"{t.fixes_beyond}",
                f"{t.track_rmse_m:.3f}",
                f"{t.track_nees:.3g}",
                f"{t.smoothed_rmse_m:.3f}",
                f"{t.smoothed_nees:.3g}",
            )
            if t.fixes
            else (f"{t.kept_share:.1%}" if t.fixes_contradicted else "-", "0", *10 * ("-",))
        )
        rows.append(
            (one.name, f"{t.fixes} of {t.fixes + t.fixes_refused}", f"{t.fixes_contradicted}", *given)
        )
    return rows


def _all_figures(summary: Summary) -> tuple[Sequence[str], list[tuple[str, ...]]]:
    """Head and rows of the table of each series and segment."""
    messages = any(t.messages_sent for one in summary.series for t in one.statistics.segments.values())
    positions = any(
        t.fixes or t.fixes_refused for one in summary.series for t in one.statistics.segments.values()
    )
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
    return head, rows


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


def _cases(summary: Summary) -> Iterator[tuple[str, Any]]:
    """Each scene and link with what it is."""
    for kind, cases in (("scene", summary.plan.scenes), ("link", summary.plan.links)):
        for case in cases:
            labels = ", ".join(f"{k} {v}" for k, v in case.labels.items()) or "the only one"
            identity = case.identity
            known = isinstance(identity, dict) and "digest" in identity
            digest = identity["digest"] if known else digest_of(identity)
            yield f"{kind}: {labels}; SHA-256 {digest}", identity


def _limit(value: int | None, what: str) -> str:
    return f"any number of {what}" if value is None else f"{value:,} {what}"
