"""Files written whole, so that no reader ever sees half a result; small ones read whole."""

import csv
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from evlcp_sdk.errors import EvlcpError, InputError

__all__ = ["hidden_path", "read_csv", "read_json", "whole_file", "write_text"]


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


def read_json(path: Path | str) -> Any:
    """What a JSON file holds.

    Raises:
        InputError: The file cannot be read, or is not JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror}") from fault
    except (ValueError, RecursionError) as fault:
        raise InputError(f"{path}: not JSON: {fault}") from fault
