"""Files written whole, so that no reader ever sees half a result; small ones read whole."""

import csv
import errno
import io
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evlcp_sdk.errors import EvlcpError, InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["hidden_path", "read_csv", "read_json", "read_numbers", "read_whole", "whole_file", "write_text"]


def hidden_path(folder: Path, name: str) -> Path:
    """Where a file is written until it is whole."""
    return folder / f".{name}.{os.getpid()}.part"


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a hidden path to write to, which becomes `path` in the end; an earlier file stays until then.

    Raises:
        EvlcpError: The file cannot be written.
    """
    part = hidden_path(path.parent, path.name)
    try:
        yield part
        part.replace(path)
    except OSError as fault:
        raise EvlcpError(f"{path}: cannot be written: {fault.strerror}") from fault
    finally:
        part.unlink(missing_ok=True)


def write_text(text: str, path: Path) -> None:
    """Write a text file that is never there by half.

    Raises:
        EvlcpError: The file cannot be written.
    """
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


def read_csv(path: Path | str) -> tuple[tuple[str, ...], list[tuple[int, dict[str, Any]]]]:
    """The columns of a CSV file, and its rows of text by column, each with its line; empty lines give no row.

    Raises:
        InputError: The file cannot be read, or is not CSV.
    """
    try:
        # Spreadsheets start a file with a byte order mark.
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            rows = [(reader.line_num, row) for row in reader]
            return tuple(reader.fieldnames or ()), rows
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror}") from fault
    except (UnicodeDecodeError, csv.Error) as fault:
        raise InputError(f"{path}: not a CSV file: {fault}") from fault


MOST_BYTES = 1 << 28
"""Files of more bytes are not read whole."""


def read_whole(path: Path | str) -> bytes:
    """The bytes of a file.

    Raises:
        OSError: It cannot be read, or is too large to be read whole, as a device without end.
    """
    with Path(path).open("rb") as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise OSError(errno.EFBIG, f"larger than {MOST_BYTES >> 20} MiB")
    return data


def read_numbers(path: Path | str) -> "NDArray[Any]":
    """The array of numbers that a `.npy` file holds.

    Raises:
        InputError: The file cannot be read, or holds something else.
    """
    import numpy as np

    try:
        array = np.load(io.BytesIO(read_whole(path)), allow_pickle=False)
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror or fault}") from fault
    except Exception as fault:
        # NumPy evaluates the header as a piece of Python, which may fail in any way.
        said = " ".join(str(fault).split())
        raise InputError(f"{path}: not a .npy file of plain numbers: {said:.200}") from fault
    if not isinstance(array, np.ndarray):
        raise InputError(f"{path}: not a .npy file of plain numbers, but an archive of several")
    if array.dtype.kind not in "biuf":
        raise InputError(f"{path}: not a .npy file of plain numbers, but of {array.dtype}")
    return array


def read_json(path: Path | str) -> Any:
    """What a JSON file holds.

    Raises:
        InputError: The file cannot be read, or is not JSON.
    """
    try:
        return json.loads(read_whole(path))
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror}") from fault
    except (ValueError, RecursionError) as fault:
        raise InputError(f"{path}: not JSON: {fault}") from fault
