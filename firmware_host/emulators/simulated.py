"""The firmware in this process, in virtual time: under `native:`, and for tests."""

import ctypes
from functools import cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from firmware_host import build
from firmware_host.emulators.led_record import RECORD, LedRecord
from firmware_host.ports.transport import Transport
from firmware_host.protocol.generated.requests import ROW_BYTES


class _Health(ctypes.Structure):
    _fields_: ClassVar = [
        ("temperature_dc", ctypes.c_int16),
        ("faults", ctypes.c_uint8),
        ("open_leds", ctypes.c_uint8 * ROW_BYTES),
    ]


class Bench(ctypes.Structure):
    """A board's outputs and settings for tests: `struct native_bench` of `hal/native/board.c`."""

    _fields_: ClassVar = [
        ("output", ctypes.c_void_p),
        ("output_length", ctypes.c_size_t),
        ("records", ctypes.c_void_p),
        ("record_count", ctypes.c_size_t),
        ("flash", ctypes.c_void_p),
        ("flash_bytes", ctypes.c_size_t),
        ("images", ctypes.c_void_p * 2),
        ("pulse_period", ctypes.c_double),
        ("pulse_next", ctypes.c_double),
        ("late", ctypes.c_uint32),
        ("power_left", ctypes.c_uint32),
        ("power_fails", ctypes.c_bool),
        ("level_fails", ctypes.c_bool),
        ("flash_fails", ctypes.c_bool),
        ("running", ctypes.c_uint8),
        ("level_ma", ctypes.c_uint16),
        ("shown", ctypes.c_uint8 * ROW_BYTES),
        ("health", _Health),
    ]


@cache
def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(str(build.native_library()))
    library.board_new.restype = ctypes.POINTER(Bench)
    library.board_run_us.argtypes = [ctypes.POINTER(Bench), ctypes.c_uint64]
    library.board_input.argtypes = [ctypes.POINTER(Bench), ctypes.c_char_p, ctypes.c_size_t]
    return library


class SimulatedBoard:
    """One board with a unique id of 12 bytes; time passes only in `run`.

    Attributes:
        bench: Its outputs, and settings for tests.
        now_us: Time since it was made, us.

    Raises:
        ToolchainError: The firmware cannot be built.
    """

    TICK_HZ = 10_000_000

    def __init__(self, unique_id: bytes = b"simulated   ") -> None:
        self._c = _library()
        self._board = self._c.board_new(unique_id)
        self.bench: Bench = self._board.contents
        self.now_us = 0

    def __del__(self) -> None:
        if hasattr(self, "bench"):
            self._c.board_free(self._board)

    def run(self, us: int) -> None:
        """Let `us` microseconds pass."""
        self._c.board_run_us(self._board, us)
        self.now_us += us

    def reset(self) -> None:
        """Reset the board: only its flash stays."""
        self._c.board_reset(self._board)

    def receive(self, data: bytes) -> None:
        """Deliver bytes to the board."""
        self._c.board_input(self._board, data, len(data))

    def take_output(self) -> bytes:
        """Bytes that the board has sent since the last call."""
        count, self.bench.output_length = self.bench.output_length, 0
        return ctypes.string_at(self.bench.output, count)

    def take_raw_records(self) -> NDArray[np.void]:
        """LED outputs since the last call, as an array of `RECORD`."""
        count, self.bench.record_count = self.bench.record_count, 0
        return np.frombuffer(ctypes.string_at(self.bench.records or 0, count * RECORD.itemsize), RECORD)

    def take_led_record(self) -> LedRecord:
        """LED outputs since the last call."""
        return LedRecord.of_records(self.take_raw_records())

    def read_flash(self) -> bytes:
        """The flash with the slots of SAVE."""
        return ctypes.string_at(self.bench.flash, self.bench.flash_bytes)

    def replace_flash(self, content: bytes) -> None:
        """Write the flash with the slots of SAVE, and reset the board."""
        ctypes.memmove(self.bench.flash, content, self.bench.flash_bytes)
        self.reset()


class SimulatedLine(Transport):
    """A line to a simulated board, whose clock counts; at least `step_us` pass while the host waits."""

    def __init__(self, board: SimulatedBoard, name: str = "simulated:", step_us: int = 100) -> None:
        self.name = name
        self.board = board
        self.step_us = step_us

    def time_s(self) -> float:
        """Time of the board, s."""
        return self.board.now_us * 1e-6

    def read(self, timeout_s: float) -> bytes:
        """Bytes from the board; time passes until there are some, or `timeout_s` is over."""
        end = self.board.now_us + max(self.step_us, int(timeout_s * 1e6))
        while self.board.now_us < end:
            self.board.run(self.step_us)
            data = self.board.take_output()
            if data:
                return data
        return b""

    def write(self, data: bytes) -> None:
        """Bytes to the board."""
        self.board.receive(data)

    def close(self) -> None:
        """Nothing to release."""
