"""Numbers as the result's files write them."""

import math
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.values import Fix


def text_or_empty(value: float, digits: int) -> str:
    """A number with so many digits; empty for NaN and infinity."""
    return f"{value:.{digits}f}" if math.isfinite(value) else ""


def number_or_none(value: float, digits: int) -> float | None:
    """A number rounded to so many digits; None for NaN and infinity."""
    return round(value, digits) if math.isfinite(value) else None


def symbol_list(symbols: NDArray[np.int64]) -> list[int | None]:
    """A frame's symbols; None for one that is not given, which is negative."""
    return [symbol if symbol >= 0 else None for symbol in symbols.tolist()]


def characters(symbols: Iterable[int | None]) -> str:
    """The text of codes of characters; the replacement character for one that was not received.

    Codes of ASCII are what they are; bytes beyond are UTF-8 where they are such, else Latin-1.

    >>> characters([72, 105, None, 33])
    'Hi\ufffd!'
    """
    codes = [0xFFFD if symbol is None or symbol < 0 else symbol for symbol in symbols]
    if max(codes, default=0) > 0x7F and 0xFFFD not in codes and max(codes) < 256:
        with suppress(UnicodeDecodeError):
            return bytes(codes).decode()
    return "".join(map(chr, codes))


def sigmas(covariance: NDArray[np.float64]) -> list[float]:
    """Standard deviations of a covariance, the roots of its diagonal."""
    found: list[float] = np.sqrt(np.diag(covariance)).tolist()
    return found


def integrity(fix: Fix) -> dict[str, Any]:
    """How far a fix may be trusted, as values of JSON: misfit, levels, what was left out, alarms."""
    return {
        "source": fix.source,
        "misfit": number_or_none(fix.misfit, 4),
        "freedom": fix.freedom,
        "hpl_m": number_or_none(fix.hpl_m, 3),
        "vpl_m": number_or_none(fix.vpl_m, 3),
        "excluded": list(fix.excluded),
        "contradicted": list(fix.contradicted),
        "alarms": list(fix.alarms),
    }
