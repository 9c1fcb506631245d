"""Options behind the `?` of a source's name.

The parser of a value raises a ValueError that says what it expects.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any
from urllib.parse import parse_qsl

from evlcp_sdk.errors import InputError
from evlcp_sdk.formatting import suggest
from evlcp_sdk.io.evt import MAX_SIDE


def split_options(url: str, parsers: Mapping[str, Callable[[str], Any]]) -> tuple[str, dict[str, Any]]:
    """Split a name at its last `?`; return the part before it, and the options as their parsers return them.

    Raises:
        InputError: An option is unknown, given twice, or has another value than expected.

    >>> split_options("replay:REC.raw?speed=2", {"speed": parse_positive})
    ('replay:REC.raw', {'speed': 2.0})
    """
    name, mark, query = url.rpartition("?")
    if not mark:
        return url, {}
    values: dict[str, Any] = {}
    for key, text in parse_qsl(query, keep_blank_values=True) or [(query, "")]:
        if key not in parsers:
            raise InputError(f"{url}: option {key!r}{suggest(key, list(parsers))}")
        if key in values:
            raise InputError(f"{url}: option {key!r} is given twice")
        try:
            values[key] = parsers[key](text)
        except ValueError as fault:
            raise InputError(f"{url}: {key} = {text!r}: expected {fault}") from fault
    return name, values


def parse_positive(text: str) -> float:
    """Parse a number above 0."""
    with suppress(ValueError):
        if 0 < float(text) < 1e9:
            return float(text)
    raise ValueError("a number above 0")


def parse_flag(text: str) -> bool:
    """Parse 0 or 1."""
    if text not in ("0", "1"):
        raise ValueError("0 or 1")
    return text == "1"


def parse_size(text: str) -> tuple[int, int]:
    """Parse the columns and rows of a sensor.

    >>> parse_size("1280x720")
    (1280, 720)
    """
    sides = [int(side) for side in text.split("x") if side.isascii() and side.isdigit()]
    if len(sides) != 2 or text.count("x") != 1 or not all(1 <= side <= MAX_SIDE for side in sides):
        raise ValueError(f"WIDTHxHEIGHT, each from 1 to {MAX_SIDE}")
    return sides[0], sides[1]
