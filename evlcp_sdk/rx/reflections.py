"""Finds which transmitter is a reflection of which, and holds frames back until that is known.

A wet road, a guard rail or a window shows a bar a second time: the same chips at the same time, weaker, maybe
blurred, and in a mirror on the road in the opposite order. Whatever repeats the symbols of another
transmitter on its packet grid is its reflection: two transmitters on one clock that send other data agree in
one symbol of as many as there are codewords. But every mirror takes light, sharpness or order: images that
are alike in all of these are two bars that one controller feeds.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.rx.regions import SAME_PX
from evlcp_sdk.rx.spread import Spread, compare_spreads
from evlcp_sdk.values import Frame, Packet, replace_fields

COMPLETE_AFTER_CHIPS = 2.5
"""The last events of a frame come late, some later than its clock says: it is complete if its light goes on
for two chips after those due. The stream ends with the latest event, which is later than its light by more
than the mean of those that the clock is set by: a tenth of a chip to a quarter, as latencies and rows spread,
and a half where the rows of two bars and of their reflections wait for each other."""

MAX_ROW_US = 0.35
"""The longest that a sensor takes to read a row, us: of two parts, the lower one may be as much later."""

_MIN_REPEATED = 0.25
"""Share of the symbols that a reflection repeats at least; with fewer, it would not be decoded at all."""

_COMMON_SHARE = 1 / 32
"""Share of the symbols that two transmitters on one clock may have in common beyond chance."""

_SURE_LLR = math.log(1e4)
"""Log-likelihood ratio from which on two transmitters are one, or two, until as much speaks against it."""

_MIRRORED_ODDS = 5.0
"""Log odds that of two images in opposite order of the clusters the one in the layout's order is the bar: one
installation in 150 hangs upside down over a mirror."""

_LIGHT_RATIO = 0.3
"""Logarithm of the cells that show a cluster of the bar over those of its reflection, and its spread: a pixel
answers a step with few events, however high it is, so that a fifth of the light takes a third of them. It
counts where the spread of light is unknown: for a layout without neighbours."""

_MAX_LIGHT_ODDS = 3.0
"""Log odds that cells can give at most: a blurred reflection wakes more pixels than the bar."""

_MAX_SHARP_ODDS = 4.0
"""Log odds that light and sharpness can give at most: less than the order in a mirror image does."""

_TWO_BARS_HOLD = 1.0
"""Log odds that it takes to change whether two images are two bars. At first it is whatever fits better:
mirrors are more common, but to leave a bar out costs its place and its data, and a mirror taken for one is
warned of. Equal bars have 2 to 4, those of .6 of the light 0 to 2; mirrors that keep a third, or blur it, -2
and less."""

_COMPARE_AGAIN = 1.25
"""Growth of the frames in common after which their sharpness is compared again."""

_COMPLETE_ODDS = 1.0
"""Log odds for each e-fold of clusters that the one shows more of: a rail is lower than the bar, so that its
image is cut more often than the bar is covered."""

_CUT_ODDS = 5.0
"""Log odds for each e-fold of them that the two are not two bars: hardly ever is half of one hidden."""

_BAR_HOLD = 1.0
"""Log odds in favour of what was the bar before: smaller changes are ignored."""

_LOOKBACK_PACKETS = 3
"""Packets of frames remembered: a new transmitter begins with the last two packets before its lock."""

_REMEMBER_US = 1e6
"""How long two transmitters stay one without a frame in common, and one lost from sight is remembered."""


class FrameDetection(NamedTuple):
    """A decoded frame, with what distinguishes a bar from its reflection.

    Attributes:
        frame: The frame.
        t_us: Start of the frame on the receiver's clock, see `CameraClock`, us.
        end_us: When the events of its last edge end, us.
        packet_us: Start of its packet, us.
        chip_us: Length of a chip, us.
        light: Grid cells that show a cluster, on average: brighter light shows in more of them.
        seen: Clusters that are seen.
        mirrored: The order of the clusters is the opposite of the layout's.
        spread: Measures how light spreads in it; None where that is unknown.
    """

    frame: Frame
    t_us: float
    end_us: float
    packet_us: float
    chip_us: float
    light: float
    seen: int
    mirrored: bool
    spread: Callable[[], Spread] | None = None


def repetition_llr(one: NDArray[np.int64], other: NDArray[np.int64], codewords: int) -> float:
    """Log-likelihood ratio of one frame repeating another's symbols against being independent of it.

    Both are symbols of clusters, int64 (K,), out of `codewords`; -1 is not given, and does not count.

    >>> symbols = np.arange(16)
    >>> repetition_llr(symbols, symbols, 64) > 20, repetition_llr(symbols, symbols[::-1], 64) < -3
    (True, True)
    >>> repetition_llr(symbols, np.full(16, -1), 64)
    0.0
    """
    given = (one >= 0) & (other >= 0)
    alike = int((one[given] == other[given]).sum())
    chance = 1 / codewords
    here, there = (chance + share * (1 - chance) for share in (_MIN_REPEATED, _COMMON_SHARE))
    unlike = int(given.sum()) - alike
    return alike * math.log(here / there) + unlike * math.log((1 - here) / (1 - there))


def brightness_odds(light: float) -> float:
    """Log odds of the first of two images being the bar, by the logarithm of its light over the other's.

    >>> [round(brightness_odds(light), 1) for light in (0.0, 0.3, -1.2)]
    [0.0, 2.0, -3.0]
    """
    # Two normal distributions, as far from 0 as they are wide.
    return min(max(2 * light / _LIGHT_RATIO, -_MAX_LIGHT_ODDS), _MAX_LIGHT_ODDS)


def pick_original(
    members: Sequence[int], odds: Mapping[tuple[int, int], float], before: Iterable[int] = ()
) -> int:
    """Pick the bar itself among several images of it, transmitters by number.

    `odds` are log odds of the first being the bar rather than the second, for pairs of them; `before` are
    those that were bars with reflections before.

    >>> pick_original([0, 1, 2], {(0, 1): -4.0, (0, 2): 1.0, (1, 2): 6.0})
    1
    >>> pick_original([0, 1], {(0, 1): -0.4}, before=[0])
    0
    """
    known = set(before)
    score = {m: _BAR_HOLD if m in known else 0.0 for m in members}
    for (one, other), value in odds.items():
        if one in score and other in score:
            score[one] += value / 2
            score[other] -= value / 2
    return max(sorted(members), key=score.__getitem__)


@dataclass
class _Pair:
    """What two transmitters' frames in common show.

    Attributes:
        evidence: Of one repeating the other, a log-likelihood ratio within bounds.
        same: They are images of the same data.
        frames: Frames in common.
        frames_lit: Those of them that show light in both.
        light: Sum of the logarithms of the first one's light over the second's.
        seen: The same of the clusters that are seen.
        mirrored: Frames in which only the second is mirrored less those in which only the first is.
        spread: How light spreads in each, by the frames that show it of both.
        compared: Log odds of the first being sharper and brighter, and of both being alike, at the last
            comparison; None if unknown.
        frames_compared: Frames of that comparison.
        two_bars: 1 if they are two bars, -1 if not, 0 before any comparison.
        last_us: Time of the newest frame in common, us.
    """

    evidence: float = 0.0
    same: bool = False
    frames: int = 0
    frames_lit: int = 0
    light: float = 0.0
    seen: float = 0.0
    mirrored: int = 0
    spread: tuple[Spread, Spread] | None = None
    compared: tuple[float, float] | None = None
    frames_compared: int = 0
    two_bars: int = 0
    last_us: float = -math.inf

    def add(self, one: FrameDetection, other: FrameDetection, codewords: int) -> None:
        """Add a frame in common."""
        llr = repetition_llr(one.frame.soft.symbols, other.frame.soft.symbols, codewords)
        self.evidence = min(max(self.evidence + llr, -2 * _SURE_LLR), 2 * _SURE_LLR)
        if abs(self.evidence) >= _SURE_LLR:
            self.same = self.evidence > 0
        self.frames += 1
        if one.light > 0 and other.light > 0:
            self.frames_lit += 1
            self.light += math.log(one.light / other.light)
            self.seen += math.log(one.seen / other.seen)
        self.mirrored += other.mirrored - one.mirrored
        if one.spread is not None and other.spread is not None:
            known = self.spread
            both = one.spread(), other.spread()
            self.spread = both if known is None else (known[0] + both[0], known[1] + both[1])
        self.last_us = max(one.t_us, other.t_us, self.last_us)

    def odds(self) -> float:
        """Log odds of the first being the bar and the second its reflection; updates `two_bars`."""
        mirror_odds = _MIRRORED_ODDS * self.mirrored / max(self.frames, 1)
        frames_lit = max(self.frames_lit, 1)
        if self.spread is not None and self.spread[0].frames >= self.frames_compared * _COMPARE_AGAIN:
            self.compared, self.frames_compared = compare_spreads(*self.spread), self.spread[0].frames
        seen = self.seen / frames_lit
        if self.compared is None:
            return mirror_odds + brightness_odds(self.light / frames_lit) + _COMPLETE_ODDS * seen
        sharper, alike = self.compared
        bars = alike - abs(mirror_odds) - _CUT_ODDS * abs(seen) + _TWO_BARS_HOLD * self.two_bars
        self.two_bars = 1 if bars > 0 else -1
        return mirror_odds + min(max(sharper, -_MAX_SHARP_ODDS), _MAX_SHARP_ODDS) + _COMPLETE_ODDS * seen


class Reflections:
    """Finds which transmitter is a reflection of which, by the frames that they have in common."""

    def __init__(self, packet: PacketFormat, codewords: int) -> None:
        self._codewords = codewords
        self._chip_us = packet.chip_us
        self._keep_us = _LOOKBACK_PACKETS * packet.packet_us
        self._seen: dict[int, deque[FrameDetection]] = {}
        self._pairs: dict[tuple[int, int], _Pair] = {}
        self._echo_of: dict[int, int] = {}
        self._repeated: set[int] = set()
        self._now_us = -math.inf

    def echo_of(self, transmitter: int) -> int | None:
        """Of which transmitter one is a reflection, by all frames so far; None if of none."""
        return self._echo_of.get(transmitter)

    def has_twin(self, transmitter: int) -> bool:
        """Whether a transmitter is one of two bars or more that send the same."""
        return transmitter in self._repeated

    def has_frame_at(self, t_us: float, centre_px: tuple[float, float]) -> bool:
        """Whether a transmitter had a frame that began at this time in this place."""
        for known in self._seen.values():
            for detection in known:
                frame = detection.frame
                off_px = max(abs(frame.x_px - centre_px[0]), abs(frame.y_px - centre_px[1]))
                if off_px <= SAME_PX and abs(detection.t_us - t_us) < self._chip_us / 2:
                    return True
        return False

    def add_detections(self, detections: Iterable[FrameDetection]) -> None:
        """Add the frames of a time step, in any order, but those of one transmitter in order of time."""
        ordered = sorted(detections, key=lambda s: (s.t_us, s.frame.transmitter))
        if not ordered:
            return
        self._now_us = max(self._now_us, ordered[-1].t_us)
        for detection in ordered:
            for number, others in self._seen.items():
                if number == detection.frame.transmitter:
                    continue
                other = self._find_simultaneous(detection, others)
                if other is not None:
                    first, second = sorted((detection, other), key=lambda s: s.frame.transmitter)
                    key = first.frame.transmitter, second.frame.transmitter
                    self._pairs.setdefault(key, _Pair()).add(first, second, self._codewords)
            self._seen.setdefault(detection.frame.transmitter, deque()).append(detection)
        self._drop_old()
        self._group_images()

    def _find_simultaneous(
        self, detection: FrameDetection, others: deque[FrameDetection]
    ) -> FrameDetection | None:
        """Another transmitter's frame elsewhere in the image, begun within half a chip; None without one."""
        frame = detection.frame
        nearest, least_us = None, math.inf
        # In order of time: from the newest back, until they are farther away again.
        for other in reversed(others):
            apart_us = abs(other.t_us - detection.t_us)
            if apart_us > least_us:
                break
            nearest, least_us = other, apart_us
        if nearest is None:
            return None
        within_us = self._chip_us / 2 + MAX_ROW_US * abs(nearest.frame.y_px - frame.y_px)
        off_px = max(abs(nearest.frame.x_px - frame.x_px), abs(nearest.frame.y_px - frame.y_px))
        return nearest if least_us < within_us and off_px > SAME_PX else None

    def _drop_old(self) -> None:
        for known in self._seen.values():
            while known and known[0].t_us < self._now_us - self._keep_us:
                known.popleft()
        if not all(self._seen.values()):
            self._seen = {number: known for number, known in self._seen.items() if known}
        if self._pairs:
            oldest_us = self._now_us - _REMEMBER_US
            self._pairs = {key: pair for key, pair in self._pairs.items() if pair.last_us >= oldest_us}

    def _group_images(self) -> None:
        known_bars = set(self._echo_of.values())
        self._echo_of, self._repeated = {}, set()
        if not self._pairs:
            return
        odds = {key: pair.odds() for key, pair in self._pairs.items() if pair.same}
        groups: list[set[int]] = []
        for key in sorted(odds):
            joined = [group for group in groups if group & set(key)]
            groups = [group for group in groups if group not in joined] + [set(key).union(*joined)]
        for group in groups:
            bar = pick_original(sorted(group), odds, known_bars)
            bars = {n for n in group if self._pairs.get((min(n, bar), max(n, bar)), _Pair()).two_bars > 0}
            self._repeated |= {bar, *bars} if bars else bars
            self._echo_of |= dict.fromkeys(group - {bar} - bars, bar)


_MAX_WAITING = 2
"""Packets that wait while it is uncertain whose they are: the second preamble off a grid decides."""


class PacketAssembler:
    """Collects a transmitter's frames until their packet is complete.

    A packet is a reflection as a whole, as its last frame, decoded with most evidence, has it.

    Attributes:
        unconfirmed: The frames that come now may be another transmitter's: some packets wait.
    """

    def __init__(self, frames: int) -> None:
        self._frames_sent = frames
        self._frames: list[Frame] = []
        self._start: tuple[float, float] = (0.0, 0.0)
        self._done: list[Packet] = []
        self.unconfirmed = False

    def add(self, frame: Frame, packet_t_us: float, chip_us: float) -> list[Packet]:
        """Add a frame; return the packets that are complete by it, or by the last of their frames."""
        if self._frames and self._frames[-1].packet != frame.packet:
            self._done += self._close_packet()
        if not self._frames:
            self._start = (packet_t_us, chip_us)
        self._frames.append(frame)
        if frame.frame == self._frames_sent - 1:
            self._done += self._close_packet()
        count = len(self._done) - _MAX_WAITING * self.unconfirmed
        complete, self._done = self._done[: max(count, 0)], self._done[max(count, 0) :]
        return complete

    def drop_frames_after(self, last: tuple[int, int]) -> int:
        """Drop the frames after one, given by packet and frame; return how many."""
        before = len(self._frames) + sum(len(packet.frames) for packet in self._done)
        self._frames = [one for one in self._frames if (one.packet, one.frame) <= last]
        kept = [
            replace_fields(packet, frames=tuple(f for f in packet.frames if (f.packet, f.frame) <= last))
            for packet in self._done
        ]
        self._done = [packet for packet in kept if packet.frames]
        return before - len(self._frames) - sum(len(packet.frames) for packet in self._done)

    def flush(self) -> list[Packet]:
        """Return the packets of the frames held, if any."""
        complete, self._done = self._done + self._close_packet(), []
        return complete

    def _close_packet(self) -> list[Packet]:
        if not self._frames:
            return []
        first, echo_of = self._frames[0], self._frames[-1].echo_of
        frames = [f if f.echo_of == echo_of else replace_fields(f, echo_of=echo_of) for f in self._frames]
        packet = Packet(first.transmitter, first.packet, *self._start, tuple(frames), self._frames_sent)
        self._frames = []
        return [packet]


@dataclass
class ReflectionQueue:
    """Holds decoded frames for a time step, so that a bar and its reflection are compared together.

    Their frames end within a chip of each other, but maybe not in the same step, and a new transmitter begins
    with the frames before its lock. What it gives is marked by all frames up to the step after.

    Attributes:
        reflections: Finds reflections among the frames.
        stream_end_us: When the stream ends, us: a frame is complete if it goes on for some chips after it.
        frames_at_end: Frames so near to the end of the stream that they were not given.
    """

    reflections: Reflections
    stream_end_us: float = math.inf
    frames_at_end: int = 0
    # A frame with its assembler, or, without one, the end of its transmitter's frames.
    _old: list[tuple[PacketAssembler, FrameDetection | None]] = field(default_factory=list)
    _new: list[tuple[PacketAssembler, FrameDetection | None]] = field(default_factory=list)

    def __bool__(self) -> bool:
        """Whether anything waits."""
        return bool(self._old or self._new)

    def add(self, assembler: PacketAssembler, detection: FrameDetection | None) -> None:
        """Add a frame and its assembler; None for the end of a transmitter's frames."""
        self._new.append((assembler, detection))

    def end_frames_after(self, assembler: PacketAssembler, last: tuple[int, int]) -> int:
        """End a transmitter's frames with one, by packet and frame; return how many were dropped."""
        dropped = assembler.drop_frames_after(last)
        for waiting in (self._old, self._new):
            before = len(waiting)
            waiting[:] = [
                (other, found)
                for other, found in waiting
                if other is not assembler or found is None or (found.frame.packet, found.frame.frame) <= last
            ]
            dropped += before - len(waiting)
        self.add(assembler, None)
        return dropped

    def step(self) -> list[Packet]:
        """End a time step; return the packets that are complete with the frames of the step before."""
        if self._new:
            self.reflections.add_detections(found for _, found in self._new if found is not None)
        due, self._old, self._new = self._old, self._new, []
        return [packet for assembler, found in due for packet in self._emit_packets(assembler, found)]

    def close(self) -> list[Packet]:
        """End the stream; return the packets of all frames that wait."""
        return self.step() + self.step()

    def _emit_packets(self, assembler: PacketAssembler, detection: FrameDetection | None) -> list[Packet]:
        if detection is None:
            return assembler.flush()
        frame = detection.frame
        if detection.end_us + COMPLETE_AFTER_CHIPS * detection.chip_us > self.stream_end_us:
            self.frames_at_end += 1
            return []
        echo_of = self.reflections.echo_of(frame.transmitter)
        if echo_of != frame.echo_of:
            frame = replace_fields(frame, echo_of=echo_of)
        return assembler.add(frame, detection.packet_us, detection.chip_us)
