"""Boards that run as programs of their own: the ARM image in QEMU, and models of the part."""

import contextlib
import importlib.util
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from evlcp_sdk.errors import InputError
from firmware_host import build
from firmware_host.errors import LineError, NoBoardError, ToolchainError
from firmware_host.images import FLASH_BYTES, check_flash_file
from firmware_host.ports.transport import SocketTransport

_DIES_WITH_PARENT = (
    "import ctypes, os, signal, sys;"
    " ctypes.CDLL(None).prctl(1, signal.SIGTERM);"  # PR_SET_PDEATHSIG, which holds over exec
    " os.getppid() == int(sys.argv[1]) and os.execvp(sys.argv[2], sys.argv[2:])"
)


def bound(command: Sequence[str]) -> list[str]:
    """A command line that ends with the process that starts it, however that ends; on Linux.

    The command takes the place of the process that is started, so its number stays.
    """
    if sys.platform != "linux":
        return list(command)
    return [sys.executable, "-IS", "-c", _DIES_WITH_PARENT, str(os.getpid()), *command]


class ProcessTransport(SocketTransport):
    """The socket of an emulator that ends with the line."""

    def __init__(
        self,
        name: str,
        connected: socket.socket,
        process: "subprocess.Popen[bytes]",
        folder: Path | None = None,
    ) -> None:
        super().__init__(name, connected)
        self.process = process
        self._folder = folder

    def close(self) -> None:
        """Close the socket and end the emulator."""
        super().close()
        _end(self.process)
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stderr is not None:
        process.stderr.close()


def qemu_command(listen: str, leds: Path | None = None, wait: bool = False) -> list[str]:
    """Command line of QEMU with the board's ARM image; it ends with the process that starts it.

    Args:
        listen: `unix:PATH` or `tcp:HOST:PORT`; QEMU drops bytes on a pseudo-terminal.
        leds: File for the LED records.
        wait: Start the board only when a host has connected.

    Raises:
        ToolchainError: QEMU is missing, or the image cannot be built.
    """
    if shutil.which("qemu-system-arm") is None:
        raise ToolchainError(
            "qemu-system-arm is missing: apt-get install --no-install-recommends qemu-system-arm"
        )
    # A comma in a name stands doubled in QEMU's options.
    serial = f"{listen.replace(',', ',,')},server=on,wait={'on' if wait else 'off'}"
    record = "null" if leds is None else f"file:{str(leds).replace(',', ',,')}"
    return bound(
        [
            *("qemu-system-arm", "-M", "mps2-an385", "-kernel", str(build.arm_image("mps2-an385"))),
            *("-icount", "shift=3,sleep=off", "-display", "none", "-monitor", "none", "-nodefaults"),
            *("-serial", serial, "-serial", record),
        ]
    )


def _model(name: str) -> list[str]:
    """Command line of a model of the part, which stands with the tests.

    Raises:
        ToolchainError: This is no checkout.
    """
    root = build.tests_folder().parent
    code = (
        f"import runpy, sys; sys.path.insert(0, {str(root)!r});"
        f" runpy.run_module('tests.models.{name}', run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-c", code]


def stm32_command(listen: str, leds: Path | None = None) -> list[str]:
    """Command line of the model of an STM32F405 with the image as it is flashed.

    Args:
        listen: `unix:PATH` or `tcp:HOST:PORT`.
        leds: File for the LED records.

    Raises:
        ToolchainError: Unicorn or the model is missing, or the image cannot be built.
    """
    if importlib.util.find_spec("unicorn") is None:
        raise ToolchainError("unicorn, the model's core, is missing: pip install unicorn")
    image = build.arm_image("stm32f405")
    command = [*_model("stm32_server"), str(image), "--listen", listen]
    return command if leds is None else [*command, "--leds", str(leds)]


def rom_command(listen: str, flash: Path | None = None, leds: Path | None = None) -> list[str]:
    """Command line of an STM32F405 that waits in its ROM, and runs on its model what it is told to.

    Args:
        listen: `unix:PATH` or `tcp:HOST:PORT`.
        flash: File that keeps its flash, 1 MiB; new or there.
        leds: File for the LED records of what runs.

    Raises:
        InputError: The flash file cannot be used.
        ToolchainError: The model is missing.
    """
    if flash is not None:
        check_flash_file(flash)
        if flash.is_file() and flash.stat().st_size != FLASH_BYTES:
            raise InputError(
                f"{flash}: {flash.stat().st_size} bytes, expected {FLASH_BYTES}, the flash of the part"
            )
    command = [*_model("rom_server"), "--listen", listen]
    for name, value in (("--flash", flash), ("--leds", leds)):
        if value is not None:
            command += [name, str(value)]
    return command


def wait_for(
    listen: str, process: "subprocess.Popen[bytes]", timeout_s: float = 10.0
) -> SocketTransport | None:
    """Connect to an emulator that is coming up; None if it ends or takes longer than `timeout_s`."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end and process.poll() is None:
        with contextlib.suppress(NoBoardError):
            return SocketTransport.connect(listen)
        time.sleep(0.02)
    return None


def start_qemu(leds: Path | None = None) -> ProcessTransport:
    """Start the board in QEMU and connect to it.

    Raises:
        ToolchainError: QEMU or the cross compiler is missing.
        LineError: QEMU does not come up.
    """
    folder = Path(tempfile.mkdtemp(prefix="evlcp-qemu-"))
    listen = f"unix:{folder / 'uart0'}"
    process = subprocess.Popen(qemu_command(listen, leds), stdin=subprocess.DEVNULL, stderr=subprocess.PIPE)
    connected = wait_for(listen, process)
    if connected is not None:
        return ProcessTransport("qemu:", connected.detach(), process, folder)
    process.kill()
    said = process.stderr.read().decode(errors="replace").strip() if process.stderr else ""
    _end(process)
    shutil.rmtree(folder, ignore_errors=True)
    raise LineError(f"qemu: does not come up: {said or 'no socket'}; try 'evlcp board emulate qemu'")
