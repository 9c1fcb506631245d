"""Fixes of satellites in the track, against the same as a Gaussian process; files of them; the geoid."""

import dataclasses
import math
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.gnss import GnssLog, add_heading, checksum, geoid_m, read_nmea, to_camera_fix
from evlcp_sdk.place.trajectory import GNSS, filter_fixes, smooth_trajectory, step_trajectory
from evlcp_sdk.results.nmea import format_clock, gst
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.sites import LocalAxes
from evlcp_sdk.values import Fix
from tests.unit.place.place_scenes import fix

Floats = NDArray[np.float64]

SPEC = ErrorModel(acceleration_m2_s3=0.5, gnss_s=4.0, gate_sigmas=50.0)
SIGMA_M = {"bars": np.array([0.03, 0.05, 0.02]), GNSS: np.array([0.8, 0.6, 1.5])}


def mixed_sources() -> list[tuple[float, str]]:
    """Bars at first and last, satellites all the time."""
    seen = [(0.04 + 0.1 * i, GNSS) for i in range(60)]
    seen += [(0.1 * i + 0.013, "bars") for i in range(60) if not 15 < i < 45]
    return sorted(seen)


def drive(rng: np.random.Generator) -> list[Fix]:
    found = []
    for t_s, source in mixed_sources():
        place = np.array([3.0, 20.0, 0.1]) * t_s + 0.3 * SIGMA_M[source] * rng.normal(size=3)
        spread, share = np.diag(SIGMA_M[source] ** 2), SPEC.gnss_white_share if source == GNSS else 1.0
        known = {"standing": {GNSS: np.sqrt((1 - share) * spread)}} if source == GNSS else {}
        found.append(fix(t_s * 1e6, place, share * spread, covariance_m2=spread, source=source, **known))
    return found


def process(seen: list[tuple[float, str]], axis: int) -> tuple[Floats, Floats]:
    """Covariances of one axis' places, and of the errors of what is seen, (n, n) each."""
    t = np.array([when for when, _ in seen])
    since, sooner, later = t[0], np.minimum.outer(t, t), np.maximum.outer(t, t)
    sooner, later, t = sooner - since, later - since, t - since
    wandering = sooner**3 / 3 + sooner**2 * (later - sooner) / 2
    places = 1e4 + 30.0**2 * np.outer(t, t) + SPEC.acceleration_m2_s3 * wandering
    sigma = np.array([SIGMA_M[source][axis] for _, source in seen])
    both = np.logical_and.outer(*2 * [np.array([source == GNSS for _, source in seen])])
    share = SPEC.gnss_white_share
    lasting = both * (1 - share) * np.exp(-np.abs(np.subtract.outer(t, t)) / SPEC.gnss_s)
    new = np.diag([share if source == GNSS else 1.0 for _, source in seen])
    return places, np.outer(sigma, sigma) * (lasting + new)


def test_the_track_is_the_gaussian_process() -> None:
    rng = np.random.default_rng(3)
    fixes = drive(rng)
    smooth = smooth_trajectory(filter_fixes(fixes, SPEC), SPEC)
    assert [cause.name for cause in smooth[-1].causes] == [GNSS]
    for axis in range(3):
        places, errors = process(mixed_sources(), axis)
        weight = np.linalg.solve(places + errors, places).T
        seen = np.array([one.enu_m[axis] for one in fixes])
        mean, spread = weight @ (seen - seen[0]) + seen[0], places - weight @ places
        np.testing.assert_allclose([p.mean[axis] for p in smooth], mean, atol=2e-4)
        found = [p.covariance[axis, axis] for p in smooth]
        np.testing.assert_allclose(found, np.diag(spread), rtol=2e-3, atol=1e-6)


def test_a_jump_of_satellites_is_left_out() -> None:
    fixes = drive(np.random.default_rng(5))
    jumped = dataclasses.replace(fixes[40], enu_m=fixes[40].enu_m + np.array([12.0, 0, 0]))
    assert jumped.source == GNSS
    points = filter_fixes(fixes[:40], SPEC)
    assert step_trajectory(points[-1], jumped, SPEC).rejected == 1
    assert step_trajectory(points[-1], fixes[40], SPEC).rejected == 0


def test_the_antenna_is_not_the_camera() -> None:
    axes = LocalAxes(35.0, 137.0, 50.0)
    place = np.stack(axes.to_geodetic(np.array([[200.0, 300.0, 4.0]])), 1)
    log = GnssLog(np.array([5.0]), place, np.diag([0.04, 0.09, 0.25])[None])
    spec = ErrorModel(antenna_m=(0.5, -1.0, -2.0))
    # Heading east: right is south, forward is east.
    east = Attitude(0.0, 0.0, 90.0, 0.0, math.degrees(0.1))
    found = to_camera_fix(log, 0, axes, east, spec)
    np.testing.assert_allclose(found.enu_m, [202.0, 300.5, 3.0], atol=1e-3)
    # A heading that is wrong by 0.1 moves the antenna's place by 0.2 to the side, 0.05 along.
    expected = np.diag([0.04, 0.09, 0.25]) + np.outer([0.05, -0.2, 0], [0.05, -0.2, 0])
    np.testing.assert_allclose(found.covariance_m2, expected, atol=1e-4)
    whole = found.noise_m2 + found.standing[GNSS] @ found.standing[GNSS].T
    np.testing.assert_allclose(whole, found.covariance_m2)
    assert found.alarms == ("unavailable",)
    assert to_camera_fix(log, 0, axes, Attitude(0.0, 0.0), spec) is None
    assert to_camera_fix(log, 0, axes, None, ErrorModel()) is not None


def test_headings_for_the_antenna() -> None:
    compass, gravity = Attitude(1.0, 2.0, 3.0), Attitude(1.0, 2.0, None, 0.3)
    assert add_heading(compass, None) is compass
    assert add_heading(None, None) is None
    assert add_heading(gravity, (-10.0, 0.5)) == Attitude(1.0, 2.0, 350.0, 0.3, 0.5)
    assert add_heading(None, (10.0, 0.5)).gravity_sigma_deg == pytest.approx(10)


HEAD = "t_us,latitude_deg,longitude_deg,height_m,sigma_east_m,sigma_north_m,sigma_up_m"


def test_a_file_of_fixes(tmp_path: Path) -> None:
    path = tmp_path / "gnss.csv"
    path.write_text(f"{HEAD},cov_east_north_m2\n0,35,137,50,1,2,3,0.5\n1e5,35.1,137,50,1,2,3,-0.5\n")
    log = GnssLog.read(path)
    assert log.t_us.tolist() == [0, 1e5]
    assert log.place[1].tolist() == [35.1, 137, 50]
    np.testing.assert_array_equal(log.covariance_m2[0], [[1, 0.5, 0], [0.5, 4, 0], [0, 0, 9]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + "\n", "one line of values or more"),
        (HEAD + "\n0,95,137,50,1,1,1\n", "line 2: latitude_deg = '95': expected -90 to 90"),
        (HEAD + "\n0,35,137,50,1,1,0\n", "line 2: sigma_up_m = '0': expected 0.0001 to 10000"),
        (HEAD + "\n0,35,137,5,1,1,1\n0,35,137,5,1,1,1\n", "line 3: t_us = 0: expected more than"),
        (HEAD + ",cov_east_up_m2\n0,35,137,5,1,1,3,-4\n", "cov_east_up_m2 = -4, .*: expected a covariance"),
        (HEAD + ",cov_north_east_m2\n0,35,137,5,1,1,1,0\n", "'cov_north_east_m2': expected cov_east_n"),
    ],
)
def test_faults_of_a_file(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "gnss.csv").write_text(text)
    with pytest.raises(ConfigError, match=message):
        GnssLog.read(tmp_path / "gnss.csv")
    with pytest.raises(ConfigError, match=r"gnss\.pos: a solution of RTKLIB: expected its NMEA"):
        GnssLog.read((tmp_path / "gnss.csv").rename(tmp_path / "gnss.pos"))


GGA = "$GPGGA,172814.0,3723.46587704,N,12202.26957864,W,2,6,1.2,18.893,M,-25.669,M,2.0,0031*4F"
GST = "$GPGST,172814.0,0.006,0.023,0.020,273.6,0.023,0.020,0.031*6A"
NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)


def sentence(body: str) -> str:
    return f"${body}*{checksum(body)}"


def at(clock: str, quality: int = 1) -> str:
    return sentence(f"GNGGA,{clock},3530.0,S,00015.0,W,{quality},9,1,50,M,40,M,,")


def gga(start: str, geoid: str = "40") -> str:
    return sentence(f"GPGGA,{start},N,00015,E,1,9,1,50,M,{geoid},M,,")


def write(folder: Path, *lines: str) -> Path:
    path = folder / "gnss.nmea"
    path.write_text("\r\n".join(lines) + "\r\n")
    return path


def test_a_place_with_its_sigmas(tmp_path: Path) -> None:
    log = GnssLog.read(write(tmp_path, GGA, "$GPGSA,M,1*37".replace("37", checksum("GPGSA,M,1")), GST), NOON)
    assert log.t_us.tolist() == [(5 * 3600 + 28 * 60 + 14) * 1e6]
    np.testing.assert_allclose(log.place[0], [37.391097951, -122.037826311, -6.776], atol=1e-8)
    np.testing.assert_allclose(np.sqrt(np.diag(log.covariance_m2[0])), [0.020, 0.023, 0.031])
    # An ellipse is that of the covariance.
    covariance = np.array([[4.0, -1.5, 0.0], [-1.5, 1.0, 0.0], [0.0, 0.0, 9.0]])
    reported = gst(format_clock(0.0, NOON), 1.0, covariance).strip()
    found = read_nmea(write(tmp_path, reported, at("120000.00")), NOON, 0.0)
    np.testing.assert_allclose(found.covariance_m2, [covariance], atol=0.01)


def test_days_follow_one_another(tmp_path: Path) -> None:
    times = at("235959.50"), at("000000.50"), at("000001.5", 0), "", at("120000"), at("235900")
    path = write(tmp_path, *times)
    zero = datetime(2026, 3, 2, 0, 0, 1, tzinfo=UTC)
    found = read_nmea(path, zero, 2.0)
    assert [(zero + timedelta(microseconds=t_us)).isoformat() for t_us in found.t_us] == [
        "2026-03-01T23:59:59.500000+00:00",
        "2026-03-02T00:00:00.500000+00:00",
        "2026-03-02T12:00:00+00:00",
        "2026-03-02T23:59:00+00:00",
    ]
    assert found.place[0] == pytest.approx((-35.5, -0.25, 90.0))
    np.testing.assert_allclose(found.covariance_m2[0], np.diag([4.0, 4.0, 16.0]))


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([GGA[:-1] + "0"], r"line 1: expected a sentence, \$...\*, and its checksum with 4F"),
        ([GGA, "noise"], "line 2: expected a sentence"),
        ([GGA], r"line 1: GGA without a GST of its time: expected one, or --set position.gnss_sigma_m"),
        ([at("120000", 0)], "expected a GGA with a fix or more"),
        ([gga("250000,3530")], "line 1: GGA's time = '25': expected 0 to 23"),
        ([gga("120000,9530")], "latitude_deg = '95': expected 0 to 90"),
        ([gga("120000,3530", "")], "line 1: GGA without the height of the geoid"),
        ([sentence("GPGGA,120000,3530,s,00015,E,1,9,1,50,M,40,M,,")], "GGA's field 3 = 's': expected N or S"),
        ([sentence("GPGGA,120000,3530,N,00015,E,X,9,1,50,M,40,M,,")], "quality = 'X': expected a number"),
        ([GGA, GST, GGA], "line 3: t_us = 19694000000: expected more"),
    ],
)
def test_faults_of_nmea(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        GnssLog.read(write(tmp_path, *lines), NOON)


def test_nmea_is_known_by_its_first_letter_too_and_needs_the_clock(tmp_path: Path) -> None:
    path = write(tmp_path, GGA, GST)
    other = path.rename(tmp_path / "gnss.txt")
    with pytest.raises(ConfigError, match="NMEA tells UTC: expected --clock-zero"):
        GnssLog.read(other)
    assert GnssLog.read(other, NOON).place.tolist() == GnssLog.read(other.rename(path), NOON).place.tolist()
    with pytest.raises(InputError, match="cannot be read"):
        GnssLog.read(other, NOON)


# The points and heights that come with EGM96's own program, by interpolation in its grid of a quarter degree.
PUBLISHED = [
    (38.6281550, 269.7791550, -31.628),
    (-14.6212170, 305.0211140, -2.969),
    (46.8743190, 102.4487290, -43.575),
    (-23.6174460, 133.8747120, 15.871),
    (38.6254730, 359.9995000, 50.066),
    (-0.4667440, 0.0023000, 17.329),
]


def test_published_points_and_poles() -> None:
    for latitude, longitude, height_m in PUBLISHED:
        assert geoid_m(latitude, longitude) == pytest.approx(height_m, abs=0.5)
    assert {geoid_m(90.0, lon) for lon in (-180, 0.5, 77, 359.9)} == {13.6}
    assert {geoid_m(-90.0, lon) for lon in (-180, 0.5, 77, 359.9)} == {-29.5}


@given(st.floats(-89.99, 89.99), st.floats(-180, 540))
def test_goes_around_without_a_seam(latitude: float, longitude: float) -> None:
    here = geoid_m(latitude, longitude)
    assert -107.1 <= here <= 85.5
    assert geoid_m(latitude, longitude + 1e-6) == pytest.approx(here, abs=0.1001)
    assert geoid_m(latitude, longitude - 360) == pytest.approx(here, abs=0.1001)
