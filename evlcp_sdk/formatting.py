"""Numbers, values and text as messages and files show them; this imports nothing slow."""

import math
from collections.abc import Callable, Mapping, Sequence


def format_count(number: int, noun: str) -> str:
    """A number of things, with separated thousands.

    >>> format_count(1, "frame"), format_count(4000, "frame")
    ('1 frame', '4,000 frames')
    """
    return f"{number:,} {noun}{'s' * (number != 1)}"


def format_or_empty(value: float, digits: int) -> str:
    """A number with so many decimals; empty for NaN and infinity."""
    return f"{value:.{digits}f}" if math.isfinite(value) else ""


def round_or_none(value: float, digits: int) -> float | None:
    """A number rounded to so many decimals; None for NaN and infinity."""
    return round(value, digits) if math.isfinite(value) else None


def value_or_none(value: object) -> object:
    """A value for JSON and CSV: None for a number that was not measured, as NaN or infinity."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def format_value(value: object) -> str:
    """A value as a message shows it, shortened where it is long."""
    text = to_toml_value(value) if isinstance(value, bool | int | float | str | list) else str(value)
    return shorten(text, 120)


def to_toml_value(value: object) -> str:
    """A value as TOML on one line, without what is None in a table."""
    import json

    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        pairs = (f"{key} = {to_toml_value(inner)}" for key, inner in value.items() if inner is not None)
        return f"{{{', '.join(pairs)}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(to_toml_value, value))}]"
    return repr(value)


def shorten(text: str, length: int) -> str:
    """The beginning of a text, with `...` where it is longer."""
    return text if len(text) <= length else f"{text[:length]}..."


def format_safely(form: Callable[[object], str], value: object) -> str:
    """A value by `str` or `repr`, or by its type where that fails: integers of 5000 digits."""
    try:
        return form(value)
    except Exception:
        return f"a {type(value).__name__} that cannot be shown"


def suggest(word: str, known: Sequence[str], kind: str = "known") -> str:
    """The end of a message about an unknown word: the nearest known one, and all of them.

    >>> suggest("hight", ["height", "width"])
    "; did you mean 'height'? (known: height, width)"
    """
    import difflib

    matches = difflib.get_close_matches(word, known, n=1)
    hint = f"; did you mean '{matches[0]}'?" if matches else ""
    return f"{hint} ({kind}: {', '.join(known) or 'none'})"


def add_check_hint(fault: str, role: str, id: str) -> str:
    """Append to an algorithm's fault the command that finds it.

    >>> add_check_hint("pilots algorithm 'mine': gave 3 codes", "pilots", "mine")
    "pilots algorithm 'mine': gave 3 codes; try: evlcp check pilots mine"
    """
    return f"{fault}; try: evlcp check {role} {id}"


_CONTROLS = {
    **{n: f"\\x{n:02x}" for n in (*range(0x20), *range(0x7F, 0xA0)) if chr(n) not in "\t\n"},
    # Marks that turn the direction of a text, and so disguise it.
    **{n: f"\\u{n:04x}" for n in (0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A))},
}


def escape_controls(text: str) -> str:
    r"""Replace control characters, but tabs and line feeds, by escapes.

    So is a lone surrogate, which stands for a byte of a file's name that is no text.

    >>> print(escape_controls("\x1b]0;mine\x07.raw"))
    \x1b]0;mine\x07.raw
    """
    return text.translate(_CONTROLS).encode("utf-8", "backslashreplace").decode("utf-8")
