"""Bars in step: START at a clock and at a pulse, with crystals that differ; the real image on the model."""

from collections.abc import Callable

import numpy as np
import pytest
from board_lines import board_on
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import Codebook
from firmware_host import build
from firmware_host.board.bank import Bank, random_symbols
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.board.step import start_together, wait_for_pulse
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import LineError, RefusedError
from firmware_host.protocol.client import Timing
from firmware_host.protocol.generated.requests import BoardFault, State

pytestmark = pytest.mark.usefixtures("compiler")

CHIP_US = 100.0


def crystal(
    book: Codebook, ppm: float, pulse_hz: int = 1, first_s: float = 0.5
) -> tuple[SimulatedBoard, Board]:
    """A programmed board whose crystal is off by `ppm`, with pulses of a true clock."""
    device = SimulatedBoard()
    rate = 1 + ppm * 1e-6
    device.set_pulse(1e7 * rate / pulse_hz, 1e7 * rate * first_s)
    board = board_on(SimulatedLine(device))
    bank = Bank.of_symbols(random_symbols(2, 10, book, np.random.default_rng(0)), book)
    provision(board, bank, Settings(start=False))
    return device, board


def times_us(device: SimulatedBoard, ppm: float) -> NDArray[np.float64]:
    """True times of the chips played."""
    return device.records().played().ticks / 10 / (1 + ppm * 1e-6)


def test_two_boards_that_are_60_ppm_apart_stay_within_a_tenth_of_a_chip_for_a_minute(book: Codebook) -> None:
    found = []
    for ppm in (30.0, -30.0):
        device, board = crystal(book, ppm)
        device.run(1_700_000)
        assert start_together([board]) == [5]
        assert board.status().state == State.WAITING
        device.records()
        device.run(64_000_000)
        assert (board.status().state, board.status().faults) == (State.PLAYING, 0)
        found.append(times_us(device, ppm)[:600_000])
    apart = np.abs(found[0] - found[1])
    assert len(apart) == 600_000
    assert apart.max() <= 0.1 * CHIP_US
    assert apart.max() < 1  # us
    # by their own crystals they would be 36 chips apart by then
    assert np.abs(np.diff(found[0]) - CHIP_US).max() < 1
    # the first chip is that of the pulse: 0.5 s and four more, and a chip
    assert abs(found[0][0] - (4.5e6 + CHIP_US)) < 1


def test_start_at_a_clock(book: Codebook) -> None:
    device, board = crystal(book, 0.0)
    status = board.status()
    board.start(at_clock=status.clock + 300_000)
    assert board.status().state == State.WAITING
    device.records()
    device.run(100_000)
    played = device.records().played()
    assert played.ticks[0] == status.clock + 300_000 + 1_000
    board.blank()
    # STOP before the moment: it does not come
    board.start(at_clock=board.status().clock + 300_000)
    board.stop()
    device.run(100_000)
    assert not len(device.records().played())
    assert board.status().state == State.DARK


def test_a_pulse_that_does_not_come_is_told_and_the_board_stopped(book: Codebook) -> None:
    device, board = crystal(book, 0.0)
    device.set_pulse(0, 0)
    assert start_together([board]) == [3]
    with pytest.raises(
        LineError,
        match=r"has not come in 2 s \(pulses since reset: simulated: has counted 0\): check the wire",
    ):
        wait_for_pulse([board], 2.0)
    assert board.status().state == State.DARK
    device.set_pulse(1e6, 1e5)
    device.run(500_000)
    start_together([board], 10)
    wait_for_pulse([board], 2.0)
    assert board.status().state == State.PLAYING


def test_pulses_that_cease_are_named_and_playing_goes_on(book: Codebook) -> None:
    device, board = crystal(book, 20.0)
    device.run(1_700_000)
    start_together([board])
    device.run(5_000_000)
    assert board.status().faults == 0
    device.set_pulse(0, 0)
    device.records()
    device.run(3_000_000)
    status = board.status()
    assert (status.state, status.faults) == (State.PLAYING, BoardFault.PULSE)
    times = times_us(device, 20.0)
    assert np.abs(np.diff(times) - CHIP_US).max() < 1
    board.blank()
    board.start()
    assert board.status().faults == 0


def test_what_cannot_be_is_refused(book: Codebook) -> None:
    device, board = crystal(book, 0.0)
    with pytest.raises(RefusedError, match="nearest value the board can take is 3"):
        board.start(at_pulse=2)
    device.run(3_000_000)
    pulses = board.status().pulses
    with pytest.raises(RefusedError, match=f"nearest value the board can take is {pulses + 3}"):
        board.start(at_pulse=pulses)
    with pytest.raises(RefusedError, match="OUT_OF_RANGE"):
        board.start(at_pulse=pulses + 2, pulse_hz=3)  # 10 000 chips a second
    board.start()
    with pytest.raises(RefusedError, match="BUSY"):
        board.start(at_pulse=pulses + 5)
    assert board.status().state == State.PLAYING
    # one that refuses stops the others
    other, ready = crystal(book, 0.0)
    del other
    with pytest.raises(RefusedError, match="BUSY"):
        start_together([ready, board])
    assert ready.status().state == State.DARK


def test_the_stm32_keeps_in_step(book: Codebook, needs: Callable[..., None]) -> None:
    """Crystals 600 ppm apart: in 35 ms they drift by 0.21 chips, in step they stay within 0.03."""
    needs("make", "arm-none-eabi-gcc")
    pytest.importorskip("unicorn", reason="unicorn missing: pip install --group dev installs it")
    from tests.models.stm32 import UNIT_HZ, US, Dma, ModelLine, Stm32

    pulse_hz, chips = 100, 350
    found = []
    for ppm in (300, -300):
        rate = 1 + ppm * 1e-6
        chip = Stm32(build.arm_image("stm32f405"))
        for n in range(1, 40):
            chip.pulse_at(n * UNIT_HZ / pulse_hz * rate)
        chip.run(22_000)
        board = Board(Session(ModelLine(chip), Timing(latency_s=0.02)))
        bank = Bank.of_symbols(random_symbols(1, 4, book, np.random.default_rng(0)), book)
        provision(board, bank, Settings(start=False))
        status = board.status()
        assert abs(status.pulse_clocks - 840_000 * rate) < 2
        pulse = status.pulses + 2
        board.start(pulse, pulse_hz)
        assert board.status().state == State.WAITING
        begin = len(chip.drivers.log)
        chip.run(20_000 + 100 * chips)
        status = board.status()
        assert (status.state, status.faults) == (State.PLAYING, 0)
        assert chip.longest[16 + Dma.IRQ] < 30 * US
        latched = [s.time for s in chip.drivers.log[begin:] if s.latched and not s.dark]
        found.append((np.array(latched[:chips]) / US / rate) - pulse * 1e6 / pulse_hz)
    apart = np.abs(found[0] - found[1])
    assert len(apart) == chips
    assert apart.max() <= 0.03 * CHIP_US
    for times in found:
        assert np.abs(np.diff(times) - CHIP_US).max() < 3
        assert np.abs(times - times[0] - CHIP_US * np.arange(chips)).max() < 3
