"""Where emulators listen for a host: a socket or a pseudo-terminal."""

import os
import select
import socket
import tty
from pathlib import Path

from evlcp_sdk.errors import ConfigError
from firmware_host.errors import NoBoardError, ToolchainError
from firmware_host.ports.transport import SocketTransport, socket_address

_MOST_BYTES = 2048


def check_listen(listen: str, pty: bool) -> None:
    """Raise ConfigError unless an emulator can listen there, and nobody answers; a socket left behind may be.

    Args:
        listen: What `--listen` says.
        pty: Whether it may be a pseudo-terminal.
    """
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
    """The board's end of a line, for one host at a time; another one is hung up on.

    Args:
        listen: `unix:PATH`, where a socket left behind is replaced, `tcp:HOST:PORT`, or `pty`.
        link: Name for the pseudo-terminal; a link of that name is replaced.

    Attributes:
        place: What hosts connect to.

    Raises:
        ToolchainError: One cannot listen there.
    """

    def __init__(self, listen: str, link: Path | None = None) -> None:
        self.place = listen
        self._server: socket.socket | None = None
        self._host: int | None = None
        self._others: list[int] = []
        self._link: Path | None = link
        self._out = b""
        try:
            if listen == "pty":
                self._open_terminal(link)
            else:
                self._server = self._listen(listen)
        except OSError as fault:
            raise ToolchainError(f"{listen}: no board can listen there: {fault.strerror or fault}") from fault

    def _listen(self, listen: str) -> socket.socket:
        address = socket_address(listen)
        if isinstance(address, tuple):
            return socket.create_server(address)
        self._link = Path(address)
        if self._link.is_socket():
            self._link.unlink()
        server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            server.bind(address)
        except OSError:
            server.close()
            raise
        server.listen(1)
        return server

    def _open_terminal(self, link: Path | None) -> None:
        # The other end stays open, so that a host that leaves does not hang up the line.
        self._host, end = os.openpty()
        self._others = [end]
        tty.setraw(end)
        os.set_blocking(self._host, False)
        self.place = os.ttyname(end)
        if link is not None:
            if link.is_symlink():
                link.unlink()
            link.symlink_to(self.place)
            self.place = str(link)

    def exchange(self, data: bytes, wait_s: float) -> bytes:
        """Send to the host, if there is one, and give what it has sent, after at most `wait_s`."""
        host = self._host
        self._out = self._out + data if host is not None else b""
        server = [] if self._server is None else [self._server.fileno()]
        ends = [] if host is None else [host]
        ready, free, _ = select.select(server + ends * (not self._out), ends * bool(self._out), [], wait_s)
        if self._server is not None and self._server.fileno() in ready:
            self._take_host(self._server)
        try:
            if host is not None and free:
                self._out = self._out[os.write(host, self._out) :]
            if host is not None and host in ready:
                if found := os.read(host, _MOST_BYTES):
                    return found
                self._hang_up()
        except BlockingIOError:
            pass
        except OSError:
            self._hang_up()
        return b""

    def _take_host(self, server: socket.socket) -> None:
        if self._host is not None and _has_left(self._host):
            return  # first all that it has sent is read
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
        """Listen no longer; the socket or the link is removed."""
        self._hang_up()
        for end in self._others:
            os.close(end)
        if self._server is not None:
            self._server.close()
        if self._link is not None:
            self._link.unlink(missing_ok=True)


def _has_left(host: int) -> bool:
    poll = select.poll()
    poll.register(host, select.POLLRDHUP)
    return bool(poll.poll(0))
