"""`frames.parquet`: the rows of `frames.csv` with their types."""

from collections.abc import Mapping
from typing import Any

from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.frames_csv import FILTERED_COLUMNS, FRAME_COLUMNS, is_filtered
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.results.text import number_or_none, symbol_list
from evlcp_sdk.values import Frame, Packet

__all__ = ["FramesParquet"]


class FramesParquet(Sink):
    """Writes `frames.parquet`, one row group every `GROUP` frames."""

    GROUP = 4096

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        import pyarrow
        import pyarrow.parquet

        super().__init__(folder, run)
        whole, real = pyarrow.int64(), pyarrow.float64()
        types = [whole, whole, whole, real, pyarrow.list_(whole), real, real, real, real, real]
        self._columns = FRAME_COLUMNS + (FILTERED_COLUMNS if is_filtered(run) else ())
        types += [real] * (len(self._columns) - len(types))
        self._schema = pyarrow.schema(list(zip(self._columns, types, strict=True)))
        self._arrow = pyarrow
        self._writer = pyarrow.parquet.ParquetWriter(folder.path("frames.parquet"), self._schema)
        self._waiting: list[dict[str, Any]] = []

    def packet(self, packet: Packet) -> None:
        """Keep the frames, and write a group when there are enough."""
        for frame in packet.frames:
            self._waiting.append(dict(zip(self._columns, self._values(frame), strict=True)))
            if len(self._waiting) == self.GROUP:
                self._flush()

    def _values(self, frame: Frame) -> tuple[Any, ...]:
        filtered = len(self._columns) > len(FRAME_COLUMNS)
        distances = [frame.range, frame.filtered] if filtered else [frame.range]
        found = [(None, None) if r is None else (r.distance_m, r.sigma_m) for r in distances]
        numbers = [[None if v is None else number_or_none(v, 15) for v in pair] for pair in found]
        return (
            frame.transmitter,
            frame.packet,
            frame.frame,
            frame.t_us,
            symbol_list(frame.soft.symbols),
            frame.soft.quality,
            *numbers[0],
            frame.x_px,
            frame.y_px,
            *(numbers[1] if filtered else ()),
        )

    def _flush(self) -> None:
        self._writer.write_table(self._arrow.Table.from_pylist(self._waiting, schema=self._schema))
        self._waiting = []

    def finish(self) -> Mapping[str, Any]:
        """Write the last group and the file's end."""
        if self._waiting:
            self._flush()
        self._writer.close()
        return {}
