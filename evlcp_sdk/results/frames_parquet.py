"""`frames.parquet`: the rows of `frames.csv` with their types."""

import math
from collections.abc import Mapping
from typing import Any

from evlcp_sdk.results.columns import FILTERED_COLUMNS, FRAME_COLUMNS, frame_value
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.frames_csv import is_filtered
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.values import Packet

__all__ = ["FramesParquet"]


class FramesParquet(Sink):
    """Writes `frames.parquet`, one row group every `GROUP` frames."""

    GROUP = 4096

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        import pyarrow
        import pyarrow.parquet

        super().__init__(folder, run)
        whole, real = pyarrow.int64(), pyarrow.float64()
        types = [whole, whole, whole, real, pyarrow.list_(whole), *[real] * 5, whole]
        self._columns = FRAME_COLUMNS + (FILTERED_COLUMNS if is_filtered(run) else ())
        types += [real] * (len(self._columns) - len(types))
        self._schema = pyarrow.schema(list(zip(self._columns, types, strict=True)))
        self._arrow = pyarrow
        self._writer = pyarrow.parquet.ParquetWriter(folder.path("frames.parquet"), self._schema)
        self._waiting: list[dict[str, Any]] = []

    def packet(self, packet: Packet) -> None:
        """Keep the frames, and write a group when there are enough."""
        for frame in packet.frames:
            found = {name: frame_value(frame, name) for name in self._columns}
            self._waiting.append({name: _given(value) for name, value in found.items()})
            if len(self._waiting) == self.GROUP:
                self._flush()

    def _flush(self) -> None:
        self._writer.write_table(self._arrow.Table.from_pylist(self._waiting, schema=self._schema))
        self._waiting = []

    def finish(self) -> Mapping[str, Any]:
        """Write the last group and the file's end."""
        if self._waiting:
            self._flush()
        self._writer.close()
        return {}


def _given(value: Any) -> Any:
    """A value as it is; None for NaN and infinity."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
