"""How things end: emulators with their parent, streams with Ctrl-C, boards whose pulse does not come."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_lines import Native
from test_board_cli import EVLCP

from evlcp_sdk.link.resolve import load_link
from firmware_host.board.bank import random_symbols
from firmware_host.board.board import Board
from firmware_host.board.session import Session
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import RefusedError
from firmware_host.protocol.generated.requests import State

pytestmark = pytest.mark.usefixtures("compiler")

Evlcp = Callable[..., Any]


@pytest.fixture
def port(tmp_path: Path) -> Iterator[str]:
    where = f"unix:{tmp_path / 'board'}"
    emulated = Native(where, leds=tmp_path / "leds.bin")
    yield where
    emulated.end()


def is_there(pid: int) -> bool:
    """Whether a process runs; one that has ended and is not yet waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def within(seconds: float, done: Callable[[], bool]) -> bool:
    end = time.monotonic() + seconds
    while not done() and time.monotonic() < end:
        time.sleep(0.01)
    return done()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not tell children")
def test_what_is_bound_ends_with_its_parent() -> None:
    code = (
        "import subprocess, sys, time\n"
        "from firmware_host.emulators.processes import bound\n"
        "print(subprocess.Popen(bound(['sleep', '600'])).pid, flush=True)\n"
        "time.sleep(600)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    try:
        assert within(10, lambda: "sleep" in Path(f"/proc/{child}/cmdline").read_text().split("\0")[0])
        parent.kill()
        parent.wait()
        assert within(10, lambda: not is_there(child))
    finally:
        parent.kill()
        parent.stdout.close()
        if is_there(child):
            os.kill(child, signal.SIGKILL)


def test_a_stream_that_is_stopped_ends() -> None:
    link, device = load_link(), SimulatedBoard()
    board = Board(Session(SimulatedLine(device)))
    packets = random_symbols(3, link.packet.frames, link.codebook, np.random.default_rng(0))
    asked: list[int] = []
    with board.stream(link) as stream:
        stream.play(lambda _: packets, 60.0, lambda: len(asked) > 20 or asked.append(0) is not None)
    assert stream.sent < 22
    status = board.status()
    assert (status.state, status.packets_sent) == (State.DARK, stream.sent)
    with pytest.raises(RefusedError, match="a stream that has ended, say, is gone"):
        board.start()


def test_ctrl_c_ends_the_stream_of_a_message(evlcp: Evlcp, port: str, tmp_path: Path) -> None:
    command = [*EVLCP, "tx", "message", "--text", "{n}", "--every", "60", "--port", port, "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert within(20, lambda: (tmp_path / "leds.bin").stat().st_size > 20_000)
    process.send_signal(signal.SIGINT)
    told = json.loads(process.stdout.read())
    assert process.wait(20) == 0
    process.stdout.close()
    status = json.loads(evlcp("board", "--port", port, "status", "--json").out)
    assert (status["state"], status["packets_sent"]) == ("dark", told["packets"])
    done = evlcp("board", "--port", port, "start")
    assert done.code == 5
    assert "NOTHING_COMMITTED" in done.err


def test_a_board_that_waits_for_a_pulse_says_so_and_is_stopped_without_one(evlcp: Evlcp, port: str) -> None:
    assert evlcp("board", "--port", port, "program", "--random", 1, "--no-start").code == 0
    done = evlcp("board", "--port", port, "start", "--pulse-hz", 2)
    assert (done.code, done.err) == (0, "")
    armed = f"armed: waits for a pulse on PPS ({port} for its pulse 3)"
    assert done.out == f"{armed}; 'evlcp board status' shows whether it has come\n"
    assert json.loads(evlcp("board", "--port", port, "status", "--json").out)["state"] == "waiting"
    assert evlcp("board", "--port", port, "stop").code == 0

    done = evlcp("board", "--port", port, "start", "--pulse-hz", 2, "--timeout", 0.2)
    assert done.code == 6
    assert done.out == f"{armed}, for at most 0.2 s\n"
    said = "the pulse that it waits for has not come in 0.2 s"
    assert re.fullmatch(
        rf"evlcp: {port}: {said} \(pulses since reset: .* 0\): check .*; all are stopped\n", done.err
    )
    assert json.loads(evlcp("board", "--port", port, "status", "--json").out)["state"] == "dark"
    done = evlcp("board", "--port", port, "start", "--timeout", 1)
    assert (done.code, "--timeout belongs to --pulse-hz" in done.err) == (2, True)
