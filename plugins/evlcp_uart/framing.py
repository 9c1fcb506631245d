"""The framing `uart`: a frame is a character, a packet some of them after a pause."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

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

_PIECE_EVENTS = 1 << 16
"""Events of a step."""


@dataclass(frozen=True)
class Uart(Framing):
    """Asynchronous characters of one LED: start bit, data bits, parity, stop bits.

    The rate of the bits is `air.chip_rate_hz`, the characters of a packet are `air.frames_per_packet`.
    """

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

    def infer(self, events: Events) -> tuple[Mapping[str, Any], str]:
        """Infer rate and format from the events of one light, if random bits would not look the same."""
        from evlcp_uart.inference import infer_format

        return infer_format(events.t_us, events.p)

    def rest(self) -> int:
        """A mark, as in pauses: anything else would be characters."""
        return int(self.idle == "on")

    def make_decoder(self, bit_rate_hz: float) -> CharacterDecoder:
        """Make the decoder of events to characters."""
        reader = CharacterReader(self.characters, self.pause_bits)
        return CharacterDecoder(reader, 1e6 / bit_rate_hz, self.idle == "on")

    def compile(self, codebook: Codebook, packet: PacketFormat) -> Deframer:
        """Compile for the length of the packet and the rate of its chips."""
        return _PacketFramer(self.make_decoder(packet.chip_rate_hz), packet)


def read_characters(
    t_us: NDArray[np.int64], p: NDArray[np.uint8], bit_rate_hz: float, uart: Uart | None = None
) -> list[Character]:
    """Read the characters of one LED from the events of the pixels that see it.

    Args:
        t_us: Event times, ascending, us, int64 (n,).
        p: Polarities, 1 for brighter, uint8 (n,).
        bit_rate_hz: Bits a second on air; the clock may be off by 2.5 percent.
        uart: The format; None for eight data bits, no parity, one stop bit.

    >>> read_characters(np.array([5, 7]), np.array([1, 0], np.uint8), 3125.0)
    []
    """
    decoder = (Uart() if uart is None else uart).make_decoder(bit_rate_hz)
    state, found = CharacterState(), list[Character]()
    t_us, p = np.asarray(t_us, np.int64), np.asarray(p, np.uint8)
    for k in range(0, len(t_us), _PIECE_EVENTS):
        piece = slice(k, k + _PIECE_EVENTS)
        state, more = decoder.step(state, t_us[piece], p[piece], int(t_us[piece][-1]))
        found += more
    return found + decoder.close(state)[1]


@dataclass(frozen=True, eq=False)
class _State:
    """The state of the decoder, characters that wait for the start of a packet, and its place.

    `grid` is the start of the first character of a packet, us, and the number of the packet; `last` are
    packet and place of the last character, `end_us` its end; `pauses`: the stated pause was seen.
    """

    decoder: CharacterState
    waiting: tuple[Character, ...] = ()
    grid: tuple[float, int] | None = None
    last: tuple[int, int] = (-1, -1)
    end_us: float = math.nan
    pauses: bool = False


@dataclass(frozen=True)
class _PacketFramer:
    """Numbers the characters of packets, which pauses separate."""

    decoder: CharacterDecoder
    packet: PacketFormat

    def init(self) -> _State:
        return _State(CharacterState())

    def step(self, state: _State, events: Events, until_us: int) -> tuple[_State, list[DecodedFrame]]:
        decoder, found = self.decoder.step(state.decoder, events.t_us, events.p, until_us)
        return self._assign_packets(replace(state, decoder=decoder), found)

    def close(self, state: _State) -> tuple[_State, list[DecodedFrame]]:
        decoder, found = self.decoder.close(state.decoder)
        return self._assign_packets(replace(state, decoder=decoder), found, is_last=True)

    def counts(self, state: _State) -> Mapping[str, int]:
        return state.decoder.tally

    def _assign_packets(
        self, state: _State, found: list[Character], is_last: bool = False
    ) -> tuple[_State, list[DecodedFrame]]:
        """Number characters by packet and place; one off the grid starts a packet.

        So does one after a whole packet, until the stated pause was seen: the real one may be longer.
        """
        waiting, grid, last = (*state.waiting, *found), state.grid, state.last
        end_us, pauses = state.end_us, state.pauses
        if grid is None and waiting:
            start_us = self._find_start(waiting)
            if start_us is None and not is_last:
                return replace(state, waiting=waiting), []
            # Without a pause the start of a packet is unknown; earlier characters count from 0.
            start_us = waiting[0].t_us if start_us is None else start_us
            earlier = (start_us - waiting[0].t_us) / (waiting[0].bit_us * self.packet.packet_chips)
            grid = start_us, math.ceil(earlier - 0.05)
        frames = []
        for character in waiting:
            assert grid is not None
            packets, rest = divmod(
                (character.t_us - grid[0]) / character.bit_us + 1, self.packet.packet_chips
            )
            place = (rest - 1) / self.packet.info_chips
            frame, packet = round(place), grid[1] + int(packets)
            off = abs(place - frame) * self.packet.info_chips
            pauses |= abs((character.t_us - end_us) / character.bit_us - self.packet.preamble_chips) < 0.75
            is_whole = last[1] == self.packet.frames - 1 and not pauses
            if off > 0.75 or is_whole or frame >= self.packet.frames or (packet, frame) <= last:
                packet, frame = last[0] + 1, 0
            grid = character.t_us - frame * self.packet.info_chips * character.bit_us, packet
            last, end_us = (packet, frame), character.t_us + self.packet.info_chips * character.bit_us
            soft = SoftSymbols(np.array([character.value]), character.llr[None], character.quality)
            start_us = grid[0] - self.packet.preamble_chips * character.bit_us
            frames.append(DecodedFrame(packet, frame, start_us, character.t_us, character.bit_us, soft))
        return replace(state, grid=grid, waiting=(), last=last, end_us=end_us, pauses=pauses), frames

    def _find_start(self, waiting: tuple[Character, ...]) -> float | None:
        """Return the start of a packet, us: after its pause, or the first of more characters than it has."""
        for k, (before, character) in enumerate(pairwise(waiting), 1):
            pause = (character.t_us - before.t_us) / character.bit_us - self.packet.info_chips
            if abs(pause - self.packet.preamble_chips) < 0.75:
                return character.t_us
            if k == self.packet.frames:
                return waiting[0].t_us
        return None
