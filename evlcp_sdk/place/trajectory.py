"""The camera's way from its fixes: a Kalman filter forward, live, and a smoother backward, offline."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.values import Fix

__all__ = ["TrajectoryPoint", "filter_fixes", "smooth_trajectory", "trajectory_step"]

Floats = NDArray[np.float64]

_SPEED_M_S = 30.0
"""Speeds that are likely at first (sigma): a car's."""

_MOST_MISSES = 10
"""Fixes in a row that are left out before the trajectory starts anew: so many are not outliers."""


@dataclass(frozen=True, eq=False)
class TrajectoryPoint:
    """Position and velocity at one time, filtered or smoothed; the filter's state, too.

    Attributes:
        t_us: Camera clock, us.
        mean: East, north, up, m, and their velocities, m/s, float64 (6,).
        noise: Covariance of `mean` from what is new with every fix, float64 (6, 6).
        standing_m2: Covariance of the position from what stays, as an attitude that was said wrong, (3, 3).
        misses: Fixes in a row that were left out, this one included; 0 where it counts.
        starts: A trajectory starts here.
    """

    t_us: float
    mean: Floats
    noise: Floats
    standing_m2: Floats
    misses: int = 0
    starts: bool = False

    @property
    def covariance_m2(self) -> Floats:
        """Of the position, float64 (3, 3): both parts."""
        return np.asarray(self.noise[:3, :3] + self.standing_m2)


def trajectory_step(state: TrajectoryPoint | None, fix: Fix, spec: PositionSpec) -> TrajectoryPoint:
    """Take a fix: constant velocity, driven by white acceleration (Bar-Shalom, chapter 6).

    Only what is new with every fix is filtered; what stays, as a heading that was said wrong, shifts the
    whole trajectory and is added to its covariance. A fix beyond `spec.gate_sigmas` is left out, and after
    many of those in a row the trajectory starts anew.

    Args:
        state: The last point, None at the start; not changed.
        fix: One that is given, not before the last.
        spec: Power of the acceleration, and the gate.
    """
    standing = fix.covariance_m2 - fix.noise_m2
    start = np.zeros((6, 6))
    start[:3, :3] = fix.noise_m2
    start[3:, 3:] = _SPEED_M_S**2 * np.eye(3)
    first = TrajectoryPoint(fix.t_us, np.concatenate([fix.enu_m, np.zeros(3)]), start, standing, starts=True)
    if state is None:
        return first
    mean, noise = _ahead(state, fix.t_us, spec)
    innovation = fix.enu_m - mean[:3]
    spread = noise[:3, :3] + fix.noise_m2
    if innovation @ np.linalg.solve(spread, innovation) > spec.gate_sigmas**2:
        if state.misses + 1 > _MOST_MISSES:
            return first
        return TrajectoryPoint(fix.t_us, mean, noise, standing, state.misses + 1)
    gain = np.linalg.solve(spread, noise[:3]).T
    keep = np.eye(6)
    keep[:, :3] -= gain
    # Joseph's form keeps the covariance symmetric and positive.
    after = keep @ noise @ keep.T + gain @ fix.noise_m2 @ gain.T
    return TrajectoryPoint(fix.t_us, mean + gain @ innovation, after, standing)


def filter_fixes(fixes: Iterable[Fix], spec: PositionSpec) -> list[TrajectoryPoint]:
    """Filter the fixes that are given, one point each; refused ones have none."""
    points: list[TrajectoryPoint] = []
    for fix in fixes:
        if not fix.refusal:
            points.append(trajectory_step(points[-1] if points else None, fix, spec))
    return points


def smooth_trajectory(points: Sequence[TrajectoryPoint], spec: PositionSpec) -> list[TrajectoryPoint]:
    """Smooth filtered points with those after them (Rauch, Tung, Striebel 1965), each trajectory alone."""
    smoothed = list(points)
    for i in range(len(points) - 2, -1, -1):
        if points[i + 1].starts:
            continue
        here, after = points[i], smoothed[i + 1]
        mean, noise = _ahead(here, after.t_us, spec)
        gain = np.linalg.solve(noise, _move(after.t_us - here.t_us) @ here.noise).T
        smoothed[i] = TrajectoryPoint(
            here.t_us,
            here.mean + gain @ (after.mean - mean),
            here.noise + gain @ (after.noise - noise) @ gain.T,
            here.standing_m2,
            here.misses,
            here.starts,
        )
    return smoothed


def _move(dt_us: float) -> Floats:
    move = np.eye(6)
    move[:3, 3:] = dt_us * 1e-6 * np.eye(3)
    return move


def _ahead(state: TrajectoryPoint, t_us: float, spec: PositionSpec) -> tuple[Floats, Floats]:
    dt = (t_us - state.t_us) * 1e-6
    move = _move(t_us - state.t_us)
    power = spec.acceleration_m2_s3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, math.fabs(dt)]])
    return move @ state.mean, move @ state.noise @ move.T + np.kron(power, np.eye(3))
