"""Where bars stand, from a calibrated camera at known places: the other way round than a calibration.

One least-squares problem over all views of all bars: each bar's place and attitude, and as far as they are
not exact the camera, every view's pose, and an error of all poses in common, as an antenna's place or an
IMU's mount. The poses may be of a track of the camera's own, past known bars.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.place.calibration import MOST_MISFIT, CalibrationView, KnownPose, SeenView, solve_views
from evlcp_sdk.place.error_model import EXACT, USUAL, ErrorModel
from evlcp_sdk.place.navigator import Navigator, Placed, Settled
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from evlcp_sdk.suggestions import format_count
from evlcp_sdk.values import Packet

Floats = NDArray[np.float64]

_MOST = 12
"""Poses by which a bar is surveyed: of more, errors of the track are the same ones again."""

_PAUSE_US = 200_000.0
"""Time without a bar's frames that ends its being in view."""


class OwnPoses:
    """Collects the poses of a recording's track at times when bars are in view that stand at no known site.

    The navigator computes the track; `attitude_at` is for fixes that have no attitude.
    """

    def __init__(
        self, navigator: Navigator, attitude_at: Callable[[float], Attitude | None], recording: str
    ) -> None:
        self._navigator = navigator
        self._attitude_at = attitude_at
        self._recording = recording
        self._spans: dict[int, list[tuple[float, float]]] = {}
        self._found: dict[float, KnownPose] = {}
        self._given, self._refused = 0, Counter[str]()

    def take(self, packet: Packet) -> None:
        """Take the receiver's next packet."""
        times = [f.points_t_us for f in packet.frames if math.isfinite(f.points_t_us)]
        if times and packet.echo_of is None:
            spans = self._spans.setdefault(packet.transmitter, [])
            start = min(times)
            if spans and start <= spans[-1][1] + _PAUSE_US:
                start = spans.pop()[0]
            spans.append((start, max(times)))
        self._navigator.note_span(packet.t_us, packet.t_us)
        self._settle(self._navigator.feed([packet]))

    def close(self) -> list[KnownPose]:
        """End the recording; return the poses, in order of time, not more than 12 for each new bar."""
        placed, settled = self._navigator.close()
        self._settle(placed)
        for one in settled:
            self._keep(one)
        chosen: set[float] = set()
        for number in self._new():
            times = [t for t in self._found if self._in_view(number, t)]
            if times:
                rows = np.linspace(0, len(times) - 1, min(len(times), _MOST))
                chosen |= {times[row] for row in rows.round().astype(int).tolist()}
        return [self._found[t] for t in sorted(chosen)]

    @property
    def summary(self) -> str:
        """How many positions and new bars there were, in one line."""
        refused = "".join(f", {count} refused ({why})" for why, count in self._refused.most_common())
        ids = self._navigator.positioner.bars.ids
        new = ", ".join(str(ids.get(number, "without an id")) for number in self._new()) or "none"
        return f"{format_count(self._given, 'position')}{refused}; new bars: {new}"

    def _settle(self, placed: Iterable[Placed]) -> None:
        for one in placed:
            self._given += not one.fix.refusal
            self._refused.update([one.fix.refusal] if one.fix.refusal else [])
            for settled in one.settled:
                self._keep(settled)

    def _keep(self, settled: Settled) -> None:
        fix, place = settled.fix, settled.smoothed
        if not any(self._in_view(number, fix.t_us) for number in self._new()):
            return
        attitude, sigma_deg = Attitude(fix.pitch_deg, fix.roll_deg, fix.heading_deg), fix.attitude_sigma_deg
        if not math.isfinite(fix.heading_deg):
            known = self._attitude_at(fix.t_us)
            if known is None or known.heading_deg is None:
                return
            worst = max(known.gravity_sigma_deg, known.heading_sigma_deg)
            attitude, sigma_deg = known, math.hypot(worst, known.white_sigma_deg)
        self._found[fix.t_us] = KnownPose(
            self._recording,
            fix.t_us,
            place.latitude_deg,
            place.longitude_deg,
            place.height_m,
            math.sqrt(float(np.linalg.eigvalsh(place.covariance_m2)[-1])),
            attitude,
            max(sigma_deg, 1e-6),
        )

    def _new(self) -> list[int]:
        """Transmitters that stand at no known site."""
        known = self._navigator.positioner.bars.stands_at
        return [number for number in self._spans if number not in known]

    def _in_view(self, number: int, t_us: float) -> bool:
        return any(start <= t_us <= end for start, end in self._spans[number])


_PLACE_M, _TURN_RAD = 100.0, 0.5
"""Sigmas of a bar's place and attitude about their start: next to nothing is known."""

_PASSES, _TURNED_RAD = 8, 1e-4
"""Fits about the last one's attitudes, until these stay: a turn is a straight line in each."""


@dataclass(frozen=True, eq=False)
class SurveyedBar:
    """A bar as it was surveyed, from so many views.

    Attributes:
        site: With its sigmas.
        covariance_m2: Of its place, to the east, north and up, float64 (3, 3).
        contradicted: How its own beacon contradicts that, beyond both sigmas; empty where it does not, or is
            not asked (`position.beacons`).
    """

    site: BarSite
    covariance_m2: Floats
    views: int
    contradicted: str = ""


def survey(
    views: Sequence[CalibrationView],
    axes: LocalAxes,
    length_m: float | Mapping[int, float],
    camera: CameraModel,
    sigma: CameraSigma = EXACT,
    spec: ErrorModel = USUAL,
) -> list[SurveyedBar]:
    """Estimate where bars stand, from views from known places with known attitudes in the same axes.

    The bars' `transmitter` is the id, their `enu_m` does not count; their length is of each by its id where
    they differ. The camera is known exactly without a `sigma`.

    Raises:
        ConfigError: A view's attitude is not known, no bar is seen, or the views do not fit one another.
    """
    if any(view.rotation is None for view in views):
        raise ConfigError("a survey needs poses with heading_deg, pitch_deg and roll_deg")
    numbers = sorted({bar.transmitter for view in views for bar in view.bars})
    long_m = length_m if isinstance(length_m, Mapping) else dict.fromkeys(numbers, length_m)
    started = {number: _start(views, number, camera, long_m[number]) for number in numbers}
    for _ in range(_PASSES):
        about = [_placed(view, started, long_m) for view in views]
        placed = [one for view in about if (one := SeenView.of(view, camera, spec)) is not None]
        if not placed:
            raise ConfigError("no view shows a bar: nothing to survey")
        common = (max(v.place_sigma_m for v in placed), max(v.turn_sigma_rad for v in placed))
        solved = solve_views(placed, camera, sigma.covariance_root(camera), common)
        turned = 0.0
        for number, at in solved.bars.items():
            centre, axis = started[number]
            moved = solved.x[at]
            there = axis + _TURN_RAD * np.cross(moved[3:6], axis)
            there = there / np.linalg.norm(there)
            turned = max(turned, float(np.linalg.norm(there - axis)))
            started[number] = centre + _PLACE_M * moved[:3], there
        if turned < _TURNED_RAD:
            break
    if solved.misfit > MOST_MISFIT:
        raise ConfigError(
            f"the views miss one another by {math.sqrt(solved.misfit):.1f} sigmas (rms):"
            " a pose is not as was said"
        )
    found = []
    for number, at in solved.bars.items():
        centre, axis = started[number]
        spread = solved.covariance[at, at]
        # A turn about its own axis moves nothing.
        across = _TURN_RAD * np.cross(np.eye(3), axis)
        place = LocalAxes(*(float(v) for v in axes.to_geodetic(centre)))
        east, north, up = place.rotation_from(axes) @ axis
        covariance = _PLACE_M**2 * spread[:3, :3]
        leans = across.T @ spread[3:6, 3:6] @ across
        site = BarSite(
            transmitter_id=number,
            latitude_deg=place.latitude_deg,
            longitude_deg=place.longitude_deg,
            height_m=place.height_m,
            heading_deg=math.degrees(math.atan2(east, north)) % 360,
            tilt_deg=math.degrees(math.acos(min(max(up, -1.0), 1.0))),
            length_m=long_m[number],
            position_sigma_m=math.sqrt(float(np.linalg.eigvalsh(covariance)[-1])),
            attitude_sigma_deg=math.degrees(math.sqrt(float(np.linalg.eigvalsh(leans)[-1]))),
        )
        found.append(SurveyedBar(site, covariance, sum(number in v.bar for v in placed)))
    return found


def _start(
    views: Sequence[CalibrationView], number: int, camera: CameraModel, length_m: float
) -> tuple[Floats, Floats]:
    """Centre and axis of a bar by its size and direction in the image, as if parallel to the sensor."""
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
            # From its last cluster to its first, which is at its top.
            axes.append(view.rotation @ np.append(ends[0] - ends[1], 0.0))
    axis = np.sum(axes, 0)
    return np.mean(centres, 0), axis / np.linalg.norm(axis)


def _placed(
    view: CalibrationView, started: dict[int, tuple[Floats, Floats]], length_m: Mapping[int, float]
) -> CalibrationView:
    bars = []
    for bar in view.bars:
        clusters = len(bar.points_px)
        along = (0.5 - (np.arange(clusters) + 0.5) / clusters) * length_m[bar.transmitter]
        centre, axis = started[bar.transmitter]
        survey = (_PLACE_M, _TURN_RAD, 0.0)
        bars.append(replace(bar, enu_m=centre + along[:, None] * axis, survey=survey))
    return replace(view, bars=tuple(bars))
