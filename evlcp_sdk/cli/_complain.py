"""Faults on stderr; imports nothing that takes time, so that it works before anything else does."""

import sys
from contextlib import suppress

__all__ = ["complain"]

_CONTROLS = {n: f"\\x{n:02x}" for n in (*range(0x20), *range(0x7F, 0xA0)) if n != 0x09}
"""A name from outside moves no cursor and sets no title."""


def complain(text: str) -> None:
    """Print one line per fault on stderr; without a stderr, nothing."""
    lines = (f"evlcp: {line.translate(_CONTROLS)}\n" for line in text.split("\n") if line.strip())
    # A lone surrogate stands for a byte of a file's name that is no text.
    said = "".join(lines).encode("utf-8", "backslashreplace").decode("utf-8")
    if sys.stderr is not None:
        with suppress(OSError, ValueError):
            sys.stderr.write(said)
            sys.stderr.flush()
