"""Single requests to the firmware, and what it answers; `test_board_core` runs them under sanitizers, too."""

from dataclasses import replace

import numpy as np
import pytest
from board_lines import PACKET, some_bank

from evlcp_sdk.air.codebook import word_of_chips
from firmware_host.emulators.simulated import SimulatedBoard
from firmware_host.protocol.datagram import Datagram, DatagramDecoder
from firmware_host.protocol.generated import requests as protocol
from firmware_host.protocol.generated.profiles import DIGESTS
from firmware_host.protocol.generated.requests import MAJOR, MINOR, NO_BANK, NO_SESSION, State, Status

BANK = some_bank(1, 1)
START, STOP, BLANK = protocol.StartRequest(), protocol.StopRequest(), protocol.BlankRequest()
RECALL, SAVE = protocol.RecallRequest(), protocol.SaveRequest(0)


class Wire:
    """A host of few lines: one request, one answer."""

    def __init__(self):
        self.device = SimulatedBoard()
        self.sequence, self.session = 0xFFF0, NO_SESSION
        self.hello(0x12345678)

    def hello(self, nonce):
        assert self.ask(protocol.HelloRequest(MAJOR, MINOR, nonce), session=NO_SESSION) == Status.OK
        self.session = self.reply.session

    def send(self, type_, payload, sequence, session):
        self.device.receive(Datagram(type_, 0, sequence, session, payload).encode())
        self.device.run(0)
        (self.reply,) = DatagramDecoder().feed(self.device.take_output())
        assert (self.reply.type, self.reply.sequence) == (type_ | protocol.REPLY_BIT, sequence)
        self.detail = int.from_bytes(self.reply.payload[:4], "little")
        return self.reply.status

    def ask(self, request, sequence=None, session=None):
        if sequence is None:
            sequence = self.sequence = (self.sequence + 1) & 0xFFFF
        return self.send(request.TYPE, request.pack(), sequence, self.session if session is None else session)

    def each(self, *requests):
        """How requests end, one after the other."""
        return [self.ask(request) for request in requests]

    def status(self):
        assert self.ask(protocol.StatusRequest()) == Status.OK
        return protocol.StatusReply.unpack(self.reply.payload)

    def fill(self, number, content):
        for at in range(0, len(content), 500):
            assert self.ask(protocol.WriteRequest(number, at, content[at : at + 500])) == Status.OK

    def committed(self):
        self.fill(0, BANK.content)
        assert self.ask(commit_of(BANK)) == Status.OK

    def chips(self, count):
        self.device.run(100 * count)


@pytest.fixture
def wire():
    return Wire()


def commit_of(bank, number=0):
    sizes = (bank.format, bank.packets, len(bank.content), bank.crc)
    return protocol.CommitRequest(number, *sizes, bank.digest)


def test_the_line_counts_what_it_drops(wire):
    status = Datagram(protocol.StatusRequest.TYPE, 0, 9, wire.session, b"").encode()
    spoilt = status[:3] + bytes([status[3] ^ 0x40]) + status[4:]
    # a wrong byte, one that ends within a block, one too long; and delimiters alone
    wire.device.receive(spoilt + b"\x05\x01\0" + b"\x55" * 600 + b"\0\0\0")
    wire.device.run(0)
    found = wire.status()
    assert (found.crc_errors, found.framing_errors, found.overflow_errors) == (1, 2, 0)
    wire.device.receive(b"\1" * (4096 + 100))
    wire.device.run(0)
    wire.device.receive(b"\0")
    assert wire.status().overflow_errors == 100


def test_sessions(wire):
    first = wire.session
    wire.hello(0x12345678)
    assert wire.session == first
    wire.hello(0x9ABCDEF0)
    assert wire.session != first
    assert wire.ask(protocol.StatusRequest(), session=first) == Status.NO_SESSION
    wire.device.reset()
    assert wire.ask(protocol.StatusRequest()) == Status.NO_SESSION
    assert wire.ask(protocol.HelloRequest(MAJOR + 1, 2, 3), session=NO_SESSION) == Status.INCOMPATIBLE
    assert wire.reply.payload[:2] == bytes([MAJOR, MINOR])
    # a host of a later minor version may say more
    hello = protocol.HelloRequest(MAJOR, 200, 7).pack()
    assert wire.send(protocol.HelloRequest.TYPE, hello + b"123456789", 1, NO_SESSION) == Status.OK
    assert wire.send(protocol.HelloRequest.TYPE, hello[:3], 1, NO_SESSION) == Status.BAD_LENGTH
    wire.hello(8)
    assert wire.send(0x7F, b"", 2, wire.session) == Status.UNKNOWN_TYPE
    assert wire.send(protocol.StartRequest.TYPE, bytes(11), 3, wire.session) == Status.BAD_LENGTH


def test_a_control_request_is_done_once_and_none_that_is_older(wire):
    level = protocol.LevelRequest
    assert wire.ask(level(30)) == Status.OK
    one = wire.sequence
    assert wire.ask(level(40)) == Status.OK
    assert wire.ask(level(30), sequence=one) == Status.STALE
    assert wire.ask(level(30), sequence=wire.sequence) == Status.OK, "answered again"
    assert wire.device.bench.level_ma == 40
    # the sequence wraps, and queries in between do not make a later control request look old
    for _ in range(700):
        wire.sequence = (wire.sequence + 99) & 0xFFFF
        wire.ask(protocol.StatusRequest())
    assert wire.each(level(50), level(61)) == [Status.OK, Status.OUT_OF_RANGE]
    assert wire.detail == 60
    wire.device.bench.level_fails = True
    assert wire.ask(level(10)) == Status.HARDWARE_FAULT
    assert (wire.device.bench.level_ma, wire.status().level_ma) == (50, 50)


def test_dark_until_commit_and_start(wire):
    wire.device.take_led_record()
    assert wire.ask(START) == Status.NOTHING_COMMITTED
    wire.fill(0, BANK.content)
    assert wire.ask(replace(commit_of(BANK), crc=BANK.crc ^ 1)) == Status.BAD_CRC
    assert wire.detail == BANK.crc
    # the commit twice: it is done once
    again = [Status.NOTHING_COMMITTED, Status.OK, Status.OK]
    assert wire.each(START, commit_of(BANK), commit_of(BANK)) == again
    wire.chips(100)
    assert wire.status().commits == 1
    assert not len(wire.device.take_led_record())
    assert wire.ask(START) == Status.OK
    wire.chips(100)
    played = wire.device.take_led_record()
    assert played.numbers.tolist() == list(range(100))
    assert (played.chips() == BANK.chips[:100]).all()


def test_stop_ends_with_the_packet_and_blank_at_once(wire):
    wire.committed()
    wire.ask(START)
    wire.chips(40)
    wire.device.take_led_record()
    assert wire.ask(STOP) == Status.OK
    assert wire.status().state == State.STOPPING
    wire.chips(1000)
    rest = wire.device.take_led_record().numbers
    assert (len(rest), rest[-1]) == (PACKET - 40 + 1, protocol.CHIP_DARK)
    assert (wire.status().state, wire.status().packets_sent) == (State.DARK, 1)
    wire.ask(START)
    wire.chips(100)
    wire.device.take_led_record()
    assert wire.ask(BLANK) == Status.OK
    wire.chips(1000)
    assert wire.device.take_led_record().numbers.tolist() == [protocol.CHIP_DARK]
    # a START that comes while it stops plays on
    wire.ask(START)
    wire.chips(10)
    wire.each(STOP, START)
    wire.chips(1000)
    assert wire.status().state == State.PLAYING


def test_banks_are_held(wire):
    def banks():
        return wire.status().active_bank, wire.status().pending_bank

    other = some_bank(1, 2)
    wire.committed()
    assert wire.ask(protocol.WriteRequest(0, 0, b"x")) == Status.BUSY
    wire.ask(START)
    wire.chips(10)
    wire.fill(1, other.content)
    assert wire.ask(replace(commit_of(other, 1), crc=1)) == Status.BAD_CRC
    assert banks() == (0, NO_BANK)
    assert wire.ask(commit_of(other, 1)) == Status.OK
    assert banks() == (0, 1)
    # bank 1 waits; the same commit is done once
    late = (commit_of(BANK), commit_of(other, 1), protocol.WriteRequest(1, 0, b"x"))
    assert wire.each(*late) == [Status.BUSY, Status.OK, Status.BUSY]
    wire.chips(PACKET)
    assert banks() == (1, NO_BANK)
    for number, at in ((2, 0), (0, 40960), (0, 2**32 - 1)):
        assert wire.ask(protocol.WriteRequest(number, at, b"x")) == Status.OUT_OF_RANGE
    assert wire.ask(protocol.ReadRequest(0, 0, 508)) == Status.OUT_OF_RANGE
    pushed = [protocol.PushRequest(number, 0, 0, 0, b"x") for number in (2, 0)]
    assert wire.each(*pushed) == [Status.OUT_OF_RANGE, Status.NOTHING_COMMITTED]


def test_a_foreign_codebook_never_plays(wire):
    wire.fill(0, BANK.content)
    commit = commit_of(BANK)
    foreign = replace(commit, digest=DIGESTS[protocol.Profile.WH8])
    assert wire.each(foreign, START) == [Status.FOREIGN_CODEBOOK, Status.NOTHING_COMMITTED]
    pilots = b"".join(word_of_chips(code).to_bytes(2, "little") for code in BANK.link.codebook.pilots)
    own = protocol.CodebookRequest(26, word_of_chips(BANK.link.codebook.preamble), pilots, commit.digest)
    others = replace(own, pilots=bytes([pilots[0] ^ 1]) + pilots[1:])
    found = wire.each(own, others, replace(own, digest=bytes(32)), replace(own, preamble_chips=33))
    assert found == [Status.OK, Status.FOREIGN_CODEBOOK, Status.FOREIGN_CODEBOOK, Status.OUT_OF_RANGE]
    # one under its own profile plays its own preamble; its digest vouches for nothing
    custom = protocol.ConfigureRequest(10_000, protocol.Profile.CUSTOM, 10, 1, 0, 0)
    mine = replace(own, preamble_chips=2, preamble=2, digest=bytes(32))
    commit = replace(commit, digest=bytes(32))
    assert wire.each(custom, mine, commit) == [Status.OK] * 3
    for changed in (replace(mine, pilots=others.pilots), replace(mine, preamble=1)):
        assert wire.each(changed, commit) == [Status.OK, Status.BUSY]
    assert wire.each(mine, commit) == [Status.OK] * 2
    wire.device.take_led_record()
    wire.ask(START)
    wire.chips(2)
    assert wire.device.take_led_record().chips()[:, 0].tolist() == [1, 0]


def test_limits_of_configure(wire):
    good = protocol.ConfigureRequest(20_000, 0, 10, 1, 0, 0)
    for name, value, nearest in (
        *[("chip_rate_hz", rate, near) for rate, near in ((0, 1), (3, 2), (7125, 6250), (2**32 - 1, 20_000))],
        ("frames", 0, 1),
        ("frames", 65535, 1280),
        ("profile", 9, 255),
        ("pilot_every", 0, 1),
        ("level_limit_ma", 61, 60),
        ("duty_limit", 1001, 1000),
    ):
        assert wire.ask(replace(good, **{name: value})) == Status.OUT_OF_RANGE
        assert wire.detail == nearest
    assert wire.ask(good) == Status.OK
    assert wire.reply.payload == (500).to_bytes(4, "little") + PACKET.to_bytes(4, "little")
    # another chip rate is not taken over while it plays
    wire.committed()
    wire.ask(START)
    wire.chips(10)
    assert wire.ask(replace(good, chip_rate_hz=10_000)) == Status.OK
    wire.fill(1, BANK.content)
    assert (wire.ask(commit_of(BANK, 1)), wire.detail) == (Status.BUSY, 20_000)


def test_a_chip_that_comes_a_whole_chip_late_ends_in_the_dark(wire):
    wire.committed()
    wire.ask(START)
    wire.device.bench.late = 999
    wire.chips(2)
    assert (wire.status().state, wire.status().lateness_max_ticks) == (State.PLAYING, 999)
    wire.device.bench.late = 1000
    wire.chips(2)
    assert wire.status().state == State.FAULT
    assert not any(wire.device.bench.shown)


def test_the_idle_pattern_begins_with_a_packet_and_ends_with_one(wire):
    watchdog = protocol.WatchdogRequest
    found = wire.each(watchdog(3, 100), watchdog(1, 99), watchdog(1, 100))
    assert found == [Status.OUT_OF_RANGE, Status.OUT_OF_RANGE, Status.OK]
    wire.committed()
    wire.ask(START)
    wire.device.take_led_record()
    wire.chips(900)
    wire.status()
    wire.chips(3000)
    # silent since chip 900 it acts after chip 1900, at the end of the packet
    chips = wire.device.take_led_record().chips()
    assert (chips[:2076] == np.resize(BANK.chips, (2076, 16))).all()
    assert (chips[2077:] != chips[2076:-1]).all()
    found = wire.status()
    assert (found.state, found.silence_ms >= 90) == (State.IDLE_PATTERN, True)
    wire.chips(400)
    assert wire.status().state == State.PLAYING


def test_slots_of_save(wire):
    assert wire.each(RECALL, SAVE) == [Status.EMPTY_SLOT, Status.NOTHING_COMMITTED]
    wire.committed()
    assert wire.each(protocol.SaveRequest(2), SAVE) == [Status.OUT_OF_RANGE, Status.OK]
    assert wire.reply.payload[0] == 0
    tests = [protocol.LedTestRequest(*test) for test in ((0, 96, 1), (0, 0, 0), (0, 95, 1000))]
    assert wire.each(*tests) == [Status.OUT_OF_RANGE, Status.OUT_OF_RANGE, Status.OK]
    assert wire.each(SAVE, RECALL, STOP) == [Status.BUSY, Status.BUSY, Status.OK]
    assert not any(wire.device.bench.shown)
