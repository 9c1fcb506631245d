"""An STM32F405 that waits in its ROM, for a host at a socket: `evlcp board emulate rom` runs it.

What it is told to run then runs on the model of the part, at the same socket, where `unicorn` is installed.
"""

import argparse
import contextlib
import importlib.util
import socket
import sys
from pathlib import Path

from firmware_host.emulators.listening import listener
from firmware_host.images import FLASH_START, FlashImage
from tests.models.rom import RomEmulator

__all__ = ["main", "serve_rom"]

_BOOT_US = 15_000


def serve_rom(rom: RomEmulator, server: socket.socket, flash: Path | None = None) -> socket.socket:
    """Let hosts talk to a ROM, one after the other, until one has it run something; that one's line.

    Args:
        rom: The part.
        server: Where hosts come.
        flash: File that holds its flash whenever a host has left.
    """
    while True:
        line, _ = server.accept()
        while rom.started is None and (data := _received(line)):
            line.sendall(rom.receive(data))
        if flash is not None:
            flash.write_bytes(rom.flash)
        if rom.started is not None:
            return line
        line.close()


def _received(line: socket.socket) -> bytes:
    try:
        return line.recv(4096)
    except OSError:
        return b""


def _runs(flash: bytes, server: socket.socket, line: socket.socket, leds: Path | None) -> None:
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
            serve(chip, server, stack.enter_context(leds.open("wb")) if leds else None, line)
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
        server = listener(options.listen)
        rom = RomEmulator(held)
        line = serve_rom(rom, server, options.flash)
        if importlib.util.find_spec("unicorn") is None:
            sys.stderr.write("rom: told to run; 'pip install unicorn' for the model that does\n")
            return
        _runs(bytes(rom.flash), server, line, options.leds)
    except KeyboardInterrupt:
        pass
    except OSError as fault:
        sys.stderr.write(f"rom: {fault.filename or options.listen}: {fault.strerror}\n")
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
