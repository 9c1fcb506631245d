"""Serial ports by pyserial, and what to do about one that cannot be opened, on Linux, macOS and Windows."""

import contextlib
import errno
import os
import re
import stat
import sys
import time
from pathlib import Path
from typing import Any

from firmware_host.errors import LineError, NoBoardError

_MISSING = {errno.ENOENT, errno.ENXIO, errno.ENODEV}
_DENIED = {errno.EACCES, errno.EPERM}
_TAKEN = {errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK}
_NEEDS_PORT = ("socket://", "rfc2217://")


class SerialTransport:
    """Anything that pyserial opens: a device, `socket://`, `rfc2217://`, `loop://` and so on.

    What its drivers raise differs from one platform to the next (`termios.error` is no `OSError`), and a port
    that another thread closes under a read raises `TypeError` or `AttributeError`: all of it is the line that
    broke.

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
            raise NoBoardError(f"{url}: cannot be opened: {_why(url, baud, fault)}") from fault

    def now(self) -> float:
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
            raise self._broken(fault) from fault

    def write(self, data: bytes) -> None:
        """See `Transport.write`."""
        try:
            self._port.write(data)
        except Exception as fault:
            raise self._broken(fault) from fault

    def close(self) -> None:
        """Close the port; one that is gone is closed."""
        with contextlib.suppress(Exception):
            self._port.close()

    def _broken(self, fault: Exception) -> LineError:
        return LineError(f"{self.name}: the line broke: {_text(fault)}; plug it in and run the command again")


def _text(fault: BaseException) -> str:
    return " ".join(str(fault).split()) or type(fault).__name__


def _code(fault: Exception) -> int | None:
    """The error number; pyserial hides that of Windows in its text, as the repr of what was raised."""
    number = getattr(fault, "errno", None)
    if number is None:
        number = getattr(fault.__cause__ or fault.__context__, "errno", None)
    hidden = re.search(r"(?:FileNotFound|Permission|OS)Error\((\d+),", str(fault))
    return int(hidden[1]) if number is None and hidden else number


def _why(url: str, baud: int, fault: Exception) -> str:
    """Why a port cannot be opened, and what to do."""
    if url.startswith(_NEEDS_PORT):
        scheme, _, place = url.partition("://")
        if not re.search(r":\d{1,5}(?:[/?]|$)", place) or place.startswith(":"):
            return f"expected {scheme}://HOST:PORT"
        return f"{_text(fault)}; start what listens there, or name another --port"
    code = _code(fault)
    if "://" not in url:
        if code in _MISSING:
            return "it is not there; plug it in, or find it with 'evlcp board ports'"
        if code in _DENIED and sys.platform != "win32":
            return _denied(Path(url))
        if code in _TAKEN or code in _DENIED:
            return _taken(url)
        if "baud" in str(fault).lower():
            return f"{_text(fault)}: its driver does not take --baud {baud}"
    return f"{_text(fault)}; 'evlcp board ports' lists the ports"


def _taken(device: str) -> str:
    """Who has a port."""
    if sys.platform == "win32":
        return "another program has it open, such as a terminal; end that one"
    found = holders(device)
    if found:
        return f"{' and '.join(found)} has it open; end that first"
    ask = f"lsof {device}" if sys.platform == "darwin" else f"sudo fuser -v {device}"
    return f"another program has it open; '{ask}' says which"


def holders(device: str) -> list[str]:
    """Programs that have a device open, as far as this user may know; empty where there is no `/proc`."""
    found = []
    with contextlib.suppress(OSError):
        wanted = os.path.realpath(device)
        for process in sorted(Path("/proc").glob("[0-9]*"), key=lambda p: int(p.name)):
            if int(process.name) == os.getpid():
                continue
            with contextlib.suppress(OSError):
                if any(str(link.readlink()) == wanted for link in (process / "fd").iterdir()):
                    found.append(f"{(process / 'comm').read_text().strip()} (process {process.name})")
    return found


def _denied(device: Path) -> str:
    """Which group a device belongs to, and the udev rule that opens it to who sits at the machine."""
    advice = []
    with contextlib.suppress(OSError, ImportError, KeyError):
        import getpass
        import grp

        about = device.stat()
        group = grp.getgrgid(about.st_gid)
        both = stat.S_IRGRP | stat.S_IWGRP
        user = getpass.getuser()
        if about.st_mode & both == both and group.gr_gid != 0:
            if user in group.gr_mem and group.gr_gid not in os.getgroups():
                return (
                    f"no permission: you are in its group {group.gr_name} since you logged in; log in again"
                )
            advice.append(
                f"it belongs to the group {group.gr_name}: 'sudo usermod -aG {group.gr_name} {user}'"
                " and log in again"
            )
    if sys.platform.startswith("linux"):
        advice.append(f"a udev rule lets you in: {_rule(str(device))}")
    return "no permission: " + ("; or ".join(advice) or "ask who runs this machine")


def _rule(device: str) -> str:
    """A line for /etc/udev/rules.d/70-evlcp.rules."""
    from firmware_host.ports.usb import serial_ports

    match = 'SUBSYSTEM=="tty"'
    usb = next((p.usb for p in serial_ports() if p.device == device), None)
    if usb is None:
        match += f', KERNEL=="{Path(device).name}"'
    else:
        vendor, product = usb.split(":")
        match += f', ATTRS{{idVendor}}=="{vendor}", ATTRS{{idProduct}}=="{product}"'
    return f'{match}, TAG+="uaccess", ENV{{ID_MM_DEVICE_IGNORE}}="1" in /etc/udev/rules.d/70-evlcp.rules'
