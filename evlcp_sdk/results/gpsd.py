"""Positions as gpsd's JSON (protocol 3): TPV and SKY reports, and answers to clients."""

import json
import math
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from evlcp_sdk.place.gnss import geoid_m
from evlcp_sdk.place.navigator import Place
from evlcp_sdk.values import Fix, sigmas

DEVICE: Final = "evlcp"
"""Name of the only device."""

VERSION: Final = {"class": "VERSION", "release": "3.22", "rev": "evlcp", "proto_major": 3, "proto_minor": 14}
"""The first message to a client: the release whose protocol this is."""


def tpv(fix: Fix, filtered: Place | None, zero: datetime | None) -> dict[str, Any]:
    """A fix as a TPV report: mode 3, or 1 for a refused one, which has no filtered place.

    Sigmas are standard deviations, and place, speed and course the filter's, as in `fixes.nmea`. It has a
    time if UTC of the camera clock's 0 is known.
    """
    report: dict[str, Any] = {"class": "TPV", "device": DEVICE, "mode": 1 if filtered is None else 3}
    if zero is not None:
        report["time"] = format_time(zero, fix.t_us)
    if filtered is None:
        return report
    east, north, up = sigmas(filtered.covariance_m2)
    sea = geoid_m(filtered.latitude_deg, filtered.longitude_deg)
    report |= {
        "lat": round(filtered.latitude_deg, 10),
        "lon": round(filtered.longitude_deg, 10),
        "altHAE": round(filtered.height_m, 4),
        "altMSL": round(filtered.height_m - sea, 4),
        "alt": round(filtered.height_m - sea, 4),
        "geoidSep": sea,
        "epx": round(east, 4),
        "epy": round(north, 4),
        "epv": round(up, 4),
        "eph": round(math.hypot(east, north), 4),
    }
    if not filtered.starts:
        report |= {"track": round(filtered.course_deg, 4), "speed": round(filtered.speed_m_s, 4)}
    return report


def sky(fix: Fix, zero: datetime | None) -> dict[str, Any]:
    """The bars of a fix as a SKY report, in the place of satellites."""
    used = not fix.refusal
    bars = [{"PRN": number, "used": used} for number in fix.transmitters]
    report: dict[str, Any] = {"class": "SKY", "device": DEVICE, "nSat": len(bars), "uSat": len(bars) * used}
    if zero is not None:
        report["time"] = format_time(zero, fix.t_us)
    return report | {"satellites": bars}


def answer_request(
    request: str, watch: dict[str, Any], newest: dict[str, dict[str, Any]]
) -> list[dict[str, Any]]:
    """The answer of gpsd to a line of a client, with or without its semicolon.

    `?WATCH` changes `watch`, the client's subscription; `?POLL` gives the newest reports, by class.
    """
    verb, _, text = request.strip().rstrip(";").partition("=")
    device = {"class": "DEVICE", "path": DEVICE, "driver": "evlcp", "activated": True, "flags": 1}
    if verb == "?VERSION":
        return [VERSION]
    if verb == "?DEVICES":
        return [{"class": "DEVICES", "devices": [device]}]
    if verb == "?DEVICE":
        return [device]
    if verb == "?POLL":
        reports = {name: [newest[name.upper()]] if name.upper() in newest else [] for name in ("tpv", "sky")}
        return [{"class": "POLL", "active": len(reports["tpv"]), **reports}]
    if verb != "?WATCH":
        return [{"class": "ERROR", "message": f"Unrecognized request '{request.strip()[:60]}'"}]
    try:
        options = json.loads(text) if text else {}
    except ValueError:
        options = None
    if not isinstance(options, dict):
        return [{"class": "ERROR", "message": "Invalid WATCH: expected an object"}]
    if text:
        watch["enable"] = bool(options.get("enable", True))
        watch |= {name: bool(options[name]) for name in ("json", "nmea") if name in options}
        watch["nmea"] |= bool(options.get("raw"))
    return [{"class": "DEVICES", "devices": [device]}, {"class": "WATCH", **watch}]


def format_time(zero: datetime, t_us: float) -> str:
    """A time of the camera's clock as UTC in ISO 8601, to the nearest millisecond."""
    at = zero.astimezone(UTC) + timedelta(milliseconds=math.floor(t_us / 1000 + 0.5))
    return f"{at:%Y-%m-%dT%H:%M:%S}.{at.microsecond // 1000:03d}Z"
