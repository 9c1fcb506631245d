"""An output format in one file with one hook: the line protocol of a time-series database."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

from evlcp_sdk.plugin.hooks import SinkRecord, hookimpl
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.values import Packet


@hookimpl
def evlcp_sinks() -> Iterator[SinkRecord]:
    yield SinkRecord("distances", f"{__name__}:Distances", ("distances.line",), "distances as lines")


class Distances(Sink):
    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._file = folder.open("distances.line")
        self._lines = 0
        self._stages = 0

    @hookimpl
    def evlcp_stage_finished(self, stage: str) -> None:
        self._stages += stage == "frame"

    def packet(self, packet: Packet) -> None:
        for frame in packet.frames:
            if math.isfinite(frame.range.distance_m):
                where = f"distance,transmitter={frame.transmitter}"
                value = f"depth_m={frame.range.distance_m:.4f}"
                self._file.write(f"{where} {value} {round(frame.t_us * 1000)}\n")
                self._lines += 1

    def finish(self) -> Mapping[str, Any]:
        return {"lines": self._lines, "frames_watched": self._stages}
