"""The weighted least-squares fit of a pose, and of every error that is shared, to all observations.

The unknowns, in this order, are 14 that all points share: the position, m; a small turn of the camera about
east, north and up, radians; a focal length that is other than said, in units of `FOCAL_UNIT`, which is free
in no fit but whose column says what such a fault would do; and the camera's seven errors in their own sigmas.
Then each bar has nine: a shift of its image to the right and down, errors of its length, of its place to the
east, north and up, and of its attitude about these; all in their own sigmas.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from evlcp_sdk.place.error_model import chi_square
from evlcp_sdk.place.observations import Problem, Rejection, skewed
from evlcp_sdk.place.starts import closed_form_starts
from evlcp_sdk.scene.camera import CAMERA_PARAMETERS

Floats = NDArray[np.float64]

FAULT, LENS, SHARED, LOCAL = 6, 7, 14, 9

FOCAL_UNIT = 0.005
"""Share of the focal length in which a fault of it is counted."""


@dataclass(frozen=True, eq=False)
class Fit:
    """All unknowns at one point of the fit.

    Attributes:
        position: m, float64 (3,).
        rotation: Camera axes as columns in ENU, float64 (3, 3).
        local: Each bar's own errors in their sigmas: shift of the image, length, place, turn, float64 (bars,
            9).
        lens: The camera's errors, by the root of their covariance, float64 (7,).
    """

    position: Floats
    rotation: Floats
    local: Floats
    lens: Floats

    @classmethod
    def at(cls, problem: Problem, position: Floats, rotation: Floats) -> "Fit":
        """A place and axes, and no other error."""
        return cls(position, rotation, np.zeros((len(problem.transmitters), LOCAL)), np.zeros(7))


class BarEquations(NamedTuple):
    """What bars say of the shared unknowns, each with its own errors free.

    Attributes:
        info: The matrix of their equations, float64 (bars, 14, 14).
        right: Right-hand sides, float64 (bars, 14).
        gain: By how much each bar's own errors follow, float64 (bars, 9, 14).
        own: By how much they move by themselves, float64 (bars, 9).
    """

    info: Floats
    right: Floats
    gain: Floats
    own: Floats


@dataclass(frozen=True, eq=False)
class Equations:
    """The problem at a point, linear; the camera's and the bars' errors are expected to be 0 to a sigma.

    Attributes:
        problem: What is seen and known.
        at: The point.
        rows: Of each point what its bar's own errors do, then the shared unknowns, and last seen less
            expected; whitened, float64 (n, 2, 9 + 14 + 1).
        stands: The share of each row's variance that stands for a while, float64 (2 n,).
        angles: What the shared unknowns do to the attitude as it is known, whitened, float64 (k, 14).
        angles_miss: Said less expected angles, whitened, float64 (k,).
        cost: Twice the robust cost.
    """

    problem: Problem
    at: Fit
    rows: Floats
    stands: Floats
    angles: Floats
    angles_miss: Floats
    cost: float

    @cached_property
    def bars(self) -> BarEquations:
        """What each bar says."""
        flat = [self.rows[mine].reshape(-1, self.rows.shape[2]) for mine in self.problem.parts]
        whole = np.array([part.T @ part for part in flat])
        whole[:, :LOCAL, -1] -= self.at.local
        between = whole[:, :LOCAL, LOCAL:]
        follow = np.asarray(np.linalg.solve(whole[:, :LOCAL, :LOCAL] + np.eye(LOCAL), between), np.float64)
        left = whole[:, LOCAL:-1, LOCAL:] - between[:, :, :-1].transpose(0, 2, 1) @ follow
        return BarEquations(left[:, :, :-1], left[:, :, -1], follow[:, :, :-1], follow[:, :, -1])

    @cached_property
    def normal(self) -> tuple[Floats, Floats]:
        """Normal equations of the shared unknowns that are free: the matrix, and the right-hand side."""
        free, matrix = self.problem.free, self.bars.info.sum(0) + self.angles.T @ self.angles
        matrix.flat[LENS * (SHARED + 1) :: SHARED + 1] += 1.0
        side = self.bars.right.sum(0) + self.angles.T @ self.angles_miss
        side[LENS:] -= self.at.lens
        return matrix[np.ix_(free, free)], side[free]

    @cached_property
    def spread(self) -> Floats | None:
        """Covariance of the shared unknowns, 0 of those that are not free, float64 (14, 14).

        None where the equations are singular.
        """
        inverse = inverted(self.normal[0])
        if inverse is None:
            return None
        spread = np.zeros((SHARED, SHARED))
        spread[np.ix_(self.problem.free, self.problem.free)] = inverse
        return spread

    def moved(self, shared: Floats) -> Fit:
        """The point with the shared unknowns moved, float64 (14,), and with the bars' own, which follow.

        A turn takes the camera about the points' centre, to first order along the straight line: their image
        hardly changes on that arc, so that long steps hold.
        """
        at, centre = self.at, self.problem.centre
        angle, cross = math.sqrt(shared[3:6] @ shared[3:6]), skewed(shared[None, 3:6])[0]
        # Rodrigues.
        axis = cross / max(angle, 1e-300)
        turned = np.eye(3) + math.sin(angle) * axis + (1 - math.cos(angle)) * axis @ axis
        away = at.position - centre
        return Fit(
            centre + shared[:3] + turned @ away - cross @ away,
            turned @ at.rotation,
            at.local + self.bars.own - self.bars.gain @ shared,
            at.lens + shared[LENS:],
        )


def linearize(problem: Problem, at: Fit) -> Equations | None:
    """The problem at a point; None where a point is behind the camera."""
    huber = problem.spec.huber_sigmas
    points, known, own = problem.points, problem.known, at.local[problem.bar]
    offset = points[:, :3] - at.position + known.place * own[:, 3:6] + own[:, 2:3] * known.stretched
    offset += _by(known.turn * own[:, 6:9], known.arm)
    seen = offset @ at.rotation
    if not (seen[:, 2] > 0).all():
        return None
    camera = problem.camera
    if at.lens.any():
        focal, x, y, *bent = (problem.lens_root @ at.lens).tolist()
        names, centre = CAMERA_PARAMETERS[3:], camera.centre_px
        camera = replace(
            camera,
            focal_mm=(camera.focal_px + focal) * camera.pitch_um / 1e3,
            centre_x_px=centre[0] + x,
            centre_y_px=centre[1] + y,
            **{name: getattr(camera, name) + more for name, more in zip(names, bent, strict=True)},
        )
    direction = seen[:, :2] / seen[:, 2:]
    expected = camera.distort(direction)
    miss = _by((points[:, 6:8] - expected - _by(own[:, :2], known.root)) * points[:, 8:9], known.even)
    size = np.hypot(miss[:, 0], miss[:, 1])
    weight = huber / np.maximum(size, huber)
    cost = float((np.where(size > huber, huber * (2 * size - huber), size**2)).sum())
    white = known.even * (np.sqrt(weight) * points[:, 8])[:, None, None]
    by_sight = white @ camera.distort_slope(direction) / seen[:, 2][:, None, None]
    by_point = np.concatenate([by_sight, -by_sight @ direction[:, :, None]], -1) @ at.rotation.T
    rows = np.zeros((len(points), 2, LOCAL + SHARED + 1))
    own_errors, shared = rows[:, :, :LOCAL], rows[:, :, LOCAL:-1]
    own_errors[:, :, :2] = white @ known.root
    own_errors[:, :, 2:3] = by_point @ known.stretched[:, :, None]
    if problem.surveyed:
        own_errors[:, :, 3:6] = by_point * known.place[:, :, None]
        own_errors[:, :, 6:] = by_point @ known.arm * -known.turn[:, :, None]
    shared[:, :, :3] = -by_point
    shared[:, :, 3:6] = by_point @ skewed(offset)
    by_focal = (expected - camera.centre_px) * (FOCAL_UNIT * problem.camera.focal_px / camera.focal_px)
    shared[:, :, FAULT] = _by(by_focal, white)
    if problem.free[LENS:].any():
        shared[:, :, LENS:] = white @ (camera.parameter_slope(direction, expected) @ problem.lens_root)
    rows[:, :, -1] = miss * np.sqrt(weight)[:, None]
    angles, angles_miss = _attitude(problem, at.rotation)
    cost += float(at.lens @ at.lens + at.local.ravel() @ at.local.ravel() + angles_miss @ angles_miss)
    stands = np.repeat(points[:, 9] * weight, 2)
    return Equations(problem, at, rows, stands, angles, angles_miss, cost)


def inverted(matrix: Floats) -> Floats | None:
    """The inverse of a matrix that is positive definite beyond rounding; None of another."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * scale * scale[:, None]
    try:
        if np.square(np.diag(np.linalg.cholesky(scaled))).min(initial=1.0) < _ROUNDING:
            return None
    except np.linalg.LinAlgError:
        return None
    inverse: Floats = np.linalg.inv(scaled) * scale * scale[:, None]
    return inverse


def _by(vectors: Floats, matrices: Floats) -> Floats:
    """Vectors (n, k) times symmetric, or from the left, matrices (n, k, m)."""
    product: Floats = (vectors[:, None, :] @ matrices)[:, 0]
    return product


def _attitude(problem: Problem, rotation: Floats) -> tuple[Floats, Floats]:
    """What the turns do to pitch, roll and heading as they are known, whitened, and by how much they miss."""
    angles = problem.angles
    east, north, high = rotation[:, 2].tolist()
    level = max(east * east + north * north, 1e-12)
    fe, fn = east / math.sqrt(level), north / math.sqrt(level)
    # Up as the sensor felt it, turned as the camera is: level if the rotation is right.
    x, y, z = (rotation @ angles.level[2]).tolist()
    off = angles.heading_rad - math.atan2(east, north)
    raw = np.array([x * fe + y * fn, y * fe - x * fn, math.remainder(off, 2 * math.pi)])
    by_turn = np.array(
        [
            [z * fn, -z * fe, y * fe - x * fn],
            [z * fe, z * fn, -x * fe - y * fn],
            [east * high / level, north * high / level, -1.0],
        ]
    )
    white = angles.white[: angles.known, : angles.known]
    rows = np.zeros((angles.known, SHARED))
    rows[:, 3:6] = white @ by_turn[: angles.known]
    return rows, white @ raw[: angles.known]


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

_ROUNDING = 1e-14
"""Share of a diagonal that rounding may leave of nothing."""

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
        if fit is None or not settled:
            continue
        far = _SAME * np.linalg.norm(fit.at.position - problem.points[0, :3])
        if not any(
            abs(fit.cost - other.cost) < 1e-3 * (1 + other.cost)
            and np.linalg.norm(fit.at.position - other.at.position) < far
            for other in fits
        ):
            fits.append(fit)
    if not fits:
        return Rejection("not-determined", "the fit does not settle: the bars do not determine a position")
    return sorted(fits, key=lambda fit: fit.cost)


def misfits(fit: Equations) -> bool:
    """Whether the sum of the squared misses is more than chance makes it."""
    return fit.cost > usual_cost(fit.problem)


def usual_cost(problem: Problem) -> float:
    """What a cost is not above where all is as said."""
    return chi_square(problem.spec.false_alarm / 2, problem.freedom)


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
    equations = linearize(problem, start)
    if equations is None:
        return None, False
    damping, growth, stalled = 1e-4, 4.0, 0
    for _ in range(steps):
        cost, (matrix, side) = equations.cost, equations.normal
        step = _solve(matrix, side, damping)
        if step is None:
            break
        shared = np.zeros(SHARED)
        shared[problem.free] = step
        found = linearize(problem, equations.moved(shared))
        if found is not None and found.cost > cost and problem.surveyed:
            # What a long turn leaves of second order, errors of the sites take up where they are large.
            found = linearize(problem, found.moved(np.zeros(SHARED)))
        promise = float(side @ step)
        hoped = promise + damping * float(step @ (np.diag(matrix) * step))
        stalled = 0 if found is not None and found.cost < 0.7 * cost else stalled + 1
        if found is not None and found.cost <= cost:
            won = cost - found.cost
            equations = found
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
            last = _solve(*equations.normal, 1e-9)
            if equations.cost - (0.0 if last is None else float(equations.normal[1] @ last)) > hopeless:
                return equations, True
    return equations, False


def _solve(matrix: Floats, side: Floats, damping: float) -> Floats | None:
    """The damped equations' solution; None where they are singular."""
    damped = matrix.copy()
    damped.flat[:: len(matrix) + 1] *= 1 + damping
    scale = 1 / np.sqrt(np.maximum(np.diag(damped), 1e-300))
    _, found, singular = dposv(damped * scale * scale[:, None], side * scale)
    return None if singular else found * scale
