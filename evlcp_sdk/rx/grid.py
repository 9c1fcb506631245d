"""Where a transmitter's packets and frames stand on the camera's clock."""

import math
from dataclasses import dataclass, field

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.values import SyncLock


@dataclass(frozen=True)
class DueFrame:
    """A frame whose events are all there.

    Attributes:
        number: Counted from the first frame of the grid's packet 0.
        packet: Number of its packet on the grid.
        index: Its number in the packet.
        chips: Its length, with its pilot if it has one.
        has_pilot: Whether it has.
        packet_us: Start of its packet's preamble, us.
        start_us: Start of its first chip, us.
        end_us: When the events of its last edge end, us.
        lock: What these times come from.
        read_us: When those of the chips after it that are read with it end, too, us.
    """

    number: int
    packet: int
    index: int
    chips: int
    has_pilot: bool
    packet_us: float
    start_us: float
    end_us: float
    lock: SyncLock
    read_us: float


@dataclass
class PacketGrid:
    """Packets and frames by number, and the next frame to decode.

    Attributes:
        format: Lengths of a packet's parts.
        chips_after: Chips after a frame that are read with it (`Codebook.chips_after`).
        lock: The newest lock; None before the first.
        packet: Number of the lock's packet, counted from the first that may have a frame here.
        frame: Next frame to decode, counted from that packet's first.
    """

    format: PacketFormat
    chips_after: int = 0
    lock: SyncLock | None = None
    packet: int = 0
    frame: int = 0
    _known: tuple[SyncLock, int, int, DueFrame] | None = field(default=None, init=False, repr=False)

    def follow(self, lock: SyncLock) -> bool:
        """Take a lock, frames going on where they are; False, and nothing taken, where it is off the grid."""
        if self.lock is None:
            return False
        apart = (lock.packet_t_us - self.lock.packet_t_us) / self._period_us(lock)
        if abs(apart - round(apart)) * self.format.packet_chips >= 1:
            return False
        self.packet += round(apart)
        self.lock = lock
        return True

    def restart(self, lock: SyncLock, earliest_us: float) -> None:
        """Take a lock that is off the grid; frames go on with the first whole one, under new numbers."""
        old, done = self.lock, self.frame
        if old is not None:
            earliest_us = max(earliest_us, self.start_us(done))
        back = math.ceil((lock.packet_t_us - earliest_us) / self._period_us(lock))
        self.lock = lock
        self.packet = back + (0 if old is None else -(-done // self.format.frames))
        self.frame = (self.packet - back) * self.format.frames
        self.skip_before(earliest_us)

    def skip_before(self, earliest_us: float) -> int:
        """Pass over the frames that start before a time; how many."""
        first = self.frame
        while self.start_us(self.frame) < earliest_us:
            self.frame += 1
        return self.frame - first

    def start_us(self, frame: int) -> float:
        """Start of a frame's first chip, us."""
        lock = self.lock
        assert lock is not None
        number, index = divmod(frame, self.format.frames)
        chips = (number - self.packet) * self.format.packet_chips + self.format.frame_start_chip(index)
        return lock.packet_t_us + chips * lock.chip_us

    @property
    def due_us(self) -> float:
        """When the next frame can be read, us; infinite before a lock."""
        return math.inf if self.lock is None else self._next(self.lock).read_us

    def due(self, until_us: float) -> DueFrame | None:
        """The next frame, if it lies before a time with all events that are read with it."""
        if self.lock is None:
            return None
        frame = self._next(self.lock)
        return frame if frame.read_us <= until_us else None

    def _next(self, lock: SyncLock) -> DueFrame:
        """The next frame; asked for again and again before it is due."""
        known = self._known
        if known is not None and known[0] is lock and known[1] == self.packet and known[2] == self.frame:
            return known[3]
        start_us = self.start_us(self.frame)
        number, index = divmod(self.frame, self.format.frames)
        has_pilot = self.format.has_pilot(index)
        chips = self.format.frame_chips if has_pilot else self.format.info_chips
        late_us = max(lock.delay_on_us, lock.delay_off_us, 0.0) + lock.last_row_us
        end_us = start_us + chips * lock.chip_us + late_us
        read_us = end_us + self.chips_after * lock.chip_us
        packet_us = start_us - self.format.frame_start_chip(index) * lock.chip_us
        frame = DueFrame(
            self.frame, number, index, chips, has_pilot, packet_us, start_us, end_us, lock, read_us
        )
        self._known = lock, self.packet, self.frame, frame
        return frame

    def _period_us(self, lock: SyncLock) -> float:
        return self.format.packet_chips * lock.chip_us
