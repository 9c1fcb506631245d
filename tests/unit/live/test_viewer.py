"""The web view: who may look on, what a browser gets and when, and what it shows."""

import http.client
import io
import json
import math
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from evlcp_sdk.air.blocks import Message
from evlcp_sdk.air.kinds import TextKind
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.io.open import open_source
from evlcp_sdk.live import Publisher, server
from evlcp_sdk.live.recorder import Recorder
from evlcp_sdk.live.server import serve
from evlcp_sdk.live.viewer import Viewer, render_viewer_page
from evlcp_sdk.place.navigator import Place, Placed
from evlcp_sdk.run import live
from evlcp_sdk.scene.sites import LocalAxes
from evlcp_sdk.values import Events, Fix, ReceivedMessage, Triggers
from tests.conftest import rows_of
from tests.unit.live.helpers import LINKS, PATIENT, sender, wait_until
from tests.unit.report.test_pages import HOSTILE
from tests.unit.results.test_positions import SITE, packets
from tests.unit.study.browser import CHROMIUM, Browser

websockets = pytest.importorskip("websockets", reason="the extra live is not installed")
from websockets.exceptions import ConnectionClosedError, InvalidStatus  # noqa: E402
from websockets.sync.client import ClientConnection, connect  # noqa: E402

FRAMES = [frame for packet in packets(3) for frame in packet.frames]


@dataclass
class Stage:
    """A run that a test makes up, and its view."""

    publisher: Publisher
    view: Viewer

    def connect(self, **given: Any) -> ClientConnection:
        return connect(self.view.url.replace("http", "ws") + "live", compression=None, max_size=None, **given)

    def ask(self, path: str, **headers: str) -> tuple[int, dict[str, str], str]:
        link = http.client.HTTPConnection("127.0.0.1", self.view.port, timeout=10)
        with closing(link):
            link.request("GET", path, headers=headers)
            answer = link.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read().decode()

    def frame(self, n: int) -> None:
        frame = FRAMES[n % len(FRAMES)]
        self.publisher.publish("frame", frame.t_us, frame, 2.5)

    def picture(self, t_us: int) -> None:
        """A slice with one event, at column 5 of row 7, as the loop gives it."""
        events = Events.of([t_us - 1, t_us], [5, 5], [7, 7], [1, 1])
        self.publisher.pictures.add(events, 1280, 720, ())


@contextmanager
def run_viewer(record_to: Path | None = None, **given: Any) -> Iterator[Stage]:
    publisher = Publisher()
    recorder = Recorder(publisher, record_to, 1280, 720) if record_to is not None else None
    view = Viewer(publisher, LINKS, name="a name", sites=(SITE,), recorder=recorder, **given)
    with serve(publisher, [view], recorder):
        yield Stage(publisher, view)
        publisher.close()


@pytest.fixture
def stage() -> Iterator[Stage]:
    with run_viewer() as one:
        yield one


def bundle_of(link: ClientConnection) -> tuple[dict[str, Any], bytes]:
    bundle = link.recv(30, decode=False)
    (size,) = struct.unpack_from("<I", bundle)
    return json.loads(bundle[4 : 4 + size]), bundle[4 + size :]


def next_of(link: ClientConnection) -> tuple[dict[str, Any], bytes]:
    link.send('{"next": true}')
    return bundle_of(link)


def test_the_page_needs_nothing_else_and_names_cannot_write_it() -> None:
    text = render_viewer_page(HOSTILE)
    assert HOSTILE not in text
    assert "default-src 'none'" in text
    assert "connect-src 'self'" in text
    assert "unsafe-eval" not in text
    assert not [part for part in ('<link rel="stylesheet', 'src="http', "@import") if part in text]


def test_who_may_look_on(stage: Stage) -> None:
    path = stage.view.url.split(str(stage.view.port), 1)[1]
    status, headers, body = stage.ask(path)
    assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert (headers["Referrer-Policy"], headers["Cache-Control"]) == ("no-referrer", "no-store")
    assert "a name" in body
    own = f"127.0.0.1:{stage.view.port}"
    assert stage.ask(path, Host=f"localhost:{stage.view.port}")[0] == 200
    foreign = "evil.example", f"evil.example:{stage.view.port}"
    for host in (*foreign, "127.0.0.1", "127.0.0.1:1", f"u@{own}", "[", ""):
        assert stage.ask(path, Host=host)[0] == 403, host
    for origin in ("http://evil.example", "null"):
        assert stage.ask(path, Origin=origin)[0] == 403
    for wrong in ("/", "/wrong/", path[:-2] + "/"):
        assert stage.ask(wrong)[0] == 403
    assert stage.ask(path + "else")[0] == 404
    for enter in (lambda: stage.connect(origin=foreign[0]), lambda: connect(f"ws://{own}/wrong/live")):
        with pytest.raises(InvalidStatus, match="403"):
            enter()
    with stage.connect(origin=f"http://{own}") as link:
        assert json.loads(link.recv(30))["about"]["name"] == "a name"


def test_a_credit_a_bundle(stage: Stage) -> None:
    with stage.connect() as link:
        about = json.loads(link.recv(30))["about"]
        assert (about["links"][""]["symbols"], about["may_record"]) == (64, False)
        assert len(about["links"][""]["cluster_colours"]) == 16
        stage.frame(0)
        with pytest.raises(TimeoutError):
            link.recv(0.2)
        head, picture = next_of(link)
        (reported,) = head["news"]
        assert (reported["line"], reported["t_us"], reported["late_ms"]) == ("frame", FRAMES[0].t_us, 2.5)
        assert reported["symbols"] == FRAMES[0].soft.symbols.tolist()
        assert (head["picture"], picture) == (None, b"")
        link.send('{"next": true}')
        # One is drawn once it is asked for.
        wait_until(lambda: stage.publisher.pictures._requested)
        stage.picture(20_000)
        head, picture = bundle_of(link)
        assert (head["news"], head["picture"]["t_us"]) == ([], 20_000)
        with Image.open(io.BytesIO(picture)) as shown:
            assert np.argwhere(np.array(shown)).tolist() == [[7, 5]]
        (bar,) = head["bars"]
        assert bar["points"][0] == pytest.approx(FRAMES[0].points_px[0].tolist(), abs=0.01)
        # Nothing is sent twice; who is slow to ask still gets the last words.
        link.send('{"next": true}')
        with pytest.raises(TimeoutError):
            link.recv(0.2)
        stage.frame(1)
        assert len(bundle_of(link)[0]["news"]) == 1
        stage.frame(2)
        stage.publisher.close()
        time.sleep(0.3)
        assert len(next_of(link)[0]["news"]) == 1


def test_one_that_stalls_costs_the_others_nothing(stage: Stage) -> None:
    with stage.connect() as stalled, stage.connect() as quick:
        stalled.recv(30)
        quick.recv(30)
        seen = 0
        for n in range(6000):
            stage.frame(n)
            if n % 1000 == 999:
                head, _ = next_of(quick)
                seen += len(head["news"])
                assert head["dropped"] == 0
        while seen < 6000:
            seen += len(next_of(quick)[0]["news"])
        head, _ = next_of(stalled)
        # The newest, and how many there were before them.
        assert (len(head["news"]), head["dropped"]) == (4000, 2000)
        assert stage.view.dropped == 2000


def test_what_was_before_is_shown_to_who_comes_later(stage: Stage) -> None:
    fix = Fix.from_refusal(5e3, (0,), "misfit", "why")
    stage.publisher.publish("fix", fix.t_us, Placed(fix, None))
    enu_m, unit = np.array([3.0, -20.0, -1.0]), np.eye(3)
    where = [float(v) for v in LocalAxes.of([SITE]).to_geodetic(enu_m)]
    given = Fix(6e3, *where, enu_m, unit, unit, 0.0, 0.0, 0.0, 1.0, (0,), verified=False)
    filtered = Place(6e3, *where, enu_m, unit, 1.0, 0.0, left_out=False, starts=True)
    stage.publisher.publish("fix", given.t_us, Placed(given, filtered))
    # The second one comes when all of it has been told.
    for _ in range(2):
        lines: dict[tuple[str, str | None], dict[str, Any]] = {}
        with stage.connect() as link:
            link.recv(30)
            while len(lines) < 3:
                lines |= {(line["line"], line.get("refusal")): line for line in next_of(link)[0]["news"]}
    assert lines["fix", "misfit"]["latitude_deg"] is None
    assert lines["fix", ""]["track_m"] == [3.0, -20.0, -1.0]
    # The bar is at the origin of its own axes.
    ((number, *bar),) = lines["bars", None]["bars"]
    assert number == 7
    assert bar == pytest.approx([0, 0, 0], abs=2e-3)


def test_a_message_that_cannot_be_shown_says_why(stage: Stage) -> None:
    with stage.connect() as link:
        link.recv(30)
        for number, value in enumerate((math.nan, "read me")):
            sent = Message(2, 7, number, b"-")
            message = ReceivedMessage(0, 0, 5.0, sent, TextKind(), value, "unverified", "")
            stage.publisher.publish("message", 5.0, message)
        lines: list[dict[str, Any]] = []
        while len(lines) < 2:
            lines += next_of(link)[0]["news"]
    assert lines[0]["said"] == "cannot be shown: a message kind shows NaN, which JSON has not"
    assert lines[1]["text"] == "read me"


def test_browsers_only_look_on(stage: Stage) -> None:
    for entry in ('{"record": true}', "{", '{"next": 2}', "[]", "x" * 5000):
        with stage.connect() as link:
            link.recv(30)
            link.send(entry)
            with pytest.raises(ConnectionClosedError, match=r"1008|1009"):
                link.recv(30)


def test_a_recording_is_what_came(tmp_path: Path) -> None:
    folder = tmp_path / "not" / "made"
    with run_viewer(record_to=folder) as stage, stage.connect() as link:
        publisher = stage.publisher
        link.recv(30)
        publish(publisher, 1_000)
        link.send('{"record": true}')
        wait_until(lambda: publisher.has_listeners("events"))
        publish(publisher, 2_000)
        publisher.publish("triggers", 2_500, Triggers.of([2_500, 3_004], [0, 0], [1, 0]))
        publish(publisher, 3_000)
        link.send('{"record": false}')
        wait_until(lambda: not publisher.has_listeners("events"))
        publish(publisher, 4_000)
        wait_until(lambda: any(folder.glob("live-*.raw")))
        stage.frame(0)
        assert next_of(link)[0]["record"]["events"] == 20
        (path,) = folder.iterdir()
    with open_source(path) as source:
        events, triggers = source.read()
    assert events.t_us.tolist() == [*range(2_000, 2_010), *range(3_000, 3_010)]
    assert (triggers.t_us.tolist(), triggers.value.tolist()) == ([2_500, 3_004], [1, 0])


@pytest.mark.parametrize("why", ["disk", "clock"])
def test_what_was_recorded_stays_where_a_recording_has_to_end(why, tmp_path, monkeypatch) -> None:
    publisher = Publisher()
    recorder = Recorder(publisher, tmp_path, 1280, 720)
    recorder.start()
    publish(publisher, 2_000)
    wait_until(lambda: recorder.state["events"] == 10)
    if why == "disk":
        monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=7_000_000))
    publish(publisher, 3_000 if why == "disk" else 1_000)
    wait_until(lambda: not recorder.state["recording"])
    reported = {"disk": "7 MB are left on the disk: expected 100", "clock": "event at 1000 us after 2009 us"}
    assert reported[why] in recorder.state["fault"]
    with open_source(tmp_path / recorder.state["file"]) as source:
        assert len(source.read()[0]) == (20 if why == "disk" else 10)


def publish(publisher: Publisher, t_us: int) -> None:
    t = np.arange(t_us, t_us + 10)
    publisher.publish("events", t_us, Events.of(t, t % 1280, t % 720, t % 2))


def test_who_has_asked_nothing_yet_is_left_at_the_end() -> None:
    """Browsers open connections that they may need."""
    with run_viewer() as stage:
        idle = socket.create_connection(("127.0.0.1", stage.view.port))
        assert stage.ask("/")[0] == 403
    with idle, suppress(ConnectionResetError):
        idle.settimeout(30)
        assert idle.recv(1) == b""


def test_a_port_that_is_taken_is_one_line(stage: Stage) -> None:
    reported = rf"127.0.0.1:{stage.view.port}: .*expected an address of this machine and a port"
    with pytest.raises(ConfigError, match=reported), run_viewer(port=stage.view.port):
        pass


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_browser_shows_what_the_files_say(demo_raw, tmp_path, monkeypatch) -> None:
    """Beside one that stalls: a lost link comes back, pictures change, numbers are those of frames.csv."""
    # A slow machine shows the last of it late.
    monkeypatch.setattr(server, "FINISH_S", 60.0)
    summary, enough = {}, threading.Event()

    def pieces() -> Iterator[bytes]:
        """Yields the recording bit by bit, slowly until enough of it was seen."""
        data = demo_raw.read_bytes()
        for at in range(0, len(data), size := len(data) // 300):
            yield data[at : at + size]
            enough.wait(0.2)

    with (
        run_viewer() as stage,
        Browser(tmp_path / "profile") as browser,
        stage.connect(),  # which never says that it is ready
        sender(pieces()) as source,
    ):
        browser.dress(390, dark=True)
        browser.open(stage.view.url)
        browser.until("shown.connects == 1")
        browser.value("socket.close()")
        browser.until("shown.connects == 2")

        def run() -> None:
            given: dict[str, Any] = {"publisher": stage.publisher, "budget": PATIENT}
            summary.update(live(source, tmp_path / "out", list(LINKS.values()), **given, warm=False))

        runner = threading.Thread(target=run)
        runner.start()
        images = set[str]()
        while len(images) < 3:
            before = browser.value("shown.pictures")
            browser.until(f"shown.pictures > {before}")
            images.add(browser.value("document.querySelector('#image canvas').toDataURL()"))
        enough.set()
        runner.join(60)
        assert (summary["status"], summary["live"]["shed"]["too_late"]) == ("complete", 0)
        assert "complete" in browser.until("document.querySelector('#alarm:not([hidden])')?.innerText")
        rows = rows_of(tmp_path / "out" / "frames.csv")
        for row, frame in zip(rows, browser.value("shown.last"), strict=True):
            for name in ("transmitter", "packet", "frame"):
                assert int(row[name]) == frame[name]
            assert float(row["t_us"]) == pytest.approx(frame["t_us"], abs=0.011)
            assert row["symbols"] == " ".join("-" if s is None else str(s) for s in frame["symbols"])
            distance_m = float(row["distance_m"]) if row["distance_m"] else None
            assert frame["distance_m"] == pytest.approx(distance_m, abs=1e-4)
        cells = "[...document.querySelector('#frames tr').cells]"
        newest = browser.value(f"{cells}.map((cell) => cell.textContent).join(' ')").split()
        last = rows[-1]
        assert newest[1:4] == [last["transmitter"], last["packet"], last["frame"]]
        assert newest[6:] == last["symbols"].split()
        assert browser.fits()
        shown = browser.value("[-0.004, -0.5, 0, 12.25, -0].map((v) => digits(v, 2))")
        assert shown == ["0.00", "-0.50", "0.00", "12.25", "0.00"]
        # The camera's clock restarts.
        assert browser.value("takeNews({ ...status, t_us: status.t_us - 1 }), rates.length") == 1
        assert not [m for m in browser.faults if m["method"] == "Runtime.exceptionThrown"]
        asked = {url.split("/")[2] for url in browser.requests if not url.startswith("data:")}
        assert asked <= {f"127.0.0.1:{stage.view.port}"}
