"""HDF5 files in plain layout: x, y, p and t under `/events`, `/raw_events` or `/CD/events`."""

from pathlib import Path
from typing import Any, Final

import numpy as np

from evlcp_sdk.errors import InputError
from evlcp_sdk.io._sieve import Sieve
from evlcp_sdk.io.urls import flag, split_options
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.values import Events, Triggers

__all__ = ["Hdf5Source", "open_hdf5"]

PLACES: Final = ("events", "raw_events", "CD/events")
MAGIC: Final = b"\x89HDF\r\n\x1a\n"

_ECF: Final = 36559
"""Number of the filter of Prophesee's codec, which no package with a permissive licence reads."""

_NAMES: Final = {
    "t": ("t", "ts", "timestamp"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "polarity"),
}


def open_hdf5(url: str) -> "Hdf5Source":
    """Open `hdf5:PATH`, with `?columns=txyp` for a table without names, and `swapped=1` where x is the row.

    Raises:
        InputError: As for `Hdf5Source`, or an option is wrong.
    """
    name, options = split_options(url, {"columns": _order, "swapped": flag})
    return Hdf5Source(
        name.partition(":")[2], columns=options.get("columns"), swapped=options.get("swapped", False)
    )


def _order(text: str) -> str:
    if sorted(text) != sorted(_NAMES):
        raise ValueError("the letters t, x, y and p in the order of the table's columns, such as txyp")
    return text


class Hdf5Source(EventSource):
    """An HDF5 file by `h5py`: records with fields x, y, p and t, or a group of four columns; times in us.

    Args:
        path: The file.
        columns: Of a table without names, (n, 4) or (4, n), what its columns, or rows, are, e.g. `txyp`.
        swapped: x is the row and y the column.

    Raises:
        InputError: `h5py` is not installed, the file has no such layout, or is compressed by ECF.
    """

    def __init__(self, path: Path | str, *, columns: str | None = None, swapped: bool = False) -> None:
        target = Path(path)
        try:
            import h5py
        except ImportError as fault:
            raise InputError(f"{path}: needs the extra: pip install 'evlcp-sdk[hdf5]'") from fault
        try:
            self._file = h5py.File(target, "r")
        except OSError as fault:
            raise InputError(f"{path}: found no HDF5 file, expected one ({fault})") from fault
        try:
            self._columns = _columns_of(target, self._file, columns)
            if swapped:
                self._columns |= {"x": self._columns["y"], "y": self._columns["x"]}
            size = [self._file.attrs.get(name) for name in ("width", "height")]
            width, height = (int(side) if side is not None else None for side in size)
        except BaseException:
            self._file.close()
            raise
        self._sieve = Sieve("row", width, height)
        super().__init__(target, "HDF5", width, height, None, target.stat().st_size, self._sieve)
        self._rows = min(len(column) for column in self._columns.values())
        self._row = 0

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """As `EventSource.take`.

        Raises:
            InputError: The file cannot be read on.
        """
        first, last = self._row, min(self._row + max_events, self._rows)
        if first == last:
            rest = self._sieve.close()
            return (rest, Triggers.empty()) if len(rest) else None
        self._row = last
        try:
            t, x, y, p = (np.asarray(self._columns[name][first:last]) for name in ("t", "x", "y", "p"))
        except OSError as fault:
            raise InputError(f"{self.path}: row {first + 1}: {fault}") from fault
        # Polarities are 0 and 1, or -1 and 1, or false and true.
        on = (p.astype(np.int64) > 0).astype(np.uint8)
        return self._sieve.sift(Events.of(t, x, y, on), first + 1), Triggers.empty()

    @property
    def position_bytes(self) -> int:
        """How much of the file is read."""
        return round((self.size_bytes or 0) * (self._row / self._rows if self._rows else 1))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class _Part:
    """One column of a table without names, or one row of it where it lies on its side."""

    def __init__(self, dataset: Any, place: int, *, on_its_side: bool) -> None:
        self._dataset, self._place, self._on_its_side = dataset, place, on_its_side

    def __len__(self) -> int:
        return int(self._dataset.shape[1 if self._on_its_side else 0])

    def __getitem__(self, rows: slice) -> Any:
        return self._dataset[self._place, rows] if self._on_its_side else self._dataset[rows, self._place]


class _Field:
    """One field of a dataset of records, read as a column."""

    def __init__(self, dataset: Any, name: str) -> None:
        self._dataset, self._name = dataset, name

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, rows: slice) -> Any:
        return self._dataset[rows][self._name]


def _columns_of(path: Path, file: Any, order: str | None) -> dict[str, Any]:
    place = next((place for place in PLACES if place in file), None)
    if place is None:
        found = ", ".join(sorted(file)) or "nothing"
        raise InputError(f"{path}: found {found}, expected /{' or /'.join(PLACES)} with x, y, p and t")
    node = file[place]
    is_group = hasattr(node, "keys")
    names = list(node) if is_group else list(node.dtype.names or ())
    nameless = not names and not is_group and len(node.shape) == 2 and 4 in node.shape
    if nameless and order is None:
        raise InputError(
            f"{path}: /{place} is a table of {' x '.join(map(str, node.shape))} without names: expected to be"
            " told what its columns are, as by hdf5:PATH?columns=txyp"
        )
    if order is not None and not nameless:
        raise InputError(
            f"{path}: /{place} has {', '.join(names) or 'no fields'}: columns = {order!r} is for tables"
            " without names"
        )
    columns: dict[str, Any] = {}
    for column, spellings in _NAMES.items():
        if nameless and order is not None:
            columns[column] = _Part(node, order.index(column), on_its_side=node.shape[1] != 4)
            continue
        name = next((name for name in spellings if name in names), None)
        if name is None:
            raise InputError(
                f"{path}: /{place} has {', '.join(names) or 'no fields'}, expected x, y, p and t"
            )
        columns[column] = node[name] if is_group else _Field(node, name)
    for dataset in [columns[name] for name in columns] if is_group else [node]:
        plist = dataset.id.get_create_plist()
        if any(plist.get_filter(n)[0] == _ECF for n in range(plist.get_nfilters())):
            raise InputError(
                f"{path}: /{place} is compressed by ECF, Prophesee's own codec, which is not read here:"
                " convert it to RAW by metavision_file_to_raw, or write it without compression"
            )
    return columns
