"""`frames.parquet`: the rows of `frames.csv` with their types."""

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from evlcp_sdk.results.columns import LINK_COLUMN, frame_columns, frame_value
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.values import Packet

if TYPE_CHECKING:
    import pyarrow


class FramesParquet(Sink):
    """Writes `frames.parquet`, one row group every `GROUP` frames."""

    GROUP = 4096

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        import pyarrow
        import pyarrow.parquet

        super().__init__(folder, run)
        whole, real = pyarrow.int64(), pyarrow.float64()
        types = [whole, whole, whole, real, pyarrow.list_(whole), *[real] * 5, whole]
        self._columns = frame_columns(filtered=run.filtered, links=bool(run.links))
        types += [real] * (len(self._columns) - len(types))
        if self._columns[-1] == LINK_COLUMN:
            types[-1] = pyarrow.string()
        self._schema = pyarrow.schema(list(zip(self._columns, types, strict=True)))
        self._writer = pyarrow.parquet.ParquetWriter(folder.path("frames.parquet"), self._schema)
        self._waiting: list[list[Any]] = []

    def packet(self, packet: Packet) -> None:
        """Keep the frames, and write a group when there are enough."""
        for frame in packet.frames:
            self._waiting.append([frame_value(frame, name) for name in self._columns])
            if len(self._waiting) == self.GROUP:
                self._flush()

    def _flush(self) -> None:
        import pyarrow

        columns = zip(*self._waiting, strict=True)
        arrays = [_array(values, kind) for values, kind in zip(columns, self._schema.types, strict=True)]
        self._writer.write_batch(pyarrow.RecordBatch.from_arrays(arrays, schema=self._schema))
        self._waiting = []

    def finish(self) -> Mapping[str, Any]:
        """Write the last group and the file's end."""
        if self._waiting:
            self._flush()
        self._writer.close()
        return {}


def _array(values: Sequence[Any], kind: "pyarrow.DataType") -> "pyarrow.Array":
    """Numbers, or texts, as an array of Arrow; null for None, NaN and infinity.

    Made from buffers: `pyarrow.array` imports pandas where that is installed, 50 MB of memory.
    """
    import pyarrow

    if pyarrow.types.is_list(kind):
        ends = np.cumsum([0, *map(len, values)]).astype(np.int32)
        inner = _array(list(chain.from_iterable(values)), kind.value_type)
        return pyarrow.Array.from_buffers(
            kind, len(values), [None, pyarrow.py_buffer(ends)], children=[inner]
        )
    if pyarrow.types.is_string(kind):
        texts = [value.encode() for value in values]
        ends = np.cumsum([0, *map(len, texts)]).astype(np.int32)
        buffers = [None, pyarrow.py_buffer(ends), pyarrow.py_buffer(b"".join(texts))]
        return pyarrow.Array.from_buffers(kind, len(values), buffers)
    known = np.array([value is not None and np.isfinite(value) for value in values], bool)
    filled = [value if there else 0 for value, there in zip(values, known.tolist(), strict=True)]
    numbers = np.array(filled, np.int64 if pyarrow.types.is_integer(kind) else np.float64)
    there = np.packbits(known, bitorder="little")
    buffers = [pyarrow.py_buffer(there), pyarrow.py_buffer(numbers)]
    return pyarrow.Array.from_buffers(kind, len(values), buffers)
