"""TOML to checked values, with one clear line for what is wrong."""

import difflib
import json
import tomllib
from collections.abc import Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import BaseModel, ConfigDict, create_model

from evlcp_sdk.errors import ConfigError

__all__ = [
    "expected",
    "nearest",
    "parse_toml",
    "parse_value",
    "read_toml",
    "shown",
    "spec_model",
    "toml_value",
]


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


def spec_model(cls: type[Any]) -> type[BaseModel]:
    """A pydantic model of a dataclass's parameters, which stays free of pydantic itself."""
    hints = get_type_hints(cls, include_extras=True)
    parameters: dict[str, Any] = {}
    for f in fields(cls):
        if f.init:
            default = f.default if f.default is not MISSING else ...
            if f.default_factory is not MISSING:
                default = f.default_factory()
            parameters[f.name] = (hints[f.name], default)
    config = ConfigDict(
        extra="forbid", strict=True, allow_inf_nan=False, validate_default=True, protected_namespaces=()
    )
    return create_model(cls.__name__, __config__=config, **parameters)


def expected(message: str) -> str:
    """Pydantic's message in the words of this SDK."""
    return message.replace("Input should be", "expected", 1)


def shown(value: Any) -> str:
    """A value as a message shows it."""
    return toml_value(value) if isinstance(value, bool | int | float | str | list) else str(value)


def nearest(word: str, known: Sequence[str]) -> str:
    """The end of a message about an unknown word: the nearest that is known, and all that are."""
    near = difflib.get_close_matches(word, known, n=1)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    return f"{hint} (known: {', '.join(known) or 'none'})"


def toml_value(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value)
