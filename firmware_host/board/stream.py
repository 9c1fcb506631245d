"""Packets onto a board as they come: a queue on the board, filled without waiting for each answer."""

from bisect import insort
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import takewhile
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.errors import ConfigError
from firmware_host.board.bank import Bank
from firmware_host.board.session import Session
from firmware_host.errors import BoardError, LineError
from firmware_host.protocol.client import RequestOutcome
from firmware_host.protocol.generated.requests import PushRequest, StopRequest

AHEAD = 4
"""Packets that wait on the board, the one that plays among them, unless the caller says otherwise."""

_PIECE_OVERHEAD = PushRequest.min_bytes()
_DARK_S = 10.0


@dataclass(frozen=True, order=True)
class _Piece:
    """A piece of a packet on its way."""

    number: int
    offset: int
    data: bytes = field(compare=False)
    ends: bool = field(compare=False)

    @property
    def after(self) -> tuple[int, int]:
        """Where the board stands when it has taken it."""
        return (self.number + 1, 0) if self.ends else (self.number, self.offset + len(self.data))


class Stream:
    """A board's queue of packets; `Board.stream` makes one.

    `send` puts a packet in; the board plays it after those before it, and shows its idle pattern while it
    has none. If the link's framing says what LEDs do meanwhile, a packet of that waits whenever nothing else
    does, so that the board is never without. As a context manager it ends in the dark: after the last packet,
    or, if something was raised, after the one that plays.

    Args:
        session: The session with the board; nothing else may use it meanwhile.
        bank: Number of the bank that is the queue.
        like: What is in it, as `bank.queue_of` makes it.
        ahead: Packets that wait on the board, the one that plays among them: few for a short delay, many for
            a host that may be held up.
        pulse_s: How long the board may hear nothing, s.

    Attributes:
        sent: Packets that were given to `send`.
        pauses: Packets of pause that were put in.
        begun: Packets that have begun to play, pauses among them, as far as the board has said.
        underruns: How often the board had none to play, as far as it has said.
        requests: Requests sent, repeated ones included.
    """

    def __init__(
        self,
        session: Session,
        bank: int,
        like: Bank,
        ahead: int,
        pulse_s: float,
    ) -> None:
        self._session = session
        self._bank = bank
        self._like = like
        self._ahead = ahead
        self._pulse_s = pulse_s
        self._pause = None
        if like.rest is not None:
            shape = (like.packet.packet_chips, like.clusters)
            self._pause = like.encode(np.full(shape, like.rest, np.uint8))
        self._room = session.max_payload - _PIECE_OVERHEAD
        self._retries = session.client.retries
        self._submitted = 0
        self._pieces: list[_Piece] = []
        self._flight: dict[int, tuple[_Piece | None, PushRequest]] = {}
        self._position = (0, 0)
        self.packet_s = like.packet.packet_chips / like.chip_rate_hz
        self._heard_s = session.transport.time_s()
        self._hold_s = self._heard_s
        # the latest at which the newest packet that is known to have begun did so; the first begins at once
        self._begun_s = self._heard_s - self.packet_s
        self.sent = 0
        self.pauses = 0
        self.begun = 0
        self.underruns = 0
        if self._pause is not None:
            # Before the board starts: it begins with a pause.
            self._pump(0.0)
            while self._pieces or self._flight:
                self._pump(self._pulse_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        elif not issubclass(kind, BoardError):
            self.stop()

    @property
    def requests(self) -> int:
        """Requests sent, repeated ones included."""
        return self._submitted + self._session.client.retries - self._retries

    @property
    def delay_s(self) -> float:
        """How long a packet that is sent now waits for its first chip, as far as can be told, s."""
        begins_s = self._begun_s + (self._next - self.begun + 1) * self.packet_s
        return max(0.0, begins_s - self._session.transport.time_s())

    def play(
        self,
        make: Callable[[int], Iterable[ArrayLike] | None],
        every_s: float,
        stopped: Callable[[], bool] = lambda: False,
    ) -> int:
        """Send messages that change: each round and round until it is time for the next; how many there were.

        Args:
            make: The packets of the message of a number, from 0 on, for now plus `delay_s`; None ends it. An
                iterator that makes each when it is taken holds nothing up.
            every_s: Time between two messages, s; one whose packets take longer is sent once.
            stopped: Asked before each packet whether to end early.

        Raises:
            BoardError: The line or the board fails.
        """
        line = self._session.transport
        due_s, number = line.time_s(), 0
        while not stopped() and (packets := make(number)) is not None:
            number += 1
            due_s = max(due_s + every_s, line.time_s())
            sent = []
            for packet in takewhile(lambda _: not stopped(), packets):
                sent.append(packet)
                self.send(packet)
            while sent and line.time_s() < due_s and not stopped():
                for packet in takewhile(lambda _: not stopped(), sent):
                    self.send(packet)
        return number

    def send(self, symbols: ArrayLike) -> int:
        """Send one packet; returns its number, from 0 on, as soon as it is on the line.

        Waits while `ahead` packets are on the board.

        Args:
            symbols: Symbols (frames, clusters).

        Raises:
            ConfigError: They are not a packet of the link.
            BoardError: The line or the board fails.
        """
        packet, like = np.asarray(symbols), self._like
        shape = (like.packet.frames, like.clusters)
        if packet.shape != shape:
            raise ConfigError(f"symbols of shape {packet.shape}, expected {shape}: frames, clusters")
        number = self._put(like.encode(packet_chips(packet, like.codebook, like.packet.pilot_every)))
        self.sent += 1
        while self._pieces and self._pieces[0].number <= number:
            self._pump(self._pulse_s)
            self._look()
        return self.sent - 1

    @property
    def _next(self) -> int:
        """The number on the line of the next packet."""
        return self.sent + self.pauses

    def _put(self, content: bytes) -> int:
        """Let a packet wait for its turn; the number on the line is returned."""
        number = self._next
        for at in range(0, len(content), self._room):
            data = content[at : at + self._room]
            self._pieces.append(_Piece(number, at, data, at + len(data) == len(content)))
        return number

    def wait(self, seconds: float) -> None:
        """Wait, and let the board hear of this host, so that its watchdog does not act.

        Raises:
            BoardError: The line or the board fails.
        """
        end = self._session.transport.time_s() + seconds
        while (left := end - self._session.transport.time_s()) > 0.0:
            self._pump(min(left, self._pulse_s))
            self._look()

    def close(self) -> None:
        """Play what was sent to its end, then dark.

        Raises:
            BoardError: The line or the board fails.
        """
        self._pause = None
        while self._pieces or self._flight:
            self._pump(self._pulse_s)
        if self._position != (self._next, 0):
            raise LineError(f"{self._session.name}: the board's queue lost a packet; send it again")
        self._submit(None, PushRequest(self._bank, self._next, 0, 1, b""))
        while self._flight:
            self._pump(self._pulse_s)
        self._session.wait_dark((self._next - self.begun + 1) * self.packet_s + _DARK_S)

    def stop(self) -> None:
        """Dark after the packet that plays; those that wait are not played."""
        self._pause = None
        self._pieces.clear()
        self._flight.clear()
        self._session.client.drop_requests()
        self._session.call(StopRequest())
        self._session.wait_dark(self.packet_s + _DARK_S)

    # -- what is on its way

    def _look(self) -> None:
        """Ask how the queue stands if nothing was heard for long."""
        if not self._flight and self._session.transport.time_s() - self._heard_s >= self._pulse_s:
            self._submit(None, PushRequest(self._bank, *self._position, 0, b""))

    def _submit(self, piece: _Piece | None, request: PushRequest) -> None:
        self._flight[self._session.client.submit(request)] = (piece, request)
        self._submitted += 1

    def _free_s(self, number: int, ahead: int) -> float:
        """When a packet may go out, so that `ahead` are on the board with it."""
        missing = number - ahead + 2 - self.begun
        return self._hold_s if missing <= 0 else max(self._hold_s, self._begun_s + missing * self.packet_s)

    def _pump(self, wait_s: float) -> None:
        """Send what may go out, and read for at most `wait_s`."""
        client, line = self._session.client, self._session.transport
        now = line.time_s()
        free = now + wait_s
        if self._pause is not None and not self._pieces:
            free = self._free_s(self._next, 2)
            if free <= now:
                self._put(self._pause)
                self.pauses += 1
        while self._pieces and client.has_room:
            free = self._free_s(self._pieces[0].number, self._ahead)
            if free > now:
                break
            piece = self._pieces.pop(0)
            self._submit(piece, PushRequest(self._bank, piece.number, piece.offset, 0, piece.data))
            free = now + wait_s
        data, deadline = client.poll(now)
        if data:
            line.write(data)
        end = min(free, now + wait_s, now + wait_s if deadline is None else deadline)
        # a packet that has gone out is not waited for
        done = not self._pieces and client.has_room and bool(data)
        received = line.read(0.0 if done else max(0.0, end - line.time_s()))
        for outcome in client.receive(received, line.time_s()):
            self._take(outcome)

    def _take(self, outcome: RequestOutcome) -> None:
        piece, request = self._flight.pop(outcome.token)
        reply = self._session.checked(request, outcome)
        now = self._session.transport.time_s()
        self._position = max(self._position, (reply.number, reply.offset))
        if reply.begun > self.begun:
            # packets follow each other without a gap, unless the board had none
            next_s = self._begun_s + (reply.begun - self.begun) * self.packet_s
            self._begun_s = min(now, next_s) if self.begun and reply.underruns == self.underruns else now
            self.begun = reply.begun
        else:
            # none has begun since
            self._begun_s = max(self._begun_s, now - self.packet_s)
        self.underruns = reply.underruns
        self._heard_s = now
        if piece is not None and piece.after > self._position:
            # it came before one that was lost, or there was no room
            insort(self._pieces, piece)
            self._hold_s = now + self.packet_s / 4.0
