"""Counting: decoded frames, messages and positions beside the truth, as tallies that add."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from evlcp_sdk.link.blocks import BlockCoder
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.place.navigator import Navigator, PositionPlan
from evlcp_sdk.place.observations import CONTRADICTIONS
from evlcp_sdk.scene.attitude import AttitudeLog
from evlcp_sdk.scene.sites import BarSite
from evlcp_sdk.sim.truth import Truth
from evlcp_sdk.study.frames import FrameRow
from evlcp_sdk.study.match import NEAREST_PX, BarFrames, find_start, match, nearest_bar, sent_packets
from evlcp_sdk.study.tally import Statistics, Tally, in_nm, segment_of
from evlcp_sdk.values import Frame, Packet


def bar_tallies(sent: BarFrames, pairs: Iterable[tuple[FrameRow, int]]) -> list[tuple[int, Tally]]:
    """Tallies of one bar, each with the start of its segment: one a sent frame, one a decoded."""
    bits = sent.bar.link.codebook.bits_per_symbol
    segments = [segment_of(at) for at in sent.distance_m.tolist()]
    tallies = [(segment, Tally(frames_sent=1)) for segment in segments]
    for frame, number in pairs:
        wrong = visible = erased = unseen = claimed = 0
        cut, hidden = sent.cut[number].tolist(), sent.hidden[number].tolist()
        for k, true in enumerate(sent.symbols[number].tolist()):
            given = frame.symbols[k] if k < len(frame.symbols) else -1
            if hidden[k]:
                unseen += 1
                claimed += given >= 0
            elif not cut[k]:
                visible += 1
                erased += given < 0
                wrong += (given ^ true).bit_count() if given >= 0 else 0
        tally = Tally(
            frames_found=1,
            bits=bits * (visible - erased),
            bit_errors=wrong,
            visible=visible,
            erased=erased,
            erased_bits=bits * erased,
            hidden=unseen,
            claimed=claimed,
        )
        tallies.append((segments[number], tally))
        true_m = float(sent.distance_m[number])
        if not math.isnan(frame.distance_m):
            tallies.append((segments[number], Tally.distance(frame.distance_m - true_m, frame.sigma_m)))
        if not math.isnan(frame.filtered_m):
            squared = in_nm(frame.filtered_m - true_m) ** 2
            tallies.append((segments[number], Tally(filtered=1, filtered_squares_nm2=squared)))
    return tallies


def statistics_of(
    frames: Iterable[FrameRow],
    truth: Truth,
    *,
    events: int = 0,
    packets: int = 0,
    others: Iterable[tuple[int, Tally]] = (),
    links: Mapping[str, Link] | None = None,
) -> Statistics:
    """Hold decoded frames against the truth.

    `others` are what `message_tallies` and `position_tallies` gave; `links` are the
    receiver's by name, where it has several.
    """
    frames = list(frames)
    matched = match(frames, truth, links=links)
    tallies = list(others)
    for sent, pairs in zip(matched.bars, matched.pairs, strict=True):
        tallies += bar_tallies(sent, pairs)
    return replace(
        without_truth(frames, packets),
        tasks=1,
        events=events,
        duration_us=round(truth.duration_us),
        unmatched=matched.unmatched,
        segments=Statistics.of(tallies).segments,
    )


def without_truth(frames: Iterable[FrameRow], packets: int) -> Statistics:
    """What is counted of decoded frames without knowing what was sent."""
    frames = list(frames)
    own = [frame for frame in frames if frame.echo_of is None]
    sigmas = [in_nm(f.sigma_m) for f in own if not (math.isnan(f.distance_m) or math.isnan(f.sigma_m))]
    return Statistics(
        packets=packets,
        rows=len(frames),
        echoes=len(frames) - len(own),
        stated=len(sigmas),
        sigma_squares_nm2=sum(sigma**2 for sigma in sigmas),
    )


def message_tallies(packets: Iterable[Packet], truth: Truth, coder: BlockCoder) -> list[tuple[int, Tally]]:
    """Hold the blocks of packets against what was sent: one tally a packet, with the start of its segment."""
    bars = [bar for bar in truth.bars if bar.sends_frames and bar.payload != "symbols"]
    sent = [sent_packets(bar, truth) for bar in bars]
    tallies = []
    for _, whole, distance_m in sent:
        tallies += [(segment_of(at), Tally(messages_sent=1)) for at in distance_m[whole].tolist()]
    for packet in packets:
        if packet.block is None or not packet.frames or packet.echo_of is not None:
            continue
        t_us, first = packet.t_us - truth.t0_us, packet.frames[0]
        nearest = nearest_bar(bars, truth, t_us, first.x_px, first.y_px)
        bar = 0 if nearest is None else nearest[0]
        number = None if nearest is None else find_start(sent[bar][0], t_us, bars[bar].link.packet)
        if number is None:
            tallies.append((0, Tally(messages_wrong=1)))
            continue
        _, whole, distance_m = sent[bar]
        read = coder.encode_symbols(packet.block.pack(coder.block_bytes))
        if not np.array_equal(read, bars[bar].symbols[number]):
            tallies.append((segment_of(float(distance_m[number])), Tally(messages_wrong=1)))
        elif whole[number]:
            tallies.append((segment_of(float(distance_m[number])), Tally(messages_found=1)))
    return tallies


def sites_seen(
    packets: Sequence[Packet], truth: Truth, sites: Sequence[BarSite] | None = None
) -> list[BarSite]:
    """Sites of a truth's bars, each with the number that the receiver gave to its transmitter.

    `sites` are what is reported of the bars' places, in their order; None for the truth.
    """
    found = list(truth.sites if sites is None else sites)
    first: dict[int, Frame] = {}
    for packet in packets:
        for frame in packet.frames:
            if frame.echo_of is None:
                first.setdefault(packet.transmitter, frame)
    for number, frame in first.items():
        nearest = nearest_bar(truth.bars, truth, frame.t_us - truth.t0_us, frame.x_px, frame.y_px)
        if nearest is not None and nearest[1] <= NEAREST_PX and found[nearest[0]].transmitter is None:
            found[nearest[0]] = replace(found[nearest[0]], transmitter=number)
    return found


def position_tallies(
    packets: Sequence[Packet],
    truth: Truth,
    link: Link,
    attitude: AttitudeLog | None,
    sites: Sequence[BarSite] | None = None,
) -> list[tuple[int, Tally]]:
    """Hold positions and track that follow from packets against the truth, tallies a time by the nearest bar.

    Which transmitter stands where is what the image shows, so that no beacon is needed.
    """
    navigator = Navigator(link, PositionPlan(tuple(sites_seen(packets, truth, sites))), attitude)
    placed = navigator.feed(packets)
    rest, settled = navigator.close()
    placed += rest
    axes, path, times = navigator.positioner.axes, truth.camera_path, truth.t_us

    def at(t_us: float) -> tuple[int, np.ndarray]:
        since = t_us - truth.t0_us
        segment = segment_of(min(float(np.interp(since, times, bar.distance_m)) for bar in truth.bars))
        keys = ("latitude_deg", "longitude_deg", "height_m")
        assert axes is not None
        return segment, axes.to_enu(*(np.interp(since, times, path[key]) for key in keys))

    tallies = []
    for fix in (one.fix for one in placed):
        segment, true_m = at(fix.t_us)
        if fix.refusal:
            contradicted = fix.refusal in CONTRADICTIONS
            tallies.append((segment, Tally(fixes_refused=1, fixes_contradicted=int(contradicted))))
            continue
        error = fix.enu_m - true_m
        one = Tally.fix(
            *_off(error, fix.covariance_m2),
            excluded=bool(fix.excluded),
            protected=math.isfinite(fix.hpl_m) and math.isfinite(fix.vpl_m),
            beyond=math.hypot(error[0], error[1]) > fix.hpl_m or abs(error[2]) > fix.vpl_m,
        )
        tallies.append((segment, one))
    for point in (*(p for one in placed for p in one.settled), *settled):
        segment, true_m = at(point.fix.t_us)
        both = (point.filtered, point.smoothed)
        found = (v for place in both for v in _off(place.enu_m - true_m, place.covariance_m2))
        tallies.append((segment, Tally.tracked(*found)))
    return tallies


def _off(error_m: np.ndarray, covariance_m2: np.ndarray) -> tuple[float, float]:
    """An error in space, m, and squared in its own sigmas."""
    return float(np.linalg.norm(error_m)), float(error_m @ np.linalg.solve(covariance_m2, error_m))
