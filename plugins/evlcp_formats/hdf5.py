"""Read HDF5 files, also of MATLAB 7.3: columns in a group, records, or a table without names."""

import copy
import math
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np

from evlcp_sdk.errors import InputError, short_message
from evlcp_sdk.io.arrays import Array, choose_columns, split_pieces
from evlcp_sdk.io.columns import WINDOW_US, ColumnSource, EventTable
from evlcp_sdk.io.fields import Fields, fields_from_names, parse_unit
from evlcp_sdk.io.urls import parse_flag, split_options
from evlcp_sdk.lazy import LazyModule

h5py: Any = LazyModule("h5py")

_PLACES: Final = ("events", "raw_events", "CD/events")
_ECF: Final = 36559
"""Number of the filter of Prophesee's codec, which no package with a permissive licence reads."""

_MAX_CHUNK_BYTES: Final = 1 << 26
"""Most bytes of a chunk, which is unpacked at once; libraries choose a thousandth of it."""

_MAX_RATIO: Final = 1100
"""Most unpacked bytes per byte of a file: the limit of deflate is 1032."""


def open_hdf5(url: str) -> ColumnSource:
    """Open `hdf5:PATH`, with `?columns=txyp`, `unit=ms`, and `swapped=1` where x is the row.

    Raises:
        InputError: `h5py` is not installed, the file has no such layout, is damaged, or compressed by ECF, or
            an option is wrong.
    """
    name, options = url, dict[str, Any]()
    if url.startswith("hdf5:"):
        name, options = split_options(
            url, {"columns": _parse_order, "unit": parse_unit, "swapped": parse_flag}
        )
        name = name.removeprefix("hdf5:")

    def read_table(path: Path, stack: ExitStack) -> EventTable:
        return _read_file(path, stack, options.get("columns"), options.get("swapped", False))

    return ColumnSource(name, read_table, unit=options.get("unit"))


def _parse_order(text: str) -> Fields:
    if sorted(text) != sorted("txyp"):
        raise ValueError("the letters t, x, y and p in the order of the table's columns, such as txyp")
    return Fields(text.index("t"), text.index("p"), (text.index("x"), text.index("y")))


def _read_file(path: Path, stack: ExitStack, order: Fields | None, swapped: bool) -> EventTable:
    """Read records or a group of columns under one of `_PLACES`, or the only ones in the file.

    External storage, links to other files and virtual data sets are refused.
    """
    try:
        file = stack.enter_context(h5py.File(path, "r"))
        columns, found = _find_columns(path, file, order)
        size = [file.attrs.get(name) for name in ("width", "height")]
        width, height = (int(side) if side is not None else None for side in size)
    except InputError:
        raise
    except ImportError as fault:
        raise InputError(f"{path}: needs the extra: pip install 'evlcp-sdk[hdf5]'") from fault
    except Exception as fault:
        # A damaged file makes h5py fail in any way.
        raise InputError(f"{path}: found no HDF5 file, or a damaged one ({short_message(fault)})") from fault
    if swapped:
        columns[2:] = columns[:1:-1]
    pieces = split_pieces(columns, path.stat().st_size)
    return EventTable("HDF5", pieces, found.unit, size=(width, height), window_us=WINDOW_US)


class _DataSet:
    """A data set, transposed if it lies on its side, as those of MATLAB do."""

    def __init__(self, path: Path, dataset: Any) -> None:
        _check_dataset(path, dataset)
        self._path, self._dataset = path, dataset
        self.dtype: np.dtype[Any] = dataset.dtype
        shape = dataset.shape
        self._on_its_side = len(shape) == 2 and shape[0] < shape[1]
        shape = shape[::-1] if self._on_its_side else shape
        self.shape = shape[:1] if shape[1:] == (1,) else shape
        self._part: Any = (slice(None), 0) if len(shape) > len(self.shape) else ...
        self._block: list[Any] = [None, None]

    def __getitem__(self, key: Any, /) -> Any:
        """Return some rows, read once for all columns; or a column."""
        if not isinstance(key, slice):
            column = copy.copy(self)
            column._part, column.shape = key, self.shape[:1]
            column.dtype = self.dtype[key] if isinstance(key, str) else self.dtype
            return column
        if self._block[0] != key:
            try:
                block = np.asarray(self._dataset[:, key].T if self._on_its_side else self._dataset[key])
            except Exception as fault:
                raise InputError(
                    f"{self._path}: row {(key.start or 0) + 1}: damaged: {short_message(fault)}"
                ) from fault
            self._block[:] = key, block
        return self._block[1][self._part]


def _find_columns(path: Path, file: Any, order: Fields | None) -> tuple[list[Array], Fields]:
    at, node = _find_table(path, file)
    is_group = isinstance(node, h5py.Group)
    names = [name for name in node if _is_hard_link(node, name)] if is_group else list(node.dtype.names or ())
    listed = ", ".join(names) or "no fields"
    if order is not None and names:
        raise InputError(f"{path}: {at} has {listed}: columns= is for tables without names")
    if (names or is_group) and fields_from_names(names) is None:
        raise InputError(f"{path}: {at} has {listed}, expected x, y, p and t")
    if is_group:
        return choose_columns(path, names, lambda name: _DataSet(path, node[name]), None)
    return choose_columns(path, [at], lambda _: _DataSet(path, node), order, "hdf5:PATH?columns=txyp")


def _find_table(path: Path, file: Any) -> tuple[str, Any]:
    """Find the columns: under one of `_PLACES`, or at the top, as in files of MATLAB."""
    for place in _PLACES:
        node = file
        for part in place.split("/"):
            is_there = isinstance(node, h5py.Group) and part in node
            if is_there and not _is_hard_link(node, part):
                raise InputError(f"{path}: /{place} is a link, expected it in the file itself")
            node = node[part] if is_there else None
        if node is not None:
            return f"/{place}", node
    names = [name for name in file if _is_hard_link(file, name)]
    if fields_from_names(names) is not None:
        return "/", file
    tables = [name for name in names if isinstance(file[name], h5py.Dataset)]
    if len(tables) == 1:
        return f"/{tables[0]}", file[tables[0]]
    raise InputError(
        f"{path}: found {', '.join(sorted(file)) or 'nothing'},"
        f" expected /{' or /'.join(_PLACES)} with x, y, p and t"
    )


def _is_hard_link(group: Any, name: str) -> bool:
    return isinstance(group.get(name, getlink=True), h5py.HardLink)


def _check_dataset(path: Path, dataset: Any) -> None:
    """Check that a data set is in the file itself, and no larger than a file of its size may hold.

    Raises:
        InputError: It is not, or takes more.
    """
    if not isinstance(dataset, h5py.Dataset) or len(dataset.shape or ()) not in (1, 2):
        raise InputError(f"{path}: found {dataset.name}, expected a column of numbers")
    if dataset.is_virtual or dataset.external:
        raise InputError(f"{path}: {dataset.name} is stored in another file, expected it in this one")
    plist = dataset.id.get_create_plist()
    filters = [plist.get_filter(n)[0] for n in range(plist.get_nfilters())]
    if _ECF in filters:
        raise InputError(
            f"{path}: {dataset.name} is compressed by ECF, Prophesee's own codec, which is not read here:"
            " convert it to RAW by metavision_file_to_raw, or write it without compression"
        )
    chunk_bytes = math.prod(dataset.chunks or (0,)) * dataset.dtype.itemsize
    if chunk_bytes > _MAX_CHUNK_BYTES:
        raise InputError(
            f"{path}: {dataset.name} has chunks of {chunk_bytes / 1e6:.0f} MB,"
            f" expected at most {_MAX_CHUNK_BYTES / 1e6:.0f}: h5repack makes them smaller"
        )
    size_bytes = path.stat().st_size
    if dataset.size * dataset.dtype.itemsize > _MAX_RATIO * size_bytes:
        raise InputError(
            f"{path}: {dataset.name} is declared to have {dataset.size} values, more than"
            f" {size_bytes} bytes can hold"
        )
