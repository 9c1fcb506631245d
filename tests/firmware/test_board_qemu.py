"""The core as an ARM image in QEMU, on the mps2-an385: chip timing to the tick."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.air.codebook import Codebook
from firmware_host.board.bank import Bank, random_symbols
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.emulators.led_record import LedRecord
from firmware_host.emulators.processes import start_qemu
from firmware_host.protocol.generated.requests import StatusReply, StatusRequest

CHIPS = (5_000, 2_000)
VECTORS = Path(__file__).parents[1] / "vectors" / "air-vectors.json"


@pytest.fixture(autouse=True)
def _tools(needs) -> None:
    needs("qemu-system-arm", "arm-none-eabi-gcc")


def play(leds: Path, payload: Bank, chips: int) -> tuple[int, StatusReply]:
    """Play in QEMU while the host asks without pause; returns how often it asked, and the last status."""
    with Session(start_qemu(leds)) as session:
        board = Board(session)
        provision(board, payload, Settings())
        asked = 0
        last = board.status()

        def requests() -> Iterator[StatusRequest]:
            while last.chips_sent < chips:
                yield StatusRequest()

        def handle(request: object, outcome: object) -> None:
            nonlocal asked, last
            asked += 1
            last = session.checked(request, outcome)  # type: ignore[arg-type,assignment]

        session.run(requests(), handle)
        # ended while it plays, QEMU would cut the record off anywhere
        board.stop()
        board.wait_dark()
        return asked, last


def test_chips_are_exact_while_the_host_asks_without_pause(evlcp, tmp_path: Path, book: Codebook) -> None:
    file = tmp_path / "chips.npy"
    assert evlcp("tx", "frames", "--random", 8, "--seed", 5, "--chips", file).code == 0
    expected = np.load(file)
    symbols = random_symbols(8, 10, book, np.random.default_rng(5))
    hashes, least = set(), min(CHIPS)
    for n, count in enumerate(CHIPS):
        leds = tmp_path / f"leds{n}.bin"
        asked, status = play(leds, Bank.of_symbols(symbols, book), count)
        record = LedRecord.read(leds)
        assert record.cut_bytes == 0
        played = record.played()
        assert len(played) >= count
        chips, ticks = played.chips()[:count], played.ticks[:count]
        assert (played.numbers[:count] == np.arange(count)).all()
        assert (chips == np.resize(expected, (count, 16))).all()
        intervals_us = np.diff(ticks) / 25.0  # ticks of 25 MHz
        assert (intervals_us == 100.0).all()
        # How often depends on what else the machine does.
        assert asked > count // 100
        assert status.crc_errors == status.framing_errors == status.overflow_errors == 0
        assert status.lateness_max_ticks < 250
        hashes.add(
            hashlib.sha256((ticks - ticks[0])[:least].tobytes() + played.rows[:least].tobytes()).hexdigest()
        )
    assert len(hashes) == 1


def test_recorded_stream_is_the_air_vectors(evlcp, tmp_path: Path, book: Codebook) -> None:
    example = json.loads(VECTORS.read_text())["example_packet"]
    leds = tmp_path / "leds.bin"
    play(leds, Bank.of_symbols([example["symbols"]], book), 200)
    out = tmp_path / "chips.npy"
    assert evlcp("board", "leds", leds, "--chips", out).code == 0
    chips, ticks = np.load(out), np.load(tmp_path / "chips.ticks.npy")
    masks = [f"{int(''.join(map(str, row)), 2):04x}" for row in chips[:90]]
    assert masks == example["cluster_masks"]
    assert (np.diff(ticks) == 2500).all()
    (tmp_path / "symbols.json").write_text(json.dumps([example["symbols"]]))
    frames = tmp_path / "frames.npy"
    link = ("--set", "air.frames_per_packet=2")
    assert evlcp("tx", "frames", tmp_path / "symbols.json", "--chips", frames, *link).code == 0
    assert (np.load(frames) == chips[:90]).all()
