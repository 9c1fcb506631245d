"""Banks of a driver board: packets as symbols or chips, and their bytes."""

import zlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat, packet_chips
from evlcp_sdk.errors import ConfigError, InputError
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
    """Packets of chips for a bank of a board.

    Attributes:
        format: Info words, the LEDs of each chip, or the clusters of each chip.
        codebook: The codebook of the chips.
        packet: Lengths of a packet's parts.
        led_clusters: The cluster of each LED, int64 (LEDs,).
        composed: Whether the board composes packets from info words and the codebook.
        rest: State of the LEDs while nothing is sent, by `Framing.rest`.
        chips: Whole packets, uint8 (chips, clusters or LEDs); none in the queue of a stream.
    """

    format: Format
    codebook: Codebook
    packet: PacketFormat
    led_clusters: NDArray[np.int64]
    composed: bool
    rest: int | None
    chips: Chips

    @classmethod
    def of_symbols(
        cls,
        symbols: ArrayLike,
        codebook: Codebook,
        pilot_every: int = PacketFormat.pilot_every,
        chip_rate_hz: float = PacketFormat.chip_rate_hz,
        led_clusters: NDArray[np.int64] = BOARD_LEDS,
    ) -> "Bank":
        """A bank of symbols (packets, frames, clusters): info words if boards compose packets, else chips.

        Raises:
            ConfigError: The symbols have another shape or are not in the codebook, or no board can play them.

        >>> from evlcp_sdk.link.resolve import resolve
        >>> Bank.of_symbols([[[0] * 16]], resolve({}).codebook).content[:2].hex()
        '5555'
        """
        chips = symbol_chips(symbols, codebook, pilot_every)
        packet = PacketFormat.of(codebook, np.shape(symbols)[1], chip_rate_hz, pilot_every)
        return _make_bank(codebook, packet, led_clusters, chips)

    @classmethod
    def of_chips(
        cls,
        chips: ArrayLike,
        codebook: Codebook,
        packet: PacketFormat,
        led_clusters: NDArray[np.int64] = BOARD_LEDS,
    ) -> "Bank":
        """A bank of chips, uint8 (chips, clusters or LEDs), that fill whole packets.

        Raises:
            ConfigError: The number of chips or columns is wrong, a chip is not 0 or 1, or no board can play
                them.
        """
        c = np.asarray(chips)
        if c.ndim != 2 or not len(c) or len(c) % packet.packet_chips:
            raise ConfigError(
                f"array of shape {c.shape}, expected whole packets of {packet.packet_chips} chips"
                f" ({packet.frames} frames)"
            )
        if c.shape[1] not in (len(led_clusters), codebook.clusters):
            raise ConfigError(
                f"chips of shape {c.shape}: expected one column for each of {len(led_clusters)} LEDs or"
                f" {codebook.clusters} clusters"
            )
        if c.dtype.kind not in "uib" or not np.isin(c, (0, 1)).all():
            raise ConfigError("chips: expected integers 0 and 1")
        bank = _make_bank(codebook, packet, led_clusters, c.astype(np.uint8))
        by_cluster = bank.format == Format.CLUSTERS and c.shape[1] == codebook.clusters
        return replace(bank, format=Format.CLUSTERS if by_cluster else Format.MASKS)

    @cached_property
    def content(self) -> bytes:
        """The bank's bytes; the link must not have more LEDs than a board."""
        return self.table + (self.encode(self.chips) if len(self.chips) else b"")

    def encode(self, chips: Chips) -> bytes:
        """The bytes of whole packets in a bank."""
        if self.format == Format.MASKS:
            by_cluster = chips.shape[1] == self.clusters
            return pack_led_rows(chips[:, self.led_clusters] if by_cluster else chips).tobytes()
        if self.format == Format.CLUSTERS:
            return np.packbits(chips, axis=1).tobytes()
        packet = self.packet
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
        return len(self.chips) // self.packet.packet_chips

    @property
    def digest(self) -> str:
        """Digest of the codebook, 64 hex digits."""
        return self.codebook.digest

    @property
    def chip_rate_hz(self) -> int:
        """Chips per second."""
        return int(self.packet.chip_rate_hz)

    @property
    def clusters(self) -> int:
        """Number of clusters."""
        return int(self.led_clusters.max()) + 1

    @property
    def table(self) -> bytes:
        """The clusters' masks before the first packet; empty in other formats."""
        if self.format != Format.CLUSTERS:
            return b""
        return pack_led_rows(self.led_clusters == np.arange(self.clusters)[:, None]).tobytes()

    @property
    def packet_bytes(self) -> int:
        """Bytes of a packet."""
        if self.format == Format.WORDS:
            return 2 * CLUSTERS * self.packet.frames
        return self.chip_bytes * self.packet.packet_chips

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


def _make_bank(
    codebook: Codebook,
    packet: PacketFormat,
    led_clusters: NDArray[np.int64],
    chips: Chips | None = None,
    rest: int | None = None,
) -> Bank:
    """A bank in the most compact format for a link; without chips it is a queue."""
    check_rate(packet)
    clusters = int(led_clusters.max()) + 1
    if clusters != codebook.clusters:
        raise ConfigError(f"LEDs of {clusters} clusters, expected {codebook.clusters}, one for each pilot")
    composed = is_composed(packet, led_clusters)
    form = Format.WORDS if composed else Format.CLUSTERS if -(-clusters // 8) < ROW_BYTES else Format.MASKS
    none = np.zeros((0, clusters), np.uint8)
    return Bank(form, codebook, packet, led_clusters, composed, rest, none if chips is None else chips)


def is_composed(packet: PacketFormat, led_clusters: NDArray[np.int64]) -> bool:
    """Whether a board can compose the packets of a link, instead of getting every chip."""
    return (
        np.array_equal(led_clusters, BOARD_LEDS)
        and packet.pilot_chips == packet.info_chips == WORD_CHIPS
        and packet.preamble_chips <= PREAMBLE_CHIPS
        and packet.frames <= MAX_FRAMES
    )


def check_rate(packet: PacketFormat) -> None:
    """Raise ConfigError if no driver board can play the chip rate."""
    rate = packet.chip_rate_hz
    if rate != round(rate) or rate > MAX_CHIPS_A_SECOND:
        raise ConfigError(
            f"the driver board cannot play this link: air.chip_rate_hz = {rate},"
            f" expected whole chips per second, at most {MAX_CHIPS_A_SECOND}"
        )


def make_bank(symbols: ArrayLike, link: Link) -> Bank:
    """A bank of symbols (packets, frames, clusters) of a link.

    Raises:
        ConfigError: The symbols are not the link's, or no board can play it.
    """
    bank = Bank.of_symbols(
        symbols, link.codebook, link.packet.pilot_every, link.packet.chip_rate_hz, link.bar.led_clusters()
    )
    return replace(bank, rest=link.algorithm("framing").rest())


def make_queue(link: Link) -> Bank:
    """A bank without packets, for a stream of a link's packets.

    Raises:
        ConfigError: No board can play it.
    """
    rest = link.algorithm("framing").rest()
    bank = _make_bank(link.codebook, link.packet, link.bar.led_clusters(), rest=rest)
    # A pause cannot be composed.
    return bank if rest is None else bank.to_chip_format()


def random_symbols(packets: int, frames: int, codebook: Codebook, generator: np.random.Generator) -> Symbols:
    """Random symbols that carry bits, uniform, int64 (packets, frames, clusters)."""
    shape = (packets, frames, codebook.clusters)
    return generator.integers(0, codebook.data_symbols, shape, dtype=np.int64)


def random_packets(packets: int, link: Link, seed: int) -> Symbols:
    """Random symbols of a link, int64 (packets, frames, clusters).

    Raises:
        ConfigError: There are none, or too many.
    """
    frames = link.packet.frames
    if not 0 < packets * frames <= MAX_RANDOM_FRAMES:
        raise ConfigError(
            f"random = {packets}, air.frames_per_packet = {frames}: expected at least 1 packet,"
            f" at most {MAX_RANDOM_FRAMES} frames in all"
        )
    return random_symbols(packets, frames, link.codebook, np.random.default_rng(seed))


def symbol_chips(symbols: ArrayLike, codebook: Codebook, pilot_every: int = 1) -> NDArray[np.uint8]:
    """Chips of consecutive packets: symbols (P, F, K) to uint8 (chips, K), 1 = on.

    Raises:
        ConfigError: The symbols have another shape, or are not in the codebook.
    """
    s = np.asarray(symbols)
    if s.ndim != 3 or not s.size:
        raise ConfigError(f"symbols of shape {s.shape}: expected (packets, frames, clusters)")
    return np.concatenate([packet_chips(packet, codebook, pilot_every) for packet in s])


def read_masks(path: Path, link: Link) -> Bank:
    """A bank from a `.npy` file of a link's chips: uint8 (chips, LEDs) or (chips, clusters), whole packets.

    Raises:
        ConfigError: No board can play such packets.
        InputError: The file cannot be read, or holds something else.
    """
    check_rate(link.packet)
    chips = read_npy(path)
    try:
        bank = Bank.of_chips(chips, link.codebook, link.packet, link.bar.led_clusters())
        return replace(bank, rest=link.algorithm("framing").rest())
    except ConfigError as fault:
        raise InputError(f"{path}: {fault}") from fault
