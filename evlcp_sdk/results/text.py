"""Numbers as the result's files write them."""

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["number_or_none", "sigmas", "symbol_list", "text_or_empty"]


def text_or_empty(value: float, digits: int) -> str:
    """A number with so many digits; empty for NaN and infinity."""
    return f"{value:.{digits}f}" if math.isfinite(value) else ""


def number_or_none(value: float, digits: int) -> float | None:
    """A number rounded to so many digits; None for NaN and infinity."""
    return round(value, digits) if math.isfinite(value) else None


def symbol_list(symbols: NDArray[np.int64]) -> list[int | None]:
    """A frame's symbols; None for one that is not given, which is negative."""
    return [symbol if symbol >= 0 else None for symbol in symbols.tolist()]


def sigmas(covariance: NDArray[np.float64]) -> list[float]:
    """Standard deviations of a covariance, the roots of its diagonal."""
    found: list[float] = np.sqrt(np.diag(covariance)).tolist()
    return found
