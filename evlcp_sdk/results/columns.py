"""What a frame has to say, by column: one list for CSV, Parquet and tables."""

import math
from typing import Any

from evlcp_sdk.formatting import symbol_list
from evlcp_sdk.values import Frame

__all__ = ["FILTERED_COLUMNS", "FRAME_COLUMNS", "LINK_COLUMN", "frame_columns", "frame_value"]

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
    "echo_of",
)
"""Columns of every frame."""

FILTERED_COLUMNS = ("distance_filtered_m", "distance_filtered_sigma_m")
"""Columns that follow where a tracking algorithm filters the distance."""

LINK_COLUMN = "link"
"""The last column where there are several links: the name of the one."""


def frame_columns(*, filtered: bool, links: bool) -> tuple[str, ...]:
    """The columns of a run.

    Args:
        filtered: A tracking algorithm filters the distance.
        links: There are several links.
    """
    return FRAME_COLUMNS + FILTERED_COLUMNS * filtered + (LINK_COLUMN,) * links


def frame_value(frame: Frame, column: str) -> Any:
    """A frame's value in a column, not rounded.

    `symbols` is a list, None for a symbol that is not given; a distance that is not given is NaN; `echo_of`
    is None where the frame is not a reflection.
    """
    match column:
        case "symbols":
            return symbol_list(frame.soft.symbols)
        case "quality":
            return frame.soft.quality
        case "distance_m":
            return frame.range.distance_m
        case "distance_sigma_m":
            return frame.range.sigma_m
        case "distance_filtered_m":
            return math.nan if frame.filtered is None else frame.filtered.distance_m
        case "distance_filtered_sigma_m":
            return math.nan if frame.filtered is None else frame.filtered.sigma_m
        case _:
            return getattr(frame, column)
