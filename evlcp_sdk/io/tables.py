"""Write tables of events: NPZ with one array a column, and CSV, plain or gzipped."""

import gzip
import shutil
import tempfile
import zipfile
from contextlib import ExitStack
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import StreamError
from evlcp_sdk.formatting import format_count
from evlcp_sdk.plugin.writer import LAST_TIME_US, EventWriter
from evlcp_sdk.values import Events, Triggers

COLUMNS: Final = ("t_us", "x", "y", "p")
TRIGGER_COLUMNS: Final = ("trigger_t_us", "trigger_channel", "trigger_value")
WIRE_TYPES: Final[dict[str, np.dtype[Any]]] = {
    "t_us": np.dtype("<i8"),
    "x": np.dtype("<u2"),
    "y": np.dtype("<u2"),
    "p": np.dtype("u1"),
    "trigger_t_us": np.dtype("<i8"),
    "trigger_channel": np.dtype("u1"),
    "trigger_value": np.dtype("u1"),
}
LAST_VALUES: Final = {
    "trigger_t_us": LAST_TIME_US,
    "trigger_channel": 0xFF,
    "trigger_value": 1,
}

CSV_HEADER = b"t_us,x,y,p"
CSV_ROWS = 1 << 15
BUFFER_BYTES = 1 << 20


class NpzWriter(EventWriter):
    """Writes an uncompressed NPZ file of the arrays `COLUMNS` and `TRIGGER_COLUMNS`.

    The columns grow in temporary files and are joined at the end.
    """

    def _begin(self) -> None:
        self._stack = ExitStack()
        self._spools: dict[str, IO[bytes]] = {}
        for name in WIRE_TYPES:
            spool = tempfile.TemporaryFile(dir=self.path.parent)  # noqa: SIM115
            self._spools[name] = self._stack.enter_context(spool)

    def _write(self, events: Events, triggers: Triggers) -> None:
        event_columns = (events.t_us, events.x, events.y, events.p)
        trigger_columns = (triggers.t_us, triggers.channel, triggers.value)
        columns: tuple[NDArray[Any], ...] = event_columns + trigger_columns
        for (name, spool), column in zip(self._spools.items(), columns, strict=True):
            spool.write(column.astype(WIRE_TYPES[name]).tobytes())

    def _finish(self) -> None:
        with zipfile.ZipFile(self._file, "w") as archive:
            for name, size in (("width", self.width), ("height", self.height)):
                if size is not None:
                    with archive.open(f"{name}.npy", "w") as member:
                        np.lib.format.write_array(member, np.array(size))
            for name, spool in self._spools.items():
                rows = spool.tell() // WIRE_TYPES[name].itemsize
                if name in TRIGGER_COLUMNS and not rows:
                    continue
                spool.seek(0)
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    descr = np.lib.format.dtype_to_descr(WIRE_TYPES[name])
                    header = {"descr": descr, "fortran_order": False, "shape": (rows,)}
                    np.lib.format.write_array_header_1_0(member, header)
                    shutil.copyfileobj(spool, member, BUFFER_BYTES)
        self._stack.close()

    def discard(self) -> None:
        """Remove what has been written."""
        self._stack.close()
        super().discard()


class CsvWriter(EventWriter):
    """Writes a CSV file, gzipped if its name ends in `.gz`, without triggers and the sensor's size."""

    def _begin(self) -> None:
        self._out: IO[bytes] | gzip.GzipFile = self._file
        if self.path.suffix == ".gz":
            self._out = gzip.GzipFile("", "wb", 6, self._file, 0)  # no name, no time: same events, same bytes
        self._out.write(CSV_HEADER + b"\n")

    def _write(self, events: Events, triggers: Triggers) -> None:
        if len(triggers):
            found = format_count(len(triggers), "trigger")
            raise StreamError(f"{self.path}: {found}, which a CSV file has no place for: .npz and .raw have")
        for first in range(0, len(events), CSV_ROWS):
            piece = events[first : first + CSV_ROWS]
            columns = (column.tolist() for column in (piece.t_us, piece.x, piece.y, piece.p))
            lines = (f"{t},{x},{y},{p}\n" for t, x, y, p in zip(*columns, strict=True))
            self._out.write("".join(lines).encode())

    def _finish(self) -> None:
        if self._out is not self._file:
            self._out.close()
