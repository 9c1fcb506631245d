"""Read files of MATLAB up to version 7: arrays by their names, or a table, also inside structures."""

import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import InputError, short_message
from evlcp_sdk.io.arrays import choose_columns, split_pieces, to_upright
from evlcp_sdk.io.columns import ColumnSource, EventTable
from evlcp_sdk.io.fields import Fields
from evlcp_sdk.io.lists import open_list

_VALUE_BYTES: Final = 8
_MAX_BYTES: Final = 300_000_000


def open_mat(url: str) -> ColumnSource:
    """Open a file, or `list:PATH` with options."""
    return open_list(url, _read_file)


def _read_file(path: Path, _: ExitStack, fields: Fields | None) -> EventTable:
    arrays = _load_arrays(path)
    columns, found = choose_columns(path, list(arrays), arrays.__getitem__, fields)
    return EventTable("MAT", split_pieces(columns, path.stat().st_size), found.unit)


def _load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    from scipy.io import loadmat, whosmat

    try:
        declared = sum(math.prod(map(int, shape)) for _, shape, _ in whosmat(path)) * _VALUE_BYTES
        if declared > _MAX_BYTES:
            raise InputError(
                f"{path}: holds {declared / 1e6:.0f} MB, expected at most {_MAX_BYTES / 1e6:.0f},"
                " as they are read at once: save them as HDF5 (-v7.3)"
            )
        found = loadmat(path, simplify_cells=True)
    except InputError:
        raise
    except Exception as error:
        # A damaged file makes SciPy fail in any way.
        raise InputError(f"{path}: found no MAT file, expected one ({short_message(error)})") from error

    arrays: dict[str, NDArray[Any]] = {}

    def collect(inside: Mapping[str, Any]) -> None:
        for name, value in inside.items():
            if isinstance(value, Mapping):
                collect(value)
            elif not name.startswith("__") and isinstance(value, np.ndarray) and value.dtype.kind in "biufU":
                arrays.setdefault(name, to_upright(value))

    collect(found)
    return arrays
