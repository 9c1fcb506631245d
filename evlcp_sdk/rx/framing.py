"""The built-in framing: packets of a preamble and frames, decoded from the events of regions."""

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
from evlcp_sdk.rx.framer import Framer, StreamContext, record_light
from evlcp_sdk.rx.guard import Guard, compile_algorithm
from evlcp_sdk.rx.reading import BarDecoder, FrameDecoder, FrameJob, FrameResult
from evlcp_sdk.rx.reflections import FrameDetection, ReflectionQueue
from evlcp_sdk.rx.regions import (
    MARGIN_PX,
    SAME_PX,
    STILL,
    BarPlace,
    RegionTracker,
    RhythmTracker,
    TrackedRegion,
    is_same_place,
)
from evlcp_sdk.rx.transmitters import (
    LOOKBACK_PACKETS,
    Transmitter,
    Transmitters,
    measure_row_delay,
    retime_lock,
)
from evlcp_sdk.rx.workers import AnyBarDecoder
from evlcp_sdk.values import Events, Frame, Region, SyncLock, replace_fields

_TAIL_CHIPS = 0.5
"""A frame is complete once the stream goes on for this long after its last edge: some events come late."""

_APPLY_AFTER_STEPS = 2
"""Steps after which a frame of a steadily followed bar corrects its region, counts and is published, whoever
decodes it: the next frame of its bar is due by then, and more steps would only delay it."""

_MAX_OVERDUE = 2
"""Overdue frames decoded in a step, beyond those that end in it: all frames before a first lock would take as
long as ten steps, and other transmitters would wait."""

_MAX_ALIGNMENTS = 3
"""Alignments of a frame while its region is off: for a first frame by what was found of the bar, by all of
it, and once more, as few clusters place a bar less well than all."""

_DIMMED_RATIO = 1.5
"""Events of the step with a preamble, over those of another, from which on frames are timed anew: a bar's
data alone change them by a third at most."""

_DARK_SHARE = 0.25
"""Share of a pilot's events below which a known bar is hidden or out of sight."""

_MAX_ENDED, _PART_MARGIN_PX = 64, 16.0
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
    """Why a frame that was due is skipped; the value is the count that it belongs to."""

    DARK = "frames_dark"
    """A known bar has too few events."""
    REJECTED = "frames_rejected"
    """No bar is found in it, or not where it should be."""
    UNREAD = "frames_unread"
    """It has no symbol that is sure nor, of a known transmitter, a distance."""


@dataclass(frozen=True)
class SkippedFrame:
    """A frame that was due and is skipped: what the stage `skipped` announces.

    Attributes:
        transmitter: Number of the transmitter; None before its first frame.
        packet: Number of the packet since the transmitter's first; None before that.
        frame: Number of the frame in its packet.
        t_us: Start of its first chip on the camera's clock, us.
        why: The count that it belongs to, such as `frames_dark`.
        link: Name of the link, in a receiver of several.
    """

    transmitter: int | None
    packet: int | None
    frame: int
    t_us: float
    why: str
    link: str


@dataclass(frozen=True, eq=False)
class PendingFrame:
    """A frame that was submitted for decoding, and is not applied yet.

    Attributes:
        transmitter: Whose it is.
        due: Which frame.
        step_us: Start of the time step in which it was due, us.
        ranged: Its distance is measured.
        fetch_result: Returns what was decoded once that is known; None if it has to be decoded here.
        frame: The same as published, if it was already.
    """

    transmitter: Transmitter
    due: DueFrame
    step_us: int
    ranged: bool
    fetch_result: Callable[[], FrameResult | None]
    frame: Frame | None


class PacketFramer(Framer):
    """Finds the packets of a stream's regions, decodes their frames, and corrects the regions by them.

    `follower` is `regions` again where frames correct them; None where they stay as a detector has them.
    Decoded frames go to the `queue`. Frames of a bar that its region follows steadily are decoded by
    themselves, and applied a fixed number of time steps later, so that it does not matter who decodes them.
    """

    drops_frames_at_end = True

    def __init__(
        self,
        link: Link,
        name: str,
        stream: StreamContext,
        decoder: FrameDecoder,
        regions: RegionTracker,
        follower: RhythmTracker | None,
        queue: ReflectionQueue,
        on_frame: Callable[[Frame], None] | None,
    ) -> None:
        super().__init__(link, name, stream, queue, on_frame, _COUNTS)
        self._attitude_at = stream.attitude_at
        self._fade_us = link.regions.fade_us
        self._tail_us = _TAIL_CHIPS * link.packet.chip_us
        self._sync_guard = Guard(link, "synchronization")
        self._synchronizer: Synchronizer = compile_algorithm(
            link, "synchronization", link.codebook, link.packet, methods=("init", "step")
        )
        self._decoder, self._aligner = decoder, decoder.aligner
        self._bar_decoders: Sequence[AnyBarDecoder] = (
            [BarDecoder(decoder)] if stream.bar_decoders is None else stream.bar_decoders(name)
        )
        self._pending: deque[PendingFrame] = deque()
        self._regions, self._follower = regions, follower
        self._transmitters = Transmitters(
            link.packet, self._step_us, stream.limits, link.codebook.trailing_chips
        )
        self._preamble = 2 * link.codebook.preamble.astype(np.float64) - 1
        self._reflections = queue.reflections
        self._dropped: set[int] = set()
        # Number, place and misses.
        self._ended: deque[tuple[int | None, tuple[float, float], Counter[str]]] = deque(maxlen=_MAX_ENDED)
        self._due: deque[TrackedRegion] = deque()
        self._images: set[int] = set()
        # Frames that end in one step, and how long it takes to decode those before a first lock.
        per_step = self._step_us / (link.packet.info_chips * link.packet.chip_us)
        self._max_due = math.ceil(per_step) + _MAX_OVERDUE
        caught_up = math.ceil(LOOKBACK_PACKETS * link.packet.frames / (self._max_due - per_step))
        steps_us = (caught_up + _APPLY_AFTER_STEPS) * self._step_us
        self.patience_us = LOOKBACK_PACKETS * link.packet.packet_us + steps_us
        self._pilot_frames = 0
        self._now_us = 0

    def apply_pending(self, start_us: int) -> None:
        """Apply the decoded frames that are due to be applied at the start of a time step."""
        self._now_us = start_us
        self._dropped.clear()
        self._images.clear()
        while self._pending and self._pending[0].step_us + _APPLY_AFTER_STEPS * self._step_us <= start_us:
            self._apply_frame(self._pending.popleft())

    def step(self, regions: list[TrackedRegion], step: TimeStep) -> None:
        """Synchronize with the regions of a time step and decode their frames."""
        # A frame may show another image of its bar: that is a region, too, and decoded at once.
        self._due = deque(regions)
        while self._due:
            region = self._due.popleft()
            if region.id in self._dropped:
                continue
            transmitter = self._synchronize(region, step)
            until_us = step.end_us - self._tail_us
            self._decode_due(transmitter, until_us, self._max_due)
            transmitter.is_behind = transmitter.grid.next_due(until_us) is not None
            if region.id in self._dropped:
                continue
            pending = self._pending_of(transmitter)
            due = pending[0].due if pending else transmitter.grid.next
            self._transmitters.drop_old_events(transmitter, due, step.end_us)
            if region.released:
                self._end_transmitter(transmitter, step.end_us)
                # Its last frames may have shown it to be a part of another.
                if region.id not in self._dropped:
                    self.counts["regions_released"] += 1
                    self._transmitters.release(transmitter)
        self._update_due_time()

    def _update_due_time(self) -> None:
        due_us = math.inf
        for transmitter in self._transmitters.alive.values() if self._follower is not None else ():
            due = transmitter.grid.next
            if due is not None and due.read_us < due_us and _can_decode_early(transmitter):
                due_us = due.read_us
        self.due_us = due_us + self._tail_us

    def decode_early(self, step: TimeStep) -> None:
        """Decode the frames that are due in the part of a time step that is there so far."""
        if self._follower is None:
            return
        self.apply_pending(step.start_us)
        until_us = step.end_us - self._tail_us
        alive = self._transmitters.alive.values()
        due = [one for one in alive if one.grid.next_due(until_us) is not None and _can_decode_early(one)]
        region_ids = {one.region.id for one in due}
        self._follower.begin_partial_step(step.start_us, step.end_us, step.events, region_ids)
        for transmitter in due:
            self._decode_early(transmitter, until_us)
        self._follower.end_partial_step(step.end_us)
        self._update_due_time()

    def number_of(self, region: TrackedRegion) -> int | None:
        """Number of a region's transmitter; None before its first frame."""
        transmitter = self._transmitters.alive.get(region.id)
        return None if transmitter is None else transmitter.number

    def discard_misses(self, *, place: Region | None = None, number: int | None = None) -> int:
        """Discard the misses counted where another link's packet was, or for a number; return how many."""
        missed: Counter[str] = Counter()
        for one in self._transmitters.alive.values():
            if one.number == number if place is None else is_same_place(one.region.latest, place):
                missed, one.missed = missed + one.missed, Counter()
        for ended in list(self._ended):
            ended_number, (x, y), ended_missed = ended
            if place is not None and ended_number is None:
                matches = is_same_place(replace_fields(place, x_px=x, y_px=y), place)
            else:
                matches = place is None and ended_number == number
            if matches:
                self._ended.remove(ended)
                missed += ended_missed
        return self._uncount(missed)

    def _uncount(self, missed: Counter[str]) -> int:
        for name, count in missed.items():
            self.counts[name] -= count
        return missed.total()

    def close(self) -> None:
        """End the stream: decode what the regions still show."""
        for transmitter in self._transmitters.close():
            self._end_transmitter(transmitter, self._clock.last_us)

    def _synchronize(self, region: TrackedRegion, step: TimeStep) -> Transmitter:
        """Synchronize with a region's events of a time step, or with all that it has if it is new."""
        transmitter, guard = self._transmitters.alive.get(region.id), self._sync_guard
        pieces: Iterable[tuple[int, Events]] = region.pieces if transmitter is None else (region.pieces[-1],)
        if transmitter is None:
            self.counts["regions_opened"] += 1
            with guard:
                state = self._synchronizer.init()
            transmitter = self._transmitters.add(region, state, self._decoder.init_state())
        for start_us, events in pieces:
            self.counts["events_in_regions"] += events.t_us.size
            until_us = min(start_us + self._step_us, step.end_us)
            if not self._announcer.is_silent:
                self._announcer.start_clock()
            try:
                transmitter.sync, locks = self._synchronizer.step(
                    transmitter.sync, events.t_us, events.p, until_us
                )
            except (Exception, SystemExit) as fault:
                guard.reraise(fault)
                raise
            if guard.checks:
                guard.expect_locks(locks, until_us, self._packet)
            for lock in locks:
                self._announcer.announce("synchronization", lock)
                self.counts["preambles"] += 1
                lock = self._correct_row_delay(transmitter, lock)
                transmitter.step_events = events.t_us.size
                if transmitter.grid.accept_lock(lock):
                    transmitter.confirm_frames()
                    continue
                self.counts["locks"] += 1
                if transmitter.number is not None:
                    transmitter = self._replace_transmitter(transmitter)
                self._transmitters.restart_grid(transmitter, lock)
        return transmitter

    def _replace_transmitter(self, old: Transmitter) -> Transmitter:
        """End a transmitter whose place another has taken; discard its unconfirmed frames and misses."""
        self._flush_pending(old)
        self.counts["restarts"] += 1
        self._uncount(old.unconfirmed)
        old.missed[Skipped.REJECTED] -= old.unconfirmed[Skipped.REJECTED]
        packet, frame = divmod(old.last_confirmed, self._packet.frames)
        self.counts["frames"] -= self._queue.end_frames_after(
            old.assembler, (packet - (old.first_packet or 0), frame)
        )
        self._ended.append((old.number, old.region.track.centre_at(old.region.latest.t_us), old.missed))
        return self._transmitters.replace(old)

    def _correct_row_delay(self, transmitter: Transmitter, lock: SyncLock) -> SyncLock:
        """Add to a lock the row delay of its bar, as measured in this preamble and those before."""
        region = transmitter.region
        middle_us = lock.packet_t_us + self._packet.preamble_chips / 2 * lock.chip_us
        _, y_px = region.track.centre_at(middle_us)
        _, height_px = region.track.size_at(middle_us)
        row_us, sigma_us = measure_row_delay(self._preamble, lock, region.pieces, y_px, height_px)
        if math.isfinite(row_us):
            transmitter.row_delay = transmitter.row_delay.update(row_us, sigma_us)
        return transmitter.row_delay.apply_to(lock, height_px)

    def _decode_early(self, transmitter: Transmitter, until_us: float) -> None:
        """Decode the next frame before its time step is over.

        A frame that is skipped is left to the end of the step: by then a lock may show that another
        transmitter has begun. So is one while earlier frames are pending.
        """
        due = transmitter.grid.next_due(until_us)
        if due is None or transmitter.region.id in self._dropped:
            return
        if self._is_steady(transmitter):
            self._submit_frame(transmitter, due)
            return
        if self._pending_of(transmitter):
            return
        state = transmitter.fetch_state()
        found = self._decode_frame(transmitter, due)
        if isinstance(found, Skipped):
            transmitter.state, transmitter.last_tried, transmitter.strayed = state, due.number, True
            return
        self._queue_frame(transmitter, due, found)

    def _decode_due(self, transmitter: Transmitter, until_us: float, most: float = math.inf) -> None:
        """Decode the frames whose events are all there before a time, `most` at most."""
        cut_us = transmitter.region.forgotten_until_us
        if cut_us is not None and transmitter.grid.lock is not None:
            self.counts["frames_cut"] += transmitter.grid.skip_before(cut_us)
        while most > 0 and (due := transmitter.grid.next_due(until_us)) is not None:
            most -= 1
            if until_us - due.read_us <= self._step_us and self._is_steady(transmitter):
                self._submit_frame(transmitter, due)
                continue
            if self._pending_of(transmitter):
                self._flush_pending(transmitter)
                continue
            transmitter.fetch_state()
            found = self._decode_frame(transmitter, due)
            if found is Skipped.REJECTED and self._unite_parts(transmitter):
                continue
            if transmitter.region.id in self._dropped:
                # Another region shows the frame.
                transmitter.grid.go_to(due.number + 1)
                return
            if isinstance(found, Skipped):
                self._skip_frame(transmitter, due, found)
            else:
                self._queue_frame(transmitter, due, found)

    def _skip_frame(self, transmitter: Transmitter, due: DueFrame, why: Skipped) -> None:
        transmitter.strayed = True
        transmitter.grid.go_to(due.number + 1)
        t_us = self._clock.camera_us(due.start_us)
        if why is not Skipped.DARK:
            self._record_light(transmitter, t_us)
            transmitter.missed[why] += 1
            known = transmitter.number is not None and due.number > transmitter.last_confirmed
            if why is Skipped.REJECTED and known:
                transmitter.unconfirmed[why] += 1
                transmitter.assembler.unconfirmed = True
        self.counts[why] += 1
        packet = None if transmitter.first_packet is None else due.packet - transmitter.first_packet
        skipped = SkippedFrame(transmitter.number, packet, due.index, t_us, why.value, self._name)
        self._announcer.announce("skipped", skipped)

    def _queue_frame(self, transmitter: Transmitter, due: DueFrame, found: FrameDetection) -> None:
        if transmitter.grid.frame <= due.number:
            transmitter.grid.go_to(due.number + 1)
        if not transmitter.unconfirmed:
            transmitter.last_confirmed = max(due.number, transmitter.last_confirmed)
        self._record_light(transmitter, found.frame.t_us)
        self.counts["frames"] += 1
        self._queue.add(transmitter.assembler, found)

    def _record_light(self, transmitter: Transmitter, start_us: float) -> None:
        if transmitter.first_lit_us is None:
            transmitter.first_lit_us = start_us
        if transmitter.number is not None:
            record_light(self.light_spans_us, transmitter.number, transmitter.first_lit_us, start_us)

    def _decode_frame(self, transmitter: Transmitter, due: DueFrame) -> FrameDetection | Skipped:
        self._announcer.start_clock()
        due = self._retime_frame(transmitter, due)
        aligned = self._align_frame(transmitter, due)
        if aligned is None:
            return Skipped.DARK if _is_dark(transmitter, due, self._packet) else Skipped.REJECTED
        if transmitter.number is None and self._reflections.has_frame_at(due.start_us, aligned.centre_px):
            # The same bar once more: frames show its place at that time better than its region does.
            self._regions.drop(transmitter.region)
            self.forget_region(transmitter.region)
            return Skipped.REJECTED
        job = self._build_job(transmitter, due)
        known = transmitter.number is not None
        found, transmitter.state = self._decoder.read(aligned, job, transmitter.state, known=known)
        self.counts["frames_not_ranged"] += due.has_pilot and not job.ranged
        if not found.is_readable:
            self._add_count(transmitter, "frames_askew", found.askew)
            return Skipped.UNREAD
        if not known:
            self._claim_ended_parts(transmitter.region, due.start_us)
            transmitter.number = next(self._numbers)
        frame = self._publish_frame(transmitter, due, found)
        return self._build_detection(transmitter, due, found, frame)

    def _publish_frame(self, transmitter: Transmitter, due: DueFrame, found: FrameResult) -> Frame:
        if transmitter.first_packet is None:
            transmitter.first_packet = due.packet
        assert transmitter.number is not None
        frame = Frame(
            transmitter=transmitter.number,
            packet=due.packet - transmitter.first_packet,
            frame=due.index,
            t_us=self._clock.camera_us(due.start_us),
            soft=found.soft,
            range=found.distance,
            filtered=found.filtered,
            x_px=found.centre_px[0],
            y_px=found.centre_px[1],
            points_px=found.points_px,
            points_sigma_px=found.sigma_px,
            points_flank_px=found.flank_px,
            points_t_us=self._clock.camera_us(due.middle_us),
            echo_of=self._reflections.echo_of(transmitter.number),
            link=self._name,
        )
        if self._on_frame is not None:
            self._on_frame(frame)
        self._announcer.announce_frame(frame)
        return frame

    def _build_detection(
        self, transmitter: Transmitter, due: DueFrame, found: FrameResult, frame: Frame
    ) -> FrameDetection:
        self._add_count(transmitter, "frames_askew", found.askew)
        self._add_count(transmitter, "frames_flooded", found.flooded)
        times = due.start_us, due.end_us, due.packet_us, due.lock.chip_us
        return FrameDetection(frame, *times, found.cells, found.seen, found.mirrored, found.spread)

    def _is_steady(self, transmitter: Transmitter) -> bool:
        """Whether frames of a transmitter can be decoded by themselves.

        A region that sweeps over the image is soon off by its seam: each frame has to correct it.
        """
        still = transmitter.region.velocity_px_us == STILL and self._follower is not None
        return still and not transmitter.strayed and transmitter.number is not None

    def _submit_frame(self, transmitter: Transmitter, due: DueFrame) -> None:
        self._announcer.start_clock()
        assert transmitter.number is not None
        if transmitter.decoder is None:
            transmitter.decoder = min(self._bar_decoders, key=len)
            transmitter.decoder.put_state(transmitter.number, transmitter.state)
        due = self._retime_frame(transmitter, due)
        job = self._build_job(transmitter, due)
        fetch_result = transmitter.decoder.decode(transmitter.number, job)
        frame = None
        if transmitter.decoder.is_immediate and (found := fetch_result()) is not None:
            frame = self._publish_frame(transmitter, due, found)
        self._pending.append(PendingFrame(transmitter, due, self._now_us, job.ranged, fetch_result, frame))
        transmitter.grid.go_to(due.number + 1)

    def _pending_of(self, transmitter: Transmitter) -> list[PendingFrame]:
        return [one for one in self._pending if one.transmitter is transmitter]

    def _flush_pending(self, transmitter: Transmitter) -> None:
        while pending := self._pending_of(transmitter):
            self._pending.remove(pending[0])
            self._apply_frame(pending[0])

    def _apply_frame(self, pending: PendingFrame) -> None:
        transmitter, due, found = pending.transmitter, pending.due, pending.fetch_result()
        if found is None:
            # This frame, and those after it, are decoded here, with what surrounds the region.
            for one in self._pending_of(transmitter):
                one.fetch_result()
                self._pending.remove(one)
            transmitter.fetch_state()
            transmitter.strayed = True
            transmitter.grid.go_to(due.number)
            return
        region, shown, follower = transmitter.region, found.shown, self._follower
        assert follower is not None
        if shown is not None and not region.released:
            follower.correct_region(region, shown)
            if not self._drop_duplicates(region, shown.t_us):
                return
            self._open_other_images(region, shown)
        frame = self._publish_frame(transmitter, due, found) if pending.frame is None else pending.frame
        self.counts["frames_not_ranged"] += due.has_pilot and not pending.ranged
        self._queue_frame(transmitter, due, self._build_detection(transmitter, due, found, frame))

    def _open_other_images(self, region: TrackedRegion, shown: BarPlace) -> None:
        """Open regions where a frame shows its bar again; those show others in the next step only.

        Images that touch are placed anew in each frame, and would go on opening one another.
        """
        if region.id in self._images:
            return
        assert self._follower is not None
        for centre_px, size_px in shown.others:
            known = any(one.covers_point(shown.t_us, centre_px) for one in self._regions.alive)
            if not known and self._follower.has_room():
                image = self._follower.open_duplicate(region, BarPlace(shown.t_us, centre_px, size_px))
                self._images.add(image.id)
                self._due.append(image)

    def _retime_frame(self, transmitter: Transmitter, due: DueFrame) -> DueFrame:
        """Time a frame that is due anew where the light has changed since the preamble."""
        grid, region, fewest = transmitter.grid, transmitter.region, transmitter.step_events
        inside = []
        for piece in region.pieces:
            if due.start_us < piece[0] + self._step_us <= due.end_us:
                inside.append(piece)
                fewest = min(fewest, piece[1].t_us.size)
        if region.size_px is None or _DIMMED_RATIO * fewest > transmitter.step_events:
            return due
        lock = retime_lock(due.lock, due.start_us, inside)
        if lock is due.lock:
            return due
        transmitter.step_events, grid.lock = fewest, lock
        grid.go_to(due.number)
        assert grid.next is not None
        return grid.next

    def _add_count(self, transmitter: Transmitter, name: str, count: int) -> None:
        """Add to a count; it stays unconfirmed while the transmitter's frames are."""
        self.counts[name] += count
        if transmitter.unconfirmed:
            transmitter.unconfirmed[name] += count

    def _build_job(self, transmitter: Transmitter, due: DueFrame) -> FrameJob:
        """The job of decoding a frame; each `ranging_every`-th one with a pilot is ranged."""
        if not due.has_pilot:
            return FrameJob(transmitter.region, due, None, ranged=False)
        self._pilot_frames += 1
        attitude = self._attitude_at(self._clock.camera_us(due.middle_us))
        ranged = self._pilot_frames % self.ranging_every == 0
        return FrameJob(transmitter.region, due, attitude, ranged)

    def _align_frame(self, transmitter: Transmitter, due: DueFrame) -> AlignedFrame | None:
        """Align a frame and correct its region by it; drop duplicates of the bar, open its other images."""
        region, follower = transmitter.region, self._follower
        seen: list[BarPlace] = []
        most_px = 0.0
        for _ in range(_MAX_ALIGNMENTS):
            bar_known = region.size_px is not None
            aligned = self._aligner.align(region, due, transmitter.state.pilot)
            if aligned is None or not due.has_pilot:
                break
            transmitter.state = transmitter.state._replace(pilot=aligned.pilot)
            shown = self._aligner.locate_bar(aligned)
            if follower is None:
                region.size_px = shown.size_px
                break
            # The next alignment may no longer see what this one shows beside the bar.
            seen.append(shown)
            off_px = follower.correct_region(region, shown)
            most_px = max(most_px, off_px)
            if off_px > 0 and not self._drop_duplicates(region, shown.t_us):
                return None
            # Within half of the seam, another alignment would not know the motion in the frame better.
            if off_px == 0 or (bar_known and off_px <= MARGIN_PX / 2):
                break
            follower.gather_events(region, due.start_us, due.read_us)
        if follower is not None and most_px > MARGIN_PX / 2:
            follower.gather_events(region)
        if due.has_pilot:
            transmitter.strayed = most_px > MARGIN_PX / 2
        for shown in seen if aligned is not None else ():
            self._open_other_images(region, shown)
        return aligned

    def _drop_duplicates(self, region: TrackedRegion, t_us: float) -> bool:
        """Drop other regions of a bar; if a known one has it already, drop this region and return False."""
        for other in list(self._regions.alive):
            if other is region or not region.includes_region(other, t_us, SAME_PX):
                continue
            gone = region if other.size_px is not None and other.id < region.id else other
            self._regions.drop(gone)
            self.forget_region(gone)
            if gone is region:
                return False
        return True

    def _unite_parts(self, transmitter: Transmitter) -> bool:
        parts = self._transmitters.find_synchronous(transmitter)
        if self._follower is None or transmitter.region.id in self._dropped or not parts:
            return False
        for part in parts:
            self._follower.merge_regions(transmitter.region, part.region)
            self.forget_region(part.region)
        return True

    def forget_region(self, region: TrackedRegion) -> None:
        """Forget a region that has become a part of another, or whose place is another's."""
        self._dropped.add(region.id)
        transmitter = self._transmitters.alive.get(region.id)
        if transmitter is not None:
            self._flush_pending(transmitter)
            self.counts["regions_released"] += 1
            self._count_as_parts(transmitter.missed)
            self._queue.add(transmitter.assembler, None)
            self._transmitters.release(transmitter)

    def _count_as_parts(self, missed: Counter[str]) -> None:
        self.counts["frames_of_parts"] += self._uncount(missed)

    def _claim_ended_parts(self, region: TrackedRegion, t_us: float) -> None:
        for one in list(self._ended):
            number, place_px, missed = one
            if number is None and _is_part(region, t_us, place_px, self._fade_us):
                self._ended.remove(one)
                self._count_as_parts(missed)

    def _end_transmitter(self, transmitter: Transmitter, now_us: float) -> None:
        seen_us = transmitter.region.latest.t_us + self._step_us
        until_us = min(now_us - self._tail_us, seen_us)
        self._decode_due(transmitter, until_us)
        while self._pending_of(transmitter):
            self._flush_pending(transmitter)
            self._decode_due(transmitter, until_us)
        if transmitter.region.id in self._dropped:
            return
        number, missed = transmitter.number, transmitter.missed
        if missed:
            place_px = transmitter.region.track.centre_at(seen_us)
            bars = [one for one in self._regions.alive if one is not transmitter.region and one.size_px]
            if number is None and any(_is_part(bar, seen_us, place_px, self._fade_us) for bar in bars):
                self._count_as_parts(missed)
            else:
                self._ended.append((number, place_px, missed))
        self._queue.add(transmitter.assembler, None)


def _can_decode_early(transmitter: Transmitter) -> bool:
    """Whether a transmitter's next frame can be decoded as soon as it is due.

    Not before a frame has shown the bar, nor while older frames are overdue.
    """
    known = transmitter.number is not None and transmitter.region.size_px is not None
    return known and not transmitter.is_behind and transmitter.last_tried != transmitter.grid.frame


def _is_part(bar: TrackedRegion, t_us: float, place_px: tuple[float, float], fade_us: float) -> bool:
    """Whether what was seen somewhere may have been a part of a bar, or its fading trail."""
    (x, y), before = bar.track.centre_at(t_us), bar.track.centre_at(t_us - fade_us)
    width, height = bar.track.size_at(t_us)
    right, down = abs(place_px[0] - x) - abs(before[0] - x), abs(place_px[1] - y) - abs(before[1] - y)
    return right <= width / 2 + _PART_MARGIN_PX and down <= height / 2 + _PART_MARGIN_PX


def _is_dark(transmitter: Transmitter, due: DueFrame, packet: PacketFormat) -> bool:
    pilot = transmitter.state.pilot
    if transmitter.number is None or pilot is None:
        return False
    expected = int(np.abs(pilot.sums).sum(dtype=np.int64)) * due.chips / packet.pilot_chips
    return transmitter.region.count_events(due.start_us, due.end_us) < _DARK_SHARE * expected
