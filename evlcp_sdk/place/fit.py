"""Weighted least-squares fit of a pose, and of every shared error, to all observations.

The unknowns, in this order, are 14 that all points share: the position, m; a small rotation of the camera
about east, north and up, radians; an error of the focal length in units of `FOCAL_UNIT`, which is free in no
fit but whose column shows the effect of such a fault; and the camera's seven errors in their own sigmas. Then
nine local ones for each bar: a shift of its image to the right and down, errors of its length, of its place
to the east, north and up, and of its attitude about these; all in their own sigmas.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from evlcp_sdk.place.error_model import chi_square
from evlcp_sdk.place.observations import Problem, Rejection, cross_matrices, perturb_camera

Floats = NDArray[np.float64]

_HEADINGS = 72
"""Headings tried first where none is known: 5 degrees apart, a fraction of the basin of the fit."""

_FINE_HEADINGS = 25
"""Headings tried around each minimum of these: 0.4 degrees apart."""

_MAX_STARTS = 4
"""Starts of one problem, at most."""

_FALSE_RATIO, _FALSE_PX = 10.0, 0.5
"""By Grunert's true solutions three bars are seen where they stand. By false ones their ends are off by ten
times as much as by the likeliest one, and by ten times this many pixels."""


def find_starts(problem: Problem) -> list[tuple[Floats, Floats]]:
    """Find closed-form poses: position, m, float64 (3,), and camera axes as columns in ENU, float64 (3, 3).

    The likeliest comes first. With the heading known, it is the point nearest to all lines of sight; with
    gravity known, the best of these over the headings; else Grunert's solutions for the three bars that span
    the largest triangle.
    """
    flat = problem.camera.undistort(problem.points[:, 6:8])
    seen = np.column_stack([flat, np.ones(len(flat))])
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    good = np.isfinite(seen).all(1)
    if good.sum() < 3:
        return []
    points, seen, bar = problem.points[good, :3], seen[good], problem.bar[good]
    if problem.attitude is None:
        poses = solve_three_points(*_select_widest_three(points, seen, bar))
        costs = [_sum_squared_angles(points, seen, *pose) for pose in poses]
        likeliest = min(costs, default=math.inf) + len(flat) * (_FALSE_PX / problem.camera.focal_px) ** 2
        order = sorted(range(len(poses)), key=costs.__getitem__)
        return [poses[i] for i in order if costs[i] <= _FALSE_RATIO**2 * likeliest]
    enu, mean = _average_halves(points, seen, bar)
    if problem.angles.known == 3:
        places, costs_of = intersect_sight_lines(enu, mean, problem.angles.rotation[None])
        return [(places[0], problem.angles.rotation)] if costs_of[0] < math.inf else []
    return _find_level_starts(enu, mean, problem.angles.rotation)


def _average_halves(points: Floats, seen: Floats, bar: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Mean places and directions of the halves of each bar, float64 (n, 3) each."""
    pairs = []
    for number in np.unique(bar):
        rows = np.flatnonzero(bar == number)
        for half in (rows[: len(rows) // 2], rows[len(rows) // 2 :]):
            if len(half):
                mean = seen[half].sum(0)
                pairs.append((points[half].mean(0), mean / np.linalg.norm(mean)))
    enu, directions = zip(*pairs, strict=True)
    return np.array(enu), np.array(directions)


def intersect_sight_lines(enu: Floats, directions: Floats, rotations: Floats) -> tuple[Floats, Floats]:
    """The point nearest to all lines through `enu` (n, 3) along `directions` (n, 3), for each of `rotations`.

    Returns:
        Points, m, float64 (r, 3), and the sum of 1 - cosine of the angles by which the lines miss them, large
        where a line points away, infinite where it is not determined, float64 (r,).
    """
    lines = directions @ rotations.swapaxes(1, 2)
    matrix = len(enu) * np.eye(3) - lines.swapaxes(1, 2) @ lines
    side = enu.sum(0) - (lines * (lines * enu).sum(-1, keepdims=True)).sum(1)
    # For n unit lines the determinant is at most (2 n / 3)^3; where they are parallel, it vanishes.
    is_determined = np.linalg.det(matrix) > 1e-12 * len(enu) ** 3
    matrix[~is_determined] = np.eye(3)
    places = np.linalg.solve(matrix, side[..., None])[..., 0]
    offset = enu - places[:, None]
    distance = np.maximum(np.linalg.norm(offset, axis=-1), 1e-9)
    costs = (1 - (offset * lines).sum(-1) / distance).sum(1)
    return places, np.where(is_determined, costs, math.inf)


def _find_level_starts(enu: Floats, directions: Floats, level: Floats) -> list[tuple[Floats, Floats]]:
    """Find poses by gravity alone, the likeliest first: the lowest of each minimum over headings."""
    step = 2 * math.pi / _HEADINGS
    headings = step * np.arange(_HEADINGS)
    _, costs = intersect_sight_lines(enu, directions, _rotate_about_up(level, headings))
    is_minimum = (costs <= np.roll(costs, 1)) & (costs <= np.roll(costs, -1)) & (costs < math.inf)
    starts = []
    for minimum in sorted(np.flatnonzero(is_minimum).tolist(), key=costs.__getitem__)[:_MAX_STARTS]:
        fine = headings[minimum] + step * np.linspace(-1.0, 1.0, _FINE_HEADINGS)
        rotations = _rotate_about_up(level, fine)
        places, fine_costs = intersect_sight_lines(enu, directions, rotations)
        best = int(fine_costs.argmin())
        starts.append((places[best], rotations[best]))
    return starts


def _rotate_about_up(level: Floats, headings: NDArray[np.floating]) -> Floats:
    c, s, zero = np.cos(headings), np.sin(headings), np.zeros(len(headings))
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, zero + 1]]
    return np.moveaxis(np.array(rows), -1, 0) @ level


def _select_widest_three(points: Floats, seen: Floats, bar: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Select the three bars that span the largest triangle: centres and directions, float64 (3, 3) each."""
    bars = [bar == number for number in np.unique(bar)]
    centres, directions = (np.array([part[rows].mean(0) for rows in bars]) for part in (points, seen))
    if len(centres) < 3:
        return np.zeros((3, 3)), np.zeros((3, 3))

    triples = list(combinations(range(len(centres)), 3))
    sides = [(centres[j] - centres[i], centres[k] - centres[i]) for i, j, k in triples]
    areas = [float(np.linalg.norm(np.cross(one, other))) for one, other in sides]
    chosen = list(triples[int(np.argmax(areas))])
    directions = directions[chosen]
    return centres[chosen], directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _sum_squared_angles(points: Floats, seen: Floats, position: Floats, rotation: Floats) -> float:
    away = points - position
    cosine = (away @ rotation * seen).sum(1) / np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    return float(np.maximum(2 - 2 * cosine, 0.0).sum())


def solve_three_points(enu_m: Floats, directions: Floats) -> list[tuple[Floats, Floats]]:
    """Positions and rotations from which three points are seen in three directions (Grunert 1841).

    In the notation of Haralick et al., IJCV 13 (1994), 331. Complex roots, as noise makes of double ones,
    count with their real part.

    Args:
        enu_m: The points, m, float64 (3, 3).
        directions: Unit vectors towards them in the camera's axes, float64 (3, 3).

    Returns:
        Up to four pairs of position, m, float64 (3,), and camera axes as columns in ENU, float64 (3, 3).
    """
    one, two, other = enu_m
    a2, b2, c2 = (float(side @ side) for side in (two - other, one - other, one - two))
    ca, cb, cg = (float(directions[i] @ directions[j]) for i, j in ((1, 2), (0, 2), (0, 1)))
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
    poses = []
    for root in np.roots(quartic).tolist():
        v = root.real
        bottom = 2 * (cg - v * ca)
        # A conjugate pair counts once.
        if root.imag < -1e-9 * abs(root) or v <= 0 or abs(bottom) < 1e-15:
            continue
        u = ((-1 + q) * v**2 - 2 * q * cb * v + 1 + q) / bottom
        square = 1 + v * v - 2 * v * cb
        if u > 0 and square > 0:
            in_camera = math.sqrt(b2 / square) * np.array([[1.0], [u], [v]]) * directions
            rotation = _triangle_axes(enu_m).T @ _triangle_axes(in_camera)
            poses.append((enu_m.mean(0) - rotation @ in_camera.mean(0), rotation))
    return poses


def _triangle_axes(points: Floats) -> Floats:
    """Axes of a triangle (3, 3), as rows: along its first side, across that in its plane, and its normal."""
    along, normal = points[1] - points[0], np.cross(points[1] - points[0], points[2] - points[0])
    along, normal = (axis / max(float(np.linalg.norm(axis)), 1e-300) for axis in (along, normal))
    return np.array([along, np.cross(normal, along), normal])


FAULT, LENS, SHARED, LOCAL = 6, 7, 14, 9

FOCAL_UNIT = 0.005
"""Unit of a focal-length fault, as a share of the focal length."""


@dataclass(frozen=True, eq=False)
class FitState:
    """All unknowns at one step of the fit.

    Attributes:
        position: m, float64 (3,).
        rotation: Camera axes as columns in ENU, float64 (3, 3).
        local: Each bar's local errors in their sigmas: shift of the image, length, place, rotation, float64
            (bars, 9).
        lens: The camera's errors, by the root of their covariance, float64 (7,).
    """

    position: Floats
    rotation: Floats
    local: Floats
    lens: Floats

    @classmethod
    def from_pose(cls, problem: Problem, position: Floats, rotation: Floats) -> "FitState":
        """A pose with all errors 0."""
        return cls(position, rotation, np.zeros((len(problem.transmitters), LOCAL)), np.zeros(7))


class BarEquations(NamedTuple):
    """Equations of the shared unknowns by each bar, its local errors eliminated.

    Attributes:
        information: Their matrix, float64 (bars, 14, 14).
        right_side: float64 (bars, 14).
        gain: How the local errors follow the shared unknowns, float64 (bars, 9, 14).
        local_step: The local errors' own step, float64 (bars, 9).
    """

    information: Floats
    right_side: Floats
    gain: Floats
    local_step: Floats


@dataclass(frozen=True, eq=False)
class Equations:
    """The problem linearized at a state; the camera's and the bars' errors are expected to be 0 to a sigma.

    Attributes:
        state: Where it is linearized.
        rows: Of each point the slopes by its bar's local errors, then by the shared unknowns, and last the
            residual; whitened, float64 (n, 2, 9 + 14 + 1).
        standing_share: Share of each row's variance that persists for a while, float64 (2 n,).
        angles: Slopes of the known angles by the shared unknowns, whitened, float64 (k, 14).
        angle_residuals: Stated less expected angles, whitened, float64 (k,).
        cost: Twice the robust cost.
    """

    problem: Problem
    state: FitState
    rows: Floats
    standing_share: Floats
    angles: Floats
    angle_residuals: Floats
    cost: float

    @cached_property
    def bars(self) -> BarEquations:
        """Equations by each bar."""
        rows = [self.rows[bar].reshape(-1, self.rows.shape[2]) for bar in self.problem.bar_slices]
        products = np.array([part.T @ part for part in rows])
        products[:, :LOCAL, -1] -= self.state.local
        local, mixed = products[:, :LOCAL, :LOCAL] + np.eye(LOCAL), products[:, :LOCAL, LOCAL:]
        gain = np.asarray(np.linalg.solve(local, mixed), np.float64)
        reduced = products[:, LOCAL:-1, LOCAL:] - mixed[:, :, :-1].transpose(0, 2, 1) @ gain
        return BarEquations(reduced[:, :, :-1], reduced[:, :, -1], gain[:, :, :-1], gain[:, :, -1])

    @cached_property
    def normal_equations(self) -> tuple[Floats, Floats]:
        """Matrix and right-hand side for the free shared unknowns."""
        free, matrix = self.problem.free, self.bars.information.sum(0) + self.angles.T @ self.angles
        matrix.flat[LENS * (SHARED + 1) :: SHARED + 1] += 1.0
        side = self.bars.right_side.sum(0) + self.angles.T @ self.angle_residuals
        side[LENS:] -= self.state.lens
        return matrix[np.ix_(free, free)], side[free]

    @cached_property
    def covariance(self) -> Floats | None:
        """Of the shared unknowns, 0 for those not free, float64 (14, 14); None for singular equations."""
        inverse = invert_definite(self.normal_equations[0])
        if inverse is None:
            return None
        covariance = np.zeros((SHARED, SHARED))
        covariance[np.ix_(self.problem.free, self.problem.free)] = inverse
        return covariance

    def apply_step(self, step: Floats) -> FitState:
        """The state after a step of the shared unknowns, float64 (14,), which the local ones follow.

        A rotation takes the camera about the points' centre, to first order along the straight line: their
        image hardly changes on that arc, so that long steps hold.
        """
        state, centre = self.state, self.problem.centre
        angle, cross = math.sqrt(step[3:6] @ step[3:6]), cross_matrices(step[None, 3:6])[0]
        # Rodrigues.
        axis = cross / max(angle, 1e-300)
        rotation = np.eye(3) + math.sin(angle) * axis + (1 - math.cos(angle)) * axis @ axis
        offset = state.position - centre
        return FitState(
            centre + step[:3] + rotation @ offset - cross @ offset,
            rotation @ state.rotation,
            state.local + self.bars.local_step - self.bars.gain @ step,
            state.lens + step[LENS:],
        )


def linearize(problem: Problem, state: FitState) -> Equations | None:
    """Linearize the problem at a state; None where a point is behind the camera."""
    huber = problem.spec.huber_sigmas
    points, local = problem.points, state.local[problem.bar]
    sigmas, root, whitening = (errors[problem.bar] for errors in problem.errors)
    place_sigma, turn_sigma, by_length = sigmas[:, :1], sigmas[:, 1:2], sigmas[:, 2:3] * points[:, 3:6]
    arm_cross = cross_matrices(points[:, 3:6])
    offset = points[:, :3] - state.position + place_sigma * local[:, 3:6] + local[:, 2:3] * by_length
    offset += _multiply_each(turn_sigma * local[:, 6:9], arm_cross)
    in_camera = offset @ state.rotation
    if not (in_camera[:, 2] > 0).all():
        return None
    camera = problem.camera
    if state.lens.any():
        camera = perturb_camera(camera, problem.lens_root @ state.lens)
    direction = in_camera[:, :2] / in_camera[:, 2:]
    expected = camera.distort(direction)
    residuals = (points[:, 6:8] - expected - _multiply_each(local[:, :2], root)) * points[:, 8:9]
    residuals = _multiply_each(residuals, whitening)
    sizes = np.hypot(residuals[:, 0], residuals[:, 1])
    weight = huber / np.maximum(sizes, huber)
    cost = float((np.where(sizes > huber, huber * (2 * sizes - huber), sizes**2)).sum())
    weighting = whitening * (np.sqrt(weight) * points[:, 8])[:, None, None]
    by_direction = weighting @ camera.distortion_jacobian(direction) / in_camera[:, 2][:, None, None]
    by_point = np.concatenate([by_direction, -by_direction @ direction[:, :, None]], -1) @ state.rotation.T
    rows = np.zeros((len(points), 2, LOCAL + SHARED + 1))
    by_local, by_shared = rows[:, :, :LOCAL], rows[:, :, LOCAL:-1]
    by_local[:, :, :2] = weighting @ root
    by_local[:, :, 2:3] = by_point @ by_length[:, :, None]
    if problem.has_survey_errors:
        by_local[:, :, 3:6] = by_point * place_sigma[:, :, None]
        by_local[:, :, 6:] = by_point @ arm_cross * -turn_sigma[:, :, None]
    by_shared[:, :, :3] = -by_point
    by_shared[:, :, 3:6] = by_point @ cross_matrices(offset)
    by_focal = (expected - camera.centre_px) * (FOCAL_UNIT * problem.camera.focal_px / camera.focal_px)
    by_shared[:, :, FAULT] = _multiply_each(by_focal, weighting)
    if problem.free[LENS:].any():
        by_parameter = camera.parameter_jacobian(direction, expected)
        by_shared[:, :, LENS:] = weighting @ (by_parameter @ problem.lens_root)
    rows[:, :, -1] = residuals * np.sqrt(weight)[:, None]
    angles, angle_residuals = _linearize_attitude(problem, state.rotation)
    cost += float(
        state.lens @ state.lens
        + state.local.ravel() @ state.local.ravel()
        + angle_residuals @ angle_residuals
    )
    standing_share = np.repeat(points[:, 9] * weight, 2)
    return Equations(problem, state, rows, standing_share, angles, angle_residuals, cost)


def invert_definite(matrix: Floats) -> Floats | None:
    """The inverse of a matrix that is positive definite beyond rounding; None for any other."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * scale * scale[:, None]
    try:
        if np.square(np.diag(np.linalg.cholesky(scaled))).min(initial=1.0) < _ROUNDING_SHARE:
            return None
    except np.linalg.LinAlgError:
        return None
    return np.asarray(np.linalg.inv(scaled) * scale * scale[:, None])


def _multiply_each(vectors: Floats, matrices: Floats) -> Floats:
    """Products of vectors (n, k) and matrices (n, k, m), from the left."""
    return np.asarray((vectors[:, None, :] @ matrices)[:, 0])


def _linearize_attitude(problem: Problem, rotation: Floats) -> tuple[Floats, Floats]:
    """Slopes of the known angles by the shared unknowns, whitened, and their residuals."""
    angles = problem.angles
    east, north, up = rotation[:, 2].tolist()
    level = max(east * east + north * north, 1e-12)
    fe, fn = east / math.sqrt(level), north / math.sqrt(level)
    # Measured up, rotated like the camera: vertical if the rotation is right.
    x, y, z = (rotation @ angles.rotation[2]).tolist()
    heading_residual = angles.heading_rad - math.atan2(east, north)
    residuals = np.array([x * fe + y * fn, y * fe - x * fn, math.remainder(heading_residual, 2 * math.pi)])
    by_turn = np.array(
        [
            [z * fn, -z * fe, y * fe - x * fn],
            [z * fe, z * fn, -x * fe - y * fn],
            [east * up / level, north * up / level, -1.0],
        ]
    )
    whitening = angles.whitening[: angles.known, : angles.known]
    rows = np.zeros((angles.known, SHARED))
    rows[:, 3:6] = whitening @ by_turn[: angles.known]
    return rows, whitening @ residuals[: angles.known]


DISTINCT_COST = 18.4
"""Costs that differ by less do not distinguish solutions: beyond, one is 10 000 times likelier."""

_STEPS = 50
"""Levenberg-Marquardt steps at most; from a closed-form start, five to ten are enough."""

_OTHER_STEPS = 15
"""Steps of a fit from another start, once there is one."""

_SAME_SHARE = 1e-3
"""Fits nearer to each other than this share of the distance, and of equal cost, are one."""

_HOPELESS_COST = 20.0
"""Cost a point beyond which a misfit is refused, wherever exactly the fit ends."""

_ROUNDING_SHARE = 1e-14
"""Share of a diagonal that rounding may leave of zero."""


def fit_from_all_starts(problem: Problem) -> list[Equations] | Rejection:
    """Fit from all starts and keep each place once, the likeliest first; or why there is none."""
    starts = find_starts(problem)
    if not starts:
        return Rejection("not-determined", "no place from which the bars would be seen so")
    limit = cost_limit(problem)
    fits: list[Equations] = []
    for position, rotation in starts:
        steps = _STEPS if all(fit.cost > limit for fit in fits) else _OTHER_STEPS
        fit, settled = fit_pose(problem, FitState.from_pose(problem, position, rotation), steps)
        if fit is None or not settled:
            continue
        same_m = _SAME_SHARE * np.linalg.norm(fit.state.position - problem.points[0, :3])
        if not any(
            abs(fit.cost - other.cost) < 1e-3 * (1 + other.cost)
            and np.linalg.norm(fit.state.position - other.state.position) < same_m
            for other in fits
        ):
            fits.append(fit)
    if not fits:
        return Rejection("not-determined", "the fit does not settle: the bars do not determine a position")
    return sorted(fits, key=lambda fit: fit.cost)


def is_misfit(fit: Equations) -> bool:
    """Whether the sum of squared residuals is larger than chance allows."""
    return fit.cost > cost_limit(fit.problem)


def cost_limit(problem: Problem) -> float:
    """The cost that a fit without a fault exceeds by half the probability of a false alarm."""
    return chi_square(problem.spec.false_alarm / 2, problem.freedom)


def fit_pose(problem: Problem, start: FitState, steps: int = _STEPS) -> tuple[Equations | None, bool]:
    """Levenberg-Marquardt with Huber's weights; the damping follows the gain ratio (Nielsen 1999).

    Returns:
        Where it ends, None where the start has a point behind the camera; and whether it settled there.
    """
    equations = linearize(problem, start)
    if equations is None:
        return None, False
    damping, growth = 1e-4, 4.0
    for _ in range(steps):
        cost, (matrix, side) = equations.cost, equations.normal_equations
        step = _solve_damped(matrix, side, damping)
        if step is None:
            break
        shared = np.zeros(SHARED)
        shared[problem.free] = step
        found = linearize(problem, equations.apply_step(shared))
        if found is not None and found.cost > cost and problem.has_survey_errors:
            # Large errors of the sites take up the second order of a long rotation.
            found = linearize(problem, found.apply_step(np.zeros(SHARED)))
        predicted = float(side @ step)
        predicted_gain = predicted + damping * float(step @ (np.diag(matrix) * step))
        if found is not None and found.cost <= cost:
            gain = cost - found.cost
            equations = found
            ratio = gain / predicted_gain if predicted_gain > 0 else 1.0
            damping = min(max(damping * max(0.1, 1 - (2 * ratio - 1) ** 3), 1e-12), 1e12)
            growth = 4.0
            tolerance = 1e-3 if found.cost > _HOPELESS_COST * len(problem.points) else 1e-6
            if gain <= tolerance * (1 + found.cost) and abs(predicted) < tolerance * (100 + found.cost):
                return equations, True
        else:
            damping *= growth
            growth *= 2
            if damping > 1e12 or abs(predicted) < 1e-9:
                # No step is an improvement any more but for rounding.
                return equations, predicted < 1e-3
    return equations, False


def _solve_damped(matrix: Floats, side: Floats, damping: float) -> Floats | None:
    damped = matrix.copy()
    damped.flat[:: len(matrix) + 1] *= 1 + damping
    scale = 1 / np.sqrt(np.maximum(np.diag(damped), 1e-300))
    _, solution, singular = dposv(damped * scale * scale[:, None], side * scale)
    return None if singular else solution * scale
