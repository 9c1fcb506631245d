"""Split the LEDs of a layout into strips of light: columns and rows, cut between clusters."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.scene.bar import BarLayout, LedGrid, LedRing, LedTable
from evlcp_sdk.sim.scene import MAX_SOURCES, BarSpec

_ALIGNED_M = 1e-6
"""LEDs aligned to a micrometre make one strip."""


@dataclass(frozen=True, eq=False)
class LitStrip:
    """A strip of the LEDs of a layout, in parts.

    Attributes:
        centre_m: Its middle (x right, y down, z towards the viewer) from the layout's centre, m.
        is_vertical: Whether it runs down, or else to the right.
        length_m: Its length.
        width_m: Its width.
        cuts: Where its parts start and end, shares of its length from -0.5 to 0.5.
        clusters: The cluster of each part, -1 of a gap, int64 (parts,).
        switched: Light that each cluster switches, as a share of that of perfect LEDs, float64 (parts,).
        constant: Light that is always on, likewise, float64 (parts,).
        leds: LEDs side by side across it.
        pitch_m: Length along it that they light.
    """

    centre_m: tuple[float, float, float]
    is_vertical: bool
    length_m: float
    width_m: float
    cuts: tuple[float, ...]
    clusters: NDArray[np.int64]
    switched: NDArray[np.float64]
    constant: NDArray[np.float64]
    leds: int
    pitch_m: float


def draw_led_light(bar: BarSpec, leds: int, seed: int) -> NDArray[np.float64]:
    """Draw the share of each LED's light that is switched, and the share always on, float64 (2, leds).

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


def split_into_strips(bar: BarSpec, layout: BarLayout, seed: int = 0) -> list[LitStrip]:
    """Split the LEDs of a layout into strips, with brightnesses drawn by `seed`.

    On a grid each column of clusters is one strip of even light, as wide as its columns of LEDs. In other
    layouts aligned LEDs make a strip: columns and rows, the longest first. Neighbours closer than two widths
    of an LED light the gap between them; others light a square each. Neighbours of one cluster are one part,
    unless LEDs differ or are hidden one by one.

    Raises:
        ConfigError: There are more strips than a scene may have, or a dead or stuck LED is none of the bar's.
    """
    shape = layout.shape
    light = draw_led_light(bar, len(layout.led_clusters()), seed)
    per_led = bool(bar.dead_leds or bar.stuck_leds or bar.led_spread or bar.lattice_m)
    if isinstance(shape, LedGrid):
        return _split_grid(bar, shape, layout, light, per_led)
    side_m = shape.led_m if isinstance(shape, LedRing | LedTable) else bar.width_m
    place, clusters = layout.led_positions_m(), layout.led_clusters()
    steps = np.round(place / _ALIGNED_M).astype(np.int64)
    lines = [np.unique(steps[:, keys], axis=0, return_inverse=True)[1].ravel() for keys in ([0, 2], [1, 2])]
    unused = np.ones(len(place), np.bool_)
    found: list[LitStrip] = []
    while unused.any():
        if len(found) == MAX_SOURCES:
            raise ConfigError(
                f"link: bar: its LEDs stand in more than {MAX_SOURCES} columns and rows, which none renders"
            )
        counts = [np.bincount(line[unused]) for line in lines]
        axis = int(counts[1].max() > counts[0].max())
        members = np.flatnonzero(unused & (lines[axis] == int(counts[axis].argmax())))
        unused[members] = False
        found.append(
            _make_strip(place[members], clusters[members], light[:, members], axis == 0, side_m, per_led)
        )
    return found


def _split_grid(
    bar: BarSpec, grid: LedGrid, layout: BarLayout, light: NDArray[np.float64], per_led: bool
) -> list[LitStrip]:
    columns = grid.columns // grid.cluster_columns
    width_m = bar.width_m + (grid.cluster_columns - 1) * grid.led_pitch_m
    row = np.arange(0, grid.rows + 1, 1 if per_led else grid.cluster_rows)
    cuts = tuple(np.linspace(-0.5, 0.5, len(row)).tolist())
    found = []
    for column in range(columns):
        aside_m = ((column + 0.5) * grid.cluster_columns - grid.columns / 2) * grid.led_pitch_m
        # The light of a row is the mean of its LEDs.
        row_light = light.reshape(2, grid.rows, columns, grid.cluster_columns)[:, :, column].mean(-1)
        clusters = column + columns * (row[:-1] // grid.cluster_rows)
        found.append(
            LitStrip(
                (aside_m, 0.0, 0.0),
                True,
                layout.length_m,
                width_m,
                cuts,
                clusters,
                row_light[0, row[:-1]],
                row_light[1, row[:-1]],
                grid.cluster_columns,
                grid.led_pitch_m,
            )
        )
    return found


def _make_strip(
    place: NDArray[np.float64],
    clusters: NDArray[np.int64],
    light: NDArray[np.float64],
    is_vertical: bool,
    side_m: float,
    per_led: bool,
) -> LitStrip:
    """Make a strip of the LEDs (n, 3) of one column or row, of clusters (n,) and light (2, n)."""
    along = place[:, int(is_vertical)]
    order = np.argsort(along, kind="stable")
    at = along[order]
    # The last entry, -1, is that of gaps.
    cluster, light = np.append(clusters[order], -1), np.column_stack([light[:, order], np.zeros(2)])
    gaps = np.diff(at)
    near = float(gaps.min()) if len(gaps) else np.inf
    pitch_m = near if near <= 2 * side_m else side_m
    cuts, parts = [float(at[0]) - pitch_m / 2], [0]
    for i, gap in enumerate(gaps.tolist()):
        if gap > 1.001 * pitch_m:
            cuts += [float(at[i]) + pitch_m / 2, float(at[i + 1]) - pitch_m / 2]
            parts += [-1, i + 1]
        elif per_led or cluster[i + 1] != cluster[i]:
            cuts.append(float(at[i] + at[i + 1]) / 2)
            parts.append(i + 1)
    cuts.append(float(at[-1]) + pitch_m / 2)
    length_m, middle = cuts[-1] - cuts[0], (cuts[0] + cuts[-1]) / 2
    shares = tuple((cut - middle) / length_m for cut in cuts)
    centre = place[0].copy()
    centre[int(is_vertical)] = middle
    x, y, z = centre.tolist()
    switched, constant = light[:, parts]
    return LitStrip(
        (x, y, z), is_vertical, length_m, side_m, shares, cluster[parts], switched, constant, 1, pitch_m
    )
