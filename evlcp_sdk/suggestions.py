"""How messages speak of what is not known, and of how many."""

import difflib
from collections.abc import Sequence


def counted(number: int, what: str) -> str:
    """A number of things, with thousands apart.

    >>> counted(1, "frame"), counted(4000, "frame")
    ('1 frame', '4,000 frames')
    """
    return f"{number:,} {what}{'s' * (number != 1)}"


def nearest(word: str, known: Sequence[str], kind: str = "known") -> str:
    """The end of a message about an unknown word: the nearest that is known, and all that are.

    >>> nearest("hight", ["height", "width"])
    "; did you mean 'height'? (known: height, width)"
    """
    near = difflib.get_close_matches(word, known, n=1)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    return f"{hint} ({kind}: {', '.join(known) or 'none'})"


def hinted(what: str, role: str, id: str) -> str:
    """A fault of an algorithm, and the command that finds it.

    >>> hinted("pilots algorithm 'mine': gave 3 codes", "pilots", "mine")
    "pilots algorithm 'mine': gave 3 codes; try: evlcp check pilots mine"
    """
    return f"{what}; try: evlcp check {role} {id}"
