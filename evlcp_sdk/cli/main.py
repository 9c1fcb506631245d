"""Entry point of the `evlcp` command line: whatever happens ends in lines on stderr and an exit code.

It imports nothing that takes time before it can be interrupted.
"""

from __future__ import annotations

import gc
import os
import sys

from evlcp_sdk.cli._complain import complain

_FAILED = 1
_INTERRUPTED = 130

_GARBAGE = 250_000
"""New objects before the collector of garbage looks for cycles: to load Numba makes 170 000, a run few."""


def main() -> None:
    """Run the command line; whatever goes wrong becomes one line per fault on stderr and its exit code."""
    code: object = 0
    # Our matrices are of a dozen rows: a thread a core only spins on them. NumPy reads it when it is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # To look for plugins of pydantic is to read what every package says of itself.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    gc.set_threshold(_GARBAGE, *gc.get_threshold()[1:])
    before = sys.unraisablehook

    def unraisable(fault: sys.UnraisableHookArgs) -> None:
        # Ctrl-C that falls into a callback, such as those of imports, Python would only report, and go on. It
        # comes again with the next call.
        if fault.exc_type is KeyboardInterrupt:
            sys.setprofile(_interrupt)
        else:
            before(fault)

    sys.unraisablehook = unraisable
    try:
        from signal import SIGHUP, SIGTERM

        from evlcp_sdk.signals import handle_signals, interrupt

        # Python itself handles Ctrl-C.
        with handle_signals(interrupt, SIGTERM, SIGHUP):
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
        code = _report_fault(fault)
    sys.unraisablehook = before
    if not _stdout_took_all() and not code:
        code = _FAILED
    # Else the interpreter's end looks for cycles in all that was imported, a tenth of a second.
    gc.freeze()
    sys.exit(code)  # type: ignore[arg-type]


def _interrupt(_frame: object, event: str, _of: object) -> None:
    """Raise, as a profiler that is told of the next call."""
    if event == "call":
        sys.setprofile(None)
        raise KeyboardInterrupt


def _report_fault(fault: BaseException) -> int:
    """Say what went wrong; the exit code."""
    from evlcp_sdk.errors import explain_fault

    # Our own files are written where their names are known, so what has none is stdout.
    if isinstance(fault, OSError) and fault.filename is None:
        complain(f"standard output: {fault.strerror or fault}")
        _drop_stdout()
        return _FAILED
    message, code = explain_fault(fault)
    complain(message)
    return code


def _stdout_took_all() -> bool:
    """Whether all that was printed has been written; says so if not, but for a reader who has left."""
    import errno

    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as fault:
        if fault.errno != errno.EPIPE:
            complain(f"standard output: {fault.strerror}")
        _drop_stdout()
        return False
    except ValueError:
        # It is closed.
        return True
    return True


def _drop_stdout() -> None:
    """Let what is not written yet go nowhere: or else it is tried again, and complained of twice."""
    from contextlib import suppress

    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
