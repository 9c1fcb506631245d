"""`fixes.mcap`: positions as MCAP with well-known schemas: `/fix`, `/pose`, `/track`, `/integrity`."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.navigator import Place
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.results.text import integrity
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.values import Fix

__all__ = ["Mcap"]

FRAME_ID = "enu"
"""Name of the local axes; camera axes in it are x right, y down, z forward."""


class Mcap(Sink):
    """Writes `fixes.mcap`, message by message.

    `/fix` (foxglove.LocationFix) and `/pose` (foxglove.PoseInFrame, camera axes in ENU) hold each fix as it
    was measured, `/pose` those of bars; `/track` (foxglove.LocationFix) the filtered position at its time;
    `/integrity` (google.protobuf.Struct) protection levels, what was left out and alarms, of refused fixes,
    too.
    """

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        from mcap_protobuf.writer import Writer

        super().__init__(folder, run)
        zero = run.clock_zero
        self._zero_us = round(zero.timestamp() * 1e6) if zero is not None else 0
        self._writer: Any = Writer(folder.open_binary("fixes.mcap"))

    def fix(self, fix: Fix, filtered: Place | None) -> None:
        """Write a fix that is given, and the filtered place at its time."""
        from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
        from scipy.spatial.transform import Rotation

        self._integrity(fix)
        if filtered is None:
            return
        measured = (fix.latitude_deg, fix.longitude_deg, fix.height_m)
        place = (filtered.latitude_deg, filtered.longitude_deg, filtered.height_m)
        self._location("/fix", fix.t_us, measured, fix.covariance_m2)
        self._location("/track", fix.t_us, place, filtered.covariance_m2)
        if not math.isfinite(fix.heading_deg):
            return
        axes = Attitude(fix.pitch_deg, fix.roll_deg, fix.heading_deg).rotation()
        turn = Rotation.from_matrix(axes).as_quat()
        pose = PoseInFrame(frame_id=FRAME_ID)
        pose.timestamp.FromNanoseconds(self._at_ns(fix.t_us))
        where, how = pose.pose.position, pose.pose.orientation
        where.x, where.y, where.z = fix.enu_m.tolist()
        how.x, how.y, how.z, how.w = turn.tolist()
        self._write("/pose", fix.t_us, pose)

    def finish(self) -> Mapping[str, Any]:
        """Write the file's index."""
        self._writer.finish()
        return {}

    def _location(
        self, topic: str, t_us: float, place: tuple[float, float, float], covariance_m2: NDArray[np.float64]
    ) -> None:
        from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix

        latitude, longitude, height = place
        message = LocationFix(
            frame_id=FRAME_ID,
            latitude=latitude,
            longitude=longitude,
            altitude=height,
            position_covariance=covariance_m2.ravel().tolist(),
            position_covariance_type=LocationFix.KNOWN,
        )
        message.timestamp.FromNanoseconds(self._at_ns(t_us))
        self._write(topic, t_us, message)

    def _integrity(self, fix: Fix) -> None:
        from google.protobuf.struct_pb2 import Struct

        message = Struct()
        message.update({"bars": list(fix.transmitters), "refusal": fix.refusal} | integrity(fix))
        self._write("/integrity", fix.t_us, message)

    def _write(self, topic: str, t_us: float, message: Any) -> None:
        at_ns = self._at_ns(t_us)
        self._writer.write_message(topic=topic, message=message, log_time=at_ns, publish_time=at_ns)

    def _at_ns(self, t_us: float) -> int:
        return self._zero_us * 1000 + round(t_us * 1000)
