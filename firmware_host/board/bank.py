"""What a driver board is sent: symbols or chip masks, as the content of a bank."""

import zlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.air.codebook import Codebook, word_of_values
from evlcp_sdk.air.frames import PacketFormat, info_words, packet_chips, pilot_words
from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.files import read_numbers
from evlcp_sdk.link.resolve import Link
from firmware_host.protocol.requests import CLUSTERS, LEDS, ROW_BYTES, Format
from firmware_host.protocol.rows import rows_of_chips

__all__ = ["Bank", "bank_of", "check_link", "limits", "random_symbols", "read_masks", "symbol_chips"]

WORD_CHIPS = 16
"""Chips of a pilot, and of an info segment, that the board composes."""

PREAMBLE_CHIPS = 32
"""Chips of a preamble at most."""

MOST_FRAMES = 65_535
"""Frames of a packet at most."""

MOST_RANDOM_FRAMES = 1_000_000
"""Random frames at most: minutes of light, far beyond any bank, and within memory."""

MOST_CHIPS_A_SECOND = 1_000_000
"""Chips a second that no board takes more of; each says its own maximum, too."""

Symbols = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Bank:
    """Content of one bank.

    Attributes:
        format: Info words or chip masks.
        packets: Packets in it.
        content: The bank's bytes.
        codebook: The codebook it was made with.
        packet: Lengths of a packet's parts, and the chip rate.
    """

    format: Format
    packets: int
    content: bytes
    codebook: Codebook
    packet: PacketFormat

    @classmethod
    def of_symbols(
        cls,
        symbols: ArrayLike,
        codebook: Codebook,
        pilot_every: int = PacketFormat.pilot_every,
        chip_rate_hz: float = PacketFormat.chip_rate_hz,
    ) -> "Bank":
        """Info words of symbols (packets, frames, clusters).

        Raises:
            ConfigError: Symbols of another shape or outside the codebook, or a board cannot play them.

        >>> from evlcp_sdk.link.resolve import resolve
        >>> Bank.of_symbols([[[0] * 16]], resolve({}).codebook).content[:2].hex()
        '5555'
        """
        s = _checked(symbols)
        packet = PacketFormat.of(codebook, s.shape[1], chip_rate_hz, pilot_every)
        _refuse(limits(codebook, packet))
        words = np.concatenate([info_words(one, codebook) for one in s])
        return cls(Format.WORDS, len(s), words.astype("<u2").tobytes(), codebook, packet)

    @classmethod
    def of_masks(cls, chips: ArrayLike, codebook: Codebook, packet: PacketFormat) -> "Bank":
        """Precomposed chips, uint8 (chips, 96 LEDs or 16 clusters), that fill whole packets.

        Raises:
            ConfigError: Another number of chips, or a board cannot play them.
        """
        _refuse(limits(codebook, packet))
        c = np.asarray(chips)
        if c.ndim != 2 or not len(c) or len(c) % packet.packet_chips:
            raise ConfigError(
                f"array of shape {c.shape}, expected whole packets of {packet.packet_chips} chips"
                f" ({packet.frames} frames)"
            )
        rows = rows_of_chips(c)
        return cls(Format.MASKS, len(rows) // packet.packet_chips, rows.tobytes(), codebook, packet)

    @property
    def chip_rate_hz(self) -> int:
        """Chips per second."""
        return int(self.packet.chip_rate_hz)

    def packet_bytes(self, frames: int) -> int:
        """Bytes a packet of this format with another number of frames takes in a bank."""
        if self.format == Format.MASKS:
            return ROW_BYTES * replace(self.packet, frames=frames).packet_chips
        return 2 * self.codebook.clusters * frames

    @cached_property
    def duty(self) -> int:
        """Share of time that it has a LED on, that of the brightest, permille, rounded up."""
        chips = self.packets * self.packet.packet_chips
        if self.format == Format.MASKS:
            rows = np.frombuffer(self.content, np.uint8).reshape(chips, ROW_BYTES)
            on = int(np.unpackbits(rows, axis=1).sum(0, dtype=np.int64).max())
        else:
            words = np.frombuffer(self.content, "<u2").reshape(-1, self.codebook.clusters)
            pilots = -(-self.packet.frames // self.packet.pilot_every)
            own = pilots * np.bitwise_count(pilot_words(self.codebook)).astype(np.int64)
            own += word_of_values(self.codebook.preamble).bit_count()
            on = int((np.bitwise_count(words).sum(0, dtype=np.int64) + self.packets * own).max())
        return -(-1000 * on // chips)

    @cached_property
    def crc(self) -> int:
        """CRC-32/ISO-HDLC of the content."""
        return zlib.crc32(self.content)


def limits(codebook: Codebook, packet: PacketFormat) -> list[str]:
    """What of a link a driver board cannot play; empty if it can."""
    faults = []
    if codebook.clusters != CLUSTERS:
        faults.append(f"bar of {codebook.clusters} clusters, the board has {CLUSTERS}")
    for name, chips in (("pilots", packet.pilot_chips), ("modulation", packet.info_chips)):
        if chips != WORD_CHIPS:
            faults.append(f"{name}: codes of {chips} chips, the board's words have {WORD_CHIPS}")
    if packet.preamble_chips > PREAMBLE_CHIPS:
        faults.append(f"preamble of {packet.preamble_chips} chips, the board's has at most {PREAMBLE_CHIPS}")
    if packet.frames > MOST_FRAMES:
        faults.append(f"air.frames_per_packet = {packet.frames}, at most {MOST_FRAMES}")
    if packet.chip_rate_hz != round(packet.chip_rate_hz):
        faults.append(f"air.chip_rate_hz = {packet.chip_rate_hz}: a board takes whole chips per second")
    elif packet.chip_rate_hz > MOST_CHIPS_A_SECOND:
        faults.append(f"air.chip_rate_hz = {packet.chip_rate_hz}, at most {MOST_CHIPS_A_SECOND}")
    return faults


def check_link(link: Link) -> None:
    """Raise ConfigError, one line, if a driver board cannot play a link; see `limits`."""
    faults = limits(link.codebook, link.packet)
    leds = np.bincount(link.bar.led_clusters())
    other = leds[leds != LEDS // CLUSTERS]
    if link.codebook.clusters == CLUSTERS and len(other):
        faults.insert(0, f"bar of {other[0]} LEDs a cluster, the board has {LEDS // CLUSTERS}")
    _refuse(faults)


def bank_of(symbols: ArrayLike, link: Link) -> Bank:
    """Info words of symbols (packets, frames, clusters) of a link.

    Raises:
        ConfigError: The symbols are not the link's, or a board cannot play it.
    """
    check_link(link)
    return Bank.of_symbols(symbols, link.codebook, link.packet.pilot_every, link.packet.chip_rate_hz)


def _refuse(faults: list[str]) -> None:
    if faults:
        raise ConfigError(f"the driver board cannot play this link: {'; '.join(faults)}")


def _checked(symbols: ArrayLike) -> NDArray[Any]:
    s = np.asarray(symbols)
    if s.ndim != 3 or not s.size:
        raise ConfigError(f"symbols of shape {s.shape}: expected (packets, frames, clusters)")
    return s


def random_symbols(packets: int, frames: int, codebook: Codebook, generator: np.random.Generator) -> Symbols:
    """Uniform symbols, int64 (packets, frames, clusters)."""
    shape = (packets, frames, codebook.clusters)
    return generator.integers(0, len(codebook.codewords), shape, dtype=np.int64)


def symbol_chips(symbols: ArrayLike, codebook: Codebook, pilot_every: int = 1) -> NDArray[np.uint8]:
    """Chips of packets one after another: symbols (P, F, K) to uint8 (chips, K), 1 = on.

    Raises:
        ConfigError: Symbols of another shape or outside the codebook.
    """
    return np.concatenate([packet_chips(packet, codebook, pilot_every) for packet in _checked(symbols)])


def read_masks(path: Path, codebook: Codebook, packet: PacketFormat) -> Bank:
    """Precomposed chips of a `.npy` file: uint8 (chips, 96) or (chips, 16), whole packets.

    Raises:
        ConfigError: A board cannot play such packets.
        InputError: The file cannot be read, or holds something else.
    """
    _refuse(limits(codebook, packet))
    chips = read_numbers(path)
    try:
        return Bank.of_masks(chips, codebook, packet)
    except ConfigError as fault:
        raise InputError(f"{path}: {fault}") from fault
