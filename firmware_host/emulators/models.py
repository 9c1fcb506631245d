"""Emulated parts, whose models are among the tests of a checkout."""

import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path

from evlcp_sdk.errors import InputError
from firmware_host import build
from firmware_host.emulators.listening import HostLine
from firmware_host.errors import ToolchainError
from firmware_host.images import FLASH_BYTES, check_flash_file

_ROOT = Path(__file__).parents[2]


def part_image(rom: bool, flash: Path | None) -> Path | None:
    """The image that a part runs; None for one that waits in its ROM.

    Raises:
        InputError: The file of its flash, 1 MiB, existing or new, cannot be used.
        ToolchainError: The model or its core is missing, or the image cannot be built.
    """
    if not (_ROOT / "tests" / "models").is_dir():
        raise ToolchainError("this emulator comes with a checkout of the sources, not with a package")
    if not rom:
        if importlib.util.find_spec("unicorn") is None:
            raise ToolchainError("unicorn, the model's core, is missing: pip install unicorn")
        return build.arm_image("stm32f405")
    if flash is not None:
        check_flash_file(flash)
        if flash.is_file() and flash.stat().st_size != FLASH_BYTES:
            raise InputError(
                f"{flash}: {flash.stat().st_size} bytes, expected {FLASH_BYTES}, the flash of the part"
            )
    return None


def serve_part(
    line: HostLine, image: Path | None, flash: Path | None, leds: Path | None, stopped: Callable[[], bool]
) -> None:
    """Let hosts talk to an STM32F405 with an image of `part_image` until it is stopped."""
    sys.path.insert(0, str(_ROOT))
    importlib.import_module("tests.models.server").serve_part(line, image, flash, leds, stopped)
