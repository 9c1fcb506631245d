"""Quantiles of the delays of results, in constant memory."""

import math
from collections import Counter
from typing import Final

from evlcp_sdk.formatting import round_or_none
from evlcp_sdk.values import find_quantile_bin

_RANGE_MS: Final = (1e-3, 1e6)
_CELLS_PER_E: Final = 50
"""Of 2 % each, for a factor of e."""


class DelayTally:
    """Delays counted in cells of 2 %, from 1 us to a million ms; their number, and the longest, ms.

    >>> tally = DelayTally()
    >>> for delay_ms in (1.0, 2.0, 3.0, 40.0):
    ...     tally.add(delay_ms)
    >>> round(tally.quantile_ms(0.5), 1), tally.to_dict()["max_ms"]
    (2.0, 40.0)
    """

    def __init__(self) -> None:
        self.count = 0
        self.max_ms = 0.0
        self._cells = Counter[int]()

    def add(self, delay_ms: float) -> None:
        """Add a delay; one that is not positive counts as the shortest."""
        self.count += 1
        self.max_ms = max(self.max_ms, delay_ms)
        self._cells[math.ceil(math.log(min(max(delay_ms, _RANGE_MS[0]), _RANGE_MS[1])) * _CELLS_PER_E)] += 1

    def quantile_ms(self, share: float) -> float:
        """The delay that this share of all does not exceed, ms, to 2 %; NaN where there is none."""
        cell = find_quantile_bin(self._cells, share)
        return math.nan if cell is None else min(math.exp(cell / _CELLS_PER_E), self.max_ms)

    def to_dict(self) -> dict[str, float | int | None]:
        """Count, p50, p99 and maximum, ms, as JSON values."""
        return {
            "count": self.count,
            "p50_ms": round_or_none(self.quantile_ms(0.5), 3),
            "p99_ms": round_or_none(self.quantile_ms(0.99), 3),
            "max_ms": round(self.max_ms, 3) if self.count else None,
        }
