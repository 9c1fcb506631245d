"""NMEA of receivers of satellites: against sentences of a maker's manual, and our own writer."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.place.gnss import GnssLog, checksum, read_nmea
from evlcp_sdk.results.nmea import clock_of, gst

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


def test_an_ellipse_is_that_of_the_covariance(tmp_path: Path) -> None:
    covariance = np.array([[4.0, -1.5, 0.0], [-1.5, 1.0, 0.0], [0.0, 0.0, 9.0]])
    told = gst(clock_of(0.0, NOON), 1.0, covariance).strip()
    (found,) = read_nmea(write(tmp_path, told, at("120000.00")), NOON, 0.0)
    np.testing.assert_allclose(found.covariance_m2, covariance, atol=0.01)


def test_days_follow_one_another(tmp_path: Path) -> None:
    path = write(
        tmp_path, at("235959.50"), at("000000.50"), at("000001.5", 0), "", at("120000"), at("235900")
    )
    found = read_nmea(path, datetime(2026, 3, 2, 0, 0, 1, tzinfo=UTC), 2.0)
    assert [fix.utc.isoformat() for fix in found] == [
        "2026-03-01T23:59:59.500000+00:00",
        "2026-03-02T00:00:00.500000+00:00",
        "2026-03-02T12:00:00+00:00",
        "2026-03-02T23:59:00+00:00",
    ]
    assert found[0].place == pytest.approx((-35.5, -0.25, 90.0))
    np.testing.assert_allclose(found[0].covariance_m2, np.diag([4.0, 4.0, 16.0]))


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([GGA[:-1] + "0"], r"line 1: expected a sentence, \$...\*, and its checksum with 4F"),
        ([GGA, "noise"], "line 2: expected a sentence"),
        ([GGA], r"line 1: GGA without a GST of its time: expected one, or --set position.gnss_sigma_m"),
        ([at("120000", 0)], "expected a GGA with a fix or more"),
        ([gga("250000,3530")], "line 1: GGA's time = '25': expected 0 to 23"),
        ([gga("120000,9530")], "latitude_deg = '95': expected 0 to 90"),
        ([gga("120000,")], "latitude_deg = '': expected a number"),
        ([gga("120000,3530", "")], "line 1: GGA without the height of the geoid"),
        ([gga("120000,-3530")], "latitude_deg = '-35': expected 0 to 90"),
        ([sentence("GPGGA,120000,3530,s,00015,E,1,9,1,50,M,40,M,,")], "GGA's field 3 = 's': expected N or S"),
        ([sentence("GPGGA,120000,3530,N,00015,N,1,9,1,50,M,40,M,,")], "GGA's field 5 = 'N': expected E or W"),
        ([sentence("GPGGA,120000,3530,N,00015,E,1,9,1,50,F,40,M,,")], "GGA's field 10 = 'F': expected M"),
        ([sentence("GPGGA,120000,3530,N,00015,E,X,9,1,50,M,40,M,,")], "quality = 'X': expected a number"),
        ([GGA, GST, GGA], "line 3: t_us = 19694000000: expected more"),
    ],
)
def test_faults_of_nmea(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        GnssLog.read(write(tmp_path, *lines), NOON)


def test_nmea_is_known_by_its_first_letter_too(tmp_path: Path) -> None:
    path = write(tmp_path, GGA, GST)
    other = path.rename(tmp_path / "gnss.txt")
    assert GnssLog.read(other, NOON).place.tolist() == GnssLog.read(other.rename(path), NOON).place.tolist()


def test_utc_needs_the_clock(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="NMEA tells UTC: expected --clock-zero"):
        GnssLog.read(write(tmp_path, GGA, GST))
    with pytest.raises(InputError, match="cannot be read"):
        GnssLog.read(tmp_path / "none.txt", NOON)
