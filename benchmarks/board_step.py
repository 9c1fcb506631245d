"""Two STM32 boards on the model, crystals at +30 and -30 ppm: how far apart their chips are, in step and not.

Prints the largest distance, in chips, over so many chips; pulses come a hundred times a second.
"""

import sys
from pathlib import Path

import numpy as np

from evlcp_sdk.link.resolve import load_link
from firmware_host import build
from firmware_host.board.bank import Bank, random_symbols
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.protocol.client import Timing

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.models.stm32 import UNIT_HZ, US, ModelLine, Stm32

PULSE_HZ = 100
CHIPS = 3_000
CHIP_US = 100


def chip_times_us(ppm: float, in_step: bool) -> np.ndarray:
    """True times of the chips, from the pulse or the moment of the start on."""
    book = load_link().codebook
    rate = 1 + ppm * 1e-6
    chip = Stm32(build.arm_image("stm32f405"))
    for n in range(1, 50):
        chip.pulse_at(n * UNIT_HZ / PULSE_HZ * rate)
    chip.run(22_000)
    board = Board(Session(ModelLine(chip), Timing(latency_s=0.02)))
    symbols = random_symbols(1, 4, book, np.random.default_rng(0))
    provision(board, Bank.of_symbols(symbols, book), Settings(start=False))
    status = board.status()
    begin = len(chip.drivers.log)
    start_us = (status.pulses + 2) * 1e6 / PULSE_HZ
    if in_step:
        board.start(status.pulses + 2, PULSE_HZ)
    else:
        start_us = (chip.now / US + 20_000) / rate
        board.start(at_clock=(status.clock + round(84 * (20_000 + chip.now / US)) - status.clock) % 2**32)
    chip.run(20_000 + CHIP_US * CHIPS)
    latched = [s.time for s in chip.drivers.log[begin:] if s.latched and not s.dark]
    return np.array(latched[:CHIPS]) / US / rate - start_us


def main() -> None:
    """Print both."""
    for in_step in (True, False):
        fast, slow = (chip_times_us(ppm, in_step) for ppm in (30.0, -30.0))
        apart = fast - slow if in_step else (fast - fast[0]) - (slow - slow[0])
        name = "in step" if in_step else "by their own crystals"
        print(f"{name:22} {np.abs(apart).max() / CHIP_US:.3f} chips apart at most, {len(apart)} chips")


if __name__ == "__main__":
    main()
