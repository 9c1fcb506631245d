"""The compiled fit against plain NumPy: numerical slopes, dense equations, SciPy's least squares."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import approx_fprime, least_squares
from scipy.spatial.transform import Rotation

from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.place import _kernels
from evlcp_sdk.place.fit import FOCAL_UNIT, Fit, data, fit_pose
from evlcp_sdk.place.judgement import Judged, judged
from evlcp_sdk.place.observations import BarView, Problem, project_bars, shared_sigmas
from evlcp_sdk.place.starts import likely_starts
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.bar import BarLayout, LedColumns, LedGrid, LedRing
from evlcp_sdk.scene.camera import CAMERA_PARAMETERS, CameraModel, CameraSigma

Floats = NDArray[np.float64]

BENT = CameraModel(k1=-0.3, k2=0.1, p1=1e-3, p2=-1e-3, centre_x_px=655.0, centre_y_px=350.0)
CORRELATED = tuple(tuple(0.4 if i != j else 1.0 for j in range(7)) for i in range(7))
LENS = CameraSigma(0.1, 3.0, 2.0, 0.05, 0.05, 1e-4, 1e-4, correlation=CORRELATED)
SURVEY = (0.05, 0.01, 0.01)
SPEC = PositionSpec(huber_sigmas=3.0)
ALONG = (0.5 - (np.arange(16) + 0.5) / 16) * 0.96


def problem(rng: np.random.Generator, bars: int = 2, noise: float = 3.0) -> tuple[Problem, Floats, Floats]:
    """Bars seen with errors, and the place and axes near which they are."""
    attitude = Attitude(4.0, -2.0, 30.0, 0.2, 0.4, 0.1, 2000.0, (10.0, -20.0, 30.0))
    rotation, position = attitude.rotation(), np.array([5.0, -3.0, 1.0])
    views = []
    for number in range(bars):
        sight = np.array([0.05 * (number - 0.5), 0.02 * number, 1.0]) * (40 + 8 * number)
        stands = position + rotation @ sight + ALONG[:, None] * np.array([0.1, 0.05, 0.99])
        points, _ = project_bars(stands, position, rotation, BENT)
        points = points + noise * rng.normal(0, 0.1, points.shape)
        sigma_px = rng.uniform(0.08, 0.15, 16)
        views.append(BarView(number, stands, points, sigma_px, SURVEY, across=0.6 + 0.7 * number))
    found = Problem.of(views, BENT, attitude, SPEC, LENS)
    assert isinstance(found, Problem)
    return found, position, rotation


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations at a point: see `_kernels.normal` for its arrays.

    Attributes:
        cost: Twice the robust cost; NaN where a point is behind the camera.
        bar_cost: Of each bar, least over its own unknowns, float64 (bars,).
        whole: The sum over everything, float64 (14, 14).
        side: Its right-hand side, float64 (14,).
    """

    cost: float
    info: Floats
    right: Floats
    gain: Floats
    step: Floats
    bar_cost: Floats
    rows: Floats
    miss: Floats
    pixel: Floats
    whole: Floats
    side: Floats


def normal_equations(problem: Problem, at: Fit) -> Normal:
    """Normal equations at a point."""
    bars, wide, own = len(problem.transmitters), _kernels.GLOBAL, _kernels.LOCAL
    info, right, cost = np.zeros((bars, wide, wide)), np.zeros((bars, wide)), np.zeros(bars)
    gain, step, pixel = np.zeros((bars, own, wide)), np.zeros((bars, own)), np.zeros((bars, wide, wide))
    rows, miss = np.zeros((3, wide)), np.zeros(3)
    point = (at.position, at.rotation, at.local, at.lens)
    found = (info, right, gain, step, cost, rows, miss, pixel)
    total = _kernels.normal(*data(problem), *point, *found)  # type: ignore[call-arg]
    whole, side = np.zeros((wide, wide)), np.zeros(wide)
    if not np.isnan(total):
        _kernels.summed(info, right, rows, miss, at.lens, problem.free, whole, side)
    return Normal(total, info, right, gain, step, cost, rows, miss, pixel, whole, side)


def moved(problem: Problem, at: Fit, normal: Normal, move: Floats) -> Fit:
    """A point with its unknowns moved by (14,), about the bars; what is a bar's own follows."""
    point = (at.position, at.rotation, at.local, at.lens)
    centre = problem.points[:, :3].mean(0)
    return Fit(*_kernels.stepped(move, normal.gain, normal.step, centre, *point), np.nan)


def misses(p: Problem, at: Fit, change: Floats) -> Floats:
    """All misses in sigmas, of points and of what is known, at a point that is moved: written out anew.

    `change`: 6 of the pose, 1 of the focal length's fault, 7 of the lens, 9 of each bar.
    """
    z = at.lens + change[7:14]
    off = LENS.root(BENT) @ z
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
        place, lean, length, columns, both, rows_px, *even = p.bar_sigma[b]
        stands = rows[:, :3] + place * own[3:6] + np.cross(lean * own[6:9], arm) + length * own[2] * arm
        points, _ = project_bars(stands, position, rotation, camera)
        centre = np.array(camera.centre_px)
        points = centre + (points - centre) * (1 + FOCAL_UNIT * change[6])
        points = points + np.array([[columns, both], [both, rows_px]]) @ own[:2]
        white = np.array([even[:2], even[1:]]) * rows[:, 8, None, None]
        found.append(np.einsum("nij,nj->ni", white, rows[:, 6:8] - points).ravel())
        found.append(-own)
    found.append(-z)
    assert p.attitude is not None
    seen = Attitude.of_rotation(rotation)
    off_deg = np.array(
        [
            p.attitude.pitch_deg - seen.pitch_deg,
            p.attitude.roll_deg - seen.roll_deg,
            (p.attitude.heading_deg or 0) - (seen.heading_deg or 0),
        ]
    )
    causes = p.attitude.standing()
    spread = causes @ causes.T + np.radians(p.attitude.white_sigma_deg) ** 2 * np.eye(3)
    found.append(np.linalg.solve(np.linalg.cholesky(spread), np.radians(off_deg)))
    return np.concatenate(found)


def test_normal_equations_are_those_of_numerical_slopes() -> None:
    rng = np.random.default_rng(1)
    p, position, rotation = problem(rng, noise=0.8)
    p = dataclasses.replace(p, spec=dataclasses.replace(SPEC, huber_sigmas=100.0))
    at = Fit(position, rotation, rng.normal(0, 0.3, (2, 9)), rng.normal(0, 0.3, 7), 0.0)
    found = normal_equations(p, at)
    at_rest = misses(p, at, np.zeros(32))
    slope = -approx_fprime(np.zeros(32), lambda x: misses(p, at, x), 1e-6)
    whole, side = slope.T @ slope, slope.T @ at_rest
    # The local unknowns eliminated; the fault's column is masked in the sum.
    own = np.arange(14, 32)
    gain = np.linalg.solve(whole[np.ix_(own, own)], np.column_stack([whole[own][:, :14], side[own]]))
    want = whole[:14, :14] - whole[:14, own] @ gain[:, :14]
    want_side = side[:14] - whole[:14, own] @ gain[:, 14]
    keep = np.array([i for i in range(14) if i != 6])
    scale = np.sqrt(np.diag(want))
    np.testing.assert_allclose(
        (found.whole / np.outer(scale, scale))[np.ix_(keep, keep)],
        (want / np.outer(scale, scale))[np.ix_(keep, keep)],
        # The roll is about the level forward axis, not the pitched one.
        atol=1e-3,
    )
    np.testing.assert_allclose(found.side[keep] / scale[keep], want_side[keep] / scale[keep], atol=2e-3)
    np.testing.assert_allclose(found.gain.reshape(18, 14)[:, keep], gain[:, keep], rtol=2e-3, atol=2e-3)
    np.testing.assert_allclose(found.step.ravel(), gain[:, 14], atol=1e-3)
    assert found.info.sum(0)[6, 6] == pytest.approx(want[6, 6], rel=1e-3)
    np.testing.assert_allclose(
        found.info.sum(0)[6, keep] / scale[keep], want[6, keep] / scale[keep], atol=0.05 * scale[6]
    )
    assert found.cost == pytest.approx(at_rest @ at_rest, rel=1e-6)
    assert found.bar_cost.sum() == pytest.approx(
        at_rest[: 2 * (32 + 9)] @ at_rest[: 2 * (32 + 9)]
        - sum(side[i] @ np.linalg.solve(whole[np.ix_(i, i)], side[i]) for i in (own[:9], own[9:])),
        rel=1e-5,
    )


def test_what_the_pixels_say_is_counted() -> None:
    """Of points whose sigma is that of pixels alone, it is all but what the prior sigmas say."""
    p, position, rotation = problem(np.random.default_rng(2), noise=0.5)
    sharp = p.points.copy()
    sharp[:, 8:] = 1 / SPEC.pixel_sigma_px, 1.0
    p = dataclasses.replace(p, points=sharp, spec=dataclasses.replace(SPEC, huber_sigmas=100.0))
    found = normal_equations(p, Fit(position, rotation, np.zeros((2, 9)), np.zeros(7), 0.0))
    priors = np.einsum("bij,bik->bjk", found.gain, found.gain)
    np.testing.assert_allclose(found.pixel + priors, found.info, rtol=1e-6, atol=1e-6 * found.info.max())


def test_the_fit_is_that_of_scipy() -> None:
    rng = np.random.default_rng(3)
    p, position, rotation = problem(rng, noise=1.0)
    # A point far out, for Huber's loss.
    far = p.points.copy()
    far[4, 6] += 4.0
    p = dataclasses.replace(p, points=far)
    fit = fit_pose(p, Fit.at(p, position + np.array([0.5, -0.4, 0.2]), rotation))
    assert fit.settled
    start = Fit(position, rotation, np.zeros((2, 9)), np.zeros(7), 0.0)

    def cost(x: Floats) -> Floats:
        all_ = misses(p, start, np.concatenate([x[:6], [0.0], x[6:]]))
        for b in range(2):
            rows = slice(41 * b, 41 * b + 32)
            pairs = all_[rows].reshape(-1, 2)
            size = np.linalg.norm(pairs, axis=1)
            most = SPEC.huber_sigmas
            less = np.where(
                size > most, np.sqrt(np.abs(most * (2 * size - most))) / np.maximum(size, 1e-9), 1.0
            )
            all_[rows] = (pairs * less[:, None]).ravel()
        return all_

    scipy = least_squares(cost, np.zeros(31), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    # The roll is about the level forward axis, not the pitched one.
    assert fit.cost == pytest.approx(2 * scipy.cost, rel=5e-5)
    sigma = np.sqrt(np.diag(np.linalg.inv(normal_equations(p, fit).whole))[:3])
    np.testing.assert_allclose(fit.position / sigma, (position + scipy.x[:3]) / sigma, atol=0.03)
    np.testing.assert_allclose(fit.lens, scipy.x[6:13], atol=0.03)
    np.testing.assert_allclose(fit.local.ravel(), scipy.x[13:], atol=0.03)


def test_a_step_turns_about_the_bars() -> None:
    """To first order along the straight line; a turn alone keeps the camera as far from the bars."""
    p, position, rotation = problem(np.random.default_rng(4))
    at = Fit(position, rotation, np.zeros((2, 9)), np.zeros(7), 0.0)
    normal = dataclasses.replace(normal_equations(p, at), gain=np.zeros((2, 9, 14)), step=np.zeros((2, 9)))
    centre = p.points[:, :3].mean(0)
    turn = np.array([0.0, 0.0, 0.3])
    move = np.zeros(14)
    move[:3], move[3:6] = np.cross(turn, position - centre), turn
    there = moved(p, at, normal, move)
    assert np.linalg.norm(there.position - centre) == pytest.approx(np.linalg.norm(position - centre))
    np.testing.assert_allclose(there.rotation, Rotation.from_rotvec(turn).as_matrix() @ rotation, atol=1e-12)
    small = moved(p, at, normal, 1e-6 * move)
    np.testing.assert_allclose(small.position - position, 1e-6 * move[:3], atol=1e-10)


@pytest.mark.parametrize("bound", [0.0, 0.3])
def test_a_mean_shift_test_is_the_larger_fit(bound: float) -> None:
    """A linear problem with the fault's parameters as unknowns beside the others, solved whole."""
    rng = np.random.default_rng(5)
    rows, wrong = rng.normal(size=(40, 14)), np.zeros((40, 3))
    wrong[:12] = rng.normal(size=(12, 3))
    seen = rng.normal(size=40) + wrong @ [1.0, -2.0, 0.5]
    spread = np.linalg.inv(rows.T @ rows)
    left = seen - rows @ (spread @ (rows.T @ seen))
    value, freedom, added, unseen = _kernels.tested(
        wrong.T @ wrong, rows.T @ wrong, wrong.T @ left, spread, bound * np.eye(3), 1e-6
    )
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


def test_a_part_that_says_nothing_has_no_test() -> None:
    empty = _kernels.tested(
        np.zeros((2, 2)), np.zeros((14, 2)), np.zeros(2), np.eye(14), np.zeros((2, 2)), 1e-3
    )
    assert empty[:2] == (0.0, 0)
    assert not empty[2].any()
    assert not empty[3].any()


def test_the_nearest_point_to_sights() -> None:
    rng = np.random.default_rng(6)
    enu, here = rng.uniform(-10, 10, (6, 3)) + np.array([0, 50, 0]), np.array([1.0, 2.0, 3.0])
    sights = (enu - here) / np.linalg.norm(enu - here, axis=1, keepdims=True) + rng.normal(0, 1e-3, (6, 3))
    sights /= np.linalg.norm(sights, axis=1, keepdims=True)
    turns = Rotation.from_rotvec([[0, 0, 0], [0, 0, 0.3], [0, 0, math.pi]]).as_matrix()
    places, costs = np.zeros((3, 3)), np.zeros(3)
    _kernels.nearest_to_sights(enu, sights, turns, places, costs)
    for turn, place, cost in zip(turns, places, costs, strict=True):
        lines = sights @ turn.T
        flat = np.eye(3) - lines[:, :, None] * lines[:, None]
        want = np.linalg.lstsq(flat.reshape(-1, 3), (flat @ enu[:, :, None]).ravel(), rcond=None)[0]
        np.testing.assert_allclose(place, want, atol=1e-6)
        away = enu - want
        cosine = (away * lines).sum(1) / np.linalg.norm(away, axis=1)
        assert cost == pytest.approx((1 - cosine).sum())
    parallel = np.tile([[0.0, 1.0, 0.0]], (6, 1))
    _kernels.nearest_to_sights(enu, parallel, turns, places, costs)
    assert np.isinf(costs).all()


def test_equations_that_are_singular_are_not_solved() -> None:
    whole, move = np.diag(np.arange(1.0, 15.0)), np.zeros(14)
    assert _kernels.solved(whole, np.ones(14), 0.0, move)
    np.testing.assert_allclose(move, 1 / np.arange(1.0, 15.0))
    whole[0, 0] = 0
    assert not _kernels.solved(whole, np.ones(14), 0.0, move)
    whole[:2, :2] = 1
    assert not _kernels.solved(whole, np.ones(14), 0.0, move)


def test_jacobis_turns_give_the_axes_of_numpy() -> None:
    rng = np.random.default_rng(7)
    for n in (1, 2, 3, 6):
        root = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-4, 4, n)
        matrix = root @ root.T
        values, axes = np.zeros(n), np.zeros((n, n))
        _kernels.eigen(matrix.copy(), values, axes)
        largest = np.linalg.eigvalsh(matrix)[-1]
        np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(matrix), atol=1e-13 * largest)
        np.testing.assert_allclose(axes @ axes.T, np.eye(n), atol=1e-13)
        np.testing.assert_allclose((axes * values) @ axes.T, matrix, atol=1e-13 * largest)


def test_what_whitens_is_the_inverse_of_the_root() -> None:
    causes, out = np.random.default_rng(9).normal(size=(3, 4)), np.zeros((3, 3))
    _kernels.whitening(causes, 0.1, out)
    want = np.linalg.inv(np.linalg.cholesky(causes @ causes.T + 0.1 * np.eye(3)))
    np.testing.assert_allclose(out, want, atol=1e-12)


def test_errors_across_a_bar_are_others_than_those_along_it() -> None:
    turn = np.radians(30.0)
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    enu = np.outer(np.arange(16.0), [0.0, 0.0, 0.06])
    points = np.array([500.0, 300.0]) + 10.0 * np.arange(16)[:, None] * along
    own, usual = np.zeros(9), np.array([0.02, 0.06, 0.001, 0.0, 0.4])
    _kernels.shared(enu, points, np.ones(16, np.bool_), usual, own)
    root = np.array([[own[3], own[4]], [own[4], own[5]]])
    np.testing.assert_allclose(root @ across, 0.02 * across, atol=1e-12)
    np.testing.assert_allclose(root @ along, math.hypot(0.06, 0.16) * along, atol=1e-12)
    even = np.array([[own[6], own[7]], [own[7], own[8]]])
    np.testing.assert_allclose(even @ along, along, atol=1e-12)
    np.testing.assert_allclose(even @ across, across / 0.4, atol=1e-12)
    # What is no line has neither: 150 px from one corner to the other, 16 of 15 parts.
    points[7] += 20 * across
    _kernels.shared(enu, points, np.ones(16, np.bool_), usual, own)
    shift = math.hypot(0.06, 0.16)
    np.testing.assert_allclose(own[3:], [shift, 0.0, shift, 1.0, 0.0, 1.0], atol=1e-12)


def test_clusters_that_count_and_their_rows() -> None:
    """12 px apart: beside an edge, three quarters of that and half a pixel must be free."""
    rng = np.random.default_rng(10)
    enu, sigma = np.outer(np.arange(8), rng.normal(size=3)) + rng.normal(size=3), rng.uniform(0.04, 0.2, 8)
    points = np.stack([np.full(8, 100.0), 9.0 + 12 * np.arange(8)], 1)
    points[3], sigma[4], sigma[5] = np.nan, 0.0, np.inf
    points[6, 0] = 9.4
    seen = np.zeros(8, np.bool_)
    assert _kernels.whole(points, sigma, 1280, 720, seen) == 3
    assert seen.nonzero()[0].tolist() == [1, 2, 7]
    out, bar = np.zeros((5, 10)), np.zeros(5, np.int64)
    own, usual = np.append([0.3, 0.2, 0.03], np.zeros(6)), np.array([0.02, 0.06, 0.001, 0.04, 0.5])
    given = (enu, points, sigma, 0.05, 1280, 720, usual)
    assert _kernels.gathered(*given, 4, 4, 1, out, bar, own.copy()) == 3
    assert not out.any()
    assert _kernels.gathered(*given, 3, 4, 1, out, bar, own) == 3
    # Six of eight clusters, 12 px apart.
    across, along = 0.02, math.hypot(0.06, 0.001 * 72 * 8 / 6)
    # Upright: rows are along it.
    np.testing.assert_allclose(own, [0.3, 0.2, 0.05, across, 0.0, along, 2.0, 0.0, 1.0], atol=1e-15)
    assert not out[[0, 4]].any()
    out, bar = out[1:4], bar[1:4]
    arm, sharp = enu - enu.mean(0), 1 / sigma[seen]
    want = np.column_stack([enu[seen], arm[seen], points[seen], sharp, np.minimum((0.05 * sharp) ** 2, 1)])
    np.testing.assert_allclose(out, want)
    assert (bar == 4).all()


def test_halves_of_bars() -> None:
    rng = np.random.default_rng(11)
    points, sights = rng.normal(size=(11, 10)), rng.normal(size=(11, 3))
    bar = np.repeat([0, 1, 2], [6, 4, 1])
    sights[2] = np.nan
    enu, mean = np.zeros((6, 3)), np.zeros((6, 3))
    assert _kernels.halves(points, bar, sights, enu, mean) == 5
    for i, rows in enumerate(([0, 1], [3, 4, 5], [6, 7], [8, 9], [10])):
        np.testing.assert_allclose(enu[i], points[rows, :3].mean(0))
        total = sights[rows].sum(0)
        np.testing.assert_allclose(mean[i], total / np.linalg.norm(total))


def bar_bound(p: Problem, b: int, position: Floats, fault_m: float) -> Floats:
    """A bar moved and turned about its centre looks as to a camera that did the reverse about it."""
    if fault_m == 0:
        return np.zeros((6, 6))
    row = p.points[p.bar == b][0]
    centre = row[:3] - row[3:6]
    by_move = np.concatenate([-np.eye(3), np.zeros((3, 3))], 1)
    by_turn = np.concatenate([np.cross(np.eye(3), centre - position), -np.eye(3)], 1)
    causes = np.concatenate([fault_m * by_move, math.radians(5.0) * by_turn])
    return np.linalg.inv(causes.T @ causes)


@pytest.mark.parametrize("offset", [0.0, 0.1, 5.0])
def test_how_far_bars_are_from_a_line(offset: float) -> None:
    rng = np.random.default_rng(16)
    bar = np.repeat([0, 1, 2, 3], [5, 7, 4, 6])
    line = np.array([[0, 0, offset], [3, 6, 0], [6, 12, 0], [9, 18, 0]])
    points = rng.normal(0, 0.01, (len(bar), 10))
    points[:, :3] += line[bar]
    centres = np.stack([points[bar == b, :3].mean(0) for b in range(4)])
    extent = np.linalg.svd(centres - centres.mean(0), compute_uv=False)
    assert _kernels.flatness(points, bar, 4) == pytest.approx(extent[1] / extent[0], rel=1e-6)


@pytest.mark.parametrize(("bars", "bar_fault_m"), [(2, 0.5), (3, 0.0)])
def test_a_fit_is_judged_as_by_numpy(bars: int, bar_fault_m: float) -> None:
    """Covariance, causes, tests of each part and protection levels, written out anew."""
    p, position, rotation = problem(np.random.default_rng(12), bars, noise=1.0)
    p = dataclasses.replace(p, spec=dataclasses.replace(p.spec, bar_fault_m=bar_fault_m))
    fit = fit_pose(p, Fit.at(p, position, rotation))
    assert fit.settled
    found = judged(p, fit)
    assert isinstance(found, Judged)
    normal, pose = normal_equations(p, fit), found.pose
    free = np.flatnonzero(p.free)
    spread = np.zeros((14, 14))
    spread[np.ix_(free, free)] = np.linalg.inv(normal.whole[np.ix_(free, free)])
    np.testing.assert_allclose(pose.covariance, spread[:6, :6], rtol=1e-6, atol=1e-12)
    slow = spread[:3] @ normal.pixel.sum(0) @ spread[:3].T
    np.testing.assert_allclose(pose.slow, slow, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(pose.standing["camera"], -spread[:3, 7:], rtol=1e-6, atol=1e-9)
    assert p.attitude is not None
    angles = spread[:3] @ normal.rows.T @ p.white @ p.attitude.standing()
    np.testing.assert_allclose(pose.standing["attitude"], angles, rtol=1e-6, atol=1e-9)
    for b in range(bars):
        moves = spread[:3] @ normal.gain[b, 2:].T
        np.testing.assert_allclose(pose.standing[f"bar {b}"], moves, rtol=1e-6, atol=1e-9)
    sizes, directions = np.linalg.eigh(spread[:3, :3])
    wide = math.sqrt(sizes[-1])
    assert abs(directions[:, -1] @ pose.along) == pytest.approx(1)
    by_camera, by_bar = [], []
    for sigmas in (2.0, -2.0):
        there = moved(p, fit, normal, spread[:, :3] @ pose.along * sigmas / wide)
        # Errors of the sites take up what is left of second order.
        after = normal_equations(p, moved(p, there, normal_equations(p, there), np.zeros(14)))
        spread_there = np.zeros((14, 14))
        spread_there[np.ix_(free, free)] = np.linalg.inv(after.whole[np.ix_(free, free)])
        by_camera.append(-spread_there[:3, 7:])
        by_bar.append(spread_there[:3] @ after.gain[0, 2:].T)
    for name, (plus, minus) in (("camera", by_camera), ("bar 0", by_bar)):
        np.testing.assert_allclose(
            pose.standing_slope[name], (plus - minus) / (4 * wide), rtol=1e-5, atol=1e-9
        )
    rest = spread[:3, :3] - slow - sum(m @ m.T for m in pose.standing.values())
    values, axes = np.linalg.eigh((rest + rest.T) / 2)
    np.testing.assert_allclose(pose.noise, (axes * np.maximum(values, 1e-12)) @ axes.T, atol=1e-11)

    focal = normal.info.sum(0)[:, [6]]
    bound = np.linalg.inv(math.radians(1.0) ** 2 * p.white @ p.white.T)
    parts = {
        f"bar {b}": (
            *(normal.info[b, :6, :6], normal.info[b, :, :6], normal.right[b, :6]),
            bar_bound(p, b, fit.position, bar_fault_m),
        )
        for b in range(bars)
    }
    parts["focal length"] = focal[6:7], focal, normal.right.sum(0)[6:7], np.eye(1)
    parts["attitude"] = np.eye(3), normal.rows.T, normal.miss, bound
    parts["heading"] = np.eye(1), normal.rows[2:].T, normal.miss[2:], bound[2:, 2:]
    levels = [(0.0, np.zeros((3, 3)), np.zeros((3, 3)))]
    for name, (own, column, side, prior) in parts.items():
        column = np.where(p.free[:, None], column, 0)
        value, freed, added, unseen = _kernels.tested(own, column, side, spread, prior, 1e-4)
        assert found.tests[name] == pytest.approx(value, rel=1e-6)
        if name != "heading":
            levels.append((stats.chi2.isf(SPEC.false_alarm / 2 / len(parts), freed), added, unseen))
    hidden = np.max([np.sqrt(limit * np.diag(unseen)) for limit, _, unseen in levels], axis=0)
    np.testing.assert_allclose(pose.hidden_m, hidden, rtol=1e-6)

    def level(limit: float, added: Floats, unseen: Floats, axis: slice) -> float:
        moved_m = limit * np.linalg.eigvalsh(unseen[axis, axis])[-1]
        off_m = stats.chi2.isf(SPEC.risk, axis.stop - axis.start)
        return math.sqrt(moved_m) + math.sqrt(
            off_m * np.linalg.eigvalsh((spread[:3, :3] + added)[axis, axis])[-1]
        )

    for given, axis in ((pose.hpl_m, slice(0, 2)), (pose.vpl_m, slice(2, 3))):
        want = max(level(*each, axis) for each in levels)
        assert given == pytest.approx(want, rel=1e-6) or (math.isinf(given) and want > SPEC.max_protection_m)


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
    out = np.zeros((6, 6))
    _kernels.doubted(spread, angles, seen[30:] - angles @ at, rarely, larger, out)
    np.testing.assert_allclose(out, want, rtol=1e-3, atol=1e-6)
    assert (np.trace(out) > 0.1 * np.trace(spread[:6, :6])) == (off > 5)


def test_halves_are_weighted_means() -> None:
    p, _, _ = problem(np.random.default_rng(14), bars=3)
    few = p.halved()
    assert few.bar.tolist() == [0, 0, 1, 1, 2, 2]
    for i in range(6):
        rows = p.points[8 * i : 8 * i + 8]
        weight = rows[:, 8] ** 2
        np.testing.assert_allclose(few.points[i, :8], weight @ rows[:, :8] / weight.sum())
        assert few.points[i, 8] == pytest.approx(math.sqrt(weight.sum()))


def test_sights_are_unit_vectors() -> None:
    flat, out = np.random.default_rng(15).normal(size=(5, 2)), np.zeros((5, 3))
    flat[2] = np.nan
    assert _kernels.sights(flat, out) == 4
    want = np.column_stack([flat, np.ones(5)])
    np.testing.assert_allclose(
        out[[0, 1, 3, 4]], (want / np.linalg.norm(want, axis=1)[:, None])[[0, 1, 3, 4]]
    )
    assert np.isnan(out[2, :2]).all()


def test_headings_are_tried_to_a_fraction_of_a_degree() -> None:
    """Against SciPy's search in each valley; the true heading is among them."""
    rng = np.random.default_rng(16)
    level = Attitude(5.0, -3.0, 0.0).rotation()
    true = Rotation.from_rotvec([0, 0, 0.777]).as_matrix() @ level
    enu = true @ (rng.uniform(-1, 1, (3, 4)) * [[4], [2], [5]] + [[0], [0], [40]])
    sights = (enu / np.linalg.norm(enu, axis=0)).T @ true
    places, turned = np.zeros((4, 3)), np.zeros((4, 3, 3))
    found = _kernels.level_starts(enu.T.copy(), sights, level, 72, places, turned)
    assert 1 <= found <= 4
    assert Rotation.from_matrix(turned[0].T @ true).magnitude() < math.radians(0.05)
    assert np.linalg.norm(places[0]) < 0.05
    upright = turned[:found, 2]
    np.testing.assert_allclose(upright, np.tile(level[2], (found, 1)), atol=1e-12)


def test_the_widest_triangle_of_bars() -> None:
    rng = np.random.default_rng(17)
    corners = np.array([[0.0, 0, 0], [8, 0, 0], [0, 9, 0], [1, 1, 0]])
    points, bar = np.repeat(corners, 3, 0), np.repeat(np.arange(4), 3)
    seen = rng.normal(size=(12, 3))
    seen[4] = np.nan
    enu, mean = np.zeros((3, 3)), np.zeros((3, 3))
    _kernels.widest_three(points, bar, seen, 4, enu, mean)
    np.testing.assert_allclose(enu, corners[:3])
    for i in range(3):
        total = np.nansum(seen[bar == i], 0)
        np.testing.assert_allclose(mean[i], total / np.linalg.norm(total))


def test_what_is_missed_are_squares_of_angles() -> None:
    rng = np.random.default_rng(18)
    points = rng.normal(size=(6, 3)) + np.array([0, 0, 20])
    seen = rng.normal(size=(6, 3)) * 0.02 + np.array([0, 0, 1])
    seen /= np.linalg.norm(seen, axis=1)[:, None]
    seen[3] = np.nan
    places, turns = rng.normal(size=(2, 3)), Rotation.random(2, random_state=rng).as_matrix()
    costs = np.zeros(2)
    _kernels.missed(points, seen, places, turns, costs)
    for place, turn, cost in zip(places, turns, costs, strict=True):
        away = (points - place) @ turn
        away /= np.linalg.norm(away, axis=1)[:, None]
        assert cost == pytest.approx(np.nansum((away - seen) ** 2))


@pytest.mark.parametrize("seed", range(4))
def test_starts_lead_to_where_all_points_do(seed: int) -> None:
    """The fit to a few points is within what noise makes of the one to all; nothing far off is hidden."""
    p, position, _ = problem(np.random.default_rng(20 + seed), bars=3, noise=1.0)
    for told in (p, p.told(dataclasses.replace(p.attitude, heading_deg=None)), p.told(None)):
        assert isinstance(told, Problem)
        starts = likely_starts(told)
        fit = fit_pose(told, starts[0])
        sigma = np.sqrt(np.diag(np.linalg.inv(normal_equations(told, fit).whole))[:3])
        assert fit.settled
        assert np.abs((starts[0].position - fit.position) / sigma).max() < 1.0
        assert np.abs((position - fit.position) / sigma).max() < 5


def test_a_fit_that_stalls_far_off_ends() -> None:
    """A site that is metres off: hopeless from the start of the search, and after few steps."""
    p, position, rotation = problem(np.random.default_rng(30), bars=2, noise=1.0)
    wrong = p.points.copy()
    wrong[p.bar == 1, 0] += 30.0
    p = dataclasses.replace(p, points=wrong)
    start = Fit.at(p, position, rotation)
    whole, short = fit_pose(p, start, robust=False), fit_pose(p, start, robust=False, hopeless=1000.0)
    assert short.settled
    assert short.cost > 1000
    assert whole.cost <= short.cost < 3 * whole.cost


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
    spec = PositionSpec(shared_along_px=0.05, shared_share=0.002, stretch_share=0.003)
    view = BarView(0, enu_m, points, np.full(len(enu_m), 0.1), (0.1, 0.2, 0.004))
    shift, *site = shared_sigmas(view, seen, spec, 1.0)
    assert shift == pytest.approx(math.hypot(0.05, 0.002 * 250 * length_m), rel=1e-9)
    assert site == pytest.approx([0.1, 0.2, 0.005])
