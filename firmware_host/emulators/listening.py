"""The board's end of an emulator's line: a socket or a pseudo-terminal."""

import os
import select
import socket
import tty
from contextlib import ExitStack
from pathlib import Path

from evlcp_sdk.errors import ConfigError
from firmware_host.errors import NoBoardError, ToolchainError
from firmware_host.ports.transport import SocketTransport, socket_address

_READ_BYTES = 2048


def check_listen_address(listen: str, pty: bool) -> None:
    """Raise ConfigError if an address, or `pty` if not allowed, is invalid, or a program listens there."""
    if listen == "pty" and pty:
        return
    try:
        socket_address(listen)
    except ValueError as fault:
        raise ConfigError(f"--listen {listen}: {fault}{', or pty' * pty}") from fault
    try:
        SocketTransport.connect(listen).close()
    except NoBoardError:
        return
    raise ConfigError(f"--listen {listen}: another program answers there; end it, or listen elsewhere")


class HostLine:
    """The board's end of a line, for one host at a time; others are disconnected.

    Args:
        listen: `unix:PATH`, where an old socket is replaced, `tcp:HOST:PORT`, or `pty`.
        link: Symbolic link to the pseudo-terminal; an old one is replaced.

    Attributes:
        place: Address for hosts.

    Raises:
        ToolchainError: It cannot listen there.
    """

    def __init__(self, listen: str, link: Path | None = None) -> None:
        self.place = listen
        self._server: socket.socket | None = None
        self._host: int | None = None
        self._unsent = b""
        self._closing = ExitStack()
        try:
            if listen == "pty":
                self._open_terminal(link)
            else:
                self._server = self._listen(listen)
        except OSError as fault:
            self.close()
            place = f"{listen}, link {link}" if listen == "pty" and link else listen
            raise ToolchainError(f"{place}: no board can listen there: {fault.strerror or fault}") from fault

    def _listen(self, listen: str) -> socket.socket:
        address = socket_address(listen)
        if isinstance(address, tuple):
            return self._closing.enter_context(socket.create_server(address))
        path = Path(address)
        if path.is_socket():
            path.unlink()
        server = self._closing.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        server.bind(address)
        self._closing.callback(path.unlink, missing_ok=True)
        server.listen(1)
        return server

    def _open_terminal(self, link: Path | None) -> None:
        # The other end stays open, so that the line outlives a host.
        self._host, end = os.openpty()
        self._closing.callback(os.close, end)
        tty.setraw(end)
        os.set_blocking(self._host, False)
        self.place = os.ttyname(end)
        if link is not None:
            if link.is_symlink():
                link.unlink()
            link.symlink_to(self.place)
            self._closing.callback(link.unlink, missing_ok=True)
            self.place = str(link)

    def exchange(self, data: bytes, wait_s: float) -> bytes:
        """Send to the host, if there is one; return what it has sent, after at most `wait_s`."""
        host = self._host
        self._unsent = self._unsent + data if host is not None else b""
        server = [] if self._server is None else [self._server.fileno()]
        ends = [] if host is None else [host]
        ready, free, _ = select.select(
            server + ends * (not self._unsent), ends * bool(self._unsent), [], wait_s
        )
        if self._server is not None and self._server.fileno() in ready:
            self._accept_host(self._server)
        try:
            if host is not None and free:
                self._unsent = self._unsent[os.write(host, self._unsent) :]
            if host is not None and host in ready:
                if found := os.read(host, _READ_BYTES):
                    return found
                self._hang_up()
        except BlockingIOError:
            pass
        except OSError:
            self._hang_up()
        return b""

    def _accept_host(self, server: socket.socket) -> None:
        if self._host is not None and _has_left(self._host):
            return  # all that it has sent is read first
        found, _ = server.accept()
        if self._host is not None:
            found.close()
            return
        found.setblocking(False)
        self._host = found.detach()

    def _hang_up(self) -> None:
        if self._host is not None:
            os.close(self._host)
        self._host = None

    def close(self) -> None:
        """Stop listening, and remove the socket or the link."""
        self._hang_up()
        self._closing.close()


def _has_left(host: int) -> bool:
    poll = select.poll()
    poll.register(host, select.POLLRDHUP)
    return bool(poll.poll(0))
