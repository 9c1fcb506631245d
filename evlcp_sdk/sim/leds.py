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
        clusters: The cluster of each part, -1 of a gap, int64 (parts,).
        swing: Light of each part that its cluster switches, as a share of that of LEDs as they should be.
        rest: Light of each that is always on, likewise, float64 (parts,).
        leds: LEDs beside each other across it.
        pitch_m: Length along it that they light.
    """

    centre_m: tuple[float, float, float]
    down: bool
    length_m: float
    width_m: float
    cuts: tuple[float, ...]
    clusters: NDArray[np.int64]
    swing: NDArray[np.float64]
    rest: NDArray[np.float64]
    leds: int
    pitch_m: float


def led_light(bar: BarSpec, leds: int, seed: int) -> NDArray[np.float64]:
    """What each LED's cluster switches of its light, and what is always on, as shares: float64 (2, leds).

    Raises:
        ConfigError: A dead or a stuck LED is none of the bar's.
    """
    known: set[int] = set()
    for key, numbers in (("dead_leds", bar.dead_leds), ("stuck_leds", bar.stuck_leds)):
        if not all(0 <= i < leds for i in numbers):
            raise ConfigError(f"{key} = {list(numbers)}: expected LEDs, 0 to {leds - 1}")
        if len(set(numbers) - known) < len(numbers):
            raise ConfigError(f"{key} = {list(numbers)}: expected each LED once, either dead or stuck")
        known.update(numbers)
    light = np.zeros((2, leds))
    light[0] = np.exp(bar.led_spread * np.random.default_rng([seed, 0x1ED]).normal(size=leds))
    stuck = list(bar.stuck_leds)
    light[1, stuck] = light[0, stuck]
    light[0, [*bar.dead_leds, *stuck]] = 0.0
    return light


def lit_strips(bar: BarSpec, layout: BarLayout, seed: int = 0) -> list[LitStrip]:
    """The strips that a layout's LEDs make.

    On a grid each column of clusters is one strip of even light, as wide as its columns of LEDs. Of another
    layout LEDs in line make a strip: columns and rows, the longest first. Neighbours there that are nearer
    than two widths of an LED light all between them; others light a square each. Neighbours of one cluster
    are one part, but where LEDs differ or are hidden one by one.

    Args:
        bar: The bar.
        layout: Its LEDs.
        seed: Of how brightly they shine.

    Raises:
        ConfigError: They are more than a scene may have, or what is dead or stuck is none of them.
    """
    shape = layout.shape
    light = led_light(bar, len(layout.led_clusters()), seed)
    each = bool(bar.dead_leds or bar.stuck_leds or bar.led_spread or bar.lattice_m)
    if isinstance(shape, LedGrid):
        return _of_grid(bar, shape, layout, light, each)
    side_m = shape.led_m if isinstance(shape, LedRing | LedTable) else bar.width_m
    place, which = layout.led_positions_m(), layout.led_clusters()
    steps = np.round(place / _SAME_M).astype(np.int64)
    lines = [np.unique(steps[:, keys], axis=0, return_inverse=True)[1].ravel() for keys in ([0, 2], [1, 2])]
    left = np.ones(len(place), np.bool_)
    found: list[LitStrip] = []
    while left.any():
        if len(found) == MOST_SOURCES:
            raise ConfigError(
                f"link: bar: its LEDs stand in more than {MOST_SOURCES} columns and rows, which none renders"
            )
        counts = [np.bincount(line[left]) for line in lines]
        axis = int(counts[1].max() > counts[0].max())
        mine = np.flatnonzero(left & (lines[axis] == int(counts[axis].argmax())))
        left[mine] = False
        found.append(_of_line(place[mine], which[mine], light[:, mine], axis == 0, side_m, each))
    return found


def _of_grid(
    bar: BarSpec, grid: LedGrid, layout: BarLayout, light: NDArray[np.float64], each: bool
) -> list[LitStrip]:
    columns = grid.columns // grid.cluster_columns
    width_m = bar.width_m + (grid.cluster_columns - 1) * grid.led_pitch_m
    row = np.arange(0, grid.rows + 1, 1 if each else grid.cluster_rows)
    cuts = tuple(np.linspace(-0.5, 0.5, len(row)).tolist())
    found = []
    for column in range(columns):
        aside_m = ((column + 0.5) * grid.cluster_columns - grid.columns / 2) * grid.led_pitch_m
        # A row shines as its LEDs beside each other do on average.
        beside = light.reshape(2, grid.rows, columns, grid.cluster_columns)[:, :, column].mean(-1)
        clusters = column + columns * (row[:-1] // grid.cluster_rows)
        found.append(
            LitStrip(
                (aside_m, 0.0, 0.0),
                True,
                layout.length_m,
                width_m,
                cuts,
                clusters,
                beside[0, row[:-1]],
                beside[1, row[:-1]],
                grid.cluster_columns,
                grid.led_pitch_m,
            )
        )
    return found


def _of_line(
    place: NDArray[np.float64],
    which: NDArray[np.int64],
    light: NDArray[np.float64],
    down: bool,
    side_m: float,
    each: bool,
) -> LitStrip:
    """LEDs (n, 3) of one column or row, of clusters (n,) and light (2, n), as a strip."""
    along = place[:, int(down)]
    order = np.argsort(along, kind="stable")
    at = along[order]
    # Behind them what stands for a gap, number -1.
    cluster, light = np.append(which[order], -1), np.column_stack([light[:, order], np.zeros(2)])
    gaps = np.diff(at)
    near = float(gaps.min()) if len(gaps) else np.inf
    pitch_m = near if near <= 2 * side_m else side_m
    cuts, parts = [float(at[0]) - pitch_m / 2], [0]
    for i, gap in enumerate(gaps.tolist()):
        if gap > 1.001 * pitch_m:
            cuts += [float(at[i]) + pitch_m / 2, float(at[i + 1]) - pitch_m / 2]
            parts += [-1, i + 1]
        elif each or cluster[i + 1] != cluster[i]:
            cuts.append(float(at[i] + at[i + 1]) / 2)
            parts.append(i + 1)
    cuts.append(float(at[-1]) + pitch_m / 2)
    length_m, middle = cuts[-1] - cuts[0], (cuts[0] + cuts[-1]) / 2
    shares = tuple((cut - middle) / length_m for cut in cuts)
    centre = place[0].copy()
    centre[int(down)] = middle
    x, y, z = centre.tolist()
    swing, rest = light[:, parts]
    return LitStrip((x, y, z), down, length_m, side_m, shares, cluster[parts], swing, rest, 1, pitch_m)
