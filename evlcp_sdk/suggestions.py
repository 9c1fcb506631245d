"""Parts of messages: counts, the nearest known word, the command that finds a fault."""

import difflib
from collections.abc import Sequence


def format_count(number: int, noun: str) -> str:
    """A number of things, with separated thousands.

    >>> format_count(1, "frame"), format_count(4000, "frame")
    ('1 frame', '4,000 frames')
    """
    return f"{number:,} {noun}{'s' * (number != 1)}"


def suggest(word: str, known: Sequence[str], kind: str = "known") -> str:
    """The end of a message about an unknown word: the nearest known one, and all of them.

    >>> suggest("hight", ["height", "width"])
    "; did you mean 'height'? (known: height, width)"
    """
    matches = difflib.get_close_matches(word, known, n=1)
    hint = f"; did you mean '{matches[0]}'?" if matches else ""
    return f"{hint} ({kind}: {', '.join(known) or 'none'})"


def add_check_hint(fault: str, role: str, id: str) -> str:
    """Append to an algorithm's fault the command that finds it.

    >>> add_check_hint("pilots algorithm 'mine': gave 3 codes", "pilots", "mine")
    "pilots algorithm 'mine': gave 3 codes; try: evlcp check pilots mine"
    """
    return f"{fault}; try: evlcp check {role} {id}"
