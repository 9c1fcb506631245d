"""The transmitters that a receiver knows: numbered at their first frame, remembered when lost from sight."""

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.rx.alignment import Pilot
from evlcp_sdk.rx.delays import LONGEST_ROW_US, RowDelay
from evlcp_sdk.rx.followed import Followed, Places
from evlcp_sdk.rx.grid import PacketGrid
from evlcp_sdk.rx.limits import Limits
from evlcp_sdk.rx.reflections import PacketAssembler
from evlcp_sdk.values import SyncLock

LOOKBACK_PACKETS = 2
"""Packets of events kept while there is no lock: one to find a preamble in, one to look back on."""

_REMEMBER_US = 1e6
"""How long a transmitter lost from sight is remembered: clocks 100 ppm apart drift by a chip in it."""

_UNSEEN_STEPS = 5
"""Steps without a position after which a region counts as lost: it blinks in every chip otherwise."""


@dataclass
class Transmitter:
    """What the receiver knows of one region.

    Attributes:
        region: Where it is in the image, and its events.
        sync: State of its synchronization.
        packets: Collects its frames.
        grid: Where its frames stand on the clock.
        distance: What is known of its distance.
        number: Transmitter number, None before the first frame.
        first: Number of the first packet on the grid that had a frame, None before.
        rows: How late the rows of its bar are read.
        pilot: The newest pilot, None where it showed no bar.
        said: Number of the newest frame that was decoded, on the grid, and its symbols.
        missed: Frames due that were not given, by the count that they belong to.
        behind: Frames that are due wait for the next step.
        tried: Number of the newest frame on the grid that was not given as soon as it was due.
        lit_us: When the first frame was due in which its light was there, camera clock, us; None before.
    """

    region: Followed
    sync: Any
    packets: PacketAssembler
    grid: PacketGrid
    distance: Any = None
    number: int | None = None
    first: int | None = None
    rows: RowDelay = field(default_factory=RowDelay)
    pilot: Pilot | None = None
    said: tuple[int, NDArray[np.int64]] = (-1, np.empty(0, np.int64))
    missed: Counter[str] = field(default_factory=Counter)
    behind: bool = False
    tried: int = -1
    lit_us: float | None = None


class Transmitters:
    """Regions with what is known of them, by the region's number.

    Args:
        packet: What is on air.
        step_us: Length of a time step, us.
        limits: How many are remembered.
        numbers: Where their numbers come from; None for 0, 1, 2...
        chips_after: Chips after a frame that are read with it.
    """

    def __init__(
        self,
        packet: PacketFormat,
        step_us: int,
        limits: Limits,
        numbers: Iterator[int] | None = None,
        chips_after: int = 0,
    ) -> None:
        self._packet = packet
        self._chips_after = chips_after
        self._remembered = limits.remembered
        self._step_us = step_us
        self._alive: dict[int, Transmitter] = {}
        self._released: list[Transmitter] = []
        self._numbers = count() if numbers is None else numbers

    def of(self, region: Followed) -> Transmitter | None:
        """What is known of a region; None before it was opened."""
        return self._alive.get(region.id)

    @property
    def alive(self) -> list[Transmitter]:
        """Those in sight."""
        return list(self._alive.values())

    def open(self, region: Followed, sync: Any, distance: Any) -> Transmitter:
        """Take a new region, with the first states of its synchronization and its distance filter."""
        packets, grid = PacketAssembler(self._packet.frames), self._grid()
        transmitter = Transmitter(region, sync, packets, grid, distance)
        self._alive[region.id] = transmitter
        return transmitter

    def adopt(self, transmitter: Transmitter, lock: SyncLock) -> bool:
        """Take a new lock; frames go on where they were, or start with the first whole one of the region.

        Args:
            transmitter: Whose preamble was found.
            lock: How.

        Returns:
            Whether it is another packet grid than before.
        """
        if transmitter.grid.follow(lock):
            return False
        transmitter.pilot = None
        # Half a chip before the first event, at 0, is still within the first edge's delay.
        earliest_us = max(transmitter.region.first_us, -lock.chip_us / 2)
        if transmitter.grid.lock is None and self._inherit(transmitter, lock):
            transmitter.grid.skip_before(earliest_us)
            return True
        transmitter.grid.restart(lock, earliest_us)
        return True

    def number(self, transmitter: Transmitter) -> int:
        """Its number: the next one, if it has none."""
        if transmitter.number is None:
            transmitter.number = next(self._numbers)
        return transmitter.number

    def _inherit(self, transmitter: Transmitter, lock: SyncLock) -> bool:
        """Go on as a transmitter that was lost from sight, if the packets stand on its grid."""
        for lost in [*self._alive.values(), *self._released]:
            unseen_us = lock.packet_t_us - lost.region.latest.t_us
            if lost is transmitter or not 0 < unseen_us < _REMEMBER_US:
                continue
            if unseen_us < _UNSEEN_STEPS * self._step_us or not lost.grid.follow(lock):
                continue
            transmitter.number, transmitter.first = lost.number, lost.first
            transmitter.distance = lost.distance
            transmitter.packets, lost.packets = lost.packets, transmitter.packets
            transmitter.grid, lost.grid = lost.grid, self._grid()
            return True
        return False

    def _grid(self) -> PacketGrid:
        return PacketGrid(self._packet, self._chips_after)

    def in_step(self, transmitter: Transmitter) -> list[Transmitter]:
        """Others that have shown no frame yet either, whose packets stand on the same times.

        They are parts of one bar, or a bar and its image: of two bars, three in a hundred pairs would.
        """
        lock = transmitter.grid.lock
        if lock is None or transmitter.region.size_px is not None:
            return []
        period_us, same = self._packet.packet_chips * lock.chip_us, []
        for other in self._alive.values():
            heard = other.grid.lock
            if other is transmitter or heard is None or other.region.size_px is not None:
                continue
            apart = (heard.packet_t_us - lock.packet_t_us) / period_us
            rows_px = abs(other.region.latest.y_px - transmitter.region.latest.y_px)
            within_us = lock.chip_us / 4 + LONGEST_ROW_US * rows_px
            if abs(apart - round(apart)) * period_us <= within_us:
                same.append(other)
        return same

    def forget(self, transmitter: Transmitter, now_us: float) -> None:
        """Drop the events that no frame can need any more."""
        region, grid = transmitter.region, transmitter.grid
        oldest_us = now_us - LOOKBACK_PACKETS * self._packet.packet_chips * self._packet.chip_us
        if grid.lock is None:
            keep_us = oldest_us
            region.first_us = max(region.first_us, int(keep_us))
        else:
            # A later lock may move the next frame's start by a chip; the preamble before a packet's first
            # frame has yet to say how late the rows are.
            keep_us = grid.start_us(grid.frame) - grid.lock.chip_us
            if grid.frame % self._packet.frames == 0:
                keep_us -= self._packet.preamble_chips * grid.lock.chip_us
        region.forget_before(keep_us, self._step_us, min(keep_us, oldest_us))

    def release(self, transmitter: Transmitter) -> None:
        """Remember a transmitter whose region has ended, without its events."""
        region = transmitter.region
        del self._alive[region.id]
        region.hold(deque())
        region.positions = Places([region.latest])
        transmitter.sync = transmitter.pilot = None
        oldest_us = region.latest.t_us - _REMEMBER_US
        kept = [r for r in self._released if r.region.latest.t_us > oldest_us]
        self._released = [*kept, transmitter][-self._remembered :]

    def close(self) -> list[Transmitter]:
        """Give those that are alive, and forget all."""
        alive = list(self._alive.values())
        self._alive, self._released = {}, []
        return alive
