"""Values as the files of a result contain them."""

import math
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.values import Fix


def format_or_empty(value: float, digits: int) -> str:
    """A number with so many decimals; empty for NaN and infinity."""
    return f"{value:.{digits}f}" if math.isfinite(value) else ""


def round_or_none(value: float, digits: int) -> float | None:
    """A number rounded to so many decimals; None for NaN and infinity."""
    return round(value, digits) if math.isfinite(value) else None


def list_symbols(symbols: NDArray[np.int64]) -> list[int | None]:
    """A frame's symbols; None for negative ones, which are not given."""
    return [symbol if symbol >= 0 else None for symbol in symbols.tolist()]


def decode_characters(symbols: Iterable[int | None]) -> str:
    """The text of character codes, with the replacement character for those not received.

    Bytes beyond ASCII are UTF-8 where that is valid, else Latin-1.

    >>> decode_characters([72, 105, None, 33])
    'Hi\ufffd!'
    """
    codes = [0xFFFD if symbol is None or symbol < 0 else symbol for symbol in symbols]
    if max(codes, default=0) > 0x7F and 0xFFFD not in codes and max(codes) < 256:
        with suppress(UnicodeDecodeError):
            return bytes(codes).decode()
    return "".join(map(chr, codes))


def sigmas(covariance: NDArray[np.float64]) -> list[float]:
    """Standard deviations of a covariance."""
    deviations: list[float] = np.sqrt(np.diag(covariance)).tolist()
    return deviations


def integrity_fields(fix: Fix) -> dict[str, Any]:
    """The integrity of a fix as JSON values: misfit, protection levels, what was left out, alarms."""
    return {
        "source": fix.source,
        "misfit": round_or_none(fix.misfit, 4),
        "freedom": fix.freedom,
        "hpl_m": round_or_none(fix.hpl_m, 3),
        "vpl_m": round_or_none(fix.vpl_m, 3),
        "excluded": list(fix.excluded),
        "contradicted": list(fix.contradicted),
        "alarms": list(fix.alarms),
    }
