"""The host's end of the protocol as a state machine without I/O: window, time-outs, tries, sessions.

The caller moves bytes and time: `submit` requests, hand what was read to `receive`, write what `poll` gives,
and come back before its deadline.
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
"""How often a request is sent before it is given up, unless the caller says otherwise."""


BACKOFF = 2.0
"""Factor by which each further try waits longer."""

MOST_LATENCY_S = 10.0
"""The most that a measured latency makes a request wait for its first answer, s."""

SLOW_S = 0.1
"""A board whose answers are later than that gets requests one at a time, s; a USB bridge's take 16 ms."""

MOST_PATIENCE = 32.0
"""The most by which requests that were sent again make the next one wait longer."""


@dataclass(frozen=True)
class Timing:
    """How long an answer may take.

    Attributes:
        baud: Line rate, bit/s; a byte takes ten bits.
        latency_s: What board and host operating system add, s.

    >>> Timing(1_000_000).wire_s(200)
    0.002
    """

    baud: int = 1_000_000
    latency_s: float = 0.1

    def wire_s(self, count: int) -> float:
        """Time that `count` bytes take on the line, s."""
        return 10.0 * count / self.baud


@dataclass(frozen=True, slots=True)
class RequestOutcome:
    """How a request ended.

    Attributes:
        token: What `submit` returned for it.
        status: The board's status, or None if no answer came.
        reply: The answer, if the status is OK.
        detail: Number that goes with another status.
        tries: How often it was sent.
    """

    token: int
    status: Status | int | None
    reply: WireMessage | None
    detail: int
    tries: int


@dataclass(slots=True)
class _Waiting:
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

    What answers take beyond their time on the line is measured, as TCP does (RFC 6298): a slow board gets
    longer than `timing` says, never less.

    Args:
        timing: How long an answer may take.
        window: Requests under way at once; HELLO says how many the board takes.
        session: Session that HELLO gave.
        sealer: Seals requests of the session; None where the board has no key, or this host has not.
        minor: Minor version of the protocol in which requests are sent: the board's, that HELLO gave.
        first: First sequence number, by default drawn at random.
        tries: How often a request is sent before it is given up.
        retries: Counts the requests sent again.

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
    _queue: deque[_Waiting] = field(default_factory=deque)
    _flight: dict[int, _Waiting] = field(default_factory=dict)
    _outcomes: list[RequestOutcome] = field(default_factory=list)
    _now: float = 0.0
    _mean_s: float | None = None
    _spread_s: float = 0.0
    _patience: float = 1.0
    _largest: int = 32

    @property
    def latency_s(self) -> float:
        """What an answer may take beyond its time on the line, s; `timing` says at least how much."""
        measured = min((self._mean_s or 0.0) + 4 * self._spread_s, MOST_LATENCY_S)
        return max(self.timing.latency_s, measured) * self._patience

    def _may_go(self, waiting: _Waiting) -> bool:
        """Whether a request may go out beside those under way.

        What waits for its turn at a slow board would be sent again before: it gets one at a time, and of one
        whose short answers are late already the first long one is waited for.
        """
        if not self._flight:
            return True
        late_s = self._mean_s or 0.0
        alone = late_s > SLOW_S or (late_s > SLOW_S / 4 and len(waiting.wire) > 2 * self._largest)
        return not alone and len(self._flight) < self.window

    def _measure(self, waiting: _Waiting) -> None:
        """Take in how long an answer took; if its request was sent again, it may be to any of these."""
        if waiting.tries > 1:
            # until one is answered at its first try, as long as this one needed
            self._patience = min(self._patience * BACKOFF ** (waiting.tries - 1), MOST_PATIENCE)
            return
        self._patience = 1.0
        self._largest = max(self._largest, len(waiting.wire))
        late_s = max(0.0, self._now - waiting.sent - waiting.wire_s)
        if self._mean_s is None:
            self._mean_s, self._spread_s = late_s, late_s / 2
        else:
            self._spread_s += (abs(late_s - self._mean_s) - self._spread_s) / 4
            self._mean_s += (late_s - self._mean_s) / 8

    def submit(self, request: WireRequest[Any]) -> int:
        """Queue a request; returns the token its outcome will carry."""
        sequence = (self.first + self._tokens) & 0xFFFF
        token, payload, status = self._tokens, request.pack(self.minor), 0
        if self.sealer is not None and self.session != protocol.NO_SESSION:
            payload += self.sealer.seal(request.TYPE, self.session, token, payload)
            status = SEALED
        wire = Datagram(request.TYPE, status, sequence, self.session, payload).encode()
        reply = REPLIES[request.TYPE]
        longest = protocol.MAX_PAYLOAD if reply.takes_more() else max(4, reply.fixed_bytes())
        self._tokens += 1
        self._queue.append(
            _Waiting(token, request.TYPE, wire, longest + protocol.HEADER_BYTES + protocol.CRC_BYTES + 4)
        )
        return token

    @property
    def room(self) -> bool:
        """Whether one more request would go out at once."""
        return len(self._queue) + len(self._flight) < self.window

    def forget(self) -> None:
        """Drop everything queued and under way; late answers will be ignored."""
        self._queue.clear()
        self._flight.clear()

    def receive(self, data: bytes, now: float | None = None) -> list[RequestOutcome]:
        """Take what was read from the line, at a time; give what it settles."""
        self._now = self._now if now is None else now
        for datagram in self.decoder.feed(data):
            waiting = self._flight.get(datagram.sequence)
            if waiting is None or datagram.type != waiting.type | protocol.REPLY_BIT:
                continue
            outcome = _outcome(waiting, datagram)
            if outcome is not None:
                del self._flight[datagram.sequence]
                self._measure(waiting)
                self._outcomes.append(outcome)
        done, self._outcomes = self._outcomes, []
        return done

    def poll(self, now: float) -> tuple[bytes, float | None]:
        """Bytes to write now, and the time by which to come back (None if nothing is under way).

        Requests that have had all their tries are settled without a status; `receive` gives them.
        """
        out = []
        self._now = now
        while self._queue and self._may_go(self._queue[0]):
            waiting = self._queue.popleft()
            self._flight[(self.first + waiting.token) & 0xFFFF] = waiting
            out.append(self._send(waiting, now))
        for sequence, waiting in list(self._flight.items()):
            if waiting.due > now:
                continue
            if waiting.tries >= self.tries:
                del self._flight[sequence]
                self._outcomes.append(RequestOutcome(waiting.token, None, None, 0, waiting.tries))
            else:
                self.retries += 1
                out.append(self._send(waiting, now))
        if self._outcomes:
            return b"".join(out), now
        return b"".join(out), min((w.due for w in self._flight.values()), default=None)

    def _send(self, waiting: _Waiting, now: float) -> bytes:
        queued = sum(len(w.wire) for w in self._flight.values())
        replies = sum(w.reply_bytes for w in self._flight.values())
        waiting.wire_s = 2 * self.timing.wire_s(queued + replies)
        waiting.due = now + (waiting.wire_s + self.latency_s) * BACKOFF**waiting.tries
        waiting.sent = now
        waiting.tries += 1
        return waiting.wire


def _outcome(waiting: _Waiting, datagram: Datagram) -> RequestOutcome | None:
    """The outcome, or None if the payload is not the reply's (then a further try decides)."""
    if datagram.status == Status.OK:
        try:
            reply = REPLIES[waiting.type].unpack(datagram.payload)
        except DatagramError:
            return None
        return RequestOutcome(waiting.token, Status.OK, reply, 0, waiting.tries)
    detail = int.from_bytes(datagram.payload[:4], "little")
    try:
        status: Status | int = Status(datagram.status)
    except ValueError:
        status = datagram.status
    return RequestOutcome(waiting.token, status, None, detail, waiting.tries)
