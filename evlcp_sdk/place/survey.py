"""Where bars stand, from a calibrated camera at known places: the inverse of a calibration.

One least-squares problem over all views of all bars: each bar's place and attitude, and as far as they are
not exact the camera, every view's pose, and an error that all poses share, as of an antenna's place or an
IMU's mount. The poses may be of the camera's own track, past known bars.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.formatting import format_count
from evlcp_sdk.place.calibration import MAX_MISFIT, CalibrationView, KnownPose, WhitenedView, solve_views
from evlcp_sdk.place.error_model import DEFAULT_ERRORS, EXACT_CAMERA, ErrorModel
from evlcp_sdk.place.navigator import Navigator, Placed, Settled
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from evlcp_sdk.values import Packet

Floats = NDArray[np.float64]

_MAX_POSES = 12
"""Poses by which a bar is surveyed; with more, errors of the track repeat."""

_PAUSE_US = 200_000.0
"""Time without a bar's frames after which it is out of view."""


class TrackPoses:
    """Collects the poses of a recording's track while bars without a known site are in view.

    The navigator computes the track; `attitude_at` is for fixes that have no attitude.
    """

    def __init__(
        self, navigator: Navigator, attitude_at: Callable[[float], Attitude | None], recording: str
    ) -> None:
        self._navigator = navigator
        self._attitude_at = attitude_at
        self._recording = recording
        self._spans: dict[int, list[tuple[float, float]]] = {}
        self._poses: dict[float, KnownPose] = {}
        self._positions, self._refused = 0, Counter[str]()

    def add_packet(self, packet: Packet) -> None:
        """Process the receiver's next packet."""
        times = [f.points_t_us for f in packet.frames if math.isfinite(f.points_t_us)]
        if times and packet.echo_of is None:
            spans = self._spans.setdefault(packet.transmitter, [])
            start = min(times)
            if spans and start <= spans[-1][1] + _PAUSE_US:
                start = spans.pop()[0]
            spans.append((start, max(times)))
        self._navigator.extend_span(packet.t_us, packet.t_us)
        self._count_fixes(self._navigator.feed([packet]))

    def close(self) -> list[KnownPose]:
        """End the recording; return the poses, in order of time, at most 12 for each new bar."""
        placed, settled = self._navigator.close()
        self._count_fixes(placed)
        for one in settled:
            self._add_pose(one)
        selected: set[float] = set()
        for number in self._find_new_bars():
            times = [t for t in self._poses if self._is_in_view(number, t)]
            rows = np.linspace(0, len(times) - 1, min(len(times), _MAX_POSES))
            selected |= {times[row] for row in rows.round().astype(int).tolist()}
        return [self._poses[t] for t in sorted(selected)]

    @property
    def summary(self) -> str:
        """Numbers of positions and new bars, in one line."""
        refused = "".join(f", {count} refused ({why})" for why, count in self._refused.most_common())
        ids = self._navigator.positioner.bars.ids
        new = ", ".join(str(ids.get(number, "without an id")) for number in self._find_new_bars()) or "none"
        return f"{format_count(self._positions, 'position')}{refused}; new bars: {new}"

    def _count_fixes(self, placed: Iterable[Placed]) -> None:
        for one in placed:
            self._positions += not one.fix.refusal
            self._refused.update([one.fix.refusal] if one.fix.refusal else [])
            for settled in one.settled:
                self._add_pose(settled)

    def _add_pose(self, settled: Settled) -> None:
        fix, place = settled.fix, settled.smoothed
        if not any(self._is_in_view(number, fix.t_us) for number in self._find_new_bars()):
            return
        attitude, sigma_deg = Attitude(fix.pitch_deg, fix.roll_deg, fix.heading_deg), fix.attitude_sigma_deg
        if not math.isfinite(fix.heading_deg):
            known = self._attitude_at(fix.t_us)
            if known is None or known.heading_deg is None:
                return
            worst = max(known.gravity_sigma_deg, known.heading_sigma_deg)
            attitude, sigma_deg = known, math.hypot(worst, known.white_sigma_deg)
        self._poses[fix.t_us] = KnownPose(
            self._recording,
            fix.t_us,
            place.latitude_deg,
            place.longitude_deg,
            place.height_m,
            math.sqrt(float(np.linalg.eigvalsh(place.covariance_m2)[-1])),
            attitude,
            max(sigma_deg, 1e-6),
        )

    def _find_new_bars(self) -> list[int]:
        known = self._navigator.positioner.bars.known_sites
        return [number for number in self._spans if number not in known]

    def _is_in_view(self, number: int, t_us: float) -> bool:
        return any(start <= t_us <= end for start, end in self._spans[number])


_PLACE_M, _TURN_RAD = 100.0, 0.5
"""Prior sigmas of a bar's place and attitude about their start."""

_MAX_PASSES, _SETTLED_RAD = 8, 1e-4
"""Fits, each linear about the last one's attitudes, until these change by less."""


@dataclass(frozen=True, eq=False)
class SurveyedBar:
    """A bar as surveyed.

    Attributes:
        site: With its sigmas.
        covariance_m2: Of its place, to the east, north and up, float64 (3, 3).
        views: Number of views of it.
        contradiction: How its own beacon contradicts the site; empty where it does not, or where beacons are
            not used (`position.beacons`).
    """

    site: BarSite
    covariance_m2: Floats
    views: int
    contradiction: str = ""


def survey_bars(
    views: Sequence[CalibrationView],
    axes: LocalAxes,
    length_m: float | Mapping[int, float],
    camera: CameraModel,
    sigma: CameraSigma = EXACT_CAMERA,
    spec: ErrorModel = DEFAULT_ERRORS,
) -> list[SurveyedBar]:
    """Estimate where bars stand, from views from known places with known attitudes in the same axes.

    The bars' `transmitter` is the id, their `enu_m` does not count; `length_m` is by id where lengths differ.
    With the default `sigma` the camera is known exactly.

    Raises:
        ConfigError: No bar is seen, or the views do not fit one another.
    """
    ids = sorted({bar.transmitter for view in views for bar in view.bars})
    lengths_m = length_m if isinstance(length_m, Mapping) else dict.fromkeys(ids, length_m)
    lines = {id_: _estimate_start(views, id_, camera, lengths_m[id_]) for id_ in ids}
    for _ in range(_MAX_PASSES):
        placed = [_place_bars(view, lines, lengths_m) for view in views]
        whitened = [one for view in placed if (one := WhitenedView.of(view, camera, spec)) is not None]
        if not whitened:
            raise ConfigError("no view shows a bar that sends its id: nothing to survey")
        common = (max(v.place_sigma_m for v in whitened), max(v.turn_sigma_rad for v in whitened))
        solution = solve_views(whitened, camera, sigma.covariance_root(camera), common)
        change = 0.0
        for id_, columns in solution.bars.items():
            centre, axis = lines[id_]
            steps = solution.x[columns]
            new_axis = axis + _TURN_RAD * np.cross(steps[3:6], axis)
            new_axis = new_axis / np.linalg.norm(new_axis)
            change = max(change, float(np.linalg.norm(new_axis - axis)))
            lines[id_] = centre + _PLACE_M * steps[:3], new_axis
        if change < _SETTLED_RAD:
            break
    if solution.misfit > MAX_MISFIT:
        raise ConfigError(
            f"the views miss one another by {math.sqrt(solution.misfit):.1f} sigmas (rms): a pose is wrong"
        )
    bars = []
    for id_, columns in solution.bars.items():
        centre, axis = lines[id_]
        covariance = solution.covariance[columns, columns]
        # A rotation about its own axis moves nothing.
        across = _TURN_RAD * np.cross(np.eye(3), axis)
        place = LocalAxes(*(float(v) for v in axes.to_geodetic(centre)))
        east, north, up = place.rotation_from(axes) @ axis
        place_m2 = _PLACE_M**2 * covariance[:3, :3]
        tilts = across.T @ covariance[3:6, 3:6] @ across
        site = BarSite(
            transmitter_id=id_,
            latitude_deg=place.latitude_deg,
            longitude_deg=place.longitude_deg,
            height_m=place.height_m,
            heading_deg=math.degrees(math.atan2(east, north)) % 360,
            tilt_deg=math.degrees(math.acos(min(max(up, -1.0), 1.0))),
            length_m=lengths_m[id_],
            position_sigma_m=math.sqrt(float(np.linalg.eigvalsh(place_m2)[-1])),
            attitude_sigma_deg=math.degrees(math.sqrt(float(np.linalg.eigvalsh(tilts)[-1]))),
        )
        bars.append(SurveyedBar(site, place_m2, sum(id_ in v.bar for v in whitened)))
    return bars


def _estimate_start(
    views: Sequence[CalibrationView], number: int, camera: CameraModel, length_m: float
) -> tuple[Floats, Floats]:
    """Estimate a bar's centre and axis by its image's size and direction, as if parallel to the sensor."""
    centres, axes = [], []
    for view in views:
        for bar in view.bars:
            rows = np.flatnonzero(np.isfinite(bar.points_px).all(1))
            if bar.transmitter != number or len(rows) < 2:
                continue
            assert view.rotation is not None
            ends = camera.undistort(bar.points_px[rows[[0, -1]]])
            share = (rows[-1] - rows[0]) / len(bar.points_px)
            depth = length_m * share / np.linalg.norm(ends[1] - ends[0])
            middle = camera.undistort(bar.points_px[rows]).mean(0)
            centres.append(view.enu_m + view.rotation @ np.append(middle, 1.0) * depth)
            # From its last cluster up to its first.
            axes.append(view.rotation @ np.append(ends[0] - ends[1], 0.0))
    axis = np.sum(axes, 0)
    return np.mean(centres, 0), axis / np.linalg.norm(axis)


def _place_bars(
    view: CalibrationView, lines: dict[int, tuple[Floats, Floats]], length_m: Mapping[int, float]
) -> CalibrationView:
    bars = []
    for bar in view.bars:
        clusters = len(bar.points_px)
        along_m = (0.5 - (np.arange(clusters) + 0.5) / clusters) * length_m[bar.transmitter]
        centre, axis = lines[bar.transmitter]
        sigmas = (_PLACE_M, _TURN_RAD, 0.0)
        bars.append(replace(bar, enu_m=centre + along_m[:, None] * axis, survey_sigmas=sigmas))
    return replace(view, bars=tuple(bars))
