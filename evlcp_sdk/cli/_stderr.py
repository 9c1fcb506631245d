"""Messages on stderr; imports nothing slow, so that it works before anything else does."""

import sys
from contextlib import suppress

from evlcp_sdk.formatting import escape_controls


def print_stderr(text: str) -> None:
    """Print each line with the program's name on stderr, if there is one."""
    lines = "".join(f"evlcp: {line}\n" for line in escape_controls(text).split("\n") if line.strip())
    if sys.stderr is not None:
        with suppress(OSError, ValueError):
            sys.stderr.write(lines)
            sys.stderr.flush()
