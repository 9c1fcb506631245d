"""What is found, as a stream of lines of JSON: frames, messages, fixes."""

import json
from collections.abc import Callable
from typing import Any

from evlcp_sdk.results.columns import FILTERED_COLUMNS, FRAME_COLUMNS, frame_value
from evlcp_sdk.results.packets_jsonl import message_line
from evlcp_sdk.results.text import integrity, number_or_none, sigmas
from evlcp_sdk.values import Fix, Frame, Packet

__all__ = ["JsonLines"]

_DIGITS = {"t_us": 2, "x_px": 3, "y_px": 3}
"""Digits behind the point; of all else four."""


class JsonLines:
    """Gives a line for each frame, message and fix as it comes; `line` in it says which it is.

    Args:
        give: Takes a line, without its end.
        filtered: Whether distances are filtered, too.
    """

    def __init__(self, give: Callable[[str], None], *, filtered: bool = False) -> None:
        self._give = give
        self._columns = FRAME_COLUMNS + (FILTERED_COLUMNS if filtered else ())

    def packet(self, packet: Packet) -> None:
        """Give the lines of a packet: its frames, and then the messages that it completes.

        Raises:
            PluginError: A kind of messages fails.
        """
        for frame in packet.frames:
            self._line("frame", {name: _value(frame, name) for name in self._columns})
        for message in packet.messages:
            self._line("message", json.loads(message_line(message)))

    def fix(self, fix: Fix) -> None:
        """Give the line of a fix, given or refused."""
        self._line(
            "fix",
            {
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
            },
        )

    def _line(self, line: str, values: dict[str, Any]) -> None:
        self._give(json.dumps({"line": line} | values))


def _value(frame: Frame, column: str) -> Any:
    value = frame_value(frame, column)
    return number_or_none(value, _DIGITS.get(column, 4)) if isinstance(value, float) else value
