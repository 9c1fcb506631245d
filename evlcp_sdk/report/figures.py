"""Figures of one recording: regions, pixels of each cluster, distance over time.

A bounded share of the data is kept as it comes, so that recordings of any length take constant memory.
"""

import math
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from evlcp_sdk.formatting import format_count
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.report.colours import cluster_colours, transmitter_colour
from evlcp_sdk.report.drawing import INK_COLOUR, draw_plots, set_heading, style_axes
from evlcp_sdk.report.recording import (
    ChartSink,
    name_transmitter,
    plot_distances,
    plot_positions,
    plot_quality,
    seconds_axis,
)
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run
from evlcp_sdk.rx.boxes import Box, bounding_box, box_of
from evlcp_sdk.values import Events, Frame, PresenceMap, Region

_DPI = 150
_MAX_TRANSMITTERS = 3
_MAX_REGIONS = 64
"""Regions that are kept."""


class Figures(ChartSink):
    """Draws `regions.png`, `presence.png`, `distance.png`, and with positions `track.png`.

    A figure without data is left out.

    Attributes:
        image: Events of each pixel, int64 (rows, columns).
        regions: How often each region was seen, and the box that holds it all the time, px.
        region_count: Number of all regions; `regions` has those that were seen most often.
        clearest: The frame of best quality of each transmitter, and its presence map.
    """

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self.image: NDArray[np.int64] = np.zeros((run.link.camera.height, run.link.camera.width), np.int64)
        self.regions: dict[int, tuple[int, Box]] = {}
        self.region_count = 0
        self.clearest: dict[int, tuple[Frame, PresenceMap]] = {}
        self._presence: PresenceMap | None = None

    def events(self, events: Events) -> None:
        """Add events to the accumulated image."""
        super().events(events)
        if len(events):
            height, width = self.image.shape
            inside = (events.x < width) & (events.y < height)
            flat = events.y[inside].astype(np.int64) * width + events.x[inside]
            self.image += np.bincount(flat, minlength=self.image.size).reshape(self.image.shape)

    @hookimpl
    def evlcp_stage_finished(self, stage: str, value: Any) -> None:
        """Keep regions, and the clearest frames with their presence maps."""
        if stage == "regions":
            self._add_region(value)
        elif stage == "separation":
            self._presence = value
        elif stage == "frame" and self._presence is not None:
            best = self.clearest.get(value.transmitter)
            has_room = best is None and len(self.clearest) < _MAX_TRANSMITTERS
            if has_room or (best is not None and value.soft.quality > best[0].soft.quality):
                self.clearest[value.transmitter] = value, self._presence

    def _add_region(self, region: Region) -> None:
        if region.id not in self.regions:
            self.region_count += 1
            if len(self.regions) == _MAX_REGIONS:
                del self.regions[min(self.regions, key=lambda number: self.regions[number][0])]
        times, box = self.regions.get(region.id, (0, box_of(region)))
        self.regions[region.id] = times + 1, bounding_box([box, box_of(region)])

    def finish(self) -> None:
        """Draw the figures."""
        name = self.run.name
        self._save(draw_regions(self, name), "regions.png")
        if self.clearest.keys() & self.transmitters:
            self._save(draw_presence(self, name), "presence.png")
        if self.transmitters:
            self._save(draw_distance(self, name), "distance.png")
        if self.run.navigator is not None:
            points = [*self.track]
            plots = plot_positions(points, self.run.navigator.bars_enu_m(), seconds_axis(0.0))
            self._save(
                draw_plots(plots, f"{name}: {format_count(len(points), 'position')} shown"), "track.png"
            )

    def _save(self, figure: Figure, name: str) -> None:
        figure.savefig(self.folder.path(name), format="png", dpi=_DPI)


def draw_regions(kept: Figures, title: str) -> Figure:
    """Draw the accumulated events of the whole sensor with the followed regions."""
    figure = Figure(figsize=(8, 4.8), layout="constrained")
    axis = figure.subplots()
    height, width = kept.image.shape
    top = float(np.quantile(kept.image[kept.image > 0], 0.99)) if kept.image.any() else 1.0
    shades = np.log1p(kept.image, dtype=np.float32)
    # Coloured here, in bytes: Matplotlib would take 80 MB for it.
    picture = colormaps["Greys"](np.clip(shades / np.float32(math.log1p(top)), 0, 1), bytes=True)
    axis.imshow(picture, interpolation="nearest")
    axis.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="column, px", ylabel="row, px")
    text = format_count(kept.region_count, "region")
    if kept.region_count > len(kept.regions):
        text += f", {len(kept.regions)} shown"
    set_heading(axis, f"{title}: {kept.image.sum():,} events, {text}")
    for index, (number, (_, (left, upper, right, lower))) in enumerate(sorted(kept.regions.items())):
        colour = transmitter_colour(index)
        box = right - left + 12, lower - upper + 12
        axis.add_patch(Rectangle((left - 6, upper - 6), *box, fill=False, ec=colour, lw=1.4))
        axis.annotate(
            str(number),
            (right + 6, upper - 6),
            xytext=(3, 0),
            textcoords="offset points",
            color=colour,
            va="top",
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )
    return figure


def draw_presence(kept: Figures, title: str) -> Figure:
    """Draw which pixels show which cluster, in one frame of each transmitter, and the profile of each
    cluster.
    """
    frames = [kept.clearest[n] for n in sorted(kept.clearest.keys() & kept.transmitters)]
    figure = Figure(figsize=(6.4 * len(frames), 7.4), layout="constrained")
    text = fill(_PRESENCE_NOTE.format(size=frames[0][1].grid_px), 92 * len(frames))
    figure.supxlabel(text, x=0.02, ha="left", fontsize=9, color=INK_COLOUR)
    parts = figure.subfigures(1, len(frames), squeeze=False)[0]
    for part, (frame, presence) in zip(parts, frames, strict=True):
        echo_of = kept.transmitters[frame.transmitter].echo_of
        _draw_frame_presence(part, frame, presence, name_transmitter(frame.transmitter, echo_of))
    figure.suptitle(f"{title}: which pixels show which cluster", fontsize=11, color=INK_COLOUR)
    return figure


_PRESENCE_NOTE = (
    "Each cluster of LEDs sends a pilot of its own, by which it is found in the image; a colour is a cluster."
    " Cells: squares of {size} x {size} px that surely show one. Pixels: the cluster whose pilot each pixel"
    " repeats best, the paler the less. Rows: how well each row of pixels repeats each pilot, with the"
    " clusters' numbers; distances are measured from where neighbouring curves cross."
)


def _draw_frame_presence(part: SubFigure, frame: Frame, presence: PresenceMap, who: str) -> None:
    cells, pixels, profile = part.subplots(1, 3, width_ratios=[1, 1, 1.8], sharey=True)
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
        _colour_pixels(presence.probability, strength, colours),
        extent=(-0.5, columns * size - 0.5, rows * size - 0.5, -0.5),
        interpolation="nearest",
    )
    set_heading(cells, "cells")
    signal = np.clip(presence.pixels, 0, None)
    strongest = signal.max(0)
    scale = float(np.quantile(strongest[strongest > 0], 0.9)) if strongest.any() else 1.0
    pixels.imshow(_colour_pixels(signal, np.clip(strongest / scale, 0, 1), colours), interpolation="nearest")
    set_heading(pixels, "pixels")
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
    style_axes(profile)
    set_heading(profile, "rows")
    # Over the whole width: a reflection's name leaves no room above the rows alone.
    part.suptitle(
        f"{who}, packet {frame.packet}, frame {frame.frame}", x=0.02, ha="left", fontsize=10, color=INK_COLOUR
    )


def draw_distance(kept: Figures, title: str) -> Figure:
    """Draw distance and its deviation from neighbours of each transmitter, and quality, over time."""
    axis = seconds_axis(kept.first_us or 0)
    frames = dict([*kept.frames().items()][:_MAX_TRANSMITTERS])
    plots = [plot for number, one in frames.items() for plot in plot_distances(number, *one, axis)]
    return draw_plots([*plots, plot_quality(frames, axis)], f"{title}: distance along the optical axis")


def _colour_pixels(
    clusters: NDArray[np.floating[Any]], strength: NDArray[Any], colours: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Colour each pixel by its strongest cluster, paler where that is weak: float64 (rows, columns, 3)."""
    alpha = np.asarray(strength, np.float64)[..., None]
    return np.asarray(colours[np.argmax(clusters, axis=0)] * alpha + (1 - alpha))
