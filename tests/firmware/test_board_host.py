"""What the host tool says and does about a board that is left, taken, silent, gone or of another rate."""

import json
import re
import signal
from contextlib import nullcontext
from dataclasses import replace

import pytest
from board_lines import FatalLine, board_on, check_fault, some_bank, well

from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.board.stream import Stream
from firmware_host.board.update import UpdatePackage, update_firmware
from firmware_host.commands._line import BoardLine
from firmware_host.errors import IncompatibleError, LineError, NoBoardError, VerifyError
from firmware_host.ports.transport import SocketTransport
from firmware_host.protocol.generated.requests import (
    BoardFault,
    HelloReply,
    State,
    StatusReply,
    UpdateStatusReply,
    Watchdog,
)


def test_a_host_that_stays_keeps_the_watchdog_still(device, board):
    done = provision(board, some_bank(2), Settings(watchdog="idle", watchdog_ms=300))
    assert (done.watchdog, done.watchdog_ms) == ("idle", 300)
    status = board.status()
    board.wait_with_keep_alive(3.0, status)
    after = board.status()
    assert (after.state, after.faults) == (State.PLAYING, 0)
    assert after.uptime_ms - status.uptime_ms == pytest.approx(3000, abs=50)
    # a tenth of a second apart: no more than the watchdog needs
    assert after.requests - status.requests < 40
    device.run(1_000_000)
    assert board.status().faults & BoardFault.WATCHDOG
    with pytest.raises(LineError, match="still PLAYING; try 'evlcp board blank'"):
        board.wait_dark(0.1)
    # one that plays on is asked nothing
    board.set_watchdog(Watchdog.KEEP, 0)
    before = board.status()
    board.wait_with_keep_alive(3.0, before)
    assert board.status().requests == before.requests + 1


def test_program_keeps_alive_until_it_is_ended(evlcp, monkeypatch):
    stays = iter([Board.start, Board.blank])

    def wait_with_keep_alive(board, seconds, status):
        if (does := next(stays, None)) is None:
            raise KeyboardInterrupt
        does(board)

    monkeypatch.setattr(Board, "wait_with_keep_alive", wait_with_keep_alive)
    done = well(evlcp("board", "program", "--random", 1, "--port", "native:", "--keep-alive"))
    assert done.err == "evlcp: native:: state dark, faults none\n"


def test_ctrl_c_ends_the_stream_of_a_message(evlcp, native, monkeypatch):
    send = Stream.send

    def interrupted(stream, symbols):
        signal.raise_signal(signal.SIGINT)
        return send(stream, symbols)

    monkeypatch.setattr(Stream, "send", interrupted)
    done = well(evlcp("tx", "message", "--text", "{n}", "--every", 60, "--port", native, "--json"))
    status = json.loads(evlcp("board", "--port", native, "status", "--json").out)
    assert (status["state"], status["packets_sent"]) == ("dark", json.loads(done.out)["packets"])
    check_fault(evlcp("board", "--port", native, "start"), 5, "NOTHING_COMMITTED")


def test_a_board_that_waits_for_a_pulse_says_so_and_is_stopped_without_one(evlcp, native):
    board = ("board", "--port", native)
    well(evlcp(*board, "program", "--random", 1, "--no-start"))
    done = evlcp(*board, "start", "--pulse-hz", 2)
    assert (done.code, done.err) == (0, "")
    armed = f"armed: waits for a pulse on PPS ({native} for its pulse 3)"
    assert done.out == f"{armed}; 'evlcp board status' shows whether it has come\n"
    assert json.loads(evlcp(*board, "status", "--json").out)["state"] == "waiting"
    well(evlcp(*board, "stop"))

    done = evlcp(*board, "start", "--pulse-hz", 2, "--timeout", 0.2)
    assert (done.code, done.out) == (6, f"{armed}, for at most 0.2 s\n")
    message = "the pulse that it waits for has not come in 0.2 s"
    assert re.fullmatch(
        rf"evlcp: {native}: {message} \(pulses since reset: .* 0\): check .*; all are stopped\n", done.err
    )
    assert json.loads(evlcp(*board, "status", "--json").out)["state"] == "dark"


def test_a_bank_that_does_not_hold_is_reported(board, monkeypatch):
    crc = board.read_crc
    monkeypatch.setattr(board, "read_crc", lambda *place: crc(*place) ^ 1)
    with pytest.raises(VerifyError, match="does not hold what was sent") as caught:
        board.program(some_bank(2))
    assert "baud" not in str(caught.value)


@pytest.mark.parametrize(
    ("reply", "wrong", "kind"),
    [
        (HelloReply, {"max_payload": 1}, IncompatibleError),
        (StatusReply, {"chip_rate_hz": 0}, VerifyError),
        (UpdateStatusReply, {"next": 0}, IncompatibleError),
    ],
)
def test_a_board_that_answers_nonsense_is_refused(device, monkeypatch, reply, wrong, kind):
    unpack = reply.unpack
    monkeypatch.setattr(reply, "unpack", lambda data: replace(unpack(data), **wrong))
    with pytest.raises(kind):  # noqa: PT012
        board = board_on(device)
        board.program(some_bank())
        update_firmware(board, UpdatePackage("native", {1: b"x", 2: b"x"}))


def test_a_second_host_learns_of_the_first(evlcp, native):
    with Session(SocketTransport.connect(native)) as session:
        first = Board(session)
        second = evlcp("board", "hello", "--port", native)
        check_fault(second, 4, "hangs up before it answers: another host is connected to it")
        assert "power" not in second.err
        assert first.status().state == State.DARK
    # the first has left: nobody is turned away
    for _ in range(20):
        with Session(SocketTransport.connect(native)) as session:
            Board(session).status()


def test_a_monitor_finds_its_board_again(evlcp, device, monkeypatch):
    """A line that breaks, a board that is off for a while, and one that is reset."""

    def breaks(_):
        raise LineError("x: the line broke")

    def off():
        raise NoBoardError("x: it is not there")

    def fatal(then):
        return lambda: board_on(FatalLine(device, 50, then))

    lines = iter([fatal(breaks), off, fatal(lambda line: line.board.reset()), lambda: board_on(device), off])
    monkeypatch.setattr(BoardLine, "open", lambda _: nullcontext(next(lines)()))
    monitor = ("board", "monitor", "--port", "x", "--interval", 0.01, "--json")
    done = well(evlcp(*monitor, "--count", 6))
    rows = [json.loads(line) for line in done.out.splitlines()]
    seen = [row["error"]["kind"] if "error" in row else "state" in row for row in rows]
    assert seen == [True, True, "LineError", False, True, True, "BoardResetError", False, True, True]
    assert rows[3]["back_after_s"] >= 0.5
    lost, back, *_ = done.err.splitlines()
    assert lost == "evlcp: x: the line broke; it is looked for, end with Ctrl-C"
    assert back.startswith("evlcp: x: answers again after ")
    check_fault(evlcp(*monitor), 4, "it is not there")
