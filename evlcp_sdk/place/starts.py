"""Closed-form positions and attitudes to fit from."""

import math
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.observations import Problem

__all__ = ["closed_form_starts", "three_point_poses"]

Floats = NDArray[np.float64]

_HEADINGS = 72
"""Headings tried at first where none is known: 5 degrees apart, a fraction of the basin of the fit."""


def closed_form_starts(problem: Problem) -> list[tuple[Floats, Floats]]:
    """Pairs of position, m, float64 (3,), and camera axes as columns in ENU, float64 (3, 3), to fit from."""
    sights = problem.sights()
    good = np.isfinite(sights).all(1)
    if good.sum() < 3:
        return []
    sights, enu = sights[good], problem.enu_m[good]
    if problem.attitude is None:
        return _three_point_starts(problem)
    known = problem.attitude.rotation()
    if problem.compass:
        position, cost = _nearest_to_sights(enu, sights @ known.T)
        return [(position, known)] if np.isfinite(cost) else []
    angle = np.arange(_HEADINGS) * (2 * math.pi / _HEADINGS)
    turned = np.zeros((_HEADINGS, 3, 3))
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(angle)
    turned[:, 1, 0], turned[:, 0, 1] = np.sin(angle), -np.sin(angle)
    turned[:, 2, 2] = 1
    rotations = turned @ known
    positions, costs = _nearest_to_sights(enu, sights @ rotations.transpose(0, 2, 1))
    # A start from each valley, so that a second solution is found where there is one.
    low = (costs <= np.roll(costs, 1)) & (costs <= np.roll(costs, -1)) & np.isfinite(costs)
    order = [int(i) for i in np.argsort(costs) if low[i]][:4]
    return [(positions[i], rotations[i]) for i in order]


def _nearest_to_sights(enu_m: Floats, sights: Floats) -> tuple[Floats, Floats]:
    """The point nearest to all lines through `enu_m` along `sights`, and how far it is from them.

    Args:
        enu_m: Points, m, float64 (n, 3).
        sights: Unit vectors, float64 (..., n, 3).

    Returns:
        Points, m, float64 (..., 3), and the sum of 1 - cosine of the angles by which the lines miss them,
        float64 (...,): large where lines lead there from behind, infinite where it is not determined.
    """
    normal = len(enu_m) * np.eye(3) - np.swapaxes(sights, -1, -2) @ sights
    # What the lines leave open, as when all are parallel, is a direction of no curvature.
    determined = np.linalg.eigvalsh(normal)[..., 0] > 1e-12 * len(enu_m)
    normal = np.where(determined[..., None, None], normal, np.eye(3))
    along = (sights * enu_m).sum(-1, keepdims=True)
    position = np.linalg.solve(normal, (enu_m - sights * along).sum(-2)[..., None])[..., 0]
    offset = enu_m - position[..., None, :]
    distance = np.maximum(np.linalg.norm(offset, axis=-1), 1e-9)
    cost = (1 - (offset * sights).sum(-1) / distance).sum(-1)
    return position, np.where(determined, cost, np.inf)


def _three_point_starts(problem: Problem) -> list[tuple[Floats, Floats]]:
    """Grunert's solutions for the three bars that span the largest triangle."""
    sights = problem.sights()
    centres, seen = problem.centres_m, []
    for i in range(len(centres)):
        mean = sights[problem.bar == i].mean(0)
        seen.append(mean / np.linalg.norm(mean))

    def area(three: list[int]) -> float:
        a, b, c = centres[three]
        return float(np.linalg.norm(np.cross(b - a, c - a)))

    three = max((list(c) for c in combinations(range(len(centres)), 3)), key=area)
    return three_point_poses(centres[three], np.array(seen)[three])


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
    for v in np.roots(quartic).real:
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
