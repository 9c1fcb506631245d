"""Links that are not built in, on every board: characters and 4-PPM, to the chip, and to the text."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_lines import board_on
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link, load_link
from firmware_host import build
from firmware_host.board.bank import bank_of, random_symbols
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import RefusedError
from firmware_host.protocol.client import Timing
from firmware_host.protocol.generated.requests import Watchdog

pytestmark = pytest.mark.usefixtures("compiler")

Evlcp = Callable[..., Any]

LAMP = ["bar.rows=6", "bar.columns=1", "bar.cluster_rows=6", "bar.cluster_columns=1", "framing.id=uart"]
SERIAL = [*LAMP, "framing.data_bits=7", "framing.parity=even", "framing.stop_bits=2"]
TURNED = [*LAMP, "framing.parity=odd", "framing.idle=off", "framing.first_bit=highest"]
PULSES = ["modulation.id=ppm", "bar.rows=48"]


def serial_chips(text: bytes) -> list[int]:
    """7E2 as a serial port sends it behind a pause of 16 bits: marks are ones."""
    bits = [1] * 16
    for byte in text:
        data = [byte >> k & 1 for k in range(7)]
        bits += [0, *data, sum(data) % 2, 1, 1]
    return bits


def turned_chips(text: bytes) -> list[int]:
    """8O1, highest bit first, by an LED that is dark in pauses: a start bit lights it."""
    bits = [1] * 16
    for byte in text:
        data = [byte >> k & 1 for k in reversed(range(8))]
        bits += [0, *data, 1 - sum(data) % 2, 1]
    return [1 - bit for bit in bits]


def pulse_chips(symbols: NDArray[np.int64], link: Link) -> NDArray[np.uint8]:
    """4-PPM: in each four chips one is lit, and its place says two bits."""
    clusters = symbols.shape[1]
    rows = [[chip] * clusters for chip in link.codebook.preamble.tolist()]
    for frame in symbols:
        rows += link.codebook.pilots.T.tolist()
        for first in (4, 2, 0):
            places = frame >> first & 3
            rows += [[int(place == slot) for place in places] for slot in range(4)]
    return np.array(rows, np.uint8)


def packet_of(kind: str) -> tuple[Link, NDArray[np.int64], NDArray[np.uint8]]:
    """A link, a packet's symbols, and the chips of its LEDs, (chips, LEDs), by the test's own encoders."""
    text = b"Tempo 30!"
    if kind == "4-PPM":
        link = load_link(overrides=[*PULSES, "air.frames_per_packet=3"])
        symbols = random_symbols(1, 3, link.codebook, np.random.default_rng(2))[0]
        return link, symbols, np.repeat(pulse_chips(symbols, link), 6, axis=1)
    chips = serial_chips(text) if kind == "7E2" else turned_chips(text)
    link = load_link(overrides=[*(SERIAL if kind == "7E2" else TURNED), f"air.frames_per_packet={len(text)}"])
    return link, np.array([[byte] for byte in text]), np.repeat(np.array(chips, np.uint8)[:, None], 6, axis=1)


def on_the_host(link: Link, symbols: NDArray[np.int64]) -> NDArray[np.uint8]:
    device = SimulatedBoard()
    provision(board_on(SimulatedLine(device)), bank_of(symbols[None], link), Settings())
    device.run(100_000)
    return device.records().played().chips(None)


def on_the_model(link: Link, symbols: NDArray[np.int64]) -> NDArray[np.uint8]:
    """The image as it is flashed; rows as they are latched, from START on."""
    pytest.importorskip("unicorn", reason="unicorn missing: pip install --group dev installs it")
    from tests.models.stm32 import ModelLine, Stm32

    chip = Stm32(build.arm_image("stm32f405"))
    chip.run(15_000)
    board = Board(Session(ModelLine(chip), Timing(latency_s=0.02)))
    provision(board, bank_of(symbols[None], link), Settings(start=False))
    begin = len(chip.drivers.log)
    board.start()
    chip.run(15_000)
    rows = [shown.row for shown in chip.drivers.log[begin:] if shown.latched and not shown.dark]
    assert rows[0] == 0, "the latch closes over dark before the first chip"
    return np.array([[int(bit) for bit in f"{row:096b}"] for row in rows[1:]], np.uint8)


BOARDS = {"native": on_the_host, "stm32": on_the_model}


@pytest.mark.parametrize("kind", ["7E2", "8O1, turned", "4-PPM"])
@pytest.mark.parametrize("board", BOARDS)
def test_every_board_plays_the_chips_of_the_link(board: str, kind: str, needs: Callable[..., None]) -> None:
    if board != "native":
        needs("cc", "make", "arm-none-eabi-gcc")
    link, symbols, told = packet_of(kind)
    rows = BOARDS[board](link, symbols)
    leds = told.shape[1]
    assert len(rows) > len(told), "more than a packet"
    assert not rows[:, leds:].any()
    assert (rows[:, :leds] == np.resize(told, (len(rows), leds))).all()


@pytest.mark.parametrize(
    "settings",
    [[*SERIAL, "air.frames_per_packet=80"], [*PULSES, "air.frames_per_packet=20"]],
    ids=["7E2", "4-PPM"],
)
def test_a_text_by_a_board_and_a_camera(settings: list[str], evlcp: Evlcp, tmp_path: Path) -> None:
    options = [part for one in settings for part in ("--set", one)]
    done = evlcp("loop", "--text", "Tempo 30!", "--seed", 2, "--json", "-o", tmp_path, *options)
    assert (done.code, done.err) == (0, ""), done.err
    said = {step.pop("step"): step for step in map(json.loads, done.out.splitlines())}
    assert said["text"]["texts"] == ["Tempo 30!"]
    assert said["receiver"]["bit_errors"] == 0
    assert said["receiver"]["warnings"] == []
    assert (
        said["receiver"]["frames_sent"] - 1 <= said["receiver"]["frames"] <= said["receiver"]["frames_sent"]
    )


@pytest.mark.parametrize("kind", ["7E2", "8O1, turned"])
def test_a_stream_rests_while_there_is_nothing_to_send(kind: str) -> None:
    """The board's idle pattern would be characters: packets of pause keep it from being shown."""
    device = SimulatedBoard()
    link, symbols, told = packet_of(kind)
    with board_on(SimulatedLine(device)).stream(link) as stream:
        stream.wait(0.05)
        assert stream.send(symbols) == 0
        stream.wait(0.1)
        assert [stream.send(symbols) for _ in range(3)] == [1, 2, 3]
        assert stream.pauses > 5
    assert (stream.underruns, stream.sent) == (0, 4)
    chips = device.records().played().chips(link.bar.led_clusters())
    packets = chips.reshape(-1, len(told))
    sent = (packets == told[:, 0]).all(1)
    assert (packets[~sent] == told[0, 0]).all(), "the level of a pause"
    assert sent.sum() == 4
    assert np.flatnonzero(sent)[0] >= 3, "it rests from the first chip on"
    assert sent[-3:].all(), "behind one another"
    assert not device.shown().any()


def test_what_would_be_characters_is_refused() -> None:
    device = SimulatedBoard()
    link, symbols, _ = packet_of("7E2")
    board = board_on(SimulatedLine(device))
    bank = bank_of(symbols[None], link)
    with pytest.raises(
        ConfigError, match="watchdog = idle: LEDs that are on for a chip of two say something"
    ):
        provision(board, bank, Settings(watchdog=Watchdog.IDLE))
    provision(board, bank, Settings(watchdog=Watchdog.DARK, duty_limit=0.8, start=False))
    with pytest.raises(RefusedError, match="a pause of this link has a LED on for 1 of the time, the duty"):
        board.stream(link)
    turned, symbols, _ = packet_of("8O1, turned")
    with board.stream(turned) as stream:
        stream.send(symbols)
