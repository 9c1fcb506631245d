"""Entry point of the `evlcp` command line: every fault ends in lines on stderr and an exit code.

It imports nothing slow before it can be interrupted.
"""

from __future__ import annotations

import gc
import os
import sys

from evlcp_sdk.cli._stderr import print_stderr

_FAILED = 1
_INTERRUPTED = 130

_GARBAGE_THRESHOLD = 250_000
"""New objects before the garbage collector looks for cycles: loading Numba makes 170 000, a run few."""


def main() -> None:
    """Run the command line; every fault becomes a line on stderr and an exit code."""
    code: object = 0
    # Matrices have a dozen rows, too few for threads. NumPy reads it when it is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # The search for plugins of pydantic reads the metadata of every package.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    gc.set_threshold(_GARBAGE_THRESHOLD, *gc.get_threshold()[1:])
    previous_hook = sys.unraisablehook

    def unraisable(fault: sys.UnraisableHookArgs) -> None:
        # Python only reports a Ctrl-C that falls into a callback, such as those of imports. It is raised
        # again at the next call.
        if fault.exc_type is KeyboardInterrupt:
            sys.setprofile(_interrupt_next_call)
        else:
            previous_hook(fault)

    sys.unraisablehook = unraisable
    try:
        from signal import SIGHUP, SIGTERM, default_int_handler

        from evlcp_sdk.signals import handle_signals

        # Python itself handles Ctrl-C; these do the same.
        with handle_signals(default_int_handler, SIGTERM, SIGHUP):
            from evlcp_sdk.cli._app import run

            run()
    except SystemExit as end:
        code = end.code
        if code == _INTERRUPTED:
            print_stderr("interrupted")
    except KeyboardInterrupt:
        code = _INTERRUPTED
        print_stderr("interrupted")
    except BaseException as fault:
        code = _report_fault(fault)
    sys.unraisablehook = previous_hook
    if not _flush_stdout() and not code:
        code = _FAILED
    # Or else the interpreter looks for cycles in all imports at its end, a tenth of a second.
    gc.freeze()
    sys.exit(code)  # type: ignore[arg-type]


def _interrupt_next_call(_frame: object, event: str, _of: object) -> None:
    """Raise KeyboardInterrupt, as a profiler at the next call."""
    if event == "call":
        sys.setprofile(None)
        raise KeyboardInterrupt


def _report_fault(fault: BaseException) -> int:
    from evlcp_sdk.errors import explain_fault

    # Only stdout has no name here.
    if isinstance(fault, OSError) and fault.filename is None:
        print_stderr(f"standard output: {fault.strerror or fault}")
        _drop_stdout()
        return _FAILED
    message, code = explain_fault(fault)
    print_stderr(message)
    return code


def _flush_stdout() -> bool:
    """Write the rest of stdout; whether that worked. A fault is reported, unless the reader has left."""
    import errno

    if sys.stdout is None:
        print_stderr("standard output: it is closed")
        return False
    try:
        sys.stdout.flush()
    except OSError as fault:
        if fault.errno != errno.EPIPE:
            print_stderr(f"standard output: {fault.strerror}")
        _drop_stdout()
        return False
    except ValueError:
        pass  # It is closed.
    return True


def _drop_stdout() -> None:
    """Discard what is not written yet, or else it is tried again, and reported twice."""
    from contextlib import suppress

    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
