"""Results of a live run as JSON for browsers, and pictures with the bars in them."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from evlcp_sdk.errors import PluginError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.live.pictures import WINDOW_US, Picture
from evlcp_sdk.live.publisher import News
from evlcp_sdk.results.columns import frame_columns
from evlcp_sdk.results.lines import fix_line, format_frame
from evlcp_sdk.results.packets_jsonl import message_line
from evlcp_sdk.results.picture import encode_png
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from evlcp_sdk.values import Fix, Frame, ReceivedMessage, remember_newest

_MAX_CHARACTERS: Final = 200
"""Of a message."""

_BAR_MEMORY_US: Final = 500_000
_MAX_BARS: Final = 64
"""Time for which a bar is drawn after its newest frame, and most bars."""


class Serializer:
    """Serializes results for browsers, by the links' names and, for the map, the places of the bars."""

    def __init__(self, links: Mapping[str, Link], sites: Sequence[BarSite] = ()) -> None:
        self._columns = frame_columns(filtered=False, links=len(links) > 1)
        self._sites = tuple(sites)
        self._sites_sent = not sites
        self._bars: dict[int, Frame] = {}
        self._last_picture = (-1, "", b"")

    def serialize(self, news: News, *, frames: bool) -> list[tuple[str, str]]:
        """Lines of JSON for some news, each with its kind: that of the news, or `bars`.

        Frames are only kept for pictures unless `frames`.
        """
        if news.kind != "frame":
            return [(kind, json.dumps({"line": kind} | values)) for kind, values in self._describe_news(news)]
        frame: Frame = news.value
        remember_newest(self._bars, frame.transmitter, frame, _MAX_BARS)
        late = "null" if news.late_ms is None else f"{news.late_ms:.3f}"
        line = f'{format_frame(frame, self._columns)[:-1]}, "late_ms": {late}}}'
        return [("frame", line)] * frames

    def serialize_picture(self, picture: Picture) -> tuple[str, bytes]:
        """The members `picture` and `bars` of a JSON object for a picture, and the picture as PNG.

        They have its time and regions, and the clusters of the bars in it with their newest symbols. The last
        picture is cached.
        """
        if self._last_picture[0] != picture.number:
            latest = [one for one in self._bars.values() if abs(one.t_us - picture.t_us) < _BAR_MEMORY_US]
            self._last_picture = picture.number, _picture_json(picture, latest), encode_png(picture.paint())
        return self._last_picture[1:]

    def _describe_news(self, news: News) -> list[tuple[str, dict[str, Any]]]:
        kind, value = news.kind, news.value
        if kind == "message":
            return [(kind, _describe_message(value))]
        if kind == "status":
            status = asdict(value)
            return [(kind, {name: status[name] for name in status.keys() - {"regions", "health"}})]
        if kind == "end":
            return [(kind, {key: value.get(key) for key in ("status", "error", "result")})]
        fix, place = value.fix, value.filtered
        if place is None:
            return [(kind, fix_line(fix))]
        map_fields = {
            "enu_m": [round(v, 3) for v in fix.enu_m.tolist()],
            "covariance_m2": [float(f"{v:.4g}") for v in fix.covariance_m2[:2, :2].ravel().tolist()],
            "track_m": [round(v, 3) for v in place.enu_m.tolist()],
            "starts": place.starts,
            "speed_m_s": None if place.starts else round(place.speed_m_s, 2),
        }
        return [*self._describe_sites(fix), (kind, fix_line(fix) | map_fields)]

    def _describe_sites(self, fix: Fix) -> list[tuple[str, dict[str, Any]]]:
        """The places of the bars in local metres, with the first given fix."""
        if self._sites_sent:
            return []
        self._sites_sent = True
        # The axes of a fix turn by 0.009 degrees a kilometre, which no map shows.
        axes = LocalAxes(fix.latitude_deg, fix.longitude_deg, fix.height_m)
        bars = []
        for site in self._sites:
            place = axes.to_enu(site.latitude_deg, site.longitude_deg, site.height_m) + fix.enu_m
            bars.append([site.transmitter_id, *(round(v, 3) for v in place.tolist())])
        return [("bars", {"bars": bars})]


def _describe_message(message: ReceivedMessage) -> dict[str, Any]:
    """A message as JSON values; where its kind, which may be a plugin's, fails, the reason."""
    try:
        # A page reads no NaN.
        line: dict[str, Any] = json.loads(message_line(message), parse_constant=_refuse_constant)
    except (PluginError, ValueError) as fault:
        fields = {name: getattr(message, name) for name in ("transmitter", "t_us", "trust")}
        ids = {"kind": message.kind.name, "transmitter_id": message.message.transmitter_id}
        return {**fields, **ids, "said": f"cannot be shown: {fault}"}
    return line | {"said": message.summary(_MAX_CHARACTERS)}


def _refuse_constant(name: str) -> None:
    raise ValueError(f"a message kind shows {name}, which JSON has not")


def _picture_json(picture: Picture, bars: Sequence[Frame]) -> str:
    regions = [
        [one.id, *(round(v, 1) for v in (one.x_px, one.y_px, one.width_px, one.height_px))]
        for one in picture.regions
    ]
    table = {"number": picture.number, "t_us": picture.t_us, "window_us": WINDOW_US, "regions": regions}
    return json.dumps({"picture": table, "bars": [_describe_bar(frame) for frame in bars]})[1:-1]


def _describe_bar(frame: Frame) -> dict[str, Any]:
    points = np.round(frame.points_px, 2).tolist()
    return {
        "transmitter": frame.transmitter,
        "link": frame.link,
        "echo_of": frame.echo_of,
        "x_px": round(frame.x_px, 2),
        "y_px": round(frame.y_px, 2),
        "points": [point if math.isfinite(sum(point)) else None for point in points],
        "symbols": frame.soft.symbols.tolist(),
    }
