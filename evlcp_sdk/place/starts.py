"""Positions and attitudes to fit from, in closed form."""

import math
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.observations import Problem

Floats = NDArray[np.float64]

_HEADINGS = 72
"""Tried at first where none is known: 5 degrees apart, a fraction of the basin of the fit."""

_FINER = 25
"""Tried in each valley of these: 0.4 degrees apart."""

_MOST = 4
"""Starts of one problem."""

_FALSE, _FALSE_PX = 10.0, 0.5
"""By all of Grunert's solutions three bars are seen where they stand. By false ones, their ends are off
by ten times as much as by the likeliest one, and by ten times this much."""


def closed_form_starts(problem: Problem) -> list[tuple[Floats, Floats]]:
    """Pairs of position, m, float64 (3,), and camera axes as columns in ENU, float64 (3, 3).

    The likeliest comes first. With the heading known, the point nearest to all lines of sight; with gravity
    known, the best of these over the headings; else Grunert's solutions for the three bars that span the
    largest triangle.
    """
    flat = problem.camera.undistort(problem.points[:, 6:8])
    seen = np.column_stack([flat, np.ones(len(flat))])
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    good = np.isfinite(seen).all(1)
    if good.sum() < 3:
        return []
    points, seen, bar = problem.points[good, :3], seen[good], problem.bar[good]
    if problem.attitude is None:
        poses = three_point_poses(*_widest_three(points, seen, bar))
        costs = [_missed(points, seen, *pose) for pose in poses]
        likeliest = min(costs, default=math.inf) + len(flat) * (_FALSE_PX / problem.camera.focal_px) ** 2
        order = sorted(range(len(poses)), key=costs.__getitem__)
        return [poses[i] for i in order if costs[i] <= _FALSE**2 * likeliest]
    enu, mean = _halves(points, seen, bar)
    if problem.angles.known == 3:
        places, costs_of = nearest_to_sights(enu, mean, problem.angles.level[None])
        return [(places[0], problem.angles.level)] if costs_of[0] < math.inf else []
    return _level_starts(enu, mean, problem.angles.level)


def _halves(points: Floats, seen: Floats, bar: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Mean places and sights of the halves of each bar, float64 (n, 3) each."""
    pairs = []
    for number in np.unique(bar):
        rows = np.flatnonzero(bar == number)
        for half in (rows[: len(rows) // 2], rows[len(rows) // 2 :]):
            if len(half):
                mean = seen[half].sum(0)
                pairs.append((points[half].mean(0), mean / np.linalg.norm(mean)))
    enu, sights = zip(*pairs, strict=True)
    return np.array(enu), np.array(sights)


def nearest_to_sights(enu: Floats, sights: Floats, rotations: Floats) -> tuple[Floats, Floats]:
    """The point nearest to all lines through `enu` (n, 3) along `sights` (n, 3), for each of `rotations`.

    Returns:
        Points, m, float64 (r, 3), and the sum of 1 - cosine of the angles by which the lines miss them, large
        where lines lead there from behind, infinite where it is not determined, float64 (r,).
    """
    here = sights @ rotations.swapaxes(1, 2)
    matrix = len(enu) * np.eye(3) - here.swapaxes(1, 2) @ here
    side = enu.sum(0) - (here * (here * enu).sum(-1, keepdims=True)).sum(1)
    # Of n unit lines the determinant is at most (2 n / 3)^3; what they leave open makes it vanish.
    good = np.linalg.det(matrix) > 1e-12 * len(enu) ** 3
    matrix[~good] = np.eye(3)
    places = np.linalg.solve(matrix, side[..., None])[..., 0]
    away = enu - places[:, None]
    far = np.maximum(np.linalg.norm(away, axis=-1), 1e-9)
    costs = (1 - (away * here).sum(-1) / far).sum(1)
    return places, np.where(good, costs, math.inf)


def _level_starts(enu: Floats, sights: Floats, level: Floats) -> list[tuple[Floats, Floats]]:
    """Poses by gravity alone, the likeliest first: of each valley of what headings miss, its lowest."""
    step = 2 * math.pi / _HEADINGS
    headings = step * np.arange(_HEADINGS)
    _, costs = nearest_to_sights(enu, sights, _turned(level, headings))
    low = (costs <= np.roll(costs, 1)) & (costs <= np.roll(costs, -1)) & (costs < math.inf)
    found = []
    for valley in sorted(np.flatnonzero(low).tolist(), key=costs.__getitem__)[:_MOST]:
        finer = headings[valley] + step * np.linspace(-1.0, 1.0, _FINER)
        rotations = _turned(level, finer)
        places, misses = nearest_to_sights(enu, sights, rotations)
        best = int(misses.argmin())
        found.append((places[best], rotations[best]))
    return found


def _turned(level: Floats, headings: NDArray[np.floating]) -> Floats:
    """Axes (3, 3) turned about up, float64 (r, 3, 3)."""
    c, s, zero = np.cos(headings), np.sin(headings), np.zeros(len(headings))
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, zero + 1]]
    return np.moveaxis(np.array(rows), -1, 0) @ level


def _widest_three(points: Floats, seen: Floats, bar: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Centres of the three bars that span the largest triangle, and sights of them, float64 (3, 3) each."""
    centres, sights = (
        np.array([part[bar == number].mean(0) for number in np.unique(bar)]) for part in (points, seen)
    )
    if len(centres) < 3:
        return np.zeros((3, 3)), np.zeros((3, 3))

    threes = list(combinations(range(len(centres)), 3))
    sides = [(centres[j] - centres[i], centres[k] - centres[i]) for i, j, k in threes]
    areas = [float(np.linalg.norm(np.cross(one, other))) for one, other in sides]
    chosen = list(threes[int(np.argmax(areas))])
    sights = sights[chosen]
    return centres[chosen], sights / np.linalg.norm(sights, axis=1, keepdims=True)


def _missed(points: Floats, seen: Floats, position: Floats, rotation: Floats) -> float:
    """The sum of squares of the angles between the points and where they are seen."""
    away = points - position
    cosine = (away @ rotation * seen).sum(1) / np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    return float(np.maximum(2 - 2 * cosine, 0.0).sum())


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
    one, two, other = enu_m
    a2, b2, c2 = (float(side @ side) for side in (two - other, one - other, one - two))
    ca, cb, cg = (float(sights[i] @ sights[j]) for i, j in ((1, 2), (0, 2), (0, 1)))
    if not (a2 and b2 and c2):
        return []
    q, r, s = (a2 - c2) / b2, (a2 + c2) / b2, c2 / b2
    quartic = [
        (q - 1) ** 2 - 4 * s * ca**2,
        4 * (q * (1 - q) * cb - (1 - r) * ca * cg + 2 * s * ca**2 * cb),
        2 * (q**2 - 1 + 2 * q**2 * cb**2 + 2 * (b2 - c2) / b2 * ca**2 - 4 * r * ca * cb * cg)
        + 4 * (b2 - a2) / b2 * cg**2,
        4 * (-q * (1 + q) * cb + 2 * a2 / b2 * cg**2 * cb - (1 - r) * ca * cg),
        (1 + q) ** 2 - 4 * a2 / b2 * cg**2,
    ]
    found = []
    for root in np.roots(quartic).tolist():
        v = root.real
        bottom = 2 * (cg - v * ca)
        # Of a conjugate pair, the real part counts once.
        if root.imag < -1e-9 * abs(root) or v <= 0 or abs(bottom) < 1e-15:
            continue
        u = ((-1 + q) * v**2 - 2 * q * cb * v + 1 + q) / bottom
        square = 1 + v * v - 2 * v * cb
        if u > 0 and square > 0:
            there = math.sqrt(b2 / square) * np.array([[1.0], [u], [v]]) * sights
            # Turns the triangle as it is seen onto the one that stands there.
            rotation = _triad(enu_m).T @ _triad(there)
            found.append((enu_m.mean(0) - rotation @ there.mean(0), rotation))
    return found[:_MOST]


def _triad(points: Floats) -> Floats:
    """Axes of a triangle (3, 3), as rows: along its first side, across that in its plane, and upright."""
    along, upright = points[1] - points[0], np.cross(points[1] - points[0], points[2] - points[0])
    along, upright = (axis / max(float(np.linalg.norm(axis)), 1e-300) for axis in (along, upright))
    return np.array([along, np.cross(upright, along), upright])
