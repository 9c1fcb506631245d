"""A framing of one LED that flashes once a frame: when it does is what it says."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

import evlcp_sdk as evlcp

__all__ = ["FlashPosition"]

_PREAMBLE = (1, 0, 1, 0, 1, 0, 0)
_SLOT_CHIPS = 3
"""Flashes of a preamble are two chips apart, all others three or more: none of those is taken for one."""

_BLIND_CHIPS = 1.5
"""After the first event of a flash: what comes so soon is its tail."""

_STRAY = 0.3
"""Share of the flashes' events that are taken to be of anything else, for the log-likelihood ratios."""


@dataclass(frozen=True)
class FlashPosition(evlcp.Framing):
    """Pulse position: a frame is one flash of one chip, in one of `2 ** bits` slots; dark for the rest.

    The default of three bits lights the LED for a 24th of the time. Three flashes that are nearer to each
    other than any other begin a packet. The clock may be off by a thousandth.
    """

    roles: ClassVar[frozenset[str]] = frozenset()

    bits: Annotated[int, Field(ge=1, le=6, description="Bits of a symbol.")] = 3
    min_events: Annotated[int, Field(ge=1, description="Positive events of a flash, within a chip.")] = 4

    def codebook(self, clusters: int) -> evlcp.Codebook:
        """A codeword a slot, no pilots.

        Raises:
            ConfigError: There is more than one cluster.
        """
        if clusters != 1:
            raise evlcp.ConfigError(
                f"framing 'flash-position': a bar of {clusters} clusters, expected one:"
                " set bar.cluster_rows = bar.rows"
            )
        slots = 2**self.bits
        words = np.zeros((slots, _SLOT_CHIPS * slots), np.uint8)
        words[np.arange(slots), _SLOT_CHIPS * np.arange(slots)] = 1
        pilots = np.empty((1, 0), np.uint8)
        return evlcp.Codebook(f"flash-{self.bits}", np.array(_PREAMBLE, np.uint8), pilots, words)

    def compile(self, codebook: evlcp.Codebook, packet: evlcp.PacketFormat) -> evlcp.Deframer:
        """For the packet's length and the rate of its chips."""
        return _Flashes(self.bits, self.min_events, packet)


@dataclass(frozen=True)
class _Packet:
    """A packet that is being read: its number, the time of its first flash, us, and the frame that is due."""

    number: int
    t_us: float
    frame: int = 0


@dataclass(frozen=True, eq=False)
class _State:
    """Events that may begin a flash, flashes that are not used up, and the packet that is being read."""

    pending_us: NDArray[np.float64]
    blind_us: float = -math.inf
    flashes: tuple[tuple[float, int], ...] = ()
    packet: _Packet | None = None
    last: _Packet | None = None
    preambles: int = 0
    frames_dark: int = 0


@dataclass(frozen=True)
class _Flashes:
    """Events to flashes, flashes to packets; what is decided depends on no event that is still to come."""

    bits: int
    min_events: int
    packet: evlcp.PacketFormat

    def init(self) -> _State:
        return _State(np.empty(0))

    def step(
        self, state: _State, events: evlcp.Events, until_us: float
    ) -> tuple[_State, list[evlcp.DecodedFrame]]:
        state = self._flashes(state, events.t_us[events.p == 1], until_us)
        decoded: list[evlcp.DecodedFrame] = []
        # A flash is known a chip after it began.
        known_us = until_us - self.packet.chip_us
        while True:
            if state.packet is None:
                state = self._begin_packet(state)
                if state.packet is None:
                    return state, decoded
            now = state.packet
            if now.frame == self.packet.frames:
                state = replace(state, packet=None, last=now)
                continue
            start_us = now.t_us + self.packet.frame_start_chip(now.frame) * self.packet.chip_us
            end_us = start_us + self.packet.info_chips * self.packet.chip_us
            # Up to half a slot before a frame a flash is of its first slot.
            edge_us = end_us - _SLOT_CHIPS / 2 * self.packet.chip_us
            if edge_us > known_us:
                return state, decoded
            soft = self._soft([flash for flash in state.flashes if flash[0] < edge_us], start_us)
            state = replace(
                state,
                flashes=tuple(flash for flash in state.flashes if flash[0] >= edge_us),
                packet=replace(now, frame=now.frame + 1),
                frames_dark=state.frames_dark + (soft is None),
            )
            if soft is not None:
                chip_us = self.packet.chip_us
                decoded.append(evlcp.DecodedFrame(now.number, now.frame, now.t_us, start_us, chip_us, soft))

    def close(self, state: _State) -> tuple[_State, list[evlcp.DecodedFrame]]:
        return self.step(state, evlcp.Events.empty(), math.inf)

    def counts(self, state: _State) -> Mapping[str, int]:
        return {"preambles": state.preambles, "frames_dark": state.frames_dark}

    def _flashes(self, state: _State, t_us: NDArray[np.int64], until_us: float) -> _State:
        """Find the flashes that have ended before a time."""
        t = np.concatenate([state.pending_us, t_us])
        found, blind_us, i = list(state.flashes), state.blind_us, 0
        while i < len(t) and t[i] + self.packet.chip_us <= until_us:
            j = int(np.searchsorted(t, t[i] + self.packet.chip_us))
            if t[i] < blind_us or j - i < self.min_events:
                i += 1
                continue
            found.append((float(t[i:j].mean()), j - i))
            blind_us = float(t[i]) + _BLIND_CHIPS * self.packet.chip_us
            i = j
        return replace(state, pending_us=t[i:], blind_us=blind_us, flashes=tuple(found))

    def _begin_packet(self, state: _State) -> _State:
        """Begin a packet at the first preamble among the flashes, if there is one."""
        flashes, chip_us = state.flashes, self.packet.chip_us
        for k in range(len(flashes) - 2):
            gap_chips = np.diff([t for t, _ in flashes[k : k + 3]]) / chip_us
            if (np.abs(gap_chips - 2) < 0.5).all():
                t_us, last = flashes[k][0], state.last
                packet_us = self.packet.packet_chips * chip_us
                number = 0 if last is None else last.number + max(1, round((t_us - last.t_us) / packet_us))
                packet = _Packet(number, t_us)
                return replace(state, flashes=flashes[k + 3 :], packet=packet, preambles=state.preambles + 1)
        return replace(state, flashes=flashes[-2:])

    def _soft(self, flashes: list[tuple[float, int]], start_us: float) -> evlcp.SoftSymbols | None:
        """Soft symbol of a frame; None without a flash."""
        if not flashes:
            return None
        slots = 2**self.bits
        events = np.zeros(slots)
        for t_us, many in flashes:
            slot = round((t_us - start_us) / (_SLOT_CHIPS * self.packet.chip_us))
            events[min(max(slot, 0), slots - 1)] += many
        # An event is of the flash, or a stray one, which may be in any slot.
        weight = events * math.log((1 - _STRAY + _STRAY / slots) / (_STRAY / slots))
        symbol = np.arange(slots)
        zero = (symbol >> np.arange(self.bits - 1, -1, -1)[:, None] & 1) == 0
        sides = (np.logaddexp.reduce(np.where(side, weight, -np.inf), -1) for side in (zero, ~zero))
        llr = np.subtract(*sides)[None].astype(np.float32)
        quality = math.exp(weight.max() - np.logaddexp.reduce(weight))
        return evlcp.SoftSymbols(np.array([weight.argmax()]), llr, quality)
