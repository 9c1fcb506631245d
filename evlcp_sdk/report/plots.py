"""Charts of lines, bands and dots, put together once, shown in pages and drawn by `report.drawing`.

In a page they are SVG and HTML of our own: as wide as the page, dark by night, values where one points,
lines shown or hidden by their names. A chart's lines are stretched to its box, its texts are not, so that it
is read as well on a phone.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib.resources import files

import numpy as np
from markupsafe import Markup
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.report.pages import TEMPLATES

SCRIPT = files("evlcp_sdk.report").joinpath("plots.js").read_text(encoding="utf-8")
"""What a page with charts runs; it reads `Plot.labels`, under `plots` of the page's data."""

INK = "var(--ink)"
"""The colour of the page's text."""

DASHES = ((), (8, 4), (2, 3), (8, 3, 2, 3))
"""Patterns that lines differ in, in widths of a line."""

WIDTHS_PX = {"line": 1.6, "stem": 1.2, "level": 3.0, "dots": 5.0, "ring": 1.0}
"""How thick lines and dots are."""

_SIDE = 2000
"""Steps of a chart's box in either direction."""

_STYLES = {
    "band": "fill:{colour};fill-opacity:0.25",
    "line": "stroke:{colour};stroke-width:{width}px;stroke-dasharray:{dash}",
    "stem": "stroke:{colour};stroke-width:{width}px",
    "level": "stroke:{colour};stroke-width:{width}px;stroke-dasharray:{dash}",
    "dots": "stroke:{colour};stroke-width:{width}px;stroke-linecap:round",
    "ring": "stroke:{colour};stroke-width:{width}px;stroke-opacity:0.7",
}
"""How shapes are drawn, the lowest first."""


@dataclass(frozen=True, eq=False)
class Shape:
    """What is drawn in one piece.

    Attributes:
        kind: A key of `_STYLES`.
        colour: As pages write it.
        points: Float64 (n, 2).
        name: What it belongs to, in the legend; empty for nothing.
        dash: One of `DASHES`.
    """

    kind: str
    colour: str
    points: NDArray[np.float64]
    name: str = ""
    dash: Sequence[int] = ()


@dataclass(eq=False)
class Plot:
    """One chart, put together line by line.

    Args:
        id: Of its element in the page, and its file's name.
        x_name, y_name: What its axes are, with the unit.
        note: What a reader must know of it.
        aspect: Width by height of its box, in which x and y are then to one scale; None for a low wide box,
            filled by what is shown.
        down: y grows downwards, as rows of an image do.
        x_limits, y_limits: Ends of the axes; None for what is shown.

    Attributes:
        shapes: What is drawn.
        names: What is written beside a point: x, y, text.
        legend: What the names stand for: one of the shapes of each.
        labels: What is shown where the pointer is: x, y in thousandths of the box, a text, and the number of
            its name in the legend or -1; once `markup` was asked for.
    """

    id: str
    x_name: str
    y_name: str
    title: str = ""
    note: str = ""
    aspect: float | None = None
    down: bool = False
    log_y: bool = False
    from_zero: bool = False
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None
    shapes: list[Shape] = field(default_factory=list)
    names: list[tuple[float, float, str]] = field(default_factory=list)
    legend: dict[str, Shape] = field(default_factory=dict)
    labels: list[tuple[int, int, str, int]] = field(default_factory=list)
    _labelled: list[tuple[float, float, str, str]] = field(default_factory=list)

    def _draw(self, shape: Shape) -> None:
        self.shapes.append(shape)
        if shape.name:
            self.legend.setdefault(shape.name, shape)

    def dots(
        self, x: ArrayLike, y: ArrayLike, colour: str, name: str = "", labels: Sequence[str] = ()
    ) -> None:
        """Draw points; those that are not finite are left out, with their labels."""
        points = _points(x, y)
        self._draw(Shape("dots", colour, points[_known(points)], name))
        self.label(x, y, labels, name)

    def label(self, x: ArrayLike, y: ArrayLike, labels: Sequence[str], name: str = "") -> None:
        """Say something where the pointer is on one of these points."""
        points = _points(x, y)
        self._labelled += [
            (px, py, text, name)
            for (px, py), text, good in zip(points.tolist(), labels, _known(points).tolist(), strict=False)
            if good
        ]

    def line(
        self,
        x: ArrayLike,
        y: ArrayLike,
        colour: str,
        name: str = "",
        dash: Sequence[int] = (),
        kind: str = "line",
    ) -> None:
        """Draw a line, with a gap where a value is not finite."""
        points = _points(x, y)
        for part in _runs(_known(points)):
            self._draw(Shape(kind, colour, points[part], name, dash))

    def band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, colour: str, name: str = "") -> None:
        """Fill what is between two lines, with a gap where a value is not finite."""
        lower, upper = _points(x, low), _points(x, high)
        for part in _runs(_known(lower) & _known(upper)):
            self._draw(Shape("band", colour, np.concatenate([lower[part], upper[part][::-1]]), name))

    def ring(self, points: NDArray[np.float64], colour: str, name: str = "") -> None:
        """Draw a closed line through points, float64 (n, 2)."""
        self._draw(Shape("ring", colour, points, name))

    def name(self, x: float, y: float, text: str) -> None:
        """Write a name beside a point."""
        self.names.append((x, y, text))

    @property
    def empty(self) -> bool:
        """Nothing is drawn in it."""
        return not any(len(shape.points) for shape in self.shapes)

    def markup(self) -> Markup:
        """The chart."""
        (x0, x1), (y0, y1) = limits = self._limits()

        def place(points: Sequence[tuple[float, float]] | NDArray[np.float64]) -> NDArray[np.float64]:
            """Where points are in the box, as shares of it."""
            share = (self._scaled(np.reshape(points, (-1, 2))) - (x0, y0)) / (x1 - x0, y1 - y0)
            if not self.down:
                share[:, 1] = 1 - share[:, 1]
            return share

        across, upwards = _ticks(*limits[0]), (log_ticks if self.log_y else _ticks)(*limits[1])
        number = {name: i for i, name in enumerate(self.legend)}
        at = place([(x, y) for x, y, _, _ in self._labelled]).tolist()
        self.labels = [
            (round(1000 * x), round(1000 * y), text, number.get(name, -1))
            for (x, y), (_, _, text, name) in zip(at, self._labelled, strict=True)
        ]
        shown = TEMPLATES.get_template("plot.html").render(
            plot=self,
            side=_SIDE,
            columns=list(zip(across, place([(x, 1.0) for x in across])[:, 0].tolist(), strict=True)),
            rows=list(zip(upwards, place([(x0, y) for y in upwards])[:, 1].tolist(), strict=True)),
            paths=[
                (number.get(shape.name, -1), _style(shape), _path(place(shape.points), kind))
                for kind in _STYLES
                for shape in self.shapes
                if shape.kind == kind and len(shape.points)
            ],
            names=[(*place([(x, y)])[0].tolist(), text) for x, y, text in self.names],
            legend=[(name, _style(shape)) for name, shape in self.legend.items()],
        )
        return Markup(shown)

    def _scaled(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points as they stand on the axes: a logarithmic one has no 0."""
        if not self.log_y:
            return points
        return np.column_stack([points[:, 0], np.log10(np.maximum(points[:, 1], 1e-300))])

    def _limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        shown = [shape.points for shape in self.shapes if len(shape.points)]
        points = np.concatenate(shown) if shown else np.zeros((1, 2))
        if self.log_y:
            positive = points[points[:, 1] > 0]
            points = self._scaled(positive) if len(positive) else np.zeros((1, 2))
        limits = []
        for fixed, column in ((self.x_limits, 0), (self.y_limits, 1)):
            low, high = float(points[:, column].min()), float(points[:, column].max())
            room = 0.04 * (high - low) or 0.5
            limits.append(fixed or (low - room, high + room))
        (x0, x1), (y0, y1) = limits
        if self.from_zero:
            y0 = 0.0
        if self.aspect is not None and self.x_limits is None:
            # One scale for both: the shorter side gets the room that it lacks.
            more_x = (y1 - y0) * self.aspect - (x1 - x0)
            more_y = (x1 - x0) / self.aspect - (y1 - y0)
            x0, x1 = x0 - max(more_x, 0) / 2, x1 + max(more_x, 0) / 2
            y0, y1 = y0 - max(more_y, 0) / 2, y1 + max(more_y, 0) / 2
        return (x0, x1), (y0, y1)


def _style(shape: Shape) -> str:
    dash = " ".join(map(str, shape.dash)) or "none"
    return _STYLES[shape.kind].format(colour=shape.colour, width=WIDTHS_PX.get(shape.kind), dash=dash)


def _ticks(low: float, high: float) -> list[float]:
    return [float(v) for v in MaxNLocator(5).tick_values(low, high) if low <= v <= high]


def log_ticks(low: float, high: float) -> list[float]:
    """Ticks of a logarithmic axis from 10^low to 10^high; over less than a step of 1, 2, 5, even ones."""
    ticks = LogLocator(subs=(1.0, 2.0, 5.0) if high - low < 2 else (1.0,)).tick_values(10**low, 10**high)
    inside = [float(v) for v in ticks if low <= math.log10(v) <= high]
    return inside if len(inside) > 1 else _ticks(10**low, 10**high)


def _points(x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
    return np.column_stack([np.asarray(x, np.float64), np.asarray(y, np.float64)])


def _known(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.isfinite(points[:, 0]) & np.isfinite(points[:, 1])


def _runs(known: NDArray[np.bool_]) -> Iterable[slice]:
    """Where values follow one another without a gap."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], known.astype(np.int8), [0]])))
    return [slice(a, b) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]


def _path(share: NDArray[np.float64], kind: str) -> str:
    # Far beyond the box, where it makes no difference.
    steps = np.clip(np.rint(share * _SIDE), -10 * _SIDE, 10 * _SIDE).astype(int).tolist()
    if kind == "dots":
        return "".join(f"M{x} {y}h0" for x, y in steps)
    return "M" + "L".join(f"{x} {y}" for x, y in steps) + ("Z" if kind in ("band", "ring") else "")


def ellipse(
    centre: NDArray[np.float64], covariance: NDArray[np.float64], share: float
) -> NDArray[np.float64]:
    """The line around which a share of a normal distribution of the plane lies within, float64 (48, 2)."""
    values, ways = np.linalg.eigh(covariance)
    # The quantile of chi squared with two degrees of freedom.
    long = np.sqrt(-2 * math.log(1 - share) * np.maximum(values, 0))
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    found: NDArray[np.float64] = centre + (np.column_stack([np.cos(turn), np.sin(turn)]) * long) @ ways.T
    return found


def enlarge_ellipses(covariances_m2: Sequence[NDArray[np.float64]], places: NDArray[np.float64]) -> int:
    """How many times as large 95 % ellipses are to be drawn to be seen beside a track of places."""
    extent_m = float(np.ptp(places[:, :2], axis=0).max())
    longest_m2 = [np.linalg.eigvalsh(covariance[:2, :2]).max() for covariance in covariances_m2]
    # 95 % lie within 2.45 sigmas; a diameter is twice that.
    long_m = 4.9 * math.sqrt(float(np.median(longest_m2)))
    seen = [times for times in (1, 2, 5, 10, 20, 50) if times * long_m <= _ELLIPSE_SHARE * extent_m]
    return max(seen, default=1)


_ELLIPSE_SHARE = 0.15
"""Length of an ellipse beside the extent of its track, at most, where it is drawn larger than it is."""
