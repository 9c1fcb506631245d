"""The firmware in this process, in virtual time: under `native:`, and for tests."""

import ctypes
from functools import cache

import numpy as np
from numpy.typing import NDArray

from firmware_host import build
from firmware_host.emulators.led_record import RECORD, LedRecord
from firmware_host.protocol.generated.requests import LEDS, ROW_BYTES


@cache
def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(str(build.native_library()))
    handle, size = ctypes.c_void_p, ctypes.c_size_t
    for name, result, arguments in (
        ("new", handle, [ctypes.c_char_p]),
        ("free", None, [handle]),
        ("reset", None, [handle]),
        ("run_us", None, [handle, ctypes.c_uint64]),
        ("input", None, [handle, ctypes.c_char_p, size]),
        ("output", size, [handle, ctypes.c_char_p, size]),
        ("record_count", size, [handle]),
        ("take_records", None, [handle, handle]),
        ("set_health", None, [handle, ctypes.c_int16, ctypes.c_uint8, ctypes.c_uint8]),
        ("set_late", None, [handle, ctypes.c_uint32]),
        ("set_failures", None, [handle, ctypes.c_uint8, ctypes.c_uint8]),
        ("shown", None, [handle, ctypes.c_char_p]),
        ("level", ctypes.c_uint16, [handle]),
        ("running", ctypes.c_uint8, [handle]),
        ("set_pulse", None, [handle, ctypes.c_double, ctypes.c_double]),
        ("cut_power", None, [handle, ctypes.c_uint32]),
        ("image", None, [handle, ctypes.c_uint8, ctypes.c_char_p]),
        ("flash_bytes", size, []),
        ("flash", None, [handle, ctypes.c_char_p]),
        ("set_flash", None, [handle, ctypes.c_char_p]),
    ):
        function = getattr(library, f"board_{name}")
        function.restype, function.argtypes = result, arguments
    return library


class SimulatedBoard:
    """One board, of a number of 12 bytes; time moves only in `run`.

    Raises:
        ToolchainError: The firmware cannot be built.
    """

    TICK_HZ = 10_000_000

    def __init__(self, unique_id: bytes = b"simulated   ") -> None:
        self._c = _library()
        self._board = self._c.board_new(unique_id)
        self._room = ctypes.create_string_buffer(1 << 16)
        self.now_us = 0

    def __del__(self) -> None:
        if getattr(self, "_board", None):
            self._c.board_free(self._board)
            self._board = None

    def run(self, us: int) -> None:
        """Let `us` microseconds pass."""
        self._c.board_run_us(self._board, us)
        self.now_us += us

    def reset(self) -> None:
        """Reset: all but the flash is lost."""
        self._c.board_reset(self._board)

    def receive(self, data: bytes) -> None:
        """Bytes reach the board."""
        self._c.board_input(self._board, data, len(data))

    def sent(self) -> bytes:
        """Bytes the board has sent since the last call."""
        count = self._c.board_output(self._board, self._room, len(self._room))
        return ctypes.string_at(self._room, count)

    def take_records(self) -> NDArray[np.void]:
        """LED outputs since the last call, an array of `RECORD`."""
        table = np.zeros(self._c.board_record_count(self._board), RECORD)
        self._c.board_take_records(self._board, table.ctypes.data)
        return table

    def records(self) -> LedRecord:
        """LED outputs since the last call."""
        return LedRecord.of_records(self.take_records())

    def flash(self) -> bytes:
        """The slots of SAVE."""
        room = ctypes.create_string_buffer(self._c.board_flash_bytes())
        self._c.board_flash(self._board, room)
        return room.raw

    def set_flash(self, content: bytes) -> None:
        """Be a board that has these slots, and has just been reset."""
        self._c.board_set_flash(self._board, content)

    def shown(self) -> NDArray[np.uint8]:
        """The LEDs now, uint8 (96,)."""
        row = ctypes.create_string_buffer(ROW_BYTES)
        self._c.board_shown(self._board, row)
        return np.unpackbits(np.frombuffer(row.raw, np.uint8))[:LEDS]

    def level_ma(self) -> int:
        """The LED current that the hardware is set to, mA."""
        return int(self._c.board_level(self._board))

    def running(self) -> int:
        """The image of the firmware that runs: 0 the first, 1 or 2 one that came by an update."""
        return int(self._c.board_running(self._board))

    def image(self, image: int, count: int) -> bytes:
        """The first bytes in the place of image 1 or 2."""
        room = ctypes.create_string_buffer(1 << 16)
        self._c.board_image(self._board, image, room)
        return room.raw[:count]

    def cut_power(self, left: int) -> None:
        """Let the flash do so many words and erases more, the last one by half; 0: all of them."""
        self._c.board_cut_power(self._board, left)

    def set_pulse(self, period_ticks: float, first_tick: float) -> None:
        """Pulses on the pulse input, in ticks of the board's own crystal; a period of 0: none."""
        self._c.board_set_pulse(self._board, period_ticks, first_tick)

    def set_health(self, temperature_c: float = 25.0, faults: int = 0, open_led: int = 255) -> None:
        """What the sensors report from now on; an `open_led` of 255 is none."""
        self._c.board_set_health(self._board, round(10 * temperature_c), faults, open_led)

    def set_late(self, ticks: int) -> None:
        """Delay that every chip reports from now on, ticks."""
        self._c.board_set_late(self._board, ticks)

    def set_failures(self, level: bool = False, flash: bool = False) -> None:
        """Hardware that does not follow."""
        self._c.board_set_failures(self._board, level, flash)


class SimulatedLine:
    """A line to a simulated board, as a `Transport`; its clock is the board's.

    Args:
        board: The board.
        name: What to call it in messages.
        step_us: Time that passes at least when the host waits.
    """

    def __init__(self, board: SimulatedBoard, name: str = "simulated:", step_us: int = 100) -> None:
        self.name = name
        self.board = board
        self.step_us = step_us

    def now(self) -> float:
        """Time of the board, s."""
        return self.board.now_us * 1e-6

    def to_board(self, data: bytes) -> bytes:
        """What of `data` arrives at the board; here everything."""
        return data

    def to_host(self, data: bytes) -> bytes:
        """What of `data` arrives at the host; here everything."""
        return data

    def read(self, timeout_s: float) -> bytes:
        """Bytes from the board; time passes until some come, or `timeout_s` is over."""
        end = self.board.now_us + max(self.step_us, int(timeout_s * 1e6))
        while self.board.now_us < end:
            self.board.run(self.step_us)
            data = self.board.sent()
            if data:
                return self.to_host(data)
        return b""

    def write(self, data: bytes) -> None:
        """Bytes to the board."""
        self.board.receive(self.to_board(data))

    def close(self) -> None:
        """Nothing to let go."""
