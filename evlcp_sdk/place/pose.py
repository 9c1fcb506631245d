"""The camera's position from the image points of bars at known places.

One bar needs the camera's attitude; two or more need gravity and give the heading, too; three or more that
are not in line give the full attitude. All are one weighted least-squares problem over the image points of
all clusters, with the known angles as further observations, and every error that many points share as a
further unknown. What the geometry does not determine is refused, with the reason; a part that the rest
contradicts is left out, and named. Frames and signs: `docs/position.md`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np

from evlcp_sdk.place.error_model import DEFAULT_ERRORS, EXACT_CAMERA, ErrorModel, chi_square
from evlcp_sdk.place.fit import DISTINCT_COST, Equations, fit_from_all_starts, is_misfit
from evlcp_sdk.place.fit_assessment import FOCAL, Pose, assess_fit, widen_levels
from evlcp_sdk.place.observations import BarView, Candidate, Problem, Rejection, project_bars
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.values import FailedBar

_DISTINCT_SIGMAS = 6.0
"""Solutions nearer to each other, in sigmas of the position, are one."""

_HOPELESS_SHARE = 0.02
"""Share of the largest test value below which a part does not explain a misfit."""

_LARGE_TEST = 1e3
"""Largest test value above which that holds in spite of nonlinearity: beyond 30 sigmas."""

_RIVAL_SHARE = 0.25
"""Share by which test values of two parts differ where either may be at fault: they hold for small faults,
and an attitude wrong by some degrees moves an image along curves."""

_FOCAL_SIGMA_SHARE = 0.02
"""Sigma of an unknown focal length, as a share."""

_FOCAL_SHARES = np.geomspace(1 / 4.0, 4.0, 47)
"""Focal lengths that are tried, as a share: steps of 6 %."""

_FAULT_STEPS = 4
"""Gauss-Newton steps; the image of a bar is nearly linear in its place."""

_FAULT_FREEDOM = 6
"""Degrees of freedom of the test of a bar: three of its place, three of its attitude."""


def solve_pose(
    views: Sequence[BarView],
    camera: CameraModel,
    attitude: Attitude | None = None,
    spec: ErrorModel = DEFAULT_ERRORS,
    sigma: CameraSigma = EXACT_CAMERA,
) -> Pose | Rejection:
    """Fit position and attitude to all image points.

    Huber's loss over the residual of each point in its sigmas; Levenberg-Marquardt from closed-form starts:
    with the heading known, the point nearest to all lines of sight; with gravity known, the best of these
    over the headings; else the three-point solutions (Grunert) of the widest triangle of bars. Where the
    tests fail, each part is left out in turn: if one alone explains it, the fix is the one without it.

    The attitude may be unknown, or its heading; with the default `sigma` the camera is known exactly.

    Returns:
        The pose, or why the geometry does not determine one, or the parts contradict one another.
    """
    problem_of = partial(Problem.of, camera=camera, attitude=attitude, spec=spec, sigma=sigma)
    problem = problem_of(views)
    if isinstance(problem, Rejection):
        return problem
    find_exchanged = partial(_find_exchanged_sites, views, problem_of)
    pose = _fit_and_assess(problem)
    if isinstance(pose, Rejection):
        if pose.kind != "not-determined":
            return pose
    elif not pose.warning:
        # Two bars on gravity may be exchanged.
        if problem.angles.known == 2 == len(pose.transmitters) and math.isfinite(pose.hpl_m + pose.vpl_m):
            for _, exchanged in find_exchanged():
                pose = widen_levels(pose, exchanged, spec)
        return pose
    warning, tests = (pose.detail, {}) if isinstance(pose, Rejection) else (pose.warning, pose.tests)
    fits, open_parts = _fit_without_each_part(problem, sigma, tests)
    names = [name for name, _ in fits]
    if "heading" in names:
        fits = [fit for fit in fits if fit[0] != "attitude"]
    largest = max((tests.get(name, 0.0) for name in names), default=0.0)
    margin = max(DISTINCT_COST, _RIVAL_SHARE * largest)
    rivals = [name for name in open_parts if name in tests and largest - tests[name] < margin]
    if len(fits) == 1:
        name, pose_without = fits[0]
        if not rivals and tests:
            rivals = [name for name, _ in find_exchanged()]
            if not rivals:
                failed = None
                if name.startswith("bar ") and name in tests:
                    bar = problem.transmitters.index(int(name[4:]))
                    failed = estimate_fault(problem, bar, pose_without, tests[name], len(tests))
                return replace(pose_without, excluded=(name,), failed=failed)
        names = [name]
    names += rivals
    if isinstance(pose, Rejection) and not names:
        return pose
    suspects = f"; it may be {' or '.join(names)}" if names else ""
    return Rejection("misfit", warning + suspects, suspects=tuple(names))


def _fit_without_each_part(
    problem: Problem, sigma: CameraSigma, tests: Mapping[str, float]
) -> tuple[list[tuple[str, Pose]], list[str]]:
    """Fit without each part: the parts and poses of consistent fits, and the parts without which none is
    known.
    """
    attitude = problem.attitude
    focal_mm = math.hypot(sigma.focal_mm, _FOCAL_SIGMA_SHARE * problem.camera.focal_mm)
    parts: dict[str, Problem | Rejection] = {}
    if len(problem.transmitters) > 1:
        parts = {f"bar {number}": problem.without_bar(i) for i, number in enumerate(problem.transmitters)}
        if attitude is not None and attitude.heading_deg is not None:
            parts["heading"] = problem.with_attitude(replace(attitude, heading_deg=None))
        if attitude is not None:
            parts["attitude"] = problem.with_attitude(None)
    sigma = replace(sigma, focal_mm=focal_mm, correlation=())
    parts[FOCAL] = replace(problem, lens_root=sigma.covariance_root(problem.camera))
    largest = max(tests.values(), default=0.0)
    least = _HOPELESS_SHARE * largest if largest > _LARGE_TEST else -math.inf
    hopeless = {name for name in parts if tests.get(name, largest) < least}
    fits: list[tuple[str, Pose]] = []
    open_parts = []
    # If no fit without a likely part is consistent, or several are, the tests may be of a wrong minimum.
    for names in (parts.keys() - hopeless, hopeless):
        if len(fits) == 1:
            break
        for name in (name for name in parts if name in names):
            other = parts[name]
            pose = other if isinstance(other, Rejection) else _fit_if_consistent(other)
            if isinstance(pose, Pose):
                fits.append((name, pose))
            elif pose is not None:
                # It may be this part, but without it no position can be computed.
                open_parts.append(name)
    return fits, open_parts


def estimate_fault(problem: Problem, bar: int, pose: Pose, test: float, parts: int) -> FailedBar:
    """Estimate where a bar stands by its image, seen from a pose computed without it.

    Weighted least squares over its points, which share the shift of its image, for its place; attitude and
    length are its site's. `bar` is its index in `problem.transmitters`, `test` its test value among those of
    `parts` parts.
    """
    from scipy.special import chndtr

    rows = problem.points[problem.bar == bar]
    weight = rows[:, 8, None, None] * problem.errors.whitening[bar]
    shift = (weight @ problem.errors.root[bar]).reshape(-1, 2)
    weights = np.linalg.inv(np.eye(2 * len(rows)) + shift @ shift.T)
    off_m = np.zeros(3)
    for _ in range(_FAULT_STEPS):
        points, slope = project_bars(rows[:, :3] + off_m, pose.enu_m, pose.rotation, problem.camera)
        by_pose = (weight @ slope).reshape(-1, 6)
        by_place = -by_pose[:, :3]
        residuals = (weight @ (rows[:, 6:8] - points)[:, :, None]).ravel()
        gain = np.linalg.solve(by_place.T @ weights @ by_place, by_place.T @ weights)
        off_m = off_m + gain @ residuals
    site_sigma_m = problem.errors.bar_sigmas[bar, 0]
    by_camera = gain @ by_pose
    covariance = gain @ np.linalg.inv(weights) @ gain.T + by_camera @ pose.covariance @ by_camera.T
    covariance = covariance + site_sigma_m**2 * np.eye(3)
    limit = chi_square(problem.spec.false_alarm / 2 / parts, _FAULT_FREEDOM)
    missed = float(chndtr(limit, _FAULT_FREEDOM, test))
    return FailedBar(problem.transmitters[bar], off_m, covariance, missed)


def search_focal_mm(
    views: Sequence[BarView],
    camera: CameraModel,
    attitude: Attitude | None = None,
    spec: ErrorModel = DEFAULT_ERRORS,
    sigma: CameraSigma = EXACT_CAMERA,
) -> float:
    """The focal length with which contradictory views fit best, mm; NaN if none does.

    For what `solve_pose` refuses: it finds faults of the focal length of some percent at most, and a mistyped
    one is another lens altogether.
    """

    def problem_with(focal_mm: float, share: float) -> Problem | Rejection:
        sigma_mm = float(np.hypot(sigma.focal_mm, share * focal_mm))
        free = replace(sigma, focal_mm=sigma_mm, correlation=())
        return Problem.of(views, replace(camera, focal_mm=focal_mm), attitude, spec, free)

    best_mm, least = math.nan, math.inf
    for share in _FOCAL_SHARES.tolist():
        # Free within a step, so that no minimum is missed.
        problem = problem_with(share * camera.focal_mm, _FOCAL_SIGMA_SHARE)
        fits = problem if isinstance(problem, Rejection) else fit_from_all_starts(problem)
        if isinstance(problem, Problem) and isinstance(fits, list) and fits[0].cost < least:
            error_px = float(problem.lens_root[0] @ fits[0].state.lens)
            best_mm, least = problem.camera.focal_mm + error_px * camera.pitch_um / 1e3, fits[0].cost
    if math.isinf(least):
        return math.nan
    problem = problem_with(best_mm, _FOCAL_SIGMA_SHARE / 5)
    pose = problem if isinstance(problem, Rejection) else _fit_and_assess(problem)
    return best_mm if isinstance(pose, Pose) and not pose.warning else math.nan


def _find_exchanged_sites(
    views: Sequence[BarView], problem_of: Callable[[Sequence[BarView]], Problem | Rejection]
) -> list[tuple[str, Pose]]:
    """Find pairs of bars that explain all with their sites exchanged, and the poses by that.

    From behind, two bars are seen the other way round: without a third, the position would be wrong.
    """
    found = []
    for i, j in combinations(range(len(views)), 2):
        one, other, exchanged = views[i], views[j], list(views)
        exchanged[i] = replace(one, enu_m=other.enu_m, survey_sigmas=other.survey_sigmas)
        exchanged[j] = replace(other, enu_m=one.enu_m, survey_sigmas=one.survey_sigmas)
        problem = problem_of(exchanged)
        pose = _fit_if_consistent(problem) if isinstance(problem, Problem) else None
        if isinstance(pose, Pose):
            name = f"bar {one.transmitter} at the site of bar {other.transmitter} and the reverse"
            found.append((name, pose))
    return found


def _fit_and_assess(problem: Problem) -> Pose | Rejection:
    fits = fit_from_all_starts(problem)
    if isinstance(fits, Rejection) or not is_misfit(fits[0]):
        return fits if isinstance(fits, Rejection) else _assess_likeliest(fits)
    # Of a misfit the faulty part matters, not other solutions nor the sigma.
    pose = assess_fit(fits[0])
    return pose if isinstance(pose, Pose) else Rejection("not-determined", "nothing explains what is seen")


def _fit_if_consistent(problem: Problem) -> Pose | Rejection | None:
    """The pose by all observations; None if they are contradictory; a rejection if they may be consistent."""
    fits = fit_from_all_starts(problem)
    if isinstance(fits, Rejection):
        return fits
    pose = None if is_misfit(fits[0]) else _assess_likeliest(fits)
    return None if isinstance(pose, Pose) and pose.warning else pose


def _assess_likeliest(fits: Sequence[Equations]) -> Pose | Rejection:
    """Assess the likeliest of some fits, the first; refused if another one is as likely."""
    best = fits[0]
    pose = assess_fit(best)
    if isinstance(pose, Rejection) or len(fits) == 1:
        return pose
    distinct, inverse = [best], np.linalg.pinv(pose.covariance[:3, :3])
    for other in fits[1:]:
        offsets = [other.state.position - one.state.position for one in distinct]
        is_distinct = all(m @ inverse @ m > _DISTINCT_SIGMAS**2 for m in offsets)
        if other.cost - best.cost < DISTINCT_COST and is_distinct:
            distinct.append(other)
    if len(distinct) == 1:
        return pose
    candidates = []
    for fit in distinct:
        one, covariance = assess_fit(fit), np.full((3, 3), math.nan)
        if isinstance(one, Pose):
            covariance = one.covariance[:3, :3]
        likelihood = math.exp((best.cost - fit.cost) / 2)
        candidates.append(Candidate(fit.state.position, fit.state.rotation, covariance, likelihood))
    distance_m = float(np.linalg.norm(distinct[1].state.position - best.state.position))
    detail = f"two positions {distance_m:.2f} m apart fit the image alike"
    return Rejection("two-solutions", detail, tuple(candidates))
