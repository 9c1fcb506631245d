"""The STM32F405 image on its model, for a host at a socket: `evlcp board emulate stm32` runs it.

The model is slower than the part, and never faster: its time is that of the clock, or behind it. A record
holds each row that the latches took while the outputs were on, and the time, in ticks of 14 MHz.
"""

import argparse
import struct
import sys
import time
from pathlib import Path
from typing import BinaryIO

from firmware_host.emulators.listening import HostLine
from firmware_host.errors import ToolchainError
from firmware_host.protocol.generated.requests import CHIP_DARK, LEDS
from tests.models.stm32 import UNIT_HZ, Shown, Stm32

__all__ = ["main", "records", "serve"]

_UNITS_A_TICK = UNIT_HZ // 14_000_000
_STEP_US = 200


def records(log: list[Shown], chip: int = 0) -> tuple[bytes, int]:
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
        out.append(struct.pack("<2I", shown.time // _UNITS_A_TICK & 0xFFFFFFFF, number) + row)
    return b"".join(out), chip


def serve(chip: Stm32, line: HostLine, leds: BinaryIO | None = None) -> None:
    """Run a model for hosts, one at a time, until it is ended."""
    begun, number = time.monotonic(), 0
    while True:
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
            packed, number = records(done, number)
            if leds is not None:
                leds.write(packed)
                leds.flush()


def main(arguments: list[str] | None = None) -> None:
    """Run the model of an image until it is ended."""
    parser = argparse.ArgumentParser(prog="python -m tests.models.stm32_server")
    parser.add_argument("image", type=Path)
    parser.add_argument("--listen", required=True)
    parser.add_argument("--leds", type=Path)
    options = parser.parse_args(arguments)
    leds = options.leds.open("wb") if options.leds else None
    try:
        serve(Stm32(options.image), HostLine(options.listen), leds)
    except KeyboardInterrupt:
        pass
    except ToolchainError as fault:
        sys.stderr.write(f"stm32: {fault}\n")
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
