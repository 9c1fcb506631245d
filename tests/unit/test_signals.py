"""SIGTERM and SIGHUP end a run as Ctrl-C does."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from evlcp_sdk.signals import ENDING, stop_on_request, waiting

MAIN = "from evlcp_sdk.cli.main import main; main()"


def hear_all() -> None:
    """Whoever runs the tests may have set some to be ignored."""
    for number in ENDING:
        signal.signal(number, signal.SIG_DFL)


def start(*arguments: str | Path, alone: bool = False) -> subprocess.Popen[str]:
    """A command in a process; `alone`: in a group of its own."""
    command = [sys.executable, "-c", MAIN, *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, **pipes, text=True, preexec_fn=hear_all, start_new_session=alone)


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT, signal.SIGTERM])
def test_a_run_that_is_asked_to_end_keeps_what_it_has(number, demo_raw, tmp_path) -> None:
    """And begins no other recording."""
    pipe, out = tmp_path / "live.raw", tmp_path / "out" / "live"
    os.mkfifo(pipe)
    process = start("receive", pipe, demo_raw, "-o", out.parent)
    data = demo_raw.read_bytes()
    with pipe.open("wb", buffering=0) as file:
        # A pipe holds less than this: the receiver has begun.
        file.write(data[: len(data) // 2])
        process.send_signal(number)
        time.sleep(0.2)
        # It may have ended by now, and nobody reads on.
        with suppress(BrokenPipeError):
            file.write(data[len(data) // 2 :])
        _, reported = process.communicate(timeout=60)
    # Before it may stand that kernels were compiled.
    assert reported.splitlines()[-1] == f"evlcp: interrupted; what was decoded until then is in {out}"
    assert process.returncode == 130
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] == "interrupted"
    assert summary["transmitters"][0]["frames_found"] > 0
    assert {p.name for p in out.iterdir()} == {"frames.csv", "packets.jsonl", "summary.json"}
    assert list(out.parent.iterdir()) == [out]


def test_a_simulation_that_is_asked_to_end_leaves_nothing(tmp_path: Path) -> None:
    process = start("simulate", "--preset", "night", "-o", tmp_path / "a.raw", "--set", "duration_s=60")
    until = time.monotonic() + 60
    while not list(tmp_path.glob(".evlcp-*/a.raw")) and time.monotonic() < until:
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    out, reported = process.communicate(timeout=60)
    assert (process.returncode, out, reported.splitlines()[-1:]) == (130, "", ["evlcp: interrupted"])
    assert list(tmp_path.iterdir()) == []


def test_a_request_ends_a_wait_and_nothing_else() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with stop_on_request() as stopped:
        also = stopped.or_when(lambda: False)
        with waiting(also):
            pass
        assert (stopped(), also()) == (False, False)
        signal.raise_signal(signal.SIGTERM)
        assert (stopped(), also()) == (True, True)
        # It was asked before: what would be waited for may never come.
        with pytest.raises(KeyboardInterrupt), waiting(also):
            pytest.fail("it waits")
    assert signal.getsignal(signal.SIGTERM) is before
    with stop_on_request() as stopped:
        with pytest.raises(KeyboardInterrupt), waiting(stopped):
            signal.raise_signal(signal.SIGTERM)
        assert stopped()
    with stop_on_request() as stopped:
        assert stopped.or_when(lambda: True)()
        assert not stopped()
    with waiting(lambda: True):
        pass


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.mark.parametrize("command", ["receive", "serve"])
def test_a_stream_whose_sender_never_speaks_is_left_at_once(command: str, tmp_path: Path) -> None:
    port = free_port()
    given = ("-o", tmp_path / "o") if command == "receive" else ("--tcp", "0")
    process = start(command, f"udp://127.0.0.1:{port}", *given)
    until = time.monotonic() + 60
    listens = f" {0x0100007F:08X}:{port:04X} "
    while listens not in Path("/proc/net/udp").read_text() and time.monotonic() < until:
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    _, reported = process.communicate(timeout=20)
    assert (process.returncode, reported) == (130, "evlcp: interrupted\n")
    assert list(tmp_path.iterdir()) == []
