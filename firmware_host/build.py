"""Builds the firmware on demand into the user's cache, under a hash of the sources."""

import fcntl
import hashlib
import os
import shutil
import subprocess
from pathlib import Path

from firmware_host.errors import ToolchainError

FIRMWARE = Path(__file__).parent / "firmware"
"""The firmware's source tree."""


def build_folder() -> Path:
    """The folder for builds: `evlcp/firmware-HASH` in the user's cache."""
    digest = hashlib.sha256()
    for path in sorted(FIRMWARE.rglob("*")):
        if path.suffix in (".c", ".h", ".ld") or path.name == "Makefile":
            digest.update(path.relative_to(FIRMWARE).as_posix().encode() + b"\0" + path.read_bytes())
    try:
        cache_folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError as fault:
        raise ToolchainError(f"{fault} Set XDG_CACHE_HOME to a folder that can be written") from fault
    return cache_folder / "evlcp" / f"firmware-{digest.hexdigest()[:16]}"


def run_make(*targets: str) -> Path:
    """Run make in the firmware tree; return the build folder.

    Raises:
        ToolchainError: A tool is missing, or a step fails.
    """
    _require_tool("make", "make gcc")
    folder = build_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "lock").touch()
    except OSError as fault:
        raise ToolchainError(
            f"{folder}: the firmware cannot be built there ({fault.strerror}); set XDG_CACHE_HOME to a folder"
            " that can be written"
        ) from fault
    with (folder / "lock").open("w") as lock:
        # Two programs may build the same image at once.
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = subprocess.run(
            ["make", "-s", "-C", str(FIRMWARE), f"BUILD={folder}", *targets],
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        last = (done.stderr or done.stdout).strip().splitlines()
        raise ToolchainError(
            f"building the firmware ({' '.join(targets)}) failed: {last[0] if last else '?'}"
        )
    return folder


def _require_tool(name: str, package: str) -> None:
    if shutil.which(name) is None:
        raise ToolchainError(f"{name} is missing: apt-get install --no-install-recommends {package}")


def native_library() -> Path:
    """Build the board as a shared library for this machine; return its path.

    Raises:
        ToolchainError: No C compiler, or it fails.
    """
    _require_tool(os.environ.get("CC", "cc"), "gcc libc6-dev make")
    return run_make("library") / "libevlcp-board.so"


def arm_image(board: str) -> Path:
    """Build the ARM image of `stm32f405-8mhz` (also `stm32f405`) or `stm32f405-12mhz`; return its path.

    With `-1` or `-2` it is for one of the two places of updates.

    Raises:
        ToolchainError: The cross compiler is missing, or fails.
    """
    _require_tool("arm-none-eabi-gcc", "gcc-arm-none-eabi")
    return run_make("images" if board[-2:] in ("-1", "-2") else "stm32") / f"{board.replace('-8mhz', '')}.elf"
