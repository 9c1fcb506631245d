"""The formats that few use: bags, HDF5, MAT, AEDAT4, DAT, ES; Parquet, KML, MCAP."""

import os
from collections.abc import Iterator
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING

from evlcp_sdk.errors import InputError
from evlcp_sdk.plugin.hooks import SinkRecord, hookimpl

if TYPE_CHECKING:
    from evlcp_sdk.files import Outputs
    from evlcp_sdk.plugin.source import EventSource
    from evlcp_sdk.plugin.writer import EventWriter

_OPENERS = {
    "bag": "evlcp_formats.bags:open_bag",
    "hdf5": "evlcp_formats.hdf5:open_hdf5",
    "mat": "evlcp_formats.matlab:open_mat",
    "faery": "evlcp_formats.faery:FaerySource",
}
_STARTS = {
    b"#ROSBAG V2.0": "bag",
    b"SQLite format 3": "bag",
    b"\x89MCAP0\r\n": "bag",
    b"\x89HDF\r\n\x1a\n": "hdf5",
    # HDF5 starts later in the file.
    b"MATLAB 7.3": "hdf5",
    b"MATLAB 5.0": "mat",
}
_SUFFIXES = {".aedat4": "faery", ".aedat": "faery", ".dat": "faery", ".es": "faery", ".mat": "mat"}


@hookimpl(trylast=True)
def evlcp_open_events(url: str) -> "EventSource | None":
    """Open a file of one of these formats by its first bytes or its suffix, or by a scheme as `bag:`."""
    scheme, colon, rest = url.partition(":")
    if not colon or os.path.lexists(url):
        return _open_as(url, _detect_format(url))
    scheme = scheme.lower()
    if scheme in ("bag", "hdf5"):
        return _open_as(f"{scheme}:{rest}", scheme)
    if scheme != "list":
        return None
    path = rest.rpartition("?")[0] or rest
    found = _detect_format(path)
    if found == "hdf5":
        raise InputError(f"{path}: a file of MATLAB 7.3 or HDF5, expected to be named hdf5:{path}")
    return _open_as(f"{scheme}:{rest}", found) if found == "mat" else None


def _open_as(url: str, format: str) -> "EventSource | None":
    source: EventSource | None = resolve_name(_OPENERS[format])(url) if format else None
    return source


def _detect_format(name: str) -> str:
    """Return the format of a file by its suffix or its first bytes, or of a folder; empty for another."""
    path = Path(name)
    try:
        if path.is_dir():
            return "bag" if (path / "metadata.yaml").is_file() else ""
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            start = file.read(16)
        by_suffix = _SUFFIXES.get(path.suffix.lower(), "")
        if path.suffix.lower() == ".dat":
            from evlcp_sdk.io.lists import is_list

            # Tables of text are often named so, too.
            by_suffix = "" if is_list(path) else by_suffix
    except OSError:
        return ""
    return next((found for magic, found in _STARTS.items() if start.startswith(magic)), by_suffix)


@hookimpl(trylast=True)
def evlcp_open_writer(
    path: Path, width: int | None, height: int | None, format: str, outputs: "Outputs | None"
) -> "EventWriter | None":
    """Write a bag of ROS 2: format BAG, or `.mcap`."""
    if (format or path.suffix).upper() not in ("BAG", ".MCAP"):
        return None
    from evlcp_formats.ros import EventBagWriter

    return EventBagWriter(path, width, height, outputs=outputs)


@hookimpl
def evlcp_sinks() -> Iterator[SinkRecord]:
    """Results as Parquet, for Google Earth, ROS 2 and Foxglove."""
    yield SinkRecord(
        *("parquet", "evlcp_formats.parquet:FramesParquet", ("frames.parquet",)),
        summary="frames.csv's rows with their types",
        packages=("pyarrow",),
        extra="evlcp-sdk[parquet]",
    )
    yield SinkRecord(
        *("kml", "evlcp_formats.kml:Kml", ("fixes.kml",)),
        summary="positions, bars and track for Google Earth",
        positions=True,
    )
    yield SinkRecord(
        *("navsat", "evlcp_formats.navsat:NavSat", ("navsat.mcap",)),
        summary="positions as a bag of ROS 2",
        positions=True,
        packages=("mcap", "rosbags"),
        extra="evlcp-sdk[ros]",
    )
    yield SinkRecord(
        *("mcap", "evlcp_formats.foxglove:Mcap", ("fixes.mcap",)),
        summary="positions for Foxglove",
        positions=True,
        packages=("mcap", "mcap_protobuf", "foxglove_schemas_protobuf"),
        extra="evlcp-sdk[mcap]",
    )
