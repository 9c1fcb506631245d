"""Where a camera was when: the poses that a calibration goes by, from a file."""

from dataclasses import dataclass
from pathlib import Path

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import check_columns, csv_number, read_csv
from evlcp_sdk.scene.attitude import Attitude

PLACE = {
    "latitude_deg": (-90.0, 90.0),
    "longitude_deg": (-180.0, 180.0),
    "height_m": (-12_000.0, 20_000.0),
}
"""Columns of a place on earth, and what they may be, least and most."""

_ANGLES = ("heading_deg", "pitch_deg", "roll_deg")
"""Columns that come together."""

_OPTIONAL = ("recording", "position_sigma_m", "attitude_sigma_deg", *_ANGLES)

_RANGES = PLACE | {
    "position_sigma_m": (1e-6, 1e6),
    "attitude_sigma_deg": (1e-6, 1e6),
    "heading_deg": (-360.0, 360.0),
    "pitch_deg": (-90.0, 90.0),
    "roll_deg": (-360.0, 360.0),
    "t_us": (-1e18, 1e18),
}
"""What a pose's values may be; exact ones would outweigh all in double precision."""


@dataclass(frozen=True)
class KnownPose:
    """Where a camera was, and how it was turned if that is known: a row of `poses.csv`.

    Attributes:
        recording: Name of the recording's file; empty where there is only one.
        t_us: When, camera clock, us.
        latitude_deg: WGS-84.
        longitude_deg: The same.
        height_m: Above the ellipsoid, m.
        position_sigma_m: Standard deviation of each of these, m.
        attitude: With heading; None where it is not known.
        attitude_sigma_deg: Standard deviation of a turn about each axis, degrees.
    """

    recording: str
    t_us: float
    latitude_deg: float
    longitude_deg: float
    height_m: float
    position_sigma_m: float
    attitude: Attitude | None
    attitude_sigma_deg: float


def read_poses(path: Path | str) -> list[KnownPose]:
    """Read a CSV of known poses.

    Columns t_us, latitude_deg, longitude_deg, height_m; optional recording, position_sigma_m (0.01),
    heading_deg, pitch_deg and roll_deg together, and attitude_sigma_deg (0.1).

    Raises:
        InputError: The file cannot be read.
        ConfigError: A column is missing, or a value is not a number or is out of range.
    """
    names, rows = read_csv(path)
    check_columns(path, names, ("t_us", *PLACE), _OPTIONAL)
    if not rows:
        raise ConfigError(f"{path}: expected one line of values or more")
    poses = []
    for line, row in rows:
        given = [n for n in _RANGES if n in ("t_us", *PLACE) or row.get(n)]
        angles = [name for name in _ANGLES if name in given]
        if angles:
            if absent := [name for name in _ANGLES if name not in names]:
                raise ConfigError(
                    f"{path}: line 1: no column {absent[0]}: angles come together, {', '.join(_ANGLES)}"
                )
            given = [*dict.fromkeys([*given, *_ANGLES])]
        value = {name: csv_number(path, line, name, row[name], _RANGES[name]) for name in given}
        poses.append(
            KnownPose(
                row.get("recording") or "",
                value["t_us"],
                value["latitude_deg"],
                value["longitude_deg"],
                value["height_m"],
                value.get("position_sigma_m", 0.01),
                Attitude(value["pitch_deg"], value["roll_deg"], value["heading_deg"]) if angles else None,
                value.get("attitude_sigma_deg", 0.1),
            )
        )
    return poses
