"""The frames of packets as a table of pandas or Arrow."""

import math
from collections.abc import Iterable
from typing import Any, Literal

from evlcp_sdk.errors import ConfigError, import_extra
from evlcp_sdk.results.columns import frame_columns, frame_value
from evlcp_sdk.values import Packet


def frames_table(packets: Iterable[Packet], kind: Literal["pandas", "arrow"] = "pandas") -> Any:
    """The frames of packets as a table, a row per frame, with the columns of `frames.csv`, not rounded.

    `symbols` holds lists, None for a symbol that is not given; a distance that is not given is NaN in pandas,
    null in Arrow; `echo_of` is null in both where a frame is not a reflection. The columns of the filtered
    distance are there if any frame has one.

    Args:
        packets: What a receiver gives; read to the end.
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
    for name, values in columns.items():
        if values and isinstance(values[0], float):
            columns[name] = [v if math.isfinite(v) else None for v in values]
    table, at = import_extra("pyarrow", "parquet").table(columns), names.index("echo_of")
    # Where nothing is a reflection, the column has no type of its own.
    return table.set_column(at, "echo_of", table.column(at).cast("int64"))
