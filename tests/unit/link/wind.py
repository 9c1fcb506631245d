"""A kind of message in one file with one hook: the wind, in m/s and degrees."""

import struct
from collections.abc import Iterator, Mapping
from typing import Any

from evlcp_sdk.air.kinds import MessageKind
from evlcp_sdk.plugin.hooks import hookimpl


class Wind(MessageKind):
    number = 15
    name = "wind"

    def pack(self, value: tuple[float, float]) -> bytes:
        return struct.pack("<ff", *value)

    def unpack(self, payload: bytes) -> tuple[float, float]:
        # Raises what is no error of the SDK where the payload is another.
        speed_m_s, from_deg = struct.unpack("<ff", payload)
        return speed_m_s, from_deg

    def to_dict(self, value: tuple[float, float]) -> Mapping[str, Any]:
        return {"speed_m_s": value[0], "from_deg": value[1]}


@hookimpl
def evlcp_message_kinds() -> Iterator[MessageKind]:
    yield Wind()
