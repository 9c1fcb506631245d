"""Positions over TCP: as NMEA's and gpsd's own readers take them, and what a client that stalls costs."""

import json
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime

import numpy as np
import pynmea2
import pytest

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.link.several import named_links
from evlcp_sdk.live import Publisher
from evlcp_sdk.live.services import Services, Serving
from evlcp_sdk.place.navigator import Place, Placed
from evlcp_sdk.values import Fix

LINKS = named_links(load_link())
GPSPIPE = shutil.which("gpspipe")


@pytest.fixture
def served() -> Iterator[tuple[Publisher, Services]]:
    publisher = Publisher()
    with Services(Serving(nmea_port=0, gpsd_port=0), publisher, LINKS, name="x") as services:
        yield publisher, services
        publisher.close()


def port_of(services: Services, kind: str) -> int:
    server = {"nmea": services.nmea, "gpsd": services.gpsd}[kind]
    assert server is not None
    return server.port


def tell(publisher: Publisher, t_us: float) -> None:
    spread = np.diag([0.09, 0.16, 0.25])
    east_north_up = np.zeros(3)
    where = 35.68, 139.77, 60.0
    fix = Fix(
        t_us, *where, east_north_up, spread, spread, 0.0, 0.0, 0.0, 0.1, (0,), verified=True, misfit=1.0
    )
    place = Place(t_us, *where, east_north_up, spread, 5.0, 90.0, left_out=False, starts=False)
    publisher.publish("fix", t_us, Placed(fix, place))


def until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + 10
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_nmea_has_the_time_of_day_where_no_other_is_known(served: tuple[Publisher, Services]) -> None:
    publisher, services = served
    with socket.create_connection(("127.0.0.1", port_of(services, "nmea")), 10) as link:
        link.settimeout(10)
        lines = link.makefile("r", newline="\r\n")
        time.sleep(0.5)  # until it is served
        for n in range(3):
            tell(publisher, 7e9 + n * 1e6)
        sentences = [pynmea2.parse(next(lines).strip(), check=True) for _ in range(15)]
    assert [one.sentence_type for one in sentences[:5]] == ["TXT", "GGA", "RMC", "GST", "GBS"]
    told = [datetime.combine(one.datestamp, one.timestamp) for one in sentences[2::5]]
    # The first fix was just now, as its camera's clock was first heard of then.
    assert abs((told[0].replace(tzinfo=UTC) - datetime.now(UTC)).total_seconds()) < 5
    assert [(at - told[0]).total_seconds() for at in told] == [0, 1, 2]
    assert [float(one.altitude) + float(one.geo_sep) for one in sentences[1::5]] == pytest.approx([60.0] * 3)


def test_a_client_that_stalls_or_leaves_costs_nothing(served: tuple[Publisher, Services]) -> None:
    publisher, services = served
    address = "127.0.0.1", port_of(services, "nmea")
    stalled = socket.socket()
    stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    stalled.connect(address)
    gone = socket.create_connection(address)
    time.sleep(0.1)
    gone.close()
    longest = 0.0
    for n in range(20_000):
        began = time.perf_counter()
        tell(publisher, n * 1e5)
        longest = max(longest, time.perf_counter() - began)
        if n % 200 == 0:
            time.sleep(0.01)
        if services.dropped["nmea"] > 10:
            break
    assert services.dropped["nmea"] > 10
    assert longest < 1
    stalled.close()
    with socket.create_connection(address, 10) as link:
        link.settimeout(10)
        link.settimeout(0.2)
        began = time.monotonic()
        got = b""
        while not got and time.monotonic() < began + 10:
            tell(publisher, 5e9)
            with suppress(TimeoutError):
                got = link.recv(6)
        assert got == b"$INTXT"


def test_gpsd_talks_once_it_is_asked(served: tuple[Publisher, Services]) -> None:
    publisher, services = served
    with socket.create_connection(("127.0.0.1", port_of(services, "gpsd")), 10) as link:
        link.settimeout(10)
        lines = link.makefile("rw", newline="\r\n")
        assert json.loads(next(lines))["class"] == "VERSION"
        tell(publisher, 0)
        link.sendall(b'?WATCH={"enable":true,"json":true};\n')
        assert [json.loads(next(lines))["class"] for _ in range(2)] == ["DEVICES", "WATCH"]
        tell(publisher, 1e6)
        place, bars = (json.loads(next(lines)) for _ in range(2))
        assert (place["class"], place["mode"], place["altHAE"], place["track"]) == ("TPV", 3, 60.0, 90.0)
        assert (bars["class"], bars["uSat"]) == ("SKY", 1)
        link.sendall(b"?POLL;?VERSION;\n")
        poll, version = (json.loads(next(lines)) for _ in range(2))
        assert poll["tpv"] == [place]
        assert version["class"] == "VERSION"
        link.sendall(b"x" * 10_000)
        until(lambda: link.recv(4096) == b"" or True)


@pytest.mark.skipif(GPSPIPE is None, reason="gpspipe is not installed (Debian: package gpsd-clients)")
def test_gpspipe_reads_it(served: tuple[Publisher, Services]) -> None:
    publisher, services = served
    assert GPSPIPE is not None
    address = f"127.0.0.1:{port_of(services, 'gpsd')}"
    reader = subprocess.Popen([GPSPIPE, "-w", "-n", "6", address], stdout=subprocess.PIPE, text=True)
    for n in range(200):
        tell(publisher, n * 1e5)
        if reader.poll() is not None:
            break
        time.sleep(0.05)
    out, _ = reader.communicate(timeout=10)
    kinds = [json.loads(line)["class"] for line in out.splitlines()]
    assert kinds[:3] == ["VERSION", "DEVICES", "WATCH"]
    assert "TPV" in kinds
