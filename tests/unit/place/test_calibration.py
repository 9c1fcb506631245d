"""Calibration: the camera comes back within its sigmas, or is refused."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.place.calibration import Calibration, CalibrationView, _turn_slope, fit_camera, read_poses
from evlcp_sdk.place.observations import BarView, project_bars
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CAMERA_PARAMETERS, CameraModel
from tests.unit.place.place_scenes import POINTS_ONLY, bar

TRUE = CameraModel(focal_mm=8.2, centre_x_px=652.0, centre_y_px=351.0, k1=-0.12, k2=0.05, p1=8e-4, p2=-5e-4)
NOMINAL = CameraModel(focal_mm=8.0)


def views(rng, count, known, noise_px=0.1, bars=6) -> list[CalibrationView]:
    """A camera among poles 8 to 20 m away, that looks about and is rolled."""
    poles = [bar([rng.uniform(-9, 9), rng.uniform(8, 20), rng.uniform(-4, 4)]) for _ in range(bars)]
    found = []
    while len(found) < count:
        attitude = Attitude(rng.uniform(-10, 10), rng.choice([0, 90, -90, 180]) + rng.uniform(-5, 5), 0.0)
        attitude = dataclasses.replace(attitude, heading_deg=rng.uniform(-15, 15))
        place, rotation = rng.uniform(-1, 1, 3), attitude.rotation()
        reported = place + rng.normal(0, 0.005, 3)
        turned = Rotation.from_rotvec(np.radians(rng.normal(0, 0.05, 3))).as_matrix() @ rotation
        seen = []
        for i, pole in enumerate(poles):
            points, _ = project_bars(pole, place, rotation, TRUE)
            inside = (points > 0).all() and (points < [TRUE.width, TRUE.height]).all()
            if inside:
                points = points + rng.normal(0, noise_px, points.shape)
                seen.append(BarView(i, pole, points, np.full(16, noise_px)))
        if len(seen) >= 2:
            found.append(CalibrationView(tuple(seen), reported, 0.005, turned if known else None, 0.05))
    return found


def squares_of(found: Calibration) -> list[float]:
    """Errors of what was determined, squared in their sigmas."""
    return [((getattr(found.camera, n) - getattr(TRUE, n)) / s) ** 2 for n, s in found.sigma.items()]


@pytest.mark.parametrize("known", [True, False])
def test_the_camera_comes_back_within_its_sigmas(known: bool) -> None:
    rng = np.random.default_rng(6)
    squares = []
    for _ in range(4):
        found = fit_camera(views(rng, 12, known), NOMINAL, POINTS_ONLY)
        assert set(found.sigma) >= {"focal_mm", "k1"}
        assert set(found.sigma) | set(found.undetermined_px) == set(CAMERA_PARAMETERS)
        if known:
            assert set(found.sigma) >= {"centre_x_px", "centre_y_px", "p1", "p2"}
        assert 0.7 < found.misfit < 1.3
        squares += squares_of(found)
    assert len(squares) >= 12
    # Parameters are correlated: the mean square is 1, the bounds are those of a few.
    assert 0.2 < np.mean(squares) < stats.chi2.isf(1e-4, 8) / 8
    assert max(squares) < 5**2


def test_sites_that_are_not_exact_are_in_the_covariance() -> None:
    """Every bar is off by the same in all views: more views do not average it away."""
    rng = np.random.default_rng(9)
    survey, squares, spreads = (0.03, 0.002, 0.003), [], []
    for _ in range(6):
        seen = views(rng, 10, True)
        off = {one.transmitter: rng.normal(size=7) for view in seen for one in view.bars}
        reports = []
        for view in seen:
            bars = []
            for one in view.bars:
                z, arm = off[one.transmitter], one.enu_m - one.enu_m.mean(0)
                moved = survey[0] * z[:3] + np.cross(survey[1] * z[3:6], arm) + survey[2] * z[6] * arm
                bars.append(dataclasses.replace(one, enu_m=one.enu_m + moved, survey_sigmas=survey))
            reports.append(dataclasses.replace(view, bars=tuple(bars)))
        found = fit_camera(reports, NOMINAL, POINTS_ONLY)
        exact = fit_camera(seen, NOMINAL, POINTS_ONLY)
        spreads.append(found.sigma["focal_mm"] / exact.sigma["focal_mm"])
        squares += squares_of(found)
        # The whole covariance, as a link has it.
        sigma = found.camera_sigma
        assert sigma.focal_mm == pytest.approx(found.sigma["focal_mm"], rel=1e-3)
        for name in CAMERA_PARAMETERS[3:]:
            assert abs(getattr(found.camera, name) - getattr(TRUE, name)) < 5 * getattr(sigma, name)
        root = sigma.covariance_root(found.camera)
        assert root[0, 0] == pytest.approx(sigma.focal_mm * 1e3 / TRUE.pitch_um, rel=1e-3)
    assert min(spreads) > 1.2
    assert 0.2 < np.mean(squares) < stats.chi2.isf(1e-4, 8) / 8


def test_what_one_bar_does_not_determine_is_refused() -> None:
    rng = np.random.default_rng(2)
    pole = bar([0.5, 12.0, 0.2])
    rotation, seen = Attitude(0.0, 0.0, 0.0).rotation(), []
    for n in range(3):
        place = np.array([0.0, 2.0 * n, 0.0])
        points, _ = project_bars(pole, place, rotation, NOMINAL)
        view = BarView(0, pole, points + rng.normal(0, 0.02, points.shape), np.full(16, 0.02))
        seen.append(CalibrationView((view,), place, 0.002, None, 0.1))
    found = fit_camera(seen, dataclasses.replace(NOMINAL, focal_mm=8.3), POINTS_ONLY)
    assert "focal_mm" in found.sigma
    assert not {"centre_x_px", "centre_y_px", "p1", "p2"} & set(found.sigma)
    assert abs(found.camera.focal_mm - 8.0) < 5 * found.sigma["focal_mm"]
    assert found.camera.centre_x_px is None
    assert found.camera.p1 == 0
    assert set(found.undetermined_px) == set(CAMERA_PARAMETERS) - set(found.sigma)
    blurred = [dataclasses.replace(v, position_sigma_m=5.0) for v in seen]
    with pytest.raises(ConfigError, match="do not determine the focal length"):
        fit_camera(blurred, NOMINAL, POINTS_ONLY)
    with pytest.raises(ConfigError, match="nothing to calibrate from"):
        fit_camera([dataclasses.replace(seen[0], bars=())], NOMINAL, POINTS_ONLY)


def test_a_pose_that_is_not_right_is_reported_and_not_the_lens() -> None:
    """One of eight, or all of them in another town."""
    seen = views(np.random.default_rng(3), 8, True)
    wrong = dataclasses.replace(seen[2], enu_m=seen[2].enu_m + np.array([0.5, 0, 0]))
    away = [dataclasses.replace(v, enu_m=v.enu_m + np.array([0, 111e3, 0])) for v in seen[:4]]
    for row in ([*seen[:2], wrong, *seen[3:]], away):
        with pytest.raises(ConfigError, match="not as stated"):
            fit_camera(row, NOMINAL, POINTS_ONLY)


def test_angles_that_are_all_wrong_are_not_the_principal_point() -> None:
    """Poses pitched by 4 degrees that say 0 move it by hundreds of pixels."""
    camera, rng = CameraModel(focal_mm=35.0), np.random.default_rng(5)
    seen = []
    for n in range(8):
        place, bars = np.array([0.0, 0.5 * n, 0.0]), []
        for i, east in enumerate((-3.0, 3.0)):
            pole = bar([east, 45.0 + 5 * i, 3.5])
            points, _ = project_bars(pole, place, Attitude(4.0, 0.0, 0.0).rotation(), camera)
            bars.append(BarView(i, pole, points + rng.normal(0, 0.05, points.shape), np.full(16, 0.05)))
        seen.append(CalibrationView(tuple(bars), place, 0.01, Attitude(4.0, 0.0, 0.0).rotation(), 0.1))
    assert fit_camera(seen, camera).camera.focal_mm == pytest.approx(35.0, abs=0.2)
    level = Attitude(0.07, 0.0, 0.0).rotation()
    with pytest.raises(ConfigError, match=r"centre_y_px = [\d.-]+ would fit .*, 360 is configured and 26 "):
        fit_camera([dataclasses.replace(view, rotation=level) for view in seen], camera)


@pytest.mark.parametrize("turn", [np.array([0.2, -0.3, 0.1]), np.full(3, 1e-9)])
def test_the_slope_of_a_turn_is_the_numerical_one(turn: NDArray[np.float64]) -> None:
    start = Rotation.from_rotvec(turn).inv()
    want = approx_fprime(np.zeros(3), lambda d: (Rotation.from_rotvec(turn + d) * start).as_rotvec(), 1e-7)
    np.testing.assert_allclose(_turn_slope(turn), want, atol=1e-6)


def test_poses_are_read_and_their_faults_reported(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    head = "recording,t_us,latitude_deg,longitude_deg,height_m,heading_deg,pitch_deg,roll_deg\n"
    path.write_text(head + "a.raw,5000,35,137,5,,,\nb.raw,6000,35,137,5,350,1,2\n")
    one, two = read_poses(path)
    assert (one.recording, one.t_us, one.attitude, one.position_sigma_m) == ("a.raw", 5000, None, 0.01)
    assert two.attitude == Attitude(1, 2, 350)
    # As spreadsheets write it.
    path.write_text(path.read_text(), encoding="utf-8-sig")
    assert read_poses(path) == [one, two]
    for text, message in (
        (head, "one line of values or more"),
        (head + "a.raw,,35,137,5,,,\n", r"line 2: t_us = '': expected a number"),
        (head + "a.raw,1,35,137,5,3,,\n", r"line 2: pitch_deg = '': expected a number"),
        (head.replace("heading_deg,", ""), "line 1: no column heading_deg"),
        (head + "\na.raw,1,95,137,5,,,\n", r"line 3: latitude_deg = '95': expected -90 to 90"),
        (f"attitude_sigma_deg,{head}0,a.raw,1,35,137,5,1,1,1\n", r"line 2: attitude_sigma_deg = '0'"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=message):
            read_poses(path)
