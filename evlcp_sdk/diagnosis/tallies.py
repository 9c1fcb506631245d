"""The figures of a summary, counted as packets and positions come, in constant memory."""

from __future__ import annotations

import math
from collections import Counter, OrderedDict
from collections.abc import Mapping
from copy import copy
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.formatting import round_or_none, sigmas
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.values import Fix, Frame, Packet, ReceivedMessage

if TYPE_CHECKING:
    from evlcp_sdk.place.navigator import EstimatedBias, Navigator, Placed

_CELL_M = 0.01
_FARTHEST_M = 1_000.0
"""Medians know no distance beyond: a hundred thousand cells are enough."""

_MOST_TRANSMITTERS = 1024
"""Transmitters with figures of their own; of more, those not received for longest are only counted."""

_MOST_CLOCK_ERROR = 0.01
"""Of a step between packets from the one that is stated."""

_CHIP_ERROR = 1e-4
"""The same from that by the chips that the packet was read by: characters may come behind another pause."""

SURE = 0.8
"""Mean quality of frames from which their symbols are the link's; below, light may be too weak, or the
modulation another one."""

_BY_CHANCE = 1e-6
"""Probability of a finding by chance below which it is stated."""

MOST_MESSAGES = 20
"""Messages that a summary shows, the newest."""

_MOST_SAID = 2000
"""Characters of a message, or of a transmitter of characters, that it shows; `packets.jsonl` has all."""


@dataclass
class TransmitterTally:
    """Running figures of one transmitter, in constant memory.

    Args:
        packet_frames: Frames that a packet has.
        nominal_packet_us: Length of a packet that the configuration states, us.
        link: Name of its link, where there are several.
        number: Its number.

    Attributes:
        first_us: Start of its first frame, us; its last one starts at `last_us`.
        reach_sum: Sum over `sized` frames of the logarithm of the distance, m, times how far apart the first
            and the last cluster are in the image, px.
        along_px: Sum of the ways from the first to the last, right and down, px.
        blocks: Packets whose block is read.
        firsts: Its first symbols, where a frame has one; -1 for one that was not received.
        passed_px: Where it has been in the image: left, top, right, bottom.
        packet_chips: Chips of a packet; 0 where nobody says. Sum of their lengths by packets: `chips_us`.
        beacon_m: Length of the bar by its newest beacon, m; NaN without.
        bent: Frames in which its image is bent; mean sigma of their distances, m: `bent_sigma_m`.
        bent_px: In how many of them each boundary is seen, sum of how far it lies off, px, and of the squares
            of that, float64 (3, K - 1); empty before the first.
    """

    packet_frames: int
    nominal_packet_us: float
    packets: int = 0
    frames: int = 0
    first_frame: int = -1
    last_frame: int = -1
    last_packet: tuple[int, float] = (0, math.nan)
    steps_us: float = 0.0
    nominal_steps_us: float = 0.0
    quality_sum: float = 0.0
    ranged: int = 0
    first_m: float = math.nan
    last_m: float = math.nan
    cells: Counter[int] = field(default_factory=Counter)
    echoes: int = 0
    echo_of: int | None = None
    values: Counter[int] = field(default_factory=Counter)
    unseen: Counter[int] = field(default_factory=Counter)
    first_us: float = math.inf
    last_us: float = -math.inf
    reach_sum: float = 0.0
    sized: int = 0
    along_px: tuple[float, float] = (0.0, 0.0)
    beacon_m: float = math.nan
    bent: int = 0
    bent_sigma_m: float = 0.0
    bent_px: NDArray[np.float64] = field(default_factory=lambda: np.zeros((3, 0)))
    blocks: int = 0
    firsts: list[int] = field(default_factory=list)
    passed_px: tuple[float, float, float, float] = (math.inf, math.inf, -math.inf, -math.inf)
    link: str = ""
    number: int = 0
    packet_chips: int = 0
    chips_us: float = 0.0

    def add(self, packet: Packet) -> None:
        """Count a packet and its frames."""
        self.packets += 1
        self.chips_us += packet.chip_us
        self.blocks += packet.block is not None
        self.frames += len(packet.frames)
        number, t_us = self.last_packet
        steps = packet.packet - number
        step_us, nominal_us = packet.t_us - t_us, steps * self.nominal_packet_us
        own_us = steps * self.packet_chips * packet.chip_us if self.firsts else step_us
        if (
            abs(step_us - nominal_us) < _MOST_CLOCK_ERROR * nominal_us
            and abs(step_us - own_us) < 0.75 * packet.chip_us + _CHIP_ERROR * nominal_us
        ):
            self.steps_us += step_us
            self.nominal_steps_us += nominal_us
        self.last_packet = (packet.packet, packet.t_us)
        for message in packet.messages:
            if message.beacon is not None:
                self.beacon_m = message.beacon.length_m
        for frame in packet.frames:
            number = frame.packet * self.packet_frames + frame.frame
            self.first_frame = number if self.first_frame < 0 else self.first_frame
            self.last_frame = number
            left, top, right, bottom = self.passed_px
            ends_px = frame.points_px[:: max(len(frame.points_px) - 1, 1)].tolist()
            for x, y in ((frame.x_px, frame.y_px), *ends_px):
                left, top, right, bottom = min(left, x), min(top, y), max(right, x), max(bottom, y)
            self.passed_px = left, top, right, bottom
            self.first_us, self.last_us = min(self.first_us, frame.t_us), max(self.last_us, frame.t_us)
            self.quality_sum += frame.soft.quality
            self.echoes += frame.echo_of is not None
            self.echo_of = frame.echo_of
            symbols = frame.soft.symbols.tolist()
            self.values.update([s for s in symbols if s >= 0])
            if len(symbols) == 1 and len(self.firsts) < _MOST_SAID:
                self.firsts += symbols
            self.unseen.update([k for k, s in enumerate(symbols) if s < 0])
            distance_m = frame.range.distance_m
            if math.isfinite(distance_m):
                self.ranged += 1
                self.last_m = distance_m
                if self.ranged == 1:
                    self.first_m = distance_m
                self.cells[round(min(distance_m, _FARTHEST_M) / _CELL_M)] += 1
                if frame.echo_of is None:
                    # A mirror image stands on its head.
                    self._add_shape(frame)

    def _add_shape(self, frame: Frame) -> None:
        """Add how long the bar looks times its distance, which is the same wherever it is, and how bent."""
        x, y = (frame.points_px[-1:] - frame.points_px[:1]).sum(0).tolist()
        reach = frame.range.distance_m * math.hypot(x, y)
        if math.isfinite(reach) and reach > 0:
            self.reach_sum += math.log(reach)
            self.sized += 1
            self.along_px = (self.along_px[0] + x, self.along_px[1] + y)
        if frame.range.distortion_px is not None:
            seen = np.isfinite(frame.range.distortion_px)
            px = np.where(seen, frame.range.distortion_px, 0.0)
            self.bent += 1
            self.bent_px = np.stack([seen, px, px**2]) + (self.bent_px if self.bent_px.size else 0.0)
            self.bent_sigma_m += (frame.range.sigma_m - self.bent_sigma_m) / self.bent

    def median_m(self) -> float:
        """Median distance to the centimetre, m; NaN without any."""
        seen = 0
        for cell in sorted(self.cells):
            seen += self.cells[cell]
            if 2 * seen >= self.ranged:
                return round(cell * _CELL_M, 2)
        return math.nan

    @property
    def given(self) -> int:
        """Symbols that are given."""
        return self.values.total()

    @property
    def erased(self) -> int:
        """Symbols that are not, as their cluster was not seen."""
        return self.unseen.total()

    def clock_ppm(self) -> float:
        """The transmitter's chip rate against the camera's clock, ppm; NaN before the second packet.

        Taken from the times of the packets, so it is the surer the longer the recording; a step from one
        packet to the next that no clock explains, as after a loss of lock, is left out. Of characters behind
        pauses that nobody stated it is that of their bits.
        """
        if self.steps_us:
            return (self.nominal_steps_us / self.steps_us - 1) * 1e6
        if self.firsts and self.packets > 1 and self.packet_chips:
            return (self.nominal_packet_us / self.packet_chips * self.packets / self.chips_us - 1) * 1e6
        return math.nan

    def to_dict(self) -> dict[str, Any]:
        """The figures as JSON values; what was never measured is null.

        `frames_expected` counts what was sent from the first decoded frame to the last; `echo_of` is what the
        newest frame says.
        """
        return {
            **({"link": self.link} if self.link else {}),
            "packets": self.packets,
            "frames_found": self.frames,
            "frames_expected": self.last_frame - self.first_frame + 1 if self.frames else 0,
            "echo_of": self.echo_of,
            "frames_echo": self.echoes,
            "symbols_given": self.given,
            "symbols_erased": self.erased,
            "quality": round_or_none(self.quality_sum / self.frames if self.frames else math.nan, 4),
            "clock_ppm": round_or_none(self.clock_ppm(), 2),
            "frames_ranged": self.ranged,
            "distance_first_m": round_or_none(self.first_m, 4),
            "distance_last_m": round_or_none(self.last_m, 4),
            "distance_median_m": round_or_none(self.median_m(), 2),
        }


def count_missing_codewords(one: TransmitterTally, link: Link) -> int:
    """How many codewords never occur in what a transmitter sent, 0 where that may be chance or a text's.

    Packets may repeat one another, so that all of them say no more than one.
    """
    codewords = link.codebook.data_symbols
    never = codewords - sum(symbol < codewords for symbol in one.values)
    if not one.given or not never or (link.characters_on_air and not one.blocks):
        return 0
    if never == codewords:
        return never
    # Equally likely codewords; the union of all sets of so many bounds the chance that they never occur.
    ways = math.lgamma(codewords + 1) - math.lgamma(never + 1) - math.lgamma(codewords - never + 1)
    given = min(one.given, link.packet.frames * link.codebook.clusters)
    chance = ways + given * math.log1p(-never / codewords)
    return never if chance < math.log(_BY_CHANCE) else 0


class RunTally:
    """Running figures of all transmitters.

    Args:
        form: Lengths of a packet's parts; where there are several links, by the name of each.

    Attributes:
        transmitters: Figures by number.
        others: Transmitters whose figures were dropped, as there are too many; a number may come twice.
        others_frames: Their frames.
        covered_us: Time in which frames of any transmitter were received, us; a packet counts as a whole.
    """

    def __init__(self, form: PacketFormat | Mapping[str, PacketFormat]) -> None:
        self.transmitters: OrderedDict[int, TransmitterTally] = OrderedDict()
        self.others = self.others_frames = 0
        self.covered_us = 0.0
        self._messages: OrderedDict[tuple[int, int, int], ReceivedMessage] = OrderedDict()
        self._forms = {"": form} if isinstance(form, PacketFormat) else form
        self._until_us = -math.inf

    def add(self, *packets: Packet) -> None:
        """Count packets and their frames."""
        for packet in packets:
            self._add(packet)

    def _add(self, packet: Packet) -> None:
        form = self._forms[packet.link]
        packet_us = form.packet_us
        if packet.transmitter not in self.transmitters:
            self.transmitters[packet.transmitter] = TransmitterTally(
                *(packet.sent, packet_us),
                link=packet.link,
                number=packet.transmitter,
                packet_chips=form.packet_chips,
            )
        self.transmitters[packet.transmitter].add(packet)
        for message in packet.messages:
            said = message.message
            key = (said.transmitter_id, said.kind, said.sequence)
            # A beacon's trust may change later.
            self._messages.pop(key, None)
            self._messages[key] = message
            if len(self._messages) > MOST_MESSAGES:
                self._messages.popitem(last=False)
        end_us = packet.t_us + packet_us
        self.covered_us += min(max(end_us - max(packet.t_us, self._until_us), 0.0), packet_us)
        self._until_us = end_us
        self.transmitters.move_to_end(packet.transmitter)
        if len(self.transmitters) > _MOST_TRANSMITTERS:
            self.others += 1
            self.others_frames += self.transmitters.popitem(last=False)[1].frames

    def of_link(self, name: str) -> RunTally:
        """The same of the transmitters of a link alone."""
        part = copy(self)
        part.transmitters = OrderedDict((n, one) for n, one in self.transmitters.items() if one.link == name)
        return part

    @property
    def own(self) -> list[TransmitterTally]:
        """Figures of the transmitters that are no reflections."""
        return [one for one in self.transmitters.values() if one.frames > one.echoes]

    @property
    def quality(self) -> float:
        """Mean quality of their frames; 0 without any."""
        own = self.own
        return sum(one.quality_sum for one in own) / max(sum(one.frames for one in own), 1)

    def headline(self) -> str:
        """What was found, in one sentence."""
        if not self.transmitters:
            return "no transmitter was found"
        tallies = self.transmitters.values()
        # Its first frames may not have been known to be a reflection's.
        own = [t.frames for t in tallies if t.echo_of is None]
        echoes = [t.frames for t in tallies if t.echo_of is not None]
        others = [self.others_frames] + [0] * (self.others - 1) if self.others else []
        parts = ((own, "transmitter"), (echoes, "reflection"), (others, "earlier one"))
        return "; ".join(
            f"{len(frames)} {what}{'s' * (len(frames) > 1)}, {sum(frames)} frame{'s' * (sum(frames) != 1)}"
            for frames, what in parts
            if frames
        )

    def messages(self) -> list[dict[str, Any]]:
        """The newest messages as JSON values: what each says, who sent it, and how far it may be believed."""
        return [
            {
                "kind": one.kind.name,
                "transmitter": one.transmitter,
                **({"link": one.link} if one.link else {}),
                "transmitter_id": one.message.transmitter_id,
                "t_us": round(one.t_us, 2),
                "trust": one.trust,
                "said": one.summary(_MOST_SAID),
            }
            for one in self._messages.values()
        ]

    def to_list(self) -> list[dict[str, Any]]:
        """The figures of each transmitter as JSON values."""
        return [{"transmitter": n} | tally.to_dict() for n, tally in sorted(self.transmitters.items())]


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
        """The figures as JSON values, with what is known of the bars in the end."""
        positioner = navigator.positioner
        axes, offset_m = positioner.axes, navigator.gnss_offset_m
        return {
            "fixes": self.given,
            "fixes_verified": self.verified,
            "last": None if self.last is None else _last(self.last),
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
            "sites_contradicted": {str(n): how for n, how in positioner.bars.contradictions.items()},
            "learnt": [_learnt_row(one) for one in navigator.estimate_biases()],
            "origin": asdict(axes) if axes is not None else None,
            "bars_exact": [n for n, s in positioner.bars.known_sites.items() if s.position_sigma_m is None],
            "heard": {str(n): one for n, one in sorted(positioner.bars.ids.items())},
            "sites_unseen": [site.transmitter_id for site in positioner.bars.unseen_sites],
            "bars": {str(n): s.transmitter_id for n, s in positioner.bars.known_sites.items()},
        }


def _last(fix: Fix) -> dict[str, Any]:
    return {
        "t_us": round(fix.t_us, 1),
        "latitude_deg": round(fix.latitude_deg, 10),
        "longitude_deg": round(fix.longitude_deg, 10),
        "height_m": round(fix.height_m, 4),
        "sigma_m": [round(value, 4) for value in sigmas(fix.covariance_m2)],
        "heading_deg": round_or_none(fix.heading_deg, 4),
    }


def _learnt_row(one: EstimatedBias) -> dict[str, Any]:
    names = ("correction", "sigma", "stated_sigma")
    numbers = {name: float(f"{getattr(one, name):.6g}") for name in names}
    return {"part": one.part, "what": one.what, **numbers, "determined": one.determined}
