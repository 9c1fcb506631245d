"""Matching: decoded frames and packets paired with those that were sent.

A frame is paired with the true one that started nearest in time, on the bar whose centre is nearest in the
image. Every length follows from the link that the bar sends with.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.shared import find_differences
from evlcp_sdk.rx.reflections import COMPLETE_AFTER_CHIPS
from evlcp_sdk.sim.truth import SentBar, Truth
from evlcp_sdk.study.frames import FrameRow

Floats = NDArray[np.float64]

NEAREST_PX = 60.0
"""Largest distance of a frame from the centre of its bar, given by the image and the receiver's regions, not
by the link."""

TAIL_CHIPS = COMPLETE_AFTER_CHIPS
"""A frame was sent whole if the recording goes on for this long after it, as the receiver requires. The
receiver's clock is late by as much as events are in the mean, 0.15 to 0.95 chips at 30 kHz: a frame that it
gives was sent whole, and it may leave out a whole one, in one recording of a hundred."""

RECOVERY_CHIPS = 3
"""Time after a cluster is uncovered during which frames that start are still cut."""


def _tail_us(packet: PacketFormat) -> float:
    return TAIL_CHIPS * packet.chip_us


def find_start(starts_us: Floats, t_us: float, packet: PacketFormat) -> int | None:
    """Index of the start nearest to a time, within half a pilot; None if there is none.

    What is farther off has not found the pilot. Frames without one follow each other by an info segment, of
    which it is not more than half, either.
    """
    chips = packet.pilot_chips if packet.pilot_every == 1 else min(packet.pilot_chips, packet.info_chips)
    if not len(starts_us):
        return None
    nearest = int(np.argmin(np.abs(starts_us - t_us)))
    most_us = (chips or packet.info_chips) / 2 * packet.chip_us
    return nearest if abs(starts_us[nearest] - t_us) <= most_us else None


def find_nearest_bar(
    bars: Sequence[SentBar], truth: Truth, t_us: float, x_px: float, y_px: float
) -> tuple[int, float] | None:
    """Index of the bar nearest in the image at a time after the scene's start, and its distance, px.

    None without bars. Of bars in one place, as after a restart, it is one that is not hidden.
    """
    distances, is_hidden = [], []
    for bar in bars:
        x, y = (float(np.interp(t_us, truth.t_us, bar.centre_px[:, axis])) for axis in (0, 1))
        distances.append(float(np.hypot(x_px - x, y_px - y)))
        is_hidden.append(any(a <= t_us * 1e-6 < b for a, b in bar.pole_s))
    return min(enumerate(distances), key=lambda one: one[1] + is_hidden[one[0]], default=None)


@dataclass(frozen=True, eq=False)
class SentFrames:
    """The frames that a bar sent whole while the recording ran.

    Attributes:
        start_us: Start of each after the scene's, us, float64 (n,).
        cut_us: Start of those that are hidden completely, or cut by an end of the recording, us.
        symbols: Symbols of each, int64 (n, clusters).
        distance_m: Distance in the middle of its pilot, or of its info segment without one, m, float64 (n,).
        hidden: Clusters that are hidden all the time, bool (n, clusters).
        cut: Clusters that are hidden at any time, bool (n, clusters).
    """

    bar: SentBar
    start_us: Floats
    cut_us: Floats
    symbols: NDArray[np.int64]
    distance_m: Floats
    hidden: NDArray[np.bool_]
    cut: NDArray[np.bool_]

    @classmethod
    def of(cls, bar: SentBar, truth: Truth, *, covers: bool) -> "SentFrames":
        """Those of a bar; with `covers`, a frame that is hidden completely is not sent."""
        packet = bar.link.packet
        rate_hz = bar.rate_hz
        starts = np.array(packet.frame_starts)
        packets = len(bar.symbols) if bar.sends_frames else 0
        chip_numbers = np.add.outer(np.arange(packets) * packet.packet_chips, starts[:-1]).ravel()
        lengths = np.tile(np.diff(starts), packets)
        start_us: Floats = (chip_numbers - bar.start_chip) / rate_hz * 1e6
        end_us: Floats = start_us + lengths / rate_hz * 1e6
        clusters = bar.link.codebook.clusters
        hidden, cut = (np.zeros((len(chip_numbers), clusters), np.bool_) for _ in range(2))
        if covers:
            _mark_hidden(bar, start_us, end_us, hidden, cut)
        sent = (start_us >= 0) & (end_us + _tail_us(packet) < truth.duration_us) & ~cut.all(1)
        # Ranging uses mostly the pilot, whose middle is the time of the distance.
        chips = np.where(lengths > packet.info_chips, packet.pilot_chips, packet.info_chips)
        middle = chips / 2 * packet.chip_us
        distance_m: Floats = np.interp(start_us[sent] + middle[sent], truth.t_us, bar.distance_m)
        symbols = bar.symbols.reshape(-1, clusters)[: len(chip_numbers)]
        return cls(bar, start_us[sent], start_us[~sent], symbols[sent], distance_m, hidden[sent], cut[sent])


def _mark_hidden(
    bar: SentBar, start_us: Floats, end_us: Floats, whole: NDArray[np.bool_], part: NDArray[np.bool_]
) -> None:
    """Mark clusters that are hidden during the whole of each time, or during part of it, (n, clusters)."""
    clusters = whole.shape[1]
    whole[:, bar.covered] = part[:, bar.covered] = True
    recovery_us = RECOVERY_CHIPS * bar.link.packet.chip_us
    for from_s, to_s, first, last in (*bar.cover_s, *((a, b, 0, clusters - 1) for a, b in bar.pole_s)):
        clusters_hidden = slice(first, last + 1)
        part[(start_us < to_s * 1e6 + recovery_us) & (end_us > from_s * 1e6), clusters_hidden] = True
        whole[(start_us >= from_s * 1e6) & (end_us <= to_s * 1e6), clusters_hidden] = True


@dataclass(frozen=True, eq=False)
class MatchResult:
    """Decoded frames paired with the sent ones.

    Attributes:
        bars: The sent frames of the lit bars, in the truth's order.
        pairs: For each of these, (decoded frame, index of the sent one), in the order of decoding.
        unmatched: Decoded frames without a sent one, or whose sent one was found before.
        echoes: Decoded frames that are declared reflections and were left out.
    """

    bars: tuple[SentFrames, ...]
    pairs: tuple[list[tuple[FrameRow, int]], ...]
    unmatched: int
    echoes: int


def match_frames(
    frames: Iterable[FrameRow], truth: Truth, *, road: bool = True, links: Mapping[str, Link] | None = None
) -> MatchResult:
    """Pair each decoded frame with the sent one.

    A frame that names its link is paired with those of bars that send with it. A frame that is cut by an end
    of the recording, or hidden completely, is neither found nor unmatched. Of two for the same sent one, the
    first counts. On a `road`, declared reflections are left out and hidden clusters are known; `links` are
    the receiver's by name, if it has several.
    """
    bars = tuple(SentFrames.of(bar, truth, covers=road) for bar in truth.bars if bar.lit)
    pairs: tuple[list[tuple[FrameRow, int]], ...] = tuple([] for _ in bars)
    found: tuple[set[int], ...] = tuple(set() for _ in bars)
    unmatched = echoes = 0
    senders = {
        name: [i for i, one in enumerate(bars) if not find_differences(one.bar.link, link)]
        for name, link in (links or {}).items()
    }
    for frame in frames:
        if road and frame.echo_of is not None:
            echoes += 1
            continue
        t_us = frame.t_us - truth.t0_us
        candidates = senders.get(frame.link, range(len(bars)))
        sent = [bars[i].bar for i in candidates]
        nearest = find_nearest_bar(sent, truth, t_us, frame.x_px, frame.y_px)
        if nearest is None:
            unmatched += 1
            continue
        i, distance_px = candidates[nearest[0]], nearest[1]
        number = find_start(bars[i].start_us, t_us, bars[i].bar.link.packet)
        if distance_px <= NEAREST_PX and number is not None and number not in found[i]:
            found[i].add(number)
            pairs[i].append((frame, number))
        elif distance_px > NEAREST_PX or not _is_cut(bars[i], truth, t_us, found[i], road=road):
            unmatched += 1
    return MatchResult(bars, pairs, unmatched, echoes)


def _is_cut(sent: SentFrames, truth: Truth, t_us: float, found: set[int], *, road: bool) -> bool:
    """Whether a frame of a bar at a time is cut, or nearly so and the nearest one was not found before."""
    packet = sent.bar.link.packet
    tail_us = _tail_us(packet)
    # With its pilot, until its last events.
    long_us = packet.frame_chips * packet.chip_us + tail_us
    is_at_end = t_us < tail_us or t_us + long_us > truth.duration_us
    hidden = ((a * 1e6, b * 1e6) for a, b in sent.bar.pole_s)
    is_hidden = road and any(t_us < end + long_us and t_us + long_us > begin for begin, end in hidden)
    if not (is_at_end or is_hidden):
        return False
    if road and find_start(sent.cut_us, t_us, packet) is not None:
        return True
    return not len(sent.start_us) or int(np.argmin(np.abs(sent.start_us - t_us))) not in found


def find_sent_packets(bar: SentBar, truth: Truth) -> tuple[Floats, NDArray[np.bool_], Floats]:
    """Find the packets that a bar sent, at least in part, while the recording ran.

    Returns:
        Start of each after the scene's, us; whether it was sent whole; the distance in its middle, m.
    """
    packet = bar.link.packet
    period_us = packet.packet_chips / bar.rate_hz * 1e6
    first_us = -bar.start_chip / bar.rate_hz * 1e6
    start_us: Floats = np.arange(len(bar.symbols), dtype=np.float64) * period_us + first_us
    whole = (start_us >= 0) & (start_us + period_us + _tail_us(packet) < truth.duration_us)
    distance_m: Floats = np.interp(start_us + period_us / 2, truth.t_us, bar.distance_m)
    return start_us, whole, distance_m


def check_link(truth: Truth, link: Link | Mapping[str, Link], name: str, *, messages: bool = False) -> None:
    """Refuse a link that a bar of the truth does not send with, so that a mismatch is never a wrong answer.

    Of several links, each bar must send with one; with `messages`, also with their error correction.

    Raises:
        ConfigError: They differ; with the place.
    """
    for i, bar in enumerate(truth.bars):
        if bar.lit and bar.sends_frames:
            differing = [
                find_differences(bar.link, one, messages=messages and bar.payload != "symbols")
                for one in ([link] if isinstance(link, Link) else link.values())
            ]
            if all(differing):
                # Of several, name the most similar one.
                nearest = min(differing, key=len)
                raise ConfigError(f"{name}: bar {i} was sent with another link: {'; '.join(nearest)}")
