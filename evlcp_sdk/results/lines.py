"""Frames, messages and fixes as a stream of JSON lines."""

import json
from collections.abc import Callable, Sequence
from typing import Any

from evlcp_sdk.formatting import round_or_none
from evlcp_sdk.results.columns import FRAME_COLUMNS, frame_columns, frame_value, list_symbols
from evlcp_sdk.results.packets_jsonl import message_line
from evlcp_sdk.results.sink import Run
from evlcp_sdk.values import Fix, Frame, Packet, sigmas


class JsonLines:
    """Writes a line for each frame, message and fix as it comes, without its end; its key `line` is the kind.

    Where there are several links, a fix has the names of those that it is computed from.
    """

    def __init__(self, write: Callable[[str], None], run: Run) -> None:
        self._write = write
        self._navigator = run.navigator if run.links else None
        self._columns = frame_columns(filtered=run.filtered, links=bool(run.links))

    def packet(self, packet: Packet) -> None:
        """Write the lines of a packet: its frames, and then the messages that it completes.

        Raises:
            PluginError: A kind of messages fails.
        """
        for frame in packet.frames:
            self._write(format_frame(frame, self._columns))
        for message in packet.messages:
            self._write(json.dumps({"line": "message"} | json.loads(message_line(message))))

    def fix(self, fix: Fix) -> None:
        """Write the line of a fix, given or refused."""
        navigator = self._navigator
        links = {} if navigator is None else {"link": navigator.positioner.links_of(fix)}
        self._write(json.dumps(fix_line(fix) | links))


def format_frame(frame: Frame, columns: Sequence[str] = FRAME_COLUMNS) -> str:
    """The line of a frame as JSON, rounded as in `frames.csv`; other columns follow `FRAME_COLUMNS`."""
    soft, distance = frame.soft, frame.range
    # Written out for hundreds of frames a second: rounding and `json` take twice as long.
    numbers = (
        f'{{"line": "frame", "transmitter": {frame.transmitter}, "packet": {frame.packet},'
        f' "frame": {frame.frame}, "t_us": {frame.t_us:.2f}, "symbols": {list_symbols(soft)},'
        f' "quality": {soft.quality:.4f}, "distance_m": {distance.distance_m:.4f},'
        f' "distance_sigma_m": {distance.sigma_m:.4f}, "x_px": {frame.x_px:.3f}, "y_px": {frame.y_px:.3f},'
        f' "echo_of": {frame.echo_of}'
    )
    text = (
        numbers.replace("None", "null").replace("nan", "null").replace("-inf", "null").replace("inf", "null")
    )
    for name in columns[len(FRAME_COLUMNS) :]:
        value = frame_value(frame, name)
        text += f', "{name}": {json.dumps(round_or_none(value, 4) if isinstance(value, float) else value)}'
    return text + "}"


def fix_line(fix: Fix) -> dict[str, Any]:
    """The line of a fix, as JSON values."""
    return {
        "line": "fix",
        "t_us": round(fix.t_us, 1),
        "latitude_deg": round_or_none(fix.latitude_deg, 10),
        "longitude_deg": round_or_none(fix.longitude_deg, 10),
        "height_m": round_or_none(fix.height_m, 4),
        "sigma_m": [round_or_none(value, 4) for value in sigmas(fix.covariance_m2)],
        "heading_deg": round_or_none(fix.heading_deg, 4),
        "bars": list(fix.transmitters),
        "verified": fix.verified,
        "refusal": fix.refusal,
        "detail": fix.detail,
        **integrity_fields(fix),
    }


def integrity_fields(fix: Fix) -> dict[str, Any]:
    """The integrity of a fix as JSON values: misfit, protection levels, what was left out, alarms."""
    return {
        "source": fix.source,
        "misfit": round_or_none(fix.misfit, 4),
        "freedom": fix.freedom,
        "hpl_m": round_or_none(fix.hpl_m, 3),
        "vpl_m": round_or_none(fix.vpl_m, 3),
        "excluded": list(fix.excluded),
        "contradicted": list(fix.contradicted),
        "alarms": list(fix.alarms),
    }
