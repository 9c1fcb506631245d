"""Byte lines to a board: serial ports, sockets, traces.

A port is named by a device or any pyserial URL, by `usb:VID:PID` or `usb:VID:PID:SERIAL`, by `unix:PATH` or
`tcp:HOST:PORT`.
"""

import contextlib
import errno
import json
import re
import select
import socket
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from evlcp_sdk.errors import InputError, fault_message
from evlcp_sdk.files import open_log, read_bytes, writing
from firmware_host.errors import LineError, NoBoardError
from firmware_host.ports.usb import find_usb_device
from firmware_host.protocol.generated.requests import DEFAULT_BAUD

_NETWORK = ("unix:", "tcp:", "socket://", "rfc2217://")


def on_network(port: str) -> bool:
    """Whether a port is a socket, which has no line rate and may have another host at its other end.

    >>> on_network("unix:/tmp/board"), on_network("/dev/ttyUSB0")
    (True, False)
    """
    return port.startswith(_NETWORK)


def socket_address(spec: str) -> str | tuple[str, int]:
    """The path of `unix:PATH`, or host and port of `tcp:HOST:PORT`.

    Raises:
        ValueError: It is neither; the message says what was expected.
    """
    scheme, _, place = spec.partition(":")
    if scheme == "unix" and place:
        return place
    host, _, port = place.rpartition(":")
    # Not left to the system: some take a port modulo 65536.
    if scheme != "tcp" or not host or not re.fullmatch("[0-9]{1,5}", port) or not 1 <= int(port) <= 65535:
        raise ValueError("expected unix:PATH, or tcp:HOST:PORT with a port from 1 to 65535")
    return host, int(port)


class Transport(Protocol):
    """A byte line and the clock that its time-outs follow.

    Attributes:
        name: Its name in messages.
    """

    name: str

    def time_s(self) -> float:
        """The monotonic clock, s; a simulated line has its own."""
        return time.monotonic()

    def read(self, timeout_s: float) -> bytes:
        """The received bytes, after at most `timeout_s`; empty if there are none.

        Raises:
            LineError: The line went away.
        """

    def write(self, data: bytes) -> None:
        """Send bytes.

        Raises:
            LineError: The line went away.
        """

    def close(self) -> None:
        """Release the line."""


class SocketTransport(Transport):
    """A connected stream socket."""

    def __init__(self, name: str, connected: socket.socket) -> None:
        self.name = name
        self._socket = connected

    @classmethod
    def connect(cls, spec: str) -> "SocketTransport":
        """Connect to `unix:PATH` or `tcp:HOST:PORT`.

        Raises:
            NoBoardError: Nobody listens there, or the address is invalid.
        """
        try:
            address = socket_address(spec)
        except ValueError as fault:
            raise NoBoardError(f"{spec}: {fault}") from fault
        try:
            if isinstance(address, tuple):
                connected = socket.create_connection(address, timeout=5.0)
                connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            else:
                connected = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
                connected.settimeout(5.0)
                try:
                    connected.connect(address)
                except OSError:
                    connected.close()
                    raise
        except (OSError, ValueError, OverflowError) as fault:
            raise NoBoardError(
                f"{spec}: no board listens there ({fault}); start one with"
                f" 'evlcp board emulate native --listen {spec}' or name another --port"
            ) from fault
        return cls(spec, connected)

    def read(self, timeout_s: float) -> bytes:
        """See `Transport.read`."""
        try:
            if not select.select([self._socket], [], [], max(0.0, timeout_s))[0]:
                return b""
            data = self._socket.recv(65536)
        except (OSError, ValueError) as fault:
            raise LineError(f"{self.name}: the line broke: {fault}; run the command again") from fault
        if not data:
            raise LineError(f"{self.name}: the board hung up; start it again and run the command again")
        return data

    def write(self, data: bytes) -> None:
        """See `Transport.write`."""
        try:
            self._socket.sendall(data)
        except OSError as fault:
            raise LineError(f"{self.name}: the line broke: {fault}; run the command again") from fault

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


_ABSENT_ADVICE = "it is not there; plug it in, or find it with 'evlcp board ports'"
_DENIED_ADVICE = (
    "no permission: join its group, which 'ls -l {}' names: 'sudo usermod -aG GROUP USER', log in again"
)
_BUSY_ADVICE = "another program has it open; 'sudo fuser -v {}' says which"
_ADVICE: dict[int | None, str] = {
    **dict.fromkeys((errno.ENOENT, errno.ENXIO, errno.ENODEV), _ABSENT_ADVICE),
    **dict.fromkeys((errno.EACCES, errno.EPERM), _DENIED_ADVICE),
    **dict.fromkeys((errno.EBUSY, errno.EAGAIN), _BUSY_ADVICE),
}
"""Advice for a device that cannot be opened, by errno."""


class SerialTransport(Transport):
    """Anything that pyserial opens: a device, `socket://`, `rfc2217://`, `loop://` and so on.

    Drivers raise different errors on each platform (`termios.error` is no `OSError`), and a port that another
    thread closes during a read raises `TypeError` or `AttributeError`: each means that the line broke.

    Raises:
        NoBoardError: It cannot be opened.
    """

    _SLICE_S = 0.005

    def __init__(self, url: str, baud: int, even_parity: bool = False) -> None:
        import serial

        self.name = url
        options: dict[str, Any] = {} if "://" in url else {"exclusive": True}
        if even_parity:
            options["parity"] = serial.PARITY_EVEN
        try:
            self._port = serial.serial_for_url(
                url, baudrate=baud, timeout=self._SLICE_S, write_timeout=5.0, **options
            )
        except Exception as fault:
            raise NoBoardError(f"{url}: cannot be opened: {_explain_open_fault(url, baud, fault)}") from fault

    def read(self, timeout_s: float) -> bytes:
        """See `Transport.read`."""
        end = time.monotonic() + timeout_s
        try:
            while True:
                data = bytes(self._port.read(max(1, self._port.in_waiting)))
                if data or time.monotonic() >= end:
                    return data
        except Exception as fault:
            raise self._line_error(fault) from fault

    def write(self, data: bytes) -> None:
        """See `Transport.write`."""
        try:
            self._port.write(data)
        except Exception as fault:
            raise self._line_error(fault) from fault

    def close(self) -> None:
        """Close the port; errors of one that is gone are ignored."""
        with contextlib.suppress(Exception):
            self._port.close()

    def _line_error(self, fault: Exception) -> LineError:
        return LineError(
            f"{self.name}: the line broke: {fault_message(fault)}; plug it in and run the command again"
        )


def _explain_open_fault(url: str, baud: int, fault: Exception) -> str:
    scheme, on_network, _ = url.partition("://")
    if scheme in ("socket", "rfc2217"):
        return (
            f"{fault_message(fault)}; expected {scheme}://HOST:PORT; start what listens there, or name"
            " another --port"
        )
    advice = _ADVICE.get(getattr(fault, "errno", None))
    if advice is not None and not on_network:
        return advice.format(url)
    if "baud" in str(fault).lower():
        return f"{fault_message(fault)}: its driver does not take --baud {baud}"
    return f"{fault_message(fault)}; 'evlcp board ports' lists the ports"


class TraceTransport(Transport):
    """Passes everything through and records it as JSON lines.

    The first line has port, line rate and the client's random numbers; each further one is
    `{"t": seconds, "dir": "tx" | "rx", "hex": bytes}`.

    Raises:
        OutputError: The file cannot be written; so do `read`, `write` and `close`.
    """

    def __init__(self, inner: Transport, path: Path, baud: int, first: int, nonce: int) -> None:
        self.name = inner.name
        self._inner = inner
        self._path = path
        self._file = open_log(path)
        self._start = inner.time_s()
        self._write_line({"evlcp_trace": 1, "port": inner.name, "baud": baud, "first": first, "nonce": nonce})

    def _write_line(self, line: Mapping[str, Any]) -> None:
        with writing(self._path):
            self._file.write(json.dumps(line) + "\n")

    def _record(self, direction: str, data: bytes) -> None:
        if data:
            t = round(self._inner.time_s() - self._start, 6)
            self._write_line({"t": t, "dir": direction, "hex": data.hex()})

    def time_s(self) -> float:
        """The inner line's time, s."""
        return self._inner.time_s()

    def read(self, timeout_s: float) -> bytes:
        """See `Transport.read`."""
        data = self._inner.read(timeout_s)
        self._record("rx", data)
        return data

    def write(self, data: bytes) -> None:
        """See `Transport.write`."""
        self._record("tx", data)
        self._inner.write(data)

    def close(self) -> None:
        """Close line and file."""
        self._inner.close()
        with writing(self._path):
            self._file.close()


class ReplayTransport(Transport):
    """Plays a file of `TraceTransport` back: each received piece comes after those that were sent before it.

    Raises:
        InputError: The file cannot be read, or a line of it is wrong.
    """

    def __init__(self, path: Path) -> None:
        self.name = f"replay of {path}"
        self._events: deque[tuple[float, str, bytes]] = deque()
        number = 1
        try:
            head, *lines = read_bytes(path).decode("utf-8").splitlines()
            table = json.loads(head)
            self.first, self.nonce, self.baud = int(table["first"]), int(table["nonce"]), int(table["baud"])
            if not (0 <= self.nonce < 1 << 32 and self.baud > 0):
                raise ValueError(f"nonce {self.nonce}, baud {self.baud}")
            for line in lines:
                number += 1
                event = json.loads(line)
                if event["dir"] not in ("tx", "rx"):
                    raise ValueError(f"dir = {event['dir']!r}, expected 'tx' or 'rx'")
                self._events.append((float(event["t"]), event["dir"], bytes.fromhex(event["hex"])))
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as fault:
            what = f"{type(fault).__name__}: {fault}"[:200]
            raise InputError(f"{path}: line {number}: not a trace of the wire: {what}") from fault
        self._time_s = 0.0
        self._sent = 0

    def time_s(self) -> float:
        """Time in the trace, s."""
        return self._time_s

    def read(self, timeout_s: float) -> bytes:
        """The next received piece of the trace; while one to send is due, time passes."""
        if self._events and self._events[0][1] == "rx":
            at, _, data = self._events.popleft()
            self._time_s = max(self._time_s, at)
            return data
        if not self._events:
            raise LineError(f"{self.name}: the trace ends here; record it again with --trace")
        self._time_s += timeout_s
        return b""

    def write(self, data: bytes) -> None:
        """Compare with what was sent in the trace.

        Raises:
            LineError: It is something else.
        """
        while data:
            at, direction, expected = self._events.popleft() if self._events else (0.0, "end", b"")
            n = min(len(data), len(expected))
            if direction != "tx" or data[:n] != expected[:n]:
                raise LineError(
                    f"{self.name}: byte {self._sent} sent is another one than was recorded;"
                    " replay the command, the options and the files that were"
                )
            self._time_s = max(self._time_s, at)
            data = data[n:]
            self._sent += n
            if n < len(expected):
                self._events.appendleft((at, "tx", expected[n:]))

    def close(self) -> None:
        """Nothing to release."""


def open_transport(spec: str, baud: int = DEFAULT_BAUD, even_parity: bool = False) -> Transport:
    """Open a port by its name, as above; `firmware_host.emulators.opening` opens emulators, too.

    Raises:
        NoBoardError: It cannot be opened.
    """
    scheme, _, rest = spec.partition(":")
    if scheme in ("unix", "tcp"):
        return SocketTransport.connect(spec)
    return SerialTransport(find_usb_device(rest) if scheme == "usb" else spec, baud, even_parity)
