"""RAW words from the network and from other programs: TCP, UDP, Unix sockets."""

import socket
from contextlib import ExitStack
from typing import Final
from urllib.parse import urlsplit

from evlcp_sdk.errors import InputError
from evlcp_sdk.io.raw import CODECS, ChunkReader, RawSource, format_header
from evlcp_sdk.io.urls import parse_size, split_options
from evlcp_sdk.plugin.source import EventSource

SCHEMES: Final = ("tcp", "udp", "unix")
"""Schemes that `open_stream` opens."""

_CONNECT_S: Final = 5.0
_POLL_S: Final = 0.2
"""How often a read checks whether another thread has closed it."""

_DATAGRAM_BYTES: Final = 1 << 16
_KERNEL_BYTES: Final = 1 << 22
"""The kernel's receive buffer: 10 ms of the most that a camera sends."""


def _parse_encoding(text: str) -> str:
    names = {"2": "EVT2", "3": "EVT3"}
    names |= {key: codec.name for codec in CODECS.values() for key in (codec.version, codec.name.lower())}
    if text.lower() not in names:
        raise ValueError("2, 2.1 or 3")
    return names[text.lower()]


class SocketReader(ChunkReader):
    """The bytes that a socket receives, behind `header` if they come without one."""

    def __init__(self, sock: socket.socket, header: bytes = b"") -> None:
        super().__init__()
        self._socket = sock
        self._header = header
        self._datagrams = sock.type == socket.SOCK_DGRAM
        self._closed = False
        sock.settimeout(_POLL_S)

    def fileno(self) -> int:
        """Return the descriptor of the socket."""
        return self._socket.fileno()

    def read_chunk(self) -> bytes:
        """Wait for bytes; return none at the end, or once the socket is closed.

        Raises:
            OSError: The connection has failed.
        """
        while True:
            try:
                data = self._socket.recv(_DATAGRAM_BYTES)
            except TimeoutError:
                continue
            except OSError:
                if self._closed:
                    return b""
                raise
            is_first = not self.bytes_read
            # Some datagrams are empty, and some repeat the header.
            if self._datagrams and (not data or (not is_first and data.startswith(b"% evt "))):
                continue
            bare = is_first and data and not data.startswith(b"% ")
            return self._header + data if bare else data

    def close(self) -> None:
        """Close the connection; a read in another thread ends soon."""
        self._closed = True
        self._socket.close()


class StreamSource(RawSource):
    """A stream of RAW words from a socket."""

    live = True


def open_stream(url: str) -> EventSource:
    """Open RAW words from `tcp://HOST:PORT`, `udp://HOST:PORT` (listens there) or `unix:PATH`.

    A stream without a RAW file's header takes the options `?evt=3` (the default of UDP), `?evt=2.1` or
    `?evt=2`, and `&size=1280x720`.

    Raises:
        InputError: Nobody sends there, the name has another form, or the bytes are not RAW.
    """
    named, options = split_options(url, {"evt": _parse_encoding, "size": parse_size})
    scheme = named.partition(":")[0].lower()
    header = b""
    if options or scheme == "udp":
        width, height = options.get("size", (1280, 720))
        header = format_header(CODECS[options.get("evt", "EVT3")], width, height)
    try:
        sock = _open_socket(scheme, named)
    except OSError as fault:
        what = fault.strerror or str(fault) or type(fault).__name__
        raise InputError(f"{url}: {what}; {_HINTS[scheme]}") from fault
    return StreamSource(url, file=SocketReader(sock, header))


_HINTS: Final = {
    "tcp": "expected a program that sends there, such as: evlcp serve REC.raw --tcp PORT",
    "udp": "expected an address of this machine and a port that is free, e.g. udp://0.0.0.0:5600",
    "unix": "expected a socket that a program listens on",
}


def _open_socket(scheme: str, url: str) -> socket.socket:
    with ExitStack() as stack:
        if scheme == "tcp":
            sock = stack.enter_context(socket.create_connection(_parse_address(url), _CONNECT_S))
        elif scheme == "unix":
            sock = stack.enter_context(socket.socket(socket.AF_UNIX))
            sock.settimeout(_CONNECT_S)
            sock.connect(url.partition(":")[2].removeprefix("//"))
        else:
            address = _parse_address(url)
            family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
            sock = stack.enter_context(socket.socket(family, socket.SOCK_DGRAM))
            sock.bind(address)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _KERNEL_BYTES)
        stack.pop_all()
    return sock


def _parse_address(url: str) -> tuple[str, int]:
    """Return the host and port of a URL.

    Raises:
        InputError: It has no port, or port 0.
    """
    parts = urlsplit(url)
    try:
        port = parts.port
    except ValueError:
        port = None
    if not port or not url.partition(":")[2].startswith("//") or parts.path not in ("", "/"):
        raise InputError(f"{url}: expected {parts.scheme}://HOST:PORT")
    return parts.hostname or "localhost", port
