"""Streams: every packet once and in order over any line, underruns named, dark at the end."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from board_lines import (
    LINK,
    NoisyLine,
    board_link,
    board_on,
    packets_shown,
    some_bank,
    state_of,
    symbols_of,
)
from hypothesis import given, settings, strategies as st

from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.errors import ConfigError
from firmware_host.board.bank import make_queue
from firmware_host.board.board import Settings, provision
from firmware_host.emulators.simulated import SimulatedBoard
from firmware_host.errors import BoardResetError, IncompatibleError, RefusedError, VerifyError
from firmware_host.protocol.generated import requests as protocol
from firmware_host.protocol.generated.requests import BoardFault, Capability, Format, State, Watchdog
from tests.models.usb import UsbLine

LONG = board_link("air.frames_per_packet=40", "air.pilot_every=4")


def played_packets(device, link=LINK):
    found, idle = packets_shown(device.take_led_record().select_chips().chips(), link)
    return [packet.tobytes() for packet in found], idle


def expected_packets(packets, link=LINK):
    return [packet_chips(p, link.codebook, link.packet.pilot_every).tobytes() for p in packets]


@pytest.mark.parametrize("link", [LINK, LONG], ids=["one piece a packet", "three pieces a packet"])
@pytest.mark.parametrize(("latency_s", "ahead"), [(0.0, 5), (0.016, 2)])
def test_packets_follow_without_a_gap(device, link, latency_s, ahead):
    packets = symbols_of(30, 0, link)
    with board_on(UsbLine(device, latency_s), nonce=1).stream(link, ahead) as stream:
        for n, packet in enumerate(packets):
            assert stream.send(packet) == n
            assert stream.sent - stream.begun <= ahead + 1
    chips = device.take_led_record().select_chips()
    assert (np.diff(chips.ticks) == 1000).all()
    length = link.packet.packet_chips
    at = len(chips) - 30 * length
    # the idle pattern until the first has come, then packet after packet
    assert chips.chips()[at:].tobytes() == b"".join(expected_packets(packets, link))
    assert (chips.chips()[:at] == np.arange(at)[:, None] % 2).all()
    assert at % 2 == 0
    assert (stream.underruns, stream.sent) == (0, 30)
    pieces = -(-link.packet.frames * 32 // (512 - protocol.PushRequest.min_bytes()))
    assert stream.requests <= 30 * pieces + 3
    assert not any(device.bench.shown)


@pytest.mark.parametrize("fails_at", [0, 8])
def test_a_board_that_goes_dark_ends_its_stream(device, fails_at):
    def send(stream):
        with stream:
            for n, packet in enumerate(symbols_of(9)):
                if n == fails_at:
                    device.bench.health.faults = BoardFault.OVER_TEMPERATURE
                stream.send(packet)

    with pytest.raises(RefusedError, match="dark before the stream ended, faults over_temperature"):
        send(board_on(device).stream(LINK, 4))


def test_an_empty_queue_is_named_and_shows_the_idle_pattern(device):
    board = board_on(UsbLine(device, 0.001), nonce=1)
    packets = symbols_of(4)
    with board.stream(LINK) as stream:
        stream.wait(0.2)
        assert stream.underruns == 0, "a stream that has not begun is not late"
        for packet in packets[:2]:
            stream.send(packet)
        stream.wait(0.3)
        probe = status_of(stream)
        assert (probe.state, probe.faults, probe.underruns) == (State.IDLE_PATTERN, BoardFault.UNDERRUN, 1)
        for packet in packets[2:]:
            stream.send(packet)
        stream.wait(0.01)
        assert not status_of(stream).faults
    found, idle = played_packets(device)
    assert found == expected_packets(packets)
    assert idle > 2000
    assert stream.underruns == 1
    after = board.status()
    assert (after.state, after.faults, after.underruns) == (State.DARK, 0, 1)


def status_of(stream):
    """STATUS in between; nothing of the stream is under way then."""
    assert not stream._in_flight
    return stream._session.call(protocol.StatusRequest())


@pytest.mark.parametrize("seed", range(2))
def test_a_noisy_line_loses_and_doubles_nothing(device, seed):
    line = NoisyLine(device, 0.0, 0.0, 0.0, seed)
    board = board_on(line, nonce=1, latency_s=0.004, tries=12)
    link = LONG if seed % 2 else LINK
    packets = symbols_of(25, seed, link)
    with board.stream(link, 6) as stream:
        line.rates = (2e-4, 0.05, 0.05)
        for packet in packets:
            stream.send(packet)
    line.rates = (0.0, 0.0, 0.0)
    assert line.counts["dropped"]
    assert line.counts["doubled"]
    found, _ = played_packets(device, link)
    assert found == expected_packets(packets, link)


def test_the_watchdog_acts_on_a_stream_whose_host_is_gone(device, board):
    board.set_watchdog(Watchdog.DARK, 200)
    stream = board.stream(LINK)
    stream.send(symbols_of(1)[0])
    stream.wait(1.0)
    assert status_of(stream).state == State.IDLE_PATTERN
    device.run(500_000)
    assert not any(device.bench.shown)


def test_a_raised_fault_ends_in_the_dark_and_a_reset_is_reported(device, board):
    with suppress(KeyError), board.stream(LINK, 8) as stream:
        for packet in symbols_of(4):
            stream.send(packet)
        raise KeyError("x")
    assert not any(device.bench.shown)
    assert board.status().packets_sent < 4
    stream = board.stream(LINK)
    device.reset()
    with pytest.raises(BoardResetError):
        stream.wait(2.0)


def test_a_board_that_takes_no_packet_ends_the_stream(board, monkeypatch):
    client = board.session.client
    submit = client.submit

    def with_another_number(request):
        return submit(replace(request, number=99) if isinstance(request, protocol.PushRequest) else request)

    stream = board.stream(LINK)
    monkeypatch.setattr(client, "submit", with_another_number)
    with pytest.raises(RefusedError, match="takes no more packets"):
        stream.send(symbols_of(1)[0])


def test_what_a_board_refuses(device, board):
    for ahead, wanted in ((1, "expected 2 or more"), (500, "holds 127 packets")):
        with pytest.raises(ConfigError, match=wanted):
            board.stream(LINK, ahead)
    assert board.status().active_bank == protocol.NO_BANK
    # what it answers counts, not what HELLO lets expect
    board.info = replace(info := board.info, bank_bytes=1 << 20)
    with pytest.raises(ConfigError, match="holds 127 packets"):
        board.stream(LINK, 200)
    assert board.status().state == State.DARK
    board.info = info
    huge = board_link("air.frames_per_packet=700")
    with pytest.raises(ConfigError, match=r"700 frames takes 22400 bytes.*room for two; .* 640 frames"):
        board.stream(huge)
    with board.stream(LINK) as stream:
        with pytest.raises(ConfigError, match=r"shape \(9, 16\), expected \(10, 16\)"):
            stream.send(symbols_of(1)[0][:9])
        with pytest.raises(ConfigError):
            stream.send(np.full((10, 16), 64))
    fast = board_link("air.chip_rate_hz=20000.0")
    provision(board, some_bank(), Settings())
    with pytest.raises(RefusedError, match=r"keeps its rate"):
        board.stream(fast)
    board.stop()
    board.wait_dark()
    with board.stream(fast) as stream:
        stream.send(symbols_of(1, 0, fast)[0])
    with pytest.raises(RefusedError, match="NOTHING_COMMITTED"):
        board.save()  # a stream is not
    object.__setattr__(board.info, "capabilities", board.info.capabilities & ~Capability.STREAM)
    with pytest.raises(IncompatibleError, match="has no streams"):
        board.stream(LINK)


class Queue:
    """What a board's queue should do, in Python."""

    def __init__(self, slots, size):
        self.slots, self.size = slots, size
        self.packets = []
        self.part = b""
        self.ended = False

    def push(self, number, offset, data, last, begun):
        room = len(self.packets) - begun + 1 < self.slots
        is_next = (number, offset) == (len(self.packets), len(self.part))
        if is_next and data and room and not self.ended and offset + len(data) <= self.size:
            self.part += data
            if len(self.part) == self.size:
                self.packets.append(self.part)
                self.part = b""
        if last and not self.part and len(self.packets) == number + bool(data):
            self.ended = True
        return len(self.packets), len(self.part)


@given(st.data())
@settings(max_examples=30, deadline=None)
def test_the_queue_takes_what_a_queue_should(data):
    """Pieces of any number, offset and length, and time between them, against a model."""
    link = board_link("air.frames_per_packet=320")  # 10 240 bytes a packet: 4 slots
    device = SimulatedBoard()
    board = board_on(device)
    like = make_queue(link)
    board.prepare_commit(like)
    request = protocol.StreamRequest(0, Format.WORDS, bytes.fromhex(link.codebook.digest))
    slots = board.session.call(request).slots
    assert slots == 4
    board.start()
    model = Queue(slots, 10_240)
    begun = 0

    def push(number, offset, payload, last=False):
        nonlocal begun
        reply = board.session.call(protocol.PushRequest(0, number, offset, int(last), payload))
        # the model knows when packets begin only from the board; they never go back
        assert begun <= reply.begun <= len(model.packets)
        begun = reply.begun
        assert (reply.number, reply.offset) == model.push(number, offset, payload, last, begun)

    for _ in range(data.draw(st.integers(1, 60))):
        if data.draw(st.booleans()):
            number, offset = len(model.packets), len(model.part)
        else:
            number = data.draw(st.integers(0, len(model.packets) + 1))
            offset = data.draw(st.sampled_from([0, len(model.part), 490, 10_239]))
        left = 10_240 - offset
        count = data.draw(st.sampled_from([0, 1, 490, 490, 490]))
        count = min(count, left) if data.draw(st.booleans()) else count
        payload = bytes([data.draw(st.integers(0, 255))]) * count
        push(number, offset, payload, last=data.draw(st.integers(0, 20)) == 0)
        device.run(data.draw(st.sampled_from([0, 100, 2_000_000])))
    # until it is full
    for _ in range(4 * 21):
        offset = len(model.part)
        push(len(model.packets), offset, bytes(min(490, 10_240 - offset)))
    held = board.read_bank(0, 0, 4 * 10_240)
    for n in range(max(0, len(model.packets) - 2), len(model.packets)):
        at = n % 4 * 10_240
        assert held[at : at + 10_240] == model.packets[n]


@pytest.mark.parametrize("latency_s", [0.0, 0.016])
def test_what_changes_is_right_at_its_first_chip(device, latency_s):
    """A countdown made for `delay_s` ahead, against the ticks at which the board showed it."""
    from benchmarks.board import starts_of
    from evlcp_sdk.air.blocks import Kind, Message
    from evlcp_sdk.air.kinds import Countdown, CountdownKind
    from evlcp_sdk.link.compose import encode_messages

    board, coder = board_on(UsbLine(device, latency_s)), LINK.block_coder()
    made = []
    due_us = []
    with board.stream(LINK, 2) as stream:

        def next_one(number):
            if number == 8:
                return None
            at_s = device.now_us * 1e-6 + stream.delay_s
            due_us.append(at_s * 1e6)
            result = CountdownKind().pack(Countdown("red", "green", 100.0 - at_s))
            made.append(encode_messages([Message(Kind.COUNTDOWN, 7, number, result)], coder))
            return made[-1]

        assert stream.play(next_one, 0.25) == 8
    assert stream.underruns == 0
    record = device.take_led_record().select_chips()
    chips, length = record.chips(), LINK.packet.packet_chips
    starts = starts_of(chips, record.ticks, stream.sent, length)
    packets = [chips[n : n + length].tobytes() for n in np.searchsorted(record.ticks, starts)]
    for message, due in zip(made, due_us, strict=True):
        (reported,) = expected_packets(message, LINK)
        begun_us = starts[packets.index(reported)] / (device.TICK_HZ / 1e6)
        # the board's answers come late by the line's latency, and with them what is known of its queue
        assert -8_000 <= due - begun_us <= 8_000 + 1e6 * latency_s
        assert 6 <= packets.count(reported) <= 10, "round and round for 0.25 s"


@pytest.mark.parametrize("how", ["stop", "blank"])
@pytest.mark.parametrize("at_once", [False, True])
def test_a_stopped_stream_is_empty(device, board, how, at_once):
    """What waits is not played by another START, nor by one that comes before the board is dark."""
    sent = symbols_of(6)
    stream = board.stream(LINK, ahead=6)
    for packet in sent:
        stream.send(packet)
    stream.wait(0.05)
    begun = stream.begun
    assert 1 <= begun < 6
    getattr(board, how)()
    if not at_once:
        board.wait_dark()
    with pytest.raises(RefusedError, match=r"NOTHING_COMMITTED.*a stream that has ended, say, is gone"):
        board.start()
    device.run(300_000)
    assert board.status().state == State.DARK
    found, _ = played_packets(device)
    assert found[:begun] == expected_packets(sent)[:begun]
    assert len(found) <= begun + 1
    with pytest.raises(VerifyError, match="the queue of a stream, which holds nothing to compare"):
        board.verify(some_bank())
    provision(board, some_bank(), Settings())
    assert state_of(board) == (State.PLAYING, 0)
    board.verify(some_bank())
