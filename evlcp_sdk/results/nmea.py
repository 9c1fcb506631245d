"""`fixes.nmea`: NMEA-0183 sentences of a fix, GGA, RMC, GST and GBS, and TXT for alarms.

Talker `IN`, integrated navigation; quality 6 and mode E, estimated, as there are no satellites. The altitude
is above sea level, the EGM96 geoid, whose height above the WGS-84 ellipsoid is beside it: their sum is the
fix's height, whatever the geoid. The number of satellites is that of bars. The dilution of precision is
empty: it would be a factor without a unit, which bars do not have. GST has the precision: first the root of
the misfit, in sigmas, as bars give no ranges, then the ellipse and sigmas in metres. GBS, of bars only, is
what RAIM gives for satellites: the largest shift of the fix by one wrong bar, angle or focal length whose
test just passed, and the bar that was left out.
"""

import math
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.gnss import checksum, geoid_m
from evlcp_sdk.place.navigator import Place
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.utc import clock_zero_at
from evlcp_sdk.values import FailedBar, Fix, sigmas

_KNOTS_PER_M_S = 3600 / 1852

Clock = tuple[str, str]
"""Time of day to a millisecond, and the date; the latter is empty where UTC is not known."""


class Nmea(Sink):
    """Writes `fixes.nmea`: place, speed and course are the filter's."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._file = folder.open("fixes.nmea")

    def fix(self, fix: Fix, filtered: Place | None) -> None:
        """Write its sentences; those of a refused fix have no place."""
        self._file.write(format_sentences(fix, filtered, clock_zero_at(self.run.clock_zero, fix.t_us)))


def format_sentences(fix: Fix, filtered: Place | None, zero: datetime | None) -> str:
    """The NMEA sentences of a fix: a TXT for each alarm, GGA, RMC and, where there is a place, GST and GBS.

    A refused fix has no filtered place. Without UTC of the camera clock's 0 the clock itself is the time of
    day.
    """
    clock = format_clock(fix.t_us, zero)
    alarms = [txt(len(fix.alarms), n, _alarm_text(fix, alarm)) for n, alarm in enumerate(fix.alarms, 1)]
    if filtered is None:
        return "".join([*alarms, gga(clock, None, 0), rmc(clock, None, None)])
    place = (filtered.latitude_deg, filtered.longitude_deg, filtered.height_m)
    velocity = None if filtered.starts else (filtered.speed_m_s, filtered.course_deg)
    return "".join(
        [
            *alarms,
            gga(clock, place, len(fix.transmitters)),
            rmc(clock, place, velocity),
            gst(clock, math.sqrt(fix.misfit), filtered.covariance_m2),
            gbs(clock, fix.undetected_m, fix.failed) if fix.source == "bars" else "",
        ]
    )


def _alarm_text(fix: Fix, alarm: str) -> str:
    if alarm == "excluded":
        return f"EXCLUDED {' '.join(fix.excluded)}"
    if alarm == "contradicted":
        return f"{fix.source.upper()} CONTRADICTED BY {' '.join(fix.contradicted).upper()}"
    return "NO PROTECTION LEVEL" if alarm == "unavailable" else alarm.upper()


def gga(clock: Clock, place: tuple[float, float, float] | None, bars: int) -> str:
    """A GGA sentence, with its line end, by the number of bars that the fix is computed from.

    The place is latitude and longitude, degrees, and height above the ellipsoid, m; None where there is no
    fix.
    """
    if place is None:
        return _close_sentence(f"INGGA,{clock[0]},,,,,0,{bars:02d},,,M,,M,,")
    latitude, longitude, height = place
    where = f"{_format_angle(latitude, 2, 'NS')},{_format_angle(longitude, 3, 'EW')}"
    sea = geoid_m(latitude, longitude)
    return _close_sentence(f"INGGA,{clock[0]},{where},6,{bars:02d},,{height - sea:.3f},M,{sea:.1f},M,,")


def rmc(clock: Clock, place: tuple[float, float, float] | None, velocity: tuple[float, float] | None) -> str:
    """An RMC sentence, with its line end; the place is that of `gga`.

    The velocity is the speed over ground, m/s, and the course, degrees clockwise from north; None if unknown.
    """
    time, date = clock
    if place is None:
        return _close_sentence(f"INRMC,{time},V,,,,,,,{date},,,N")
    latitude, longitude, _ = place
    where = f"{_format_angle(latitude, 2, 'NS')},{_format_angle(longitude, 3, 'EW')}"
    knots = course = ""
    if velocity is not None:
        knots, course = f"{velocity[0] * _KNOTS_PER_M_S:.3f}", f"{round(velocity[1], 2) % 360:.2f}"
    return _close_sentence(f"INRMC,{time},A,{where},{knots},{course},{date},,,E")


def gst(clock: Clock, misfit: float, covariance_m2: NDArray[np.float64]) -> str:
    """A GST sentence, with its line end: the error's ellipse and sigmas.

    The misfit is the root mean square of the residuals, in sigmas, NaN where there are none; the covariance
    that of east, north and up, m2, float64 (3, 3).
    """
    values, axes = np.linalg.eigh(covariance_m2[:2, :2])
    minor, major = np.sqrt(np.maximum(values, 0)).tolist()
    orientation_deg = math.degrees(math.atan2(axes[0, 1], axes[1, 1])) % 180
    east, north, up = sigmas(covariance_m2)
    rms = f"{misfit:.2f}" if math.isfinite(misfit) else ""
    return _close_sentence(
        f"INGST,{clock[0]},{rms},{major:.3f},{minor:.3f},{orientation_deg:.1f},{north:.3f},{east:.3f},{up:.3f}"
    )


def gbs(clock: Clock, undetected_m: NDArray[np.float64], failed: FailedBar | None = None) -> str:
    """A GBS sentence, with its line end: the shift of the fix by an undetected fault, and the failed bar.

    The shift is the largest possible, east, north, up, m, float64 (3,); what is not finite is left empty.

    >>> gbs(format_clock(1e6, None), np.array([0.5, 0.25, 0.125])).strip()
    '$INGBS,000001.000,0.250,0.500,0.125,,,,*64'
    """
    east, north, up = (f"{m:.3f}" if math.isfinite(m) else "" for m in undetected_m.tolist())
    bar = ",,,"
    if failed is not None:
        bar = (
            f"{failed.transmitter:02d},{failed.missed_probability:.4f}"
            f",{failed.bias_m:.3f},{failed.sigma_m:.3f}"
        )
    return _close_sentence(f"INGBS,{clock[0]},{north},{east},{up},{bar}")


def txt(count: int, number: int, text: str) -> str:
    """A TXT sentence, with its line end: a text, its number and their count; 01 stands for a warning.

    >>> txt(1, 1, "EXCLUDED bar 2").strip()
    '$INTXT,01,01,01,EXCLUDED bar 2*1F'
    """
    return _close_sentence(f"INTXT,{count:02d},{number:02d},01,{text}")


def _close_sentence(body: str) -> str:
    return f"${body}*{checksum(body)}\r\n"


def _format_angle(degrees: float, digits: int, signs: str) -> str:
    """Degrees and minutes to 1e-6 minutes, 2 mm; with another digit a GGA has more than 82 characters."""
    ticks = round(abs(degrees) * 60 * 1e6)
    whole, minutes = divmod(ticks, 60 * 10**6)
    return f"{whole:0{digits}d}{minutes // 10**6:02d}.{minutes % 10**6:06d},{signs[degrees < 0]}"


def format_clock(t_us: float, zero: datetime | None) -> Clock:
    """A time of the camera's clock as UTC; without `zero`, UTC of its 0, as the clock's own time of day."""
    start = zero if zero is not None else datetime(1970, 1, 1, tzinfo=UTC)
    at = start.astimezone(UTC) + timedelta(milliseconds=math.floor(t_us / 1000 + 0.5))
    date = at.strftime("%d%m%y") if zero is not None else ""
    return f"{at:%H%M%S}.{at.microsecond // 1000:03d}", date
