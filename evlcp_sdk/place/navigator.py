"""Packets to the camera's trajectory: fixes as they are known, filtered at once, smoothed a window later."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.place.positioner import Positioner
from evlcp_sdk.place.trajectory import TrajectoryPoint, smooth_trajectory, trajectory_step
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog, attitude_source
from evlcp_sdk.scene.sites import BarSite
from evlcp_sdk.values import Fix, Packet

__all__ = ["Navigator", "Place", "Placed", "PositionPlan", "Settled"]

Floats = NDArray[np.float64]

_BLOCK = 1024
"""Points smoothed at a time; those behind them, as many again, are over half a minute: far more than an
acceleration of 1 m/s2 lasts against fixes of centimetres."""


@dataclass(frozen=True)
class PositionPlan:
    """What positions are computed from beside what the camera sees and how it is turned.

    Attributes:
        sites: Where the bars stand.
    """

    sites: tuple[BarSite, ...]


@dataclass(frozen=True, eq=False)
class Place:
    """Where the camera is at one time, filtered or smoothed, and how it moves.

    Attributes:
        t_us: Camera clock, us.
        latitude_deg: WGS-84.
        longitude_deg: The same.
        height_m: Above the ellipsoid, m.
        enu_m: The same place in the local axes, m, float64 (3,).
        covariance_m2: Of `enu_m`, float64 (3, 3).
        speed_m_s: Over ground.
        course_deg: Where it moves to, clockwise from north.
        left_out: The fix at this time was beyond the gate and does not count.
        starts: A trajectory starts here; nothing is known of its speed, unless it is smoothed.
    """

    t_us: float
    latitude_deg: float
    longitude_deg: float
    height_m: float
    enu_m: Floats
    covariance_m2: Floats
    speed_m_s: float
    course_deg: float
    left_out: bool
    starts: bool


@dataclass(frozen=True, eq=False)
class Settled:
    """A fix with its places that no later fix changes.

    Attributes:
        fix: As it was measured.
        filtered: By the fixes up to it.
        smoothed: By those after it, too.
    """

    fix: Fix
    filtered: Place
    smoothed: Place


@dataclass(frozen=True, eq=False)
class Placed:
    """What a packet adds: a fix, and what it settles.

    Attributes:
        fix: Given or refused.
        filtered: The place at its time; None for a refused fix.
        settled: Earlier fixes that are settled now, in order of time; mostly none.
    """

    fix: Fix
    filtered: Place | None
    settled: tuple[Settled, ...] = ()


class Navigator:
    """A recording's positions, in constant memory.

    Args:
        link: The configuration that the receiver ran with.
        plan: Where the bars stand.
        attitude: What is known of the camera's attitude, the same always or over time; None for nothing.
    """

    def __init__(
        self, link: Link, plan: PositionPlan, attitude: Attitude | AttitudeLog | None = None
    ) -> None:
        self._spec = link.position
        self.positioner = Positioner(
            link.camera,
            link.bar.clusters,
            link.packet.packet_chips * link.packet.chip_us,
            plan.sites,
            attitude_source(attitude),
            link.position,
            link.camera_sigma,
        )
        self._state: TrajectoryPoint | None = None
        self._window: list[tuple[Fix, TrajectoryPoint, Place]] = []

    def feed(self, packets: Iterable[Packet]) -> list[Placed]:
        """Take the receiver's next packets; return the fixes that no later packet can change."""
        return [self._placed(fix) for fix in self.positioner.feed(packets)]

    def close(self) -> tuple[list[Placed], tuple[Settled, ...]]:
        """End the stream; return the rest of the fixes, and what was not settled before."""
        placed = [self._placed(fix) for fix in self.positioner.close()]
        return placed, self._settle(len(self._window))

    def bars_enu_m(self) -> dict[int, Floats]:
        """Centres of the bars whose places are known, in the local axes, m, float64 (3,) each."""
        axes = self.positioner.axes
        if axes is None:
            return {}
        return {
            number: axes.to_enu(site.latitude_deg, site.longitude_deg, site.height_m)
            for number, site in self.positioner.stands_at.items()
        }

    def _placed(self, fix: Fix) -> Placed:
        if fix.refusal:
            return Placed(fix, None)
        point = self._state = trajectory_step(self._state, fix, self._spec)
        filtered = self._place(point)
        self._window.append((fix, point, filtered))
        return Placed(fix, filtered, self._settle(_BLOCK) if len(self._window) == 2 * _BLOCK else ())

    def _settle(self, count: int) -> tuple[Settled, ...]:
        """Smooth the window, and drop its first points from it."""
        smoothed = smooth_trajectory([point for _, point, _ in self._window], self._spec)
        settled = tuple(
            Settled(fix, filtered, self._place(point))
            for (fix, _, filtered), point in zip(self._window[:count], smoothed, strict=False)
        )
        self._window = self._window[count:]
        return settled

    def _place(self, point: TrajectoryPoint) -> Place:
        axes = self.positioner.axes
        assert axes is not None
        latitude, longitude, height = axes.to_geodetic(point.mean[:3])
        east, north = float(point.mean[3]), float(point.mean[4])
        return Place(
            t_us=point.t_us,
            latitude_deg=float(latitude),
            longitude_deg=float(longitude),
            height_m=float(height),
            enu_m=point.mean[:3],
            covariance_m2=point.covariance_m2,
            speed_m_s=math.hypot(east, north),
            course_deg=math.degrees(math.atan2(east, north)) % 360,
            left_out=point.misses > 0,
            starts=point.starts,
        )
