"""Charts of a page as SVG and HTML of our own: as wide as the page, dark by night, values where one points.

A chart's lines are stretched to its box, its texts are not, so that it is read as well on a phone. What it
tells where the pointer is comes from `Plot.told`, which the page's script reads.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.report.markup import Markup

__all__ = ["PLOT_STYLE", "Plot", "ellipse"]

PLOT_STYLE = """
.plot { margin: 0.4rem 0 1.2rem } .plot .legend { color: var(--dim); font-size: 0.85rem }
.legend i { display: inline-block; width: 0.8em; height: 0.8em; border-radius: 50%; margin-right: 0.3em }
.legend span { white-space: nowrap; margin-right: 0.7em }
.area { position: relative; margin: 1.5rem 0.5rem 2.6rem 3.4rem; border-left: 1px solid var(--dim);
  border-bottom: 1px solid var(--dim); touch-action: pan-y }
.area svg { position: absolute; inset: 0; width: 100%; height: 100%; overflow: hidden }
.area path { fill: none; vector-effect: non-scaling-stroke } .area path.grid { stroke: var(--line) }
@media (prefers-color-scheme: dark) { .area svg, .legend i { filter: brightness(1.3) } }
.area span { position: absolute; color: var(--dim); font-size: 0.75rem; line-height: 1; white-space: nowrap }
.area .x { top: calc(100% + 0.4rem); transform: translateX(-50%) }
.area .y { right: calc(100% + 0.4rem); transform: translateY(-50%) }
.area .xname { top: calc(100% + 1.5rem); right: 0 }
.area .yname { left: -3.2rem; bottom: calc(100% + 0.5rem) }
.area .named { transform: translate(0.5rem, -50%); color: var(--ink) }
.area .tip { position: absolute; z-index: 1; pointer-events: none; background: var(--paper);
  color: var(--ink); border: 1px solid var(--dim); border-radius: 0.3rem; padding: 0.25rem 0.5rem;
  font-size: 0.8rem; white-space: pre; max-width: 15rem }
.area .at { position: absolute; width: 9px; height: 9px; margin: -6px; border: 2px solid var(--ink);
  border-radius: 50%; pointer-events: none }
"""

_SIDE = 2000
"""Steps of a chart's box in either direction."""


@dataclass(eq=False)
class Plot:
    """One chart, put together line by line.

    Args:
        id: Of its element in the page.
        x_name: What its x axis says, with the unit.
        y_name: The same of y.
        aspect: Width by height of its box, in which x and y are then to one scale; None for a low wide box,
            filled by what is shown.
        down: y grows downwards, as rows of an image do.
        y_limits: Ends of the y axis; None for what is shown. With `x_limits` an image's.
        x_limits: The same of x.

    Attributes:
        told: What is said where the pointer is: x, y in thousandths of the box, and a text; once `markup` was
            asked for.
    """

    id: str
    x_name: str
    y_name: str
    aspect: float | None = None
    down: bool = False
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None
    told: list[tuple[int, int, str]] = field(default_factory=list)
    _shapes: list[tuple[str, str, NDArray[np.float64]]] = field(default_factory=list)
    _said: list[tuple[float, float, str]] = field(default_factory=list)
    _names: list[tuple[float, float, str]] = field(default_factory=list)
    _legend: dict[str, str] = field(default_factory=dict)

    def dots(self, x: ArrayLike, y: ArrayLike, colour: str, name: str = "", said: Sequence[str] = ()) -> None:
        """Draw points; those that are not finite are left out, with what would be said of them."""
        points = _points(x, y)
        known = _known(points)
        self._shapes.append(("dots", colour, points[known]))
        for (px, py), text in zip(points[known].tolist(), _picked(said, known), strict=False):
            self._said.append((px, py, text))
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
        (x0, x1), (y0, y1) = self._limits()

        def placed(points: NDArray[np.float64]) -> NDArray[np.float64]:
            share = (points - (x0, y0)) / (x1 - x0, y1 - y0)
            if not self.down:
                share[:, 1] = 1 - share[:, 1]
            return share

        paths = []
        ticks = []
        for which, low, high in (("x", x0, x1), ("y", y0, y1)):
            for value in _ticks(low, high, 5):
                at = np.array([[value, y0] if which == "x" else [x0, value]])
                share = float(placed(at)[0, int(which == "y")])
                side = "left" if which == "x" else "top"
                ticks.append(
                    Markup('<span class="{}" style="{}:{}%">{}</span>').format(
                        which, side, f"{100 * share:.2f}", f"{value:.6g}"
                    )
                )
                step = round(_SIDE * share)
                grid = f"M{step} 0V{_SIDE}" if which == "x" else f"M0 {step}H{_SIDE}"
                paths.append(Markup('<path class="grid" d="{}"/>').format(grid))
        styles = {
            "band": "fill:{0};fill-opacity:0.25",
            "line": "stroke:{0};stroke-width:1.6px",
            "dots": "stroke:{0};stroke-width:5px;stroke-linecap:round",
            "ring": "stroke:{0};stroke-width:1px;stroke-opacity:0.7",
        }
        for kind in styles:
            for shape, colour, points in self._shapes:
                if shape == kind and len(points):
                    style = styles[kind].format(colour)
                    paths.append(
                        Markup('<path style="{}" d="{}"/>').format(style, _path(placed(points), kind))
                    )
        names = []
        for x, y, text in self._names:
            ((px, py),) = (100 * placed(np.array([[x, y]]))).tolist()
            names.append(
                Markup('<span class="named" style="left:{}%;top:{}%">{}</span>').format(
                    f"{px:.2f}", f"{py:.2f}", text
                )
            )
        self.told = [
            (*(round(1000 * float(v)) for v in placed(np.array([[x, y]]))[0]), text)  # type: ignore[misc]
            for x, y, text in self._said
        ]
        legend = Markup("").join(
            Markup('<span><i style="background:{}"></i>{}</span> ').format(colour, name)
            for name, colour in self._legend.items()
        )
        height = "height:15rem" if self.aspect is None else f"aspect-ratio:{self.aspect:.4f}"
        return Markup(
            '<div class="plot" id="{}"><div class="legend">{}</div><div class="area" style="{}">'
            '<svg viewBox="0 0 {} {}" preserveAspectRatio="none" aria-hidden="true">{}</svg>{}{}'
            '<span class="xname">{}</span><span class="yname">{}</span></div></div>'
        ).format(
            self.id,
            legend,
            height,
            _SIDE,
            _SIDE,
            Markup("").join(paths),
            Markup("").join(ticks),
            Markup("").join(names),
            self.x_name,
            self.y_name,
        )

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


def _ticks(low: float, high: float, most: int) -> list[float]:
    return [float(v) for v in MaxNLocator(most).tick_values(low, high) if low <= v <= high]


def _points(x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
    return np.column_stack([np.asarray(x, np.float64), np.asarray(y, np.float64)])


def _known(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.isfinite(points[:, 0]) & np.isfinite(points[:, 1])


def _picked(said: Sequence[str], known: NDArray[np.bool_]) -> Iterable[str]:
    return (text for text, good in zip(said, known.tolist(), strict=False) if good)


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
