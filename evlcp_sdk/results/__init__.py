"""What a run leaves behind: one sink a format."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import SinkRecord, hookimpl

__all__ = ["evlcp_sinks"]


@hookimpl
def evlcp_sinks() -> Iterator[SinkRecord]:
    """The formats that come with the SDK."""
    here = "evlcp_sdk.results"
    yield SinkRecord(
        "frames", f"{here}.frames_csv:FramesCsv", ("frames.csv",), "a row per frame", default=True
    )
    yield SinkRecord(
        "packets",
        f"{here}.packets_jsonl:PacketsJsonl",
        ("packets.jsonl",),
        "a line per packet or message",
        default=True,
    )
    yield SinkRecord(
        "parquet",
        f"{here}.frames_parquet:FramesParquet",
        ("frames.parquet",),
        "the rows of frames.csv with their types",
        packages=("pyarrow",),
        extra="evlcp-sdk[parquet]",
    )
    yield SinkRecord(
        "points",
        f"{here}.points_csv:PointsCsv",
        ("points.csv",),
        "where each frame's bar is in the camera's axes",
    )
    yield SinkRecord(
        "fixes",
        f"{here}.fixes_csv:FixesCsv",
        ("fixes.csv",),
        "a row a position",
        default=True,
        positions=True,
    )
    yield SinkRecord(
        "alternatives",
        f"{here}.alternatives_csv:AlternativesCsv",
        ("alternatives.csv",),
        "the poses that fit where a position is refused as two do",
        positions=True,
    )
    yield SinkRecord(
        "track",
        f"{here}.track_csv:TrackCsv",
        ("track.csv",),
        "positions smoothed and filtered",
        default=True,
        positions=True,
    )
    yield SinkRecord(
        "geojson",
        f"{here}.geojson:GeoJson",
        ("fixes.geojson",),
        "positions, bars and track for a map",
        default=True,
        positions=True,
    )
    yield SinkRecord(
        "nmea",
        f"{here}.nmea:Nmea",
        ("fixes.nmea",),
        "positions as NMEA-0183",
        default=True,
        positions=True,
    )
    yield SinkRecord(
        "kml",
        f"{here}.kml:Kml",
        ("fixes.kml",),
        "positions, bars and track for Google Earth",
        positions=True,
    )
    yield SinkRecord(
        "navsat",
        f"{here}.navsat:NavSat",
        ("navsat.mcap",),
        "positions as a bag of ROS 2",
        positions=True,
        packages=("mcap", "rosbags"),
        extra="evlcp-sdk[ros]",
    )
    yield SinkRecord(
        "mcap",
        f"{here}.mcap:Mcap",
        ("fixes.mcap",),
        "positions for Foxglove",
        positions=True,
        packages=("mcap", "mcap_protobuf", "foxglove_schemas_protobuf"),
        extra="evlcp-sdk[mcap]",
    )
    yield SinkRecord(
        "figures",
        "evlcp_sdk.report.figures:Figures",
        ("regions.png", "presence.png", "distance.png", "track.png"),
        "regions, presence, distance and track as pictures",
    )
    yield SinkRecord(
        "report",
        "evlcp_sdk.report.page:Report",
        ("report.html",),
        "the recording on one page: slow motion, charts, map, messages, warnings",
    )
