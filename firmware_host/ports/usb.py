"""Serial ports of this machine with their USB ids, and which of them may have a board."""

import re
from collections.abc import Callable
from dataclasses import dataclass

from evlcp_sdk.errors import ConfigError
from firmware_host.errors import NoBoardError

BRIDGES = (
    *("0403:6001", "0403:6010", "0403:6011", "0403:6014", "0403:6015"),  # FTDI
    *("0483:374b", "0483:374e", "0483:374f", "0483:3753"),  # ST-LINK
    "10c4:ea60",  # Silicon Labs CP210x
    *("1a86:55d4", "1a86:7523"),  # WCH CH9102, CH340
    "2e8a:000c",  # Raspberry Pi Debug Probe
)
"""USB ids of the bridges that boards usually have; by default only these ports are written to."""


@dataclass(frozen=True)
class SerialPort:
    """A serial port.

    Attributes:
        device: Name to give to `--port`.
        description: The operating system's description.
        usb: USB id `vvvv:pppp` in hex, or None.
        serial_number: The USB device's serial number, or None.
    """

    device: str
    description: str = ""
    usb: str | None = None
    serial_number: str | None = None


def usb_filter(text: str) -> Callable[[SerialPort], bool]:
    """Whether a port is of the USB devices `VID`, `VID:PID` or `VID:PID:SERIAL`, four hex digits an id.

    Raises:
        ConfigError: It is none of these.

    >>> usb_filter("0403:6015:D30A1")(SerialPort("COM7", "", "0403:6015", "D30A1"))
    True
    """
    found = re.fullmatch(r"([0-9a-fA-F]{4})(?::([0-9a-fA-F]{4})(?::(.+))?)?", text)
    if found is None:
        raise ConfigError(f"USB id {text!r}: expected VID, VID:PID or VID:PID:SERIAL, such as 0403:6015")
    vendor, product, serial = found.groups("")
    wanted = tuple(part for part in (vendor.lower(), product.lower(), serial) if part)
    return lambda port: (*(port.usb or "").split(":"), port.serial_number)[: len(wanted)] == wanted


def serial_ports() -> list[SerialPort]:
    """Serial ports of this machine, by name; nothing is opened or written."""
    from serial.tools.list_ports import comports

    return sorted(
        (
            SerialPort(
                p.device,
                p.description or "",
                None if p.vid is None or p.pid is None else f"{p.vid:04x}:{p.pid:04x}",
                p.serial_number or None,
            )
            for p in comports()
        ),
        key=lambda port: port.device,
    )


def find_usb_device(text: str) -> str:
    """The device of the one serial port with a USB id, `VID`, `VID:PID` or `VID:PID:SERIAL`.

    Raises:
        ConfigError: It is no USB id.
        NoBoardError: There is none, or there are several.
    """
    found = list(filter(usb_filter(text), serial_ports()))
    if len(found) == 1:
        return found[0].device
    if not found:
        raise NoBoardError(f"usb:{text}: no serial port has this USB id; 'evlcp board ports' lists them")
    names = ", ".join(f"{p.device} (serial number {p.serial_number})" for p in found)
    raise NoBoardError(f"usb:{text}: {len(found)} ports have it: {names}; give VID:PID:SERIAL")
