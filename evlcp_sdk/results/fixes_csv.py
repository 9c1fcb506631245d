"""`fixes.csv`: a row per fix, given or refused."""

import csv

from evlcp_sdk.files import defused
from evlcp_sdk.formatting import text_or_empty
from evlcp_sdk.place.navigator import Place
from evlcp_sdk.results.columns import PLACE_COLUMNS, place_row
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.values import Fix

FIX_COLUMNS = (
    "t_us",
    *PLACE_COLUMNS,
    *("heading_deg", "heading_sigma_deg", "pitch_deg", "roll_deg", "bars", "verified", "misfit", "freedom"),
    *("hpl_m", "vpl_m", "excluded", "alarms", "refusal", "detail", "source", "contradicted"),
)
"""Columns of `fixes.csv`."""


class FixesCsv(Sink):
    """Writes `fixes.csv`."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._rows = csv.writer(folder.open("fixes.csv"), lineterminator="\n")
        self._rows.writerow([*FIX_COLUMNS, *(["link"] if run.links else [])])

    def fix(self, fix: Fix, filtered: Place | None) -> None:
        """Write a row."""
        navigator = self.run.navigator if self.run.links else None
        self._rows.writerow(
            [
                f"{fix.t_us:.1f}",
                *place_row(fix),
                *(text_or_empty(v, 4) for v in (fix.heading_deg, fix.heading_sigma_deg)),
                *(text_or_empty(v, 4) for v in (fix.pitch_deg, fix.roll_deg)),
                " ".join(map(str, fix.transmitters)),
                str(int(fix.verified)),
                text_or_empty(fix.misfit, 4),
                str(fix.freedom),
                text_or_empty(fix.hpl_m, 3),
                text_or_empty(fix.vpl_m, 3),
                "; ".join(fix.excluded),
                " ".join(fix.alarms),
                defused(fix.refusal),
                defused(fix.detail),
                fix.source,
                " ".join(fix.contradicted),
                *([] if navigator is None else [navigator.positioner.links_of(fix)]),
            ]
        )
