"""A stream of packets: a queue on the board that is filled without waiting for each answer."""

from bisect import insort
from collections.abc import Callable, Iterable
from itertools import takewhile
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.errors import ConfigError
from firmware_host.board.bank import Bank
from firmware_host.board.session import Session
from firmware_host.board.tables import flag_names
from firmware_host.errors import BoardError, LineError, RefusedError
from firmware_host.protocol.client import RequestOutcome
from firmware_host.protocol.generated.requests import (
    BoardFault,
    PushRequest,
    State,
    Status,
    StatusReply,
    StatusRequest,
    StopRequest,
)

DEFAULT_AHEAD = 4
"""Default number of packets on the board, the playing one included."""

_PIECE_OVERHEAD = PushRequest.min_bytes()
_DARK_S = 10.0


class Stream:
    """A board's queue of packets; `Board.stream` makes one.

    `send` adds a packet; the board plays it after the earlier ones, and shows its idle pattern while the
    queue is empty. If the link's framing determines the LEDs' state meanwhile, pauses of that state keep the
    queue from being empty. As a context manager it ends in the dark: after the last packet, or, if something
    was raised, after the playing one. Its methods raise a `BoardError` if the line or the board fails.

    Args:
        session: The session with the board; nothing else may use it meanwhile.
        bank: Number of the bank that is the queue.
        template: The link's bank without packets, from `bank.make_queue`.
        ahead: Packets on the board, the playing one included: few for a short delay, many for a host that may
            stall.
        pulse_s: Longest time between two requests, s.

    Attributes:
        sent: Packets given to `send`.
        pauses: Pauses added, in packets.
        begun: Packets that have begun to play, pauses included, by the last reply.
        underruns: Times that the queue was empty, by the last reply.
    """

    def __init__(self, session: Session, bank: int, template: Bank, ahead: int, pulse_s: float) -> None:
        self._session = session
        self._bank = bank
        self._template = template
        self._ahead = ahead
        self._pulse_s = pulse_s
        self._pause_packet = None
        if template.rest is not None:
            shape = (template.link.packet.packet_chips, template.clusters)
            self._pause_packet = template.encode(np.full(shape, template.rest, np.uint8))
        self._piece_bytes = session.max_payload - _PIECE_OVERHEAD
        self._retries = session.client.retries
        self._submitted = 0
        self._pieces: list[PushRequest] = []
        self._in_flight: dict[int, PushRequest] = {}
        self._position = (0, 0)
        self._last_ends: tuple[tuple[int, int], int] | None = None
        self._stands = 0
        self.packet_s = template.link.packet.packet_chips / template.chip_rate_hz
        self._last_reply_s = session.transport.time_s()
        self._set_state_due()
        self._blocked_until_s = self._last_reply_s
        # latest possible start of the newest packet that has begun; the first begins at once
        self._begun_s = self._last_reply_s - self.packet_s
        self.sent = 0
        self.pauses = 0
        self.begun = 0
        self.underruns = 0
        if self._pause_packet is not None:
            # The board starts with a pause.
            self._exchange(0.0)
            while self._pieces or self._in_flight:
                self._exchange(self._pulse_s)
                self._request_position()

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
        """Expected time until the first chip of a packet that is sent now, s."""
        begins_s = self._begun_s + (self._next_number - self.begun + 1) * self.packet_s
        return max(0.0, begins_s - self._session.transport.time_s())

    def play(
        self,
        make_packets: Callable[[int], Iterable[ArrayLike] | None],
        every_s: float,
        stopped: Callable[[], bool] = lambda: False,
    ) -> int:
        """Send changing messages, each repeatedly until the next is due; return their number.

        Args:
            make_packets: Gives the packets of a message by its number, from 0 on, to be on air after
                `delay_s`, or None to end; an iterator that encodes each on demand avoids delays.
            every_s: Time between two messages, s; one whose packets take longer is sent once.
            stopped: Asked before each packet whether to end early.
        """
        line = self._session.transport
        due_s, number = line.time_s(), 0
        while not stopped() and (packets := make_packets(number)) is not None:
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
        """Send one packet, symbols (frames, clusters); return its number, from 0, when it is on the line.

        Waits while `ahead` packets are on the board.

        Raises:
            ConfigError: The symbols are not a packet of the link.
        """
        packet, template = np.asarray(symbols), self._template
        shape = (template.link.packet.frames, template.clusters)
        if packet.shape != shape:
            raise ConfigError(f"symbols of shape {packet.shape}, expected {shape}: frames, clusters")
        chips = packet_chips(packet, template.link.codebook, template.link.packet.pilot_every)
        number = self._queue_packet(template.encode(chips))
        self.sent += 1
        while self._pieces and self._pieces[0].number <= number:
            self._exchange(self._pulse_s)
            self._request_position()
        return self.sent - 1

    @property
    def _next_number(self) -> int:
        return self.sent + self.pauses

    def _queue_packet(self, content: bytes) -> int:
        number = self._next_number
        for at in range(0, len(content), self._piece_bytes):
            data = content[at : at + self._piece_bytes]
            self._pieces.append(PushRequest(self._bank, number, at, 0, data))
        return number

    def wait(self, seconds: float) -> None:
        """Wait, with requests often enough that the board's watchdog does not act."""
        end = self._session.transport.time_s() + seconds
        while (left := end - self._session.transport.time_s()) > 0.0:
            self._exchange(min(left, self._pulse_s))
            self._request_position()

    def close(self) -> None:
        """Play all sent packets to their end, then go dark."""
        self._pause_packet = None
        while self._pieces or self._in_flight:
            self._exchange(self._pulse_s)
            self._request_position()
        if self._position != (self._next_number, 0):
            raise LineError(f"{self._session.name}: the board's queue lost a packet; send it again")
        self._submit(PushRequest(self._bank, self._next_number, 0, 1, b""))
        while self._in_flight:
            self._exchange(self._pulse_s)
        left_s = (self._next_number - self.begun + 1) * self.packet_s
        self._check_state(self._session.wait_dark(left_s + _DARK_S), State.FAULT)

    def stop(self) -> None:
        """Go dark after the playing packet; waiting ones are dropped."""
        self._pause_packet = None
        self._pieces.clear()
        self._in_flight.clear()
        self._session.client.drop_requests()
        self._session.call(StopRequest())
        self._session.wait_dark(self.packet_s + _DARK_S)

    # -- requests

    def _request_position(self) -> None:
        """Request the state if no packet has begun for long, or the queue's position without a reply."""
        now_s = self._session.transport.time_s()
        if self._in_flight:
            return
        if now_s >= self._state_due_s:
            status = self._session.call(StatusRequest())
            self._check_state(status, State.FAULT, State.DARK)
            self._check_progress(status)
            self._set_state_due()
        elif now_s - self._last_reply_s >= self._pulse_s:
            self._submit(PushRequest(self._bank, *self._position, 0, b""))

    def _set_state_due(self) -> None:
        self._state_due_s = self._session.transport.time_s() + self.packet_s + self._pulse_s

    def _check_state(self, status: StatusReply, *wrong: State) -> None:
        """Raise RefusedError if the board has gone dark, by a fault, its watchdog or another host."""
        if status.state in wrong:
            faults = ", ".join(flag_names(BoardFault, status.faults)) or "none"
            raise RefusedError(
                f"{self._session.name}: went dark before the stream ended, faults {faults};"
                " see 'evlcp board status', then stream again",
                Status.HARDWARE_FAULT,
                status.faults,
            )

    def _check_progress(self, status: StatusReply) -> None:
        """Raise RefusedError if the board plays the queue, but takes no piece, and begins no packet of it."""
        plays = status.state in (State.PLAYING, State.IDLE_PATTERN) and status.active_bank == self._bank
        ends = (self._position, self.begun)
        stands = plays and self._pieces and ends == self._last_ends
        self._stands, self._last_ends = self._stands + 1 if stands else 0, ends
        if self._stands == 3:  # one may have waited for a boundary, or for a piece
            raise RefusedError(
                f"{self._session.name}: plays, but takes no more packets of the stream ({self.begun} of"
                f" {self._position[0]} have begun); 'evlcp board stop', then stream again",
                Status.BUSY,
            )

    def _submit(self, request: PushRequest) -> None:
        self._in_flight[self._session.client.submit(request)] = request
        self._submitted += 1

    def _earliest_send_s(self, number: int, ahead: int) -> float:
        """Earliest time to send a packet so that at most `ahead` are on the board, s."""
        missing = number - ahead + 2 - self.begun
        return max(self._blocked_until_s, self._begun_s + missing * self.packet_s)

    def _exchange(self, wait_s: float) -> None:
        """Send all pieces that are due, and read for at most `wait_s`."""
        client, line = self._session.client, self._session.transport
        now_s = line.time_s()
        due_s = now_s + wait_s
        if self._pause_packet is not None and not self._pieces:
            due_s = self._earliest_send_s(self._next_number, 2)
            if due_s <= now_s:
                self._queue_packet(self._pause_packet)
                self.pauses += 1
        while self._pieces and client.has_room:
            due_s = self._earliest_send_s(self._pieces[0].number, self._ahead)
            if due_s > now_s:
                break
            self._submit(self._pieces.pop(0))
            due_s = now_s + wait_s
        data, deadline = client.poll(now_s)
        if data:
            line.write(data)
        end = min(due_s, now_s + wait_s, now_s + wait_s if deadline is None else deadline)
        # no wait after a packet is out
        done = not self._pieces and client.has_room and bool(data)
        received = line.read(0.0 if done else max(0.0, end - line.time_s()))
        for outcome in client.receive(received, line.time_s()):
            self._handle_outcome(outcome)

    def _handle_outcome(self, outcome: RequestOutcome) -> None:
        request = self._in_flight.pop(outcome.token)
        reply = self._session.expect_reply(request, outcome)
        now_s = self._session.transport.time_s()
        self._position = max(self._position, (reply.number, reply.offset))
        if reply.begun > self.begun:
            # packets follow each other without a gap unless the queue was empty
            next_s = self._begun_s + (reply.begun - self.begun) * self.packet_s
            self._begun_s = min(now_s, next_s) if self.begun and reply.underruns == self.underruns else now_s
            self.begun = reply.begun
            self._set_state_due()
        else:
            # none has begun since
            self._begun_s = max(self._begun_s, now_s - self.packet_s)
        self.underruns = reply.underruns
        self._last_reply_s = now_s
        if request.data and (request.number, request.offset + len(request.data)) > self._position:
            # an earlier piece was lost, or there was no room
            insort(self._pieces, request, key=lambda piece: (piece.number, piece.offset))
            self._blocked_until_s = now_s + self.packet_s / 4.0
