"""What a driver board is sent: symbols or chip masks, as bank content, words and chip tables."""

import json
import zipfile
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat, info_words, packet_chips, pilot_words
from evlcp_sdk.errors import ConfigError, InputError
from firmware_host.errors import IncompatibleError
from firmware_host.protocol.requests import ROW_BYTES, Format
from firmware_host.protocol.rows import rows_of_chips

__all__ = [
    "Bank",
    "random_symbols",
    "read_masks",
    "read_symbols",
    "symbol_chips",
    "word_table",
]

Symbols = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Bank:
    """Content of one bank.

    Attributes:
        format: Info words or chip masks.
        packets: Packets in it.
        frames: Frames per packet.
        content: The bank's bytes.
        codebook: The codebook it was made with.
        pilot_every: Frames from one pilot to the next.
    """

    format: Format
    packets: int
    frames: int
    content: bytes
    codebook: Codebook
    pilot_every: int = 1

    @classmethod
    def of_symbols(cls, symbols: ArrayLike, codebook: Codebook, pilot_every: int = 1) -> "Bank":
        """Info words of symbols (packets, frames, clusters).

        Raises:
            ConfigError: Symbols of another shape or outside the codebook.

        >>> from firmware_host.protocol.generate import codebook_of
        >>> Bank.of_symbols([[[0] * 16]], codebook_of("wh4x2")).content[:2].hex()
        '5555'
        """
        s = np.asarray(symbols)
        if s.ndim != 3 or not s.size:
            raise ConfigError(f"symbols of shape {s.shape}: expected (packets, frames, clusters)")
        words = np.concatenate([info_words(packet, codebook) for packet in s])
        return cls(Format.WORDS, len(s), s.shape[1], words.astype("<u2").tobytes(), codebook, pilot_every)

    @classmethod
    def of_masks(
        cls, chips: ArrayLike, packets: int, frames: int, codebook: Codebook, pilot_every: int = 1
    ) -> "Bank":
        """Precomposed chips, uint8 (chips, 96 LEDs), that fill `packets` packets.

        Raises:
            ConfigError: Another number of chips.
        """
        rows = rows_of_chips(chips)
        expected = packets * _packet_chips(codebook, frames, pilot_every)
        if len(rows) != expected:
            raise ConfigError(
                f"{len(rows)} chips: expected {expected} for {packets} packets of {frames} frames"
            )
        return cls(Format.MASKS, packets, frames, rows.tobytes(), codebook, pilot_every)

    def packet_bytes(self, frames: int) -> int:
        """Bytes a packet of this format with another number of frames takes in a bank."""
        if self.format == Format.MASKS:
            return ROW_BYTES * _packet_chips(self.codebook, frames, self.pilot_every)
        return 2 * self.codebook.clusters * frames

    @cached_property
    def crc(self) -> int:
        """CRC-32/ISO-HDLC of the content."""
        return zlib.crc32(self.content)


def _packet_chips(codebook: Codebook, frames: int, pilot_every: int) -> int:
    return PacketFormat.of(codebook, frames, pilot_every=pilot_every).packet_chips


def random_symbols(packets: int, frames: int, codebook: Codebook, generator: np.random.Generator) -> Symbols:
    """Uniform symbols, int64 (packets, frames, clusters)."""
    shape = (packets, frames, codebook.clusters)
    return generator.integers(0, len(codebook.codewords), shape, dtype=np.int64)


def symbol_chips(symbols: ArrayLike, codebook: Codebook, pilot_every: int = 1) -> NDArray[np.uint8]:
    """Chips of packets one after another: symbols (P, F, K) to uint8 (chips, K), 1 = on.

    Raises:
        ConfigError: Symbols of another shape or outside the codebook.
    """
    s = np.asarray(symbols)
    if s.ndim != 3 or not s.size:
        raise ConfigError(f"symbols of shape {s.shape}: expected (packets, frames, clusters)")
    return np.concatenate([packet_chips(packet, codebook, pilot_every) for packet in s])


def word_table(symbols: ArrayLike, codebook: Codebook) -> NDArray[np.uint16]:
    """Pilot and info words, uint16 (packets, frames, clusters, 2)."""
    s = np.asarray(symbols)
    info = np.stack([info_words(packet, codebook) for packet in s])
    pilots = np.broadcast_to(pilot_words(codebook), info.shape)
    return np.stack([pilots, info], axis=-1)


def read_symbols(path: Path, codebook: Codebook, pilot_every: int = 1) -> Symbols:
    """Symbols of a JSON file: `[packet][frame][cluster]`, or an object with the key `symbols`.

    An object's `profile` and `digest`, where given, must be the codebook's, and its `pilot_every` that of the
    packets.

    Raises:
        IncompatibleError: The file's digest is another one.
        InputError: The file cannot be read, is no JSON, or an element is missing, out of range or no integer;
            the message names the place.
    """
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror}") from fault
    except (ValueError, RecursionError) as fault:
        raise InputError(f"{path}: not JSON: {fault}") from fault
    place = "symbols"
    if isinstance(table, dict):
        profile = table.get("profile", codebook.profile)
        if profile != codebook.profile:
            raise InputError(
                f"{path}: profile = {profile!r}, expected {codebook.profile!r}; choose it with --profile"
            )
        digest = table.get("digest", codebook.digest)
        if digest != codebook.digest:
            raise IncompatibleError(
                f"{path}: digest = {json.dumps(digest)[:18]}, expected {codebook.digest[:16]}"
                f" ({codebook.profile}): made with another codebook; make the file again"
            )
        every = table.get("pilot_every", pilot_every)
        if every != pilot_every:
            raise InputError(
                f"{path}: pilot_every = {json.dumps(every)}, expected {pilot_every};"
                " choose it with --pilot-every"
            )
        if "symbols" not in table:
            raise InputError(f"{path}: key symbols is missing, expected symbols[packet][frame][cluster]")
        table = table["symbols"]
    packets = _list(path, place, table, "packets")
    frames = len(_list(path, f"{place}[0]", packets[0], "frames"))
    for p, packet in enumerate(packets):
        _list(path, f"{place}[{p}]", packet, "frames", frames)
        for f, frame in enumerate(packet):
            _list(path, f"{place}[{p}][{f}]", frame, "symbols, one a cluster", codebook.clusters)
            for k, symbol in enumerate(frame):
                top = len(codebook.codewords) - 1
                if type(symbol) is not int or not 0 <= symbol <= top:
                    raise InputError(
                        f"{path}: {place}[{p}][{f}][{k}] = {json.dumps(symbol)},"
                        f" expected an integer 0 to {top} ({codebook.profile})"
                    )
    return np.array(packets, np.int64)


def _list(path: Path, place: str, value: Any, of: str, length: int | None = None) -> list[Any]:
    if not isinstance(value, list) or not value or (length is not None and len(value) != length):
        found = f"{len(value)} elements" if isinstance(value, list) else json.dumps(value)[:40]
        wanted = f"{length} {of}" if length is not None else f"a list of {of}"
        raise InputError(f"{path}: {place}: found {found}, expected {wanted}")
    return value


def read_masks(path: Path, frames: int, codebook: Codebook, pilot_every: int = 1) -> Bank:
    """Precomposed chips of a `.npy` file: uint8 (chips, 96) or (chips, 16), whole packets of `frames` frames.

    Raises:
        InputError: The file cannot be read, or holds something else.
    """
    try:
        with path.open("rb") as file:
            chips = np.load(file, allow_pickle=False)
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault}") from fault
    except (ValueError, EOFError, MemoryError, zipfile.BadZipFile) as fault:
        raise InputError(f"{path}: not a .npy file of plain numbers: {fault}") from fault
    if not isinstance(chips, np.ndarray):
        raise InputError(f"{path}: not a .npy file, but an archive of several")
    length = _packet_chips(codebook, frames, pilot_every)
    if chips.ndim != 2 or not len(chips) or len(chips) % length:
        raise InputError(
            f"{path}: array of shape {chips.shape},"
            f" expected whole packets of {length} chips ({frames} frames)"
        )
    try:
        return Bank.of_masks(chips, len(chips) // length, frames, codebook, pilot_every)
    except ConfigError as fault:
        raise InputError(f"{path}: {fault}") from fault
