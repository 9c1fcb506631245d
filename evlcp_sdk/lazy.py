"""Modules that are imported at their first use: formats, and SciPy."""

from importlib import import_module
from typing import Any


class LazyModule:
    """Stands for a module that is imported at its first use; later uses cost what any module's do.

    An import statement in a function that runs a thousand times a second takes longer than some kernels.

    Args:
        name: Of the module.
    """

    def __init__(self, name: str) -> None:
        self.__dict__["__name__"] = name

    def __getattr__(self, name: str) -> Any:
        value = self.__dict__[name] = getattr(import_module(self.__dict__["__name__"]), name)
        return value
