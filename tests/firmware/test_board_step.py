"""Bars in step: START at a clock and at a pulse, with crystals that differ; the real image on the model."""

import numpy as np
import pytest
from board_lines import board_on, some_bank, state_of

from firmware_host.board.board import Settings, provision
from firmware_host.board.step import start_together
from firmware_host.emulators.simulated import SimulatedBoard
from firmware_host.errors import RefusedError
from firmware_host.protocol.generated.requests import BoardFault, State

CHIP_US = 100.0


def crystal(ppm=0.0):
    """A programmed board whose crystal is off by `ppm`, with a pulse of a true clock each second."""
    device = SimulatedBoard()
    rate = 1 + ppm * 1e-6
    device.bench.pulse_period, device.bench.pulse_next = 1e7 * rate, 1e7 * rate * 0.5
    board = board_on(device)
    provision(board, some_bank(2), Settings(start=False))
    return device, board


def times_us(device, ppm):
    """True times of the chips played."""
    return device.take_led_record().select_chips().ticks / 10 / (1 + ppm * 1e-6)


def test_boards_60_ppm_apart_stay_within_a_hundredth_of_a_chip_until_pulses_cease():
    found = []
    for ppm in (30.0, -30.0):
        device, board = crystal(ppm)
        device.run(1_700_000)
        assert start_together([board]) == [5]
        assert board.status().state == State.WAITING
        device.take_led_record()
        device.run(24_000_000)
        assert state_of(board) == (State.PLAYING, 0)
        found.append(times_us(device, ppm)[:200_000])
        # without pulses it is named, and playing goes on by its own crystal
        device.bench.pulse_period, device.bench.pulse_next = 0, 0
        device.run(3_000_000)
        assert state_of(board) == (State.PLAYING, BoardFault.PULSE)
        assert np.abs(np.diff(times_us(device, ppm)) - CHIP_US).max() < 1
        board.blank()
        board.start()
        assert board.status().faults == 0
    apart = np.abs(found[0] - found[1])
    assert len(apart) == 200_000
    # by their own crystals they would be 12 chips apart by then
    assert apart.max() < 0.01 * CHIP_US
    assert np.abs(np.diff(found[0]) - CHIP_US).max() < 1
    # the first chip is that of the pulse: 0.5 s and four more, and a chip
    assert abs(found[0][0] - (4.5e6 + CHIP_US)) < 1


def test_start_at_a_clock():
    device, board = crystal()
    clock = board.status().clock
    board.start(at_clock=clock + 300_000)
    assert board.status().state == State.WAITING
    device.take_led_record()
    device.run(100_000)
    assert device.take_led_record().select_chips().ticks[0] == clock + 300_000 + 1_000
    board.blank()
    # STOP before the moment: it does not come
    board.start(at_clock=board.status().clock + 300_000)
    board.stop()
    device.run(100_000)
    assert not len(device.take_led_record().select_chips())
    assert board.status().state == State.DARK
    # nor does a pulse that is farther away than half the range of the clock
    device.run(2_500_000)
    board.start(at_pulse=board.status().pulses + 300)
    device.run(1_000_000)
    assert board.status().state == State.WAITING


def test_what_cannot_be_is_refused():
    device, board = crystal()
    for pulses in (0, 3):
        device.run(pulses * 1_000_000)
        assert board.status().pulses == pulses
        with pytest.raises(RefusedError, match=f"nearest value the board can take is {pulses + 3}"):
            board.start(at_pulse=pulses or 2)
    with pytest.raises(RefusedError, match="OUT_OF_RANGE"):
        board.start(at_pulse=5, pulse_hz=3)  # 10 000 chips a second
    board.start()
    with pytest.raises(RefusedError, match="BUSY"):
        board.start(at_pulse=8)
    assert board.status().state == State.PLAYING
    # one that refuses stops the others
    _other, ready = crystal()
    with pytest.raises(RefusedError, match="BUSY"):
        start_together([ready, board])
    assert ready.status().state == State.DARK


def test_the_stm32_keeps_in_step(stm32):
    """Crystals 600 ppm apart: in 10 ms they drift by 0.06 chips, in step they stay within 0.03."""
    from tests.models.stm32 import UNIT_HZ, US, Dma

    pulse_hz, chips = 400, 100
    found = []
    for ppm in (300, -300):
        rate = 1 + ppm * 1e-6
        chip, board = stm32(pulses=[n * UNIT_HZ / pulse_hz * rate for n in range(1, 80)])
        provision(board, some_bank(), Settings(start=False))
        status = board.status()
        assert abs(status.pulse_clocks - 84_000_000 / pulse_hz * rate) < 2
        pulse = status.pulses + 3
        board.start(pulse, pulse_hz)
        assert board.status().state == State.WAITING
        begin = len(chip.drivers.log)
        chip.run(8_000 + 100 * chips)
        assert state_of(board) == (State.PLAYING, 0)
        assert chip.longest[16 + Dma.IRQ] < 30 * US
        latched = [s.time for s in chip.drivers.log[begin:] if s.latched and not s.dark]
        found.append((np.array(latched[:chips]) / US / rate) - pulse * 1e6 / pulse_hz)
    apart = np.abs(found[0] - found[1])
    assert len(apart) == chips
    assert apart.max() <= 0.03 * CHIP_US
    for times in found:
        assert np.abs(np.diff(times) - CHIP_US).max() < 3
        assert np.abs(times - times[0] - CHIP_US * np.arange(chips)).max() < 3
