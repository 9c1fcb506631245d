"""Decoded frames held against the truth: what was found, which bits are wrong, how far distances are off."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.link.blocks import BlockCoder
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.place.positioner import Positioner
from evlcp_sdk.scene.attitude import AttitudeLog
from evlcp_sdk.scene.sites import BarSite
from evlcp_sdk.study.tally import Statistics, Tally, segment_of
from evlcp_sdk.values import Frame, Packet

__all__ = ["message_tallies", "position_tallies", "statistics_of"]

_MOST_LATE_US = 800.0
_MOST_APART_PX = 60.0
_TAIL_US = 200.0
_MIDDLE_OF_PILOT_US = 800.0


def statistics_of(
    frames: Iterable[Frame],
    known: Mapping[str, Any],
    events: int,
    others: Iterable[tuple[int, Tally]] = (),
) -> Statistics:
    """Hold decoded frames against the truth, each beside the sent one that began nearest on the nearest bar.

    Args:
        frames: The decoded frames.
        known: The truth of the scene.
        events: Events that the sensor sent.
        others: What `message_tallies` and `position_tallies` gave.
    """
    duration_us = known["scene"]["duration_s"] * 1e6
    bars = [_Sent(known, i) for i, bar in enumerate(known["bars"]) if _sends_frames(bar)]
    tallies: list[tuple[int, Tally]] = [
        (segment_of(at), Tally.sent()) for bar in bars for at in bar.distance_m.tolist()
    ]
    unmatched = 0
    for frame in frames:
        t_us = frame.t_us - known["scene"]["t0_us"]
        near = min(bars, key=lambda bar: bar.sight.apart_px(t_us, frame), default=None)
        place = None if near is None else near.take(t_us, frame)
        if near is None or place is None:
            cut = near is not None and near.sight.apart_px(t_us, frame) <= _MOST_APART_PX
            unmatched += not (cut and (t_us < _TAIL_US or t_us + 3400 > duration_us))
            continue
        heard = frame.soft.symbols.tolist()
        sent = near.symbols[place]
        errors = sum((a ^ b).bit_count() for a, b in zip(heard, sent, strict=True))
        distance_m, true_m = frame.range.distance_m, float(near.distance_m[place])
        error_m = distance_m - true_m if np.isfinite(distance_m) else None
        bits = near.bits_per_symbol(frame) * len(sent)
        tallies.append((segment_of(true_m), Tally.found(bits, errors, error_m)))
    tallies += others
    return Statistics.of(1, events, round(duration_us), unmatched, tallies)


def message_tallies(
    packets: Iterable[Packet], known: Mapping[str, Any], coder: BlockCoder
) -> list[tuple[int, Tally]]:
    """Hold the blocks of packets against what was sent: one tally a packet, with the begin of its segment.

    Args:
        packets: The received packets.
        known: The truth of the scene.
        coder: How packets carry blocks.
    """
    bars = [_SentPackets(known, i) for i, bar in enumerate(known["bars"]) if bar.get("payload")]
    tallies = [(segment_of(at), Tally(messages_sent=1)) for bar in bars for at in bar.whole_m()]
    for packet in packets:
        if packet.block is None or not packet.frames:
            continue
        t_us = packet.t_us - known["scene"]["t0_us"]
        near = min(bars, key=lambda bar: bar.sight.apart_px(t_us, packet.frames[0]), default=None)
        number = None if near is None else near.number(t_us)
        if near is None or number is None:
            tallies.append((0, Tally(messages_wrong=1)))
            continue
        said = coder.symbols(packet.block.pack(coder.block_bytes)).tolist()
        segment = segment_of(float(near.distance_m[number]))
        if said != near.symbols[number]:
            tallies.append((segment, Tally(messages_wrong=1)))
        elif near.whole[number]:
            tallies.append((segment, Tally(messages_found=1)))
    return tallies


def position_tallies(
    packets: Sequence[Packet], known: Mapping[str, Any], link: Link, attitude: AttitudeLog | None
) -> list[tuple[int, Tally]]:
    """Hold the positions that follow from packets against the truth: one tally a time, by the nearest bar.

    Which transmitter stands where is what the image shows, so that no beacon is needed.

    Args:
        packets: The received packets.
        known: The truth of the scene, with its `sites`.
        link: The link they were received with.
        attitude: What is known of the camera's attitude; None for nothing.
    """
    sights = [_Sight(known, i) for i in range(len(known["bars"]))]
    sites = [BarSite(**site) for site in known["sites"]]
    t0_us, path = known["scene"]["t0_us"], known["camera_path"]
    first: dict[int, Frame] = {}
    for packet in packets:
        for frame in packet.frames:
            first.setdefault(packet.transmitter, frame)
    for number, frame in first.items():
        away = [sight.apart_px(frame.t_us - t0_us, frame) for sight in sights]
        i = int(np.argmin(away))
        if away[i] <= _MOST_APART_PX and sites[i].transmitter is None:
            sites[i] = replace(sites[i], transmitter=number)
    positioner = Positioner(
        link.camera,
        link.bar.clusters,
        link.packet.packet_chips * link.packet.chip_us,
        sites,
        (lambda _: None) if attitude is None else attitude.at,
        link.position,
    )
    frame_of = positioner.frame
    assert frame_of is not None
    t_us = np.array(known["t_s"]) * 1e6
    tallies = []
    for fix in [*positioner.feed(packets), *positioner.close()]:
        at = fix.t_us - t0_us
        segment = segment_of(min(float(np.interp(at, t_us, depth)) for depth in known["distance_m"]))
        if fix.refusal:
            tallies.append((segment, Tally(fixes_refused=1)))
            continue
        place = (np.interp(at, t_us, path[key]) for key in ("latitude_deg", "longitude_deg", "height_m"))
        error = fix.enu_m - frame_of.to_enu(*place)
        nees = float(error @ np.linalg.solve(fix.covariance_m2, error))
        tallies.append((segment, Tally.fix(float(np.linalg.norm(error)), nees)))
    return tallies


class _Sight:
    """Where a bar is in the image."""

    def __init__(self, known: Mapping[str, Any], number: int) -> None:
        self._t_us = np.array(known["t_s"]) * 1e6
        self._centre_px = np.array(known["bar_centre_px"][number])

    def apart_px(self, t_us: float, frame: Frame) -> float:
        """How far a frame's bar lies from it."""
        x, y = (float(np.interp(t_us, self._t_us, c)) for c in self._centre_px)
        return float(np.hypot(frame.x_px - x, frame.y_px - y))


class _SentPackets:
    """The packets that a bar sent, at least in part, while the recording ran."""

    def __init__(self, known: Mapping[str, Any], number: int) -> None:
        bar = known["bars"][number]
        rate_hz = bar.get("chip_rate_hz", 1e4) * (1 + bar["ppm"] * 1e-6)
        period_us = bar["packet_chips"] / rate_hz * 1e6
        self.symbols = bar["symbols"]
        self.sight = _Sight(known, number)
        self._start_us = np.arange(len(self.symbols)) * period_us - bar["start_chip"] / rate_hz * 1e6
        end_us = known["scene"]["duration_s"] * 1e6
        self.whole = (self._start_us >= 0) & (self._start_us + period_us + _TAIL_US < end_us)
        depth_m = np.array(known["distance_m"][number])
        t_us = np.array(known["t_s"]) * 1e6
        self.distance_m = np.interp(self._start_us + period_us / 2, t_us, depth_m)

    def whole_m(self) -> list[float]:
        """Distance of each packet that was sent whole, m."""
        return [float(at) for at in self.distance_m[self.whole]]

    def number(self, t_us: float) -> int | None:
        """The packet that began at a time; None if there is none."""
        nearest = int(np.argmin(np.abs(self._start_us - t_us)))
        return nearest if abs(self._start_us[nearest] - t_us) <= _MOST_LATE_US else None


def _sends_frames(bar: Mapping[str, Any]) -> bool:
    """Whether the bar is lit and sends packets, not just any chips."""
    lit = bar.get("led_w_m2") is None or bar["led_w_m2"] > 1e-6
    return lit and bar.get("chips_file") is None


class _Sent:
    """The frames that a bar sent whole while the recording ran, each of which may be found once."""

    def __init__(self, known: Mapping[str, Any], number: int) -> None:
        bar = known["bars"][number]
        self.sight = _Sight(known, number)
        rate_hz = bar.get("chip_rate_hz", 1e4) * (1 + bar["ppm"] * 1e-6)
        end_us = known["scene"]["duration_s"] * 1e6
        starts, self.symbols = [], []
        for start_us, chips, symbols in _frames_of(bar, rate_hz):
            if start_us >= 0 and start_us + chips / rate_hz * 1e6 + _TAIL_US < end_us:
                starts.append(start_us)
                self.symbols.append(symbols)
        self._start_us = np.array(starts)
        depth_m = np.array(known["distance_m"][number])
        t_us = np.array(known["t_s"]) * 1e6
        self.distance_m = np.interp(self._start_us + _MIDDLE_OF_PILOT_US, t_us, depth_m)
        self._taken: set[int] = set()

    def take(self, t_us: float, frame: Frame) -> int | None:
        """Number of the sent frame that this is; None if it is none, or was found before."""
        if not len(self._start_us) or self.sight.apart_px(t_us, frame) > _MOST_APART_PX:
            return None
        nearest = int(np.argmin(np.abs(self._start_us - t_us)))
        if abs(self._start_us[nearest] - t_us) > _MOST_LATE_US or nearest in self._taken:
            return None
        self._taken.add(nearest)
        return nearest

    @staticmethod
    def bits_per_symbol(frame: Frame) -> int:
        """Bits of each symbol of the frame."""
        return int(frame.soft.llr.shape[1])


def _frames_of(bar: Mapping[str, Any], rate_hz: float) -> Iterator[tuple[float, int, Sequence[int]]]:
    """Start (us), chips and symbols of every frame."""
    bare = PacketFormat(0, 16, 16, bar["frames"], pilot_every=bar.get("pilot_every", 1))
    form = replace(bare, preamble_chips=bar["packet_chips"] - bare.packet_chips)
    for packet, frames in enumerate(bar["symbols"]):
        for frame, symbols in enumerate(frames):
            first, last = form.frame_start_chip(frame), form.frame_start_chip(frame + 1)
            chip = packet * bar["packet_chips"] + first
            yield (chip - bar["start_chip"]) / rate_hz * 1e6, last - first, symbols
