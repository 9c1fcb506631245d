"""Beacons: a transmitter's position, attitude and length."""

import struct
from dataclasses import dataclass

from evlcp_sdk.air.blocks import BlockError
from evlcp_sdk.errors import ConfigError

_FIXED = struct.Struct("<qqiHHI")

BEACON_BYTES = _FIXED.size
"""Bytes of a beacon before the user's."""

_NANO = 1_000_000_000
_MILLI = 1000
_CENTI = 100
_TURN = 360 * _CENTI


@dataclass(frozen=True)
class Beacon:
    """A transmitter's position, attitude and length: the payload of a beacon.

    Attributes:
        latitude_deg: WGS-84 latitude of the bar's centre, to 1e-9 degrees (0.1 mm).
        longitude_deg: Its longitude, likewise.
        height_m: Its height above the ellipsoid, to a millimetre.
        heading_deg: Direction to which its top tilts, clockwise from north, to a hundredth of a degree.
        tilt_deg: Of its axis from the vertical, to a hundredth of a degree; 90: lying, 180: upside down.
        length_m: From its first to its last LED's outer edge, to a millimetre.
        user: The user's own bytes.

    Raises:
        ConfigError: A value is out of range.

    >>> beacon = Beacon(35.156, 136.965, 52.4, 0.0, 0.0, 0.96, b"lane 2")
    >>> Beacon.unpack(beacon.pack()) == beacon
    True
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    heading_deg: float
    tilt_deg: float
    length_m: float
    user: bytes = b""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("latitude_deg", -90.0, 90.0),
            ("longitude_deg", -180.0, 180.0),
            ("height_m", -12_000.0, 20_000.0),
            ("heading_deg", 0.0, 360.0),
            ("tilt_deg", 0.0, 180.0),
            ("length_m", 0.001, 100.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"beacon: {name} = {value}, expected {low:g} to {high:g}")

    @property
    def place(self) -> tuple[float, float, float]:
        """Latitude and longitude, degrees, and height, m."""
        return self.latitude_deg, self.longitude_deg, self.height_m

    def pack(self) -> bytes:
        """The payload of a beacon message."""
        return (
            _FIXED.pack(
                round(self.latitude_deg * _NANO),
                round(self.longitude_deg * _NANO),
                round(self.height_m * _MILLI),
                round(self.heading_deg * _CENTI) % _TURN,
                round(self.tilt_deg * _CENTI),
                round(self.length_m * _MILLI),
            )
            + self.user
        )

    @classmethod
    def unpack(cls, payload: bytes) -> "Beacon":
        """A beacon from its payload.

        Raises:
            BlockError: Too few bytes, or a value out of range.
        """
        if len(payload) < BEACON_BYTES:
            raise BlockError(f"beacon of {len(payload)} bytes, expected at least {BEACON_BYTES}")
        latitude, longitude, height, heading, tilt, length = _FIXED.unpack_from(payload)
        try:
            return cls(
                latitude / _NANO,
                longitude / _NANO,
                height / _MILLI,
                heading / _CENTI,
                tilt / _CENTI,
                length / _MILLI,
                payload[BEACON_BYTES:],
            )
        except ConfigError as fault:
            raise BlockError(str(fault)) from fault
