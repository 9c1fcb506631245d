"""The ARM images in QEMU: chip timing on the mps2-an385, register writes on the netduinoplus2."""

import hashlib
import json
import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.air.codebook import Codebook
from firmware_host import build
from firmware_host.board.bank import Bank, random_symbols
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.emulators.led_record import LedRecord
from firmware_host.emulators.processes import bound, start_qemu
from firmware_host.errors import RefusedError
from firmware_host.ports.transport import SocketTransport
from firmware_host.protocol.generated.requests import BoardFault, State, StatusReply, StatusRequest

pytestmark = pytest.mark.usefixtures("compiler")

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


# -- the real part, as far as QEMU goes


class Netduino:
    """The STM32F405 image in QEMU: its line, its registers, and the log of writes QEMU has no device for."""

    def __init__(self, folder: Path) -> None:
        self.log = folder / "unimplemented.log"
        self.process = subprocess.Popen(
            bound(
                [
                    *("qemu-system-arm", "-M", "netduinoplus2", "-display", "none", "-nodefaults"),
                    *("-kernel", str(build.arm_image("stm32f405-netduinoplus2"))),
                    *("-serial", f"unix:{folder / 'uart'},server=on,wait=off"),
                    *("-monitor", f"unix:{folder / 'monitor'},server=on,wait=off"),
                    *("-d", "unimp,guest_errors", "-D", str(self.log)),
                ]
            ),
            stdin=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self.line = self.connect(folder / "uart")
        self.monitor = self.connect(folder / "monitor")

    def connect(self, path: Path) -> SocketTransport:
        from firmware_host.errors import NoBoardError

        for _ in range(200):
            try:
                return SocketTransport.connect(f"unix:{path}")
            except NoBoardError:
                time.sleep(0.05)
        raise AssertionError("QEMU does not come up")

    def register(self, address: int) -> int:
        self.monitor.write(f"xp /1wx {address:#x}\n".encode())
        text, end = "", time.monotonic() + 10.0
        while not (found := re.search(rf"{address:016x}: 0x([0-9a-f]{{8}})", text)):
            assert time.monotonic() < end, text
            text += self.monitor.read(0.5).decode()
        return int(found[1], 16)

    def writes(self) -> list[tuple[str, int, int]]:
        pattern = r"^(.+): unimplemented device write \(size 4, offset (0x[0-9a-f]+), value (0x[0-9a-f]+)\)"
        found = re.findall(pattern, self.log.read_text(), re.M)
        return [(name, int(offset, 16), int(value, 16)) for name, offset, value in found]

    def close(self) -> None:
        self.line.close()
        self.monitor.close()
        self.process.terminate()
        self.process.wait()


def test_stm32f405_register_writes(tmp_path: Path, book: Codebook) -> None:
    netduino = Netduino(tmp_path)
    try:
        board = Board(Session(netduino.line))
        assert board.about.hal.rstrip(b"\0") == b"stm32f405"
        assert board.about.tick_hz == 14_000_000
        boot = netduino.writes()

        def at(device: str, offset: int, writes: list[tuple[str, int, int]]) -> list[int]:
            return [v for d, o, v in writes if d == device and o == offset]

        # dark comes first: output enable high before its pin drives, and nothing lights a LED before START
        first_gpio = next(w for w in boot if w[0].startswith("GPIO"))
        assert first_gpio == ("GPIOB", 0x18, 1)
        assert 0x10000 not in at("GPIOB", 0x18, boot)
        # crystal, PLL 8 MHz / 8 * 336 / 2, clock security, five wait states, APB1 / 4, APB2 / 2, switch
        assert at("RCC", 0x00, boot) == [0x00010000, 0x01000000, 0x00080000]
        assert at("RCC", 0x04, boot) == [7 << 24 | 1 << 22 | 336 << 6 | 8]
        assert at("Flash Int", 0x00, boot) == [0x705]
        assert at("RCC", 0x08, boot)[0] == 5 << 10 | 4 << 13
        assert at("RCC", 0x08, boot)[1] & 3 == 2
        # TIM2 on PA0, SPI1 and TIM3 on PA5 PA6 PA7, USART1 on PA9 PA10, DAC on PA4
        assert at("GPIOA", 0x20, boot) == [0x52500001]
        assert at("GPIOA", 0x24, boot) == [0x00000770]
        assert at("GPIOA", 0x00, boot)[0] == 2 | 3 << 8 | 2 << 10 | 2 << 12 | 2 << 14 | 2 << 18 | 2 << 20
        # devices that QEMU has: 1 Mbit/s, SPI master 16 bits at 10.5 MHz
        assert netduino.register(0x40011008) == 84
        assert netduino.register(0x40013000) == 1 << 11 | 1 << 9 | 1 << 8 | 1 << 6 | 2 << 3 | 1 << 2

        board.level(30)
        assert at("DAC", 0x08, netduino.writes())[-1] == 30 * 4095 // 60
        with pytest.raises(RefusedError, match="nearest value the board can take is 60"):
            board.level(61)

        payload = Bank.of_symbols(random_symbols(2, 10, book, np.random.default_rng(0)), book)
        before = len(netduino.writes())
        provision(board, payload, Settings())
        # QEMU has no TIM1: no chip comes, and the board notices
        end = time.monotonic() + 10.0
        while (status := board.status()).state == State.PLAYING:
            assert time.monotonic() < end
        assert (status.state, status.faults) == (State.FAULT, BoardFault.CHIP_LOST)
        run = netduino.writes()[before:]
        ends = next(i for i, w in enumerate(run) if w[1:] == (0x18, 1) and w[0] == "GPIOB")
        run, fault = run[:ends], run[ends:]
        assert 0 in at("DMA2", 0x88, fault)
        assert 0x10000 not in at("GPIOB", 0x18, fault)
        timer = [(o, v) for d, o, v in run if d == "timer[0]" or d.lower().startswith("tim")]
        dma = [(o, v) for d, o, v in run if d == "DMA2"]
        assert dict(dma)[0x90] == 0x4001300C  # to SPI1's data register
        assert dict(dma)[0x8C] == 12  # two rows of six words
        control = [v for o, v in dma if o == 0x88]
        assert control[0] == (
            6 << 25 | 3 << 16 | 1 << 13 | 1 << 11 | 1 << 10 | 1 << 8 | 1 << 6 | 1 << 4 | 1 << 3
        )
        # enabled last, with the interrupts of errors; QEMU reads zeros
        assert control[-1] == 1 << 2 | 1 << 1 | 1
        assert dict(dma)[0x9C] == 1 << 7
        assert 0x20000000 <= dict(dma)[0x94] < 0x20020000
        # TIM1: a slot of 2800 cycles (six a chip of 100 us), update -> DMA, enable as trigger; started last
        assert (0x2C, 2799) in timer
        assert (0x0C, 0x100) in timer
        assert (0x04, 0x10) in timer
        assert timer[-1] == (0x00, 1)
        last = [i for i, w in enumerate(run) if w[0] == "DMA2"][-1]
        starts = [i for i, w in enumerate(run) if (w[1], w[2]) == (0x00, 1) and w[0] != "DMA2"]
        assert starts[-1] > last
        # TIM3: a chip at 84 MHz, latch 1 us, started by TIM1
        assert netduino.register(0x4000042C) == 8399
        assert netduino.register(0x40000434) == 84
        assert netduino.register(0x40000408) == 6
        # the two rows begin dark, and the outputs stay off until a dark row is latched
        words = dict(dma)[0x94]
        assert [netduino.register(words + 4 * i) for i in range(6)] == [0] * 6
        assert 0x10000 not in at("GPIOB", 0x18, run)
        board.blank()
        off = netduino.writes()[before + len(run) :]
        assert 1 in at("GPIOB", 0x18, off)
        assert 0 in [v for d, o, v in off if d == "DMA2" and o == 0x88]
    finally:
        netduino.close()
