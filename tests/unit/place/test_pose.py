"""Positions: slopes against differences, known poses, honest sigmas, refusals."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import stats
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.fit import solve_three_points
from evlcp_sdk.place.fit_assessment import Pose
from evlcp_sdk.place.observations import BarView, Problem, Rejection, project_bars
from evlcp_sdk.place.pose import estimate_fault, search_focal_mm, solve_pose
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from tests.unit.place.place_scenes import POINTS_ONLY, Floats, bar, by_chance, square

CAMERA, USUAL = CameraModel(), ErrorModel()
BENT = CameraModel(k1=-0.3, k2=0.1, p1=1e-3, p2=-1e-3, centre_x_px=655.0, centre_y_px=350.0)
UP = Attitude(pitch_deg=5.0, heading_deg=0.0)
"""The camera looks up by 5 degrees, as it must to see bars on poles 4 m above it at 50 m."""
COMPASS, GRAVITY = Attitude(5.0, 0.0, 0.0, 0.1, 0.1), Attitude(5.0, 0.0, None, 0.1)
EXACT, LEVEL = Attitude(5.0, 0.0, 0.0, 0.0, 0.0), Attitude(5.0, 0.0, None, 0.0)
"""What is known of that: with a heading and without, to a tenth of a degree and exactly."""

Place = tuple[float, float, float]
POLES: list[Place] = [(-4.0, 50.0, 4.5), (4.0, 50.0, 4.5)]
THREE: list[Place] = [(-4.0, 50.0, 4.5), (4.0, 50.0, 5.5), (0.0, 40.0, 3.5)]
SURVEY = (0.05, math.radians(0.3), 0.002)
"""A survey of 5 cm, 0.3 degrees and 2 mm in a metre."""


def views(bars, position, rotation, rng=None, noise_px=0.3, camera=CAMERA, across=1.0) -> list[BarView]:
    seen = []
    for i, enu in enumerate(bars):
        points, _ = project_bars(enu, position, rotation, camera)
        if rng is not None:
            way = (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0])
            off = rng.normal(0, noise_px, points.shape)
            points = points + across * off + (1 - across) * np.outer(off @ way, way)
        seen.append(BarView(i, enu, points, np.full(len(enu), noise_px), across=across))
    return seen


def draw_scene(
    rng: np.random.Generator, places: list[Place], known: Attitude | None,
    survey: tuple[float, float, float] = (0.0, 0.0, 0.0), focal: float = 0.0, across: float = 1.0,
    spec: ErrorModel = USUAL, noise_px: float = 0.1, between: tuple[float, ...] = (1.0, 1.0, 1.0),
) -> tuple[list[BarView], Attitude | None, CameraSigma]:  # fmt: skip
    """A camera at the origin that looks up, with every error drawn from its stated sigma."""
    true = replace(CAMERA, focal_mm=CAMERA.focal_mm * (1 + focal * rng.normal()))
    seen, shaken = [], rng.normal(0, spec.vibration_sigma_px, 2)
    exact = views([bar(p) for p in places], np.zeros(3), UP.rotation(), rng, noise_px, true, across)
    for view, gap in zip(exact, between, strict=False):
        arm = view.enu_m - view.enu_m.mean(0)
        result = view.enu_m + rng.normal(0, survey[0], 3) + np.cross(rng.normal(0, survey[1], 3), arm)
        result = result + rng.normal(0, math.hypot(survey[2], spec.stretch_share)) * arm
        whole = view.points_px[-1] - view.points_px[0]
        along = whole / np.linalg.norm(whole)
        longways = math.hypot(spec.shared_along_px, spec.shared_share * float(whole @ along) * 16 / 15)
        points = view.points_px + rng.normal(0, longways) * along + gap * shaken
        points = points + rng.normal(0, spec.shared_sigma_px) * np.array([-along[1], along[0]])
        seen.append(replace(view, enu_m=result, points_px=points, survey_sigmas=survey, vibration=gap))
    reported = None
    if known is not None:
        # A bias of each angle, an offset in time that moves all of them, and noise.
        off = np.degrees(known.bias_root_rad()) @ rng.normal(size=4) + rng.normal(0, known.white_sigma_deg, 3)
        heading = None if known.heading_deg is None else known.heading_deg + off[2]
        pitch, roll = known.pitch_deg + off[0], known.roll_deg + off[1]
        reported = replace(known, pitch_deg=pitch, roll_deg=roll, heading_deg=heading)
    return seen, reported, CameraSigma(focal_mm=focal * CAMERA.focal_mm)


def move_site(view: BarView, *by_m: float) -> BarView:
    """A bar whose site is said to be elsewhere."""
    return replace(view, enu_m=view.enu_m + np.array(by_m))


def at_each_others(one: BarView, two: BarView) -> list[BarView]:
    return [replace(one, enu_m=two.enu_m), replace(two, enu_m=one.enu_m)]


def as_pose(found: Pose | Rejection) -> Pose:
    assert isinstance(found, Pose), found
    return found


def as_rejection(found: Pose | Rejection) -> Rejection:
    assert isinstance(found, Rejection), found
    assert found.detail
    return found


def squared_error(pose: Pose) -> float:
    """The square of the error of a camera at the origin."""
    return square(pose.enu_m, pose.covariance[:3, :3])


@given(st.floats(-180, 180), st.floats(-60, 60), st.floats(-180, 180))
def test_attitude_is_the_named_turns(heading: float, pitch: float, roll: float) -> None:
    # SciPy's intrinsic turns about the camera's own axes: right (y, down), up (x), roll (z, forward).
    level = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    turns = Rotation.from_euler("YXZ", [heading, pitch, roll], degrees=True).as_matrix()
    np.testing.assert_allclose(Attitude(pitch, roll, heading).rotation(), level @ turns, atol=1e-12)
    back = Attitude.of_rotation(level @ turns)
    np.testing.assert_allclose(back.rotation(), level @ turns, atol=1e-7)


@given(st.integers(0, 2**32 - 1))
def test_three_points_give_their_pose_among_the_solutions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    position = rng.uniform(-50, 50, 3)
    seen = np.stack([rng.uniform(-8, 8, 3), rng.uniform(-5, 5, 3), rng.uniform(10, 40, 3)], 1)
    enu = position + seen @ rotation.T
    sights = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    sides = np.linalg.norm(np.cross(enu[1] - enu[0], enu[2] - enu[0]))
    found = solve_three_points(enu, sights)
    off = [np.linalg.norm(p - position) for p, _ in found]
    # A triangle seen nearly edge on has nearly double roots, of which half the digits are lost.
    if sides > 5:
        assert min(off) < 0.5
        _, best = found[int(np.argmin(off))]
        assert np.linalg.det(best) == pytest.approx(1)


ALL = {"survey": SURVEY, "focal": 0.005, "across": 0.5}
SHIFTED = {"spec": replace(POINTS_ONLY, shared_sigma_px=0.1, shared_along_px=0.1)}
SHAKEN = {"spec": replace(POINTS_ONLY, vibration_sigma_px=0.5)}
LATE = Attitude(5.0, 0.0, 0.0, 0.02, 0.02, 0.05, 5000.0, (10.0, -5.0, 45.0))


POINTS = {"spec": POINTS_ONLY, "noise_px": 0.3}


@pytest.mark.parametrize(
    ("places", "known", "errors", "most_m"),
    [
        # At 50 m, with the largest error of nineteen in twenty.
        (POLES, LEVEL, POINTS, 0.15),
        (THREE, None, POINTS, 0.03),
        (POLES[:1], COMPASS, POINTS, 0.35),
        *((places, known, ALL, math.inf) for places, known in (
            (POLES[:1], COMPASS), (POLES[:1], LATE), (POLES, COMPASS), (POLES, GRAVITY), (THREE, GRAVITY),
            (THREE, None),
        )),
        (THREE, None, {"survey": SURVEY}, math.inf),
        (THREE, COMPASS, {"focal": 0.005}, math.inf),
        (THREE, LEVEL, {"spec": replace(POINTS_ONLY, shared_sigma_px=0.1, shared_along_px=0.3)}, math.inf),
        # What all bars share is an error of an exact attitude.
        (POLES[:1], EXACT, SHAKEN, math.inf),
        (POLES, LEVEL, SHAKEN, math.inf),
        # A compass of half a degree: 0.44 m at 50 m, along an arc 8 mm off its tangent.
        (POLES[:1], Attitude(5.0, 0.0, 0.0, 0.1, 0.5), SHIFTED, math.inf),
    ],
)  # fmt: skip
def test_every_error_that_is_stated_is_in_the_covariance(places, known, errors, most_m) -> None:
    rng, squares, off_m, open_ones = np.random.default_rng(11), [], [], 0
    for _ in range(120):
        seen, reported, sigma = draw_scene(rng, places, known, **errors)
        found = solve_pose(seen, CAMERA, reported, errors.get("spec", USUAL), sigma)
        if isinstance(found, Rejection):
            # Two bars on gravity and a survey of 5 cm leave metres along an arc.
            assert found.kind in ("uncertain", "two-solutions"), found
            open_ones += 1
            continue
        squares.append(squared_error(found))
        off_m.append(np.linalg.norm(found.enu_m))
        parts = found.noise + found.slow + sum(s @ s.T for s in found.standing.values())
        # What Huber's weights take from a few points is the difference.
        np.testing.assert_allclose(parts, found.covariance[:3, :3], rtol=0.05, atol=1e-4)
    assert open_ones < (12 if "survey" in errors else 1)
    assert by_chance(squares, 3, 0.999, 1.03)
    assert np.quantile(off_m, 0.95) <= most_m


@pytest.mark.parametrize(
    ("between", "known"), [((0.3, 5.3), LEVEL), ((5.3, 5.3), EXACT), ((0.0, 1.0), LEVEL), ((0.3, 5.3), EXACT)]
)
def test_bars_whose_frames_leave_gaps_at_other_times_err_apart(between, known) -> None:
    """The image moves as one, and each bar's place is interpolated by its own frames."""
    rng, spec, squares = np.random.default_rng(6), replace(POINTS_ONLY, vibration_sigma_px=0.1), []
    for _ in range(200):
        seen, reported, _ = draw_scene(rng, POLES, known, spec=spec, noise_px=0.05, between=between)
        squares.append(squared_error(as_pose(solve_pose(seen, CAMERA, reported, spec))))
    # What bars have for their own counts as independent of what they share, though it is the same motion.
    assert 1.9 < np.mean(squares) < 3.6


@pytest.mark.parametrize(("which", "way"), list(enumerate(np.eye(3))))
@pytest.mark.parametrize("known", [COMPASS, GRAVITY])
def test_a_bar_that_disagrees_is_left_out_by_name(which: int, way: Floats, known: Attitude) -> None:
    seen, reported, _ = draw_scene(np.random.default_rng(13), THREE, known)
    seen[which] = move_site(seen[which], *0.5 * way)
    found = solve_pose(seen, CAMERA, reported)
    if isinstance(found, Rejection):
        # A pair that stays cannot always tell which of three is wrong; it never says a place.
        assert found.kind == "misfit", found
        assert f"bar {which}" in found.detail or "not" in found.detail
        return
    assert found.excluded == (f"bar {which}",)
    assert which not in found.transmitters
    assert squared_error(found) < stats.chi2.isf(1e-5, 3)


@pytest.mark.parametrize("across", [0.3, 1.0, 2.0])
def test_where_a_left_out_bar_stands_is_the_weighted_fit_of_its_points(across: float) -> None:
    """Least squares with the points' whole covariance, along the bar and across; and of the pose."""
    rng, spec = np.random.default_rng(34), ErrorModel()
    seen, reported, sigma = draw_scene(rng, THREE, COMPASS, (2e-4, 0.0, 0.0), across=across)
    wrong = move_site(seen[1], -0.3, 0.4, -0.2)
    pose = as_pose(solve_pose(seen, CAMERA, reported, spec))
    # As sure as the bar's image, so that each part of the covariance counts.
    pose = replace(pose, covariance=0.1 * pose.covariance)
    problem = Problem.of([seen[0], wrong, seen[2]], CAMERA, reported, spec, sigma)
    assert isinstance(problem, Problem)
    found = estimate_fault(problem, 1, pose, 30.0, 5)
    limit = stats.chi2.isf(spec.false_alarm / 2 / 5, 6)
    assert found.missed_probability == pytest.approx(stats.ncx2.cdf(limit, 6, 30.0))
    way = wrong.points_px[-1] - wrong.points_px[0]
    size = float(np.linalg.norm(way))
    way = way / size
    beside = np.eye(2) - np.outer(way, way)
    shift = spec.shared_along_px**2 + (spec.shared_share * size * 16 / 15) ** 2
    each = 0.1**2 * (np.outer(way, way) + across**2 * beside)
    whole = np.kron(np.eye(16), each)
    whole += np.kron(np.ones((16, 16)), shift * np.outer(way, way) + spec.shared_sigma_px**2 * beside)
    white = np.linalg.cholesky(np.linalg.inv(whole)).T

    def missed(off_m: Floats) -> Floats:
        points, _ = project_bars(wrong.enu_m + off_m, pose.enu_m, pose.rotation, CAMERA)
        return np.asarray(white @ (wrong.points_px - points).ravel())

    fit = least_squares(missed, np.zeros(3), xtol=1e-14)
    np.testing.assert_allclose(found.off_m, fit.x, atol=1e-5)
    _, slope = project_bars(wrong.enu_m + fit.x, pose.enu_m, pose.rotation, CAMERA)
    by_points = np.linalg.pinv(fit.jac)
    by_pose = by_points @ white @ slope.reshape(-1, 6)
    spread = by_points @ by_points.T + by_pose @ pose.covariance @ by_pose.T + 2e-4**2 * np.eye(3)
    np.testing.assert_allclose(found.covariance_m2, spread, rtol=1e-3, atol=1e-9)
    assert found.bias_m == pytest.approx(float(np.linalg.norm(found.off_m)))


def test_an_attitude_that_disagrees_is_left_out_by_name() -> None:
    seen, reported, _ = draw_scene(np.random.default_rng(14), THREE, COMPASS)
    assert reported is not None
    for change, part in (({"heading_deg": 3.0}, "heading"), ({"roll_deg": 2.0}, "attitude")):
        found = as_pose(solve_pose(seen, CAMERA, replace(reported, **change)))
        assert (found.excluded, found.failed) == ((part,), None)
        assert abs(math.remainder(Attitude.of_rotation(found.rotation).heading_deg or 0, 360)) < 0.3
        assert np.linalg.norm(found.enu_m) < 0.3
    # Of two bars, either may be the wrong one; so may the heading.
    seen[0] = move_site(seen[0], 0.0, 0.0, 0.5)
    both = as_rejection(solve_pose(seen[:2], CAMERA, reported))
    assert both.kind == "misfit"
    assert {"bar 0", "bar 1"} <= set(both.suspects)


@pytest.mark.parametrize("said_mm", [12.0, 50.0])
def test_a_focal_length_that_is_another_lens_is_found(said_mm: float) -> None:
    """35 mm: two bars, of which one is nearer, are refused; of three, one is left out by mistake."""
    rng = np.random.default_rng(4)
    for places, known in ((THREE[1:], UP), (THREE, Attitude(pitch_deg=5.0))):
        seen = views([bar(p) for p in places], np.zeros(3), UP.rotation(), rng)
        reported = replace(CAMERA, focal_mm=said_mm)
        found = solve_pose(seen, reported, known)
        assert found.kind == "misfit" if isinstance(found, Rejection) else found.excluded
        assert search_focal_mm(seen, reported, known) == pytest.approx(35.0, rel=0.04)
    # None fits a bar that is moved aside.
    assert math.isnan(search_focal_mm([move_site(seen[0], 0.0, 0.0, 0.5), seen[1]], CAMERA, UP))


def test_two_sites_mixed_up_are_not_a_third_bar_at_fault() -> None:
    """From behind, two upright bars are seen the other way round, and only the third is in the way."""
    rng = np.random.default_rng(16)
    bars = [bar((-2.0, 50.0, 4.5)), bar((2.0, 54.0, 4.5)), bar((0.0, 58.0, 5.5), (1, 0, 0.02))]
    seen = views(bars, np.zeros(3), UP.rotation(), rng, 0.1)
    mixed = [*at_each_others(*seen[:2]), seen[2]]
    behind = as_pose(solve_pose(mixed[:2], CAMERA, GRAVITY))
    assert np.linalg.norm(behind.enu_m) > 80
    found = as_rejection(solve_pose(mixed, CAMERA, GRAVITY))
    assert found.kind == "misfit"
    assert "bar 0 at the site of bar 1 and the reverse" in found.detail


def test_protection_levels_cover_what_no_test_finds() -> None:
    """Faults of every size, most of them too small to be found: none of these few is beyond a level."""
    rng = np.random.default_rng(16)
    hidden = 0
    for trial in range(60):
        three = trial % 2
        seen, reported, _ = draw_scene(rng, THREE if three else POLES, COMPASS)
        camera, size = CAMERA, 10 ** rng.uniform(-2, 0)
        which = trial % 3
        if which == 0:
            seen[0] = move_site(seen[0], *size * rng.normal(size=3))
        elif which == 1:
            reported = replace(reported, pitch_deg=reported.pitch_deg + size)
        else:
            camera = replace(CAMERA, focal_mm=CAMERA.focal_mm * (1 + 0.01 * size))
        found = solve_pose(seen, camera, reported)
        if isinstance(found, Rejection) or math.isinf(found.hpl_m):
            continue
        assert math.hypot(*found.enu_m[:2]) < found.hpl_m
        assert abs(found.enu_m[2]) < found.vpl_m
        hidden += squared_error(found) > stats.chi2.isf(0.0027, 3)
    assert hidden > 8


def test_two_bars_that_may_be_mixed_up_are_protected_as_far_as_behind_them() -> None:
    """On gravity alone, two that stand alike fit from behind, too, each at the other's site: 100 m away."""
    rng, spec = np.random.default_rng(19), ErrorModel(bar_fault_m=0.5)
    both = [bar(POLES[0]), bar((4.0, 46.0, 5.5))], [bar(place) for place in POLES]
    other, seen = (views(bars, np.zeros(3), UP.rotation(), rng, 0.1) for bars in both)
    assert math.isfinite(as_pose(solve_pose(other, CAMERA, GRAVITY, spec)).hpl_m)
    pose = as_pose(solve_pose(seen, CAMERA, GRAVITY, spec))
    assert math.isinf(pose.hpl_m)
    behind = as_pose(solve_pose(at_each_others(*seen), CAMERA, GRAVITY, spec))
    apart = np.hypot(*(behind.enu_m - pose.enu_m)[:2])
    reach = as_pose(solve_pose(seen, CAMERA, GRAVITY, replace(spec, max_protection_m=300.0)))
    sigma = np.linalg.eigvalsh(behind.covariance[:2, :2])[-1] ** 0.5
    assert reach.hpl_m == pytest.approx(apart + stats.chi2.isf(1e-4, 2) ** 0.5 * sigma, rel=1e-6)


@pytest.mark.parametrize(
    ("fault", "size"), [("bar_fault_m", 1.5), ("attitude_fault_deg", 5.0), ("focal_fault", 0.025)]
)
def test_levels_hold_for_faults_of_the_size_that_is_stated(fault: str, size: float) -> None:
    """A lone bar, which shows none of them: one of twice as much is covered where it is stated only."""
    rng, outside = np.random.default_rng(20), 0
    usual = ErrorModel(bar_fault_m=0.01, attitude_fault_deg=0.1)
    stated, spared = (replace(usual, **{fault: value}) for value in (size, 0.0))
    for trial in range(40):
        (seen,), reported, _ = draw_scene(rng, POLES[:1], COMPASS)
        camera, off = CAMERA, (-1) ** trial * 2.0 * size
        if fault == "bar_fault_m":
            seen = move_site(seen, off, 0.0, 0.0)
        elif fault == "attitude_fault_deg":
            reported = replace(reported, heading_deg=(reported.heading_deg or 0.0) + off)
        else:
            camera = replace(CAMERA, focal_mm=CAMERA.focal_mm * (1 + off))
        pose, other = (as_pose(solve_pose([seen], camera, reported, spec)) for spec in (stated, usual))
        assert math.hypot(*pose.enu_m[:2]) < pose.hpl_m < 50
        assert abs(pose.enu_m[2]) < pose.vpl_m < 50
        outside += math.hypot(*other.enu_m[:2]) > other.hpl_m
        # A part that may be off by any amount leaves nothing protected.
        assert math.isinf(as_pose(solve_pose([seen], camera, reported, spared)).hpl_m)
    assert outside > 20


def test_false_alarms_are_as_rare_as_stated() -> None:
    """At a chance that can be counted: one of fifty."""
    rng, spec = np.random.default_rng(18), ErrorModel(false_alarm=0.02)
    alarms = 0
    for _ in range(200):
        seen, reported, sigma = draw_scene(rng, THREE, COMPASS, SURVEY, 0.002)
        found = solve_pose(seen, CAMERA, reported, spec, sigma)
        alarms += isinstance(found, Rejection) or bool(found.excluded)
    # Tests of overlapping parts share alarms, and the total is counted by Huber: never more, and not none.
    assert 1 <= alarms <= stats.binom.isf(1e-3, 200, 0.02)


def test_what_is_not_determined_is_refused() -> None:
    rng = np.random.default_rng(1)

    def kind_of(places, known, spec=USUAL, axis=(0, 0, 1)) -> str:
        seen = views([bar(p, axis) for p in places], np.zeros(3), UP.rotation(), rng, 0.1)
        found = solve_pose(seen, CAMERA, known, spec)
        return as_rejection(found).kind if isinstance(found, Rejection) else ""

    def in_line(up_m: float) -> list[Place]:
        return [(-4.0, 50.0, 4.5), (0.0, 50.0, up_m), (4.0, 50.0, 4.5)]

    assert kind_of([], COMPASS) == "too-few-clusters"
    (few,) = views([bar(POLES[0])], np.zeros(3), UP.rotation(), rng, 0.1)
    few.points_px[5:] = np.nan
    assert as_rejection(solve_pose([few], CAMERA, COMPASS)).kind == "too-few-clusters"
    assert kind_of(POLES[:1], LEVEL) == "heading-unknown"
    assert kind_of(POLES, None) == "gravity-unknown"
    # In line, hardly beside the line, and clearly.
    assert [kind_of(in_line(up_m), None) for up_m in (4.5, 4.54, 4.9)] == 2 * ["gravity-unknown"] + [""]
    # At the camera's own height, two bars leave a circle through them; ranges alone say where on it.
    low = views([bar((x, 50.0, 0.0)) for x in (-3.0, 3.0)], np.zeros(3), Attitude().rotation(), rng, 0.3)
    found = solve_pose(low, CAMERA, Attitude(gravity_sigma_deg=0.0))
    assert as_rejection(found).kind in ("uncertain", "not-determined", "two-solutions")
    assert kind_of(POLES[:1], COMPASS, ErrorModel(max_sigma_m=0.01)) == "uncertain"
    # A bar that points at the camera.
    sight = np.array(POLES[0]) / np.linalg.norm(POLES[0])
    assert kind_of(POLES[:1], COMPASS, USUAL, sight + np.array([0.1, 0, 0])) == "end-on"
    swapped = at_each_others(*views([bar(p) for p in POLES], np.zeros(3), UP.rotation(), rng, 0.1))
    assert as_rejection(solve_pose(swapped, CAMERA, COMPASS)).kind in ("misfit", "not-determined")


def test_both_poses_are_reported_where_two_fit() -> None:
    """Two small bars, noisy and far: seen alike from the side, too. One of them is the truth."""
    rng = np.random.default_rng(0)
    bars = [0.1 * bar((0, 0, 0)) + [-2.6, 58.4, 3.9], 0.1 * bar((0, 0, 0)) + [0.5, 57.1, 5.8]]
    seen = views(bars, np.zeros(3), UP.rotation(), rng, 1.0)
    found = as_rejection(solve_pose(seen, CAMERA, GRAVITY, POINTS_ONLY))
    assert found.kind == "two-solutions"
    likelihoods = [one.likelihood for one in found.candidates]
    assert likelihoods[0] == 1
    assert 1e-4 < likelihoods[1] < 1
    right = found.candidates[0]
    assert square(right.enu_m, right.covariance_m2) < stats.chi2.isf(1e-4, 3)
    for one in found.candidates:
        image, _ = project_bars(np.concatenate(bars), one.enu_m, one.rotation, CAMERA)
        missed = image - np.concatenate([view.points_px for view in seen])
        assert np.sqrt((missed**2).mean()) < 1.5


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.sampled_from(["all", "gravity", "none"]))
def test_never_a_silent_wrong_position(seed: int, count: int, told: str) -> None:
    """Bars anywhere in view: what is given lies within its sigmas, or is refused."""
    rng = np.random.default_rng(seed)
    true = Attitude(*rng.uniform(-10, 10, 2), rng.uniform(0, 360))
    rotation, position = true.rotation(), rng.uniform(-100, 100, 3)
    bars = []
    for _ in range(count):
        aside = rng.uniform([-0.08, -0.04, 1.0], [0.08, 0.04, 1.0]) * rng.uniform(15, 100)
        axis = rng.normal(0, 0.1, 3) + np.array([0, 0, 1])
        bars.append(bar(position + rotation @ aside, axis / np.linalg.norm(axis)))
    known = {"all": replace(true, gravity_sigma_deg=0.05, heading_sigma_deg=0.1), "none": None}.get(
        told, replace(true, heading_deg=None, gravity_sigma_deg=0.05)
    )
    found = solve_pose(views(bars, position, rotation, rng, 0.2), CAMERA, known, POINTS_ONLY)
    if isinstance(found, Pose):
        assert square(found.enu_m - position, found.covariance[:3, :3]) < stats.chi2.isf(1e-7, 3)
    else:
        assert found.kind


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
        assert as_rejection(found).kind == "misfit"
        suspects.append(found.suspects)
    assert sum("attitude" in some for some in suspects) >= 15
