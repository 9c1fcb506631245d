"""`frames.csv`: a row a decoded frame."""

import csv
from typing import Any

from evlcp_sdk.formatting import format_or_empty
from evlcp_sdk.results.columns import frame_columns, frame_value
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.values import Packet


class FramesCsv(Sink):
    """Writes `frames.csv`."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._columns = frame_columns(filtered=run.filtered, links=bool(run.links))
        self._rows = csv.writer(folder.open("frames.csv"), lineterminator="\n")
        self._rows.writerow(self._columns)

    def packet(self, packet: Packet) -> None:
        """Write a row per frame."""
        for frame in packet.frames:
            self._rows.writerow([_format_value(name, frame_value(frame, name)) for name in self._columns])


_DIGITS = {"t_us": 2, "quality": 4, "x_px": 3, "y_px": 3}
"""Decimals; distances and their sigmas, m, have four."""


def _format_value(column: str, value: Any) -> str:
    """A value as text; empty where there is none, `-` for a symbol that is not given."""
    if isinstance(value, float):
        return format_or_empty(value, _DIGITS.get(column, 4))
    if isinstance(value, list):
        return " ".join(["-" if symbol is None else str(symbol) for symbol in value])
    return "" if value is None else str(value)
