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
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from evlcp_sdk.errors import ConfigError
from firmware_host.board import survey
from firmware_host.errors import LineError, NoBoardError
from firmware_host.ports import serial_port
from firmware_host.ports.serial_port import SerialTransport, holders
from firmware_host.ports.transport import open_transport
from firmware_host.ports.usb import UsbFilter, device_of, serial_ports

serial = pytest.importorskip("serial")


def listed(**usb: tuple[int, int, str] | None) -> list[SimpleNamespace]:
    """Ports as pyserial lists them."""
    rows = []
    for device, given in usb.items():
        vid, pid, number = given or (None, None, None)
        rows.append(
            SimpleNamespace(
                device=device, description=f"{device} n/a", vid=vid, pid=pid, serial_number=number
            )
        )
    return rows


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch) -> list[SimpleNamespace]:
    found = listed(COM7=(0x0403, 0x6015, "D30A1"), COM3=None, COM9=(0x1546, 0x01A9, "gps"))
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: found)
    return found


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Which ports were opened; none can be."""
    names: list[str] = []

    def refuse(url: str, **_: object) -> None:
        names.append(url)
        raise serial.SerialException(errno.ENOENT, "could not open port")

    monkeypatch.setattr("serial.serial_for_url", refuse)
    return names


def test_ports_have_usb_ids(ports: list[SimpleNamespace]) -> None:
    assert [(p.device, p.usb, p.serial_number, p.likely) for p in serial_ports()] == [
        ("COM3", None, None, False),
        ("COM7", "0403:6015", "D30A1", True),
        ("COM9", "1546:01a9", "gps", False),
    ]


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


def test_a_usb_id_must_be_one(ports: list[SimpleNamespace], opened: list[str]) -> None:
    for wrong in ("", "403", "0403-6015", "xyz0", "0403:"):
        with pytest.raises(ConfigError, match="expected VID, VID:PID or VID:PID:SERIAL"):
            UsbFilter.parse(wrong)
    with pytest.raises(NoBoardError, match="COM7: cannot be opened"):
        open_transport("usb:0403")
    ports += listed(COM8=(0x0403, 0x6015, "D30A2"))
    with pytest.raises(NoBoardError, match=r"2 ports have it: COM7 \(serial number D30A1\), COM8"):
        open_transport("usb:0403:6015")
    assert opened == ["COM7"]


def test_only_likely_ports_are_opened(ports: list[SimpleNamespace], opened: list[str]) -> None:
    found = survey.survey(1_000_000)
    assert opened == ["COM7"]
    assert [(f.port.device, f.asked) for f in found] == [("COM3", False), ("COM7", True), ("COM9", False)]
    opened.clear()
    survey.survey(1_000_000, usb=UsbFilter.parse("1546"))
    assert opened == ["COM9"]
    opened.clear()
    survey.survey(1_000_000, every=True)
    assert sorted(opened) == ["COM3", "COM7", "COM9"]
    with pytest.raises(NoBoardError, match=r"\(COM7\); not asked: COM3, COM9"):
        survey.find(1_000_000)


def test_the_command_shows_and_filters(
    evlcp: Callable[..., Any], ports: list[SimpleNamespace], opened: list[str]
) -> None:
    rows = json.loads(evlcp("board", "ports", "--json").out)
    assert [(r["port"], r["usb"], r["asked"]) for r in rows] == [
        ("COM3", None, False),
        ("COM7", "0403:6015", True),
        ("COM9", "1546:01a9", False),
    ]
    opened.clear()
    said = evlcp("board", "ports", "--no-ask", "--usb", "0403").out
    assert said == "COM7  0403:6015 D30A1  COM7 n/a  not asked\n"
    assert opened == []
    assert "no serial port with USB id ffff" in evlcp("board", "ports", "--usb", "ffff").out
    assert evlcp("board", "ports", "--usb", "no").code == 2


def test_a_real_tty_gets_no_byte(monkeypatch: pytest.MonkeyPatch, evlcp: Callable[..., Any]) -> None:
    """What hangs on a port of no bridge hears nothing of the search."""
    ours, other = pty.openpty()
    tty.setraw(other)
    os.set_blocking(ours, False)
    row = SimpleNamespace(
        device=os.ttyname(other), description="modem", vid=None, pid=None, serial_number=None
    )
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [row])
    assert evlcp("board", "hello").code == 4
    with pytest.raises(BlockingIOError):
        os.read(ours, 100)
    evlcp("board", "ports", "--all")
    assert os.read(ours, 100)
    os.close(ours)
    os.close(other)


def test_who_has_the_port_is_said() -> None:
    ours, other = pty.openpty()
    tty.setraw(other)
    device = os.ttyname(other)
    code = (
        "import serial, sys, time; p = serial.Serial(sys.argv[1], exclusive=True); print(1, flush=True);"
        " time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, device], stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    try:
        with pytest.raises(NoBoardError) as told:
            SerialTransport(device, 1_000_000)
        assert f"(process {process.pid}) has it open; end that first" in str(told.value)
        assert any(str(process.pid) in who for who in holders(device))
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        os.close(ours)
        os.close(other)
    assert holders("/dev/nowhere") == []


def refusing(monkeypatch: pytest.MonkeyPatch, fault: Exception) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise fault

    monkeypatch.setattr("serial.serial_for_url", refuse)


WINDOWS = "could not open port 'COM3': "


@pytest.mark.parametrize(
    ("system", "port", "fault", "says"),
    [
        # as pyserial words them on each system
        (
            "win32",
            "COM3",
            serial.SerialException(WINDOWS + "FileNotFoundError(2, 'x', None, 2)"),
            "not there",
        ),
        (
            "win32",
            "COM3",
            serial.SerialException(WINDOWS + "PermissionError(13, 'Zugriff verweigert', None, 5)"),
            "another program has it open",
        ),
        (
            "win32",
            "COM3",
            serial.SerialException(WINDOWS + "OSError(22, 'x', None, 121)"),
            "evlcp board ports",
        ),
        ("win32", "COM3", ValueError("Support for non-exclusive access not available"), "evlcp board ports"),
        (
            "darwin",
            "/dev/cu.usbserial-1",
            serial.SerialException(errno.EBUSY, "busy"),
            "lsof /dev/cu.usbserial-1",
        ),
        ("darwin", "/dev/cu.usbserial-1", serial.SerialException(errno.ENOENT, "gone"), "it is not there"),
        ("darwin", "/dev/cu.usbserial-1", ValueError("Failed to set custom baud rate (3)"), "take --baud 3"),
        ("linux", "/dev/ttyUSB0", termios.error(5, "Input/output error"), "Input/output error"),
        ("linux", "/dev/ttyUSB0", serial.SerialException(errno.ENXIO, "x"), "it is not there"),
        ("linux", "/dev/ttyUSB0", serial.SerialException(errno.EAGAIN, "x"), "sudo fuser -v /dev/ttyUSB0"),
        ("linux", "hwgrep://[", KeyError("x"), "evlcp board ports"),
    ],
)
def test_any_system_says_what_to_do(
    evlcp: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
    system: str,
    port: str,
    fault: Exception,
    says: str,
) -> None:
    refusing(monkeypatch, fault)
    monkeypatch.setattr(serial_port.sys, "platform", system)
    done = evlcp("board", "hello", "--port", port, "--baud", "3000000")
    assert done.code == 4
    assert f"{port}: cannot be opened" in done.err
    assert says in done.err
    assert done.err.count("\n") == 1


def test_no_permission_names_group_and_rule(
    evlcp: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    grp = pytest.importorskip("grp")
    device = tmp_path / "ttyUSB7"
    device.write_text("")
    device.chmod(0o660)
    row = SimpleNamespace(device=str(device), description="", vid=0x0403, pid=0x6015, serial_number=None)
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [row])
    monkeypatch.setattr(
        grp, "getgrgid", lambda _: SimpleNamespace(gr_name="dialout", gr_gid=20, gr_mem=["bob"])
    )
    monkeypatch.setattr("getpass.getuser", lambda: "ann")
    refusing(monkeypatch, serial.SerialException(errno.EACCES, "could not open port"))
    said = evlcp("board", "hello", "--port", device).err
    assert "it belongs to the group dialout: 'sudo usermod -aG dialout ann' and log in again" in said
    assert 'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6015", TAG+="uaccess"' in said
    assert "/etc/udev/rules.d/70-evlcp.rules" in said
    assert said.count("\n") == 1
    monkeypatch.setattr("getpass.getuser", lambda: "bob")
    assert "log in again" in evlcp("board", "hello", "--port", device).err


@pytest.mark.parametrize(
    "fault",
    [
        serial.SerialException("device reports readiness to read but returned no data"),
        serial.SerialException("ClearCommError failed (PermissionError(13, 'x', None, 22))"),
        termios.error(5, "Input/output error"),
        TypeError("'NoneType' object cannot be interpreted as an integer"),
        AttributeError("'NoneType' object has no attribute 'hEvent'"),
        OSError(errno.EIO, "x"),
    ],
    ids=lambda fault: type(fault).__name__,
)
def test_an_unplugged_port_is_a_broken_line(monkeypatch: pytest.MonkeyPatch, fault: Exception) -> None:
    class Unplugged:
        @property
        def in_waiting(self) -> int:
            raise fault

        def write(self, _: bytes) -> None:
            raise fault

        def close(self) -> None:
            raise fault

    monkeypatch.setattr("serial.serial_for_url", lambda *_, **__: Unplugged())
    line = SerialTransport("COM3", 1_000_000)
    for do in (lambda: line.read(0.0), lambda: line.write(b"x")):
        with pytest.raises(LineError, match=r"COM3: the line broke: .*plug it in"):
            do()
    line.close()


def test_without_unix_sockets(monkeypatch: pytest.MonkeyPatch, evlcp: Callable[..., Any]) -> None:
    monkeypatch.delattr(socket, "AF_UNIX")
    done = evlcp("board", "hello", "--port", "unix:/tmp/board")
    assert done.code == 4
    assert "this system has no unix sockets" in done.err


def test_no_port_at_all(evlcp: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("serial.tools.list_ports.comports", list)
    done = evlcp("board", "status", "--json")
    assert done.code == 4
    assert json.loads(done.out)["error"]["kind"] == "NoBoardError"
    assert "--port native: for an emulated one" in done.err
