"""Modules that are imported at their first use: formats, and SciPy."""

from collections.abc import Callable, Mapping
from importlib import import_module
from types import ModuleType
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


def find_module(packages: Mapping[str, str]) -> Callable[[str], ModuleType]:
    """A `__getattr__` for a module that stands for others: packages, each with names of its modules."""
    names = {name: package for package, modules in packages.items() for name in modules.split()}

    def find(name: str) -> ModuleType:
        if name not in names:
            raise AttributeError(f"no module {name!r} is listed here")
        return import_module(f"{names[name]}.{name}")

    return find
