"""The native board: the firmware compiled for this machine, in real time."""

import os
import stat
import time
from collections.abc import Callable
from pathlib import Path

from evlcp_sdk.errors import InputError
from evlcp_sdk.files import Outputs, read_bytes, writing
from firmware_host.emulators.listening import HostLine
from firmware_host.emulators.simulated import SimulatedBoard
from firmware_host.images import check_flash_file
from firmware_host.ports.transport import Transport

_PIECE = 2048
"""Bytes that the board receives at once: half of its buffer."""

_STEP_S = 0.005


class NativeBoard(Transport):
    """A line to a board in this process, in virtual time that catches up with the clock when it is used.

    Args:
        leds: File for the LED records.
        flash: File for what SAVE writes, existing or new.
        unique_id: The board's number, 64 bits.

    Raises:
        InputError: The flash file cannot be used.
        OutputError: A file cannot be written; so does `read`.
        ToolchainError: The board cannot be built.
    """

    name = "native:"

    def __init__(self, leds: Path | None = None, flash: Path | None = None, unique_id: int = 0) -> None:
        self._device = SimulatedBoard(bytes(4) + unique_id.to_bytes(8, "big"))
        self._saved_flash = self._device.read_flash()
        self._flash = None if flash is None else flash.resolve()
        if flash is not None:
            check_flash_file(flash)
            if flash.is_file():
                held = read_bytes(flash)
                if len(held) != len(self._saved_flash):
                    raise InputError(f"{flash}: not a flash file of {len(self._saved_flash)} bytes")
                self._device.replace_flash(held)
            self._save_flash(flash.resolve(), self._device.read_flash())  # raises now if SAVE could not
        with writing(leds or ""):
            self._leds = None if leds is None else leds.open("wb")
        self._start_s = self.time_s()

    def _catch_up(self) -> None:
        self._device.run(int((self.time_s() - self._start_s) * 1e6) - self._device.now_us)

    def write(self, data: bytes) -> None:
        """See `Transport.write`."""
        self._catch_up()
        for at in range(0, len(data), _PIECE):
            self._device.receive(data[at : at + _PIECE])
            self._device.run(0)

    def read(self, timeout_s: float) -> bytes:
        """See `Transport.read`."""
        end = self.time_s() + timeout_s
        while True:
            self._catch_up()
            self._write_files()
            data, left = self._device.take_output(), end - self.time_s()
            if data or left <= 0:
                return data
            time.sleep(min(left, 0.001))

    def _write_files(self) -> None:
        # The slots are in the file before the answer to a SAVE is sent.
        if self._flash is not None and (held := self._device.read_flash()) != self._saved_flash:
            self._save_flash(self._flash, held)
        records = self._device.take_raw_records()
        if self._leds is not None:
            with writing(self._leds.name):
                self._leds.write(records.tobytes())
                self._leds.flush()

    def close(self) -> None:
        """Switch it off, and close its files."""
        if self._leds is not None:
            with writing(self._leds.name):
                self._leds.close()

    def _save_flash(self, flash: Path, held: bytes) -> None:
        """Replace the flash file when the new one is complete; a symbolic link stays.

        It may hold a key: it keeps the permissions of the old one, and a new one is for its owner alone.
        """
        with Outputs() as outputs, writing(flash):
            mode = stat.S_IMODE(flash.stat().st_mode) if flash.exists() else 0o600
            file = outputs.open_binary(flash)
            os.fchmod(file.fileno(), mode)
            file.write(held)
        self._saved_flash = held


def serve_board(board: NativeBoard, line: HostLine, stopped: Callable[[], bool]) -> None:
    """Let hosts talk to a board, one at a time, until it is stopped."""
    while not stopped():
        board.write(line.exchange(board.read(0.0), _STEP_S))
