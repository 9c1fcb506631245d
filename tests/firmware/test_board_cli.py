"""`evlcp board` against running boards: commands, exit codes, traces, hosts that are killed."""

import contextlib
import json
import os
import pty
import resource
import signal
import socket
import subprocess
import sys
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from board_lines import Native

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import OutputError
from firmware_host.board.bank import Bank, random_symbols
from firmware_host.board.board import Board
from firmware_host.board.session import Session
from firmware_host.emulators.led_record import RECORD, LedRecord
from firmware_host.emulators.processes import bound
from firmware_host.errors import LineError
from firmware_host.ports.transport import open_transport
from tests.conftest import Run

pytestmark = pytest.mark.usefixtures("compiler")

EVLCP = [sys.executable, "-c", "from evlcp_sdk.cli.main import main; main()"]


def test_qemu_in_the_foreground(evlcp, needs, tmp_path: Path) -> None:
    needs("qemu-system-arm", "arm-none-eabi-gcc")
    port, leds, out = f"unix:{tmp_path / 'board'}", tmp_path / "leds.bin", tmp_path / "out.npy"
    emulated = Emulated("qemu", "--listen", port, "--leds", leds)
    assert emulated.said == f"listening on {port}\n"
    done = evlcp("board", "program", "--random", 3, "--seed", 2, "--port", port)
    assert done.code == 0, done.err
    assert evlcp("board", "verify", "--random", 3, "--seed", 2, "--port", port).code == 0
    assert evlcp("board", "stop", "--port", port).code == 0
    assert emulated.end() == 0
    assert evlcp("board", "leds", leds, "--chips", out).code == 0
    frames = tmp_path / "frames.npy"
    evlcp("tx", "frames", "--random", 3, "--seed", 2, "--chips", frames)
    played, expected = np.load(out), np.load(frames)
    assert len(played) >= 346
    assert (played == np.resize(expected, played.shape)).all()


class Emulated:
    """`evlcp board emulate` in the background."""

    def __init__(self, *options: object) -> None:
        command = bound([*EVLCP, "board", "emulate", *map(str, options)])
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, stdin=subprocess.DEVNULL)
        assert self.process.stdout is not None
        self.said = self.process.stdout.readline()

    def end(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        code = self.process.wait(10)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return code


@pytest.fixture
def native(tmp_path: Path) -> Iterator[str]:
    place = f"unix:{tmp_path / 'board'}"
    board = Native(place, leds=tmp_path / "leds.bin", flash=tmp_path / "flash.bin")
    yield place
    board.end()


def test_a_users_first_hour(evlcp, native: str, tmp_path: Path) -> None:
    def board(*arguments: object) -> Run:
        return evlcp("board", *arguments, "--port", native)

    about = json.loads(board("hello", "--json").out)
    assert (about["hal"], about["clusters"], about["leds"]) == ("native", 16, 96)
    assert board("start").code == 5
    assert "'evlcp board program' first" in board("send", "--random", 1).err
    done = board("program", "--random", 8, "--seed", 3, "--level", 25, "--watchdog", "idle")
    assert done.code == 0
    sent, told = done.out.splitlines()
    assert sent == "sent 2560 of 2560 bytes; bank 0 is active"
    assert told.startswith("watchdog: the board shows its idle pattern once no host has spoken for 5 s;")
    status = json.loads(board("status", "--json").out)
    assert (status["state"], status["level_ma"], status["watchdog"]) == ("playing", 25, "idle")
    assert "was there already" in board("program", "--random", 8, "--seed", 3).out
    assert board("verify", "--random", 8, "--seed", 3).code == 0
    other = board("verify", "--random", 8, "--seed", 4)
    assert other.code == 7
    assert "byte 0 of bank 0" in other.err
    assert board("verify", "--random", 9, "--seed", 4).code == 7
    for other_air, says in (
        ("modulation.id=wh8", "this payload's link has codebook"),
        (
            "air.chip_rate_hz=5000.0",
            "plays 10000 chips per second, this payload's link has air.chip_rate_hz = 5000",
        ),
    ):
        for command in ("send", "verify"):
            foreign = board(command, "--random", 8, "--seed", 3, "--set", other_air)
            assert foreign.code == 8
            assert says in foreign.err
            assert foreign.err.count("\n") == 1
    assert board("send", "--random", 2, "--seed", 9, "--json").code == 0
    lines = board("monitor", "--count", 2, "--interval", 0.05).out.splitlines()
    assert len(lines) == 2
    assert "playing" in lines[0]
    refused = board("level", 61)
    assert refused.code == 5
    assert "the nearest value the board can take is 60" in refused.err
    assert board("watchdog", "dark", "--after-ms", 60_000).code == 0
    assert board("save").code == 5
    assert board("stop").code == 0
    assert board("save").out == "saved in slot 0, number 1\n"
    assert board("test-leds", "--dwell-ms", 1).code == 0
    assert board("recall").out == "recalled slot 0, number 1\n"
    assert board("start").code == 0
    assert board("blank").code == 0
    assert json.loads(board("status", "--json").out)["state"] == "dark"
    assert (tmp_path / "flash.bin").stat().st_size > 80_000


def test_masks_and_leds(evlcp, native: str, tmp_path: Path) -> None:
    chips = tmp_path / "chips.npy"
    evlcp("tx", "frames", "--random", 3, "--seed", 1, "--chips", chips)
    done = evlcp("board", "program", "--masks", chips, "--port", native)
    assert done.code == 0, done.err
    time.sleep(0.3)
    evlcp("board", "stop", "--port", native)
    out = tmp_path / "out.npy"
    assert evlcp("board", "leds", tmp_path / "leds.bin", "--chips", out).code == 0
    assert (np.load(out)[: 3 * 346] == np.load(chips)).all()
    assert len(np.load(tmp_path / "out.ticks.npy")) == len(np.load(out))
    assert evlcp("board", "leds", tmp_path / "leds.bin", "--chips", out, "--per-led").code == 0
    assert np.load(out).shape[1] == 96


def test_wrong_records_are_told(evlcp, tmp_path: Path) -> None:
    torn = tmp_path / "leds.bin"
    records = np.zeros(3, RECORD)
    records["chip"] = (0, 1, 3)
    torn.write_bytes(records.tobytes())
    done = evlcp("board", "leds", torn, "--chips", tmp_path / "c.npy")
    assert done.code == 3
    assert "at byte 40: chip 3 after chip 1: not an LED record" in done.err
    torn.write_bytes(records.tobytes()[:45])
    cut = evlcp("board", "leds", torn, "--chips", tmp_path / "c.npy")
    assert (cut.code, cut.out) == (3, "2 chips\n")
    assert "the last record is cut off (5 bytes)" in cut.err
    assert cut.err.count("\n") == 1
    assert len(np.load(tmp_path / "c.npy")) == 2
    for count in (0, 19):
        torn.write_bytes(records.tobytes()[:count])
        none = evlcp("board", "leds", torn, "--chips", tmp_path / "none.npy")
        assert (none.code, none.out) == (3, "")
        assert f"{torn}: {count} bytes, expected LED records of 20 bytes" in none.err
        assert not (tmp_path / "none.npy").exists()
    assert evlcp("board", "leds", tmp_path / "no", "--chips", tmp_path / "c.npy").code == 3


def test_ticks_unwrap() -> None:
    records = np.zeros(4, RECORD)
    records["tick"] = (2**32 - 2500, 0, 2500, 5000)
    assert LedRecord.of_records(records).ticks.tolist() == [2**32 + n for n in (-2500, 0, 2500, 5000)]
    assert len(LedRecord.of_records(records[:0])) == 0


def test_trace_and_replay(evlcp, tmp_path: Path) -> None:
    trace = tmp_path / "wire.jsonl"
    arguments = ("board", "program", "--random", 8, "--seed", 3)
    live = evlcp(*arguments, "--port", "native:", "--trace", trace)
    assert live.code == 0, live.err
    lines = [json.loads(x) for x in trace.read_text().splitlines()]
    assert lines[0]["evlcp_trace"] == 1
    assert {x["dir"] for x in lines[1:]} == {"tx", "rx"}
    replayed = evlcp(*arguments, "--replay", trace)
    assert (replayed.code, replayed.out) == (0, live.out)
    other = evlcp("board", "program", "--random", 8, "--seed", 4, "--replay", trace)
    assert other.code == 6
    assert "is another one" in other.err
    trace.write_text("\n".join(trace.read_text().splitlines()[:5]) + "\n")
    assert "the trace ends here" in evlcp(*arguments, "--replay", trace).err
    trace.write_text('{"evlcp_trace": 1, "first": 1, "nonce": 2, "baud": 9600}\n{"dir": "up"}\n')
    wrong = evlcp(*arguments, "--replay", trace)
    assert wrong.code == 3
    assert f"{trace}: line 2: not a trace" in wrong.err
    both = evlcp(*arguments, "--replay", trace, "--trace", trace)
    assert both.code == 2


@pytest.mark.parametrize(
    ("port", "says"),
    [
        ("unix:/nowhere/at/all", "no board listens there"),
        ("tcp:127.0.0.1:1", "no board listens there"),
        ("tcp:what", "tcp:what: expected tcp:HOST:PORT with a port from 1 to 65535"),
        ("tcp:127.0.0.1:99999", "expected tcp:HOST:PORT"),
        ("unix:", "expected unix:PATH"),
        ("/dev/nowhere", "cannot be opened"),
        ("what://ever", "cannot be opened"),
        ("loop://", "no board answers; check power"),
    ],
)
def test_no_board_is_four(evlcp, port: str, says: str) -> None:
    done = evlcp("board", "hello", "--port", port)
    assert done.code == 4
    assert says in done.err
    assert done.err.count("\n") == 1


def test_usage_is_two(evlcp) -> None:
    for arguments in (
        ("program", "--port", "native:"),
        ("program", "--random", 1, "--masks", "x.npy", "--port", "native:"),
        ("program", "--random", 129, "--port", "native:"),
        ("program", "--inventory", "x.toml", "--random", 1),
        ("emulate", "qemu", "--listen", "pty"),
        ("emulate", "native", "--listen", "smoke:signals"),
        ("emulate", "native", "--listen", "tcp:127.0.0.1:999999"),
        ("emulate", "native", "--listen", "tcp:127.0.0.1"),
        ("emulate", "native", "--unique-id", 2**64),
        ("level", "much"),
    ):
        done = evlcp("board", *arguments)
        assert done.code == 2, (arguments, done.err)
        assert "Traceback" not in done.err


def test_port_from_the_environment(evlcp, native: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EVLCP_PORT", native)
    done = evlcp("board", "hello")
    assert done.code == 0
    assert "native" in done.out


def test_no_place_to_build_is_told(tmp_path: Path) -> None:
    """In a process of its own: this one has built it."""
    (tmp_path / "file").write_text("")
    env = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "file")}
    command = [*EVLCP, "board", "hello", "--port", "native:"]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "set XDG_CACHE_HOME" in done.stderr
    assert done.stderr.count("\n") == 1


def test_an_emulator_does_not_take_anothers_place(evlcp, native: str, tmp_path: Path) -> None:
    for emulator in ("native", "qemu", "stm32", "rom"):
        done = evlcp("board", "emulate", emulator, "--listen", native)
        assert (done.code, done.out) == (2, "")
        assert done.err.count("\n") == 1
        assert f"--listen {native}: another program answers there; end it, or listen elsewhere" in done.err
    assert evlcp("board", "hello", "--port", native).code == 0
    # what one that was killed leaves behind is no hindrance
    path = tmp_path / "stale"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as left:
        left.bind(str(path))
    emulated = Emulated("native", "--listen", f"unix:{path}")
    assert evlcp("board", "hello", "--port", f"unix:{path}").code == 0
    assert emulated.end() == 0


def test_a_duty_limit_below_what_plays_is_one_line(evlcp, native: str) -> None:
    assert evlcp("board", "program", "--random", 2, "--port", native).code == 0
    done = evlcp("board", "program", "--random", 2, "--duty-limit", 0.3, "--port", native)
    assert done.code == 5
    assert (
        "this payload has a LED on for 0.5 of the time, the duty limit is 0.3: give a limit of at least 0.5"
        in (done.err)
    )
    status = json.loads(evlcp("board", "status", "--json", "--port", native).out)
    assert (status["state"], status["duty_limit"], status["faults"]) == ("playing", 1.0, [])


def test_pty_and_tcp(evlcp, tmp_path: Path) -> None:
    emulated = Emulated("native", "--listen", "pty", "--link", tmp_path / "tty")
    assert emulated.said == f"listening on {tmp_path / 'tty'}\n"
    done = evlcp("board", "program", "--random", 64, "--port", tmp_path / "tty")
    assert (done.code, done.err) == (0, "")
    assert evlcp("board", "verify", "--random", 64, "--port", tmp_path / "tty").code == 0
    assert emulated.end() == 0
    with socket.create_server(("127.0.0.1", 0)) as free:
        place = f"127.0.0.1:{free.getsockname()[1]}"
    emulated = Emulated("native", "--listen", f"tcp:{place}")
    assert evlcp("board", "hello", "--port", f"tcp:{place}").code == 0
    assert evlcp("board", "hello", "--port", f"socket://{place}").code == 0
    assert emulated.end() == 0


def test_ports_are_asked(native: str, tmp_path: Path) -> None:
    from firmware_host.board.survey import find, survey
    from firmware_host.errors import NoBoardError
    from firmware_host.ports.usb import SerialPort

    silent, other = pty.openpty()
    tty.setraw(other)
    listed = [SerialPort(p, usb="0403:6015") for p in (os.ttyname(other), native, "/dev/nowhere")]
    found = survey(1_000_000, listed)
    assert [f.about is not None for f in found] == [False, True, False]
    assert find(1_000_000, listed) == native
    with pytest.raises(NoBoardError, match=r"no board answers on any serial port \(.*gone|nowhere"):
        find(1_000_000, [listed[0], listed[2]])
    second = Native(f"unix:{tmp_path / 'second'}")
    with pytest.raises(NoBoardError, match="2 boards answer"):
        find(1_000_000, [listed[1], SerialPort(f"unix:{tmp_path / 'second'}", usb="0403:6015")])
    second.end()
    os.close(silent)
    os.close(other)


def test_board_that_hangs_up_is_told(tmp_path: Path) -> None:
    board = Native(f"unix:{tmp_path / 'b'}")
    options = ("--interval", "0.05", "--no-reconnect", "--port", f"unix:{tmp_path / 'b'}")
    command = [*EVLCP, "board", "monitor", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    board.end()
    said = process.communicate(timeout=20)[1]
    assert process.returncode == 6
    assert "the board hung up; start it again" in said


@pytest.mark.parametrize(
    "option",
    [("--no-start",), ("--level", 30), ("--seed", 1), ("--port", "native:"), ("--set", "air.pilot_every=2")],
)
def test_an_inventory_takes_no_settings_from_the_command_line(evlcp, option: tuple[object, ...]) -> None:
    done = evlcp("board", "program", "--inventory", "x.toml", *option)
    assert done.code == 2
    assert str(option[0]) in done.err


def test_nor_before_the_command(evlcp) -> None:
    done = evlcp("board", "--port", "native:", "program", "--inventory", "x.toml")
    assert done.code == 2
    assert "write --port there" in done.err


def test_options_of_the_line_stand_before_or_behind_the_command(
    evlcp, native: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = evlcp("board", "--port", native, "hello", "--json")
    behind = evlcp("board", "hello", "--json", "--port", native)
    assert (before.code, behind.code) == (0, 0)
    assert json.loads(before.out)["unique_id"] == json.loads(behind.out)["unique_id"]
    # behind counts more, and either more than the environment
    assert evlcp("board", "--port", "unix:/nowhere", "start", "--port", native).code == 5
    with monkeypatch.context() as environment:
        environment.setenv("EVLCP_PORT", "unix:/nowhere")
        assert evlcp("board", "--port", native, "hello").code == 0
    trace = tmp_path / "wire.jsonl"
    assert evlcp("board", "--port", native, "--trace", trace, "status").code == 0
    assert evlcp("board", "--replay", trace, "status").code == 0
    for command in (("leds", "x", "--chips", "y"), ("emulate", "native"), ("ports",)):
        refused = evlcp("board", "--port", native, *command)
        assert refused.code == 2
        assert f"'{command[0]}' takes no --port" in refused.err


@pytest.mark.parametrize("command", ["hello", "program", "start", "level", "test-leds", "recall"])
def test_a_command_on_a_board_has_the_options_of_the_line(evlcp, command: str) -> None:
    said = evlcp("board", command, "--help").out
    assert [o for o in ("--port", "--baud", "--trace", "--replay") if o not in said] == []


@pytest.mark.parametrize(
    "command",
    [
        ("tx", "frames", "--random", 1, "--seed", -1),
        ("tx", "frames", "--random", 10**12),
        ("tx", "frames", "--random", 1, "--set", f"air.frames_per_packet={10**12}"),
        ("tx", "check", "--random", 1, "--set", "air.chip_rate_hz=inf"),
    ],
)
def test_numbers_beyond_reason_are_usage(evlcp, command: tuple[object, ...]) -> None:
    done = evlcp(*command)
    assert done.code == 2
    assert "Traceback" not in done.err


@pytest.mark.parametrize("head", ['{"first": 1e999, "nonce": 1, "baud": 1}', "[" * 100_000])
def test_a_trace_of_nonsense_is_one_line(evlcp, tmp_path: Path, head: str) -> None:
    path = tmp_path / "wire.jsonl"
    path.write_text(head)
    done = evlcp("board", "hello", "--replay", path)
    assert done.code == 3
    assert done.err.count("\n") == 1


@pytest.mark.parametrize("option", ["--listen", "--link"])
def test_an_emulator_leaves_a_users_file_alone(evlcp, tmp_path: Path, option: str) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("mine")
    place = f"unix:{path}" if option == "--listen" else path
    assert evlcp("board", "emulate", "native", option, place).code == 1
    assert path.read_text() == "mine"


@pytest.mark.parametrize(
    ("place", "code", "says"),
    [("unix:", 2, "expected unix:PATH"), ("unix:" + "x" * 200, 1, "AF_UNIX path too long")],
)
def test_a_place_where_no_emulator_can_listen(evlcp, place: str, code: int, says: str) -> None:
    done = evlcp("board", "emulate", "native", "--listen", place)
    assert (done.code, done.err.count("\n")) == (code, 1)
    assert says in done.err


def test_a_flash_file_is_replaced_whole(tmp_path: Path, book: Codebook) -> None:
    flash, place = tmp_path / "flash.bin", f"unix:{tmp_path / 'board'}"
    payload = Bank.of_symbols(random_symbols(1, 10, book, np.random.default_rng(0)), book)

    @contextlib.contextmanager
    def started() -> "Iterator[tuple[Emulated, Board]]":
        emulated = Emulated("native", "--listen", place, "--flash", flash)
        try:
            with Session(open_transport(place)) as session:
                yield emulated, Board(session)
        finally:
            emulated.end()

    with started() as (emulated, board):
        assert flash.stat().st_mode & 0o777 == 0o600  # it may hold a key
        flash.chmod(0o640)
        board.program(payload)
        for number in range(1, 6):
            with flash.open("rb") as old:
                before = flash.read_bytes()
                assert board.save().save_sequence == number
                # who opened the old file still reads it whole: the new one is another
                assert old.read() == before
            assert flash.read_bytes() != before
        saved = flash.read_bytes()
        assert flash.stat().st_mode & 0o777 == 0o640
        # The system takes no more in the middle of the next write.
        resource.prlimit(emulated.process.pid, resource.RLIMIT_FSIZE, (40_000, 40_000))
        with pytest.raises(LineError):
            board.save()
        assert emulated.process.wait(10) == OutputError.exit_code
    assert flash.read_bytes() == saved
    with started() as (_, board):
        assert board.recall().save_sequence == 5
        assert board.holds(payload, board.status())


@pytest.mark.parametrize("through", ["--flash", "native:"])
def test_a_flash_file_that_cannot_be_used_is_told_at_once(evlcp, tmp_path: Path, through: str) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "notes.txt").write_text("mine")
    for name, says in (
        ("no/flash.bin", "No such file or directory"),
        ("folder", "not a file"),
        ("notes.txt/flash.bin", "Not a directory"),
    ):
        path = tmp_path / name
        listen = ("--listen", f"unix:{tmp_path / 'b'}")
        done = (
            evlcp("board", "emulate", "native", *listen, "--flash", path)
            if through == "--flash"
            else evlcp("board", "hello", "--port", f"native:{path}")
        )
        assert done.code == 3, (name, done.err)
        assert says in done.err
        assert done.err.count("\n") == 1


def test_a_file_that_is_no_flash_is_left_alone(evlcp, tmp_path: Path) -> None:
    path = tmp_path / "notes.bin"
    for size in (4, 100_000):
        path.write_bytes(bytes(size))
        done = evlcp("board", "emulate", "native", "--listen", f"unix:{tmp_path / 'b'}", "--flash", path)
        assert done.code == 3
        assert f"{path}: not a flash file of" in done.err
        assert done.err.count("\n") == 1
        assert path.read_bytes() == bytes(size)
