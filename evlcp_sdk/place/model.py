"""The image of bars as a camera sees them, and what every unknown does to it, in arrays.

The unknowns, in this order, are 14 that all points share: the position, m; a small turn of the camera about
east, north and up, radians; a focal length that is other than said, in units of `FOCAL_UNIT`, which is free
in no fit but whose column says what such a fault would do; and the camera's seven errors in their own sigmas.
Then each bar has nine: a shift of its image to the right and down, errors of its length, of its place to the
east, north and up, and of its attitude about these; all in their own sigmas.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.observations import Problem, skewed
from evlcp_sdk.scene.camera import CameraModel

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
        at: The point.
        parts: Where each bar's points are.
        rows: Of each point what its bar's own errors do, then the shared unknowns, and last seen less
            expected; whitened, float64 (n, 2, 9 + 14 + 1).
        stands: The share of each row's variance that stands for a while, float64 (2 n,).
        angles: What the shared unknowns do to the attitude as it is known, whitened, float64 (k, 14).
        angles_miss: Said less expected angles, whitened, float64 (k,).
        cost: Twice the robust cost.
    """

    at: Fit
    parts: Sequence[slice]
    rows: Floats
    stands: Floats
    angles: Floats
    angles_miss: Floats
    cost: float

    @cached_property
    def bars(self) -> BarEquations:
        """What each bar says."""
        flat = [self.rows[mine].reshape(-1, self.rows.shape[2]) for mine in self.parts]
        whole = np.array([part.T @ part for part in flat])
        whole[:, :LOCAL, -1] -= self.at.local
        between = whole[:, :LOCAL, LOCAL:]
        follow = np.asarray(np.linalg.solve(whole[:, :LOCAL, :LOCAL] + np.eye(LOCAL), between), np.float64)
        left = whole[:, LOCAL:-1, LOCAL:] - between[:, :, :-1].transpose(0, 2, 1) @ follow
        return BarEquations(left[:, :, :-1], left[:, :, -1], follow[:, :, :-1], follow[:, :, -1])

    def normal(self) -> tuple[Floats, Floats]:
        """Normal equations of the shared unknowns: the matrix, float64 (14, 14), and the right-hand side."""
        matrix = self.bars.info.sum(0) + self.angles.T @ self.angles
        matrix.flat[LENS * (SHARED + 1) :: SHARED + 1] += 1.0
        side = self.bars.right.sum(0) + self.angles.T @ self.angles_miss
        side[LENS:] -= self.at.lens
        return matrix, side

    def step(self, shared: Floats) -> Floats:
        """A move of the shared unknowns, float64 (14,), and of the bars' own, which follow."""
        return np.concatenate([shared, (self.bars.own - self.bars.gain @ shared).ravel()])


def linearize(problem: Problem, at: Fit, huber: float) -> Equations | None:
    """The problem at a point; None where a point is behind the camera.

    Args:
        problem: What is seen and known.
        at: The point.
        huber: Misses in sigmas beyond which a point weighs less.
    """
    points, known, own = problem.points, problem.known, at.local[problem.bar]
    offset = points[:, :3] - at.position + known.place * own[:, 3:6] + own[:, 2:3] * known.stretched
    offset += _by(known.turn * own[:, 6:9], known.arm)
    seen = offset @ at.rotation
    if not (seen[:, 2] > 0).all():
        return None
    camera = _erring(problem.camera, problem.lens_root @ at.lens) if at.lens.any() else problem.camera
    direction = seen[:, :2] / seen[:, 2:]
    expected = camera.distort(direction)
    miss = _by((points[:, 6:8] - expected - _by(own[:, :2], known.root)) * points[:, 8:9], known.even)
    size = np.hypot(miss[:, 0], miss[:, 1])
    weight = huber / np.maximum(size, huber)
    cost = float((np.where(size > huber, huber * (2 * size - huber), size**2)).sum())
    white = known.even * (np.sqrt(weight) * points[:, 8])[:, None, None]
    by_point = _by_point(white @ camera.distort_slope(direction), direction, seen[:, 2], at.rotation)
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
    return Equations(at, problem.parts, rows, stands, angles, angles_miss, cost)


def move(problem: Problem, at: Fit, step: Floats) -> Fit:
    """The point with its unknowns moved, float64 (14 + 9 bars,).

    A turn takes the camera about the points' centre, to first order along the straight line: their image
    hardly changes on that arc, so that long steps hold.
    """
    angle, cross = math.sqrt(step[3:6] @ step[3:6]), skewed(step[None, 3:6])[0]
    # Rodrigues.
    axis = cross / max(angle, 1e-300)
    turned = np.eye(3) + math.sin(angle) * axis + (1 - math.cos(angle)) * axis @ axis
    centre = problem.centre
    away = at.position - centre
    return Fit(
        centre + step[:3] + turned @ away - cross @ away,
        turned @ at.rotation,
        at.local + step[SHARED:].reshape(at.local.shape),
        at.lens + step[LENS:SHARED],
    )


def _by(vectors: Floats, matrices: Floats) -> Floats:
    """Vectors (n, k) times symmetric, or from the left, matrices (n, k, m)."""
    product: Floats = (vectors[:, None, :] @ matrices)[:, 0]
    return product


def _erring(camera: CameraModel, error: Floats) -> CameraModel:
    """A camera with errors of focal length, principal point, k1, k2, p1, p2."""
    focal, x, y, k1, k2, p1, p2 = error.tolist()
    return replace(
        camera,
        focal_mm=(camera.focal_px + focal) * camera.pitch_um / 1e3,
        centre_x_px=camera.centre_px[0] + x,
        centre_y_px=camera.centre_px[1] + y,
        k1=camera.k1 + k1,
        k2=camera.k2 + k2,
        p1=camera.p1 + p1,
        p2=camera.p2 + p2,
    )


def _by_point(slope: Floats, direction: Floats, ahead: Floats, rotation: Floats) -> Floats:
    """What a move of a point does to its image, by what its direction does, float64 (n, 2, 3), in ENU."""
    by = slope / ahead[:, None, None]
    return np.concatenate([by, -by @ direction[:, :, None]], -1) @ rotation.T


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
