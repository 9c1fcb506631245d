"""Closed-form positions and attitudes to fit from."""

import math
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place import _kernels
from evlcp_sdk.place.observations import Problem

__all__ = ["closed_form_starts", "three_point_poses"]

Floats = NDArray[np.float64]

_ANGLES = np.arange(72) * (2 * math.pi / 72)
"""Headings tried at first where none is known: 5 degrees apart, a fraction of the basin of the fit."""

_HEADINGS = np.zeros((72, 3, 3))
_HEADINGS[:, 0, 0] = _HEADINGS[:, 1, 1] = np.cos(_ANGLES)
_HEADINGS[:, 1, 0], _HEADINGS[:, 0, 1] = np.sin(_ANGLES), -np.sin(_ANGLES)
_HEADINGS[:, 2, 2] = 1


def closed_form_starts(problem: Problem) -> list[tuple[Floats, Floats]]:
    """Pairs of position, m, float64 (3,), and camera axes as columns in ENU, float64 (3, 3), to fit from.

    The likeliest comes first.
    """
    sights = problem.sights()
    if np.isfinite(sights[:, 0]).sum() < 3:
        return []
    if problem.attitude is None:
        return _three_point_starts(problem, sights)
    enu, mean = _halves(problem, sights)
    known = problem.attitude.rotation()
    if problem.angles == 3:
        positions, costs = _nearest_to_sights(enu, mean, known[None])
        return [(positions[0], known)] if costs[0] < np.inf else []
    rotations = _HEADINGS @ known
    positions, costs = _nearest_to_sights(enu, mean, rotations)
    # A start from each valley, so that a second solution is found where there is one.
    low = (costs <= np.roll(costs, 1)) & (costs <= np.roll(costs, -1)) & (costs < np.inf)
    order = [int(i) for i in np.argsort(costs) if low[i]][:4]
    return [(positions[i], rotations[i]) for i in order]


def _halves(problem: Problem, sights: Floats) -> tuple[Floats, Floats]:
    """Mean places and sights of the halves of each bar: what a start needs of its points."""
    bars = len(problem.transmitters)
    enu, mean = np.empty((2 * bars, 3)), np.empty((2 * bars, 3))
    found = _kernels.halves(problem.points, problem.bar, sights, enu, mean)
    return enu[:found], mean[:found]


def _nearest_to_sights(enu_m: Floats, sights: Floats, rotations: Floats) -> tuple[Floats, Floats]:
    """The points nearest to all lines along `sights`, for each rotation, and how far these miss them."""
    positions, costs = np.zeros((len(rotations), 3)), np.zeros(len(rotations))
    _kernels.nearest_to_sights(enu_m, sights, np.ascontiguousarray(rotations), positions, costs)
    return positions, costs


def _three_point_starts(problem: Problem, sights: Floats) -> list[tuple[Floats, Floats]]:
    """Grunert's solutions for the three bars that span the largest triangle."""
    centres, seen = problem.centres_m(), []
    for i in range(len(centres)):
        mean = np.nansum(sights[problem.bar == i], 0)
        seen.append(mean / np.linalg.norm(mean))

    def area(three: list[int]) -> float:
        a, b, c = centres[three]
        return float(np.linalg.norm(np.cross(b - a, c - a)))

    three = max((list(c) for c in combinations(range(len(centres)), 3)), key=area)
    found = three_point_poses(centres[three], np.array(seen)[three])
    return sorted(found, key=lambda start: _off(problem, sights, *start))


def _off(problem: Problem, sights: Floats, position: Floats, rotation: Floats) -> float:
    """By how much the points are away from where they are seen: the sum of 1 - cosine of the angles."""
    away = (problem.points[:, :3] - position) @ rotation
    return -float(np.nansum((away * sights).sum(1) / np.sqrt((away * away).sum(1))))


def three_point_poses(enu_m: Floats, sights: Floats) -> list[tuple[Floats, Floats]]:
    """Positions and rotations from which three points are seen in three directions (Grunert 1841).

    In the notation of Haralick et al., IJCV 13 (1994), 331. Complex roots, as noise makes of double ones,
    count with their real part.

    Args:
        enu_m: The points, m, float64 (3, 3).
        sights: Unit vectors towards them in the camera's axes, float64 (3, 3).

    Returns:
        Up to four pairs of position, m, float64 (3,), and camera axes as columns in ENU, float64 (3, 3).
    """
    p, j = enu_m, sights
    a2, b2, c2 = (float(((p[m] - p[n]) ** 2).sum()) for m, n in ((1, 2), (0, 2), (0, 1)))
    ca, cb, cg = float(j[1] @ j[2]), float(j[0] @ j[2]), float(j[0] @ j[1])
    q, r, s = (a2 - c2) / b2, (a2 + c2) / b2, c2 / b2
    quartic = [
        (q - 1) ** 2 - 4 * s * ca**2,
        4 * (q * (1 - q) * cb - (1 - r) * ca * cg + 2 * s * ca**2 * cb),
        2 * (q**2 - 1 + 2 * q**2 * cb**2 + 2 * (b2 - c2) / b2 * ca**2 - 4 * r * ca * cb * cg
             + 2 * (b2 - a2) / b2 * cg**2),
        4 * (-q * (1 + q) * cb + 2 * a2 / b2 * cg**2 * cb - (1 - r) * ca * cg),
        (1 + q) ** 2 - 4 * a2 / b2 * cg**2,
    ]  # fmt: skip
    found = []
    roots = np.roots(quartic)
    # Of a conjugate pair, the real part counts once.
    for v in roots[roots.imag >= 0].real:
        bottom = 2 * (cg - v * ca)
        if v <= 0 or abs(bottom) < 1e-15:
            continue
        u = ((-1 + q) * v**2 - 2 * q * cb * v + 1 + q) / bottom
        square = 1 + v * v - 2 * v * cb
        if u <= 0 or square <= 0:
            continue
        first = math.sqrt(b2 / square)
        seen = np.array([first, u * first, v * first])[:, None] * j
        # Kabsch: the rotation that brings the points as seen onto the points as they stand.
        left, _, right = np.linalg.svd((p - p.mean(0)).T @ (seen - seen.mean(0)))
        rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        found.append((p.mean(0) - rotation @ seen.mean(0), rotation))
    return found
