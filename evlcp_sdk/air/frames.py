"""Frames and packets: symbols and bits to chips on air, and back.

A packet is the preamble followed by F frames; a frame is a pilot and an info segment; packets follow one
another without a gap (air interface 1). At a higher rate only every N-th frame of a packet, from its first
on, has a pilot; the others are the info segment alone.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError


@dataclass(frozen=True)
class PacketFormat:
    """Lengths of a packet's parts in chips, and the chip rate.

    >>> from evlcp_sdk.air.codebook import Codebook, hadamard
    >>> book = Codebook.of_values("demo", hadamard(2)[1], hadamard(8), hadamard(8))
    >>> PacketFormat.of(book, frames=10).frame_chips
    32
    >>> PacketFormat.of(book, frames=10, pilot_every=4).packet_chips
    212
    """

    preamble_chips: int = 26
    pilot_chips: int = 16
    info_chips: int = 16
    frames: int = 10
    chip_rate_hz: float = 10_000.0
    pilot_every: int = 1

    @classmethod
    def of(
        cls,
        codebook: Codebook,
        frames: int,
        chip_rate_hz: float = chip_rate_hz,
        pilot_every: int = pilot_every,
    ) -> "PacketFormat":
        """The format with the lengths of a codebook's codes."""
        return cls(
            preamble_chips=len(codebook.preamble),
            pilot_chips=codebook.pilots.shape[1],
            info_chips=codebook.codewords.shape[1],
            frames=frames,
            chip_rate_hz=chip_rate_hz,
            pilot_every=pilot_every,
        )

    @cached_property
    def frame_chips(self) -> int:
        """Chips of a frame with a pilot: pilot and info segment."""
        return self.pilot_chips + self.info_chips

    @cached_property
    def packet_chips(self) -> int:
        """Chips of one packet: preamble and frames."""
        return self.frame_start_chip(self.frames)

    @cached_property
    def chip_us(self) -> float:
        """Nominal length of a chip, us."""
        return 1e6 / self.chip_rate_hz

    @property
    def packet_us(self) -> float:
        """Nominal length of a packet, us."""
        return self.packet_chips * self.chip_us

    def has_pilot(self, frame: int) -> bool:
        """Whether a frame of the packet starts with a pilot."""
        return frame % self.pilot_every == 0

    def frame_start_chip(self, frame: int) -> int:
        """Chip of the packet at which a frame starts: with its pilot, or with its info segment."""
        pilots = -(-frame // self.pilot_every)
        return self.preamble_chips + frame * self.info_chips + pilots * self.pilot_chips

    @cached_property
    def frame_starts(self) -> tuple[int, ...]:
        """Chips of the packet at which its frames start, and at which it ends: see `frame_start_chip`."""
        return tuple(map(self.frame_start_chip, range(self.frames + 1)))

    def gross_bit_s(self, bits_per_symbol: int, clusters: int) -> float:
        """Bits on air a second, without the time for preamble and pilots.

        >>> round(PacketFormat().gross_bit_s(6, 16))
        27746
        """
        return self.frames * clusters * bits_per_symbol * self.chip_rate_hz / self.packet_chips


def _check_symbols(symbols: ArrayLike, codebook: Codebook) -> NDArray[np.int64]:
    s = np.asarray(symbols)
    if s.ndim != 2 or s.shape[1] != codebook.clusters:
        raise ConfigError(f"symbols of shape {s.shape}: expected (frames, {codebook.clusters} clusters)")
    if s.dtype.kind not in "ui":
        raise ConfigError(f"symbols of type {s.dtype}: expected integers")
    top = len(codebook.codewords)
    if s.size and (s.min() < 0 or s.max() >= top):
        f, k = np.argwhere((s < 0) | (s >= top))[0]
        raise ConfigError(
            f"symbol {s[f, k]} at frame {f}, cluster {k}: expected 0 to {top - 1} ({codebook.profile})"
        )
    return s.astype(np.int64)


def packet_chips(symbols: ArrayLike, codebook: Codebook, pilot_every: int = 1) -> NDArray[np.uint8]:
    """Chips of one packet, uint8 (chips, K), 1 = on, from its symbols (F, K).

    Raises:
        ConfigError: The symbols have another shape, or are not in the codebook.
    """
    s = _check_symbols(symbols, codebook)
    preamble = np.repeat(codebook.preamble[:, None], codebook.clusters, axis=1)
    pilot, info = codebook.pilots.T, codebook.codewords
    parts = [preamble]
    for frame, row in enumerate(s):
        parts += [pilot, info[row].T] if frame % pilot_every == 0 else [info[row].T]
    return np.concatenate(parts)


def chips_after_frame(codebook: Codebook, packet: PacketFormat, frame: int) -> NDArray[np.int8]:
    """The chip of each cluster right after a frame of a packet, int8 (K,); -1 where it may be either.

    A pilot follows, the next frame's codeword, or a preamble. After the last packet the LEDs are dark, so
    that the chip is undetermined if preambles begin lit.

    >>> book = Codebook("demo", np.array([0, 1]), np.array([[1, 0], [0, 1]]), np.array([[0, 1], [1, 1]]))
    >>> packet = PacketFormat.of(book, frames=3, pilot_every=2)
    >>> [chips_after_frame(book, packet, frame).tolist() for frame in range(3)]
    [[-1, -1], [1, 0], [0, 0]]
    """
    last = frame + 1 == packet.frames
    if not last and packet.has_pilot(frame + 1):
        return codebook.pilots[:, 0].astype(np.int8)
    first = {0, int(codebook.preamble[0])} if last else set(codebook.codewords[:, 0].tolist())
    return np.full(codebook.clusters, first.pop() if len(first) == 1 else -1, np.int8)


def bits_of_symbols(symbols: ArrayLike, bits_per_symbol: int) -> NDArray[np.uint8]:
    """Bits of symbols (F, K), frame by frame, cluster 0 first, most significant bit first.

    >>> bits_of_symbols([[5, 2]], 3).tolist()
    [1, 0, 1, 0, 1, 0]
    """
    s = np.asarray(symbols, np.int64)
    shifts = np.arange(bits_per_symbol - 1, -1, -1)
    return ((s[..., None] >> shifts) & 1).astype(np.uint8).ravel()


def symbols_of_bits(bits: ArrayLike, bits_per_symbol: int, clusters: int) -> NDArray[np.int64]:
    """Symbols (F, K) of a packet's bits; the inverse of `bits_of_symbols`.

    Raises:
        ConfigError: The bits do not fill whole frames.

    >>> symbols_of_bits([1, 0, 1, 0, 1, 0], 3, 2).tolist()
    [[5, 2]]
    """
    b = np.asarray(bits, np.int64).ravel()
    if b.size % (bits_per_symbol * clusters):
        raise ConfigError(f"{b.size} bits: expected a multiple of {bits_per_symbol * clusters} (one frame)")
    weights = 1 << np.arange(bits_per_symbol - 1, -1, -1)
    symbols: NDArray[np.int64] = (b.reshape(-1, clusters, bits_per_symbol) * weights).sum(-1)
    return symbols
