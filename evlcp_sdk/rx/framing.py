"""The built-in framing: packets of a preamble and frames, from the events of regions to frames."""

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.clock import TimeStep
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import Synchronizer
from evlcp_sdk.rx.alignment import AlignedFrame, DueFrame
from evlcp_sdk.rx.framer import Framer, StreamContext, note_lit
from evlcp_sdk.rx.guard import Guard, compiled
from evlcp_sdk.rx.reading import BarDecoder, Bars, FrameDecoder, FrameJob, FrameResult
from evlcp_sdk.rx.reflections import FrameDetection, ReflectionQueue
from evlcp_sdk.rx.regions import (
    MARGIN_PX,
    SAME_PX,
    STILL,
    Followed,
    RegionFollower,
    RegionTracker,
    ShownPlace,
    same_place,
)
from evlcp_sdk.rx.transmitters import LOOKBACK_PACKETS, Transmitter, Transmitters, measure_row_delay, retime
from evlcp_sdk.values import Events, Frame, Region, SyncLock, replace_fields

_TAIL_CHIPS = 0.5
"""A frame is whole if the stream goes on for this long after its last edge's events: some come later."""

_APPLIED_STEPS = 2
"""Steps after which a frame of a bar that is followed well sets its region right, counts and is given,
whoever decodes it: the next one of its bar is due by then, and more would only make it later."""

_MOST_OLD = 2
"""Frames decoded in a step beyond those that end in one: all that came before a first lock would take as long
as ten steps, and other transmitters would wait."""

_LOOKS = 3
"""Looks at a region's first frame: at what was found of a bar, at the whole of it, and once more, as few
clusters place it less well than all. Looks at another one whose region had strayed, too."""

_DIMMED = 1.5
"""Events of a step with a preamble, over those of another, from which on it is looked when in a chip these
come: a bar's data alone change them by a third at the most."""

_DARK = 0.25
"""Share of a pilot's events below which a bar that was seen before is out of sight, or hidden."""

_MOST_ENDED, _PART_PX = 64, 16.0
"""Regions that ended without a frame that are remembered, and how far outside of a bar they may have been
parts of it: pieces of a near bar are followed before the whole of it is known, and the image moves."""

_COUNTS = (
    "events_in_regions",
    "regions_opened",
    "regions_released",
    "restarts",
    "locks",
    "preambles",
    "frames",
    "frames_rejected",
    "frames_of_parts",
    "frames_dark",
    "frames_unread",
    "frames_askew",
    "frames_flooded",
    "frames_cut",
    "frames_not_ranged",
)


class Skipped(StrEnum):
    """Why a frame that was due is not given; its value is the count that it belongs to."""

    DARK = "frames_dark"
    """A bar that was seen before has few events by now."""
    REJECTED = "frames_rejected"
    """It does not show its clusters where the bar has them."""
    UNREAD = "frames_unread"
    """It shows them, and no symbol that is sure."""


@dataclass(frozen=True)
class SkippedFrame:
    """A frame that was due and is not given: what the stage `skipped` announces.

    Attributes:
        transmitter: Number of the transmitter; None before its first frame.
        packet: Number of the packet since the transmitter's first; None before that.
        frame: Number of the frame in its packet.
        t_us: Start of its first chip on the camera's clock, us.
        why: The count that it belongs to, such as `frames_dark`.
        link: Name of the link, of a receiver of several.
    """

    transmitter: int | None
    packet: int | None
    frame: int
    t_us: float
    why: str
    link: str


@dataclass(frozen=True, eq=False)
class PendingFrame:
    """A frame that is decoded by itself, and not applied.

    Attributes:
        transmitter: Whose it is.
        due: Which frame.
        step_us: Start of the time step in which it was due, us.
        ranged: Its distance is measured.
        answer: Gives what it says, once that is known; None where it is to be decoded again, here.
        frame: The same for those who listen, if it was told already.
    """

    transmitter: Transmitter
    due: DueFrame
    step_us: int
    ranged: bool
    answer: Callable[[], FrameResult | None]
    frame: Frame | None


class PacketFraming(Framer):
    """Finds the packets of the regions of a stream, decodes their frames, and sets the regions right by them.

    The `follower` is the same as the regions where frames correct them; None where they stay as a detector
    has them. Decoded frames go to the `queue`. Frames of a bar that its region follows well are decoded by
    themselves, and applied a fixed number of time steps later: so it is all the same who decodes them.
    """

    cut_by_the_end = True

    def __init__(
        self,
        link: Link,
        name: str,
        stream: StreamContext,
        decoder: FrameDecoder,
        regions: RegionTracker,
        follower: RegionFollower | None,
        queue: ReflectionQueue,
        on_frame: Callable[[Frame], None] | None,
    ) -> None:
        self._attitude_at = stream.attitude_at
        self._packet = link.packet
        self._step_us, self._fade_us = link.regions.step_us, link.regions.fade_us
        self._tail_us = _TAIL_CHIPS * link.packet.chip_us
        self._clock = stream.clock
        self._announcer, self._on_frame = stream.announcer, on_frame
        self._sync_guard = Guard(link, "synchronization")
        self._synchronizer: Synchronizer = compiled(
            link, "synchronization", link.codebook, link.packet, methods=("init", "step")
        )
        self._decoder, self._aligner = decoder, decoder.aligner
        self._bars: Sequence[Bars] = [BarDecoder(decoder)] if stream.bars is None else stream.bars(name)
        self._pending: deque[PendingFrame] = deque()
        self._regions, self._follower = regions, follower
        self._name = name
        self._transmitters = Transmitters(
            link.packet, self._step_us, stream.limits, stream.numbers, link.codebook.chips_after
        )
        self._preamble = 2 * link.codebook.preamble.astype(np.float64) - 1
        self._reflections = queue.reflections
        self._queue = queue
        self._joined: set[int] = set()
        # Number, place and what was missed.
        self._ended: deque[tuple[int | None, tuple[float, float], Counter[str]]] = deque(maxlen=_MOST_ENDED)
        self._due: deque[Followed] = deque()
        # Frames that end in one step, and how long it takes to decode those before a first lock.
        per_step = self._step_us / (link.packet.info_chips * link.packet.chip_us)
        self._most_due = math.ceil(per_step) + _MOST_OLD
        caught_up = math.ceil(LOOKBACK_PACKETS * link.packet.frames / (self._most_due - per_step))
        packets_us = LOOKBACK_PACKETS * link.packet.packet_chips * link.packet.chip_us
        self.patience_us = packets_us + (caught_up + _APPLIED_STEPS) * self._step_us
        self.counts = dict.fromkeys(_COUNTS, 0)
        self.lit: dict[int, tuple[float, float]] = {}
        self.ranging_every = 1
        self._measurable = 0
        self._now_us = 0

    def catch_up(self, start_us: int) -> None:
        """Apply the frames whose time it is at the start of a time step."""
        self._now_us = start_us
        self._joined.clear()
        while self._pending and self._pending[0].step_us + _APPLIED_STEPS * self._step_us <= start_us:
            self._apply(self._pending.popleft())

    def step(self, regions: list[Followed], step: TimeStep) -> None:
        """Receive and decode what the regions of a time step send."""
        self._joined.clear()
        # A frame may show another image of its bar: that is a region, too, and received at once.
        self._due = deque(regions)
        while self._due:
            region = self._due.popleft()
            if region.id in self._joined:
                continue
            transmitter = self._hear(region, step)
            until_us = step.end_us - self._tail_us
            self._decode_due(transmitter, until_us, self._most_due)
            transmitter.behind = transmitter.grid.due(until_us) is not None
            if region.id in self._joined:
                continue
            waiting = self._waiting(transmitter)
            due = waiting[0].due if waiting else transmitter.grid.next
            self._transmitters.forget(transmitter, due, step.end_us)
            if region.released:
                self._end(transmitter, step.end_us)
                # Its last frames may have shown that it is a part of another.
                if region.id not in self._joined:
                    self.counts["regions_released"] += 1
                    self._transmitters.release(transmitter)
        self._find_due()

    def _find_due(self) -> None:
        """Find out when the next frame is due whose region is set right by its frames."""
        due_us = math.inf
        for one in self._transmitters.alive.values() if self._follower is not None else ():
            due = one.grid.next
            if due is not None and due.read_us < due_us and _in_time(one):
                due_us = due.read_us
        self.due_us = due_us + self._tail_us

    def ahead(self, step: TimeStep) -> None:
        """Decode the frames that are due in the part so far of a time step."""
        if self._follower is None:
            return
        self.catch_up(step.start_us)
        self._due.clear()
        until_us = step.end_us - self._tail_us
        alive = self._transmitters.alive.values()
        due = [one for one in alive if one.grid.due(until_us) is not None and _in_time(one)]
        meant = {one.region.id for one in due}
        self._follower.begin_part(step.start_us, step.end_us, step.events, meant)
        for transmitter in due:
            self._decode_ahead(transmitter, until_us)
        self._follower.end_part(step.end_us)
        self._find_due()

    def number_of(self, region: Followed) -> int | None:
        """Number of a region's transmitter; None before its first frame."""
        transmitter = self._transmitters.alive.get(region.id)
        return None if transmitter is None else transmitter.number

    def discard(self, *, place: Region | None = None, number: int | None = None) -> int:
        """Take frames missed where another link's packet was, or of a number, out of the counts; how many."""
        missed: Counter[str] = Counter()
        for one in self._transmitters.alive.values():
            if one.number == number if place is None else same_place(one.region.latest, place):
                missed, one.missed = missed + one.missed, Counter()
        for ended in list(self._ended):
            known, (x, y), its = ended
            if place is not None and known is None:
                found = same_place(replace_fields(place, x_px=x, y_px=y), place)
            else:
                found = place is None and known == number
            if found:
                self._ended.remove(ended)
                missed += its
        return self._discarded(missed)

    def _discarded(self, missed: Counter[str]) -> int:
        for name, many in missed.items():
            self.counts[name] -= many
        return missed.total()

    def close(self) -> None:
        """End the stream: decode what the regions still show."""
        for transmitter in self._transmitters.close():
            self._end(transmitter, self._clock.last_us)

    def _hear(self, region: Followed, step: TimeStep) -> Transmitter:
        """Listen to a region's events of a time step, or to all that it has if it is new."""
        transmitter, guard = self._transmitters.alive.get(region.id), self._sync_guard
        pieces: Iterable[tuple[int, Events]] = region.pieces if transmitter is None else (region.pieces[-1],)
        if transmitter is None:
            self.counts["regions_opened"] += 1
            with guard:
                state = self._synchronizer.init()
            transmitter = self._transmitters.open(region, state, self._decoder.first_state())
        for start_us, events in pieces:
            self.counts["events_in_regions"] += events.t_us.size
            until_us = min(start_us + self._step_us, step.end_us)
            if self._announcer is not None:
                self._announcer.start()
            try:
                transmitter.sync, locks = self._synchronizer.step(
                    transmitter.sync, events.t_us, events.p, until_us
                )
            except (Exception, SystemExit) as fault:
                guard.blame(fault)
                raise
            if guard.checks:
                guard.expect_locks(locks, until_us, self._packet)
            for heard in locks:
                if self._announcer is not None:
                    self._announcer.lap("synchronization", heard)
                self.counts["preambles"] += 1
                lock = self._late_rows(transmitter, heard)
                transmitter.step_events = events.t_us.size
                if transmitter.grid.follow(lock):
                    transmitter.settle()
                    continue
                self.counts["locks"] += 1
                if transmitter.number is not None:
                    transmitter = self._succeed(transmitter)
                self._transmitters.adopt(transmitter, lock)
        return transmitter

    def _succeed(self, old: Transmitter) -> Transmitter:
        """End a transmitter that another is in the place of; what was read since, or rejected, is not its."""
        self._flush(old)
        self.counts["restarts"] += 1
        self._discarded(old.doubtful)
        old.missed[Skipped.REJECTED] -= old.doubtful[Skipped.REJECTED]
        packet, frame = divmod(old.given, self._packet.frames)
        self.counts["frames"] -= self._queue.end_after(old.packets, (packet - (old.first or 0), frame))
        self._ended.append((old.number, old.region.positions.place_at(old.region.latest.t_us), old.missed))
        return self._transmitters.succeed(old)

    def _late_rows(self, transmitter: Transmitter, lock: SyncLock) -> SyncLock:
        """A lock with what its preamble, and those before, say of the rows of its bar."""
        region = transmitter.region
        middle_us = lock.packet_t_us + self._packet.preamble_chips / 2 * lock.chip_us
        _, y_px = region.positions.place_at(middle_us)
        _, height_px = region.positions.size_at(middle_us)
        row_us, sigma_us = measure_row_delay(self._preamble, lock, region.pieces, y_px, height_px)
        if math.isfinite(row_us):
            transmitter.rows = transmitter.rows.measured(row_us, sigma_us)
        return transmitter.rows.delayed(lock, height_px)

    def _decode_ahead(self, transmitter: Transmitter, until_us: float) -> None:
        """Decode the next frame before its time step is over.

        One that cannot be given is left to the step's end: by then a lock may say that the transmitter has
        begun anew. So is one that others wait before.
        """
        due = transmitter.grid.due(until_us)
        if due is None or transmitter.region.id in self._joined:
            return
        if self._is_steady(transmitter):
            self._hand_over(transmitter, due)
            return
        if self._waiting(transmitter):
            return
        state = transmitter.fetch_state()
        found = self._decode(transmitter, due)
        if isinstance(found, Skipped):
            transmitter.state, transmitter.tried, transmitter.strayed = state, due.number, True
            return
        self._take(transmitter, due, found)

    def _decode_due(self, transmitter: Transmitter, until_us: float, most: float = math.inf) -> None:
        """Decode the frames that lie before a time with the events after their last edge, so many at most."""
        cut_us = transmitter.region.cut_us
        if cut_us is not None and transmitter.grid.lock is not None:
            self.counts["frames_cut"] += transmitter.grid.skip_before(cut_us)
        while most > 0 and (due := transmitter.grid.due(until_us)) is not None:
            most -= 1
            if until_us - due.read_us <= self._step_us and self._is_steady(transmitter):
                self._hand_over(transmitter, due)
                continue
            if self._waiting(transmitter):
                self._flush(transmitter)
                continue
            transmitter.fetch_state()
            found = self._decode(transmitter, due)
            if found is Skipped.REJECTED and self._put_together(transmitter):
                continue
            if transmitter.region.id in self._joined:
                # Another region shows the frame.
                transmitter.grid.go_to(due.number + 1)
                return
            if isinstance(found, Skipped):
                transmitter.strayed = True
                transmitter.grid.go_to(due.number + 1)
                if found is not Skipped.DARK:
                    self._lit_in(transmitter, self._clock.camera_us(due.start_us))
                    transmitter.missed[found] += 1
                    known = transmitter.number is not None and due.number > transmitter.given
                    if found is Skipped.REJECTED and known:
                        transmitter.doubtful[found] += 1
                        transmitter.packets.in_doubt = True
                self.counts[found] += 1
                self._announce_skipped(transmitter, due, found)
                continue
            self._take(transmitter, due, found)

    def _announce_skipped(self, transmitter: Transmitter, due: DueFrame, why: Skipped) -> None:
        if self._announcer is not None:
            packet = None if transmitter.first is None else due.packet - transmitter.first
            t_us = self._clock.camera_us(due.start_us)
            skipped = SkippedFrame(transmitter.number, packet, due.index, t_us, why.value, self._name)
            self._announcer.lap("skipped", skipped)

    def _take(self, transmitter: Transmitter, due: DueFrame, found: FrameDetection) -> None:
        """Hand a frame on."""
        if transmitter.grid.frame <= due.number:
            transmitter.grid.go_to(due.number + 1)
        if not transmitter.doubtful:
            transmitter.given = max(due.number, transmitter.given)
        self._lit_in(transmitter, found.frame.t_us)
        self.counts["frames"] += 1
        self._queue.add(transmitter.packets, found)

    def _lit_in(self, transmitter: Transmitter, start_us: float) -> None:
        """Note that a transmitter's light is there in a frame that is due, by its start, camera clock, us."""
        if transmitter.lit_us is None:
            transmitter.lit_us = start_us
        if transmitter.number is not None:
            note_lit(self.lit, transmitter.number, transmitter.lit_us, start_us)

    def _decode(self, transmitter: Transmitter, due: DueFrame) -> FrameDetection | Skipped:
        """Read a frame, or say why it is not given."""
        if self._announcer is not None:
            self._announcer.start()
        due = self._retimed(transmitter, due)
        aligned = self._align(transmitter, due)
        if aligned is None:
            return Skipped.DARK if _went_dark(transmitter, due, self._packet) else Skipped.REJECTED
        if transmitter.number is None and self._reflections.shown(due.start_us, aligned.centre_px):
            # The same bar once more: where the first region was then is not known as well as what it showed.
            self._regions.drop(transmitter.region)
            self.let_go(transmitter.region)
            return Skipped.REJECTED
        attitude = self._attitude_at(self._clock.camera_us(due.middle_us)) if due.has_pilot else None
        ranged = due.has_pilot and self._is_ranged()
        known = transmitter.number is not None
        found, transmitter.state = self._decoder.read(
            aligned, due, transmitter.state, attitude, ranged=ranged, known=known
        )
        self.counts["frames_not_ranged"] += due.has_pilot and not ranged
        if not found.given:
            self._note(transmitter, "frames_askew", found.reading.sight.askew)
            return Skipped.UNREAD
        if not known:
            self._find_parts(transmitter.region, due.start_us)
        self._transmitters.number(transmitter)
        frame = self._frame(transmitter, due, found)
        self._tell(frame)
        return self._detection(transmitter, due, found, frame)

    def _frame(self, transmitter: Transmitter, due: DueFrame, found: FrameResult) -> Frame:
        """What is given of a frame."""
        reading = found.reading
        if transmitter.first is None:
            transmitter.first = due.packet
        assert transmitter.number is not None
        return Frame(
            transmitter=transmitter.number,
            packet=due.packet - transmitter.first,
            frame=due.index,
            t_us=self._clock.camera_us(due.start_us),
            soft=reading.soft,
            range=reading.distance,
            filtered=found.filtered,
            x_px=reading.centre_px[0],
            y_px=reading.centre_px[1],
            points_px=reading.points_px,
            points_sigma_px=reading.sigma_px,
            points_flank_px=reading.flank_px,
            points_t_us=self._clock.camera_us(due.middle_us),
            echo_of=self._reflections.echo_of(transmitter.number),
            link=self._name,
        )

    def _tell(self, frame: Frame) -> None:
        if self._on_frame is not None:
            self._on_frame(frame)
        if self._announcer is not None:
            self._announcer.frame(frame)

    def _detection(
        self, transmitter: Transmitter, due: DueFrame, found: FrameResult, frame: Frame
    ) -> FrameDetection:
        """A frame with what tells a bar from its reflection; counts what it notes."""
        self._note(transmitter, "frames_askew", found.reading.sight.askew)
        self._note(transmitter, "frames_flooded", found.reading.flooded)
        times = due.start_us, due.end_us, due.packet_us, due.lock.chip_us
        return FrameDetection(frame, *times, found.cells, found.seen, found.mirrored, found.reading.spread)

    def _is_steady(self, transmitter: Transmitter) -> bool:
        """Whether frames of a transmitter can be decoded by themselves.

        What sweeps over the image is a region off by more than its seam soon: each frame sets it right.
        """
        still = transmitter.region.speed == STILL and self._follower is not None
        return still and not transmitter.strayed and transmitter.number is not None

    def _hand_over(self, transmitter: Transmitter, due: DueFrame) -> None:
        """Have a frame decoded by itself."""
        if self._announcer is not None:
            self._announcer.start()
        assert transmitter.number is not None
        if transmitter.decoder is None:
            transmitter.decoder = min(self._bars, key=len)
            transmitter.decoder.put(transmitter.number, transmitter.state)
        due = self._retimed(transmitter, due)
        ranged = due.has_pilot and self._is_ranged()
        middle_us = self._clock.camera_us(due.middle_us)
        attitude = self._attitude_at(middle_us) if due.has_pilot else None
        job = FrameJob(transmitter.region, due, attitude, ranged)
        answer = transmitter.decoder.decode(transmitter.number, job)
        frame = None
        if transmitter.decoder.at_once and (found := answer()) is not None:
            frame = self._frame(transmitter, due, found)
            self._tell(frame)
        self._pending.append(PendingFrame(transmitter, due, self._now_us, ranged, answer, frame))
        transmitter.grid.go_to(due.number + 1)

    def _waiting(self, transmitter: Transmitter) -> list[PendingFrame]:
        """Frames of a transmitter that are decoded, and not applied."""
        return [one for one in self._pending if one.transmitter is transmitter]

    def _flush(self, transmitter: Transmitter) -> None:
        """Apply all frames of a transmitter that are decoded."""
        while waiting := self._waiting(transmitter):
            self._pending.remove(waiting[0])
            self._apply(waiting[0])

    def _apply(self, pending: PendingFrame) -> None:
        """Let a frame that was decoded by itself set its region right, and hand it on."""
        transmitter, due, found = pending.transmitter, pending.due, pending.answer()
        if found is None:
            # It, and those after it, are decoded here: with what is around.
            for one in self._waiting(transmitter):
                one.answer()
                self._pending.remove(one)
            transmitter.fetch_state()
            transmitter.strayed = True
            transmitter.grid.go_to(due.number)
            return
        region, shown, follower = transmitter.region, found.shown, self._follower
        assert follower is not None
        if shown is not None and not region.released:
            follower.shape(region, shown)
            if not self._join(region, shown.t_us):
                return
            self._open_beside(region, shown)
        frame = self._frame(transmitter, due, found) if pending.frame is None else pending.frame
        if pending.frame is None:
            self._tell(frame)
        self.counts["frames_not_ranged"] += due.has_pilot and not pending.ranged
        self._take(transmitter, due, self._detection(transmitter, due, found, frame))

    def _open_beside(self, region: Followed, shown: ShownPlace) -> None:
        """Open regions for other images of a bar that are not followed yet."""
        assert self._follower is not None
        for centre_px, size_px in shown.others:
            known = any(one.covers(shown.t_us, centre_px) for one in self._regions.alive)
            if not known and self._follower.has_room():
                self._due.append(self._follower.beside(region, shown.t_us, centre_px, size_px))

    def _retimed(self, transmitter: Transmitter, due: DueFrame) -> DueFrame:
        """A frame that is due, timed anew where light has changed since the preamble."""
        grid, region, fewest = transmitter.grid, transmitter.region, transmitter.step_events
        inside = []
        for piece in region.pieces:
            if due.start_us < piece[0] + self._step_us <= due.end_us:
                inside.append(piece)
                fewest = min(fewest, piece[1].t_us.size)
        if region.size_px is None or _DIMMED * fewest > transmitter.step_events:
            return due
        lock = retime(due.lock, due.start_us, inside)
        if lock is due.lock:
            return due
        transmitter.step_events, grid.lock = fewest, lock
        grid.go_to(due.number)
        assert grid.next is not None
        return grid.next

    def _note(self, transmitter: Transmitter, name: str, many: int) -> None:
        """Count something of a frame, as doubtful as the frame is."""
        self.counts[name] += many
        if transmitter.doubtful:
            transmitter.doubtful[name] += many

    def _is_ranged(self) -> bool:
        """Whether the turn of a frame with a pilot has come to be ranged."""
        self._measurable += 1
        return self._measurable % self.ranging_every == 0

    def _align(self, transmitter: Transmitter, due: DueFrame) -> AlignedFrame | None:
        """Look at a frame; set its region right by it, join what is of the same bar, open what is another."""
        region, follower = transmitter.region, self._follower
        seen: list[ShownPlace] = []
        most_px = 0.0
        for _ in range(_LOOKS):
            whole = region.size_px is not None
            aligned = self._aligner.align(region, due, transmitter.state.pilot)
            if aligned is None or not due.has_pilot:
                break
            transmitter.state = transmitter.state._replace(pilot=aligned.pilot)
            shown = self._decoder.shown_place(aligned)
            if follower is None:
                region.size_px = shown.size_px
                break
            # What the first look shows beside the bar is out of the second one's sight.
            seen.append(shown)
            off_px = follower.shape(region, shown)
            most_px = max(most_px, off_px)
            if off_px > 0 and not self._join(region, shown.t_us):
                return None
            # Within half of the seam, motion in the frame is known as well as by its next look.
            if off_px == 0 or (whole and off_px <= MARGIN_PX / 2):
                break
            follower.gather(region, due.start_us, due.read_us)
        if follower is not None and most_px > MARGIN_PX / 2:
            follower.gather(region)
        if due.has_pilot:
            transmitter.strayed = most_px > MARGIN_PX / 2
        for shown in seen if aligned is not None else ():
            self._open_beside(region, shown)
        return aligned

    def _join(self, region: Followed, t_us: float) -> bool:
        """Let other regions of the bar seen at a time go; False if this one goes, as the other is known."""
        for other in list(self._regions.alive):
            if other is region or not region.holds(other, t_us, SAME_PX):
                continue
            gone = region if other.size_px is not None and other.id < region.id else other
            self._regions.drop(gone)
            self.let_go(gone)
            if gone is region:
                return False
        return True

    def _put_together(self, transmitter: Transmitter) -> bool:
        """Unite a region that shows too little of a bar with others in step with it, if there are any."""
        parts = self._transmitters.in_step(transmitter)
        if self._follower is None or transmitter.region.id in self._joined or not parts:
            return False
        for part in parts:
            self._follower.unite(transmitter.region, part.region)
            self.let_go(part.region)
        return True

    def let_go(self, region: Followed) -> None:
        """Forget a region that has become a part of another, or whose place is another's."""
        self._joined.add(region.id)
        transmitter = self._transmitters.alive.get(region.id)
        if transmitter is not None:
            self._flush(transmitter)
            self.counts["regions_released"] += 1
            self._was_part(transmitter.missed)
            self._queue.add(transmitter.packets, None)
            self._transmitters.release(transmitter)

    def _was_part(self, missed: Counter[str]) -> None:
        """Count the frames that a part of a bar could not show apart from those that no bar shows."""
        self.counts["frames_of_parts"] += self._discarded(missed)

    def _find_parts(self, region: Followed, t_us: float) -> None:
        """Look among the regions that ended for parts of a bar whose first frame is read."""
        for one in list(self._ended):
            number, place_px, missed = one
            if number is None and _is_part(region, t_us, place_px, self._fade_us):
                self._ended.remove(one)
                self._was_part(missed)

    def _end(self, transmitter: Transmitter, now_us: float) -> None:
        """Decode what a region that has ended still shows; its last packet is over."""
        seen_us = transmitter.region.latest.t_us + self._step_us
        until_us = min(now_us - self._tail_us, seen_us)
        self._decode_due(transmitter, until_us)
        while self._waiting(transmitter):
            self._flush(transmitter)
            self._decode_due(transmitter, until_us)
        if transmitter.region.id in self._joined:
            return
        number, missed = transmitter.number, transmitter.missed
        if missed:
            place_px = transmitter.region.positions.place_at(seen_us)
            bars = [one for one in self._regions.alive if one is not transmitter.region and one.size_px]
            if number is None and any(_is_part(bar, seen_us, place_px, self._fade_us) for bar in bars):
                self._was_part(missed)
            else:
                self._ended.append((number, place_px, missed))
        self._queue.add(transmitter.packets, None)


def _in_time(transmitter: Transmitter) -> bool:
    """Whether a transmitter's next frame is decoded when it is due: not before one has shown the bar.

    Nor as long as older ones wait.
    """
    known = transmitter.number is not None and transmitter.region.size_px is not None
    return known and not transmitter.behind and transmitter.tried != transmitter.grid.frame


def _is_part(bar: Followed, t_us: float, place_px: tuple[float, float], fade_us: float) -> bool:
    """Whether what was seen somewhere may have been a part of a bar, or what it has left to fade."""
    (x, y), before = bar.positions.place_at(t_us), bar.positions.place_at(t_us - fade_us)
    width, height = bar.positions.size_at(t_us)
    right, down = abs(place_px[0] - x) - abs(before[0] - x), abs(place_px[1] - y) - abs(before[1] - y)
    return right <= width / 2 + _PART_PX and down <= height / 2 + _PART_PX


def _went_dark(transmitter: Transmitter, due: DueFrame, packet: PacketFormat) -> bool:
    """Whether a bar that was seen before has few events in a frame by now."""
    pilot = transmitter.state.pilot
    if transmitter.number is None or pilot is None:
        return False
    expected = int(np.abs(pilot.sums).sum(dtype=np.int64)) * due.chips / packet.pilot_chips
    return transmitter.region.events_between(due.start_us, due.end_us) < _DARK * expected
