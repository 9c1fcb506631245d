"""What every kernel is compiled with: numba, and its cache where there can be one."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

import numba
from numba.core.caching import FunctionCache

__all__ = ["njit"]

F = TypeVar("F", bound=Callable[..., Any])


def njit(*, cache: bool = False, **options: Any) -> Callable[[F], F]:
    """As `numba.njit`, but a cache that cannot be written or read does not matter.

    Where the package is installed read-only and there is no home, or on a full disk, kernels are compiled in
    each process.
    """

    def compile_(function: F) -> F:
        kernel = numba.njit(**options)(function)
        # numba says so by a RuntimeError where it finds no folder.
        with suppress(RuntimeError, OSError):
            if cache:
                kernel._cache = _Cache(function)  # type: ignore[no-untyped-call]
        compiled: F = kernel
        return compiled

    return compile_


class _Cache(FunctionCache):
    """A cache whose files may be refused at any time."""

    @contextmanager
    def _guard_against_spurious_io_errors(self) -> Iterator[None]:
        with suppress(OSError):
            yield
