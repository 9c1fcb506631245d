"""One self-contained page of a campaign: charts that answer the pointer, tables, configuration, digests."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from markupsafe import Markup

from evlcp_sdk.report.pages import render_page
from evlcp_sdk.report.plots import SCRIPT
from evlcp_sdk.spelling import counted
from evlcp_sdk.study.charts import charts_of
from evlcp_sdk.study.intervals import INTERVALS, measure, number_text
from evlcp_sdk.study.plan import digest_of
from evlcp_sdk.study.summary import AGREEMENT, PAPER_NAME, PaperComparison, Summary, beside_paper
from evlcp_sdk.study.tally import SEGMENT_M, Tally


def page(summary: Summary) -> str:
    """The page's HTML."""
    charts, beside = charts_of(summary), beside_paper(summary.series)

    def marked(verdict: str) -> Markup:
        return Markup('<span class="{}">{}</span>').format(_MARKED[verdict], verdict)

    # Labels are known once a chart is drawn.
    drawn = [(chart, chart.markup()) for chart in charts]
    rule = summary.plan.rule
    return render_page(
        "campaign.html",
        title_of(summary),
        [SCRIPT],
        {"plots": {chart.id: chart.labels for chart in charts}},
        summary=summary,
        about=_about(summary),
        figures=_headlines(summary, beside),
        charts=drawn,
        beside=[[*row[:-1], marked(row[-1])] for row in comparison_rows(beside)],
        paper=PAPER_NAME,
        paper_head=PAPER_HEAD,
        agreement=AGREEMENT,
        segment_m=SEGMENT_M,
        positions=position_rows(summary),
        position_head=POSITION_HEAD,
        intervals=INTERVALS,
        all_figures=figure_rows(summary),
        ends=(_limit(rule.max_bits, "bits"), _limit(rule.max_errors, "wrong bits")),
        cases=_cases(summary),
    )


def title_of(summary: Summary) -> str:
    """What was measured, at which distances, and the campaign's name."""
    tallies = [tally for one in summary.series for tally in one.statistics.segments.values()]
    begins = [begin for one in summary.series for begin in one.statistics.segments]
    if not begins:
        return f"{summary.plan.name}: nothing measured yet"
    what = ["bit errors", "distance errors"]
    what += ["messages"] * any(t.messages_sent for t in tallies)
    what += ["positions"] * any(t.fixes or t.fixes_refused for t in tallies)
    said = f"{', '.join(what[:-1])} and {what[-1]}"
    return f"{summary.plan.name}: {said}, {min(begins)} to {max(begins) + SEGMENT_M} m"


def _about(summary: Summary) -> list[str]:
    """How much was done, and what the series differ in."""
    few = summary.done < summary.tasks
    done = f"{summary.done} of {summary.tasks} tasks" if few else counted(summary.done, "task")
    statistics = [one.statistics for one in summary.series]
    events, seconds = sum(s.events for s in statistics), sum(s.duration_us for s in statistics) * 1e-6
    told = [f"{done}, {seconds:,.1f} s received, {events / 1e6:,.1f} million events."]
    if len(summary.series) > 1:
        varied = []
        for key in dict.fromkeys(key for one in summary.series for key in one.labels):
            labelled = [one for one in summary.series if key in one.labels]
            values = dict.fromkeys(replace(one, labels={key: one.labels[key]}).name for one in labelled)
            if len(values) > 1:
                *most, last = values
                varied.append(f"{', '.join(most)} or {last}")
        told.append(f"{len(summary.series)} series: {'; '.join(varied)}.")
    return told


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


_MARKED = {"better": "yes", "agrees": "", "worse": "no"}
_MEASURES = {"ber": "bit error rate", "rmse_m": "distance RMSE, m", "gross_share": "errors of 0.5 m or more"}


PAPER_HEAD = ("figure", "distance", "series", "paper", "here", "95 %", "verdict")


def comparison_rows(comparisons: Iterable[PaperComparison]) -> list[tuple[str, ...]]:
    """Rows of `PAPER_HEAD`, as text."""
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
        rows.append(
            (
                one.name,
                f"{t.fixes} of {t.fixes + t.fixes_refused}",
                f"{t.fixes_contradicted}",
                number_text(t.kept_share, ".1%"),
                f"{t.fixes_excluded}",
                ", ".join(number_text(m, ".3f") for m in (t.position_median_m, t.position_95_m)),
                number_text(t.position_nees, ".3g"),
                f"{t.fixes_silent}",
                f"{t.fixes_uncovered}",
                f"{t.fixes_protected}",
                f"{t.fixes_beyond}",
                number_text(t.track_rmse_m, ".3f"),
                number_text(t.track_nees, ".3g"),
                number_text(t.smoothed_rmse_m, ".3f"),
                number_text(t.smoothed_nees, ".3g"),
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
            t = Tally.together(recordings)
            row = [
                one.name,
                f"{begin} to {begin + SEGMENT_M} m",
                f"{t.frames_found} of {t.frames_sent}",
                f"{t.bit_errors} of {t.bits}",
                _shown(recordings, "ber", ".2g"),
                _shown(recordings, "rmse_m", ".3f"),
                number_text(t.bias_m, "+.3f"),
                _shown(recordings, "gross_share", ".2%"),
            ]
            if messages:
                row += [f"{t.messages_found} of {t.messages_sent}", f"{t.messages_wrong}"]
            if positions:
                row += [
                    f"{t.fixes} of {t.fixes + t.fixes_refused}",
                    _shown(recordings, "position_rmse_m", ".3f"),
                    number_text(t.position_median_m, ".3f"),
                    number_text(t.position_95_m, ".3f"),
                    number_text(t.position_nees, ".2f"),
                ]
            rows.append(row)
    return head, rows


_POSITION_HEAD = ["positions", "RMSE in space, m", "half within, m", "95 % within, m", "NEES, ideally 3"]


def _shown(recordings: Sequence[Tally], kind: str, form: str) -> str:
    figure = measure(recordings, kind)
    return f"{figure.value:{form}} {figure.interval(form)}".rstrip() if figure.count else "-"


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
