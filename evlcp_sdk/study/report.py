"""The self-contained page of a campaign: charts that answer the pointer, tables, configuration, digests.

`report.drawing` draws the charts for papers.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from markupsafe import Markup

from evlcp_sdk.formatting import format_count
from evlcp_sdk.report.colours import TRANSMITTER_COLOURS
from evlcp_sdk.report.pages import render_page
from evlcp_sdk.report.plots import DASHES, INK, SCRIPT, Plot, render_plot
from evlcp_sdk.study.intervals import FEWEST_RECORDINGS, INTERVALS, Figure, format_number, measure_figure
from evlcp_sdk.study.plan import digest_of
from evlcp_sdk.study.summary import (
    AGREEMENT,
    PAPER,
    PAPER_NAME,
    PaperComparison,
    Reference,
    Series,
    Summary,
    compare_with_paper,
    verdict_of,
)
from evlcp_sdk.study.tally import BIN_M, SEGMENT_M, Tally

Dash = Sequence[int]

_ARROW = 2.0
"""Length of an upper limit's arrow, as a factor downwards; each wing is a sixteenth of a segment wide."""


def draw_charts(summary: Summary) -> list[Plot]:
    """Draw the charts: BER, RMSE, gross errors, frames found, histogram, and positions if any."""
    note = f"Segments of {SEGMENT_M} m. {INTERVALS}"
    limit = f"{note} An arrow is an upper limit: not one error was seen, in one segment or in all that the"
    limit += " paper has one figure for."
    nearest = f"{note} The distance is that of the nearest bar."

    def plot(id: str, y_name: str, title: str, note: str = note, **options: Any) -> Plot:
        return Plot(id, "distance, m", y_name, title, note, **options)

    by_kind = {
        "ber": plot("ber", "bit error rate", "Bit error rate", limit, log_y=True),
        "rmse_m": plot("rmse", "distance RMSE, m", "Distance error", log_y=True),
        "gross_share": plot(
            "gross", "share of distances", "Distance errors of 0.5 m or more", limit, log_y=True
        ),
        "found_share": plot("found", "share of frames sent", "Frames found", from_zero=True),
        "position_rmse_m": plot(
            "position", "position RMSE in space, m", "Position error", nearest, log_y=True
        ),
    }
    histogram = Plot(
        "histogram",
        "measured less true distance, m",
        f"share of distances in {BIN_M:g} m",
        "Histogram of distance errors",
        "All distances together; the outermost bins hold everything beyond.",
        from_zero=True,
    )
    series = summary.series
    scenes, links = ([_label_key(one, prefix) for one in series] for prefix in ("scene.", "link."))
    for number, one in enumerate(series):
        scene, link = ([*dict.fromkeys(parts)].index(parts[number]) for parts in (scenes, links))
        # Colour shows the scene, dash the link; neighbours are shifted a little.
        colour = scene if len(set(scenes)) > 1 else link
        style = TRANSMITTER_COLOURS[colour % len(TRANSMITTER_COLOURS)], DASHES[link % len(DASHES)]
        shift = (number - (len(series) - 1) / 2) * min(0.7, 5 / len(series))
        for kind, chart in by_kind.items():
            _draw_segments(chart, one, kind, shift, *style)
        _draw_bins(histogram, one, *style)
    for reference in PAPER:
        _draw_reference(by_kind[reference.measure], reference)
    *by_distance, positions = by_kind.values()
    return [*by_distance, histogram, *([] if positions.is_empty else [positions])]


def _label_key(series: Series, prefix: str) -> str:
    return repr([(k, v) for k, v in series.labels.items() if k.startswith(prefix)])


def _draw_segments(plot: Plot, series: Series, kind: str, shift: float, colour: str, dash: Dash) -> None:
    """Draw a figure of each segment with its interval; on a logarithmic axis, 0 as an upper limit."""
    xs, ys, labels, dots, stems = [], [], [], [], []
    for begin, end in _find_spans(series, kind):
        figure = measure_figure(series.tallies_between(begin, end), kind)
        if not figure.count:
            continue
        is_limit = plot.log_y and figure.is_zero
        x, y = (begin + end) / 2 + shift, figure.high if is_limit else figure.value
        value = f"below {figure.high:.2g}" if is_limit else f"{figure.value:.4g}"
        text = f"{value}, counted on {figure.count:,}"
        labels.append(f"{series.name}\n{begin} to {end} m: {text}\n{_interval_text(figure)}")
        xs.append(x)
        ys.append(y)
        dots.append(math.nan if is_limit else y)
        left, right, tip, wing = x - SEGMENT_M / 16, x + SEGMENT_M / 16, y / _ARROW, y / _ARROW**0.8
        arrow = [x, x, left, x, right], [y, tip, wing, tip, wing]
        stems.append(arrow if is_limit else ([x, x], [figure.low, figure.high]))
    plot.add_line(xs, dots, colour, series.name, dash)
    plot.add_dots(xs, dots, colour, series.name)
    plot.add_labels(xs, ys, labels, series.name)
    for stem_x, stem_y in stems:
        plot.add_line(stem_x, stem_y, colour, series.name, dash, kind="stem")


def _find_spans(series: Series, kind: str) -> list[tuple[int, int]]:
    """Find the ranges of distance of the figures, m: segments, or the paper's range where it has one figure
    for them.

    The latter if not one error was seen, and a segment alone has too little data to stay below the paper's
    figure.
    """
    spans = [(begin, begin + SEGMENT_M) for begin, _ in series.segments]
    for paper in (one for one in PAPER if one.measure == kind):
        whole = paper.from_m, paper.to_m
        contained = [span for span in spans if whole[0] <= span[0] and span[1] <= whole[1]]
        too_few = [
            verdict_of(measure_figure(series.tallies_between(*span), kind), paper) == "too few"
            for span in contained
        ]
        if any(too_few) and measure_figure(series.tallies_between(*whole), kind).is_zero:
            spans = [span for span in spans if span not in contained] + [whole]
    return sorted(spans)


def _interval_text(figure: Figure) -> str:
    if math.isnan(figure.high):
        return "one recording: no interval"
    few = figure.recordings < FEWEST_RECORDINGS and not figure.is_zero
    kind = f"range of {figure.recordings} recordings" if few else "95 %"
    return f"{kind}: {figure.low:.3g} to {figure.high:.3g}"


def _draw_bins(plot: Plot, series: Series, colour: str, dash: Dash) -> None:
    tally = series.statistics.total()
    if not tally.ranged:
        return
    counts = tally.histogram
    bins = range(min(counts) - 1, max(counts) + 2)
    shares = [counts.get(bin, 0) / tally.ranged for bin in bins]
    edges = [bin * BIN_M for bin in (*bins, bins[-1] + 1)]
    x, y = ([value for value in values for _ in (0, 1)] for values in (edges, shares))
    plot.add_line(x[1:-1], y, colour, series.name, dash)
    labels = [
        f"{series.name}\n{low:+.2f} to {low + BIN_M:+.2f} m: {counts.get(bin, 0)} of {tally.ranged}"
        for bin, low in zip(bins, edges, strict=False)
    ]
    plot.add_labels([low + BIN_M / 2 for low in edges[:-1]], shares, labels, series.name)


def _draw_reference(plot: Plot, reference: Reference) -> None:
    clusters, speed_kmh = reference.clusters, reference.speed_kmh
    parts = [f"{clusters} cluster{'s' * (clusters != 1)}"] if clusters and speed_kmh else []
    parts += [f"{speed_kmh:g} km/h"] if speed_kmh else ["20 to 40 km/h"]
    name = f"{PAPER_NAME}: {', '.join(parts)}"
    text = f"{'at most ' * reference.bound}{reference.value:g}"
    x = [reference.from_m, (reference.from_m + reference.to_m) / 2, reference.to_m]
    y = [reference.value] * 3
    plot.add_line(x, y, INK, name, DASHES[1] if clusters == 2 else (), "level")
    plot.add_labels(x, y, [f"{name}\n{x[0]:g} to {x[2]:g} m: {text}"] * 3, name)
    plot.add_name(reference.from_m, reference.value, text + (f" ({clusters})" if clusters else ""))


def render_campaign(summary: Summary) -> str:
    """Render the page as HTML."""
    charts, comparisons = draw_charts(summary), compare_with_paper(summary.series)

    def mark_verdict(verdict: str) -> Markup:
        return Markup('<span class="{}">{}</span>').format(_VERDICT_CLASSES[verdict], verdict)

    rendered = [(chart, *render_plot(chart)) for chart in charts]
    rule = summary.plan.rule
    return render_page(
        "campaign.html",
        summary.plan.name,
        [SCRIPT],
        {"plots": {chart.id: labels for chart, _, labels in rendered}},
        summary=summary,
        about=_progress_text(summary),
        charts=[(chart, markup) for chart, markup, _ in rendered],
        comparisons=[[*row[:-1], mark_verdict(row[-1])] for row in paper_rows(comparisons)],
        paper=PAPER_NAME,
        paper_head=PAPER_HEAD,
        agreement=AGREEMENT,
        segment_m=SEGMENT_M,
        positions=position_rows(summary),
        position_head=POSITION_HEAD,
        intervals=INTERVALS,
        all_figures=figure_rows(summary),
        ends=(_limit_text(rule.max_bits, "bits"), _limit_text(rule.max_errors, "wrong bits")),
        cases=_describe_cases(summary),
    )


def _progress_text(summary: Summary) -> str:
    is_partial = summary.done < summary.tasks
    done = f"{summary.done} of {summary.tasks} tasks" if is_partial else format_count(summary.done, "task")
    statistics = [one.statistics for one in summary.series]
    events, seconds = sum(s.events for s in statistics), sum(s.duration_us for s in statistics) * 1e-6
    return f"{done}, {seconds:,.1f} s received, {events / 1e6:,.1f} million events."


_VERDICT_CLASSES = {"better": "yes", "agrees": "", "worse": "no", "too few": ""}
_MEASURES = {"ber": "bit error rate", "rmse_m": "distance RMSE, m", "gross_share": "errors of 0.5 m or more"}


PAPER_HEAD = ("figure", "distance", "series", "paper", "here", "95 %", "verdict")


def paper_rows(comparisons: Iterable[PaperComparison]) -> list[tuple[str, ...]]:
    """Rows of `PAPER_HEAD`, as text."""
    rows: list[tuple[str, ...]] = []
    for one in comparisons:
        r = one.reference
        is_part = (r.from_m, r.to_m) != (one.from_m, one.to_m)
        form = ".2%" if r.measure == "gross_share" else ".3g"
        rows.append(
            (
                _MEASURES[r.measure],
                f"{r.from_m} to {r.to_m} m",
                one.series,
                ("at most " if r.bound else "") + f"{r.value:{form}}",
                f"{one.ours.value:{form}}" + (f" at {one.from_m} to {one.to_m} m" if is_part else ""),
                one.ours.interval(form) or "-",
                one.verdict,
            )
        )
    return rows


POSITION_HEAD = (
    *("series", "positions", "contradicted", "kept", "left out", "half, 95 % within, m", "NEES"),
    *("silent", "not covered", "protected", "beyond", "track, m", "NEES", "smoothed, m", "NEES"),
)


def position_rows(summary: Summary) -> list[tuple[str, ...]]:
    """Rows of positions and tracks, one a series, all distances together, as text."""
    rows: list[tuple[str, ...]] = []
    for one in summary.series:
        t = one.statistics.total()
        if not t.fixes + t.fixes_refused:
            continue
        rows.append(
            (
                one.name,
                f"{t.fixes} of {t.fixes + t.fixes_refused}",
                f"{t.fixes_contradicted}",
                format_number(t.kept_share, ".1%"),
                f"{t.fixes_excluded}",
                ", ".join(format_number(m, ".3f") for m in (t.position_median_m, t.position_95_m)),
                format_number(t.position_nees, ".3g"),
                f"{t.fixes_silent}",
                f"{t.fixes_uncovered}",
                f"{t.fixes_protected}",
                f"{t.fixes_beyond}",
                format_number(t.track_rmse_m, ".3f"),
                format_number(t.track_nees, ".3g"),
                format_number(t.smoothed_rmse_m, ".3f"),
                format_number(t.smoothed_nees, ".3g"),
            )
        )
    return rows


def figure_rows(summary: Summary) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the table of each series and segment, as text."""
    tallies = [t for one in summary.series for t in one.statistics.segments.values()]
    messages = any(t.messages_sent for t in tallies)
    positions = any(t.fixes or t.fixes_refused for t in tallies)
    head = ["series", "distance", "frames", "bit errors", "BER", "RMSE, m", "bias, m", "0.5 m or more"]
    head += ["messages", "read wrong"] if messages else []
    head += _POSITION_HEAD if positions else []
    rows = []
    for one in summary.series:
        for begin, recordings in one.segments:
            t = Tally.sum(recordings)
            row = [
                one.name,
                f"{begin} to {begin + SEGMENT_M} m",
                f"{t.frames_found} of {t.frames_sent}",
                f"{t.bit_errors} of {t.bits}",
                _figure_text(recordings, "ber", ".2g"),
                _figure_text(recordings, "rmse_m", ".3f"),
                format_number(t.bias_m, "+.3f"),
                _figure_text(recordings, "gross_share", ".2%"),
            ]
            if messages:
                row += [f"{t.messages_found} of {t.messages_sent}", f"{t.messages_wrong}"]
            if positions:
                row += [
                    f"{t.fixes} of {t.fixes + t.fixes_refused}",
                    _figure_text(recordings, "position_rmse_m", ".3f"),
                    format_number(t.position_median_m, ".3f"),
                    format_number(t.position_95_m, ".3f"),
                    format_number(t.position_nees, ".2f"),
                ]
            rows.append(row)
    return head, rows


_POSITION_HEAD = ["positions", "RMSE in space, m", "half within, m", "95 % within, m", "NEES, ideally 3"]


def _figure_text(recordings: Sequence[Tally], kind: str, form: str) -> str:
    figure = measure_figure(recordings, kind)
    return f"{figure.value:{form}} {figure.interval(form)}".rstrip() if figure.count else "-"


def _describe_cases(summary: Summary) -> Iterator[tuple[str, Any]]:
    for kind, cases in (("scene", summary.plan.scenes), ("link", summary.plan.links)):
        for case in cases:
            labels = ", ".join(f"{k} {v}" for k, v in case.labels.items()) or "the only one"
            identity = case.identity
            has_digest = isinstance(identity, dict) and "digest" in identity
            digest = identity["digest"] if has_digest else digest_of(identity)
            yield f"{kind}: {labels}; SHA-256 {digest}", identity


def _limit_text(value: int | None, what: str) -> str:
    return f"any number of {what}" if value is None else f"{value:,} {what}"
