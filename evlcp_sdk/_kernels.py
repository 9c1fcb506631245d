"""Loops over grid cells, compiled."""

from typing import Any

from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]


@njit(cache=True, nogil=True)
def take_in(heard: Array, prior: Array, out: Array) -> None:
    """Probability of each cluster in each cell by Bayes' rule, from what was heard and from the place alone.

    All are (K, rows, columns). Without a cluster, what was heard is as likely as each with equal priors, and
    not even a cell that fits a code in all its values is sure to show a cluster, nor a place.
    """
    clusters, rows, columns = prior.shape
    out[:] = 0
    for r in range(rows):
        for c in range(columns):
            place, share = 0.0, 0.0
            for k in range(clusters):
                place += prior[k, r, c]
                share += heard[k, r, c]
            if place == 0:
                continue
            odds = clusters / max(1 - share, 1e-6)
            total = max(1 - place, 1e-6)
            for k in range(clusters):
                total += prior[k, r, c] * (heard[k, r, c] * odds if share > 0 else 1.0)
            for k in range(clusters):
                likely = heard[k, r, c] * odds if share > 0 else 1.0
                out[k, r, c] = prior[k, r, c] * likely / total
