"""TOML tables to validated values, with one clear line for each fault."""

import json
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.files import read_bytes
from evlcp_sdk.formatting import format_value, suggest

T = TypeVar("T")
Model = TypeVar("Model", bound=BaseModel)


class SpecError(ConfigError):
    """A table that does not describe a dataclass.

    Args:
        faults: The path and the rest of the message of each, e.g. `(("air", "ppm"), " = 3: unknown key")`.
    """

    def __init__(self, faults: Sequence[tuple[tuple[str, ...], str]]) -> None:
        self.faults = tuple(faults)
        lines = (f"{'.'.join(path)}{text}".lstrip() for path, text in self.faults)
        super().__init__("\n".join(lines))


def build_spec(
    cls: type[T], table: Mapping[str, Any], *, hint: Callable[[tuple[str, ...]], str | None] = lambda _: None
) -> T:
    """Build the dataclass that a table describes, and those nested in it.

    Args:
        cls: A dataclass whose fields have types that pydantic knows; the class itself stays free of pydantic.
        table: As read from TOML.
        hint: Gives the message about an unknown key at a path; None for the nearest known one.

    Raises:
        SpecError: Keys or values are wrong.
        ConfigError: The dataclass refuses a combination of values.

    >>> from evlcp_sdk.scene.camera import CameraModel
    >>> build_spec(CameraModel, {"width": 0, "hight": 3}).width
    Traceback (most recent call last):
    evlcp_sdk.specs.SpecError: width = 0: expected greater than 0
    hight = 3: unknown key; did you mean 'height'? (known: ...
    """
    values = validate_table(
        make_model(cls),
        table,
        lambda path: hint(path) or suggest(path[-1], _list_keys(cls, path[:-1])),
    )
    return cls(**{name: getattr(values, name) for name in type(values).model_fields})


def validate_table(
    model: type[Model], table: Any, unknown: Callable[[tuple[str, ...]], str] = lambda _: ""
) -> Model:
    """Validate a table by a pydantic model; `unknown` gives the message about an unknown key at a path.

    Raises:
        SpecError: Keys or values are wrong; a value that may be one of several types has one fault for all.
    """
    try:
        return model.model_validate_json(json.dumps(table, default=str))
    except ValidationError as fault:
        faults: dict[tuple[str, ...], str] = {}
        for error in fault.errors():
            path, text = _describe_error(dict(error), unknown)
            if path and _TYPE_TAG.fullmatch(path[-1]):
                path = path[:-1]
            text = f"{faults[path]} or {text.partition(': expected ')[2]}" if path in faults else text
            faults[path] = text
        raise SpecError(list(faults.items())) from fault


_TYPE_TAG = re.compile(r"str|(dict|list|tuple)\[.*\]")
"""The last part of the path that pydantic gives to a value of several possible types."""


def _describe_error(
    error: Mapping[str, Any], unknown: Callable[[tuple[str, ...]], str]
) -> tuple[tuple[str, ...], str]:
    path, kind, value = tuple(map(str, error["loc"])), error["type"], error["input"]
    if kind == "missing":
        return path, ": missing"
    rows = value if isinstance(value, list) and value else [value]
    tables = all(isinstance(row, Mapping) for row in rows)
    value_text = "" if tables else f" = {format_value(value)}"
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        return path, f"{value_text}: unknown {'table' if tables else 'key'}{unknown(path)}"
    if kind in ("dataclass_type", "model_type", "dict_type"):
        return path, f"{value_text}: expected a table"
    text = error["msg"].replace("Input should be", "expected", 1).replace("a valid array", "a list")
    return path, f"{value_text}: {re.sub(r'^[A-Z][a-z]+ should ', 'expected to ', text)}"


def _list_keys(cls: type[Any], path: Sequence[str]) -> list[str]:
    for part in path:
        if not part.isdigit():
            inner = _find_dataclass(get_type_hints(cls).get(part))
            if inner is None:
                return []
            cls = inner
    return [f.name for f in fields(cls) if f.init]


def _find_dataclass(hint: Any) -> type[Any] | None:
    """The dataclass of `Spec`, `Spec | None` or `tuple[Spec, ...]`."""
    if isinstance(hint, type) and is_dataclass(hint):
        return hint
    return next((found for inner in get_args(hint) if (found := _find_dataclass(inner)) is not None), None)


def read_toml(path: Path | str) -> dict[str, Any]:
    """The table of a TOML file.

    Raises:
        ConfigError: The file cannot be read, or is not TOML.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig").replace("\r\n", "\n")
    except InputError as fault:
        raise ConfigError(str(fault)) from fault
    except UnicodeDecodeError as fault:
        raise ConfigError(f"{path}: at byte {fault.start}: not UTF-8 text") from fault
    return parse_toml(text, str(path))


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """The table of a TOML text; messages name its `source`.

    Raises:
        ConfigError: It is not TOML.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as fault:
        raise ConfigError(f"{source}: not TOML: {fault}") from fault
    except RecursionError as fault:
        raise ConfigError(f"{source}: not TOML: nested too deep") from fault
    except ValueError as fault:
        raise ConfigError(f"{source}: not TOML: {_LONG_INTEGER}") from fault
    if _has_long_integer(table):
        raise ConfigError(f"{source}: not TOML: {_LONG_INTEGER}")
    return table


_LONG_INTEGER = "an integer beyond 64 bits"
"""TOML has none, and one of thousands of digits cannot be shown."""


def _has_long_integer(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(map(_has_long_integer, value.values()))
    if isinstance(value, list):
        return any(map(_has_long_integer, value))
    return isinstance(value, int) and not -(1 << 63) <= value < 1 << 63


def parse_value(text: str) -> Any:
    """The value of a TOML text; any other text is a string, so that a shell needs no second quotes.

    >>> parse_value("[1, 2.5]"), parse_value("joint-scale")
    ([1, 2.5], 'joint-scale')
    """
    try:
        (value,) = tomllib.loads(f"value = {text}").values()
    except (ValueError, RecursionError):
        return text.strip()
    return text.strip() if _has_long_integer(value) else value


_MODELS: dict[type[Any], type[BaseModel]] = {}
"""Cached models: making one takes as long as validating many tables."""


def make_model(cls: type[Any]) -> type[BaseModel]:
    """A pydantic model of a dataclass's parameters."""
    if cls in _MODELS:
        return _MODELS[cls]
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
    model: type[BaseModel] = create_model(cls.__name__, __config__=config, **parameters)
    return _MODELS.setdefault(cls, model)
