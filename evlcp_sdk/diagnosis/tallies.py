"""The figures of a summary, counted as packets and positions come, in constant memory."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from copy import copy
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.formatting import round_or_none
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.values import (
    Fix,
    Frame,
    Packet,
    ReceivedMessage,
    find_quantile_bin,
    remember_newest,
    sigmas,
)

if TYPE_CHECKING:
    from evlcp_sdk.place.navigator import EstimatedBias, Navigator, Placed

_CELL_M = 0.01
_MAX_DISTANCE_M = 1_000.0
"""Of distances in medians: a hundred thousand cells are enough."""

_MAX_TRANSMITTERS = 1024
"""Transmitters with figures of their own; beyond, those not received for longest are only counted."""

_MAX_CLOCK_ERROR = 0.01
"""Relative, of a step between packets from the configured one."""

_CHIP_ERROR = 1e-4
"""The same from the step by the packet's own chips: characters may follow another pause."""

SURE = 0.8
"""Mean quality of frames from which on their symbols are reliable; below, light may be too weak, or the
modulation another one."""

_MAX_CHANCE = 1e-6
"""Probability by chance below which a finding is reported."""

MAX_MESSAGES = 20
"""Newest messages that a summary lists."""

_MAX_CHARACTERS = 2000
"""Characters that it gives of a message, or of a transmitter of characters; `packets.jsonl` has all."""


@dataclass
class TransmitterTally:
    """Running figures of one transmitter, in constant memory.

    Args:
        form: Lengths of its packets' parts, by the configuration.
        link: Name of its link, where there are several.
        number: Its number.

    Attributes:
        first_us: Start of its first frame, us; its last one starts at `last_us`.
        reach_sum: Sum over `sized_frames` of the logarithm of the distance, m, times the length in the image
            from the first cluster to the last, px.
        along_px: Sum of the vectors from the first to the last, right and down, px.
        blocks: Packets whose block is decoded.
        first_symbols: Its first symbols, where a frame has one; -1 for one that was not received.
        path_box_px: Where it has been in the image: left, top, right, bottom.
        chips_us: Sum of the lengths of a chip over its packets, us.
        beacon_m: Length of the bar by its newest beacon, m; NaN without.
        distorted_frames: Frames whose image is distorted.
        distortion_sigma_m: Mean sigma of their distances, m.
        distortion_px: Number of them that show each boundary, sum of its offsets, px, and of their squares,
            float64 (3, K - 1); empty before the first.
    """

    form: PacketFormat
    packets: int = 0
    frames: int = 0
    first_frame: int = -1
    last_frame: int = -1
    last_packet: tuple[int, float] = (0, math.nan)
    steps_us: float = 0.0
    nominal_steps_us: float = 0.0
    quality_sum: float = 0.0
    ranged_frames: int = 0
    first_m: float = math.nan
    last_m: float = math.nan
    distance_cells: Counter[int] = field(default_factory=Counter)
    echo_frames: int = 0
    echo_of: int | None = None
    symbol_counts: Counter[int] = field(default_factory=Counter)
    unseen_counts: Counter[int] = field(default_factory=Counter)
    first_us: float = math.inf
    last_us: float = -math.inf
    reach_sum: float = 0.0
    sized_frames: int = 0
    along_px: tuple[float, float] = (0.0, 0.0)
    beacon_m: float = math.nan
    distorted_frames: int = 0
    distortion_sigma_m: float = 0.0
    distortion_px: NDArray[np.float64] = field(default_factory=lambda: np.zeros((3, 0)))
    blocks: int = 0
    first_symbols: list[int] = field(default_factory=list)
    path_box_px: tuple[float, float, float, float] = (math.inf, math.inf, -math.inf, -math.inf)
    link: str = ""
    number: int = 0
    chips_us: float = 0.0

    def add(self, packet: Packet) -> None:
        """Count a packet and its frames."""
        self.packets += 1
        self.chips_us += packet.chip_us
        self.blocks += packet.block is not None
        self.frames += len(packet.frames)
        number, t_us = self.last_packet
        steps = packet.packet - number
        step_us, nominal_us = packet.t_us - t_us, steps * self.form.packet_us
        own_us = steps * self.form.packet_chips * packet.chip_us if self.first_symbols else step_us
        if (
            abs(step_us - nominal_us) < _MAX_CLOCK_ERROR * nominal_us
            and abs(step_us - own_us) < 0.75 * packet.chip_us + _CHIP_ERROR * nominal_us
        ):
            self.steps_us += step_us
            self.nominal_steps_us += nominal_us
        self.last_packet = (packet.packet, packet.t_us)
        for message in packet.messages:
            if message.beacon is not None:
                self.beacon_m = message.beacon.length_m
        for frame in packet.frames:
            number = frame.packet * self.form.frames + frame.frame
            self.first_frame = number if self.first_frame < 0 else self.first_frame
            self.last_frame = number
            left, top, right, bottom = self.path_box_px
            ends_px = frame.points_px[:: max(len(frame.points_px) - 1, 1)].tolist()
            for x, y in ((frame.x_px, frame.y_px), *ends_px):
                left, top, right, bottom = min(left, x), min(top, y), max(right, x), max(bottom, y)
            self.path_box_px = left, top, right, bottom
            self.first_us, self.last_us = min(self.first_us, frame.t_us), max(self.last_us, frame.t_us)
            self.quality_sum += frame.soft.quality
            self.echo_frames += frame.echo_of is not None
            self.echo_of = frame.echo_of
            symbols = frame.soft.symbols.tolist()
            self.symbol_counts.update([s for s in symbols if s >= 0])
            if len(symbols) == 1 and len(self.first_symbols) < _MAX_CHARACTERS:
                self.first_symbols += symbols
            self.unseen_counts.update([k for k, s in enumerate(symbols) if s < 0])
            distance_m = frame.range.distance_m
            if math.isfinite(distance_m):
                self.ranged_frames += 1
                self.last_m = distance_m
                if self.ranged_frames == 1:
                    self.first_m = distance_m
                self.distance_cells[round(min(distance_m, _MAX_DISTANCE_M) / _CELL_M)] += 1
                if frame.echo_of is None:
                    # A mirror image is upside down.
                    self._add_shape(frame)

    def _add_shape(self, frame: Frame) -> None:
        """Add the bar's length in the image times its distance, a constant, and the image's distortion."""
        x, y = (frame.points_px[-1:] - frame.points_px[:1]).sum(0).tolist()
        reach = frame.range.distance_m * math.hypot(x, y)
        if math.isfinite(reach) and reach > 0:
            self.reach_sum += math.log(reach)
            self.sized_frames += 1
            self.along_px = (self.along_px[0] + x, self.along_px[1] + y)
        if frame.range.distortion_px is not None:
            seen = np.isfinite(frame.range.distortion_px)
            px = np.where(seen, frame.range.distortion_px, 0.0)
            self.distorted_frames += 1
            self.distortion_px = np.stack([seen, px, px**2]) + (
                self.distortion_px if self.distortion_px.size else 0.0
            )
            self.distortion_sigma_m += (frame.range.sigma_m - self.distortion_sigma_m) / self.distorted_frames

    def median_m(self) -> float:
        """Median distance to the centimetre, m; NaN without any."""
        cell = find_quantile_bin(self.distance_cells, 0.5)
        return math.nan if cell is None else round(cell * _CELL_M, 2)

    @property
    def symbols_given(self) -> int:
        """Number of given symbols."""
        return self.symbol_counts.total()

    @property
    def symbols_erased(self) -> int:
        """Number of symbols of unseen clusters."""
        return self.unseen_counts.total()

    def clock_ppm(self) -> float:
        """The transmitter's chip rate relative to the camera's clock, ppm; NaN before the second packet.

        By the times of the packets, so it is the more precise the longer the recording; steps between packets
        that no clock explains, as after a loss of lock, are left out. Of characters after pauses of unknown
        length it is that of their bits.
        """
        if self.steps_us:
            return (self.nominal_steps_us / self.steps_us - 1) * 1e6
        if self.first_symbols and self.packets > 1:
            return (self.form.packet_us / self.form.packet_chips * self.packets / self.chips_us - 1) * 1e6
        return math.nan

    def to_dict(self) -> dict[str, Any]:
        """The figures as JSON values; what was never measured is null.

        `frames_expected` counts the frames sent from the first decoded one to the last; `echo_of` is that of
        the newest frame.
        """
        return {
            "transmitter": self.number,
            **({"link": self.link} if self.link else {}),
            "packets": self.packets,
            "frames_found": self.frames,
            "frames_expected": self.last_frame - self.first_frame + 1 if self.frames else 0,
            "echo_of": self.echo_of,
            "frames_echo": self.echo_frames,
            "symbols_given": self.symbols_given,
            "symbols_erased": self.symbols_erased,
            "quality": round_or_none(self.quality_sum / self.frames if self.frames else math.nan, 4),
            "clock_ppm": round_or_none(self.clock_ppm(), 2),
            "frames_ranged": self.ranged_frames,
            "distance_first_m": round_or_none(self.first_m, 4),
            "distance_last_m": round_or_none(self.last_m, 4),
            "distance_median_m": round_or_none(self.median_m(), 2),
        }


def count_missing_codewords(one: TransmitterTally, link: Link) -> int:
    """Number of codewords that a transmitter never sent; 0 where that may be due to chance or to a text.

    Packets may repeat one another, so only as many symbols count as one packet has.
    """
    codewords = link.codebook.data_symbols
    missing = codewords - sum(symbol < codewords for symbol in one.symbol_counts)
    if not one.symbols_given or (link.characters_on_air and not one.blocks):
        return 0
    if missing == codewords:
        return missing
    # Equally likely codewords; the union bound over all sets of so many.
    ways = math.lgamma(codewords + 1) - math.lgamma(missing + 1) - math.lgamma(codewords - missing + 1)
    given = min(one.symbols_given, link.packet.frames * link.codebook.clusters)
    chance = ways + given * math.log1p(-missing / codewords)
    return missing if chance < math.log(_MAX_CHANCE) else 0


class RunTally:
    """Running figures of all transmitters, by the lengths of a packet's parts, or these by the link's name.

    Attributes:
        transmitters: Figures by number.
        dropped_transmitters: Number of those whose figures were dropped; one that returns counts again.
        dropped_frames: Their frames.
        covered_us: Time covered by packets with frames of any transmitter, us.
    """

    def __init__(self, form: PacketFormat | Mapping[str, PacketFormat]) -> None:
        self.transmitters: dict[int, TransmitterTally] = {}
        self.dropped_transmitters = self.dropped_frames = 0
        self.covered_us = 0.0
        self._messages: dict[tuple[int, int, int], ReceivedMessage] = {}
        self._forms = {"": form} if isinstance(form, PacketFormat) else form
        self._until_us = -math.inf

    def add(self, *packets: Packet) -> None:
        """Count packets and their frames."""
        for packet in packets:
            form, number = self._forms[packet.link], packet.transmitter
            packet_us = form.packet_us
            tally = self.transmitters.get(number) or TransmitterTally(form, link=packet.link, number=number)
            tally.add(packet)
            for message in packet.messages:
                content = message.message
                key = (content.transmitter_id, content.kind, content.sequence)
                # A beacon's trust may change later.
                remember_newest(self._messages, key, message, MAX_MESSAGES)
            end_us = packet.t_us + packet_us
            self.covered_us += min(max(end_us - max(packet.t_us, self._until_us), 0.0), packet_us)
            self._until_us = end_us
            for dropped in remember_newest(self.transmitters, number, tally, _MAX_TRANSMITTERS).values():
                self.dropped_transmitters += 1
                self.dropped_frames += dropped.frames

    def of_link(self, name: str) -> RunTally:
        """The figures of one link's transmitters."""
        part = copy(self)
        part.transmitters = {n: one for n, one in self.transmitters.items() if one.link == name}
        return part

    @property
    def non_reflections(self) -> list[TransmitterTally]:
        """Figures of the transmitters that are no reflections."""
        return [one for one in self.transmitters.values() if one.frames > one.echo_frames]

    @property
    def quality(self) -> float:
        """Mean quality of their frames; 0 without any."""
        tallies = self.non_reflections
        return sum(one.quality_sum for one in tallies) / max(sum(one.frames for one in tallies), 1)

    def headline(self) -> str:
        """The transmitters and frames, in one sentence."""
        if not self.transmitters:
            return "no transmitter was found"
        tallies = self.transmitters.values()
        # Its first frames may not have been known to be a reflection's.
        own = [t.frames for t in tallies if t.echo_of is None]
        echoes = [t.frames for t in tallies if t.echo_of is not None]
        others = (
            [self.dropped_frames] + [0] * (self.dropped_transmitters - 1) if self.dropped_transmitters else []
        )
        parts = ((own, "transmitter"), (echoes, "reflection"), (others, "earlier one"))
        return "; ".join(
            f"{len(frames)} {what}{'s' * (len(frames) > 1)}, {sum(frames)} frame{'s' * (sum(frames) != 1)}"
            for frames, what in parts
            if frames
        )

    def messages(self) -> list[dict[str, Any]]:
        """The newest messages as JSON values: content, sender and trust."""
        return [
            {
                "kind": one.kind.name,
                "transmitter": one.transmitter,
                **({"link": one.link} if one.link else {}),
                "transmitter_id": one.message.transmitter_id,
                "t_us": round(one.t_us, 2),
                "trust": one.trust,
                "said": one.summary(_MAX_CHARACTERS),
            }
            for one in self._messages.values()
        ]


@dataclass
class PositionTally:
    """Running figures of the positions."""

    given: int = 0
    verified: int = 0
    left_out: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    alarms: Counter[str] = field(default_factory=Counter)
    excluded: Counter[str] = field(default_factory=Counter)
    suspects: Counter[str] = field(default_factory=Counter)
    last: Fix | None = None

    def add(self, placed: Placed) -> None:
        """Count a fix."""
        self.alarms.update(placed.fix.alarms)
        self.excluded.update(placed.fix.excluded)
        if placed.filtered is None:
            self.refused[placed.fix.refusal] += 1
            self.suspects.update(placed.fix.suspects)
            return
        if placed.fix.source != "bars":
            return
        self.given += 1
        self.last = placed.fix
        self.verified += placed.fix.verified
        self.left_out += placed.filtered.left_out

    def to_dict(self, navigator: Navigator) -> dict[str, Any]:
        """The figures as JSON values, with what is known of the bars at the end."""
        positioner = navigator.positioner
        axes, offset_m = positioner.axes, navigator.gnss_offset_m
        return {
            "fixes": self.given,
            "fixes_verified": self.verified,
            "last": None if self.last is None else _describe_fix(self.last),
            "refused": dict(sorted(self.refused.items())),
            "alarms": dict(sorted(self.alarms.items())),
            "excluded": dict(sorted(self.excluded.items())),
            "suspects": dict(sorted(self.suspects.items())),
            "focal_mm_fits": round_or_none(positioner.search_focal_mm(), 2),
            "left_out_of_track": self.left_out,
            **navigator.counts,
            "gnss_apart_m": None if offset_m is None else offset_m.round(3).tolist(),
            "frames_late": positioner.counts["frames_late"],
            "beacons_forged": positioner.counts["beacons_forged"],
            "sites_contradicted": {str(n): reason for n, reason in positioner.bars.contradictions.items()},
            "learnt": [_describe_bias(one) for one in navigator.estimate_biases()],
            "origin": asdict(axes) if axes is not None else None,
            "bars_exact": [n for n, s in positioner.bars.known_sites.items() if s.position_sigma_m is None],
            "heard": {str(n): one for n, one in sorted(positioner.bars.ids.items())},
            "sites_unseen": [site.transmitter_id for site in positioner.bars.unseen_sites],
            "bars": {str(n): s.transmitter_id for n, s in positioner.bars.known_sites.items()},
        }


def _describe_fix(fix: Fix) -> dict[str, Any]:
    return {
        "t_us": round(fix.t_us, 1),
        "latitude_deg": round(fix.latitude_deg, 10),
        "longitude_deg": round(fix.longitude_deg, 10),
        "height_m": round(fix.height_m, 4),
        "sigma_m": [round(value, 4) for value in sigmas(fix.covariance_m2)],
        "heading_deg": round_or_none(fix.heading_deg, 4),
    }


def _describe_bias(bias: EstimatedBias) -> dict[str, Any]:
    names = ("correction", "sigma", "stated_sigma")
    numbers = {name: float(f"{getattr(bias, name):.6g}") for name in names}
    return {"part": bias.part, "what": bias.what, **numbers, "determined": bias.is_determined}
