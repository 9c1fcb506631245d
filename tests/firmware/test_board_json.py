"""`--json` of every command, faults too; inventories for more than programming; a monitor that reconnects."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from board_lines import Native

from firmware_host.board.board import Board
from firmware_host.board.monitor import Back, Gone, watch
from firmware_host.board.session import Session
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import LineError, NoBoardError
from firmware_host.protocol.generated.requests import StatusReply

pytestmark = pytest.mark.usefixtures("compiler")

Evlcp = Callable[..., Any]

SITE = """
[[bar]]
transmitter_id = 7
latitude_deg = 35.156789
longitude_deg = 136.965432
height_m = 52.4
"""


def test_every_command_on_a_board_takes_json() -> None:
    from firmware_host.commands import board, tx

    for app in (board.app, tx.app):
        for name, command in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
            options = {o for p in command.params for o in p.opts}
            # frames says it by --format json; an emulator runs in the foreground
            assert "--json" in options or name in ("frames", "emulate"), name


@pytest.fixture
def native(tmp_path: Path) -> Iterator[str]:
    place = f"unix:{tmp_path / 'board'}"
    board = Native(place, flash=tmp_path / "f.bin")
    yield place
    board.end()


def test_what_is_done_is_one_object(evlcp: Evlcp, native: str) -> None:
    for arguments, expected in (
        (("program", "--random", 2), {"swapped": True, "watchdog": "keep"}),
        (("verify", "--random", 2), {"bank": 0, "bytes": 640}),
        (("level", 20), {"level_ma": 20}),
        (("watchdog", "idle", "--after-ms", 700), {"watchdog": "idle", "watchdog_ms": 700}),
        (("stop",), {"state": "dark"}),
        (("save", "--autostart"), {"slot": 0, "save_sequence": 1, "autostart": True}),
        (("recall",), {"slot": 0, "save_sequence": 1}),
        (("test-leds", "--last", 1, "--dwell-ms", 1), {"first": 0, "last": 1}),
        (("start",), {"state": "playing"}),
        (("status",), {"state": "playing"}),
        (("blank",), {"state": "dark"}),
        (("monitor", "--count", 1), {"port": native, "state": "dark"}),
    ):
        done = evlcp("board", *map(str, arguments), "--port", native, "--json")
        assert (done.code, done.err) == (0, ""), arguments
        table = json.loads(done.out)
        assert expected.items() <= table.items(), arguments


@pytest.mark.parametrize(
    ("arguments", "code", "kind"),
    [
        (("hello", "--port", "unix:/nowhere"), 4, "NoBoardError"),
        (("start", "--port", "native:"), 5, "RefusedError"),
        (("save", "--port", "native:"), 5, "RefusedError"),
        (("verify", "--random", "1", "--port", "native:"), 7, "VerifyError"),
        (("program", "no.json", "--port", "native:"), 3, "InputError"),
        (("program", "--port", "native:"), 2, "ConfigError"),
        (("level", "much", "--port", "native:"), 2, "UsageError"),
        (("status", "--no-such", "--port", "native:"), 2, "UsageError"),
        (("leds", "no.bin", "--chips", "c.npy"), 3, "InputError"),
        (("program", "--inventory", "no.toml"), 2, "ConfigError"),
    ],
)
def test_a_fault_is_json_too(evlcp: Evlcp, arguments: tuple[str, ...], code: int, kind: str) -> None:
    done = evlcp("board", *arguments, "--json")
    assert done.code == code
    error = json.loads(done.out)["error"]
    assert (error["exit_code"], error["kind"]) == (code, kind)
    # a person reads the same
    assert error["message"].splitlines()[0].split(":")[-1].strip()[:20] in done.err


def test_a_fault_of_tx_is_json_too(evlcp: Evlcp, tmp_path: Path) -> None:
    for arguments, kind in (
        (("message",), "ConfigError"),
        (("message", "--text", "hi", "--id", "-1"), "UsageError"),
        (("check", "no.json"), "InputError"),
        (("keygen", str(tmp_path)), "OutputError"),
    ):
        done = evlcp("tx", *arguments, "--json")
        assert json.loads(done.out)["error"]["kind"] == kind, done.err


def fleet(path: Path, count: int) -> tuple[Path, list[Native]]:
    """An inventory of boards that run."""
    (path / "site.toml").write_text(SITE)
    ports = [f"unix:{path / f'b{n}'}" for n in range(count)]
    emulated = [Native(port, unique_id=n) for n, port in enumerate(ports)]
    text = '[defaults]\nsequence = 4\nbeacon = "site.toml"\nuser = "north"\ntext = "Tempo 30"\n'
    for n, port in enumerate(ports):
        text += f'[[board]]\nid = "T{n}"\nport = "{port}"\nposition_m = [0, 0, {n}]\n'
    (path / "tunnel.toml").write_text(text)
    return path / "tunnel.toml", emulated


def test_an_inventory_for_all_that_is_done_with_boards(evlcp: Evlcp, tmp_path: Path) -> None:
    file, emulated = fleet(tmp_path, 3)

    def rows(*arguments: object) -> list[dict[str, Any]]:
        done = evlcp("board", *map(str, arguments), "--inventory", file, "--json")
        assert done.code == 0, done.err
        return sorted(map(json.loads, done.out.splitlines()), key=lambda row: row["id"])

    assert all(row["ok"] and row["swapped"] for row in rows("program"))
    assert not any(row["swapped"] for row in rows("program")), "a message with a number stays the same"
    assert all(row["ok"] and row["bank"] == 0 for row in rows("verify"))
    assert [row["status"]["state"] for row in rows("status")] == ["playing"] * 3
    assert [row["state"] for row in rows("blank")] == ["dark"] * 3
    assert [(row["slot"], row["save_sequence"]) for row in rows("save", "--autostart")] == [(0, 1)] * 3
    assert [row["state"] for row in rows("start")] == ["playing"] * 3
    seen = rows("monitor", "--count", 2, "--interval", 0.01)
    assert [row["id"] for row in seen] == ["T0", "T0", "T1", "T1", "T2", "T2"]
    assert {row["state"] for row in seen} == {"playing"}
    said = evlcp("board", "status", "--inventory", file).out.splitlines()
    assert sorted(line.split("  ")[0] for line in said) == ["T0", "T1", "T2"]
    assert all("playing, " in line for line in said)
    # one that is off does not hold up the others
    emulated[1].end()
    done = evlcp("board", "stop", "--inventory", file, "--json")
    assert done.code == 4
    *ended, error = map(json.loads, done.out.splitlines())
    assert {row["id"]: row["ok"] for row in ended} == {"T0": True, "T1": False, "T2": True}
    assert error["error"]["kind"] == "FleetError"
    file.write_text(file.read_text().replace("Tempo 30", "Tempo 50"))
    other = evlcp("board", "verify", "--inventory", file)
    assert other.code == 7
    assert "T0" in other.err
    refused = evlcp("board", "status", "--inventory", file, "--port", "native:")
    assert refused.code == 2
    assert "write --port there" in refused.err
    for one in (emulated[0], emulated[2]):
        one.end()


def test_the_packets_of_an_inventory_are_those_of_tx_message(evlcp: Evlcp, tmp_path: Path) -> None:
    pytest.importorskip("cryptography", reason="the extra sign is not installed")
    from firmware_host.board.fleet import read_inventory

    (tmp_path / "site.toml").write_text(SITE)
    assert evlcp("tx", "keygen", tmp_path / "private.pem").code == 0
    options = ("--beacon", tmp_path / "site.toml", "--key", tmp_path / "private.pem", "--user", "north")
    done = evlcp("tx", "message", "--text", "hi", *options, "--sequence", 9, "--repeat", 2, "--json")
    (tmp_path / "one.toml").write_text(
        '[[board]]\nid = "a"\nport = "native:"\nposition_m = [0, 0, 0]\ntext = "hi"\nbeacon = "site.toml"\n'
        'key = "private.pem"\nuser = "north"\nsequence = 9\nrepeat = 2\n'
    )
    (tmp_path / "symbols.json").write_text(done.out)
    (tmp_path / "two.toml").write_text(
        '[[board]]\nid = "a"\nport = "native:"\nposition_m = [0, 0, 0]\npayload = "symbols.json"\n'
    )
    (one,) = read_inventory(tmp_path / "one.toml").banks.values()
    (two,) = read_inventory(tmp_path / "two.toml").banks.values()
    assert one.content == two.content
    assert one.packets == json.loads(done.out)["packets"]


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ('text = "a"', "a message needs sequence"),
        ('text = "a"\nsequence = 1\nrandom = 2', "give payload or random or a message"),
        ('random = 1\nkey = "k.pem"', "key and user belong to a beacon"),
        ('beacon = "no.toml"\nsequence = 1', "no.toml: cannot be read"),
        ('beacon = "site.toml"\nsequence = 1\ntransmitter_id = 8', "no bar has transmitter_id 8, but 7"),
        ('beacon = "site.toml"\nkey = "no.pem"\nsequence = 1', "no.pem: cannot be read"),
    ],
)
def test_a_wrong_message_of_an_inventory_is_one_line(
    evlcp: Evlcp, tmp_path: Path, keys: str, says: str
) -> None:
    (tmp_path / "site.toml").write_text(SITE)
    file = tmp_path / "one.toml"
    file.write_text(f'[[board]]\nid = "a"\nport = "native:"\nposition_m = [0, 0, 0]\n{keys}\n')
    done = evlcp("board", "program", "--inventory", file)
    assert done.code in (2, 3)
    assert says in done.err
    assert done.err.count("\n") == 1


def test_a_monitor_finds_its_board_again() -> None:
    """A line that breaks, a board that is off for a while, and one that was reset."""
    device = SimulatedBoard()
    opens = 0

    class Breaking(SimulatedLine):
        left = 2

        def write(self, data: bytes) -> None:
            self.left -= 1
            if self.left < 0:
                raise LineError("x: the line broke")
            super().write(data)

    def opened() -> Any:
        nonlocal opens
        opens += 1
        if opens == 2:
            raise NoBoardError("x: it is not there")
        line = Breaking(device)
        line.left = 4 if opens == 1 else 1000

        class Line(Session):
            def __enter__(self) -> Any:
                return Board(self)

        return Line(line)

    seen = []
    for what in watch(opened, 0.01, count=6):
        seen.append(what)
        if len(seen) == 6:
            device.reset()
    kinds = [type(s) for s in seen]
    assert kinds == [StatusReply, StatusReply, Gone, Back, *[StatusReply] * 2, Gone, Back, *[StatusReply] * 2]
    assert isinstance(seen[2], Gone)
    assert "the line broke" in str(seen[2].fault)
    assert isinstance(seen[3], Back)
    assert seen[3].after_s >= 0.5
    assert opens == 4
    with pytest.raises(NoBoardError):
        list(watch(lambda: (_ for _ in ()).throw(NoBoardError("off")), 0.01, count=1))  # type: ignore[arg-type]
