"""`fixes.csv`, `alternatives.csv` and `track.csv` of positions, and `points.csv` of frames."""

import csv
from collections.abc import Sequence
from typing import ClassVar

from evlcp_sdk.files import escape_formula
from evlcp_sdk.formatting import format_or_empty
from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.navigator import Place, Settled
from evlcp_sdk.place.points import locate_bar
from evlcp_sdk.results.columns import PLACE_COLUMNS, place_row
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.values import Fix, Packet

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


class _Table(Sink):
    """A CSV file with these columns, and one for the link's name where there are several links."""

    name: ClassVar[str]
    columns: ClassVar[tuple[str, ...]]
    names_link: ClassVar[bool] = False

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._rows = csv.writer(folder.open(self.name), lineterminator="\n")
        self._rows.writerow([*self.columns, *["link"] * bool(self.names_link and run.links)])


class FixesCsv(_Table):
    """Writes `fixes.csv`: a row per fix, given or refused."""

    name = "fixes.csv"
    columns = (
        *("t_us", *PLACE_COLUMNS, "heading_deg", "heading_sigma_deg", "pitch_deg", "roll_deg", "bars"),
        *("verified", "misfit", "freedom", "hpl_m", "vpl_m", "excluded", "alarms", "refusal", "detail"),
        *("source", "contradicted"),
    )
    names_link = True

    def fix(self, fix: Fix, filtered: Place | None) -> None:
        """Write a row."""
        navigator = self.run.navigator if self.run.links else None
        self._rows.writerow(
            [
                f"{fix.t_us:.1f}",
                *place_row(fix),
                *(format_or_empty(v, 4) for v in (fix.heading_deg, fix.heading_sigma_deg)),
                *(format_or_empty(v, 4) for v in (fix.pitch_deg, fix.roll_deg)),
                " ".join(map(str, fix.transmitters)),
                int(fix.verified),
                format_or_empty(fix.misfit, 4),
                fix.freedom,
                *(format_or_empty(v, 3) for v in (fix.hpl_m, fix.vpl_m)),
                "; ".join(fix.excluded),
                " ".join(fix.alarms),
                *(escape_formula(fix.refusal), escape_formula(fix.detail), fix.source),
                " ".join(fix.contradicted),
                *([] if navigator is None else [navigator.positioner.links_of(fix)]),
            ]
        )


class AlternativesCsv(_Table):
    """Writes `alternatives.csv`: a row per pose that fits where a fix is refused because several do."""

    name = "alternatives.csv"
    columns = (
        *("t_us", "number", "likelihood", *PLACE_COLUMNS, "heading_deg", "pitch_deg", "roll_deg", "bars"),
    )

    def fix(self, fix: Fix, filtered: Place | None) -> None:
        """Write a row per pose, the likeliest first."""
        for number, pose in enumerate(fix.alternatives):
            self._rows.writerow(
                [
                    *(f"{fix.t_us:.1f}", number, f"{pose.likelihood:.6g}"),
                    *place_row(pose),
                    *(f"{angle:.4f}" for angle in (pose.heading_deg, pose.pitch_deg, pose.roll_deg)),
                    " ".join(map(str, fix.transmitters)),
                ]
            )


class TrackCsv(_Table):
    """Writes `track.csv`: a row per given fix, its place smoothed and filtered."""

    name = "track.csv"
    columns = (
        *("t_us", *PLACE_COLUMNS, "speed_m_s", "course_deg", *(f"filtered_{name}" for name in PLACE_COLUMNS)),
        *("left_out", "source", "focal_share", "focal_share_sigma"),
    )

    def settle(self, settled: Sequence[Settled]) -> None:
        """Write a row per fix."""
        for row in settled:
            smoothed = row.smoothed
            self._rows.writerow(
                [
                    f"{row.fix.t_us:.1f}",
                    *place_row(smoothed),
                    *(f"{smoothed.speed_m_s:.3f}", f"{smoothed.course_deg:.2f}"),
                    *place_row(row.filtered),
                    *(int(row.filtered.left_out), row.fix.source),
                    *(format_or_empty(v, 6) for v in (smoothed.focal_share, smoothed.focal_share_sigma)),
                ]
            )


class PointsCsv(_Table):
    """Writes `points.csv`: a row per frame with a distance, the bar's centre, x right, y down, z forward."""

    name = "points.csv"
    columns = (
        *("transmitter", "packet", "frame", "t_us", "x_m", "y_m", "z_m"),
        *("cov_xx_m2", "cov_yy_m2", "cov_zz_m2", "cov_xy_m2", "cov_xz_m2", "cov_yz_m2"),
    )
    names_link = True

    def packet(self, packet: Packet) -> None:
        """Write a row per frame that has a distance and is no reflection."""
        link = self.run.link_of(packet.link)
        errors = ErrorModel.of(link.position)
        for frame in (frame for frame in packet.frames if frame.echo_of is None):
            point = locate_bar(frame, link.bar.length_m, link.camera, link.camera_sigma, errors)
            if point is not None:
                self._rows.writerow(
                    [
                        *(frame.transmitter, frame.packet, frame.frame, f"{frame.t_us:.2f}"),
                        *(f"{value:.4f}" for value in point.point_m),
                        *(f"{point.covariance_m2[i, j]:.6g}" for i, j in _PAIRS),
                        *([packet.link] if packet.link else []),
                    ]
                )
