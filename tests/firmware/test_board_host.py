"""What the host tool says and does about a board that is left, taken, silent or of another rate."""

import json
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from board_lines import Native, board_on
from test_board_cli import EVLCP

from evlcp_sdk.air.codebook import Codebook
from firmware_host.board.bank import Bank, random_symbols
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import NoBoardError, RefusedError, VerifyError
from firmware_host.ports.transport import SocketTransport
from firmware_host.protocol.client import Timing
from firmware_host.protocol.generated.requests import BoardFault, State, Status, Watchdog
from tests.conftest import Run
from tests.models.usb import UsbLine

pytestmark = pytest.mark.usefixtures("compiler")

Evlcp = Callable[..., Run]


def payload(book: Codebook, seed: int = 0, rate: float = 10_000.0) -> Bank:
    return Bank.of_symbols(random_symbols(2, 10, book, np.random.default_rng(seed)), book, 1, rate)


def test_a_host_that_stays_keeps_the_watchdog_still(book: Codebook) -> None:
    device = SimulatedBoard()
    board = board_on(SimulatedLine(device))
    done = provision(board, payload(book), Settings(watchdog=Watchdog.IDLE, watchdog_ms=300))
    assert (done.watchdog, done.watchdog_ms) == ("idle", 300)
    status = board.status()
    board.stay(3.0, status)
    after = board.status()
    assert (after.state, after.faults & BoardFault.WATCHDOG) == (State.PLAYING, 0)
    assert after.uptime_ms - status.uptime_ms == pytest.approx(3000, abs=50)
    # a tenth of a second apart: no more than the watchdog needs
    assert after.requests - status.requests < 40
    device.run(1_000_000)
    assert board.status().faults & BoardFault.WATCHDOG


def test_staying_with_a_board_that_plays_on_asks_nothing(book: Codebook) -> None:
    board = board_on(SimulatedLine(SimulatedBoard()))
    provision(board, payload(book), Settings())
    before = board.status()
    board.stay(3.0, before)
    assert board.status().requests == before.requests + 1


def test_program_keeps_alive_until_it_is_ended(evlcp: Evlcp, tmp_path: Path) -> None:
    port = f"unix:{tmp_path / 'board'}"
    emulated = Native(port, leds=tmp_path / "leds.bin")
    options = ("--random", "1", "--watchdog", "idle", "--watchdog-ms", "300", "--port", port)
    command = [*EVLCP, "board", "program", *options, "--keep-alive", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    done = json.loads(process.stdout.readline())
    assert (done["watchdog"], done["watchdog_ms"]) == ("idle", 300)
    time.sleep(1.2)
    process.send_signal(signal.SIGINT)
    assert process.wait(10) == 0
    assert process.stderr is not None
    assert process.stderr.read() == ""
    process.stdout.close()
    process.stderr.close()
    # nobody else has looked since: no packet of the idle pattern has been played
    status = json.loads(evlcp("board", "status", "--json", "--port", port).out)
    assert "watchdog" not in status["faults"] or status["silence_ms"] >= 300
    assert status["packets_sent"] > 25
    emulated.end()


@pytest.mark.parametrize(("action", "what"), [("idle", "shows its idle pattern"), ("dark", "goes dark")])
def test_what_the_watchdog_will_do_is_said(evlcp: Evlcp, action: str, what: str) -> None:
    options = ("--port", "native:", "--random", 1)
    done = evlcp("board", "program", *options, "--watchdog", action, "--watchdog-ms", 1500)
    assert f"watchdog: the board {what} once no host has spoken for 1.5 s" in done.out
    assert "watchdog" not in evlcp("board", "program", *options, "--watchdog", "keep").out
    said = evlcp("board", "watchdog", action, "--after-ms", 1500, "--port", "native:").out
    assert f"the board {what}" in said


@pytest.mark.parametrize(("latency_s", "frame_s", "at_most"), [(0.0, 0.0, 1.15), (0.002, 0.001, 1.3)])
def test_programming_is_near_the_wire_time(
    book: Codebook, latency_s: float, frame_s: float, at_most: float
) -> None:
    """By the board's own clock, over a line alone and behind a USB bridge: few waits for answers."""
    baud = 1_000_000
    device = SimulatedBoard()
    board = board_on(UsbLine(device, latency_s, baud, frame_s))
    bank = Bank.of_symbols(random_symbols(64, 10, book, np.random.default_rng(0)), book)
    began_us = device.now_us
    assert provision(board, bank, Settings()).written == len(bank.content)
    wire_us = 10e6 * len(bank.content) / baud
    assert wire_us < device.now_us - began_us <= at_most * wire_us


def test_another_rate_while_it_plays_is_refused_before_anything_is_sent(book: Codebook) -> None:
    device = SimulatedBoard()
    line = SimulatedLine(device)
    board = board_on(line)
    provision(board, payload(book), Settings())
    written: list[int] = []
    write = line.write
    line.write = lambda data: (written.append(len(data)), write(data))[1]  # type: ignore[method-assign]
    with pytest.raises(
        RefusedError, match=r"plays 10000 chips per second.*has 20000.*stop' first"
    ) as refused:
        provision(board, payload(book, 1, 20_000.0), Settings())
    assert refused.value.status == Status.BUSY
    assert sum(written) < 100, "only STATUS went out"
    board.stop()
    board.wait_dark()
    assert provision(board, payload(book, 1, 20_000.0), Settings()).swapped


def test_a_bank_that_does_not_hold_is_not_blamed_on_the_rate(book: Codebook) -> None:
    board = board_on(SimulatedLine(SimulatedBoard()))
    crc = board.crc
    board.crc = lambda *place: crc(*place) ^ 1  # type: ignore[method-assign]
    with pytest.raises(VerifyError, match="does not hold what was sent") as told:
        board.program(payload(book))
    assert "baud" not in str(told.value)


@pytest.mark.parametrize("url", ["socket://localhost", "socket://", "socket://localhost:x", "rfc2217://"])
def test_a_url_without_a_port_is_one_line(evlcp: Evlcp, url: str) -> None:
    done = evlcp("board", "hello", "--port", url)
    assert done.code == 4
    assert f"cannot be opened: expected {url.split(':')[0]}://HOST:PORT" in done.err
    assert done.err.count("\n") == 1


def test_a_second_host_learns_of_the_first(evlcp: Evlcp, tmp_path: Path) -> None:
    port = f"unix:{tmp_path / 'board'}"
    emulated = Native(port)
    with Session(SocketTransport.connect(port)) as session:
        first = Board(session)
        start = time.monotonic()
        second = evlcp("board", "hello", "--port", port)
        assert second.code == 4
        assert "another host is connected to it" in second.err
        assert "power" not in second.err
        assert time.monotonic() - start < 5.0
        assert first.status().state == State.DARK
    # the first has left: nobody is turned away
    for _ in range(20):
        with Session(SocketTransport.connect(port)) as session:
            Board(session).status()
    emulated.end()


def test_a_socket_that_stays_silent_is_not_told_to_look_at_power() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = f"tcp:127.0.0.1:{server.getsockname()[1]}"
        with (
            Session(SocketTransport.connect(port), Timing(latency_s=0.01), tries=1) as session,
            pytest.raises(NoBoardError, match="another host may be connected") as told,
        ):
            session.hello()
        assert "power" not in str(told.value)
