"""Charts drawn by Matplotlib in one style: for papers, and for figures beside a result."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import NullLocator, StrMethodFormatter

from evlcp_sdk.files import Outputs, writing
from evlcp_sdk.report.plots import INK, WIDTHS_PX, Plot, Shape, log_ticks, set_scales

INK_COLOUR = "#333333"


def set_heading(axis: Axes, text: str) -> None:
    """Set a small heading on the left."""
    axis.set_title(text, loc="left", fontsize=10, color=INK_COLOUR, parse_math=False)


def style_axes(axis: Axes) -> None:
    """Style axes: without a frame, with a pale grid behind the data."""
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    axis.grid(color="#e6e6e6", lw=0.8)
    axis.set_axisbelow(True)


def draw_plot(plot: Plot, title: str) -> Figure:
    """Draw a chart with its legend below."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axis = figure.subplots()
    _draw_axes(axis, plot)
    set_heading(axis, f"{title}: {plot.title}")
    # A column is as wide as the longest name.
    columns = max(1, min(len(plot.legend), 110 // (8 + max(map(len, plot.legend), default=0))))
    _draw_legend(figure, axis, plot, "outside lower left", columns)
    return figure


def draw_plots(plots: Sequence[Plot], title: str) -> Figure:
    """Draw charts in two columns."""
    rows = max(1, (len(plots) + 1) // 2)
    figure = Figure(figsize=(12, 3.4 * rows), layout="constrained")
    for number, plot in enumerate(plots, 1):
        axis = figure.add_subplot(rows, 2, number)
        _draw_axes(axis, plot)
        set_heading(axis, plot.title)
        _draw_legend(axis, axis, plot, "best", 1)
    figure.suptitle(title, fontsize=11, color=INK_COLOUR, parse_math=False)
    return figure


def _draw_axes(axis: Axes, plot: Plot) -> None:
    for shape in plot.shapes:
        _draw_shape(axis, shape)
    middle = sum(x for x, _, _ in plot.names) / max(len(plot.names), 1)
    for x, y, text in plot.names:
        # Outward, so that neighbours do not cover each other's names.
        axis.annotate(
            text, (x, y), xytext=(0, 3), textcoords="offset points", fontsize=8, color=INK_COLOUR,
            ha="right" if x < middle else "left", path_effects=[withStroke(linewidth=3, foreground="white")],
        )  # fmt: skip
    set_scales(axis, plot)
    if plot.log_y:
        axis.set_yticks(log_ticks(*axis.get_ylim()))
        axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.yaxis.set_minor_locator(NullLocator())
    axis.set(xlabel=plot.x_name, ylabel=plot.y_name)
    style_axes(axis)


def _draw_legend(owner: Any, axis: Axes, plot: Plot, location: str, columns: int) -> None:
    if plot.legend:
        handles = [_draw_shape(axis, shape, legend=True) for shape in plot.legend.values()]
        legend = owner.legend(handles, [*plot.legend], loc=location, frameon=False, fontsize=8, ncols=columns)
        for entry in legend.get_texts():
            entry.set_parse_math(False)


def _draw_shape(axis: Axes, shape: Shape, *, legend: bool = False) -> Any:
    colour = INK_COLOUR if shape.colour == INK else shape.colour
    x, y = ((), ()) if legend else shape.points.T
    if shape.kind == "band":
        return axis.fill(x, y, color=colour, alpha=0.25, lw=0)[0]
    width = WIDTHS_PX[shape.kind]
    if shape.kind == "dots":
        return axis.plot(x, y, "o", ms=width, mec="none", mfc=colour, zorder=4)[0]
    style = (0, tuple(shape.dash)) if shape.dash else "-"
    return axis.plot(x, y, ls=style, lw=0.75 * width, color=colour, zorder=3)[0]


def save_plots(plots: Sequence[Plot], title: str, folder: Path, outputs: Outputs) -> None:
    """Save charts as PNG and SVG, named by their id, in a folder that is created if needed.

    Raises:
        OutputError: A file cannot be written.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for plot in plots:
        figure = draw_plot(plot, title)
        for kind in ("png", "svg"):
            path = folder / f"{plot.id}.{kind}"
            with writing(path):
                figure.savefig(outputs.path(path), format=kind, dpi=150)
