"""Read columns of arrays: NPZ and NPY files, and what other files of arrays share with them."""

import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import InputError, short_message
from evlcp_sdk.io.columns import PIECE_ROWS, WINDOW_US, EventTable, Piece
from evlcp_sdk.io.fields import Fields, fields_from_names, fields_from_values
from evlcp_sdk.io.tables import COLUMNS, LAST_VALUES, TRIGGER_COLUMNS, WIRE_TYPES
from evlcp_sdk.values import Triggers

_SAMPLE_ROWS: Final = 1 << 14
"""Rows at the start by which columns are recognized."""

_TRIGGER_ROWS: Final = 1 << 12
_MAX_COLUMNS: Final = 8

_MAX_RATIO, _SMALL_BYTES = 100, 1 << 29
"""Most ratio of unpacked bytes to an archive's own, where events make 16; unpacked bytes always allowed."""


class Array(Protocol):
    """Values (n,), records (n,) or a table (n, k), of which some rows are read at a time."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows, and columns of a table."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values."""

    def __getitem__(self, key: Any, /) -> Any:
        """Return the rows of a slice, or a column by its name or by `(slice(None), number)`."""


def to_upright(array: NDArray[Any]) -> NDArray[Any]:
    """Return a single column or row as an array (n,), a table that lies on its side as a table (n, k)."""
    if array.ndim != 2 or 1 in array.shape:
        return array.ravel() if array.ndim == 2 else array
    return array if array.shape[0] >= array.shape[1] else array.T


def choose_columns(
    path: Path,
    names: Sequence[str],
    load: Callable[[str], Array],
    fields: Fields | None,
    hint: str = "list:PATH?columns=t,p",
) -> tuple[list[Array], Fields]:
    """Return time, polarity and perhaps x and y: from arrays by name, or from a table among them.

    Args:
        path: The file, for messages.
        names: Names of its arrays.
        load: Returns the array of a name.
        fields: Which column is what; None recognizes it by names, or else by the first rows.
        hint: How to state the columns, for messages.

    Raises:
        InputError: There are no such columns, or they are no numbers, or of different lengths.
    """
    found = fields or fields_from_names(names)
    if found is None and len(names) == 2:
        with suppress(InputError):  # one may be a table, the other something else
            found = _fields_from_sample([load(name) for name in names])
    if found is None or max(found.numbers) >= len(names):
        named, found = _choose_table(path, names, load, fields, hint)
    else:
        named = [(names[k], load(names[k])) for k in found.numbers]
    if any(column.shape == () for _, column in named[2:]):
        # One x or y is no column of events.
        found, named = replace(found, places=None), named[:2]
    for (name, column), kinds in zip(named, ("iuf", "iubfUS", "iuf", "iuf"), strict=False):
        if column.dtype.kind not in kinds or len(column.shape) != 1:
            what = f"{column.dtype} {column.shape}"
            raise InputError(f"{path}: array {name}: found {what}, expected numbers (n,)")
    _check_lengths(path, dict(named))
    return [column for _, column in named], found


def _choose_table(
    path: Path, names: Sequence[str], load: Callable[[str], Array], fields: Fields | None, hint: str
) -> tuple[list[tuple[str, Array]], Fields]:
    """Return the columns of the first table in which they are recognized, short names first."""
    for name in sorted(names, key=len):
        try:
            table = load(name)
        except InputError:
            if len(names) == 1:
                raise
            continue
        parts: Sequence[Any] = table.dtype.names or ()
        if len(table.shape) == 2 and 1 < table.shape[1] <= _MAX_COLUMNS:
            parts = [(slice(None), k) for k in range(table.shape[1])]
        columns: list[Array] = [table[part] for part in parts]
        found = fields or fields_from_names(table.dtype.names or ()) or _fields_from_sample(columns)
        if found is not None and max(found.numbers) < len(columns):
            return [(name, columns[k]) for k in found.numbers], found
    raise InputError(
        f"{path}: found the arrays {', '.join(sorted(names)) or 'none'}, expected t and p or a table"
        f" of them (or say which columns they are, as by {hint})"
    )


def _fields_from_sample(columns: Sequence[Array]) -> Fields | None:
    if not columns or not all(column.dtype.kind in "iubfUS" and len(column.shape) == 1 for column in columns):
        return None
    return fields_from_values([column[:_SAMPLE_ROWS] for column in columns])


def _check_lengths(path: Path, columns: Mapping[str, Array]) -> None:
    lengths = {name: (*column.shape, 1)[0] for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise InputError(f"{path}: found arrays of the lengths {lengths}, expected one length")


def split_pieces(columns: Sequence[Array], size_bytes: int) -> Iterator[Piece]:
    """Yield the rows of the columns time, polarity and perhaps x and y, of a file of so many bytes."""
    rows = columns[0].shape[0]
    for first in range(0, rows, PIECE_ROWS):
        part = slice(first, min(first + PIECE_ROWS, rows))
        times, *others = (column[part] for column in columns)
        if times.dtype.kind == "u" and times.max() > np.iinfo(np.int64).max:
            times = times.astype(np.float64)
        elif times.dtype.kind != "f":
            times = times.astype(np.int64)
        done = round(size_bytes * part.stop / rows)
        yield Piece((times, *others), (first + 1).__add__, done)


def _map_array(name: str, file: Path) -> NDArray[Any]:
    """Map an array in NumPy's format into memory.

    Raises:
        InputError: The file is damaged or has another format.
    """
    try:
        return to_upright(np.lib.format.open_memmap(file, mode="r"))
    except Exception as error:
        # NumPy evaluates the header as Python, which may fail in any way.
        raise InputError(f"{name}: found no array of numbers ({short_message(error)})") from error


def read_npy(path: Path, _: ExitStack, fields: Fields | None) -> EventTable:
    """Read a table in an NPY file, of records, (n, k) or (k, n)."""
    array = _map_array(str(path), path)
    columns, found = choose_columns(path, [path.name], lambda _: array, fields)
    return EventTable("NPY", split_pieces(columns, path.stat().st_size), found.unit)


def read_npz(path: Path, stack: ExitStack, fields: Fields | None) -> EventTable:
    """Read arrays of an NPZ file, or a table in one; our own file may have triggers and the sensor's size.

    They are unpacked into a temporary folder, so that none has to be in memory.
    """
    try:
        archive = stack.enter_context(zipfile.ZipFile(path))
    except (zipfile.BadZipFile, UnicodeDecodeError, NotImplementedError) as error:
        raise InputError(f"{path}: found no NPZ file, expected one ({error})") from error
    names = [member.removesuffix(".npy") for member in archive.namelist() if member.endswith(".npy")]
    size, unpacked = path.stat().st_size, sum(member.file_size for member in archive.infolist())
    if unpacked > _MAX_RATIO * size + _SMALL_BYTES:
        raise InputError(f"{path}: {size} bytes are declared to unpack to {unpacked}, more than events can")
    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="evlcp-"))

    def load(name: str) -> NDArray[Any]:
        try:
            file = archive.extract(f"{name}.npy", folder)
        except Exception as error:
            # Codecs and encryption fail in many ways.
            raise InputError(f"{path}: array {name}: damaged: {short_message(error)}") from error
        return _map_array(f"{path}: array {name}", Path(file))

    columns, found = choose_columns(path, names, load, fields)
    pieces = split_pieces(columns, path.stat().st_size)
    if fields is not None or not set(COLUMNS) <= set(names):
        return EventTable("NPZ", pieces, found.unit)
    width, height = (
        _read_scalar(path, name, load(name)) if name in names else None for name in ("width", "height")
    )
    triggers: dict[str, Array] = {}
    if "trigger_t_us" in names:
        for name in TRIGGER_COLUMNS:
            if name not in names:
                raise InputError(f"{path}: found the arrays {', '.join(sorted(names))}, expected {name} too")
            triggers[name] = load(name)
    _check_lengths(path, triggers)
    edges = _read_triggers(path, triggers) if triggers else None
    return EventTable("NPZ", pieces, found.unit, size=(width, height), triggers=edges, window_us=WINDOW_US)


def _read_triggers(path: Path, columns: Mapping[str, Array]) -> Iterator[Triggers]:
    for first in range(0, columns["trigger_t_us"].shape[0], _TRIGGER_ROWS):
        part = slice(first, first + _TRIGGER_ROWS)
        values = (_convert_values(path, name, column[part], first) for name, column in columns.items())
        yield Triggers(*values)


def _convert_values(path: Path, name: str, values: NDArray[Any], row: int) -> NDArray[Any]:
    """Convert values of one of our columns, from a row on, to its type.

    Raises:
        InputError: A value is no integer, or out of the column's range.
    """
    last = LAST_VALUES.get(name, 0xFFFF)
    first = -last if name == "trigger_t_us" else 0
    if values.dtype.kind not in "iub":
        raise InputError(f"{path}: array {name}: found {values.dtype}, expected integers")
    wrong = (values < first) | (values > last)
    if wrong.any():
        k = int(wrong.argmax())
        raise InputError(
            f"{path}: array {name}: row {row + k + 1}: found {values[k]}, expected {first} to {last}"
        )
    return values.astype(WIRE_TYPES.get(name, np.dtype(np.int64)))


def _read_scalar(path: Path, name: str, array: NDArray[Any]) -> int:
    if array.shape not in ((), (1,)):
        raise InputError(f"{path}: array {name}: found {array.shape} values, expected one")
    return int(_convert_values(path, name, array.ravel(), 0)[0])
