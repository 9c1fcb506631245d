"""Which transmitter is the reflection of which, and frames that wait until that is known.

A wet road, a guard rail or a window shows a bar a second time: the same chips at the same time, weaker, maybe
blurred, and in a mirror on the road in the opposite order. Whatever repeats the symbols of another
transmitter on its packet grid is its reflection: two transmitters on one clock that send other data agree in
one symbol of as many as there are codewords. But every mirror takes light, sharpness or order: images that
are alike in all of them are two bars that one controller feeds.
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
from evlcp_sdk.rx.spread import Spread, compare
from evlcp_sdk.values import Frame, Packet, replace_fields

FOLLOWED_CHIPS = 2.5
"""The last events of a frame come late, some later than its clock says: it is whole if its light goes on for
two chips after those due. The stream ends with the latest event, which is later than its light by more than
the mean of those that the clock is set by: a tenth of a chip to a quarter, as latencies and rows spread, and
a half where the rows of two bars and of their reflections wait for each other."""

LONGEST_ROW_US = 0.35
"""The longest that a sensor takes to read a row, us: of two parts, the lower one may come as much later."""

_REPEATED = 0.25
"""Share of the symbols that a reflection repeats at the least; with fewer, nothing would be read of it."""

_ALIKE = 1 / 32
"""Share of the symbols that two transmitters on one clock may have in common beside those of chance."""

_SURE = math.log(1e4)
"""Log-likelihood ratio from which on two transmitters are one, or two, until as much speaks against it."""

_MIRRORED = 5.0
"""Log odds that of two images in opposite order of the clusters the one that stands as the layout says is the
bar: one installation in 150 hangs upside down over a mirror."""

_LIGHT = 0.3
"""Logarithm of the cells that show a cluster of the bar over those of its reflection, and how much it varies:
a pixel answers a step with few events, however high it is, so a fifth of the light takes a third of them. It
counts where nothing is known of how light spreads: of a layout without neighbours."""

_MOST_LIGHT = 3.0
"""Log odds that cells can give at the most: a reflection that is blurred wakes more pixels than the bar."""

_MOST_SHARP = 4.0
"""Log odds that light and sharpness can give at the most: less than a mirror image's order does."""

_TWO_STAY = 1.0
"""Log odds that it takes to change whether two that say the same are two bars. At first it is by what images
fit better: mirrors are more common, but to leave a bar out costs its place and what it says, and a mirror
taken for one is warned of. Equal bars have 2 to 4, those of .6 of the light 0 to 2; mirrors that keep a third
of it, or blur it, mostly -2 and less."""

_ANEW = 1.25
"""Share of frames by which those in common must have grown before their sharpness is compared again."""

_WHOLE = 1.0
"""Log odds for each e-fold of clusters that the one shows more of: a rail is lower than the bar, so that its
image is cut more often than the bar is covered."""

_CUT = 5.0
"""Log odds for each e-fold of them that the two are no two bars: hardly ever is half of one hidden."""

_STAYS = 1.0
"""Log odds for what was said to be the bar before: what wavers by less changes nothing."""

_LOOKBACK_PACKETS = 3
"""Packets of frames remembered: a new transmitter begins with the last two packets before its lock."""

_REMEMBER_US = 1e6
"""How long two transmitters stay one without a frame in common; so long one lost from sight is remembered."""


class FrameDetection(NamedTuple):
    """A decoded frame, and what tells a bar from its reflection.

    Attributes:
        frame: The frame.
        t_us: Start of the frame inside, see `CameraClock`, us.
        end_us: When the events of its last edge end, us.
        packet_us: Start of its packet, us.
        chip_us: Length of a chip, us.
        light: Grid cells that show a cluster, on average: what shines more shows in more of them.
        seen: Clusters that are seen.
        mirrored: The order of the clusters is the opposite of the layout's.
        spread: Measures how light spreads in it; None where nothing shows that.
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


def repeats(one: NDArray[np.int64], other: NDArray[np.int64], codewords: int) -> float:
    """Log-likelihood ratio of one frame repeating another's symbols against being independent of it.

    Both are symbols of clusters, int64 (K,), of so many codewords; -1, one not given in either, says nothing.

    >>> said = np.arange(16)
    >>> repeats(said, said, 64) > 20, repeats(said, said[::-1], 64) < -3
    (True, True)
    >>> repeats(said, np.full(16, -1), 64)
    0.0
    """
    given = (one >= 0) & (other >= 0)
    alike = int((one[given] == other[given]).sum())
    chance = 1 / codewords
    here, there = (chance + share * (1 - chance) for share in (_REPEATED, _ALIKE))
    unlike = int(given.sum()) - alike
    return alike * math.log(here / there) + unlike * math.log((1 - here) / (1 - there))


def brighter(light: float) -> float:
    """Log odds of the first of two images being the bar, by the logarithm of its light over the other's.

    >>> [round(brighter(light), 1) for light in (0.0, 0.3, -1.2)]
    [0.0, 2.0, -3.0]
    """
    # Two normal distributions, as far from 0 as they are wide.
    return min(max(2 * light / _LIGHT, -_MOST_LIGHT), _MOST_LIGHT)


def originals(
    members: Sequence[int], odds: Mapping[tuple[int, int], float], before: Iterable[int] = ()
) -> int:
    """Which of several images of one bar is the bar itself.

    Args:
        members: Numbers of the transmitters.
        odds: Log odds of the first being the bar rather than the second, for pairs of them.
        before: Those of which others are said to be reflections already.

    >>> originals([0, 1, 2], {(0, 1): -4.0, (0, 2): 1.0, (1, 2): 6.0})
    1
    >>> originals([0, 1], {(0, 1): -0.4}, before=[0])
    0
    """
    known = set(before)
    score = {m: _STAYS if m in known else 0.0 for m in members}
    for (one, other), value in odds.items():
        if one in score and other in score:
            score[one] += value / 2
            score[other] -= value / 2
    return max(sorted(members), key=score.__getitem__)


@dataclass
class _Pair:
    """What the frames in common say of two transmitters.

    Attributes:
        evidence: That one repeats the other, a log-likelihood ratio within bounds.
        same: Whether they are one.
        frames: Frames in common.
        lit: Those of them that show light in both.
        light: Sum of the logarithms of the first one's light over the second's.
        seen: The same of the clusters that are seen.
        mirrored: Frames in which only the second is mirrored less those in which only the first is.
        spread: How light spreads in each, by the frames that tell it of both.
        compared: Log odds of the first being sharper and brighter, and of both being alike, by the frames up
            to some; None if unknown.
        frames_compared: Frames by which that is.
        two: 1 if they are two bars, -1 if not, 0 as long as light has not told.
        last_us: Time of the newest frame in common, us.
    """

    evidence: float = 0.0
    same: bool = False
    frames: int = 0
    lit: int = 0
    light: float = 0.0
    seen: float = 0.0
    mirrored: int = 0
    spread: tuple[Spread, Spread] | None = None
    compared: tuple[float, float] | None = None
    frames_compared: int = 0
    two: int = 0
    last_us: float = -math.inf

    def add(self, one: FrameDetection, other: FrameDetection, codewords: int) -> None:
        """Take a frame in common."""
        change = repeats(one.frame.soft.symbols, other.frame.soft.symbols, codewords)
        self.evidence = min(max(self.evidence + change, -2 * _SURE), 2 * _SURE)
        if abs(self.evidence) >= _SURE:
            self.same = self.evidence > 0
        self.frames += 1
        if one.light > 0 and other.light > 0:
            self.lit += 1
            self.light += math.log(one.light / other.light)
            self.seen += math.log(one.seen / other.seen)
        self.mirrored += other.mirrored - one.mirrored
        if one.spread is not None and other.spread is not None:
            known = self.spread
            both = one.spread(), other.spread()
            self.spread = both if known is None else (known[0] + both[0], known[1] + both[1])
        self.last_us = max(one.t_us, other.t_us, self.last_us)

    def odds(self) -> float:
        """Log odds of the first being the bar and the second its reflection; says whether they are `two`."""
        turned, lit = _MIRRORED * self.mirrored / max(self.frames, 1), max(self.lit, 1)
        if self.spread is not None and self.spread[0].frames >= self.frames_compared * _ANEW:
            self.compared, self.frames_compared = compare(*self.spread), self.spread[0].frames
        seen = self.seen / lit
        if self.compared is None:
            return turned + brighter(self.light / lit) + _WHOLE * seen
        sharper, alike = self.compared
        bars = alike - abs(turned) - _CUT * abs(seen) + _TWO_STAY * self.two
        self.two = 1 if bars > 0 else -1
        return turned + min(max(sharper, -_MOST_SHARP), _MOST_SHARP) + _WHOLE * seen


class Reflections:
    """Judges which transmitter is a reflection of which, from the frames that they have in common."""

    def __init__(self, packet: PacketFormat, codewords: int) -> None:
        self._codewords = codewords
        self._chip_us = packet.chip_us
        self._keep_us = _LOOKBACK_PACKETS * packet.packet_chips * packet.chip_us
        self._seen: dict[int, deque[FrameDetection]] = {}
        self._pairs: dict[tuple[int, int], _Pair] = {}
        self._echo_of: dict[int, int] = {}
        self._alike: set[int] = set()
        self._now_us = -math.inf

    def echo_of(self, transmitter: int) -> int | None:
        """Of which transmitter one is a reflection, by all frames so far; None if of none."""
        return self._echo_of.get(transmitter)

    def alike(self, transmitter: int) -> bool:
        """Whether a transmitter is a bar, and another bar says the same."""
        return transmitter in self._alike

    def shown(self, t_us: float, centre_px: tuple[float, float]) -> bool:
        """Whether a transmitter has shown a frame that began at this time in this place."""
        for known in self._seen.values():
            for detection in known:
                frame = detection.frame
                off_px = max(abs(frame.x_px - centre_px[0]), abs(frame.y_px - centre_px[1]))
                if off_px <= SAME_PX and abs(detection.t_us - t_us) < self._chip_us / 2:
                    return True
        return False

    def judge(self, seen: Iterable[FrameDetection]) -> None:
        """Take the frames of a time step in any order, those of one transmitter in order of time."""
        fresh = sorted(seen, key=lambda s: (s.t_us, s.frame.transmitter))
        if not fresh:
            return
        self._now_us = max(self._now_us, fresh[-1].t_us)
        for detection in fresh:
            for number, known in self._seen.items():
                if number != detection.frame.transmitter and (other := self._beside(detection, known)):
                    first, second = sorted((detection, other), key=lambda s: s.frame.transmitter)
                    key = first.frame.transmitter, second.frame.transmitter
                    self._pairs.setdefault(key, _Pair()).add(first, second, self._codewords)
            self._seen.setdefault(detection.frame.transmitter, deque()).append(detection)
        self._forget()
        self._decide()

    def _beside(self, detection: FrameDetection, known: deque[FrameDetection]) -> FrameDetection | None:
        """Another transmitter's frame elsewhere in the image, begun within half a chip; None without one."""
        frame = detection.frame
        nearest, least_us = None, math.inf
        # In order of time: from the newest back, until they are farther away again.
        for other in reversed(known):
            apart_us = abs(other.t_us - detection.t_us)
            if apart_us > least_us:
                break
            nearest, least_us = other, apart_us
        if nearest is None:
            return None
        within_us = self._chip_us / 2 + LONGEST_ROW_US * abs(nearest.frame.y_px - frame.y_px)
        off_px = max(abs(nearest.frame.x_px - frame.x_px), abs(nearest.frame.y_px - frame.y_px))
        return nearest if least_us < within_us and off_px > SAME_PX else None

    def _forget(self) -> None:
        for known in self._seen.values():
            while known and known[0].t_us < self._now_us - self._keep_us:
                known.popleft()
        if not all(self._seen.values()):
            self._seen = {number: known for number, known in self._seen.items() if known}
        if self._pairs:
            oldest_us = self._now_us - _REMEMBER_US
            self._pairs = {key: pair for key, pair in self._pairs.items() if pair.last_us >= oldest_us}

    def _decide(self) -> None:
        before = set(self._echo_of.values())
        self._echo_of, self._alike = {}, set()
        if not self._pairs:
            return
        odds = {key: pair.odds() for key, pair in self._pairs.items() if pair.same}
        groups: list[set[int]] = []
        for key in sorted(odds):
            joined = [group for group in groups if group & set(key)]
            groups = [group for group in groups if group not in joined] + [set(key).union(*joined)]
        for group in groups:
            bar = originals(sorted(group), odds, before)
            bars = {n for n in group if self._pairs.get((min(n, bar), max(n, bar)), _Pair()).two > 0}
            self._alike |= {bar, *bars} if bars else bars
            self._echo_of |= dict.fromkeys(group - {bar} - bars, bar)


_MOST_WAITING = 2
"""Packets that wait while it is in doubt whose they are: the second preamble off a grid settles it."""


class PacketAssembler:
    """Collects a transmitter's frames until their packet, of so many frames, is over.

    A packet is a reflection as a whole, as its last frame, which knows most, says.

    Attributes:
        in_doubt: The frames that come now may be of another transmitter: packets wait, so many at most.
    """

    def __init__(self, sent: int) -> None:
        self._sent = sent
        self._frames: list[Frame] = []
        self._start: tuple[float, float] = (0.0, 0.0)
        self._done: list[Packet] = []
        self.in_doubt = False

    def add(self, frame: Frame, packet_t_us: float, chip_us: float) -> list[Packet]:
        """Take a frame; return the packets that are over, by the last of their frames or by this one."""
        if self._frames and self._frames[-1].packet != frame.packet:
            self._done += self._over()
        if not self._frames:
            self._start = (packet_t_us, chip_us)
        self._frames.append(frame)
        if frame.frame == self._sent - 1:
            self._done += self._over()
        many = len(self._done) - _MOST_WAITING * self.in_doubt
        over, self._done = self._done[: max(many, 0)], self._done[max(many, 0) :]
        return over

    def end_after(self, last: tuple[int, int]) -> int:
        """Let the frames go that are later than one, by packet and frame; how many."""
        many = len(self._frames) + sum(len(packet.frames) for packet in self._done)
        self._frames = [one for one in self._frames if (one.packet, one.frame) <= last]
        kept = [
            replace_fields(packet, frames=tuple(f for f in packet.frames if (f.packet, f.frame) <= last))
            for packet in self._done
        ]
        self._done = [packet for packet in kept if packet.frames]
        return many - len(self._frames) - sum(len(packet.frames) for packet in self._done)

    def flush(self) -> list[Packet]:
        """The packets of the frames held, if any."""
        over, self._done = self._done + self._over(), []
        return over

    def _over(self) -> list[Packet]:
        if not self._frames:
            return []
        first, echo_of = self._frames[0], self._frames[-1].echo_of
        frames = [f if f.echo_of == echo_of else replace_fields(f, echo_of=echo_of) for f in self._frames]
        packet = Packet(first.transmitter, first.packet, *self._start, tuple(frames), self._sent)
        self._frames = []
        return [packet]


@dataclass
class ReflectionQueue:
    """Keeps decoded frames for one time step, so that a bar and its reflection are judged together.

    Their frames end within a chip of each other, but maybe not in the same step, and a transmitter that is
    new begins with the frames before its lock. What the queue gives is marked by all frames up to the step
    after its own.

    Attributes:
        reflections: The judge.
        ends_us: When the stream ends, us: a frame is whole if it goes on for some chips after it.
        cut: Frames so near to the end of the stream that they were not given.
    """

    reflections: Reflections
    ends_us: float = math.inf
    cut: int = 0
    # A frame and where it goes, or, without one, the end of its transmitter's frames.
    _old: list[tuple[PacketAssembler, FrameDetection | None]] = field(default_factory=list)
    _new: list[tuple[PacketAssembler, FrameDetection | None]] = field(default_factory=list)

    def __bool__(self) -> bool:
        """Whether anything waits."""
        return bool(self._old or self._new)

    def add(self, packets: PacketAssembler, detection: FrameDetection | None) -> None:
        """Take a frame, and where it goes; None for the end of a transmitter's frames."""
        self._new.append((packets, detection))

    def end_after(self, packets: PacketAssembler, last: tuple[int, int]) -> int:
        """End a transmitter's frames with one, by packet and frame: let later ones go; how many."""
        gone = packets.end_after(last)
        for waiting in (self._old, self._new):
            many = len(waiting)
            waiting[:] = [
                (its, found)
                for its, found in waiting
                if its is not packets or found is None or (found.frame.packet, found.frame.frame) <= last
            ]
            gone += many - len(waiting)
        self.add(packets, None)
        return gone

    def step(self) -> list[Packet]:
        """End a time step; give the packets that are complete with the frames of the step before it."""
        if self._new:
            self.reflections.judge(one for _, one in self._new if one is not None)
        due, self._old, self._new = self._old, self._new, []
        return [packet for packets, one in due for packet in self._emit(packets, one)]

    def close(self) -> list[Packet]:
        """End the stream; give the packets of all frames that wait."""
        return self.step() + self.step()

    def _emit(self, packets: PacketAssembler, one: FrameDetection | None) -> list[Packet]:
        if one is None:
            return packets.flush()
        frame = one.frame
        if one.end_us + FOLLOWED_CHIPS * one.chip_us > self.ends_us:
            self.cut += 1
            return []
        echo_of = self.reflections.echo_of(frame.transmitter)
        if echo_of != frame.echo_of:
            frame = replace_fields(frame, echo_of=echo_of)
        return packets.add(frame, one.packet_us, one.chip_us)
