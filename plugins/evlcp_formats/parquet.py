"""`frames.parquet`: the rows of `frames.csv` with their types."""

import json
from typing import Any

from evlcp_sdk.formatting import value_or_none
from evlcp_sdk.results.columns import LINK_COLUMN, frame_columns, frame_value
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.values import Packet


class FramesParquet(Sink):
    """Writes `frames.parquet`, one row group every `GROUP` frames."""

    GROUP = 4096

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        import pyarrow
        import pyarrow.parquet

        super().__init__(folder, run)
        integer, real = pyarrow.int64(), pyarrow.float64()
        types = [integer, integer, integer, real, pyarrow.list_(integer), *[real] * 5, integer]
        self._columns = frame_columns(filtered=run.filtered, links=bool(run.links))
        types += [real] * (len(self._columns) - len(types))
        if self._columns[-1] == LINK_COLUMN:
            types[-1] = pyarrow.string()
        self._schema = pyarrow.schema(list(zip(self._columns, types, strict=True)))
        self._writer = pyarrow.parquet.ParquetWriter(folder.path("frames.parquet"), self._schema)
        self._waiting: list[dict[str, Any]] = []

    def packet(self, packet: Packet) -> None:
        """Keep the frames, and write a group when there are enough."""
        for frame in packet.frames:
            self._waiting.append({name: value_or_none(frame_value(frame, name)) for name in self._columns})
            if len(self._waiting) == self.GROUP:
                self._flush()

    def _flush(self) -> None:
        """Write a group by way of JSON: `pyarrow.array` imports pandas where that is installed, 50 MB."""
        import pyarrow.json

        lines = "\n".join(map(json.dumps, self._waiting)).encode()
        options = pyarrow.json.ParseOptions(explicit_schema=self._schema)
        self._writer.write_table(pyarrow.json.read_json(pyarrow.BufferReader(lines), parse_options=options))
        self._waiting = []

    def finish(self) -> None:
        """Write the last group and the file's end."""
        if self._waiting:
            self._flush()
        self._writer.close()
