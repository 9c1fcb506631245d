"""Firmware into a part by its ROM, and over the line of a board: what it takes, and where power may fail.

Prints the time that flashing takes by the clock of the line, on lines that lose bytes too, and how, after an
update, the board comes back from a power cut at each word and erase of the flash.
"""

import contextlib
import sys
from pathlib import Path

import numpy as np

from firmware_host import build
from firmware_host.board.board import Board
from firmware_host.board.session import Session
from firmware_host.board.update import Package, confirm, update, update_status
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import BoardError
from firmware_host.images import FlashImage
from firmware_host.ports.rom import RomLoader, flash_image
from firmware_host.protocol.client import Timing

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.models.rom import RomEmulator, RomLine

IMAGE_BYTES = 400
OPERATIONS = 1 + IMAGE_BYTES // 4 + 5 + 1 + 1  # erase, content, seal, try, confirmed


class BadLine(RomLine):
    """Loses or turns a byte in so many."""

    def __init__(self, rom: RomEmulator, one_in: int, seed: int) -> None:
        super().__init__(rom)
        self._one_in, self._rng = one_in, np.random.default_rng(seed)

    def to_part(self, data: bytes) -> bytes:
        """What arrives."""
        return self._harm(data)

    def to_host(self, data: bytes) -> bytes:
        """What arrives."""
        return self._harm(data)

    def _harm(self, data: bytes) -> bytes:
        dice = self._rng.integers(0, 2 * self._one_in, len(data))
        return bytes(b ^ (0x10 * (d == 1)) for b, d in zip(data, dice, strict=True) if d)


def package(seed: int) -> Package:
    """Two images of random bytes."""
    draw = np.random.default_rng(seed)
    return Package("native", {n: draw.integers(0, 256, IMAGE_BYTES, np.uint8).tobytes() for n in (1, 2)})


def connect(device: SimulatedBoard) -> Board:
    """A session with a board."""
    return Board(Session(SimulatedLine(device), Timing(latency_s=0.01)))


def cut(left: int) -> str:
    """What a board runs after an update that the power failed in, and another one after it."""
    device = SimulatedBoard()
    update(connect(device), package(1))
    device.cut_power(left)
    with contextlib.suppress(BoardError):
        update(connect(device), package(2), wait_s=0.5)
    device.cut_power(0)
    device.reset()
    ran = device.running()
    whole = ran in (1, 2) and device.image(ran, IMAGE_BYTES) == package(ran).images[ran]
    board = connect(device)
    if update_status(board).trial:
        confirm(board)
    done = update(board, package(3))
    return ("new" if ran == 2 else "old") if whole and device.running() == done.image else "lost"


def main() -> None:
    """Print both tables."""
    image = FlashImage.read(build.arm_image("stm32f405"))
    for one_in in (0, 10_000, 3_000):
        right, seconds = 0, []
        for seed in range(10):
            rom = RomEmulator()
            line = BadLine(rom, one_in, seed) if one_in else RomLine(rom)
            with contextlib.suppress(BoardError):
                flash_image(RomLoader(line), image)
                right += rom.flash[: len(image.data)] == image.data
                seconds.append(line.now())
        kind = f"a byte in {one_in} bad" if one_in else "a good line"
        print(f"flash {len(image.data)} bytes, {kind:22} {right} of 10 right, {np.mean(seconds):.1f} s")
    ends = [cut(left) for left in range(1, OPERATIONS + 1)]
    counts = ", ".join(f"{name} {ends.count(name)}" for name in ("old", "new", "lost"))
    print(f"update, power cut at each of {OPERATIONS} words and erases: {counts}")


if __name__ == "__main__":
    main()
