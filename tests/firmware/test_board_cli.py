"""`evlcp board` against running boards: commands, exit codes, traces, emulators."""

import json
import os
import pty
import signal
import socket
import subprocess
import sys
import tty
from pathlib import Path

import numpy as np
import pytest
import typer
from board_lines import Native, check_fault, well

from evlcp_sdk.errors import OutputError
from firmware_host.board.survey import find_board_port, survey_ports
from firmware_host.board.update import UpdatePackage
from firmware_host.emulators.led_record import RECORD, LedRecord
from firmware_host.emulators.native import NativeBoard
from firmware_host.errors import NoBoardError
from firmware_host.ports.usb import SerialPort
from tests.conftest import Run

EVLCP = [sys.executable, "-c", "from evlcp_sdk.cli.main import main; main()"]


class Emulated:
    """`evlcp board emulate` in the background."""

    def __init__(self, *options):
        command = [*EVLCP, "board", "emulate", *map(str, options)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, stdin=subprocess.DEVNULL)
        self.first_line = self.process.stdout.readline()

    def end(self):
        self.process.send_signal(signal.SIGTERM)
        code = self.process.wait(10)
        self.process.stdout.close()
        return code


def test_a_users_first_hour(evlcp, native, tmp_path):
    def board(*arguments):
        return evlcp("board", *arguments, "--port", native)

    def table(*arguments, **expected):
        done = board(*arguments, "--json")
        assert (done.code, done.err) == (0, ""), arguments
        assert expected.items() <= json.loads(done.out).items(), arguments

    assert "native" in board("hello").out
    table("hello", hal="native", clusters=16, leds=96)
    check_fault(board("send", "--random", 1), 5, "'evlcp board program' first")
    eight = ("--random", 8, "--seed", 3)
    done = well(board("program", *eight, "--level", 25, "--watchdog", "idle", "--watchdog-ms", 1500))
    sent, reported = done.out.splitlines()
    assert sent == "sent 2560 of 2560 bytes; bank 0 is active"
    idle = "watchdog: the board shows its idle pattern once no host has spoken for 1.5 s;"
    assert reported.startswith(idle)
    table("status", state="playing", level_ma=25, watchdog="idle", watchdog_ms=1500)
    assert board("watchdog", "idle", "--after-ms", 1500).out.startswith(idle)
    assert "the board goes dark" in board("watchdog", "dark").out
    table("watchdog", "keep", "--after-ms", 700, watchdog="keep", watchdog_ms=700)
    again = board("program", *eight).out
    assert "was there already" in again
    assert "watchdog" not in again
    table("program", *eight, swapped=False, watchdog="keep", bank=0)
    table("verify", *eight, bank=0, bytes=2560)
    check_fault(board("verify", "--random", 8, "--seed", 4), 7, "byte 0 of bank 0")
    check_fault(board("verify", "--random", 9, "--seed", 4), 7)
    for other, message in (
        ("modulation.id=wh8", "(wh8) at air.chip_rate_hz = 10000"),
        ("air.chip_rate_hz=5000.0", "at 10000 chips per second, this payload's link has"),
    ):
        for command in ("send", "verify"):
            check_fault(board(command, *eight, "--set", other), 8, message)
    table("send", "--random", 2, "--seed", 9, bank=1)
    assert "playing" in board("monitor", "--count", 1).out
    table("monitor", "--count", 1, port=native, state="playing")
    table("level", 20, level_ma=20)
    check_fault(board("level", 61), 5, "the nearest value the board can take is 60")
    message = "this payload has a LED on for 0.5 of the time, the duty limit is 0.3: give a limit of at least"
    check_fault(board("program", "--random", 8, "--duty-limit", 0.3), 5, message)
    check_fault(board("save"), 5)
    table("stop", state="dark")
    assert board("save").out == "saved in slot 0, number 1\n"
    table("save", "--autostart", slot=1, save_sequence=2, autostart=True)
    assert board("recall").out == "recalled slot 1, number 2\n"
    table("recall", slot=1, save_sequence=2)
    table("test-leds", "--last", 1, "--dwell-ms", 1, first=0, last=1)
    table("start", state="playing")
    table("blank", state="dark")
    assert (tmp_path / "flash.bin").stat().st_size > 80_000


def test_the_command_updates_on_trial_and_keeps(evlcp, native, tmp_path):
    path = tmp_path / "a.update.json"
    path.write_text(UpdatePackage("native", {1: b"one!", 2: b"two!"}).to_json())
    update = ("board", "update", "--port", native)
    assert well(evlcp(*update, path)).out == "image 1 runs, 4 bytes, firmware 1.0.0\n"
    table = json.loads(well(evlcp(*update, path, "--no-keep", "--json")).out)
    assert table == {"image": 2, "bytes": 4, "sequence": 2, "firmware": "1.0.0", "kept": False}
    assert well(evlcp(*update, "--confirm")).out == "image 2 is kept\n"
    check_fault(evlcp(*update, path, "--confirm"), 2, "one of the three")


def test_every_command_on_a_board_takes_json_and_a_line():
    from firmware_host.commands import board, tx

    for app in (board.app, tx.app):
        for name, command in typer.main.get_command(app).commands.items():
            # frames says it by --format json; an emulator runs in the foreground
            options = {option for parameter in command.params for option in parameter.opts}
            assert "--json" in options or name in ("frames", "emulate"), name


HELLO = ("board", "hello", "--port")
PROGRAM = ("board", "program")
FLEET = (*PROGRAM, "--inventory", "x.toml")
EMULATE = ("board", "emulate", "native")


@pytest.mark.parametrize(
    ("arguments", "code", "kind", "message"),
    [
        ((*HELLO, "unix:/nowhere/at/all"), 4, "NoBoardError", "no board listens there"),
        ((*HELLO, "unix:"), 4, "NoBoardError", "expected unix:PATH"),
        ((*HELLO, "tcp:127.0.0.1:1"), 4, "NoBoardError", "no board listens there"),
        ((*HELLO, "rfc2217://:1"), 4, "NoBoardError", "expected rfc2217://HOST:PORT"),
        ((*HELLO, "socket://127.0.0.1:1"), 4, "NoBoardError", "start what listens there"),
        ((*HELLO, "/dev/nowhere"), 4, "NoBoardError", "cannot be opened"),
        ((*HELLO, "what://ever"), 4, "NoBoardError", "cannot be opened"),
        ((*HELLO, "native:", "--trace", "no/w.jsonl"), 1, "OutputError", "no/w.jsonl: cannot be written"),
        (("board", "start", "--port", "native:"), 5, "RefusedError", "NOTHING_COMMITTED"),
        (("board", "start", "--timeout", "1"), 2, "ConfigError", "--timeout belongs to --pulse-hz"),
        (("board", "verify", "--random", "1", "--port", "native:"), 7, "VerifyError", "nothing is"),
        ((*PROGRAM, "--port", "native:"), 2, "ConfigError", "one of the two"),
        ((*PROGRAM, "--random", "1", "--masks", "x.npy"), 2, "ConfigError", "give one of them"),
        ((*PROGRAM, "--random", "129", "--port", "native:"), 2, "ConfigError", "send at most 128"),
        ((*FLEET, "--seed", "1"), 2, "ConfigError", "--seed"),
        ((*FLEET, "--port", "native:"), 2, "ConfigError", "--port"),
        (("board", "--port", "native:", *FLEET[1:]), 2, "ConfigError", "write --port there"),
        (("board", "leds", "no.bin", "--chips", "c.npy"), 3, "InputError", "no.bin"),
        (("board", "emulate", "stm32", "--listen", "pty"), 2, None, "expected unix:PATH, or tcp:HOST:PORT"),
        ((*EMULATE, "--listen", "smoke:signals"), 2, None, "from 1 to 65535, or pty"),
        ((*EMULATE, "--listen", "unix:" + "x" * 200), 1, None, "AF_UNIX path too long"),
        (("tx", "frames", "--random", str(10**12)), 2, None, "at most 100000 frames in all"),
        (("tx", "message"), 2, "ConfigError", "give what to send: --text TEXT, --file FILE, --beacon"),
        (("board", "flash", "--port", "tcp:127.0.0.1:1"), 2, None, "give an image, or --target"),
        (("board", "flash", "--target", "stm32f405-8mhz"), 2, None, "--port: expected"),
        (("loop", "--text", ""), 2, None, "text: expected at least one character"),
        (("loop", "--distance", "5"), 2, None, "the bar, 0.96 m high, fits into the image from 9.6 m on"),
        (("loop", "--set", "air.chip_rate_hz=12.5"), 2, None, "expected whole chips per second"),
    ],
)
def test_a_fault_is_one_line_and_json_too(evlcp, tmp_path, monkeypatch, arguments, code, kind, message):
    monkeypatch.chdir(tmp_path)
    done = evlcp(*arguments, *["--json"] * (kind is not None))
    check_fault(done, code, message)
    if kind is not None:
        error = json.loads(done.out)["error"]
        assert (error["exit_code"], error["kind"]) == (code, kind)
        assert message in error["message"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("board", "level", "much", "--port", "native:"), "MA"),
        (("board", "status", "--no-such", "--port", "native:"), "--no-such"),
        (("tx", "message", "--text", "hi", "--id", "-1"), "--id"),
    ],
)
def test_a_fault_of_usage(evlcp, arguments, message):
    done = evlcp(*arguments, "--json")
    assert (done.code, message in done.err, "Traceback" in done.err) == (2, True, False)
    assert json.loads(done.out)["error"]["kind"] == "UsageError"
    assert "'ports' takes no --port" in evlcp("board", "--port", "x", "ports").err


def test_wrong_records_are_reported(evlcp, tmp_path):
    torn, out = tmp_path / "leds.bin", tmp_path / "c.npy"
    records = np.zeros(3, RECORD)
    records["chip"] = (0, 1, 3)
    for count, message in (
        (60, "at byte 40: chip 3 after chip 1: not an LED record"),
        (19, f"{torn}: 19 bytes, expected LED records of 20 bytes"),
        (0, f"{torn}: 0 bytes, expected LED records of 20 bytes"),
    ):
        torn.write_bytes(records.tobytes()[:count])
        check_fault(evlcp("board", "leds", torn, "--chips", out), 3, message)
        assert not out.exists()
    torn.write_bytes(records.tobytes()[:45])
    cut = evlcp("board", "leds", torn, "--chips", out)
    check_fault(cut, 3, "the last record is cut off (5 bytes)")
    assert cut.out == "2 chips\n"
    assert len(np.load(out)) == 2
    check_fault(evlcp("board", "leds", torn, "--chips", torn), 2, f"would overwrite the record {torn}")
    two = ("--leds", out, "--flash", out, "--listen", f"unix:{tmp_path / 'board'}")
    check_fault(evlcp("board", "emulate", "native", *two), 2, f"{out} cannot be both")


def test_a_record_that_is_written_is_the_one_that_is_read(tmp_path):
    """Ticks wrap, and are unwrapped."""
    made = np.zeros(4, RECORD)
    made["tick"], made["chip"] = (2**32 - 2500, 0, 2500, 5000), range(4)
    made["row"] = np.random.default_rng(0).integers(0, 256, (4, 12))
    record = LedRecord.of_records(made)
    assert record.ticks.tolist() == [2**32 + n for n in (-2500, 0, 2500, 5000)]
    assert record.to_bytes() == made.tobytes()
    (tmp_path / "leds.bin").write_bytes(record.to_bytes())
    assert (LedRecord.read(tmp_path / "leds.bin").rows == made["row"]).all()
    assert len(LedRecord.of_records(made[:0])) == 0


def test_trace_and_replay(evlcp, tmp_path):
    trace = tmp_path / "wire.jsonl"
    arguments = ("board", "program", "--random", 8, "--seed", 3)
    live = well(evlcp(*arguments, "--port", "native:", "--trace", trace))
    lines = [json.loads(x) for x in trace.read_text().splitlines()]
    assert lines[0]["evlcp_trace"] == 1
    assert {x["dir"] for x in lines[1:]} == {"tx", "rx"}
    replayed = evlcp(*arguments, "--replay", trace)
    assert (replayed.code, replayed.out) == (0, live.out)
    check_fault(evlcp(*arguments[:-1], 4, "--replay", trace), 6, "is another one than was recorded")
    trace.write_text("\n".join(trace.read_text().splitlines()[:5]) + "\n")
    check_fault(evlcp(*arguments, "--replay", trace), 6, "the trace ends here")
    check_fault(evlcp(*arguments, "--replay", trace, "--trace", trace), 2, "give one of the two")
    for text, message in (
        ('{"evlcp_trace": 1, "first": 1, "nonce": 2, "baud": 9600}\n{"dir": "up"}\n', "line 2: not a trace"),
        ('{"first": 1e999, "nonce": 1, "baud": 1}', "line 1: not a trace"),
        ("[" * 100_000, "line 1: not a trace"),
    ):
        trace.write_text(text)
        check_fault(evlcp(*arguments, "--replay", trace), 3, f"{trace}: {message}")


def test_line_options_stand_anywhere(evlcp, native, monkeypatch):
    before = evlcp("board", "--port", native, "hello", "--json")
    behind = evlcp("board", "hello", "--json", "--port", native)
    assert json.loads(before.out)["unique_id"] == json.loads(behind.out)["unique_id"]
    # behind counts more, and either more than the environment
    assert evlcp("board", "--port", "unix:/nowhere", "start", "--port", native).code == 5
    monkeypatch.setenv("EVLCP_PORT", "unix:/nowhere")
    well(evlcp("board", "--port", native, "hello"))
    monkeypatch.setenv("EVLCP_PORT", native)
    well(evlcp("board", "hello"))


def test_no_place_to_build_is_reported(tmp_path):
    """In a process of its own: this one has built it."""
    (tmp_path / "file").write_text("")
    env = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "file")}
    command = [*EVLCP, "board", "hello", "--port", "native:"]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    check_fault(Run(done.returncode, done.stdout, done.stderr), 1, "set XDG_CACHE_HOME")


def test_an_emulator_does_not_take_anothers_place(evlcp, native, tmp_path):
    for emulator in ("native", "stm32", "rom"):
        done = evlcp("board", "emulate", emulator, "--listen", native)
        message = f"--listen {native}: another program answers there; end it, or listen elsewhere"
        check_fault(done, 2, message)
        assert done.out == ""
    well(evlcp("board", "hello", "--port", native))
    # what one that was killed leaves behind is no hindrance
    path = tmp_path / "stale"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as left:
        left.bind(str(path))
    emulated = Emulated("native", "--listen", f"unix:{path}")
    well(evlcp("board", "hello", "--port", f"unix:{path}"))
    assert emulated.end() == 0


def test_pty_and_tcp(evlcp, tmp_path):
    emulated = Emulated("native", "--listen", "pty", "--link", tmp_path / "tty")
    assert emulated.first_line == f"listening on {tmp_path / 'tty'}\n"
    done = evlcp("board", "program", "--random", 64, "--port", tmp_path / "tty")
    assert (done.code, done.err) == (0, "")
    well(evlcp("board", "verify", "--random", 64, "--port", tmp_path / "tty"))
    assert emulated.end() == 0
    with socket.create_server(("127.0.0.1", 0)) as free:
        place = f"127.0.0.1:{free.getsockname()[1]}"
    emulated = Emulated("native", "--listen", f"tcp:{place}")
    well(evlcp("board", "hello", "--port", f"tcp:{place}"))
    well(evlcp("board", "hello", "--port", f"socket://{place}"))
    assert emulated.end() == 0


def test_ports_are_asked(native, tmp_path, monkeypatch):
    silent, other = pty.openpty()
    tty.setraw(other)
    listed = [SerialPort(p, usb="0403:6015") for p in (os.ttyname(other), native, "/dev/nowhere")]
    monkeypatch.setattr("firmware_host.board.survey.serial_ports", lambda: listed)
    assert [f.info is not None for f in survey_ports(1_000_000)] == [False, True, False]
    assert find_board_port(1_000_000) == native
    board = listed.pop(1)
    with pytest.raises(NoBoardError, match=r"no board answers on any serial port .*asked: .*, /dev/nowhere;"):
        find_board_port(1_000_000)
    second = Native(f"unix:{tmp_path / 'second'}")
    listed[:] = board, SerialPort(f"unix:{tmp_path / 'second'}", usb="0403:6015")
    with pytest.raises(NoBoardError, match="2 boards answer"):
        find_board_port(1_000_000)
    second.end()
    os.close(silent)
    os.close(other)


@pytest.mark.parametrize("option", ["--listen", "--link"])
def test_an_emulator_leaves_a_users_file_alone(evlcp, tmp_path, option):
    path = tmp_path / "notes.txt"
    path.write_text("mine")
    place = f"unix:{path}" if option == "--listen" else path
    assert evlcp("board", "emulate", "native", option, place).code == 1
    assert path.read_text() == "mine"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_record_on_a_full_disk_is_named():
    board = NativeBoard(Path("/dev/full"))
    for use in (lambda: board.read(0.0), board.close):
        with pytest.raises(OutputError, match="/dev/full: cannot be written: No space left"):
            use()


def test_a_flash_file_is_as_private_as_it_was(tmp_path):
    flash = tmp_path / "flash.bin"
    for mode in (0o600, 0o640):  # it may hold a key
        NativeBoard(flash=flash).close()
        assert flash.stat().st_mode & 0o777 == mode
        flash.chmod(0o640)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no/flash.bin", "No such file or directory"),
        ("folder", "not a file"),
        ("notes.txt/flash.bin", "Not a directory"),
        ("notes.txt", "notes.txt: not a flash file of"),
    ],
)
def test_a_flash_file_that_cannot_be_used_is_left_alone(evlcp, tmp_path, name, message):
    (tmp_path / "folder").mkdir()
    (tmp_path / "notes.txt").write_text("mine")
    options = ("--listen", f"unix:{tmp_path / 'b'}", "--flash", tmp_path / name)
    check_fault(evlcp("board", "emulate", "native", *options), 3, message)
    check_fault(evlcp("board", "hello", "--port", f"native:{tmp_path / name}"), 3, message)
    assert (tmp_path / "notes.txt").read_text() == "mine"
