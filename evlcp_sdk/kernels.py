"""What every kernel is compiled with: numba, its cache where there can be one, and a process to compile in.

LLVM keeps most of what it took to compile, some 300 MB for all kernels of the receiver. A kernel that goes
into the cache is therefore compiled by a child, which ends when it has grown, and loaded from there.
"""

import gc
import importlib
import logging
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numba
from numba.core.caching import FunctionCache
from numba.core.event import Event, Listener, register, trigger_event
from numba.core.sigutils import normalize_signature

from evlcp_sdk.signals import ENDING

__all__ = ["njit"]

F = TypeVar("F", bound=Callable[..., Any])

_GROWN_MB = 200
"""How much a child may grow before another takes its place, which compiles some helpers once more."""

_LONG_S = 2.0
"""Time spent on compiling after which that is said."""

_IDLE_S = 5.0
"""How long a child waits for another kernel."""


def njit(*, cache: bool = False, **options: Any) -> Callable[[F], F]:
    """As `numba.njit`, but a cache that cannot be written or read does not matter.

    Where the package is installed read-only and there is no home, or on a full disk, kernels are compiled in
    each process. Where they can be kept, a child of it compiles them, unless it has threads.
    """

    def compile_(function: F) -> F:
        kernel = numba.njit(**options)(function)
        # numba says so by a RuntimeError where it finds no folder.
        with suppress(RuntimeError, OSError):
            if cache:
                kernel._cache = _Cache(function)
        compiled: F = kernel
        return compiled

    return compile_


class _Cache(FunctionCache):
    """A cache whose files may be refused at any time, and that has kernels compiled that are not in it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._place = (function.__module__, function.__qualname__)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kernel for a signature; None where it is to be compiled here."""
        found = self._kept(sig, target_context)
        if found is None and self._enabled and _COMPILER.is_ready():
            with trigger_event("numba:compile"):
                compiled = _COMPILER.compile(*self._place, sig)
            found = self._kept(sig, target_context) if compiled else None
        return found

    def _kept(self, sig: Any, target_context: Any) -> Any:
        """What the cache has for a signature.

        Two processes that keep a kernel at the same time may take the same file for two signatures.
        """
        found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        wanted, _ = normalize_signature(sig)  # type: ignore[no-untyped-call]
        return None if found is None or tuple(found.signature.args) != tuple(wanted) else found

    @contextmanager
    def _guard_against_spurious_io_errors(self) -> Iterator[None]:
        with suppress(OSError):
            yield


class _Patience(Listener):
    """Says once in a process, to the log, that kernels are being compiled, when that takes long."""

    def __init__(self) -> None:
        self._spent_s = self._began_s = 0.0
        self._depth = 0
        self._told = False

    def on_start(self, event: Event) -> None:
        """A kernel begins, which may need others."""
        if not self._depth:
            self._began_s = time.perf_counter()
            self._tell()
        self._depth += 1

    def on_end(self, event: Event) -> None:
        """It ends."""
        self._depth -= 1
        if not self._depth:
            self._spent_s += time.perf_counter() - self._began_s
            self._tell()

    def _tell(self) -> None:
        if self._spent_s > _LONG_S and not self._told:
            self._told = True
            logging.getLogger(__name__).info("compiling kernels, once on a machine; half a minute in all")


class _Compiler:
    """A child that puts kernels into the cache; forked when there is one to compile, and gone soon after."""

    def __init__(self) -> None:
        self._child = 0
        self._pipe: Connection | None = None
        self._home = os.getpid()

    def is_ready(self) -> bool:
        """Whether there may be a child: without other threads, nobody else holds a lock that it needs."""
        return sys.platform == "linux" and os.getpid() == self._home and threading.active_count() == 1

    def compile(self, module: str, name: str, sig: Any) -> bool:
        """Have a kernel compiled and kept; whether that was tried."""
        # A child that has grown or waited too long is gone.
        for _ in range(2):
            try:
                if self._pipe is None:
                    self._fork()
                assert self._pipe is not None
                self._pipe.send((module, name, sig))
                return bool(self._pipe.recv())
            except (EOFError, OSError):
                self._end()
            except Exception:
                # A signature that cannot be sent.
                self._end()
                return False
            except BaseException:
                # An interrupt would leave an answer behind.
                self._end()
                raise
        return False

    def _fork(self) -> None:
        ours, theirs = Pipe()
        with warnings.catch_warnings():
            # Later Pythons warn of threads of libraries, too, which the child does not use.
            warnings.simplefilter("ignore", DeprecationWarning)
            child = os.fork()
        if child == 0:
            ours.close()
            _serve(theirs)
        theirs.close()
        self._child, self._pipe = child, ours

    def _end(self) -> None:
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
            # Somebody else may have been told of its end.
            with suppress(ChildProcessError):
                if os.waitpid(self._child, os.WNOHANG) == (0, 0):
                    os.kill(self._child, signal.SIGKILL)
                    os.waitpid(self._child, 0)


_COMPILER = _Compiler()
register("numba:compile", _Patience())  # type: ignore[no-untyped-call]


def _serve(pipe: Connection) -> NoReturn:
    """What the child does until its parent ends, it has grown, or nothing comes; it says nothing."""
    try:
        for number in ENDING:
            signal.signal(number, signal.SIG_IGN)
        silence = os.open(os.devnull, os.O_RDWR)
        for said in (0, 1, 2):
            os.dup2(silence, said)
        warnings.simplefilter("ignore")
        # To look through what the parent has would copy it; what compiling leaves is looked at less often.
        gc.freeze()
        gc.set_threshold(100_000)
        most_pages = _resident_pages() + (_GROWN_MB << 20) // os.sysconf("SC_PAGE_SIZE")
        while pipe.poll(_IDLE_S):
            module, name, sig = pipe.recv()
            kernel = getattr(importlib.import_module(module), name, None)
            if kernel is not None:
                with suppress(Exception):
                    kernel.compile(sig)
            pipe.send(kernel is not None)
            if _resident_pages() > most_pages:
                break
    finally:
        os._exit(0)


def _resident_pages() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1])
