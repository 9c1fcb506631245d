"""Packets to positions: a pose at each time at which bars are seen."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.place.bar_registry import BarRegistry
from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.observations import BarView, Rejection
from evlcp_sdk.place.points import views_at
from evlcp_sdk.place.pose import search_focal_mm, solve_pose
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from evlcp_sdk.values import Alternative, Fix, Frame, Packet

Floats = NDArray[np.float64]


class Positioner:
    """Fixes on a fixed time grid, one per packet time, from the packets of a receiver.

    With several links, the longest packets make the grid; bars of all of them enter one fix. A fix takes the
    bars that are seen within half a packet time before and after it. The image moves in that time, with the
    vehicle's vibration, but a bar's shape hardly changes: the shape is a straight line in time through all
    frames, the place is interpolated between the frames next to the fix. Feeding packet by packet or all at
    once gives the same fixes. Reflections are left out.

    Args:
        links: The links of the bars, by the name in their packets, with one camera and one `[position]`;
            packets of others are left out.
        sites: Where the bars stand; may be empty where beacons are accepted.
        attitude_at: The camera's attitude at a time, us, as far as it is known; None if it is not.

    Attributes:
        axes: The local axes; None as long as no place is known.
        bars: Where the transmitters stand.
    """

    def __init__(
        self,
        links: Mapping[str, Link],
        sites: Sequence[BarSite],
        attitude_at: Callable[[float], Attitude | None],
    ) -> None:
        self.axes: LocalAxes | None = LocalAxes.of(sites) if sites else None
        self._links = dict(links)
        link = next(iter(links.values()))
        self._camera, self._camera_sigma = link.camera, link.camera_sigma
        self._packet_us = max(one.packet.packet_us for one in links.values())
        self._attitude_at = attitude_at
        self._spec = ErrorModel.of(link.position)
        self.bars = BarRegistry(sites, self._spec, link.name if len(links) == 1 else "")
        self._frames: dict[int, list[Frame]] = {}
        self._next: int | None = None
        self._contradiction: tuple[list[BarView], Attitude | None] | None = None
        self._counts = dict.fromkeys(("fixes", "refused", "frames_late"), 0)

    @property
    def counts(self) -> dict[str, int]:
        """Fixes given and refused, frames too late for theirs, forged beacons."""
        return self._counts | {"beacons_forged": self.bars.forged}

    def search_focal_mm(self) -> float:
        """The focal length with which the first contradictory views fit, mm; NaN if there is none."""
        if self._contradiction is None:
            return math.nan
        views, attitude = self._contradiction
        return search_focal_mm(views, self._camera, attitude, self._spec, self._camera_sigma)

    def feed(self, packets: Iterable[Packet]) -> list[Fix]:
        """Process the next packets; return the fixes that no later packet can change."""
        fixes = []
        for packet in packets:
            if packet.link not in self._links:
                continue
            self.bars.add_packet(packet)
            if packet.echo_of is not None:
                # Its earlier frames are of a reflection, too.
                self._frames.pop(packet.transmitter, None)
            link = self._links[packet.link]
            for frame in packet.frames if packet.echo_of is None else ():
                if len(frame.points_px) != link.bar.clusters or not np.isfinite(frame.points_t_us):
                    continue
                number = math.ceil(frame.points_t_us / self._packet_us - 0.5)
                if self._next is None:
                    self._next = number
                # A frame too late for its own grid time may still serve the next as a neighbour.
                self._counts["frames_late"] += number < self._next
                self._frames.setdefault(packet.transmitter, []).append(frame)
            # A packet of another bar that starts half a packet after a fix is complete one packet later;
            # longer packets that are not yet complete have begun earlier than this one.
            earlier = 1 - link.packet.packet_us / self._packet_us
            fixes += self._compute_until(packet.t_us / self._packet_us - 1.5 - earlier)
        return fixes

    def links_of(self, fix: Fix) -> str:
        """Names of the links of a fix's transmitters, each once."""
        return " ".join(dict.fromkeys(self.bars.link_of(number) for number in fix.transmitters))

    def close(self) -> list[Fix]:
        """End the stream; return the rest of the fixes."""
        last = max((f.points_t_us for kept in self._frames.values() for f in kept), default=-math.inf)
        return self._compute_until(last / self._packet_us + 0.5)

    def _compute_until(self, limit: float) -> list[Fix]:
        """Compute the fixes of the grid times up to a limit, in packet times."""
        fixes = []
        while self._next is not None and self._next <= limit:
            t_us = self._next * self._packet_us
            fix = self._compute_fix(t_us)
            if fix is not None:
                self._counts["refused" if fix.refusal else "fixes"] += 1
                fixes.append(fix)
            self._next += 1
            remaining = {n: [f for f in kept if f.points_t_us > t_us] for n, kept in self._frames.items()}
            self._frames = {number: kept for number, kept in remaining.items() if kept}
            times_us = [f.points_t_us for kept in self._frames.values() for f in kept]
            # With nothing in view, the grid goes on with the next frame.
            first = math.ceil(min(times_us) / self._packet_us - 0.5) if times_us else None
            self._next = None if first is None else max(self._next, first)
        return fixes

    def _compute_fix(self, t_us: float) -> Fix | None:
        views, placed, unplaced = [], [], []
        bar_axes: LocalAxes | None = None
        for number, view in sorted(views_at(t_us, self._frames, self._links, self._spec).items()):
            views.append(number)
            site = self.bars.site_of(number)
            if site is None:
                continue
            # Gravity and north are those of the bars, which may be far from the trajectory's origin.
            bar_axes = bar_axes or LocalAxes.of([site])
            self.axes = self.axes or bar_axes
            try:
                link = self._links[self.bars.link_of(number)]
                enu = site.layout_positions_m(link.bar, bar_axes)
                placed.append(replace(view, enu_m=enu, survey_sigmas=site.survey_sigmas))
            except ConfigError as error:
                unplaced.append(str(error))
        if not views:
            return None
        if unplaced and not placed:
            return Fix.from_refusal(t_us, tuple(views), "no-facing", "; ".join(unplaced))
        if bar_axes is None or self.axes is None:
            contradictions = [text for number in views if (text := self.bars.contradiction_of(number))]
            if contradictions:
                return Fix.from_refusal(t_us, tuple(views), "site-contradicted", "; ".join(contradictions))
            which = ", ".join(f"{n} (id {self.bars.ids.get(n, 'not received')})" for n in views)
            return Fix.from_refusal(t_us, tuple(views), "no-site", f"no site is known of transmitter {which}")
        return self._solve_fix(t_us, views, placed, bar_axes, self.axes)

    def _solve_fix(
        self, t_us: float, views: list[int], placed: list[BarView], bar_axes: LocalAxes, axes: LocalAxes
    ) -> Fix:
        """The fix by bars whose places are known in `bar_axes`, or why there is none."""
        attitude = self._attitude_at(t_us)
        pose = solve_pose(placed, self._camera, attitude, self._spec, self._camera_sigma)
        has_contradiction = pose.kind == "misfit" if isinstance(pose, Rejection) else bool(pose.excluded)
        if has_contradiction and self._contradiction is None:
            self._contradiction = placed, attitude
        if isinstance(pose, Rejection):
            refused = Fix.from_refusal(t_us, tuple(views), pose.kind, pose.detail)
            alternatives = _to_alternatives(pose, bar_axes, axes)
            return replace(refused, alternatives=alternatives, suspects=pose.suspects)
        turn = axes.rotation_from(bar_axes)
        failed, is_protected = pose.failed, math.isfinite(pose.hpl_m + pose.vpl_m)
        if failed is not None:
            covariance_m2 = turn @ failed.covariance_m2 @ turn.T
            failed = replace(failed, off_m=turn @ failed.off_m, covariance_m2=covariance_m2)
        return Fix(
            t_us=t_us,
            **_to_earth(pose.enu_m, pose.rotation, bar_axes, axes),
            covariance_m2=turn @ pose.covariance[:3, :3] @ turn.T,
            noise_m2=turn @ pose.noise @ turn.T,
            heading_sigma_deg=math.degrees(math.sqrt(pose.covariance[5, 5])),
            transmitters=pose.transmitters,
            verified=all(self.bars.is_verified(n) for n in pose.transmitters),
            slow_m2=turn @ pose.slow @ turn.T,
            standing={name: turn @ moves for name, moves in pose.standing.items()},
            misfit=pose.misfit,
            freedom=pose.freedom,
            hpl_m=pose.hpl_m,
            vpl_m=pose.vpl_m,
            excluded=pose.excluded,
            attitude_sigma_deg=math.degrees(math.sqrt(np.linalg.eigvalsh(pose.covariance[3:, 3:])[-1])),
            weakest_axis=turn @ pose.weakest_axis,
            standing_slope={name: turn @ slope for name, slope in pose.standing_slope.items()},
            undetected_m=pose.undetected_m if is_protected else np.full(3, math.inf),
            failed=failed,
        )


def _to_earth(enu_m: Floats, rotation: Floats, bar_axes: LocalAxes, axes: LocalAxes) -> dict[str, Any]:
    angles = Attitude.of_rotation(rotation)
    latitude, longitude, height = (float(v) for v in bar_axes.to_geodetic(enu_m))
    return {
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "height_m": height,
        "enu_m": axes.to_enu(latitude, longitude, height),
        "heading_deg": angles.heading_deg,
        "pitch_deg": angles.pitch_deg,
        "roll_deg": angles.roll_deg,
    }


def _to_alternatives(refusal: Rejection, bar_axes: LocalAxes, axes: LocalAxes) -> tuple[Alternative, ...]:
    turn = axes.rotation_from(bar_axes)
    return tuple(
        Alternative(
            **_to_earth(one.enu_m, one.rotation, bar_axes, axes),
            covariance_m2=turn @ one.covariance_m2 @ turn.T,
            likelihood=one.likelihood,
        )
        for one in refusal.candidates
    )
