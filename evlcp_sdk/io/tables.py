"""Tables of events: NPZ with one array a column, and CSV, plain or gzipped."""

import gzip
import lzma
import shutil
import tempfile
import zipfile
import zlib
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import InputError, OutputError, StreamError
from evlcp_sdk.files import Outputs
from evlcp_sdk.io.writers import LAST_TIME_US, EventWriter
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


DAMAGE: Final = (
    *(OSError, EOFError, ValueError, RuntimeError, zlib.error, lzma.LZMAError, zipfile.BadZipFile),
)
"""What reading a member of a ZIP file raises; RuntimeError: encrypted, or packed by an unknown method."""


class NpzColumn:
    """One array of an NPZ file, read from front to back.

    Args:
        path: The file, for messages.
        archive: The open file.
        name: Of the array.
        stack: Closes it.
        kinds: Kinds of types that it may have, as NumPy's.

    Raises:
        InputError: There is no such array, or it is not one of numbers of these kinds in one dimension.
    """

    def __init__(
        self,
        path: Path,
        archive: zipfile.ZipFile,
        name: str,
        stack: ExitStack,
        kinds: str = "iub",
    ) -> None:
        self.name, self.row, self._path = name, 0, path
        try:
            self._file = stack.enter_context(archive.open(f"{name}.npy"))
        except KeyError:
            found = ", ".join(sorted(member.removesuffix(".npy") for member in archive.namelist()))
            raise InputError(f"{path}: found the arrays {found or 'none'}, expected {name} too") from None
        except DAMAGE as error:
            raise InputError(f"{path}: array {name}: {said(error)}") from error
        try:
            shape, _, dtype = npy_header(self._file)
        except ValueError as error:
            raise InputError(f"{path}: array {name}: {error}") from error
        if len(shape) == 2 and 1 in shape:
            # One column or one row of a table is a column, too.
            shape = (shape[0] * shape[1],)
        if dtype.kind not in kinds or len(shape) > 1 or min(shape, default=0) < 0:
            what = "numbers" if "f" in kinds else "integers"
            raise InputError(f"{path}: array {name}: found {dtype} {shape}, expected {what} (n,)")
        self.dtype = dtype
        self.is_scalar = not shape
        self.rows = shape[0] if shape else 1

    def take(self, rows: int) -> NDArray[Any]:
        """Return the next values, as many as there are up to `rows`.

        Raises:
            InputError: The array ends too early.
        """
        rows = min(rows, self.rows - self.row)
        data = self._file.read(rows * self.dtype.itemsize)
        if len(data) < rows * self.dtype.itemsize:
            found = self.row + len(data) // self.dtype.itemsize
            raise InputError(f"{self._path}: array {self.name}: found {found} values, expected {self.rows}")
        self.row += rows
        return np.frombuffer(data, self.dtype)

    def take_bounded(self, rows: int) -> NDArray[Any]:
        """The same of a column of ours, in its type.

        Raises:
            InputError: A value has no place in the column, or the array ends too early.
        """
        row, values = self.row, self.take(rows)
        last = LAST_VALUES.get(self.name, 0xFFFF)
        first = -last if self.name == "trigger_t_us" else 0
        if len(values) and not (first <= values.min() and values.max() <= last):
            k = int(((values < first) | (values > last)).argmax())
            raise InputError(
                f"{self._path}: array {self.name}: row {row + k + 1}: found {values[k]},"
                f" expected {first} to {last}"
            )
        return values.astype(WIRE_TYPES.get(self.name, np.dtype(np.int64)))

    def one(self) -> int:
        """The only value.

        Raises:
            InputError: There are none or several, or it has no place in the column.
        """
        if self.rows != 1:
            raise InputError(f"{self._path}: array {self.name}: found {self.rows} values, expected one")
        return int(self.take_bounded(1)[0])


def npy_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape of an array in NumPy's format, whether columns lie on end, and type.

    Raises:
        ValueError: It is none.
    """
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0
        found = (read if version == (1, 0) else np.lib.format.read_array_header_2_0)(file)
    except Exception as error:
        # NumPy evaluates the header as a piece of Python, which may fail in any way.
        raise ValueError(said(error)) from error
    shape, on_end, dtype = found
    return shape, on_end, dtype


def said(error: Exception) -> str:
    """What an error says, in one line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 200 else f"{text[:200]}..."


class NpzWriter(EventWriter):
    """An NPZ file being written, with the arrays `COLUMNS` and `TRIGGER_COLUMNS`; not compressed.

    The columns grow in temporary files and are put together at the end.

    Args:
        path: The file.
        width: Columns of the sensor, or None if unknown.
        height: Rows of the sensor, or None.
        outputs: See `EventWriter`.

    Raises:
        OutputError: The file cannot be written.
    """

    def __init__(
        self,
        path: Path | str,
        width: int | None = None,
        height: int | None = None,
        outputs: Outputs | None = None,
    ) -> None:
        super().__init__(path, width, height, outputs)
        self._stack = ExitStack()
        try:
            with self._outputs.told(self.path):
                self._spools: dict[str, IO[bytes]] = {
                    name: self._stack.enter_context(tempfile.TemporaryFile(dir=self.path.parent))  # noqa: SIM115
                    for name in WIRE_TYPES
                }
        except OutputError:
            self.discard()
            raise

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


def show(line: bytes) -> str:
    """Return the start of a line for a message."""
    text = line[:60].decode("utf-8", "replace")
    return repr(text + ("..." if len(line) > 60 else ""))


class CsvWriter(EventWriter):
    """A CSV file being written; gzipped if its name ends in `.gz`. It has no place for triggers.

    Args:
        path: The file.
        width: Columns of the sensor, or None if unknown; only checked, the file does not say it.
        height: Rows of the sensor, or None.
        outputs: See `EventWriter`.

    Raises:
        OutputError: The file cannot be written.
    """

    def __init__(
        self,
        path: Path | str,
        width: int | None = None,
        height: int | None = None,
        outputs: Outputs | None = None,
    ) -> None:
        super().__init__(path, width, height, outputs)
        self._out: IO[bytes] | gzip.GzipFile = self._file
        if self.path.suffix == ".gz":
            self._out = gzip.GzipFile("", "wb", 6, self._file, 0)  # no name, no time: same events, same bytes
        self._out.write(CSV_HEADER + b"\n")

    def _write(self, events: Events, triggers: Triggers) -> None:
        if len(triggers):
            raise StreamError(f"{self.path}: {len(triggers)} triggers, which a CSV file has no place for")
        for first in range(0, len(events), CSV_ROWS):
            piece = events[first : first + CSV_ROWS]
            columns = (column.tolist() for column in (piece.t_us, piece.x, piece.y, piece.p))
            lines = (f"{t},{x},{y},{p}\n" for t, x, y, p in zip(*columns, strict=True))
            self._out.write("".join(lines).encode())

    def _finish(self) -> None:
        if self._out is not self._file:
            self._out.close()
