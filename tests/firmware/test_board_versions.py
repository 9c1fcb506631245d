"""Hosts and firmware of two minor versions: today's and one of tomorrow, with fields and a message more."""

import copy
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_lines import board_on

import firmware_host
from evlcp_sdk.air.codebook import Codebook
from firmware_host import build
from firmware_host.board.bank import Bank, random_symbols
from firmware_host.board.board import Settings, provision
from firmware_host.emulators import simulated
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.protocol import generate
from firmware_host.protocol.generated.requests import MINOR, State

LATER = MINOR + 1


def later(name: str, type_: str = "u32") -> dict[str, Any]:
    return {"name": name, "type": type_, "doc": "Of tomorrow.", "since": LATER}


@pytest.fixture(scope="module")
def definition() -> dict[str, Any]:
    """The protocol of tomorrow: HELLO, CONFIGURE and STATUS are longer."""
    text = (generate.HERE / "protocol" / "protocol.toml").read_text()
    table = copy.deepcopy(tomllib.loads(text))
    table["protocol"]["minor"] = LATER
    for message in table["message"]:
        if message["name"] in ("hello", "configure"):
            message["request"].append(later("later_wish", "u16"))
        if message["name"] in ("hello", "configure", "status"):
            message["reply"] += [later("later_bytes", "bytes[3]"), later("later_numbers", "u16[2]")]
    return table


def test_todays_host_and_tomorrows_firmware(
    definition: dict[str, Any], tmp_path: Path, book: Codebook, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = tmp_path / "firmware"
    shutil.copytree(build.FIRMWARE, tree)
    (tree / "generated" / "protocol.h").write_text(generate.render("protocol.h", definition))
    done = subprocess.run(["make", "-s", "-C", str(tree), f"BUILD={tmp_path}", "library"], check=False)
    assert done.returncode == 0
    monkeypatch.setattr(build, "native_library", lambda: tmp_path / "libevlcp-board.so")
    library = simulated._library.__wrapped__()
    monkeypatch.setattr(simulated, "_library", lambda: library)

    board = board_on(SimulatedLine(SimulatedBoard()))
    assert board.about.minor == LATER
    assert board.session.client.minor == MINOR
    bank = Bank.of_symbols(random_symbols(2, 10, book, np.random.default_rng(1)), book)
    provision(board, bank, Settings(level_ma=7))
    status = board.status()
    assert board.holds(bank, status)
    assert (status.state, status.level_ma) == (State.PLAYING, 7)
    assert board.read(status.active_bank, 0, len(bank.content)) == bank.content


HOST = """
import sys
import numpy as np
import firmware_host
from evlcp_sdk.link.resolve import load_link
from firmware_host.board.bank import Bank, random_symbols
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import IncompatibleError
from firmware_host.protocol.generated import requests as r
from firmware_host.protocol.client import Timing

assert firmware_host.__file__.startswith(sys.argv[1]), firmware_host.__file__
board = Board(Session(SimulatedLine(SimulatedBoard()), Timing()))
assert board.about.minor == board.session.client.minor == r.MINOR - 1
assert (board.about.later_bytes, board.about.later_numbers) == (bytes(3), (0, 0))
book = load_link().codebook
bank = Bank.of_symbols(random_symbols(2, 10, book, np.random.default_rng(1)), book)
provision(board, bank, Settings(level_ma=7))
status = board.status()
assert board.holds(bank, status) and status.level_ma == 7 and status.later_numbers == (0, 0)
try:
    board.session.call(r.ConfigureRequest(10000, 0, 10, 1, 0, 0, later_wish=5))
except IncompatibleError as fault:
    print(fault)
"""


def test_tomorrows_host_and_todays_firmware(definition: dict[str, Any], tmp_path: Path) -> None:
    package = Path(firmware_host.__file__).parent
    shutil.copytree(package, tmp_path / "firmware_host", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "firmware_host" / "protocol" / "generated" / "requests.py").write_text(
        generate.render("requests.py", definition)
    )
    paths = [str(tmp_path), str(package.parent), str(package.parent / "plugins"), *sys.path]
    done = subprocess.run(
        [sys.executable, "-c", HOST, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(p for p in paths if p)},
    )
    assert done.returncode == 0, done.stderr
    assert "CONFIGURE with later_wish is not in its protocol" in done.stdout
    assert "update the firmware" in done.stdout
