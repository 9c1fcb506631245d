"""What to say of a word that is not known."""

import difflib
from collections.abc import Sequence

__all__ = ["nearest"]


def nearest(word: str, known: Sequence[str], kind: str = "known") -> str:
    """The end of a message about an unknown word: the nearest that is known, and all that are.

    >>> nearest("hight", ["height", "width"])
    "; did you mean 'height'? (known: height, width)"
    """
    near = difflib.get_close_matches(word, known, n=1)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    return f"{hint} ({kind}: {', '.join(known) or 'none'})"
