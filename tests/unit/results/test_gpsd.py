"""Reports and answers as those of gpsd."""

from datetime import UTC, datetime

import numpy as np
import pytest

from evlcp_sdk.place.navigator import Place
from evlcp_sdk.results.gpsd import answer, sky, tpv
from evlcp_sdk.values import Fix

COVARIANCE = np.diag([0.09, 0.16, 0.25])


def test_reports_say_what_the_fix_says() -> None:
    zero = datetime(2026, 3, 1, 10, 15, tzinfo=UTC)
    here = 600e3, 35.68, 139.77, 60.0, np.zeros(3), COVARIANCE
    place = Place(*here, 10.0, 0.0, left_out=False, starts=False)
    fix = Fix(*here, COVARIANCE, 0.0, 0.0, 0.0, 0.1, (0, 3), verified=True)
    report = tpv(fix, place, zero)
    assert report["time"] == "2026-03-01T10:15:00.600Z"
    assert report["altMSL"] + report["geoidSep"] == pytest.approx(report["altHAE"]) == 60.0
    assert (report["epx"], report["epy"], report["epv"], report["eph"]) == (0.3, 0.4, 0.5, 0.5)
    assert (report["mode"], report["speed"], report["track"]) == (3, 10.0, 0.0)
    assert sky(fix, zero)["satellites"] == [{"PRN": 0, "used": True}, {"PRN": 3, "used": True}]
    refused = Fix.refused(1e6, (2,), "misfit", "")
    assert tpv(refused, None, None) == {"class": "TPV", "device": "evlcp", "mode": 1}
    assert sky(refused, None)["uSat"] == 0


def test_clients_are_answered() -> None:
    watch = {"enable": False, "json": False, "nmea": False}
    said = answer('?WATCH={"enable":true,"json":true};', watch, {})
    assert [one["class"] for one in said] == ["DEVICES", "WATCH"]
    assert watch == {"enable": True, "json": True, "nmea": False}
    answer('?WATCH={"enable":true,"nmea":true}', watch, {})
    assert watch["nmea"]
    assert answer("?VERSION;", watch, {})[0]["proto_major"] == 3
    assert answer("?POLL;", watch, {"TPV": {"mode": 3}})[0]["tpv"] == [{"mode": 3}]
    for fault in ("?WATCH={", "?WATCH=[1]", "hello", "?\x00"):
        assert answer(fault, watch, {})[0]["class"] == "ERROR"
