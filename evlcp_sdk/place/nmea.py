"""NMEA-0183: fixes of a receiver of satellites, GGA with GST, and the checksum of a sentence."""

import math
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from functools import partial, reduce
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import csv_number, read_whole
from evlcp_sdk.place.poses import PLACE

Floats = NDArray[np.float64]

_HALF_DAY_S = 43_200
_UP = 2.0
"""How much less precise heights of satellites are than places, where only the latter's sigma is said."""


class NmeaFix(NamedTuple):
    """A GGA with its GST: the line of the first, UTC, latitude, longitude and height, sigmas.

    The height is above the ellipsoid; `covariance_m2` is of east, north and up, float64 (3, 3).
    """

    line: int
    utc: datetime
    place: tuple[float, float, float]
    covariance_m2: Floats


def checksum(body: str) -> str:
    """Exclusive or of a sentence's characters between `$` and `*`, two hex digits.

    >>> checksum("GPGLL,4916.45,N,12311.12,W,225444,A,")
    '1D'
    """
    return f"{reduce(lambda a, b: a ^ b, body.encode('ascii'), 0):02X}"


def read_nmea(path: Path | str, near: datetime, usual_sigma_m: float) -> list[NmeaFix]:
    """The fixes of a file, of any talker; a GGA that says that it has no fix gives none.

    Args:
        path: The file.
        near: The day of the first fix is that within half a day of this; later ones follow it.
        usual_sigma_m: Of east and north where a GGA has no GST of its time, of up twice that; 0: none.

    Raises:
        InputError: The file cannot be read.
        ConfigError: A checksum is wrong, a value is not a number or is out of range, a height is above an
            unknown geoid, or nothing says how precise a fix is.
    """
    fixes: list[tuple[int, float, tuple[float, float, float]]] = []
    sigmas: dict[float, Floats] = {}
    # One day for both kinds: the last time that is known.
    last = near.timestamp()
    for line, kind, fields in _sentences(path):
        if kind not in ("GGA", "GST") or (kind == "GGA" and fields[6] in ("", "0")):
            continue
        if kind == "GST" and not all(fields[6:9]):
            continue
        value = partial(_value, path, line, fields)
        if kind == "GGA":
            _check_letters(path, line, fields)
            value(6, "quality", (0, 9))
        hours, minutes, seconds = (
            value(1, f"{kind}'s time", (0, most), piece)
            for most, piece in ((23, slice(0, 2)), (59, slice(2, 4)), (61, slice(4, None)))
        )
        day = datetime.fromtimestamp(last, UTC).replace(hour=0, minute=0, second=0, microsecond=0).timestamp()
        at = day + 3600 * hours + 60 * minutes + seconds
        at += 2 * _HALF_DAY_S * ((at < last - _HALF_DAY_S) - (at > last + _HALF_DAY_S))
        last = at
        if kind == "GST":
            east, north, up = (value(i, "GST's sigma", (1e-4, 1e4)) for i in (7, 6, 8))
            both = 0.0
            if all(fields[3:6]):
                major, minor, turned = (value(i, "GST's ellipse", (0, 1e4)) for i in (3, 4, 5))
                both = (major**2 - minor**2) * math.sin(2 * math.radians(turned)) / 2
            # Digits are few: what is left of a correlation of 1 is none.
            both = min(max(both, -0.999 * east * north), 0.999 * east * north)
            sigmas[round(at, 3)] = np.array([[east**2, both, 0], [both, north**2, 0], [0, 0, up**2]])
            continue
        if not fields[11]:
            raise ConfigError(
                f"{path}: line {line}: GGA without the height of the geoid (field 11): expected one, as"
                " heights here are above the ellipsoid"
            )
        height = value(9, "height_m", PLACE["height_m"]) + value(11, "height of the geoid", (-200, 200))
        latitude = _angle(value, fields, 2, "latitude_deg", "NS")
        fixes.append((line, at, (latitude, _angle(value, fields, 4, "longitude_deg", "EW"), height)))
    found = []
    for line, at, place in fixes:
        spread = sigmas.get(round(at, 3))
        if spread is None:
            if not usual_sigma_m:
                raise ConfigError(
                    f"{path}: line {line}: GGA without a GST of its time: expected one, or --set"
                    " position.gnss_sigma_m=METRES"
                )
            spread = usual_sigma_m**2 * np.diag([1.0, 1.0, _UP**2])
        utc = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(milliseconds=round(at * 1e3))
        found.append(NmeaFix(line, utc, place, spread))
    return found


def _sentences(path: Path | str) -> Iterator[tuple[int, str, list[str]]]:
    """Line, kind and fields of each sentence, of which there are 15 or more: empty ones are added."""
    lines = read_whole(path).decode("ascii", "replace").splitlines()
    for line, text in enumerate(lines, 1):
        if not text.strip():
            continue
        body, _, given = text.strip().removeprefix("$").partition("*")
        if not text.startswith("$") or "\ufffd" in text or given.upper() != (due := checksum(body)):
            expected = "" if "\ufffd" in text or not text.startswith("$") else f" with {due}"
            raise ConfigError(f"{path}: line {line}: expected a sentence, $...*, and its checksum{expected}")
        fields = body.split(",")
        yield line, fields[0][2:], fields + [""] * 15


_LETTERS = {3: ("N", "S"), 5: ("E", "W"), 10: ("M", ""), 12: ("M", "")}
"""Fields of GGA that are a letter: hemispheres, and metres."""


def _check_letters(path: Path | str, line: int, fields: list[str]) -> None:
    for field, letters in _LETTERS.items():
        if fields[field] not in letters:
            expected = " or ".join(filter(None, letters))
            raise ConfigError(
                f"{path}: line {line}: GGA's field {field} = {fields[field]!r:.40}: expected {expected}"
            )


def _value(
    path: Path | str,
    line: int,
    fields: list[str],
    field: int,
    name: str,
    within: tuple[float, float],
    piece: slice = slice(None),
) -> float:
    return csv_number(path, line, name, fields[field][piece], within)


def _angle(value: "partial[float]", fields: list[str], field: int, name: str, signs: str) -> float:
    """Degrees of ddmm.mmm and its sign, which is the next field."""
    point = fields[field].partition(".")[0]
    digits = slice(0, len(point) - 2), slice(len(point) - 2, None)
    degrees = value(field, name, (0, PLACE[name][1]), digits[0]) + value(field, name, (0, 60), digits[1]) / 60
    return -degrees if fields[field + 1] == signs[1] else degrees
