"""Charts of lines, bands and dots, composed once, shown in pages and drawn by `report.drawing`.

In a page they are our own SVG and HTML: as wide as the page, dark by night, with values at the pointer, and
lines that are shown or hidden by their names. A chart's lines are stretched to its box, its texts are not, so
that it is legible on a phone.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib.resources import files

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.report.pages import TEMPLATES

SCRIPT = files("evlcp_sdk.report").joinpath("plots.js").read_text(encoding="utf-8")
"""Script of a page with charts; it reads the labels of `render_plot`, under `plots` of the page's data."""

INK = "var(--ink)"
"""The colour of the page's text."""

DASHES = ((), (8, 4), (2, 3), (8, 3, 2, 3))
"""Dash patterns of lines, in widths of a line."""

WIDTHS_PX = {"line": 1.6, "stem": 1.2, "level": 3.0, "dots": 5.0, "ring": 1.0}
"""Widths of lines and dots."""

_BOX_STEPS = 2000
"""Steps of a chart's box in either direction."""

_SHAPE_STYLES = {
    "band": "fill:{colour};fill-opacity:0.25",
    "line": "stroke:{colour};stroke-width:{width}px;stroke-dasharray:{dash}",
    "stem": "stroke:{colour};stroke-width:{width}px",
    "level": "stroke:{colour};stroke-width:{width}px;stroke-dasharray:{dash}",
    "dots": "stroke:{colour};stroke-width:{width}px;stroke-linecap:round",
    "ring": "stroke:{colour};stroke-width:{width}px;stroke-opacity:0.7",
}
"""CSS of shapes, the lowest first."""


@dataclass(frozen=True, eq=False)
class Shape:
    """One drawn element.

    Attributes:
        kind: A key of `_SHAPE_STYLES`.
        colour: As CSS.
        points: Float64 (n, 2).
        name: Its entry in the legend; empty for none.
        dash: One of `DASHES`.
    """

    kind: str
    colour: str
    points: NDArray[np.float64]
    name: str = ""
    dash: Sequence[int] = ()


@dataclass(eq=False)
class Plot:
    """One chart, composed line by line.

    Args:
        id: Of its element in the page, and its file's name.
        x_name, y_name: Names of its axes, with the unit.
        note: For the reader.
        aspect: Width by height of its box, in which x and y then have one scale; None for a low wide box,
            filled by the data.
        x_limits, y_limits: Ends of the axes, left and right, bottom and top; None for those of the data.

    Attributes:
        shapes: What is drawn.
        names: Texts beside points: x, y, text.
        legend: One of the shapes of each name.
        labels: Texts at the pointer: x, y, a text, and its name in the legend; empty for none.
    """

    id: str
    x_name: str
    y_name: str
    title: str = ""
    note: str = ""
    aspect: float | None = None
    log_y: bool = False
    from_zero: bool = False
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None
    shapes: list[Shape] = field(default_factory=list)
    names: list[tuple[float, float, str]] = field(default_factory=list)
    legend: dict[str, Shape] = field(default_factory=dict)
    labels: list[tuple[float, float, str, str]] = field(default_factory=list)

    def _add_shape(self, shape: Shape) -> None:
        self.shapes.append(shape)
        if shape.name:
            self.legend.setdefault(shape.name, shape)

    def add_dots(
        self, x: ArrayLike, y: ArrayLike, colour: str, name: str = "", labels: Sequence[str] = ()
    ) -> None:
        """Draw points; those that are not finite are left out, with their labels."""
        points = _stack_points(x, y)
        self._add_shape(Shape("dots", colour, points[np.isfinite(points).all(1)], name))
        self.add_labels(x, y, labels, name)

    def add_labels(self, x: ArrayLike, y: ArrayLike, labels: Sequence[str], name: str = "") -> None:
        """Add texts for the pointer on these points."""
        points = _stack_points(x, y)
        self.labels += [
            (px, py, text, name)
            for (px, py), text in zip(points.tolist(), labels, strict=False)
            if math.isfinite(px) and math.isfinite(py)
        ]

    def add_line(
        self,
        x: ArrayLike,
        y: ArrayLike,
        colour: str,
        name: str = "",
        dash: Sequence[int] = (),
        kind: str = "line",
    ) -> None:
        """Draw a line, with a gap where a value is not finite."""
        points = _stack_points(x, y)
        for part in _find_runs(points):
            self._add_shape(Shape(kind, colour, points[part], name, dash))

    def add_band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, colour: str, name: str = "") -> None:
        """Fill the area between two lines, with a gap where a value is not finite."""
        lower, upper = _stack_points(x, low), _stack_points(x, high)
        for part in _find_runs(np.column_stack([lower, upper])):
            self._add_shape(Shape("band", colour, np.concatenate([lower[part], upper[part][::-1]]), name))

    def add_name(self, x: float, y: float, text: str) -> None:
        """Write a text beside a point."""
        self.names.append((x, y, text))

    @property
    def is_empty(self) -> bool:
        """Whether nothing is drawn in it."""
        return not any(len(shape.points) for shape in self.shapes)


def set_scales(axis: Axes, plot: Plot) -> None:
    """Set scale, limits and aspect of axes that hold a chart's points."""
    if plot.log_y:
        axis.set_yscale("log")
    if plot.from_zero:
        axis.set_ylim(bottom=0)
    if plot.x_limits is not None:
        axis.set_xlim(*plot.x_limits)
    if plot.y_limits is not None:
        axis.set_ylim(*plot.y_limits)
    if plot.aspect is not None:
        axis.set_aspect("equal", adjustable="datalim")


PlacedLabel = tuple[int, int, str, int]
"""A text at the pointer: x, y in thousandths of the box, the text, and the number of its name or -1."""


def render_plot(plot: Plot) -> tuple[Markup, list[PlacedLabel]]:
    """Render a chart as HTML; its labels are for the page's script, under `plots` and the chart's id."""
    axis = Figure((plot.aspect or 1, 1)).add_axes((0, 0, 1, 1))
    for shape in plot.shapes:
        axis.update_datalim(shape.points)
    axis.autoscale_view()
    set_scales(axis, plot)
    axis.apply_aspect()
    # Shares of the box are from the top.
    axis.invert_yaxis()
    to_box = axis.transData - axis.transAxes

    def place(points: Sequence[tuple[float, float]] | NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(to_box.transform(np.reshape(points, (-1, 2))))

    x_ticks = _linear_ticks(*axis.get_xbound())
    y_ticks = log_ticks(*axis.get_ybound()) if plot.log_y else _linear_ticks(*axis.get_ybound())
    numbers = {name: i for i, name in enumerate(plot.legend)}
    html = TEMPLATES.get_template("plot.html").render(
        plot=plot,
        side=_BOX_STEPS,
        columns=list(zip(x_ticks, place([(x, 1.0) for x in x_ticks])[:, 0].tolist(), strict=True)),
        rows=list(zip(y_ticks, place([(0.0, y) for y in y_ticks])[:, 1].tolist(), strict=True)),
        paths=[
            (numbers.get(shape.name, -1), _shape_style(shape), _svg_path(place(shape.points), kind))
            for kind in _SHAPE_STYLES
            for shape in plot.shapes
            if shape.kind == kind and len(shape.points)
        ],
        names=[(*place([(x, y)])[0].tolist(), text) for x, y, text in plot.names],
        legend=[(name, _shape_style(shape)) for name, shape in plot.legend.items()],
    )
    places = np.rint(1000 * place([(x, y) for x, y, _, _ in plot.labels])).astype(int).tolist()
    labels = [
        (x, y, text, numbers.get(name, -1))
        for (x, y), (_, _, text, name) in zip(places, plot.labels, strict=True)
    ]
    return Markup(html), labels


def _shape_style(shape: Shape) -> str:
    dash = " ".join(map(str, shape.dash)) or "none"
    return _SHAPE_STYLES[shape.kind].format(colour=shape.colour, width=WIDTHS_PX.get(shape.kind), dash=dash)


def _linear_ticks(low: float, high: float) -> list[float]:
    return [float(v) for v in MaxNLocator(5).tick_values(low, high) if low <= v <= high]


def log_ticks(low: float, high: float) -> list[float]:
    """Ticks of a logarithmic axis between two numbers; even ones over less than a step of 1, 2, 5."""
    ticks = LogLocator(subs=(1.0, 2.0, 5.0) if high < 100 * low else (1.0,)).tick_values(low, high)
    inside = [float(v) for v in ticks if low <= v <= high]
    return inside if len(inside) > 1 else _linear_ticks(low, high)


def _stack_points(x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
    return np.column_stack([np.asarray(x, np.float64), np.asarray(y, np.float64)])


def _find_runs(points: NDArray[np.float64]) -> Iterable[slice]:
    finite = np.isfinite(points).all(1).astype(np.int8)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], finite, [0]])))
    return [slice(a, b) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]


def _svg_path(share: NDArray[np.float64], kind: str) -> str:
    # Far beyond the box, a clipped point makes no difference.
    steps = np.clip(np.rint(share * _BOX_STEPS), -10 * _BOX_STEPS, 10 * _BOX_STEPS).astype(int).tolist()
    if kind == "dots":
        return "".join(f"M{x} {y}h0" for x, y in steps)
    return "M" + "L".join(f"{x} {y}" for x, y in steps) + ("Z" if kind in ("band", "ring") else "")


def ellipse_points(
    centre: NDArray[np.float64], covariance: NDArray[np.float64], share: float
) -> NDArray[np.float64]:
    """Outline of the ellipse that holds a share of a normal distribution of the plane, float64 (48, 2)."""
    variances, axes = np.linalg.eigh(covariance)
    # The quantile of chi squared with two degrees of freedom.
    lengths = np.sqrt(-2 * math.log(1 - share) * np.maximum(variances, 0))
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    return np.asarray(centre + (circle * lengths) @ axes.T)


def choose_ellipse_scale(covariances_m2: Sequence[NDArray[np.float64]], places: NDArray[np.float64]) -> int:
    """Choose the factor by which 95 % ellipses are enlarged to be visible beside a track of places."""
    extent_m = float(np.ptp(places[:, :2], axis=0).max())
    longest_m2 = [np.linalg.eigvalsh(covariance[:2, :2]).max() for covariance in covariances_m2]
    # 95 % lie within 2.45 sigmas; a diameter is twice that.
    diameter_m = 4.9 * math.sqrt(float(np.median(longest_m2)))
    scales = [scale for scale in (1, 2, 5, 10, 20, 50) if scale * diameter_m <= _ELLIPSE_SHARE * extent_m]
    return max(scales, default=1)


_ELLIPSE_SHARE = 0.15
"""Largest length of an enlarged ellipse as a share of its track's extent."""
