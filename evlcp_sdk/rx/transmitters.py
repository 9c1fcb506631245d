"""Transmitters: what is known of each region that sends, and when its frames are due.

A transmitter is numbered at its first frame, and remembered when lost from sight. Its frames are on a grid of
packets, which a lock sets. Its rows are delayed: a sensor reads them one after another, 0.1 to 0.35 us each,
those without an event in no time. All clusters of a bar change together at the preamble's edges, as they do
in the middle of every value, so that its rows wait for one another: 20 us at 50 m, 90 us at 16 m.
"""

import cmath
import math
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.alignment import DueFrame
from evlcp_sdk.rx.limits import Limits
from evlcp_sdk.rx.reading import BarState
from evlcp_sdk.rx.reflections import MAX_ROW_US, PacketAssembler
from evlcp_sdk.rx.regions import RegionTrack, TrackedRegion
from evlcp_sdk.rx.workers import AnyBarDecoder
from evlcp_sdk.values import Events, SyncLock, replace_fields

LOOKBACK_PACKETS = 2
"""Packets of events kept while there is no lock: one to find a preamble in, one to look back on."""

_REMEMBER_US = 1e6
"""How long a transmitter lost from sight is remembered: clocks 100 ppm apart drift by a chip meanwhile."""

_UNSEEN_STEPS = 5
"""Steps without a position after which a region counts as lost: it blinks in every chip otherwise."""

_CHIP_STEPS = 10
"""Steps of a chip in which the response of a block of rows is measured."""

_BLOCK_PX = 8
"""Rows of a block: they have hundreds of events in a preamble, and are read within 2 us."""

_MIN_BLOCKS = 4
"""Blocks below which a bar is too small to measure a delay by row, or for it to matter."""

_TYPICAL_ROW_US = 0.2
"""Time a row takes (sigma) before it has been measured."""

_ROW_WALK_US = 0.01
"""Change of that from packet to packet: it grows with the events in a row, as the bar does."""

_CHANCE_SIGMAS = 4.0
"""Sigmas (the root of the number of events) by which a block has to fit the preamble."""

_PLACE_SIGMA_US = 2.0
"""Least error of a block's delay, from the steps."""

_MIN_COHERENCE, _MAX_OFFSET_CHIPS = 0.5, 0.25
"""How near to one another in a chip events come, 0 to 1, for their time to be known; and how far off its
middle they may be. In bright light they are so by 0.6 to 0.8, and off by an eighth; dim ones fill chips."""


@dataclass
class PacketGrid:
    """Packets and frames by number, and the next frame to decode.

    Attributes:
        format: Lengths of a packet's parts.
        trailing_chips: Chips after a frame that are read with it (`Codebook.trailing_chips`).
        lock: The newest lock; None before the first.
        packet: Number of the lock's packet, counted from the first that may have a frame here.
        frame: Next frame to decode, counted from the first of packet 0.
        next: When it is due; None before the first lock.
    """

    format: PacketFormat
    trailing_chips: int = 0
    lock: SyncLock | None = None
    packet: int = 0
    frame: int = 0
    next: DueFrame | None = None

    def accept_lock(self, lock: SyncLock) -> bool:
        """Accept a lock on the grid, and go on with the same frame; False for a lock off the grid."""
        if self.lock is None:
            return False
        packets = (lock.packet_t_us - self.lock.packet_t_us) / (self.format.packet_chips * lock.chip_us)
        if abs(packets - round(packets)) * self.format.packet_chips >= 1:
            return False
        self.packet += round(packets)
        self.lock = lock
        self.go_to(self.frame)
        return True

    def restart(self, lock: SyncLock, earliest_us: float) -> None:
        """Begin a new grid by a lock; frames count from the packet of the first one that is complete."""
        back = math.ceil((lock.packet_t_us - earliest_us) / (self.format.packet_chips * lock.chip_us))
        self.lock, self.packet, self.frame = lock, back, 0
        self.skip_before(earliest_us)

    def skip_before(self, earliest_us: float) -> int:
        """Skip the frames that start before a time; return how many."""
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
        """Set the next frame, and its times by the newest lock."""
        lock, lengths = self.lock, self.format
        assert lock is not None
        self.frame, start_us = frame, self.start_us(frame)
        packet, index = divmod(frame, lengths.frames)
        begin, end = lengths.frame_starts[index : index + 2]
        late_us = max(lock.delay_on_us, lock.delay_off_us, 0.0) + lock.last_row_us
        end_us = start_us + (end - begin) * lock.chip_us + late_us
        self.next = DueFrame(
            number=frame,
            packet=packet,
            index=index,
            chips=end - begin,
            has_pilot=end - begin > lengths.info_chips,
            packet_us=start_us - begin * lock.chip_us,
            start_us=start_us,
            end_us=end_us,
            lock=lock,
            read_us=end_us + self.trailing_chips * lock.chip_us,
            middle_us=float(start_us) + min(end - begin, lengths.pilot_chips) // 2 * float(lock.chip_us),
        )

    def next_due(self, until_us: float) -> DueFrame | None:
        """The next frame, if all that is read with it lies before a time."""
        due = self.next
        return due if due is not None and due.read_us <= until_us else None


@dataclass(frozen=True)
class RowDelay:
    """Delay of a bar's rows.

    Attributes:
        row_us: How much later a row's events come than those of the row above, us.
        variance: Of it, us2.
    """

    row_us: float = 0.0
    variance: float = _TYPICAL_ROW_US**2

    def update(self, row_us: float, sigma_us: float) -> "RowDelay":
        """Update by a packet's measurement, as a Kalman filter does."""
        variance = self.variance + _ROW_WALK_US**2
        gain = variance / (variance + sigma_us**2)
        return RowDelay(self.row_us + gain * (row_us - self.row_us), (1 - gain) * variance)

    def apply_to(self, lock: SyncLock, height_px: float) -> SyncLock:
        """A lock with this delay, for a bar of this height."""
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
    region, (start us, events) a time step. The bar's centre is in row `centre_px`.
    """
    blocks = round(height_px / _BLOCK_PX)
    if blocks < _MIN_BLOCKS:
        return math.nan, math.nan
    reach = _CHIP_STEPS + _CHIP_STEPS // 2
    step_us = float(lock.chip_us) / _CHIP_STEPS
    top_px = centre_px - (height_px - 1) / 2 - 0.5
    start_us = np.array([lock.delay_off_us, lock.delay_on_us]) + lock.packet_t_us - reach * step_us
    counts = np.zeros((2, blocks, len(chips) * _CHIP_STEPS + 2 * reach))
    first_us, last_us = float(start_us.min()), float(start_us.max()) + counts.shape[2] * step_us
    for begin_us, e in pieces:
        if begin_us < last_us and e.t_us.size and e.t_us[-1] >= first_us:
            _kernels.count_rows(e.t_us, e.y, e.p, start_us, step_us, top_px, height_px / blocks, counts)
    rows_px = (np.arange(blocks) + 0.5) * height_px / blocks
    limits = _MIN_BLOCKS, _CHANCE_SIGMAS, _PLACE_SIGMA_US / step_us
    return _kernels.fit_row_delay(counts, chips, _CHIP_STEPS, step_us, rows_px, limits)


def retime_lock(lock: SyncLock, start_us: float, pieces: Iterable[tuple[int, Events]]) -> SyncLock:
    """Correct a lock by when in a chip a region's events come from a time on.

    In bright light events come close together in the middle of a chip; where they are off it, light or
    readout were slower before, and events come sooner now. A lock with spread or centred events is returned
    as it is.
    """
    turn, total = 0j, 0
    for _, e in pieces:
        t_us, on = e.t_us[e.t_us >= start_us], e.p[e.t_us >= start_us] > 0
        chips = (t_us - start_us - np.where(on, lock.delay_on_us, lock.delay_off_us)) / lock.chip_us
        turn += complex(np.exp(2j * math.pi * (chips - 0.5)).sum())
        total += t_us.size
    late = cmath.phase(turn) / (2 * math.pi)
    if abs(turn) < _MIN_COHERENCE * total or abs(late) <= _MAX_OFFSET_CHIPS:
        return lock
    late_us = (late - 1 if late > 0 else late) * lock.chip_us
    return replace_fields(
        lock, delay_on_us=lock.delay_on_us + late_us, delay_off_us=lock.delay_off_us + late_us
    )


@dataclass
class Transmitter:
    """A region that may be a transmitter, and what the receiver knows of it.

    Attributes:
        region: Where it is in the image, and its events.
        sync: State of its synchronization.
        state: What its frames left for the next, unless a decoder has it.
        assembler: Collects its frames.
        grid: When its frames are due.
        number: Transmitter number, None before the first frame.
        first_packet: Number of the first packet on the grid that had a frame, None before.
        row_delay: Of its bar.
        last_confirmed: The newest frame on the grid before one was rejected since the newest preamble.
        unconfirmed: Frames since then, by count: another transmitter may send.
        missed: Frames that were due and skipped, by count.
        is_behind: Frames that are due wait for the next step.
        last_tried: Number of the newest frame on the grid that was skipped as soon as it was due.
        first_lit_us: When the first frame with its light was due, camera clock, us; None before.
        step_events: Its events in the time step of its lock.
        strayed: Its newest frame was not found, or not where its region was.
        decoder: Decodes its frames and has its state; None while that is here.
    """

    region: TrackedRegion
    sync: Any
    state: BarState
    assembler: PacketAssembler
    grid: PacketGrid
    number: int | None = None
    first_packet: int | None = None
    row_delay: RowDelay = field(default_factory=RowDelay)
    last_confirmed: int = -1
    unconfirmed: Counter[str] = field(default_factory=Counter)
    missed: Counter[str] = field(default_factory=Counter)
    is_behind: bool = False
    last_tried: int = -1
    first_lit_us: float | None = None
    step_events: int = 0
    strayed: bool = True
    decoder: AnyBarDecoder | None = None

    def fetch_state(self) -> BarState:
        """Fetch the state back from the decoder, if one has it."""
        if self.decoder is not None:
            assert self.number is not None
            self.state, self.decoder = self.decoder.take_state(self.number), None
        return self.state

    def confirm_frames(self) -> None:
        """Confirm all frames before a preamble on the grid."""
        self.last_confirmed, self.unconfirmed = max(self.last_confirmed, self.grid.frame - 1), Counter()
        self.assembler.unconfirmed = False


class Transmitters:
    """The regions with what is known of them; those in sight are `alive`, by the number of their region."""

    def __init__(self, packet: PacketFormat, step_us: int, limits: Limits, trailing_chips: int) -> None:
        self._packet = packet
        self._lookback_us = LOOKBACK_PACKETS * packet.packet_us
        self._trailing_chips = trailing_chips
        self._max_remembered = limits.remembered
        self._step_us = step_us
        self.alive: dict[int, Transmitter] = {}
        self._released: list[Transmitter] = []

    def add(self, region: TrackedRegion, sync: Any, state: BarState) -> Transmitter:
        """Add a new region, with the first states of its synchronization and its frames."""
        assembler = PacketAssembler(self._packet.frames)
        transmitter = Transmitter(region, sync, state, assembler, self._new_grid())
        self.alive[region.id] = transmitter
        return transmitter

    def restart_grid(self, transmitter: Transmitter, lock: SyncLock) -> None:
        """Begin a new grid by a lock; frames start with the first complete one of the region's events."""
        region, grid = transmitter.region, transmitter.grid
        transmitter.state = transmitter.fetch_state()._replace(pilot=None)
        # Half a chip before the first event, at 0, is still within the first edge's delay.
        earliest_us = max(region.first_us, -lock.chip_us / 2)
        if grid.lock is None and self._resume_lost(transmitter, lock):
            transmitter.grid.skip_before(earliest_us)
            return
        if grid.lock is not None:
            earliest_us = max(earliest_us, grid.start_us(grid.frame))
        grid.restart(lock, earliest_us)

    def replace(self, old: Transmitter) -> Transmitter:
        """Begin another transmitter in a region, after the last confirmed frame of the old one."""
        region = old.region
        oldest_us = region.pieces[0][0] if region.pieces else 0
        region.first_us = max(region.first_us, oldest_us, int(old.grid.start_us(old.last_confirmed + 1)))
        # The LEDs may be the same: the place of the bar and its distance go on.
        new = self.add(region, old.sync, old.fetch_state()._replace(frame=-1, pilot=None))
        new.row_delay = old.row_delay
        return new

    def _resume_lost(self, transmitter: Transmitter, lock: SyncLock) -> bool:
        """Resume a transmitter that was lost from sight, if the packets are on its grid."""
        for lost in [*self.alive.values(), *self._released]:
            unseen_us = lock.packet_t_us - lost.region.latest.t_us
            if lost is transmitter or not 0 < unseen_us < _REMEMBER_US:
                continue
            if unseen_us < _UNSEEN_STEPS * self._step_us or not lost.grid.accept_lock(lock):
                continue
            transmitter.number, transmitter.first_packet = lost.number, lost.first_packet
            transmitter.state = transmitter.state._replace(distance=lost.fetch_state().distance)
            transmitter.last_confirmed = lost.last_confirmed
            lost.number, lost.first_packet, lost.last_confirmed = None, None, -1
            transmitter.assembler, lost.assembler = lost.assembler, transmitter.assembler
            transmitter.grid, lost.grid = lost.grid, self._new_grid()
            transmitter.confirm_frames()
            return True
        return False

    def _new_grid(self) -> PacketGrid:
        return PacketGrid(self._packet, self._trailing_chips)

    def find_synchronous(self, transmitter: Transmitter) -> list[Transmitter]:
        """Find others without a frame so far whose packets are at the found times.

        They are parts of one bar, or a bar and its image: of two bars, 3 % of pairs would be in step.
        """
        lock = transmitter.grid.lock
        if lock is None or transmitter.region.size_px is not None:
            return []
        period_us, found = self._packet.packet_chips * lock.chip_us, []
        for other in self.alive.values():
            other_lock = other.grid.lock
            if other is transmitter or other_lock is None or other.region.size_px is not None:
                continue
            packets = (other_lock.packet_t_us - lock.packet_t_us) / period_us
            rows_px = abs(other.region.latest.y_px - transmitter.region.latest.y_px)
            within_us = lock.chip_us / 4 + MAX_ROW_US * rows_px
            if abs(packets - round(packets)) * period_us <= within_us:
                found.append(other)
        return found

    def drop_old_events(self, transmitter: Transmitter, due: DueFrame | None, now_us: float) -> None:
        """Drop the events that no frame needs any more; the next one is `due`, if one is."""
        region = transmitter.region
        oldest_us = now_us - self._lookback_us
        if due is None:
            keep_us = oldest_us
            region.first_us = max(region.first_us, int(keep_us))
        else:
            # A later lock may move the next frame's start by a chip; the preamble before a packet's first
            # frame has yet to show the delay of the rows.
            keep_us = due.start_us - due.lock.chip_us
            if due.index == 0:
                keep_us -= self._packet.preamble_chips * due.lock.chip_us
            if transmitter.number is not None and due.number > transmitter.last_confirmed + 1:
                # Another transmitter may have begun here, which is known after its second preamble.
                oldest_us -= 2 * self._packet.preamble_chips * due.lock.chip_us
                keep_us = min(
                    keep_us, max(transmitter.grid.start_us(transmitter.last_confirmed + 1), oldest_us)
                )
        region.forget_before(keep_us, self._step_us, min(keep_us, oldest_us))

    def release(self, transmitter: Transmitter) -> None:
        """Remember a transmitter whose region has ended, without its events."""
        region = transmitter.region
        del self.alive[region.id]
        region.replace_pieces(deque())
        region.track = RegionTrack([region.latest])
        transmitter.sync, transmitter.state = None, transmitter.fetch_state()._replace(pilot=None)
        oldest_us = region.latest.t_us - _REMEMBER_US
        kept = [one for one in self._released if one.region.latest.t_us > oldest_us]
        self._released = [*kept, transmitter][-self._max_remembered :]

    def close(self) -> list[Transmitter]:
        """Forget all transmitters; return those that are alive."""
        alive = list(self.alive.values())
        self.alive, self._released = {}, []
        return alive
