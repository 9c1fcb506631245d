"""What the board's tests share: banks, boards and sessions, lines that go wrong, and what LEDs may show."""

import shutil
import threading
from itertools import pairwise

import numpy as np
import pytest

from evlcp_sdk.link.resolve import load_link
from firmware_host.board.bank import make_bank, random_packets, symbol_chips
from firmware_host.board.board import Board
from firmware_host.board.session import Session
from firmware_host.emulators.listening import HostLine
from firmware_host.emulators.native import NativeBoard, serve_board
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.protocol.client import Timing

PACKET = 346
LINK = load_link()

SITE = """
[[bar]]
transmitter_id = 7
latitude_deg = 35.156789
longitude_deg = 136.965432
height_m = 52.4
"""


def needs(*tools):
    """Skip, loudly, unless all these programs are there."""
    missing = [name for name in tools if shutil.which(name) is None]
    if missing:
        install = "sh firmware_host/firmware/install-toolchain.sh installs it (as root)"
        pytest.skip(f"{', '.join(missing)} missing: {install}")


def board_link(*overrides):
    """The default link but for these values."""
    return load_link(overrides=list(overrides))


def options_of(*overrides):
    """The same on the command line."""
    return [part for setting in overrides for part in ("--set", setting)]


def symbols_of(packets, seed=0, link=LINK):
    """Random symbols of packets of a link."""
    return random_packets(packets, link, seed)


def some_bank(packets=1, seed=0, link=LINK):
    """Random packets of a link."""
    return make_bank(symbols_of(packets, seed, link), link)


def board_on(line, nonce=None, **options):
    """A session; with a nonce of one's own its bytes are the same each time."""
    timing = Timing(latency_s=options.pop("latency_s", 0.02))
    line = SimulatedLine(line) if isinstance(line, SimulatedBoard) else line
    return Board(Session(line, timing, first=nonce, nonce=nonce, **options))


def state_of(board):
    """State and faults."""
    status = board.status()
    return status.state, status.faults


def shown_chips(device):
    """What each LED did since the last look, uint8 (chips, 96)."""
    return device.take_led_record().select_chips().chips(None)


def packets_shown(chips, link=LINK):
    """The packets that were shown, and how many chips of the idle pattern stood between them."""
    preamble, length = link.codebook.preamble[:, None], link.packet.packet_chips
    found, at, idle = [], 0, 0
    while at + length <= len(chips):
        if (chips[at : at + len(preamble)] == preamble).all():
            found.append(chips[at : at + length])
            at += length
        else:
            assert (chips[at] == idle % 2).all(), f"chip {at} is neither of a packet nor of the idle pattern"
            at += 1
            idle += 1
    return found, idle


def well(done):
    """A command that has ended well."""
    assert done.code == 0, done.err
    return done


def check_fault(done, code, *expected):
    """See that a command ended with a code, and one line that says why."""
    assert (done.code, done.err.count("\n")) == (code, 1), done.err
    assert [words for words in expected if words not in done.err] == [], done.err


class Native:
    """A native board in the background, as `evlcp board emulate native` runs it; options are its own."""

    def __init__(self, listen, **options):
        self.board, self.line = NativeBoard(**options), HostLine(listen)
        self.ended = threading.Event()
        self.thread = threading.Thread(target=serve_board, args=(self.board, self.line, self.ended.is_set))
        self.thread.start()

    def end(self):
        if self.ended.is_set():
            return
        self.ended.set()
        self.thread.join(10)
        assert not self.thread.is_alive()
        self.line.close()
        self.board.close()


class FatalLine(SimulatedLine):
    """Calls `then` once `after` bytes have gone to the board; the bytes before have arrived."""

    def __init__(self, board, after, then):
        super().__init__(board)
        self.left = after
        self.then = then
        self.written = b""

    def write(self, data):
        self.written += data
        if self.left is not None:
            now, data = data[: self.left], data[self.left :]
            super().write(now)
            self.left -= len(now)
            if self.left:
                return
            self.left = None
            self.board.run(100)
            self.then(self)
        super().write(data)


def recording(board):
    """A line that keeps what was written, and never fails."""
    return FatalLine(board, 1 << 30, lambda _: None)


def deafen(line):
    """Let nothing arrive at the board from now on."""
    line.write = lambda _: None


class NoisyLine(SimulatedLine):
    """Flips, drops and doubles bytes and whole portions, both ways."""

    def __init__(self, board, flips, drops, doubles, seed):
        super().__init__(board, step_us=500)
        self.rates = (flips, drops, doubles)
        self.random = np.random.default_rng(seed)
        self.counts = {"flipped": 0, "dropped": 0, "doubled": 0}

    def spoil(self, data):
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
            return out + out
        return out

    def write(self, data):
        super().write(self.spoil(data))

    def read(self, timeout_s):
        data = super().read(timeout_s)
        return self.spoil(data) if data else data


def packet_sequence(played, payloads):
    """Name and packet number of every whole packet that was played; fails on one that is none of them."""
    known = {}
    for name, symbols in payloads.items():
        for p, packet in enumerate(np.split(symbol_chips(symbols, LINK), len(symbols))):
            known[packet.tobytes()] = (name, p)
    assert len(known) == sum(len(s) for s in payloads.values())
    chips = played.chips()
    whole = len(chips) - len(chips) % PACKET
    sequence = []
    for at in range(0, whole, PACKET):
        packet = chips[at : at + PACKET].tobytes()
        assert packet in known, f"torn packet at chip {at}"
        sequence.append(known[packet])
    assert any(k.startswith(chips[whole:].tobytes()) for k in known)
    return sequence


def check_order(sequence, counts):
    """Packets of one payload follow round and round; another begins with its first. Returns the payloads."""
    order = [sequence[0][0]]
    assert sequence[0][1] == 0
    for (name, p), (next_name, q) in pairwise(sequence):
        assert q == ((p + 1) % counts[name] if next_name == name else 0)
        if next_name != name:
            order.append(next_name)
    return order
