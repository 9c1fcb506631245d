"""TOML to checked values, with one clear line for what is wrong."""

import json
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.files import read_whole
from evlcp_sdk.suggestions import nearest

T = TypeVar("T")
Model = TypeVar("Model", bound=BaseModel)


class SpecError(ConfigError):
    """A table that does not describe a dataclass.

    Args:
        faults: (path, what follows it in a message) of each, e.g. `(("air", "ppm"), " = 3: unknown key")`.
    """

    def __init__(self, faults: Sequence[tuple[tuple[str, ...], str]]) -> None:
        self.faults = tuple(faults)
        super().__init__("\n".join(self.lines()))

    def lines(self, before: str = "") -> list[str]:
        """One line per fault, with `before` in front of each path."""
        return [f"{before}{'.'.join(path)}{text}" for path, text in self.faults]


def build(
    cls: type[T], table: Mapping[str, Any], *, hint: Callable[[tuple[str, ...]], str | None] = lambda _: None
) -> T:
    """The dataclass that a table describes, with those nested in it.

    Args:
        cls: A dataclass whose fields have types that pydantic knows; the class itself stays free of pydantic.
        table: As read from TOML.
        hint: What to say of the unknown key at a path; None for the nearest that is known.

    Raises:
        SpecError: Keys or values are wrong.
        ConfigError: The dataclass itself refuses values that are right each by itself.

    >>> from evlcp_sdk.scene.camera import CameraModel
    >>> build(CameraModel, {"width": 0, "hight": 3}).width
    Traceback (most recent call last):
    evlcp_sdk.specs.SpecError: width = 0: expected greater than 0
    hight = 3: unknown key; did you mean 'height'? (known: ...
    """
    values = checked(
        spec_model(cls), table, lambda path: hint(path) or nearest(path[-1], _known_keys(cls, path[:-1]))
    )
    return cls(**{name: getattr(values, name) for name in type(values).model_fields})


def checked(
    model: type[Model], table: Any, unknown: Callable[[tuple[str, ...]], str] = lambda _: ""
) -> Model:
    """The values of a table by a model of pydantic; `unknown` is what to say of an unknown key at a path.

    Raises:
        SpecError: Keys or values are wrong; of a value that may be one of several types, one fault for all.
    """
    try:
        return model.model_validate_json(json.dumps(table, default=str))
    except ValidationError as refused:
        found: dict[tuple[str, ...], str] = {}
        for error in refused.errors():
            path, text = _fault(dict(error), unknown)
            if path and _TYPE_TAG.fullmatch(path[-1]):
                path = path[:-1]
            text = f"{found[path]} or {text.partition(': expected ')[2]}" if path in found else text
            found[path] = text
        raise SpecError(list(found.items())) from refused


_TYPE_TAG = re.compile(r"str|(dict|list|tuple)\[.*\]")
"""What pydantic puts behind the path of a value that may be one of several types."""


def _fault(
    error: Mapping[str, Any], unknown: Callable[[tuple[str, ...]], str]
) -> tuple[tuple[str, ...], str]:
    path, kind, value = tuple(map(str, error["loc"])), error["type"], error["input"]
    if kind == "missing":
        return path, ": missing"
    rows = value if isinstance(value, list) and value else [value]
    tables = all(isinstance(row, Mapping) for row in rows)
    given = "" if tables else f" = {shown(value)}"
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        return path, f"{given}: unknown {'table' if tables else 'key'}{unknown(path)}"
    if kind in ("dataclass_type", "model_type", "dict_type"):
        return path, f"{given}: expected a table"
    text = error["msg"].replace("Input should be", "expected", 1).replace("a valid array", "a list")
    return path, f"{given}: {re.sub(r'^[A-Z][a-z]+ should ', 'expected to ', text)}"


def _known_keys(cls: type[Any], path: Sequence[str]) -> list[str]:
    """The keys of the dataclass that stands at a path within another."""
    for part in path:
        if not part.isdigit():
            inner = _dataclass_in(get_type_hints(cls).get(part))
            if inner is None:
                return []
            cls = inner
    return [f.name for f in fields(cls) if f.init]


def _dataclass_in(hint: Any) -> type[Any] | None:
    """The dataclass of `Spec`, `Spec | None` or `tuple[Spec, ...]`."""
    if isinstance(hint, type) and is_dataclass(hint):
        return hint
    return next((found for inner in get_args(hint) if (found := _dataclass_in(inner)) is not None), None)


def read_toml(path: Path | str) -> dict[str, Any]:
    """The table of a TOML file.

    Raises:
        ConfigError: The file cannot be read, or is not TOML.
    """
    try:
        text = read_whole(path).decode().replace("\r\n", "\n")
    except InputError as fault:
        raise ConfigError(str(fault)) from fault
    except UnicodeDecodeError as fault:
        raise ConfigError(f"{path}: at byte {fault.start}: not UTF-8 text") from fault
    return parse_toml(text, str(path))


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """The table of a TOML text; `source` says in the message where it comes from.

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
        raise ConfigError(f"{source}: not TOML: {_LONG}") from fault
    if _has_long(table):
        raise ConfigError(f"{source}: not TOML: {_LONG}")
    return table


_LONG = "an integer beyond 64 bits"


def _has_long(value: Any) -> bool:
    """Whether an integer is in it that TOML does not know; one of thousands of digits cannot be shown."""
    if isinstance(value, Mapping):
        return any(map(_has_long, value.values()))
    if isinstance(value, list):
        return any(map(_has_long, value))
    return isinstance(value, int) and not -(1 << 63) <= value < 1 << 63


def parse_value(text: str) -> Any:
    """A TOML value; any other text is a string, so that a shell needs no second quotes.

    >>> parse_value("[1, 2.5]"), parse_value("joint-scale")
    ([1, 2.5], 'joint-scale')
    """
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text.strip()
    return text.strip() if _has_long(value) else value


_MODELS: dict[type[Any], type[BaseModel]] = {}
"""The models made so far: making one takes as long as checking many tables."""


def spec_model(cls: type[Any]) -> type[BaseModel]:
    """A pydantic model of a dataclass's parameters, which stays free of pydantic itself."""
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


_MOST_SHOWN = 120


def shown(value: Any) -> str:
    """A value as a message shows it, its start only where it is long."""
    text = toml_value(value) if isinstance(value, bool | int | float | str | list) else str(value)
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."


def toml_value(value: Any) -> str:
    """A value as TOML, on one line; what is None in a table is left out."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        pairs = (f"{key} = {toml_value(inner)}" for key, inner in value.items() if inner is not None)
        return f"{{{', '.join(pairs)}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value)
