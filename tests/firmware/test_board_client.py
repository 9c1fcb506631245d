"""The client's state machine: window, time-outs, tries, and what it ignores."""

from itertools import pairwise

import pytest

from firmware_host.protocol.client import TRIES, Client, Timing
from firmware_host.protocol.datagram import Datagram, DatagramDecoder
from firmware_host.protocol.generated.requests import (
    MAX_PAYLOAD,
    CrcReply,
    CrcRequest,
    Status,
    StatusRequest,
    StopRequest,
    WriteRequest,
)


def reply(request: Datagram, payload: bytes = b"", status: int = 0) -> bytes:
    return Datagram(request.type | 0x80, status, request.sequence, request.session, payload).encode()


def sent(wire: bytes) -> list[Datagram]:
    return DatagramDecoder().feed(wire)


def test_window_bounds_what_is_under_way() -> None:
    client = Client(Timing(), window=3)
    tokens = [client.submit(CrcRequest(0, i, 1)) for i in range(5)]
    first = sent(client.poll(0.0)[0])
    assert len(first) == 3
    assert not client.room
    done = client.receive(reply(first[1], CrcReply(9).pack()))
    assert [(o.token, o.reply) for o in done] == [(tokens[1], CrcReply(9))]
    assert len(sent(client.poll(0.0)[0])) == 1
    assert not client.idle


def test_tries_back_off_and_end() -> None:
    client = Client(Timing(1_000_000, latency_s=0.1))
    token = client.submit(StopRequest())
    now, times = 0.0, []
    while True:
        wire, deadline = client.poll(now)
        done = client.receive(b"")
        if done:
            break
        assert sent(wire)
        times.append(now)
        assert deadline is not None
        now = deadline
    assert len(times) == TRIES == 5
    waits = [b - a for a, b in pairwise(times)]
    assert all(b == pytest.approx(2 * a) for a, b in pairwise(waits))
    assert (done[0].token, done[0].status, done[0].tries) == (token, None, 5)
    assert client.idle
    assert client.retries == 4


def test_time_out_follows_the_line_rate() -> None:
    def wait(baud: int) -> float:
        client = Client(Timing(baud, latency_s=0.0))
        client.submit(WriteRequest(0, 0, bytes(500)))
        return client.poll(0.0)[1] or 0.0

    assert wait(1_000_000) == pytest.approx(wait(115_200) * 115_200 / 1_000_000)
    # at least the request and its answer must fit the line
    assert wait(115_200) > 10 * 550 / 115_200
    assert wait(1_000_000) < 10 * 4 * MAX_PAYLOAD / 1_000_000


def test_late_doubled_and_foreign_answers_are_ignored() -> None:
    client = Client(Timing(), first=0xFFFF)
    client.submit(CrcRequest(0, 0, 1))
    request = sent(client.poll(0.0)[0])[0]
    assert request.sequence == 0xFFFF
    answer = CrcReply(9).pack()
    other = Datagram(request.type, 0, 5, 0, b"")
    assert client.receive(reply(other)) == []
    wrong_type = Datagram(0x01, 0, request.sequence, 0, b"")
    assert client.receive(reply(wrong_type)) == []
    assert client.receive(reply(request, b"cut")) == []
    assert client.receive(request.encode()) == []  # an echo
    assert client.receive(reply(request, answer))[0].reply == CrcReply(9)
    assert client.receive(reply(request, answer)) == []
    client.submit(StatusRequest())
    assert sent(client.poll(1.0)[0])[0].sequence == 0


def test_refusal_carries_status_and_detail() -> None:
    client = Client(Timing())
    for status in (Status.OUT_OF_RANGE, 99):
        client.submit(StopRequest())
        request = sent(client.poll(0.0)[0])[0]
        outcome = client.receive(reply(request, (60).to_bytes(4, "little"), int(status)))[0]
        assert (outcome.status, outcome.detail, outcome.reply) == (status, 60, None)


def answer(client: Client, now: float, after_s: float) -> float:
    """A CRC request that is sent again until its answer, which takes so long, is there; gives that time."""
    client.submit(CrcRequest(0, 0, 1))
    wire, deadline = client.poll(now)
    request, end = sent(wire)[0], now + after_s
    while deadline is not None and deadline < end:
        deadline = client.poll(deadline)[1]
    (done,) = client.receive(reply(request, CrcReply(9).pack()), end)
    assert done.status == Status.OK
    return end


def test_a_slow_board_gets_the_time_that_it_takes() -> None:
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
