"""Files read and written whole: TOML with one clear line for what is wrong, and no half-written results."""

import os
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from evlcp_sdk.errors import ConfigError, EvlcpError

__all__ = ["hidden_path", "parse_toml", "parse_value", "read_toml", "whole_file", "write_text"]


def read_toml(path: Path | str) -> dict[str, Any]:
    """The table of a TOML file.

    Raises:
        ConfigError: The file cannot be read, or is no TOML.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as fault:
        raise ConfigError(f"{path}: cannot be read: {fault.strerror}") from fault
    except UnicodeDecodeError as fault:
        raise ConfigError(f"{path}: at byte {fault.start}: not UTF-8 text") from fault
    return parse_toml(text, str(path))


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """The table of a TOML text; `source` says in the message where it comes from.

    Raises:
        ConfigError: It is no TOML.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as fault:
        raise ConfigError(f"{source}: not TOML: {fault}") from fault
    except RecursionError as fault:
        raise ConfigError(f"{source}: not TOML: nested too deep") from fault


def parse_value(text: str) -> Any:
    """A TOML value; what is none is a string, so that a shell needs no second quotes.

    >>> parse_value("[1, 2.5]"), parse_value("joint-scale")
    ([1, 2.5], 'joint-scale')
    """
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        return text.strip()


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
