"""Positions over TCP: as NMEA's and gpsd's own readers take them, and what a client that stalls costs."""

import json
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime

import pynmea2
import pytest

from evlcp_sdk.cli.live import ServingOptions, _serve
from evlcp_sdk.errors import InterruptedRunError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.live import News, Publisher
from evlcp_sdk.live.recorder import Recorder
from evlcp_sdk.live.server import Server, serve
from evlcp_sdk.live.tcp_output import TcpOutput
from tests.unit.live.helpers import dies, publish_fix


@pytest.fixture
def served() -> Iterator[tuple[Publisher, dict[str, Server]]]:
    publisher = Publisher()
    services = {kind: TcpOutput(publisher, gpsd=kind == "gpsd") for kind in ("nmea", "gpsd")}
    with serve(publisher, services.values()):
        yield publisher, services
        publisher.close()


def test_nmea_has_the_time_of_day_where_no_other_is_known(served) -> None:
    publisher, services = served
    got, n = b"", 0
    with socket.create_connection(("127.0.0.1", services["nmea"].port), 10) as link:
        link.settimeout(0.1)
        # The first ones may come before it is served.
        while got.count(b"\n") < 15:
            publish_fix(publisher, 7e9 + n * 1e6)
            n += 1
            with suppress(TimeoutError):
                got += link.recv(1 << 16)
    sentences = [pynmea2.parse(line, check=True) for line in got.decode().splitlines()[:15]]
    assert [one.sentence_type for one in sentences[:5]] == ["TXT", "GGA", "RMC", "GST", "GBS"]
    reported = [datetime.combine(one.datestamp, one.timestamp) for one in sentences[2::5]]
    # The very first fix was just now, as its camera's clock was first heard of then.
    assert 0 < (reported[0].replace(tzinfo=UTC) - datetime.now(UTC)).total_seconds() + 60 < n + 60
    assert [(at - reported[0]).total_seconds() for at in reported] == [0, 1, 2]


def test_the_computer_knows_utc_from_the_first_event_on_and_again_at_a_restart() -> None:
    output = TcpOutput(Publisher(), gpsd=True)
    for t_us in (0.0, 9e9, 5e6, 4.9e6):
        output._send_fix(News("status", t_us, None))
    assert 0 <= (datetime.now(UTC) - output._zero).total_seconds() - 5 < 60


def test_a_client_that_stalls_or_leaves_costs_nothing(served: tuple[Publisher, dict[str, Server]]) -> None:
    publisher, services = served
    address = "127.0.0.1", services["nmea"].port
    stalled = socket.socket()
    stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    stalled.connect(address)
    gone = socket.create_connection(address)
    time.sleep(0.1)
    dies(gone)
    for n in range(20_000):
        publish_fix(publisher, n * 1e5)
        if n % 200 == 0:
            time.sleep(0.01)
        if services["nmea"].dropped > 10:
            break
    assert services["nmea"].dropped > 10
    stalled.close()
    with socket.create_connection(address, 10) as link:
        link.settimeout(0.2)
        got = b""
        while not got:
            publish_fix(publisher, 5e9)
            with suppress(TimeoutError):
                got = link.recv(6)
        assert got == b"$INTXT"


def test_the_command_reports_what_slow_clients_and_a_full_disk_missed(monkeypatch, capsys) -> None:
    monkeypatch.setattr(TcpOutput, "dropped", 3)
    monkeypatch.setattr(Recorder, "state", {"fault": "no room", "file": "live.raw", "dropped": 2})
    options = ServingOptions(nmea_port=0, view_record=True)
    serving = _serve(options, Publisher(), [load_link()], "a.raw", None, None, None)
    with suppress(InterruptedRunError), serving:
        served = capsys.readouterr().err
        raise InterruptedRunError
    assert served.startswith("evlcp: NMEA at ")
    url = served.split()[-1]
    assert capsys.readouterr().err.splitlines() == [
        f"evlcp: {url}: 3 results were not sent, as clients were too slow",
        "evlcp: the recording ended: no room",
        "evlcp: live.raw: 2 pieces are missing: the disk was too slow",
    ]


def test_gpsd_talks_once_it_is_asked(served: tuple[Publisher, dict[str, Server]]) -> None:
    publisher, services = served
    with socket.create_connection(("127.0.0.1", services["gpsd"].port), 10) as link:
        link.settimeout(10)
        lines = link.makefile("rw", newline="\r\n")
        assert json.loads(next(lines))["class"] == "VERSION"
        publish_fix(publisher, 0)
        link.sendall(b'?WATCH={"enable":true,"json":true};\n')
        assert [json.loads(next(lines))["class"] for _ in range(2)] == ["DEVICES", "WATCH"]
        publish_fix(publisher, 1e6)
        place, bars = (json.loads(next(lines)) for _ in range(2))
        assert (place["class"], place["mode"], place["altHAE"], place["track"]) == ("TPV", 3, 60.0, 90.0)
        assert (bars["class"], bars["uSat"]) == ("SKY", 1)
        link.sendall(b"?POLL;?VERSION;\n")
        poll, version = (json.loads(next(lines)) for _ in range(2))
        assert poll["tpv"] == [place]
        assert version["class"] == "VERSION"
        link.sendall(b"x" * 10_000)
        with suppress(ConnectionError):
            while link.recv(4096):
                pass
