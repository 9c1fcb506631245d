"""Single requests to the firmware, and what it answers; `test_board_core` runs them under sanitizers, too."""

import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from board_lines import some_bank

from evlcp_sdk.air.codebook import word_of_chips
from firmware_host.board.bank import Bank
from firmware_host.emulators.simulated import SimulatedBoard
from firmware_host.protocol.datagram import Datagram, DatagramDecoder
from firmware_host.protocol.generated.profiles import DIGESTS
from firmware_host.protocol.generated.requests import (
    CHIP_DARK,
    MAJOR,
    MINOR,
    NO_BANK,
    NO_SESSION,
    REPLIES,
    REPLY_BIT,
    BlankRequest,
    CodebookRequest,
    CommitRequest,
    ConfigureRequest,
    HelloRequest,
    LedTestRequest,
    LevelRequest,
    Profile,
    ReadRequest,
    RecallRequest,
    SaveRequest,
    StartRequest,
    State,
    Status,
    StatusReply,
    StatusRequest,
    StopRequest,
    WatchdogRequest,
    WriteRequest,
)
from firmware_host.protocol.wire import WireRequest
from tests.firmware.wire_vectors import read_vectors

CHIP_US = 100


class Wire:
    """A host of few lines: one request, one answer."""

    def __init__(self) -> None:
        self.device = SimulatedBoard()
        self.sequence, self.session = 0xFFF0, NO_SESSION
        self.hello(0x12345678)

    def hello(self, nonce: int) -> None:
        assert self.ask(HelloRequest(MAJOR, MINOR, nonce), session=NO_SESSION) == Status.OK
        self.session = self.reply.session

    def send(self, type_: int, payload: bytes, sequence: int, session: int) -> int:
        self.device.receive(Datagram(type_, 0, sequence, session, payload).encode())
        self.device.run(0)
        (self.reply,) = DatagramDecoder().feed(self.device.sent())
        assert (self.reply.type, self.reply.sequence) == (type_ | REPLY_BIT, sequence)
        self.detail = int.from_bytes(self.reply.payload[:4], "little")
        return self.reply.status

    def ask(self, request: WireRequest[Any], sequence: int | None = None, session: int | None = None) -> int:
        if sequence is None:
            sequence = self.sequence = (self.sequence + 1) & 0xFFFF
        return self.send(request.TYPE, request.pack(), sequence, self.session if session is None else session)

    def status(self) -> StatusReply:
        assert self.ask(StatusRequest()) == Status.OK
        reply = REPLIES[StatusRequest.TYPE].unpack(self.reply.payload)
        assert isinstance(reply, StatusReply)
        return reply

    def fill(self, bank: int, content: bytes) -> None:
        for at in range(0, len(content), 500):
            assert self.ask(WriteRequest(bank, at, content[at : at + 500])) == Status.OK

    def chips(self, count: int) -> None:
        self.device.run(count * CHIP_US)


@pytest.fixture
def wire() -> Wire:
    return Wire()


@pytest.fixture
def bank() -> Bank:
    return some_bank(1, 1)


def commit_of(bank: Bank, number: int = 0) -> CommitRequest:
    digest = bytes.fromhex(bank.digest)
    return CommitRequest(number, bank.format, bank.packets, len(bank.content), bank.crc, digest)


def committed(wire: Wire, bank: Bank) -> None:
    wire.fill(0, bank.content)
    assert wire.ask(commit_of(bank)) == Status.OK


def test_the_line_counts_what_it_drops(wire: Wire) -> None:
    status = Datagram(StatusRequest.TYPE, 0, 9, wire.session, b"").encode()
    spoilt = status[:3] + bytes([status[3] ^ 0x40]) + status[4:]
    # a wrong byte, one that ends within a block, one too long; and delimiters alone
    wire.device.receive(spoilt + b"\x05\x01\0" + b"\x55" * 600 + b"\0\0\0")
    wire.device.run(0)
    found = wire.status()
    assert found.crc_errors + found.framing_errors == 3
    assert found.crc_errors
    assert found.framing_errors >= 2
    assert found.overflow_errors == 0
    wire.device.receive(b"\1" * (4096 + 100))
    wire.device.run(0)
    wire.device.receive(b"\0")
    assert wire.status().overflow_errors == 100


def test_a_board_takes_the_golden_wires_and_no_noise(wire: Wire) -> None:
    requests = [one for one in read_vectors() if not one.datagram.type & REPLY_BIT]
    for one in requests:
        wire.device.receive(one.wire)
        wire.device.run(0)
    found = [reply.type for reply in DatagramDecoder().feed(wire.device.sent())]
    assert found == [one.datagram.type | REPLY_BIT for one in requests]
    wire.hello(7)
    before = wire.status()
    assert (before.crc_errors, before.framing_errors) == (0, 0)
    rng = np.random.default_rng(1)
    for length in rng.integers(1, 700, 1000).tolist():
        wire.device.receive(rng.bytes(length) + b"\0")
        wire.device.run(0)
        wire.device.sent()
    after = wire.status()
    assert after.crc_errors + after.framing_errors >= 1000
    assert after.state == before.state


def test_sessions(wire: Wire) -> None:
    first = wire.session
    wire.hello(0x12345678)
    assert wire.session == first
    wire.hello(0x9ABCDEF0)
    assert wire.session != first
    assert wire.ask(StatusRequest(), session=first) == Status.NO_SESSION
    wire.device.reset()
    assert wire.ask(StatusRequest()) == Status.NO_SESSION
    assert wire.ask(HelloRequest(MAJOR + 1, 2, 3), session=NO_SESSION) == Status.INCOMPATIBLE
    assert wire.reply.payload[:2] == bytes([MAJOR, MINOR])
    # a host of a later minor version may say more
    hello = HelloRequest(MAJOR, 200, 7).pack()
    assert wire.send(HelloRequest.TYPE, hello + b"123456789", 1, NO_SESSION) == Status.OK
    assert wire.send(HelloRequest.TYPE, hello[:3], 1, NO_SESSION) == Status.BAD_LENGTH
    wire.hello(8)
    assert wire.send(0x7F, b"", 2, wire.session) == Status.UNKNOWN_TYPE
    assert wire.send(StartRequest.TYPE, bytes(11), 3, wire.session) == Status.BAD_LENGTH


def test_a_control_request_is_done_once_and_none_that_is_older(wire: Wire) -> None:
    assert wire.ask(LevelRequest(30)) == Status.OK
    one = wire.sequence
    assert wire.ask(LevelRequest(40)) == Status.OK
    assert wire.ask(LevelRequest(30), sequence=one) == Status.STALE
    assert wire.ask(LevelRequest(30), sequence=wire.sequence) == Status.OK, "answered again"
    assert wire.device.level_ma() == 40
    # the sequence wraps, and queries in between do not make a later control request look old
    for _ in range(700):
        wire.sequence = (wire.sequence + 99) & 0xFFFF
        wire.ask(StatusRequest())
    assert wire.ask(LevelRequest(50)) == Status.OK
    assert (wire.ask(LevelRequest(61)), wire.detail) == (Status.OUT_OF_RANGE, 60)
    wire.device.set_failures(level=True)
    assert wire.ask(LevelRequest(10)) == Status.HARDWARE_FAULT
    assert (wire.device.level_ma(), wire.status().level_ma) == (50, 50)


def test_dark_until_commit_and_start(wire: Wire, bank: Bank) -> None:
    wire.device.records()
    assert wire.ask(StartRequest()) == Status.NOTHING_COMMITTED
    wire.fill(0, bank.content)
    assert wire.ask(replace(commit_of(bank), crc=bank.crc ^ 1)) == Status.BAD_CRC
    assert wire.detail == bank.crc
    assert wire.ask(StartRequest()) == Status.NOTHING_COMMITTED
    assert wire.ask(commit_of(bank)) == Status.OK
    assert wire.ask(commit_of(bank)) == Status.OK, "idempotent"
    wire.chips(100)
    assert wire.status().commits == 1
    assert not len(wire.device.records())
    assert wire.ask(StartRequest()) == Status.OK
    wire.chips(100)
    played = wire.device.records()
    assert played.numbers.tolist() == list(range(100))
    assert (played.chips() == bank.chips[:100]).all()


def test_stop_ends_with_the_packet_and_blank_at_once(wire: Wire, bank: Bank) -> None:
    committed(wire, bank)
    wire.ask(StartRequest())
    wire.chips(40)
    wire.device.records()
    assert wire.ask(StopRequest()) == Status.OK
    assert wire.status().state == State.STOPPING
    wire.chips(1000)
    rest = wire.device.records().numbers
    assert (len(rest), rest[-1]) == (346 - 40 + 1, CHIP_DARK)
    assert (wire.status().state, wire.status().packets_sent) == (State.DARK, 1)
    wire.ask(StartRequest())
    wire.chips(100)
    wire.device.records()
    assert wire.ask(BlankRequest()) == Status.OK
    wire.chips(1000)
    assert wire.device.records().numbers.tolist() == [CHIP_DARK]
    # a START that comes while it stops plays on
    wire.ask(StartRequest())
    wire.chips(10)
    wire.ask(StopRequest())
    wire.ask(StartRequest())
    wire.chips(1000)
    assert wire.status().state == State.PLAYING


def test_banks_are_held(wire: Wire, bank: Bank) -> None:
    other = some_bank(1, 2)
    committed(wire, bank)
    assert wire.ask(WriteRequest(0, 0, b"x")) == Status.BUSY
    wire.ask(StartRequest())
    wire.chips(10)
    wire.fill(1, other.content)
    assert wire.ask(replace(commit_of(other, 1), crc=1)) == Status.BAD_CRC
    assert (wire.status().active_bank, wire.status().pending_bank) == (0, NO_BANK)
    assert wire.ask(commit_of(other, 1)) == Status.OK
    assert (wire.status().active_bank, wire.status().pending_bank) == (0, 1)
    assert wire.ask(commit_of(bank)) == Status.BUSY, "bank 1 waits"
    assert wire.ask(commit_of(other, 1)) == Status.OK, "idempotent"
    assert wire.ask(WriteRequest(1, 0, b"x")) == Status.BUSY
    wire.chips(346)
    assert (wire.status().active_bank, wire.status().pending_bank) == (1, NO_BANK)
    for wrong in (WriteRequest(2, 0, b"x"), WriteRequest(0, 40960, b"x"), WriteRequest(0, 2**32 - 1, b"x")):
        assert wire.ask(wrong) == Status.OUT_OF_RANGE
    assert wire.ask(ReadRequest(0, 0, 508)) == Status.OUT_OF_RANGE


def test_a_foreign_codebook_never_plays(wire: Wire, bank: Bank) -> None:
    wire.fill(0, bank.content)
    commit = commit_of(bank)
    assert wire.ask(replace(commit, digest=bytes.fromhex(DIGESTS[Profile.WH8]))) == Status.FOREIGN_CODEBOOK
    assert wire.ask(StartRequest()) == Status.NOTHING_COMMITTED
    pilots = tuple(map(word_of_chips, bank.codebook.pilots))
    own = CodebookRequest(26, word_of_chips(bank.codebook.preamble), pilots, commit.digest)
    assert wire.ask(own) == Status.OK
    others = replace(own, pilots=(pilots[0] ^ 1, *pilots[1:]))
    assert wire.ask(others) == Status.FOREIGN_CODEBOOK
    assert wire.ask(replace(own, digest=bytes(32))) == Status.FOREIGN_CODEBOOK
    assert wire.ask(replace(own, preamble_chips=33)) == Status.OUT_OF_RANGE
    # one under its own profile plays its own preamble; its digest vouches for nothing
    assert wire.ask(ConfigureRequest(10_000, Profile.CUSTOM, 10, 1, 0, 0)) == Status.OK
    mine = replace(own, preamble_chips=2, preamble=2, digest=bytes(32))
    commit = replace(commit, digest=bytes(32))
    assert (wire.ask(mine), wire.ask(commit)) == (Status.OK, Status.OK)
    for changed in (replace(mine, pilots=others.pilots), replace(mine, preamble=1)):
        assert (wire.ask(changed), wire.ask(commit)) == (Status.OK, Status.BUSY)
    assert (wire.ask(mine), wire.ask(commit)) == (Status.OK, Status.OK)
    wire.device.records()
    wire.ask(StartRequest())
    wire.chips(2)
    assert wire.device.records().chips()[:, 0].tolist() == [1, 0]


def test_limits_of_configure(wire: Wire, bank: Bank) -> None:
    good = ConfigureRequest(20_000, 0, 10, 1, 0, 0)
    for wrong, nearest in (
        ({"chip_rate_hz": 0}, 1),
        ({"chip_rate_hz": 3}, 2),
        ({"chip_rate_hz": 7125}, 6250),
        ({"chip_rate_hz": 2**32 - 1}, 20_000),
        ({"frames": 0}, 1),
        ({"frames": 65535}, 1280),
        ({"profile": 9}, 255),
        ({"pilot_every": 0}, 1),
        ({"level_limit_ma": 61}, 60),
        ({"duty_limit": 1001}, 1000),
    ):
        assert wire.ask(replace(good, **wrong)) == Status.OUT_OF_RANGE
        assert wire.detail == nearest
    assert wire.ask(good) == Status.OK
    assert wire.reply.payload == (500).to_bytes(4, "little") + (346).to_bytes(4, "little")
    # another chip rate is not taken over while it plays
    committed(wire, bank)
    wire.ask(StartRequest())
    wire.chips(10)
    assert wire.ask(replace(good, chip_rate_hz=10_000)) == Status.OK
    wire.fill(1, bank.content)
    assert (wire.ask(commit_of(bank, 1)), wire.detail) == (Status.BUSY, 20_000)


def test_a_chip_that_comes_a_whole_chip_late_ends_in_the_dark(wire: Wire, bank: Bank) -> None:
    committed(wire, bank)
    wire.ask(StartRequest())
    wire.device.set_late(999)
    wire.chips(2)
    assert (wire.status().state, wire.status().lateness_max_ticks) == (State.PLAYING, 999)
    wire.device.set_late(1000)
    wire.chips(2)
    assert wire.status().state == State.FAULT
    assert not wire.device.shown().any()


def test_the_idle_pattern_begins_with_a_packet_and_ends_with_one(wire: Wire, bank: Bank) -> None:
    assert wire.ask(WatchdogRequest(3, 100)) == Status.OUT_OF_RANGE
    assert wire.ask(WatchdogRequest(1, 99)) == Status.OUT_OF_RANGE
    assert wire.ask(WatchdogRequest(1, 100)) == Status.OK
    committed(wire, bank)
    wire.ask(StartRequest())
    wire.device.records()
    wire.chips(900)
    wire.status()
    wire.chips(3000)
    # silent since chip 900 it acts after chip 1900, at the end of the packet
    chips = wire.device.records().chips()
    assert (chips[:2076] == np.resize(bank.chips, (2076, 16))).all()
    assert (chips[2077:] != chips[2076:-1]).all()
    found = wire.status()
    assert (found.state, found.silence_ms >= 90) == (State.IDLE_PATTERN, True)
    wire.chips(400)
    assert wire.status().state == State.PLAYING


def test_slots_of_save(wire: Wire, bank: Bank) -> None:
    assert wire.ask(RecallRequest()) == Status.EMPTY_SLOT
    assert wire.ask(SaveRequest(0)) == Status.NOTHING_COMMITTED
    committed(wire, bank)
    assert wire.ask(SaveRequest(2)) == Status.OUT_OF_RANGE
    assert (wire.ask(SaveRequest(0)), wire.reply.payload[0]) == (Status.OK, 0)
    assert wire.ask(LedTestRequest(0, 96, 1)) == Status.OUT_OF_RANGE
    assert wire.ask(LedTestRequest(0, 0, 0)) == Status.OUT_OF_RANGE
    assert wire.ask(LedTestRequest(0, 95, 1000)) == Status.OK
    assert (wire.ask(SaveRequest(0)), wire.ask(RecallRequest())) == (Status.BUSY, Status.BUSY)
    assert wire.ask(StopRequest()) == Status.OK
    assert not wire.device.shown().any()
    # a whole slot of the layout before pilot_every is empty to this firmware
    header = bytearray(wire.device.flash()[:124])
    header[:4] = (0x45564C31).to_bytes(4, "little")
    old = bytes(header) + zlib.crc32(header).to_bytes(4, "little") + wire.device.flash()[128:]
    wire.device.set_flash(old)
    wire.hello(2)
    assert wire.ask(RecallRequest()) == Status.EMPTY_SLOT
    assert wire.status().active_bank == NO_BANK
