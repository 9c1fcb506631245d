"""The camera's position from the image points of bars at known places.

One bar needs the camera's attitude; two or more need gravity and give the heading, too; three or more that do
not stand in line give the full attitude. All are one weighted least-squares problem over the image points of
all clusters, with what is known of the attitude as further observations, and with every error that many
points share as a further unknown. What the geometry does not determine is refused, with the reason; a part
that the rest contradicts is left out, and named. Frames and signs: `docs/position.md`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np

from evlcp_sdk.place.error_model import EXACT, USUAL, ErrorModel, chi_square
from evlcp_sdk.place.fit import ODDS, Equations, likely_fits, misfits
from evlcp_sdk.place.fit_assessment import FOCAL, Pose, assess_fit, covering
from evlcp_sdk.place.observations import BarView, Candidate, Problem, Rejection, project_bars
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.values import FailedBar

_APART_SIGMAS = 6.0
"""Solutions nearer to each other, in sigmas of the position, are one."""

_HOPELESS = 0.02
"""Share of the largest test value below which a part explains nothing of a misfit."""

_FAR = 1e3
"""Test value above which that is so, whatever is not linear: beyond 30 sigmas."""

_CURVED = 0.25
"""Share by which test values of two parts differ where either may be at fault: they are those of small
faults, and an attitude that is off by some degrees moves an image along curves."""

_FREE_FOCAL = 0.02
"""Sigma of a focal length that is other than said, as a share: what is left to be known of it."""

_FOCALS = np.geomspace(1 / 4.0, 4.0, 47)
"""Focal lengths that are tried, as a share: steps of 6 %."""

_FAULT_STEPS = 4
"""Of Gauss and Newton; the image of a bar is nearly linear in where it stands."""

_FAULT_FREEDOM = 6
"""Of the test of a bar: three of its place, three of its attitude."""


def solve_pose(
    views: Sequence[BarView],
    camera: CameraModel,
    attitude: Attitude | None = None,
    spec: ErrorModel = USUAL,
    sigma: CameraSigma = EXACT,
) -> Pose | Rejection:
    """Fit position and attitude to all image points.

    Huber's loss over the miss of each point in its sigmas; Levenberg-Marquardt from closed-form starts: with
    the heading known, the point nearest to all lines of sight; with gravity known, the best of these over the
    headings; else the three-point solutions (Grunert) of the widest triangle of bars. Where the tests fail,
    each part is left out in turn: if one alone explains it, the fix is the one without it.

    Of the attitude the heading may be unknown, or all; the camera is known exactly without a `sigma`.

    Returns:
        The pose, or why the geometry does not determine one, or the parts contradict one another.
    """
    problem_of = partial(Problem.of, camera=camera, attitude=attitude, spec=spec, sigma=sigma)
    problem = problem_of(views)
    if isinstance(problem, Rejection):
        return problem
    mixed_up = partial(_mixed_up, views, problem_of)
    found = _plain(problem)
    if isinstance(found, Rejection):
        if found.kind != "not-determined":
            return found
    elif not found.warning:
        # Two bars on gravity do not show which is which.
        if problem.angles.known == 2 == len(found.transmitters) and math.isfinite(found.hpl_m + found.vpl_m):
            for _, behind in mixed_up():
                found = covering(found, behind, spec)
        return found
    warning, tests = (found.detail, {}) if isinstance(found, Rejection) else (found.warning, found.tests)
    fits, unsure = _fits_without_one(problem, sigma, tests)
    names = [name for name, _ in fits]
    if "heading" in names:
        fits = [fit for fit in fits if fit[0] != "attitude"]
    most = max((tests.get(name, 0.0) for name in names), default=0.0)
    rivals = [n for n in unsure if n in tests and most - tests[n] < max(ODDS, _CURVED * most)]
    if len(fits) == 1:
        name, pose = fits[0]
        if not rivals and tests:
            rivals = [name for name, _ in mixed_up()]
            if not rivals:
                failed = None
                if name.startswith("bar ") and name in tests:
                    bar = problem.transmitters.index(int(name[4:]))
                    failed = estimate_fault(problem, bar, pose, tests[name], len(tests))
                return replace(pose, excluded=(name,), failed=failed)
        names = [name]
    names += rivals
    if isinstance(found, Rejection) and not names:
        return found
    could = f"; it may be {' or '.join(names)}" if names else ""
    return Rejection("misfit", warning + could, suspects=tuple(names))


def _fits_without_one(
    problem: Problem, sigma: CameraSigma, tests: Mapping[str, float]
) -> tuple[list[tuple[str, Pose]], list[str]]:
    """Which part is left out of each fit that is fine, and the parts without which there is no position."""
    attitude = problem.attitude
    focal_mm = math.hypot(sigma.focal_mm, _FREE_FOCAL * problem.camera.focal_mm)
    parts: dict[str, Problem | Rejection] = {}
    if len(problem.transmitters) > 1:
        parts = {f"bar {number}": problem.without(i) for i, number in enumerate(problem.transmitters)}
        if attitude is not None and attitude.heading_deg is not None:
            parts["heading"] = problem.with_attitude(replace(attitude, heading_deg=None))
        if attitude is not None:
            parts["attitude"] = problem.with_attitude(None)
    parts[FOCAL] = problem.seen_by(replace(sigma, focal_mm=focal_mm, correlation=()))
    most = max(tests.values(), default=0.0)
    hopeless = {name for name in parts if tests.get(name, most) < _HOPELESS * most and most > _FAR}
    fits: list[tuple[str, Pose]] = []
    unsure = []
    # Where nothing fits without one, or several do, the tests may be of a fit that has gone astray.
    for names in (parts.keys() - hopeless, hopeless):
        if len(fits) == 1:
            break
        for name in (name for name in parts if name in names):
            other = parts[name]
            again = other if isinstance(other, Rejection) else _explained(other)
            if isinstance(again, Pose):
                fits.append((name, again))
            elif again is not None:
                # It may be this part; without it there is no position that would tell.
                unsure.append(name)
    return fits, unsure


def estimate_fault(problem: Problem, bar: int, pose: Pose, test: float, parts: int) -> FailedBar:
    """Where a bar stands by its image, seen from a pose that does without it.

    Weighted least squares over its points, which share the shift of its image, for its place; its attitude
    and length are taken as its site says. `bar` is its place among `problem.transmitters`, `test` its test
    value among those of so many `parts`.
    """
    from scipy.special import chndtr

    rows = problem.points[problem.bar == bar]
    weight = rows[:, 8, None, None] * problem.errors.even[bar]
    shift = (weight @ problem.errors.root[bar]).reshape(-1, 2)
    whole = np.linalg.inv(np.eye(2 * len(rows)) + shift @ shift.T)
    off_m = np.zeros(3)
    for _ in range(_FAULT_STEPS):
        points, slope = project_bars(rows[:, :3] + off_m, pose.enu_m, pose.rotation, problem.camera)
        by_pose = (weight @ slope).reshape(-1, 6)
        by_place = -by_pose[:, :3]
        missed = (weight @ (rows[:, 6:8] - points)[:, :, None]).ravel()
        follow = np.linalg.solve(by_place.T @ whole @ by_place, by_place.T @ whole)
        off_m = off_m + follow @ missed
    place_m = problem.errors.survey[bar, 0]
    by_camera = follow @ by_pose
    covariance = follow @ np.linalg.inv(whole) @ follow.T + by_camera @ pose.covariance @ by_camera.T
    covariance = covariance + place_m**2 * np.eye(3)
    limit = chi_square(problem.spec.false_alarm / 2 / parts, _FAULT_FREEDOM)
    missed = float(chndtr(limit, _FAULT_FREEDOM, test))
    return FailedBar(problem.transmitters[bar], off_m, covariance, missed)


def fitting_focal_mm(
    views: Sequence[BarView],
    camera: CameraModel,
    attitude: Attitude | None = None,
    spec: ErrorModel = USUAL,
    sigma: CameraSigma = EXACT,
) -> float:
    """The focal length with which views that contradict one another fit best, mm; NaN where with none.

    For what `solve_pose` refuses: it believes a focal length that is some percent off at the most, and one
    that was mistyped is another lens altogether.
    """

    def tried(focal_mm: float, free: float) -> Problem | Rejection:
        other = replace(camera, focal_mm=focal_mm)
        step_mm = float(np.hypot(sigma.focal_mm, free * focal_mm))
        return Problem.of(views, other, attitude, spec, replace(sigma, focal_mm=step_mm, correlation=()))

    around, least = math.nan, math.inf
    for share in _FOCALS.tolist():
        # Free within a step, so that none is stepped over, and as the best fit has it.
        problem = tried(share * camera.focal_mm, _FREE_FOCAL)
        fits = problem if isinstance(problem, Rejection) else likely_fits(problem)
        if isinstance(problem, Problem) and isinstance(fits, list) and fits[0].cost < least:
            off_px = float(problem.lens_root[0] @ fits[0].at.lens)
            around, least = problem.camera.focal_mm + off_px * camera.pitch_um / 1e3, fits[0].cost
    if math.isinf(least):
        return math.nan
    given = tried(around, _FREE_FOCAL / 5)
    found = given if isinstance(given, Rejection) else _plain(given)
    return around if isinstance(found, Pose) and not found.warning else math.nan


def _mixed_up(
    views: Sequence[BarView], problem_of: Callable[[Sequence[BarView]], Problem | Rejection]
) -> list[tuple[str, Pose]]:
    """Which two sites would explain all, too, if they stood at each other's place, and the pose by that.

    From behind, two bars are seen the other way round: without a third that is in the way, they would be
    believed to be where they are not.
    """
    found = []
    for i, j in combinations(range(len(views)), 2):
        one, two, mixed = views[i], views[j], list(views)
        mixed[i] = replace(one, enu_m=two.enu_m, survey=two.survey)
        mixed[j] = replace(two, enu_m=one.enu_m, survey=one.survey)
        swapped = problem_of(mixed)
        pose = _explained(swapped) if isinstance(swapped, Problem) else None
        if isinstance(pose, Pose):
            name = f"bar {one.transmitter} at the site of bar {two.transmitter} and the reverse"
            found.append((name, pose))
    return found


def _plain(problem: Problem) -> Pose | Rejection:
    """The pose by all that is given, whether it is to be believed or not."""
    fits = likely_fits(problem)
    if isinstance(fits, Rejection) or not misfits(fits[0]):
        return fits if isinstance(fits, Rejection) else _settled(fits)
    # What is off matters, not whether it is as much off from elsewhere, nor how surely it is there.
    found = assess_fit(fits[0])
    if isinstance(found, Pose):
        return found
    return Rejection("not-determined", "nothing explains what is seen")


def _explained(problem: Problem) -> Pose | Rejection | None:
    """The pose by all that is given; None where that does not fit together; a refusal: it may do."""
    fits = likely_fits(problem)
    if isinstance(fits, Rejection):
        return fits
    found = None if misfits(fits[0]) else _settled(fits)
    if isinstance(found, Pose):
        return None if found.warning else found
    return found


def _settled(fits: Sequence[Equations]) -> Pose | Rejection:
    """The likeliest of some fits, which is the first, assessed; refused where another one is as likely."""
    best = fits[0]
    found = assess_fit(best)
    if isinstance(found, Rejection) or len(fits) == 1:
        return found
    known, inverse = [best], np.linalg.pinv(found.covariance[:3, :3])
    for other in fits[1:]:
        away = [other.at.position - one.at.position for one in known]
        # By the covariance of the likeliest one.
        alone = all(m @ inverse @ m > _APART_SIGMAS**2 for m in away)
        if other.cost - best.cost < ODDS and alone:
            known.append(other)
    if len(known) == 1:
        return found
    candidates = []
    for fit in known:
        one, spread = assess_fit(fit), np.full((3, 3), math.nan)
        if isinstance(one, Pose):
            spread = one.covariance[:3, :3]
        likelihood = math.exp((best.cost - fit.cost) / 2)
        candidates.append(Candidate(fit.at.position, fit.at.rotation, spread, likelihood))
    apart_m = float(np.linalg.norm(known[1].at.position - best.at.position))
    detail = f"two positions {apart_m:.2f} m apart fit the image alike"
    return Rejection("two-solutions", detail, tuple(candidates))
