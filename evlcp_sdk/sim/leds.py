"""A layout's LEDs as strips of light: columns and rows of them, cut between one cluster and the next."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.scene.bar import BarLayout, LedGrid, LedRing, LedTable
from evlcp_sdk.sim.scene import MOST_SOURCES, BarSpec

_SAME_M = 1e-6
"""LEDs that stand in one line to the micrometre stand in one strip."""


@dataclass(frozen=True, eq=False)
class LitStrip:
    """A strip of a layout that shines, in parts.

    Attributes:
        centre_m: Its middle (x right, y down, z towards who looks at it), from the layout's centre, m.
        down: It runs down; else to the right.
        length_m: Its length.
        width_m: Its width.
        cuts: Where its parts start and end, shares of its length from -0.5 to 0.5.
        clusters: The cluster of each part, -1 of a dark one, int64 (parts,).
        leds: LEDs beside each other across it.
        pitch_m: Length along it that they light.
    """

    centre_m: tuple[float, float, float]
    down: bool
    length_m: float
    width_m: float
    cuts: tuple[float, ...]
    clusters: NDArray[np.int64]
    leds: int
    pitch_m: float


def lit_strips(bar: BarSpec, layout: BarLayout) -> list[LitStrip]:
    """The strips that a layout's LEDs make.

    On a grid each column of clusters is one strip of even light, as wide as its columns of LEDs. Of another
    layout LEDs in line make a strip: columns and rows, the longest first. Neighbours there that are nearer
    than two widths of an LED light all between them; others light a square each.

    Raises:
        ConfigError: They are more than a scene may have.
    """
    shape = layout.shape
    if isinstance(shape, LedGrid):
        return _of_grid(bar, shape, layout)
    side_m = shape.led_m if isinstance(shape, LedRing | LedTable) else bar.width_m
    place, which = layout.led_positions_m(), layout.led_clusters()
    steps = np.round(place / _SAME_M).astype(np.int64)
    lines = [np.unique(steps[:, keys], axis=0, return_inverse=True)[1].ravel() for keys in ([0, 2], [1, 2])]
    left = np.ones(len(place), np.bool_)
    found: list[LitStrip] = []
    while left.any():
        if len(found) == MOST_SOURCES:
            raise ConfigError(
                f"bar: its LEDs stand in more than {MOST_SOURCES} columns and rows, which no scene renders"
            )
        counts = [np.bincount(line[left]) for line in lines]
        axis = int(counts[1].max() > counts[0].max())
        mine = np.flatnonzero(left & (lines[axis] == int(counts[axis].argmax())))
        left[mine] = False
        found.append(_of_line(place[mine], which[mine], axis == 0, side_m))
    return found


def _of_grid(bar: BarSpec, grid: LedGrid, layout: BarLayout) -> list[LitStrip]:
    rows, columns = grid.rows // grid.cluster_rows, grid.columns // grid.cluster_columns
    width_m = bar.width_m + (grid.cluster_columns - 1) * grid.led_pitch_m
    cuts = tuple(np.linspace(-0.5, 0.5, rows + 1).tolist())
    found = []
    for column in range(columns):
        aside_m = ((column + 0.5) * grid.cluster_columns - grid.columns / 2) * grid.led_pitch_m
        clusters = np.arange(column, rows * columns, columns)
        found.append(
            LitStrip(
                (aside_m, 0.0, 0.0),
                True,
                layout.length_m,
                width_m,
                cuts,
                clusters,
                grid.cluster_columns,
                grid.led_pitch_m,
            )
        )
    return found


def _of_line(place: NDArray[np.float64], which: NDArray[np.int64], down: bool, side_m: float) -> LitStrip:
    """LEDs (n, 3) of one column or row, of clusters (n,), as a strip."""
    along = place[:, int(down)]
    order = np.argsort(along, kind="stable")
    at, cluster = along[order], which[order]
    gaps = np.diff(at)
    near = float(gaps.min()) if len(gaps) else np.inf
    pitch_m = near if near <= 2 * side_m else side_m
    cuts, parts = [float(at[0]) - pitch_m / 2], [int(cluster[0])]
    for i, gap in enumerate(gaps.tolist()):
        if gap > 1.001 * pitch_m:
            cuts += [float(at[i]) + pitch_m / 2, float(at[i + 1]) - pitch_m / 2]
            parts += [-1, int(cluster[i + 1])]
        elif cluster[i + 1] != parts[-1]:
            cuts.append(float(at[i] + at[i + 1]) / 2)
            parts.append(int(cluster[i + 1]))
    cuts.append(float(at[-1]) + pitch_m / 2)
    length_m, middle = cuts[-1] - cuts[0], (cuts[0] + cuts[-1]) / 2
    shares = tuple((cut - middle) / length_m for cut in cuts)
    centre = place[0].copy()
    centre[int(down)] = middle
    x, y, z = centre.tolist()
    return LitStrip((x, y, z), down, length_m, side_m, shares, np.array(parts), 1, pitch_m)
