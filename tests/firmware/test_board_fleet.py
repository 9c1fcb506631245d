"""Fleets: one inventory, many boards, some of which fail."""

import json
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from board_lines import Native

from evlcp_sdk.errors import ConfigError
from firmware_host.board.fleet import read_inventory
from firmware_host.errors import IncompatibleError

pytestmark = pytest.mark.usefixtures("compiler")


@pytest.fixture
def boards(tmp_path: Path) -> Iterator[list[str]]:
    """Native boards on unix sockets."""
    ports = [f"unix:{tmp_path / f'b{n}'}" for n in range(8)]
    emulated = [Native(port, unique_id=n) for n, port in enumerate(ports)]
    yield ports
    for board in emulated:
        board.end()


def inventory(path: Path, ports: list[str], extra: dict[int, str]) -> Path:
    tables = ["[defaults]\nrandom = 16"]
    for n, port in enumerate(ports):
        line = f'[[board]]\nid = "T{n:02}"\nport = "{port}"\nposition_m = [0.0, {n}.5, 5]\nseed = {n}\n'
        tables.append(line + extra.get(n, ""))
    path.write_text("\n".join(tables))
    return path


def test_a_boards_link(tmp_path: Path) -> None:
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "fast.toml").write_text("[air]\nchip_rate_hz = 20000.0\n")
    extra = {1: "link = {air = {pilot_every = 4, frames_per_packet = 8}}\n", 2: 'link = "links/fast.toml"\n'}
    file = inventory(tmp_path / "three.toml", ["unix:/a", "unix:/b", "unix:/c"], extra)
    banks = list(read_inventory(file).banks.values())
    assert [b.packet.pilot_every for b in banks] == [1, 4, 1]
    assert [b.packet.frames for b in banks] == [10, 8, 10]
    assert [b.chip_rate_hz for b in banks] == [10_000, 10_000, 20_000]
    inventory(file, ["unix:/a"], {0: "link = {air = {pilot_every = 0}}\n"})
    with pytest.raises(ConfigError, match=r"board\[0\]: link: air\.pilot_every = 0"):
        read_inventory(file)


def test_a_link_for_all_boards(tmp_path: Path) -> None:
    file = inventory(tmp_path / "two.toml", ["unix:/a", "unix:/b"], {1: "link = {}\n"})
    file.write_text(
        file.read_text().replace("random = 16", 'random = 16\nlink = {modulation = {id = "wh8"}}')
    )
    assert [bank.codebook.profile for bank in read_inventory(file).banks.values()] == ["wh8", "wh4x2"]


def test_a_payload_has_its_own_link(evlcp, tmp_path: Path) -> None:
    options = ("--set", "modulation.id=wh8", "--set", "air.chip_rate_hz=5000.0")
    assert evlcp("tx", "message", "--text", "a", "-o", tmp_path / "m.json", *options).code == 0
    file = tmp_path / "one.toml"
    entry = 'id = "a"\nport = "native:"\nposition_m = [0, 0, 0]\npayload = "m.json"\n'
    file.write_text("[[board]]\n" + entry)
    (bank,) = read_inventory(file).banks.values()
    assert (bank.codebook.profile, bank.chip_rate_hz) == ("wh8", 5000)
    file.write_text("[[board]]\n" + entry + "link = {air = {chip_rate_hz = 5000.0}}\n")
    with pytest.raises(IncompatibleError, match=r"board\[0\]: .*modulation\.id: sent with .*wh8"):
        read_inventory(file)


def test_six_of_eight(evlcp, boards: list[str], tmp_path: Path) -> None:
    # one port has nobody, one board cannot take the level
    silent = socket.socket(socket.AF_UNIX)
    silent.bind(str(tmp_path / "silent"))
    silent.listen()
    ports = [*boards[:3], f"unix:{tmp_path / 'silent'}", *boards[4:]]
    file = inventory(tmp_path / "tunnel.toml", ports, {5: "level_ma = 500\n"})
    done = evlcp("board", "program", "--inventory", file)
    silent.close()
    lines = done.out.splitlines()
    assert len(lines) == 8
    good = [x for x in lines if "programmed 5120 of 5120 bytes" in x]
    bad = sorted(x for x in lines if "FAILED" in x)
    assert (len(good), len(bad)) == (6, 2)
    assert bad[0].startswith("T03")
    assert "FAILED (4)" in bad[0]
    assert bad[1].startswith("T05")
    assert "FAILED (5)" in bad[1]
    assert "nearest value the board can take is 60" in bad[1]
    assert done.code == 4
    assert done.err.startswith(f"evlcp: {file}: 2 of 8 boards failed (T03, T05)")
    for n in (0, 7):
        same = evlcp("board", "verify", "--random", 16, "--seed", n, "--port", boards[n])
        assert same.code == 0, same.err

    # repaired, the next run does only what is missing
    file = inventory(tmp_path / "tunnel.toml", boards, {})
    again = evlcp("board", "program", "--inventory", file, "--json")
    assert again.code == 0, again.err
    rows = [json.loads(x) for x in again.out.splitlines()]
    assert sorted(r["id"] for r in rows if r["written_bytes"]) == ["T03", "T05"]
    assert all(r["ok"] for r in rows)
    assert len(rows) == 8
    assert rows[0]["position_m"][0] == 0.0


GOOD = 'id = "a"\nport = "native:"\nposition_m = [0, 0, 0]\nrandom = 1\n'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("board = 3", "expected at least one [[board]]"),
        ("[[board", "not TOML"),
        ("", "expected at least one [[board]]"),
        ("[other]\n", "other: unknown table"),
        ("defaults = 3\n[[board]]\n" + GOOD, "defaults = 3"),
        ("[[board]]\n" + GOOD.replace("random = 1", ""), "give payload or random or a message"),
        ("[[board]]\n" + GOOD + 'colour = "red"', 'board[0].colour = "red": unknown key'),
        ("[[board]]\n" + GOOD.replace("[0, 0, 0]", "[0, 0]"), "board[0].position_m = [0, 0]"),
        ("[[board]]\n" + GOOD.replace("[0, 0, 0]", "[0, 0, nan]"), "board[0].position_m.2"),
        ("[[board]]\n" + GOOD.replace("random = 1", 'random = "1"'), 'board[0].random = "1"'),
        ("[[board]]\n" + GOOD + 'watchdog = "sleep"', 'board[0].watchdog = "sleep"'),
        ("[[board]]\n" + GOOD + 'profile = "wh8"', 'board[0].profile = "wh8": unknown key'),
        (
            '[[board]]\nlink = {modulation = {id = "wh9"}}\n' + GOOD,
            "board[0]: link: no modulation algorithm named 'wh9'",
        ),
        ('[[board]]\nlink = "no.toml"\n' + GOOD, "no.toml: cannot be read"),
        (
            "[[board]]\nlink = {air = {chip_rate_hz = 2e6}}\n" + GOOD,
            "board[0]: the driver board cannot play this link: air",
        ),
        (
            "[[board]]\nlink = {air = {chip_rate_hz = 12.5}}\n" + GOOD,
            "air.chip_rate_hz = 12.5: a board takes whole",
        ),
        ("[[board]]\n" + GOOD + "[[board]]\n" + GOOD, 'board[1].id = "a", expected another than board[0]\'s'),
        ("[[board]]\n" + GOOD.replace("random = 1", 'payload = "no.json"'), "no.json: cannot be read"),
    ],
)
def test_wrong_inventory_is_one_line(evlcp, tmp_path: Path, text: str, expected: str) -> None:
    file = tmp_path / "tunnel.toml"
    file.write_text(text)
    done = evlcp("board", "program", "--inventory", file)
    assert done.code == (3 if "payload" in text else 2)
    assert done.out == ""
    assert done.err.startswith(f"evlcp: {file}: ")
    assert expected in done.err
    assert done.err.count("\n") == 1


def test_another_board_on_the_port_is_refused(evlcp, tmp_path: Path) -> None:
    file = tmp_path / "tunnel.toml"
    file.write_text("[[board]]\n" + GOOD + f'unique_id = "{"0" * 23}7"\n')
    done = evlcp("board", "program", "--inventory", file)
    assert done.code == 8
    assert "the inventory expects" in done.out
    file.write_text("[[board]]\n" + GOOD + f'unique_id = "{"0" * 24}"\n')
    assert evlcp("board", "program", "--inventory", file).code == 0
