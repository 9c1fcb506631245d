"""The message `speed-limit`: a speed in km/h, and for how many metres it holds."""

import struct
from collections.abc import Iterator, Mapping
from typing import Any

import evlcp_sdk as evlcp

__all__ = ["SpeedLimit", "evlcp_message_kinds"]

_FORM = struct.Struct("<BH")


class SpeedLimit(evlcp.MessageKind):
    """A speed limit: (km/h, metres)."""

    number = 7
    name = "speed-limit"

    def pack(self, value: tuple[int, int]) -> bytes:
        """Three bytes."""
        speed_km_h, length_m = value
        if not (0 < speed_km_h < 256 and 0 < length_m < 65536):
            raise evlcp.ConfigError(f"speed-limit: {value}, expected 1 to 255 km/h and 1 to 65535 m")
        return _FORM.pack(speed_km_h, length_m)

    def unpack(self, payload: bytes) -> tuple[int, int]:
        """The two numbers."""
        if len(payload) != _FORM.size:
            raise evlcp.BlockError(f"speed-limit of {len(payload)} bytes, expected {_FORM.size}")
        speed_km_h, length_m = _FORM.unpack(payload)
        return speed_km_h, length_m

    def to_dict(self, value: tuple[int, int]) -> Mapping[str, Any]:
        """The two numbers, by name."""
        return {"speed_km_h": value[0], "length_m": value[1]}


@evlcp.hookimpl
def evlcp_message_kinds() -> Iterator[evlcp.MessageKind]:
    """The kind of this module."""
    yield SpeedLimit()
