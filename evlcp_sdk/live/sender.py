"""A source given to other programs over the network, as RAW words."""

import socket
import threading
from pathlib import Path
from typing import Final

from evlcp_sdk.errors import OutputError
from evlcp_sdk.io.evt import EVT3
from evlcp_sdk.io.interruptible import stream_until_stopped
from evlcp_sdk.io.raw import RawEncoder, format_header
from evlcp_sdk.live.publisher import Publisher, Subscription
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.signals import Stopped

_MOST_PIECES: Final = 2000
"""Pieces that wait for one who takes them slowly: two seconds of a camera."""

_STALLED_S: Final = 10.0
"""Who takes nothing for so long is let go."""

_LOOK_S: Final = 0.2


class Sender:
    """Sends a source's events and triggers, EVT3, to all who connect; a context manager.

    Each gets a header and what comes from then on. Nobody is waited for: of one who is slow the oldest pieces
    are dropped, which is counted; who takes nothing for ten seconds is let go.

    Args:
        source: What is sent; not closed. It must say the size of its sensor, or 1280 x 720 is taken.
        tcp: Host and port to listen on; port 0 for any that is free. None for no TCP.
        unix: Path of a Unix socket to listen on, too; None for none.

    Attributes:
        port: The TCP port; 0 without.
        counts: Pieces read and dropped, and listeners, so far.

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
        self._first = threading.Event()
        self._over = threading.Event()
        self._unix = unix
        self.port = 0
        self.counts = {"events": 0, "listeners": 0, "pieces_dropped": 0}
        try:
            if tcp is not None:
                family = socket.AF_INET6 if ":" in tcp[0] else socket.AF_INET
                self._listening.append(socket.create_server(tcp, family=family))
                self.port = self._listening[-1].getsockname()[1]
            if unix is not None:
                made = socket.socket(socket.AF_UNIX)
                self._listening.append(made)
                made.bind(str(unix))
                made.listen()
        except OSError as fault:
            self.close()
            where = f"{tcp[0]}:{tcp[1]}" if tcp is not None and not self.port else str(unix)
            raise OutputError(f"{where}: cannot listen: {fault.strerror or fault}") from fault
        for one in self._listening:
            one.settimeout(_LOOK_S)
            self._start(self._accept, one)

    def wait(self, stopped: Stopped) -> bool:
        """Wait until somebody has connected; False where that ends early."""
        while not stopped():
            if self._first.wait(_LOOK_S):
                return True
        return False

    def run(self, stopped: Stopped = lambda: False) -> None:
        """Send the source to its end, or until stopped; returns when all who listen have what was sent.

        Raises:
            InputError: The source cannot be read on.
        """
        try:
            for events, triggers in stream_until_stopped(self._source, stopped):
                self.counts["events"] += len(events)
                self._publisher.publish("events", 0.0, (events, triggers))
                if stopped():
                    break
        finally:
            self._publisher.close()
            self._over.set()
            for thread in self._threads:
                thread.join(2 * _STALLED_S)

    def close(self) -> None:
        """Let all go."""
        self._over.set()
        self._publisher.close()
        for one in self._listening:
            one.close()
        if self._unix is not None and self._listening:
            self._unix.unlink(missing_ok=True)
        self._listening = []

    def __enter__(self) -> "Sender":
        return self

    def __exit__(self, *_fault: object) -> None:
        self.close()

    def _start(self, target: object, *args: object) -> None:
        thread = threading.Thread(target=target, args=args, daemon=True)  # type: ignore[arg-type]
        self._threads.append(thread)
        thread.start()

    def _accept(self, listening: socket.socket) -> None:
        while not self._over.is_set():
            try:
                connection, _ = listening.accept()
            except TimeoutError:
                continue
            except OSError:
                return
            mine = self._publisher.subscribe({"events"}, most=_MOST_PIECES)
            self.counts["listeners"] += 1
            self._start(self._send, connection, mine)
            self._first.set()

    def _send(self, connection: socket.socket, mine: Subscription) -> None:
        width, height = self._source.width or 1280, self._source.height or 720
        encoder = RawEncoder(EVT3)
        with connection:
            connection.settimeout(_STALLED_S)
            try:
                connection.sendall(format_header(EVT3, width, height))
                while not mine.ended:
                    for news in mine.take():
                        for words in encoder.encode(*news.value):
                            connection.sendall(words)
            except OSError:
                pass  # It has left, or takes nothing.
            finally:
                self._publisher.leave(mine)
                self.counts["pieces_dropped"] += mine.dropped
