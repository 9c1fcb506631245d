"""Positions and attitudes to fit from: in closed form, then fitted to a few points."""

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.late import Late
from evlcp_sdk.place.chances import chi_square
from evlcp_sdk.place.fit import STEPS, Fit, fit_pose
from evlcp_sdk.place.observations import Problem

if TYPE_CHECKING:
    from evlcp_sdk.place import _kernels
else:
    _kernels = Late("evlcp_sdk.place._kernels")

__all__ = ["ODDS", "is_hopeless", "likely_starts", "three_point_poses"]

Floats = NDArray[np.float64]

ODDS = 18.4
"""Square sums that differ by less are not told apart: beyond, one solution is 10 000 times likelier."""

_HEADINGS = 72
"""Tried at first where none is known: 5 degrees apart, a fraction of the basin of the fit."""

_MOST = 4
"""Starts of one problem."""

_OTHER_STEPS = 15
"""Steps of a fit from another start, once there is one."""

_ROUGHLY = 40.0
"""What a square sum of the means may be off the one of all points, between two starts."""

_FALSE, _FALSE_PX = 10.0, 0.5
"""By all of Grunert's solutions three bars are seen where they stand. By false ones, their ends are off
by ten times as much as by the likeliest one, and by ten times this much."""

_SAME = 1e-3
"""Starts that are nearer to each other than this share of the distance, and fit alike, are one."""


def likely_starts(problem: Problem) -> list[Fit]:
    """Where to fit from, the likeliest first.

    Starts in closed form are fitted to the means of the halves of each bar, by plain least squares, which is
    much faster than to all points and as robust against a poor start. What ends at the same place counts
    once; what fits far worse than another is left out.
    """
    few, limit, usual = problem.halved(), _hopeless(problem), _usual(problem)
    fits: list[Fit] = []
    unsettled: list[Fit] = []
    for position, rotation in _closed_form_starts(problem):
        steps = STEPS if all(fit.cost > usual for fit in fits) else _OTHER_STEPS
        start = Fit.at(problem, position, rotation)
        fit = fit_pose(few, start, steps, robust=False, hopeless=limit)
        if not fit.settled and not math.isnan(fit.cost):
            unsettled.append(fit)
        elif fit.settled and not any(_same(problem, fit, other) for other in fits):
            fits.append(fit)
    if all(fit.cost > usual for fit in fits):
        fits += unsettled
    fits.sort(key=lambda fit: fit.cost)
    return [fit for fit in fits if fit.cost < fits[0].cost + ODDS + _ROUGHLY]


def is_hopeless(problem: Problem, start: Fit) -> bool:
    """Whether the fit to all points, as robust as it is, misses them by more than chance from this start."""
    return start.cost > _hopeless(problem)


def _hopeless(problem: Problem) -> float:
    """A robust square sum within its limit holds that of the means to about the same, and never to this."""
    return 100 + 4 * _usual(problem)


def _usual(problem: Problem) -> float:
    """What a square sum is not above where all is as said."""
    return chi_square(problem.spec.false_alarm / 2, problem.freedom)


def _same(problem: Problem, one: Fit, two: Fit) -> bool:
    away, far = one.position - two.position, one.position - problem.points[0, :3]
    alike = abs(one.cost - two.cost) < 1e-3 * (1 + two.cost)
    return bool(alike and away @ away < _SAME**2 * (far @ far))


def _closed_form_starts(problem: Problem) -> list[tuple[Floats, Floats]]:
    """Pairs of position, m, float64 (3,), and camera axes as columns in ENU, float64 (3, 3).

    The likeliest comes first. With the heading known, the point nearest to all lines of sight; with gravity
    known, the best of these over the headings; else Grunert's solutions for the three bars that span the
    largest triangle.
    """
    flat, bars = problem.camera.undistort(problem.points[:, 6:8]), len(problem.transmitters)
    seen = np.empty((len(flat), 3))
    if _kernels.sights(flat, seen) < 3:
        return []
    positions, rotations = np.empty((_MOST, 3)), np.empty((_MOST, 3, 3))
    if problem.attitude is None:
        enu, mean = np.zeros((3, 3)), np.zeros((3, 3))
        _kernels.widest_three(problem.points, problem.bar, seen, bars, enu, mean)
        found = _kernels.three_points(enu, mean, positions, rotations)
        costs = np.empty(found)
        _kernels.missed(problem.points, seen, positions, rotations, costs)
        likeliest = costs.min(initial=math.inf) + len(flat) * (_FALSE_PX / problem.camera.focal_px) ** 2
        most = _FALSE**2 * likeliest
        return [(positions[i], rotations[i]) for i in costs.argsort().tolist() if costs[i] <= most]
    enu, mean = np.empty((2 * bars, 3)), np.empty((2 * bars, 3))
    count = _kernels.halves(problem.points, problem.bar, seen, enu, mean)
    enu, mean = enu[:count], mean[:count]
    known = problem.level
    if problem.angles == 3:
        costs = np.empty(1)
        _kernels.nearest_to_sights(enu, mean, known[None], positions, costs)
        return [(positions[0], known)] if costs[0] < math.inf else []
    found = _kernels.level_starts(enu, mean, known, _HEADINGS, positions, rotations)
    return [(positions[i], rotations[i]) for i in range(found)]


def three_point_poses(enu_m: Floats, sights: Floats) -> list[tuple[Floats, Floats]]:
    """Positions and rotations from which three points are seen in three directions (Grunert 1841).

    Args:
        enu_m: The points, m, float64 (3, 3).
        sights: Unit vectors towards them in the camera's axes, float64 (3, 3).

    Returns:
        Up to four pairs of position, m, float64 (3,), and camera axes as columns in ENU, float64 (3, 3).
    """
    positions, rotations = np.empty((_MOST, 3)), np.empty((_MOST, 3, 3))
    found = _kernels.three_points(enu_m, sights, positions, rotations)
    return [(positions[i], rotations[i]) for i in range(found)]
