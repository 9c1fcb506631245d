"""Banks for a simulated board, lines to it that go wrong, and what its LEDs may show all the same."""

import threading
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.resolve import Link, load_link
from firmware_host.board.bank import Bank, bank_of, random_symbols, symbol_chips
from firmware_host.board.board import Board
from firmware_host.board.session import Session
from firmware_host.emulators.led_record import LedRecord
from firmware_host.emulators.listening import HostLine
from firmware_host.emulators.native import NativeBoard, serve
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.protocol.client import Timing
from tests.conftest import Run

PACKET = 346
LINK = load_link()

SITE = """
[[bar]]
transmitter_id = 7
latitude_deg = 35.156789
longitude_deg = 136.965432
height_m = 52.4
"""


def board_link(*overrides: str) -> Link:
    """The default link but for these values."""
    return load_link(overrides=list(overrides))


def symbols_of(packets: int, seed: int = 0, link: Link = LINK) -> NDArray[np.int64]:
    """Random symbols of packets of a link."""
    return random_symbols(packets, link.packet.frames, link.codebook, np.random.default_rng(seed))


def some_bank(packets: int = 1, seed: int = 0, link: Link = LINK) -> Bank:
    """Random packets of a link."""
    return bank_of(symbols_of(packets, seed, link), link)


def shown(device: SimulatedBoard) -> NDArray[np.uint8]:
    """What each LED did since the last look, uint8 (chips, 96)."""
    return device.records().played().chips(None)


def check_fault(done: Run, code: int, *says: str) -> None:
    """See that a command ended with a code, and one line that says why."""
    assert (done.code, done.err.count("\n")) == (code, 1), done.err
    assert [words for words in says if words not in done.err] == [], done.err


class HostDiedError(Exception):
    """The host died here."""


class Native:
    """A native board in the background, as `evlcp board emulate native` runs it; options are its own."""

    def __init__(self, listen: str, **options: Any) -> None:
        self.board, self.line = NativeBoard(**options), HostLine(listen)
        self.ended = threading.Event()
        self.thread = threading.Thread(target=serve, args=(self.board, self.line, self.ended.is_set))
        self.thread.start()

    def end(self) -> None:
        if self.ended.is_set():
            return
        self.ended.set()
        self.thread.join(10)
        assert not self.thread.is_alive()
        self.line.close()
        self.board.close()


class FatalLine(SimulatedLine):
    """Calls `then` once `after` bytes have gone to the board; the bytes before have arrived."""

    def __init__(self, board: SimulatedBoard, after: int, then: Callable[[], None]) -> None:
        super().__init__(board)
        self.left: int | None = after
        self.then = then
        self.written = 0

    def write(self, data: bytes) -> None:
        self.written += len(data)
        if self.left is None:
            super().write(data)
            return
        now, later = data[: self.left], data[self.left :]
        super().write(now)
        self.left -= len(now)
        if self.left == 0:
            self.left = None
            self.board.run(100)
            self.then()
            super().write(later)


class NoisyLine(SimulatedLine):
    """Flips, drops and doubles bytes and whole portions, both ways."""

    def __init__(self, board: SimulatedBoard, flips: float, drops: float, doubles: float, seed: int) -> None:
        super().__init__(board, step_us=500)
        self.rates = (flips, drops, doubles)
        self.random = np.random.default_rng(seed)
        self.counts = {"flipped": 0, "dropped": 0, "doubled": 0}
        self.late: list[bytes] = []

    def spoil(self, data: bytes) -> bytes:
        flips, drops, doubles = self.rates
        body = np.frombuffer(data, np.uint8).copy()
        flip = self.random.random(len(body)) < flips
        body[flip] ^= self.random.integers(1, 256, int(flip.sum()), dtype=np.uint8)
        self.counts["flipped"] += int(flip.sum())
        what = self.random.random()
        out = body.tobytes()
        if what < drops:
            self.counts["dropped"] += 1
            return b""
        if what < 2 * drops and len(out) > 1:
            self.counts["dropped"] += 1
            at = int(self.random.integers(len(out)))
            return out[:at] + out[at + 1 :]
        if what < 2 * drops + doubles:
            self.counts["doubled"] += 1
            # half of the doubles come at once, half after what is sent next
            if self.random.random() < 0.5:
                return out + out
            self.late.append(out)
        elif self.late and self.random.random() < 0.5:
            return out + self.late.pop()
        return out

    def to_board(self, data: bytes) -> bytes:
        return self.spoil(data)

    def to_host(self, data: bytes) -> bytes:
        return self.spoil(data)


def board_on(line: SimulatedLine, nonce: int | None = None, key: bytes | None = None) -> Board:
    """A session; with a nonce of one's own its bytes are the same each time."""
    return Board(Session(line, Timing(latency_s=0.02), first=nonce, nonce=nonce, key=key))


def packet_sequence(played: LedRecord, payloads: dict[str, NDArray[np.int64]]) -> list[tuple[str, int]]:
    """Name and packet number of every whole packet that was played; fails on one that is none of them."""
    known = {}
    for name, symbols in payloads.items():
        chips = symbol_chips(symbols, LINK.codebook)
        for p in range(len(symbols)):
            known[chips[p * PACKET : (p + 1) * PACKET].tobytes()] = (name, p)
    assert len(known) == sum(len(s) for s in payloads.values())
    chips = played.chips()
    sequence = []
    for at in range(0, len(chips) - PACKET + 1, PACKET):
        packet = chips[at : at + PACKET].tobytes()
        assert packet in known, f"torn packet at chip {at}"
        sequence.append(known[packet])
    rest = chips[len(chips) - len(chips) % PACKET :].tobytes()
    assert any(k.startswith(rest) for k in known)
    return sequence


def check_order(sequence: list[tuple[str, int]], counts: dict[str, int]) -> list[str]:
    """Packets of one payload follow round and round; another begins with its first. Returns the payloads."""
    order = [sequence[0][0]]
    assert sequence[0][1] == 0
    for (name, p), (next_name, q) in pairwise(sequence):
        if next_name == name:
            assert q == (p + 1) % counts[name]
        else:
            assert q == 0
            order.append(next_name)
    return order
