"""Serial ports: found by USB id without being written to; what is said of one that cannot be opened."""

import errno
import json
import os
import pty
import termios
import tty
from types import SimpleNamespace
from unittest.mock import Mock, PropertyMock

import pytest
from board_lines import check_fault

from evlcp_sdk.errors import ConfigError
from firmware_host.errors import LineError, NoBoardError
from firmware_host.ports.transport import SerialTransport, open_transport
from firmware_host.ports.usb import find_usb_device, usb_filter

serial = pytest.importorskip("serial")
Fault = serial.SerialException


def listed_port(device, vid=None, pid=None, number=None):
    """A port as pyserial lists it."""
    return SimpleNamespace(device=device, description=f"{device} n/a", vid=vid, pid=pid, serial_number=number)


@pytest.fixture
def pty_name():
    """A pseudo-terminal: our end, and the name of the other, a port."""
    ours, other = pty.openpty()
    tty.setraw(other)
    yield ours, os.ttyname(other)
    os.close(ours)
    os.close(other)


@pytest.fixture
def ports(monkeypatch):
    found = [
        listed_port("COM7", 0x0403, 0x6015, "D30A1"),
        listed_port("COM3"),
        listed_port("COM9", 0x1546, 0x01A9, "gps"),
    ]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: found)
    return found


@pytest.fixture
def opened(monkeypatch):
    """Which ports were opened since the last look; none can be."""
    refuse = Mock(side_effect=Fault(errno.ENOENT, "could not open port"))
    monkeypatch.setattr("serial.serial_for_url", refuse)

    def names():
        found = sorted(call.args[0] for call in refuse.call_args_list)
        refuse.reset_mock()
        return found

    return names


def test_a_usb_id_must_be_one(ports, opened):
    for wrong in ("", "403", "0403-6015", "xyz0", "0403:"):
        with pytest.raises(ConfigError, match="expected VID, VID:PID or VID:PID:SERIAL"):
            usb_filter(wrong)
    with pytest.raises(NoBoardError, match="COM7: cannot be opened"):
        open_transport("usb:0403")
    assert find_usb_device("1546:01A9") == "COM9"
    with pytest.raises(NoBoardError, match="no serial port has this USB id"):
        find_usb_device("0403:6001")
    ports.append(listed_port("COM8", 0x0403, 0x6015, "D30A2"))
    with pytest.raises(NoBoardError, match=r"2 ports have it: COM7 \(serial number D30A1\), COM8"):
        open_transport("usb:0403:6015")
    assert opened() == ["COM7"]


def test_board_ports(evlcp, ports, opened):
    rows = json.loads(evlcp("board", "ports", "--json").out)
    assert [(r["port"], r["usb"], r["asked"]) for r in rows] == [
        ("COM3", None, False),
        ("COM7", "0403:6015", True),
        ("COM9", "1546:01a9", False),
    ]
    assert opened() == ["COM7"]
    reported = evlcp("board", "ports", "--no-ask", "--usb", "0403").out
    assert reported == "COM7  0403:6015 D30A1  COM7 n/a  not asked\n"
    assert opened() == []
    assert "no serial port with USB id ffff" in evlcp("board", "ports", "--usb", "ffff").out
    check_fault(evlcp("board", "ports", "--usb", "no"), 2, "expected VID, VID:PID or VID:PID:SERIAL")


def test_a_real_tty_gets_no_byte(monkeypatch, evlcp, pty_name):
    """What hangs on a port of no bridge hears nothing of the search."""
    ours, port = pty_name
    os.set_blocking(ours, False)
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [listed_port(port)])
    assert evlcp("board", "hello").code == 4
    with pytest.raises(BlockingIOError):
        os.read(ours, 100)
    evlcp("board", "ports", "--all")
    assert os.read(ours, 100)


@pytest.mark.parametrize(
    ("port", "fault", "message"),
    [
        ("/dev/ttyUSB0", ValueError("Failed to set custom baud rate (3)"), "take --baud 3"),
        ("/dev/ttyUSB0", termios.error(5, "Input/output error"), "Input/output error"),
        ("/dev/ttyUSB0", Fault(errno.EACCES, "x"), "no permission: join its group, which 'ls -l"),
        ("/dev/ttyUSB0", Fault(errno.EAGAIN, "x"), "sudo fuser -v /dev/ttyUSB0"),
        ("hwgrep://[", KeyError("x"), "evlcp board ports"),
    ],
)
def test_what_cannot_be_opened_says_what_to_do(evlcp, monkeypatch, port, fault, message):
    monkeypatch.setattr("serial.serial_for_url", Mock(side_effect=fault))
    done = evlcp("board", "hello", "--port", port, "--baud", "3000000")
    check_fault(done, 4, f"{port}: cannot be opened", message)


def test_a_port_has_one_host(pty_name):
    line = SerialTransport(pty_name[1], 9600)
    with pytest.raises(NoBoardError, match="another program has it open"):
        SerialTransport(pty_name[1], 9600)
    line.close()


@pytest.mark.parametrize(
    "fault",
    [
        Fault("device reports readiness to read but returned no data"),
        termios.error(5, "Input/output error"),
        TypeError("'NoneType' object cannot be interpreted as an integer"),
    ],
    ids=lambda fault: type(fault).__name__,
)
def test_an_unplugged_port_is_a_broken_line(monkeypatch, fault):
    unplugged = Mock()
    type(unplugged).in_waiting = PropertyMock(side_effect=fault)
    unplugged.write.side_effect = unplugged.close.side_effect = fault
    monkeypatch.setattr("serial.serial_for_url", lambda *_, **__: unplugged)
    line = SerialTransport("COM3", 1_000_000)
    for do in (lambda: line.read(0.0), lambda: line.write(b"x")):
        with pytest.raises(LineError, match=r"COM3: the line broke: .*plug it in"):
            do()
    line.close()


def test_no_port(monkeypatch, evlcp):
    monkeypatch.setattr("serial.tools.list_ports.comports", list)
    check_fault(evlcp("board", "status"), 4, "--port native: for an emulated one")
