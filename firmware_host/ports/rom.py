"""The boot loader in an STM32's ROM, over its USART: application note AN3155.

The part runs it when BOOT0 is high at reset. Bytes have even parity, the rate is taken from the first byte.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from functools import reduce
from itertools import accumulate
from operator import xor

from firmware_host.errors import LineError, NoBoardError, RefusedError, VerifyError
from firmware_host.images import FLASH_START, FlashImage
from firmware_host.ports.transport import Transport

BAUD = 115_200
"""Fastest rate that the ROM is sure to take, bit/s."""
PRODUCT = 0x413
"""Product number of an STM32F405."""
SECTORS = (*[16 << 10] * 4, 64 << 10, *[128 << 10] * 7)
"""Sizes of the flash's sectors, bytes."""

_ACK, _NACK, _SYNC = 0x79, 0x1F, 0x7F
_GET_ID, _READ, _GO, _WRITE, _ERASE = 0x02, 0x11, 0x21, 0x31, 0x44
_TRIES = 3
_ANSWER_S = 1.0  # an erase takes up to 2 s a sector more
_PIECE = 256
_OPTIONS = 0x1FFF_C000
_BROWN_OUT = 0x0C

Progress = Callable[[int, int], None]


class RomLoader:
    """A part that waits in its ROM, on a line with even parity.

    Raises:
        NoBoardError: Nobody answers.
    """

    def __init__(self, transport: Transport) -> None:
        self.line = transport
        self._received = bytearray()
        for _ in range(_TRIES):
            self.line.write(bytes([_SYNC]))
            if self._read_byte(_ANSWER_S) in (_ACK, _NACK):  # NACK: it was in step already
                break
            if self._resynchronize():  # it waited for the rest of another run's command
                break
        else:
            raise NoBoardError(
                f"{self.line.name}: no boot loader answers; set BOOT0 high, press reset, and run it again;"
                " PA9 and PA10 must lead to this port"
            )
        self._drain()

    # -- bytes

    def _read_byte(self, timeout_s: float) -> int | None:
        end = self.line.time_s() + timeout_s
        while not self._received:
            left = end - self.line.time_s()
            if left <= 0:
                return None
            self._received += self.line.read(left)
        return self._received.pop(0)

    def _read_bytes(self, count: int) -> bytes:
        found = bytearray()
        while len(found) < count:
            byte = self._read_byte(_ANSWER_S)
            if byte is None:
                raise _FailedError(silent=True)
            found.append(byte)
        return bytes(found)

    def _drain(self) -> None:
        self._received.clear()
        end = self.line.time_s() + _ANSWER_S  # another device may never be silent
        while self.line.read(0.02) and self.line.time_s() < end:
            pass

    def _expect_acknowledgement(self, timeout_s: float = _ANSWER_S) -> None:
        byte = self._read_byte(timeout_s)
        if byte != _ACK:
            raise _FailedError(silent=byte is None)

    def _resynchronize(self) -> bool:
        """Complete a command that lost a byte with 0xff until the loader refuses it; whether it did."""
        self._drain()
        for _ in range(_PIECE + 8):
            self.line.write(b"\xff")
            if (answer := self._read_byte(0.005)) is not None:
                break
        self._drain()
        return answer in (_ACK, _NACK)

    def _run_command(
        self, code: int, what: str, *parts: bytes, count: int = 0, timeout_s: float = _ANSWER_S
    ) -> bytes:
        """Send a command and its parts, each after an acknowledgement; return `count` bytes of the answer."""
        silent = False
        for _ in range(_TRIES):
            try:
                self.line.write(bytes([code, code ^ 0xFF]))
                self._expect_acknowledgement()
                for part in parts:
                    self.line.write(part)
                    self._expect_acknowledgement(timeout_s)
                return self._read_bytes(count)
            except _FailedError as failed:
                silent = failed.silent
            self._resynchronize()
        if silent:
            raise LineError(f"{self.line.name}: no answer to {what} after {_TRIES} tries; check the line")
        raise RefusedError(
            f"{self.line.name}: the boot loader refuses {what}; a part whose read-out is protected takes no"
            " image by this way",
            _NACK,
        )

    # -- commands

    def read_product(self) -> int:
        """Product number of the part."""
        # the number of its bytes less one, these, and an acknowledgement
        return int.from_bytes(self._run_command(_GET_ID, "GET ID", count=4)[1:3], "big")

    def read(self, address: int, count: int) -> bytes:
        """Read up to 256 bytes."""
        wanted = bytes([count - 1, (count - 1) ^ 0xFF])
        return self._run_command(
            _READ, f"READ at {address:#x}", _encode_address(address), wanted, count=count
        )

    def write(self, address: int, data: bytes) -> None:
        """Write up to 256 bytes, a multiple of four, into erased flash."""
        body = _append_checksum(bytes([len(data) - 1]) + data)
        self._run_command(_WRITE, f"WRITE at {address:#x}", _encode_address(address), body)

    def verify(self, address: int, data: bytes) -> None:
        """Read up to 256 bytes back and compare them.

        Raises:
            VerifyError: The flash holds something else.
        """
        for _ in range(_TRIES):  # what is read has no check sum
            found = self.read(address, len(data))
            if found == data:
                return
        wrong = next(i for i, (a, b) in enumerate(zip(found, data, strict=True)) if a != b)
        raise VerifyError(
            f"{self.line.name}: the flash holds {found[wrong]:#04x} at {address + wrong:#x},"
            f" expected {data[wrong]:#04x}; flash it again, then replace the part"
        )

    def erase(self, sectors: Sequence[int]) -> None:
        """Erase sectors."""
        body = _append_checksum(
            b"".join(number.to_bytes(2, "big") for number in (len(sectors) - 1, *sectors))
        )
        what = f"ERASE of sectors {', '.join(map(str, sectors))}"
        self._run_command(_ERASE, what, body, timeout_s=_ANSWER_S + 2.0 * len(sectors))

    def run_program(self, address: int) -> None:
        """Run the program at an address."""
        self._run_command(_GO, f"GO to {address:#x}", _encode_address(address))

    def has_brown_out(self) -> bool | None:
        """Whether the option bytes set a brown-out reset at 2.1 V or more; None if they cannot be read."""
        try:
            # level 3 is off but for 1.7 V, 0 resets below 2.7 V
            return self.read(_OPTIONS, 4)[0] & _BROWN_OUT != _BROWN_OUT
        except RefusedError:
            return None

    def set_brown_out(self) -> None:
        """Set the brown-out reset to 2.7 V; the part resets at once."""
        options = bytearray(self.read(_OPTIONS, 16))
        options[0] &= ~_BROWN_OUT & 0xFF
        self.write(_OPTIONS, bytes(options))


class _FailedError(Exception):
    def __init__(self, silent: bool) -> None:
        self.silent = silent


def _append_checksum(data: bytes) -> bytes:
    return data + bytes([reduce(xor, data)])


def _encode_address(address: int) -> bytes:
    return _append_checksum(address.to_bytes(4, "big"))


def flash_image(
    loader: RomLoader,
    image: FlashImage,
    verify: bool = True,
    start: bool = True,
    progress: Progress = lambda *_: None,
) -> list[int]:
    """Erase the sectors of an image, write it, read it back, and run it; return the sectors.

    Other sectors, such as those of SAVE, stay as they are.

    Raises:
        RefusedError: The part is another one, or refuses.
        VerifyError: The flash does not hold what was sent.
        LineError: The line fails.
    """
    product = loader.read_product()
    if product != PRODUCT:
        raise RefusedError(
            f"{loader.line.name}: the part says {product:#x}, expected {PRODUCT:#x}, an STM32F405", _NACK
        )
    begin = image.address - FLASH_START
    ends = list(accumulate(SECTORS))
    sectors = list(range(bisect_right(ends, begin), bisect_left(ends, begin + len(image.data)) + 1))
    data = image.data + b"\xff" * (-len(image.data) % 4)
    total, done = len(data) * (2 if verify else 1), 0
    pieces = [(image.address + at, data[at : at + _PIECE]) for at in range(0, len(data), _PIECE)]
    loader.erase(sectors)
    for transfer in (loader.write, loader.verify)[: 1 + verify]:
        for at, piece in pieces:
            progress(done, total)
            transfer(at, piece)
            done += len(piece)
    progress(done, total)
    if start:
        loader.run_program(image.address)
    return sectors
