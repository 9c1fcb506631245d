"""Banks of a driver board: packets as symbols or chips, and their bytes."""

import zlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.air.frames import PacketFormat, packet_chips
from evlcp_sdk.errors import ConfigError, InputError, name_place
from evlcp_sdk.files import read_npy
from evlcp_sdk.link.resolve import Link
from firmware_host.protocol.generated.requests import CLUSTERS, ROW_BYTES, Format
from firmware_host.protocol.rows import BOARD_LEDS, pack_led_rows

WORD_CHIPS = 16
PREAMBLE_CHIPS = 32
MAX_FRAMES = 65_535
"""Packets that a board can compose: chips of a pilot and of an info segment, most chips of a preamble, and
most frames."""

MAX_RANDOM_FRAMES = 100_000
"""Most random frames: minutes of light, far more than any bank holds, but within memory."""

MAX_CHIPS_A_SECOND = 1_000_000
"""Highest chip rate of any board; each reports its own limit, too."""

Symbols = NDArray[np.int64]
Chips = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Bank:
    """Packets of chips of a link for a bank of a board.

    Attributes:
        format: Info words, the LEDs of each chip, or the clusters of each chip.
        link: The packets' link.
        composed: Whether the board composes packets from info words and the codebook.
        chips: Whole packets, uint8 (chips, clusters or LEDs); none in the queue of a stream.
    """

    format: Format
    link: Link
    composed: bool
    chips: Chips

    @classmethod
    def of_chips(cls, chips: ArrayLike, link: Link) -> "Bank":
        """A bank of a link's chips, uint8 (chips, clusters or LEDs), that fill whole packets.

        Raises:
            ConfigError: The number of chips or columns is wrong, a chip is not 0 or 1, or no board can play
                them.
        """
        c, packet = np.asarray(chips), link.packet
        if c.ndim != 2 or not len(c) or len(c) % packet.packet_chips:
            raise ConfigError(
                f"array of shape {c.shape}, expected whole packets of {packet.packet_chips} chips"
                f" ({packet.frames} frames)"
            )
        leds, clusters = len(link.bar.led_clusters()), link.codebook.clusters
        if c.shape[1] not in (leds, clusters):
            raise ConfigError(
                f"chips of shape {c.shape}: expected one column for each of {leds} LEDs or"
                f" {clusters} clusters"
            )
        if c.dtype.kind not in "uib" or not np.isin(c, (0, 1)).all():
            raise ConfigError("chips: expected integers 0 and 1")
        bank = _make_bank(link, c.astype(np.uint8))
        by_cluster = bank.format == Format.CLUSTERS and c.shape[1] == clusters
        return replace(bank, format=Format.CLUSTERS if by_cluster else Format.MASKS)

    @cached_property
    def content(self) -> bytes:
        """The bank's bytes; the link must not have more LEDs than a board."""
        return self.table + (self.encode(self.chips) if len(self.chips) else b"")

    def encode(self, chips: Chips) -> bytes:
        """The bytes of whole packets in a bank."""
        if self.format == Format.MASKS:
            by_cluster = chips.shape[1] == self.clusters
            leds = chips[:, self.link.bar.led_clusters()] if by_cluster else chips
            return pack_led_rows(leds).tobytes()
        if self.format == Format.CLUSTERS:
            return np.packbits(chips, axis=1).tobytes()
        packet = self.link.packet
        ends = [packet.frame_start_chip(frame + 1) for frame in range(packet.frames)]
        info = np.array([range(end - WORD_CHIPS, end) for end in ends])
        segments = chips.reshape(-1, packet.packet_chips, self.clusters)[:, info].swapaxes(2, 3)
        return np.packbits(segments, axis=3)[..., ::-1].tobytes()

    def to_chip_format(self) -> "Bank":
        """The same bank with every chip, if the board would compose packets."""
        form = Format.CLUSTERS if self.format == Format.WORDS else self.format
        return replace(self, format=form, composed=False)

    @property
    def packets(self) -> int:
        """Number of packets."""
        return len(self.chips) // self.link.packet.packet_chips

    @property
    def digest(self) -> bytes:
        """Digest of the codebook, 32 bytes."""
        return bytes.fromhex(self.link.codebook.digest)

    @property
    def chip_rate_hz(self) -> int:
        """Chips per second."""
        return int(self.link.packet.chip_rate_hz)

    @property
    def clusters(self) -> int:
        """Number of clusters."""
        return self.link.codebook.clusters

    @property
    def rest(self) -> int | None:
        """State of the LEDs while nothing is sent, as of `Framing.rest`."""
        return self.link.algorithm("framing").rest()

    @property
    def table(self) -> bytes:
        """The clusters' masks before the first packet; empty in other formats."""
        if self.format != Format.CLUSTERS:
            return b""
        return pack_led_rows(self.link.bar.led_clusters() == np.arange(self.clusters)[:, None]).tobytes()

    @property
    def packet_bytes(self) -> int:
        """Bytes of a packet."""
        if self.format == Format.WORDS:
            return 2 * CLUSTERS * self.link.packet.frames
        return self.chip_bytes * self.link.packet.packet_chips

    @property
    def chip_bytes(self) -> int:
        """Bytes of a chip, if the bank has every chip."""
        return -(-self.clusters // 8) if self.format == Format.CLUSTERS else ROW_BYTES

    @cached_property
    def duty(self) -> int:
        """Share of time that the brightest LED is on, permille, rounded up."""
        return -(-1000 * int(self.chips.sum(0, dtype=np.int64).max()) // len(self.chips))

    @cached_property
    def crc(self) -> int:
        """CRC-32/ISO-HDLC of the content."""
        return zlib.crc32(self.content)


def _make_bank(link: Link, chips: Chips | None = None) -> Bank:
    """A bank in the most compact format for a link; without chips it is a queue."""
    check_rate(link.packet)
    packet, clusters = link.packet, link.codebook.clusters
    composed = (
        np.array_equal(link.bar.led_clusters(), BOARD_LEDS)
        and packet.pilot_chips == packet.info_chips == WORD_CHIPS
        and packet.preamble_chips <= PREAMBLE_CHIPS
        and packet.frames <= MAX_FRAMES
    )
    form = Format.WORDS if composed else Format.CLUSTERS if -(-clusters // 8) < ROW_BYTES else Format.MASKS
    return Bank(form, link, composed, np.zeros((0, clusters), np.uint8) if chips is None else chips)


def check_rate(packet: PacketFormat) -> None:
    """Raise ConfigError if no driver board can play the chip rate."""
    rate = packet.chip_rate_hz
    if rate != round(rate) or rate > MAX_CHIPS_A_SECOND:
        raise ConfigError(
            f"the driver board cannot play this link: air.chip_rate_hz = {rate},"
            f" expected whole chips per second, at most {MAX_CHIPS_A_SECOND}"
        )


def make_bank(symbols: ArrayLike, link: Link) -> Bank:
    """A bank of a link's symbols (packets, frames, clusters): info words if boards compose them, else chips.

    Raises:
        ConfigError: The symbols are not the link's, or no board can play it.

    >>> from evlcp_sdk.link.resolve import resolve
    >>> make_bank([[[0] * 16] * 10], resolve({})).content[:2].hex()
    '5555'
    """
    return _make_bank(link, symbol_chips(symbols, link))


def make_queue(link: Link) -> Bank:
    """A bank without packets, for a stream of a link's packets.

    Raises:
        ConfigError: No board can play it.
    """
    bank = _make_bank(link)
    # A pause cannot be composed.
    return bank if bank.rest is None else bank.to_chip_format()


def random_packets(packets: int, link: Link, seed: int) -> Symbols:
    """Random symbols of a link that carry bits, uniform, int64 (packets, frames, clusters).

    Raises:
        ConfigError: There are none, or too many.
    """
    frames, book = link.packet.frames, link.codebook
    if not 0 < packets * frames <= MAX_RANDOM_FRAMES:
        raise ConfigError(
            f"random = {packets}, air.frames_per_packet = {frames}: expected at least 1 packet,"
            f" at most {MAX_RANDOM_FRAMES} frames in all"
        )
    return np.random.default_rng(seed).integers(0, book.data_symbols, (packets, frames, book.clusters))


def symbol_chips(symbols: ArrayLike, link: Link) -> NDArray[np.uint8]:
    """Chips of consecutive packets of a link: symbols (P, F, K) to uint8 (chips, K), 1 = on.

    Raises:
        ConfigError: The symbols have another shape, or are not in the codebook.
    """
    s, frames = np.asarray(symbols), link.packet.frames
    if s.ndim != 3 or not s.size or s.shape[1] != frames:
        raise ConfigError(f"symbols of shape {s.shape}: expected (packets, {frames} frames, clusters)")
    return np.concatenate([packet_chips(packet, link.codebook, link.packet.pilot_every) for packet in s])


def read_masks(path: Path, link: Link) -> Bank:
    """A bank from a `.npy` file of a link's chips: uint8 (chips, LEDs) or (chips, clusters), whole packets.

    Raises:
        ConfigError: No board can play such packets.
        InputError: The file cannot be read, or holds something else.
    """
    check_rate(link.packet)
    chips = read_npy(path)
    with name_place(f"{path}: ", InputError):
        return Bank.of_chips(chips, link)
