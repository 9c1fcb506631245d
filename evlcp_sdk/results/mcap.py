"""Positions as MCAP with Foxglove's well-known schemas: `/fix`, `/pose`, `/track`."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.values import Fix

__all__ = ["McapFixes", "check_mcap"]

FRAME_ID = "enu"
"""Name of the local frame; camera axes in it are x right, y down, z forward."""


def check_mcap() -> None:
    """See whether the packages are there.

    Raises:
        ConfigError: They are not.
    """
    if any(find_spec(name) is None for name in ("mcap", "mcap_protobuf", "foxglove_schemas_protobuf")):
        raise ConfigError("MCAP needs the extra: pip install 'evlcp-sdk[mcap]', or leave --mcap out")


class McapFixes:
    """Writes fixes and a filtered track, message by message.

    `/fix` (foxglove.LocationFix) and `/pose` (foxglove.PoseInFrame, camera axes in ENU) hold each fix as it
    was measured; `/track` (foxglove.LocationFix) the filtered position at its time.

    Args:
        path: The file.
        zero_us: Unix time of the camera clock's 0, us.
    """

    def __init__(self, path: Path, zero_us: int) -> None:
        from mcap_protobuf.writer import Writer

        self._file = path.open("wb")
        self._writer: Any = Writer(self._file)
        self._zero_us = zero_us

    def add(
        self,
        fix: Fix,
        place: tuple[float, float, float],
        covariance_m2: NDArray[np.float64],
    ) -> None:
        """Take a fix that is given, and the filtered place at its time with its covariance."""
        from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
        from scipy.spatial.transform import Rotation

        measured = (fix.latitude_deg, fix.longitude_deg, fix.height_m)
        self._location("/fix", fix.t_us, measured, fix.covariance_m2)
        self._location("/track", fix.t_us, place, covariance_m2)
        axes = Attitude(fix.pitch_deg, fix.roll_deg, fix.heading_deg).rotation()
        turn = Rotation.from_matrix(axes).as_quat()
        pose = PoseInFrame(frame_id=FRAME_ID)
        pose.timestamp.FromNanoseconds(self._at_ns(fix.t_us))
        where, how = pose.pose.position, pose.pose.orientation
        where.x, where.y, where.z = fix.enu_m.tolist()
        how.x, how.y, how.z, how.w = turn.tolist()
        self._write("/pose", fix.t_us, pose)

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

    def _write(self, topic: str, t_us: float, message: Any) -> None:
        at_ns = self._at_ns(t_us)
        self._writer.write_message(topic=topic, message=message, log_time=at_ns, publish_time=at_ns)

    def _at_ns(self, t_us: float) -> int:
        return self._zero_us * 1000 + round(t_us * 1000)

    def close(self) -> None:
        """Write the file's index and end it."""
        if not self._file.closed:
            self._writer.finish()
            self._file.close()
