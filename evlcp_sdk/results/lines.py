"""What is found, as a stream of lines of JSON: frames, messages, fixes."""

import json
from collections.abc import Callable, Sequence
from typing import Any

from evlcp_sdk.formatting import integrity, number_or_none, sigmas, symbol_list
from evlcp_sdk.results.columns import FRAME_COLUMNS, frame_columns, frame_value
from evlcp_sdk.results.packets_jsonl import message_line
from evlcp_sdk.values import Fix, Frame, Packet

__all__ = ["FrameValues", "JsonLines", "fix_line", "format_frame", "format_values", "frame_values"]

FrameValues = tuple[Any, ...]
"""What a frame's line says, as values that take little to hand to another process: see `frame_values`."""


class JsonLines:
    """Gives a line for each frame, message and fix as it comes; `line` in it says which it is.

    Args:
        give: Takes a line, without its end.
        filtered: Whether distances are filtered, too.
        links: There are several links.
        links_of: Gives the names of those that a fix is computed from, where there are several.
    """

    def __init__(
        self,
        give: Callable[[str], None],
        *,
        filtered: bool = False,
        links: bool = False,
        links_of: Callable[[Fix], str] | None = None,
    ) -> None:
        self._give = give
        self._links_of = links_of
        self._columns = frame_columns(filtered=filtered, links=links)

    def packet(self, packet: Packet) -> None:
        """Give the lines of a packet: its frames, and then the messages that it completes.

        Raises:
            PluginError: A kind of messages fails.
        """
        for frame in packet.frames:
            self._give(format_frame(frame, self._columns))
        for message in packet.messages:
            self._give(json.dumps({"line": "message"} | json.loads(message_line(message))))

    def fix(self, fix: Fix) -> None:
        """Give the line of a fix, given or refused."""
        links = {"link": self._links_of(fix)} if self._links_of is not None else {}
        self._give(json.dumps(fix_line(fix) | links))


def format_frame(frame: Frame, columns: Sequence[str] = FRAME_COLUMNS) -> str:
    """The line of a frame as JSON, rounded as in `frames.csv`.

    Args:
        frame: The frame.
        columns: `FRAME_COLUMNS`, and others behind them.
    """
    return format_values(frame_values(frame, columns))


def frame_values(frame: Frame, columns: Sequence[str] = FRAME_COLUMNS) -> FrameValues:
    """The values of a frame's line: of `FRAME_COLUMNS`, then names and values of the columns behind them."""
    soft, found = frame.soft, frame.range
    more = columns[len(FRAME_COLUMNS) :]
    return (
        frame.transmitter,
        frame.packet,
        frame.frame,
        frame.t_us,
        symbol_list(soft.symbols),
        soft.quality,
        found.distance_m,
        found.sigma_m,
        frame.x_px,
        frame.y_px,
        frame.echo_of,
        [(name, frame_value(frame, name)) for name in more] if more else (),
    )


def format_values(values: FrameValues) -> str:
    """The line of a frame as JSON, of what `frame_values` gives."""
    # Written out, as there are hundreds a second: rounding and `json` take twice as long.
    transmitter, packet, frame, t_us, symbols, quality, distance_m, sigma_m, x_px, y_px, echo_of, more = (
        values
    )
    numbers = (
        f'{{"line": "frame", "transmitter": {transmitter}, "packet": {packet}, "frame": {frame},'
        f' "t_us": {t_us:.2f}, "symbols": {symbols}, "quality": {quality:.4f},'
        f' "distance_m": {distance_m:.4f}, "distance_sigma_m": {sigma_m:.4f},'
        f' "x_px": {x_px:.3f}, "y_px": {y_px:.3f}, "echo_of": {echo_of}'
    )
    text = (
        numbers.replace("None", "null").replace("nan", "null").replace("-inf", "null").replace("inf", "null")
    )
    for name, value in more:
        text += f', "{name}": {json.dumps(number_or_none(value, 4) if isinstance(value, float) else value)}'
    return text + "}"


def fix_line(fix: Fix) -> dict[str, Any]:
    """What the line of a fix says, as JSON values."""
    return {
        "line": "fix",
        "t_us": round(fix.t_us, 1),
        "latitude_deg": number_or_none(fix.latitude_deg, 10),
        "longitude_deg": number_or_none(fix.longitude_deg, 10),
        "height_m": number_or_none(fix.height_m, 4),
        "sigma_m": [number_or_none(value, 4) for value in sigmas(fix.covariance_m2)],
        "heading_deg": number_or_none(fix.heading_deg, 4),
        "bars": list(fix.transmitters),
        "verified": fix.verified,
        "refusal": fix.refusal,
        "detail": fix.detail,
        **integrity(fix),
    }
