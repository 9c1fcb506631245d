"""Charts of a page as SVG and HTML of our own: as wide as the page, dark by night, values where one points.

A chart's lines are stretched to its box, its texts are not, so that it is read as well on a phone. What it
shows where the pointer is comes from `Plot.labels`, which the page's script reads.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from markupsafe import Markup
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.report.pages import TEMPLATES

_SIDE = 2000
"""Steps of a chart's box in either direction."""

_STYLES = {
    "band": "fill:{0};fill-opacity:0.25",
    "line": "stroke:{0};stroke-width:1.6px",
    "dots": "stroke:{0};stroke-width:5px;stroke-linecap:round",
    "ring": "stroke:{0};stroke-width:1px;stroke-opacity:0.7",
}
"""How shapes are drawn, the lowest first."""


@dataclass(eq=False)
class Plot:
    """One chart, put together line by line.

    Args:
        id: Of its element in the page.
        x_name: What its x axis is, with the unit.
        y_name: The same of y.
        aspect: Width by height of its box, in which x and y are then to one scale; None for a low wide box,
            filled by what is shown.
        down: y grows downwards, as rows of an image do.
        y_limits: Ends of the y axis; None for what is shown. With `x_limits` an image's.
        x_limits: The same of x.

    Attributes:
        labels: What is shown where the pointer is: x, y in thousandths of the box, and a text; once `markup`
            was asked for.
    """

    id: str
    x_name: str
    y_name: str
    aspect: float | None = None
    down: bool = False
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None
    labels: list[tuple[int, int, str]] = field(default_factory=list)
    _shapes: list[tuple[str, str, NDArray[np.float64]]] = field(default_factory=list)
    _labelled: list[tuple[float, float, str]] = field(default_factory=list)
    _names: list[tuple[float, float, str]] = field(default_factory=list)
    _legend: dict[str, str] = field(default_factory=dict)

    def dots(
        self, x: ArrayLike, y: ArrayLike, colour: str, name: str = "", labels: Sequence[str] = ()
    ) -> None:
        """Draw points; those that are not finite are left out, with their labels."""
        points = _points(x, y)
        known = _known(points)
        self._shapes.append(("dots", colour, points[known]))
        labels = [text for text, good in zip(labels, known.tolist(), strict=False) if good]
        self._labelled += [
            (px, py, text) for (px, py), text in zip(points[known].tolist(), labels, strict=False)
        ]
        if name:
            self._legend[name] = colour

    def line(self, x: ArrayLike, y: ArrayLike, colour: str, name: str = "") -> None:
        """Draw a line, with a gap where a value is not finite."""
        points = _points(x, y)
        for part in _runs(_known(points)):
            self._shapes.append(("line", colour, points[part]))
        if name:
            self._legend[name] = colour

    def band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, colour: str) -> None:
        """Fill what is between two lines, with a gap where a value is not finite."""
        lower, upper = _points(x, low), _points(x, high)
        for part in _runs(_known(lower) & _known(upper)):
            self._shapes.append(("band", colour, np.concatenate([lower[part], upper[part][::-1]])))

    def ring(self, points: NDArray[np.float64], colour: str, name: str = "") -> None:
        """Draw a closed line through points, float64 (n, 2)."""
        self._shapes.append(("ring", colour, points))
        if name:
            self._legend[name] = colour

    def name(self, x: float, y: float, text: str) -> None:
        """Write a name beside a point."""
        self._names.append((x, y, text))

    @property
    def empty(self) -> bool:
        """Nothing is drawn in it."""
        return not any(len(points) for _, _, points in self._shapes)

    def markup(self) -> Markup:
        """The chart."""
        (x0, x1), (y0, y1) = limits = self._limits()

        def place(points: Sequence[tuple[float, float]] | NDArray[np.float64]) -> NDArray[np.float64]:
            """Where points are in the box, as shares of it."""
            share = (np.reshape(points, (-1, 2)) - (x0, y0)) / (x1 - x0, y1 - y0)
            if not self.down:
                share[:, 1] = 1 - share[:, 1]
            return share

        across, upwards = (_ticks(*one) for one in limits)
        at = place([(x, y) for x, y, _ in self._labelled]).tolist()
        self.labels = [
            (round(1000 * x), round(1000 * y), text)
            for (x, y), (_, _, text) in zip(at, self._labelled, strict=True)
        ]
        shown = TEMPLATES.get_template("plot.html").render(
            plot=self,
            side=_SIDE,
            columns=list(zip(across, place([(x, y0) for x in across])[:, 0].tolist(), strict=True)),
            rows=list(zip(upwards, place([(x0, y) for y in upwards])[:, 1].tolist(), strict=True)),
            paths=[
                (style.format(colour), _path(place(points), kind))
                for kind, style in _STYLES.items()
                for shape, colour, points in self._shapes
                if shape == kind and len(points)
            ],
            names=[(*place([(x, y)])[0].tolist(), text) for x, y, text in self._names],
            legend=self._legend,
        )
        return Markup(shown)

    def _limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        shown = [points for _, _, points in self._shapes if len(points)]
        points = np.concatenate(shown) if shown else np.zeros((1, 2))
        limits = []
        for fixed, column in ((self.x_limits, 0), (self.y_limits, 1)):
            low, high = float(points[:, column].min()), float(points[:, column].max())
            room = 0.04 * (high - low) or 0.5
            limits.append(fixed or (low - room, high + room))
        (x0, x1), (y0, y1) = limits
        if self.aspect is not None and self.x_limits is None:
            # One scale for both: the shorter side gets the room that it lacks.
            more_x = (y1 - y0) * self.aspect - (x1 - x0)
            more_y = (x1 - x0) / self.aspect - (y1 - y0)
            x0, x1 = x0 - max(more_x, 0) / 2, x1 + max(more_x, 0) / 2
            y0, y1 = y0 - max(more_y, 0) / 2, y1 + max(more_y, 0) / 2
        return (x0, x1), (y0, y1)


def _ticks(low: float, high: float) -> list[float]:
    return [float(v) for v in MaxNLocator(5).tick_values(low, high) if low <= v <= high]


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
    return "M" + "L".join(f"{x} {y}" for x, y in steps) + ("" if kind == "line" else "Z")


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
