"""The weighted least-squares fit of position, attitude and shared shifts to all observations."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.observations import Problem, cross_matrix, observe

__all__ = ["Fit", "fit_pose", "moved", "normal_equations"]

Floats = NDArray[np.float64]

_STEPS = 50
"""Levenberg-Marquardt steps; from a closed-form start, five to ten arrive."""


@dataclass(frozen=True, eq=False)
class Fit:
    """One point of the fit.

    Attributes:
        position: m, float64 (3,).
        rotation: Camera axes as columns in ENU, float64 (3, 3).
        shared: Shift of each bar's image, px, float64 (bars, 2).
        cost: Twice the robust cost.
    """

    position: Floats
    rotation: Floats
    shared: Floats
    cost: float


def fit_pose(problem: Problem, position: Floats, rotation: Floats) -> Fit | None:
    """Levenberg-Marquardt with Huber's weights; None where it leaves the view or does not settle."""
    bars = len(problem.transmitters)
    here = Fit(position, rotation, np.zeros((bars, 2)), np.inf)
    found = normal_equations(problem, here)
    if found is None:
        return None
    normal, right, cost = found
    here = Fit(position, rotation, here.shared, cost)
    damping = 1e-4
    for _ in range(_STEPS):
        try:
            move = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), right)
        except np.linalg.LinAlgError:
            return None
        there = moved(problem, here, np.asarray(move, np.float64))
        found = normal_equations(problem, there)
        if found is not None and found[2] <= here.cost:
            gain = here.cost - found[2]
            normal, right, cost = found
            here = Fit(there.position, there.rotation, there.shared, cost)
            damping = max(damping / 10, 1e-12)
            if gain <= 1e-9 * (1 + cost) and float(np.abs(right @ move)) < 1e-6:
                return here
        else:
            damping *= 10
            if damping > 1e12:
                # No step is an improvement any more: rounding decides.
                return here if float(right @ move) < 1e-3 else None
    return None


def normal_equations(problem: Problem, at: Fit) -> tuple[Floats, Floats, float] | None:
    """Normal equations and twice the robust cost; None where a point is behind the camera."""
    seen = observe(problem, at.position, at.rotation, at.shared)
    if seen is None:
        return None
    known, rows = seen.known_miss, seen.known_slope
    size = np.linalg.norm(seen.miss, axis=1)
    bound = problem.spec.huber_sigmas
    far = size > bound
    weight = np.where(far, bound / np.maximum(size, 1e-300), 1.0)
    cost = float(np.where(far, bound * (2 * size - bound), size**2).sum() + (known**2).sum())
    flat, flat_miss = seen.slope.reshape(-1, seen.slope.shape[2]), seen.miss.ravel()
    weighted = flat * np.repeat(weight, 2)[:, None]
    return flat.T @ weighted + rows.T @ rows, weighted.T @ flat_miss + rows.T @ known, cost


def moved(problem: Problem, fit: Fit, move: Floats) -> Fit:
    """The fit with its unknowns moved."""
    n = len(problem.turns)
    turns = np.zeros(3)
    turns[list(problem.turns)] = move[3 : 3 + n]
    shared = fit.shared + move[3 + n :].reshape(-1, 2) if len(move) > 3 + n else fit.shared
    return Fit(fit.position + move[:3], _turn(turns) @ fit.rotation, shared, np.inf)


def _turn(vector: Floats) -> Floats:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3) + cross_matrix(vector)
    k = cross_matrix(vector / angle)
    return np.asarray(np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * (k @ k))
