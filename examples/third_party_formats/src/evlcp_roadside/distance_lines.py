"""The output format `distance-lines`: a line a distance, in the line protocol of time-series databases."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import evlcp_sdk as evlcp

__all__ = ["DistanceLines", "evlcp_sinks"]


@evlcp.hookimpl
def evlcp_sinks() -> Iterator[evlcp.SinkRecord]:
    """The format of this module; its class is imported when it is asked for."""
    yield evlcp.SinkRecord(
        name="distance-lines",
        target="evlcp_roadside.distance_lines:DistanceLines",
        files=("distances.line",),
        summary="a line a distance, for time-series databases",
    )


class DistanceLines(evlcp.Sink):
    """Writes `distances.line`."""

    def __init__(self, folder: evlcp.ResultFolder, run: evlcp.Run) -> None:
        super().__init__(folder, run)
        self._file = folder.open("distances.line")
        self._lines = 0

    def packet(self, packet: evlcp.Packet) -> None:
        """Write a line per frame that has a distance; time is the camera's clock, in ns."""
        for frame in packet.frames:
            if math.isfinite(frame.range.distance_m):
                values = f"depth_m={frame.range.distance_m:.4f},sigma_m={frame.range.sigma_m:.4f}"
                t_ns = round(frame.t_us * 1000)
                self._file.write(f"distance,transmitter={frame.transmitter} {values} {t_ns}\n")
                self._lines += 1

    def finish(self) -> Mapping[str, Any]:
        """Say how many lines there are."""
        return {"lines": self._lines}
