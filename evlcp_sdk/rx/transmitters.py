"""Transmitters: what is known of each region that sends, and where its frames stand on the clock.

One is numbered at its first frame, and remembered when lost from sight. Its frames stand on a grid of
packets, which a lock sets. Its rows come late: a sensor reads them one after another, 0.1 to 0.35 us each,
those without an event in no time. All clusters of a bar change together at the preamble's edges, as they do
in the middle of every value, so that its rows wait for one another: 20 us from end to end at 50 m, 90 us at
16 m.
"""

import cmath
import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.alignment import DueFrame
from evlcp_sdk.rx.limits import Limits
from evlcp_sdk.rx.reading import Bars, BarState
from evlcp_sdk.rx.reflections import LONGEST_ROW_US, PacketAssembler
from evlcp_sdk.rx.regions import Followed, Places
from evlcp_sdk.values import Events, SyncLock, replace_fields

LOOKBACK_PACKETS = 2
"""Packets of events kept while there is no lock: one to find a preamble in, one to look back on."""

_REMEMBER_US = 1e6
"""How long a transmitter lost from sight is remembered: clocks 100 ppm apart drift by a chip in it."""

_UNSEEN_STEPS = 5
"""Steps without a position after which a region counts as lost: it blinks in every chip otherwise."""

_STEPS = 10
"""Steps of a chip in which the response of a block of rows is placed."""

_BLOCK_PX = 8
"""Rows that are looked at together: hundreds of events in a preamble, read within 2 us."""

_FEWEST_BLOCKS = 4
"""Blocks below which a bar is too small to tell, and for a delay by row to matter."""

_TYPICAL_US = 0.2
"""Time a row takes (sigma) before one has been measured."""

_WALK_US = 0.01
"""Change of it from packet to packet: with the number of events in a row, as the bar grows."""

_CHANCE_SIGMAS = 4.0
"""Sigmas (the root of the number of events) that a block must fit the preamble by."""

_PLACE_SIGMA_US = 2.0
"""Least error of a block's place, from the steps."""

_NEAR, _OFF_CHIPS = 0.5, 0.25
"""How near to one another in a chip events come, 0 to 1, that say when; and how far off its middle they may
be. Of a bar in bright light they are so by 0.6 to 0.8, and off by an eighth; in the dim they fill chips."""


@dataclass
class PacketGrid:
    """Packets and frames by number, and the next frame to decode.

    Attributes:
        format: Lengths of a packet's parts.
        chips_after: Chips after a frame that are read with it (`Codebook.chips_after`).
        lock: The newest lock; None before the first.
        packet: Number of the lock's packet, counted from the first that may have a frame here.
        frame: Next frame to decode, counted from the first of packet 0.
        next: What is known of it; None before the first lock.
    """

    format: PacketFormat
    chips_after: int = 0
    lock: SyncLock | None = None
    packet: int = 0
    frame: int = 0
    next: DueFrame | None = None

    def follow(self, lock: SyncLock) -> bool:
        """Take a lock, frames going on where they are; False, and nothing taken, where it is off the grid."""
        if self.lock is None:
            return False
        apart = (lock.packet_t_us - self.lock.packet_t_us) / (self.format.packet_chips * lock.chip_us)
        if abs(apart - round(apart)) * self.format.packet_chips >= 1:
            return False
        self.packet += round(apart)
        self.lock = lock
        self.go_to(self.frame)
        return True

    def restart(self, lock: SyncLock, earliest_us: float) -> None:
        """Take a lock whatever was before; frames are numbered from the first whole one's packet on."""
        back = math.ceil((lock.packet_t_us - earliest_us) / (self.format.packet_chips * lock.chip_us))
        self.lock, self.packet, self.frame = lock, back, 0
        self.skip_before(earliest_us)

    def skip_before(self, earliest_us: float) -> int:
        """Pass over the frames that start before a time; how many."""
        first = frame = self.frame
        while self.start_us(frame) < earliest_us:
            frame += 1
        self.go_to(frame)
        return frame - first

    def start_us(self, frame: int) -> float:
        """Start of a frame's first chip, us."""
        lock = self.lock
        assert lock is not None
        packet, index = divmod(frame, self.format.frames)
        chips = (packet - self.packet) * self.format.packet_chips + self.format.frame_starts[index]
        return lock.packet_t_us + chips * lock.chip_us

    def go_to(self, frame: int) -> None:
        """Another frame is the next one, or it stands at another time."""
        lock, form = self.lock, self.format
        assert lock is not None
        self.frame, start_us = frame, self.start_us(frame)
        packet, index = divmod(frame, form.frames)
        begin, end = form.frame_starts[index : index + 2]
        late_us = max(lock.delay_on_us, lock.delay_off_us, 0.0) + lock.last_row_us
        end_us = start_us + (end - begin) * lock.chip_us + late_us
        self.next = DueFrame(
            number=frame,
            packet=packet,
            index=index,
            chips=end - begin,
            has_pilot=end - begin > form.info_chips,
            packet_us=start_us - begin * lock.chip_us,
            start_us=start_us,
            end_us=end_us,
            lock=lock,
            read_us=end_us + self.chips_after * lock.chip_us,
            middle_us=float(start_us) + min(end - begin, form.pilot_chips) // 2 * float(lock.chip_us),
        )

    def due(self, until_us: float) -> DueFrame | None:
        """The next frame, if it lies before a time with all that is read with it."""
        known = self.next
        return known if known is not None and known.read_us <= until_us else None


@dataclass(frozen=True)
class RowDelay:
    """What is known of a bar's rows.

    Attributes:
        row_us: How much later a row's events come than those of the row above, us.
        variance: Of it, us2.
    """

    row_us: float = 0.0
    variance: float = _TYPICAL_US**2

    def measured(self, row_us: float, sigma_us: float) -> "RowDelay":
        """Take a packet's measurement, as a Kalman filter does."""
        variance = self.variance + _WALK_US**2
        gain = variance / (variance + sigma_us**2)
        return RowDelay(self.row_us + gain * (row_us - self.row_us), (1 - gain) * variance)

    def delayed(self, lock: SyncLock, height_px: float) -> SyncLock:
        """A lock with this delay, of a bar of some height."""
        return replace_fields(lock, row_us=self.row_us, last_row_us=abs(self.row_us) * height_px / 2)


def measure_row_delay(
    chips: NDArray[np.float64],
    lock: SyncLock,
    pieces: Iterable[tuple[int, Events]],
    centre_px: float,
    height_px: float,
) -> tuple[float, float]:
    """Delay from one row to the next in a preamble, and its sigma, us; NaN where too few rows show it.

    `chips` are those of the preamble, -1 and +1, float64 (P,); its events are among the `pieces` of the
    region, (start us, events) a time step. The bar's centre lies in row `centre_px`.
    """
    blocks = round(height_px / _BLOCK_PX)
    if blocks < _FEWEST_BLOCKS:
        return math.nan, math.nan
    reach = _STEPS + _STEPS // 2
    step_us = float(lock.chip_us) / _STEPS
    top_px = centre_px - (height_px - 1) / 2 - 0.5
    start_us = np.array([lock.delay_off_us, lock.delay_on_us]) + lock.packet_t_us - reach * step_us
    counts = np.zeros((2, blocks, len(chips) * _STEPS + 2 * reach))
    first_us, last_us = float(start_us.min()), float(start_us.max()) + counts.shape[2] * step_us
    for begin_us, e in pieces:
        if begin_us < last_us and e.t_us.size and e.t_us[-1] >= first_us:
            _kernels.count_rows(e.t_us, e.y, e.p, start_us, step_us, top_px, height_px / blocks, counts)
    rows_px = (np.arange(blocks) + 0.5) * height_px / blocks
    limits = _FEWEST_BLOCKS, _CHANCE_SIGMAS, _PLACE_SIGMA_US / step_us
    return _kernels.fit_row_delay(counts, chips, _STEPS, step_us, rows_px, limits)


def retime(lock: SyncLock, start_us: float, pieces: Iterable[tuple[int, Events]]) -> SyncLock:
    """A lock by when in a chip a region's events come from a time on; the same where they come in none.

    Where they are near one another, in bright light, they are in the middle of a chip; where they are off it,
    light or readout were slower before, and they come sooner now.
    """
    turn, total = 0j, 0
    for _, e in pieces:
        t_us, on = e.t_us[e.t_us >= start_us], e.p[e.t_us >= start_us] > 0
        chips = (t_us - start_us - np.where(on, lock.delay_on_us, lock.delay_off_us)) / lock.chip_us
        turn += complex(np.exp(2j * math.pi * (chips - 0.5)).sum())
        total += t_us.size
    late = cmath.phase(turn) / (2 * math.pi)
    if abs(turn) < _NEAR * total or abs(late) <= _OFF_CHIPS:
        return lock
    late_us = (late - 1 if late > 0 else late) * lock.chip_us
    return replace_fields(
        lock, delay_on_us=lock.delay_on_us + late_us, delay_off_us=lock.delay_off_us + late_us
    )


@dataclass
class Transmitter:
    """What the receiver knows of one region.

    Attributes:
        region: Where it is in the image, and its events.
        sync: State of its synchronization.
        state: What its frames left for the next, unless a decoder has it.
        packets: Collects its frames.
        grid: Where its frames stand on the clock.
        number: Transmitter number, None before the first frame.
        first: Number of the first packet on the grid that had a frame, None before.
        rows: How late the rows of its bar are read.
        given: Number of the newest frame on the grid that was given before any was rejected since the
            newest preamble on it.
        doubtful: Frames since the first that was rejected since then, by what they count as: maybe another
            transmitter sends.
        missed: Frames due that were not given, by the count that they belong to.
        behind: Frames that are due wait for the next step.
        tried: Number of the newest frame on the grid that was not given as soon as it was due.
        lit_us: When the first frame was due in which its light was there, camera clock, us; None before.
        step_events: How many of its events were in the time step in which its lock came.
        strayed: Its newest frame was not found, or not where its region was.
        decoder: Who does so, and has its state.
    """

    region: Followed
    sync: Any
    state: BarState
    packets: PacketAssembler
    grid: PacketGrid
    number: int | None = None
    first: int | None = None
    rows: RowDelay = field(default_factory=RowDelay)
    given: int = -1
    doubtful: Counter[str] = field(default_factory=Counter)
    missed: Counter[str] = field(default_factory=Counter)
    behind: bool = False
    tried: int = -1
    lit_us: float | None = None
    step_events: int = 0
    strayed: bool = True
    decoder: Bars | None = None

    def fetch_state(self) -> BarState:
        """Its state, taken from where its frames were decoded."""
        if self.decoder is not None:
            assert self.number is not None
            self.state, self.decoder = self.decoder.take(self.number), None
        return self.state

    def settle(self) -> None:
        """Take a preamble on the grid: the frames before it are its own."""
        self.given, self.doubtful = max(self.given, self.grid.frame - 1), Counter()
        self.packets.in_doubt = False


class Transmitters:
    """Regions with what is known of them; those in sight are `alive`, by the number of their region."""

    def __init__(
        self,
        packet: PacketFormat,
        step_us: int,
        limits: Limits,
        numbers: Iterator[int],
        chips_after: int,
    ) -> None:
        self._packet = packet
        self._lookback_us = LOOKBACK_PACKETS * packet.packet_chips * packet.chip_us
        self._chips_after = chips_after
        self._remembered = limits.remembered
        self._step_us = step_us
        self.alive: dict[int, Transmitter] = {}
        self._released: list[Transmitter] = []
        self._numbers = numbers

    def open(self, region: Followed, sync: Any, state: BarState) -> Transmitter:
        """Take a new region, with the first states of its synchronization and its frames."""
        packets, grid = PacketAssembler(self._packet.frames), self._grid()
        transmitter = Transmitter(region, sync, state, packets, grid)
        self.alive[region.id] = transmitter
        return transmitter

    def adopt(self, transmitter: Transmitter, lock: SyncLock) -> None:
        """Take a lock that is off the grid; frames start with the first whole one of the region's events."""
        region, grid = transmitter.region, transmitter.grid
        transmitter.state = transmitter.fetch_state()._replace(pilot=None)
        # Half a chip before the first event, at 0, is still within the first edge's delay.
        earliest_us = max(region.first_us, -lock.chip_us / 2)
        if grid.lock is None and self._inherit(transmitter, lock):
            transmitter.grid.skip_before(earliest_us)
            return
        if grid.lock is not None:
            earliest_us = max(earliest_us, grid.start_us(grid.frame))
        grid.restart(lock, earliest_us)

    def succeed(self, old: Transmitter) -> Transmitter:
        """Another transmitter in a region, after the last frame that is surely of the one before."""
        region = old.region
        oldest_us = region.pieces[0][0] if region.pieces else 0
        region.first_us = max(region.first_us, oldest_us, int(old.grid.start_us(old.given + 1)))
        # The same LEDs, as far as one knows: where the bar is does not begin anew.
        new = self.open(region, old.sync, old.fetch_state()._replace(frame=-1, pilot=None))
        new.rows = old.rows
        return new

    def number(self, transmitter: Transmitter) -> int:
        """Its number: the next one, if it has none."""
        if transmitter.number is None:
            transmitter.number = next(self._numbers)
        return transmitter.number

    def _inherit(self, transmitter: Transmitter, lock: SyncLock) -> bool:
        """Go on as a transmitter that was lost from sight, if the packets stand on its grid."""
        for lost in [*self.alive.values(), *self._released]:
            unseen_us = lock.packet_t_us - lost.region.latest.t_us
            if lost is transmitter or not 0 < unseen_us < _REMEMBER_US:
                continue
            if unseen_us < _UNSEEN_STEPS * self._step_us or not lost.grid.follow(lock):
                continue
            transmitter.number, transmitter.first = lost.number, lost.first
            transmitter.state = transmitter.state._replace(distance=lost.fetch_state().distance)
            transmitter.given = lost.given
            lost.number, lost.first, lost.given = None, None, -1
            transmitter.packets, lost.packets = lost.packets, transmitter.packets
            transmitter.grid, lost.grid = lost.grid, self._grid()
            transmitter.settle()
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
        for other in self.alive.values():
            heard = other.grid.lock
            if other is transmitter or heard is None or other.region.size_px is not None:
                continue
            apart = (heard.packet_t_us - lock.packet_t_us) / period_us
            rows_px = abs(other.region.latest.y_px - transmitter.region.latest.y_px)
            within_us = lock.chip_us / 4 + LONGEST_ROW_US * rows_px
            if abs(apart - round(apart)) * period_us <= within_us:
                same.append(other)
        return same

    def forget(self, transmitter: Transmitter, due: DueFrame | None, now_us: float) -> None:
        """Drop the events that no frame can need any more: the next one is `due`, if one is."""
        region = transmitter.region
        oldest_us = now_us - self._lookback_us
        if due is None:
            keep_us = oldest_us
            region.first_us = max(region.first_us, int(keep_us))
        else:
            # A later lock may move the next frame's start by a chip; the preamble before a packet's first
            # frame has yet to say how late the rows are.
            keep_us = due.start_us - due.lock.chip_us
            if due.index == 0:
                keep_us -= self._packet.preamble_chips * due.lock.chip_us
            if transmitter.number is not None and due.number > transmitter.given + 1:
                # They may be another's that has begun here, which its second preamble tells when it is over.
                oldest_us -= 2 * self._packet.preamble_chips * due.lock.chip_us
                keep_us = min(keep_us, max(transmitter.grid.start_us(transmitter.given + 1), oldest_us))
        region.forget_before(keep_us, self._step_us, min(keep_us, oldest_us))

    def release(self, transmitter: Transmitter) -> None:
        """Remember a transmitter whose region has ended, without its events."""
        region = transmitter.region
        del self.alive[region.id]
        region.hold(deque())
        region.positions = Places([region.latest])
        transmitter.sync, transmitter.state = None, transmitter.fetch_state()._replace(pilot=None)
        oldest_us = region.latest.t_us - _REMEMBER_US
        kept = [r for r in self._released if r.region.latest.t_us > oldest_us]
        self._released = [*kept, transmitter][-self._remembered :]

    def close(self) -> list[Transmitter]:
        """Give those that are alive, and forget all."""
        alive = list(self.alive.values())
        self.alive, self._released = {}, []
        return alive
