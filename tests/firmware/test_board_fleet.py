"""Fleets: one inventory, many boards, some of which fail."""

import json
import signal
import threading
import time
from contextlib import ExitStack

import pytest
from board_lines import SITE, Native, check_fault, well

from firmware_host.board.fleet import read_inventory

BOARD = '[[board]]\nid = "a"\nport = "native:"\nposition_m = [0, 0, 0]\n'
GOOD = BOARD + "random = 1\n"
ONLY = GOOD + f'unique_id = "{"0" * 24}"\n'


@pytest.fixture
def boards(tmp_path):
    """Native boards on unix sockets."""
    with ExitStack() as stack:
        emulated = [Native(f"unix:{tmp_path / f'b{n}'}", unique_id=n) for n in range(4)]
        for board in emulated:
            stack.callback(board.end)
        yield emulated


def inventory(path, ports, extra):
    tables = ["[defaults]\nrandom = 16"]
    for n, port in enumerate(ports):
        line = f'[[board]]\nid = "T{n:02}"\nport = "{port}"\nposition_m = [0.0, {n}.5, 5]\nseed = {n}\n'
        tables.append(line + extra.get(n, ""))
    path.write_text("\n".join(tables))
    return path


def test_a_boards_link(tmp_path):
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "fast.toml").write_text("[air]\nchip_rate_hz = 20000.0\n")
    extra = {1: "link = {air = {pilot_every = 4, frames_per_packet = 8}}\n", 2: 'link = "links/fast.toml"\n'}
    file = inventory(tmp_path / "three.toml", ["unix:/a", "unix:/b", "unix:/c"], extra)
    banks = list(read_inventory(file)[1].values())
    assert [b.link.packet.pilot_every for b in banks] == [1, 4, 1]
    assert [b.link.packet.frames for b in banks] == [10, 8, 10]
    assert [b.chip_rate_hz for b in banks] == [10_000, 10_000, 20_000]
    # one for all boards, but for those with their own
    inventory(file, ["unix:/a", "unix:/b"], {1: "link = {}\n"})
    text = file.read_text().replace("random = 16", 'random = 16\nlink = {modulation = {id = "wh8"}}')
    file.write_text(text)
    assert [bank.link.codebook.profile for bank in read_inventory(file)[1].values()] == ["wh8", "wh4x2"]


def test_two_of_four(evlcp, boards, tmp_path):
    # one port has nobody, one board cannot take the level
    ports = [board.line.place for board in boards]
    file = tmp_path / "tunnel.toml"
    inventory(file, [ports[0], f"unix:{tmp_path / 'nobody'}", *ports[2:]], {3: "level_ma = 500\n"})
    done = evlcp("board", "program", "--inventory", file)
    lines = done.out.splitlines()
    none, refused = sorted(x for x in lines if "FAILED" in x)
    assert len([x for x in lines if "programmed 5120 of 5120 bytes" in x]) == 2
    assert (none[:3], refused[:3]) == ("T01", "T03")
    assert "FAILED (4)" in none
    assert "FAILED (5)" in refused
    assert "nearest value the board can take is 60" in refused
    check_fault(done, 4, f"evlcp: {file}: 2 of 4 boards failed (T01, T03)")
    well(evlcp("board", "verify", "--random", 16, "--seed", 2, "--port", ports[2]))

    # repaired, the next run does only what is missing
    inventory(file, ports, {})
    again = well(evlcp("board", "program", "--inventory", file, "--json"))
    rows = [json.loads(x) for x in again.out.splitlines()]
    assert sorted(r["id"] for r in rows if r["written_bytes"]) == ["T01", "T03"]
    assert [r["ok"] for r in rows] == [True] * 4
    assert rows[0]["position_m"][0] == 0.0


def test_an_inventory_for_all_that_is_done_with_boards(evlcp, boards, tmp_path):
    (tmp_path / "site.toml").write_text(SITE)
    file = tmp_path / "tunnel.toml"
    text = '[defaults]\nsequence = 4\nbeacon = "site.toml"\nuser = "north"\ntext = "Tempo 30"\n'
    for n, one in enumerate(boards[:3]):
        text += f'[[board]]\nid = "T{n}"\nport = "{one.line.place}"\nposition_m = [0, 0, {n}]\n'
    file.write_text(text)

    def rows(*arguments):
        done = well(evlcp("board", *arguments, "--inventory", file, "--json"))
        return sorted(map(json.loads, done.out.splitlines()), key=lambda row: row["id"])

    assert all(row["ok"] and row["swapped"] for row in rows("program"))
    assert not any(row["swapped"] for row in rows("program")), "a message with a number stays the same"
    assert all(row["ok"] and row["bank"] == 0 for row in rows("verify"))
    assert [row["status"]["state"] for row in rows("status")] == ["playing"] * 3
    assert [row["state"] for row in rows("blank")] == ["dark"] * 3
    assert [(row["slot"], row["save_sequence"]) for row in rows("save", "--autostart")] == [(0, 1)] * 3
    assert [row["state"] for row in rows("start")] == ["playing"] * 3
    rows("blank")
    together = ("board", "start", "--inventory", file, "--pulse-hz", 2, "--timeout", 20, "--json")
    for one in boards[:3]:
        one.board._device.bench.pulse_period = 5e6
    started = json.loads(well(evlcp(*together)).out)
    assert (started["state"], list(started["at_pulse"])) == ("playing", [b.line.place for b in boards[:3]])
    seen = rows("monitor", "--count", 2, "--interval", 0.01)
    assert [row["id"] for row in seen] == ["T0", "T0", "T1", "T1", "T2", "T2"]
    assert {row["state"] for row in seen} == {"playing"}
    reported = evlcp("board", "status", "--inventory", file).out.splitlines()
    assert sorted(line.split("  ")[0] for line in reported) == ["T0", "T1", "T2"]
    assert all("playing, " in line for line in reported)
    # one that is off does not hold up the others
    boards[1].end()
    done = evlcp("board", "stop", "--inventory", file, "--json")
    assert done.code == 4
    *ended, error = map(json.loads, done.out.splitlines())
    assert {row["id"]: row["ok"] for row in ended} == {"T0": True, "T1": False, "T2": True}
    assert error["error"]["kind"] == "FleetError"
    file.write_text(file.read_text().replace("Tempo 30", "Tempo 50"))
    check_fault(evlcp("board", "verify", "--inventory", file), 7, "T0")


@pytest.mark.parametrize(
    ("text", "code", "expected"),
    [
        ("[[board", 2, "not TOML"),
        ("", 2, "board: missing"),
        (GOOD + "[other]\n", 2, "other: unknown table"),
        ("defaults = 3\n" + GOOD, 2, "defaults = 3"),
        (BOARD, 2, "give payload or random or a message"),
        (GOOD + 'link = {modulation = {id = "wh9"}}', 2, "board[0]: link: no modulation algorithm named"),
        (GOOD + 'link = "no.toml"', 2, "no.toml: cannot be read"),
        (GOOD + "link = {air = {chip_rate_hz = 2e6}}", 2, "board[0]: the driver board cannot play this link"),
        (GOOD + GOOD, 2, 'board[1]: id = "a", expected another than board[0]\'s'),
        (ONLY + ONLY.replace('"a"', '"b"'), 2, f'board[1]: unique_id = "{"0" * 24}", expected another'),
        (BOARD + 'payload = "no.json"', 3, "no.json: cannot be read"),
        (BOARD + 'text = "a"', 2, "a message needs sequence"),
        (GOOD + 'key = "k.pem"', 2, "key and user belong to a beacon"),
        (BOARD + 'beacon = "site.toml"\nsequence = 1\ntransmitter_id = 8', 2, "transmitter_id 8, but 7"),
        (BOARD + 'beacon = "site.toml"\nkey = "no.pem"\nsequence = 1', 3, "no.pem: cannot be read"),
    ],
)
def test_wrong_inventory_is_one_line(evlcp, tmp_path, text, code, expected):
    (tmp_path / "site.toml").write_text(SITE)
    file = tmp_path / "tunnel.toml"
    file.write_text(text)
    done = evlcp("board", "program", "--inventory", file)
    check_fault(done, code, f"evlcp: {file}: ", expected)
    assert done.err.count(f"{file}: ") == 1
    assert done.out == ""


def test_another_board_on_the_port_is_refused(evlcp, tmp_path):
    file = tmp_path / "tunnel.toml"
    file.write_text(GOOD + f'unique_id = "{"0" * 23}7"\n')
    done = evlcp("board", "program", "--inventory", file)
    assert done.code == 8
    assert "the inventory expects" in done.out
    wrong, other = file.read_text(), GOOD.replace('"a"', '"b"')
    file.write_text(wrong + other)
    done = evlcp("board", "monitor", "--inventory", file, "--interval", 0.05, "--count", 3)
    assert (done.code, done.out.count("b  ")) == (8, 3), "the other board is watched on"
    assert done.err.startswith("evlcp: a: native:: unique_id")
    file.write_text(ONLY)
    well(evlcp("board", "program", "--inventory", file))


def test_ctrl_c_ends_a_watch_at_once(evlcp, tmp_path, monkeypatch):
    (tmp_path / "one.toml").write_text(GOOD)
    main, name = threading.main_thread().ident, "firmware_host.commands.board._print_event"
    monkeypatch.setattr(name, lambda *_: signal.pthread_kill(main, signal.SIGINT))
    begin = time.monotonic()
    well(evlcp("board", "monitor", "--inventory", tmp_path / "one.toml", "--interval", 60))
    assert time.monotonic() - begin < 20
