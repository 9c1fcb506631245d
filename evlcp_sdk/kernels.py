"""What every kernel is compiled with: Numba, and its cache where there is a folder for one."""

import logging
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import wraps
from pathlib import Path
from threading import RLock
from typing import Any, TypeVar, overload

F = TypeVar("F", bound=Callable[..., Any])

_ROOM_BYTES = 50_000_000
"""All kernels take less; Numba fails in the middle of a run where a kernel cannot be written."""

_LONG_S = 2.0
"""Time spent on compiling after which that is said."""

_AGAIN_S = 10.0
"""And how far it is, each time that this has passed."""


class Compiling:
    """What compiling kernels, and loading those that are kept, has taken in this process.

    That it is compiled, and how far it is, is said to the log when it takes long; loading is not.

    Attributes:
        processor_s: Processor time, s.
        elapsed_s: Time on the clock, s.
    """

    def __init__(self) -> None:
        self.processor_s = self.elapsed_s = 0.0
        self._compiled_s = 0.0
        self._depth = 0
        self._said_at_s = _LONG_S

    def watched(self, kernel: Any) -> Callable[[Any], Any]:
        """A kernel's `compile`, its time added; a kernel may need others.

        What is kept of a version whose types there are no longer is forgotten.
        """
        compile_: Callable[[Any], Any] = kernel.compile

        @wraps(compile_)
        def watched(sig: Any) -> Any:
            begin = time.process_time(), time.perf_counter()
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
                    self.processor_s += time.process_time() - begin[0]
                    elapsed_s = time.perf_counter() - begin[1]
                    self.elapsed_s += elapsed_s
                    if sum(kernel.stats.cache_misses.values()) > compiled:
                        self._compiled_s += elapsed_s
                    if self._compiled_s > self._said_at_s:
                        self._said_at_s = self._compiled_s + _AGAIN_S
                        logging.getLogger(__name__).info(
                            f"compiling kernels, once on a machine: {count_compiled()} of {count_imported()}"
                        )

        return watched


COMPILING = Compiling()
"""Of this process."""


class _Kernel:
    """Stands in a module for a kernel, until one of them is called: only then Numba is imported.

    All of that module are made then, as one may call another.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._function, self._options, self._made = function, options, None

    def __call__(self, *args: Any) -> Any:
        return self.made()(*args)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.made(), name)

    def made(self) -> Any:
        with _MAKING:
            if self._made is None:
                self._made = _compiled(self._function, self._options)
                names = self._function.__globals__
                for name in list(names):
                    # Making one makes others.
                    if isinstance(names[name], _Kernel):
                        names[name] = names[name].made()
        return self._made


_MAKING = RLock()


def _compiled(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    import numba

    kernel = numba.njit(**options)(function)
    # Numba finds no folder: RuntimeError.
    with suppress(RuntimeError):
        kernel.enable_caching()
        if shutil.disk_usage(kernel.stats.cache_path).free < _ROOM_BYTES:
            kernel = numba.njit(**options)(function)
    kernel.compile = COMPILING.watched(kernel)
    return kernel


@overload
def njit(function: F, /) -> F: ...


@overload
def njit(**options: Any) -> Callable[[F], F]: ...


def njit(function: Any = None, /, **options: Any) -> Any:
    """As `numba.njit`, without the GIL, and cached; where no folder can be written, compiled in each process.

    To divide by 0 gives what NumPy gives, which is quicker to compile than an error. None is called by C.

    Args:
        function: What is compiled at its first call.
        options: Others of `numba.njit`.
    """
    chosen: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True} | options
    return (lambda given: _Kernel(given, chosen)) if function is None else _Kernel(function, chosen)


def _all_kernels() -> Iterator[Any]:
    """All of modules of which one has been called."""
    for name, module in list(sys.modules.items()):
        if name.endswith("_kernels"):
            made = (one for one in list(vars(module).values()) if not isinstance(one, _Kernel))
            yield from (one for one in made if hasattr(one, "py_func"))


def count_imported() -> int:
    """How many kernels this process has made; most of them will be called."""
    return sum(1 for _ in _all_kernels())


def count_compiled() -> int:
    """How many kernels this process has compiled."""
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in _all_kernels())


def find_cache_folder() -> Path | None:
    """The folder of the kernels made first; None where none can be written."""
    return next((Path(k.stats.cache_path) for k in _all_kernels() if k.stats.cache_path is not None), None)
