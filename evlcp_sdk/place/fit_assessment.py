"""Assessment of a fit: its covariance, tests of what may be wrong, and protection levels.

As in GNSS receivers (RAIM): for each part that may be at fault - a bar, the attitude, the focal length - a
test of whether the rest contradicts it, and a bound of the position's error where it does not.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.error_model import ErrorModel, chi_square, symmetric_root
from evlcp_sdk.place.fit import (
    FAULT,
    FOCAL_UNIT,
    LENS,
    LOCAL,
    SHARED,
    Equations,
    invert_definite,
    is_misfit,
    linearize,
)
from evlcp_sdk.place.observations import Problem, Rejection, cross_matrices
from evlcp_sdk.values import FailedBar

Floats = NDArray[np.float64]

FOCAL = "focal length"
"""Name of a fault of the camera."""

_MAX_CURVATURE = 3.0
"""Ratio of the cost two sigmas away to its parabola's, beyond which an ellipse does not describe it."""

_BAR_TURN_RAD = math.radians(5.0)
"""Rotation of a bar (sigma) where `position.bar_fault_m` gives its displacement."""

_LARGE_CHANCE = 0.05
"""Prior probability that an attitude's errors are larger than its sigmas."""

_LARGE_FACTOR = 4.0
"""Their ratio then."""

_NEGLIGIBLE_SHARE = 0.01
"""Share of a position's variance below which this does not count."""

_EMPTY_SHARE = 1e-9
"""Share of a part's information in its best direction below which it has none in another."""

_FAR_COST = 12.0
"""Growth of the cost two sigmas away, where 4 is expected, beyond which errors of sites are fitted again."""

_ANYWHERE_M2 = 1e24
"""Variance of a position that a fault may move anywhere."""

_MIN_REDUNDANCY = 1e-6
"""Share of a part's information that others must have, too, for it to be tested: as much as a heading known
to 0.1 degrees, 13 px, has of that in a bar's image seen to .013 px. Less is rounding."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A camera's position and attitude; other attributes are as in a `Fix`.

    Attributes:
        rotation: Camera axes (right, down, forward) as columns in ENU, float64 (3, 3).
        covariance: Of position, m, and of a small rotation about east, north and up, radians, float64 (6, 6);
            0 where an angle was taken as exact.
        noise: The part of the position's that is new with every frame, float64 (3, 3).
        slow: The part that changes as the image moves over the pixels, float64 (3, 3).
        standing: The rest by its causes, as shifts of the position by one sigma of each, m, float64 (3, k):
            of `camera`, its seven parameters; of `attitude`, biases of pitch, roll and heading, and the
            offset in time; of `bar N`, its length, and its place and rotation where these have a sigma;
            `attitude-excess`, of an attitude whose errors may be larger than its sigmas.
        warning: Why it is not to be trusted; empty where all tests pass.
        tests: Of each part that could be tested: how much smaller the cost is without it.
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
    weakest_axis: Floats = field(default_factory=lambda: np.zeros(3))
    standing_slope: Mapping[str, Floats] = field(default_factory=dict)
    undetected_m: Floats = field(default_factory=lambda: np.full(3, math.inf))
    failed: FailedBar | None = None
    warning: str = ""
    tests: Mapping[str, float] = field(default_factory=dict)


def assess_fit(fit: Equations) -> Pose | Rejection:
    """Compute a fit's pose with covariance and tests, or why there is none."""
    problem, covariance = fit.problem, fit.covariance
    spec, freedom = problem.spec, problem.freedom
    if covariance is None:
        return Rejection("not-determined", "the equations are singular")
    if len(problem.transmitters) == 1:
        first, last = problem.points[0, :3] - fit.state.position, problem.points[-1, :3] - fit.state.position
        sine = float(np.linalg.norm(np.cross(last - first, first + last)))
        sine /= float(np.linalg.norm(last - first) * np.linalg.norm(first + last))
        if sine < math.sin(math.radians(spec.min_view_deg)):
            seen_deg = math.degrees(math.asin(sine))
            return Rejection("end-on", f"the bar is seen {seen_deg:.0f} degrees from its axis")
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    largest_sigma_m = math.sqrt(max(variances[-1], 0.0))
    if largest_sigma_m > spec.max_sigma_m:
        return Rejection("uncertain", f"by {largest_sigma_m:.1f} m, more than {spec.max_sigma_m:g} m")
    curvature, slopes = _measure_curvature(fit, variances, axes)
    has_misfit = is_misfit(fit)
    # A misfit need not be at the least cost.
    if curvature > _MAX_CURVATURE and not has_misfit:
        return Rejection("uncertain", f"by {largest_sigma_m:.2f} m along a curve: an ellipse would mislead")
    (horizontal_m, vertical_m, hidden_m), tests, worst = _test_parts(fit, covariance)
    warning = f"the points miss the sites by {math.sqrt(fit.cost / freedom):.1f} sigmas (rms)"
    moves = _standing_moves(fit, covariance)
    noise, slow = _split_noise(fit, covariance, moves)
    excess = _attitude_excess(fit, covariance)
    standing = _name_moves(problem, *moves)
    if excess.any():
        standing = {"attitude-excess": symmetric_root(excess[:3, :3]), **standing}
    return Pose(
        fit.state.position,
        fit.state.rotation,
        covariance[:6, :6] + excess,
        noise,
        slow,
        standing,
        fit.cost / freedom,
        freedom,
        problem.transmitters,
        _limit_level(horizontal_m, spec),
        _limit_level(vertical_m, spec),
        weakest_axis=axes[:, -1],
        standing_slope=_name_moves(problem, *slopes),
        undetected_m=hidden_m,
        warning=worst or (warning if has_misfit else ""),
        tests=tests,
    )


Levels = tuple[float, float, Floats]
"""Protection levels, horizontal and vertical, m, and the errors that one fault may hide in ENU, m, (3,)."""

Moves = tuple[Floats, Floats, Floats]
"""Shifts of the position by one sigma of each standing error: of the camera (3, 7), of the attitude (3, 4),
of each bar (bars, 3, 7).
"""


def _standing_moves(fit: Equations, covariance: Floats) -> Moves:
    place = covariance[:3]
    by_attitude = place @ fit.angles.T @ fit.problem.angles.causes[: len(fit.angles)]
    return -place[:, LENS:], by_attitude, place @ fit.bars.gain[:, 2:].swapaxes(1, 2)


def _measure_curvature(fit: Equations, variances: Floats, axes: Floats) -> tuple[float, Moves]:
    """Measure how far the cost is from its parabola two sigmas away in the least certain direction.

    Returns:
        The largest of the ratios, or of their inverses, of the true and the expected growth of the cost, and
        of one and the square of the distance in sigmas between that axis and the way there, an arc about the
        bars; and the mean slopes of the standing moves, a metre.
    """
    problem, covariance, largest_sigma_m = fit.problem, fit.covariance, math.sqrt(max(variances[-1], 0.0))
    assert covariance is not None
    curvature, slopes = 1.0, tuple(np.zeros_like(part) for part in _standing_moves(fit, covariance))
    for step in (-2 / largest_sigma_m, 2 / largest_sigma_m):
        shared = step * covariance[:, :3] @ axes[:, -1]
        state = fit.apply_step(shared)
        equations = linearize(problem, state)
        if equations is not None and equations.cost - fit.cost > _FAR_COST:
            # Errors of sites take up the second order.
            state = equations.apply_step(np.zeros(SHARED))
            equations = linearize(problem, state)
        growth = 1e-9
        if equations is not None and equations.covariance is not None:
            growth = max((equations.cost - fit.cost) / 4, growth)
            weight = math.copysign(1 / (4 * largest_sigma_m), step)
            for slope, moves in zip(slopes, _standing_moves(equations, equations.covariance), strict=True):
                slope += weight * moves
        offset = axes.T @ (state.position - fit.state.position - shared[:3])
        square = float((offset**2 / np.maximum(variances, 1e-15 * variances[-1])).sum())
        curvature = max(curvature, growth, 1 / growth, 1 + square)
    return curvature, (slopes[0], slopes[1], slopes[2])


def _horizontal_sigmas(covariances: Floats) -> Floats:
    """Sigmas in the least certain horizontal direction, of (n, 3, 3)."""
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    return np.sqrt(np.maximum((a + c) / 2 + np.hypot((a - c) / 2, b), 0.0))


class _FaultTest(NamedTuple):
    """A test of whether a part is at fault.

    Attributes:
        value: How much smaller the cost is without the part.
        freedom: Degrees of freedom; 0: it cannot be tested.
        added: What the fault adds to the position's covariance once it is free, float64 (3, 3).
        hidden: Covariance of the position's undetected shift, in units of the test value, float64 (3, 3).
    """

    value: float
    freedom: int
    added: Floats
    hidden: Floats


def _test_parts(fit: Equations, covariance: Floats) -> tuple[Levels, dict[str, float], str]:
    """Protection levels, each part's test value, and a warning of the part that fits the rest the least."""
    spec = fit.problem.spec
    fault_tests = list(_iterate_fault_tests(fit, covariance))
    chance = spec.false_alarm / 2 / len(fault_tests)
    limits = {name: chi_square(chance, test.freedom) for name, test in fault_tests if test.freedom}
    tests = {name: test.value for name, test in fault_tests if test.freedom}
    worst = max(tests, key=lambda name: tests[name] / limits[name], default="")
    warning = ""
    if worst and tests[worst] > limits[worst]:
        warning = f"{worst} does not fit the rest: {math.sqrt(tests[worst]):.1f} sigmas"
    # Without a fault, and with one whose test just passes. A fault of the heading is one of the attitude.
    no_fault = np.zeros((3, 3))
    faults = [(name, test) for name, test in fault_tests if name != "heading"]
    thresholds = np.array([0.0, *(limits.get(name, 0.0) for name, _ in faults)])
    added = np.array([no_fault, *(test.added for _, test in faults)])
    hidden = np.array([no_fault, *(test.hidden for _, test in faults)])
    hidden_m = np.sqrt(thresholds[:, None] * np.maximum(np.diagonal(hidden, axis1=1, axis2=2), 0.0))
    total = covariance[:3, :3] + added
    wide, high = (math.sqrt(chi_square(spec.risk, freedom)) for freedom in (2, 1))
    horizontal_m = np.sqrt(thresholds) * _horizontal_sigmas(hidden) + wide * _horizontal_sigmas(total)
    vertical_m = hidden_m[:, 2] + high * np.sqrt(np.maximum(total[:, 2, 2], 0.0))
    return (horizontal_m.max(), vertical_m.max(), hidden_m.max(0)), tests, warning


def _iterate_fault_tests(fit: Equations, covariance: Floats) -> Iterator[tuple[str, _FaultTest]]:
    """Names and tests of each bar, the focal length, the attitude and the heading, as far as there are."""
    problem, spec, free = fit.problem, fit.problem.spec, fit.problem.free[:, None]
    information, right_side = fit.bars.information, fit.bars.right_side
    for bar, number in enumerate(problem.transmitters):
        bound = np.zeros((6, 6))
        if spec.bar_fault_m:
            # As a shift and a rotation of the camera that this bar alone sees.
            row = problem.points[int((problem.bar == bar).argmax())]
            root = np.diag(np.repeat([1 / spec.bar_fault_m, 1 / _BAR_TURN_RAD], 3))
            centre = row[:3] - row[3:6] - fit.state.position
            root[:3, 3:] = cross_matrices(centre[None])[0].T / spec.bar_fault_m
            bound = root.T @ root
        own = information[bar, :6, :6], information[bar, :, :6] * free, right_side[bar, :6]
        yield f"bar {number}", _test_fault(*own, covariance, bound)
    focal = (FOCAL_UNIT / spec.focal_fault) ** 2 if spec.focal_fault else 0.0
    column, side = information.sum(0)[:, FAULT : FAULT + 1], right_side[:, FAULT].sum().reshape(1)
    yield FOCAL, _test_fault(column[FAULT:][:1], column * free, side, covariance, np.full((1, 1), focal))
    angles, residuals = fit.angles, fit.angle_residuals
    fault = np.zeros((len(angles), len(angles)))
    if spec.attitude_fault_deg and len(angles):
        white = math.radians(spec.attitude_fault_deg) * problem.angles.whitening[: len(angles), : len(angles)]
        fault[:] = np.linalg.inv(white @ white.T)
    for first, name in ((0, "attitude"), (2, "heading")):
        if len(angles) > first and problem.free[3:6].any():
            alone, columns = np.eye(len(angles) - first), angles[first:].T * free
            yield name, _test_fault(alone, columns, residuals[first:], covariance, fault[first:, first:])


def _test_fault(
    information: Floats, column: Floats, side: Floats, covariance: Floats, bound: NDArray[np.floating]
) -> _FaultTest:
    """Test a fault that shifts some observations (mean shift), and the position without them.

    Args:
        information: Of the fault's parameters by these observations, float64 (m, m).
        column: The same between the unknowns and these parameters, float64 (14, m).
        side: Right-hand side of these parameters at the solution, float64 (m,).
        covariance: Of the unknowns, float64 (14, 14).
        bound: Inverse covariance of the size of such a fault, float64 (m, m); 0: any size.
    """
    diagonal = np.diag(information)
    scale = np.where(diagonal > 0, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    values, axes = np.linalg.eigh(information * scale * scale[:, None])
    kept = values > _EMPTY_SHARE
    # In this basis the fault's information is 1; `left` is what remains where the unknowns may follow.
    basis = scale[:, None] * axes[:, kept] / np.sqrt(values[kept])
    shared = column @ basis
    follow = covariance @ shared
    left = np.eye(kept.sum()) - shared.T @ follow
    share, axes_left = np.linalg.eigh((left + left.T) / 2)
    rotated, shifts = basis @ axes_left, follow[:3] @ axes_left
    redundant = share > _MIN_REDUNDANCY
    value = float(((rotated.T @ side)[redundant] ** 2 / share[redundant]).sum())
    # An untested fault may be of any size, or as large as the bound allows.
    share = np.where(redundant, share, 1e-12)
    if bound.any() and len(share):
        inverse = invert_definite(rotated.T @ bound @ rotated + np.diag(share))
        if inverse is None:
            return _FaultTest(0.0, 0, _ANYWHERE_M2 * np.eye(3), np.zeros((3, 3)))
        moves = shifts @ inverse
    else:
        moves = shifts / share
    return _FaultTest(value, int(redundant.sum()), moves @ shifts.T, (moves * share) @ moves.T)


def _split_noise(fit: Equations, covariance: Floats, moves: Moves) -> tuple[Floats, Floats]:
    """Split the position's covariance without standing errors into noise and slow, (3, 3) each."""
    place = covariance[:3]
    follow = (fit.bars.gain @ place.T)[fit.problem.bar]
    rows = (fit.rows[:, :, LOCAL:-1] @ place.T - fit.rows[:, :, :LOCAL] @ follow).reshape(-1, 3)
    slow = rows.T @ (rows * fit.standing_share[:, None])
    by_camera, by_attitude, by_bars = moves
    rest = place[:, :3] - slow - by_camera @ by_camera.T - by_attitude @ by_attitude.T
    rest = rest - (by_bars @ by_bars.swapaxes(1, 2)).sum(0)
    # With Huber's weights, the points' share may be larger than all.
    variances, axes = np.linalg.eigh(rest)
    return (axes * np.maximum(variances, 1e-12)) @ axes.T, slow


def _attitude_excess(fit: Equations, covariance: Floats) -> Floats:
    """Covariance to add for attitude errors larger than their sigmas: of position and rotation, (6, 6).

    The mean over two hypotheses, by their odds after the fit: errors as stated, or `_LARGE_FACTOR` times as
    large with the prior `_LARGE_CHANCE`. As far as that is no likelier after the fit, the sigmas hold it
    already. 0 if negligible.
    """
    rows, residuals = fit.angles, fit.angle_residuals
    no_excess = np.zeros((6, 6))
    if not (len(residuals) and fit.problem.free[3:6].any()):
        return no_excess
    factor = _LARGE_FACTOR**2 - 1
    follow = covariance[:6] @ rows.T
    expected = np.eye(len(residuals)) + factor * (np.eye(len(residuals)) - rows @ covariance @ rows.T)
    inverse = invert_definite(expected)
    if inverse is None:
        return no_excess
    weighted = factor * inverse @ residuals
    likelihood = 0.5 * float(residuals @ weighted - np.linalg.slogdet(expected)[1])
    log_odds = math.log(_LARGE_CHANCE / (1 - _LARGE_CHANCE)) + likelihood
    weight, shift = 1 / (1 + math.exp(-min(log_odds, 700.0))), follow @ weighted
    excess = follow @ (factor * inverse) @ follow.T
    added = max(weight - _LARGE_CHANCE, 0.0) * excess + weight * np.outer(shift, shift)
    is_negligible = np.trace(added[:3, :3]) < _NEGLIGIBLE_SHARE * np.trace(covariance[:3, :3])
    return no_excess if is_negligible else np.asarray(added)


def widen_levels(pose: Pose, other: Pose, spec: ErrorModel) -> Pose:
    """Widen a pose's levels so that they reach to another solution, with that one's error."""
    east, north, up = np.abs(other.enu_m - pose.enu_m).tolist()
    variance_m2 = np.linalg.eigvalsh(other.covariance[:2, :2])[-1]
    hpl_m = math.hypot(east, north) + math.sqrt(chi_square(spec.risk, 2) * variance_m2)
    vpl_m = up + math.sqrt(chi_square(spec.risk, 1) * other.covariance[2, 2])
    hpl_m, vpl_m = _limit_level(max(pose.hpl_m, hpl_m), spec), _limit_level(max(pose.vpl_m, vpl_m), spec)
    return replace(pose, hpl_m=hpl_m, vpl_m=vpl_m)


def _limit_level(level_m: float, spec: ErrorModel) -> float:
    return level_m if level_m <= spec.max_protection_m else math.inf


def _name_moves(problem: Problem, camera: Floats, attitude: Floats, bars: Floats) -> dict[str, Floats]:
    standing = {}
    if problem.free[7]:
        standing["camera"] = camera
    if problem.attitude is not None and problem.free[3:6].any():
        standing["attitude"] = attitude
    bar_sigmas = problem.errors.bar_sigmas.tolist()
    for moves, sigmas, number in zip(bars, bar_sigmas, problem.transmitters, strict=True):
        if any(sigmas):
            # Length, true and apparent; place and rotation where these have a sigma.
            standing[f"bar {number}"] = moves if any(sigmas[:2]) else moves[:, :1].copy()
    return standing
