"""Files written whole: no reader ever sees half a result."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from evlcp_sdk.errors import EvlcpError

__all__ = ["hidden_path", "whole_file", "write_text"]


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
