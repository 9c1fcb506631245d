"""RAW words from the network and from other programs: TCP, UDP, Unix sockets."""

import socket
from typing import Final
from urllib.parse import urlsplit

from evlcp_sdk.errors import InputError
from evlcp_sdk.io.raw import CODECS, ChunkBytes, RawSource, format_header
from evlcp_sdk.io.urls import sides, split_options
from evlcp_sdk.plugin.source import EventSource

SCHEMES: Final = ("tcp", "udp", "unix")
"""Those that `open_stream` opens."""

_CONNECT_S: Final = 5.0
_LOOK_S: Final = 0.2
"""How often a read looks whether it was closed by another thread."""

_DATAGRAM_BYTES: Final = 1 << 16
_KERNEL_BYTES: Final = 1 << 22
"""Bytes that the kernel is asked to hold for us: 10 ms of the most that a camera sends."""


def _encoding(text: str) -> str:
    named = {"2": "EVT2", "3": "EVT3", "2.0": "EVT2", "3.0": "EVT3"} | {name.lower(): name for name in CODECS}
    if text.lower() not in named:
        raise ValueError("2 or 3")
    return named[text.lower()]


class SocketBytes(ChunkBytes):
    """What a socket receives; of a stream without a header one is put before.

    Args:
        sock: The socket, connected, or bound where it is of datagrams.
        header: Put before what comes, where that has none.
    """

    def __init__(self, sock: socket.socket, header: bytes = b"") -> None:
        super().__init__()
        self._socket = sock
        self._header = header
        self._datagrams = sock.type == socket.SOCK_DGRAM
        self._first = True
        self._closed = False
        sock.settimeout(_LOOK_S)

    def fileno(self) -> int:
        """Of the socket."""
        return self._socket.fileno()

    def more(self) -> bytes:
        """Wait for bytes; nothing at the end, or once it is closed.

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
            # Of datagrams one is empty now and then, and a header comes again and again.
            if self._datagrams and (not data or (not self._first and data.startswith(b"% evt "))):
                continue
            bare = self._first and data and not data.startswith(b"% ")
            self._first = False
            return self._header + data if bare else data

    def close(self) -> None:
        """Let the connection go; a read in another thread ends soon."""
        self._closed = True
        self._socket.close()


class StreamSource(RawSource):
    """A stream of RAW words from a socket."""

    live = True


def open_stream(url: str) -> EventSource:
    """Open `tcp://HOST:PORT`, `udp://HOST:PORT` (which listens there) or `unix:PATH`: RAW words.

    A stream that starts with a RAW file's header says what it is. For others `?evt=3` (the default of UDP) or
    `?evt=2`, and `&size=1280x720`.

    Raises:
        InputError: Nobody is there, the name is not of this kind, or what comes is not RAW.
    """
    named, options = split_options(url, {"evt": _encoding, "size": sides})
    scheme = named.partition(":")[0].lower()
    header = b""
    if options or scheme == "udp":
        width, height = options.get("size", (1280, 720))
        header = format_header(CODECS[options.get("evt", "EVT3")], width, height)
    try:
        sock = _connected(scheme, named)
    except OSError as fault:
        what = fault.strerror or str(fault) or type(fault).__name__
        raise InputError(f"{url}: {what}; {_NEXT[scheme]}") from fault
    return StreamSource(url, file=SocketBytes(sock, header))


_NEXT: Final = {
    "tcp": "expected a program that sends there, such as: evlcp serve REC.raw --tcp PORT",
    "udp": "expected an address of this machine and a port that is free, e.g. udp://0.0.0.0:5600",
    "unix": "expected a socket that a program listens on",
}


def _connected(scheme: str, url: str) -> socket.socket:
    if scheme == "tcp":
        sock = socket.create_connection(_address(url), _CONNECT_S)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _KERNEL_BYTES)
        return sock
    if scheme == "unix":
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    else:
        address = _address(url)
        sock = socket.socket(socket.AF_INET6 if ":" in address[0] else socket.AF_INET, socket.SOCK_DGRAM)
    try:
        if scheme == "unix":
            sock.settimeout(_CONNECT_S)
            sock.connect(url.partition(":")[2].removeprefix("//"))
        else:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _KERNEL_BYTES)
            sock.bind(address)
    except BaseException:
        sock.close()
        raise
    return sock


def _address(url: str) -> tuple[str, int]:
    """Host and port of a URL.

    Raises:
        InputError: There is no port in it, or 0, which nobody could send to.
    """
    parts = urlsplit(url)
    try:
        port = parts.port
    except ValueError:
        port = None
    if not port or not url.partition(":")[2].startswith("//") or parts.path not in ("", "/"):
        raise InputError(f"{url}: expected {parts.scheme}://HOST:PORT")
    return parts.hostname or "localhost", port
