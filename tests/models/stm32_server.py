"""The STM32F405 image on its model, for a host at a socket: `evlcp board emulate stm32` runs it.

The model is slower than the part, and never faster: its time is that of the clock, or behind it. A record
holds each row that the latches took while the outputs were on, and the time, in ticks of 14 MHz.
"""

import argparse
import selectors
import socket
import struct
import sys
import time
from pathlib import Path
from typing import BinaryIO

from firmware_host.emulators.listening import listener
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


def serve(
    chip: Stm32, server: socket.socket, leds: BinaryIO | None = None, line: socket.socket | None = None
) -> None:
    """Run a model for hosts at a socket, one at a time, until it is ended; `line` is the first one's."""
    begun, number = time.monotonic(), 0
    with selectors.DefaultSelector() as selector:
        selector.register(server, selectors.EVENT_READ)
        if line is not None:
            selector.register(line, selectors.EVENT_READ)
        while True:
            chip.run(_STEP_US)
            ahead = chip.now / UNIT_HZ - (time.monotonic() - begun)
            if ahead < 0:
                begun -= ahead  # what was lost is not caught up with
            for key, _ in selector.select(max(0.0, ahead)):
                if key.fileobj is server:
                    found, _ = server.accept()
                    if line is not None:
                        found.close()  # a board has one host
                        continue
                    line = found
                    selector.register(line, selectors.EVENT_READ)
                elif line is not None:
                    try:
                        data = line.recv(4096)
                    except OSError:
                        data = b""
                    if data:
                        chip.usart.arrive(data)
                    else:
                        selector.unregister(line)
                        line.close()
                        line = None
            if chip.usart.to_host:
                data = bytes(chip.usart.to_host)
                chip.usart.to_host.clear()
                if line is not None:
                    line.sendall(data)
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
        serve(Stm32(options.image), listener(options.listen), leds)
    except KeyboardInterrupt:
        pass
    except OSError as fault:
        sys.stderr.write(f"stm32: {options.listen}: {fault.strerror}\n")
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
