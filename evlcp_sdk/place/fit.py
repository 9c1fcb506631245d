"""The weighted least-squares fit of a pose, and of every error that is shared, to all observations."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from evlcp_sdk.place.model import SHARED, Equations, Fit, linearize, move
from evlcp_sdk.place.observations import Problem

Floats = NDArray[np.float64]

STEPS = 50
"""Levenberg-Marquardt steps; from a closed-form start, five to ten arrive."""

_MISSING = 20.0
"""Square sum a point beyond which what misses is refused, wherever exactly it ends."""

_STALLED = 4
"""Steps in a row that hardly lower the cost before it is asked whether it can still fall below the limit."""


def fit_pose(
    problem: Problem, start: Fit, steps: int = STEPS, *, robust: bool = True, hopeless: float = math.inf
) -> Fit:
    """Levenberg-Marquardt, with Huber's weights if robust.

    The damping follows how much of what the equations promise a step wins (Nielsen 1999).

    Args:
        problem: What is seen and known.
        start: Where to begin; its cost does not matter.
        steps: At most so many.
        robust: Else plain least squares.
        hopeless: A cost above which it counts as settled where steps hardly lower it, nor promise to.

    Returns:
        Where it ends; its cost is NaN where the start has a point behind the camera.
    """
    huber = problem.spec.huber_sigmas if robust else math.inf
    here, equations = start, linearize(problem, start, huber)
    if equations is None:
        return replace(start, cost=math.nan, settled=False)
    matrix, side = _normal(problem, equations)
    near = 1e-6 if robust else 1e-4
    damping, growth, stalled = 1e-4, 4.0, 0
    for _ in range(steps):
        cost = equations.cost
        step = _solve(matrix, side, damping)
        if step is None:
            break
        shared = np.zeros(SHARED)
        shared[problem.free] = step
        there = move(problem, here, equations.step(shared))
        found = linearize(problem, there, huber)
        if found is not None and found.cost > cost and problem.surveyed:
            # What a long turn leaves of second order, errors of the sites take up where they are large.
            there = move(problem, there, found.step(np.zeros(SHARED)))
            found = linearize(problem, there, huber)
        promise = float(side @ step)
        hoped = promise + damping * float(step @ (np.diag(matrix) * step))
        stalled = 0 if found is not None and found.cost < 0.7 * cost else stalled + 1
        if found is not None and found.cost <= cost:
            won = cost - found.cost
            here, equations = there, found
            matrix, side = _normal(problem, equations)
            ratio = won / hoped if hoped > 0 else 1.0
            damping = min(max(damping * max(0.1, 1 - (2 * ratio - 1) ** 3), 1e-12), 1e12)
            growth = 4.0
            enough = 1e-3 if found.cost > _MISSING * len(problem.points) else near
            if won <= max(enough, 1e-6) * (1 + found.cost) and abs(promise) < enough * (100 + found.cost):
                return replace(here, cost=found.cost, settled=True)
        else:
            damping *= growth
            growth *= 2
            if damping > 1e12 or abs(promise) < 1e-9:
                # No step is an improvement any more: rounding decides.
                return replace(here, cost=cost, settled=promise < 1e-3)
        if stalled == _STALLED and equations.cost > hopeless:
            stalled = 0
            last = _solve(matrix, side, 1e-9)
            if equations.cost - (0.0 if last is None else float(side @ last)) > hopeless:
                return replace(here, cost=equations.cost, settled=True)
    return replace(here, cost=equations.cost, settled=False)


def _normal(problem: Problem, equations: Equations) -> tuple[Floats, Floats]:
    """Normal equations of the shared unknowns that are free."""
    matrix, side = equations.normal()
    return matrix[np.ix_(problem.free, problem.free)], side[problem.free]


def _solve(matrix: Floats, side: Floats, damping: float) -> Floats | None:
    """The damped equations' solution; None where they are singular."""
    damped = matrix.copy()
    damped.flat[:: len(matrix) + 1] *= 1 + damping
    scale = 1 / np.sqrt(np.maximum(np.diag(damped), 1e-300))
    _, found, singular = dposv(damped * scale * scale[:, None], side * scale)
    return None if singular else found * scale
