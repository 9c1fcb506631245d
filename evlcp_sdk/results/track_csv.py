"""`track.csv`: a row per fix that is given, its place smoothed and filtered."""

import csv
from collections.abc import Sequence

from evlcp_sdk.formatting import text_or_empty
from evlcp_sdk.place.navigator import Settled
from evlcp_sdk.results.columns import PLACE_COLUMNS, place_row
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink

TRACK_COLUMNS = (
    "t_us",
    *PLACE_COLUMNS,
    "speed_m_s",
    "course_deg",
    *(f"filtered_{name}" for name in PLACE_COLUMNS),
    "left_out",
    "source",
    "focal_share",
    "focal_share_sigma",
)
"""Columns of `track.csv`: smoothed, then filtered."""


class TrackCsv(Sink):
    """Writes `track.csv`."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._rows = csv.writer(folder.open("track.csv"), lineterminator="\n")
        self._rows.writerow(TRACK_COLUMNS)

    def settle(self, settled: Sequence[Settled]) -> None:
        """Write a row per fix."""
        for one in settled:
            self._rows.writerow(
                [
                    f"{one.fix.t_us:.1f}",
                    *place_row(one.smoothed),
                    f"{one.smoothed.speed_m_s:.3f}",
                    f"{one.smoothed.course_deg:.2f}",
                    *place_row(one.filtered),
                    int(one.filtered.left_out),
                    one.fix.source,
                    text_or_empty(one.smoothed.focal_share, 6),
                    text_or_empty(one.smoothed.focal_share_sigma, 6),
                ]
            )
