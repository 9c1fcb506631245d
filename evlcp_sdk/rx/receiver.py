"""The receiver: events in, packets out."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pluggy
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError, StreamError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import Synchronizer, Tracker
from evlcp_sdk.rx.detection import Followed, RegionFollower
from evlcp_sdk.rx.guard import Guard
from evlcp_sdk.rx.inbox import MessageAssembler
from evlcp_sdk.rx.look import polarity_sums
from evlcp_sdk.rx.packets import PacketAssembler
from evlcp_sdk.rx.plausibility import clusters_in_place
from evlcp_sdk.rx.points import points_finder
from evlcp_sdk.values import Events, Frame, FrameView, Packet, PresenceMap, Range, SyncLock

__all__ = ["Receiver"]

_ROLES = ("synchronization", "separation", "decoding", "ranging", "tracking")

_LOOKBACK_PACKETS = 2
"""Packets of events kept while there is no lock: one to hear a preamble in, one to look back on."""


_REMEMBER_US = 1e6
"""How long a transmitter lost from sight is remembered: clocks 100 ppm apart drift by a chip in it."""

_NO_RANGE = Range(math.nan, math.nan, 0)
_NO_POINTS = (np.empty((0, 2)), np.empty(0))

_UNSEEN_STEPS = 5
"""Steps without a position after which a region counts as lost: it blinks in every chip otherwise."""


@dataclass(frozen=True, eq=False)
class _Pilot:
    """The pilot that the frames up to the next one go by.

    Attributes:
        frame: Number of its frame, counted as `_Transmitter.frame`.
        size_px: (width, height) of the image, px.
        sums: Its polarity sums, int16 (chips, height, width).
        offset_px: The rest of the motion in it, float64 (2, chips), px.
        presence: What it shows; the bar is held still, so it shows the same in the frames after it.
    """

    frame: int
    size_px: tuple[int, int]
    sums: NDArray[np.int16]
    offset_px: NDArray[np.float64]
    presence: PresenceMap


@dataclass(frozen=True, eq=False)
class _Look:
    """A frame with the bar held still.

    Attributes:
        sums: Polarity sums of pilot and info segment, int16 (chips, height, width).
        offset_px: The rest of the motion in them, float64 (2, chips), px.
        presence: Where the clusters are.
        centre_px: Column and row of the bar's centre in the chip that begins at `middle_us`.
        middle_us: Middle of the pilot, or of the info segment of a frame without one, where a chip begins: a
            chip's events show the image at its first edge.
    """

    sums: NDArray[np.int16]
    offset_px: NDArray[np.float64]
    presence: PresenceMap
    centre_px: tuple[float, float]
    middle_us: float


@dataclass
class _Transmitter:
    """What the receiver knows of one region.

    Attributes:
        number: Transmitter number, None before the first lock.
        lock: The newest lock.
        packet: Number of the lock's packet, counted from the first that may have a frame here.
        frame: Next frame to decode, counted from that packet's first.
        first: Number of the first packet that had a frame, None before.
        pilot: The newest pilot, None where it showed no bar.
        distance: State of the distance filter, None without one.
    """

    region: Followed
    sync: Any
    assembler: PacketAssembler
    number: int | None = None
    lock: SyncLock | None = None
    packet: int = 0
    frame: int = 0
    first: int | None = None
    pilot: _Pilot | None = None
    distance: Any = None


class Receiver:
    """Decodes a stream of events, whatever pieces it comes in.

    The stream is cut into time steps on a fixed grid, so that any split of it gives the same packets.

    Args:
        link: The resolved configuration.
        hook: Where finished stages are announced (`Registry.hook`); None for nowhere.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> receiver = Receiver(load_link())
    >>> receiver.feed(Events.of(t_us=[10, 20], x=[5, 5], y=[7, 7], p=[1, 0]))
    []
    >>> receiver.close()
    []
    >>> receiver.counts["events"]
    2
    """

    def __init__(self, link: Link, hook: pluggy.HookRelay | None = None) -> None:
        self._link = link
        self._packet = link.packet
        self._step_us = link.regions.step_us
        self._hook: Callable[..., Any] | None = None
        if hook is not None and hook.evlcp_stage_finished.get_hookimpls():
            self._hook = hook.evlcp_stage_finished
        self._guards = {role: Guard(link, role) for role in _ROLES}
        with self._guards["synchronization"]:
            self._synchronizer: Synchronizer = link.algorithm("synchronization").compile(
                link.codebook, link.packet
            )
        with self._guards["separation"]:
            self._separate = link.algorithm("separation").compile(link.codebook)
        with self._guards["decoding"]:
            self._decode = link.algorithm("decoding").compile(link.codebook)
        with self._guards["ranging"]:
            self._measure = link.algorithm("ranging").compile(link.camera, link.bar, link.codebook)
        with self._guards["tracking"]:
            tracker: Tracker = link.algorithm("tracking").compile()
        self._distance = tracker.distance
        self._centres_m = link.bar.cluster_centres_m()
        self._find_points = points_finder(self._centres_m)
        self._regions = RegionFollower(link.regions, link.camera, link.packet.chip_us, tracker.position)
        self._messages = self._assembler(link)
        self._transmitters: dict[int, _Transmitter] = {}
        self._released: list[_Transmitter] = []
        self._pending: list[Events] = []
        self._step_start_us: int | None = None
        self._first_us = 0
        self._last_us = -(2**62)
        self._locked = 0
        self._closed = False
        self._counts = dict.fromkeys(
            (
                "events",
                "dropped_time_backward",
                "dropped_off_sensor",
                "events_in_regions",
                "regions_opened",
                "regions_released",
                "locks",
                "preambles",
                "frames",
                "frames_rejected",
                "packets",
            ),
            0,
        )

    @property
    def counts(self) -> dict[str, int]:
        """What was taken, found and dropped so far."""
        return self._counts | (self._messages.counts if self._messages is not None else {})

    def feed(self, events: Events) -> list[Packet]:
        """Take the next events of the stream; return the packets that are complete.

        Events before their predecessor in time, or off the sensor, are dropped and counted.

        Raises:
            StreamError: The stream was closed.
        """
        if self._closed:
            raise StreamError("the receiver is closed: make a new one for a new stream")
        events = self._checked(events)
        if not len(events):
            return []
        if self._step_start_us is None:
            self._first_us = int(events.t_us[0])
            self._step_start_us = self._first_us // self._step_us * self._step_us
        packets: list[Packet] = []
        bounds = self._bounds(events)
        begin = 0
        for end in bounds:
            self._pending.append(events[begin:end])
            begin = end
            packets += self._run_step()
            packets += self._skip_gap(int(events.t_us[end]))
        if begin < len(events):
            self._pending.append(events[begin:])
        return self._read(packets)

    def close(self) -> list[Packet]:
        """End the stream; return the packets that were still incomplete."""
        if self._closed:
            return []
        self._closed = True
        packets = self._run_step(self._last_us) if self._pending else []
        for transmitter in self._transmitters.values():
            packets += self._end(transmitter)
        self._transmitters = {}
        packets = self._read(packets)
        if self._messages is not None:
            self._messages.close()
        return packets

    @staticmethod
    def _assembler(link: Link) -> MessageAssembler | None:
        """What reads messages; None where that is turned off, or packets are too short for them."""
        if not link.messages.decode:
            return None
        try:
            coder = link.block_coder()
        except ConfigError:
            return None
        return MessageAssembler(coder, link.messages)

    def _read(self, packets: list[Packet]) -> list[Packet]:
        """Read the messages that packets carry."""
        if self._messages is None:
            return packets
        read = []
        for packet in packets:
            clock = time.perf_counter()
            read.append(self._messages.add(packet))
            elapsed = time.perf_counter() - clock
            for message in read[-1].messages:
                self._announce("message", message, elapsed)
        return read

    def _checked(self, events: Events) -> Events:
        from evlcp_sdk.rx import _kernels

        camera = self._link.camera
        t_us, x, y = events.t_us, events.x, events.y
        self._counts["events"] += len(events)
        if not len(events):
            return events
        if t_us[0] >= self._last_us and _kernels.all_ordered(t_us, x, y, camera.width, camera.height):
            self._last_us = int(t_us[-1])
            return events
        keep = np.empty(len(events), np.bool_)
        off, backward, self._last_us = _kernels.keep_ordered(
            t_us, x, y, camera.width, camera.height, self._last_us, keep
        )
        self._counts["dropped_off_sensor"] += off
        self._counts["dropped_time_backward"] += backward
        return events[keep]

    def _bounds(self, events: Events) -> list[int]:
        """Where each new time step begins among the events."""
        assert self._step_start_us is not None
        first = max(int(events.t_us[0]) // self._step_us * self._step_us, self._step_start_us)
        if int(events.t_us[-1]) - first > self._step_us * len(events):
            # Sparse events: look at each instead of at each step.
            step = events.t_us // self._step_us
            before = np.concatenate([[self._step_start_us // self._step_us], step[:-1]])
            return [int(i) for i in np.flatnonzero(step > before)]
        starts = np.arange(self._step_start_us + self._step_us, int(events.t_us[-1]) + 1, self._step_us)
        return sorted(set(np.searchsorted(events.t_us, starts).tolist()))

    def _run_step(self, until_us: int | None = None) -> list[Packet]:
        """Process the time step whose events are pending; `until_us` where the stream ends inside it."""
        assert self._step_start_us is not None
        events = self._pending[0] if len(self._pending) == 1 else Events.concat(self._pending)
        self._pending = []
        start_us = self._step_start_us
        self._step_start_us += self._step_us
        end_us = self._step_start_us if until_us is None else until_us
        clock = time.perf_counter()
        regions = self._regions.step(start_us, events)
        elapsed = time.perf_counter() - clock
        packets: list[Packet] = []
        for region in regions:
            if region.id not in self._transmitters:
                self._counts["regions_opened"] += 1
                assembler = PacketAssembler(self._packet.frames)
                self._transmitters[region.id] = _Transmitter(
                    region,
                    self._synchronizer.init(),
                    assembler,
                    distance=self._distance.init() if self._distance else None,
                )
                fresh = list(region.pieces)
            else:
                fresh = [region.pieces[-1]] if region.pieces and region.pieces[-1][0] == start_us else []
            self._counts["events_in_regions"] += sum(len(e) for _, e in fresh)
            self._announce("regions", region.latest, elapsed)
            transmitter = self._transmitters[region.id]
            for piece_us, piece in fresh:
                self._synchronize(transmitter, piece, min(piece_us + self._step_us, end_us))
            packets += self._decode_due(transmitter, end_us)
            self._forget(transmitter, end_us)
            if region.released:
                packets += self._release(region)
        return packets

    def _skip_gap(self, next_us: int) -> list[Packet]:
        """Move to the time step of the next event without visiting empty ones in which nothing can happen."""
        assert self._step_start_us is not None
        target = next_us // self._step_us * self._step_us
        packets: list[Packet] = []
        while self._step_start_us < target and self._regions.alive:
            self._pending = [Events.empty()]
            packets += self._run_step()
        if self._step_start_us < target:
            self._regions.skip()
            self._step_start_us = target
        return packets

    def _synchronize(self, transmitter: _Transmitter, events: Events, until_us: int) -> None:
        clock = time.perf_counter()
        with self._guards["synchronization"]:
            transmitter.sync, locks = self._synchronizer.step(
                transmitter.sync, events.t_us, events.p, until_us
            )
        elapsed = time.perf_counter() - clock
        for lock in locks:
            self._counts["preambles"] += 1
            self._adopt(transmitter, lock)
            self._announce("synchronization", lock, elapsed)

    def _adopt(self, transmitter: _Transmitter, lock: SyncLock) -> None:
        """Take a new lock; frames go on where they were, or begin with the first whole one of the region."""
        packet, old = self._packet, transmitter.lock
        period = packet.packet_chips * lock.chip_us
        if old is not None:
            apart = (lock.packet_t_us - old.packet_t_us) / period
            if abs(apart - round(apart)) * packet.packet_chips < 1:
                transmitter.packet += round(apart)
                transmitter.lock = lock
                return
        self._counts["locks"] += 1
        transmitter.pilot = None
        # Half a chip before the first event is still within the first edge's delay.
        earliest = max(transmitter.region.first_us, self._first_us - lock.chip_us / 2)
        if old is None and self._inherit(transmitter, lock):
            while self._frame_start_us(transmitter, transmitter.frame) < earliest:
                transmitter.frame += 1
            return
        if transmitter.number is None:
            transmitter.number = self._locked
            self._locked += 1
        done = transmitter.frame
        if old is not None:
            earliest = max(earliest, self._frame_start_us(transmitter, done))
        back = math.ceil((lock.packet_t_us - earliest) / period)
        transmitter.lock = lock
        transmitter.packet = back + (0 if old is None else -(-done // packet.frames))
        transmitter.frame = (transmitter.packet - back) * packet.frames
        while self._frame_start_us(transmitter, transmitter.frame) < earliest:
            transmitter.frame += 1

    def _inherit(self, transmitter: _Transmitter, lock: SyncLock) -> bool:
        """Go on as a transmitter that was lost from sight, if the packets stand on its grid."""
        packet = self._packet
        period = packet.packet_chips * lock.chip_us
        for lost in [*self._transmitters.values(), *self._released]:
            unseen_us = lock.packet_t_us - lost.region.latest.t_us
            if lost is transmitter or lost.lock is None or not 0 < unseen_us < _REMEMBER_US:
                continue
            if unseen_us < _UNSEEN_STEPS * self._step_us:
                continue
            apart = (lock.packet_t_us - lost.lock.packet_t_us) / period
            if abs(apart - round(apart)) * packet.packet_chips < 1:
                transmitter.number, transmitter.frame = lost.number, lost.frame
                transmitter.packet, transmitter.first = lost.packet + round(apart), lost.first
                transmitter.distance = lost.distance
                transmitter.assembler, lost.assembler = lost.assembler, transmitter.assembler
                transmitter.lock, lost.lock = lock, None
                return True
        return False

    def _frame_start_us(self, transmitter: _Transmitter, frame: int) -> float:
        lock, packet = transmitter.lock, self._packet
        assert lock is not None
        number, index = divmod(frame, packet.frames)
        chips = (number - transmitter.packet) * packet.packet_chips + packet.frame_start_chip(index)
        return lock.packet_t_us + chips * lock.chip_us

    def _decode_due(self, transmitter: _Transmitter, until_us: float) -> list[Packet]:
        """Decode the frames that lie before a time, with the events after their last edge."""
        packets: list[Packet] = []
        while (lock := transmitter.lock) is not None:
            start_us = self._frame_start_us(transmitter, transmitter.frame)
            last_delay = max(lock.delay_on_us, lock.delay_off_us, 0.0)
            end_us = start_us + self._chips_of(transmitter.frame) * lock.chip_us + last_delay
            if end_us > until_us:
                break
            frame = self._decode_frame(transmitter, start_us, end_us)
            transmitter.frame += 1
            if frame is None:
                self._counts["frames_rejected"] += 1
                continue
            self._counts["frames"] += 1
            packet_us = start_us - self._packet.frame_start_chip(frame.frame) * lock.chip_us
            done = transmitter.assembler.add(frame, packet_us, lock.chip_us)
            self._counts["packets"] += len(done)
            packets += done
        return packets

    def _chips_of(self, frame: int) -> int:
        """Chips of a frame, with its pilot or without."""
        packet = self._packet
        return packet.frame_chips if packet.has_pilot(frame % packet.frames) else packet.info_chips

    def _decode_frame(self, transmitter: _Transmitter, start_us: float, end_us: float) -> Frame | None:
        clock = [time.perf_counter()]
        assert transmitter.number is not None
        look = self._look(transmitter, start_us, end_us, clock)
        if look is None:
            return None
        with self._guards["decoding"]:
            soft = self._decode(look.presence, look.sums)
        self._guards["decoding"].expect_symbols(soft, self._link.codebook)
        self._announce("decoding", soft, _lap(clock))
        number, index = divmod(transmitter.frame, self._packet.frames)
        distance, points = _NO_RANGE, _NO_POINTS
        if self._packet.has_pilot(index):
            # Another distance of the same pilot, or other points, would say nothing new.
            view = FrameView(look.sums, look.offset_px, look.presence, soft)
            self._announce("view", view, 0.0)
            with self._guards["ranging"]:
                distance = self._measure(view)
            self._guards["ranging"].expect(distance, Range)
            self._announce("ranging", distance, _lap(clock))
            # A value is read from its second chip, and a chip's events follow the edge at its start.
            read_px = look.offset_px[:, 1 : self._packet.pilot_chips : 2]
            points = self._find_points(look.presence, read_px, look.centre_px)
        if transmitter.first is None:
            transmitter.first = number
        frame = Frame(
            transmitter=transmitter.number,
            packet=number - transmitter.first,
            frame=index,
            t_us=start_us,
            soft=soft,
            range=distance,
            filtered=self._filter(transmitter, start_us, distance),
            x_px=look.centre_px[0],
            y_px=look.centre_px[1],
            points_px=points[0],
            points_sigma_px=points[1],
            points_t_us=look.middle_us,
        )
        self._announce("frame", frame, clock[-1] - clock[0])
        return frame

    def _look(
        self, transmitter: _Transmitter, start_us: float, end_us: float, clock: list[float]
    ) -> _Look | None:
        """The next frame with the bar held still, and where its clusters are; None if they cannot be told."""
        lock, region, packet = transmitter.lock, transmitter.region, self._packet
        assert lock is not None
        index = transmitter.frame % packet.frames
        chips = self._chips_of(transmitter.frame)
        middles = start_us + (np.arange(chips, dtype=np.float64) + 0.5) * lock.chip_us
        x, y = region.at(middles)
        middle = min(chips, packet.pilot_chips) // 2
        pilot = transmitter.pilot
        if packet.has_pilot(index):
            width, height = region.size_at(middles[middle])
            margin = 2 * self._link.regions.margin_px
            size = (_even(width + margin), _even(height + margin))
        elif pilot is None or pilot.frame != transmitter.frame - index % packet.pilot_every:
            return None
        else:
            size = pilot.size_px
        pieces = [e for t, e in region.pieces if t < end_us and t + self._step_us > start_us]
        sums, offset_px = polarity_sums(pieces, lock, start_us, (x, y), size)
        if packet.has_pilot(index):
            heard, moved = sums[: packet.pilot_chips], offset_px[:, : packet.pilot_chips]
            with self._guards["separation"]:
                presence = self._separate(heard)
            self._guards["separation"].expect(presence, PresenceMap)
            self._announce("separation", presence, _lap(clock))
            in_place = clusters_in_place(presence, self._centres_m)
            if in_place < self._link.regions.min_clusters_share * len(self._centres_m):
                transmitter.pilot = None
                return None
            if packet.pilot_every > 1:
                transmitter.pilot = _Pilot(transmitter.frame, size, heard, moved, presence)
        else:
            assert pilot is not None
            presence = pilot.presence
            sums = np.concatenate([pilot.sums, sums])
            offset_px = np.concatenate([pilot.offset_px, offset_px], axis=1)
        centre_px = float(x[middle]), float(y[middle])
        middle_us = float(middles[middle]) - lock.chip_us / 2
        return _Look(sums, offset_px, presence, centre_px, middle_us)

    def _filter(self, transmitter: _Transmitter, t_us: float, measured: Range) -> Range | None:
        """The distance filtered over time; the prediction where a frame allows none."""
        if self._distance is None:
            return None
        if np.isnan(measured.distance_m) or np.isnan(measured.sigma_m):
            with self._guards["tracking"]:
                expected = self._distance.predict(transmitter.distance, t_us)
            return None if expected is None else Range(float(expected[0][0]), expected[1], 0)
        value = np.array([measured.distance_m])
        with self._guards["tracking"]:
            transmitter.distance, value, sigma = self._distance.step(
                transmitter.distance, t_us, value, measured.sigma_m
            )
        return Range(float(value[0]), sigma, measured.pairs)

    def _forget(self, transmitter: _Transmitter, now_us: float) -> None:
        """Drop what no frame can need any more."""
        if transmitter.lock is None:
            packet_us = self._packet.packet_chips * self._packet.chip_us
            keep_us = now_us - _LOOKBACK_PACKETS * packet_us
            transmitter.region.first_us = max(transmitter.region.first_us, int(keep_us))
        else:
            # A later lock may move the next frame's start by a chip.
            keep_us = self._frame_start_us(transmitter, transmitter.frame) - transmitter.lock.chip_us
        transmitter.region.forget_before(keep_us, self._step_us)

    def _release(self, region: Followed) -> list[Packet]:
        self._counts["regions_released"] += 1
        lost = self._transmitters.pop(region.id)
        packets = self._end(lost)
        lost.region.pieces.clear()
        oldest_us = region.latest.t_us - _REMEMBER_US
        self._released = [r for r in self._released if r.region.latest.t_us > oldest_us] + [lost]
        return packets

    def _end(self, transmitter: _Transmitter) -> list[Packet]:
        packets = self._decode_due(
            transmitter, min(self._last_us, transmitter.region.latest.t_us + self._step_us)
        )
        rest = transmitter.assembler.flush()
        self._counts["packets"] += len(rest)
        return packets + rest

    def _announce(self, stage: str, value: object, elapsed_s: float) -> None:
        if self._hook is not None:
            self._hook(stage=stage, value=value, elapsed_s=elapsed_s)


def _even(size: float) -> int:
    return 2 * math.ceil(size / 2)


def _lap(clock: list[float]) -> float:
    """Seconds since the last lap; `clock` keeps the first and the last time."""
    now = time.perf_counter()
    elapsed = now - clock[-1]
    clock.append(now)
    return elapsed
