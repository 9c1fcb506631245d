"""NMEA and its answers as gpsd itself reads and gives them."""

import json
import shutil
import socket
import subprocess
import threading
import time
from datetime import UTC, datetime

import numpy as np
import pytest

from evlcp_sdk.place.navigator import Place
from evlcp_sdk.results.gpsd import answer, sky, tpv
from evlcp_sdk.results.nmea import sentences
from evlcp_sdk.values import Fix

GPSD = shutil.which("gpsd") or shutil.which("gpsd", path="/usr/sbin")
COVARIANCE = np.diag([0.09, 0.16, 0.25])


def drive(zero: datetime | None) -> list[tuple[Fix, Place, str]]:
    """A camera that goes north at 10 m/s in Tokyo, five fixes a second, in NMEA."""
    found = []
    for n in range(10):
        t_us, latitude = n * 200e3, 35.68 + n * 2 / 110_950
        place = Place(
            t_us, latitude, 139.77, 60.0, np.zeros(3), COVARIANCE, 10.0, 0.0, left_out=False, starts=n == 0
        )
        fix = Fix(
            t_us, latitude, 139.77, 60.0, np.zeros(3), COVARIANCE, COVARIANCE, 0.0, 0.0, 0.0, 0.1, (0, 3),
            verified=True, misfit=1.0, hpl_m=2.0, vpl_m=2.0, hidden_m=np.array([0.75, 0.5, 1.25]),
        )  # fmt: skip
        found.append((fix, place, sentences(fix, place, zero)))
    return found


def test_reports_say_what_the_fix_says() -> None:
    zero = datetime(2026, 3, 1, 10, 15, tzinfo=UTC)
    fix, place, _ = drive(zero)[3]
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


@pytest.mark.skipif(GPSD is None, reason="gpsd is not installed (Debian: package gpsd)")
def test_gpsd_reads_the_height_above_the_ellipsoid() -> None:
    assert GPSD is not None
    with socket.create_server(("127.0.0.1", 0)) as ours, socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
        probe.close()
        over = threading.Event()

        def send() -> None:
            ours.settimeout(20)
            link, _ = ours.accept()
            with link:
                for n in range(100):
                    if over.is_set():
                        break
                    link.sendall(drive(datetime.now(UTC))[n % 10][2].encode())
                    time.sleep(0.05)

        sender = threading.Thread(target=send)
        sender.start()
        url = f"tcp://127.0.0.1:{ours.getsockname()[1]}"
        daemon = subprocess.Popen([GPSD, "-N", "-n", "-b", "-S", str(port), url], stderr=subprocess.DEVNULL)
        try:
            report = _first_place(port)
        finally:
            over.set()
            daemon.terminate()
            daemon.wait(10)
            sender.join(10)
    assert report["mode"] == 3
    assert report["lat"] == pytest.approx(35.68, abs=1e-3)
    assert report["altHAE"] == pytest.approx(60.0, abs=1e-3)
    assert report["geoidSep"] == pytest.approx(36.8, abs=0.5)
    # Of GBS: what a fault may hide.
    assert (report["epx"], report["epy"], report["epv"]) == pytest.approx((0.75, 0.5, 1.25), abs=1e-3)


def _first_place(port: int) -> dict[str, float]:
    """The first report of gpsd's with a place."""
    until = time.monotonic() + 15
    while time.monotonic() < until:
        try:
            link = socket.create_connection(("127.0.0.1", port), 5)
        except OSError:
            time.sleep(0.05)
            continue
        with link, link.makefile("rw") as lines:
            link.settimeout(10)
            lines.write('?WATCH={"enable":true,"json":true};\n')
            lines.flush()
            for line in lines:
                said = json.loads(line)
                if said["class"] == "TPV" and said.get("mode") == 3:
                    return dict(said)
    raise AssertionError("gpsd gives no place")
