"""The charts of a campaign: a page shows them, `report.drawing` draws them for papers."""

import math
from collections.abc import Sequence
from functools import partial

from evlcp_sdk.report.colours import TRANSMITTER_COLOURS
from evlcp_sdk.report.plots import DASHES, INK, Plot
from evlcp_sdk.study.intervals import FEWEST_RECORDINGS, INTERVALS, Figure, measure
from evlcp_sdk.study.summary import PAPER, PAPER_NAME, Reference, Series, Summary
from evlcp_sdk.study.tally import BIN_M, SEGMENT_M, Tally

Dash = Sequence[int]


def charts_of(summary: Summary) -> list[Plot]:
    """The charts of a campaign: BER, RMSE, gross errors, frames found, histogram, and positions if any."""
    note = f"Segments of {SEGMENT_M} m. {INTERVALS}"
    limit = f"{note} A hollow dot is an upper limit: not one error was seen."
    nearest = f"{note} The distance is that of the nearest bar."
    plot = partial(Plot, x_name="distance, m")
    by_kind = {
        "ber": plot("ber", y_name="bit error rate", title="Bit error rate", note=limit, log_y=True),
        "rmse_m": plot("rmse", y_name="distance RMSE, m", title="Distance error", note=note, log_y=True),
        "gross_share": plot(
            "gross",
            y_name="share of distances",
            title="Distance errors of 0.5 m or more",
            note=note,
            from_zero=True,
        ),
        "found_share": plot(
            "found", y_name="share of frames sent", title="Frames found", note=note, from_zero=True
        ),
        "position_rmse_m": plot(
            "position", y_name="position RMSE in space, m", title="Position error", note=nearest, log_y=True
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
    scenes, links = ([_part(one, prefix) for one in series] for prefix in ("scene.", "link."))
    for number, one in enumerate(series):
        scene, link = ([*dict.fromkeys(parts)].index(parts[number]) for parts in (scenes, links))
        # Colour is the scene, dash the link; neighbours stand a little apart.
        own = scene if len(set(scenes)) > 1 else link
        look = TRANSMITTER_COLOURS[own % len(TRANSMITTER_COLOURS)], DASHES[link % len(DASHES)]
        shift = (number - (len(series) - 1) / 2) * min(0.7, 5 / max(len(series), 1))
        for kind, chart in by_kind.items():
            _draw_segments(chart, one, kind, shift, *look)
        _draw_bins(histogram, one, *look)
    for reference in PAPER:
        _draw_reference(by_kind[reference.measure], reference)
    *by_distance, positions = by_kind.values()
    return [*by_distance, histogram, *([] if positions.empty else [positions])]


def _part(series: Series, prefix: str) -> str:
    return repr([(k, v) for k, v in series.labels.items() if k.startswith(prefix)])


def _draw_segments(plot: Plot, series: Series, kind: str, shift: float, colour: str, dash: Dash) -> None:
    """Draw a figure of each segment with its interval; on a logarithmic axis, none is an upper limit."""
    xs, ys, labels, holes, ends = [], [], [], [], []
    for begin, recordings in series.segments:
        figure = measure(recordings, kind)
        if not figure.count:
            continue
        none = plot.log_y and figure.none
        x, y = begin + SEGMENT_M / 2 + shift, figure.high if none else figure.value
        shown = f"below {figure.high:.2g}" if none else f"{figure.value:.4g}"
        what = _counts(Tally.together(recordings), kind)
        labels.append(
            f"{series.name}\n{begin} to {begin + SEGMENT_M} m: {shown}\n{_interval(figure)}\n{what}"
        )
        xs.append(x)
        ys.append(y)
        ends.append((y, y) if none else (figure.low, figure.high))
        holes.append(y if none else math.nan)
    plot.line(xs, ys, colour, series.name, dash)
    plot.dots(xs, ys, colour, series.name, labels)
    plot.line(xs, holes, colour, series.name, kind="hole")
    for x, (low, high) in zip(xs, ends, strict=True):
        plot.line([x, x], [low, high], colour, series.name, kind="stem")


def _counts(tally: Tally, kind: str) -> str:
    """What a figure was counted on."""
    return {
        "ber": f"{tally.bit_errors} of {tally.bits} bits wrong",
        "rmse_m": f"{tally.ranged} distances, bias {tally.bias_m:+.3f} m",
        "gross_share": f"{tally.gross} of {tally.ranged} distances",
        "found_share": f"{tally.frames_found} of {tally.frames_sent} frames",
        "position_rmse_m": f"{tally.fixes} position{'s' * (tally.fixes != 1)},"
        f" half within {tally.position_median_m:.3f} m,"
        f" 95 % within {tally.position_95_m:.3f} m; {tally.fixes_refused} refused",
    }[kind]


def _interval(figure: Figure) -> str:
    """What the ends of an error bar are."""
    if math.isnan(figure.high):
        return "one recording: no interval"
    few = figure.recordings < FEWEST_RECORDINGS and not figure.none
    kind = f"range of {figure.recordings} recordings" if few else "95 %"
    return f"{kind}: {figure.low:.3g} to {figure.high:.3g}"


def _draw_bins(plot: Plot, series: Series, colour: str, dash: Dash) -> None:
    """Draw the outline of a histogram."""
    tally = series.statistics.total()
    if not tally.ranged:
        return
    counts = tally.histogram
    bins = range(min(counts) - 1, max(counts) + 2)
    shares = [counts.get(bin, 0) / tally.ranged for bin in bins]
    edges = [bin * BIN_M for bin in (*bins, bins[-1] + 1)]
    plot.line(
        [edge for edge in edges for _ in (0, 1)][1:-1],
        [share for share in shares for _ in (0, 1)],
        colour,
        series.name,
        dash,
    )
    labels = [
        f"{series.name}\n{low:+.2f} to {low + BIN_M:+.2f} m: {counts.get(bin, 0)} of {tally.ranged}"
        for bin, low in zip(bins, edges, strict=False)
    ]
    plot.label([low + BIN_M / 2 for low in edges[:-1]], shares, labels, series.name)


def _draw_reference(plot: Plot, reference: Reference) -> None:
    """Draw a figure of the paper as a level, and write it above."""
    clusters, speed_kmh = reference.clusters, reference.speed_kmh
    parts = [f"{clusters} cluster{'s' * (clusters != 1)}"] if clusters and speed_kmh else []
    parts += [f"{speed_kmh:g} km/h"] if speed_kmh else ["20 to 40 km/h"]
    name = f"{PAPER_NAME}: {', '.join(parts)}"
    text = f"{'at most ' * reference.bound}{reference.value:g}"
    x = [reference.from_m, (reference.from_m + reference.to_m) / 2, reference.to_m]
    y = [reference.value] * 3
    plot.line(x, y, INK, name, DASHES[1] if clusters == 2 else (), "level")
    plot.label(x, y, [f"{name}\n{x[0]:g} to {x[2]:g} m: {text}"] * 3, name)
    plot.name(reference.from_m, reference.value, text + (f" ({clusters})" if clusters else ""))
