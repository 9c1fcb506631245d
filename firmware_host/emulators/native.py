"""The native board: the firmware compiled for this machine, whose chips fall due by the clock."""

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
"""Bytes that the board receives at once: half of what it has room for."""

_STEP_S = 0.005


class NativeBoard:
    """A board of its own time, which follows the clock whenever something is exchanged with it.

    Args:
        leds: File for the LED records.
        flash: File that keeps what SAVE writes, new or there.
        unique_id: The board's number, 64 bits.

    Raises:
        InputError: The flash file cannot be used.
        OutputError: A file cannot be written; so does `exchange`.
        ToolchainError: The board cannot be built.
    """

    def __init__(self, leds: Path | None = None, flash: Path | None = None, unique_id: int = 0) -> None:
        self._device = SimulatedBoard(bytes(4) + unique_id.to_bytes(8, "big"))
        self._held = self._device.flash()
        self._flash = None if flash is None else flash.resolve()
        if flash is not None:
            check_flash_file(flash)
            if flash.is_file():
                held = read_bytes(flash)
                if len(held) != len(self._held):
                    raise InputError(f"{flash}: not a flash file of {len(self._held)} bytes")
                self._device.set_flash(held)
            self._store(self._device.flash())  # a place that takes no SAVE is known now
        with writing(leds or ""):
            self._leds = None if leds is None else leds.open("wb")
        self._begun_s = time.monotonic()

    def exchange(self, data: bytes) -> bytes:
        """Let time pass until now, give the board what a host has sent, and take what it sends."""
        self._device.run(int((time.monotonic() - self._begun_s) * 1e6) - self._device.now_us)
        for at in range(0, len(data), _PIECE):
            self._device.receive(data[at : at + _PIECE])
            self._device.run(0)
        # Before the answer to a SAVE goes out, the slots are in the file.
        if self._flash is not None and (held := self._device.flash()) != self._held:
            self._store(held)
        records = self._device.take_records()
        if self._leds is not None:
            with writing(self._leds.name):
                self._leds.write(records.tobytes())
                self._leds.flush()
        return self._device.sent()

    def close(self) -> None:
        """Switch it off: its files are whole."""
        if self._leds is not None:
            self._leds.close()

    def _store(self, held: bytes) -> None:
        """A new file takes the place of the old one when it is whole; a link stays one.

        It may hold a key: it is as private as the old one was, and at first for its owner alone.
        """
        if self._flash is not None:
            with Outputs() as outputs, writing(self._flash):
                mode = stat.S_IMODE(self._flash.stat().st_mode) if self._flash.exists() else 0o600
                file = outputs.open_binary(self._flash)
                os.fchmod(file.fileno(), mode)
                file.write(held)
                outputs.commit()
        self._held = held


class NativeLine(Transport):
    """A native board in this process; it ends with the line."""

    name = "native:"

    def __init__(self, board: NativeBoard) -> None:
        self._board = board
        self._came = b""

    def read(self, timeout_s: float) -> bytes:
        """See `Transport.read`."""
        end = self.now() + timeout_s
        while True:
            data, self._came = self._came + self._board.exchange(b""), b""
            left = end - self.now()
            if data or left <= 0:
                return data
            time.sleep(min(left, 0.001))

    def write(self, data: bytes) -> None:
        """See `Transport.write`."""
        self._came += self._board.exchange(data)

    def close(self) -> None:
        """The board ends."""
        self._board.close()


def serve(board: NativeBoard, line: HostLine, stopped: Callable[[], bool]) -> None:
    """Let hosts talk to a board, one at a time, until it is stopped."""
    data = b""
    while not stopped():
        data = line.exchange(board.exchange(data), _STEP_S)
