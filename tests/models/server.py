"""An STM32F405 for a host at a socket: `evlcp board emulate stm32` and `rom` run it.

With an image that runs on the model of the part. Without one the part waits in its ROM; what it is told to
run then runs on the model, at the same socket, where `unicorn` is installed. The model is slower than the
part, and never faster: its time is that of the clock, or behind it. A record holds each row that the latches
took while the outputs were on, and the time, in ticks of 14 MHz.
"""

import contextlib
import importlib.util
import struct
import time

from firmware_host.errors import ToolchainError
from firmware_host.images import FLASH_START, FlashImage
from firmware_host.protocol.generated.requests import CHIP_DARK, LEDS
from tests.models.rom import RomEmulator

_TICK_HZ = 14_000_000
_STEP_US = 200
_BOOT_US = 15_000


def records(log, chip, units_a_tick):
    """LED records of what was shown, chips numbered from where the outputs go on; and the next number."""
    out = []
    for shown in log:
        if shown.dark:
            number, chip = CHIP_DARK, 0
        elif shown.latched:
            number, chip = chip, chip + 1
        else:
            continue
        row = shown.row.to_bytes(LEDS // 8, "big")
        out.append(struct.pack("<2I", shown.time // units_a_tick & 0xFFFFFFFF, number) + row)
    return b"".join(out), chip


def serve(chip, line, leds, stopped):
    """Run a model for hosts, one at a time, until it is stopped."""
    from tests.models.stm32 import UNIT_HZ

    begun, number = time.monotonic(), 0
    while not stopped():
        chip.run(_STEP_US)
        ahead = chip.now / UNIT_HZ - (time.monotonic() - begun)
        if ahead < 0:
            begun -= ahead  # what was lost is not caught up with
        sent = bytes(chip.usart.to_host)
        chip.usart.to_host.clear()
        chip.usart.arrive(line.exchange(sent, max(0.0, ahead)))
        if len(chip.drivers.log) > 1:
            # the last one is what the drivers compare the next with
            done, chip.drivers.log[:] = chip.drivers.log[:-1], chip.drivers.log[-1:]
            packed, number = records(done, number, UNIT_HZ // _TICK_HZ)
            if leds is not None:
                leds.write(packed)
                leds.flush()


def serve_rom(rom, line, flash, stopped):
    """Let hosts talk to a ROM until one has it run something; a file holds its flash whenever it changes."""
    answer, held = b"", b""
    while rom.started is None and not stopped():
        data = line.exchange(answer, 0.0 if answer else 0.2)
        answer = rom.receive(data) if data else b""
        if not data and flash is not None and rom.flash != held:
            held = bytes(rom.flash)
            flash.write_bytes(held)
    line.exchange(answer, 0.0)
    if flash is not None:
        flash.write_bytes(rom.flash)


def flashed_part(flash):
    """The model of a part with this flash, by a crystal of 8 MHz or else of 12."""
    from tests.models.stm32 import Stm32

    for hse_hz in (8_000_000, 12_000_000):
        chip = Stm32(FlashImage(FLASH_START, flash), hse_hz)
        with contextlib.suppress(AssertionError):
            chip.run(_BOOT_US)
            return chip
    raise ToolchainError("what was flashed does not run on the model")


def serve_part(line, image, flash, leds, stopped):
    """Be a part until it is stopped."""
    with contextlib.ExitStack() as stack:
        record = None if leds is None else stack.enter_context(leds.open("wb"))
        if image is None:
            rom = RomEmulator(flash.read_bytes() if flash is not None and flash.exists() else None)
            serve_rom(rom, line, flash, stopped)
            if stopped():
                return
            if importlib.util.find_spec("unicorn") is None:
                raise ToolchainError("told to run; 'pip install unicorn' for the model that does")
            chip = flashed_part(bytes(rom.flash))
        else:
            from tests.models.stm32 import Stm32

            chip = Stm32(image)
        serve(chip, line, record, stopped)
