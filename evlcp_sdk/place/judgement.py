"""Whether a fit can be trusted, and how far: covariance, tests of what may be wrong, protection levels.

As receivers of satellites do it (RAIM): for each part that may be at fault - a bar, the attitude, the focal
length - a test of whether the rest contradicts it, and how far the position may be off where it does not.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.late import Late
from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.place.chances import chi_square
from evlcp_sdk.place.fit import FOCAL_UNIT, Fit, data
from evlcp_sdk.place.observations import Problem
from evlcp_sdk.place.refusals import Refusal
from evlcp_sdk.values import FailedBar

if TYPE_CHECKING:
    from evlcp_sdk.place import _kernels
else:
    _kernels = Late("evlcp_sdk.place._kernels")

__all__ = ["FOCAL", "Judged", "Pose", "covering", "judged", "misfits"]

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
"""Share of a position's variance below which a doubt does not count."""

_REDUNDANT = 1e-6
"""Share of what a part says that others must say, too, for it to be tested: a heading that is known to 0.1
degrees, 13 px, says so much of what the image of a bar says that is seen to .013 px. Less is rounding."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A camera's position and attitude.

    Attributes:
        enu_m: Position in the local axes, m, float64 (3,).
        rotation: Camera axes (right, down, forward) as columns in ENU, float64 (3, 3).
        covariance: Of position, m, and of a small turn about east, north and up, radians, float64 (6, 6);
            0 where an angle was taken as exact.
        noise: The part of the position's that is new with every frame, float64 (3, 3).
        slow: The part that changes as the image moves over the pixels, float64 (3, 3).
        standing: The rest by its causes, as the position's move by one sigma of each, m, float64 (3, k): of
            `camera`, its seven parameters; of `attitude`, biases of pitch, roll and heading, and the offset
            in time; of `bar N`, its length, and its place and turn where these have a sigma; `doubt` whether
            the attitude errs more than its sigmas say.
        misfit: Mean square of the misses in sigmas, over the degrees of freedom.
        freedom: Degrees of freedom.
        transmitters: The bars that count.
        hpl_m: Horizontal protection level, m; infinite where the geometry protects from no fault.
        vpl_m: The vertical one, m.
        excluded: What was left out as the rest contradicts it: `bar N`, `heading`, `attitude`, `focal
            length`.
        along: The direction in which the position is the least certain, a unit vector, float64 (3,).
        standing_slope: How the moves of `standing`, but for `doubt`, change with the position along it, a
            metre, float64 (3, k).
        hidden_m: By how much one part that is wrong, and whose test just passed, moves the position at the
            most: east, north, up, m, float64 (3,).
        failed: The bar that was left out; None where none was.
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


@dataclass(frozen=True, eq=False)
class Judged:
    """A pose with what its tests say.

    Attributes:
        pose: The pose.
        doubt: Why it is not to be believed, in words; empty where all tests pass.
        tests: Of each part that could be tested: how much smaller the cost is without it.
    """

    pose: Pose
    doubt: str
    tests: Mapping[str, float]


def judged(problem: Problem, fit: Fit) -> Judged | Refusal:
    """The pose with its covariance and tests, or why it cannot be trusted."""
    spec = problem.spec
    turns = bool(problem.free[3:6].any())
    names = _parts(problem.transmitters, problem.angles if turns else 0)
    limits = _limits(spec.false_alarm / 2 / len(names))
    found: tuple[Any, ...] = _kernels.weighed(  # type: ignore[call-arg]
        *data(problem),
        problem.free,
        problem.said,
        fit.position,
        fit.rotation,
        fit.local,
        fit.lens,
        fit.cost,
        math.radians(spec.attitude_fault_deg),
        (FOCAL_UNIT / spec.focal_fault) ** 2 if spec.focal_fault else 0.0,
        spec.bar_fault_m,
        _BAR_TURN_RAD,
        limits,
        _REDUNDANT,
        spec.max_sigma_m,
        math.sqrt(chi_square(spec.risk, 2)),
        math.sqrt(chi_square(spec.risk, 1)),
        _RARELY,
        _LARGER,
        _LITTLE,
    )
    regular, wide, bent, spread, values, freed, hpl, vpl, doubted, noise, slow, *rest = found
    moves, along, slopes, hidden = rest[:3], rest[3], rest[4:7], rest[7]
    if not regular:
        return Refusal("not-determined", "the equations are singular")
    if len(problem.transmitters) == 1:
        first, last = problem.points[0, :3] - fit.position, problem.points[-1, :3] - fit.position
        axis, sight = last - first, first + last
        cosine = float(axis @ sight) / math.sqrt(float(axis @ axis) * float(sight @ sight))
        sine = math.sqrt(max(1 - cosine**2, 0.0))
        if sine < math.sin(math.radians(spec.min_view_deg)):
            return Refusal(
                "end-on", f"the bar is seen {math.degrees(math.asin(sine)):.0f} degrees from its axis"
            )
    if wide > spec.max_sigma_m:
        return Refusal("uncertain", f"by {wide:.1f} m, more than {spec.max_sigma_m:g} m")
    amiss = misfits(problem, fit)
    # A fit of what does not fit need not be at the least cost.
    if bent > _MOST_BEND and not amiss:
        return Refusal("uncertain", f"by {wide:.2f} m along a curve: an ellipse would mislead")
    freedom = problem.freedom
    doubt, tests = "", {}
    worst = 1.0
    if amiss:
        doubt = f"the points miss the sites by {math.sqrt(fit.cost / freedom):.1f} sigmas (rms)"
    for name, value, tested in zip(names, values.tolist(), freed.tolist(), strict=True):
        if tested:
            tests[name] = value
            if value / limits[tested] > worst:
                worst = value / limits[tested]
                doubt = f"{name} does not fit the rest: {math.sqrt(value):.1f} sigmas"
    pose = Pose(
        fit.position,
        fit.rotation,
        spread[:6, :6] + doubted,
        noise,
        slow,
        {**_doubt(doubted[:3, :3]), **_standing(problem, *moves)},
        fit.cost / freedom,
        freedom,
        problem.transmitters,
        _level(hpl, spec),
        _level(vpl, spec),
        along=along,
        standing_slope=_standing(problem, *slopes),
        hidden_m=hidden,
    )
    return Judged(pose, doubt, tests)


def covering(pose: Pose, other: Pose, spec: PositionSpec) -> Pose:
    """A pose with levels that reach to where the camera is by another solution, with that one's error."""
    east, north, up = np.abs(other.enu_m - pose.enu_m).tolist()
    wide = np.linalg.eigvalsh(other.covariance[:2, :2])[-1]
    hpl = math.hypot(east, north) + math.sqrt(chi_square(spec.risk, 2) * wide)
    vpl = up + math.sqrt(chi_square(spec.risk, 1) * other.covariance[2, 2])
    return replace(pose, hpl_m=_level(max(pose.hpl_m, hpl), spec), vpl_m=_level(max(pose.vpl_m, vpl), spec))


def _level(level_m: float, spec: PositionSpec) -> float:
    """A level as it is given: none above the highest."""
    return level_m if level_m <= spec.max_protection_m else math.inf


def misfits(problem: Problem, fit: Fit) -> bool:
    """Whether the sum of the squared misses is more than chance makes it."""
    return fit.cost > chi_square(problem.spec.false_alarm / 2, problem.freedom)


@lru_cache(maxsize=256)
def _parts(transmitters: tuple[int, ...], angles: int) -> tuple[str, ...]:
    """What may be at fault, in the order of `_kernels.weighed`; `angles` that are known, and free."""
    names = *(f"bar {number}" for number in transmitters), FOCAL
    return (*names, *("attitude", "heading")[: angles - 1]) if angles else names


@lru_cache(maxsize=256)
def _limits(chance: float) -> Floats:
    """What a test exceeds by this chance, by its degrees of freedom, float64 (7,)."""
    return np.array([0.0, *(chi_square(chance, freedom) for freedom in range(1, 7))])


def _doubt(doubted: Floats) -> dict[str, Floats]:
    """The position's moves by the doubt, by its name; none where there is none."""
    if not doubted.any():
        return {}
    values, axes = np.empty(3), np.empty((3, 3))
    _kernels.eigen(doubted.copy(), values, axes)
    # The symmetric root changes little from fix to fix.
    return {"doubt": (axes * np.sqrt(np.maximum(values, 0))) @ axes.T}


def _standing(problem: Problem, camera: Floats, attitude: Floats, bars: Floats) -> dict[str, Floats]:
    """The position's moves by what stays, by name; or how they change."""
    standing = {}
    if problem.free[7]:
        standing["camera"] = camera
    if problem.attitude is not None and problem.free[3:6].any():
        standing["attitude"] = attitude
    for moves, sigma, number in zip(bars, problem.bar_sigma.tolist(), problem.transmitters, strict=True):
        survey = sigma[:3]
        if any(survey):
            # Its length, by which it also looks too long; place and turn where these have a sigma.
            standing[f"bar {number}"] = moves if any(survey[:2]) else moves[:, :1].copy()
    return standing
