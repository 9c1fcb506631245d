"""Boards that run as programs of their own: models of the part, which stand with the tests."""

import contextlib
import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from evlcp_sdk.errors import InputError
from firmware_host import build
from firmware_host.errors import NoBoardError, ToolchainError
from firmware_host.images import FLASH_BYTES, check_flash_file
from firmware_host.ports.transport import SocketTransport

_DIES_WITH_PARENT = (
    "import ctypes, os, signal, sys;"
    " ctypes.CDLL(None).prctl(1, signal.SIGTERM);"  # PR_SET_PDEATHSIG, which holds over exec
    " os.getppid() == int(sys.argv[1]) and os.execvp(sys.argv[2], sys.argv[2:])"
)


def bound(command: Sequence[str]) -> list[str]:
    """A command line that ends with the process that starts it, however that ends.

    The command takes the place of the process that is started, so its number stays.
    """
    return [sys.executable, "-IS", "-c", _DIES_WITH_PARENT, str(os.getpid()), *command]


def _model(*options: str) -> list[str]:
    """Command line of the model; it ends with the process that starts it.

    Raises:
        ToolchainError: This is no checkout.
    """
    root = Path(__file__).parents[2]
    if not (root / "tests" / "models").is_dir():
        raise ToolchainError("this emulator comes with a checkout of the sources, not with a package")
    code = (
        f"import runpy, sys; sys.path.insert(0, {str(root)!r});"
        " runpy.run_module('tests.models.server', run_name='__main__', alter_sys=True)"
    )
    return bound([sys.executable, "-c", code, *options])


def stm32_command(listen: str, leds: Path | None = None) -> list[str]:
    """Command line of the model of an STM32F405 with the image as it is flashed.

    Raises:
        ToolchainError: Unicorn or the model is missing, or the image cannot be built.
    """
    if importlib.util.find_spec("unicorn") is None:
        raise ToolchainError("unicorn, the model's core, is missing: pip install unicorn")
    record = () if leds is None else ("--leds", str(leds))
    return _model("--image", str(build.arm_image("stm32f405")), "--listen", listen, *record)


def rom_command(listen: str, flash: Path | None = None, leds: Path | None = None) -> list[str]:
    """Command line of an STM32F405 that waits in its ROM, and runs on its model what it is told to.

    The file of its flash, 1 MiB, is new or there.

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
    files = [(name, str(path)) for name, path in (("--flash", flash), ("--leds", leds)) if path is not None]
    return _model("--listen", listen, *(part for option in files for part in option))


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
