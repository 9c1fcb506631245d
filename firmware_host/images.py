"""Images of a part's flash: from ELF, Intel HEX and binary files, and back."""

import struct
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from evlcp_sdk.errors import InputError
from evlcp_sdk.files import read_bytes

FLASH_START = 0x0800_0000
"""Address of an STM32's flash."""
FLASH_BYTES = 1 << 20
"""Size of an STM32F405's flash."""


def check_flash_file(path: Path) -> None:
    """Raise InputError unless an emulator can keep its flash in a file, existing or new."""
    try:
        if not path.is_file() and path.exists():
            raise InputError(f"{path}: not a file; expected the name of a flash file, there or new")
        if path.is_file():
            path.open("rb").close()
        # SAVE replaces the file
        tempfile.TemporaryFile(dir=path.resolve().parent).close()
    except OSError as fault:
        raise InputError(f"{path}: the flash file cannot be used: {fault.strerror}") from fault


@dataclass(frozen=True)
class FlashImage:
    """Bytes of a flash; gaps are 0xff, as erased.

    Attributes:
        address: Address of the first byte.
        data: The bytes.
    """

    address: int
    data: bytes

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read an `.elf`, `.hex` or `.bin` file; a `.bin` begins at the start of the flash.

        Raises:
            InputError: It cannot be read, is damaged, or does not fit the flash.
        """
        data = read_bytes(path)
        if data[:4] == b"\x7fELF":
            pieces = list(_elf_pieces(path, data))
        elif path.suffix.lower() in (".hex", ".ihex", ".ihx"):
            pieces = list(_hex_pieces(path, data))
        elif path.suffix.lower() == ".bin":
            pieces = [(FLASH_START, data)]
        else:
            raise InputError(f"{path}: expected .elf, .hex or .bin; 'evlcp board update' takes .update.json")
        pieces = [(at, piece) for at, piece in pieces if piece]
        if not pieces:
            raise InputError(f"{path}: holds no bytes of a flash; expected a firmware image")
        first = min(at for at, _ in pieces)
        end = max(at + len(piece) for at, piece in pieces)
        if first < FLASH_START or end > FLASH_START + FLASH_BYTES:
            raise InputError(
                f"{path}: bytes from {first:#x} to {end - 1:#x}, expected within the flash,"
                f" {FLASH_START:#x} to {FLASH_START + FLASH_BYTES - 1:#x}"
            )
        content = bytearray(b"\xff" * (end - first))
        for at, piece in pieces:
            content[at - first : at - first + len(piece)] = piece
        return cls(first, bytes(content))


def _hex_pieces(path: Path, data: bytes) -> Iterator[tuple[int, bytes]]:
    base, ended = 0, False
    for number, line in enumerate(data.decode("latin-1").splitlines(), 1):
        if not line.strip() or ended:
            continue
        try:
            body = bytes.fromhex(line.strip().removeprefix(":"))
            if not line.startswith(":") or len(body) != body[0] + 5 or sum(body) & 0xFF:
                raise ValueError
        except (ValueError, IndexError) as fault:
            raise InputError(
                f"{path}: line {number}: not a record of Intel HEX, or its check sum is wrong"
            ) from fault
        content, kind, address = body[4:-1], body[3], int.from_bytes(body[1:3], "big")
        if kind == 0:
            yield base + address, content
        elif kind == 1:
            ended = True
        elif kind in (2, 4) and len(content) == 2:
            base = int.from_bytes(content, "big") << (16 if kind == 4 else 4)
        elif kind not in (3, 5):
            raise InputError(f"{path}: line {number}: record type {kind}, expected 0 to 5")
    if not ended:
        raise InputError(f"{path}: has no end record; the file is cut off")


def _elf_pieces(path: Path, data: bytes) -> Iterator[tuple[int, bytes]]:
    try:
        if data[4:6] != b"\x01\x01":
            raise InputError(f"{path}: an ELF file, but not one of 32 bits, little-endian")
        start, number = struct.unpack_from("<I", data, 28)[0], struct.unpack_from("<H", data, 44)[0]
        for n in range(number):
            kind, offset, _, at, size = struct.unpack_from("<5I", data, start + 32 * n)
            if kind == 1 and size:
                if offset + size > len(data):
                    raise InputError(f"{path}: {len(data)} bytes, a segment ends at {offset + size}: cut off")
                yield at, data[offset : offset + size]
    except struct.error as fault:
        raise InputError(f"{path}: {len(data)} bytes: an ELF file that is cut off") from fault
