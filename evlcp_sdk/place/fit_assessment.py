"""Whether a fit can be trusted, and how far: covariance, tests of what may be wrong, protection levels.

As receivers of satellites do it (RAIM): for each part that may be at fault - a bar, the attitude, the focal
length - a test of whether the rest contradicts it, and how far the position may be off where it does not.
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
    inverted,
    linearize,
    misfits,
)
from evlcp_sdk.place.observations import Problem, Rejection, skewed
from evlcp_sdk.values import FailedBar

Floats = NDArray[np.float64]

FOCAL = "focal length"
"""What a fault of the camera is called."""

_MOST_BEND = 3.0
"""Ratio of the cost two sigmas away to its parabola's, beyond which an ellipse does not describe it."""

_BAR_TURN_RAD = math.radians(5.0)
"""How far a bar may be turned (sigma) where `position.bar_fault_m` says how far it may stand off."""

_RARELY = 0.05
"""How rarely errors of an attitude are larger than their sigmas say."""

_LARGER = 4.0
"""By how much they are then."""

_LITTLE = 0.01
"""Share of a position's variance below which an uncertain attitude does not count."""

_FLAT = 1e-9
"""Share of what a part says in its best direction below which it says nothing in another."""

_FAR_COST = 12.0
"""Growth of the cost two sigmas away, where 4 is expected, beyond which errors of sites are fitted anew."""

_ANYWHERE_M2 = 1e24
"""Variance of a position that a fault may move anywhere."""

_REDUNDANT = 1e-6
"""Share of what a part says that others must say, too, for it to be tested: a heading that is known to 0.1
degrees, 13 px, says so much of what the image of a bar says that is seen to .013 px. Less is rounding."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A camera's position and attitude; what is not said here is as in a `Fix`.

    Attributes:
        rotation: Camera axes (right, down, forward) as columns in ENU, float64 (3, 3).
        covariance: Of position, m, and of a small turn about east, north and up, radians, float64 (6, 6);
            0 where an angle was taken as exact.
        noise: The part of the position's that is new with every frame, float64 (3, 3).
        slow: The part that changes as the image moves over the pixels, float64 (3, 3).
        standing: The rest by its causes, as the position's move by one sigma of each, m, float64 (3, k): of
            `camera`, its seven parameters; of `attitude`, biases of pitch, roll and heading, and the offset
            in time; of `bar N`, its length, and its place and turn where these have a sigma; `doubt` whether
            the attitude errs more than its sigmas say.
        warning: Why it is not to be believed, in words; empty where all tests pass.
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
    along: Floats = field(default_factory=lambda: np.zeros(3))
    standing_slope: Mapping[str, Floats] = field(default_factory=dict)
    hidden_m: Floats = field(default_factory=lambda: np.full(3, math.inf))
    failed: FailedBar | None = None
    warning: str = ""
    tests: Mapping[str, float] = field(default_factory=dict)


def assess_fit(fit: Equations) -> Pose | Rejection:
    """The pose with its covariance and tests, or why there is none."""
    problem, spread = fit.problem, fit.spread
    spec, freedom = problem.spec, problem.freedom
    if spread is None:
        return Rejection("not-determined", "the equations are singular")
    if len(problem.transmitters) == 1:
        first, last = problem.points[0, :3] - fit.at.position, problem.points[-1, :3] - fit.at.position
        sine = float(np.linalg.norm(np.cross(last - first, first + last)))
        sine /= float(np.linalg.norm(last - first) * np.linalg.norm(first + last))
        if sine < math.sin(math.radians(spec.min_view_deg)):
            seen_deg = math.degrees(math.asin(sine))
            return Rejection("end-on", f"the bar is seen {seen_deg:.0f} degrees from its axis")
    size, axes = np.linalg.eigh(spread[:3, :3])
    wide = math.sqrt(max(size[-1], 0.0))
    if wide > spec.max_sigma_m:
        return Rejection("uncertain", f"by {wide:.1f} m, more than {spec.max_sigma_m:g} m")
    bent, slopes = _bend(fit, size, axes)
    amiss = misfits(fit)
    # A fit of what does not fit need not be at the least cost.
    if bent > _MOST_BEND and not amiss:
        return Rejection("uncertain", f"by {wide:.2f} m along a curve: an ellipse would mislead")
    (horizontal_m, vertical_m, hidden_m), tests, worst = _test_parts(fit, spread)
    warning = f"the points miss the sites by {math.sqrt(fit.cost / freedom):.1f} sigmas (rms)"
    moves = _moves_by_errors(fit, spread)
    noise, slow = _rest(fit, spread, moves)
    doubted = _doubted(fit, spread)
    standing = _named(problem, *moves)
    if doubted.any():
        standing = {"doubt": symmetric_root(doubted[:3, :3]), **standing}
    return Pose(
        fit.at.position,
        fit.at.rotation,
        spread[:6, :6] + doubted,
        noise,
        slow,
        standing,
        fit.cost / freedom,
        freedom,
        problem.transmitters,
        _level(horizontal_m, spec),
        _level(vertical_m, spec),
        along=axes[:, -1],
        standing_slope=_named(problem, *slopes),
        hidden_m=hidden_m,
        warning=worst or (warning if amiss else ""),
        tests=tests,
    )


Levels = tuple[float, float, Floats]
"""Protection levels, horizontal and vertical, m; what one fault may hide to the east, north and up, (3,)."""

Moves = tuple[Floats, Floats, Floats]
"""The position's moves by one sigma of what stays: of the camera (3, 7), of the attitude (3, 4), of what is
each bar's (bars, 3, 7)."""


def _moves_by_errors(fit: Equations, spread: Floats) -> Moves:
    place = spread[:3]
    by_attitude = place @ fit.angles.T @ fit.problem.angles.causes[: len(fit.angles)]
    return -place[:, LENS:], by_attitude, place @ fit.bars.gain[:, 2:].swapaxes(1, 2)


def _bend(fit: Equations, size: Floats, axes: Floats) -> tuple[float, Moves]:
    """How far the cost is from its parabola two sigmas away, and how the moves by errors change there.

    Returns:
        Along the least certain direction, the largest of the ratios, or of their inverses, of the true and
        the expected growth of the cost, and of one and the square of how far the way there, an arc about the
        bars, is from that axis, in sigmas; and the mean slopes of the moves, a metre.
    """
    problem, spread, wide = fit.problem, fit.spread, math.sqrt(max(size[-1], 0.0))
    assert spread is not None
    bent, slopes = 1.0, tuple(np.zeros_like(part) for part in _moves_by_errors(fit, spread))
    for way in (-2 / wide, 2 / wide):
        shared = way * spread[:, :3] @ axes[:, -1]
        there = fit.moved(shared)
        again = linearize(problem, there)
        if again is not None and again.cost - fit.cost > _FAR_COST:
            # Errors of sites take up what is left of second order.
            there = again.moved(np.zeros(SHARED))
            again = linearize(problem, there)
        determined = None if again is None else again.spread
        growth = 1e-9 if again is None or determined is None else max((again.cost - fit.cost) / 4, 1e-9)
        off = axes.T @ (there.position - fit.at.position - shared[:3])
        square = float((off**2 / np.maximum(size, 1e-15 * size[-1])).sum())
        bent = max(bent, growth, 1 / growth, 1 + square)
        if again is not None and determined is not None:
            share = math.copysign(1 / (4 * wide), way)
            for slope, moved in zip(slopes, _moves_by_errors(again, determined), strict=True):
                slope += share * moved
    return bent, (slopes[0], slopes[1], slopes[2])


def _widest(covariances: Floats) -> Floats:
    """Sigmas of the horizontal direction that is the least certain, of (n, 3, 3)."""
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    return np.sqrt(np.maximum((a + c) / 2 + np.hypot((a - c) / 2, b), 0.0))


class _Tested(NamedTuple):
    """A test of whether a part is at fault.

    Attributes:
        value: How much smaller the cost is without the part.
        freedom: Degrees of freedom; 0: it cannot be tested.
        added: What the fault adds to the position's covariance once it is free, float64 (3, 3).
        unseen: The covariance by which the position may have moved unnoticed, in units of the test value,
            float64 (3, 3).
    """

    value: float
    freedom: int
    added: Floats
    unseen: Floats


def _test_parts(fit: Equations, spread: Floats) -> tuple[Levels, dict[str, float], str]:
    """Protection levels, each part's test value, and the part that fits the rest the least, if any fails."""
    spec = fit.problem.spec
    tested = list(_tested_parts(fit, spread))
    chance = spec.false_alarm / 2 / len(tested)
    limits = {name: chi_square(chance, one.freedom) for name, one in tested if one.freedom}
    tests = {name: one.value for name, one in tested if one.freedom}
    worst = max(tests, key=lambda name: tests[name] / limits[name], default="")
    warning = ""
    if worst and tests[worst] > limits[worst]:
        warning = f"{worst} does not fit the rest: {math.sqrt(tests[worst]):.1f} sigmas"
    # Without a fault, and with one whose test just passes. A heading that is off is an attitude that is.
    nothing = np.zeros((3, 3))
    faults = [(name, one) for name, one in tested if name != "heading"]
    limit = np.array([0.0, *(limits.get(name, 0.0) for name, _ in faults)])
    added = np.array([nothing, *(one.added for _, one in faults)])
    unseen = np.array([nothing, *(one.unseen for _, one in faults)])
    hidden_m = np.sqrt(limit[:, None] * np.maximum(np.diagonal(unseen, axis1=1, axis2=2), 0.0))
    whole = spread[:3, :3] + added
    flat, high = (math.sqrt(chi_square(spec.risk, freedom)) for freedom in (2, 1))
    level_m = np.sqrt(limit) * _widest(unseen) + flat * _widest(whole)
    height_m = hidden_m[:, 2] + high * np.sqrt(np.maximum(whole[:, 2, 2], 0.0))
    return (level_m.max(), height_m.max(), hidden_m.max(0)), tests, warning


def _tested_parts(fit: Equations, spread: Floats) -> Iterator[tuple[str, _Tested]]:
    """Names and `_test` of each bar, the focal length, the attitude and the heading, as far as there are."""
    problem, spec, free = fit.problem, fit.problem.spec, fit.problem.free[:, None]
    info, right = fit.bars.info, fit.bars.right
    for bar, number in enumerate(problem.transmitters):
        bound = np.zeros((6, 6))
        if spec.bar_fault_m:
            # As a move and a turn of the camera that this bar alone sees.
            row = problem.points[int((problem.bar == bar).argmax())]
            half = np.diag(np.repeat([1 / spec.bar_fault_m, 1 / _BAR_TURN_RAD], 3))
            half[:3, 3:] = skewed((row[:3] - row[3:6] - fit.at.position)[None])[0].T / spec.bar_fault_m
            bound = half.T @ half
        own = info[bar, :6, :6], info[bar, :, :6] * free, right[bar, :6]
        yield f"bar {number}", _test(*own, spread, bound)
    focal = (FOCAL_UNIT / spec.focal_fault) ** 2 if spec.focal_fault else 0.0
    column, side = info.sum(0)[:, FAULT : FAULT + 1], right[:, FAULT].sum().reshape(1)
    yield FOCAL, _test(column[FAULT:][:1], column * free, side, spread, np.full((1, 1), focal))
    angles, miss = fit.angles, fit.angles_miss
    fault = np.zeros((len(angles), len(angles)))
    if spec.attitude_fault_deg and len(angles):
        white = math.radians(spec.attitude_fault_deg) * problem.angles.white[: len(angles), : len(angles)]
        fault[:] = np.linalg.inv(white @ white.T)
    for first, name in ((0, "attitude"), (2, "heading")):
        if len(angles) > first and problem.free[3:6].any():
            alone, columns = np.eye(len(angles) - first), angles[first:].T * free
            yield name, _test(alone, columns, miss[first:], spread, fault[first:, first:])


def _test(
    information: Floats, column: Floats, side: Floats, spread: Floats, bound: NDArray[np.floating]
) -> _Tested:
    """What a fault that shifts some observations would do: a mean-shift test, and the position without them.

    Args:
        information: Of the fault's parameters by these observations, float64 (m, m).
        column: The same between the unknowns and these parameters, float64 (14, m).
        side: Right-hand side of these parameters at the solution, float64 (m,).
        spread: Covariance of the unknowns, float64 (14, 14).
        bound: Inverse covariance of how large such a fault may be, float64 (m, m); 0: any size.
    """
    diagonal = np.diag(information)
    scale = np.where(diagonal > 0, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    values, axes = np.linalg.eigh(information * scale * scale[:, None])
    kept = values > _FLAT
    # In this basis the fault's own information is 1; what is left of it where the unknowns may follow.
    basis = scale[:, None] * axes[:, kept] / np.sqrt(values[kept])
    shared = column @ basis
    follow = spread @ shared
    left = np.eye(kept.sum()) - shared.T @ follow
    share, turn = np.linalg.eigh((left + left.T) / 2)
    turned, moved = basis @ turn, follow[:3] @ turn
    redundant = share > _REDUNDANT
    value = float(((turned.T @ side)[redundant] ** 2 / share[redundant]).sum())
    # What is not tested may be of any size, or of as much as the bound allows.
    share = np.where(redundant, share, 1e-12)
    if bound.any() and len(share):
        inverse = inverted(turned.T @ bound @ turned + np.diag(share))
        if inverse is None:
            return _Tested(0.0, 0, _ANYWHERE_M2 * np.eye(3), np.zeros((3, 3)))
        moves = moved @ inverse
    else:
        moves = moved / share
    return _Tested(value, int(redundant.sum()), moves @ moved.T, (moves * share) @ moves.T)


def _rest(fit: Equations, spread: Floats, moves: Moves) -> tuple[Floats, Floats]:
    """What the position's covariance is made of beside the errors that stay: noise and slow, (3, 3) each."""
    place = spread[:3]
    follow = (fit.bars.gain @ place.T)[fit.problem.bar]
    rows = (fit.rows[:, :, LOCAL:-1] @ place.T - fit.rows[:, :, :LOCAL] @ follow).reshape(-1, 3)
    slow = rows.T @ (rows * fit.stands[:, None])
    by_camera, by_attitude, by_bars = moves
    rest = place[:, :3] - slow - by_camera @ by_camera.T - by_attitude @ by_attitude.T
    rest = rest - (by_bars @ by_bars.swapaxes(1, 2)).sum(0)
    # What Huber's weights leave of the points' share may be less than nothing.
    size, axes = np.linalg.eigh(rest)
    return (axes * np.maximum(size, 1e-12)) @ axes.T, slow


def _doubted(fit: Equations, spread: Floats) -> Floats:
    """What the doubt adds to a covariance whether the attitude's errors are larger than their sigmas say.

    The mean over both hypotheses, by their odds after the fit: as said, or `_LARGER` times as large, which
    is so `_RARELY`. What is no likelier after the fit than before is in the sigmas already. Of position and
    turn, float64 (6, 6); 0 where it is too little to count.
    """
    rows, miss = fit.angles, fit.angles_miss
    nothing = np.zeros((6, 6))
    if not (len(miss) and fit.problem.free[3:6].any()):
        return nothing
    more = _LARGER**2 - 1
    follow = spread[:6] @ rows.T
    whole = np.eye(len(miss)) + more * (np.eye(len(miss)) - rows @ spread @ rows.T)
    inverse = inverted(whole)
    if inverse is None:
        return nothing
    off = more * inverse @ miss
    evidence = math.log(_RARELY / (1 - _RARELY)) + 0.5 * float(miss @ off - np.linalg.slogdet(whole)[1])
    weight, moved = 1 / (1 + math.exp(-min(evidence, 700.0))), follow @ off
    wider = follow @ (more * inverse) @ follow.T
    added = max(weight - _RARELY, 0.0) * wider + weight * np.outer(moved, moved)
    little = np.trace(added[:3, :3]) < _LITTLE * np.trace(spread[:3, :3])
    return nothing if little else np.asarray(added)


def covering(pose: Pose, other: Pose, spec: ErrorModel) -> Pose:
    """A pose with levels that reach to where the camera is by another solution, with that one's error."""
    east, north, up = np.abs(other.enu_m - pose.enu_m).tolist()
    wide = np.linalg.eigvalsh(other.covariance[:2, :2])[-1]
    hpl = math.hypot(east, north) + math.sqrt(chi_square(spec.risk, 2) * wide)
    vpl = up + math.sqrt(chi_square(spec.risk, 1) * other.covariance[2, 2])
    return replace(pose, hpl_m=_level(max(pose.hpl_m, hpl), spec), vpl_m=_level(max(pose.vpl_m, vpl), spec))


def _level(level_m: float, spec: ErrorModel) -> float:
    """A level as it is given: none above the highest."""
    return level_m if level_m <= spec.max_protection_m else math.inf


def _named(problem: Problem, camera: Floats, attitude: Floats, bars: Floats) -> dict[str, Floats]:
    """The position's moves by what stays, by name; or how they change."""
    standing = {}
    if problem.free[7]:
        standing["camera"] = camera
    if problem.attitude is not None and problem.free[3:6].any():
        standing["attitude"] = attitude
    for moves, survey, number in zip(bars, problem.errors.survey.tolist(), problem.transmitters, strict=True):
        if any(survey):
            # Its length, by which it also looks too long; place and turn where these have a sigma.
            standing[f"bar {number}"] = moves if any(survey[:2]) else moves[:, :1].copy()
    return standing
