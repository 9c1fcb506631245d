"""Quantiles that tests of positions go by."""

from functools import lru_cache


@lru_cache(maxsize=4096)
def chi_square(chance: float, freedom: int) -> float:
    """What a chi-square of so many degrees of freedom exceeds by this chance.

    >>> round(chi_square(0.0027, 3), 2)
    14.16
    """
    from scipy.special import chdtri

    return float(chdtri(freedom, chance))
