"""Time to program one board with 64 packets, against the time its bytes take at 1 Mbit/s.

The native board keeps to the line rate in both directions. Prints the time, the wire time and their ratio.
"""

import time

import numpy as np

from evlcp_sdk.link.resolve import load_link
from firmware_host.board.bank import Bank, random_symbols
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.emulators.processes import start_native
from firmware_host.protocol.client import Timing

BAUD = 1_000_000
RUNS = 5


def once(bank: Bank, settings: Settings) -> float:
    with Session(start_native(baud=BAUD), Timing(BAUD)) as session:
        start = time.perf_counter()
        done = provision(Board(session), bank, settings)
        elapsed = time.perf_counter() - start
    assert done.written == len(bank.content)
    return elapsed


def main() -> None:
    book = load_link().codebook
    bank = Bank.of_symbols(random_symbols(64, 10, book, np.random.default_rng(0)), book)
    times = sorted(once(bank, Settings()) for _ in range(RUNS))
    wire = 10 * len(bank.content) / BAUD
    best, median = times[0], times[RUNS // 2]
    print(f"64 packets, {len(bank.content)} bytes, verified and playing, {BAUD} bit/s")
    print(f"wire time {wire * 1e3:.1f} ms; median {median * 1e3:.1f} ms, best {best * 1e3:.1f} ms")
    print(f"ratio {median / wire:.3f}")


if __name__ == "__main__":
    main()
