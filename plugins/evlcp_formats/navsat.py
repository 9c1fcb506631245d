"""`navsat.mcap`: fixes as a bag of ROS 2, `sensor_msgs/NavSatFix`."""

from typing import Final

import numpy as np

from evlcp_formats.ros import RosBag
from evlcp_sdk.place.navigator import Place
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.utc import to_utc_ns
from evlcp_sdk.values import Fix

_NO_FIX, _FIX = -1, 0
_UNKNOWN, _KNOWN = 0, 3
"""Types of a covariance."""

TOPIC: Final = "/evlcp/fix"


class NavSat(Sink):
    """Writes `navsat.mcap`: the filtered place at each fix; refused ones have the status NO_FIX.

    Stamps are UTC if it is known, or else the camera's clock.
    """

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._bag = RosBag(folder.open_binary("navsat.mcap"), "navsat.mcap")

    def fix(self, fix: Fix, filtered: Place | None) -> None:
        """Write a message."""
        stamp_ns = to_utc_ns(self.run.clock_zero, fix.t_us)
        place, covariance_m2, status, covariance_type = (np.nan,) * 3, np.zeros((3, 3)), _NO_FIX, _UNKNOWN
        if filtered is not None:
            place = filtered.latitude_deg, filtered.longitude_deg, filtered.height_m
            covariance_m2, status, covariance_type = filtered.covariance_m2, _FIX, _KNOWN
        latitude, longitude, height = place
        message = self._bag.make_message(
            "sensor_msgs/msg/NavSatFix",
            header=self._bag.make_header(stamp_ns),
            status=self._bag.make_message("sensor_msgs/msg/NavSatStatus", status=status, service=0),
            latitude=float(latitude),
            longitude=float(longitude),
            altitude=float(height),
            position_covariance=np.ascontiguousarray(covariance_m2, np.float64).ravel(),
            position_covariance_type=covariance_type,
        )
        self._bag.write(TOPIC, message, stamp_ns)

    def finish(self) -> None:
        """Write the file's index."""
        self._bag.finish()
