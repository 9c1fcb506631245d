"""`alternatives.csv`: a row per pose that fits where a fix is refused, as more than one does."""

import csv

from evlcp_sdk.place.navigator import Place
from evlcp_sdk.results.columns import PLACE_COLUMNS, place_row
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.values import Fix

ALTERNATIVE_COLUMNS = (
    *("t_us", "number", "likelihood", *PLACE_COLUMNS),
    *("heading_deg", "pitch_deg", "roll_deg", "bars"),
)
"""Columns of `alternatives.csv`."""


class AlternativesCsv(Sink):
    """Writes `alternatives.csv`."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._rows = csv.writer(folder.open("alternatives.csv"), lineterminator="\n")
        self._rows.writerow(ALTERNATIVE_COLUMNS)

    def fix(self, fix: Fix, filtered: Place | None) -> None:
        """Write a row per pose, the likeliest first."""
        for number, one in enumerate(fix.alternatives):
            self._rows.writerow(
                [
                    *(f"{fix.t_us:.1f}", number, f"{one.likelihood:.6g}"),
                    *place_row(one),
                    *(f"{angle:.4f}" for angle in (one.heading_deg, one.pitch_deg, one.roll_deg)),
                    " ".join(map(str, fix.transmitters)),
                ]
            )
