"""The weighted least-squares fit of a pose, and of every error that is shared, to all observations."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from evlcp_sdk.place.error_model import chi_square
from evlcp_sdk.place.model import SHARED, Equations, Fit, linearize, move
from evlcp_sdk.place.observations import Problem
from evlcp_sdk.place.rejections import Rejection
from evlcp_sdk.place.starts import closed_form_starts

Floats = NDArray[np.float64]

ODDS = 18.4
"""Square sums that differ by less are not told apart: beyond, one solution is 10 000 times likelier."""

_STEPS = 50
"""Levenberg-Marquardt steps; from a closed-form start, five to ten arrive."""

_OTHER_STEPS = 15
"""Steps of a fit from another start, once there is one."""

_HOPELESS = 50.0
"""How many times as much as is usual a fit costs that is given up: by Huber's weights it falls slowly."""

_SAME = 1e-3
"""Fits that are nearer to each other than this share of the distance, and fit alike, are one."""

_MISSING = 20.0
"""Square sum a point beyond which what misses is refused, wherever exactly it ends."""

_STALLED = 4
"""Steps in a row that hardly lower the cost before it is asked whether it can still fall below the limit."""


def likely_fits(problem: Problem) -> list[Equations] | Rejection:
    """Where fits from all starts settle, each place once, the likeliest first; or why there is none.

    What is hopeless ends before it is at its least cost.
    """
    starts = closed_form_starts(problem)
    if not starts:
        return Rejection("not-determined", "no place from which the bars would be seen so")
    usual = usual_cost(problem)
    fits: list[Equations] = []
    for position, rotation in starts:
        steps = _STEPS if all(fit.cost > usual for fit in fits) else _OTHER_STEPS
        start = Fit.at(problem, position, rotation)
        fit, settled = fit_pose(problem, start, steps, hopeless=_HOPELESS * usual)
        if fit is not None and settled and not any(_same(problem, fit, other) for other in fits):
            fits.append(fit)
    if not fits:
        return Rejection("not-determined", "the fit does not settle: the bars do not determine a position")
    return sorted(fits, key=lambda fit: fit.cost)


def usual_cost(problem: Problem) -> float:
    """What a cost is not above where all is as said."""
    return chi_square(problem.spec.false_alarm / 2, problem.freedom)


def _same(problem: Problem, one: Equations, two: Equations) -> bool:
    away, far = one.at.position - two.at.position, one.at.position - problem.points[0, :3]
    alike = abs(one.cost - two.cost) < 1e-3 * (1 + two.cost)
    return bool(alike and away @ away < _SAME**2 * (far @ far))


def fit_pose(
    problem: Problem, start: Fit, steps: int = _STEPS, *, hopeless: float = math.inf
) -> tuple[Equations | None, bool]:
    """Levenberg-Marquardt with Huber's weights.

    The damping follows how much of what the equations promise a step wins (Nielsen 1999).

    Args:
        problem: What is seen and known.
        start: Where to begin.
        steps: At most so many.
        hopeless: A cost above which it counts as settled where steps hardly lower it, nor promise to.

    Returns:
        Where it ends, None where the start has a point behind the camera; and whether it settled there.
    """
    huber = problem.spec.huber_sigmas
    equations = linearize(problem, start, huber)
    if equations is None:
        return None, False
    matrix, side = _normal(problem, equations)
    damping, growth, stalled = 1e-4, 4.0, 0
    for _ in range(steps):
        cost = equations.cost
        step = _solve(matrix, side, damping)
        if step is None:
            break
        shared = np.zeros(SHARED)
        shared[problem.free] = step
        there = move(problem, equations.at, equations.step(shared))
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
            equations = found
            matrix, side = _normal(problem, equations)
            ratio = won / hoped if hoped > 0 else 1.0
            damping = min(max(damping * max(0.1, 1 - (2 * ratio - 1) ** 3), 1e-12), 1e12)
            growth = 4.0
            enough = 1e-3 if found.cost > _MISSING * len(problem.points) else 1e-6
            if won <= enough * (1 + found.cost) and abs(promise) < enough * (100 + found.cost):
                return equations, True
        else:
            damping *= growth
            growth *= 2
            if damping > 1e12 or abs(promise) < 1e-9:
                # No step is an improvement any more: rounding decides.
                return equations, promise < 1e-3
        if stalled == _STALLED and equations.cost > hopeless:
            stalled = 0
            last = _solve(matrix, side, 1e-9)
            if equations.cost - (0.0 if last is None else float(side @ last)) > hopeless:
                return equations, True
    return equations, False


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
