"""A client on a line: requests are sent, answers awaited, refusals become errors that say what to do."""

import random
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar, cast

from evlcp_sdk.errors import OutputError
from firmware_host.board.tables import name_of
from firmware_host.errors import (
    BoardError,
    BoardResetError,
    IncompatibleError,
    LineError,
    NoBoardError,
    RefusedError,
    VerifyError,
)
from firmware_host.ports.transport import TraceTransport, Transport, on_network
from firmware_host.protocol.client import TRIES, Client, RequestOutcome, Timing
from firmware_host.protocol.generated import requests as protocol
from firmware_host.protocol.generated.requests import MAJOR, MINOR, State, Status
from firmware_host.protocol.seal import Sealer, key_name
from firmware_host.protocol.wire import WireMessage, WireRequest

Reply = TypeVar("Reply", bound=WireMessage)
Request = TypeVar("Request", bound=WireRequest[Any])

_ADVICE = {
    Status.UNKNOWN_TYPE: "the firmware does not know it; update the firmware",
    Status.BAD_LENGTH: "it expects {detail} bytes; host and firmware are of different versions",
    Status.OUT_OF_RANGE: "the nearest value the board can take is {detail}; choose that",
    Status.BUSY: "not while it plays, swaps or tests its LEDs; 'evlcp board stop' first, or try again",
    Status.BAD_CRC: "the bank holds other bytes than were sent (CRC {detail:08x}); program it again",
    Status.FOREIGN_CODEBOOK: "the firmware was built with another codebook; update firmware or host",
    Status.NO_SESSION: "the board was reset, or another program took it over; run the command again",
    Status.STALE: "the board has done a later request already; run the command again",
    Status.NOTHING_COMMITTED: "nothing is programmed that could play: a stream that has ended, say, is gone;"
    " 'evlcp board program' first",
    Status.INCOMPATIBLE: f"it speaks protocol {{protocol}}, this host {MAJOR}.{MINOR}; update the {{older}}",
    Status.FLASH_FAULT: "its flash does not hold the data; try again, then replace the board",
    Status.NOT_SUPPORTED: "this board cannot do that; 'evlcp board hello' shows what it can",
    Status.EMPTY_SLOT: "no settings are saved; 'evlcp board save' first",
    Status.TOO_BRIGHT: "a LED would be on for longer than the limits allow ({detail} of 1000 chips at this"
    " current); lower the level, raise --duty-limit if the installation allows it, or program chips that are"
    " dark more often",
    Status.NEEDS_KEY: "it has a key: give it with --key; without, it can only be looked at",
    Status.BAD_SEAL: "sealed with another key, or not for this session; run the command again",
    Status.HARDWARE_FAULT: "a fault holds the LEDs dark (bits {detail:#x}); see 'evlcp board status'",
}

_KINDS: dict[int, type[BoardError]] = {
    Status.BAD_CRC: VerifyError,
    Status.FOREIGN_CODEBOOK: IncompatibleError,
    Status.INCOMPATIBLE: IncompatibleError,
    Status.NO_SESSION: BoardResetError,
}


def refusal(name: str, type_: int, status: Status | int, detail: int) -> BoardError:
    """The error for a request that a board refused; its message says why and what to do."""
    request = protocol.Type(type_).name
    word = status.name if isinstance(status, Status) else f"status {status}"
    advice = _ADVICE.get(status, "update the host") if isinstance(status, Status) else "update the host"
    major, minor = detail & 0xFF, detail >> 8 & 0xFF
    values = {
        "detail": detail,
        "protocol": f"{major}.{minor}",
        "older": "firmware" if major < MAJOR else "host",
    }
    message = f"{name}: {request} refused ({word}): {advice.format(**values)}"
    kind = _KINDS.get(status)
    return kind(message) if kind else RefusedError(message, int(status), detail)


class Session:
    """A session with the board on a line.

    Args:
        transport: The line; closed with the session.
        timing: How long an answer may take.
        first: First sequence number, by default drawn at random.
        nonce: Number of the session, by default drawn at random.
        tries: How often a request is sent before it is given up.
        key: The board's key, which requests are sealed with if it has one.
        trace: File to record the line in.

    Attributes:
        max_payload: Largest payload that the board takes, bytes; HELLO says it.

    Raises:
        OutputError: The trace cannot be written; the line is closed.
    """

    def __init__(
        self,
        transport: Transport,
        timing: Timing | None = None,
        first: int | None = None,
        nonce: int | None = None,
        tries: int = TRIES,
        key: bytes | None = None,
        trace: Path | None = None,
    ) -> None:
        draw = random.SystemRandom()
        first = draw.randrange(1 << 16) if first is None else first
        self._nonce = draw.randrange(1 << 32) if nonce is None else nonce
        self.key = key
        self.max_payload = protocol.MAX_PAYLOAD
        self.client = Client(timing or Timing(), first=first, tries=tries)
        self.transport = transport
        if trace is not None:
            try:
                self.transport = TraceTransport(transport, trace, self.client.timing.baud, first, self._nonce)
            except OutputError:
                transport.close()
                raise

    @property
    def name(self) -> str:
        """What to call the board in messages."""
        return self.transport.name

    def __enter__(self) -> "Session":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the line."""
        self.transport.close()

    def hello(self) -> protocol.HelloReply:
        """Open the session, or keep it.

        Raises:
            NoBoardError: Nobody answers.
            IncompatibleError: The board speaks another protocol.
            RefusedError: It has another key than this host.
        """
        self.client.session = protocol.NO_SESSION
        self.client.sealer, known = None, self.client.sealer
        self.client.window = 1
        self.client.minor = MINOR
        found: list[RequestOutcome] = []
        request = protocol.HelloRequest(MAJOR, MINOR, self._nonce)
        try:
            # Ends what a host before this one may have left half sent.
            self.transport.write(b"\0")
            self.run([request], lambda _, outcome: found.append(outcome))
        except LineError as fault:
            if not on_network(self.name):
                raise
            raise NoBoardError(
                f"{self.name}: hangs up before it answers: another host is connected to it, or the board"
                " has ended; end that host, or start the board again"
            ) from fault
        (outcome,) = found
        if outcome.status is None:
            advice = "check power, cable and --baud, or find it with 'evlcp board ports'"
            if on_network(self.name):
                advice = "another host may be connected to it: end that one; or the board behind it is off"
            raise NoBoardError(f"{self.name}: no board answers; {advice}")
        if not isinstance(outcome.reply, protocol.HelloReply):
            raise refusal(self.name, protocol.Type.HELLO, outcome.status, outcome.detail)
        self.client.session = outcome.reply.session
        self.client.window = max(1, outcome.reply.window)
        self.max_payload = outcome.reply.max_payload
        self._agree_on_key(outcome.reply, outcome.token, known)
        self.client.minor = min(MINOR, outcome.reply.minor)
        return outcome.reply

    def renew(self) -> protocol.HelloReply:
        """Open another session; faults as of `hello`."""
        self._nonce = (self._nonce + 1) & 0xFFFFFFFF
        return self.hello()

    def _agree_on_key(self, about: protocol.HelloReply, token: int, known: Sealer | None) -> None:
        """Seal what follows if the board has a key; without it its board can only be looked at."""
        if not any(about.key_name) or self.key is None:
            return
        own = key_name(self.key)
        if own != about.key_name:
            raise RefusedError(
                f"{self.name}: has the key {about.key_name.hex()}, this host's is {own.hex()};"
                " give that board's with --key",
                Status.BAD_SEAL,
            )
        # numbers begin with that of the HELLO that opened the session
        start = ((self.client.first + token) & 0xFFFF) - token
        same = known is not None and known.challenge == about.challenge
        self.client.sealer = known if same else Sealer(self.key, about.challenge, start)
        self.max_payload = about.max_payload - protocol.SEAL_BYTES

    def call(self, request: WireRequest[Reply]) -> Reply:
        """One request and its answer.

        Raises:
            RefusedError: The board refuses; or the error that its status stands for.
            LineError: No answer came.
        """
        replies: list[Reply] = []
        self.call_each([request], lambda _, reply: replies.append(reply))
        return replies[0]

    def call_each(self, requests: Iterable[WireRequest[Reply]], handle: Callable[[Any, Reply], None]) -> None:
        """Many requests; `handle` gets each with its answer. Faults as of `call`, and of `handle`, end it."""
        self.run(requests, lambda request, outcome: handle(request, self.checked(request, outcome)))

    def status_when(
        self, done: Callable[[protocol.StatusReply], bool], timeout_s: float, pause_s: float = 0.005
    ) -> protocol.StatusReply:
        """Status once it is as wanted; or, not so, when `timeout_s` and a packet are over."""
        status = self.call(protocol.StatusRequest())
        # an older board's packet by its frames: a preamble of 32 chips at most, 32 a frame
        packet_s = (status.packet_chips or 32 + 32 * status.frames) / status.chip_rate_hz
        end = self.transport.time_s() + timeout_s + packet_s
        while not done(status) and self.transport.time_s() <= end:
            self.transport.read(pause_s)
            status = self.call(protocol.StatusRequest())
        return status

    def wait_dark(self, timeout_s: float) -> protocol.StatusReply:
        """Status once the LEDs are dark after a stop.

        Raises:
            LineError: They are not within `timeout_s` and the packet that a stop finishes.
        """
        ends = (State.DARK, State.FAULT)
        status = self.status_when(lambda status: status.state in ends, timeout_s)
        if status.state not in ends:
            state = name_of(State, status.state).upper()
            raise LineError(f"{self.name}: still {state}; try 'evlcp board blank'")
        return status

    def _check_known(self, request: WireRequest[Any]) -> None:
        """Raise IncompatibleError if the board's protocol is too old for a request."""
        later = request.find_unsupported(self.client.minor)
        if later is None:
            return
        what = protocol.Type(request.TYPE).name + ("" if later == "it" else f" with {later}")
        raise IncompatibleError(
            f"{self.name}: {what} is not in its protocol {MAJOR}.{self.client.minor}, this host has"
            f" {MAJOR}.{MINOR}; update the firmware"
        )

    def checked(self, request: WireRequest[Reply], outcome: RequestOutcome) -> Reply:
        """The answer of an outcome.

        Raises:
            BoardError: There is none; see `call`.
        """
        if outcome.status is None:
            raise LineError(
                f"{self.name}: no answer to {protocol.Type(request.TYPE).name} after {outcome.tries} tries;"
                " check the line and run the command again"
            )
        if outcome.reply is None:
            raise refusal(self.name, request.TYPE, outcome.status, outcome.detail)
        return cast(Reply, outcome.reply)

    def run(self, requests: Iterable[Request], handle: Callable[[Request, RequestOutcome], None]) -> None:
        """Send requests, as many at once as the board takes; `handle` gets each with its outcome.

        The next of `requests` is asked for when there is room for it, so that a generator may go by what has
        come in. What `handle` raises ends the run.

        Raises:
            LineError: The line went away.
        """
        source = iter(requests)
        sent: dict[int, Request] = {}
        more = True
        try:
            while sent or more:
                while more and self.client.has_room:
                    request = next(source, None)
                    if request is None:
                        more = False
                    else:
                        self._check_known(request)
                        sent[self.client.submit(request)] = request
                data, deadline = self.client.poll(self.transport.time_s())
                if data:
                    self.transport.write(data)
                wait = 0.0 if deadline is None else max(0.0, deadline - self.transport.time_s())
                received = self.transport.read(wait) if sent else b""
                for outcome in self.client.receive(received, self.transport.time_s()):
                    handle(sent.pop(outcome.token), outcome)
        finally:
            self.client.drop_requests()
