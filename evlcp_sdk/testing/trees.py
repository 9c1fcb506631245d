"""Change and compare arrays within tuples, lists and frozen dataclasses."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


def map_arrays(value: Any, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Any:
    """Return the same structure with every array changed."""
    if isinstance(value, np.ndarray):
        return change(value)
    if isinstance(value, tuple | list):
        return type(value)(map_arrays(v, change) for v in value)
    if is_dataclass(value) and not isinstance(value, type):
        return type(value)(**{f.name: map_arrays(getattr(value, f.name), change) for f in fields(value)})
    return value


def find_difference(got: Any, wanted: Any, tolerance: float = 0.0, name: str = "result") -> str | None:
    """Describe the first difference of two values, None if there is none; NaN equals NaN."""
    if isinstance(wanted, np.ndarray):
        if not isinstance(got, np.ndarray):
            return f"{name}: {type(got).__name__}, not an array"
        if got.shape != wanted.shape or got.dtype != wanted.dtype:
            return f"{name}: {got.dtype} {got.shape}, not {wanted.dtype} {wanted.shape}"
        floats = got.dtype.kind == "f"
        near = np.isclose(got, wanted, tolerance, tolerance, equal_nan=True) if floats else got == wanted
        if near.all():
            return None
        at = tuple(int(i) for i in np.argwhere(~near)[0])
        return f"{name}{list(at)}: {got[at]}, not {wanted[at]}"
    if isinstance(wanted, tuple | list):
        if len(got) != len(wanted):
            return f"{name}: {len(got)} entries, not {len(wanted)}"
        parts = [(g, w, f"{name}[{i}]") for i, (g, w) in enumerate(zip(got, wanted, strict=True))]
    elif is_dataclass(wanted) and type(got) is type(wanted):
        names = [f.name for f in fields(wanted)]
        parts = [(getattr(got, n), getattr(wanted, n), f"{name}.{n}") for n in names]
    elif isinstance(wanted, float):
        same = bool(np.isclose(got, wanted, tolerance, tolerance, equal_nan=True))
        return None if same else f"{name}: {got}, not {wanted}"
    else:
        return None if got == wanted else f"{name}: {got!r}, not {wanted!r}"
    return next((d for g, w, n in parts if (d := find_difference(g, w, tolerance, n)) is not None), None)
