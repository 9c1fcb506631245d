"""The framing `uart`: a frame is a character, a packet some of them behind a pause."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Deframer, Framing
from evlcp_sdk.values import DecodedFrame, Events, SoftSymbols
from evlcp_uart.characters import BitOrder, Characters, Parity
from evlcp_uart.decoder import Character, CharacterDecoder, CharacterState
from evlcp_uart.reader import CLOCK_SHARE, CharacterReader

_PIECE = 1 << 16
"""Events that are taken at once from an array."""


@dataclass(frozen=True)
class Uart(Framing):
    """Asynchronous characters of one LED: start bit, data bits, parity, stop bits.

    The rate of the bits is `air.chip_rate_hz`, the characters of a packet are `air.frames_per_packet`.
    """

    roles: ClassVar[frozenset[str]] = frozenset()
    detection: ClassVar[str] = "spots"
    characters_on_air: ClassVar[bool] = True
    clock_share: ClassVar[float] = CLOCK_SHARE

    data_bits: Annotated[int, Field(ge=5, le=9, description="Data bits of a character.")] = 8
    parity: Annotated[Parity, Field(description="The parity bit makes the number of ones so.")] = "none"
    stop_bits: Annotated[int, Field(ge=1, le=2, description="Stop bits behind a character.")] = 1
    idle: Annotated[Literal["on", "off"], Field(description="What the LED does for a one and in pauses.")] = (
        "on"
    )
    first_bit: Annotated[
        BitOrder, Field(description="The data bit that comes first; of a serial port the lowest.")
    ] = "lowest"
    pause_bits: Annotated[int, Field(ge=2, le=4096, description="Pause before a packet that is sent.")] = 16

    @property
    def characters(self) -> Characters:
        """The format of a character."""
        return Characters(self.data_bits, self.parity, self.stop_bits, self.first_bit)

    def codebook(self, clusters: int) -> Codebook:
        """A codeword a character, the pause as preamble, no pilots.

        Raises:
            ConfigError: There is more than one cluster.
        """
        if clusters != 1:
            raise ConfigError(
                f"framing 'uart': a bar of {clusters} clusters, expected one: set bar.cluster_rows = bar.rows"
            )
        mark = self.rest()
        levels = self.characters.levels()
        order = "" if self.first_bit == "lowest" else "-highest"
        profile = f"uart-{self.data_bits}{self.parity[0].upper()}{self.stop_bits}{order}"
        pause = np.full(self.pause_bits, mark, np.uint8)
        return Codebook(profile, pause, np.empty((1, 0), np.uint8), levels if mark else 1 - levels)

    def rest(self) -> int:
        """A mark, as in pauses: anything else would be characters."""
        return int(self.idle == "on")

    def decoder(self, bit_rate_hz: float) -> CharacterDecoder:
        """What reads characters from events."""
        return CharacterDecoder(
            CharacterReader(self.characters, self.pause_bits), 1e6 / bit_rate_hz, self.idle == "on"
        )

    def compile(self, codebook: Codebook, packet: PacketFormat) -> Deframer:
        """For the packet's length and the rate of its chips."""
        return _Packets(self.decoder(packet.chip_rate_hz), packet)


def read_characters(
    t_us: NDArray[np.int64], p: NDArray[np.uint8], bit_rate_hz: float, uart: Uart | None = None
) -> list[Character]:
    """Read the characters of one LED from the events of the pixels that see it.

    Args:
        t_us: Event times, ascending, us, int64 (n,).
        p: Polarities, 1 for brighter, uint8 (n,).
        bit_rate_hz: Bits a second on air; the clock may be off by two percent.
        uart: Their format; None for eight data bits, no parity, one stop bit.

    >>> read_characters(np.array([5, 7]), np.array([1, 0], np.uint8), 3125.0)
    []
    """
    decoder = (Uart() if uart is None else uart).decoder(bit_rate_hz)
    state, found = decoder.init(), []
    for k in range(0, len(t_us), _PIECE):
        t, q = np.asarray(t_us[k : k + _PIECE], np.int64), np.asarray(p[k : k + _PIECE], np.uint8)
        state, more = decoder.step(state, t, q, int(t[-1]))
        found += more
    return found + decoder.close(state)[1]


@dataclass(frozen=True, eq=False)
class _Grid:
    """Where packets stand: the start of the first character of one, us, and its number."""

    t_us: float
    packet: int


@dataclass(frozen=True, eq=False)
class _Heard:
    """State of the decoder, grid of packets, characters that wait for one, and the last one's place."""

    decoder: CharacterState
    grid: _Grid | None = None
    waiting: tuple[Character, ...] = ()
    last: tuple[int, int] = (-1, -1)


@dataclass(frozen=True)
class _Packets:
    """Numbers characters by packets: some follow one another, then there is a pause."""

    decoder: CharacterDecoder
    packet: PacketFormat

    def init(self) -> _Heard:
        return _Heard(self.decoder.init())

    def step(self, state: _Heard, events: Events, until_us: int) -> tuple[_Heard, list[DecodedFrame]]:
        decoder, found = self.decoder.step(state.decoder, events.t_us, events.p, until_us)
        return self._number(replace(state, decoder=decoder), found)

    def close(self, state: _Heard) -> tuple[_Heard, list[DecodedFrame]]:
        decoder, found = self.decoder.close(state.decoder)
        state, heard = self._number(replace(state, decoder=decoder), found)
        if state.waiting:
            # There was no pause by which to tell where a packet begins.
            state, more = self._give(self._begun(state, state.waiting[0].t_us), state.waiting)
            heard += more
        return state, heard

    def counts(self, state: _Heard) -> Mapping[str, int]:
        return state.decoder.given

    def _number(self, state: _Heard, found: list[Character]) -> tuple[_Heard, list[DecodedFrame]]:
        heard: list[DecodedFrame] = []
        for one in found:
            if state.grid is not None:
                state, more = self._give(state, (one,))
                heard += more
                continue
            before = state.waiting[-1] if state.waiting else None
            state = replace(state, waiting=(*state.waiting, one))
            start_us = None
            if before is not None and self._paused(before, one):
                # Those before it are the last ones of the packet before.
                start_us = one.t_us
            elif len(state.waiting) > self.packet.frames:
                start_us = state.waiting[0].t_us
            if start_us is not None:
                state, more = self._give(self._begun(state, start_us), state.waiting)
                heard += more
        return state, heard

    def _paused(self, before: Character, one: Character) -> bool:
        """Whether there is the pause between two characters that is sent before a packet."""
        pause = (one.t_us - before.t_us) / one.bit_us - self.packet.info_chips
        return abs(pause - self.packet.preamble_chips) < 0.75

    def _begun(self, state: _Heard, t_us: float) -> _Heard:
        """With a packet whose first character begins at a time; packets before it count from 0."""
        earlier = (t_us - state.waiting[0].t_us) / (state.waiting[0].bit_us * self.packet.packet_chips)
        return replace(state, grid=_Grid(t_us, math.ceil(earlier - 0.05)))

    def _give(self, state: _Heard, found: tuple[Character, ...]) -> tuple[_Heard, list[DecodedFrame]]:
        """Characters by packet and place in it; one off the grid begins a packet."""
        heard = []
        grid, last = state.grid, state.last
        assert grid is not None
        for one in found:
            bits = (one.t_us - grid.t_us) / one.bit_us
            packets, rest = divmod(bits + 1, self.packet.packet_chips)
            place = (rest - 1) / self.packet.info_chips
            frame, packet = round(place), grid.packet + int(packets)
            off = abs(place - frame) * self.packet.info_chips
            if off > 0.75 or frame >= self.packet.frames or (packet, frame) <= last:
                packet, frame = last[0] + 1, 0
                grid = _Grid(one.t_us, packet)
            else:
                start = one.t_us - frame * self.packet.info_chips * one.bit_us
                grid = _Grid(start, packet)
            last = packet, frame
            heard.append(self._heard(one, packet, frame, grid.t_us))
        return replace(state, grid=grid, waiting=(), last=last), heard

    def _heard(self, one: Character, packet: int, frame: int, first_us: float) -> DecodedFrame:
        soft = SoftSymbols(np.array([one.value]), one.llr[None], one.quality)
        start_us = first_us - self.packet.preamble_chips * one.bit_us
        return DecodedFrame(packet, frame, start_us, one.t_us, one.bit_us, soft)
