"""`frames.csv`: a row a decoded frame."""

import csv

from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.results.text import symbol_list, text_or_empty
from evlcp_sdk.values import Frame, Packet

__all__ = ["FILTERED_COLUMNS", "FRAME_COLUMNS", "FramesCsv", "filtered_row", "frame_row", "is_filtered"]

FRAME_COLUMNS = (
    "transmitter",
    "packet",
    "frame",
    "t_us",
    "symbols",
    "quality",
    "distance_m",
    "distance_sigma_m",
    "x_px",
    "y_px",
)
"""Columns of `frames.csv` and `frames.parquet`."""

FILTERED_COLUMNS = ("distance_filtered_m", "distance_filtered_sigma_m")
"""Columns that follow where a tracking algorithm filters the distance."""


class FramesCsv(Sink):
    """Writes `frames.csv`."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._filtered = is_filtered(run)
        self._rows = csv.writer(folder.open("frames.csv"), lineterminator="\n")
        self._rows.writerow(FRAME_COLUMNS + (FILTERED_COLUMNS if self._filtered else ()))

    def packet(self, packet: Packet) -> None:
        """Write a row per frame."""
        for frame in packet.frames:
            self._rows.writerow(frame_row(frame) + (filtered_row(frame) if self._filtered else []))


def is_filtered(run: Run) -> bool:
    """Whether the distance is filtered, so that `FILTERED_COLUMNS` follow."""
    return run.link.algorithm("tracking").compile().distance is not None


def frame_row(frame: Frame) -> list[str]:
    """The values of `FRAME_COLUMNS` as text; empty where there is none, `-` for a symbol not given."""
    symbols = symbol_list(frame.soft.symbols)
    return [
        str(frame.transmitter),
        str(frame.packet),
        str(frame.frame),
        f"{frame.t_us:.2f}",
        " ".join("-" if symbol is None else str(symbol) for symbol in symbols),
        f"{frame.soft.quality:.4f}",
        text_or_empty(frame.range.distance_m, 4),
        text_or_empty(frame.range.sigma_m, 4),
        f"{frame.x_px:.3f}",
        f"{frame.y_px:.3f}",
    ]


def filtered_row(frame: Frame) -> list[str]:
    """The frame's values of `FILTERED_COLUMNS` as text; empty where there is none."""
    if frame.filtered is None:
        return ["", ""]
    return [text_or_empty(frame.filtered.distance_m, 4), text_or_empty(frame.filtered.sigma_m, 4)]
