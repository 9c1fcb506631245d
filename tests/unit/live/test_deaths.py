"""Whoever reads results, or sends events, may die at any moment: the receiver is untouched."""

import json
import random
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from evlcp_sdk.live import Publisher
from evlcp_sdk.live.services import Serving, serve
from evlcp_sdk.run import live, receive
from tests.unit.live.helpers import LINKS, PATIENT, key, publish_fix, sender

NOW = struct.pack("ii", 1, 0)
"""A connection is not ended, but broken off (RST), as by a process that is killed."""
ENOUGH = 8
"""So many times each kind of reader dies while a recording comes in."""


def dies(link: socket.socket) -> None:
    link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, NOW)
    link.close()


def test_who_reads_results_may_die_at_any_moment(demo_raw: Path) -> None:
    publisher, over, lives = Publisher(), threading.Event(), dict.fromkeys(("nmea", "gpsd", "view"), 0)
    serving = Serving(view=True, nmea_port=0, gpsd_port=0)
    with serve(serving, publisher, LINKS, name="x") as services:
        url = services["view"].url.replace("http", "ws") + "live"

        def read_a_while(kind: str, rng: random.Random) -> None:
            if kind == "view":
                with connect(url, compression=None) as link:
                    link.recv(5)
                    for _ in range(rng.randrange(4)):
                        link.send('{"next": true}')
                        with suppress(TimeoutError, ConnectionClosed):
                            link.recv(rng.choice((0.001, 0.02, 1.0)))
                            lives[kind] += 1
                    # It says no farewell.
                    link.socket.shutdown(socket.SHUT_RDWR)
                return
            link = socket.create_connection(("127.0.0.1", services[kind].port), 5)
            link.settimeout(rng.choice((0.001, 0.02, 0.05)))
            with suppress(OSError):
                link.sendall(b'?WATCH={"enable":true,"json":true};\n' if kind == "gpsd" else b"\n")
                lives[kind] += bool(link.recv(rng.choice((1, 100, 5000))))
            dies(link)

        def until_over(kind: str) -> None:
            rng = random.Random(kind)
            while not over.is_set():
                try:
                    read_a_while(kind, rng)
                except (OSError, ConnectionClosed):
                    # At the run's end its servers leave, a moment before this test has heard of it.
                    assert over.wait(30)

        def fixes() -> None:
            while not over.wait(0.01):
                publish_fix(publisher, time.monotonic() * 1e6)

        def pieces() -> Iterator[bytes]:
            """Yields the recording bit by bit: as long as any kind has died too seldom, it goes slowly."""
            data = demo_raw.read_bytes()
            for n, at in enumerate(range(0, len(data), size := len(data) // 200)):
                yield data[at : at + size]
                patience = time.monotonic() + 0.5
                while min(lives.values()) < ENOUGH * n / 200 and time.monotonic() < patience:
                    time.sleep(0.01)

        threads = [threading.Thread(target=until_over, args=(kind,)) for kind in lives]
        threads.append(threading.Thread(target=fixes))
        mine = publisher.subscribe({"frame"}, most=100_000)
        for thread in threads:
            thread.start()
        try:
            with sender(pieces()) as source:
                summary = live(source, publisher=publisher, budget=PATIENT, warm=False)
        finally:
            over.set()
            for thread in threads:
                thread.join(10)
        assert not any(thread.is_alive() for thread in threads)
    assert summary["status"] == "complete"
    assert not any(summary["live"]["shed"].values())
    assert min(lives.values()) >= ENOUGH, lives
    assert [key(news.value) for news in mine.take()] == [key(f) for p in receive(demo_raw) for f in p.frames]


def test_who_sends_may_die_at_any_moment(demo_raw: Path, tmp_path: Path, evlcp: Callable[..., Any]) -> None:
    """Half a recording, and half a word, are received; where the connection broke is said in one line."""
    data = demo_raw.read_bytes()
    data = data[: len(data) // 2 | 1]
    (tmp_path / "half.raw").write_bytes(data)
    assert evlcp("receive", tmp_path / "half.raw", "-o", tmp_path / "file").code == 0
    want = (tmp_path / "file" / "frames.csv").read_text()
    assert want.count("\n") > 4
    for end, status, code in ((socket.socket.close, "complete", 0), (dies, "failed", 3)):
        with sender([data], end) as url:
            done = evlcp("live", url, "--waiting-ms", "100000", "--json", "-o", tmp_path / status)
        summary = json.loads(done.out)
        assert (done.code, summary["status"]) == (code, status), done.err
        assert summary["counts"]["frames"] == want.count("\n") - 1
        assert (tmp_path / status / "frames.csv").read_text() == want
    assert len(done.err.strip().splitlines()) == 1
