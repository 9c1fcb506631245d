"""`points.csv`: a row per frame with a distance, the bar's centre in the camera's axes."""

import csv

from evlcp_sdk.place.bearing import bar_point
from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.values import Packet

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

POINT_COLUMNS = (
    *("transmitter", "packet", "frame", "t_us", "x_m", "y_m", "z_m"),
    *(f"cov_{'xyz'[i]}{'xyz'[j]}_m2" for i, j in _PAIRS),
)
"""Columns of `points.csv`: x right, y down, z forward."""


class PointsCsv(Sink):
    """Writes `points.csv`."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._rows = csv.writer(folder.open("points.csv"), lineterminator="\n")
        self._rows.writerow([*POINT_COLUMNS, *["link"] * bool(run.links)])

    def packet(self, packet: Packet) -> None:
        """Write a row per frame that has a distance; reflections are no bars at a place."""
        link = self.run.link_of(packet.link)
        errors = ErrorModel.of(link.position)
        for frame in packet.frames:
            found = None
            if frame.echo_of is None:
                found = bar_point(frame, link.bar.length_m, link.camera, link.camera_sigma, errors)
            if found is not None:
                self._rows.writerow(
                    [
                        *(frame.transmitter, frame.packet, frame.frame, f"{frame.t_us:.2f}"),
                        *(f"{value:.4f}" for value in found.point_m),
                        *(f"{found.covariance_m2[i, j]:.6g}" for i, j in _PAIRS),
                        *([packet.link] if packet.link else []),
                    ]
                )
