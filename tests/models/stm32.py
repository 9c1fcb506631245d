"""An STM32F405 with a bar of LEDs on it, for the real image: the core by Unicorn, the rest from RM0090.

It knows nothing of the firmware but the wiring of the board (the table in hal.c). Peripherals are event
models: what they do between two instructions is worked out from how they were set up. Time is in units of
1/336 MHz. Timers, DMA, SPI and the latch are exact to the clock against each other; an instruction counts as
one clock of the core, so its speed is an estimate. The timers, the stream, SPI, USART and SysTick raise at a
setting that they do not know, PWR and the flash at one that the clock does not allow; ports, DAC and EXTI
keep what is written. A peripheral's `read` and `write` are what the core does to a register.
"""

import heapq
import secrets
import struct
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import ClassVar

import numpy as np
import unicorn
from unicorn import arm_const

from firmware_host.board.board import Board
from firmware_host.board.session import Session
from firmware_host.images import FlashImage
from firmware_host.protocol.client import Timing

UNIT_HZ = 336_000_000
HSI_HZ, HSE_HZ, LSI_HZ = 16_000_000, 8_000_000, 32_000
US = UNIT_HZ // 1_000_000
LEDS = 96
NEVER = 1 << 62

RETURN = 0x1FFE0000
"""Where BX LR goes at the end of an exception: a place the part does not have."""

RESET_BY_PIN, RESET_BY_SOFTWARE, RESET_BY_IWDG = 1 << 26, 1 << 28, 1 << 29
TO_ITSELF = b"\xfe\xe7"
"""An instruction that jumps to itself: nothing but an event ends it."""

PWR_CR = 0x40007000
SCALE = "168 MHz need scale 1 of the regulator, which reset sets (RM0090 5.4.1)"

SLICE = 240
"""Instructions from one look at the events to the next, at most: 1.4 us at 168 MHz."""


class Peripheral:
    """Registers that are attributes, by their offsets, and events that end when it is set up anew."""

    REGISTERS: ClassVar = {}
    generation = 0

    def __init__(self, chip):
        self.chip = chip

    def read(self, offset):
        return getattr(self, self.REGISTERS[offset])

    def write(self, offset, value):
        setattr(self, self.REGISTERS[offset], value)

    def later(self, time, event):
        """Do this then, in this generation."""
        generation = self.generation
        self.chip.at(time, lambda: event() if generation == self.generation else None)


class Timer(Peripheral):
    """TIM1 to TIM3, as far as the board needs: up-counting, update, PWM mode 1 on channel 1, trigger mode."""

    CR1, CR2, SMCR, DIER, SR, EGR, CCMR1, CCER, CNT, PSC, ARR, CCR1 = (
        *(0x00, 0x04, 0x08, 0x0C, 0x10, 0x14, 0x18, 0x20, 0x24, 0x28, 0x2C, 0x34),
    )

    def __init__(self, chip, name):
        super().__init__(chip)
        self.name = name
        self.r = dict.fromkeys((0x00, 0x04, 0x08, 0x0C, 0x10, 0x18, 0x20, 0x24, 0x28, 0x34), 0)
        self.r[self.ARR] = 0xFFFFFFFF if name == "TIM2" else 0xFFFF
        self.since = 0  # when the counter stood at `held`
        self.held = 0
        self.unit = UNIT_HZ // HSI_HZ  # time of a count
        self.stands = False  # broken: the counter does not move
        self.request = False  # of the update, for DMA
        self.slave = None
        self.master = None

    @property
    def gated(self):
        """It counts while its master does."""
        return self.r[self.SMCR] & 0x77 == 0x05

    @property
    def running(self):
        """Whether the counter moves."""
        gate = self.master is None or not self.gated or self.master.running
        return bool(self.r[self.CR1] & 1) and gate and not self.stands

    def counter(self):
        period = self.r[self.ARR] + 1
        moved = (self.chip.now - self.since) // self.unit if self.running else 0
        return (self.held + moved) % period

    def hold(self, value):
        """Let the counter go on from a value."""
        self.held, self.since = value, self.chip.now

    def read(self, offset):
        if offset == self.CCR1 and self.r[self.CCMR1] & 3 == 1:
            self.r[self.SR] &= ~2  # a capture that is read
        return self.counter() if offset == self.CNT else self.r[offset]

    def capture(self):
        """A rising edge at channel 1."""
        if self.r[self.CCMR1] & 0xFF == 1 and self.r[self.CCER] & 0xF == 1 and self.running:
            self.r[self.CCR1] = self.counter()
            self.r[self.SR] |= 2

    def write(self, offset, value):
        self.hold(self.counter())
        if offset == self.EGR:
            assert value == 1, value
            self.hold(0)
            self.update()
        elif offset == self.SR:
            self.r[self.SR] &= value
        elif offset == self.CNT:
            self.hold(value)
        else:
            assert self.name == "TIM3" or offset != self.SMCR
            allowed = {self.CR1: 1, self.CR2: 0x70, self.SMCR: 0x77, self.DIER: 0x100, self.PSC: 0}
            assert not value & ~allowed.get(offset, 0xFFFFFFFF), (self.name, hex(offset), hex(value))
            started = offset == self.CR1 and value & 1 and not self.r[self.CR1] & 1
            slave = self.slave if offset == self.CR1 and self.slave and self.slave.gated else None
            if slave:
                slave.hold(slave.counter())
            self.r[offset] = value
            if slave:
                slave.hold(slave.held)
                slave.plan()
            if offset == self.DIER and not value & 0x100:
                self.request = False
            triggered = self.slave and self.slave.r[self.SMCR] & 0x77 == 0x06
            if started and triggered and self.r[self.CR2] & 0x70 == 0x10 and not self.stands:
                # a rising edge of ITR0: TIM3's is TIM1's TRGO (RM0090, table 99)
                self.slave.hold(self.slave.counter())
                self.slave.r[self.CR1] |= 1
                self.slave.plan()
        self.plan()

    def update(self):
        """An update event: a flag, and with UDE a DMA request that stays until it is served."""
        self.r[self.SR] |= 1
        if self.r[self.DIER] & 0x100:
            self.request = True
            self.chip.at(self.chip.now, self.chip.dma.serve)

    def output(self):
        """Channel 1 in PWM mode 1."""
        on = self.r[self.CCMR1] & 0x70 == 0x60 and self.r[self.CCER] & 1
        return bool(on) and self.counter() < self.r[self.CCR1]

    def plan(self):
        """Look ahead to the next wrap and the next edge of the output."""
        self.generation += 1
        self.chip.drivers.look()
        if not self.running or self.name == "TIM2":
            return
        here, unit = self.counter(), self.unit
        period, edge = self.r[self.ARR] + 1, self.r[self.CCR1]
        base = self.since + (here - self.held) % period * unit
        self.later(base + (period - here) * unit, lambda: self.event(True))
        if here < edge < period:
            self.later(base + (edge - here) * unit, lambda: self.event(False))

    def event(self, wraps):
        if not self.running:
            return
        if wraps:
            self.hold(0)
            self.update()
        self.plan()

    def stop_for_good(self):
        """Broken: the counter stands, whatever is written."""
        self.hold(self.counter())
        self.stands = True
        self.generation += 1


class Dma(Peripheral):
    """Stream 5 of DMA2: direct mode, memory to peripheral, 16 bits, circular (RM0090 10)."""

    IRQ = 68
    HALF, ALL, TRANSFER_ERROR, DIRECT_ERROR, FIFO_ERROR = 1 << 10, 1 << 11, 1 << 9, 1 << 8, 1 << 6

    REGISTERS: ClassVar = {0x04: "flags", 0x0C: "cleared", 0x88: "cr", 0x8C: "left"}
    REGISTERS |= {0x90: "par", 0x94: "memory", 0x9C: "fcr"}
    cr = left = count = par = memory = flags = cleared = 0
    fcr = 0x21
    ahead = 0  # the word fetched ahead
    dead = False

    def write(self, offset, value):
        on = self.cr & 1
        if offset == 0x0C:
            self.flags &= ~value
        elif offset == 0x88:
            if not value & 1:
                self.cr = value | (on if self.dead else 0)  # broken: EN never falls
                if on and not self.dead:
                    self.flags |= self.ALL  # ended by software
            else:
                self.cr = value
                if not on:
                    self.start()
        elif not on:  # these are protected while the stream runs
            super().write(offset, value)
        self.line()

    def start(self):
        # channel 6, 16 bits both sides, memory counts up, circular, to the peripheral: all the model knows
        assert self.cr & ~0x1E == 6 << 25 | 3 << 16 | 1 << 13 | 1 << 11 | 1 << 10 | 1 << 8 | 1 << 6 | 1
        assert not self.fcr & 4  # direct mode
        assert not self.flags & 0xF40, "a stream starts only with its flags cleared (RM0090 10.3.17)"
        self.count = self.left
        self.fetch()
        self.serve()

    def fetch(self):
        at = self.memory + 2 * (self.count - self.left)
        self.ahead = struct.unpack("<H", self.chip.uc.mem_read(at, 2))[0]

    def serve(self):
        """A request of TIM1's update, if the stream runs, moves a word at once."""
        if not self.chip.tim1.request or not self.cr & 1 or self.dead:
            return
        self.chip.tim1.request = False
        assert self.par == 0x4001300C
        self.chip.spi.send(self.ahead)
        self.left -= 1
        if self.left == self.count // 2:
            self.flags |= self.HALF
        if self.left == 0:
            self.flags |= self.ALL
            self.left = self.count
        self.fetch()
        self.line()

    def error(self, flag):
        """An error of the stream; a transfer error ends it."""
        self.flags |= flag
        if flag == self.TRANSFER_ERROR:
            self.cr &= ~1
        self.line()

    def line(self):
        """Raise or drop the interrupt."""
        cr = self.cr
        enabled = (cr >> 4 & 1) * self.ALL | (cr >> 3 & 1) * self.HALF | (cr >> 2 & 1) * self.TRANSFER_ERROR
        enabled |= (cr >> 1 & 1) * self.DIRECT_ERROR | (self.fcr >> 7 & 1) * self.FIFO_ERROR
        self.chip.set_line(16 + self.IRQ, bool(self.flags & enabled))


class Spi(Peripheral):
    """SPI1, master, 16 bits."""

    REGISTERS: ClassVar = {0x00: "cr1", 0x04: "cr2", 0x08: "status", 0x0C: "received"}
    cr1 = cr2 = received = 0
    buffer = word = None
    dead = False

    @property
    def status(self):
        return (self.buffer is None) << 1 | (self.word is not None) << 7

    @property
    def bit(self):
        return UNIT_HZ // self.chip.pclk2 * (2 << (self.cr1 >> 3 & 7))

    def write(self, offset, value):
        if offset == 0x0C:
            self.send(value)
        else:
            assert offset or value & ~0x78 == 1 << 11 | 1 << 9 | 1 << 8 | 1 << 2, hex(value)
            super().write(offset, value)

    def send(self, word):
        if not self.cr1 & 0x40:
            return
        if self.word is None and not self.dead:
            self.shift(word)
        else:
            self.buffer = word

    def shift(self, word):
        """A word begins to leave."""
        self.word = word
        self.chip.at(self.chip.now + 16 * self.bit, self.done)

    def done(self):
        """A word has left."""
        if self.dead or self.word is None:
            return
        self.chip.drivers.shift(self.word)
        self.word = None
        if self.buffer is not None:
            word, self.buffer = self.buffer, None
            self.shift(word)


@dataclass(frozen=True)
class Shown:
    """What 96 LEDs show from `time` on; LED 0 is the highest bit of `row`."""

    time: int
    row: int
    latched: bool
    """Whether the latch has just closed, whatever the row."""
    dark: bool
    """Whether output enable keeps all LEDs off."""


class Drivers:
    """The LED drivers: a chain of shift registers, latches, transparent while high, and output enable."""

    def __init__(self, chip):
        self.chip = chip
        self.chain = 0  # 96 bits; the one that left first is the highest
        self.latch = False
        self.held = 0
        self.log = []

    def shift(self, word):
        self.chain = (self.chain << 16 | word) & (1 << LEDS) - 1
        self.look()

    @property
    def dark(self):
        """Output enable is high: driven so, or an input, which the board pulls up."""
        return self.chip.pin(0x40020400, 0) is not False

    @property
    def row(self):
        return 0 if self.dark else self.held

    def look(self):
        """Something may have changed: the chain, the latch, output enable."""
        level = self.chip.pin(0x40020000, 6)
        closes = self.latch and not level
        if self.latch or level:
            self.held = self.chain
        self.latch = bool(level)
        last = self.log[-1] if self.log else None
        if closes or last is None or (last.row, last.dark) != (self.row, self.dark):
            self.log.append(Shown(self.chip.now, self.row, closes, self.dark))


class Usart(Peripheral):
    """USART1 and the host at its other end, which keeps to 1 Mbit/s."""

    IRQ = 37
    BYTE = 10 * US

    REGISTERS: ClassVar = {0x00: "sr", 0x04: "dr", 0x08: "brr", 0x0C: "cr1"}
    sr = 0xC0
    dr = brr = cr1 = 0
    free_at = 0  # when the transmitter has room
    line_free = 0

    def __init__(self, chip):
        super().__init__(chip)
        self.to_host = bytearray()

    def right_rate(self):
        """Within 3 % of the host's."""
        return self.brr >= 16 and abs(self.chip.pclk2 / self.brr / 1e6 - 1) < 0.03

    def arrive(self, data):
        """Bytes from the host, one after the other."""
        self.line_free = max(self.line_free, self.chip.now)
        for byte in data:
            self.line_free += self.BYTE
            self.chip.at(self.line_free, partial(self.received, byte))

    def received(self, byte):
        """A byte of the host has come."""
        if self.cr1 & 0x2004 != 0x2004 or not self.right_rate():
            return
        if self.sr & 0x20:
            self.sr |= 0x08
        else:
            self.dr, self.sr = byte, self.sr | 0x20
        self.line()

    def read(self, offset):
        if offset == 0x00:
            return self.sr & ~0x80 | (self.chip.now >= self.free_at) << 7
        if offset == 0x04:
            self.sr &= ~0x28
            self.line()
        return super().read(offset)

    def write(self, offset, value):
        if offset == 0x04:
            if self.cr1 & 0x2008 == 0x2008:
                leaves = max(self.chip.now, self.free_at) + self.BYTE
                self.free_at = leaves
                if self.right_rate():
                    self.chip.at(leaves, lambda: self.to_host.append(value & 0xFF))
        else:
            assert offset == 0x08 or (offset == 0x0C and not value & ~0x202C), (hex(offset), hex(value))
            super().write(offset, value)
        self.line()

    def line(self):
        """Raise or drop the interrupt."""
        self.chip.set_line(16 + self.IRQ, bool(self.cr1 & 0x20 and self.sr & 0x28))


class SysTick(Peripheral):
    """The core's own timer, on the core's clock."""

    REGISTERS: ClassVar = {0x10: "csr", 0x14: "rvr", 0x18: "cvr"}
    csr = rvr = cvr = 0

    def write(self, offset, value):
        assert offset != 0x10 or value in (0, 5, 7), "on the core's clock"
        if offset != 0x18:
            super().write(offset, value & 0xFFFFFF)
        self.plan()  # a write to the counter clears it: it begins again with the reload value

    def plan(self):
        """Look ahead to the end."""
        self.generation += 1
        if self.csr & 1 and self.rvr:
            self.later(self.chip.now + (self.rvr + 1) * self.chip.cycle, self.ends)

    def ends(self):
        if self.csr & 2:
            self.chip.pending.add(15)
        self.plan()


class Iwdg(Peripheral):
    """The independent watchdog, on the LSI (RM0090 21)."""

    REGISTERS: ClassVar = {0x0: "key", 0x4: "pr", 0x8: "rlr", 0xC: "busy"}
    key = pr = busy_until = 0
    rlr = 0xFFF
    open = on = False
    due = NEVER

    @property
    def busy(self):
        return 3 if self.chip.now < self.busy_until else 0

    def write(self, offset, value):
        if offset == 0x0:
            self.open = value == 0x5555
            self.on |= value == 0xCCCC
            if value in (0xAAAA, 0xCCCC) and self.on:
                self.due = self.chip.now + (self.rlr + 1) * (4 << self.pr) * UNIT_HZ // LSI_HZ
        elif self.open:
            self.busy_until = self.chip.now + 5 * UNIT_HZ // LSI_HZ
            super().write(offset, value)


class Flash(Peripheral):
    """The flash's registers; words take no time, and a sector a second, in which the core stands."""

    REGISTERS: ClassVar = {0x00: "acr", 0x0C: "sr", 0x10: "cr"}
    acr = sr = 0
    cr = 0x80000000
    keys = (0, 0)
    stale = False  # the caches may hold what was erased

    def write(self, offset, value):
        if offset == 0x00:
            # a cache is reset only while it is off
            assert not (value & 0x1800 and value & 0x600), hex(value)
            assert self.chip.cycle != 2 or value & 7 == 5, "168 MHz need 5 wait states (RM0090 3.5.1)"
            if value & 0x1800 == 0x1800:
                self.stale = False
            self.acr = value
        elif offset == 0x04:
            self.keys = self.keys[1], value
            if self.keys == (0x45670123, 0xCDEF89AB):
                self.cr &= 0x7FFFFFFF
        elif offset == 0x10 and not self.cr & 0x80000000:
            self.cr = value
            if value & 0x10002 == 0x10002:
                sector = value >> 3 & 15
                assert 6 <= sector < 12, "the last six, of 128 KiB each"
                self.chip.uc.mem_write(0x08040000 + 0x20000 * (sector - 6), b"\xff" * 0x20000)
                self.chip.now += UNIT_HZ
                self.stale = bool(self.acr & 0x600)
                self.cr &= ~0x10000


def numbers(offset, value):
    """The exceptions that the bits of a register of the NVIC are."""
    return {16 + 8 * offset + n for n in range(32) if value >> n & 1}


KEPT = (*(getattr(arm_const, f"UC_ARM_REG_R{n}") for n in (0, 1, 2, 3, 12)), arm_const.UC_ARM_REG_LR)
"""What an exception puts onto the stack, before the place and the status."""


class Stm32:
    """The part, from power-up on.

    Args:
        image: What is flashed.
        hse_hz: The crystal.
    """

    def __init__(self, image, hse_hz=HSE_HZ):
        self.hse_hz = hse_hz
        uc = unicorn.Uc(unicorn.UC_ARCH_ARM, unicorn.UC_MODE_THUMB | unicorn.UC_MODE_MCLASS)
        self.uc = uc
        uc.ctl_set_cpu_model(arm_const.UC_CPU_ARM_CORTEX_M4)
        uc.mem_map(0x08000000, 1 << 20)
        uc.mem_write(0x08000000, b"\xff" * (1 << 20))
        uc.mem_map(0x20000000, 1 << 17)
        uc.mem_map(0x1FFF7000, 0x1000, unicorn.UC_PROT_READ)
        uc.mem_map(RETURN, 0x1000)
        for base, size in ((0x40000000, 0x80000), (0x50060000, 0x1000), (0xE0000000, 0x100000)):
            uc.mmio_map(base, size, self._read, base, self._write, base)
        whole = FlashImage.read(image) if isinstance(image, Path) else image
        uc.mem_write(whole.address, whole.data)
        uc.hook_add(unicorn.UC_HOOK_MEM_READ, self._slot_read, begin=0x080C0000, end=0x080FFFFF)
        uc.hook_add(unicorn.UC_HOOK_MEM_WRITE, self._flash_write, begin=0x08000000, end=0x080FFFFF)
        self.now = 0
        self.events = []
        self.order = count()
        self.resets = []
        self.hse_works = True
        self.drivers = Drivers(self)
        self.reset(RESET_BY_PIN)

    # -- clocks and reset

    def reset(self, cause):
        """All but RAM, flash and the log of the LEDs begins anew."""
        self.resets.append(cause)
        self.events.clear()
        self.plain = {0x40023800: 0x83, 0x40023874: cause, 0x40023804: 0x24003010}
        self.plain |= {0x40020000: 0xA8000000, PWR_CR: 1 << 14}
        self.cycle = UNIT_HZ // HSI_HZ
        self.enabled = set()
        self.pending = set()
        self.lines = set()
        self.priorities = {}
        self.active = []
        self.entered = []
        self.longest = {}
        self.tim1, self.tim2, self.tim3 = Timer(self, "TIM1"), Timer(self, "TIM2"), Timer(self, "TIM3")
        self.tim1.slave, self.tim3.master = self.tim3, self.tim1
        self.dma, self.spi, self.usart = Dma(self), Spi(self), Usart(self)
        self.systick, self.iwdg, self.flash = SysTick(self), Iwdg(self), Flash(self)
        self.drivers.latch = False
        self.places = {
            0x40000000: self.tim2,
            0x40000400: self.tim3,
            0x40003000: self.iwdg,
            0x40010000: self.tim1,
            0x40011000: self.usart,
            0x40013000: self.spi,
            0x40023C00: self.flash,
            0x40026400: self.dma,
        }
        stack, entry = struct.unpack("<2I", self.uc.mem_read(0x08000000, 8))
        self.uc.reg_write(arm_const.UC_ARM_REG_SP, stack)
        self.pc = entry & ~1
        self.drivers.look()

    @property
    def stack(self):
        return int(self.uc.reg_read(arm_const.UC_ARM_REG_SP))

    @property
    def pclk2(self):
        """Clock of APB2, Hz: half of the core's, but the whole of 16 MHz."""
        return HSI_HZ if self.cycle == UNIT_HZ // HSI_HZ else 84_000_000

    def _rcc_write(self, offset, value):
        at = 0x40023800 + offset
        if offset == 0x00:
            hse = bool(value & 1 << 16 and self.hse_works)
            pll = bool(value & 1 << 24 and hse)
            value = value & ~(1 << 17 | 1 << 25) | hse << 17 | pll << 25
        elif offset == 0x08:
            fast = value == 5 << 10 | 4 << 13 | 2
            assert fast or not value & 3, hex(value)
            if fast:
                m = self.hse_hz // 1_000_000
                pll = 7 << 24 | 1 << 22 | 336 << 6 | m
                assert self.plain[0x40023804] == pll, "not 168 MHz by this crystal"
                assert self.flash.acr & 7 == 5
                assert self.plain[PWR_CR] & 1 << 14, SCALE
            self._core_cycle(2 if fast else UNIT_HZ // HSI_HZ)
            value |= (value & 3) << 2
        self.plain[at] = value

    def _core_cycle(self, cycle):
        timers = (self.tim1, self.tim2, self.tim3)
        for timer in timers:
            timer.hold(timer.counter())
        self.cycle = cycle
        for timer in timers:
            # TIM2 and TIM3 are on the slower bus: 84 MHz of 168
            timer.unit = 4 if cycle == 2 and timer is not self.tim1 else cycle
            timer.plan()
        self.systick.plan()

    def pulse_at(self, time):
        """A rising edge on PA0 then, in units of the board's own crystal."""
        self.at(round(time), self._pulse)

    def _pulse(self):
        if self.plain.get(0x40020000, 0) & 3 == 2 and self.plain.get(0x40020020, 0) & 15 == 1:  # TIM2
            self.tim2.capture()

    def stop_crystal(self):
        """The crystal stands: with clock security the core goes on at 16 MHz, with an NMI, else it stops."""
        self.hse_works = False
        cr = self.plain[0x40023800]
        if not self.plain.get(0x40023808, 0) & 2:
            return
        self.plain[0x40023800] = cr & ~(1 << 16 | 1 << 17 | 1 << 24 | 1 << 25)
        if cr & 1 << 19:
            self.plain[0x40023808] &= ~0xF
            self._core_cycle(UNIT_HZ // HSI_HZ)
            self.pending.add(2)
        else:
            for timer in (self.tim1, self.tim2, self.tim3):
                timer.stop_for_good()
            self.spi.dead = self.dma.dead = True
            self.systick.generation += 1
            self.core_stands = True

    core_stands = False
    restarts = False
    thermal_open = False
    """Too hot, or the wire to the switch is broken."""

    # -- pins

    def pin(self, port, number):
        """What a pin drives; None if it does not."""
        mode = self.plain.get(port, 0) >> 2 * number & 3
        if mode == 1:
            return bool(self.plain.get(port + 0x14, 0) >> number & 1)
        if mode == 2 and (port, number) == (0x40020000, 6):
            assert self.plain[port + 0x20] >> 24 & 15 == 2  # TIM3
            return self.tim3.output()
        return None

    # -- registers

    def _slot_read(self, uc, access, at, size, value, data):
        assert not self.flash.stale, f"{at:#x} is read through caches that were not flushed"

    def _flash_write(self, uc, access, at, size, value, data):
        assert (size, self.flash.cr & 0x80000303) == (4, 0x201), "words, by an unlocked PG (RM0090 3.6.4)"
        assert not value & ~int.from_bytes(uc.mem_read(at, 4), "little"), f"{at:#x} is not erased"

    def _read(self, uc, offset, size, base):
        at = base + offset
        if at == 0x40000024:  # by far the most frequent one
            return self.tim2.counter()
        assert size == 4, hex(at)
        place = self.places.get(at & ~0x3FF)
        if place is not None:
            return int(place.read(at & 0x3FF))
        if 0xE000E010 <= at < 0xE000E020:
            return self.systick.read(at & 0xFF)
        if at == 0x50060804:  # random numbers, by the PLL's 48 MHz
            on = self.plain.get(0x40023834, 0) >> 6 & self.plain[0x50060800] >> 2
            return on & self.plain[0x40023800] >> 25 & 1
        if at == 0x50060808:
            return int.from_bytes(secrets.token_bytes(4), "little")
        if at == 0x40020410:  # the thermal switch: closed to ground while it is cool
            pulled_up = self.plain.get(0x4002040C, 0) >> 2 & 3 == 1
            return int(self.thermal_open and pulled_up) << 1
        return self.plain.get(at, 0)

    def _write(self, uc, offset, size, value, base):
        at = base + offset
        place = self.places.get(at & ~0x3FF)
        if place is not None:
            place.write(at & 0x3FF, value)
        elif at & ~0x3FF == 0x40023800:
            self._rcc_write(at & 0x3FF, value)
        elif at in (0x40020018, 0x40020418):
            port = at & ~0x3FF
            old = self.plain.get(port + 0x14, 0)
            self.plain[port + 0x14] = old & ~(value >> 16) | value & 0xFFFF
            self.drivers.look()
        elif 0xE000E010 <= at < 0xE000E020:
            self.systick.write(at & 0xFF, value)
        elif 0xE000E100 <= at < 0xE000E120:
            self.enabled |= numbers(at - 0xE000E100, value)
        elif 0xE000E280 <= at < 0xE000E2A0:
            self.pending -= numbers(at - 0xE000E280, value) - self.lines
        elif 0xE000E400 <= at < 0xE000E500:
            self.priorities[16 + at - 0xE000E400] = value & 0xF0
        elif at == PWR_CR:
            assert self.plain.get(0x40023840, 0) & 1 << 28, "PWR without its clock"
            assert self.cycle != 2 or value & 1 << 14, SCALE
            self.plain[at] = value
        elif at == 0xE000ED0C:
            assert value == 0x05FA0004
            self.restarts = True
            self.uc.emu_stop()
        elif at == 0xE000ED04:
            assert value == 1 << 25
            self.pending.discard(15)
        else:
            self.plain[at] = value
            if at in (0x40020000, 0x40020400):
                self.drivers.look()

    # -- exceptions

    def set_line(self, number, high):
        if high:
            self.lines.add(number)
            self.pending.add(number)
        else:
            self.lines.discard(number)

    def _priority(self, number):
        return {2: -2, 3: -1}.get(number, self.priorities.get(number, 0))

    def _take(self):
        ready = [n for n in self.pending if n < 16 or n in self.enabled]
        if not ready:
            return
        number = min(ready, key=lambda n: (self._priority(n), n))
        if self.active and self._priority(number) >= min(map(self._priority, self.active)):
            return
        self.pending.discard(number)
        self.exception(number)
        self.entered.append((number, self.now))

    def exception(self, number):
        """Enter an exception: eight words go onto the stack."""
        c, uc = arm_const, self.uc
        frame = [*map(uc.reg_read, KEPT), self.pc, uc.reg_read(c.UC_ARM_REG_XPSR) | 1 << 24]
        stack = uc.reg_read(c.UC_ARM_REG_SP)
        stack -= 32
        uc.mem_write(stack, struct.pack("<8I", *frame))
        uc.reg_write(c.UC_ARM_REG_SP, stack)
        uc.reg_write(c.UC_ARM_REG_LR, RETURN | 1)
        table = self.plain.get(0xE000ED08, 0) or 0x08000000
        handler = struct.unpack("<I", uc.mem_read(table + 4 * number, 4))[0]
        assert handler & 1, f"exception {number} has no handler"
        self.pc = handler & ~1
        self.active.append(number)
        self.now += 12 * self.cycle

    def _leave(self):
        c, uc = arm_const, self.uc
        stack = uc.reg_read(c.UC_ARM_REG_SP)
        *kept, self.pc, status = struct.unpack("<8I", uc.mem_read(stack, 32))
        for register, value in zip(KEPT, kept, strict=True):
            uc.reg_write(register, value)
        uc.reg_write(c.UC_ARM_REG_XPSR, status & 0xFF000000)
        uc.reg_write(c.UC_ARM_REG_SP, stack + 32)
        ended = self.active.pop()
        if self.entered:
            number, at = self.entered.pop()
            self.longest[number] = max(self.longest.get(number, 0), self.now - at)
        if ended in self.lines:
            self.pending.add(ended)
        self.now += 12 * self.cycle

    # -- time

    def at(self, time, event):
        """Do this then."""
        heapq.heappush(self.events, (time, next(self.order), event))

    def _next(self):
        """When something happens that the core does not do."""
        return min(self.iwdg.due, self.events[0][0] if self.events else NEVER)

    def _events(self):
        while self._next() <= self.now:
            if self.iwdg.due <= self.now:
                self.reset(RESET_BY_IWDG)
                return
            time, _, event = heapq.heappop(self.events)
            now, self.now = self.now, time
            event()
            self.now = max(now, self.now)

    def run(self, us):
        """Let `us` microseconds pass."""
        end = self.now + round(us * US)
        while self.now < end:
            self._events()
            until = min(end, self._next())
            if self.core_stands:
                self.now = max(self.now, until)
                continue
            self._take()
            instructions = max(1, min(SLICE, (until - self.now) // self.cycle))
            self.uc.emu_start(self.pc | 1, RETURN, count=instructions)
            if self.restarts:
                self.restarts = False
                self.reset(RESET_BY_SOFTWARE)
                continue
            self.now += instructions * self.cycle
            before, self.pc = self.pc, self.uc.reg_read(arm_const.UC_ARM_REG_PC)
            if self.pc == RETURN:
                self._leave()
            elif self.pc == before and self.uc.mem_read(before, 2) == TO_ITSELF:
                self.now = max(self.now, until)


class ModelLine:
    """The host's line to the model, as a `Transport`; its clock is the model's."""

    def __init__(self, chip):
        self.name = "model:"
        self.chip = chip

    def time_s(self):
        return self.chip.now / UNIT_HZ

    def read(self, timeout_s):
        """Bytes from the board; time passes until some come, or `timeout_s` is over."""
        end = self.chip.now + max(50 * US, int(timeout_s * UNIT_HZ))
        while not self.chip.usart.to_host and self.chip.now < end:
            self.chip.run(50)
        data = bytes(self.chip.usart.to_host)
        self.chip.usart.to_host.clear()
        return data

    def write(self, data):
        self.chip.usart.arrive(data)

    def close(self):
        """Nothing to let go."""


def connect(chip):
    """A session with the firmware on a model."""
    return Board(Session(ModelLine(chip), Timing(latency_s=0.02)))


def lit_rows(log):
    """Rows that the latch showed, from the first lit one on, (n, 96), and when."""
    shown = [s for s in log if s.latched and not s.dark]
    while shown and not shown[0].row:
        del shown[0]
    rows = [[int(bit) for bit in f"{s.row:096b}"] for s in shown]
    return np.array(rows, np.uint8).reshape(-1, 96), np.array([s.time for s in shown])
