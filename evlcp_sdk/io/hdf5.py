"""HDF5 files, those of MATLAB 7.3 among them: columns in a group, records, or a table without names."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np

from evlcp_sdk.errors import InputError
from evlcp_sdk.io.columns import PIECE_ROWS, WINDOW_US, ColumnSource, Piece, piece_of
from evlcp_sdk.io.fields import Fields, fields_of, fields_of_values, unit_named
from evlcp_sdk.io.tables import said
from evlcp_sdk.io.urls import flag, split_options

PLACES: Final = ("events", "raw_events", "CD/events")
MAGIC: Final = b"\x89HDF\r\n\x1a\n"
MATLAB: Final = b"MATLAB 7.3"
"""How a file of MATLAB 7.3 begins, in which HDF5 begins later."""

_ECF: Final = 36559
"""Number of the filter of Prophesee's codec, which no package with a permissive licence reads."""

_MOST_CHUNK_BYTES: Final = 1 << 26
"""Of what is unpacked at once; libraries choose a thousandth of it."""

_MOST_COLUMNS: Final = 8
_LOOKED_AT: Final = 1 << 14
"""Rows at the start from which columns are recognized."""

_MOST_RATIO: Final = 1100
"""How much a byte of a file can hold: the limit of deflate is 1032."""


def open_hdf5(url: str) -> "Hdf5Source":
    """Open `hdf5:PATH`, with `?columns=txyp`, `unit=ms`, and `swapped=1` where x is the row.

    Raises:
        InputError: As for `Hdf5Source`, or an option is wrong.
    """
    name, options = split_options(url, {"columns": _order, "unit": unit_named, "swapped": flag})
    return Hdf5Source(
        name.partition(":")[2],
        columns=options.get("columns"),
        unit=options.get("unit"),
        swapped=options.get("swapped", False),
    )


def _order(text: str) -> str:
    if sorted(text) != sorted("txyp"):
        raise ValueError("the letters t, x, y and p in the order of the table's columns, such as txyp")
    return text


class Hdf5Source(ColumnSource):
    """An HDF5 file by `h5py`: records or a group of columns, under one of `PLACES`, or the only ones.

    Columns are known by their names, as those of lists, and so is the unit of the times, if it is named.
    External storage, links to other files and virtual data sets are refused.

    Args:
        path: The file.
        columns: Of a table without names, (n, 4) or (4, n), what its columns, or rows, are, e.g. `txyp`.
        unit: Of the times, `s`, `ms`, `us` or `ns`; None: as the file says or shows.
        swapped: x is the row and y the column.

    Raises:
        InputError: `h5py` is not installed, the file has no such layout, is damaged, or compressed by ECF.
    """

    def __init__(
        self, path: Path | str, *, columns: str | None = None, unit: str | None = None, swapped: bool = False
    ) -> None:
        target = self.path = Path(path)
        try:
            import h5py
        except ImportError as fault:
            raise InputError(f"{path}: needs the extra: pip install 'evlcp-sdk[hdf5]'") from fault
        with ExitStack() as stack:
            try:
                file = stack.enter_context(h5py.File(target, "r"))
                found, named = _columns_of(target, file, columns)
                size = [file.attrs.get(name) for name in ("width", "height")]
                width, height = (int(side) if side is not None else None for side in size)
            except InputError:
                raise
            except Exception as fault:
                # A damaged file makes h5py fail in any way.
                raise InputError(f"{path}: found no HDF5 file, or a damaged one ({said(fault)})") from fault
            if swapped:
                found[2:] = found[:1:-1]
            super().__init__(
                target,
                "HDF5",
                self._read(found),
                stack,
                named=lambda: named,
                unit=unit,
                size=(width, height),
                window_us=WINDOW_US,
            )
            self._stack = stack.pop_all()

    def _read(self, columns: list["_Column"]) -> Iterator[Piece]:
        rows = len(columns[0])
        for first in range(0, rows, PIECE_ROWS):
            try:
                time, polarity, *places = (column[first : first + PIECE_ROWS] for column in columns)
            except Exception as fault:
                raise InputError(f"{self.path}: row {first + 1}: damaged: {said(fault)}") from fault
            self._position = round(self.path.stat().st_size * min((first + PIECE_ROWS) / rows, 1.0))
            yield piece_of([time, polarity, *places], first + 1)


class _Column:
    """One column: a data set, a field of records, or a part of a table, which may lie on its side."""

    def __init__(self, dataset: Any, part: str | int | None = None, *, on_its_side: bool = False) -> None:
        self.dataset, self._part, self._on_its_side = dataset, part, on_its_side

    @property
    def kind(self) -> str:
        """Of its type, as NumPy's."""
        kinds = self.dataset.dtype
        return str((kinds[self._part] if isinstance(self._part, str) else kinds).kind)

    def __len__(self) -> int:
        shape = self.dataset.shape
        return int(max(shape) if self._part is None else shape[1 if self._on_its_side else 0])

    def __getitem__(self, rows: slice) -> Any:
        if self._part is None:
            # A column of MATLAB lies on its side.
            on_its_side = len(self.dataset.shape) == 2 and self.dataset.shape[0] == 1
            return np.asarray(self.dataset[0, rows] if on_its_side else self.dataset[rows]).ravel()
        if isinstance(self._part, str):
            return np.asarray(self.dataset[rows][self._part])
        return np.asarray(
            self.dataset[self._part, rows] if self._on_its_side else self.dataset[rows, self._part]
        )


def _columns_of(path: Path, file: Any, order: str | None) -> tuple[list[_Column], str | None]:
    """Time, polarity and, if there are any, x and y; and the unit that the time's name says."""
    import h5py

    at, node = _place_of(path, file)
    is_group = isinstance(node, h5py.Group)
    names = [name for name in node if _is_own(node, name)] if is_group else list(node.dtype.names or ())
    nameless = (
        not names and not is_group and len(node.shape or ()) == 2 and 1 < min(node.shape) <= _MOST_COLUMNS
    )
    if order is not None and not nameless:
        raise InputError(
            f"{path}: {at} has {', '.join(names) or 'no fields'}: columns = {order!r} is for tables"
            " without names"
        )
    if nameless:
        columns, fields = _nameless_columns(path, at, node, order)
    else:
        known = fields_of(names)
        if known is None:
            raise InputError(f"{path}: {at} has {', '.join(names) or 'no fields'}, expected x, y, p and t")
        fields = known
        columns = [_Column(node[names[k]]) if is_group else _Column(node, names[k]) for k in fields.which]
    _check_columns(path, at, columns)
    return columns, fields.unit


def _check_columns(path: Path, at: str, columns: list[_Column]) -> None:
    """Refuse columns of other things than numbers, or of other lengths."""
    for number, column in enumerate(columns):
        _check(path, column.dataset)
        if column.kind not in ("biufS" if number == 1 else "biuf"):
            raise InputError(f"{path}: found {column.dataset.name}, expected a column of numbers")
    lengths = [len(column) for column in columns]
    if len(set(lengths)) > 1:
        raise InputError(f"{path}: {at} has columns of the lengths {lengths}, expected one length")


def _nameless_columns(path: Path, at: str, table: Any, order: str | None) -> tuple[list[_Column], Fields]:
    """The columns of a table without names, in an order that is given, or by what is in them."""
    _check(path, table)
    on_its_side = table.shape[0] < table.shape[1]
    parts = [_Column(table, k, on_its_side=on_its_side) for k in range(min(table.shape))]
    if order is not None:
        fields = Fields(order.index("t"), order.index("p"), (order.index("x"), order.index("y")))
        return [parts[k] for k in fields.which], fields
    found = fields_of_values([part[:_LOOKED_AT] for part in parts])
    if found is None:
        raise InputError(
            f"{path}: {at} is a table of {' x '.join(map(str, table.shape))} without names: expected to be"
            " told what its columns are, as by hdf5:PATH?columns=txyp"
        )
    return [parts[k] for k in found.which], found


def _place_of(path: Path, file: Any) -> tuple[str, Any]:
    """Where the columns are: in one of `PLACES`, or at the top, as in files of MATLAB."""
    import h5py

    for place in PLACES:
        node = file
        for part in place.split("/"):
            inside = isinstance(node, h5py.Group) and part in node
            if inside and not _is_own(node, part):
                raise InputError(f"{path}: /{place} is a link, expected it in the file itself")
            node = node[part] if inside else None
        if node is not None:
            return f"/{place}", node
    own = [name for name in file if _is_own(file, name)]
    if fields_of(own) is not None:
        return "/", file
    tables = [name for name in own if isinstance(file[name], h5py.Dataset)]
    if len(tables) == 1:
        return f"/{tables[0]}", file[tables[0]]
    raise InputError(
        f"{path}: found {', '.join(sorted(file)) or 'nothing'},"
        f" expected /{' or /'.join(PLACES)} with x, y, p and t"
    )


def _is_own(group: Any, name: str) -> bool:
    """Whether it lies in the file itself, not behind a link to another."""
    import h5py

    return isinstance(group.get(name, getlink=True), h5py.HardLink)


def _check(path: Path, dataset: Any) -> None:
    """Refuse what is not in the file, or would take more room or time than a file of its size may.

    Raises:
        InputError: Which it is.
    """
    import h5py

    is_column = (
        isinstance(dataset, h5py.Dataset) and dataset.shape is not None and 1 <= len(dataset.shape) <= 2
    )
    if not is_column:
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
    width = dataset.dtype.itemsize
    if dataset.chunks is not None and int(np.prod(dataset.chunks)) * width > _MOST_CHUNK_BYTES:
        raise InputError(
            f"{path}: {dataset.name} has chunks of {int(np.prod(dataset.chunks)) * width / 1e6:.0f} MB,"
            f" expected at most {_MOST_CHUNK_BYTES / 1e6:.0f}: h5repack makes them smaller"
        )
    if int(np.prod(dataset.shape)) * width > _MOST_RATIO * path.stat().st_size:
        raise InputError(
            f"{path}: {dataset.name} is said to have {int(np.prod(dataset.shape))} values,"
            f" more than {path.stat().st_size} bytes can hold"
        )
