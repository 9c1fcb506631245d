"""A link as commented TOML text."""

from collections.abc import Iterator, Mapping
from typing import Any

from evlcp_sdk.formatting import to_toml_value
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import ROLES
from evlcp_sdk.scene.bar import SHAPES, BarLayout
from evlcp_sdk.specs import make_model

_UNITS = ("deg_s", "us", "ms", "s", "hz", "ppm", "px", "um", "mm", "m", "deg", "chips")
"""Ends of keys' names; those of rates come before those that they end with."""


def to_toml(link: Link, registry: Registry) -> str:
    """The link as TOML, each key with meaning, unit, bounds and default; its digest stays the same."""
    return "\n".join(_make_lines(link, registry)).rstrip("\n") + "\n"


def _make_lines(link: Link, registry: Registry) -> Iterator[str]:
    yield "# EVLCP link: what transmitter and receiver agree on, and how the receiver works."
    yield f"# digest {link.digest}"
    yield f"# codebook {link.codebook.digest}"
    yield ""
    for section, values in link.table.items():
        thing = link.algorithms.get(section) or getattr(link, section)
        cls = type(thing.shape if isinstance(thing, BarLayout) else thing)
        schema = make_model(cls).model_json_schema()["properties"]
        yield f"# {(cls.__doc__ or cls.__name__).strip().splitlines()[0]}"
        yield f"[{section}]"
        if section == "camera_sigma" and thing == cls():
            yield f"# {', '.join(schema)}: by `evlcp calibrate`; default: exact"
            yield ""
            continue
        if "shape" in values:
            yield f'shape = "{values["shape"]}"  # or {", ".join(s for s in SHAPES if s != values["shape"])}'
        if section in ROLES:
            ids = dict.fromkeys(e.algorithm.id for e in registry.list_algorithms(section))
            others = [id for id in ids if id != values["id"]]
            yield f'id = "{values["id"]}"' + (f"  # or {', '.join(others)}" if others else "")
        for key, value in values.items():
            if key in schema:
                yield f"# {_describe_key(key, schema[key])}"
                yield f"# {key} =" if value is None else f"{key} = {to_toml_value(value)}"
        yield ""


def _describe_key(key: str, schema: Mapping[str, Any]) -> str:
    unit = next((unit for unit in _UNITS if key.endswith(f"_{unit}")), "")
    bounds = [
        f"{sign} {schema[name]}"
        for name, sign in (
            ("exclusiveMinimum", ">"),
            ("minimum", ">="),
            ("exclusiveMaximum", "<"),
            ("maximum", "<="),
        )
        if name in schema
    ]
    choices = [" | ".join(to_toml_value(c) for c in schema["enum"])] if "enum" in schema else []
    value = schema.get("default")
    if value is not None and schema.get("type") == "number":
        value = float(value)
    default = "none" if value is None else to_toml_value(value)
    written = {"deg_s": "deg/s", "hz": "Hz"}.get(unit, unit)
    facts = ", ".join([*([written] if unit else []), *bounds, *choices, f"default {default}"])
    text = str(schema.get("description", "")).strip()
    return f"{text} [{facts}]" if text else f"[{facts}]"
