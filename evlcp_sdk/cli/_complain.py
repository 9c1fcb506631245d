"""Faults on stderr; imports nothing that takes time, so that it works before anything else does."""

import sys
from contextlib import suppress

from evlcp_sdk.printable import escape_controls


def complain(text: str) -> None:
    """Print one line per fault on stderr; without a stderr, nothing."""
    said = "".join(f"evlcp: {line}\n" for line in escape_controls(text).split("\n") if line.strip())
    if sys.stderr is not None:
        with suppress(OSError, ValueError):
            sys.stderr.write(said)
            sys.stderr.flush()
