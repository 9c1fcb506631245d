"""The columns of a frame and of a place: one list for CSV, Parquet and tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Literal

from evlcp_sdk.errors import ConfigError, import_extra
from evlcp_sdk.formatting import format_or_empty, value_or_none
from evlcp_sdk.values import Alternative, Fix, Frame, Packet, SoftSymbols, sigmas

if TYPE_CHECKING:
    from evlcp_sdk.place.navigator import Place

FRAME_COLUMNS = (
    *("transmitter", "packet", "frame", "t_us", "symbols", "quality", "distance_m", "distance_sigma_m"),
    *("x_px", "y_px", "echo_of"),
)
"""Columns of every frame."""

FILTERED_COLUMNS = ("distance_filtered_m", "distance_filtered_sigma_m")
"""Columns that follow where a tracking algorithm filters the distance."""

LINK_COLUMN = "link"
"""The last column where there are several links: the name of the frame's."""

PLACE_COLUMNS = (
    *("latitude_deg", "longitude_deg", "height_m", "sigma_east_m", "sigma_north_m", "sigma_up_m"),
    *("cov_east_north_m2", "cov_east_up_m2", "cov_north_up_m2"),
)
"""Columns of a place on earth."""


def frame_columns(*, filtered: bool, links: bool) -> tuple[str, ...]:
    """The columns of a run, by whether distances are filtered, and whether there are several links."""
    return FRAME_COLUMNS + FILTERED_COLUMNS * filtered + (LINK_COLUMN,) * links


def frame_value(frame: Frame, column: str) -> Any:
    """A frame's value in a column, not rounded.

    `symbols` is a list, None for a symbol that is not given; a distance that is not given is NaN; `echo_of`
    is None where the frame is not a reflection.
    """
    return _VALUES.get(column, attrgetter(column))(frame)


_VALUES: Mapping[str, Callable[[Frame], Any]] = {
    "symbols": lambda frame: list_symbols(frame.soft),
    "quality": attrgetter("soft.quality"),
    "distance_m": attrgetter("range.distance_m"),
    "distance_sigma_m": attrgetter("range.sigma_m"),
    "distance_filtered_m": lambda frame: getattr(frame.filtered, "distance_m", math.nan),
    "distance_filtered_sigma_m": lambda frame: getattr(frame.filtered, "sigma_m", math.nan),
}
"""Values of columns that are no attributes of a frame."""


def list_symbols(soft: SoftSymbols) -> list[int | None]:
    """A frame's symbols; None for negative ones, which are not given."""
    return [symbol if symbol >= 0 else None for symbol in soft.symbols.tolist()]


def place_row(place: Alternative | Fix | Place) -> list[str]:
    """A place as text, by `PLACE_COLUMNS`; empty where unknown."""
    return [
        *(format_or_empty(value, 10) for value in (place.latitude_deg, place.longitude_deg)),
        *(format_or_empty(value, 4) for value in (place.height_m, *sigmas(place.covariance_m2))),
        *(f"{v:.6g}" if math.isfinite(v) else "" for v in place.covariance_m2[[0, 0, 1], [1, 2, 2]].tolist()),
    ]


def frames_table(packets: Iterable[Packet], kind: Literal["pandas", "arrow"] = "pandas") -> Any:
    """The frames of packets as a table, a row per frame, with the columns of `frames.csv`, not rounded.

    `symbols` holds lists, None for a symbol that is not given; a distance that is not given is NaN in pandas,
    null in Arrow; `echo_of` is null in both where a frame is not a reflection. The columns of the filtered
    distance are there if any frame has one.

    Args:
        packets: Packets of a receiver; read to the end.
        kind: "pandas" for a `pandas.DataFrame`, "arrow" for a `pyarrow.Table`.

    Raises:
        ConfigError: The library is not installed, or `kind` is another word.
    """
    if kind not in ("pandas", "arrow"):
        raise ConfigError(f"kind = {kind!r}, expected 'pandas' or 'arrow'")
    frames = [frame for packet in packets for frame in packet.frames]
    names = frame_columns(
        filtered=any(frame.filtered is not None for frame in frames),
        links=any(frame.link for frame in frames),
    )
    columns = {name: [frame_value(frame, name) for frame in frames] for name in names}
    if kind == "pandas":
        return import_extra("pandas", "pandas").DataFrame(columns).astype({"echo_of": "Int64"})
    columns = {name: [value_or_none(v) for v in values] for name, values in columns.items()}
    table, at = import_extra("pyarrow", "parquet").table(columns), names.index("echo_of")
    # Where nothing is a reflection, the column has no type of its own.
    return table.set_column(at, "echo_of", table.column(at).cast("int64"))
