"""Scenes on earth: bars as sites, the camera's path, against the image itself."""

from dataclasses import replace

import numpy as np
import pymap3d
import pytest

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.scene.attitude import AttitudeLog
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from evlcp_sdk.sim import Simulation, load_scene, resolve_scene, sites_of, truth_of
from evlcp_sdk.sim.leds import split_into_strips
from evlcp_sdk.sim.motion import CameraPath, project
from evlcp_sdk.sim.world import attitude_log, scene_to_enu, survey_sites

WORLD = {"latitude_deg": 35.1, "longitude_deg": 137.2, "height_m": 40.0, "heading_deg": 30.0}
MOTION = {"distance_m": 50.0, "yaw_deg": 2.0, "pitch_deg": -1.0, "roll_deg": 4.0}
BARS = [
    {"x_m": -2.0, "y_m": -0.5, "lean_deg": 10.0},
    {"x_m": 2.5, "z_m": 6.0, "tilt_deg": 20.0, "transmitter_id": 77},
    {"x_m": 0.5, "y_m": -2.0, "z_m": 3.0},
]
SCENE = resolve_scene({"duration_s": 0.02, "world": WORLD, "motion": MOTION, "bars": BARS})


def camera_axes(*degrees: float) -> np.ndarray:
    """Rows: the camera's right, down and ahead in east, north, up, from the attitude's definition."""
    h, p, r = np.radians(degrees)
    ahead = np.array([np.sin(h) * np.cos(p), np.cos(h) * np.cos(p), np.sin(p)])
    level = np.array([np.cos(h), -np.sin(h), 0.0])
    above = np.cross(level, ahead)
    # The top leans right: the camera's right sinks.
    right = level * np.cos(r) - above * np.sin(r)
    return np.stack([right, np.cross(ahead, right), ahead])


def test_sites_and_camera_say_what_the_image_shows() -> None:
    simulation = Simulation(SCENE)
    truth = truth_of(simulation).table
    sites, path = sites_of(SCENE), truth["camera_path"]
    assert [s.transmitter_id for s in sites] == [1, 77, 3]
    camera = SCENE.camera
    for i in (0, 19):
        local = LocalAxes(*(path[key][i] for key in ("latitude_deg", "longitude_deg", "height_m")))
        axes = camera_axes(*(path[key][i] for key in ("heading_deg", "pitch_deg", "roll_deg")))
        position, attitude = simulation.path.sample(truth["t_s"][i] * 1e6)
        for site, light in zip(sites, simulation.bars, strict=True):
            seen = camera.project(site.cluster_positions_m(16, local) @ axes.T)
            strip = light.strips[0]
            parts = (np.arange(16) + 0.5) / 16 - 0.5
            ends = strip.centre_m + parts[:, None] * strip.along_m
            places, _ = project(ends, position, attitude, camera)
            # A level plane is level at its origin only: 50 m away the earth has turned by 8 urad.
            np.testing.assert_allclose(seen, places[0], atol=0.15)


@pytest.mark.parametrize(
    "layout", [{"shape": "ring", "leds": 8}, {"rows": 4, "columns": 4, "cluster_rows": 1}]
)
def test_clusters_that_are_not_in_line_stand_where_their_light_is(layout: dict[str, object]) -> None:
    bar = {"x_m": -2.0, "y_m": -0.5, "lean_deg": 10.0, "tilt_deg": 20.0, "link": {"bar": layout}}
    scene = resolve_scene({"world": WORLD, "motion": {"distance_m": 50.0}, "bars": [bar]})
    (site,), (light,) = sites_of(scene), Simulation(scene).bars
    found = site.layout_positions_m(light.link.bar, LocalAxes(35.1, 137.2, 40.0))
    for lit, strip in zip(split_into_strips(light.bar, light.link.bar), light.strips, strict=True):
        cuts = strip.cuts_m()
        for k, middle in zip(lit.clusters, (cuts[1:] + cuts[:-1]) / 2, strict=True):
            if k >= 0:
                np.testing.assert_allclose(found[k], scene_to_enu(middle, 30.0), atol=1e-5)


def test_without_a_world_there_are_no_sites() -> None:
    scene = load_scene("drive-30kmh", ["duration_s=0.01"])
    assert "sites" not in truth_of(Simulation(scene)).table
    with pytest.raises(ConfigError, match=r"no \[world\]"):
        sites_of(scene)


def test_an_imu_tells_the_attitude_and_one_error() -> None:
    scene = load_scene("drive-30kmh", {"duration_s": 0.05, "world.heading_deg": 359.5, "motion.yaw_deg": 1.0})
    assert scene.world is not None
    errors = []
    for seed in range(60):
        path = CameraPath(scene.motion, scene.duration_s, seed)
        log = attitude_log(replace(scene, seed=seed), seed, path)
        found, true = log.interpolate(20_300.0), path.sample(20_300.0)[1][0]
        assert found.heading_deg is not None
        heading = (found.heading_deg - 359.5 - np.degrees(true[0]) + 180) % 360 - 180
        errors.append([found.pitch_deg - np.degrees(true[1]), found.roll_deg - np.degrees(true[2]), heading])
    # 60 draws of a normal error of 0.1 degrees: its spread is known to 9 %, four times that is allowed.
    np.testing.assert_allclose(np.std(errors, 0), 0.1, rtol=0.36)


def test_what_is_stated_of_sites_is_wrong_as_declared() -> None:
    assert survey_sites(SCENE, 5) == sites_of(SCENE)
    one, two, three = SCENE.bars
    swapped = (replace(one, site_of=1), replace(two, site_of=0, site_off_m=(0.3, -0.4, 1.2)), three)
    wrong = replace(SCENE, bars=swapped)
    true, reported = sites_of(wrong), survey_sites(wrong, 5)
    assert true == sites_of(SCENE)
    assert [s.transmitter_id for s in reported] == [1, 77, 3]
    assert replace(reported[0], transmitter_id=77) == true[1]
    assert reported[2] == true[2]
    np.testing.assert_allclose(off_m(reported[1], true[0]), [0.3, -0.4, 1.2], atol=1e-5)
    with pytest.raises(ConfigError, match=r"bars\.2\.site_of = 3: expected one of 3 bars"):
        replace(wrong, bars=(one, two, replace(three, site_of=3)))
    with pytest.raises(ConfigError, match=r"bars\.transmitter_id = \[1, 77, 77\]: expected"):
        replace(wrong, bars=(one, two, replace(three, transmitter_id=77)))
    with pytest.raises(ConfigError, match=r"bars\.0: site_of and site_off_m .* expected a \[world\]"):
        replace(wrong, world=None)


def off_m(said: BarSite, true: BarSite) -> tuple[float, float, float]:
    """Where a site is said to be of where it is: east, north and up, m."""
    here, there = ((s.latitude_deg, s.longitude_deg, s.height_m) for s in (said, true))
    return pymap3d.geodetic2enu(*here, *there)


def test_a_survey_errs_by_what_it_says() -> None:
    assert SCENE.world is not None
    scene = replace(SCENE, world=replace(SCENE.world, survey_sigma_m=0.2))
    surveys = [survey_sites(scene, seed) for seed in range(100)]
    assert {site.position_sigma_m for survey in surveys for site in survey} == {0.2}
    errors = [off_m(*both) for survey in surveys for both in zip(survey, sites_of(scene), strict=True)]
    # 300 draws: the spread is known to 4 %.
    np.testing.assert_allclose(np.std(errors, 0), 0.2, rtol=0.16)


def test_what_is_stated_of_the_attitude_is_wrong_as_declared() -> None:
    assert SCENE.world is not None
    scene = replace(SCENE, duration_s=0.1, motion=replace(SCENE.motion, vib_rate_rad_s=0.2))
    simulation = Simulation(scene)

    def said(**wrong: object) -> AttitudeLog:
        log = attitude_log(replace(scene, world=replace(scene.world, **wrong)), 3, simulation.path)  # type: ignore[type-var]
        assert log is not None
        return log

    right, off = said(), said(attitude_off_deg=(1.0, -2.0, 3.0))
    for name, off_deg in (("pitch_deg", 1.0), ("roll_deg", -2.0), ("heading_deg", 3.0)):
        np.testing.assert_allclose(getattr(off, name) - getattr(right, name), off_deg)
    late = said(attitude_late_ms=10.0)
    np.testing.assert_allclose(late.pitch_deg[10:], right.pitch_deg[:-10])
    assert np.ptp(right.pitch_deg) > 0.01
    true = np.degrees(simulation.path.sample(right.t_us)[1][:, 1])
    np.testing.assert_allclose(said(attitude_errs=2.0).pitch_deg - true, 2 * (right.pitch_deg - true))
    assert set(said(attitude_errs=2.0).gravity_sigma_deg) == {0.1}
