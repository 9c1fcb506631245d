"""What every kernel is compiled with: Numba, and its cache where there is a folder for one."""

import logging
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from pathlib import Path
from threading import RLock
from typing import Any, TypeVar, overload

F = TypeVar("F", bound=Callable[..., Any])

_MIN_FREE_BYTES = 50_000_000
"""More than all kernels take; Numba fails in the middle of a run when a kernel cannot be written."""

_REPORT_AFTER_S = 2.0
"""Time spent on compiling after which it is logged."""

_REPORT_EVERY_S = 10.0
"""And how often the progress is, from then on."""


class CompileTimer:
    """Time spent in this process on compiling kernels and loading cached ones: of processors and elapsed, s.

    Compiling that takes long is logged, with its progress; loading is not.
    """

    def __init__(self) -> None:
        self.processor_s = self.elapsed_s = 0.0
        self._compiled_s = 0.0
        self._depth = 0
        self._report_at_s = _REPORT_AFTER_S

    def watch(self, kernel: Any) -> Callable[[Any], Any]:
        """A kernel's `compile` that adds the time it takes, also when it compiles other kernels.

        A cached version whose types no longer exist is deleted.
        """
        compile_: Callable[[Any], Any] = kernel.compile

        @wraps(compile_)
        def compile_and_time(sig: Any) -> Any:
            start = time.process_time(), time.perf_counter()
            compiled = sum(kernel.stats.cache_misses.values())
            self._depth += 1
            try:
                return compile_(sig)
            except (AttributeError, ImportError):
                if kernel.stats.cache_path is None:
                    raise
                for index in Path(kernel.stats.cache_path).glob(f"*.{kernel.py_func.__name__}-*.nbi"):
                    index.unlink(missing_ok=True)
                return compile_(sig)
            finally:
                self._depth -= 1
                if not self._depth:
                    self.processor_s += time.process_time() - start[0]
                    elapsed_s = time.perf_counter() - start[1]
                    self.elapsed_s += elapsed_s
                    if sum(kernel.stats.cache_misses.values()) > compiled:
                        self._compiled_s += elapsed_s
                    if self._compiled_s > self._report_at_s:
                        self._report_at_s = self._compiled_s + _REPORT_EVERY_S
                        logging.getLogger(__name__).info(
                            f"compiling kernels, once on a machine: {count_compiled()} of {len(LOADED)}"
                        )

        return compile_and_time


COMPILE_TIMER = CompileTimer()
"""Of this process."""

LOADED: list[Any] = []
"""The kernels that this process has loaded, those of modules of which one was called; most will be called."""


class _Kernel:
    """Stands in a module for a kernel until one of the module is called: only then Numba is imported.

    All kernels of that module are loaded then, as one may call another.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._function, self._options, self._dispatcher = function, options, None

    def __call__(self, *args: Any) -> Any:
        return self.load()(*args)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.load(), name)

    def load(self) -> Any:
        with _LOAD_LOCK:
            if self._dispatcher is None:
                self._dispatcher = _create_dispatcher(self._function, self._options)
                names = self._function.__globals__
                for name in list(names):
                    # Loading one loads others.
                    if isinstance(names[name], _Kernel):
                        names[name] = names[name].load()
        return self._dispatcher


_LOAD_LOCK = RLock()


def _create_dispatcher(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    import numba

    kernel = numba.njit(**options)(function)
    if kernel is function:
        # NUMBA_DISABLE_JIT=1: kernels are debugged as Python.
        return function
    # RuntimeError: Numba finds no folder.
    with suppress(RuntimeError):
        kernel.enable_caching()
        if shutil.disk_usage(kernel.stats.cache_path).free < _MIN_FREE_BYTES:
            kernel = numba.njit(**options)(function)
    kernel.compile = COMPILE_TIMER.watch(kernel)
    LOADED.append(kernel)
    return kernel


@overload
def njit(function: F, /) -> F: ...


@overload
def njit(**options: Any) -> Callable[[F], F]: ...


def njit(function: Any = None, /, **options: Any) -> Any:
    """As `numba.njit`, without the GIL, and cached; compiled in each process where no folder can be written.

    The function is compiled at its first call. A division by 0 gives what NumPy gives, which is quicker to
    compile than an error. C calls none of them.
    """
    all_options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True} | options
    return (lambda f: _Kernel(f, all_options)) if function is None else _Kernel(function, all_options)


def count_compiled() -> int:
    """How many kernels this process has compiled."""
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in LOADED)


def find_cache_folder() -> Path | None:
    """The folder of the kernels loaded first; None where none can be written."""
    return next((Path(k.stats.cache_path) for k in LOADED if k.stats.cache_path is not None), None)
