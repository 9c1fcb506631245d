"""Fixes of a receiver of satellites: from a file, and as the track takes them."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import ANY_NUMBER, check_rising, read_table
from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.nmea import read_nmea
from evlcp_sdk.place.poses import PLACE
from evlcp_sdk.place.trajectory import GNSS
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.sites import LocalAxes
from evlcp_sdk.values import Fix

Floats = NDArray[np.float64]

_SIGMAS = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
_SIGMA_M = (1e-4, 1e4)
"""What a sigma may be: with one of 0 nothing else would count, and of 10 km it says nothing."""
_CROSSED = {"cov_east_north_m2": (0, 1), "cov_east_up_m2": (0, 2), "cov_north_up_m2": (1, 2)}

_GRAVITY_RAD = math.radians(10.0)
"""Sigma of pitch and roll where nothing measures them, for where the antenna is."""


@dataclass(frozen=True, eq=False)
class GnssLog:
    """Fixes of a GNSS receiver, in order of time.

    Attributes:
        t_us: Camera clock, us, float64 (n,), rising.
        place: Of the antenna: latitude and longitude, degrees, height above the ellipsoid, m, float64
            (n, 3).
        covariance_m2: Of its place, east, north and up, float64 (n, 3, 3).
    """

    t_us: Floats
    place: Floats
    covariance_m2: Floats

    @classmethod
    def read(
        cls, path: Path | str, clock_zero: datetime | None = None, usual_sigma_m: float = 0.0
    ) -> "GnssLog":
        """Read a CSV whose columns are named as those of `fixes.csv`, or NMEA with GGA and GST.

        NMEA is what is named `.nmea`, or starts with a dollar sign.

        t_us, latitude_deg, longitude_deg, height_m, sigma_east_m, sigma_north_m, sigma_up_m; optional
        cov_east_north_m2, cov_east_up_m2, cov_north_up_m2.

        Args:
            path: The file.
            clock_zero: UTC of the camera clock's 0, which NMEA needs.
            usual_sigma_m: Of east and north where NMEA has no GST, of up twice that; 0: none.

        Raises:
            InputError: The file cannot be read.
            ConfigError: A column is missing, a value is not a number or is out of range, times do not rise,
                a covariance is none, or NMEA lacks what it needs.
        """
        if Path(path).suffix.lower() == ".nmea" or _starts_with_dollar(Path(path)):
            return cls._of_nmea(path, clock_zero, usual_sigma_m)
        if Path(path).suffix.lower() == ".pos":
            raise ConfigError(f"{path}: a solution of RTKLIB: expected its NMEA (rnx2rtkp -n), or a CSV file")
        needed = {"t_us": ANY_NUMBER, **PLACE, **dict.fromkeys(_SIGMAS, _SIGMA_M)}
        lines, table = read_table(path, needed, dict.fromkeys(_CROSSED, ANY_NUMBER), rising="t_us")
        spread = np.eye(3) * np.stack([table[name] for name in _SIGMAS], 1)[:, None] ** 2
        for name, (a, b) in _CROSSED.items():
            if name in table:
                spread[:, a, b] = spread[:, b, a] = table[name]
        for line, one in zip(lines, spread, strict=True):
            _check_covariance(f"{path}: line {line}", one)
        return cls(table["t_us"], np.stack([table[name] for name in PLACE], 1), spread)

    @classmethod
    def _of_nmea(cls, path: Path | str, zero: datetime | None, usual_sigma_m: float) -> "GnssLog":
        if zero is None:
            raise ConfigError(
                f"{path}: NMEA tells UTC: expected --clock-zero, the UTC of the camera clock's 0, as `evlcp"
                " receive` takes it, or a CSV file"
            )
        found = read_nmea(path, zero, usual_sigma_m)
        if not found:
            raise ConfigError(f"{path}: expected a GGA with a fix or more")
        t_us = np.array([(fix.utc - zero).total_seconds() * 1e6 for fix in found])
        check_rising(path, [fix.line for fix in found], "t_us", t_us)
        return cls(
            t_us, np.array([fix.place for fix in found]), np.array([fix.covariance_m2 for fix in found])
        )


def _starts_with_dollar(path: Path) -> bool:
    """Whether a file does; a pipe, of which a byte would be lost, counts by its name."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return file.read(1) == b"$"
    except OSError:
        return False


def _check_covariance(where: str, spread: Floats) -> None:
    """Whether sigmas and covariances go together."""
    sigma = np.sqrt(np.diag(spread))
    for name, (a, b) in _CROSSED.items():
        most = float(sigma[a] * sigma[b])
        if not abs(spread[a, b]) < most:
            both = f"{_SIGMAS[a]} times {_SIGMAS[b]}"
            raise ConfigError(f"{where}: {name} = {spread[a, b]:g}: expected less than {most:g}, {both}")
    # Of the correlations, so that units do not count: below it the inverse has no digit that is right.
    if not np.linalg.eigvalsh(spread / sigma / sigma[:, None])[0] > 3 * np.finfo(float).eps:
        said = ", ".join(f"{name} = {spread[at]:g}" for name, at in _CROSSED.items())
        raise ConfigError(f"{where}: {said}: expected a covariance, which these are not together")


def gnss_fix(
    log: GnssLog,
    row: int,
    axes: LocalAxes,
    attitude: Attitude | None,
    spec: ErrorModel,
) -> Fix | None:
    """A fix of satellites as one of the camera; None where no heading tells where the antenna is from it.

    Args:
        log: The fixes.
        row: Which one.
        axes: The local axes.
        attitude: The camera's, with heading; None where that is not known.
        spec: Where the antenna is, and how the error lasts.
    """
    here = LocalAxes(*log.place[row].tolist())
    arm, spread = np.zeros(3), log.covariance_m2[row]
    if any(spec.antenna_m):
        if attitude is None or attitude.heading_deg is None:
            return None
        arm = attitude.rotation() @ spec.antenna_m
        # About east, north and up: gravity by the camera's turn about level axes, heading by that about up.
        level, upright = math.radians(attitude.gravity_sigma_deg), math.radians(attitude.heading_sigma_deg)
        turned = np.cross(np.diag([level, level, upright]), arm)
        spread = spread + turned.T @ turned
    latitude, longitude, height = (float(v) for v in here.to_geodetic(-arm))
    turn = axes.turn_from(here)
    spread = turn @ spread @ turn.T
    values, own = np.linalg.eigh((1 - spec.gnss_white_share) * spread)
    unknown = math.nan
    return Fix(
        t_us=float(log.t_us[row]),
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        enu_m=axes.to_enu(latitude, longitude, height),
        covariance_m2=spread,
        noise_m2=spec.gnss_white_share * spread,
        heading_deg=unknown,
        pitch_deg=unknown,
        roll_deg=unknown,
        heading_sigma_deg=unknown,
        transmitters=(),
        verified=False,
        standing={GNSS: (own * np.sqrt(np.maximum(values, 0))) @ own.T},
        source=GNSS,
    )


def attitude_of(known: Attitude | None, heading: Callable[[], tuple[float, float] | None]) -> Attitude | None:
    """An attitude with a heading: its own, or the track's; level where nothing measures gravity."""
    if known is not None and known.heading_deg is not None:
        return known
    found = heading()
    if found is None:
        return known
    level = Attitude(gravity_sigma_deg=math.degrees(_GRAVITY_RAD)) if known is None else known
    return Attitude(level.pitch_deg, level.roll_deg, found[0] % 360, level.gravity_sigma_deg, found[1])
