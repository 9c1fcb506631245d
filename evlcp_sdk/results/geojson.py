"""`fixes.geojson`: fixes and bars as points, the smoothed trajectory as lines."""

import json
from collections.abc import Sequence
from typing import Any

from evlcp_sdk.formatting import round_or_none
from evlcp_sdk.place.navigator import Place, Settled
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.lines import integrity_fields
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.results.trail import Trail
from evlcp_sdk.values import Fix, sigmas


class GeoJson(Sink):
    """Writes `fixes.geojson`."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._file = folder.open("fixes.geojson")
        self._file.write('{"type": "FeatureCollection", "features": [')
        self._features = 0
        self._trail = Trail()

    def fix(self, fix: Fix, filtered: Place | None) -> None:
        """Write a given fix as a point, and one refused with an alarm without a place."""
        if filtered is None:
            if fix.alarms:
                refusal = {"t_us": round(fix.t_us, 1), "bars": list(fix.transmitters), "detail": fix.detail}
                self._write_feature(None, [], refusal | integrity_fields(fix))
            return
        self._write_feature(
            "Point",
            [round(fix.longitude_deg, 9), round(fix.latitude_deg, 9), round(fix.height_m, 4)],
            {
                "t_us": round(fix.t_us, 1),
                "heading_deg": round_or_none(fix.heading_deg, 3),
                "sigma_m": [round(value, 4) for value in sigmas(fix.covariance_m2)],
                "covariance_m2": [[float(f"{v:.6g}") for v in row] for row in fix.covariance_m2.tolist()],
                "bars": list(fix.transmitters),
                "verified": fix.verified,
                **integrity_fields(fix),
            },
        )

    def settle(self, settled: Sequence[Settled]) -> None:
        """Write the smoothed places as a line, one per trajectory."""
        for line in self._trail.lines(settled):
            self._write_feature("LineString", line, {"track": "smoothed"})

    def finish(self) -> None:
        """Write the bars, and end the file."""
        assert self.run.navigator is not None
        for number, site in self.run.navigator.positioner.bars.known_sites.items():
            self._write_feature(
                "Point",
                [site.longitude_deg, site.latitude_deg, site.height_m],
                {"bar": number, "transmitter_id": site.transmitter_id},
            )
        self._file.write("]}\n")

    def _write_feature(self, kind: str | None, coordinates: list[Any], properties: dict[str, Any]) -> None:
        geometry = None if kind is None else {"type": kind, "coordinates": coordinates}
        feature = {"type": "Feature", "geometry": geometry, "properties": properties}
        self._file.write(("," if self._features else "") + "\n" + json.dumps(feature))
        self._features += 1
