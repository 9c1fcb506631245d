"""RAW words from the network and from other programs: TCP, UDP, Unix sockets."""

import os
import socket
import threading
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from evlcp_sdk.errors import InputError
from evlcp_sdk.io.raw import CODECS, RawSource, format_header
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


class SocketBytes:
    """What a socket receives, as `RawSource` reads it; of a stream without a header one is put before.

    Args:
        sock: The socket, connected, or bound where it is of datagrams.
        name: What faults call it.
        header: Put before what comes, where that has none; None where it must have one.
    """

    def __init__(self, sock: socket.socket, name: str, header: bytes | None) -> None:
        self._socket = sock
        self._name = name
        self._header = header
        self._datagrams = sock.type == socket.SOCK_DGRAM
        self._ready = b""
        self._buffer = bytearray(_DATAGRAM_BYTES)
        self._first = True
        self._closed = threading.Event()
        sock.settimeout(_LOOK_S)

    def fileno(self) -> int:
        """Of the socket."""
        return self._socket.fileno()

    def readinto(self, room: Any) -> int:
        """Wait for bytes; 0 at the end, or once it is closed.

        Raises:
            OSError: The connection has failed.
        """
        if not self._ready:
            self._ready = self._received(len(room))
            if self._first and self._ready:
                self._first = False
                if self._header is not None and not self._ready.startswith(b"% "):
                    self._ready = self._header + self._ready
        size = min(len(room), len(self._ready))
        room[:size] = self._ready[:size]
        self._ready = self._ready[size:]
        return size

    def _received(self, most: int) -> bytes:
        while not self._closed.is_set():
            try:
                size = self._socket.recv_into(
                    self._buffer, 0 if self._datagrams else min(most, _DATAGRAM_BYTES)
                )
            except TimeoutError:
                continue
            except OSError:
                if self._closed.is_set():
                    break
                raise
            data = bytes(memoryview(self._buffer)[:size])
            if not self._datagrams or (data and (self._first or not data.startswith(b"% evt "))):
                return data
        return b""

    def close(self) -> None:
        """Let the connection go; a read in another thread ends soon."""
        self._closed.set()
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
    header = None
    if options or scheme == "udp":
        width, height = options.get("size", (1280, 720))
        header = format_header(CODECS[options.get("evt", "EVT3")], width, height)
    try:
        sock = _connected(scheme, named)
    except OSError as fault:
        raise InputError(f"{url}: {_what(fault)}; {_NEXT[scheme]}") from fault
    return StreamSource(url, file=SocketBytes(sock, url, header))


_NEXT: Final = {
    "tcp": "expected a program that sends there, such as: evlcp serve REC.raw --tcp PORT",
    "udp": "expected an address of this machine and a port that is free, e.g. udp://0.0.0.0:5600",
    "unix": "expected a socket that a program listens on",
}


def _what(fault: OSError) -> str:
    return fault.strerror or str(fault) or type(fault).__name__


def _connected(scheme: str, url: str) -> socket.socket:
    if scheme == "unix":
        path = url.partition(":")[2].removeprefix("//")
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            sock.settimeout(_CONNECT_S)
            sock.connect(os.fspath(Path(path)))
        except BaseException:
            sock.close()
            raise
        return sock
    host, port = _address(url)
    if scheme == "tcp":
        sock = socket.create_connection((host or "localhost", port), _CONNECT_S)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _KERNEL_BYTES)
        return sock
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_DGRAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _KERNEL_BYTES)
        sock.bind((host or "localhost", port))
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
    return parts.hostname or "", port
