"""An STM32F405 that waits in its ROM, for a host at a socket: `evlcp board emulate rom` runs it.

What it is told to run then runs on the model of the part, at the same socket, where `unicorn` is installed.
"""

import argparse
import contextlib
import importlib.util
import sys
from pathlib import Path

from firmware_host.emulators.listening import HostLine
from firmware_host.errors import ToolchainError
from firmware_host.images import FLASH_START, FlashImage
from tests.models.rom import RomEmulator

__all__ = ["main", "serve_rom"]

_BOOT_US = 15_000


def serve_rom(rom: RomEmulator, line: HostLine, flash: Path | None = None) -> None:
    """Let hosts talk to a ROM, one after the other, until one has it run something.

    Args:
        rom: The part.
        line: Where hosts come.
        flash: File that holds its flash whenever it has changed.
    """
    answer, held = b"", b""
    while rom.started is None:
        data = line.exchange(answer, 0.0 if answer else 0.2)
        answer = rom.receive(data) if data else b""
        if not data and flash is not None and rom.flash != held:
            held = bytes(rom.flash)
            flash.write_bytes(held)
    line.exchange(answer, 0.0)
    if flash is not None:
        flash.write_bytes(rom.flash)


def _runs(flash: bytes, line: HostLine, leds: Path | None) -> None:
    """Run what was flashed, by a crystal of 8 MHz or else of 12."""
    from tests.models.stm32 import Stm32
    from tests.models.stm32_server import serve

    image = FlashImage(FLASH_START, flash)
    for hse_hz in (8_000_000, 12_000_000):
        chip = Stm32(image, hse_hz)
        try:
            chip.run(_BOOT_US)
        except AssertionError as fault:
            wrong = fault
            continue
        with contextlib.ExitStack() as stack:
            serve(chip, line, stack.enter_context(leds.open("wb")) if leds else None)
    sys.stderr.write(f"rom: what was flashed does not run on the model: {wrong}\n")
    raise SystemExit(1)


def main(arguments: list[str] | None = None) -> None:
    """Be a part to flash until it is ended."""
    parser = argparse.ArgumentParser(prog="python -m tests.models.rom_server")
    parser.add_argument("--listen", required=True)
    parser.add_argument("--flash", type=Path)
    parser.add_argument("--leds", type=Path)
    options = parser.parse_args(arguments)
    try:
        held = options.flash.read_bytes() if options.flash and options.flash.exists() else None
        line = HostLine(options.listen)
        rom = RomEmulator(held)
        serve_rom(rom, line, options.flash)
        if importlib.util.find_spec("unicorn") is None:
            sys.stderr.write("rom: told to run; 'pip install unicorn' for the model that does\n")
            return
        _runs(bytes(rom.flash), line, options.leds)
    except KeyboardInterrupt:
        pass
    except (OSError, ToolchainError) as fault:
        sys.stderr.write(f"rom: {fault}\n")
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
