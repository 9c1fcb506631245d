"""The camera's trajectory from its fixes: a Kalman filter forward, live, and a smoother backward, offline.

Fixes are of bars or of GNSS; between them the trajectory turns and accelerates as an IMU measures, if there
is one.

Errors that persist over many fixes - of a bar's site, the camera's focal length, an IMU's bias and clock -
are states beside position and velocity, so that they are never averaged away as noise, and are estimated
where a drive shows them. Errors that change as the image moves over the pixels are states with a memory of a
fraction of a second.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.error_model import ErrorModel, chi_square, symmetric_root
from evlcp_sdk.scene.attitude import ImuMotion
from evlcp_sdk.values import Fix

Floats = NDArray[np.float64]

Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class DeadReckoning:
    """Propagation of position, m, and velocity, m/s, over a time: east, north, up of each.

    Attributes:
        transition: Slopes by the earlier position and velocity, float64 (6, 6).
        displacement: Change by a measured acceleration, float64 (6,).
        noise: Covariance of the unknown part, float64 (6, 6).
        by_bias: Slopes by the IMU's biases in their sigmas, float64 (6, 0, 1 or 4).
        turn_rad: Change of the heading, clockwise.
    """

    transition: Floats
    displacement: Floats
    noise: Floats
    by_bias: Floats
    turn_rad: float


def imu_sigmas(motion: ImuMotion, spec: ErrorModel) -> Floats:
    """Sigmas of an IMU's biases: the gyroscope's, radians/s, the accelerometer's, m/s2: none, 1 or 4."""
    sigmas = [np.radians(spec.rate_sigma_deg_s)] if motion.has_gyro else []
    if motion.acceleration_m_s2 is not None:
        sigmas += 3 * [spec.accelerometer_sigma_m_s2]
    return np.array(sigmas)


_LEVEL = [0, 1, 3, 4]
"""Rows of east and north among those of place and speed."""


def dead_reckon(
    motion: ImuMotion,
    velocity_m_s: Floats,
    heading_rad: float,
    heading_sigma_rad: float,
    imu: Floats,
    spec: ErrorModel,
) -> DeadReckoning:
    """Propagate position and velocity over a time.

    East and north are one complex number, east + i north: a clockwise rotation by an angle is a factor exp(-i
    angle). Without an accelerometer the velocity turns with the camera, driven by white acceleration; with
    one it changes as measured, and the camera's heading, clockwise from north, matters. Velocity (east,
    north, up) and heading are those at the start; `imu` are the estimated biases in their sigmas (0, 1 or
    4,).
    """
    sigmas = imu_sigmas(motion, spec)
    bias = imu * sigmas
    t_s, weight = _simpson_nodes(motion.t_s)
    dt_s = float(t_s[-1])
    angle = np.interp(t_s, motion.t_s, motion.turn_rad)
    if motion.has_gyro:
        angle = angle - bias[0] * t_s
    rotation, path = np.exp(-1j * angle), _integrate_turn(t_s, angle)
    displacement, noise, by_bias = np.zeros(6), np.zeros((6, 6)), np.zeros((6, len(sigmas)))
    level = np.ix_(_LEVEL, _LEVEL)
    if motion.acceleration_m_s2 is None:
        remaining = path[-1] - path
        moves = np.stack([remaining, np.full_like(remaining, rotation[-1])])
        by_turn = _by_level(-1j * complex(*velocity_m_s[:2]) * moves)[:, 0]
        kicks, power, by_speed = moves / rotation, spec.acceleration_m2_s3, moves[:, 0]
    else:
        right, forward, up = (np.interp(t_s, motion.t_s, a) for a in (motion.acceleration_m_s2 - bias[-3:]).T)
        facing = np.exp(-1j * heading_rad)
        speed = _integrate(t_s, facing * rotation * (right + 1j * forward))
        place, climb = _integrate(t_s, speed), _integrate(t_s, up)
        turned = np.stack([place[-1] - place - speed * (dt_s - t_s), speed[-1] - speed])
        by_turn = _by_level(-1j * turned)[:, 0]
        kicks, power = np.stack([dt_s - t_s, np.ones_like(t_s)]), spec.accelerometer_white_m2_s3
        by_speed = kicks[:, 0]
        displacement[_LEVEL] = _by_level(np.array([place[-1], speed[-1]]))[:, 0]
        displacement[[2, 5]] = _integrate(t_s, climb)[-1], climb[-1]
        by_bias[_LEVEL, -3:-1] = -sigmas[-1] * _by_level(facing * np.array([path @ weight, path[-1]]))
        by_bias[[2, 5], -1] = -sigmas[-1] * dt_s**2 / 2, -sigmas[-1] * dt_s
        noise[level] = heading_sigma_rad**2 * np.outer(by_turn[:, 0], by_turn[:, 0])
    transition = np.eye(6)
    transition[_LEVEL, 3:5] = _by_level(by_speed)
    transition[2, 5] = dt_s
    pushes = _by_level(kicks).reshape(4, -1)
    noise[level] += power * (pushes * np.tile(weight, 2)) @ pushes.T
    noise[np.ix_((2, 5), (2, 5))] = power * np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]])
    if motion.has_gyro:
        noise[level] += np.radians(spec.rate_white_deg_rts) ** 2 * (by_turn * weight) @ by_turn.T
        by_bias[_LEVEL, 0] = -(by_turn @ weight) * sigmas[0]
    return DeadReckoning(transition, displacement, noise, by_bias, float(angle[-1]))


def _by_level(moves: NDArray[Any]) -> Floats:
    """Level place and speed by what their complex moves (2, ...) multiply: (4, 2, ...), east and north."""
    both = np.stack([moves, 1j * moves], 1)
    return np.stack([both.real, both.imag], 1).reshape(4, 2, *moves.shape[1:])


def _simpson_nodes(t_s: Floats) -> tuple[Floats, Floats]:
    """Times with one midway between each two, and Simpson's weights of them."""
    steps = np.diff(t_s)
    nodes = np.empty(2 * len(t_s) - 1)
    nodes[::2], nodes[1::2] = t_s, t_s[:-1] + steps / 2
    weight = np.zeros(len(nodes))
    weight[1::2] = 4 * steps / 6
    weight[:-1:2] += steps / 6
    weight[2::2] += steps / 6
    return nodes, weight


def _integrate_turn(t_s: Floats, angle: Floats) -> Complex:
    """Integral of exp(-i angle) from the start to each time, for an angle that is linear between two."""
    half = np.diff(angle) / 2
    chord = np.diff(t_s) * np.sinc(half / np.pi) * np.exp(-1j * (angle[:-1] + half))
    return np.concatenate([np.zeros(1, np.complex128), np.cumsum(chord)])


def _integrate(t_s: Floats, values: NDArray[Any]) -> NDArray[Any]:
    area = np.cumsum(np.diff(t_s) * (values[1:] + values[:-1]) / 2)
    return np.concatenate([np.zeros(1, values.dtype), area])


MotionSource = Callable[[float, float], ImuMotion | None]
"""The camera's motion from one time to a later one, us; None if it is unknown."""

GNSS, IMU = "gnss", "imu"
"""Causes of standing errors: a GNSS receiver, whose errors have a memory of `ErrorModel.gnss_s`, and the
IMU's rates and accelerations."""

_SPEED_M_S = 30.0
"""Prior sigma of the speed: a car's."""

_MAX_REJECTED = 10
"""Fixes in a row that are rejected before the trajectory starts anew: so many are not outliers. In a young
one, no more than it has accepted: an outlier among its first fixes points it elsewhere."""

_MOTION = 6
_SLOW = slice(6, 9)
_FIXED = 9
"""Columns of position and velocity, of slow errors, and the first of standing errors."""

_MEMORY_US = 10e6
"""Time out of sight after which a bar's errors are dropped: most bars never come back."""

_COURSE_S = 0.3
"""Memory of the course of fixes: an acceleration of 3 m/s2 takes it a quarter of a metre off."""

_COURSE_FIXES = 3
"""Fixes from which on the course predicts the next one; before, it is the line through them and that one."""

_REFILTER_COUNTS = (4, 8, 16)
"""Fixes after which those since a course began are filtered again, each where the course has it by then."""

_MAX_NOISE_SIGMAS = 3.0
"""Sigmas of its noise that a fix may be off its course; more is not noise."""

_NOISY_SHARE = 1e-3
"""Share of a fix's noise, as variance, by which its shifts by one sigma of each standing error may change
with the noise: each fix adds so much false information; a bar is seen for some hundred."""

_TURN_US = 1e6
"""Longest time between fixes over which the trajectory turns with the camera's headings."""


@dataclass(frozen=True)
class Cause:
    """Standing errors of one part, `size` of them, as states of a trajectory.

    The name is as in `Fix.standing`: `camera`, `attitude`, `bar N`; the time is of the last fix that they
    entered.
    """

    name: str
    size: int
    t_us: float


@dataclass(frozen=True, eq=False)
class Course:
    """Where fixes of some bars lead, standing errors included: a line through the last `count` of them.

    Place and speed, east, north, up, float64 (3,), are at the last of them.
    """

    place_m: Floats
    speed_m_s: Floats
    count: int
    transmitters: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class TrajectoryPoint:
    """Position and velocity at one time, filtered or smoothed, with standing errors; the filter's state, too.

    Attributes:
        t_us: Camera clock, us.
        mean: East, north, up, m, their velocities, m/s, three slow errors, and the standing ones of all
            `causes` in a row, in their own sigmas, float64 (n,).
        covariance: Of these, float64 (n, n).
        causes: Of the standing errors.
        heading_deg: The camera's, by the last fix or the IMU, of `heading_t_us`, with `heading_sigma_deg`.
        motion: The camera's motion since the point before.
        rejected: Fixes in a row that were rejected, up to this one; 0 where it counts.
        starts: A trajectory starts here.
        accepted: Fixes that count since then, at most `_MAX_REJECTED`.
        fix: The fix, accepted or rejected.
        course: The course of fixes of the same bars, with little of their noise.
        recent: The points from the one before that course on, as long as it is short.
    """

    t_us: float
    mean: Floats
    covariance: Floats
    causes: tuple[Cause, ...] = ()
    heading_deg: float = math.nan
    heading_t_us: float = -math.inf
    heading_sigma_deg: float = 0.0
    motion: ImuMotion | None = None
    rejected: int = 0
    starts: bool = False
    accepted: int = 1
    fix: Fix | None = None
    course: Course | None = None
    recent: tuple["TrajectoryPoint", ...] = ()

    @property
    def covariance_m2(self) -> Floats:
        """Of the position, float64 (3, 3)."""
        return self.covariance[:3, :3]

    def standing(self, name: str) -> tuple[Floats, Floats] | None:
        """Estimates of a part's standing errors, in their sigmas, (k,), and their covariance, (k, k).

        None where it has none. An error that nothing has shown is 0 with a covariance of 1.
        """
        for cause, columns in _cause_columns(self.causes):
            if cause.name == name:
                return self.mean[columns], self.covariance[columns, columns]
        return None


def _cause_columns(causes: Iterable[Cause]) -> list[tuple[Cause, slice]]:
    columns, first = [], _FIXED
    for cause in causes:
        columns.append((cause, slice(first, first + cause.size)))
        first += cause.size
    return columns


def step_trajectory(
    state: TrajectoryPoint | None, fix: Fix, spec: ErrorModel, imu: MotionSource | None = None
) -> TrajectoryPoint:
    """Filter a fix: velocity turns with the camera, driven by white acceleration (Bar-Shalom, chapter 6), or
    changes as an accelerometer measures.

    A fix beyond `spec.gate_sigmas`, or one of GNSS that fails its test at `spec.false_alarm`, is rejected;
    after many in a row the trajectory starts anew. The fix is a given one, not before the last; the state,
    None at the start, is not changed. Without an IMU's motion, the fixes' headings show how the camera turns.
    """
    if state is None:
        return _start_trajectory(fix)
    motion = imu(state.t_us, fix.t_us) if imu is not None and fix.t_us > state.t_us else None
    if motion is None:
        turn = math.remainder(fix.heading_deg - state.heading_deg, 360.0)
        recent = fix.t_us - state.heading_t_us <= _TURN_US
        turn_rad = math.radians(turn) if recent and math.isfinite(turn) else 0.0
        motion = ImuMotion(np.array([0.0, (fix.t_us - state.t_us) * 1e-6]), np.array([0.0, turn_rad]))
    predicted = _add_fix_causes(_predict(state, fix.t_us, motion, spec), fix)
    predicted, observation = _observe_on_course(predicted, fix)
    innovation = fix.enu_m - observation @ predicted.mean
    spread = observation @ predicted.covariance @ observation.T + fix.noise_m2
    limit = chi_square(spec.false_alarm, 3) if fix.source == GNSS else spec.gate_sigmas**2
    if innovation @ np.linalg.solve(spread, innovation) > limit:
        if state.rejected + 1 > min(_MAX_REJECTED, state.accepted):
            return _start_trajectory(fix)
        return _refine_course(state, replace(_set_heading(predicted, fix), rejected=state.rejected + 1), spec)
    return _refine_course(state, _apply_fix(predicted, fix, observation), spec)


def _refine_course(state: TrajectoryPoint, point: TrajectoryPoint, spec: ErrorModel) -> TrajectoryPoint:
    """Filter the fixes of a young course again, now that it is known better; return the point so."""
    course = point.course
    if course is None or course.count > _REFILTER_COUNTS[-1] or point.fix is None:
        return point
    before = replace(state, recent=())
    recent = (*state.recent, before) if course.count > 1 else (before,)
    if course is not state.course and course.count in _REFILTER_COUNTS and _has_noisy_standing(point.fix):
        points = [*recent, point]
        *refiltered, point = _refilter(points, _smooth_once(points, spec), spec)
        recent = tuple(refiltered)
    return replace(point, recent=recent if course.count < _REFILTER_COUNTS[-1] else ())


def _apply_fix(predicted: TrajectoryPoint, fix: Fix, observation: Floats) -> TrajectoryPoint:
    """Kalman update with a fix, whose observation matrix is float64 (3, n)."""
    crossed = predicted.covariance @ observation.T
    spread = observation @ crossed + fix.noise_m2
    gain = np.linalg.solve(spread, crossed.T).T
    # Joseph's form keeps the covariance positive.
    change = gain @ crossed.T
    after = predicted.covariance - change - change.T + gain @ spread @ gain.T
    mean = predicted.mean + gain @ (fix.enu_m - observation @ predicted.mean)
    after = (after + after.T) / 2
    accepted = min(predicted.accepted + 1, _MAX_REJECTED)
    return replace(_set_heading(predicted, fix), mean=mean, covariance=after, rejected=0, accepted=accepted)


def filter_fixes(
    fixes: Iterable[Fix], spec: ErrorModel, imu: MotionSource | None = None
) -> list[TrajectoryPoint]:
    """Filter the given fixes, one point each; refused ones have none."""
    points: list[TrajectoryPoint] = []
    for fix in fixes:
        if not fix.refusal:
            points.append(step_trajectory(points[-1] if points else None, fix, spec, imu))
    return points


def smooth_trajectory(points: Sequence[TrajectoryPoint], spec: ErrorModel) -> list[TrajectoryPoint]:
    """Smooth filtered points with later ones (Rauch, Tung, Striebel 1965), each trajectory by itself.

    Where a fix's noise changes its shifts by standing errors, all are filtered and smoothed once more, each
    where the smoothed track has it: the iterated smoother (Bell, SIAM J. Optim. 4 (1994), 626).
    """
    smoothed = _smooth_once(points, spec)
    if not any(point.fix is not None and _has_noisy_standing(point.fix) for point in points):
        return smoothed
    return _smooth_once(_refilter(points, smoothed, spec), spec)


def _refilter(
    points: Sequence[TrajectoryPoint], smoothed: Sequence[TrajectoryPoint], spec: ErrorModel
) -> list[TrajectoryPoint]:
    """Filter points again, with observation matrices where the smoothed track has the fixes; the first point
    stays unless a trajectory starts there.
    """
    refiltered = list(points)
    for i, (point, smooth) in enumerate(zip(points, smoothed, strict=True)):
        fix = point.fix
        if fix is None:
            continue
        # Slow errors count as noise.
        mean = np.where(np.arange(len(smooth.mean)) // 3 == _SLOW.start // 3, 0.0, smooth.mean)
        shifted = _shift_standing(fix, fix.enu_m - _observation_matrix(smooth.causes, fix) @ mean)
        if point.starts:
            refiltered[i] = replace(_start_trajectory(shifted), fix=fix)
        elif i:
            assert point.motion is not None
            new = _add_fix_causes(_predict(refiltered[i - 1], point.t_us, point.motion, spec), fix)
            observation = _observation_matrix(new.causes, shifted)
            new = _set_heading(new, fix) if point.rejected else _apply_fix(new, fix, observation)
            refiltered[i] = replace(
                new, rejected=point.rejected, accepted=point.accepted, course=point.course
            )
    return refiltered


def _smooth_once(points: Sequence[TrajectoryPoint], spec: ErrorModel) -> list[TrajectoryPoint]:
    smoothed = list(points)
    for i in range(len(points) - 2, -1, -1):
        if points[i + 1].starts:
            continue
        after, motion = smoothed[i + 1], points[i + 1].motion
        assert motion is not None
        point = _add_imu_biases(points[i], after.t_us, motion, spec)
        predicted, transition, noise, causes, _ = _state_transition(point, after.t_us, motion, spec)
        # Later causes are independent of this point.
        columns = {c.name: range(at.start, at.stop) for c, at in _cause_columns(after.causes)}
        common = [*range(_FIXED), *(i for cause in causes for i in columns[cause.name])]
        mean = predicted[: len(common)]
        spread = (transition @ point.covariance @ transition.T + noise)[: len(common), : len(common)]
        crossed = (transition @ point.covariance)[: len(common)]
        gain = np.linalg.solve(spread, crossed).T
        smooth = after.covariance[np.ix_(common, common)]
        covariance = point.covariance + gain @ (smooth - spread) @ gain.T
        mean_after = point.mean + gain @ (after.mean[common] - mean)
        smoothed[i] = replace(point, mean=mean_after, covariance=(covariance + covariance.T) / 2)
    return smoothed


def predict_heading(
    point: TrajectoryPoint, t_us: float, imu: MotionSource | None = None
) -> tuple[float, float] | None:
    """The camera's heading at a time not before a point, and its sigma, degrees; None if it is unknown."""
    if not math.isfinite(point.heading_deg):
        return None
    motion = imu(point.heading_t_us, t_us) if imu is not None and t_us > point.heading_t_us else None
    if motion is not None:
        return point.heading_deg + math.degrees(float(motion.turn_rad[-1])), point.heading_sigma_deg
    recent = t_us - point.heading_t_us <= _TURN_US
    return (point.heading_deg, point.heading_sigma_deg) if recent else None


def _start_trajectory(fix: Fix) -> TrajectoryPoint:
    """Start a trajectory at a fix, with the errors of its position correlated with the standing ones."""
    causes = tuple(Cause(name, moves.shape[1], fix.t_us) for name, moves in fix.standing.items())
    size = _FIXED + sum(cause.size for cause in causes)
    covariance = np.eye(size)
    covariance[3:_MOTION, 3:_MOTION] *= _SPEED_M_S**2
    moves = _observation_matrix(causes, fix)[:, _MOTION:]
    covariance[:3, :3] = fix.noise_m2 + moves @ moves.T
    covariance[:3, _MOTION:] = -moves
    covariance[_MOTION:, :3] = -moves.T
    mean = np.concatenate([fix.enu_m, np.zeros(size - 3)])
    point = TrajectoryPoint(fix.t_us, mean, covariance, causes, starts=True, course=_start_course(fix))
    return _set_heading(point, fix)


def _observation_matrix(causes: Sequence[Cause], fix: Fix) -> Floats:
    """Slopes of a fix by the states, float64 (3, n)."""
    observation = np.zeros((3, _FIXED + sum(cause.size for cause in causes)))
    observation[:, :3] = np.eye(3)
    observation[:, _SLOW] = symmetric_root(fix.slow_m2)
    for cause, columns in _cause_columns(causes):
        if cause.name in fix.standing:
            observation[:, columns] = fix.standing[cause.name]
    return observation


def _observe_on_course(predicted: TrajectoryPoint, fix: Fix) -> tuple[TrajectoryPoint, Floats]:
    """Observation matrix of a fix where its course has it, float64 (3, n), and the point with that course.

    Not where the fix is: there, the shifts by standing errors follow the fix's noise, which would seem to
    show them. With two or three bars, each surveyed to 5 cm, a track's sigmas would be half of the true ones.
    """
    course = predicted.course
    if not fix.standing_slope:
        return predicted, _observation_matrix(predicted.causes, fix)
    if course is None or course.transmitters != fix.transmitters or predicted.motion is None:
        return replace(predicted, course=_start_course(fix)), _observation_matrix(predicted.causes, fix)
    dt_s = float(predicted.motion.t_s[-1])
    horizontal = complex(*course.speed_m_s[:2]) * np.exp(-1j * float(predicted.motion.turn_rad[-1]))
    speed_m_s = np.array([horizontal.real, horizontal.imag, course.speed_m_s[2]])
    place_m = course.place_m + speed_m_s * dt_s
    offset_m, count, fade = fix.enu_m - place_m, course.count, math.exp(-dt_s / _COURSE_S)
    # Gains of a line through all fixes, until older ones count less: Brookner, Tracking, 1998, 1.2.10.
    by_place = max(2 * (2 * count + 1) / ((count + 1) * (count + 2)), 1 - fade**2)
    by_speed = max(6 / ((count + 1) * (count + 2)), (1 - fade) ** 2)
    place_m, speed_m_s = place_m + by_place * offset_m, speed_m_s + by_speed * offset_m / max(dt_s, 1e-6)
    course = Course(place_m, speed_m_s, count + 1, fix.transmitters)
    if count < _COURSE_FIXES:
        offset_m = fix.enu_m - course.place_m
    sigmas = math.sqrt(float(offset_m @ np.linalg.solve(fix.noise_m2 + fix.slow_m2, offset_m)))
    offset_m = offset_m * min(1.0, _MAX_NOISE_SIGMAS / max(sigmas, 1e-9))
    observation = _observation_matrix(predicted.causes, _shift_standing(fix, offset_m))
    return replace(predicted, course=course), observation


def _start_course(fix: Fix) -> Course:
    return Course(fix.enu_m, np.zeros(3), 1, fix.transmitters)


def _shift_standing(fix: Fix, offset_m: Floats) -> Fix:
    """A fix with the standing moves that it has at a place shifted against its noise, m, float64 (3,)."""
    along_m = float(fix.weakest_axis @ offset_m)
    changes = {n: fix.standing[n] - along_m * slope for n, slope in fix.standing_slope.items()}
    return replace(fix, standing={**fix.standing, **changes})


def _has_noisy_standing(fix: Fix) -> bool:
    """Whether a fix's noise changes its standing moves by an amount that matters in a hundred fixes."""
    noise = fix.noise_m2 + fix.slow_m2
    variance = float(fix.weakest_axis @ noise @ fix.weakest_axis)
    change = variance * sum([(s * s).sum() for s in fix.standing_slope.values()])
    return bool(change > _NOISY_SHARE * np.trace(noise))


def _add_fix_causes(point: TrajectoryPoint, fix: Fix) -> TrajectoryPoint:
    causes = [replace(c, t_us=fix.t_us) if c.name in fix.standing else c for c in point.causes]
    known = {cause.name for cause in causes}
    new = [Cause(n, moves.shape[1], fix.t_us) for n, moves in fix.standing.items() if n not in known]
    return _add_causes(replace(point, causes=tuple(causes)), new)


def _add_imu_biases(
    point: TrajectoryPoint, t_us: float, motion: ImuMotion, spec: ErrorModel
) -> TrajectoryPoint:
    """Add the IMU's biases if the point lacks them."""
    biases = len(imu_sigmas(motion, spec))
    known = not biases or any(cause.name == IMU for cause in point.causes)
    return point if known else _add_causes(point, [Cause(IMU, biases, t_us)])


def _add_causes(point: TrajectoryPoint, new: Sequence[Cause]) -> TrajectoryPoint:
    more, size = sum(cause.size for cause in new), len(point.mean)
    covariance = np.eye(size + more)
    covariance[:size, :size] = point.covariance
    mean = np.concatenate([point.mean, np.zeros(more)])
    return replace(point, mean=mean, covariance=covariance, causes=(*point.causes, *new))


def _predict(point: TrajectoryPoint, t_us: float, motion: ImuMotion, spec: ErrorModel) -> TrajectoryPoint:
    point = _add_imu_biases(point, t_us, motion, spec)
    mean, transition, noise, causes, turn_rad = _state_transition(point, t_us, motion, spec)
    covariance = transition @ point.covariance @ transition.T + noise
    predicted = replace(
        point, t_us=t_us, mean=mean, covariance=covariance, causes=causes, motion=motion, starts=False
    )
    if not motion.has_gyro:
        return predicted
    drift_deg = spec.rate_white_deg_rts * math.sqrt(float(motion.t_s[-1]))
    return replace(
        predicted,
        heading_deg=point.heading_deg + math.degrees(turn_rad),
        heading_t_us=t_us,
        heading_sigma_deg=math.hypot(point.heading_sigma_deg, drift_deg),
    )


def _set_heading(point: TrajectoryPoint, fix: Fix) -> TrajectoryPoint:
    """Set a point's fix, and its heading if the fix has one."""
    if not math.isfinite(fix.heading_deg):
        return replace(point, fix=fix)
    sigma_deg = fix.heading_sigma_deg if math.isfinite(fix.heading_sigma_deg) else 0.0
    return replace(
        point, heading_deg=fix.heading_deg, heading_t_us=fix.t_us, heading_sigma_deg=sigma_deg, fix=fix
    )


def _state_transition(
    point: TrajectoryPoint, t_us: float, motion: ImuMotion, spec: ErrorModel
) -> tuple[Floats, Floats, Floats, tuple[Cause, ...], float]:
    """Mean at a later time, (m,), transition, (m, n), added covariance, (m, m), causes, and the turn."""
    dt_s = (t_us - point.t_us) * 1e-6
    outdated = [c for c in point.causes if t_us - c.t_us > _MEMORY_US]
    dropped = {c.name for c in outdated if c.name.startswith("bar ") or c.name == "attitude-excess"}
    kept = [(c, columns) for c, columns in _cause_columns(point.causes) if c.name not in dropped]
    rows = [*range(_FIXED), *(i for _, columns in kept for i in range(columns.start, columns.stop))]
    transition = np.eye(len(point.mean))[rows]
    noise = np.zeros((len(rows), len(rows)))
    imu_columns = next((columns for c, columns in _cause_columns(point.causes) if c.name == IMU), slice(0, 0))
    if motion.acceleration_m_s2 is not None and not math.isfinite(point.heading_deg):
        # An acceleration has no direction without a heading.
        motion = replace(motion, acceleration_m_s2=None)
    biases = point.mean[imu_columns][: len(imu_sigmas(motion, spec))]
    heading_rad, sigma_rad = math.radians(point.heading_deg), math.radians(point.heading_sigma_deg)
    reckoned = dead_reckon(motion, point.mean[3:_MOTION], heading_rad, sigma_rad, biases, spec)
    transition[:_MOTION, :_MOTION] = reckoned.transition
    noise[:_MOTION, :_MOTION] = reckoned.noise
    fade = math.exp(-dt_s / spec.slow_s)
    transition[_SLOW] *= fade
    noise[_SLOW, _SLOW] = (1 - fade**2) * np.eye(3)
    causes = [cause for cause, _ in kept]
    for cause, columns in _cause_columns(causes):
        if cause.name == GNSS:
            fade = math.exp(-dt_s / spec.gnss_s)
            transition[columns] *= fade
            noise[columns, columns] = (1 - fade**2) * np.eye(cause.size)
    mean = transition @ point.mean
    mean[:_MOTION] += reckoned.displacement
    # The mean has the biases already; what is left is their effect on the covariance.
    transition[:_MOTION, imu_columns.start : imu_columns.start + len(biases)] = reckoned.by_bias
    return mean, transition, noise, tuple(causes), reckoned.turn_rad
