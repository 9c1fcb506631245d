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


def chance_below(value: float, freedom: int, noncentral: float) -> float:
    """Chance that a non-central chi-square of so many degrees of freedom is below a value.

    >>> round(chance_below(chi_square(1e-4, 6), 6, 50.0), 3)
    0.014
    """
    from scipy.special import chndtr

    return float(chndtr(value, freedom, noncentral))
