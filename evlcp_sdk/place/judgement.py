"""Whether a fit can be trusted, and how far: covariance, tests of what may be wrong, protection levels.

As receivers of satellites do it (RAIM): for each part that may be at fault - a bar, the attitude, the focal
length - a test of whether the rest contradicts it, and how far the position may be off where it does not.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place import _kernels
from evlcp_sdk.place.chances import chi_square
from evlcp_sdk.place.fit import Fit, Normal, moved, normal_equations
from evlcp_sdk.place.observations import Problem
from evlcp_sdk.place.refusals import Refusal

__all__ = ["FOCAL", "Judged", "Pose", "judged"]

Floats = NDArray[np.float64]

FOCAL = "focal length"
"""What a fault of the camera is called."""

_MOST_BEND = 3.0
"""Ratio of the cost two sigmas away to its parabola's, beyond which an ellipse does not describe it."""

_ATTITUDE_FAULT_RAD = math.radians(1.0)
"""How far an angle may be off without anybody's knowledge (sigma): the fault that protection levels cover."""

_REDUNDANT = 1e-4
"""Share of what a part says that others must say, too, for it to be tested."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A camera's position and attitude.

    Attributes:
        enu_m: Position in the local axes, m, float64 (3,).
        rotation: Camera axes (right, down, forward) as columns in ENU, float64 (3, 3).
        covariance: Of position, m, and of a small turn about east, north and up, radians, float64 (6, 6);
            0 where an angle was taken as exact.
        noise: The part of the position's that is new with every frame, float64 (3, 3).
        slow: The part that changes as the image moves over the pixels, float64 (3, 3).
        standing: The rest by its causes, as the position's move by one sigma of each, m, float64 (3, k): of
            `camera`, its seven parameters; of `attitude`, biases of pitch, roll and heading, and the offset
            in time; of `bar N`, its length, and its place and turn where these have a sigma.
        misfit: Mean square of the misses in sigmas, over the degrees of freedom.
        freedom: Degrees of freedom.
        transmitters: The bars that count.
        hpl_m: Horizontal protection level, m; infinite where the geometry protects from no fault.
        vpl_m: The vertical one, m.
        excluded: What was left out as the rest contradicts it: `bar N`, `heading`, `attitude`, `focal
            length`.
    """

    enu_m: Floats
    rotation: Floats
    covariance: Floats
    noise: Floats
    slow: Floats
    standing: Mapping[str, Floats]
    misfit: float
    freedom: int
    transmitters: tuple[int, ...]
    hpl_m: float
    vpl_m: float
    excluded: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Judged:
    """A pose with what its tests say.

    Attributes:
        pose: The pose.
        doubt: Why it is not to be believed, in words; empty where all tests pass.
        tests: Of each part that could be tested: how much smaller the cost is without it.
    """

    pose: Pose
    doubt: str
    tests: Mapping[str, float]


def judged(problem: Problem, fit: Fit) -> Judged | Refusal:
    """The pose with its covariance and tests, or why it cannot be trusted."""
    spec = problem.spec
    normal = normal_equations(problem, fit)
    spread = _inverse(normal.whole)
    if spread is None:
        return Refusal("not-determined", "the equations are singular")
    spread[~problem.free] = 0
    spread[:, ~problem.free] = 0
    if len(problem.transmitters) == 1:
        first, last = problem.points[0, :3] - fit.position, problem.points[-1, :3] - fit.position
        axis, sight = last - first, first + last
        sine = math.sqrt(_square(np.cross(axis, sight)) / _square(axis) / _square(sight))
        if sine < math.sin(math.radians(spec.min_view_deg)):
            return Refusal(
                "end-on", f"the bar is seen {math.degrees(math.asin(sine)):.0f} degrees from its axis"
            )
    size, axes = np.linalg.eigh(spread[:3, :3])
    wide = math.sqrt(max(float(size[-1]), 0.0))
    if wide > spec.max_sigma_m:
        return Refusal("uncertain", f"by {wide:.1f} m, more than {spec.max_sigma_m:g} m")
    if _bend(problem, fit, normal, spread, wide, axes[:, -1]) > _MOST_BEND:
        return Refusal("uncertain", f"by {wide:.2f} m along a curve: an ellipse would mislead")
    # Every shared error has an observation of its own, that it is about 0; an angle that is exact is no
    # unknown.
    freedom = max(2 * len(problem.points) + problem.angles - 6, 1)
    chance = spec.false_alarm / 2
    doubt, tests, levels = "", {}, []
    worst = 1.0
    if fit.cost > chi_square(chance, freedom):
        doubt = f"the points miss the sites by {math.sqrt(fit.cost / freedom):.1f} sigmas (rms)"
    parts = list(_parts(problem, normal))
    for name, information, column, side, bound in parts:
        value, tested, added, unseen = _kernels.tested(information, column, side, spread, bound, _REDUNDANT)
        limit = chi_square(chance / len(parts), tested) if tested else 0.0
        if tested:
            tests[name] = value
        if tested and value / limit > worst:
            worst = value / limit
            doubt = f"{name} does not fit the rest: {math.sqrt(value):.1f} sigmas"
        if name != "heading":
            levels.append((limit, added, unseen))
    hpl, vpl = _protection(spread[:3, :3], levels, spec.risk)
    most = spec.max_protection_m
    covariance = np.ascontiguousarray(spread[:6, :6])
    noise, slow, standing = _causes(problem, normal, spread)
    return Judged(
        Pose(
            fit.position,
            fit.rotation,
            covariance,
            noise,
            slow,
            standing,
            fit.cost / freedom,
            freedom,
            problem.transmitters,
            hpl if hpl <= most else math.inf,
            vpl if vpl <= most else math.inf,
        ),
        doubt,
        tests,
    )


def _parts(problem: Problem, normal: Normal) -> Iterator[tuple[str, Floats, Floats, Floats, Floats]]:
    """What may be at fault: its name, and what `_kernels.tested` takes of it."""
    free = problem.free[:, None]
    for b, number in enumerate(problem.transmitters):
        info = normal.info[b]
        yield f"bar {number}", info[:6, :6], info[:, :6] * free, normal.right[b, :6], np.zeros((6, 6))
    focal = normal.info.sum(0)[:, _kernels.FAULT]
    own, side = focal[_kernels.FAULT].reshape(1, 1), normal.right.sum(0)[_kernels.FAULT].reshape(1)
    yield FOCAL, own, (focal * problem.free)[:, None], side, np.eye(1)
    angles = problem.angles
    if angles and problem.free[3:6].any():
        rows = normal.rows[:angles] * problem.free
        white = problem.white[:angles, :angles]
        bound: Floats = np.asarray(np.linalg.inv(_ATTITUDE_FAULT_RAD**2 * white @ white.T))
        yield "attitude", np.eye(angles), rows.T, normal.miss[:angles], bound
        if angles == 3:
            yield "heading", np.eye(1), rows[2:].T, normal.miss[2:3], bound[2:, 2:]


def _protection(
    spread: Floats, levels: list[tuple[float, Floats, Floats]], risk: float
) -> tuple[float, float]:
    """Horizontal and vertical protection levels, m.

    For each fault: how far the solution may have moved with the test just passed, and how far the solution
    that does without the part may be off at the risk. The same without any fault.
    """
    flat, high = math.sqrt(chi_square(risk, 2)), math.sqrt(chi_square(risk, 1))
    hpl, vpl = flat * _widest(spread), high * math.sqrt(max(spread[2, 2], 0.0))
    for limit, added, unseen in levels:
        without = spread + added
        hpl = max(hpl, math.sqrt(limit) * _widest(unseen) + flat * _widest(without))
        vpl = max(vpl, math.sqrt(limit * max(unseen[2, 2], 0.0)) + high * math.sqrt(max(without[2, 2], 0.0)))
    return hpl, vpl


def _widest(covariance: Floats) -> float:
    """Sigma of the horizontal direction that is the least certain."""
    a, b, c = float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
    return math.sqrt(max((a + c) / 2 + math.hypot((a - c) / 2, b), 0.0))


def _causes(problem: Problem, normal: Normal, spread: Floats) -> tuple[Floats, Floats, dict[str, Floats]]:
    """The position's covariance by causes: new with every frame, slow, and standing by name."""
    by = spread[:3]
    standing = {}
    if problem.free[7]:
        standing["camera"] = -by[:, 7:]
    if problem.attitude is not None and problem.free[3:6].any():
        angles = problem.angles
        said = problem.white[:angles, :angles] @ problem.attitude.standing()[:angles]
        standing["attitude"] = by @ normal.rows[:angles].T @ said
    for b, number in enumerate(problem.transmitters):
        if problem.bar_sigma[b, 1:].any():
            # Its length, by which it also looks too long; place and turn where these have a sigma.
            last = 9 if problem.bar_sigma[b, 1:3].any() else 3
            standing[f"bar {number}"] = by @ normal.gain[b, 2:last].T
    slow = by @ normal.pixel.sum(0) @ by.T
    noise = spread[:3, :3] - slow - sum((s @ s.T for s in standing.values()), np.zeros((3, 3)))
    # What Huber's weights leave of the points' share may be less than nothing.
    values, axes = np.linalg.eigh((noise + noise.T) / 2)
    return (axes * np.maximum(values, 1e-12)) @ axes.T, slow, standing


def _inverse(whole: Floats) -> Floats | None:
    scale = 1 / np.sqrt(np.maximum(np.diag(whole), 1e-300))
    values, axes = np.linalg.eigh(whole * scale * scale[:, None])
    if not values[0] > 1e-14 * values[-1]:
        return None
    half = axes * scale[:, None]
    return np.asarray((half / values) @ half.T)


def _bend(problem: Problem, fit: Fit, normal: Normal, spread: Floats, wide: float, axis: Floats) -> float:
    """How far an ellipse is from the truth two sigmas away along the position's least certain axis.

    There the camera stands on an arc about the bars, not on the axis. The larger of the ratios, or of their
    inverses, of the true and the expected growth of the cost to both sides, and of one and the square of how
    far the arc is from the axis, in sigmas.
    """
    move = spread[:, :3] @ axis * (2 / wide)
    inverse = np.linalg.pinv(spread[:3, :3])
    worst = 1.0
    for side in (-1.0, 1.0):
        there = moved(problem, fit, normal, side * move)
        found = normal_equations(problem, there)
        cost = found.cost
        if cost - fit.cost > 4 * _MOST_BEND:
            # Errors of sites take up what is left of second order.
            cost = normal_equations(problem, moved(problem, there, found, 0 * move)).cost
        growth = 1e-9 if np.isnan(cost) else max((cost - fit.cost) / 4, 1e-9)
        off = there.position - fit.position - side * move[:3]
        worst = max(worst, growth, 1 / growth, 1 + float(off @ inverse @ off))
    return worst


def _square(vector: Floats) -> float:
    return float(vector @ vector)
