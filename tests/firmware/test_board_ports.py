"""Serial ports: found by USB id without being written to; what is said of one that cannot be opened."""

import errno
import json
import os
import pty
import socket
import subprocess
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock, PropertyMock

import pytest
from board_lines import check_fault

from evlcp_sdk.errors import ConfigError
from firmware_host.board import survey
from firmware_host.errors import LineError, NoBoardError
from firmware_host.ports import serial_port
from firmware_host.ports.serial_port import SerialTransport, holders
from firmware_host.ports.transport import open_transport
from firmware_host.ports.usb import UsbFilter, device_of, serial_ports

serial = pytest.importorskip("serial")
Fault = serial.SerialException


def listed(
    device: str, vid: int | None = None, pid: int | None = None, number: str | None = None
) -> SimpleNamespace:
    """A port as pyserial lists it."""
    return SimpleNamespace(device=device, description=f"{device} n/a", vid=vid, pid=pid, serial_number=number)


@pytest.fixture
def pty_name() -> Iterator[tuple[int, str]]:
    """A pseudo-terminal: our end, and the name of the other, a port."""
    ours, other = pty.openpty()
    tty.setraw(other)
    yield ours, os.ttyname(other)
    os.close(ours)
    os.close(other)


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch) -> list[SimpleNamespace]:
    found = [listed("COM7", 0x0403, 0x6015, "D30A1"), listed("COM3"), listed("COM9", 0x1546, 0x01A9, "gps")]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: found)
    return found


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[str]]:
    """Which ports were opened since the last look; none can be."""
    refuse = Mock(side_effect=Fault(errno.ENOENT, "could not open port"))
    monkeypatch.setattr("serial.serial_for_url", refuse)

    def names() -> list[str]:
        found = sorted(call.args[0] for call in refuse.call_args_list)
        refuse.reset_mock()
        return found

    return names


@pytest.mark.parametrize(
    ("text", "takes"),
    [
        ("0403", ["COM7"]),
        ("1546:01A9", ["COM9"]),
        ("0403:6015:D30A1", ["COM7"]),
        ("0403:6015:other", []),
        ("0403:6001", []),
    ],
)
def test_ports_by_usb_id(ports: list[SimpleNamespace], text: str, takes: list[str]) -> None:
    wanted = UsbFilter.parse(text)
    assert [p.device for p in serial_ports() if wanted.takes(p)] == takes
    if takes:
        assert device_of(text) == takes[0]
    else:
        with pytest.raises(NoBoardError, match="no serial port has this USB id"):
            device_of(text)


def test_a_usb_id_must_be_one(ports: list[SimpleNamespace], opened: Callable[[], list[str]]) -> None:
    for wrong in ("", "403", "0403-6015", "xyz0", "0403:"):
        with pytest.raises(ConfigError, match="expected VID, VID:PID or VID:PID:SERIAL"):
            UsbFilter.parse(wrong)
    with pytest.raises(NoBoardError, match="COM7: cannot be opened"):
        open_transport("usb:0403")
    ports.append(listed("COM8", 0x0403, 0x6015, "D30A2"))
    with pytest.raises(NoBoardError, match=r"2 ports have it: COM7 \(serial number D30A1\), COM8"):
        open_transport("usb:0403:6015")
    assert opened() == ["COM7"]


def test_only_likely_ports_are_opened(ports: list[SimpleNamespace], opened: Callable[[], list[str]]) -> None:
    found = survey.survey(1_000_000)
    assert opened() == ["COM7"]
    assert [(f.port.device, f.asked) for f in found] == [("COM3", False), ("COM7", True), ("COM9", False)]
    survey.survey(1_000_000, usb=UsbFilter.parse("1546"))
    assert opened() == ["COM9"]
    survey.survey(1_000_000, every=True)
    assert opened() == ["COM3", "COM7", "COM9"]
    with pytest.raises(NoBoardError, match=r"\(COM7\); not asked: COM3, COM9"):
        survey.find(1_000_000)


def test_board_ports(evlcp, ports: list[SimpleNamespace], opened: Callable[[], list[str]]) -> None:
    rows = json.loads(evlcp("board", "ports", "--json").out)
    assert [(r["port"], r["usb"], r["asked"]) for r in rows] == [
        ("COM3", None, False),
        ("COM7", "0403:6015", True),
        ("COM9", "1546:01a9", False),
    ]
    assert opened() == ["COM7"]
    said = evlcp("board", "ports", "--no-ask", "--usb", "0403").out
    assert said == "COM7  0403:6015 D30A1  COM7 n/a  not asked\n"
    assert opened() == []
    assert "no serial port with USB id ffff" in evlcp("board", "ports", "--usb", "ffff").out
    check_fault(evlcp("board", "ports", "--usb", "no"), 2, "expected VID, VID:PID or VID:PID:SERIAL")


def test_a_real_tty_gets_no_byte(monkeypatch: pytest.MonkeyPatch, evlcp, pty_name: tuple[int, str]) -> None:
    """What hangs on a port of no bridge hears nothing of the search."""
    ours, port = pty_name
    os.set_blocking(ours, False)
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [listed(port)])
    assert evlcp("board", "hello").code == 4
    with pytest.raises(BlockingIOError):
        os.read(ours, 100)
    evlcp("board", "ports", "--all")
    assert os.read(ours, 100)


def test_who_has_the_port_is_said(pty_name: tuple[int, str]) -> None:
    device = pty_name[1]
    code = (
        "import serial, sys, time; p = serial.Serial(sys.argv[1], exclusive=True); print(1, flush=True);"
        " time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code, device], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            says = rf"\(process {process.pid}\) has it open; end that first"
            with pytest.raises(NoBoardError, match=says):
                SerialTransport(device, 1_000_000)
            assert any(str(process.pid) in who for who in holders(device))
        finally:
            process.kill()
    assert holders("/dev/nowhere") == []


def refusing(monkeypatch: pytest.MonkeyPatch, fault: Exception) -> None:
    monkeypatch.setattr("serial.serial_for_url", Mock(side_effect=fault))


WINDOWS = "could not open port 'COM3': "
MAC = "/dev/cu.usbserial-1"


@pytest.mark.parametrize(
    ("system", "port", "fault", "says"),
    [
        # as pyserial words them on each system
        ("win32", "COM3", Fault(WINDOWS + "FileNotFoundError(2, 'x', None, 2)"), "not there"),
        ("win32", "COM3", Fault(WINDOWS + "PermissionError(13, 'x', None, 5)"), "another program has it"),
        ("win32", "COM3", Fault(WINDOWS + "OSError(22, 'x', None, 121)"), "evlcp board ports"),
        ("win32", "COM3", ValueError("Support for non-exclusive access not available"), "evlcp board ports"),
        ("darwin", MAC, Fault(errno.EBUSY, "busy"), f"lsof {MAC}"),
        ("darwin", MAC, Fault(errno.ENOENT, "gone"), "it is not there"),
        ("darwin", MAC, ValueError("Failed to set custom baud rate (3)"), "take --baud 3"),
        ("linux", "/dev/ttyUSB0", termios.error(5, "Input/output error"), "Input/output error"),
        ("linux", "/dev/ttyUSB0", Fault(errno.ENXIO, "x"), "it is not there"),
        ("linux", "/dev/ttyUSB0", Fault(errno.EAGAIN, "x"), "sudo fuser -v /dev/ttyUSB0"),
        ("linux", "hwgrep://[", KeyError("x"), "evlcp board ports"),
    ],
)
def test_any_system_says_what_to_do(
    evlcp, monkeypatch: pytest.MonkeyPatch, system: str, port: str, fault: Exception, says: str
) -> None:
    refusing(monkeypatch, fault)
    monkeypatch.setattr(serial_port.sys, "platform", system)
    done = evlcp("board", "hello", "--port", port, "--baud", "3000000")
    check_fault(done, 4, f"{port}: cannot be opened", says)


def test_no_permission_names_group_and_rule(evlcp, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    grp = pytest.importorskip("grp")
    device = tmp_path / "ttyUSB7"
    device.write_text("")
    device.chmod(0o660)
    port = listed(str(device), 0x0403, 0x6015)
    group = SimpleNamespace(gr_name="dialout", gr_gid=20, gr_mem=["bob"])
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [port])
    monkeypatch.setattr(grp, "getgrgid", lambda _: group)
    monkeypatch.setattr("getpass.getuser", lambda: "ann")
    refusing(monkeypatch, Fault(errno.EACCES, "could not open port"))
    check_fault(
        evlcp("board", "hello", "--port", device),
        4,
        "it belongs to the group dialout: 'sudo usermod -aG dialout ann' and log in again",
        'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6015", TAG+="uaccess"',
        "/etc/udev/rules.d/70-evlcp.rules",
    )
    monkeypatch.setattr("getpass.getuser", lambda: "bob")
    assert "log in again" in evlcp("board", "hello", "--port", device).err


@pytest.mark.parametrize(
    "fault",
    [
        Fault("device reports readiness to read but returned no data"),
        Fault("ClearCommError failed (PermissionError(13, 'x', None, 22))"),
        termios.error(5, "Input/output error"),
        TypeError("'NoneType' object cannot be interpreted as an integer"),
        AttributeError("'NoneType' object has no attribute 'hEvent'"),
        OSError(errno.EIO, "x"),
    ],
    ids=lambda fault: type(fault).__name__,
)
def test_an_unplugged_port_is_a_broken_line(monkeypatch: pytest.MonkeyPatch, fault: Exception) -> None:
    unplugged = Mock()
    type(unplugged).in_waiting = PropertyMock(side_effect=fault)
    unplugged.write.side_effect = unplugged.close.side_effect = fault
    monkeypatch.setattr("serial.serial_for_url", lambda *_, **__: unplugged)
    line = SerialTransport("COM3", 1_000_000)
    for do in (lambda: line.read(0.0), lambda: line.write(b"x")):
        with pytest.raises(LineError, match=r"COM3: the line broke: .*plug it in"):
            do()
    line.close()


def test_no_port_and_no_unix_sockets(monkeypatch: pytest.MonkeyPatch, evlcp) -> None:
    monkeypatch.setattr("serial.tools.list_ports.comports", list)
    check_fault(evlcp("board", "status"), 4, "--port native: for an emulated one")
    monkeypatch.delattr(socket, "AF_UNIX")
    check_fault(evlcp("board", "hello", "--port", "unix:/tmp/board"), 4, "this system has no unix sockets")
