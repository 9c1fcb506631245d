"""The matcher: decoded frames and packets beside those that were sent.

A frame is put beside the true one that started nearest in time, on the bar whose centre is nearest in the
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
"""How far from a bar's centre a frame may lie and still be the bar's: the image and the receiver's regions
decide this, not the link."""

TAIL_CHIPS = COMPLETE_AFTER_CHIPS
"""A frame was sent whole if the recording goes on for this long after it, as the receiver asks. It asks so by
its own clock, which is late by as much as events are in the mean, 0.15 to 0.95 chips at 30 kHz: what it gives
was sent whole, and it may leave out a frame that was, in one recording of a hundred."""

RECOVERY_CHIPS = 3
"""How long after a cluster is uncovered the frames that start are still cut."""


def _tail_us(packet: PacketFormat) -> float:
    return TAIL_CHIPS * packet.chip_us


def find_start(starts_us: Floats, t_us: float, packet: PacketFormat) -> int | None:
    """Number of the start that is nearest to a time, if it is so by half a pilot; None if none is.

    What is further off has not found the pilot. Frames without one follow each other by an info segment, so
    that it is not more than half of that, either.
    """
    chips = packet.pilot_chips if packet.pilot_every == 1 else min(packet.pilot_chips, packet.info_chips)
    if not len(starts_us):
        return None
    nearest = int(np.argmin(np.abs(starts_us - t_us)))
    near_us = (chips or packet.info_chips) / 2 * packet.chip_us
    return nearest if abs(starts_us[nearest] - t_us) <= near_us else None


def nearest_bar(
    bars: Sequence[SentBar], truth: Truth, t_us: float, x_px: float, y_px: float
) -> tuple[int, float] | None:
    """Number of the bar that is nearest in the image at a time after the scene's start, and its distance, px.

    None without bars. Of bars in one place, as after a restart, it is one that is not hidden.
    """
    away, behind = [], []
    for bar in bars:
        x, y = (float(np.interp(t_us, truth.t_us, bar.centre_px[:, axis])) for axis in (0, 1))
        away.append(float(np.hypot(x_px - x, y_px - y)))
        behind.append(any(a <= t_us * 1e-6 < b for a, b in bar.pole_s))
    return min(enumerate(away), key=lambda one: one[1] + behind[one[0]], default=None)


@dataclass(frozen=True, eq=False)
class BarFrames:
    """The frames that a bar sent whole while the recording ran.

    Attributes:
        bar: The bar.
        start_us: Start of each after the scene's, us, float64 (n,).
        cut_us: Start of those that something hides all of, or an end of the recording cuts, us.
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
    def of(cls, bar: SentBar, truth: Truth, *, covers: bool) -> "BarFrames":
        """Those of a bar; with `covers`, one of which nothing is to be seen is not sent."""
        packet = bar.link.packet
        rate_hz = bar.rate_hz
        numbers = range(packet.frames)
        first = np.array([packet.frame_start_chip(f) for f in numbers], np.int64)
        last = np.array([packet.frame_start_chip(f + 1) for f in numbers], np.int64)
        packets = len(bar.symbols) if bar.sends_frames else 0
        chip = (np.arange(packets)[:, None] * packet.packet_chips + first).ravel().astype(np.float64)
        long = np.tile(last - first, packets)
        start_us: Floats = (chip - bar.start_chip) / rate_hz * 1e6
        end_us: Floats = start_us + long / rate_hz * 1e6
        clusters = bar.link.codebook.clusters
        hidden, cut = (np.zeros((len(chip), clusters), np.bool_) for _ in range(2))
        if covers:
            _hide(bar, start_us, end_us, hidden, cut)
        sent = (start_us >= 0) & (end_us + _tail_us(packet) < truth.duration_us) & ~cut.all(1)
        # Most of what ranging uses is the pilot, and its middle the time that the distance is of.
        chips = np.where(long > packet.info_chips, packet.pilot_chips, packet.info_chips)
        middle = chips / 2 * packet.chip_us
        distance_m: Floats = np.interp(start_us[sent] + middle[sent], truth.t_us, bar.distance_m)
        symbols = np.asarray(bar.symbols, np.int64).reshape(-1, clusters)[: len(chip)]
        return cls(bar, start_us[sent], start_us[~sent], symbols[sent], distance_m, hidden[sent], cut[sent])


def _hide(
    bar: SentBar, start_us: Floats, end_us: Floats, whole: NDArray[np.bool_], part: NDArray[np.bool_]
) -> None:
    """Mark clusters that are hidden in the whole of each time, and in any part of it, (n, clusters)."""
    clusters = whole.shape[1]
    covered = list(bar.covered)
    whole[:, covered] = part[:, covered] = True
    recovery_us = RECOVERY_CHIPS * bar.link.packet.chip_us
    for from_s, to_s, first, last in (*bar.cover_s, *((a, b, 0, clusters - 1) for a, b in bar.pole_s)):
        behind = slice(int(first), int(last) + 1)
        part[(start_us < to_s * 1e6 + recovery_us) & (end_us > from_s * 1e6), behind] = True
        whole[(start_us >= from_s * 1e6) & (end_us <= to_s * 1e6), behind] = True


@dataclass(frozen=True, eq=False)
class Matched:
    """Decoded frames beside the sent ones.

    Attributes:
        bars: What the bars that are lit sent, in the truth's order.
        pairs: For each of these, (decoded frame, number of the sent one), in the order of decoding.
        unmatched: Decoded frames beside which there is no sent one, or one that was found before.
        echoes: Decoded frames that are declared reflections and were left out.
    """

    bars: tuple[BarFrames, ...]
    pairs: tuple[list[tuple[FrameRow, int]], ...]
    unmatched: int
    echoes: int


def match(
    frames: Iterable[FrameRow], truth: Truth, *, road: bool = True, links: Mapping[str, Link] | None = None
) -> Matched:
    """Put each decoded frame beside the sent one.

    A frame that names its link is put beside those of bars that send with it. A frame that is cut by an end
    of the recording, or by something that hides all of the bar, is neither found nor unmatched. Of two
    beside the same sent one, the first is it. On a `road`, what is declared a reflection is left out, and
    what hides clusters is minded; `links` are the receiver's by name, where it has several.
    """
    bars = tuple(BarFrames.of(bar, truth, covers=road) for bar in truth.bars if bar.lit)
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
        among = senders.get(frame.link, range(len(bars)))
        sent = [bars[i].bar for i in among]
        nearest = nearest_bar(sent, truth, t_us, frame.x_px, frame.y_px)
        if nearest is None:
            unmatched += 1
            continue
        i, away_px = among[nearest[0]], nearest[1]
        number = find_start(bars[i].start_us, t_us, bars[i].bar.link.packet)
        if away_px <= NEAREST_PX and number is not None and number not in found[i]:
            found[i].add(number)
            pairs[i].append((frame, number))
        elif away_px > NEAREST_PX or not _is_cut(bars[i], truth, t_us, found[i], road=road):
            unmatched += 1
    return Matched(bars, pairs, unmatched, echoes)


def _is_cut(sent: BarFrames, truth: Truth, t_us: float, found: set[int], *, road: bool) -> bool:
    """Whether a frame of a bar at a time is cut, or would be and the one nearest was not found before."""
    packet = sent.bar.link.packet
    tail_us = _tail_us(packet)
    # With its pilot, until its last events have come.
    long_us = packet.frame_chips * packet.chip_us + tail_us
    at_end = t_us < tail_us or t_us + long_us > truth.duration_us
    dark = road and any(t_us < b * 1e6 + long_us and t_us + long_us > a * 1e6 for a, b in sent.bar.pole_s)
    if not (at_end or dark):
        return False
    if road and find_start(sent.cut_us, t_us, packet) is not None:
        return True
    return not len(sent.start_us) or int(np.argmin(np.abs(sent.start_us - t_us))) not in found


def sent_packets(bar: SentBar, truth: Truth) -> tuple[Floats, NDArray[np.bool_], Floats]:
    """Packets that a bar sent, at least in part, while the recording ran.

    Returns:
        Start of each after the scene's, us; those that were sent whole; the distance in its middle, m.
    """
    packet = bar.link.packet
    period_us = packet.packet_chips / bar.rate_hz * 1e6
    first_us = -bar.start_chip / bar.rate_hz * 1e6
    start_us: Floats = np.arange(len(bar.symbols), dtype=np.float64) * period_us + first_us
    whole = (start_us >= 0) & (start_us + period_us + _tail_us(packet) < truth.duration_us)
    distance_m: Floats = np.interp(start_us + period_us / 2, truth.t_us, bar.distance_m)
    return start_us, whole, distance_m


def check_link(truth: Truth, link: Link | Mapping[str, Link], name: str, *, messages: bool = False) -> None:
    """Refuse a link that a bar of the truth does not send with: a mismatch is an error, never a wrong answer.

    Of several links, each bar has to send with one; with `messages`, also with their error correction.

    Raises:
        ConfigError: They differ; with the place.
    """
    for i, bar in enumerate(truth.bars):
        if bar.lit and bar.sends_frames:
            found = [
                find_differences(bar.link, one, messages=messages and bar.payload != "symbols")
                for one in ([link] if isinstance(link, Link) else link.values())
            ]
            if all(found):
                # Of several, by the one that is most alike.
                nearest = min(found, key=len)
                raise ConfigError(f"{name}: bar {i} was sent with another link: {'; '.join(nearest)}")
