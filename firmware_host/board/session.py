"""A session with a board: sends requests, waits for answers, and turns refusals into errors with advice."""

import random
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar, cast

from evlcp_sdk.errors import OutputError
from firmware_host.board.tables import enum_name
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

_ADVICE: dict[int, str] = {
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

_LEAST_PAYLOAD = 128
"""Payload that every board takes, bytes: the longest request with its seal is shorter."""

_KINDS: dict[int, type[BoardError]] = {
    Status.BAD_CRC: VerifyError,
    Status.FOREIGN_CODEBOOK: IncompatibleError,
    Status.INCOMPATIBLE: IncompatibleError,
    Status.NO_SESSION: BoardResetError,
}


def make_refusal(name: str, type_: int, status: int, detail: int) -> BoardError:
    """The error for a request that a board refused, with the reason and advice."""
    request = protocol.Type(type_).name
    word = next((known.name for known in Status if known == status), f"status {status}")
    major, minor = detail & 0xFF, detail >> 8 & 0xFF
    values = {
        "detail": detail,
        "protocol": f"{major}.{minor}",
        "older": "firmware" if major < MAJOR else "host",
    }
    message = f"{name}: {request} refused ({word}): {_ADVICE.get(status, 'update the host').format(**values)}"
    kind = _KINDS.get(status)
    return kind(message) if kind else RefusedError(message, status, detail)


class Session:
    """A session with the board on a line.

    Args:
        transport: The line; closed with the session.
        timing: The time that an answer may take.
        first: First sequence number, by default random.
        nonce: Number of the session, by default random.
        tries: Number of times that a request is sent.
        key: The board's key, by which requests are sealed if the board has one.
        trace: File to record the line in.

    Attributes:
        max_payload: Largest payload that the board takes, bytes, from HELLO.

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
        """The board's name in messages."""
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
        self.client.sealer, old_sealer = None, self.client.sealer
        self.client.minor = MINOR
        found: list[RequestOutcome] = []
        request = protocol.HelloRequest(MAJOR, MINOR, self._nonce)
        try:
            # Ends a datagram that an earlier host may have left incomplete.
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
            raise make_refusal(self.name, protocol.Type.HELLO, outcome.status, outcome.detail)
        if outcome.reply.max_payload < _LEAST_PAYLOAD:
            raise IncompatibleError(
                f"{self.name}: takes {outcome.reply.max_payload} bytes of payload, expected at least"
                f" {_LEAST_PAYLOAD}: no board that this host can use"
            )
        self.client.session = outcome.reply.session
        self.client.window = max(1, outcome.reply.window)
        self.max_payload = min(outcome.reply.max_payload, protocol.MAX_PAYLOAD)
        self._agree_on_key(outcome.reply, outcome.token, old_sealer)
        self.client.minor = min(MINOR, outcome.reply.minor)
        return outcome.reply

    def renew(self) -> protocol.HelloReply:
        """Open another session; errors as of `hello`."""
        self._nonce = (self._nonce + 1) & 0xFFFFFFFF
        return self.hello()

    def _agree_on_key(self, info: protocol.HelloReply, token: int, old_sealer: Sealer | None) -> None:
        """Seal further requests if both ends have the board's key; without it only its state can be read."""
        if not any(info.key_name) or self.key is None:
            return
        own = key_name(self.key)
        if own != info.key_name:
            raise RefusedError(
                f"{self.name}: has the key {info.key_name.hex()}, this host's is {own.hex()};"
                " give that board's with --key",
                Status.BAD_SEAL,
            )
        # numbers begin with that of the session's HELLO
        start = ((self.client.first + token) & 0xFFFF) - token
        same = old_sealer is not None and old_sealer.challenge == info.challenge
        self.client.sealer = old_sealer if same else Sealer(self.key, info.challenge, start)
        self.max_payload -= protocol.SEAL_BYTES

    def call(self, request: WireRequest[Reply]) -> Reply:
        """Send one request, and return its answer.

        Raises:
            RefusedError: The board refuses; or the error class of its status.
            LineError: There is no answer.
        """
        replies: list[Reply] = []
        self.call_each([request], lambda _, reply: replies.append(reply))
        return replies[0]

    def call_each(self, requests: Iterable[WireRequest[Reply]], handle: Callable[[Any, Reply], None]) -> None:
        """Send many requests; `handle` gets each with its answer. Errors, as of `call`, end it."""
        self.run(requests, lambda request, outcome: handle(request, self.expect_reply(request, outcome)))

    def wait_for_status(
        self, done: Callable[[protocol.StatusReply], bool], timeout_s: float, pause_s: float = 0.005
    ) -> protocol.StatusReply:
        """The status when it fulfils `done`, or the last one after `timeout_s` and a packet."""
        status = self.call(protocol.StatusRequest())
        # older firmware gives frames alone: at most a preamble of 32 chips, and 32 a frame
        packet_s = (status.packet_chips or 32 + 32 * status.frames) / max(1, status.chip_rate_hz)
        end = self.transport.time_s() + timeout_s + packet_s
        while not done(status) and self.transport.time_s() <= end:
            self.transport.read(pause_s)
            status = self.call(protocol.StatusRequest())
        return status

    def wait_dark(self, timeout_s: float) -> protocol.StatusReply:
        """Status when the LEDs are dark after a stop.

        Raises:
            LineError: They are not within `timeout_s` and a packet.
        """
        ends = (State.DARK, State.FAULT)
        status = self.wait_for_status(lambda status: status.state in ends, timeout_s)
        if status.state not in ends:
            state = enum_name(State, status.state).upper()
            raise LineError(f"{self.name}: still {state}; try 'evlcp board blank'")
        return status

    def _check_supported(self, request: WireRequest[Any]) -> None:
        part = request.find_unsupported(self.client.minor)
        if part is None:
            return
        what = protocol.Type(request.TYPE).name + ("" if part == "it" else f" with {part}")
        raise IncompatibleError(
            f"{self.name}: {what} is not in its protocol {MAJOR}.{self.client.minor}, this host has"
            f" {MAJOR}.{MINOR}; update the firmware"
        )

    def expect_reply(self, request: WireRequest[Reply], outcome: RequestOutcome) -> Reply:
        """The answer in an outcome.

        Raises:
            BoardError: There is none; see `call`.
        """
        if outcome.status is None:
            raise LineError(
                f"{self.name}: no answer to {protocol.Type(request.TYPE).name} after {outcome.tries} tries;"
                " check the line and run the command again"
            )
        if outcome.reply is None:
            raise make_refusal(self.name, request.TYPE, outcome.status, outcome.detail)
        return cast(Reply, outcome.reply)

    def run(self, requests: Iterable[Request], handle: Callable[[Request, RequestOutcome], None]) -> None:
        """Send requests, as many at once as the board takes; `handle` gets each with its outcome.

        Each is taken from `requests` when there is room for it, so that a generator may depend on earlier
        outcomes. An error of `handle` ends the run.

        Raises:
            LineError: The line went away.
        """
        source = iter(requests)
        sent: dict[int, Request] = {}
        try:
            while True:
                while self.client.has_room and (request := next(source, None)) is not None:
                    self._check_supported(request)
                    sent[self.client.submit(request)] = request
                if not sent:
                    return
                data, deadline = self.client.poll(self.transport.time_s())
                if data:
                    self.transport.write(data)
                wait = 0.0 if deadline is None else max(0.0, deadline - self.transport.time_s())
                received = self.transport.read(wait)
                for outcome in self.client.receive(received, self.transport.time_s()):
                    handle(sent.pop(outcome.token), outcome)
        finally:
            self.client.drop_requests()
