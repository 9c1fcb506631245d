"""The STM32F405 image as it is flashed, on a model of the part: every LED, chip by chip, and what fails."""

import subprocess

import numpy as np
import pytest
from board_lines import board_link, state_of, symbols_of, well
from test_board_cli import Emulated

from firmware_host import build
from firmware_host.board.bank import Bank, make_bank, symbol_chips
from firmware_host.board.board import Settings, provision
from firmware_host.errors import RefusedError
from firmware_host.protocol.generated.requests import BoardFault, State, Watchdog, WriteRequest

pytest.importorskip("unicorn", reason="unicorn missing: pip install --group dev installs it")
from tests.models.stm32 import RESET_BY_IWDG, RESET_BY_PIN, US, Dma, Usart, connect, lit_rows

CHIP = 100 * US
BOOT_US = 15_000
FOUR = board_link("air.frames_per_packet=4")


class Bar:
    """A programmed board on the model, dark."""

    def __init__(self, chip):
        self.chip = chip
        self.board = connect(chip)
        symbols = symbols_of(1, 1, FOUR)
        provision(self.board, make_bank(symbols, FOUR), Settings(start=False))
        self.chips = symbol_chips(symbols, FOUR)

    def expected(self, count):
        """Rows from the first lit chip on, (count, 96)."""
        first = int(self.chips.any(1).argmax())
        return np.repeat(np.resize(np.roll(self.chips, -first, axis=0), (count, 16)), 6, axis=1)

    def play(self, us, least):
        """Start, and see that all rows are right, at least so many; these from the first lit on, and when."""
        begin = len(self.log)
        self.board.start()
        self.chip.run(us)
        rows, times = lit_rows(self.log[begin:])
        assert len(rows) >= least
        assert (rows == self.expected(len(rows))).all()
        return rows, times

    @property
    def log(self):
        return self.chip.drivers.log

    @property
    def dark(self):
        return self.chip.drivers.dark


@pytest.fixture
def bar(stm32):
    return Bar(stm32()[0])


def test_every_start_shows_every_chip_on_every_led(bar):
    for _ in range(2):
        begin = len(bar.log)
        _, times = bar.play(21_500, 200)
        assert (np.diff(times) == CHIP).all()
        assert bar.board.status().state == State.PLAYING
        bar.board.stop()
        bar.board.wait_dark()
        bar.chip.run(500)  # the last rows leave the chain
        assert bar.dark
        assert bar.board.status().faults == 0
        # whole packets, chip for chip to the last lit one
        rows, _ = lit_rows(bar.log[begin:])
        lit = np.flatnonzero(rows.any(1))[-1] + 1
        whole = np.flatnonzero(bar.chips.any(1))
        assert (lit + whole[0] + len(bar.chips) - 1 - whole[-1]) % len(bar.chips) == 0
        assert (rows[:lit] == bar.expected(lit)).all()


def test_registers_are_those_of_the_schematic(bar):
    chip = bar.chip
    gpio_a, gpio_b = 0x40020000, 0x40020400
    # TIM2 on PA0, SPI1 and TIM3 on PA5 PA6 PA7, USART1 on PA9 PA10, DAC on PA4; PB0 drives, PB1 is pulled up
    assert (chip.plain[gpio_a + 0x20], chip.plain[gpio_a + 0x24]) == (0x52500001, 0x770)
    assert chip.plain[gpio_a] & 0x3FFFFF == 2 | 3 << 8 | 2 << 10 | 2 << 12 | 2 << 14 | 2 << 18 | 2 << 20
    assert (chip.plain[gpio_b], chip.plain[gpio_b + 0x0C]) == (1, 4)
    # SPI master of 16 bits at 10.5 MHz, the level as a share of 60 mA
    assert chip.spi.cr1 == 1 << 11 | 1 << 9 | 1 << 8 | 1 << 6 | 2 << 3 | 1 << 2
    bar.board.set_level(30)
    assert chip.plain[0x40007408] == 30 * 4095 // 60
    assert chip.plain[0x40007000] == 1 << 14 | 0xD0  # the regulator for 168 MHz, the PVD at 2.8 V
    assert (bar.board.info.tick_hz, bar.board.info.hal.rstrip(b"\0")) == (14_000_000, b"stm32f405")


BREAKS = {
    "tim1": (lambda chip: chip.tim1.stop_for_good(), BoardFault.CHIP_LOST, 1.6),
    "stream-stands": (lambda chip: setattr(chip.dma, "dead", True), BoardFault.CHIP_LOST, 1.6),
    "stream-ends": (lambda chip: setattr(chip.dma, "cr", chip.dma.cr & ~1), BoardFault.CHIP_LOST, 1.6),
    "transfer-error": (lambda chip: chip.dma.error(Dma.TRANSFER_ERROR), BoardFault.CHIP_LOST, 0.1),
    "direct-mode-error": (lambda chip: chip.dma.error(Dma.DIRECT_ERROR), BoardFault.CHIP_LOST, 0.1),
    "fifo-error": (lambda chip: chip.dma.error(Dma.FIFO_ERROR), BoardFault.CHIP_LOST, 0.1),
    "interrupt": (lambda chip: chip.enabled.discard(16 + Dma.IRQ), BoardFault.CHIP_LOST, 1.6),
    "crystal": (lambda chip: chip.stop_crystal(), BoardFault.CLOCK, 0.1),
    "supply": (lambda chip: chip.pending.add(16 + 1), BoardFault.CHIP_LOST, 0.1),
    "spi": (lambda chip: setattr(chip.spi, "dead", True), BoardFault.CHIP_LOST, 1.7),
    "latch-timer": (lambda chip: chip.tim3.stop_for_good(), BoardFault.CHIP_LOST, 1.7),
}


@pytest.mark.parametrize("what", BREAKS)
def test_what_fails_while_playing_ends_in_the_dark(bar, what):
    breaks, fault, most_chips = BREAKS[what]
    rng = np.random.default_rng(list(BREAKS).index(what))
    bar.board.start()
    bar.chip.run(5_000 + float(rng.uniform(0, 10_000)))
    assert not bar.dark
    assert bar.board.status().state == State.PLAYING
    bar.chip.run(float(rng.uniform(0, 200)))
    at = bar.chip.now
    breaks(bar.chip)
    bar.chip.run(1_000)
    assert bar.dark
    went = max(s.time for s in bar.log if s.dark)
    assert not any(not s.dark for s in bar.log if s.time > went)
    assert went - at <= most_chips * CHIP
    # named at once, and STOP and BLANK find nothing that could hang
    for ends in (lambda: None, bar.board.stop, bar.board.blank):
        ends()
        assert state_of(bar.board) == (State.FAULT, fault)
    bar.chip.run(10_000)
    assert bar.dark
    assert bar.chip.resets == [RESET_BY_PIN]


def test_stop_ends_in_the_dark_on_a_stream_that_dies_meanwhile(bar):
    for moment in (0, 70, 250):
        bar.board.start()
        bar.chip.run(5_000 + moment)
        bar.board.stop()
        assert bar.board.status().state == State.STOPPING
        bar.chip.dma.dead = True
        bar.chip.run(300)
        assert bar.dark
        assert bar.board.status().state == State.FAULT
        # a fault within the last chip's interrupt leaves it waiting for what has stopped
        bar.chip.uc.mem_write(symbol("draining"), bytes([3]))
        bar.board.test_leds(0, 0, 1)
        assert bar.chip.resets == [RESET_BY_PIN]
        bar.chip.dma.dead = False
        bar.chip.dma.cr &= ~1
    # what works again plays again
    bar.play(15_000, 100)
    assert bar.board.status().state == State.PLAYING


def test_a_supply_that_is_low_already_lights_nothing(bar):
    bar.chip.plain[0x40007004] = 4  # the PVD's output, which does not interrupt while it stays so
    for light in (bar.board.start, lambda: bar.board.test_leds(0, 0, 100)):
        light()
        bar.chip.run(1_000)
        assert state_of(bar.board) == (State.FAULT, BoardFault.CHIP_LOST)
    assert not any(s.row for s in bar.log)


def test_a_request_that_takes_long_to_check_is_no_silence(bar):
    bar.board.set_key(bytes(range(1, 17)))
    bar.board.set_watchdog(Watchdog.DARK, 60_000)
    bar.board.start()
    for phase in range(5):  # a millisecond ends while one is checked
        bar.chip.run(1_000 - bar.chip.now / US % 1_000 + 200 * phase)
        bar.board.session.call(WriteRequest(1, 0, bytes(400)))
    assert state_of(bar.board) == (State.PLAYING, 0)


def test_no_crystal_then_no_chip(bar):
    bar.chip.stop_crystal()
    bar.chip.run(1_000)
    # at 16 MHz the line rate is kept
    assert state_of(bar.board) == (State.FAULT, BoardFault.CLOCK)
    with pytest.raises(RefusedError, match="HARDWARE_FAULT"):
        bar.board.start()
    before = bar.board.status().uptime_ms
    bar.chip.run(50_000)
    assert 49 <= bar.board.status().uptime_ms - before <= 54


def test_led_test_shows_one_led_and_nothing_on_a_dead_spi(bar):
    begin = len(bar.log)
    bar.board.test_leds(0, 95, 1)
    bar.board.wait_dark()
    lit = [s.row for s in bar.log[begin:] if s.row]
    assert [row for n, row in enumerate(lit) if lit[n - 1] != row] == [1 << 95 - led for led in range(96)]
    bar.chip.spi.dead = True
    begin = len(bar.log)
    bar.board.test_leds(3, 3, 100)
    assert all(s.dark for s in bar.log[begin:])
    assert bar.board.status().state == State.FAULT


def test_save_outlives_the_watchdog_and_autostart_waits_for_start_after_its_reset(bar):
    bar.board.save(autostart=True)
    bar.chip.run(20_000)
    assert bar.chip.resets == [RESET_BY_PIN]
    bar.chip.reset(RESET_BY_PIN)
    bar.chip.run(BOOT_US + 5_000)
    assert not bar.dark
    bar.chip.exception(3)
    bar.chip.run(110_000 + BOOT_US)
    assert bar.chip.resets == [RESET_BY_PIN, RESET_BY_PIN, RESET_BY_IWDG]
    assert bar.dark
    board = connect(bar.chip)
    assert board.status().faults == BoardFault.CHIP_LOST
    board.start()
    bar.chip.run(5_000)
    assert not bar.dark
    assert board.status().faults == 0


@pytest.mark.parametrize("what", ["hangs", "hangs-in-chip", "stands", "faults"])
def test_a_core_that_stops_is_reset_and_stays_dark(bar, what):
    bar.board.start()
    bar.chip.run(8_000)
    assert not bar.dark
    at = bar.chip.now
    if what == "faults":
        bar.chip.exception(3)
    elif what.startswith("hangs"):
        # an instruction that jumps to itself: in the chip interrupt, or where nothing interrupts it
        if what == "hangs-in-chip":
            bar.chip.exception(16 + Dma.IRQ)
        else:
            bar.chip.enabled.clear()
            bar.chip.systick.generation += 1
        bar.chip.uc.mem_write(0x20018000, b"\xfe\xe7")
        bar.chip.pc = 0x20018000
    else:
        bar.chip.plain[0x40023800] &= ~(1 << 19)  # as if clock security had failed as well
        bar.chip.stop_crystal()
    bar.chip.run(200)
    assert bar.dark == (what in ("faults", "hangs-in-chip"))
    bar.chip.run(110_000)
    assert bar.chip.resets == [RESET_BY_PIN, RESET_BY_IWDG]
    assert bar.dark
    assert max(s.time for s in bar.log if not s.dark) - at <= 101_000 * US
    # named, and dark until START
    bar.chip.hse_works, bar.chip.core_stands = True, False
    bar.chip.run(BOOT_US)
    assert state_of(connect(bar.chip)) == (State.FAULT, BoardFault.CHIP_LOST)
    assert bar.dark


def test_a_broken_thermal_wire_is_too_hot(bar):
    bar.board.start()
    bar.chip.run(5_000)
    assert not bar.dark
    bar.chip.thermal_open = True
    # it is looked at every 100 ms, most of which are skipped
    millis = int.from_bytes(bar.chip.uc.mem_read(symbol("millis"), 4), "little")
    bar.chip.uc.mem_write(symbol("millis"), (millis + 90).to_bytes(4, "little"))
    bar.chip.run(11_000)
    assert bar.dark
    assert state_of(bar.board) == (State.FAULT, BoardFault.OVER_TEMPERATURE)
    with pytest.raises(RefusedError, match="HARDWARE_FAULT"):
        bar.board.start()
    bar.chip.thermal_open = False
    bar.board.start()
    bar.chip.run(5_000)
    assert not bar.dark


def test_emulate_serves_the_model(evlcp, stm32, tmp_path):
    listen, record, out = f"unix:{tmp_path / 'board'}", tmp_path / "leds.bin", tmp_path / "chips.npy"
    emulated = Emulated("stm32", "--listen", listen, "--leds", record)
    try:
        assert emulated.first_line == f"listening on {listen}\n"
        random = ("--random", 1, "--seed", 4, "--set", "air.frames_per_packet=2")
        for command in (("program", *random), ("stop",)):
            well(evlcp("board", *command, "--port", listen))
    finally:
        assert emulated.end() == 0
    well(evlcp("board", "leds", record, "--chips", out))
    chips, link = np.load(out), board_link("air.frames_per_packet=2")
    once = symbol_chips(symbols_of(1, 4, link), link)
    start = int(chips.any(1).argmax()) - int(once.any(1).argmax())
    whole = (len(chips) - start) // len(once) * len(once)
    assert whole >= len(once)
    assert (chips[start : start + whole] == np.tile(once, (whole // len(once), 1))).all()
    assert not chips[start + whole :].any()


def symbol(name):
    """Address of a variable of the image."""
    table = subprocess.run(
        ["arm-none-eabi-nm", build.arm_image("stm32f405")], capture_output=True, text=True, check=True
    ).stdout
    return next(int(line.split()[0], 16) for line in table.splitlines() if line.split()[-1] == name)


def test_counters_pass_two_to_the_32(bar):
    """TIM2, the milliseconds, the chips and the packets sent all wrap while it plays."""
    chip = bar.chip
    bar.board.start()
    chip.run(20_000)
    bar.board.blank()
    status = bar.board.status()
    board = symbol("board")
    memory = bytes(chip.uc.mem_read(board, 90_000))
    pattern = status.packets_sent.to_bytes(4, "little") + status.chips_sent.to_bytes(4, "little")
    places = [n for n in range(0, len(memory), 4) if memory[n : n + 8] == pattern]
    # the counters, and after them the reply that has just told of them
    assert len(places) == 2
    looks = symbol("hal_millis")
    while 0 <= chip.pc - looks < 128:  # not while it looks at them
        chip.run(0.1)
    chip.uc.mem_write(board + places[0], b"\xff\xff\xff\xff" + (2**32 - 60).to_bytes(4, "little"))
    last = symbol("last_count")
    chip.uc.mem_write(symbol("millis"), (2**32 - 25).to_bytes(4, "little"))
    ticks = 84_000  # of TIM2 in a millisecond
    chip.tim2.hold(2**32 - 15 * ticks)
    chip.uc.mem_write(last, (2**32 - 15 * ticks).to_bytes(4, "little"))
    _, times = bar.play(40_000, 390)
    assert (np.diff(times) == CHIP).all()
    assert chip.tim2.counter() < 2**31
    status = bar.board.status()
    assert status.uptime_ms < 1_000
    assert 0 < status.packets_sent < 10
    assert 300 < status.chips_sent < 400
    assert (status.state, status.faults) == (State.PLAYING, 0)


def test_interrupts_stack_and_line_have_room(bar):
    """At 20 000 chips per second and 1 Mbit/s both ways: no byte lost, no chip late."""
    chip = bar.chip
    lowest = symbol("link_bss_end")
    room = chip.stack - 64 - lowest
    chip.uc.mem_write(lowest, b"\xa5" * room)
    masks = np.zeros((26 + 32 * 10, 96), np.uint8)
    masks[::2] = np.random.default_rng(0).integers(0, 2, masks[::2].shape)
    link = board_link("air.chip_rate_hz=20000.0")
    bank = Bank.of_chips(masks, link)
    provision(bar.board, bank, Settings())
    before = bar.board.status()
    spare = 1 - before.active_bank
    content = np.random.default_rng(1).integers(0, 256, 1_500, np.uint8).tobytes()
    began = chip.now
    assert bar.board.write_missing(spare, content) == len(content)
    assert bar.board.read_bank(spare, 0, len(content)) == content
    took_us = (chip.now - began) / US
    status = bar.board.status()
    assert (status.overflow_errors, status.crc_errors, status.framing_errors) == (0, 0, 0)
    assert (status.state, status.faults) == (State.PLAYING, 0)
    assert bar.board.session.client.retries == 0
    assert took_us < 2.5 * 20 * len(content)  # at most 2.5 times the bytes' own time on the line
    # a chip takes 50 us; an instruction is a clock here, on the part up to three
    assert chip.longest[16 + Dma.IRQ] < 50 * US / 3
    assert chip.longest[16 + Usart.IRQ] < 3 * US
    assert status.lateness_max_ticks < 14 * 10
    bar.board.stop()
    bar.board.wait_dark()
    bar.board.save()
    bar.board.test_leds(0, 1, 1)
    bar.board.wait_dark()
    used = room - next(n for n, byte in enumerate(chip.uc.mem_read(lowest, room)) if byte != 0xA5)
    assert used < 3_000
    assert room > 8_192
