"""Fixes and track as files, written as they come: CSV, GeoJSON, NMEA-0183, and MCAP on request."""

import csv
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError, EvlcpError
from evlcp_sdk.files import hidden_path
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.place.positioner import Positioner
from evlcp_sdk.place.refusals import REFUSALS
from evlcp_sdk.place.trajectory import TrajectoryPoint, smooth_trajectory, trajectory_step
from evlcp_sdk.results.mcap import McapFixes, check_mcap
from evlcp_sdk.results.nmea import gga, rmc
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog
from evlcp_sdk.scene.sites import BarSite
from evlcp_sdk.values import Fix, Packet

__all__ = ["FIX_COLUMNS", "TRACK_COLUMNS", "PositionPlan", "PositionWriter", "Watcher", "attitude_source"]

FIX_COLUMNS = (
    "t_us",
    "latitude_deg",
    "longitude_deg",
    "height_m",
    "sigma_east_m",
    "sigma_north_m",
    "sigma_up_m",
    "heading_deg",
    "heading_sigma_deg",
    "pitch_deg",
    "roll_deg",
    "bars",
    "verified",
    "refusal",
    "detail",
)
"""Columns of `fixes.csv`."""

_PLACE_COLUMNS = ("latitude_deg", "longitude_deg", "height_m", "sigma_east_m", "sigma_north_m", "sigma_up_m")

TRACK_COLUMNS = (
    "t_us",
    *_PLACE_COLUMNS,
    "speed_m_s",
    "course_deg",
    *(f"filtered_{name}" for name in _PLACE_COLUMNS),
    "left_out",
)
"""Columns of `track.csv`: smoothed, then filtered."""

_BLOCK = 1024
"""Points smoothed at a time; those behind them, as many again, are over half a minute: far more than an
acceleration of 1 m/s2 lasts against fixes of centimetres."""


class Watcher(Protocol):
    """Told of every point of the track, e.g. to draw it."""

    def add(self, fix: Fix, filtered: TrajectoryPoint, smoothed: TrajectoryPoint) -> None:
        """Take a fix with its points of the track, in order of time."""


@dataclass(frozen=True)
class PositionPlan:
    """What positions are computed from, and which files are written.

    Attributes:
        sites: Where the bars stand.
        attitude: What is known of the camera's attitude, the same always or over time; None for nothing.
        clock_zero: UTC of the camera clock's 0, where known.
        mcap: Also write `fixes.mcap` (needs the extra `mcap`).
    """

    sites: tuple[BarSite, ...]
    attitude: Attitude | AttitudeLog | None = None
    clock_zero: datetime | None = None
    mcap: bool = False


def attitude_source(attitude: Attitude | AttitudeLog | None) -> Callable[[float], Attitude | None]:
    """The attitude at a time, us."""
    return attitude.at if isinstance(attitude, AttitudeLog) else lambda _t_us: attitude


class PositionWriter:
    """Computes and writes one recording's positions; a context manager beside `ResultWriter`.

    Files are written under hidden names, in constant memory; the `ResultWriter` of the same folder moves them
    into place with its own.

    Args:
        folder: There already.
        link: The configuration that the receiver ran with.
        plan: Sites, attitude, files.
        watchers: Told of every point of the track.

    Raises:
        ConfigError: The folder cannot be written, or the extra is not installed.
    """

    def __init__(
        self, folder: Path, link: Link, plan: PositionPlan, watchers: Iterable[Watcher] = ()
    ) -> None:
        self._folder = folder
        self._plan = plan
        self._spec = link.position
        self._watchers = tuple(watchers)
        period_us = link.packet.packet_chips * link.packet.chip_us
        self.positioner = Positioner(
            link.camera,
            link.bar.clusters,
            period_us,
            plan.sites,
            attitude_source(plan.attitude),
            link.position,
        )
        self._state: TrajectoryPoint | None = None
        self._window: list[tuple[Fix, TrajectoryPoint]] = []
        self._line_end: list[list[float]] = []
        self._refused: Counter[str] = Counter()
        self._given = self._verified = self._left_out = self._features = 0
        self._mcap: McapFixes | None = None
        if plan.mcap:
            check_mcap()
        try:
            self._fixes = self._open("fixes.csv")
            self._track = self._open("track.csv")
            self._nmea = self._open("fixes.nmea")
            self._geojson = self._open("fixes.geojson")
            if plan.mcap:
                zero_us = round(plan.clock_zero.timestamp() * 1e6) if plan.clock_zero else 0
                self._mcap = McapFixes(hidden_path(folder, "fixes.mcap"), zero_us)
        except OSError as fault:
            raise ConfigError(f"{folder}: cannot be written: {fault.strerror}") from fault
        self._fix_rows = csv.writer(self._fixes, lineterminator="\n")
        self._fix_rows.writerow(FIX_COLUMNS)
        self._track_rows = csv.writer(self._track, lineterminator="\n")
        self._track_rows.writerow(TRACK_COLUMNS)
        self._geojson.write('{"type": "FeatureCollection", "features": [')

    def _open(self, name: str) -> Any:
        return hidden_path(self._folder, name).open("w", encoding="utf-8", newline="")

    def write(self, packets: Iterable[Packet]) -> None:
        """Take the receiver's next packets.

        Raises:
            EvlcpError: A file cannot be written.
        """
        self._take(self.positioner.feed(packets))

    def finish(self) -> dict[str, Any]:
        """Write the rest; return what the summary says of positions.

        Raises:
            EvlcpError: A file cannot be written.
        """
        self._take(self.positioner.close())
        try:
            self._emit(len(self._window))
            for number, site in self.positioner.stands_at.items():
                self._feature(
                    "Point",
                    [site.longitude_deg, site.latitude_deg, site.height_m],
                    {"bar": number, "transmitter_id": site.transmitter_id},
                )
            self._geojson.write("]}\n")
            self._close()
        except OSError as fault:
            raise EvlcpError(f"{self._folder}: cannot be written: {fault.strerror}") from fault
        frame = self.positioner.frame
        return {
            "fixes": self._given,
            "fixes_verified": self._verified,
            "refused": {kind: self._refused[kind] for kind in REFUSALS if self._refused[kind]},
            "left_out_of_track": self._left_out,
            "frames_late": self.positioner.counts["frames_late"],
            "beacons_forged": self.positioner.counts["beacons_forged"],
            "sites_contradicted": {str(n): how for n, how in self.positioner.contradicted.items()},
            "origin": asdict(frame) if frame is not None else None,
            "bars": {str(n): s.transmitter_id for n, s in self.positioner.stands_at.items()},
        }

    def bars_enu_m(self) -> dict[int, NDArray[np.float64]]:
        """Centres of the bars whose places are known, in the local frame, m, float64 (3,) each."""
        frame = self.positioner.frame
        if frame is None:
            return {}
        return {
            number: frame.to_enu(site.latitude_deg, site.longitude_deg, site.height_m)
            for number, site in self.positioner.stands_at.items()
        }

    def _take(self, fixes: Iterable[Fix]) -> None:
        try:
            for fix in fixes:
                self._write(fix)
        except OSError as fault:
            raise EvlcpError(f"{self._folder}: cannot be written: {fault.strerror}") from fault

    def _write(self, fix: Fix) -> None:
        self._fix_rows.writerow(_fix_row(fix))
        zero = self._plan.clock_zero
        if fix.refusal:
            self._refused[fix.refusal] += 1
            self._nmea.write(gga(fix.t_us, zero, None, 0, 0.0) + rmc(fix.t_us, zero, None, None))
            return
        self._given += 1
        self._verified += fix.verified
        point = self._state = trajectory_step(self._state, fix, self._spec)
        self._left_out += point.misses > 0
        place, sigma = self._place(point), np.sqrt(np.diag(point.covariance_m2))
        way = None if point.starts else _way(point)
        bars, across = len(fix.transmitters), math.hypot(sigma[0], sigma[1])
        self._nmea.write(gga(fix.t_us, zero, place, bars, across) + rmc(fix.t_us, zero, place, way))
        if self._mcap is not None:
            self._mcap.add(fix, place, point.covariance_m2)
        self._feature(
            "Point",
            [round(fix.longitude_deg, 9), round(fix.latitude_deg, 9), round(fix.height_m, 4)],
            {
                "t_us": round(fix.t_us, 1),
                "heading_deg": round(fix.heading_deg, 3),
                "sigma_m": [round(float(v), 4) for v in np.sqrt(np.diag(fix.covariance_m2))],
                "bars": list(fix.transmitters),
                "verified": fix.verified,
            },
        )
        self._window.append((fix, point))
        if len(self._window) == 2 * _BLOCK:
            self._emit(_BLOCK)

    def _emit(self, count: int) -> None:
        """Smooth the window, write its first points and drop them."""
        smooth = smooth_trajectory([point for _, point in self._window], self._spec)
        line = self._line_end
        for (fix, filtered), smoothed in list(zip(self._window, smooth, strict=True))[:count]:
            place, way = self._place(smoothed), _way(smoothed)
            self._track_rows.writerow(
                [
                    f"{fix.t_us:.1f}",
                    *_place_row(place, smoothed.covariance_m2),
                    f"{way[0]:.3f}",
                    f"{way[1]:.2f}",
                    *_place_row(self._place(filtered), filtered.covariance_m2),
                    int(filtered.misses > 0),
                ]
            )
            if filtered.starts and line:
                self._line(line)
                line = []
            line.append([round(place[1], 9), round(place[0], 9), round(place[2], 4)])
            for watcher in self._watchers:
                watcher.add(fix, filtered, smoothed)
        self._line(line)
        # The next line begins where this one ends.
        self._line_end = line[-1:]
        self._window = self._window[count:]

    def _line(self, line: list[list[float]]) -> None:
        for piece in _cut(line):
            # A line of GeoJSON has two points or more.
            if len(piece) > 1:
                self._feature("LineString", piece, {"track": "smoothed"})

    def _feature(self, kind: str, coordinates: list[Any], properties: dict[str, Any]) -> None:
        shape = {"type": kind, "coordinates": coordinates}
        feature = {"type": "Feature", "geometry": shape, "properties": properties}
        self._geojson.write(("," if self._features else "") + "\n" + json.dumps(feature))
        self._features += 1

    def _place(self, point: TrajectoryPoint) -> tuple[float, float, float]:
        frame = self.positioner.frame
        assert frame is not None
        latitude, longitude, height = frame.to_geodetic(point.mean[:3])
        return float(latitude), float(longitude), float(height)

    def _close(self) -> None:
        for file in (self._fixes, self._track, self._nmea, self._geojson):
            file.close()
        if self._mcap is not None:
            self._mcap.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the files; the `ResultWriter` drops what it has not moved into place."""
        with suppress(OSError):
            self._close()


def _cut(line: list[list[float]]) -> list[list[list[float]]]:
    """A line in pieces that do not cross the 180th meridian (RFC 7946, 3.1.9)."""
    pieces = [line[:1]]
    for here, there in pairwise(line):
        turn = there[0] - here[0]
        if abs(turn) > 180:
            edge = math.copysign(180.0, here[0])
            share = (edge - here[0]) / (turn - math.copysign(360.0, turn))
            at = [round(a + share * (b - a), 9) for a, b in zip(here[1:], there[1:], strict=True)]
            pieces[-1].append([edge, *at])
            pieces.append([[-edge, *at]])
        pieces[-1].append(there)
    return pieces


def _fix_row(fix: Fix) -> list[str]:
    sigma = np.sqrt(np.diag(fix.covariance_m2)).tolist()
    return [
        f"{fix.t_us:.1f}",
        _text(fix.latitude_deg, 10),
        _text(fix.longitude_deg, 10),
        _text(fix.height_m, 4),
        *(_text(value, 4) for value in sigma),
        _text(fix.heading_deg, 4),
        _text(fix.heading_sigma_deg, 4),
        _text(fix.pitch_deg, 4),
        _text(fix.roll_deg, 4),
        " ".join(map(str, fix.transmitters)),
        str(int(fix.verified)),
        fix.refusal,
        fix.detail,
    ]


def _place_row(place: tuple[float, float, float], covariance_m2: NDArray[np.float64]) -> list[str]:
    sigma = np.sqrt(np.diag(covariance_m2)).tolist()
    return [f"{place[0]:.10f}", f"{place[1]:.10f}", f"{place[2]:.4f}", *(f"{value:.4f}" for value in sigma)]


def _way(point: TrajectoryPoint) -> tuple[float, float]:
    """Speed over ground, m/s, and course, degrees clockwise from north."""
    east, north = float(point.mean[3]), float(point.mean[4])
    return math.hypot(east, north), math.degrees(math.atan2(east, north)) % 360


def _text(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""
