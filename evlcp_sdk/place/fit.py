"""The weighted least-squares fit of a pose, and of every error that is shared, to all observations.

The unknowns, in this order, are 14 that all points share: the position, m; a small turn of the camera about
east, north and up, radians; a focal length that is other than said, in units of `FOCAL_UNIT`, which is free
in no fit but whose column says what such a fault would do; and the camera's seven errors in their own sigmas.
Then each bar has nine: a shift of its image to the right and down, errors of its length, of its place to the
east, north and up, and of its attitude about these; all in their own sigmas.
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
from evlcp_sdk.place.observations import Problem, Rejection, camera_off, skewed

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
    bars = [bar == number for number in np.unique(bar)]
    centres, sights = (np.array([part[mine].mean(0) for mine in bars]) for part in (points, seen))
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
    points, own = problem.points, at.local[problem.bar]
    survey, root, even = (one[problem.bar] for one in problem.errors)
    place, turn, stretched = survey[:, :1], survey[:, 1:2], survey[:, 2:3] * points[:, 3:6]
    arm = skewed(points[:, 3:6])
    offset = points[:, :3] - at.position + place * own[:, 3:6] + own[:, 2:3] * stretched
    offset += _by(turn * own[:, 6:9], arm)
    seen = offset @ at.rotation
    if not (seen[:, 2] > 0).all():
        return None
    camera = problem.camera
    if at.lens.any():
        camera = camera_off(camera, problem.lens_root @ at.lens)
    direction = seen[:, :2] / seen[:, 2:]
    expected = camera.distort(direction)
    miss = _by((points[:, 6:8] - expected - _by(own[:, :2], root)) * points[:, 8:9], even)
    size = np.hypot(miss[:, 0], miss[:, 1])
    weight = huber / np.maximum(size, huber)
    cost = float((np.where(size > huber, huber * (2 * size - huber), size**2)).sum())
    white = even * (np.sqrt(weight) * points[:, 8])[:, None, None]
    by_sight = white @ camera.distortion_jacobian(direction) / seen[:, 2][:, None, None]
    by_point = np.concatenate([by_sight, -by_sight @ direction[:, :, None]], -1) @ at.rotation.T
    rows = np.zeros((len(points), 2, LOCAL + SHARED + 1))
    own_errors, shared = rows[:, :, :LOCAL], rows[:, :, LOCAL:-1]
    own_errors[:, :, :2] = white @ root
    own_errors[:, :, 2:3] = by_point @ stretched[:, :, None]
    if problem.surveyed:
        own_errors[:, :, 3:6] = by_point * place[:, :, None]
        own_errors[:, :, 6:] = by_point @ arm * -turn[:, :, None]
    shared[:, :, :3] = -by_point
    shared[:, :, 3:6] = by_point @ skewed(offset)
    by_focal = (expected - camera.centre_px) * (FOCAL_UNIT * problem.camera.focal_px / camera.focal_px)
    shared[:, :, FAULT] = _by(by_focal, white)
    if problem.free[LENS:].any():
        shared[:, :, LENS:] = white @ (camera.parameter_jacobian(direction, expected) @ problem.lens_root)
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

_SAME = 1e-3
"""Fits that are nearer to each other than this share of the distance, and fit alike, are one."""

_MISSING = 20.0
"""Square sum a point beyond which what misses is refused, wherever exactly it ends."""

_ROUNDING = 1e-14
"""Share of a diagonal that rounding may leave of nothing."""


def likely_fits(problem: Problem) -> list[Equations] | Rejection:
    """Where fits from all starts settle, each place once, the likeliest first; or why there is none."""
    starts = closed_form_starts(problem)
    if not starts:
        return Rejection("not-determined", "no place from which the bars would be seen so")
    usual = usual_cost(problem)
    fits: list[Equations] = []
    for position, rotation in starts:
        steps = _STEPS if all(fit.cost > usual for fit in fits) else _OTHER_STEPS
        fit, settled = fit_pose(problem, Fit.at(problem, position, rotation), steps)
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


def fit_pose(problem: Problem, start: Fit, steps: int = _STEPS) -> tuple[Equations | None, bool]:
    """Levenberg-Marquardt with Huber's weights.

    The damping follows how much of what the equations promise a step wins (Nielsen 1999).

    Returns:
        Where it ends, None where the start has a point behind the camera; and whether it settled there.
    """
    equations = linearize(problem, start)
    if equations is None:
        return None, False
    damping, growth = 1e-4, 4.0
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
    return equations, False


def _solve(matrix: Floats, side: Floats, damping: float) -> Floats | None:
    """The damped equations' solution; None where they are singular."""
    damped = matrix.copy()
    damped.flat[:: len(matrix) + 1] *= 1 + damping
    scale = 1 / np.sqrt(np.maximum(np.diag(damped), 1e-300))
    _, found, singular = dposv(damped * scale * scale[:, None], side * scale)
    return None if singular else found * scale
