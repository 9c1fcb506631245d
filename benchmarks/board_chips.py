"""Chip timing of the ARM image in QEMU while the host asks for STATUS without pause.

Prints the intervals between LED outputs in virtual time, how often the host asked, the delay of the latest
chip, and a hash of the trace that is the same in every run.
"""

import hashlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evlcp_sdk.link.resolve import load_link
from firmware_host.board.bank import Bank, bank_of, random_symbols, symbol_chips
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.emulators.led_record import LedRecord
from firmware_host.emulators.processes import start_qemu
from firmware_host.protocol.client import RequestOutcome
from firmware_host.protocol.requests import StatusReply, StatusRequest
from firmware_host.protocol.wire import WireMessage

CHIPS = 20_000
TICKS_PER_US = 25.0


def play(leds: Path, bank: Bank) -> tuple[int, StatusReply]:
    with Session(start_qemu(leds)) as session:
        board = Board(session)
        provision(board, bank, Settings())
        asked, last = 0, board.status()

        def requests() -> Iterator[StatusRequest]:
            while last.chips_sent < CHIPS:
                yield StatusRequest()

        def handle(request: WireMessage, outcome: RequestOutcome) -> None:
            nonlocal asked, last
            reply = session.checked(request, outcome)
            if isinstance(reply, StatusReply):
                asked, last = asked + 1, reply

        session.run(requests(), handle)
        return asked, last


def measure(name: str, bank: Bank, expected: np.ndarray) -> None:
    """Play a bank and print how it went; `expected` are the 96 LEDs, uint8 (chips, 96)."""
    with tempfile.TemporaryDirectory() as folder:
        leds = Path(folder) / "leds.bin"
        asked, status = play(leds, bank)
        played = LedRecord.read(leds).played()
    ticks, rows = played.ticks[:CHIPS], played.rows[:CHIPS]
    wrong = int((played.chips(None)[:CHIPS] != np.resize(expected, (CHIPS, 96))).any(1).sum())
    intervals = np.diff(ticks) / TICKS_PER_US
    trace = hashlib.sha256((ticks - ticks[0]).tobytes() + rows.tobytes()).hexdigest()
    print(f"{name}: {len(ticks)} chips, {wrong} of them wrong, {asked} requests answered meanwhile")
    print(f"  intervals {intervals.min():.2f} to {intervals.max():.2f} us")
    print(f"  largest delay of a chip {status.lateness_max_ticks / TICKS_PER_US:.2f} us")
    print(f"  trace {trace[:16]}")


def main() -> None:
    for name, bar in (("words", []), ("10 clusters", ["bar.rows=90", "bar.cluster_rows=9"])):
        link = load_link(overrides=bar)
        symbols = random_symbols(8, 10, link.codebook, np.random.default_rng(5))
        expected = symbol_chips(symbols, link.codebook)[:, link.bar.led_clusters()]
        expected = np.pad(expected, ((0, 0), (0, 96 - expected.shape[1])))
        measure(name, bank_of(symbols, link), expected)


if __name__ == "__main__":
    main()
