"""What a drive tells of its own errors, against the truth of simulated drives."""

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.navigator import EstimatedBias, estimate_biases, focal_share
from evlcp_sdk.place.observations import BarView, Rejection, project_bars
from evlcp_sdk.place.pose import solve_pose
from evlcp_sdk.place.trajectory import IMU, TrajectoryPoint, filter_fixes
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.scene.sites import BarSite
from evlcp_sdk.values import Fix
from tests.unit.place.place_scenes import Floats, bar, fix

SPEC = ErrorModel(stretch_share=0.0, shared_sigma_px=0.05, shared_along_px=0.05, shared_share=0.0)
CAMERA, LENS = CameraModel(), CameraSigma(focal_mm=0.005 * CameraModel().focal_mm)
SITE_M, BIAS_DEG, TIME_US = 0.1, 0.1, 8000.0


def angles_deg(t_s: float) -> Floats:
    """Pitch, roll and heading of a car that sways, and drives straight on."""
    return np.array([2 + np.sin(6 * t_s), 0.5 * np.cos(5 * t_s), 1.0])


def drive(rng: np.random.Generator) -> tuple[list[Fix], dict[tuple[str, str], float]]:
    """Past eight bars, two or three in view; what is to be added to each stated value."""
    truth = {("camera", "focal_mm"): LENS.focal_mm * rng.normal()}
    names = ("pitch_deg", "roll_deg", "heading_deg")
    truth |= {("attitude", name): BIAS_DEG * rng.normal() for name in names}
    truth["attitude", "time_us"] = TIME_US * rng.normal()
    off = rng.normal(0, SITE_M, (8, 3))
    for b, row in enumerate(off):
        truth |= {(f"bar {b}", name): v for name, v in zip(("east_m", "north_m", "up_m"), row, strict=True)}
    lens = dataclasses.replace(CAMERA, focal_mm=CAMERA.focal_mm + truth["camera", "focal_mm"])
    late_s = truth["attitude", "time_us"] * 1e-6
    fixes = []
    for t in np.arange(0, 20, 0.3):
        place = np.array([0.0, 10 * t, -4.0])
        turned = Attitude(*angles_deg(t)).rotation()
        measured = angles_deg(t + late_s) - [truth["attitude", name] for name in names]
        rate = (angles_deg(t + 1e-3) - angles_deg(t - 1e-3)) / 2e-3
        attitude = Attitude(
            *measured, BIAS_DEG, BIAS_DEG, time_sigma_us=TIME_US, rate_deg_s=tuple(rate.tolist())
        )
        views = []
        for b in range(8):
            centre = np.array([(-1) ** b * 4.0, 60 + 25.0 * b, 0.5 * (b % 3)])
            if 28 < centre[1] - place[1] < 90:
                said = bar(centre)
                points, _ = project_bars(said + off[b], place, turned, lens)
                points += rng.normal(0, 0.07, points.shape) + rng.normal(0, SPEC.shared_sigma_px, 2)
                views.append(BarView(b, said, points, np.full(16, 0.0707), (SITE_M, 0.0, 0.0)))
        pose = solve_pose(views, CAMERA, attitude, SPEC, LENS)
        if not isinstance(pose, Rejection):
            heading = Attitude.of_rotation(pose.rotation).heading_deg
            known = {"slow_m2": pose.slow, "standing": pose.standing, "heading_deg": heading}
            fixes.append(fix(t * 1e6, pose.enu_m, pose.noise, **known))
    return fixes, truth


def states_of(point: TrajectoryPoint) -> dict[str, tuple[Floats, Floats]]:
    found = {cause.name: point.standing(cause.name) for cause in point.causes}
    return {name: state for name, state in found.items() if state is not None}


def test_a_drive_past_bars_tells_their_errors_and_its_own() -> None:
    rng, squares, widths = np.random.default_rng(7), [], []
    sites = {b: BarSite(b, 35.0, 137.0, 50.0, position_sigma_m=SITE_M) for b in range(8)}
    said = Attitude(0, 0, 0, BIAS_DEG, BIAS_DEG, time_sigma_us=TIME_US)
    for _ in range(3):
        fixes, truth = drive(rng)
        last = filter_fixes(fixes, dataclasses.replace(SPEC, acceleration_m2_s3=0.01))[-1]
        rows = estimate_biases(states_of(last), CAMERA, LENS, said, sites, SPEC)
        squares += [((row.correction - truth[row.part, row.what]) / row.sigma) ** 2 for row in rows]
        table = {(row.part, row.what): row for row in rows}
        for key in (("camera", "focal_mm"), ("attitude", "time_us"), ("attitude", "heading_deg")):
            assert table[key].determined
            widths.append(table[key].sigma / table[key].stated_sigma)
        share, sigma = focal_share(last.standing("camera"), CAMERA, LENS)
        assert share == pytest.approx(table["camera", "focal_mm"].correction / CAMERA.focal_mm)
        assert sigma == pytest.approx(table["camera", "focal_mm"].sigma / CAMERA.focal_mm)
    assert max(widths) < 0.7
    # Errors of one drive hang together: a mean of squares, wide.
    assert 0.5 < np.mean(squares) < 1.8
    assert max(squares) < stats.chi2.isf(1e-5, 1)


def test_what_a_drive_does_not_tell_keeps_its_sigma() -> None:
    stays = {"camera": np.zeros((3, 7)), "attitude": np.zeros((3, 4)), "bar 3": np.zeros((3, 1))}
    fixes = [fix(t, np.zeros(3), np.eye(3), standing=stays) for t in (0.0, 1e5, 2e5)]
    points = filter_fixes(fixes, SPEC)
    rows = estimate_biases(states_of(points[-1]), CAMERA, LENS, Attitude(0, 0, 0, 0.2, 0.3), {}, SPEC)
    found = {(row.part, row.what): row for row in rows}
    # Nothing was stated of the clock, nor of the principal point, nor of the site.
    assert list(found) == [
        ("camera", "focal_mm"),
        *(("attitude", name) for name in ("pitch_deg", "roll_deg", "heading_deg")),
    ]
    for row in rows:
        assert not row.determined
        assert row.sigma == pytest.approx(row.stated_sigma)
        assert row.correction == 0
    assert found["attitude", "heading_deg"].stated_sigma == 0.3
    assert math.isnan(focal_share(points[-1].standing("camera"), CAMERA, CameraSigma())[0])


def test_biases_of_an_imu_are_taken_off() -> None:
    state = np.array([1.0, 0.0, -2.0, 0.5]), np.diag([0.25, 1.0, 0.04, 1.0])
    rows = estimate_biases({IMU: state, "gnss": state}, CAMERA, LENS, None, {}, SPEC)
    assert rows[0] == EstimatedBias(IMU, "rate_deg_s", -0.1, 0.05, 0.1)
    assert [row.what for row in rows[1:]] == ["push_right_m_s2", "push_forward_m_s2", "push_up_m_s2"]
    assert rows[2].correction == pytest.approx(0.1)
    assert [row.determined for row in rows] == [True, False, True, False]
