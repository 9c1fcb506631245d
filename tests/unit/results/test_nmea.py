"""NMEA sentences, read back by an independent parser; reports and answers as those of gpsd."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pynmea2
import pytest
from hypothesis import given, strategies as st

from evlcp_sdk.place.navigator import Place
from evlcp_sdk.results.gpsd import answer_request, sky, tpv
from evlcp_sdk.results.nmea import format_clock, gga, rmc
from evlcp_sdk.values import Fix

ZERO = datetime(2026, 3, 1, 23, 59, 58, tzinfo=UTC)


@given(
    st.floats(-90, 90), st.floats(-180, 180), st.floats(-100, 9000), st.floats(0, 1e9),
    st.integers(1, 20), st.floats(0, 100), st.floats(0, 360),
)  # fmt: skip
def test_sentences_read_back(lat, lon, height, t_us, bars, speed, course) -> None:
    place = (lat, lon, height)
    sentence = gga(format_clock(t_us, ZERO), place, bars)
    assert len(sentence) <= 82
    seen = pynmea2.parse(sentence.strip(), check=True)
    assert seen.talker == "IN"
    # 1e-6 minutes, rounded.
    assert seen.latitude == pytest.approx(lat, abs=1e-8)
    assert seen.longitude == pytest.approx(lon, abs=1e-8)
    # Above the sea, and the sea above the ellipsoid: a reader who adds them has the height.
    assert seen.altitude + float(seen.geo_sep) == pytest.approx(height, abs=5e-4 + 1e-9)
    assert (seen.altitude_units, seen.geo_sep_units) == ("M", "M")
    assert (seen.gps_qual, int(seen.num_sats)) == (6, bars)
    assert seen.horizontal_dil == ""
    moved = pynmea2.parse(rmc(format_clock(t_us, ZERO), place, (speed, course)).strip(), check=True)
    assert moved.is_valid
    assert moved.latitude == pytest.approx(lat, abs=1e-8)
    assert moved.spd_over_grnd == pytest.approx(speed * 3600 / 1852, abs=6e-4)
    assert abs((moved.true_course - course + 180) % 360 - 180) < 6e-3
    at = ZERO + timedelta(microseconds=t_us)
    reported = datetime.combine(moved.datestamp, moved.timestamp)
    assert abs((reported - at).total_seconds()) <= 6e-4


def test_no_fix_says_so() -> None:
    begun = format_clock(1e6, None)
    seen = pynmea2.parse(gga(begun, None, 0).strip(), check=True)
    assert seen.gps_qual == 0
    assert seen.lat == ""
    assert str(seen.timestamp)[:8] == "00:00:01"
    lost = pynmea2.parse(rmc(begun, None, None).strip(), check=True)
    assert not lost.is_valid
    assert lost.datestamp is None
    still = pynmea2.parse(rmc(begun, (0.0, 0.0, 0.0), None).strip(), check=True)
    assert still.is_valid
    assert still.spd_over_grnd is None


def test_sixty_minutes_carry() -> None:
    assert ",0.00,010326," in rmc(format_clock(0, ZERO), (0.0, 0.0, 0.0), (0.0, 359.999))
    assert ",3600.000000,N," in gga(format_clock(0, None), (35.999999999, 0.0, 0.0), 1)


def test_reports_say_what_the_fix_says() -> None:
    spread = np.diag([0.09, 0.16, 0.25])
    here = 600e3, 35.68, 139.77, 60.0, np.zeros(3), spread
    place = Place(*here, 10.0, 0.0, left_out=False, starts=False)
    fix = Fix(*here, spread, 0.0, 0.0, 0.0, 0.1, (0, 3), verified=True)
    report = tpv(fix, place, ZERO)
    assert report["time"] == "2026-03-01T23:59:58.600Z"
    assert report["altMSL"] + report["geoidSep"] == pytest.approx(report["altHAE"]) == 60.0
    assert (report["epx"], report["epy"], report["epv"], report["eph"]) == (0.3, 0.4, 0.5, 0.5)
    assert (report["mode"], report["speed"], report["track"]) == (3, 10.0, 0.0)
    assert sky(fix, ZERO)["satellites"] == [{"PRN": 0, "used": True}, {"PRN": 3, "used": True}]
    refused = Fix.from_refusal(1e6, (2,), "misfit", "")
    assert tpv(refused, None, None) == {"class": "TPV", "device": "evlcp", "mode": 1}
    assert sky(refused, None)["uSat"] == 0


def test_clients_are_answered() -> None:
    watch = {"enable": False, "json": False, "nmea": False}
    # A client that only polls gets nothing else.
    answer_request('?WATCH={"enable":true}', watch, {})
    assert watch == {"enable": True, "json": False, "nmea": False}
    reported = answer_request('?WATCH={"enable":true,"json":true};', watch, {})
    assert [one["class"] for one in reported] == ["DEVICES", "WATCH"]
    assert watch == {"enable": True, "json": True, "nmea": False}
    for name in ("nmea", "raw"):
        watch["nmea"] = False
        answer_request(f'?WATCH={{"enable":true,"{name}":1}}', watch, {})
        assert watch["nmea"] is True
    assert answer_request("?VERSION;", watch, {})[0]["proto_major"] == 3
    (device,) = answer_request("?DEVICE;", watch, {})
    assert answer_request("?DEVICES;", watch, {}) == [{"class": "DEVICES", "devices": [device]}]
    assert answer_request("?POLL;", watch, {})[0]["active"] == 0
    assert answer_request("?POLL;", watch, {"TPV": {"mode": 3}})[0]["tpv"] == [{"mode": 3}]
    for fault in ("?WATCH={", "?WATCH=[1]", "hello", "?\x00"):
        assert answer_request(fault, watch, {})[0]["class"] == "ERROR"
