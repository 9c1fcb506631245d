"""The camera's way from its fixes: a Kalman filter forward, live, and a smoother backward, offline.

What stays wrong over many fixes - a bar's site, the camera's focal length, an IMU's bias and clock - is a
state beside position and velocity, so that it is never averaged away as if it were noise, and is estimated
where a drive shows it. What changes as the image moves over the pixels is one with a memory of a fraction of
a second.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

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

_MOTION = 6
_SLOW = slice(6, 9)
_FIXED = 9
"""Position, velocity, and what changes slowly; the standing causes follow."""

_KEPT_US = 10e6
"""Time out of sight after which a bar's errors are no state any more: most bars never come back."""

_TURN_US = 1e6
"""Longest time between fixes over which the way turns as the camera did."""


@dataclass(frozen=True)
class Cause:
    """Standing errors of one part, that are states of a trajectory.

    Attributes:
        name: As in `Fix.standing`: `camera`, `attitude`, `bar N`.
        size: How many they are.
        t_us: Of the last fix that they entered, us.
    """

    name: str
    size: int
    t_us: float


@dataclass(frozen=True, eq=False)
class TrajectoryPoint:
    """Position and velocity at one time, filtered or smoothed, with what stays wrong; the filter's state,
    too.

    Attributes:
        t_us: Camera clock, us.
        mean: East, north, up, m, their velocities, m/s, three slow errors, and the standing ones of all
            `causes` in a row, in their own sigmas, float64 (n,).
        covariance: Of these, float64 (n, n).
        causes: What the standing errors are of.
        heading_deg: Of the camera at the last fix.
        misses: Fixes in a row that were left out, this one included; 0 where it counts.
        starts: A trajectory starts here.
    """

    t_us: float
    mean: Floats
    covariance: Floats
    causes: tuple[Cause, ...] = ()
    heading_deg: float = math.nan
    misses: int = 0
    starts: bool = False

    @property
    def covariance_m2(self) -> Floats:
        """Of the position, float64 (3, 3)."""
        return self.covariance[:3, :3]

    def standing(self, name: str) -> tuple[Floats, Floats] | None:
        """What is estimated of a part's standing errors, in their sigmas, (k,), and its covariance, (k, k).

        None where it has none. An error that nothing has shown is 0 with a covariance of 1.
        """
        for cause, at in _columns(self.causes):
            if cause.name == name:
                return self.mean[at], self.covariance[at, at]
        return None


def _columns(causes: Iterable[Cause]) -> list[tuple[Cause, slice]]:
    found, at = [], _FIXED
    for cause in causes:
        found.append((cause, slice(at, at + cause.size)))
        at += cause.size
    return found


def trajectory_step(state: TrajectoryPoint | None, fix: Fix, spec: PositionSpec) -> TrajectoryPoint:
    """Take a fix: velocity that turns as the camera does, driven by white acceleration (Bar-Shalom, chapter
    6).

    A fix beyond `spec.gate_sigmas` is left out, and after many of those in a row the trajectory starts anew.

    Args:
        state: The last point, None at the start; not changed.
        fix: One that is given, not before the last.
        spec: Power of the acceleration, memory of the slow errors, and the gate.
    """
    if state is None:
        return _first(fix)
    ahead = _joined(_ahead(state, fix.t_us, _turn_rad(state, fix), spec), fix)
    seen = _seen(ahead.causes, fix)
    known = ahead.covariance @ seen.T
    spread = seen @ known + fix.noise_m2
    innovation = fix.enu_m - seen @ ahead.mean
    if innovation @ np.linalg.solve(spread, innovation) > spec.gate_sigmas**2:
        if state.misses + 1 > _MOST_MISSES:
            return _first(fix)
        return replace(ahead, heading_deg=fix.heading_deg, misses=state.misses + 1)
    gain = np.linalg.solve(spread, known.T).T
    # Joseph's form keeps the covariance positive.
    change = gain @ known.T
    after = ahead.covariance - change - change.T + gain @ spread @ gain.T
    mean = ahead.mean + gain @ innovation
    after = (after + after.T) / 2
    return replace(ahead, mean=mean, covariance=after, heading_deg=fix.heading_deg, misses=0)


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
        turn = _between(here.heading_deg, points[i + 1].heading_deg, after.t_us - here.t_us)
        move, noise, causes = _motion(here, after.t_us, turn, spec)
        # Causes that came later are independent of this point: what is common has passed on.
        common = _shared(causes, after.causes)
        mean = (move @ here.mean)[: len(common)]
        spread = (move @ here.covariance @ move.T + noise)[: len(common), : len(common)]
        crossed = (move @ here.covariance)[: len(common)]
        gain = np.linalg.solve(spread, crossed).T
        there = after.covariance[np.ix_(common, common)]
        covariance = here.covariance + gain @ (there - spread) @ gain.T
        smoothed[i] = replace(
            here,
            mean=here.mean + gain @ (after.mean[common] - mean),
            covariance=(covariance + covariance.T) / 2,
        )
    return smoothed


def _first(fix: Fix) -> TrajectoryPoint:
    """A trajectory that starts at a fix: its position is off by what stays as the fix is."""
    causes = tuple(Cause(name, moves.shape[1], fix.t_us) for name, moves in fix.standing.items())
    size = _FIXED + sum(cause.size for cause in causes)
    covariance = np.eye(size)
    covariance[3:_MOTION, 3:_MOTION] *= _SPEED_M_S**2
    moves = _seen(causes, fix)[:, _MOTION:]
    covariance[:3, :3] = fix.noise_m2 + moves @ moves.T
    covariance[:3, _MOTION:] = -moves
    covariance[_MOTION:, :3] = -moves.T
    mean = np.concatenate([fix.enu_m, np.zeros(size - 3)])
    return TrajectoryPoint(fix.t_us, mean, covariance, causes, fix.heading_deg, starts=True)


def _seen(causes: Sequence[Cause], fix: Fix) -> Floats:
    """How a fix depends on the states, float64 (3, n)."""
    seen = np.zeros((3, _FIXED + sum(cause.size for cause in causes)))
    seen[:, :3] = np.eye(3)
    values, axes = np.linalg.eigh(fix.slow_m2)
    # The symmetric root turns as little as it can from fix to fix.
    seen[:, _SLOW] = (axes * np.sqrt(np.maximum(values, 0))) @ axes.T
    for cause, at in _columns(causes):
        if cause.name in fix.standing:
            seen[:, at] = fix.standing[cause.name]
    return seen


def _joined(point: TrajectoryPoint, fix: Fix) -> TrajectoryPoint:
    """A point with the fix's causes among its own."""
    causes = [replace(c, t_us=fix.t_us) if c.name in fix.standing else c for c in point.causes]
    known = {cause.name for cause in causes}
    new = [Cause(n, moves.shape[1], fix.t_us) for n, moves in fix.standing.items() if n not in known]
    more = sum(cause.size for cause in new)
    size = len(point.mean)
    covariance = np.eye(size + more)
    covariance[:size, :size] = point.covariance
    mean = np.concatenate([point.mean, np.zeros(more)])
    return replace(point, mean=mean, covariance=covariance, causes=(*causes, *new))


def _ahead(point: TrajectoryPoint, t_us: float, turn_rad: float, spec: PositionSpec) -> TrajectoryPoint:
    move, noise, causes = _motion(point, t_us, turn_rad, spec)
    covariance = move @ point.covariance @ move.T + noise
    return replace(
        point, t_us=t_us, mean=move @ point.mean, covariance=covariance, causes=causes, starts=False
    )


def _motion(
    point: TrajectoryPoint, t_us: float, turn_rad: float, spec: PositionSpec
) -> tuple[Floats, Floats, tuple[Cause, ...]]:
    """What takes a point to a later time, (m, n), what that adds, (m, m), and the causes that are kept."""
    dt = (t_us - point.t_us) * 1e-6
    kept = [(c, at) for c, at in _columns(point.causes) if _stays(c, t_us)]
    rows = [*range(_FIXED), *(i for _, at in kept for i in range(at.start, at.stop))]
    move = np.eye(len(point.mean))[rows]
    along, turned = _turned(dt, turn_rad)
    move[:3, 3:6], move[3:6, 3:6] = along, turned
    fade = math.exp(-dt / spec.slow_s)
    move[_SLOW] *= fade
    noise = np.zeros((len(rows), len(rows)))
    power = spec.acceleration_m2_s3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    noise[:_MOTION, :_MOTION] = np.kron(power, np.eye(3))
    noise[_SLOW, _SLOW] = (1 - fade**2) * np.eye(3)
    return move, noise, tuple(cause for cause, _ in kept)


def _stays(cause: Cause, t_us: float) -> bool:
    return not cause.name.startswith("bar ") or t_us - cause.t_us <= _KEPT_US


def _shared(causes: Sequence[Cause], later: Sequence[Cause]) -> list[int]:
    """Where a later point has the motion and these causes, in their order; it has all of them."""
    at = {cause.name: columns for cause, columns in _columns(later)}
    return [*range(_FIXED), *(i for c in causes for i in range(at[c.name].start, at[c.name].stop))]


def _turned(dt: float, turn_rad: float) -> tuple[Floats, Floats]:
    """What a velocity becomes on the way and in the end, turning clockwise at an even rate, (3, 3) each."""
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    turned = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    if abs(turn_rad) < 1e-6:
        return dt * np.eye(3), turned
    even, aside = sin / turn_rad, (1 - cos) / turn_rad
    return dt * np.array([[even, aside, 0.0], [-aside, even, 0.0], [0.0, 0.0, 1.0]]), turned


def _turn_rad(state: TrajectoryPoint, fix: Fix) -> float:
    return _between(state.heading_deg, fix.heading_deg, fix.t_us - state.t_us)


def _between(before_deg: float, after_deg: float, dt_us: float) -> float:
    """By how much a way turns between two fixes: as the camera did, if that is known."""
    turn = math.remainder(after_deg - before_deg, 360.0)
    return math.radians(turn) if dt_us <= _TURN_US and math.isfinite(turn) else 0.0
