"""The transmitter's page holds: its commands run, its inventory is valid, its tables are complete."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from firmware_host.board.fleet import read_inventory

PAGE = (Path(__file__).parents[2] / "docs" / "transmitter.md").read_text()


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("block", blocks("console"), ids=["tx", "messages", "changing", "board", "others"])
def test_commands_run(evlcp, block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for line in block.splitlines():
        done = evlcp(*line.removeprefix("$ evlcp ").split())
        assert (done.code, done.err) == (0, ""), line


def test_inventory_is_valid(tmp_path):
    pytest.importorskip("cryptography", reason="the extra sign is not installed")
    from evlcp_sdk.air.signing import make_key

    (tmp_path / "t01.json").write_text(str([[[0] * 16] * 10]))
    (tmp_path / "link.toml").write_text("[air]\npilot_every = 4\n")
    (tmp_path / "site.toml").write_text(
        "[[bar]]\ntransmitter_id = 3\nlatitude_deg = 35.0\nlongitude_deg = 137.0\nheight_m = 50.0\n"
    )
    make_key(tmp_path / "private.pem")
    (tmp_path / "tunnel.toml").write_text(blocks("toml")[0])
    entries, banks = read_inventory(tmp_path / "tunnel.toml")
    # beacon, signature (two packets) and text
    assert [(e.id, e.level_ma, banks[e.id].packets) for e in entries] == [
        ("T01", 20, 1),
        ("T02", 20, 16),
        ("T03", 20, 4),
    ]
    assert [bank.link.packet.pilot_every for bank in banks.values()] == [1, 4, 4]


@pytest.mark.parametrize("block", blocks("python"))
def test_code_runs(block):
    exec(compile(block, "docs/transmitter.md", "exec"), {})


def test_the_delays_of_streams_are_the_benchmarks():
    """One row of the table measured again; the others are of the same function."""
    from benchmarks.board import measure_stream

    m = measure_stream(0.016, 4, 0.1, packets=5)
    (row,) = re.findall(r"^\| 16 ms \| alone \| ([0-9.]+) \| ([0-9.]+) \|", PAGE, re.MULTILINE)
    assert float(row[0]) == pytest.approx(np.median(m.delays_ms), abs=0.2)
    assert float(row[1]) == pytest.approx(m.delays_ms.max(), abs=0.2)


def test_file_of_symbols_is_one(evlcp, tmp_path):
    (tmp_path / "s.json").write_text(blocks("json")[0])
    assert evlcp("tx", "frames", tmp_path / "s.json").code == 0


def test_every_command_and_every_key_of_an_inventory_is_reported():
    from firmware_host.board.fleet import FleetEntry
    from firmware_host.commands.board import app

    table = PAGE.split("| command | does |")[1].split("\n\n")[0]
    names = [command.name or command.callback.__name__ for command in app.registered_commands]
    assert [name for name in names if f"`{name}" not in table] == []
    section = PAGE.split("## Many boards")[1].split("## Emulated")[0]
    assert [field.name for field in fields(FleetEntry) if field.name not in section] == []
