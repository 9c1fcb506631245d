"""Loops over grid cells, compiled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]


@njit(cache=True, nogil=True)
def take_in(heard: Array, prior: Array, out: Array) -> None:
    """Probability of each cluster in each cell by Bayes' rule, from what was heard and from the place alone.

    All are (K, rows, columns). Without a cluster, what was heard is as likely as each with equal priors, and
    not even a cell that fits a code in all its values is sure to show a cluster, nor a place.
    """
    clusters, rows, columns = prior.shape
    place, share = np.zeros((rows, columns)), np.zeros((rows, columns))
    for k in range(clusters):
        for r in range(rows):
            for c in range(columns):
                out[k, r, c] = 0
                place[r, c] += prior[k, r, c]
                share[r, c] += heard[k, r, c]
    for r in range(rows):
        for c in range(columns):
            if place[r, c] == 0:
                continue
            odds = clusters / max(1 - share[r, c], 1e-6)
            unheard = 0.0 if share[r, c] > 0 else 1.0
            total = max(1 - place[r, c], 1e-6)
            for k in range(clusters):
                total += prior[k, r, c] * (heard[k, r, c] * odds + unheard)
            for k in range(clusters):
                out[k, r, c] = prior[k, r, c] * (heard[k, r, c] * odds + unheard) / total
