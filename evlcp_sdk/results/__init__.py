"""The results of a run: one sink a format."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import SinkRecord, hookimpl

__all__ = ["evlcp_sinks"]

_FORMATS = {
    "frames": ("results.frames_csv:FramesCsv", "frames.csv", "a row per frame"),
    "packets": ("results.packets_jsonl:PacketsJsonl", "packets.jsonl", "a line per packet or message"),
    "points": (
        "results.position_tables:PointsCsv",
        "points.csv",
        "where each frame's bar is in the camera's axes",
    ),
    "fixes": ("results.position_tables:FixesCsv", "fixes.csv", "a row a position"),
    "alternatives": (
        "results.position_tables:AlternativesCsv",
        "alternatives.csv",
        "the poses that fit where a position is refused as two do",
    ),
    "track": ("results.position_tables:TrackCsv", "track.csv", "positions smoothed and filtered"),
    "geojson": ("results.geojson:GeoJson", "fixes.geojson", "positions, bars and track for a map"),
    "nmea": ("results.nmea:Nmea", "fixes.nmea", "positions as NMEA-0183"),
    "figures": (
        "report.figures:Figures",
        "regions.png presence.png distance.png track.png",
        "regions, presence, distance and track as pictures",
    ),
    "report": (
        "report.page:Report",
        "report.html",
        "the recording on one page: slow motion, charts, map, messages, warnings",
    ),
}
"""Of each format its sink in `evlcp_sdk`, its files, and a line for help."""

_OF_POSITIONS = ("fixes", "alternatives", "track", "geojson", "nmea")
_DEFAULT = ("frames", "packets", "fixes", "track", "geojson", "nmea")
"""Formats that are written with positions only, and those that are written by default."""


@hookimpl
def evlcp_sinks() -> Iterator[SinkRecord]:
    """The formats that come with the SDK."""
    for name, (target, files, summary) in _FORMATS.items():
        default, positions = name in _DEFAULT, name in _OF_POSITIONS
        yield SinkRecord(name, f"evlcp_sdk.{target}", (*files.split(),), summary, default, positions)
