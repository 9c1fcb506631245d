"""A source over a socket is received as it is; who is slow or gone holds up nobody."""

import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.errors import InputError, OutputError, StreamError
from evlcp_sdk.io import open_source, write_events
from evlcp_sdk.live.sender import Sender
from evlcp_sdk.values import Events, Triggers

EVENTS = Events.of(np.arange(30_000) * 2 + 40_000_000, np.arange(30_000) % 640, [7] * 30_000, [1] * 30_000)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    write_events(tmp_path / "a.raw", EVENTS, 640, 480, Triggers.of([40_000_500, 40_059_998], [1, 2], [1, 0]))
    return tmp_path / "a.raw"


def test_what_is_sent_is_received(recording: Path, tmp_path: Path) -> None:
    url = f"replay:{recording}?speed=20"

    def receive(url: str) -> tuple[Events, Triggers]:
        with open_source(url) as other:
            assert (other.width, other.height, other.format) == (640, 480, "EVT3")
            return other.read()

    with (
        open_source(url) as source,
        Sender(source, ("localhost", 0), tmp_path / "s") as sender,
        ThreadPoolExecutor() as threads,
    ):
        stalled = socket.create_connection(("localhost", sender.port))
        urls = f"tcp://localhost:{sender.port}", f"unix:{tmp_path / 's'}"
        got = threads.map(receive, urls)
        while sender.counts["listeners"] < 3:
            assert sender.wait(lambda: False)
        stalled.close()
        sender.run()
    for events, triggers in got:
        for column in ("t_us", "x", "y", "p"):
            assert (getattr(events, column) == getattr(EVENTS, column)).all()
        assert triggers.t_us.tolist() == [40_000_500, 40_059_998]
    assert not (tmp_path / "s").exists()
    assert sender.counts["events"] == len(EVENTS)


def test_what_words_cannot_say_is_not_sent(tmp_path: Path) -> None:
    write_events(tmp_path / "a.csv", Events.of([1, 2], [7, 3000], [7, 7], [1, 0]))
    wrong = pytest.raises(StreamError, match="an event in column or row 3000, expected 0 to 2047")
    with open_source(tmp_path / "a.csv") as source, Sender(source, ("localhost", 0)) as sender, wrong:
        sender.run()


def test_where_it_cannot_listen_is_reported(recording: Path) -> None:
    with socket.create_server(("localhost", 0)) as taken, open_source(recording) as source:
        port = taken.getsockname()[1]
        with pytest.raises(OutputError, match=f"localhost:{port}: cannot listen: Address already in use"):
            Sender(source, ("localhost", port))
        for path, reason in ((Path("/no/such"), "No such file"), (recording, "Address already in use")):
            with pytest.raises(OutputError, match=f"{path}: cannot listen: {reason}"):
                Sender(source, unix=path)
        assert recording.exists()


def test_the_command(evlcp: Callable[..., Any], recording: Path, tmp_path: Path) -> None:
    got = []

    def receive() -> None:
        while not got:
            # Until it listens.
            with suppress(InputError), open_source(f"unix:{tmp_path / 's'}") as source:
                got.append(len(source.read()[0]))
            time.sleep(0.02)

    thread = threading.Thread(target=receive, daemon=True)
    thread.start()
    run = evlcp("serve", f"replay:{recording}?speed=20", "--unix", tmp_path / "s")
    thread.join(10)
    assert (run.code, got) == (0, [len(EVENTS)])
    assert "to whoever connects to unix:" in run.err
    for options, expected in (((), "give --tcp PORT"), (("--tcp", "x:y"), "expected PORT or HOST:PORT")):
        run = evlcp("serve", recording, *options)
        assert run.code == 2
        assert expected in run.err
