"""The board: programming, chips on the model of the STM32F405, streams, flashing.

    python benchmarks/board.py [program] [stm32] [stream] [flash]

Prints Markdown, all sections without a name. Times of the model are virtual and the same in every run; it
counts an instruction of the core as a clock.
"""

import argparse
import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.scene.bar import BarLayout, LedTable
from firmware_host import build
from firmware_host.board.bank import Bank, make_bank, random_packets
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.emulators.simulated import SimulatedBoard
from firmware_host.errors import BoardError
from firmware_host.images import FlashImage
from firmware_host.ports.rom import RomLoader, flash_image
from firmware_host.protocol.client import Timing
from firmware_host.protocol.generated.requests import CommitRequest
from tests.models.usb import UsbLine

BAUD = 1_000_000
CHIP_US = 100
STREAMED = 200


def program() -> None:
    """64 packets behind a USB bridge against the time that their bytes take, by the board's clock."""
    link = load_link()
    bank = make_bank(random_packets(64, link, 0), link)
    board = SimulatedBoard()
    with Session(UsbLine(board, 0.002, BAUD, 0.001), Timing(BAUD)) as session:
        provision(Board(session), bank, Settings())
    wire_s = 10 * len(bank.content) / BAUD
    print(
        f"64 packets verified and playing: {board.now_us / 1e6 / wire_s:.2f} times the wire's {wire_s:.3f} s"
    )


def stm32() -> None:
    """What interrupts and COMMIT take on the model, by bank, and how soon it is dark on a fault."""
    from tests.models.stm32 import US, Dma, Stm32, connect

    def model() -> tuple[Stm32, Board]:
        chip = Stm32(build.arm_image("stm32f405"))
        chip.run(15_000)
        return chip, connect(chip)

    print("| bank | chip interrupt, us | COMMIT, ms |\n|---|---|---|")
    for name, bank in full_banks().items():
        chip, board = model()
        board.prepare_commit(bank)
        board.write_missing(0, bank.content)
        sizes = (bank.format, bank.packets, len(bank.content), bank.crc)
        began = chip.now
        board.session.call(CommitRequest(0, *sizes, bank.digest))
        commit_ms = (chip.now - began) / US / 1e3
        board.start()
        chip.run(10_000)
        print(f"| {name} | {chip.longest[16 + Dma.IRQ] / US:.1f} | {commit_ms:.1f} |")
    breaks: dict[str, Callable[[Stm32], object]] = {
        "TIM1 stands": lambda chip: chip.tim1.stop_for_good(),
        "DMA stands": lambda chip: setattr(chip.dma, "dead", True),
        "DMA transfer error": lambda chip: chip.dma.error(Dma.TRANSFER_ERROR),
        "SPI1 stands": lambda chip: setattr(chip.spi, "dead", True),
        "TIM3 stands": lambda chip: chip.tim3.stop_for_good(),
        "crystal stops": lambda chip: chip.stop_crystal(),
        "supply falls": lambda chip: chip.pending.add(16 + 1),
    }
    link = load_link(overrides=["air.frames_per_packet=4"])
    print("\n| fault at a random moment | dark after, chips at most |\n|---|---|")
    for name, fail in breaks.items():
        late_us = []
        for moment in range(12):
            rng = np.random.default_rng(moment)
            chip, board = model()
            symbols = rng.integers(0, link.codebook.data_symbols, (1, 4, 16))
            provision(board, make_bank(symbols, link), Settings())
            chip.run(5_000 + float(rng.uniform(0, 1_000)))
            at = chip.now
            fail(chip)
            chip.run(1_000)
            dark = max(s.time for s in chip.drivers.log if s.dark) if chip.drivers.dark else np.inf
            late_us.append((dark - at) / US)
        print(f"| {name} | {max(late_us) / CHIP_US:.2f} |")


def full_banks() -> dict[str, Bank]:
    """A bank of each kind, as full as it gets; every chip that is lit lights every LED."""
    link = load_link()
    found = {"words": make_bank(random_packets(128, link, 1), link)}
    for clusters in (1, 10, 16, 88, 96):
        drawn = np.random.default_rng(1).integers(0, 2, (clusters + 2, 48), dtype=np.uint8)
        own = Codebook("drawn", link.codebook.preamble, drawn[:-2], drawn[-2:])
        row = -(-clusters // 8)
        most = (40_960 - (12 * clusters if row < 12 else 0)) // row
        packet = replace(PacketFormat.of(own, 1), preamble_chips=most - 96)
        light = np.tile(np.array([[1], [0]], np.uint8), (most, clusters))[:most]
        name = f"{clusters} clusters" if row < 12 else "masks of each LED"
        leds = tuple((0.0, n / 100, 0.0, n * clusters // 96) for n in range(96))
        bar = BarLayout(LedTable(leds))
        found[name] = Bank.of_chips(light, replace(link, codebook=own, packet=packet, bar=bar))
    return found


@dataclass(frozen=True)
class Measured:
    """Delays, ms, of some packets, and what they took."""

    delays_ms: np.ndarray
    round_trips: float
    underruns: int


def stream() -> None:
    """Delay of a streamed packet from the call to its first chip, on a line of 1 Mbit/s behind USB.

    `alone`: each packet when the board has none; else so many are kept on the board.
    """
    print("| USB latency | queue | median, ms | largest | round trips a packet | underruns |")
    print("|---|---|---|---|---|---|")
    for latency_s in (0.0, 1e-3, 16e-3):
        rows = [("alone", measure_stream(latency_s, 4, 0.1))]
        rows += [(f"{ahead} on the board", measure_stream(latency_s, ahead, 0.0)) for ahead in (2, 4, 8)]
        for name, m in rows:
            underruns = "-" if name == "alone" else m.underruns
            print(
                f"| {latency_s * 1e3:g} ms | {name} | {np.median(m.delays_ms):.1f} | {m.delays_ms.max():.1f}"
                f" | {m.round_trips:.2f} | {underruns} |"
            )


def measure_stream(latency_s: float, ahead: int, pause_s: float, packets: int = STREAMED) -> Measured:
    """Stream packets, each `pause_s` after the one before has gone out; the board has virtual time."""
    link, device = load_link(), SimulatedBoard()
    symbols = random_packets(packets, link, 0)
    session = Session(UsbLine(device, latency_s, frame_s=1e-3), Timing(), first=1, nonce=1)
    calls = []
    with Board(session).stream(link, ahead) as streamed:
        for packet in symbols:
            calls.append(device.now_us)
            streamed.send(packet)
            if pause_s:
                streamed.wait(pause_s)
    played = device.take_led_record().select_chips()
    starts = starts_of(played.chips(), played.ticks, symbols.shape[0], link.packet.packet_chips)
    delays_ms = (np.array(starts) / (device.TICK_HZ / 1e6) - np.array(calls)) / 1e3
    return Measured(delays_ms, streamed.requests / packets, streamed.underruns)


def starts_of(chips: np.ndarray, ticks: np.ndarray, packets: int, packet_chips: int) -> list[int]:
    """Tick of each packet's first chip; between packets there may be the idle pattern."""
    preamble = load_link().codebook.preamble
    found, at = [], 0
    while len(found) < packets:
        while not (chips[at : at + len(preamble)] == preamble[:, None]).all():
            at += 1
        found.append(int(ticks[at]))
        at += packet_chips
    return found


def flash() -> None:
    """What flashing by the part's ROM takes by the line's clock, with bytes lost or turned, too."""
    from tests.models.rom import RomEmulator, RomLine

    class BadLine(RomLine):
        """Loses or turns a byte in so many, both ways."""

        def __init__(self, rom: RomEmulator, one_in: int, seed: int) -> None:
            super().__init__(rom)
            self._one_in, self._rng = one_in, np.random.default_rng(seed)

        def to_part(self, data: bytes) -> bytes:
            dice = self._rng.integers(0, 2 * self._one_in, len(data))
            return bytes(b ^ (0x10 * (d == 1)) for b, d in zip(data, dice, strict=True) if d)

        to_host = to_part

    image = FlashImage.read(build.arm_image("stm32f405"))
    for one_in in (0, 10_000, 3_000):
        right, seconds = 0, []
        for seed in range(10):
            rom = RomEmulator()
            line = BadLine(rom, one_in, seed) if one_in else RomLine(rom)
            with contextlib.suppress(BoardError):
                flash_image(RomLoader(line), image)
                right += rom.flash[: len(image.data)] == image.data
                seconds.append(line.time_s())
        kind = f"a byte in {one_in} bad" if one_in else "a good line"
        print(f"flash {len(image.data)} bytes, {kind}: {right} of 10 right, {np.mean(seconds):.1f} s")


SECTIONS: dict[str, Callable[[], None]] = {
    "program": program, "stm32": stm32, "stream": stream, "flash": flash,
}  # fmt: skip


def main() -> None:
    """Print the sections that are named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=", ".join(SECTIONS))
    given = parser.parse_args().sections or list(SECTIONS)
    for name in given:
        if name not in SECTIONS:
            parser.error(f"{name}: expected {', '.join(SECTIONS)}")
        print(f"\n## {name}\n")
        SECTIONS[name]()


if __name__ == "__main__":
    main()
