"""Whether a fit can be trusted, and how far."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.fit import Fit, moved, normal_equations
from evlcp_sdk.place.observations import Problem, observe
from evlcp_sdk.place.refusals import Refusal

__all__ = ["Pose", "judged"]

Floats = NDArray[np.float64]

_MOST_BEND = 3.0
"""Ratio of the cost two sigmas away to its parabola's, beyond which an ellipse does not describe it."""

_OUTLIER_SHARE = 0.3
"""Share of points that may lie beyond the Huber bound before nothing is believed."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A camera's position and attitude.

    Attributes:
        enu_m: Position in the local axes, m, float64 (3,).
        rotation: Camera axes (right, down, forward) as columns in ENU, float64 (3, 3).
        covariance: Of position, m, and of a small turn about east, north and up, radians, float64 (6, 6);
            0 where an angle was taken as exact.
        noise: The part of `covariance` that changes from frame to frame: from the image, not from what was
            said about the attitude.
        misfit: Mean square of the misses in sigmas, over the degrees of freedom.
        transmitters: The bars that count.
    """

    enu_m: Floats
    rotation: Floats
    covariance: Floats
    noise: Floats
    misfit: float
    transmitters: tuple[int, ...]


def judged(problem: Problem, fit: Fit) -> Pose | Refusal:
    """The pose with its covariance, or why it cannot be trusted."""
    spec = problem.spec
    found = normal_equations(problem, fit)
    seen = observe(problem, fit.position, fit.rotation, fit.shared)
    assert found is not None
    assert seen is not None
    normal = found[0]
    known = seen.known_miss
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * scale * scale[:, None]
    if np.linalg.cond(scaled) > 1e14:
        return Refusal("not-determined", "the equations are singular")
    full = np.linalg.inv(scaled) * scale * scale[:, None]
    size = np.linalg.norm(seen.miss, axis=1)
    outliers = int((size > spec.huber_sigmas).sum())
    if outliers > _OUTLIER_SHARE * len(size):
        return Refusal("misfit", f"{outliers} of {len(size)} points do not lie where the sites have them")
    freedom = max(2 * len(size) + len(known) - len(normal), 1)
    misfit = float((np.minimum(size, spec.huber_sigmas) ** 2).sum() + (known**2).sum()) / freedom
    if misfit > spec.max_misfit:
        return Refusal("misfit", f"the points miss the sites by {math.sqrt(misfit):.1f} sigmas (rms)")
    if len(problem.transmitters) == 1:
        first, last = problem.enu_m[0] - fit.position, problem.enu_m[-1] - fit.position
        axis, sight = last - first, first + last
        sine = np.linalg.norm(np.cross(axis, sight)) / np.linalg.norm(axis) / np.linalg.norm(sight)
        if sine < math.sin(math.radians(spec.min_view_deg)):
            return Refusal(
                "end-on", f"the bar is seen {math.degrees(math.asin(sine)):.0f} degrees from its axis"
            )
    spread = float(np.sqrt(np.linalg.eigvalsh(full[:3, :3])[-1]))
    if spread > spec.max_sigma_m:
        return Refusal("uncertain", f"by {spread:.1f} m, more than {spec.max_sigma_m:g} m")
    bend = _bend(problem, fit, full)
    if bend > _MOST_BEND:
        return Refusal("uncertain", f"by {spread:.2f} m along a curve: an ellipse would mislead")
    turns = len(problem.turns)
    said = seen.known_slope[seen.attitude]
    systematic = full @ (said.T @ said) @ full
    where = [0, 1, 2, *(3 + t for t in problem.turns)]
    covariance, noise = np.zeros((6, 6)), np.zeros((6, 6))
    covariance[np.ix_(where, where)] = full[: 3 + turns, : 3 + turns]
    noise[np.ix_(where, where)] = (full - systematic)[: 3 + turns, : 3 + turns]
    return Pose(fit.position, fit.rotation, covariance, noise, misfit, problem.transmitters)


def _bend(problem: Problem, fit: Fit, covariance: Floats) -> float:
    """How far the cost is from its parabola two sigmas away along the position's least certain axis.

    The larger of the ratios, or of their inverses, of the true and the expected growth to both sides. Of a
    lone bar, angles and shared shift follow the position: the arc that an uncertain heading leaves is bent by
    less than these allow. Of several bars they stay, as they would hide the circle through the bars.
    """
    values, axes = np.linalg.eigh(covariance[:3, :3])
    move = np.asarray(2 * covariance[:, :3] @ axes[:, -1] / math.sqrt(values[-1]), np.float64)
    worst = 1.0
    for side in (-1.0, 1.0):
        there = moved(problem, fit, np.asarray(side * move, np.float64))
        found = normal_equations(problem, there)
        if found is not None and len(problem.transmitters) == 1:
            follow = np.linalg.solve(found[0][3:, 3:], found[1][3:])
            found = normal_equations(problem, moved(problem, there, np.concatenate([np.zeros(3), follow])))
        growth = 1e-9 if found is None else max((found[2] - fit.cost) / 4, 1e-9)
        worst = max(worst, growth, 1 / growth)
    return worst
