"""The camera's way from its fixes: a Kalman filter forward, live, and a smoother backward, offline.

Fixes are of bars or of GNSS; between them the way turns, and is pushed, as an IMU says, where there is one.

What stays wrong over many fixes - a bar's site, the camera's focal length, an IMU's bias and clock - is a
state beside position and velocity, so that it is never averaged away as if it were noise, and is estimated
where a drive shows it. What changes as the image moves over the pixels is one with a memory of a fraction of
a second.
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
class Reckoned:
    """What time makes of position, m, and velocity, m/s: east, north, up of each.

    Attributes:
        move: How they depend on what they were, float64 (6, 6).
        added: What a push adds to them, float64 (6,).
        noise: Covariance of what is not known of it, float64 (6, 6).
        by_imu: How they depend on the IMU's biases in their sigmas, float64 (6, 0, 1 or 4).
        turn_rad: By how much the heading changes, clockwise.
    """

    move: Floats
    added: Floats
    noise: Floats
    by_imu: Floats
    turn_rad: float


def imu_sigmas(motion: ImuMotion, spec: ErrorModel) -> Floats:
    """Sigmas of an IMU's biases: the gyroscope's, radians/s, the accelerometer's, m/s2: none, 1 or 4."""
    sigmas = [np.radians(spec.rate_sigma_deg_s)] if motion.has_gyro else []
    if motion.acceleration_m_s2 is not None:
        sigmas += 3 * [spec.push_sigma_m_s2]
    return np.array(sigmas)


def reckon(
    motion: ImuMotion,
    velocity_m_s: Floats,
    heading_rad: float,
    heading_sigma_rad: float,
    imu: Floats,
    spec: ErrorModel,
) -> Reckoned:
    """Carry position and velocity over a time.

    East and north are one complex number, east + i north: a turn by an angle clockwise is a factor exp(-i
    angle).
    Without a push the velocity turns as the camera does, driven by white acceleration; with one it changes by
    what is measured. Velocity, east, north, up, and the camera's heading, clockwise from north, which matters
    for a push only, are those at the start; `imu` has its estimated biases in their sigmas (0, 1 or 4,).
    """
    sigmas = imu_sigmas(motion, spec)
    bias = imu * sigmas
    s, weight = _nodes(motion.t_s)
    span = float(s[-1])
    angle = np.interp(s, motion.t_s, motion.turn_rad)
    if motion.has_gyro:
        angle = angle - bias[0] * s
    turned, way = np.exp(-1j * angle), _integral_of_turn(s, angle)
    pushed = None
    if motion.acceleration_m_s2 is None:
        ahead = complex(velocity_m_s[0], velocity_m_s[1])
        rest = way[-1] - way
        by_angle = -1j * ahead * np.stack([rest, np.full_like(rest, turned[-1])])
        kicked = np.stack([rest, np.full_like(rest, turned[-1])]) / turned
        white = spec.acceleration_m2_s3
        move_to = complex(way[-1]), complex(turned[-1])
        added = np.zeros(6)
    else:
        pushed = motion.acceleration_m_s2 - bias[-3:]
        level = np.interp(s, motion.t_s, pushed[:, 0]) + 1j * np.interp(s, motion.t_s, pushed[:, 1])
        facing = np.exp(-1j * heading_rad)
        speed = _running(s, facing * turned * level)
        place = _running(s, speed)
        by_angle = -1j * np.stack([place[-1] - place - speed * (span - s), speed[-1] - speed])
        kicked = np.stack([span - s, np.ones_like(s)]).astype(np.complex128)
        white = spec.push_white_m2_s3
        move_to = complex(span), complex(1.0)
        up = np.interp(s, motion.t_s, pushed[:, 2])
        climb = _running(s, up)
        high = _running(s, climb)
        there, then = place[-1], speed[-1]
        added = np.array([there.real, there.imag, high[-1], then.real, then.imag, climb[-1]])
    move = np.eye(6)
    move[:2, 3:5], move[3:5, 3:5] = _matrix(move_to[0]), _matrix(move_to[1])
    move[2, 5] = span
    noise = white * _white(kicked, weight)
    noise[np.ix_((2, 5), (2, 5))] = white * np.array([[span**3 / 3, span**2 / 2], [span**2 / 2, span]])
    flat = np.stack([by_angle[0].real, by_angle[0].imag, by_angle[1].real, by_angle[1].imag])
    level_rows = [0, 1, 3, 4]
    by_imu = np.zeros((6, len(sigmas)))
    if motion.has_gyro:
        drift = np.radians(spec.rate_white_deg_rts) ** 2
        noise[np.ix_(level_rows, level_rows)] += drift * (flat * weight) @ flat.T
        by_imu[level_rows, 0] = -(flat @ weight) * sigmas[0]
    if pushed is not None:
        facing = np.exp(-1j * heading_rad)
        along = (complex(facing * (way @ weight)), complex(facing * way[-1]))
        for row, c in zip((0, 3), along, strict=True):
            by_imu[row : row + 2, -3:-1] = -_matrix(c) * sigmas[-1]
        by_imu[2, -1], by_imu[5, -1] = -(span**2) / 2 * sigmas[-1], -span * sigmas[-1]
        askew = flat[:, 0] * heading_sigma_rad
        noise[np.ix_(level_rows, level_rows)] += np.outer(askew, askew)
    return Reckoned(move, added, noise, by_imu, float(angle[-1]))


def _nodes(t_s: Floats) -> tuple[Floats, Floats]:
    """Times with one midway between each two, and Simpson's weights of them."""
    step = np.diff(t_s)
    s = np.empty(2 * len(t_s) - 1)
    s[::2], s[1::2] = t_s, t_s[:-1] + step / 2
    weight = np.zeros(len(s))
    weight[1::2] = 4 * step / 6
    weight[:-1:2] += step / 6
    weight[2::2] += step / 6
    return s, weight


def _integral_of_turn(s: Floats, angle: Floats) -> Complex:
    """The integral of exp(-i angle) from the start to each time; the angle is a straight line between two."""
    half = np.diff(angle) / 2
    chord = np.diff(s) * np.sinc(half / np.pi) * np.exp(-1j * (angle[:-1] + half))
    return np.concatenate([np.zeros(1, np.complex128), np.cumsum(chord)])


def _running(s: Floats, values: NDArray[Any]) -> NDArray[Any]:
    """The integral from the start to each time, by the trapezoidal rule."""
    area = np.cumsum(np.diff(s) * (values[1:] + values[:-1]) / 2)
    return np.concatenate([np.zeros(1, values.dtype), area])


def _white(kicked: Complex, weight: Floats) -> Floats:
    """Covariance of east and north of place and speed by white kicks of power 1, in (6, 6)."""
    place, speed = kicked
    noise = np.zeros((6, 6))
    noise[:2, :2] = np.eye(2) * float(weight @ abs(place) ** 2)
    noise[3:5, 3:5] = np.eye(2) * float(weight @ abs(speed) ** 2)
    noise[:2, 3:5] = _matrix(complex(weight @ (place * speed.conj())))
    noise[3:5, :2] = noise[:2, 3:5].T
    return noise


def _matrix(c: complex) -> Floats:
    """What multiplies (east, north) as `c` does east + i north."""
    return np.array([[c.real, -c.imag], [c.imag, c.real]])


MotionSource = Callable[[float, float], ImuMotion | None]
"""How the camera turned from one time to a later one, us; None where that is not known."""

GNSS, IMU = "gnss", "imu"
"""Causes of standing errors: a receiver of satellites, whose errors have a memory of `ErrorModel.gnss_s`, and
the IMU's rates and accelerations."""

_SPEED_M_S = 30.0
"""Speeds that are likely at first (sigma): a car's."""

_MOST_MISSES = 10
"""Fixes in a row that are left out before the trajectory starts anew: so many are not outliers. Of a young
one, no more than it has taken: an outlier among its first fixes points it elsewhere."""

_MOTION = 6
_SLOW = slice(6, 9)
_FIXED = 9
"""Position, velocity, and what changes slowly; the standing causes follow."""

_KEPT_US = 10e6
"""Time out of sight after which a bar's errors are no state any more: most bars never come back."""

_COURSE_S = 0.3
"""Memory of the course of fixes: acceleration of 3 m/s2 takes it a quarter of a metre off."""

_FORESEEN = 3
"""Fixes from which on the course foresees the next one; before, it is the line through them and that one."""

_AGAIN = (4, 8, 16)
"""Fixes after which those since a course began are taken again, each where the course has it by then."""

_MOST_NOISE = 3.0
"""Sigmas of its noise that a fix may be off its course; what is more is not noise."""

_SWAYED = 1e-3
"""Share of a fix's noise, as variance, by which what one sigma of each error that stays does to it may change
with the noise: so much information each fix adds where there is none; a bar is seen for some hundred."""

_TURN_US = 1e6
"""Longest time between fixes over which the way turns as the camera did."""


@dataclass(frozen=True)
class Cause:
    """So many standing errors of one part, that are states of a trajectory.

    The name is as in `Fix.standing`: `camera`, `attitude`, `bar N`; the time is of the last fix that they
    entered.
    """

    name: str
    size: int
    t_us: float


@dataclass(frozen=True, eq=False)
class Course:
    """Where fixes of some bars go on to, errors that stay included: a line through the last `count` of them.

    Place and speed, east, north, up, float64 (3,), are those at the last of them.
    """

    place_m: Floats
    speed_m_s: Floats
    count: int
    transmitters: tuple[int, ...]


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
        heading_deg: Of the camera, as a fix or the IMU said last; when and how surely: `heading_t_us`,
            `heading_sigma_deg`.
        motion: How the camera turned from the point before to this one.
        misses: Fixes in a row that were left out, this one included; 0 where it counts.
        starts: A trajectory starts here.
        taken: Fixes that count since then, this one included, as far as that matters.
        fix: What was taken, or left out.
        course: How the fixes of the same bars go on, with little of their noise.
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
    misses: int = 0
    starts: bool = False
    taken: int = 1
    fix: Fix | None = None
    course: Course | None = None
    recent: tuple["TrajectoryPoint", ...] = ()

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


def trajectory_step(
    state: TrajectoryPoint | None, fix: Fix, spec: ErrorModel, imu: MotionSource | None = None
) -> TrajectoryPoint:
    """Take a fix: velocity that turns as the camera does, driven by white acceleration (Bar-Shalom, chapter
    6), or that changes as an accelerometer says.

    A fix beyond `spec.gate_sigmas`, one of GNSS that fails its test at `spec.false_alarm`, is left out, and
    after many of those in a row the trajectory starts anew. The fix is a given one, not before the last; the
    state, None at the start, is not changed. Where no IMU says how the camera turns, the fixes' headings do.
    """
    if state is None:
        return _first(fix)
    motion = imu(state.t_us, fix.t_us) if imu is not None and fix.t_us > state.t_us else None
    if motion is None:
        # As the camera's headings do, if they are known.
        turn = math.remainder(fix.heading_deg - state.heading_deg, 360.0)
        recent = fix.t_us - state.heading_t_us <= _TURN_US
        turn_rad = math.radians(turn) if recent and math.isfinite(turn) else 0.0
        motion = ImuMotion.from_uniform_turn((fix.t_us - state.t_us) * 1e-6, turn_rad)
    ahead, seen = _expected(_joined(_ahead(state, fix.t_us, motion, spec), fix), fix)
    innovation = fix.enu_m - seen @ ahead.mean
    spread = seen @ ahead.covariance @ seen.T + fix.noise_m2
    limit = chi_square(spec.false_alarm, 3) if fix.source == GNSS else spec.gate_sigmas**2
    if innovation @ np.linalg.solve(spread, innovation) > limit:
        if state.misses + 1 > min(_MOST_MISSES, state.taken):
            return _first(fix)
        return _caught_up(state, replace(_faced(ahead, fix), misses=state.misses + 1), spec)
    return _caught_up(state, _taken(ahead, fix, seen), spec)


def _caught_up(state: TrajectoryPoint, point: TrajectoryPoint, spec: ErrorModel) -> TrajectoryPoint:
    """A point after a state; when a course is young, and known better, its fixes are taken again."""
    course = point.course
    if course is None or course.count > _AGAIN[-1] or point.fix is None:
        return point
    before = replace(state, recent=())
    recent = (*state.recent, before) if course.count > 1 else (before,)
    if course is not state.course and course.count in _AGAIN and _swayed(point.fix):
        points = [*recent, point]
        *recent_again, point = _again(points, _smoothed(points, spec), spec)
        recent = tuple(recent_again)
    return replace(point, recent=recent if course.count < _AGAIN[-1] else ())


def _taken(ahead: TrajectoryPoint, fix: Fix, seen: Floats) -> TrajectoryPoint:
    """A point with a fix taken that depends on the states so, float64 (3, n)."""
    known = ahead.covariance @ seen.T
    spread = seen @ known + fix.noise_m2
    gain = np.linalg.solve(spread, known.T).T
    # Joseph's form keeps the covariance positive.
    change = gain @ known.T
    after = ahead.covariance - change - change.T + gain @ spread @ gain.T
    mean = ahead.mean + gain @ (fix.enu_m - seen @ ahead.mean)
    after = (after + after.T) / 2
    taken = min(ahead.taken + 1, _MOST_MISSES)
    return replace(_faced(ahead, fix), mean=mean, covariance=after, misses=0, taken=taken)


def filter_fixes(
    fixes: Iterable[Fix], spec: ErrorModel, imu: MotionSource | None = None
) -> list[TrajectoryPoint]:
    """Filter the fixes that are given, one point each; refused ones have none."""
    points: list[TrajectoryPoint] = []
    for fix in fixes:
        if not fix.refusal:
            points.append(trajectory_step(points[-1] if points else None, fix, spec, imu))
    return points


def smooth_trajectory(points: Sequence[TrajectoryPoint], spec: ErrorModel) -> list[TrajectoryPoint]:
    """Smooth filtered points with those after them (Rauch, Tung, Striebel 1965), each trajectory alone.

    Where noise of the fixes changes how errors that stay move them, they are filtered and smoothed once more,
    each as it is where the smoothed track has it: the iterated smoother (Bell, SIAM J. Optim. 4 (1994), 626).
    """
    smoothed = _smoothed(points, spec)
    if not any(point.fix is not None and _swayed(point.fix) for point in points):
        return smoothed
    return _smoothed(_again(points, smoothed, spec), spec)


def _again(
    points: Sequence[TrajectoryPoint], smoothed: Sequence[TrajectoryPoint], spec: ErrorModel
) -> list[TrajectoryPoint]:
    """Filter points again, each fix as it is where the smoothed track has it; the first one, where no
    trajectory starts, stays.
    """
    again = list(points)
    for i, (point, there) in enumerate(zip(points, smoothed, strict=True)):
        if point.fix is None:
            continue
        # What changes slowly is noise.
        still = np.where(np.arange(len(there.mean)) // 3 == _SLOW.start // 3, 0.0, there.mean)
        away = point.fix.enu_m - _seen(there.causes, point.fix) @ still
        if point.starts:
            again[i] = replace(_first(_moved(point.fix, away)), fix=point.fix)
        elif i:
            assert point.motion is not None
            ahead = _joined(_ahead(again[i - 1], point.t_us, point.motion, spec), point.fix)
            seen = _seen(ahead.causes, _moved(point.fix, away))
            taken = _faced(ahead, point.fix) if point.misses else _taken(ahead, point.fix, seen)
            again[i] = replace(taken, misses=point.misses, course=point.course, taken=point.taken)
    return again


def _smoothed(points: Sequence[TrajectoryPoint], spec: ErrorModel) -> list[TrajectoryPoint]:
    """One pass of the smoother."""
    smoothed = list(points)
    for i in range(len(points) - 2, -1, -1):
        if points[i + 1].starts:
            continue
        after, motion = smoothed[i + 1], points[i + 1].motion
        assert motion is not None
        here = _biased(points[i], after.t_us, motion, spec)
        ahead, move, noise, causes, _ = _motion(here, after.t_us, motion, spec)
        # Causes that came later are independent of this point: what is common has passed on.
        at = {cause.name: columns for cause, columns in _columns(after.causes)}
        common = [*range(_FIXED), *(i for c in causes for i in range(at[c.name].start, at[c.name].stop))]
        mean = ahead[: len(common)]
        spread = (move @ here.covariance @ move.T + noise)[: len(common), : len(common)]
        crossed = (move @ here.covariance)[: len(common)]
        gain = np.linalg.solve(spread, crossed).T
        there = after.covariance[np.ix_(common, common)]
        covariance = here.covariance + gain @ (there - spread) @ gain.T
        moved = here.mean + gain @ (after.mean[common] - mean)
        smoothed[i] = replace(here, mean=moved, covariance=(covariance + covariance.T) / 2)
    return smoothed


def heading_at(
    point: TrajectoryPoint, t_us: float, imu: MotionSource | None = None
) -> tuple[float, float] | None:
    """The camera's heading at a time not before a point, and its sigma, degrees; None if not known."""
    if not math.isfinite(point.heading_deg):
        return None
    motion = imu(point.heading_t_us, t_us) if imu is not None and t_us > point.heading_t_us else None
    if motion is not None:
        return point.heading_deg + math.degrees(float(motion.turn_rad[-1])), point.heading_sigma_deg
    recent = t_us - point.heading_t_us <= _TURN_US
    return (point.heading_deg, point.heading_sigma_deg) if recent else None


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
    first = TrajectoryPoint(fix.t_us, mean, covariance, causes, starts=True, course=_course(fix))
    return _faced(first, fix)


def _seen(causes: Sequence[Cause], fix: Fix) -> Floats:
    """How a fix depends on the states, float64 (3, n)."""
    seen = np.zeros((3, _FIXED + sum(cause.size for cause in causes)))
    seen[:, :3] = np.eye(3)
    seen[:, _SLOW] = symmetric_root(fix.slow_m2)
    for cause, at in _columns(causes):
        if cause.name in fix.standing:
            seen[:, at] = fix.standing[cause.name]
    return seen


def _expected(ahead: TrajectoryPoint, fix: Fix) -> tuple[TrajectoryPoint, Floats]:
    """How a fix depends on the states where the course of fixes has it, float64 (3, n), and that course.

    Not where it is: how errors that stay move it follows its noise there, and noise would seem to show them.
    Two or three bars of which each is surveyed to 5 cm so make a track twice too sure.
    """
    last = ahead.course
    if not fix.standing_slope:
        return ahead, _seen(ahead.causes, fix)
    if last is None or last.transmitters != fix.transmitters or ahead.motion is None:
        return replace(ahead, course=_course(fix)), _seen(ahead.causes, fix)
    dt = float(ahead.motion.t_s[-1])
    turn = complex(*last.speed_m_s[:2]) * np.exp(-1j * float(ahead.motion.turn_rad[-1]))
    speed = np.array([turn.real, turn.imag, last.speed_m_s[2]])
    place = last.place_m + speed * dt
    away, count, fade = fix.enu_m - place, last.count, math.exp(-dt / _COURSE_S)
    # Of the line through all of so many fixes, until older ones count less: Brookner, Tracking, 1998, 1.2.10.
    by_place = max(2 * (2 * count + 1) / ((count + 1) * (count + 2)), 1 - fade**2)
    by_speed = max(6 / ((count + 1) * (count + 2)), (1 - fade) ** 2)
    place, speed = place + by_place * away, speed + by_speed * away / max(dt, 1e-6)
    course = Course(place, speed, count + 1, fix.transmitters)
    if count < _FORESEEN:
        away = fix.enu_m - course.place_m
    sigmas = math.sqrt(float(away @ np.linalg.solve(fix.noise_m2 + fix.slow_m2, away)))
    away = away * min(1.0, _MOST_NOISE / max(sigmas, 1e-9))
    return replace(ahead, course=course), _seen(ahead.causes, _moved(fix, away))


def _course(fix: Fix) -> Course:
    """A course that begins."""
    return Course(fix.enu_m, np.zeros(3), 1, fix.transmitters)


def _moved(fix: Fix, away_m: Floats) -> Fix:
    """A fix with what errors that stay do to it where its noise is less by so much, float64 (3,)."""
    along_m, slopes = float(fix.weakest_axis @ away_m), fix.standing_slope
    moves = {n: m - along_m * slopes[n] if n in slopes else m for n, m in fix.standing.items()}
    return replace(fix, standing=moves)


def _swayed(fix: Fix) -> bool:
    """Whether its noise changes what errors that stay do to it by as much as matters in a hundred fixes."""
    noise = fix.noise_m2 + fix.slow_m2
    change = float(fix.weakest_axis @ noise @ fix.weakest_axis) * sum(
        [(s * s).sum() for s in fix.standing_slope.values()]
    )
    return bool(change > _SWAYED * np.trace(noise))


def _joined(point: TrajectoryPoint, fix: Fix) -> TrajectoryPoint:
    """A point with the fix's causes among its own."""
    causes = [replace(c, t_us=fix.t_us) if c.name in fix.standing else c for c in point.causes]
    known = {cause.name for cause in causes}
    new = [Cause(n, moves.shape[1], fix.t_us) for n, moves in fix.standing.items() if n not in known]
    return _widened(replace(point, causes=tuple(causes)), new)


def _biased(point: TrajectoryPoint, t_us: float, motion: ImuMotion, spec: ErrorModel) -> TrajectoryPoint:
    """A point with the biases of the IMU that lead to the next one, which nothing may have shown before."""
    biases = len(imu_sigmas(motion, spec))
    known = not biases or any(cause.name == IMU for cause in point.causes)
    return point if known else _widened(point, [Cause(IMU, biases, t_us)])


def _widened(point: TrajectoryPoint, new: Sequence[Cause]) -> TrajectoryPoint:
    """A point with further causes, of which nothing is known but their sigmas."""
    more, size = sum(cause.size for cause in new), len(point.mean)
    covariance = np.eye(size + more)
    covariance[:size, :size] = point.covariance
    mean = np.concatenate([point.mean, np.zeros(more)])
    return replace(point, mean=mean, covariance=covariance, causes=(*point.causes, *new))


def _ahead(point: TrajectoryPoint, t_us: float, motion: ImuMotion, spec: ErrorModel) -> TrajectoryPoint:
    point = _biased(point, t_us, motion, spec)
    mean, move, noise, causes, turn_rad = _motion(point, t_us, motion, spec)
    covariance = move @ point.covariance @ move.T + noise
    ahead = replace(
        point, t_us=t_us, mean=mean, covariance=covariance, causes=causes, motion=motion, starts=False
    )
    if not motion.has_gyro:
        return ahead
    drift_deg = spec.rate_white_deg_rts * math.sqrt(float(motion.t_s[-1]))
    return replace(
        ahead,
        heading_deg=point.heading_deg + math.degrees(turn_rad),
        heading_t_us=t_us,
        heading_sigma_deg=math.hypot(point.heading_sigma_deg, drift_deg),
    )


def _faced(point: TrajectoryPoint, fix: Fix) -> TrajectoryPoint:
    """A point at a fix, with its heading if it has one."""
    if not math.isfinite(fix.heading_deg):
        return replace(point, fix=fix)
    sigma_deg = fix.heading_sigma_deg if math.isfinite(fix.heading_sigma_deg) else 0.0
    return replace(
        point, heading_deg=fix.heading_deg, heading_t_us=fix.t_us, heading_sigma_deg=sigma_deg, fix=fix
    )


def _motion(
    point: TrajectoryPoint, t_us: float, motion: ImuMotion, spec: ErrorModel
) -> tuple[Floats, Floats, Floats, tuple[Cause, ...], float]:
    """A point at a later time, (m,), how it depends on it, (m, n), what is new, (m, m), causes, the turn."""
    dt = (t_us - point.t_us) * 1e-6
    # Of what passes by, most never comes back.
    late = [c for c in point.causes if t_us - c.t_us > _KEPT_US]
    passed = {c.name for c in late if c.name.startswith("bar ") or c.name == "doubt"}
    kept = [(c, at) for c, at in _columns(point.causes) if c.name not in passed]
    rows = [*range(_FIXED), *(i for _, at in kept for i in range(at.start, at.stop))]
    move = np.eye(len(point.mean))[rows]
    noise = np.zeros((len(rows), len(rows)))
    own = next((at for c, at in _columns(point.causes) if c.name == IMU), slice(0, 0))
    if motion.acceleration_m_s2 is not None and not math.isfinite(point.heading_deg):
        # Where a push points to is not known without a heading.
        motion = replace(motion, acceleration_m_s2=None)
    imu = point.mean[own][: len(imu_sigmas(motion, spec))]
    heading_rad, sigma_rad = math.radians(point.heading_deg), math.radians(point.heading_sigma_deg)
    way = reckon(motion, point.mean[3:_MOTION], heading_rad, sigma_rad, imu, spec)
    move[:_MOTION, :_MOTION] = way.move
    noise[:_MOTION, :_MOTION] = way.noise
    fade = math.exp(-dt / spec.slow_s)
    move[_SLOW] *= fade
    noise[_SLOW, _SLOW] = (1 - fade**2) * np.eye(3)
    causes = [cause for cause, _ in kept]
    for cause, at in _columns(causes):
        if cause.name == GNSS:
            fade = math.exp(-dt / spec.gnss_s)
            move[at] *= fade
            noise[at, at] = (1 - fade**2) * np.eye(cause.size)
    mean = move @ point.mean
    mean[:_MOTION] += way.added
    # The mean has them already, the move by them is what is left.
    move[:_MOTION, own.start : own.start + len(imu)] = way.by_imu
    return mean, move, noise, tuple(causes), way.turn_rad
