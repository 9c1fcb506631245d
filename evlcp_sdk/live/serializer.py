"""What browsers are told of a live run: results as lines of JSON, pictures with what is drawn on them."""

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
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from evlcp_sdk.values import Fix, Frame, ReceivedMessage

_MOST_SAID: Final = 200
"""Characters of a message that are shown."""

_LATEST_US: Final = 500_000
_MOST_BARS: Final = 64
"""A bar is drawn as its newest frame shows it, for so long, and so many of them."""


class Serializer:
    """Writes what a run finds for browsers, in the thread that asks.

    Args:
        links: The configurations by name, as `name_links` gives them.
        sites: Where the bars stand, for the map.
    """

    def __init__(self, links: Mapping[str, Link], sites: Sequence[BarSite] = ()) -> None:
        self._columns = frame_columns(filtered=False, links=len(links) > 1)
        self._sites = tuple(sites)
        self._sites_sent = not sites
        self._bars: dict[int, Frame] = {}
        self._shot = (-1, "", b"")

    def lines(self, news: News, *, frames: bool) -> list[tuple[str, str]]:
        """What is said of some news, JSON, each with its kind: that of the news, or `bars`.

        Args:
            news: Of a kind that is shown.
            frames: Tell of frames, too; False where nobody looks on.
        """
        if news.kind != "frame":
            return [(kind, json.dumps({"line": kind} | values)) for kind, values in self._lines_of(news)]
        self._keep(news.value)
        return [("frame", self._frame(news))] * frames

    def shot(self, picture: Picture) -> tuple[str, bytes]:
        """A picture's time and regions, and the clusters of bars in it with what they said last; and as PNG.

        The first are members `picture` and `bars` of a JSON object, the same again for the same picture.
        """
        if self._shot[0] != picture.number:
            latest = [one for one in self._bars.values() if one.t_us > picture.t_us - _LATEST_US]
            self._shot = picture.number, _picture_json(picture, latest), picture.image().to_png()
        return self._shot[1:]

    def _keep(self, frame: Frame) -> None:
        self._bars[frame.transmitter] = frame
        if len(self._bars) > _MOST_BARS:
            del self._bars[min(self._bars, key=lambda number: self._bars[number].t_us)]

    def _lines_of(self, news: News) -> list[tuple[str, dict[str, Any]]]:
        kind, value = news.kind, news.value
        if kind == "message":
            return [(kind, _shown(value))]
        if kind == "status":
            shown = asdict(value)
            return [(kind, {name: shown[name] for name in shown.keys() - {"regions", "health"}})]
        if kind == "end":
            return [(kind, {key: value.get(key) for key in ("status", "error", "result")})]
        fix, place = value.fix, value.filtered
        if place is None:
            return [(kind, fix_line(fix))]
        on_the_map = {
            "enu_m": [round(v, 3) for v in fix.enu_m.tolist()],
            "covariance_m2": [float(f"{v:.4g}") for v in fix.covariance_m2[:2, :2].ravel().tolist()],
            "track_m": [round(v, 3) for v in place.enu_m.tolist()],
            "starts": place.starts,
            "speed_m_s": None if place.starts else round(place.speed_m_s, 2),
        }
        return [*self._bars_of(fix), (kind, fix_line(fix) | on_the_map)]

    def _frame(self, news: News) -> str:
        late = "null" if news.late_ms is None else f"{news.late_ms:.3f}"
        return f'{format_frame(news.value, self._columns)[:-1]}, "late_ms": {late}}}'

    def _bars_of(self, fix: Fix) -> list[tuple[str, dict[str, Any]]]:
        """The bars in local metres, with the first fix that is given."""
        if self._sites_sent:
            return []
        self._sites_sent = True
        # The axes of a fix turn by 0.009 degrees a kilometre: nothing on a map.
        here = LocalAxes(fix.latitude_deg, fix.longitude_deg, fix.height_m)
        bars = []
        for one in self._sites:
            place = here.to_enu(one.latitude_deg, one.longitude_deg, one.height_m) + fix.enu_m
            bars.append([one.transmitter_id, *(round(v, 3) for v in place.tolist())])
        return [("bars", {"bars": bars})]


def _shown(message: ReceivedMessage) -> dict[str, Any]:
    """What a message says; where its kind, which may be a plugin's, fails to show it, why."""
    try:
        # A page reads no NaN.
        shown: dict[str, Any] = json.loads(message_line(message), parse_constant=_not_a_number)
    except (PluginError, ValueError) as fault:
        about = {name: getattr(message, name) for name in ("transmitter", "t_us", "trust")}
        ids = {"kind": message.kind.name, "transmitter_id": message.message.transmitter_id}
        return {**about, **ids, "said": f"cannot be shown: {fault}"}
    return shown | {"said": message.summary(_MOST_SAID)}


def _not_a_number(name: str) -> None:
    raise ValueError(f"a message kind shows {name}, which JSON has not")


def _picture_json(picture: Picture, bars: Sequence[Frame]) -> str:
    regions = [
        [one.id, *(round(v, 1) for v in (one.x_px, one.y_px, one.width_px, one.height_px))]
        for one in picture.regions
    ]
    shown = {"number": picture.number, "t_us": picture.t_us, "window_us": WINDOW_US, "regions": regions}
    return json.dumps({"picture": shown, "bars": [_bar(frame) for frame in bars]})[1:-1]


def _bar(frame: Frame) -> dict[str, Any]:
    """Where a bar's clusters are, and what they said last."""
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
