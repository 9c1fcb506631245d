"""Sends a source to other programs over the network, as RAW words."""

import socket
import threading
from contextlib import suppress
from pathlib import Path
from typing import Final

from evlcp_sdk.errors import OutputError, StreamError
from evlcp_sdk.io.evt import EVT3, MAX_SIDE
from evlcp_sdk.io.interruptible import stream_until_stopped
from evlcp_sdk.io.raw import RawEncoder, format_header
from evlcp_sdk.live.publisher import Publisher, Subscription
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.signals import Stopped, never_stop

_MAX_PIECES: Final = 2000
"""Pieces that may wait for a slow client: two seconds of a camera."""

_STALLED_S: Final = 10.0
"""A client that takes nothing for so long is disconnected."""

_POLL_S: Final = 0.2


class Sender:
    """Sends a source's events and triggers, EVT3, to all clients; a context manager.

    Each gets a header and all pieces from then on. A slow client never delays the others: its oldest pieces
    are dropped, which is counted; one that takes nothing for ten seconds is disconnected.

    Args:
        source: The source; not closed. A sensor of unknown size counts as 1280 x 720.
        tcp: Host and port to listen on; port 0 for any free one. None for no TCP.
        unix: Path of a Unix socket to listen on, too; None for none.

    Attributes:
        port: The TCP port; 0 without.
        counts: Events sent, clients, and pieces dropped.

    Raises:
        OutputError: It cannot listen there.
    """

    def __init__(
        self, source: EventSource, tcp: tuple[str, int] | None = None, unix: Path | None = None
    ) -> None:
        self._source = source
        self._publisher = Publisher()
        self._threads: list[threading.Thread] = []
        self._listening: list[socket.socket] = []
        self._connected = threading.Event()
        self._unix: Path | None = None
        self.port = 0
        self.counts = {"events": 0, "listeners": 0, "pieces_dropped": 0}
        try:
            if tcp is not None:
                family = socket.AF_INET6 if ":" in tcp[0] else socket.AF_INET
                self._listening.append(socket.create_server(tcp, family=family))
                self.port = self._listening[-1].getsockname()[1]
            if unix is not None:
                self._listening.append(socket.socket(socket.AF_UNIX))
                self._listening[-1].bind(str(unix))
                self._unix = unix  # until then it may be another's file
                self._listening[-1].listen()
        except OSError as fault:
            self.close()
            address = f"{tcp[0]}:{tcp[1]}" if tcp is not None and not self.port else str(unix)
            raise OutputError(f"{address}: cannot listen: {fault.strerror or fault}") from fault
        for one in self._listening:
            self._start(self._accept, one)

    def wait(self, stopped: Stopped) -> bool:
        """Wait for the first client; False where `stopped` ends that."""
        while not stopped():
            if self._connected.wait(_POLL_S):
                return True
        return False

    def run(self, stopped: Stopped = never_stop) -> None:
        """Send the source to its end, or until stopped; return when all clients have got it.

        Raises:
            InputError: The source cannot be read on.
            StreamError: An event is at a place that EVT3 words cannot have.
        """
        try:
            for events, triggers in stream_until_stopped(self._source, stopped):
                if (place := max(events.x.max(initial=0), events.y.max(initial=0))) >= MAX_SIDE:
                    what = f"an event in column or row {place}, expected 0 to {MAX_SIDE - 1}"
                    raise StreamError(f"{self._source.path}: {what}")
                self.counts["events"] += len(events)
                self._publisher.publish("events", 0.0, (events, triggers))
                if stopped():
                    break
        finally:
            self.close()
            for thread in self._threads:
                thread.join(2 * _STALLED_S)

    def close(self) -> None:
        """Listen no more, and disconnect clients when they have got the rest."""
        self._publisher.close()
        for one in self._listening:
            # Closing alone does not end an `accept`.
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        if self._unix is not None:
            self._unix.unlink(missing_ok=True)
        self._unix, self._listening = None, []

    def __enter__(self) -> "Sender":
        return self

    def __exit__(self, *_fault: object) -> None:
        self.close()

    def _start(self, target: object, *args: object) -> None:
        thread = threading.Thread(target=target, args=args, daemon=True)  # type: ignore[arg-type]
        self._threads.append(thread)
        thread.start()

    def _accept(self, listening: socket.socket) -> None:
        # It ends when it is closed.
        with suppress(OSError):
            while True:
                connection, _ = listening.accept()
                subscription = self._publisher.subscribe({"events"}, most=_MAX_PIECES)
                self.counts["listeners"] += 1
                self._start(self._send, connection, subscription)
                self._connected.set()

    def _send(self, connection: socket.socket, subscription: Subscription) -> None:
        width, height = self._source.width or 1280, self._source.height or 720
        encoder = RawEncoder(EVT3)
        with connection:
            connection.settimeout(_STALLED_S)
            try:
                connection.sendall(format_header(EVT3, width, height))
                while not subscription.ended:
                    for news in subscription.take():
                        for words in encoder.encode(*news.value):
                            connection.sendall(words)
            except OSError:
                pass  # The client has left, or takes nothing.
            finally:
                self._publisher.unsubscribe(subscription)
                self.counts["pieces_dropped"] += subscription.dropped
