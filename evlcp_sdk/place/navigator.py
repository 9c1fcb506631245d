"""Packets to the camera's trajectory: fixes as computed, filtered at once, smoothed a window later."""

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.formatting import suggest
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.gnss import GnssLog, add_heading, to_camera_fix
from evlcp_sdk.place.positioner import Positioner
from evlcp_sdk.place.trajectory import (
    GNSS,
    IMU,
    TrajectoryPoint,
    predict_heading,
    smooth_trajectory,
    step_trajectory,
)
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog, attitude_source
from evlcp_sdk.scene.camera import CAMERA_PARAMETERS, CameraModel, CameraSigma
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from evlcp_sdk.values import Fix, Packet, remember_newest

Floats = NDArray[np.float64]

_DETERMINED_SHARE = 0.9
"""Share of its stated sigma below which an error counts as determined by the drive."""


@dataclass(frozen=True)
class EstimatedBias:
    """One standing error as estimated by a drive.

    Attributes:
        part: `camera`, `attitude`, `imu`, `bar N`.
        what: Which error, with its unit: `focal_mm`, `pitch_deg`, `time_us`, `east_m` ...
        correction: To be added to the stated value.
        sigma: Of it.
        stated_sigma: Before the drive.
    """

    part: str
    what: str
    correction: float
    sigma: float
    stated_sigma: float

    @property
    def is_determined(self) -> bool:
        """Whether the drive determines it; else it keeps the stated sigma."""
        return self.sigma < _DETERMINED_SHARE * self.stated_sigma


def estimate_biases(
    states: Mapping[str, tuple[Floats, Floats]],
    camera: CameraModel,
    camera_sigma: CameraSigma,
    attitude: Attitude | None,
    sites: Mapping[int, BarSite],
    spec: ErrorModel,
) -> list[EstimatedBias]:
    """Convert standing states to their units; an error without a stated sigma is left out.

    `states` are of each part, means in its sigmas, (k,), and covariance, (k, k), as in
    `TrajectoryPoint.standing`; the other arguments are as stated.
    """
    biases: list[EstimatedBias] = []
    for part, (mean, covariance) in states.items():
        if part == "camera":
            root = camera_sigma.covariance_root(camera)
            root[0] *= camera.focal_mm / camera.focal_px
            names: tuple[str, ...] = CAMERA_PARAMETERS
        elif part == "attitude" and attitude is not None:
            gravity, heading = attitude.gravity_sigma_deg, attitude.heading_sigma_deg
            # A correction has the opposite sign of an error.
            root = np.diag([-gravity, -gravity, -heading, attitude.time_sigma_us])
            names = ("pitch_deg", "roll_deg", "heading_deg", "time_us")
        elif part == IMU:
            root = np.diag([-spec.rate_sigma_deg_s, *(len(mean) - 1) * [-spec.accelerometer_sigma_m_s2]])
            names = ("rate_deg_s", "push_right_m_s2", "push_forward_m_s2", "push_up_m_s2")[: len(mean)]
        elif part.startswith("bar ") and len(mean) > 1 and (site := sites.get(int(part[4:]))) is not None:
            # After its length come its place and its rotation.
            mean, covariance = mean[1:4], covariance[1:4, 1:4]
            root = site.survey_sigmas[0] * np.eye(3)
            names = ("east_m", "north_m", "up_m")
        else:
            continue
        values, spread = root @ mean, root @ covariance @ root.T
        stated = np.sqrt((root * root).sum(1))
        for i, name in enumerate(names):
            if stated[i] > 0:
                sigma = math.sqrt(max(float(spread[i, i]), 0.0))
                biases.append(EstimatedBias(part, name, float(values[i]), sigma, float(stated[i])))
    return biases


def focal_share(
    state: tuple[Floats, Floats] | None, camera: CameraModel, camera_sigma: CameraSigma
) -> tuple[float, float]:
    """Relative error of the stated focal length, and its sigma; NaN if it was stated exactly."""
    if state is None or not camera_sigma.focal_mm > 0:
        return math.nan, math.nan
    row = camera_sigma.covariance_root(camera)[0] / camera.focal_px
    return float(row @ state[0]), math.sqrt(max(float(row @ state[1] @ row), 0.0))


_BLOCK = 1024
"""Points smoothed at a time; those behind them, as many again, are over half a minute: far longer than an
acceleration of 1 m/s2 matters against fixes of centimetres."""


_MAX_STANDING = 256
"""Parts whose standing errors are remembered; then the one not seen for longest is dropped."""

_SUPPORT_US = 10e6
"""Time for which fixes of a source support the track."""


@dataclass(frozen=True)
class PositionPlan:
    """What positions are computed from, besides the image and the camera's attitude.

    Attributes:
        sites: Where the bars stand.
        gnss: GNSS fixes, which enter the track; None for none.
    """

    sites: tuple[BarSite, ...]
    gnss: GnssLog | None = None

    def check_links(self, names: Sequence[str]) -> None:
        """Check that each site's `link` is among the names of several links; a single link has none to check.

        Raises:
            ConfigError: One is not, so that no bar would ever stand there.
        """
        for site in self.sites if len(names) > 1 else ():
            if site.link is not None and site.link not in names:
                raise ConfigError(
                    f"site of id {site.transmitter_id}: link = '{site.link}': no link is named so"
                    + suggest(site.link, names, "links")
                )


@dataclass(frozen=True, eq=False)
class Place:
    """Where the camera is at one time, filtered or smoothed, and how it moves.

    Attributes:
        t_us: Camera clock, us.
        enu_m: The place, WGS-84 and above the ellipsoid, in the local axes, m, float64 (3,).
        covariance_m2: Of `enu_m`, float64 (3, 3).
        speed_m_s: Over ground.
        course_deg: Direction of movement, clockwise from north.
        left_out: The fix at this time was rejected by the gate or its test.
        starts: A trajectory starts here; its speed is unknown, unless it is smoothed.
        focal_share: Relative error of the stated focal length, as the track estimates it; NaN where it was
            stated exactly.
        focal_share_sigma: Of it.
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
    focal_share: float = math.nan
    focal_share_sigma: float = math.nan


@dataclass(frozen=True, eq=False)
class Settled:
    """A fix with its places, which no later fix changes.

    Attributes:
        fix: As measured.
        filtered: By the fixes up to it.
        smoothed: By later ones, too.
    """

    fix: Fix
    filtered: Place
    smoothed: Place


@dataclass(frozen=True, eq=False)
class Placed:
    """The result of a packet: a fix, and earlier ones that it settles.

    Attributes:
        fix: Given or refused.
        filtered: The place at its time; None for a refused fix.
        settled: In order of time; mostly none.
    """

    fix: Fix
    filtered: Place | None
    settled: tuple[Settled, ...] = ()


class Navigator:
    """A recording's positions, in constant memory.

    Args:
        links: The receiver's configuration; of several, those that locate bars, by name.
        plan: Where the bars stand, and GNSS.
        attitude: The camera's attitude, constant or over time; None if it is unknown.
    """

    def __init__(
        self,
        links: Link | Mapping[str, Link],
        plan: PositionPlan,
        attitude: Attitude | AttitudeLog | None = None,
    ) -> None:
        links = {"": links} if isinstance(links, Link) else links
        link = next(iter(links.values()))
        self._spec = ErrorModel.of(link.position)
        self._attitude_at = attitude_source(attitude)
        self.positioner = Positioner(links, plan.sites, self._attitude_at)
        self._log = attitude if isinstance(attitude, AttitudeLog) else None
        self._imu = None if self._log is None else self._log.motion_between
        self._gnss, self._gnss_next = plan.gnss, 0
        self._span: tuple[float, float] | None = None
        self._last_used_us: dict[str, float] = {}
        self._link = link
        self._attitude: Attitude | None = None
        self._standing: dict[str, tuple[Floats, Floats]] = {}
        self._counts = dict.fromkeys(("gnss", "gnss_left_out", "gnss_without_heading", "attitude_missing"), 0)
        self._gnss_offsets_m: deque[Floats] = deque(maxlen=_BLOCK)
        self._state: TrajectoryPoint | None = None
        self._window: list[tuple[Fix, TrajectoryPoint, Place]] = []

    @property
    def counts(self) -> dict[str, int]:
        """GNSS fixes: used, left out of the track, without the heading that the antenna needs, and outside of
        the recording's time so far; fixes of bars, given or not, without an attitude in the attitude file,
        and that file's lines if all are outside of that time.
        """
        used = self._counts["gnss"] + self._counts["gnss_without_heading"]
        given = 0 if self._gnss is None else len(self._gnss.t_us)
        lines = 0
        if self._log is not None and self._span is not None:
            first_us, last_us = self._span
            t_us = self._log.t_us
            lines = len(t_us) if t_us[-1] < first_us or t_us[0] > last_us else 0
        return self._counts | {"gnss_outside": given - used, "attitude_outside": lines}

    @property
    def gnss_offset_m(self) -> Floats | None:
        """Offset of GNSS from bars to the east, north and up where they contradict one another.

        The median of the last thousand times, float64 (3,); None for none.
        """
        return np.median(self._gnss_offsets_m, 0) if self._gnss_offsets_m else None

    def extend_span(self, first_us: float, last_us: float) -> None:
        """Extend the time span of the recording's events, in which GNSS fixes count.

        Without it, those from the first fix of bars to the last one count.
        """
        self._span = (first_us if self._span is None else self._span[0], last_us)

    def feed(self, packets: Iterable[Packet]) -> list[Placed]:
        """Process the receiver's next packets; return the fixes that no later packet can change."""
        return self._merge_gnss(self.positioner.feed(packets))

    def close(self) -> tuple[list[Placed], tuple[Settled, ...]]:
        """End the stream; return the rest of the fixes, and those not settled before."""
        placed = self._merge_gnss(self.positioner.close())
        if self._span is not None:
            placed += self._filter_gnss(self._span[1])
        return placed, self._smooth_oldest(len(self._window))

    def _merge_gnss(self, fixes: Iterable[Fix]) -> list[Placed]:
        """Filter fixes of bars, each after the GNSS fixes before it."""
        placed = []
        for fix in fixes:
            if self._span is None:
                self._span = (fix.t_us, fix.t_us)
            placed += self._filter_gnss(fix.t_us)
            if self._log is not None and self._log.interpolate(fix.t_us) is None:
                self._counts["attitude_missing"] += 1
            placed.append(self._filter(fix))
        return placed

    def _filter_gnss(self, until_us: float) -> list[Placed]:
        log, placed = self._gnss, []
        if log is None or self._span is None:
            return []
        first = max(self._gnss_next, int(np.searchsorted(log.t_us, self._span[0])))
        self._gnss_next = max(first, int(np.searchsorted(log.t_us, until_us, "right")))
        for row in range(first, self._gnss_next):
            if self.positioner.axes is None:
                self.positioner.axes = LocalAxes(*log.place[row].tolist())
            t_us = log.t_us[row]
            heading = None if self._state is None else predict_heading(self._state, t_us, self._imu)
            attitude = add_heading(self._attitude_at(t_us), heading)
            fix = to_camera_fix(log, row, self.positioner.axes, attitude, self._spec)
            self._counts["gnss" if fix is not None else "gnss_without_heading"] += 1
            if fix is not None:
                placed.append(self._filter(fix))
        return placed

    def estimate_biases(self) -> list[EstimatedBias]:
        """Estimates so far of standing errors: of the camera, the attitude, the IMU, the sites."""
        link, sites = self._link, self.positioner.bars.known_sites
        camera, sigma = link.camera, link.camera_sigma
        return estimate_biases(self._standing, camera, sigma, self._attitude, sites, self._spec)

    def bars_enu_m(self) -> dict[int, Floats]:
        """Centres of the bars whose places are known, in the local axes, m, float64 (3,) each."""
        axes = self.positioner.axes
        if axes is None:
            return {}
        sites = self.positioner.bars.known_sites.items()
        return {n: axes.to_enu(s.latitude_deg, s.longitude_deg, s.height_m) for n, s in sites}

    def _filter(self, fix: Fix) -> Placed:
        if fix.refusal:
            return Placed(fix, None)
        point = self._state = step_trajectory(self._state, fix, self._spec, self._imu)
        if point.starts:
            self._last_used_us = {}
        if point.rejected:
            # Other sources that supported the track when it was left out contradict it.
            self._counts["gnss_left_out"] += fix.source == GNSS
            used = self._last_used_us.items()
            others = tuple(n for n, t in used if n != fix.source and fix.t_us - t <= _SUPPORT_US)
            if others:
                offset = fix.enu_m - point.mean[:3]
                self._gnss_offsets_m.append(offset if fix.source == GNSS else -offset)
            fix = replace(fix, contradicted=others)
        else:
            self._last_used_us[fix.source] = fix.t_us
        self._attitude = self._attitude_at(fix.t_us) or self._attitude
        for cause in point.causes:
            if (standing := point.standing(cause.name)) is not None:
                remember_newest(self._standing, cause.name, standing, _MAX_STANDING)
        filtered = self._to_place(point)
        self._window.append((fix, point, filtered))
        return Placed(fix, filtered, self._smooth_oldest(_BLOCK) if len(self._window) == 2 * _BLOCK else ())

    def _smooth_oldest(self, count: int) -> tuple[Settled, ...]:
        smoothed = smooth_trajectory([point for _, point, _ in self._window], self._spec)
        settled = tuple(
            Settled(fix, filtered, self._to_place(point))
            for (fix, _, filtered), point in zip(self._window[:count], smoothed, strict=False)
        )
        self._window = self._window[count:]
        return settled

    def _to_place(self, point: TrajectoryPoint) -> Place:
        axes = self.positioner.axes
        assert axes is not None
        latitude, longitude, height = axes.to_geodetic(point.mean[:3])
        east, north = float(point.mean[3]), float(point.mean[4])
        link = self._link
        return Place(
            point.t_us,
            float(latitude),
            float(longitude),
            float(height),
            point.mean[:3],
            point.covariance_m2,
            math.hypot(east, north),
            math.degrees(math.atan2(east, north)) % 360,
            point.rejected > 0,
            point.starts,
            *focal_share(point.standing("camera"), link.camera, link.camera_sigma),
        )
