"""A survey: bars come back within their sigmas, by poses that are all off alike."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.place.calibration import CalibrationView, KnownPose
from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.gnss import GnssLog
from evlcp_sdk.place.navigator import PositionPlan
from evlcp_sdk.place.observations import BarView, project_bars
from evlcp_sdk.place.survey import survey_bars
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.scene.sites import BarSite, LocalAxes, load_sites
from evlcp_sdk.sim.truth import read_truth, truth_path
from evlcp_sdk.simulated import simulate
from evlcp_sdk.surveying import survey, survey_along_track
from tests.unit.place.place_scenes import POINTS_ONLY, square

AXES = LocalAxes(35.0, 137.0, 50.0)
CAMERA = CameraModel(focal_mm=16.0)
SPEC = dataclasses.replace(POINTS_ONLY, curvature_sigma_px=0)
ROTATION = Attitude(3.0, 1.0, 2.0).rotation()


def site_at(number: int, enu: list[float], tilt: float, heading: float) -> BarSite:
    return BarSite(number, *map(float, AXES.to_geodetic(np.array(enu))), heading, tilt)


BARS = [site_at(7, [-3.0, 45.0, 3.0], 4.0, 200.0), site_at(9, [3.0, 50.0, 4.0], 90.0, 80.0)]


def views(rng, place_m, turn_deg, focal=0.0, bend_px=0.0, bars=BARS) -> list[CalibrationView]:
    """A drive of 12 m towards bars that look bent; poses are off by one error in common, and by one each."""
    place = np.linspace(-1, 1, 16)
    square = place**2 - (place**2).mean()
    bends = rng.normal(0, bend_px, len(bars))[:, None] * square / np.linalg.norm(square)
    lens = dataclasses.replace(CAMERA, focal_mm=CAMERA.focal_mm * (1 + focal * rng.normal()))
    drift, tilt = rng.normal(0, place_m, 3), rng.normal(0, math.radians(turn_deg), 3)
    found = []
    for step in range(7):
        place = np.array([0.2 * step, 2.0 * step, 0.0])
        seen = []
        for bar, bend in zip(bars, bends, strict=True):
            enu = bar.cluster_positions_m(16, AXES)
            points, _ = project_bars(enu, place, ROTATION, lens)
            way = points[-1] - points[0]
            points = points + bend[:, None] * way / np.linalg.norm(way) + rng.normal(0, 0.1, points.shape)
            seen.append(BarView(bar.transmitter_id, np.empty((0, 3)), points, np.full(16, 0.1)))
        off = tilt + rng.normal(0, math.radians(turn_deg), 3)
        reported = Rotation.from_rotvec(off).as_matrix() @ ROTATION
        where = place + drift + rng.normal(0, place_m, 3)
        found.append(CalibrationView(tuple(seen), where, place_m, reported, turn_deg))
    return found


def test_bars_come_back_within_their_sigmas() -> None:
    rng = np.random.default_rng(8)
    squares, wide = [], []
    for _ in range(6):
        seen = views(rng, 0.02, 0.05, 0.002)
        found = survey_bars(seen, AXES, 0.96, CAMERA, CameraSigma(focal_mm=0.032), SPEC)
        assert [bar.site.transmitter_id for bar in found] == [7, 9]
        for bar, true in zip(found, BARS, strict=True):
            place = LocalAxes.of([true])
            error = place.to_enu(bar.site.latitude_deg, bar.site.longitude_deg, bar.site.height_m)
            squares.append(square(error, bar.covariance_m2))
            wide.append(bar.site.position_sigma_m)
            assert bar.views == 7
            assert bar.site.length_m == 0.96
            assert np.linalg.eigvalsh(bar.covariance_m2)[-1] == pytest.approx(bar.site.position_sigma_m**2)
            off = math.degrees(math.acos(min(bar.site.axis_enu() @ true.axis_enu(), 1)))
            assert off < 4 * bar.site.attitude_sigma_deg
    # The two bars of a survey share its errors: the bounds are those of the surveys.
    assert stats.chi2.isf(0.999, 18) / 6 < np.mean(squares) < stats.chi2.isf(0.001, 18) / 6
    assert 0.03 < np.mean(wide) < 0.5


def test_a_bar_that_looks_curved_is_tilted_within_its_sigma() -> None:
    """The perspective of a lean towards the camera is a bend, and the same in all views."""
    rng = np.random.default_rng(12)
    bars = [site_at(7, [0.1, 45.0, 0.2], 6.0, 10.0)]
    bent = dataclasses.replace(SPEC, curvature_sigma_px=0.2)
    sigmas: dict[ErrorModel, list[float]] = {bent: [], SPEC: []}
    for _ in range(8):
        seen = views(rng, 0.002, 0.002, bend_px=0.2, bars=bars)
        for spec, misses in sigmas.items():
            (bar,) = survey_bars(seen, AXES, 0.96, CAMERA, spec=spec)
            off = math.degrees(math.acos(min(bar.site.axis_enu() @ bars[0].axis_enu(), 1)))
            misses.append(off / (bar.site.attitude_sigma_deg or 0))
    # Towards the camera a bar leans by far more than across.
    low, high = stats.chi2.ppf([0.001, 0.999], 8) / 8
    assert low < np.mean(np.square(sigmas[bent])) < high < np.mean(np.square(sigmas[SPEC]))


def test_what_cannot_be_surveyed_is_reported() -> None:
    seen = views(np.random.default_rng(10), 0.02, 0.05)
    with pytest.raises(ConfigError, match="line 7: a survey needs heading_deg"):
        survey(["never-read.raw"], [KnownPose("", 0.0, 35.0, 137.0, 5.0, 0.01, None, 0.1, 7)], name="p.csv")
    with pytest.raises(ConfigError, match="no view shows a bar"):
        survey_bars([dataclasses.replace(view, bars=()) for view in seen], AXES, 0.96, CAMERA)
    wrong = dataclasses.replace(seen[3], enu_m=seen[3].enu_m + np.array([3.0, 0.0, 0.0]))
    with pytest.raises(ConfigError, match="miss one another"):
        survey_bars([*seen[:3], wrong, *seen[4:]], AXES, 0.96, CAMERA, spec=SPEC)


def test_a_bar_alone_in_view_before_its_id_is_surveyed(tmp_path: Path) -> None:
    """Until its beacon, of two packets, it is the only bar, and is taken for the only known one."""
    link, recording = load_link(overrides="air.frames_per_packet=6"), tmp_path / "rec.raw"
    world = {"latitude_deg": 35.0, "longitude_deg": 137.0, "height_m": 50.0}
    parts = {"link": {"air": link.table["air"]}, "world": world, "motion": {"vib_rate_rad_s": 0.0}}
    simulate(parts | {"duration_s": 0.07, "bars": [{"payload": "messages"}]}).save(recording)
    (true,), truth = load_sites(tmp_path / "rec.site.toml"), read_truth(truth_path(recording))
    place = np.stack([truth.camera_path[name] for name in world], 1)
    gnss = GnssLog(truth.t_us, place, np.tile(1e-4 * np.eye(3), (len(place), 1, 1)))
    known = dataclasses.replace(true, transmitter_id=9, latitude_deg=35.001)
    attitude = Attitude(0.0, 0.0, 0.0, 0.01, 0.01)
    (found,) = survey_along_track([str(recording)], PositionPlan((known,), gnss), link, attitude=attitude)
    assert found.site.transmitter_id == true.transmitter_id
    site = found.site
    error = LocalAxes.of([true]).to_enu(site.latitude_deg, site.longitude_deg, site.height_m)
    assert square(error, found.covariance_m2) < 20
