"""The built-in framing: packets of a preamble and frames, from the events of regions to frames."""

import math
from collections import Counter, deque
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.rx.alignment import AlignedFrame, FrameAligner
from evlcp_sdk.rx.delays import RowDelays
from evlcp_sdk.rx.detection import MARGIN_PX, RegionFollower
from evlcp_sdk.rx.followed import SAME_PX, Followed, same_place
from evlcp_sdk.rx.framer import Framer, LitTimes, RegionTracker, StreamContext
from evlcp_sdk.rx.grid import DueFrame
from evlcp_sdk.rx.reading import FrameReader
from evlcp_sdk.rx.reflections import FrameDetection, ReflectionQueue
from evlcp_sdk.rx.steps import Announcer, Steps
from evlcp_sdk.rx.timeline import TimeStep
from evlcp_sdk.rx.transmitters import LOOKBACK_PACKETS, Transmitter, Transmitters
from evlcp_sdk.values import Frame, Region, SyncLock, changed

_TAIL_CHIPS = 0.5
"""A frame is whole if the stream goes on for this long after its last edge's events: some come later."""

_MOST_OLD = 2
"""Frames decoded in a step beyond those that end in one: all that came before a first lock would take as long
as ten steps, and other transmitters would wait."""

_LOOKS = 3
"""Looks at a region's first frame: at what was found of a bar, at the whole of it, and once more, as few
clusters place it less well than all. Looks at another one whose region had strayed, too."""

_DARK = 0.25
"""Share of a pilot's events below which a bar that was seen before is out of sight, or hidden."""

_MOST_ENDED, _PART_PX = 64, 16.0
"""Regions that ended without a frame that are remembered, and how far outside of a bar they may have been
parts of it: pieces of a near bar are followed before the whole of it is known, and the image moves."""

_COUNTS = (
    "events_in_regions",
    "regions_opened",
    "regions_released",
    "locks",
    "preambles",
    "frames",
    "frames_rejected",
    "frames_of_parts",
    "frames_dark",
    "frames_unread",
    "frames_askew",
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


class PacketFraming(Framer):
    """Finds the packets of the regions of a stream, decodes their frames, and sets the regions right by them.

    Args:
        link: The resolved configuration.
        name: Name of the link, that its frames have; empty for none.
        stream: What it is a part of.
        steps: The algorithms of the other roles.
        regions: The regions of the stream.
        follower: The same where frames correct them; None where they stay as a detector has them.
        queue: Where decoded frames go.
        announcer: Gets every frame.
    """

    cut_by_the_end = True

    def __init__(
        self,
        link: Link,
        name: str,
        stream: StreamContext,
        steps: Steps,
        regions: RegionTracker,
        follower: RegionFollower | None,
        queue: ReflectionQueue,
        announcer: Announcer,
    ) -> None:
        self._attitude_at = stream.attitude_at
        self._packet = link.packet
        self._step_us = link.regions.step_us
        self._tail_us = _TAIL_CHIPS * link.packet.chip_us
        self._clock = stream.clock
        self._announcer = announcer
        self._steps = steps
        self._regions, self._follower = regions, follower
        self._name = name
        self._transmitters = Transmitters(
            link.packet, self._step_us, stream.limits, stream.numbers, link.codebook.chips_after
        )
        self._aligner = FrameAligner(
            link.packet,
            link.regions,
            link.bar.cluster_centres_m(),
            link.codebook,
            self._steps.separate,
            (link.camera.width, link.camera.height),
        )
        self._reader = FrameReader(link, steps, self._aligner)
        self._codebook = link.codebook
        self._unknown = np.full(link.codebook.clusters, -1, np.int8)
        self._unknown.setflags(write=False)
        self._rows = RowDelays(link.codebook.preamble)
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
        self.patience_us = packets_us + caught_up * self._step_us
        self.counts = dict.fromkeys(_COUNTS, 0)
        self.lit = LitTimes()
        self.ranging_every = 1
        self._measurable = 0

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
            transmitter.behind = transmitter.grid.due_us <= until_us
            if region.id in self._joined:
                continue
            self._transmitters.forget(transmitter, step.end_us)
            if region.released:
                self._end(transmitter, step.end_us)
                # Its last frames may have shown that it is a part of another.
                if region.id not in self._joined:
                    self.counts["regions_released"] += 1
                    self._transmitters.release(transmitter)

    @property
    def due_us(self) -> float:
        """When the next frame can be decoded, us; infinite where that waits for the end of a time step."""
        if self._follower is None:
            return math.inf
        due_us = math.inf
        for one in self._transmitters.alive:
            if _in_time(one):
                due_us = min(due_us, one.grid.due_us)
        return due_us + self._tail_us

    def ahead(self, step: TimeStep) -> None:
        """Decode the frames that are due in the part so far of a time step."""
        if self._follower is None:
            return
        self._joined.clear()
        self._due.clear()
        until_us = step.end_us - self._tail_us
        due = [one for one in self._transmitters.alive if _in_time(one) and one.grid.due_us <= until_us]
        meant = {one.region.id for one in due}
        with self._follower.ahead(step.start_us, step.end_us, step.events, meant):
            for transmitter in due:
                self._decode_ahead(transmitter, until_us)

    def number_of(self, region: Followed) -> int | None:
        """Number of a region's transmitter; None before its first frame."""
        transmitter = self._transmitters.of(region)
        return None if transmitter is None else transmitter.number

    def discard(self, *, place: Region | None = None, number: int | None = None) -> int:
        """Count no frame that was not read where another link's packet was; return how many they were."""
        missed: Counter[str] = Counter()
        for one in self._transmitters.alive:
            if one.number == number if place is None else same_place(one.region.latest, place):
                missed, one.missed = missed + one.missed, Counter()
        for ended in list(self._ended):
            known, (x, y), its = ended
            if place is not None and known is None:
                found = same_place(changed(place, x_px=x, y_px=y), place)
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
        transmitter, pieces = self._transmitters.of(region), [region.pieces[-1]]
        if transmitter is None:
            self.counts["regions_opened"] += 1
            sync, distance = self._steps.sync_init(), self._steps.distance_init()
            transmitter, pieces = self._transmitters.open(region, sync, distance), list(region.pieces)
        for start_us, events in pieces:
            self.counts["events_in_regions"] += events.t_us.size
            until_us = min(start_us + self._step_us, step.end_us)
            transmitter.sync, locks = self._steps.synchronize(transmitter.sync, events, until_us)
            for heard in locks:
                self.counts["preambles"] += 1
                lock = self._late_rows(transmitter, heard)
                self.counts["locks"] += self._transmitters.adopt(transmitter, lock)
        return transmitter

    def _late_rows(self, transmitter: Transmitter, lock: SyncLock) -> SyncLock:
        """A lock with what its preamble says of the rows of its bar."""
        region = transmitter.region
        middle_us = lock.packet_t_us + self._packet.preamble_chips / 2 * lock.chip_us
        _, y = region.positions.place_at(middle_us)
        _, height_px = region.positions.size_at(middle_us)
        transmitter.rows, lock = self._rows.hear(transmitter.rows, lock, region.pieces, y, height_px)
        return lock

    def _decode_ahead(self, transmitter: Transmitter, until_us: float) -> None:
        """Decode the next frame before its time step is over.

        One that cannot be given is left to the step's end: by then a lock may say that the transmitter has
        begun anew.
        """
        due = transmitter.grid.due(until_us)
        if due is None or transmitter.region.id in self._joined:
            return
        pilot, said = transmitter.pilot, transmitter.said
        found = self._decode(transmitter, due)
        if isinstance(found, Skipped):
            transmitter.pilot, transmitter.said, transmitter.tried = pilot, said, due.number
            return
        self._take(transmitter, due, found)

    def _decode_due(self, transmitter: Transmitter, until_us: float, most: float = math.inf) -> None:
        """Decode the frames that lie before a time with the events after their last edge, so many at most."""
        cut_us = transmitter.region.cut_us
        if cut_us is not None and transmitter.grid.lock is not None:
            self.counts["frames_cut"] += transmitter.grid.skip_before(cut_us)
        while most > 0 and (due := transmitter.grid.due(until_us)) is not None:
            most -= 1
            found = self._decode(transmitter, due)
            if found is Skipped.REJECTED and self._put_together(transmitter):
                continue
            if transmitter.region.id in self._joined:
                # Another region shows the frame.
                transmitter.grid.frame += 1
                return
            if isinstance(found, Skipped):
                transmitter.grid.frame += 1
                if found is not Skipped.DARK:
                    self._lit_in(transmitter, due)
                    transmitter.missed[found] += 1
                self.counts[found] += 1
                continue
            self._take(transmitter, due, found)

    def _take(self, transmitter: Transmitter, due: DueFrame, found: FrameDetection) -> None:
        """Hand a frame on."""
        transmitter.grid.frame += 1
        self._lit_in(transmitter, due)
        self.counts["frames"] += 1
        self._queue.add(transmitter.packets, found)

    def _lit_in(self, transmitter: Transmitter, due: DueFrame) -> None:
        """Note that a transmitter's light is there in a frame that is due."""
        start_us = self._clock.camera_us(due.start_us)
        transmitter.lit_us = start_us if transmitter.lit_us is None else transmitter.lit_us
        if transmitter.number is not None:
            self.lit.note(transmitter.number, transmitter.lit_us, start_us)

    def _decode(self, transmitter: Transmitter, due: DueFrame) -> FrameDetection | Skipped:
        """Read a frame, or say why it is not given."""
        self._announcer.start()
        aligned = self._align(transmitter, due)
        if aligned is None:
            return Skipped.DARK if _went_dark(transmitter, due, self._packet) else Skipped.REJECTED
        if transmitter.number is None and self._reflections.shown(due.start_us, aligned.centre_px):
            # The same bar once more: where the first region was then is not known as well as what it showed.
            self._regions.drop(transmitter.region)
            self.let_go(transmitter.region)
            return Skipped.REJECTED
        ranged = due.has_pilot and self._is_ranged()
        attitude = self._attitude_at(self._clock.camera_us(aligned.middle_us)) if due.has_pilot else None
        before = self._before(transmitter, due)
        reading = self._reader.read(aligned, due, before, attitude, ranged=ranged)
        transmitter.said = due.number, reading.symbols
        distance, soft = reading.distance, reading.soft
        self.counts["frames_askew"] += reading.sight.askew
        if max(soft.symbols.tolist()) < 0 and (
            transmitter.number is None or not math.isfinite(distance.distance_m)
        ):
            # What says nothing is no transmitter, and of one that is known its distance may still be of use.
            return Skipped.UNREAD
        if transmitter.number is None:
            self._find_parts(transmitter.region, due.start_us)
        number = self._transmitters.number(transmitter)
        transmitter.distance, distance, filtered = self._steps.follow(
            transmitter.distance, due.start_us, due.lock.chip_us, distance, reading.sight
        )
        if transmitter.first is None:
            transmitter.first = due.packet
        frame = Frame(
            transmitter=number,
            packet=due.packet - transmitter.first,
            frame=due.index,
            t_us=self._clock.camera_us(due.start_us),
            soft=soft,
            range=distance,
            filtered=filtered,
            x_px=reading.centre_px[0],
            y_px=reading.centre_px[1],
            points_px=reading.points_px,
            points_sigma_px=reading.sigma_px,
            points_flank_px=reading.flank_px,
            points_t_us=self._clock.camera_us(aligned.middle_us),
            echo_of=self._reflections.echo_of(number),
            link=self._name,
        )
        self._announcer.frame(frame)
        return FrameDetection.of(frame, due, aligned.pilot.placement, reading.spread)

    def _is_ranged(self) -> bool:
        """Whether the turn of a frame with a pilot has come to be ranged."""
        self._measurable += 1
        ranged = self._measurable % self.ranging_every == 0
        self.counts["frames_not_ranged"] += not ranged
        return ranged

    def _before(self, transmitter: Transmitter, due: DueFrame) -> NDArray[np.int8]:
        """The chip that each cluster sent before a frame's info segment, int8 (K,); -1 if not known.

        In a pair code it says nothing new, and is not looked up.
        """
        book = self._codebook
        if book.pairs:
            return self._unknown
        if due.has_pilot:
            return book.pilots[:, -1].astype(np.int8)
        number, symbols = transmitter.said
        if number != due.number - 1 or due.index == 0:
            return self._unknown
        return np.where(symbols >= 0, book.codewords[symbols, -1].astype(np.int8), np.int8(-1))

    def _align(self, transmitter: Transmitter, due: DueFrame) -> AlignedFrame | None:
        """Look at a frame; set its region right by it, join what is of the same bar, open what is another."""
        region, follower = transmitter.region, self._follower
        others: list[tuple[float, tuple[float, float], tuple[float, float]]] = []
        most_px = 0.0
        for _ in range(_LOOKS):
            whole = region.size_px is not None
            aligned = self._aligner.align(region, due, transmitter.pilot)
            if aligned is None or not due.has_pilot:
                break
            transmitter.pilot = pilot = aligned.pilot
            centre_px, size_px = self._aligner.box(aligned, pilot.placement)
            if follower is None:
                region.size_px = size_px
                break
            # What the first look shows beside the bar is out of the second one's sight.
            others += [(aligned.middle_us, *self._aligner.box(aligned, other)) for other in pilot.others]
            lit_px, strips_px = self._aligner.lit_rows(aligned), self._aligner.strips(aligned)
            off_px = follower.shape(region, aligned.middle_us, centre_px, size_px, lit_px, strips_px)
            most_px = max(most_px, off_px)
            if off_px > 0 and not self._join(region, aligned.middle_us):
                return None
            # Within half of the seam, motion in the frame is known as well as by its next look.
            if off_px == 0 or (whole and off_px <= MARGIN_PX / 2):
                break
            follower.gather(region, due.start_us, due.read_us)
        if follower is not None and most_px > MARGIN_PX / 2:
            follower.gather(region)
        if follower is None or aligned is None:
            return aligned
        for middle_us, centre_px, size_px in others:
            known = any(one.covers(middle_us, centre_px) for one in self._regions.alive)
            if not known and follower.has_room():
                self._due.append(follower.beside(region, middle_us, centre_px, size_px))
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
        transmitter = self._transmitters.of(region)
        if transmitter is not None:
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
            if number is None and _is_part(region, t_us, place_px):
                self._ended.remove(one)
                self._was_part(missed)

    def _end(self, transmitter: Transmitter, now_us: float) -> None:
        """Decode what a region that has ended still shows; its last packet is over."""
        seen_us = transmitter.region.latest.t_us + self._step_us
        self._decode_due(transmitter, min(now_us - self._tail_us, seen_us))
        if transmitter.region.id in self._joined:
            return
        number, missed = transmitter.number, transmitter.missed
        if missed:
            place_px = transmitter.region.positions.place_at(seen_us)
            bars = [one for one in self._regions.alive if one is not transmitter.region and one.size_px]
            if number is None and any(_is_part(bar, seen_us, place_px) for bar in bars):
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


def _is_part(bar: Followed, t_us: float, place_px: tuple[float, float]) -> bool:
    """Whether what was seen somewhere may have been a part of a bar."""
    (x, y), (width, height) = bar.positions.place_at(t_us), bar.positions.size_at(t_us)
    right, down = abs(place_px[0] - x), abs(place_px[1] - y)
    return right <= width / 2 + _PART_PX and down <= height / 2 + _PART_PX


def _went_dark(transmitter: Transmitter, due: DueFrame, packet: PacketFormat) -> bool:
    """Whether a bar that was seen before has few events in a frame by now."""
    if transmitter.number is None or transmitter.pilot is None:
        return False
    expected = int(np.abs(transmitter.pilot.sums).sum(dtype=np.int64)) * due.chips / packet.pilot_chips
    return transmitter.region.events_between(due.start_us, due.end_us) < _DARK * expected
