"""Find bars that sweep over the image, and how fast, by their events alone.

Where a camera turns, a pixel sees a bar for a few chips, and none blinks in rhythm. But all of a bar's events
lie on a line that moves, and come with the chips: a plane through their places and times gives its place and
its speed across itself within a step, and rises that agree with the chips show that it is a bar.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx.boxes import Box, boxes_overlap, find_areas, grow_box, mask_inside
from evlcp_sdk.values import Events

FAST_PX_US = 2e-3
"""Speed across itself from which on a bar sweeps: its image, some 3 px wide, is on a pixel for 15 chips, too
few for the score of a candidate."""

_MAX_EVENTS = 1000
"""Events of a step, evenly sampled, that are enough: the place is good to a twentieth of a pixel."""

_MIN_EVENTS, _MIN_SAMPLES = 200, 50
"""Events of a step that a sweep needs, and samples of them; a bar at 150 m has a few thousand events."""

_ROUNDS, _OUTLIER = 3, 3.0
"""How often the plane is fitted, each time to the events within so many sigmas of it."""

_WIDEST_PX = 5.0
"""Sigma of a bar's events across it: 1.5 px at 40 m, 4 px out of focus at 18 m."""

_MIN_SHARE = 0.6
"""Share of the events that lie on the line."""

_LIT_SHARE = 0.25
"""Share of the median of rows (of a lying bar: columns) from which on one belongs to the bar."""

_MIN_PHASE_SUM = 4.0
"""Length of the sum of the phases of rises in a chip, in roots of their number, from which on they come with
the chips: random ones reach it once in 10 million cases."""

_CELL_SHIFT, _CELL_EVENTS, _MAX_AREAS = 4, 8, 4
"""Cells of 16 px with so many events show where something moves; and how many such areas, those with the most
events, are searched."""

_MAX_PHASES = 4000
"""Rises whose phases are summed at the most."""


class Sweep(NamedTuple):
    """A line that moves over the image.

    Attributes:
        x_px: Column of its centre in the middle of the step.
        y_px: Row of its centre.
        width_px: Its columns.
        height_px: Its rows.
        velocity_px_us: To the right and down.
        rows: Events in each row of the searched box, the motion taken out, int64 (n,).
    """

    x_px: float
    y_px: float
    width_px: float
    height_px: float
    velocity_px_us: tuple[float, float]
    rows: NDArray[np.int64]

    @property
    def is_fast(self) -> bool:
        """Whether it is too fast across itself for its pixels to blink."""
        return abs(self.velocity_px_us[0 if self.height_px > self.width_px else 1]) >= FAST_PX_US


def fit_sweep(
    events: Events, middle_us: float, box: Box, along_px_us: float = 0.0, least_px_us: float = 0.0
) -> Sweep | None:
    """Fit a moving line to the events in a box; None where they lie on none, or on a slow one.

    Args:
        events: Those of a step.
        middle_us: The middle of the step, us.
        box: Where to search.
        along_px_us: Speed along the line, which its events do not show.
        least_px_us: Speed across the line, half of which it must have.
    """
    every = max(events.t_us.size // _MAX_EVENTS, 1)
    some = events[::every]
    some = some[mask_inside(some, box)]
    t, x, y = np.array([some.t_us, some.x, some.y], np.float64)
    if t.size < _MIN_SAMPLES or t.size * every < _MIN_EVENTS:
        return None
    t -= middle_us
    across, along = x - x.mean(), y - y.mean()
    upright = float(along @ along) >= float(across @ across)
    across, along = (x, y - along_px_us * t) if upright else (y, x - along_px_us * t)
    centre = float(along.mean())
    terms = np.stack([np.ones_like(t), t * 1e-3, along - centre])
    near, sigma = np.ones(t.size, np.bool_), 0.0
    for _ in range(_ROUNDS):
        weighted = terms * near
        plane = np.linalg.solve(weighted @ terms.T + 1e-9 * np.eye(3), weighted @ across)
        if abs(plane[1]) * 1e-3 < least_px_us / 2:
            return None
        residual = np.abs(across - plane @ terms)
        sigma = max(1.48 * float(np.median(residual)), 0.7)
        near = residual <= _OUTLIER * sigma
    if sigma > _WIDEST_PX or near.mean() < _MIN_SHARE:
        return None
    across_px_us = float(plane[1]) * 1e-3
    first, last = _find_ends(along[near])
    middle = (first + last) / 2
    place = float(plane[0] + plane[2] * (middle - centre))
    width, length = 4 * sigma + abs(float(plane[2])) * (last - first), last - first + 1
    _, top, _, bottom = box
    y_still = y[near] - (along_px_us if upright else across_px_us) * t[near]
    rows = np.bincount(
        np.clip(np.rint(y_still - top), 0, bottom - top - 1).astype(np.int64), minlength=bottom - top
    )
    if upright:
        return Sweep(place, middle, width, length, (across_px_us, along_px_us), rows)
    return Sweep(middle, place, length, width, (along_px_us, across_px_us), rows)


def _find_ends(places: NDArray[np.float64]) -> tuple[float, float]:
    """First and last px of a line that hold what most of its px hold."""
    first = math.floor(float(places.min()))
    counts = np.bincount((np.rint(places) - first).astype(np.int64))
    lit = np.flatnonzero(counts >= _LIT_SHARE * float(np.median(counts[counts > 0])))
    return float(first + lit[0]), float(first + lit[-1])


def has_chip_rhythm(events: Events, box: Box, chip_us: float) -> bool:
    """Whether the rises in a box come with the chips."""
    t_us = events.t_us[mask_inside(events, box) & (events.p > 0)]
    t_us = t_us[:: max(t_us.size // _MAX_PHASES, 1)]
    if not t_us.size:
        return False
    phases = np.exp(2j * math.pi / chip_us * (t_us - t_us[0])).sum()
    return bool(abs(phases) > _MIN_PHASE_SUM * math.sqrt(t_us.size))


def find_sweeps(
    events: Events,
    start_us: int,
    step_us: int,
    chip_us: float | None,
    known: Sequence[Box],
    size_px: tuple[int, int],
) -> list[Sweep]:
    """Find bars that sweep over the image in a step, outside of known boxes; without `chip_us`, any lines."""
    columns, rows = ((n - 1 >> _CELL_SHIFT) + 1 for n in size_px)
    every = max(events.t_us.size // _MAX_PHASES, 1)
    cells = (events.y[::every] >> _CELL_SHIFT).astype(np.int64) * columns + (events.x[::every] >> _CELL_SHIFT)
    counts = np.bincount(cells, minlength=rows * columns).reshape(rows, columns).astype(np.int16)
    counts[counts < _CELL_EVENTS] = 0
    areas, _ = find_areas(counts, _MAX_AREAS, size_px, _CELL_SHIFT)
    sweeps = []
    for area in areas:
        box = grow_box(area, 1 << _CELL_SHIFT)
        if any(boxes_overlap(area, other) for other in known):
            continue
        sweep = fit_sweep(events, start_us + step_us / 2, box, least_px_us=FAST_PX_US)
        if sweep is None or not sweep.is_fast:
            continue
        if chip_us is None or has_chip_rhythm(events, box, chip_us):
            sweeps.append(sweep)
    return sweeps
