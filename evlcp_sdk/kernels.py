"""What every kernel is compiled with: Numba, and its cache where there is a folder for one."""

import logging
import shutil
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, overload

import numba

__all__ = ["count_compiled", "count_imported", "count_loaded", "find_cache_folder", "njit"]

F = TypeVar("F", bound=Callable[..., Any])

_ROOM_BYTES = 50_000_000
"""All kernels take less; Numba fails in the middle of a run where a kernel cannot be written."""


@overload
def njit(function: F, /) -> F: ...


@overload
def njit(**options: Any) -> Callable[[F], F]: ...


def njit(function: Any = None, /, **options: Any) -> Any:
    """As `numba.njit`, without the GIL, and cached; where no folder can be written, compiled in each process.

    Args:
        function: What is compiled at its first call.
        options: Others of `numba.njit`.
    """

    def compile_(given: Callable[..., Any]) -> Any:
        kernel = numba.njit(nogil=True, **options)(given)
        try:
            kernel.enable_caching()
        except RuntimeError:
            # Numba finds no folder.
            return kernel
        folder = Path(kernel.stats.cache_path)
        if shutil.disk_usage(folder).free < _ROOM_BYTES:
            return numba.njit(nogil=True, **options)(given)
        _announce(folder, Path(given.__code__.co_filename))
        return kernel

    return compile_ if function is None else compile_(function)


@cache
def _announce(folder: Path, source: Path) -> None:
    """Say that kernels will be compiled, where the cache has none of this source."""
    compiled_s = [path.stat().st_mtime for path in folder.glob(f"{source.stem}.*.nbi")]
    if max(compiled_s, default=0.0) < source.stat().st_mtime:
        _announce_once()


@cache
def _announce_once() -> None:
    logging.getLogger(__name__).info("compiling kernels, once on a machine; up to a minute in all")


def _all_kernels() -> Iterator[Any]:
    """All that have been imported."""
    for name, module in list(sys.modules.items()):
        if name.endswith("_kernels"):
            yield from (kernel for kernel in vars(module).values() if hasattr(kernel, "py_func"))


def count_imported() -> int:
    """How many kernels this process has imported; most of them will be called."""
    return sum(1 for _ in _all_kernels())


def count_loaded() -> int:
    """How many kernels this process has compiled or loaded from the cache."""
    return sum(len(kernel.signatures) for kernel in _all_kernels())


def count_compiled() -> int:
    """How many kernels this process has compiled."""
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in _all_kernels())


def find_cache_folder() -> Path | None:
    """The folder of the kernels imported first; None where none can be written."""
    return next((Path(k.stats.cache_path) for k in _all_kernels() if k.stats.cache_path is not None), None)
