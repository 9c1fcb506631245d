"""The charts of a campaign as plain data, and how Matplotlib draws them; `report` draws them in a page."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import escape
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from evlcp_sdk.files import Outputs, output_fault
from evlcp_sdk.report.colours import TRANSMITTER_COLOURS
from evlcp_sdk.report.figures import plain
from evlcp_sdk.study.intervals import FEWEST_RECORDINGS, INTERVALS, Figure, measure
from evlcp_sdk.study.paper import PAPER_NAME, Measure
from evlcp_sdk.study.summary import Series, Summary, reference_marks
from evlcp_sdk.study.tally import BIN_M, SEGMENT_M, Tally

DASHES = ("solid", "dash", "dot", "dashdot")
SYMBOLS = ("circle", "diamond", "square", "cross")

_MATPLOTLIB = {
    "solid": "-",
    "dash": "--",
    "dot": ":",
    "dashdot": "-.",
    "circle": "o",
    "diamond": "D",
    "square": "s",
    "cross": "X",
}
_INK = "#333333"


@dataclass(frozen=True)
class Dot:
    """A measured figure.

    Attributes:
        x: Where.
        y: The figure; where there was not one error on a logarithmic axis, the upper end of its interval.
        low: Lower end of the interval, or the figure itself where there is none.
        high: Upper end, the same.
        text: What a reader who points at it sees; HTML.
        limit: Only an upper limit is known.
    """

    x: float
    y: float
    low: float
    high: float
    text: str
    limit: bool = False


@dataclass(frozen=True)
class Line:
    """The dots of one series."""

    name: str
    dots: tuple[Dot, ...]
    colour: str
    dash: str
    symbol: str


@dataclass(frozen=True)
class Mark:
    """A reference: a level between two places; `bound` where it is a limit from above."""

    name: str
    x0: float
    x1: float
    y: float
    bound: bool
    clusters: int | None


@dataclass(frozen=True)
class Chart:
    """A chart, however it is drawn.

    Attributes:
        id: Its name in files and pages.
        title: Heading.
        x_label: Horizontal axis, with unit.
        y_label: Vertical axis, with unit.
        log_y: The vertical axis is logarithmic.
        steps: Lines are the outlines of histograms, without intervals.
        lines: A line a series.
        marks: References.
        note: What a reader must know of it.
    """

    id: str
    title: str
    x_label: str
    y_label: str
    log_y: bool
    steps: bool
    lines: tuple[Line, ...]
    marks: tuple[Mark, ...]
    note: str


def charts_of(summary: Summary) -> list[Chart]:
    """The charts of a campaign: BER, RMSE, gross errors, frames found, histogram, and positions if any."""
    distance = "distance, m"

    def over_distance(kind: str, id: str, title: str, label: str, note: str, *, log: bool) -> Chart:
        lines = _lines(summary.series, lambda series, shift: _dots(series, kind, shift, log=log))
        marks: list[Mark] = []
        if kind in ("ber", "rmse_m", "gross_share"):
            marks = [
                Mark(_mark_name(r.clusters, r.speed_kmh), r.from_m, r.to_m, r.value, r.bound, r.clusters)
                for r in reference_marks(_as_measure(kind))
            ]
        return Chart(id, title, distance, label, log, False, lines, tuple(marks), note)

    segments = f"Segments of {SEGMENT_M} m. {INTERVALS}"
    histogram = _lines(summary.series, lambda series, _: _bins(series))
    positions = over_distance(
        "position_rmse_m",
        "position",
        "Position error",
        "position RMSE in space, m",
        f"{segments} The distance is that of the nearest bar.",
        log=True,
    )
    return [
        over_distance(
            "ber",
            "ber",
            "Bit error rate",
            "bit error rate",
            f"{segments} A triangle is an upper limit: not one error was seen.",
            log=True,
        ),
        over_distance("rmse_m", "rmse", "Distance error", "distance RMSE, m", segments, log=True),
        over_distance(
            "gross_share",
            "gross",
            "Distance errors of 0.5 m or more",
            "share of distances",
            segments,
            log=False,
        ),
        over_distance(
            "found_share",
            "found",
            "Frames found",
            "share of frames sent",
            segments,
            log=False,
        ),
        Chart(
            "histogram",
            "Histogram of distance errors",
            "measured less true distance, m",
            f"share of distances in {BIN_M:g} m",
            False,
            True,
            histogram,
            (),
            "All distances together; the outermost bins hold everything beyond.",
        ),
        *((positions,) if any(line.dots for line in positions.lines) else ()),
    ]


def _as_measure(kind: str) -> Measure:
    return "ber" if kind == "ber" else "rmse_m" if kind == "rmse_m" else "gross_share"


def _mark_name(clusters: int | None, speed_kmh: float | None) -> str:
    parts = [f"{clusters} cluster{'s' * (clusters != 1)}"] if clusters and speed_kmh else []
    parts += [f"{speed_kmh:g} km/h"] if speed_kmh else ["20 to 40 km/h"]
    return f"{PAPER_NAME}: {', '.join(parts)}"


def _lines(series: Sequence[Series], dots: Callable[[Series, float], tuple[Dot, ...]]) -> tuple[Line, ...]:
    """Colour is the scene, dash and symbol the link; neighbours stand a little apart."""
    scenes = list(dict.fromkeys(_part(one, "scene.") for one in series))
    links = list(dict.fromkeys(_part(one, "link.") for one in series))
    lines = []
    for number, one in enumerate(series):
        scene, link = scenes.index(_part(one, "scene.")), links.index(_part(one, "link."))
        shift = (number - (len(series) - 1) / 2) * min(0.7, 5 / max(len(series), 1))
        lines.append(
            Line(
                one.name,
                dots(one, shift),
                TRANSMITTER_COLOURS[(scene if len(scenes) > 1 else link) % len(TRANSMITTER_COLOURS)],
                DASHES[link % len(DASHES)],
                SYMBOLS[link % len(SYMBOLS)],
            )
        )
    return tuple(lines)


def _part(series: Series, prefix: str) -> str:
    return repr([(k, v) for k, v in series.labels.items() if k.startswith(prefix)])


def _dots(series: Series, kind: str, shift: float, *, log: bool) -> tuple[Dot, ...]:
    dots = []
    for begin, recordings in series.segments:
        figure = measure(recordings, kind)
        if not figure.count:
            continue
        tally = Tally.together(recordings)
        none = log and figure.none
        what = {
            "ber": f"{tally.bit_errors} of {tally.bits} bits wrong",
            "rmse_m": f"{tally.ranged} distances, bias {tally.bias_m:+.3f} m",
            "gross_share": f"{tally.gross} of {tally.ranged} distances",
            "found_share": f"{tally.frames_found} of {tally.frames_sent} frames",
            "position_rmse_m": f"{tally.fixes} position{'s' * (tally.fixes != 1)},"
            f" half within {tally.position_quantile_m(0.5):.3f} m,"
            f" 95 % within {tally.position_quantile_m(0.95):.3f} m; {tally.fixes_refused} refused",
        }[kind]
        shown = f"below {figure.high:.2g}" if none else f"{figure.value:.4g}"
        text = (
            f"{escape(series.name)}<br>{begin} to {begin + SEGMENT_M} m: {shown}<br>{_interval(figure)}{what}"
        )
        y = figure.high if none else figure.value
        low, high = (figure.value if math.isnan(v) else v for v in (figure.low, figure.high))
        dots.append(Dot(begin + SEGMENT_M / 2 + shift, y, low, high, text, none))
    return tuple(dots)


def _interval(figure: Figure) -> str:
    """What the ends of an error bar are."""
    if math.isnan(figure.high):
        return "one recording: no interval<br>"
    few = figure.recordings < FEWEST_RECORDINGS and not figure.none
    kind = f"range of {figure.recordings} recordings" if few else "95 %"
    return f"{kind}: {figure.low:.3g} to {figure.high:.3g}<br>"


def _bins(series: Series) -> tuple[Dot, ...]:
    tally = series.statistics.total()
    if not tally.ranged:
        return ()
    counts = tally.histogram
    dots = []
    for bin in range(min(counts) - 1, max(counts) + 2):
        low, share = bin * BIN_M, counts.get(bin, 0) / tally.ranged
        some = f"{counts.get(bin, 0)} of {tally.ranged}"
        text = f"{escape(series.name)}<br>{low:+.2f} to {low + BIN_M:+.2f} m: {some}"
        dots.append(Dot(low + BIN_M / 2, share, share, share, text))
    return tuple(dots)


def draw(chart: Chart, title: str) -> Drawing:
    """Draw a chart with Matplotlib."""
    figure = Drawing(figsize=(8, 5), layout="constrained")
    axis = figure.subplots()
    for line in chart.lines:
        xs, ys = [d.x for d in line.dots], [d.y for d in line.dots]
        style = _MATPLOTLIB[line.dash]
        if chart.steps:
            axis.step(xs, ys, where="mid", color=line.colour, ls=style, lw=1.2, label=line.name)
            continue
        axis.plot(xs, ys, style, color=line.colour, lw=1.2, label=line.name)
        _draw_dots(axis, line)
    for mark in chart.marks:
        axis.plot([mark.x0, mark.x1], [mark.y, mark.y], "-", color=_INK, lw=2.5 if not mark.bound else 1.2)
    if chart.marks:
        axis.plot([], [], "-", color=_INK, lw=2.5, label=f"{PAPER_NAME} (clusters)")
    if chart.log_y:
        axis.set_yscale("log")
        if decades(chart) < 2:
            axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.yaxis.set_minor_formatter(NullFormatter())
    axis.set(xlabel=chart.x_label, ylabel=chart.y_label)
    if chart.steps:
        axis.set_xlim(*_ends(chart))
        axis.set_ylim(bottom=0)
    _name_marks(axis, chart)
    axis.set_title(f"{title}: {chart.title}", loc="left", fontsize=11, color=_INK, parse_math=False)
    plain(axis)
    if labels := axis.get_legend_handles_labels()[1]:
        # Below, where no line runs; a column as wide as the longest name.
        columns = max(1, min(len(labels), 110 // (8 + max(map(len, labels)))))
        legend = figure.legend(loc="outside lower left", frameon=False, fontsize=8, ncols=columns)
        for entry in legend.get_texts():
            entry.set_parse_math(False)
    return figure


def _draw_dots(axis: Axes, line: Line) -> None:
    """Draw figures with their intervals, and those that are limits as such."""
    for limit in (False, True):
        dots = [d for d in line.dots if d.limit is limit]
        if dots:
            axis.errorbar(
                [d.x for d in dots],
                [d.y for d in dots],
                None if limit else [[d.y - d.low for d in dots], [d.high - d.y for d in dots]],
                fmt="v" if limit else _MATPLOTLIB[line.symbol],
                mfc="none" if limit else line.colour,
                color=line.colour,
                ms=5,
                capsize=2,
                lw=1,
            )


def _name_marks(axis: Axes, chart: Chart) -> None:
    """Write each reference's figure above or below its level, where it stands on the fewest dots."""
    place = axis.transData.transform
    dots = [(d.x, y) for line in chart.lines for d in line.dots for y in (d.y, d.low, d.high)]
    spots = place([*dots, *(((m.x0 + m.x1) / 2, m.y) for m in chart.marks)])
    for mark in chart.marks:
        text = f"{'at most ' * mark.bound}{mark.y:g}" + (f" ({mark.clusters})" if mark.clusters else "")
        x, y = place(((mark.x0 + mark.x1) / 2, mark.y))
        half = _LETTER_PX * len(text) / 2 + _LETTER_PX

        def covered(side: int, x: float = x, y: float = y, half: float = half) -> int:
            above = side * (spots[:, 1] - y)
            return int(((abs(spots[:, 0] - x) < half) & (above > 1) & (above < 4 * _LETTER_PX)).sum())

        side = min((1, -1), key=covered)
        axis.annotate(
            text, ((mark.x0 + mark.x1) / 2, mark.y), xytext=(0, 3 * side), textcoords="offset points",
            ha="center", va="bottom" if side > 0 else "top", fontsize=8, color=_INK,
            path_effects=[withStroke(linewidth=3, foreground="white")],
        )  # fmt: skip


_LETTER_PX = 7.0
"""Width of a letter at Matplotlib's own resolution, about."""


def decades(chart: Chart) -> float:
    """How many powers of ten the vertical axis spans."""
    levels = [d.y for line in chart.lines for d in line.dots if d.y > 0] + [m.y for m in chart.marks]
    return math.log10(max(levels) / min(levels)) if levels else 0.0


def _ends(chart: Chart) -> tuple[float, float]:
    """Where a histogram begins and ends: at its outermost bins that hold something."""
    held = [d.x for line in chart.lines for d in line.dots if d.y]
    return (min(held) - BIN_M, max(held) + BIN_M) if held else (-1.0, 1.0)


def save_charts(charts: Sequence[Chart], title: str, folder: Path, outputs: Outputs) -> list[Path]:
    """Draw charts as PNG and SVG, named by their id.

    Args:
        charts: What is drawn.
        title: Above each.
        folder: Where they go; made if need be.
        outputs: The files that they come into place with.

    Raises:
        OutputError: A file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise output_fault(folder, fault) from fault
    written = []
    for chart in charts:
        figure = draw(chart, title)
        for kind in ("png", "svg"):
            path = folder / f"{chart.id}.{kind}"
            with outputs.told(path):
                figure.savefig(outputs.path(path), format=kind, dpi=150)
            written.append(path)
    return written
