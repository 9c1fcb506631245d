"""Figures of one recording: where the regions were, which pixels show which cluster, distance over time.

A `FigureProbe` listens to the receiver's stages and keeps a bounded share of what it hears, so that the
figures of a recording of any length take constant memory; `Figures` draws them in the end.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from textwrap import fill
from typing import Any, Generic, TypeVar

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from evlcp_sdk.place.navigator import Settled
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.report.colours import TRANSMITTER_COLOURS, cluster_colours, transmitter_colour
from evlcp_sdk.report.drawing import INK_COLOUR, plain, titled
from evlcp_sdk.report.plots import ellipse, enlarge_ellipses
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.spelling import counted
from evlcp_sdk.values import Events, Fix, Frame, PresenceMap, Region

_DPI = 150
_MOST_ZOOMS = 3
_MOST_ELLIPSES = 40
_MOST_PLACES = 4096

T = TypeVar("T")


class Thinned(Generic[T]):
    """Keeps at most `limit` values of a stream, evenly spread: every value, then every second, fourth, ...

    >>> kept = Thinned(4)
    >>> for i in range(10):
    ...     kept.add(i)
    >>> list(kept)
    [0, 4, 8]
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._every = 1
        self._seen = 0
        self._values: list[T] = []

    def add(self, value: T) -> None:
        """Take the next value of the stream."""
        if self._seen % self._every == 0:
            if len(self._values) == self._limit:
                self._values = self._values[::2]
                self._every *= 2
            if self._seen % self._every == 0:
                self._values.append(value)
        self._seen += 1

    def __iter__(self) -> Iterator[T]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


@dataclass(frozen=True, eq=False)
class _Shown:
    """The clearest presence map of a transmitter and the frame it belongs to."""

    frame: Frame
    presence: PresenceMap


class FigureProbe:
    """Watches a receiver for the figures; register it with `Registry.load(probe)`.

    Args:
        camera: Has the size of the image.
        points: How many frames of a transmitter, and places of a region, to keep.
        most_regions: How many regions to keep: of more, those with the fewest places are left out.

    Attributes:
        many_regions: How many there were.
    """

    def __init__(self, camera: CameraModel, points: int = 1024, most_regions: int = 64) -> None:
        self.image: NDArray[np.int64] = np.zeros((camera.height, camera.width), np.int64)
        self.first_us: int | None = None
        self.regions: dict[int, Thinned[Region]] = {}
        self.many_regions = 0
        self._most_regions = most_regions
        self.frames: dict[int, Thinned[Frame]] = {}
        self.clearest: dict[int, _Shown] = {}
        self.echo_of: dict[int, int | None] = {}
        self._points = points
        self._presence: PresenceMap | None = None

    def watch(self, events: Events) -> None:
        """Add events to the accumulated image."""
        if len(events):
            if self.first_us is None:
                self.first_us = int(events.t_us[0])
            height, width = self.image.shape
            inside = (events.x < width) & (events.y < height)
            flat = events.y[inside].astype(np.int64) * width + events.x[inside]
            self.image += np.bincount(flat, minlength=self.image.size).reshape(self.image.shape)

    @hookimpl
    def evlcp_stage_finished(self, stage: str, value: Any) -> None:
        """Keep regions, presence maps and frames."""
        if stage == "regions":
            self._place(value)
        elif stage == "separation":
            self._presence = value
        elif stage == "frame" and (value.transmitter in self.frames or len(self.frames) < _MOST_ZOOMS):
            self.frames.setdefault(value.transmitter, Thinned(self._points)).add(value)
            # The newest frame knows most.
            self.echo_of[value.transmitter] = value.echo_of
            best = self.clearest.get(value.transmitter)
            if self._presence is not None and (best is None or value.soft.quality > best.frame.soft.quality):
                self.clearest[value.transmitter] = _Shown(value, self._presence)

    def _place(self, region: Region) -> None:
        """Keep a place of a region, and the regions with the most of them."""
        if region.id not in self.regions:
            self.many_regions += 1
            if len(self.regions) == self._most_regions:
                del self.regions[min(self.regions, key=lambda number: len(self.regions[number]))]
            self.regions[region.id] = Thinned(self._points)
        self.regions[region.id].add(region)


class Figures(Sink):
    """Draws `regions.png`, `presence.png`, `distance.png`, and with positions `track.png`.

    A figure without anything to show is left out.
    """

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self.probe = FigureProbe(run.link.camera)
        self.track = Thinned[Settled](_MOST_PLACES)

    def events(self, events: Events) -> None:
        """Add events to the accumulated image."""
        self.probe.watch(events)

    @hookimpl
    def evlcp_stage_finished(self, stage: str, value: Any) -> None:
        """Keep regions, presence maps and frames."""
        self.probe.evlcp_stage_finished(stage, value)

    def settle(self, settled: Sequence[Settled]) -> None:
        """Keep places."""
        for one in settled:
            self.track.add(one)

    def finish(self) -> Mapping[str, Any]:
        """Draw."""
        probe, name = self.probe, self.run.name
        self._save(draw_regions(probe, name), "regions.png")
        if probe.clearest:
            self._save(draw_presence(probe, name), "presence.png")
        if probe.frames:
            self._save(draw_distance(probe, name), "distance.png")
        if self.run.navigator is not None:
            self._save(draw_track(self.track, self.run.navigator.bars_enu_m(), name), "track.png")
        return {}

    def _save(self, figure: Figure, name: str) -> None:
        figure.savefig(self.folder.path(name), format="png", dpi=_DPI)


_LEVELS = {"hpl_m": "horizontal level", "vpl_m": "vertical level"}


def draw_track(track: Iterable[Settled], bars_enu_m: Mapping[int, NDArray[np.float64]], title: str) -> Figure:
    """A map of fixes with their 95 % ellipses, the track and the bars; height, sigma, protection over time.

    Args:
        track: The trajectory.
        bars_enu_m: Centre of each bar in the local axes, m, float64 (3,), by transmitter.
        title: What the figure is of.
    """
    figure = Figure(figsize=(11, 8.8), layout="constrained")
    parts = figure.subplot_mosaic(
        [["plan", "close"], ["height", "height"], ["spread", "spread"], ["protected", "protected"]],
        height_ratios=[4, 1, 1, 1],
    )
    plan, close, height = (parts[name] for name in ("plan", "close", "height"))
    spread, protected = parts["spread"], parts["protected"]
    points = list(track)
    _draw_bars(plan, bars_enu_m)
    if points:
        fixed = np.array([point.fix.enu_m for point in points])
        live = np.array([point.filtered.enu_m for point in points])
        smooth = np.array([point.smoothed.enu_m for point in points])
        t_s = np.array([point.fix.t_us for point in points]) * 1e-6
        chosen = [point.fix for point in points[:: max(1, len(points) // _MOST_ELLIPSES)]]
        times = enlarge_ellipses([fix.covariance_m2 for fix in chosen], fixed)
        said = "95 % ellipse" + (f",\n{times} times as large" if times > 1 else "")
        for fix in chosen:
            line = ellipse(fix.enu_m[:2], fix.covariance_m2[:2, :2] * times**2, 0.95)
            close.add_patch(Polygon(line, closed=True, fc=_ELLIPSE, ec="#8fb4cc", lw=0.8, alpha=0.7))
        close.plot([], [], "o", ms=9, mfc=_ELLIPSE, mec="#8fb4cc", label=said)
        for axis in (plan, close):
            axis.plot(fixed[:, 0], fixed[:, 1], ".", ms=5, color=INK_COLOUR, label="fix", zorder=3)
        for way, colour, label in ((live, "#56b4e9", "filtered"), (smooth, "#d55e00", "smoothed")):
            for axis in (plan, close):
                axis.plot(way[:, 0], way[:, 1], "-", lw=1.2, color=colour, label=label)
            height.plot(t_s, way[:, 2], "-", lw=1.4, color=colour)
        height.plot(t_s, fixed[:, 2], ".", ms=3, color=INK_COLOUR)
        _draw_integrity(spread, protected, [point.fix for point in points])
        close.legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))
    for axis in (plan, close):
        axis.set(xlabel="east, m", ylabel="north, m")
        axis.set_aspect("equal", adjustable="datalim")
    titled(plan, "bars and track")
    titled(close, "the track alone")
    height.set(ylabel="up, m")
    spread.set(ylabel="sigma, m", ylim=(0, None))
    protected.set(ylabel="protection, m", xlabel="camera clock, s", ylim=(0, None))
    for axis in (plan, close, height, spread, protected):
        plain(axis)
    figure.suptitle(f"{title}: {counted(len(points), 'position')} shown", fontsize=11, color=INK_COLOUR)
    return figure


def _draw_bars(plan: Axes, bars_enu_m: Mapping[int, NDArray[np.float64]]) -> None:
    """Mark and name the bars on a map."""
    middle = np.mean([enu[:2] for enu in bars_enu_m.values()], axis=0) if bars_enu_m else np.zeros(2)
    for number, enu in sorted(bars_enu_m.items()):
        plan.plot(enu[0], enu[1], "s", ms=7, color=transmitter_colour(number))
        # Away from the other bars, so that no name is on another's mark.
        left, below = enu[0] < middle[0], enu[1] < middle[1]
        plan.annotate(
            f"bar {number}",
            (enu[0], enu[1]),
            xytext=(-7 if left else 7, -7 if below else 7),
            textcoords="offset points",
            ha="right" if left else "left",
            va="top" if below else "bottom",
            fontsize=9,
        )


def _draw_integrity(spread: Axes, protected: Axes, fixes: Sequence[Fix]) -> None:
    """Draw sigmas, and protection levels with a gap where there are none, over time."""
    t_s = np.array([fix.t_us for fix in fixes]) * 1e-6
    for i, name in enumerate(("east", "north", "up")):
        # Those of satellites are far larger than those of bars.
        sigma = [math.sqrt(f.covariance_m2[i, i]) if f.source == "bars" else math.nan for f in fixes]
        spread.plot(t_s, sigma, lw=1.2, color=TRANSMITTER_COLOURS[i], label=name)
    for name, style in (("hpl_m", "-"), ("vpl_m", ":")):
        level = np.array([getattr(fix, name) for fix in fixes])
        shown = np.where(np.isfinite(level), level, np.nan)
        protected.plot(t_s, shown, style, lw=1.4, color=INK_COLOUR, label=_LEVELS[name])
    alarmed = [fix.t_us * 1e-6 for fix in fixes if fix.excluded]
    protected.plot(alarmed, np.zeros(len(alarmed)), "x", ms=5, color="#d55e00", label="a part left out")
    for axis in (spread, protected):
        # Beside the lines, not on them.
        axis.legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))


_ELLIPSE = "#cfe5f3"


def draw_regions(probe: FigureProbe, title: str) -> Figure:
    """Accumulated events of the whole sensor with the followed regions, and a close view of some of them."""
    shown = sorted(probe.regions.items(), key=lambda item: -len(item[1]))
    zooms = sorted(dict(shown[:_MOST_ZOOMS]))
    figure = Figure(figsize=(8 + 1.8 * len(zooms), 4.8), layout="constrained")
    axes = figure.subplots(1, 1 + len(zooms), width_ratios=[8] + [1.6] * len(zooms), squeeze=False)[0]
    height, width = probe.image.shape
    top = max(float(np.quantile(probe.image[probe.image > 0], 0.99)) if probe.image.any() else 1.0, 1.0)
    shades = np.log1p(probe.image, dtype=np.float32)
    # Coloured once, in bytes: Matplotlib would take 80 MB to do so while it draws.
    picture = colormaps["Greys"](np.clip(shades / np.float32(math.log1p(top)), 0, 1), bytes=True)
    for axis in axes:
        axis.imshow(picture, interpolation="nearest")
        axis.set_xlabel("column, px")
    whole = axes[0]
    whole.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), ylabel="row, px")
    many = f"{probe.many_regions} region{'s' * (probe.many_regions != 1)}"
    if probe.many_regions > len(probe.regions):
        many += f", {len(probe.regions)} shown"
    if zooms:
        many += " (beside: dotted at first, solid at last)"
    titled(whole, f"{title}: {probe.image.sum():,} events, {many}")
    for n, (number, places) in enumerate(sorted(probe.regions.items())):
        colour = transmitter_colour(n)
        path = list(places)
        left, upper, right, lower = _bounds(path)
        outline = partial(Rectangle, fill=False, ec=colour, lw=1.4)
        whole.add_patch(outline((left - 6, upper - 6), right - left + 12, lower - upper + 12))
        whole.annotate(
            str(number),
            (right + 6, upper - 6),
            xytext=(3, 0),
            textcoords="offset points",
            color=colour,
            va="top",
            # What sets it apart from what it is written on.
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )
        if number in zooms:
            axis = axes[1 + zooms.index(number)]
            pad = 0.15 * max(lower - upper, 20)
            middle, half = (left + right) / 2, max(right - left, 0.36 * (lower - upper + 2 * pad)) / 2 + 4
            axis.set(xlim=(middle - half, middle + half), ylim=(lower + pad, upper - pad))
            for place, style in ((path[0], ":"), (path[-1], "-")):
                axis.add_patch(outline(_corner(place), place.width_px, place.height_px, ls=style))
            titled(axis, f"region {number}")
    return figure


def draw_presence(probe: FigureProbe, title: str) -> Figure:
    """Which pixels show which cluster, in one frame of each transmitter, and the profile of each cluster."""
    shown = [probe.clearest[n] for n in sorted(probe.clearest)[:_MOST_ZOOMS]]
    figure = Figure(figsize=(6.4 * len(shown), 7.4), layout="constrained")
    text = fill(_PRESENCE.format(size=shown[0].presence.grid_px), 92 * len(shown))
    figure.supxlabel(text, x=0.02, ha="left", fontsize=9, color=INK_COLOUR)
    parts = figure.subfigures(1, len(shown), squeeze=False)[0]
    for part, best in zip(parts, shown, strict=True):
        number = best.frame.transmitter
        _draw_one_presence(part, best, _who(number, probe.echo_of[number]))
    figure.suptitle(f"{title}: which pixels show which cluster", fontsize=11, color=INK_COLOUR)
    return figure


_PRESENCE = (
    "Each cluster of LEDs sends a pilot of its own, by which it is found in the image; a colour is a cluster."
    " Cells: squares of {size} x {size} px that surely show one. Pixels: the cluster whose pilot each pixel"
    " repeats best, the paler the less. Rows: how well each row of pixels repeats each pilot, with the"
    " clusters' numbers; distances are measured from where neighbouring curves cross."
)


def _draw_one_presence(part: SubFigure, best: _Shown, who: str) -> None:
    cells, pixels, profile = part.subplots(1, 3, width_ratios=[1, 1, 1.8], sharey=True)
    presence, frame = best.presence, best.frame
    colours = cluster_colours(len(presence.probability))
    height, width = presence.pixels.shape[1:]
    size = presence.grid_px
    selected = presence.selected.any(0)
    rows, columns = selected.shape
    where = np.argwhere(selected) * size
    upper, left = (where.min(0) if len(where) else np.zeros(2)) - 3
    lower, right = (where.max(0) + size if len(where) else np.array([height, width])) + 2

    strength = np.where(selected, presence.probability.max(0), 0)
    cells.imshow(
        _coloured(presence.probability, strength, colours),
        extent=(-0.5, columns * size - 0.5, rows * size - 0.5, -0.5),
        interpolation="nearest",
    )
    titled(cells, "cells")
    signal = np.clip(presence.pixels, 0, None)
    strongest = signal.max(0)
    scale = float(np.quantile(strongest[strongest > 0], 0.9)) if strongest.any() else 1.0
    pixels.imshow(_coloured(signal, np.clip(strongest / scale, 0, 1), colours), interpolation="nearest")
    titled(pixels, "pixels")
    for axis in (cells, pixels):
        axis.set(xlim=(left, right), ylim=(lower, upper), xlabel="column, px", aspect="auto")
    cells.set_ylabel("row of the region, px")
    for k, curve in enumerate(signal.sum(2)):
        profile.plot(curve, np.arange(height), color=colours[k], lw=1.3)
        if curve.any():
            peak = float(np.average(np.arange(height), weights=curve**4))
            profile.annotate(
                str(k),
                (1.0, peak),
                xycoords=("axes fraction", "data"),
                color=colours[k],
                va="center",
                fontsize=8,
                annotation_clip=False,
            )
    profile.set(xlabel="pilot correlation of the row", xlim=(0, None))
    plain(profile)
    titled(profile, "rows")
    # Over the whole part: beside a reflection's number there is no room for the frame's above the rows alone.
    part.suptitle(
        f"{who}, packet {frame.packet}, frame {frame.frame}", x=0.02, ha="left", fontsize=10, color=INK_COLOUR
    )


def draw_distance(probe: FigureProbe, title: str) -> Figure:
    """Distance of each transmitter with its one-sigma band, and the quality of each frame, over time."""
    numbers = sorted(probe.frames)[:_MOST_ZOOMS]
    figure = Figure(figsize=(8, 2.2 + 3.6 * len(numbers)), layout="constrained")
    axes = figure.subplots(
        2 * len(numbers) + 1, 1, sharex=True, height_ratios=[2.2, 1.4] * len(numbers) + [1]
    )
    begin_us = probe.first_us or 0
    last = axes[-1]
    for n, (axis, off, number) in enumerate(zip(axes[:-1:2], axes[1::2], numbers, strict=True)):
        frames = sorted(probe.frames[number], key=lambda f: f.t_us)
        colour = transmitter_colour(number)
        t_s = np.array([f.t_us - begin_us for f in frames]) * 1e-6
        distance = np.array([f.range.distance_m for f in frames])
        sigma = np.array([f.range.sigma_m for f in frames])
        known = np.isfinite(distance)
        t, d, s = t_s[known], distance[known], sigma[known]
        line = off_neighbours(t, d)
        for where, values in ((axis, d), (off, line)):
            where.plot(t, values, "o", ms=2.5, color=colour, label="a frame")
        axis.fill_between(t, d - s, d + s, color=colour, alpha=0.25, lw=0)
        sigma_name = "one sigma, as the ranging states it"
        off.fill_between(t, -s, s, color=colour, alpha=0.25, lw=0, label=sigma_name)
        axis.set_ylabel("distance, m")
        off.set_ylabel("off its\nneighbours, m")
        titled(axis, f"{_who(number, probe.echo_of[number])}, {known.sum()} distances")
        off.legend(frameon=False, fontsize=9, ncols=2, loc="lower left", bbox_to_anchor=(0, 1))
        # Rings of other sizes: equal qualities are seen all the same.
        last.plot(
            t_s, [f.soft.quality for f in frames], "o", ms=2.5 + 2 * n, mfc="none", mew=0.8, color=colour
        )
    last.set(ylabel="quality", xlabel="time since the first event, s", ylim=(0, 1.1))
    for axis in axes:
        plain(axis)
    figure.suptitle(f"{title}: distance along the optical axis", fontsize=11, color=INK_COLOUR)
    return figure


def off_neighbours(t_s: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """What each value lies off a straight line through itself and its neighbours in time.

    Args:
        t_s: Times, s, float64 (n,), ascending.
        values: Float64 (n,).

    Returns:
        Float64 (n,), of the values' unit.
    """
    n = len(values)
    wide = min(_NEIGHBOURS, n)
    if wide < 3:
        return np.zeros(n)
    first = np.clip(np.arange(n) - wide // 2, 0, n - wide)
    near = first[:, None] + np.arange(wide)
    t, v = t_s[near], values[near]
    middle_t, middle_v = t.mean(1), v.mean(1)
    apart = t - middle_t[:, None]
    slope = (apart * v).sum(1) / np.maximum((apart**2).sum(1), 1e-30)
    line = middle_v + slope * (t_s - middle_t)
    # The line goes through a value itself, too: as much nearer as it weighs.
    weight = 1 / wide + (t_s - middle_t) ** 2 / np.maximum((apart**2).sum(1), 1e-30)
    found: NDArray[np.float64] = (values - line) / np.sqrt(np.maximum(1 - weight, 1 / wide))
    return found


_NEIGHBOURS = 11


def _coloured(
    clusters: NDArray[np.floating[Any]], strength: NDArray[Any], colours: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Each pixel in its strongest cluster's colour, paler where it is weak: float64 (rows, columns, 3)."""
    alpha = np.asarray(strength, np.float64)[..., None]
    mixed: NDArray[np.float64] = colours[np.argmax(clusters, axis=0)] * alpha + (1 - alpha)
    return mixed


def _corner(region: Region) -> tuple[float, float]:
    return region.x_px - region.width_px / 2, region.y_px - region.height_px / 2


def _bounds(path: Iterable[Region]) -> tuple[float, float, float, float]:
    boxes = np.array([(*_corner(one), one.width_px, one.height_px) for one in path])
    (left, upper), (right, lower) = boxes[:, :2].min(0), (boxes[:, :2] + boxes[:, 2:]).max(0)
    return float(left), float(upper), float(right), float(lower)


def _who(transmitter: int, echo_of: int | None) -> str:
    """A transmitter, and of which it is a reflection."""
    return f"transmitter {transmitter}" + ("" if echo_of is None else f" (reflection of {echo_of})")
