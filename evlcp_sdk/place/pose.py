"""The camera's position from the image points of bars at known places.

One bar needs the camera's attitude; two or more need gravity and give the heading, too; three or more that do
not stand in line give the full attitude. All are one weighted least-squares problem over the image points of
all clusters, with what is known of the attitude as further observations, and with every error that many
points share as a further unknown. What the geometry does not determine is refused, with the reason; a part
that the rest contradicts is left out, and named. Frames and signs: `docs/position.md`.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from evlcp_sdk.place.error_model import ErrorModel, chi_square
from evlcp_sdk.place.fit import ODDS, fit_pose, likely_fits
from evlcp_sdk.place.fit_assessment import FOCAL, AssessedPose, Pose, assess_fit, covering, misfits
from evlcp_sdk.place.model import Equations
from evlcp_sdk.place.observations import BarView, Problem, project_bars
from evlcp_sdk.place.rejections import Candidate, Rejection
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
    spec: ErrorModel | None = None,
    sigma: CameraSigma | None = None,
) -> Pose | Rejection:
    """Fit position and attitude to all image points.

    Huber's loss over the miss of each point in its sigmas; Levenberg-Marquardt from closed-form starts: with
    the heading known, the point nearest to all lines of sight; with gravity known, the best of these over the
    headings; else the three-point solutions (Grunert) of the widest triangle of bars. Where the tests fail,
    each part is left out in turn: if one alone explains it, the fix is the one without it.

    Args:
        views: The bars seen at one time.
        camera: The camera.
        attitude: What is known of its attitude; its heading may be None; None for nothing.
        spec: Bounds and weights; None for the defaults.
        sigma: How precisely the camera is known; None: exactly.

    Returns:
        The pose, or why the geometry does not determine one, or the parts contradict one another.
    """
    spec = ErrorModel() if spec is None else spec
    sigma = CameraSigma() if sigma is None else sigma
    problem = Problem.of(views, camera, attitude, spec, sigma)
    if isinstance(problem, Rejection):
        return problem
    found = _plain(problem)
    tests: Mapping[str, float]
    if isinstance(found, Rejection):
        if found.kind != "not-determined":
            return found
        doubt, tests = found.detail, {}
    elif found.doubt:
        doubt, tests = found.doubt, found.tests
    else:
        pose = found.pose
        # Two bars on gravity do not show which is which.
        if problem.angles.known == 2 == len(pose.transmitters) and math.isfinite(pose.hpl_m + pose.vpl_m):
            for _, behind in _mixed_up(views, camera, attitude, spec, sigma):
                pose = covering(pose, behind, spec)
        return pose
    fits, unsure = _fits_without_one(problem, sigma, tests)
    names = [name for name, _ in fits]
    if "heading" in names:
        fits = [fit for fit in fits if fit[0] != "attitude"]
    most = max((tests.get(name, 0.0) for name in names), default=0.0)
    rivals = [n for n in unsure if n in tests and most - tests[n] < max(ODDS, _CURVED * most)]
    if len(fits) == 1:
        name, pose = fits[0]
        if not rivals and tests:
            rivals = [name for name, _ in _mixed_up(views, camera, attitude, spec, sigma)]
            if not rivals:
                return replace(pose, excluded=(name,), failed=_failed(problem, name, pose, tests))
        names = [name]
    names += rivals
    if isinstance(found, Rejection) and not names:
        return found
    could = f"; it may be {' or '.join(names)}" if names else ""
    return Rejection("misfit", doubt + could, suspects=tuple(names))


def _fits_without_one(
    problem: Problem, sigma: CameraSigma, tests: Mapping[str, float]
) -> tuple[list[tuple[str, Pose]], list[str]]:
    """Which part is left out of each fit that is fine, and the parts without which there is no position."""
    fits: list[tuple[str, Pose]] = []
    unsure = []
    most = max(tests.values(), default=0.0)
    likely: list[tuple[str, Problem | Rejection]] = []
    others: list[tuple[str, Problem | Rejection]] = []
    for part in _without(problem, sigma):
        hopeless = tests.get(part[0], most) < _HOPELESS * most and most > _FAR
        (others if hopeless else likely).append(part)
    # Where nothing fits without one, or several do, the tests may be of a fit that has gone astray.
    for parts in (likely, others):
        if len(fits) == 1:
            break
        for name, other in parts:
            again = other if isinstance(other, Rejection) else _explained(other)
            if isinstance(again, Pose):
                fits.append((name, again))
            elif again is not None:
                # It may be this part; without it there is no position that would tell.
                unsure.append(name)
    return fits, unsure


def _failed(problem: Problem, name: str, pose: Pose, tests: Mapping[str, float]) -> FailedBar | None:
    """The bar of a name; None where that is another part."""
    for i, number in enumerate(problem.transmitters):
        if name == f"bar {number}":
            return estimate_fault(problem, i, pose, tests[name], len(tests)) if name in tests else None
    return None


def estimate_fault(problem: Problem, bar: int, pose: Pose, test: float, parts: int) -> FailedBar:
    """Where a bar stands by its image, seen from a pose that does without it.

    Weighted least squares over its points, which share the shift of its image, for its place; its attitude
    and length are taken as its site says.

    Args:
        problem: All that is seen, this bar, too.
        bar: Its place among `problem.transmitters`.
        pose: The pose without it.
        test: Its test value.
        parts: How many parts are tested.
    """
    from scipy.special import chndtr

    rows = problem.points[problem.bar == bar]
    shift, even = (
        np.array([[one[0], one[1]], [one[1], one[2]]]) for one in problem.bar_sigma[bar, 3:].reshape(2, 3)
    )
    weight = rows[:, 8, None, None] * even
    shift = (weight @ shift).reshape(-1, 2)
    whole = np.linalg.inv(np.eye(2 * len(rows)) + shift @ shift.T)
    off_m = np.zeros(3)
    for _ in range(_FAULT_STEPS):
        points, slope = project_bars(rows[:, :3] + off_m, pose.enu_m, pose.rotation, problem.camera)
        by_pose = (weight @ slope).reshape(-1, 6)
        by_place = -by_pose[:, :3]
        missed = (weight @ (rows[:, 6:8] - points)[:, :, None]).ravel()
        follow = np.linalg.solve(by_place.T @ whole @ by_place, by_place.T @ whole)
        off_m = off_m + follow @ missed
    place_m = problem.bar_sigma[bar, 0]
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
    spec: ErrorModel | None = None,
    sigma: CameraSigma | None = None,
) -> float:
    """The focal length with which views that contradict one another fit best, mm; NaN where with none.

    For what `solve_pose` refuses: it believes a focal length that is some percent off at the most, and one
    that was mistyped is another lens altogether.
    """
    spec = ErrorModel() if spec is None else spec
    sigma = CameraSigma() if sigma is None else sigma

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
    return around if isinstance(found, AssessedPose) and not found.doubt else math.nan


def _mixed_up(
    views: Sequence[BarView],
    camera: CameraModel,
    attitude: Attitude | None,
    spec: ErrorModel,
    sigma: CameraSigma,
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
        swapped = Problem.of(mixed, camera, attitude, spec, sigma)
        pose = _explained(swapped) if isinstance(swapped, Problem) else None
        if isinstance(pose, Pose):
            name = f"bar {one.transmitter} at the site of bar {two.transmitter} and the reverse"
            found.append((name, pose))
    return found


def _without(problem: Problem, sigma: CameraSigma) -> Iterator[tuple[str, Problem | Rejection]]:
    """The same without each part that may be at fault, and its name."""
    bars, attitude = problem.transmitters, problem.attitude
    if len(bars) > 1:
        for i, number in enumerate(bars):
            yield f"bar {number}", problem.without(i)
        if attitude is not None and attitude.heading_deg is not None:
            yield "heading", problem.with_attitude(replace(attitude, heading_deg=None))
    if attitude is not None and len(bars) > 1:
        yield "attitude", problem.with_attitude(None)
    focal_mm = math.hypot(sigma.focal_mm, _FREE_FOCAL * problem.camera.focal_mm)
    yield FOCAL, problem.seen_by(replace(sigma, focal_mm=focal_mm, correlation=()))


def _plain(problem: Problem) -> AssessedPose | Rejection:
    """The pose by all that is given, whether it is to be believed or not."""
    fits = likely_fits(problem)
    if isinstance(fits, Rejection) or not misfits(problem, fits[0]):
        return fits if isinstance(fits, Rejection) else _settled(problem, fits)
    # What is off matters, not whether it is as much off from elsewhere, nor how surely it is there.
    fitted, _ = fit_pose(problem, fits[0].at)
    found = assess_fit(problem, fitted or fits[0])
    if isinstance(found, AssessedPose):
        return found
    return Rejection("not-determined", "nothing explains what is seen")


def _explained(problem: Problem) -> Pose | Rejection | None:
    """The pose by all that is given; None where that does not fit together; a refusal: it may do."""
    fits = likely_fits(problem)
    if isinstance(fits, Rejection):
        return fits
    found = None if misfits(problem, fits[0]) else _settled(problem, fits)
    if isinstance(found, AssessedPose):
        return None if found.doubt else found.pose
    return found


def _settled(problem: Problem, fits: Sequence[Equations]) -> AssessedPose | Rejection:
    """The likeliest of some fits, which is the first, assessed; refused where another one is as likely."""
    best = fits[0]
    found = assess_fit(problem, best)
    if isinstance(found, Rejection):
        return found
    known = [best]
    for other in fits:
        if other.cost - best.cost < ODDS and _apart(other, known, found.pose):
            known.append(other)
    if len(known) > 1:
        apart_m = float(np.linalg.norm(known[1].at.position - best.at.position))
        detail = f"two positions {apart_m:.2f} m apart fit the image alike"
        return Rejection("two-solutions", detail, tuple(_candidate(problem, fit, best) for fit in known))
    return found


def _apart(fit: Equations, others: Sequence[Equations], pose: Pose) -> bool:
    """Whether a fit is another solution than these, by the covariance of the likeliest one."""
    for other in others:
        apart = fit.at.position - other.at.position
        if fit is other or not apart @ np.linalg.pinv(pose.covariance[:3, :3]) @ apart > _APART_SIGMAS**2:
            return False
    return True


def _candidate(problem: Problem, fit: Equations, best: Equations) -> Candidate:
    found = assess_fit(problem, fit)
    spread = found.pose.covariance[:3, :3] if isinstance(found, AssessedPose) else np.full((3, 3), math.nan)
    return Candidate(fit.at.position, fit.at.rotation, spread, math.exp((best.cost - fit.cost) / 2))
