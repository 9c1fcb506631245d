"""What stands behind the `?` of a source's name, checked.

What makes a value of a text raises ValueError with what it expects.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any
from urllib.parse import parse_qsl

from evlcp_sdk.errors import InputError
from evlcp_sdk.io.evt import MAX_SIDE
from evlcp_sdk.suggestions import nearest


def split_options(url: str, kinds: Mapping[str, Callable[[str], Any]]) -> tuple[str, dict[str, Any]]:
    """Return what stands before the last `?` of a name, and the options behind it.

    Args:
        url: The name.
        kinds: What makes the value of each option.

    Raises:
        InputError: An option is not known, given twice, or its value is not as expected.

    >>> split_options("replay:REC.raw?speed=2", {"speed": positive})
    ('replay:REC.raw', {'speed': 2.0})
    """
    name, mark, query = url.rpartition("?")
    if not mark:
        return url, {}
    values: dict[str, Any] = {}
    for key, text in parse_qsl(query, keep_blank_values=True) or [(query, "")]:
        if key not in kinds:
            raise InputError(f"{url}: option {key!r}{nearest(key, list(kinds))}")
        if key in values:
            raise InputError(f"{url}: option {key!r} is given twice")
        try:
            values[key] = kinds[key](text)
        except ValueError as fault:
            raise InputError(f"{url}: {key} = {text!r}: expected {fault}") from fault
    return name, values


def positive(text: str) -> float:
    """A number above 0."""
    with suppress(ValueError):
        if 0 < float(text) < 1e9:
            return float(text)
    raise ValueError("a number above 0")


def flag(text: str) -> bool:
    """0 or 1."""
    if text not in ("0", "1"):
        raise ValueError("0 or 1")
    return text == "1"


def sides(text: str) -> tuple[int, int]:
    """Columns and rows of a sensor.

    >>> sides("1280x720")
    (1280, 720)
    """
    found = [int(side) for side in text.split("x") if side.isascii() and side.isdigit()]
    if len(found) != 2 or text.count("x") != 1 or not all(1 <= side <= MAX_SIDE for side in found):
        raise ValueError(f"WIDTHxHEIGHT, each from 1 to {MAX_SIDE}")
    return found[0], found[1]
