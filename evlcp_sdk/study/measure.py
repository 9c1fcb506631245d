"""Counting of decoded frames, messages and positions against the truth, as tallies that add."""

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
from evlcp_sdk.study.match import (
    NEAREST_PX,
    SentFrames,
    find_nearest_bar,
    find_sent_packets,
    find_start,
    match_frames,
)
from evlcp_sdk.study.tally import Statistics, Tally, segment_of, to_nm
from evlcp_sdk.values import Frame, Packet


def tally_bar(sent: SentFrames, pairs: Iterable[tuple[FrameRow, int]]) -> list[tuple[int, Tally]]:
    """Tally one bar's sent and decoded frames, each with the start of its segment."""
    bits = sent.bar.link.codebook.bits_per_symbol
    segments = [segment_of(at) for at in sent.distance_m.tolist()]
    tallies = [(segment, Tally(frames_sent=1)) for segment in segments]
    for frame, number in pairs:
        sent_symbols = sent.symbols[number].tolist()
        symbols = [*frame.symbols, *[-1] * len(sent_symbols)][: len(sent_symbols)]
        given = np.array([symbol >= 0 for symbol in symbols])
        visible, hidden = ~sent.cut[number], sent.hidden[number]
        received = visible & given
        errors = [symbols[k] ^ sent_symbols[k] for k in np.flatnonzero(received)]
        erased = int((visible & ~given).sum())
        tally = Tally(
            frames_found=1,
            bits=bits * int(received.sum()),
            bit_errors=sum(error.bit_count() for error in errors),
            visible=int(visible.sum()),
            erased=erased,
            erased_bits=bits * erased,
            hidden=int(hidden.sum()),
            claimed=int((hidden & given).sum()),
        )
        tallies.append((segments[number], tally))
        true_m = float(sent.distance_m[number])
        if not math.isnan(frame.distance_m):
            tallies.append((segments[number], Tally.of_distance(frame.distance_m - true_m, frame.sigma_m)))
        if not math.isnan(frame.filtered_m):
            squared = to_nm(frame.filtered_m - true_m) ** 2
            tallies.append((segments[number], Tally(filtered=1, filtered_squares_nm2=squared)))
    return tallies


def statistics_of(
    frames: Sequence[FrameRow],
    truth: Truth,
    *,
    events: int = 0,
    packets: int = 0,
    others: Iterable[tuple[int, Tally]] = (),
    links: Mapping[str, Link] | None = None,
) -> Statistics:
    """Count decoded frames against the truth.

    `others` are tallies of messages and positions; `links` are the receiver's by name, if it has several.
    """
    matched = match_frames(frames, truth, links=links)
    tallies = list(others)
    for sent, pairs in zip(matched.bars, matched.pairs, strict=True):
        tallies += tally_bar(sent, pairs)
    return replace(
        count_without_truth(frames, packets),
        tasks=1,
        events=events,
        duration_us=round(truth.duration_us),
        unmatched=matched.unmatched,
        segments=Statistics.of(tallies).segments,
    )


def count_without_truth(frames: Sequence[FrameRow], packets: int) -> Statistics:
    """Count decoded frames without a truth."""
    direct = [frame for frame in frames if frame.echo_of is None]
    sigmas = [to_nm(f.sigma_m) for f in direct if not (math.isnan(f.distance_m) or math.isnan(f.sigma_m))]
    return Statistics(
        packets=packets,
        rows=len(frames),
        echoes=len(frames) - len(direct),
        stated=len(sigmas),
        sigma_squares_nm2=sum(sigma**2 for sigma in sigmas),
    )


def tally_messages(packets: Iterable[Packet], truth: Truth, coder: BlockCoder) -> list[tuple[int, Tally]]:
    """Tally the blocks of packets against the sent ones, each with the start of its segment."""
    bars = [bar for bar in truth.bars if bar.sends_frames and bar.payload != "symbols"]
    sent = [find_sent_packets(bar, truth) for bar in bars]
    tallies = []
    for _, whole, distance_m in sent:
        tallies += [(segment_of(at), Tally(messages_sent=1)) for at in distance_m[whole].tolist()]
    for packet in packets:
        if packet.block is None or not packet.frames or packet.echo_of is not None:
            continue
        t_us, first = packet.t_us - truth.t0_us, packet.frames[0]
        bar, _ = find_nearest_bar(bars, truth, t_us, first.x_px, first.y_px) or (0, math.inf)
        number = find_start(sent[bar][0], t_us, bars[bar].link.packet) if bars else None
        if number is None:
            tallies.append((0, Tally(messages_wrong=1)))
            continue
        _, whole, distance_m = sent[bar]
        symbols = coder.encode_symbols(packet.block.pack(coder.block_bytes))
        if not np.array_equal(symbols, bars[bar].symbols[number]):
            tallies.append((segment_of(float(distance_m[number])), Tally(messages_wrong=1)))
        elif whole[number]:
            tallies.append((segment_of(float(distance_m[number])), Tally(messages_found=1)))
    return tallies


def number_sites(packets: Sequence[Packet], truth: Truth, sites: Sequence[BarSite]) -> list[BarSite]:
    """Sites of a truth's bars, in their order, each with the number of the transmitter that is seen there."""
    numbered = list(sites)
    first: dict[int, Frame] = {}
    for packet in packets:
        for frame in packet.frames:
            if frame.echo_of is None:
                first.setdefault(packet.transmitter, frame)
    for number, frame in first.items():
        nearest = find_nearest_bar(truth.bars, truth, frame.t_us - truth.t0_us, frame.x_px, frame.y_px)
        if nearest is not None and nearest[1] <= NEAREST_PX and numbered[nearest[0]].transmitter is None:
            numbered[nearest[0]] = replace(numbered[nearest[0]], transmitter=number)
    return numbered


def tally_positions(
    packets: Sequence[Packet],
    truth: Truth,
    link: Link,
    attitude: AttitudeLog | None,
    sites: Sequence[BarSite],
) -> list[tuple[int, Tally]]:
    """Tally positions and track against the truth, each with the start of the nearest bar's segment.

    The image shows which transmitter stands where, so that no beacon is needed.
    """
    navigator = Navigator(link, PositionPlan(tuple(number_sites(packets, truth, sites))), attitude)
    placed = navigator.feed(packets)
    rest, settled = navigator.close()
    placed += rest
    axes, times = navigator.positioner.axes, truth.t_us
    assert axes is not None
    # Longitudes cannot be interpolated at the 180th meridian.
    path_m = axes.to_enu(*(truth.camera_path[key] for key in ("latitude_deg", "longitude_deg", "height_m")))

    def truth_at(t_us: float) -> tuple[int, np.ndarray]:
        elapsed_us = t_us - truth.t0_us
        segment = segment_of(min(float(np.interp(elapsed_us, times, bar.distance_m)) for bar in truth.bars))
        return segment, np.array([np.interp(elapsed_us, times, column) for column in path_m.T])

    tallies = []
    for fix in (one.fix for one in placed):
        segment, true_m = truth_at(fix.t_us)
        if fix.refusal:
            contradicted = fix.refusal in CONTRADICTIONS
            tallies.append((segment, Tally(fixes_refused=1, fixes_contradicted=int(contradicted))))
            continue
        error = fix.enu_m - true_m
        one = Tally.of_fix(
            *_error_norms(error, fix.covariance_m2),
            excluded=bool(fix.excluded),
            protected=math.isfinite(fix.hpl_m) and math.isfinite(fix.vpl_m),
            beyond=math.hypot(error[0], error[1]) > fix.hpl_m or abs(error[2]) > fix.vpl_m,
        )
        tallies.append((segment, one))
    for point in (*(p for one in placed for p in one.settled), *settled):
        segment, true_m = truth_at(point.fix.t_us)
        places = (point.filtered, point.smoothed)
        errors = (v for place in places for v in _error_norms(place.enu_m - true_m, place.covariance_m2))
        tallies.append((segment, Tally.of_track_point(*errors)))
    return tallies


def _error_norms(error_m: np.ndarray, covariance_m2: np.ndarray) -> tuple[float, float]:
    """Length of an error in space, m, and its square in its own sigmas."""
    return float(np.linalg.norm(error_m)), float(error_m @ np.linalg.solve(covariance_m2, error_m))
