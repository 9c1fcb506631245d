"""Bars that sweep over the image: where, and how fast, by their events alone.

Where a camera turns, a pixel sees a bar for a few chips, and none blinks in rhythm. But all of a bar's events
lie on a line that moves, and come with the chips: a plane through their places and times says where it is and
how fast across itself, within a step, and how the times of rises agree with the chips whether it is a bar.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx.boxes import Box, find_areas, grown, inside, overlap
from evlcp_sdk.values import Events

FAST_PX_US = 2e-3
"""Speed across itself from which on a bar sweeps: its image, some 3 px wide, is on a pixel for 15 chips, in
which that hardly comes to the score of a candidate."""

_MOST_EVENTS = 1000
"""Of a step, evenly taken, that are enough: the place is good to a twentieth of a pixel."""

_LEAST_EVENTS, _FEWEST = 200, 50
"""Of a step that a sweep needs, a bar at 150 m has a few thousand; and of those taken."""

_ROUNDS, _OUTLIER = 3, 3.0
"""How often the plane is fitted, each time to what was within so many sigmas of it."""

_WIDEST_PX = 5.0
"""Sigma of a bar's events across it: 1.5 px at 40 m, 4 px out of focus at 18 m."""

_LEAST_SHARE = 0.6
"""Of the events, that lie on the line."""

_EDGE = 0.25
"""Share of the median of rows (of a lying bar: columns) from which on one belongs to the bar."""

_CHANCE = 4.0
"""Length of the sum of the phases of rises in a chip, in roots of their number, from which on they come with
the chips: random ones reach it once in 10 million cases."""

_CELL_SHIFT, _CELL_EVENTS, _MOST_AREAS = 4, 8, 4
"""Cells of 16 px, of which those with so many events show where something moves; and how many such areas,
those with the most events, are looked at."""

_PHASES = 4000
"""Rises whose phases are summed at the most."""


class Sweep(NamedTuple):
    """A line that moves.

    Attributes:
        x_px: Column of its centre in the middle of the step.
        y_px: Row of it.
        width_px: How many columns it is wide.
        height_px: How many rows.
        speed: To the right and down, px/us.
        rows: Events in each row of the box it was sought in, as if it had stood still, int64 (n,).
    """

    x_px: float
    y_px: float
    width_px: float
    height_px: float
    speed: tuple[float, float]
    rows: NDArray[np.int64]

    @property
    def is_fast(self) -> bool:
        """Whether it is too fast across itself for its pixels to blink."""
        return abs(self.speed[0 if self.height_px > self.width_px else 1]) >= FAST_PX_US


def fit_sweep(
    events: Events, middle_us: float, box: Box, along: float = 0.0, least: float = 0.0
) -> Sweep | None:
    """The line on which the events in a box lie; None where they lie on none, or it is clearly slower.

    `along` is how fast it moves along itself, px/us, which its events do not say, `least` across itself.
    """
    left, top, right, bottom = box
    every = max(events.t_us.size // _MOST_EVENTS, 1)
    t, x, y = (one[::every].astype(np.float64) for one in (events.t_us, events.x, events.y))
    here = (x >= left) & (x < right) & (y >= top) & (y < bottom)
    t, x, y = t[here] - middle_us, x[here], y[here]
    if t.size < _FEWEST or t.size * every < _LEAST_EVENTS:
        return None
    upright = float(y.std()) >= float(x.std())
    across, length = (x, y - along * t) if upright else (y, x - along * t)
    centre = float(length.mean())
    terms = np.stack([np.ones_like(t), t * 1e-3, length - centre])
    near, sigma = np.ones(t.size, np.bool_), 0.0
    for _ in range(_ROUNDS):
        weighed = terms * near
        plane = np.linalg.solve(weighed @ terms.T + 1e-9 * np.eye(3), weighed @ across)
        if abs(plane[1]) * 1e-3 < least / 2:
            return None
        off = np.abs(across - plane @ terms)
        sigma = max(1.48 * float(np.median(off)), 0.7)
        near = off <= _OUTLIER * sigma
    if sigma > _WIDEST_PX or near.mean() < _LEAST_SHARE:
        return None
    speed = float(plane[1]) * 1e-3
    first, last = _ends(length[near])
    middle = (first + last) / 2
    place = float(plane[0] + plane[2] * (middle - centre))
    wide, long = 4 * sigma + abs(float(plane[2])) * (last - first), last - first + 1
    y_still = y[near] - (along if upright else speed) * t[near]
    rows = np.bincount(
        np.clip(np.rint(y_still - top), 0, bottom - top - 1).astype(np.int64), minlength=bottom - top
    )
    if upright:
        return Sweep(place, middle, wide, long, (speed, along), rows)
    return Sweep(middle, place, long, wide, (along, speed), rows)


def _ends(places: NDArray[np.float64]) -> tuple[float, float]:
    """First and last px of a line that hold what most of its px hold."""
    first = math.floor(float(places.min()))
    many = np.bincount((np.rint(places) - first).astype(np.int64))
    lit = np.flatnonzero(many >= _EDGE * float(np.median(many[many > 0])))
    return float(first + lit[0]), float(first + lit[-1])


def with_chips(events: Events, box: Box, chip_us: float) -> bool:
    """Whether rises in a box come with the chips."""
    t_us = events.t_us[inside(events, box) & (events.p > 0)]
    t_us = t_us[:: max(t_us.size // _PHASES, 1)]
    if not t_us.size:
        return False
    turn = np.exp(2j * math.pi / chip_us * (t_us - t_us[0])).sum()
    return bool(abs(turn) > _CHANCE * math.sqrt(t_us.size))


def find_sweeps(
    events: Events,
    start_us: int,
    step_us: int,
    chip_us: float | None,
    known: Sequence[Box],
    size_px: tuple[int, int],
) -> list[Sweep]:
    """Bars that sweep over the image in a step, outside of boxes that are known; without chips, any lines."""
    columns, rows = ((n - 1 >> _CELL_SHIFT) + 1 for n in size_px)
    every = max(events.t_us.size // _PHASES, 1)
    cells = (events.y[::every] >> _CELL_SHIFT).astype(np.int64) * columns + (events.x[::every] >> _CELL_SHIFT)
    many = np.bincount(cells, minlength=rows * columns).reshape(rows, columns).astype(np.int16)
    many[many < _CELL_EVENTS] = 0
    areas, _ = find_areas(many, _MOST_AREAS, size_px, _CELL_SHIFT)
    found = []
    for area in areas:
        box = grown(area, 1 << _CELL_SHIFT)
        if any(overlap(area, one) for one in known):
            continue
        sweep = fit_sweep(events, start_us + step_us / 2, box, least=FAST_PX_US)
        if sweep is None or not sweep.is_fast:
            continue
        if chip_us is None or with_chips(events, box, chip_us):
            found.append(sweep)
    return found
