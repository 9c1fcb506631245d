"""The STM32F405 image on the model of the part: what it shows, how fast it is dark, what its interrupts take.

Prints a table; times are the model's, which counts an instruction of the core as a clock.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.link.resolve import load_link
from firmware_host import build
from firmware_host.board.bank import Bank, random_symbols, symbol_chips
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.protocol.client import Timing
from firmware_host.protocol.requests import CommitReply, CommitRequest, State

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.models.stm32 import US, Dma, ModelLine, Stm32, Usart

MOMENTS = 12
CHIP_US = 100
BREAKS = {
    "TIM1 stands": lambda chip: chip.tim1.stop_for_good(),
    "DMA stands": lambda chip: setattr(chip.dma, "dead", True),
    "DMA transfer error": lambda chip: chip.dma.error(Dma.TRANSFER_ERROR),
    "SPI1 stands": lambda chip: setattr(chip.spi, "dead", True),
    "TIM3 stands": lambda chip: chip.tim3.stop_for_good(),
    "crystal stops": lambda chip: chip.stop_crystal(),
    "supply falls": lambda chip: chip.pending.add(16 + 1),
}


def programmed(seed: int) -> tuple[Stm32, Board, np.ndarray]:
    """A bar on the model, and its rows from the first lit one on."""
    book = load_link().codebook
    chip = Stm32(build.arm_image("stm32f405"))
    chip.run(15_000)
    board = Board(Session(ModelLine(chip), Timing(latency_s=0.02)))
    symbols = random_symbols(1, 4, book, np.random.default_rng(seed))
    provision(board, Bank.of_symbols(symbols, book), Settings(start=False))
    chips = symbol_chips(symbols, book)
    rows = np.repeat(np.roll(chips, -int(chips.any(1).argmax()), axis=0), 6, axis=1)
    return chip, board, rows


def right(chip: Stm32, begin: int, rows: np.ndarray) -> tuple[int, int]:
    """How many of the rows since `begin` are right, and how many there are."""
    shown = [s.row for s in chip.drivers.log[begin:] if s.latched and not s.dark]
    while shown and not shown[0]:
        del shown[0]
    bits = np.array([[int(bit) for bit in f"{row:096b}"] for row in shown], np.uint8)
    return int((bits == np.resize(rows, bits.shape)).all(1).sum()), len(bits)


def banks() -> dict[str, Bank]:
    """A bank of each kind, as full as it gets; every chip that is lit lights every LED."""
    link = load_link()
    book = link.codebook
    symbols = random_symbols(128, 10, book, np.random.default_rng(1))
    found = {"words": Bank.of_symbols(symbols, book)}
    for clusters in (1, 10, 16, 88, 96):
        leds = np.arange(96) * clusters // 96
        drawn = np.random.default_rng(1).integers(0, 2, (clusters + 2, 48), dtype=np.uint8)
        own = Codebook("drawn", book.preamble, drawn[:-2], drawn[-2:])
        row = -(-clusters // 8)
        most = (40_960 - (12 * clusters if row < 12 else 0)) // row
        packet = replace(PacketFormat.of(own, 1), preamble_chips=most - 96)
        chips = np.tile(np.array([[1], [0]], np.uint8), (most, clusters))[:most]
        found[f"{clusters} clusters" if row < 12 else "masks of each LED"] = Bank.of_chips(
            chips, own, packet, leds
        )
    return found


def take(bank: Bank) -> tuple[float, float]:
    """What the chip interrupt takes at most with a full bank, us, and how long a COMMIT of it does, ms."""
    chip = Stm32(build.arm_image("stm32f405"))
    chip.run(15_000)
    board = Board(Session(ModelLine(chip), Timing(latency_s=0.02)))
    board.prepare(bank)
    board.fill(0, bank.content)
    request = CommitRequest(
        0, bank.format, bank.packets, len(bank.content), bank.crc, bytes.fromhex(bank.digest)
    )
    began = chip.now
    board.session.call(request, CommitReply)
    took = chip.now - began
    board.start()
    chip.run(10_000)
    status = board.status()
    assert status.state == State.PLAYING
    return chip.longest[16 + Dma.IRQ] / US, took / US / 1e3


def main() -> None:
    """Print the table."""
    for name, bank in banks().items():
        interrupt_us, commit_ms = take(bank)
        print(
            f"{name:24} chip interrupt {interrupt_us:.1f} us at most; {bank.packets * bank.packet_chips}"
            f" chips in {len(bank.content)} bytes, COMMIT answered after {commit_ms:.1f} ms"
        )
    chip, board, rows = programmed(1)
    for n in range(1, 5):
        begin = len(chip.drivers.log)
        board.start()
        chip.run(21_500)
        good, shown = right(chip, begin, rows)
        print(f"START {n}                  {good} of {shown} chips right on 96 LEDs")
        board.blank()
    status = board.status()
    print(f"chip interrupt           {chip.longest[16 + Dma.IRQ] / US:.1f} us at most, a chip is {CHIP_US}")
    print(f"receive interrupt        {chip.longest[16 + Usart.IRQ] / US:.1f} us at most, a byte is 10")
    print(f"bytes lost               {status.overflow_errors}, datagrams {status.crc_errors}")
    for name, breaks in BREAKS.items():
        late = []
        for moment in range(MOMENTS):
            rng = np.random.default_rng(moment)
            chip, board, _ = programmed(1)
            board.start()
            chip.run(5_000 + float(rng.uniform(0, 1_000)))
            at = chip.now
            breaks(chip)
            chip.run(1_000)
            late.append(
                (max(s.time for s in chip.drivers.log if s.dark) - at) / US if chip.drivers.dark else 1e9
            )
        faults = board.status().faults
        print(
            f"{name:24} dark after {max(late) / CHIP_US:.2f} chips at most, of {MOMENTS}; faults {faults:#x}"
        )


if __name__ == "__main__":
    main()
