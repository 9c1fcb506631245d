"""The protocol: one definition, golden vectors, datagrams, messages, and the client that speaks it."""

import dataclasses
import zlib
from itertools import pairwise
from pathlib import Path
from typing import get_type_hints

import pytest
from cobs import cobs
from hypothesis import given, settings, strategies as st

from firmware_host.errors import DatagramError
from firmware_host.protocol import generate
from firmware_host.protocol.client import TRIES, Client, Timing
from firmware_host.protocol.datagram import MAX_WIRE_BYTES, Datagram, DatagramDecoder
from firmware_host.protocol.generated import requests as messages
from firmware_host.protocol.wire import WireMessage

VECTORS = (Path(__file__).parents[1] / "vectors" / "wire-vectors.txt").read_text().splitlines()
PAYLOADS = [
    value
    for name, value in vars(messages).items()
    if isinstance(value, type) and issubclass(value, WireMessage) and dataclasses.is_dataclass(value)
]


def test_generated_files_are_fresh():
    stale = [path.name for path, text in generate.render_files().items() if path.read_text() != text]
    assert not stale, "run python -m firmware_host.protocol.generate"


@pytest.mark.parametrize(
    "vector", [line for line in VECTORS if not line.startswith("#")], ids=lambda line: line.split()[0]
)
def test_golden_vector(vector):
    """`name type status sequence session payload wire` in hex, `-` for no payload."""
    _, *numbers, payload, wire = vector.split()
    d = Datagram(*(int(n, 16) for n in numbers), bytes.fromhex(payload.strip("-")))
    head = bytes([d.type, d.status]) + d.sequence.to_bytes(2, "little") + d.session.to_bytes(2, "little")
    body = head + d.payload
    assert d.encode().hex() == wire
    assert d.encode() == cobs.encode(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0"
    assert DatagramDecoder().feed(bytes.fromhex(wire)) == [d]


@st.composite
def payloads(draw):
    cls = draw(st.sampled_from(PAYLOADS))
    values = []
    hints = get_type_hints(cls, include_extras=True)
    for field in dataclasses.fields(cls):
        (code,) = hints[field.name].__metadata__
        if code == "*":
            values.append(draw(st.binary(max_size=64)))
        elif code.endswith("s"):
            values.append(draw(st.binary(min_size=int(code[:-1]), max_size=int(code[:-1]))))
        else:
            bits = {"B": 8, "H": 16, "I": 32, "h": 16}[code]
            low = -(1 << bits - 1) if code == "h" else 0
            values.append(draw(st.integers(low, low + (1 << bits) - 1)))
    return cls(*values)


@given(payloads())
def test_message_round_trip(message):
    assert type(message).unpack(message.pack()) == message


@given(payloads(), st.integers(1, 3))
def test_message_of_another_length_is_refused(message, cut):
    data = message.pack()
    cls = type(message)
    if len(data) >= cut and data[:-cut] and len(data) - cut < cls.min_bytes():
        with pytest.raises(DatagramError):
            cls.unpack(data[:-cut])
    if not cls.is_open_ended():
        # of a later minor version
        assert cls.unpack(data + b"x" * cut) == message


def test_values_that_do_not_fit_are_refused():
    with pytest.raises(DatagramError, match="LevelRequest"):
        messages.LevelRequest(1 << 16).pack()
    with pytest.raises(DatagramError, match="digest"):
        messages.CommitRequest(0, 0, 1, 0, 0, b"short").pack()
    with pytest.raises(DatagramError, match="at most 512"):
        Datagram(4, 0, 0, 0, bytes(513)).encode()


@settings(max_examples=200)
@given(
    st.lists(st.binary(max_size=600), min_size=1, max_size=5),
    st.lists(st.integers(0, 2000), max_size=8),
    st.binary(max_size=100),
)
def test_decoder_does_not_care_about_portions(bodies, cuts, noise):
    sent = [Datagram(12, 0, i, 7, body[:512]) for i, body in enumerate(bodies)]
    wire = noise + b"\0" + b"".join(d.encode() for d in sent)
    whole = DatagramDecoder()
    expected = whole.feed(wire)
    assert [d for d in expected if d.session == 7][-len(sent) :] == sent
    parts = DatagramDecoder()
    found = []
    edges = sorted({0, len(wire), *(c for c in cuts if c < len(wire))})
    for a, b in pairwise(edges):
        found += parts.feed(wire[a:b])
    assert found == expected


@given(st.binary(min_size=1, max_size=80), st.data())
def test_a_flipped_byte_is_never_accepted_as_the_same(body, data):
    wire = bytearray(Datagram(4, 0, 1, 2, body).encode())
    at = data.draw(st.integers(0, len(wire) - 2))
    wire[at] ^= data.draw(st.integers(1, 255))
    assert not DatagramDecoder().feed(bytes(wire))


def test_endless_line_does_not_fill_memory():
    decoder = DatagramDecoder()
    for _ in range(100):
        assert decoder.feed(b"\x55" * 1000) == []
    assert len(decoder._partial) <= MAX_WIRE_BYTES + 1000
    good = Datagram(12, 0, 1, 2, b"")
    assert decoder.feed(b"\0" + good.encode()) == [good]


def reply(request, payload=b"", status=0):
    return Datagram(request.type | 0x80, status, request.sequence, request.session, payload).encode()


def sent_bytes(client, now=0.0):
    """What the client writes then."""
    return DatagramDecoder().feed(client.poll(now)[0])


def test_window_bounds_what_is_under_way():
    client = Client(Timing(), window=3, tries=1)
    tokens = [client.submit(messages.CrcRequest(0, i, 1)) for i in range(5)]
    first = sent_bytes(client)
    assert len(first) == 3
    assert not client.has_room
    done = client.receive(reply(first[1], messages.CrcReply(9).pack()))
    assert [(o.token, o.reply) for o in done] == [(tokens[1], messages.CrcReply(9))]
    assert len(sent_bytes(client)) == 1
    client.poll(9.0)
    client.drop_requests()
    assert client.receive(b"") == []


def test_tries_back_off_and_end():
    client = Client(Timing(1_000_000, latency_s=0.1))
    token = client.submit(messages.StopRequest())
    now, times = 0.0, []
    while True:
        wire, deadline = client.poll(now)
        done = client.receive(b"")
        if done:
            break
        assert wire
        times.append(now)
        now = deadline
    assert len(times) == TRIES == 5
    waits = [b - a for a, b in pairwise(times)]
    assert all(b == pytest.approx(2 * a) for a, b in pairwise(waits))
    assert (done[0].token, done[0].status, done[0].tries) == (token, None, 5)
    assert client.retries == 4


def test_late_doubled_and_foreign_answers_are_ignored():
    client = Client(Timing(), first=0xFFFF)
    client.submit(messages.CrcRequest(0, 0, 1))
    request = sent_bytes(client)[0]
    assert request.sequence == 0xFFFF
    answer = messages.CrcReply(9).pack()
    assert client.receive(reply(Datagram(request.type, 0, 5, 0, b""))) == []
    assert client.receive(reply(Datagram(0x01, 0, request.sequence, 0, b""))) == []
    assert client.receive(reply(request, b"cut")) == []
    assert client.receive(request.encode()) == []  # an echo
    assert client.receive(reply(request, answer))[0].reply == messages.CrcReply(9)
    assert client.receive(reply(request, answer)) == []
    client.submit(messages.StatusRequest())
    assert sent_bytes(client, 1.0)[0].sequence == 0


def answer(client, now, after_s):
    """A CRC request that is sent again until its answer, which takes so long, is there; gives that time."""
    client.submit(messages.CrcRequest(0, 0, 1))
    wire, deadline = client.poll(now)
    (request,), end = DatagramDecoder().feed(wire), now + after_s
    while deadline is not None and deadline < end:
        deadline = client.poll(deadline)[1]
    (done,) = client.receive(reply(request, messages.CrcReply(9).pack()), end)
    assert done.status == messages.Status.OK
    return end


def test_a_slow_board_gets_the_time_that_it_takes():
    client = Client(Timing(latency_s=0.1))
    now = 0.0
    for _ in range(20):
        now = answer(client, now, 0.01)
    assert client.latency_s == 0.1  # never less
    for _ in range(30):
        now = answer(client, now, 0.7)
    before = client.retries
    for _ in range(30):
        now = answer(client, now, 0.7)
    assert client.retries == before
    assert 0.7 <= client.latency_s < 2.0
    for _ in range(60):
        now = answer(client, now, 0.01)
    assert client.latency_s == 0.1
