"""The host's end of the protocol as a state machine without I/O: window, time-outs, tries, sessions.

The caller moves bytes and time: it submits requests, passes received bytes to `receive`, writes the bytes of
`poll`, and polls again before the deadline.
"""

import random
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from firmware_host.errors import DatagramError
from firmware_host.protocol.datagram import Datagram, DatagramDecoder
from firmware_host.protocol.generated import requests as protocol
from firmware_host.protocol.generated.requests import MINOR, REPLIES, SEALED, Status
from firmware_host.protocol.seal import Sealer
from firmware_host.protocol.wire import WireMessage, WireRequest

TRIES = 5
"""Default number of times that a request is sent."""

BACKOFF = 2.0
"""Factor by which each further try waits longer for its answer."""

MAX_LATENCY_S = 10.0
"""Largest latency that counts, if the measured one is larger, s."""

SLOW_S = 0.1
"""Latency above which a board gets requests one at a time, s; a USB bridge's is 16 ms."""

MAX_PATIENCE = 32.0
"""Largest factor by which repeated requests lengthen the wait of the next ones."""


@dataclass(frozen=True)
class Timing:
    """The time that an answer may take.

    Attributes:
        baud: Line rate, bit/s; a byte takes ten bits.
        latency_s: Latency of board and host operating system, s.

    >>> Timing(1_000_000).wire_s(200)
    0.002
    """

    baud: int = 1_000_000
    latency_s: float = 0.1

    def wire_s(self, count: int) -> float:
        """Duration of `count` bytes on the line, s."""
        return 10.0 * count / self.baud


@dataclass(frozen=True, slots=True)
class RequestOutcome:
    """The result of a request.

    Attributes:
        token: The request's, from `submit`.
        status: The board's status, or None without an answer.
        reply: The answer, if the status is OK.
        detail: The number that explains another status.
        tries: Number of times that the request was sent.
    """

    token: int
    status: int | None
    reply: WireMessage | None
    detail: int
    tries: int


@dataclass(slots=True)
class _PendingRequest:
    token: int
    type: int
    wire: bytes
    reply_bytes: int
    tries: int = 0
    due: float = 0.0
    sent: float = 0.0
    wire_s: float = 0.0


@dataclass
class Client:
    """Requests in, outcomes out; between them bytes and time.

    The latency of answers is measured as in TCP (RFC 6298): a slow board gets more time than by `timing`,
    never less.

    Args:
        timing: The time that an answer may take.
        window: Requests in flight at once, as the board's HELLO allows.
        session: The session, from HELLO.
        sealer: Seals requests of the session; None if the board or this host has no key.
        minor: Minor version of the protocol for requests: the board's, from HELLO.
        first: First sequence number, by default random.
        tries: Number of times that a request is sent.
        retries: Number of requests that were sent again.

    >>> from firmware_host.protocol.generated.requests import StatusRequest
    >>> client = Client(Timing())
    >>> token = client.submit(StatusRequest())
    >>> wire, deadline = client.poll(0.0)
    >>> wire[-1], deadline > 0
    (0, True)
    """

    timing: Timing
    window: int = 1
    session: int = protocol.NO_SESSION
    minor: int = MINOR
    sealer: Sealer | None = None
    first: int = field(default_factory=lambda: random.SystemRandom().randrange(1 << 16))
    tries: int = TRIES
    retries: int = 0
    decoder: DatagramDecoder = field(default_factory=DatagramDecoder)
    _tokens: int = 0
    _queue: deque[_PendingRequest] = field(default_factory=deque)
    _in_flight: dict[int, _PendingRequest] = field(default_factory=dict)
    _outcomes: list[RequestOutcome] = field(default_factory=list)
    _time_s: float = 0.0
    _mean_s: float | None = None
    _spread_s: float = 0.0
    _patience: float = 1.0
    _largest: int = 32

    @property
    def latency_s(self) -> float:
        """Time that an answer may take beyond its time on the line, at least that of `timing`, s."""
        measured = min((self._mean_s or 0.0) + 4 * self._spread_s, MAX_LATENCY_S)
        return max(self.timing.latency_s, measured) * self._patience

    def _can_send(self, pending: _PendingRequest) -> bool:
        """Whether a request may be sent while others are in flight.

        A request that waits for its turn at a slow board would be sent again too early: such a board gets one
        at a time, and one whose short answers are late gets its first long request alone.
        """
        if not self._in_flight:
            return True
        late_s = self._mean_s or 0.0
        alone = late_s > SLOW_S or (late_s > SLOW_S / 4 and len(pending.wire) > 2 * self._largest)
        return not alone and len(self._in_flight) < self.window

    def _measure_latency(self, pending: _PendingRequest) -> None:
        """Update the latency; after several tries it is unknown to which the answer belongs."""
        if pending.tries > 1:
            # kept until a request is answered at its first try
            self._patience = min(self._patience * BACKOFF ** (pending.tries - 1), MAX_PATIENCE)
            return
        self._patience = 1.0
        self._largest = max(self._largest, len(pending.wire))
        late_s = max(0.0, self._time_s - pending.sent - pending.wire_s)
        if self._mean_s is None:
            self._mean_s, self._spread_s = late_s, late_s / 2
        else:
            self._spread_s += (abs(late_s - self._mean_s) - self._spread_s) / 4
            self._mean_s += (late_s - self._mean_s) / 8

    def submit(self, request: WireRequest[Any]) -> int:
        """Queue a request; return the token of its outcome."""
        sequence = (self.first + self._tokens) & 0xFFFF
        token, payload, status = self._tokens, request.pack(self.minor), 0
        if self.sealer is not None and self.session != protocol.NO_SESSION:
            payload += self.sealer.seal(request.TYPE, self.session, token, payload)
            status = SEALED
        wire = Datagram(request.TYPE, status, sequence, self.session, payload).encode()
        reply = REPLIES[request.TYPE]
        longest = protocol.MAX_PAYLOAD if reply.is_open_ended() else max(4, reply.min_bytes())
        self._tokens += 1
        self._queue.append(
            _PendingRequest(
                token, request.TYPE, wire, longest + protocol.HEADER_BYTES + protocol.CRC_BYTES + 4
            )
        )
        return token

    @property
    def has_room(self) -> bool:
        """Whether one more request would be sent at once."""
        return len(self._queue) + len(self._in_flight) < self.window

    def drop_requests(self) -> None:
        """Drop all requests, queued or in flight; late answers will be ignored."""
        self._queue.clear()
        self._in_flight.clear()
        self._outcomes.clear()

    def receive(self, data: bytes, time_s: float | None = None) -> list[RequestOutcome]:
        """Take bytes that were received at a time, s; return the outcomes of requests."""
        self._time_s = self._time_s if time_s is None else time_s
        for datagram in self.decoder.feed(data):
            pending = self._in_flight.get(datagram.sequence)
            if pending is None or datagram.type != pending.type | protocol.REPLY_BIT:
                continue
            outcome = _parse_outcome(pending, datagram)
            if outcome is not None:
                del self._in_flight[datagram.sequence]
                self._measure_latency(pending)
                self._outcomes.append(outcome)
        done, self._outcomes = self._outcomes, []
        return done

    def poll(self, time_s: float) -> tuple[bytes, float | None]:
        """Bytes to write now, and the time of the next poll, s (None if nothing is in flight).

        The outcomes of requests without an answer after all tries come from the next `receive`.
        """
        out = []
        self._time_s = time_s
        while self._queue and self._can_send(self._queue[0]):
            pending = self._queue.popleft()
            self._in_flight[(self.first + pending.token) & 0xFFFF] = pending
            out.append(self._send(pending, time_s))
        for sequence, pending in list(self._in_flight.items()):
            if pending.due > time_s:
                continue
            if pending.tries >= self.tries:
                del self._in_flight[sequence]
                self._outcomes.append(RequestOutcome(pending.token, None, None, 0, pending.tries))
            else:
                self.retries += 1
                out.append(self._send(pending, time_s))
        if self._outcomes:
            return b"".join(out), time_s
        return b"".join(out), min((w.due for w in self._in_flight.values()), default=None)

    def _send(self, pending: _PendingRequest, time_s: float) -> bytes:
        queued = sum(len(w.wire) for w in self._in_flight.values())
        replies = sum(w.reply_bytes for w in self._in_flight.values())
        pending.wire_s = 2 * self.timing.wire_s(queued + replies)
        pending.due = time_s + (pending.wire_s + self.latency_s) * BACKOFF**pending.tries
        pending.sent = time_s
        pending.tries += 1
        return pending.wire


def _parse_outcome(pending: _PendingRequest, datagram: Datagram) -> RequestOutcome | None:
    """The outcome by a datagram, or None if the payload is invalid, so that the request is tried again."""
    if datagram.status == Status.OK:
        try:
            reply = REPLIES[pending.type].unpack(datagram.payload)
        except DatagramError:
            return None
        return RequestOutcome(pending.token, Status.OK, reply, 0, pending.tries)
    detail = int.from_bytes(datagram.payload[:4], "little")
    return RequestOutcome(pending.token, datagram.status, None, detail, pending.tries)
