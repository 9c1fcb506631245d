"""Positions: slopes against differences, known poses, honest sigmas, refusals."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.fit_assessment import Pose
from evlcp_sdk.place.observations import BarView, Problem, project_bars
from evlcp_sdk.place.pose import estimate_fault, fitting_focal_mm, solve_pose
from evlcp_sdk.place.rejections import REJECTION_REASONS, Rejection
from evlcp_sdk.place.starts import three_point_poses
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel, CameraSigma

CAMERA = CameraModel()
BENT = CameraModel(k1=-0.3, k2=0.1, p1=1e-3, p2=-1e-3, centre_x_px=655.0, centre_y_px=350.0)
POINT_ONLY = ErrorModel(
    shaken_sigma_px=0, shared_sigma_px=0, shared_along_px=0, shared_share=0, stretch_share=0
)
LEVEL = Attitude(gravity_sigma_deg=0)
UP = Attitude(pitch_deg=5.0, heading_deg=0.0)
"""The camera looks up by 5 degrees, as it must to see bars on poles 4 m above it at 50 m."""

POLES = [(-4.0, 50.0, 4.5), (4.0, 50.0, 4.5)]
THREE = [(-4.0, 50.0, 4.5), (4.0, 50.0, 5.5), (0.0, 40.0, 3.5)]


def bar(
    place: tuple[float, float, float], axis: tuple[float, float, float] = (0, 0, 1)
) -> NDArray[np.float64]:
    along = (0.5 - (np.arange(16) + 0.5) / 16) * 0.96
    return np.array(place) + along[:, None] * np.array(axis, float)


def views(
    bars: list[NDArray[np.float64]], position: NDArray[np.float64], rotation: NDArray[np.float64],
    rng: np.random.Generator | None = None, noise_px: float = 0.3, camera: CameraModel = CAMERA,
    across: float = 1.0,
) -> list[BarView]:  # fmt: skip
    seen = []
    for i, enu in enumerate(bars):
        points, _ = project_bars(enu, position, rotation, camera)
        if rng is not None:
            way = (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0])
            off = rng.normal(0, noise_px, points.shape)
            points = points + across * off + (1 - across) * np.outer(off @ way, way)
        seen.append(BarView(i, enu, points, np.full(len(enu), noise_px), across=across))
    return seen


def solved(found: Pose | Rejection) -> Pose:
    assert isinstance(found, Pose), found
    return found


@given(st.floats(-180, 180), st.floats(-60, 60), st.floats(-180, 180))
def test_attitude_is_the_named_turns(heading: float, pitch: float, roll: float) -> None:
    # SciPy's intrinsic turns about the camera's own axes: right (y, down), up (x), roll (z, forward).
    level = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    turns = Rotation.from_euler("YXZ", [heading, pitch, roll], degrees=True).as_matrix()
    np.testing.assert_allclose(Attitude(pitch, roll, heading).rotation(), level @ turns, atol=1e-12)
    back = Attitude.of_rotation(level @ turns)
    np.testing.assert_allclose(back.rotation(), level @ turns, atol=1e-7)


@given(st.integers(0, 2**32 - 1))
def test_slopes_are_the_numerical_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = Attitude(*rng.uniform(-30, 30, 2), rng.uniform(0, 360)).rotation()
    position = rng.uniform(-100, 100, 3)
    enu = position + rotation @ np.array([rng.uniform(-2, 2), rng.uniform(-1, 1), rng.uniform(20, 60)])

    def image(unknown: NDArray[np.float64]) -> NDArray[np.float64]:
        turned = Rotation.from_rotvec(unknown[3:]).as_matrix() @ rotation
        return project_bars(enu[None], position + unknown[:3], turned, BENT)[0][0]

    _, slope = project_bars(enu[None], position, rotation, BENT)
    want = approx_fprime(np.zeros(6), image, 1e-6)
    np.testing.assert_allclose(slope[0], want, rtol=1e-5, atol=2e-2)


@given(st.integers(0, 2**32 - 1))
def test_three_points_give_their_pose_among_the_solutions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    position = rng.uniform(-50, 50, 3)
    seen = np.stack([rng.uniform(-8, 8, 3), rng.uniform(-5, 5, 3), rng.uniform(10, 40, 3)], 1)
    enu = position + seen @ rotation.T
    sights = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    sides = np.linalg.norm(np.cross(enu[1] - enu[0], enu[2] - enu[0]))
    found = three_point_poses(enu, sights)
    off = [np.linalg.norm(p - position) for p, _ in found]
    # A triangle seen nearly edge on has nearly double roots, of which half the digits are lost.
    if sides > 5:
        assert min(off) < 0.5
        _, best = found[int(np.argmin(off))]
        assert np.linalg.det(best) == pytest.approx(1)


@pytest.mark.parametrize("camera", [CAMERA, BENT])
@pytest.mark.parametrize(
    ("places", "known"),
    [
        (THREE[:1], Attitude(4.0, -2.0, 123.0, 0.1, 0.1)),
        (THREE[:1], Attitude(4.0, -2.0, 123.0, 0.0, 0.0)),
        (THREE[:2], Attitude(4.0, -2.0, None, 0.0)),
        (THREE[:2], Attitude(4.0, -2.0, None, 0.01)),
        (THREE, Attitude(4.0, -2.0, None, 0.2)),
        (THREE, None),
    ],
)
def test_without_noise_the_pose_is_exact(
    camera: CameraModel, places: list[tuple[float, float, float]], known: Attitude | None
) -> None:
    # The whole scene is turned to the heading of 123 degrees and moved.
    rotation = Attitude(4.0, -2.0, 123.0).rotation()
    turn = Rotation.from_euler("z", -123, degrees=True).as_matrix()
    position = np.array([310.0, -95.0, 12.0])
    bars = [position + (bar(p, (0.05, 0.02, 1.0))) @ turn.T for p in places]
    pose = solved(solve_pose(views(bars, position, rotation, camera=camera), camera, known))
    np.testing.assert_allclose(pose.enu_m, position, atol=1e-3)
    np.testing.assert_allclose(pose.rotation, rotation, atol=2e-5)
    assert pose.transmitters == tuple(range(len(places)))


def monte_carlo(
    places: list[tuple[float, float, float]], known: Attitude | None, trials: int = 200
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors in space, m, and normalised squared errors, of a camera at the origin that looks up."""
    rng = np.random.default_rng(7)
    bars, rotation = [bar(p) for p in places], UP.rotation()
    error, square = np.empty(trials), np.empty(trials)
    for i in range(trials):
        said = known
        if said is not None:
            tilt, turn = said.gravity_sigma_deg, said.heading_sigma_deg
            said = Attitude(
                UP.pitch_deg + tilt * rng.normal(),
                UP.roll_deg + tilt * rng.normal(),
                None if said.heading_deg is None else turn * rng.normal(),
                tilt,
                turn,
            )
        pose = solved(solve_pose(views(bars, np.zeros(3), rotation, rng), CAMERA, said, POINT_ONLY))
        error[i] = np.linalg.norm(pose.enu_m)
        square[i] = pose.enu_m @ np.linalg.solve(pose.covariance[:3, :3], pose.enu_m)
    return error, square


@pytest.mark.parametrize(
    ("places", "known", "median_m", "most_m"),
    [
        (POLES, LEVEL, 0.06, 0.15),
        ([(-4.0, 50.0, 4.5), (3.5, 45.0, 4.5)], LEVEL, 0.06, 0.15),
        (THREE, LEVEL, 0.02, 0.03),
        (THREE, None, 0.02, 0.03),
        (POLES[:1], Attitude(heading_deg=0.0, gravity_sigma_deg=0.0, heading_sigma_deg=0.1), 0.2, 0.35),
        (POLES[:1], Attitude(heading_deg=0.0, gravity_sigma_deg=0.1, heading_sigma_deg=0.1), 0.2, 0.35),
    ],
)
def test_errors_at_50_m_and_their_sigmas(
    places: list[tuple[float, float, float]], known: Attitude | None, median_m: float, most_m: float
) -> None:
    error, square = monte_carlo(places, known)
    assert np.median(error) <= median_m
    assert np.quantile(error, 0.95) <= most_m
    low, high = stats.chi2.interval(0.95, 3 * len(square)) / np.array(len(square))
    # The normalised error squared within its 95 % band, by 3 % for what is not linear.
    assert low / 1.03 < square.mean() < high * 1.03


def own_shift(
    points_px: NDArray[np.float64], spec: ErrorModel, rng: np.random.Generator
) -> NDArray[np.float64]:
    """By what a bar's points are off alike, drawn across the bar and along it."""
    whole = points_px[-1] - points_px[0]
    long_px = float(np.linalg.norm(whole)) * 16 / 15
    along = whole / np.linalg.norm(whole)
    longways = math.hypot(spec.shared_along_px, spec.shared_share * long_px)
    across = np.array([-along[1], along[0]])
    return rng.normal(0, longways) * along + rng.normal(0, spec.shared_sigma_px) * across


def test_an_error_that_a_bars_points_share_is_accounted_for() -> None:
    rng = np.random.default_rng(3)
    bars, rotation = [bar(p) for p in THREE], UP.rotation()
    spec, square = dataclasses.replace(POINT_ONLY, shared_sigma_px=0.1, shared_along_px=0.3), []
    for _ in range(200):
        seen = [
            BarView(v.transmitter, v.enu_m, v.points_px + own_shift(v.points_px, spec, rng), v.sigma_px)
            for v in views(bars, np.zeros(3), rotation, rng, 0.1)
        ]
        pose = solved(solve_pose(seen, CAMERA, Attitude(5.0, 0.0, None, 0.0), spec))
        square.append(pose.enu_m @ np.linalg.solve(pose.covariance[:3, :3], pose.enu_m))
    low, high = stats.chi2.interval(0.95, 3 * 200)
    assert low / 200 < np.mean(square) < high / 200


@pytest.mark.parametrize(("places", "heading"), [(POLES[:1], 0.0), (POLES, None), (POLES, 0.0)])
def test_an_error_that_all_bars_share_is_that_of_an_exact_attitude(
    places: list[tuple[float, float, float]], heading: float | None
) -> None:
    rng, spec = np.random.default_rng(4), dataclasses.replace(POINT_ONLY, shaken_sigma_px=0.5)
    bars, rotation, square = [bar(p) for p in places], UP.rotation(), []
    for _ in range(200):
        shaken = rng.normal(0, 0.5, 2)
        seen = [
            BarView(v.transmitter, v.enu_m, v.points_px + shaken, v.sigma_px)
            for v in views(bars, np.zeros(3), rotation, rng, 0.1)
        ]
        pose = solved(solve_pose(seen, CAMERA, Attitude(5.0, 0.0, heading, 0.0, 0.0), spec))
        square.append(pose.enu_m @ np.linalg.solve(pose.covariance[:3, :3], pose.enu_m))
    low, high = stats.chi2.interval(0.99, 3 * 200)
    assert low / 200 < np.mean(square) < high / 200


@pytest.mark.parametrize("heading", [None, 0.0])
@pytest.mark.parametrize("between", [(0.3, 5.3), (5.3, 5.3), (0.0, 1.0)])
def test_bars_whose_frames_leave_gaps_at_other_times_err_apart(
    between: tuple[float, float], heading: float | None
) -> None:
    """The image moves as one, and each bar's place is interpolated by its own frames."""
    rng, spec = np.random.default_rng(6), dataclasses.replace(POINT_ONLY, shaken_sigma_px=0.1)
    bars, rotation, square = [bar(p) for p in POLES], UP.rotation(), []
    for _ in range(200):
        shaken = rng.normal(0, 0.1, 2)
        seen = [
            dataclasses.replace(view, points_px=view.points_px + shaken * gap, between=gap)
            for view, gap in zip(views(bars, np.zeros(3), rotation, rng, 0.05), between, strict=True)
        ]
        pose = solved(solve_pose(seen, CAMERA, Attitude(5.0, 0.0, heading, 0.0, 0.0), spec))
        square.append(pose.enu_m @ np.linalg.solve(pose.covariance[:3, :3], pose.enu_m))
    # What bars have for their own counts as independent of what they share, though it is the same motion.
    assert 2.2 < np.mean(square) < 3.6


def test_noise_and_what_was_said_make_up_the_covariance() -> None:
    seen = views([bar(POLES[0])], np.zeros(3), UP.rotation())
    told = Attitude(5.0, 0.0, 0.0, 0.1, 0.1)
    pose = solved(solve_pose(seen, CAMERA, told, POINT_ONLY))
    exact = solved(solve_pose(seen, CAMERA, Attitude(5.0, 0.0, 0.0, 0.0, 0.0), POINT_ONLY))
    np.testing.assert_allclose(pose.noise + pose.slow, exact.covariance[:3, :3], atol=2e-4)
    # 0.1 degrees at 50 m, across.
    aside = float(np.linalg.norm(pose.standing["attitude"][0]))
    assert aside == pytest.approx(50 * math.radians(0.1), rel=0.02)


SURVEY = (0.05, math.radians(0.3), 0.002)
"""A survey of 5 cm, 0.3 degrees and 2 mm in a metre."""


def drawn(
    rng: np.random.Generator, places: list[tuple[float, float, float]], known: Attitude | None,
    survey: tuple[float, float, float], focal: float, across: float = 1.0,
) -> tuple[list[BarView], Attitude | None, CameraSigma]:  # fmt: skip
    """A camera at the origin that looks up, with every error drawn from its stated sigma."""
    true = dataclasses.replace(CAMERA, focal_mm=CAMERA.focal_mm * (1 + focal * rng.normal()))
    spec, seen = ErrorModel(), []
    for view in views([bar(p) for p in places], np.zeros(3), UP.rotation(), rng, 0.1, true, across):
        arm = view.enu_m - view.enu_m.mean(0)
        said = view.enu_m + rng.normal(0, survey[0], 3) + np.cross(rng.normal(0, survey[1], 3), arm)
        said = said + rng.normal(0, survey[2]) * arm
        said = said + rng.normal(0, spec.stretch_share) * arm
        points = view.points_px + own_shift(view.points_px, spec, rng)
        seen.append(dataclasses.replace(view, enu_m=said, points_px=points, survey=survey))
    told = None
    if known is not None:
        # A bias of each angle, an offset in time that moves all of them, and noise.
        off = np.degrees(known.standing()) @ rng.normal(size=4) + rng.normal(0, known.white_sigma_deg, 3)
        heading = None if known.heading_deg is None else known.heading_deg + off[2]
        told = dataclasses.replace(
            known, pitch_deg=known.pitch_deg + off[0], roll_deg=known.roll_deg + off[1], heading_deg=heading
        )
    return seen, told, CameraSigma(focal_mm=focal * CAMERA.focal_mm)


@pytest.mark.parametrize(
    ("places", "known"),
    [
        (POLES[:1], Attitude(5.0, 0.0, 0.0, 0.1, 0.1)),
        (POLES[:1], Attitude(5.0, 0.0, 0.0, 0.02, 0.02, 0.05, 5000.0, (10.0, -5.0, 45.0))),
        (POLES, Attitude(5.0, 0.0, 0.0, 0.1, 0.1)),
        (POLES, Attitude(5.0, 0.0, None, 0.1)),
        (THREE, Attitude(5.0, 0.0, None, 0.1)),
        (THREE, None),
    ],
)
@pytest.mark.parametrize(("survey", "focal"), [(SURVEY, 0.0), ((0.0, 0.0, 0.0), 0.005), (SURVEY, 0.005)])
def test_every_error_that_is_stated_is_in_the_covariance(
    places: list[tuple[float, float, float]], known: Attitude | None,
    survey: tuple[float, float, float], focal: float,
) -> None:  # fmt: skip
    rng = np.random.default_rng(11)
    squares, parts = [], np.zeros((3, 3))
    while len(squares) < 120:
        seen, told, sigma = drawn(rng, places, known, survey, focal, across=0.5)
        found = solve_pose(seen, CAMERA, told, None, sigma)
        if isinstance(found, Rejection):
            # Two bars on gravity and a survey of 5 cm leave metres along an arc.
            assert found.kind in ("uncertain", "two-solutions"), found
            assert survey[0] > 0
            squares.append(3.0)
            continue
        squares.append(found.enu_m @ np.linalg.solve(found.covariance[:3, :3], found.enu_m))
        parts = found.noise + found.slow + sum(s @ s.T for s in found.standing.values())
        # What Huber's weights take from a few points is the difference.
        np.testing.assert_allclose(parts, found.covariance[:3, :3], rtol=0.05, atol=1e-4)
    assert squares.count(3.0) < 12
    low, high = stats.chi2.interval(0.999, 3 * len(squares)) / np.array(len(squares))
    assert low / 1.03 < np.mean(squares) < high * 1.03


@pytest.mark.parametrize("way", [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_bar_that_disagrees_is_left_out_by_name(which: int, way: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(13)
    for known in (Attitude(5.0, 0.0, 0.0, 0.1, 0.1), Attitude(5.0, 0.0, None, 0.1)):
        seen, told, _ = drawn(rng, THREE, known, (0.0, 0.0, 0.0), 0.0)
        seen[which] = dataclasses.replace(seen[which], enu_m=seen[which].enu_m + 0.5 * np.array(way))
        found = solve_pose(seen, CAMERA, told)
        if isinstance(found, Rejection):
            # A pair that stays cannot always tell which of three is wrong; it never says a place.
            assert found.kind == "misfit", found
            assert f"bar {which}" in found.detail or "not" in found.detail
            continue
        assert found.excluded == (f"bar {which}",)
        assert which not in found.transmitters
        assert found.enu_m @ np.linalg.solve(found.covariance[:3, :3], found.enu_m) < stats.chi2.isf(1e-5, 3)


def test_a_bar_that_is_left_out_stands_where_its_image_says() -> None:
    """As far off as it was moved, to within a covariance that holds."""
    rng = np.random.default_rng(33)
    squares = []
    for _ in range(40):
        known = Attitude(5.0, 0.0, 0.0, 0.1, 0.1)
        seen, told, _ = drawn(rng, THREE, known, (0.01, 0.0, 0.0), 0.0)
        moved_m = rng.normal(0, 0.5, 3)
        seen[1] = dataclasses.replace(seen[1], enu_m=seen[1].enu_m - moved_m)
        found = solve_pose(seen, CAMERA, told)
        if isinstance(found, Rejection) or found.excluded != ("bar 1",):
            continue
        failed = found.failed
        assert failed is not None
        assert failed.transmitter == 1
        assert failed.missed < 0.5
        assert failed.bias_m == pytest.approx(float(np.linalg.norm(failed.off_m)))
        off = failed.off_m - moved_m
        squares.append(off @ np.linalg.solve(failed.covariance_m2, off))
    low, high = stats.chi2.interval(0.999, 3 * len(squares)) / np.array(len(squares))
    assert len(squares) > 25
    assert low < np.mean(squares) < high


@pytest.mark.parametrize("across", [0.3, 1.0, 2.0])
def test_where_a_left_out_bar_stands_is_the_weighted_fit_of_its_points(across: float) -> None:
    """Generalized least squares with the points' whole covariance, along the bar and across."""
    rng, spec = np.random.default_rng(34), ErrorModel()
    known = Attitude(5.0, 0.0, 0.0, 0.1, 0.1)
    seen, told, sigma = drawn(rng, THREE, known, (0.0, 0.0, 0.0), 0.0, across)
    moved = dataclasses.replace(seen[1], enu_m=seen[1].enu_m - np.array([0.3, -0.4, 0.2]))
    pose = solved(solve_pose(seen, CAMERA, told, spec))
    exact = dataclasses.replace(pose, covariance=np.zeros_like(pose.covariance))
    problem = Problem.of([seen[0], moved, seen[2]], CAMERA, told, spec, sigma)
    assert isinstance(problem, Problem)
    found = estimate_fault(problem, 1, exact, 99.0, 5)
    way = moved.points_px[-1] - moved.points_px[0]
    size = float(np.linalg.norm(way))
    way = way / size
    beside = np.eye(2) - np.outer(way, way)
    shift = spec.shared_along_px**2 + (spec.shared_share * size * 16 / 15) ** 2
    each = 0.1**2 * (np.outer(way, way) + across**2 * beside)
    whole = np.kron(np.eye(16), each)
    whole += np.kron(np.ones((16, 16)), shift * np.outer(way, way) + spec.shared_sigma_px**2 * beside)
    off_m = np.zeros(3)
    for _ in range(6):
        points, slope = project_bars(moved.enu_m + off_m, pose.enu_m, pose.rotation, CAMERA)
        by_place = -slope[:, :, :3].reshape(-1, 3)
        weighted = np.linalg.solve(whole, by_place)
        information = by_place.T @ weighted
        off_m = off_m + np.linalg.solve(information, weighted.T @ (moved.points_px - points).ravel())
    np.testing.assert_allclose(found.off_m, off_m, atol=1e-5)
    np.testing.assert_allclose(found.covariance_m2, np.linalg.inv(information), rtol=1e-3, atol=1e-9)


def test_an_attitude_that_disagrees_is_left_out_by_name() -> None:
    rng = np.random.default_rng(14)
    seen, told, _ = drawn(rng, THREE, Attitude(5.0, 0.0, 0.0, 0.1, 0.1), (0.0, 0.0, 0.0), 0.0)
    assert told is not None
    turned = solved(solve_pose(seen, CAMERA, dataclasses.replace(told, heading_deg=3.0)))
    assert turned.excluded == ("heading",)
    assert turned.failed is None
    assert abs(math.remainder(Attitude.of_rotation(turned.rotation).heading_deg or 0, 360)) < 0.3
    leaning = solved(solve_pose(seen, CAMERA, dataclasses.replace(told, roll_deg=2.0)))
    assert leaning.excluded == ("attitude",)
    for found in (turned, leaning):
        assert np.linalg.norm(found.enu_m) < 0.3


def test_two_bars_that_disagree_are_refused() -> None:
    """Either may be the wrong one; so may the heading."""
    rng = np.random.default_rng(15)
    seen, told, _ = drawn(rng, POLES, Attitude(5.0, 0.0, 0.0, 0.1, 0.1), (0.0, 0.0, 0.0), 0.0)
    seen[0] = dataclasses.replace(seen[0], enu_m=seen[0].enu_m + np.array([0.0, 0.0, 0.5]))
    found = solve_pose(seen, CAMERA, told)
    assert refused(found) == "misfit"
    assert isinstance(found, Rejection)
    assert "bar 0" in found.detail
    assert "bar 1" in found.detail


@pytest.mark.parametrize("said_mm", [12.0, 50.0])
def test_a_focal_length_that_is_another_lens_is_found(said_mm: float) -> None:
    """35 mm: two bars, of which one is nearer, are refused; of three, one is left out by mistake."""
    rng = np.random.default_rng(4)
    for places, known in ((THREE[1:], UP), (THREE, Attitude(pitch_deg=5.0))):
        seen = views([bar(p) for p in places], np.zeros(3), UP.rotation(), rng)
        said = dataclasses.replace(CAMERA, focal_mm=said_mm)
        found = solve_pose(seen, said, known)
        assert found.kind == "misfit" if isinstance(found, Rejection) else found.excluded
        assert fitting_focal_mm(seen, said, known) == pytest.approx(35.0, rel=0.04)


def test_no_focal_length_fits_a_bar_that_is_moved_aside() -> None:
    seen = views([bar(p) for p in THREE[1:]], np.zeros(3), UP.rotation(), np.random.default_rng(4))
    moved = dataclasses.replace(seen[0], enu_m=np.add(seen[0].enu_m, (0.0, 0.0, 0.5)))
    assert math.isnan(fitting_focal_mm([moved, seen[1]], CAMERA, UP))


def test_two_sites_mixed_up_are_not_a_third_bar_at_fault() -> None:
    """From behind, two upright bars are seen the other way round, and only the third is in the way."""
    rng = np.random.default_rng(16)
    bars = [bar((-2.0, 50.0, 4.5)), bar((2.0, 54.0, 4.5)), bar((0.0, 58.0, 5.5), (1, 0, 0.02))]
    seen = views(bars, np.zeros(3), UP.rotation(), rng, 0.1)
    mixed = [
        dataclasses.replace(seen[0], enu_m=seen[1].enu_m),
        dataclasses.replace(seen[1], enu_m=seen[0].enu_m),
        seen[2],
    ]
    behind = solve_pose(mixed[:2], CAMERA, Attitude(5.0, 0.0, None, 0.1))
    assert isinstance(behind, Pose)
    assert np.linalg.norm(behind.enu_m) > 80
    found = solve_pose(mixed, CAMERA, Attitude(5.0, 0.0, None, 0.1))
    assert refused(found) == "misfit"
    assert isinstance(found, Rejection)
    assert "bar 0 at the site of bar 1 and the reverse" in found.detail


def test_protection_levels_cover_what_no_test_finds() -> None:
    """Faults of every size, most of them too small to be found: none of these few is beyond a level."""
    rng = np.random.default_rng(16)
    hidden = 0
    for trial in range(60):
        three = trial % 2
        seen, told, _ = drawn(
            rng, THREE if three else POLES, Attitude(5.0, 0.0, 0.0, 0.1, 0.1), (0.0, 0.0, 0.0), 0.0
        )
        assert told is not None
        camera, size = CAMERA, 10 ** rng.uniform(-2, 0)
        which = trial % 3
        if which == 0:
            seen[0] = dataclasses.replace(seen[0], enu_m=seen[0].enu_m + size * rng.normal(size=3))
        elif which == 1:
            told = dataclasses.replace(told, pitch_deg=told.pitch_deg + size)
        else:
            camera = dataclasses.replace(CAMERA, focal_mm=CAMERA.focal_mm * (1 + 0.01 * size))
        found = solve_pose(seen, camera, told)
        if isinstance(found, Rejection) or math.isinf(found.hpl_m):
            continue
        assert math.hypot(*found.enu_m[:2]) < found.hpl_m
        assert abs(found.enu_m[2]) < found.vpl_m
        square = found.enu_m @ np.linalg.solve(found.covariance[:3, :3], found.enu_m)
        hidden += square > stats.chi2.isf(0.0027, 3)
    assert hidden > 8


def test_a_lone_bar_has_no_protection() -> None:
    seen, told, _ = drawn(
        np.random.default_rng(17), POLES[:1], Attitude(5.0, 0.0, 0.0, 0.1, 0.1), (0.0, 0.0, 0.0), 0.0
    )
    pose = solved(solve_pose(seen, CAMERA, told))
    assert math.isinf(pose.hpl_m)
    assert math.isinf(pose.vpl_m)


def test_a_lone_bar_is_protected_from_being_off_by_so_much() -> None:
    rng, spec = np.random.default_rng(18), ErrorModel(bar_fault_m=0.5)
    level = Attitude(5.0, 0.0, 0.0, 0.1, 0.1)
    for _ in range(60):
        (seen,), told, _ = drawn(rng, POLES[:1], level, (0.0, 0.0, 0.0), 0.0)
        moved = dataclasses.replace(seen, enu_m=seen.enu_m + rng.normal(0, 0.5, 3))
        pose = solved(solve_pose([moved], CAMERA, told, spec))
        assert math.hypot(*pose.enu_m[:2]) < pose.hpl_m < 6
        assert abs(pose.enu_m[2]) < pose.vpl_m < 6


def test_two_bars_that_may_be_mixed_up_are_protected_as_far_as_behind_them() -> None:
    """On gravity alone, two that stand alike fit from behind, too, each at the other's site: 100 m away."""
    rng, spec = np.random.default_rng(19), ErrorModel(bar_fault_m=0.5)
    for other, alike in ((POLES[1], True), ((4.0, 46.0, 5.5), False)):
        seen = views([bar(POLES[0]), bar(other)], np.zeros(3), UP.rotation(), rng, 0.1)
        level = Attitude(5.0, 0.0, None, 0.1)
        pose = solved(solve_pose(seen, CAMERA, level, spec))
        assert math.isinf(pose.hpl_m) == alike
        if alike:
            mixed = [dataclasses.replace(v, enu_m=w.enu_m) for v, w in zip(seen, seen[::-1], strict=True)]
            behind = solved(solve_pose(mixed, CAMERA, level, spec))
            apart = np.hypot(*(behind.enu_m - pose.enu_m)[:2])
            reach = solved(solve_pose(seen, CAMERA, level, dataclasses.replace(spec, max_protection_m=300.0)))
            sigma = np.linalg.eigvalsh(behind.covariance[:2, :2])[-1] ** 0.5
            assert reach.hpl_m == pytest.approx(apart + stats.chi2.isf(1e-4, 2) ** 0.5 * sigma, rel=1e-6)


@pytest.mark.parametrize("what", ["attitude", "focal length"])
def test_levels_hold_for_faults_of_the_size_that_is_stated(what: str) -> None:
    """A lone bar, which shows neither: five times as large a fault is covered where it is stated only."""
    rng, level = np.random.default_rng(20), Attitude(5.0, 0.0, 0.0, 0.1, 0.1)
    usual = ErrorModel(bar_fault_m=0.01, attitude_fault_deg=0.1)
    if what == "attitude":
        stated = dataclasses.replace(usual, attitude_fault_deg=5.0)
        spared = dataclasses.replace(usual, attitude_fault_deg=0.0)
    else:
        stated = dataclasses.replace(usual, focal_fault=0.025)
        spared = dataclasses.replace(usual, focal_fault=0.0)
    outside = 0
    for trial in range(40):
        (seen,), told, _ = drawn(rng, POLES[:1], level, (0.0, 0.0, 0.0), 0.0)
        assert told is not None
        camera, off = CAMERA, (-1) ** trial * 2.0
        if what == "attitude":
            told = dataclasses.replace(told, heading_deg=(told.heading_deg or 0.0) + 5 * off)
        else:
            camera = dataclasses.replace(CAMERA, focal_mm=CAMERA.focal_mm * (1 + 0.025 * off))
        pose, other = (solved(solve_pose([seen], camera, told, spec)) for spec in (stated, usual))
        assert math.hypot(*pose.enu_m[:2]) < pose.hpl_m
        assert abs(pose.enu_m[2]) < pose.vpl_m
        outside += math.hypot(*other.enu_m[:2]) > other.hpl_m
        assert math.isinf(solved(solve_pose([seen], camera, told, spared)).hpl_m)
    assert outside > 20


def test_false_alarms_are_as_rare_as_said() -> None:
    """At a chance that can be counted: one of fifty."""
    rng, spec = np.random.default_rng(18), ErrorModel(false_alarm=0.02)
    alarms = 0
    for _ in range(200):
        seen, told, sigma = drawn(rng, THREE, Attitude(5.0, 0.0, 0.0, 0.1, 0.1), SURVEY, 0.002)
        found = solve_pose(seen, CAMERA, told, spec, sigma)
        alarms += isinstance(found, Rejection) or bool(found.excluded)
    # Tests of overlapping parts share alarms, and the total is counted by Huber: never more, and not none.
    assert 1 <= alarms <= stats.binom.isf(1e-3, 200, 0.02)


def test_a_point_out_of_place_does_not_matter() -> None:
    rng = np.random.default_rng(5)
    seen = views([bar(p) for p in THREE], np.zeros(3), UP.rotation(), rng, 0.1)
    clean = solved(solve_pose(seen, CAMERA, Attitude(5.0, 0.0, None, 0.0)))
    seen[1].points_px[3] += 40
    pose = solved(solve_pose(seen, CAMERA, Attitude(5.0, 0.0, None, 0.0)))
    assert np.linalg.norm(pose.enu_m - clean.enu_m) < 0.02


@pytest.mark.parametrize("gravity_sigma_deg", [0.0, 0.1])
def test_a_lone_bar_and_a_poor_compass(gravity_sigma_deg: float) -> None:
    """Half a degree is a compass's usual error: 0.44 m at 50 m, along an arc 8 mm off its tangent."""
    rng = np.random.default_rng(5)
    spec = dataclasses.replace(POINT_ONLY, shared_sigma_px=0.1, shared_along_px=0.1)
    squares = []
    for _ in range(60):
        told = Attitude(
            5.0 + rng.normal(0, gravity_sigma_deg), rng.normal(0, gravity_sigma_deg),
            rng.normal(0, 0.5), gravity_sigma_deg, 0.5,
        )  # fmt: skip
        (seen,) = views([bar(POLES[0])], np.zeros(3), UP.rotation(), rng, 0.1)
        seen.points_px[:] += rng.normal(0, spec.shared_sigma_px, 2)
        pose = solved(solve_pose([seen], CAMERA, told, spec))
        squares.append(pose.enu_m @ np.linalg.solve(pose.covariance[:3, :3], pose.enu_m))
    assert stats.chi2.isf(0.999, 180) < sum(squares) < stats.chi2.isf(0.001, 180)


def refused(found: Pose | Rejection) -> str:
    assert isinstance(found, Rejection), found
    assert found.kind in REJECTION_REASONS
    assert found.detail
    return found.kind


def test_what_is_not_determined_is_refused() -> None:
    rng = np.random.default_rng(1)
    here, rotation = np.zeros(3), UP.rotation()
    known = Attitude(5.0, 0.0, 0.0, 0.1, 0.1)
    gravity = Attitude(5.0, 0.0, None, 0.0)

    def seen(*places: tuple[float, float, float]) -> list[BarView]:
        return views([bar(p) for p in places], here, rotation, rng, 0.1)

    assert refused(solve_pose([], CAMERA, known)) == "too-few-clusters"
    (few,) = seen(POLES[0])
    few.points_px[5:] = np.nan
    assert refused(solve_pose([few], CAMERA, known)) == "too-few-clusters"
    assert refused(solve_pose(seen(POLES[0]), CAMERA, gravity)) == "heading-unknown"
    assert refused(solve_pose(seen(*POLES), CAMERA, None)) == "gravity-unknown"
    line = [(-4.0, 50.0, 4.5), (0.0, 50.0, 4.5), (4.0, 50.0, 4.5)]
    assert refused(solve_pose(seen(*line), CAMERA, None)) == "gravity-unknown"
    # Hardly beside the line, and clearly.
    line[1] = (0.0, 50.0, 4.54)
    assert refused(solve_pose(seen(*line), CAMERA, None)) == "gravity-unknown"
    line[1] = (0.0, 50.0, 4.9)
    solved(solve_pose(seen(*line), CAMERA, None))
    # At the camera's own height, two bars leave a circle through them; ranges alone say where on it.
    level = views([bar((-3.0, 50.0, 0.0)), bar((3.0, 50.0, 0.0))], here, Attitude().rotation(), rng, 0.3)
    assert refused(solve_pose(level, CAMERA, LEVEL)) in ("uncertain", "not-determined", "two-solutions")
    assert refused(solve_pose(seen(POLES[0]), CAMERA, known, ErrorModel(max_sigma_m=0.01))) == "uncertain"
    # A bar that points at the camera.
    sight = np.array(POLES[0]) / np.linalg.norm(POLES[0])
    end_on = bar(POLES[0], tuple(sight + np.array([0.1, 0, 0])))
    assert refused(solve_pose(views([end_on], here, rotation), CAMERA, known)) == "end-on"
    # Two bars exchanged; a bar that stands elsewhere.
    one, two = seen(*POLES)
    swapped = [
        BarView(0, two.enu_m, one.points_px, one.sigma_px),
        BarView(1, one.enu_m, two.points_px, two.sigma_px),
    ]
    assert refused(solve_pose(swapped, CAMERA, known)) in ("misfit", "not-determined")
    three = seen(*THREE)
    moved = [
        *three[:2],
        BarView(2, three[2].enu_m + np.array([1.0, 0, 0]), three[2].points_px, three[2].sigma_px),
    ]
    found = solved(solve_pose(moved, CAMERA, gravity))
    assert found.excluded == ("bar 2",)
    assert found.transmitters == (0, 1)
    assert np.linalg.norm(found.enu_m) < 0.1


def test_both_poses_are_told_where_two_fit() -> None:
    """Two small bars, noisy and far: seen alike from the side, too. One of them is the truth."""
    rng = np.random.default_rng(0)
    bars = [0.1 * bar((0, 0, 0)) + [-2.6, 58.4, 3.9], 0.1 * bar((0, 0, 0)) + [0.5, 57.1, 5.8]]
    seen = views(bars, np.zeros(3), UP.rotation(), rng, 1.0)
    found = solve_pose(seen, CAMERA, Attitude(5.0, 0.0, None, 0.1), POINT_ONLY)
    assert refused(found) == "two-solutions"
    assert isinstance(found, Rejection)
    likelihoods = [one.likelihood for one in found.candidates]
    assert likelihoods[0] == 1
    assert 1e-4 < likelihoods[1] < 1
    right = found.candidates[0]
    assert right.enu_m @ np.linalg.solve(right.covariance_m2, right.enu_m) < stats.chi2.isf(1e-4, 3)
    for one in found.candidates:
        image, _ = project_bars(np.concatenate(bars), one.enu_m, one.rotation, CAMERA)
        missed = image - np.concatenate([view.points_px for view in seen])
        assert np.sqrt((missed**2).mean()) < 1.5


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.sampled_from(["all", "gravity", "none"]))
def test_never_a_silent_wrong_position(seed: int, count: int, told: str) -> None:
    """Bars anywhere in view: what is given lies within its sigmas, or is refused."""
    rng = np.random.default_rng(seed)
    heading = rng.uniform(0, 360)
    true = Attitude(rng.uniform(-10, 10), rng.uniform(-10, 10), heading)
    rotation, position = true.rotation(), rng.uniform(-100, 100, 3)
    bars = []
    for _ in range(count):
        depth = rng.uniform(15, 100)
        aside = np.array([rng.uniform(-0.08, 0.08), rng.uniform(-0.04, 0.04), 1.0]) * depth
        axis = rng.normal(0, 0.1, 3) + np.array([0, 0, 1])
        bars.append(bar(tuple(position + rotation @ aside), tuple(axis / np.linalg.norm(axis))))
    known = {
        "all": Attitude(true.pitch_deg, true.roll_deg, heading, 0.05, 0.1),
        "gravity": Attitude(true.pitch_deg, true.roll_deg, None, 0.05),
        "none": None,
    }[told]
    found = solve_pose(views(bars, position, rotation, rng, 0.2), CAMERA, known, POINT_ONLY)
    if isinstance(found, Pose):
        error = found.enu_m - position
        assert error @ np.linalg.solve(found.covariance[:3, :3], error) < stats.chi2.isf(1e-7, 3)
    else:
        assert found.kind in REJECTION_REASONS


def test_a_pitch_of_the_wrong_sign_is_not_a_bar_at_fault() -> None:
    """Either bar alone agrees with it: one that leans away looks much as an upright one."""
    suspects = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        pitch = rng.uniform(2, 4)
        places = [(side, rng.uniform(48, 60), rng.uniform(2, 4)) for side in (-3.0, 3.0)]
        bars = [bar(place, (rng.normal(0, 0.01), rng.normal(0, 0.01), 1)) for place in places]
        seen = views(bars, np.zeros(3), Attitude(pitch, 0.0, 0.0).rotation(), rng, 0.07)
        found = solve_pose(seen, CAMERA, Attitude(-pitch, 0.0, 0.0, 0.1, 0.1))
        assert isinstance(found, Rejection)
        assert found.kind == "misfit"
        suspects.append(found.suspects)
    assert sum("attitude" in some for some in suspects) >= 15
