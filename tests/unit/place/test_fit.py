"""The fit of a pose against numerical slopes, dense equations and SciPy's least squares."""

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import approx_fprime, least_squares
from scipy.spatial.transform import Rotation
from scipy.special import huber

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.fit import FOCAL_UNIT, Equations, FitState, fit_pose, intersect_sight_lines, linearize
from evlcp_sdk.place.fit_assessment import Pose, _attitude_excess, _test_fault, assess_fit
from evlcp_sdk.place.observations import (
    BarView,
    Problem,
    compute_shared_errors,
    find_whole_clusters,
    project_bars,
)
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.bar import BarLayout, LedColumns, LedGrid, LedRing
from evlcp_sdk.scene.camera import CAMERA_PARAMETERS, CameraModel, CameraSigma
from tests.unit.place.place_scenes import bar

Floats = NDArray[np.float64]

BENT = CameraModel(k1=-0.3, k2=0.1, p1=1e-3, p2=-1e-3, centre_x_px=655.0, centre_y_px=350.0)
CORRELATED = tuple(tuple(0.4 if i != j else 1.0 for j in range(7)) for i in range(7))
LENS = CameraSigma(0.1, 3.0, 2.0, 0.05, 0.05, 1e-4, 1e-4, correlation=CORRELATED)
SURVEY = (0.05, 0.01, 0.01)
SPEC = ErrorModel(huber_sigmas=3.0)


def problem(rng: np.random.Generator, bars: int = 2, noise: float = 3.0) -> tuple[Problem, Floats, Floats]:
    """Bars seen with errors, and the place and axes near which they are."""
    attitude = Attitude(4.0, -2.0, 30.0, 0.2, 0.4, 0.1, 2000.0, (10.0, -20.0, 30.0))
    rotation, position = attitude.rotation(), np.array([5.0, -3.0, 1.0])
    views = []
    for number in range(bars):
        sight = np.array([0.05 * (number - 0.5), 0.02 * number, 1.0]) * (40 + 8 * number)
        stands = bar(position + rotation @ sight, (0.1, 0.05, 0.99))
        points, _ = project_bars(stands, position, rotation, BENT)
        points = points + noise * rng.normal(0, 0.1, points.shape)
        sigma_px = rng.uniform(0.08, 0.15, 16)
        views.append(BarView(number, stands, points, sigma_px, SURVEY, across=0.6 + 0.7 * number))
    found = Problem.of(views, BENT, attitude, SPEC, LENS)
    assert isinstance(found, Problem)
    return found, position, rotation


def misses(p: Problem, at: FitState, change: Floats) -> Floats:
    """All misses in sigmas, written anew; change: 6 of the pose, a focal fault, 7 of the lens, 9 a bar."""
    z = at.lens + change[7:14]
    off = LENS.covariance_root(BENT) @ z
    f = BENT.focal_px + off[0]
    camera = dataclasses.replace(
        BENT,
        focal_mm=BENT.focal_mm * f / BENT.focal_px,
        **{name: BENT.centre_px[i] + off[1 + i] for i, name in enumerate(CAMERA_PARAMETERS[1:3])},
        **{name: getattr(BENT, name) + off[3 + i] for i, name in enumerate(CAMERA_PARAMETERS[3:])},
    )
    turn = Rotation.from_rotvec(change[3:6]).as_matrix()
    position, rotation = at.position + change[:3], turn @ at.rotation
    found = []
    for b in range(len(p.transmitters)):
        own = at.local[b] + change[14 + 9 * b : 23 + 9 * b]
        rows = p.points[p.bar == b]
        arm = rows[:, 3:6]
        (place, lean, length), root, even = (one[b] for one in p.errors)
        stands = rows[:, :3] + place * own[3:6] + np.cross(lean * own[6:9], arm) + length * own[2] * arm
        points, _ = project_bars(stands, position, rotation, camera)
        centre = np.array(camera.centre_px)
        points = centre + (points - centre) * (1 + FOCAL_UNIT * change[6])
        points = points + root @ own[:2]
        white = even * rows[:, 8, None, None]
        found.append(np.einsum("nij,nj->ni", white, rows[:, 6:8] - points).ravel())
        found.append(-own)
    found.append(-z)
    seen = Attitude.of_rotation(rotation)
    names = ("pitch_deg", "roll_deg", "heading_deg")
    off_deg = np.array([getattr(p.attitude, name) - getattr(seen, name) for name in names])
    causes = p.attitude.bias_root_rad()
    spread = causes @ causes.T + np.radians(p.attitude.white_sigma_deg) ** 2 * np.eye(3)
    found.append(np.linalg.solve(np.linalg.cholesky(spread), np.radians(off_deg)))
    return np.concatenate(found)


def whole_equations(p: Problem, equations: Equations) -> tuple[Floats, Floats, Floats]:
    """Rows of points by all unknowns, each bar's own behind the shared ones, and their normal equations."""
    rows = np.zeros((len(p.points), 2, 14 + 9 * len(p.transmitters)))
    rows[:, :, :14] = equations.rows[:, :, 9:-1]
    for i, b in enumerate(p.bar.tolist()):
        rows[i, :, 14 + 9 * b : 23 + 9 * b] = equations.rows[i, :, :9]
    rows = rows.reshape(-1, rows.shape[2])
    angles = np.pad(equations.angles, ((0, 0), (0, rows.shape[1] - 14)))
    prior = np.r_[np.zeros(7), np.ones(rows.shape[1] - 7)]
    errors = np.r_[np.zeros(7), equations.state.lens, equations.state.local.ravel()]
    side = rows.T @ equations.rows[:, :, -1].ravel() + angles.T @ equations.angle_residuals - errors
    return rows, rows.T @ rows + angles.T @ angles + np.diag(prior), side


def free_of(p: Problem) -> NDArray[np.int64]:
    """Which of all unknowns are free."""
    return np.flatnonzero(np.r_[p.free, np.ones(9 * len(p.transmitters), bool)])


def test_equations_are_those_of_numerical_slopes() -> None:
    rng = np.random.default_rng(1)
    p, position, rotation = problem(rng, noise=0.8)
    # All points count in full.
    p = dataclasses.replace(p, spec=dataclasses.replace(SPEC, huber_sigmas=100.0))
    at = FitState(position, rotation, rng.normal(0, 0.3, (2, 9)), rng.normal(0, 0.3, 7))
    found = linearize(p, at)
    at_rest = misses(p, at, np.zeros(32))
    slope = -approx_fprime(np.zeros(32), lambda x: misses(p, at, x), 1e-6)
    _, matrix, side = whole_equations(p, found)
    scale = np.sqrt(np.diag(slope.T @ slope))
    # The roll is about the level forward axis, not the pitched one.
    even = slope / scale
    np.testing.assert_allclose(matrix / scale / scale[:, None], even.T @ even, atol=1e-3)
    np.testing.assert_allclose(side / scale, slope.T @ at_rest / scale, atol=2e-3)
    # Without the bars' own, the step is that of all.
    shared = np.zeros(14)
    shared[p.free] = np.linalg.solve(*found.normal_equations)
    step, free = np.append(shared, (found.apply_step(shared).local - at.local).ravel()), free_of(p)
    most = 1e-6 * np.abs(side / scale).max()
    np.testing.assert_allclose((matrix @ step / scale)[free], (side / scale)[free], atol=most)
    assert found.cost == pytest.approx(at_rest @ at_rest, rel=1e-6)
    behind = dataclasses.replace(at, position=position + rotation @ np.array([0, 0, 100.0]))
    assert linearize(p, behind) is None


def fit_problem(p: Problem, position: Floats, rotation: Floats) -> Equations:
    """Where the fit ends."""
    found, settled = fit_pose(p, FitState.from_pose(p, position, rotation))
    assert settled
    return found


def test_the_fit_is_that_of_scipy() -> None:
    rng = np.random.default_rng(3)
    p, position, rotation = problem(rng, noise=1.0)
    # A point far out, for Huber's loss.
    far = p.points.copy()
    far[4, 6] += 4.0
    p = dataclasses.replace(p, points=far)
    found = fit_problem(p, position + np.array([0.5, -0.4, 0.2]), rotation)
    fit = found.state
    start = FitState.from_pose(p, position, rotation)

    def cost(x: Floats) -> Floats:
        all_ = misses(p, start, np.concatenate([x[:6], [0.0], x[6:]]))
        for b in range(2):
            rows = slice(41 * b, 41 * b + 32)
            pairs = all_[rows].reshape(-1, 2)
            size = np.linalg.norm(pairs, axis=1)
            less = np.sqrt(2 * huber(SPEC.huber_sigmas, size)) / size
            all_[rows] = (pairs * less[:, None]).ravel()
        return all_

    scipy = least_squares(cost, np.zeros(31), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    # The roll is about the level forward axis, not the pitched one.
    assert found.cost == pytest.approx(2 * scipy.cost, rel=5e-5)
    spread = np.linalg.inv(whole_equations(p, found)[1][np.ix_(free_of(p), free_of(p))])
    sigma = np.sqrt(np.diag(spread)[:3])
    np.testing.assert_allclose(fit.position / sigma, (position + scipy.x[:3]) / sigma, atol=0.03)
    np.testing.assert_allclose(fit.lens, scipy.x[6:13], atol=0.03)
    np.testing.assert_allclose(fit.local.ravel(), scipy.x[13:], atol=0.03)


@pytest.mark.parametrize("bound", [0.0, 0.3])
def test_a_mean_shift_test_is_the_larger_fit(bound: float) -> None:
    """A linear problem with the fault's parameters as unknowns beside the others, solved whole."""
    rng = np.random.default_rng(5)
    rows, wrong = rng.normal(size=(40, 14)), np.zeros((40, 3))
    wrong[:12] = rng.normal(size=(12, 3))
    seen = rng.normal(size=40) + wrong @ [1.0, -2.0, 0.5]
    spread = np.linalg.inv(rows.T @ rows)
    left = seen - rows @ (spread @ (rows.T @ seen))
    fault = wrong.T @ wrong, rows.T @ wrong, wrong.T @ left
    value, freedom, added, unseen = _test_fault(*fault, spread, bound * np.eye(3))
    both = np.concatenate([rows, wrong], 1)
    better = seen - both @ np.linalg.lstsq(both, seen, rcond=None)[0]
    assert freedom == 3
    assert value == pytest.approx(left @ left - better @ better)
    prior = np.zeros((17, 17))
    prior[14:, 14:] = bound * np.eye(3)
    free = np.linalg.inv(both.T @ both + prior)
    np.testing.assert_allclose(spread[:3, :3] + added, free[:3, :3], atol=1e-9)
    # What the position moves by when the fault is free, as a linear map of the observations' noise.
    move = free[:3] @ both.T - spread[:3] @ rows.T
    noise = np.eye(40) - rows @ spread @ rows.T
    np.testing.assert_allclose(unseen, move @ noise @ move.T, atol=1e-9)
    # A part that says nothing has no test.
    nothing = np.zeros((14, 3))
    empty = _test_fault(nothing[:3], nothing, nothing[0], np.eye(14), nothing[:3])
    assert empty[:2] == (0.0, 0)
    assert not np.any(empty[2:])


def test_the_nearest_point_to_lines_of_sight() -> None:
    rng = np.random.default_rng(6)
    enu, here = rng.uniform(-10, 10, (6, 3)) + np.array([0, 50, 0]), np.array([1.0, 2.0, 3.0])
    sights = (enu - here) / np.linalg.norm(enu - here, axis=1, keepdims=True) + rng.normal(0, 1e-3, (6, 3))
    sights /= np.linalg.norm(sights, axis=1, keepdims=True)
    turns = Rotation.from_rotvec([[0, 0, 0], [0, 0, 0.3], [0, 0, math.pi]]).as_matrix()
    places, costs = intersect_sight_lines(enu, sights, turns)
    for turn, place, cost in zip(turns, places, costs, strict=True):
        lines = sights @ turn.T
        flat = np.eye(3) - lines[:, :, None] * lines[:, None]
        want = np.linalg.lstsq(flat.reshape(-1, 3), (flat @ enu[:, :, None]).ravel(), rcond=None)[0]
        np.testing.assert_allclose(place, want, atol=1e-6)
        away = enu - want
        assert cost == pytest.approx(6 - ((away * lines).sum(1) / np.linalg.norm(away, axis=1)).sum())
    parallel = np.tile([[0.0, 1.0, 0.0]], (6, 1))
    assert np.isinf(intersect_sight_lines(enu, parallel, turns)[1]).all()


def test_clusters_that_count() -> None:
    """12 px apart: beside an edge, three quarters of that and half a pixel must be free."""
    sigma = np.full(8, 0.1)
    points = np.stack([np.full(8, 100.0), 9.0 + 12 * np.arange(8)], 1)
    points[3], sigma[4], sigma[5] = np.nan, 0.0, np.inf
    points[6, 0] = 9.4
    assert np.flatnonzero(find_whole_clusters(points, sigma, 1280, 720)).tolist() == [1, 2, 7]


@pytest.mark.parametrize("bars", [2, 3])
def test_a_pose_is_as_sure_as_its_equations_whole(bars: int) -> None:
    """Covariance, its causes and what errors of sites do, by the inverse of the whole matrix."""
    p, position, rotation = problem(np.random.default_rng(12), bars, noise=1.0)
    equations = fit_problem(p, position, rotation)
    pose, keep = assess_fit(equations), free_of(p)
    assert isinstance(pose, Pose)
    rows, matrix, _ = whole_equations(p, equations)
    spread = np.zeros((14 + 9 * bars, 14 + 9 * bars))
    spread[np.ix_(keep, keep)] = np.linalg.inv(matrix[np.ix_(keep, keep)])
    np.testing.assert_allclose(pose.covariance, spread[:6, :6], rtol=1e-6, atol=1e-12)
    by_points = spread[:3] @ rows.T
    slow = by_points @ np.diag(equations.standing_share) @ by_points.T
    np.testing.assert_allclose(pose.slow, slow, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(pose.standing["camera"], -spread[:3, 7:14], rtol=1e-6, atol=1e-9)
    angles = spread[:3, :14] @ equations.angles.T @ p.angles.whitening @ p.attitude.bias_root_rad()
    np.testing.assert_allclose(pose.standing["attitude"], angles, rtol=1e-6, atol=1e-9)
    for b in range(bars):
        own = slice(14 + 9 * b + 2, 23 + 9 * b)
        np.testing.assert_allclose(pose.standing[f"bar {b}"], -spread[:3, own], rtol=1e-6, atol=1e-9)
    together = pose.noise + pose.slow + sum(m @ m.T for m in pose.standing.values())
    np.testing.assert_allclose(together, spread[:3, :3], rtol=1e-6, atol=1e-9)
    assert abs(np.linalg.eigh(spread[:3, :3])[1][:, -1] @ pose.weakest_axis) == pytest.approx(1)


@pytest.mark.parametrize("off", [0.0, 2.0, 6.0])
def test_a_doubt_is_the_mean_over_both_hypotheses(off: float) -> None:
    """A linear problem, whose evidence is that of all observations under a wide prior of the unknowns."""
    rng, rarely, larger = np.random.default_rng(13), 0.05, 4.0
    rows, angles = rng.normal(size=(30, 14)), 0.5 * rng.normal(size=(3, 14))
    seen = rng.normal(size=33)
    seen[30:] += np.array([off, 0, -off])
    both = np.concatenate([rows, angles])
    found = []
    for size in (1.0, larger):
        noise = np.diag([1.0] * 30 + [size**2] * 3)
        spread = np.linalg.inv(both.T @ np.linalg.solve(noise, both))
        mean = spread @ both.T @ np.linalg.solve(noise, seen)
        evidence = stats.multivariate_normal(np.zeros(33), 1e6 * both @ both.T + noise).logpdf(seen)
        found.append((evidence, mean, spread))
    (one, at, spread), (two, there, wider) = found
    weight = rarely * math.exp(two - one) / (1 - rarely + rarely * math.exp(two - one))
    away = (there - at)[:6]
    want = max(weight - rarely, 0) * (wider - spread)[:6, :6] + weight * np.outer(away, away)
    reported = SimpleNamespace(free=np.ones(14, bool))
    equations: Any = SimpleNamespace(problem=reported, angles=angles, angle_residuals=seen[30:] - angles @ at)
    out = _attitude_excess(equations, spread)
    little = np.trace(want[:3, :3]) < 0.01 * np.trace(spread[:3, :3])
    np.testing.assert_allclose(out, 0 * want if little else want, rtol=1e-3, atol=1e-6)
    assert (np.trace(out) > 0.1 * np.trace(spread[:6, :6])) == (off > 5)


def test_points_that_say_nothing_determine_no_position() -> None:
    p, position, rotation = problem(np.random.default_rng(31))
    p.points[:, 8] = 0.0
    found, settled = fit_pose(p, FitState.from_pose(p, position, rotation))
    assert (settled, assess_fit(found).kind) == (False, "not-determined")


@pytest.mark.parametrize(
    ("layout", "length_m"),
    [
        (LedGrid(), 0.96),
        (LedRing(leds=12, radius_m=0.25), 0.5 * 12 / 11),
        (LedColumns(apart_m=1.2, rows=24), math.hypot(1.2, 0.18) * 8 / 7),
        (LedGrid(16, 16, 0.02, 4, 4), 0.24 * math.sqrt(2) * 16 / 15),
    ],
)
@pytest.mark.parametrize("dark", [(), (0, 3)])
def test_what_points_share_grows_with_the_whole_layout(layout, length_m, dark) -> None:
    """In whatever order clusters stand: the first and the last of a ring are neighbours."""
    centres_m = BarLayout(layout).cluster_centres_m()
    enu_m = np.stack([centres_m[:, 0], 0 * centres_m[:, 0], -centres_m[:, 1]], 1)
    seen = ~np.isin(np.arange(len(enu_m)), dark)
    points = np.where(seen[:, None], 300 + 250 * centres_m, np.nan)
    spec = ErrorModel(shared_along_px=0.05, shared_share=0.002, stretch_share=0.003)
    view = BarView(0, enu_m, points, np.full(len(enu_m), 0.1), (0.1, 0.2, 0.004))
    found = compute_shared_errors(view, seen, spec, 1.0)
    longest = math.hypot(0.05, 0.002 * 250 * length_m)
    assert np.linalg.eigvalsh(found.root)[-1] == pytest.approx(longest, rel=1e-9)
    assert found.bar_sigmas == pytest.approx([0.1, 0.2, 0.005])


def test_protection_levels_hold_with_any_bar_at_fault() -> None:
    """The widest of what a bar that stands anywhere may hide, each told by its own test."""
    p, position, rotation = problem(np.random.default_rng(12), 3, noise=1.0)
    p = dataclasses.replace(p, spec=dataclasses.replace(p.spec, bar_fault_m=0.0))
    fit = fit_problem(p, position, rotation)
    found, spread = assess_fit(fit), fit.covariance
    assert isinstance(found, Pose)
    risk = stats.chi2.isf(SPEC.risk, 1)
    for b in range(3):
        bars = fit.bars
        column = bars.information[b, :, :6] * p.free[:, None]
        own, side = bars.information[b, :6, :6], bars.right_side[b, :6]
        value, freedom, added, unseen = _test_fault(own, column, side, spread, np.zeros((6, 6)))
        assert value == pytest.approx(found.tests[f"bar {b}"])
        hidden = np.sqrt(stats.chi2.isf(SPEC.false_alarm / 2 / len(found.tests), freedom) * np.diag(unseen))
        assert (found.undetected_m >= hidden * (1 - 1e-9)).all()
        height_m = hidden[2] + math.sqrt(risk * (spread[2, 2] + added[2, 2]))
        assert found.vpl_m >= height_m * (1 - 1e-9)
