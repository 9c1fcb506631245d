"""Serial ports by pyserial, and advice if one cannot be opened."""

import contextlib
import errno
import time
from typing import Any

from evlcp_sdk.errors import fault_message
from firmware_host.errors import LineError, NoBoardError

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


class SerialTransport:
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

    def time_s(self) -> float:
        """Monotonic time, s."""
        return time.monotonic()

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
