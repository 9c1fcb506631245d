"""`fixes.kml`: fixes and bars as points, the smoothed trajectory as lines, for Google Earth and GIS programs.

Altitudes in KML are above mean sea level, the geoid of EGM96.
"""

from collections.abc import Sequence
from xml.sax.saxutils import escape

from evlcp_sdk.place.gnss import geoid_m
from evlcp_sdk.place.navigator import Place, Settled
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.gpsd import format_time
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.results.trail import Trail
from evlcp_sdk.utc import clock_zero_at
from evlcp_sdk.values import Fix, sigmas

_HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>{name}</name>
<Style id="fix"><IconStyle><color>ff30a0ff</color><scale>0.4</scale></IconStyle>\
<LabelStyle><scale>0</scale></LabelStyle></Style>
<Style id="track"><LineStyle><color>ffff8030</color><width>3</width></LineStyle></Style>
"""


class Kml(Sink):
    """Writes `fixes.kml`."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._file = folder.open("fixes.kml")
        self._file.write(_HEAD.format(name=escape(run.name)))
        self._trail = Trail()

    def fix(self, fix: Fix, filtered: Place | None) -> None:
        """Write an accepted fix as a point, with its time if UTC is known."""
        if filtered is None:
            return
        east, north, up = sigmas(fix.covariance_m2)
        zero = clock_zero_at(self.run.clock_zero, fix.t_us)
        when = "" if zero is None else f"<TimeStamp><when>{format_time(zero, fix.t_us)}</when></TimeStamp>"
        name = f"<name>{fix.t_us / 1e3:.1f} ms</name>"
        label = f"&#177; {east:.3f} E {north:.3f} N {up:.3f} U m"
        where = _format_point(fix.longitude_deg, fix.latitude_deg, fix.height_m)
        self._write_placemark(
            f"{name}{when}<styleUrl>#fix</styleUrl><description>{label}</description>{where}"
        )

    def settle(self, settled: Sequence[Settled]) -> None:
        """Write the smoothed places as a line, one per trajectory."""
        for line in self._trail.lines(settled):
            where = " ".join(_format_coordinates(*place) for place in line)
            self._write_placemark(
                "<styleUrl>#track</styleUrl><LineString><altitudeMode>absolute</altitudeMode>"
                f"<coordinates>{where}</coordinates></LineString>"
            )

    def finish(self) -> None:
        """Write the bars, and end the file."""
        assert self.run.navigator is not None
        for number, site in self.run.navigator.positioner.bars.known_sites.items():
            where = _format_point(site.longitude_deg, site.latitude_deg, site.height_m)
            self._write_placemark(f"<name>bar {number}, id {site.transmitter_id}</name>{where}")
        self._file.write("</Document></kml>\n")

    def _write_placemark(self, content: str) -> None:
        self._file.write(f"<Placemark>{content}</Placemark>\n")


def _format_point(longitude_deg: float, latitude_deg: float, height_m: float) -> str:
    where = _format_coordinates(longitude_deg, latitude_deg, height_m)
    return f"<Point><altitudeMode>absolute</altitudeMode><coordinates>{where}</coordinates></Point>"


def _format_coordinates(longitude_deg: float, latitude_deg: float, height_m: float) -> str:
    altitude_m = height_m - geoid_m(latitude_deg, longitude_deg)
    return f"{longitude_deg:.9f},{latitude_deg:.9f},{altitude_m:.3f}"
