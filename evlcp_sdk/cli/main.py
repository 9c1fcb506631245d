"""Entry point of the `evlcp` command line: whatever happens ends in lines on stderr and an exit code.

It imports nothing that takes time before it can be interrupted.
"""

import sys

from evlcp_sdk.cli._complain import complain

__all__ = ["INTERNAL", "main"]

INTERNAL = 70
"""Exit code of a fault that is the SDK's own."""

_FAILED = 1
_INTERRUPTED = 130
_MOST_PLACES = 12


def main() -> None:
    """Run the command line; whatever goes wrong becomes one line per fault on stderr and its exit code."""
    code: object = 0
    try:
        from signal import SIGHUP, SIGTERM

        from evlcp_sdk.signals import heard_by, interrupt

        # Python itself hears Ctrl-C.
        with heard_by(interrupt, SIGTERM, SIGHUP):
            from evlcp_sdk.cli._app import run

            run()
    except SystemExit as end:
        code = end.code
        if code == _INTERRUPTED:
            complain("interrupted")
    except KeyboardInterrupt:
        code = _INTERRUPTED
        complain("interrupted")
    except BaseException as fault:
        code = _told(fault)
    if not _stdout_took_all() and not code:
        code = _FAILED
    sys.exit(code)  # type: ignore[arg-type]


def _told(fault: BaseException) -> int:
    """Say what went wrong; the exit code."""
    from evlcp_sdk.errors import EvlcpError

    if isinstance(fault, EvlcpError):
        complain(str(fault))
        return fault.exit_code
    if isinstance(fault, MemoryError):
        complain(f"not enough memory: {_first_line(fault)}")
        return _FAILED
    if isinstance(fault, OSError):
        # Our own files are written where their names are known, so what has none is stdout.
        complain(f"{fault.filename or 'standard output'}: {fault.strerror or _first_line(fault)}")
        return _FAILED
    complain(_report(fault))
    return INTERNAL


def _stdout_took_all() -> bool:
    """Whether all that was printed has been written; says so if not, but for a reader who has left."""
    import errno
    import os
    from contextlib import suppress

    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as fault:
        if fault.errno != errno.EPIPE:
            complain(f"standard output: {fault.strerror}")
        # Or else the interpreter tries once more as it ends, and complains in its own words.
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    except ValueError:
        # It is closed.
        return True
    return True


def _first_line(fault: BaseException) -> str:
    text = " ".join(str(fault).split())
    return text if len(text) <= 200 else f"{text[:200]}..."


def _report(fault: BaseException) -> str:
    """What a fault of ours is told with: what happened, where, and with which versions."""
    import platform
    import traceback
    from importlib.metadata import version
    from pathlib import Path

    def place(frame: traceback.FrameSummary) -> str:
        return f"{'/'.join(Path(frame.filename).parts[-2:])}:{frame.lineno}"

    frames = traceback.extract_tb(fault.__traceback__)[-_MOST_PLACES:]
    return (
        f"a fault of evlcp itself, not of what you gave: {type(fault).__name__}: {_first_line(fault)}\n"
        "please report the command, what it was given, and this:"
        f" evlcp-sdk {version('evlcp-sdk')}, Python {platform.python_version()}, {platform.platform()};"
        f" at {' > '.join(map(place, frames))}"
    )
