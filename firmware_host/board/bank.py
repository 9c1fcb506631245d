"""What a driver board is sent: symbols or chips, as the content of a bank."""

import zlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.air.codebook import Codebook, word_of_chips
from evlcp_sdk.air.frames import PacketFormat, info_words, packet_chips, pilot_words
from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.files import read_numbers
from evlcp_sdk.link.resolve import Link
from firmware_host.protocol.generated.requests import CLUSTERS, LEDS, ROW_BYTES, Format
from firmware_host.protocol.rows import BOARD_LEDS, masks_of_clusters, rows_of_chips

WORD_CHIPS = 16
"""Chips of a pilot, and of an info segment, that the board composes."""

PREAMBLE_CHIPS = 32
"""Chips of a preamble at most that the board composes."""

MOST_FRAMES = 65_535
"""Frames of a packet at most that the board composes."""

MOST_RANDOM_FRAMES = 1_000_000
"""Random frames at most: minutes of light, far beyond any bank, and within memory."""

MOST_CHIPS_A_SECOND = 1_000_000
"""Chips a second that no board takes more of; each says its own maximum, too."""

Symbols = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Composed:
    """What the board puts packets together with.

    Attributes:
        codebook: Preamble and pilots, and what the words are of.
        packet: Lengths of a packet's parts.
    """

    codebook: Codebook
    packet: PacketFormat


@dataclass(frozen=True, eq=False)
class Bank:
    """Content of one bank.

    Attributes:
        format: Info words, the LEDs of each chip, or the clusters of each chip.
        packets: Packets in it.
        content: The bank's bytes; none if the link has more LEDs than any board.
        digest: What its chips mean: digest of the codebook, 64 hex digits.
        profile: The name of that.
        chip_rate_hz: Chips per second.
        packet_chips: Chips of a packet.
        led_clusters: The cluster of each LED, int64 (LEDs,).
        composed: What the board puts packets together with; None if the bank has every chip.
        word_limits: Why it could not.
        rest: What its LEDs must do while nothing is sent, as the link's framing says.
    """

    format: Format
    packets: int
    content: bytes
    digest: str
    profile: str
    chip_rate_hz: int
    packet_chips: int
    led_clusters: NDArray[np.int64]
    composed: Composed | None = None
    word_limits: tuple[str, ...] = ()
    rest: int | None = None

    @classmethod
    def of_symbols(
        cls,
        symbols: ArrayLike,
        codebook: Codebook,
        pilot_every: int = PacketFormat.pilot_every,
        chip_rate_hz: float = PacketFormat.chip_rate_hz,
        led_clusters: NDArray[np.int64] = BOARD_LEDS,
    ) -> "Bank":
        """Symbols (packets, frames, clusters): info words where a board can compose packets, else every chip.

        Raises:
            ConfigError: Symbols of another shape or outside the codebook, or no board can play them.

        >>> from evlcp_sdk.link.resolve import resolve
        >>> Bank.of_symbols([[[0] * 16]], resolve({}).codebook).content[:2].hex()
        '5555'
        """
        s = _checked(symbols)
        like = _like(codebook, PacketFormat.of(codebook, s.shape[1], chip_rate_hz, pilot_every), led_clusters)
        if len(led_clusters) > LEDS:
            return replace(like, packets=len(s))
        packets = (packet_content(like, one, codebook, pilot_every) for one in s)
        return replace(like, packets=len(s), content=like.content + b"".join(packets))

    @classmethod
    def of_chips(
        cls,
        chips: ArrayLike,
        codebook: Codebook,
        packet: PacketFormat,
        led_clusters: NDArray[np.int64] = BOARD_LEDS,
    ) -> "Bank":
        """Chips as they are, uint8 (chips, clusters or LEDs), that fill whole packets.

        Raises:
            ConfigError: Another number of chips or columns, or no board can play them.
        """
        like = _like(codebook, packet, led_clusters)
        c = np.asarray(chips)
        if c.ndim != 2 or not len(c) or len(c) % packet.packet_chips:
            raise ConfigError(
                f"array of shape {c.shape}, expected whole packets of {packet.packet_chips} chips"
                f" ({packet.frames} frames)"
            )
        packets = len(c) // packet.packet_chips
        if len(led_clusters) > LEDS:
            return replace(like, packets=packets)
        if like.format == Format.CLUSTERS and c.shape[1] == codebook.clusters:
            return replace(like, packets=packets, content=like.content + _bits_of_chips(c))
        rows = rows_of_chips(c, led_clusters)
        return replace(like, format=Format.MASKS, packets=packets, content=rows.tobytes())

    def chip_by_chip(self) -> "Bank":
        """The same with every chip in the bank, where the board would compose packets."""
        if self.composed is None or self.format != Format.WORDS:
            return replace(self, composed=None)
        book, packet = self.composed.codebook, self.composed.packet
        words = np.frombuffer(self.content, "<u2").astype(">u2").view(np.uint8)
        info = np.unpackbits(words).reshape(self.packets, packet.frames, CLUSTERS, WORD_CHIPS)
        preamble = np.repeat(book.preamble[:, None], CLUSTERS, axis=1)
        parts = [masks_of_clusters(self.led_clusters).tobytes()]
        for one in info:
            parts.append(_bits_of_chips(preamble))
            for frame, codes in enumerate(one):
                if packet.has_pilot(frame):
                    parts.append(_bits_of_chips(book.pilots.T))
                parts.append(_bits_of_chips(codes.T))
        return replace(self, format=Format.CLUSTERS, content=b"".join(parts), composed=None)

    @property
    def clusters(self) -> int:
        """Clusters."""
        return int(self.led_clusters.max()) + 1

    @property
    def table_bytes(self) -> int:
        """Bytes before the first packet: the masks of the clusters."""
        return self.clusters * ROW_BYTES if self.format == Format.CLUSTERS else 0

    @property
    def packet_bytes(self) -> int:
        """Bytes of a packet."""
        if self.format == Format.WORDS and self.composed is not None:
            return 2 * CLUSTERS * self.composed.packet.frames
        return self.chip_bytes * self.packet_chips

    @property
    def chip_bytes(self) -> int:
        """Bytes of a chip, where every chip is in the bank."""
        return -(-self.clusters // 8) if self.format == Format.CLUSTERS else ROW_BYTES

    @cached_property
    def duty(self) -> int:
        """Share of time that it has a LED on, that of the brightest, permille, rounded up."""
        chips = self.packets * self.packet_chips
        if self.format == Format.WORDS and self.composed is not None:
            book, packet = self.composed.codebook, self.composed.packet
            words = np.frombuffer(self.content, "<u2").reshape(-1, CLUSTERS)
            pilots = -(-packet.frames // packet.pilot_every)
            own = pilots * np.bitwise_count(pilot_words(book)).astype(np.int64)
            own += word_of_chips(book.preamble).bit_count()
            on = int((np.bitwise_count(words).sum(0, dtype=np.int64) + self.packets * own).max())
        else:
            rows = np.frombuffer(self.content, np.uint8, offset=self.table_bytes).reshape(chips, -1)
            on = int(np.unpackbits(rows, axis=1).sum(0, dtype=np.int64).max())
        return -(-1000 * on // chips)

    @cached_property
    def crc(self) -> int:
        """CRC-32/ISO-HDLC of the content."""
        return zlib.crc32(self.content)


def _bits_of_chips(chips: NDArray[Any]) -> bytes:
    """A bit a cluster, cluster 0 the most significant of each chip's first byte."""
    if chips.dtype.kind not in "uib" or not np.isin(chips, (0, 1)).all():
        raise ConfigError("chips: expected integers 0 and 1")
    return np.packbits(chips.astype(np.uint8), axis=1).tobytes()


def _like(codebook: Codebook, packet: PacketFormat, led_clusters: NDArray[np.int64]) -> Bank:
    """A bank without packets in the most compact format that takes a link.

    Raises:
        ConfigError: No board can play it.
    """
    _refuse(limits(packet))
    clusters = int(led_clusters.max()) + 1
    if clusters != codebook.clusters:
        raise ConfigError(f"LEDs of {clusters} clusters, expected {codebook.clusters}, one for each pilot")
    why = tuple(word_limits(codebook, packet, led_clusters))
    composed = None if why else Composed(codebook, packet)
    form = Format.WORDS if composed else Format.CLUSTERS if -(-clusters // 8) < ROW_BYTES else Format.MASKS
    # more LEDs than a row has are refused by the board's own number
    masks = form == Format.CLUSTERS and len(led_clusters) <= LEDS
    return Bank(
        form,
        0,
        masks_of_clusters(led_clusters).tobytes() if masks else b"",
        codebook.digest,
        codebook.profile,
        int(packet.chip_rate_hz),
        packet.packet_chips,
        led_clusters,
        composed,
        why,
    )


def packet_content(like: Bank, symbols: ArrayLike, codebook: Codebook, pilot_every: int) -> bytes:
    """One packet as it stands in a bank: symbols (frames, clusters).

    Raises:
        ConfigError: Symbols of another shape or outside the codebook.
    """
    if like.format == Format.WORDS:
        return info_words(symbols, codebook).astype("<u2").tobytes()
    chips = packet_chips(symbols, codebook, pilot_every)
    if like.format == Format.CLUSTERS:
        return _bits_of_chips(chips)
    return rows_of_chips(chips, like.led_clusters).tobytes()


def rest_content(like: Bank) -> bytes | None:
    """A packet during which nothing is sent, as it stands in a bank; None if any pattern may stand there."""
    if like.rest is None:
        return None
    chips = np.full((like.packet_chips, like.clusters), like.rest, np.uint8)
    return (
        _bits_of_chips(chips)
        if like.format == Format.CLUSTERS
        else rows_of_chips(chips, like.led_clusters).tobytes()
    )


def limits(packet: PacketFormat) -> list[str]:
    """What of a link no driver board can play; empty if one can. The rest is for HELLO to say."""
    rate = packet.chip_rate_hz
    if rate != round(rate):
        return [f"air.chip_rate_hz = {rate}: a board takes whole chips per second"]
    if rate > MOST_CHIPS_A_SECOND:
        return [f"air.chip_rate_hz = {rate}, at most {MOST_CHIPS_A_SECOND}"]
    return []


def word_limits(codebook: Codebook, packet: PacketFormat, led_clusters: NDArray[np.int64]) -> list[str]:
    """Why a board cannot compose the packets of a link, so that it is sent every chip; empty if it can."""
    faults = []
    if not np.array_equal(led_clusters, BOARD_LEDS):
        faults.append(
            f"{len(led_clusters)} LEDs in {codebook.clusters} clusters, not {LEDS} in {CLUSTERS} equal ones"
        )
    for name, chips in (("pilots", packet.pilot_chips), ("modulation", packet.info_chips)):
        if chips != WORD_CHIPS:
            faults.append(f"{name}: codes of {chips} chips, not {WORD_CHIPS}")
    if packet.preamble_chips > PREAMBLE_CHIPS:
        faults.append(f"preamble of {packet.preamble_chips} chips, more than {PREAMBLE_CHIPS}")
    if packet.frames > MOST_FRAMES:
        faults.append(f"air.frames_per_packet = {packet.frames}, more than {MOST_FRAMES}")
    return faults


def check_link(link: Link) -> None:
    """Raise ConfigError, one line, if no driver board can play a link; see `limits`."""
    _refuse(limits(link.packet))


def bank_of(symbols: ArrayLike, link: Link) -> Bank:
    """Symbols (packets, frames, clusters) of a link.

    Raises:
        ConfigError: The symbols are not the link's, or no board can play it.
    """
    bank = Bank.of_symbols(
        symbols, link.codebook, link.packet.pilot_every, link.packet.chip_rate_hz, link.bar.led_clusters()
    )
    return replace(bank, rest=link.algorithm("framing").rest())


def queue_of(link: Link) -> Bank:
    """The bank of a stream of a link's packets: without packets.

    Raises:
        ConfigError: No board can play it.
    """
    rest = link.algorithm("framing").rest()
    like = replace(_like(link.codebook, link.packet, link.bar.led_clusters()), rest=rest)
    # A board that composes packets has words for no pause.
    return like if rest is None else like.chip_by_chip()


def _refuse(faults: list[str]) -> None:
    if faults:
        raise ConfigError(f"the driver board cannot play this link: {'; '.join(faults)}")


def _checked(symbols: ArrayLike) -> NDArray[Any]:
    s = np.asarray(symbols)
    if s.ndim != 3 or not s.size:
        raise ConfigError(f"symbols of shape {s.shape}: expected (packets, frames, clusters)")
    return s


def random_symbols(packets: int, frames: int, codebook: Codebook, generator: np.random.Generator) -> Symbols:
    """Uniform symbols, of those that carry bits, int64 (packets, frames, clusters)."""
    shape = (packets, frames, codebook.clusters)
    return generator.integers(0, codebook.carrying, shape, dtype=np.int64)


def symbol_chips(symbols: ArrayLike, codebook: Codebook, pilot_every: int = 1) -> NDArray[np.uint8]:
    """Chips of packets one after another: symbols (P, F, K) to uint8 (chips, K), 1 = on.

    Raises:
        ConfigError: Symbols of another shape or outside the codebook.
    """
    return np.concatenate([packet_chips(packet, codebook, pilot_every) for packet in _checked(symbols)])


def read_masks(path: Path, link: Link) -> Bank:
    """Chips of a link from a `.npy` file: uint8 (chips, LEDs) or (chips, clusters), whole packets.

    Raises:
        ConfigError: No board can play such packets.
        InputError: The file cannot be read, or holds something else.
    """
    check_link(link)
    chips = read_numbers(path)
    try:
        bank = Bank.of_chips(chips, link.codebook, link.packet, link.bar.led_clusters())
        return replace(bank, rest=link.algorithm("framing").rest())
    except ConfigError as fault:
        raise InputError(f"{path}: {fault}") from fault
