"""Synchronization once more in NumPy or plain loops, and events of clusters that blink as told."""

import numpy as np

CHIP_US = 100.0


def correlate(counts, chips, due, steps, min_events, lags):
    """The windows of each lag laid out as a table of chips."""
    rho = np.zeros(lags)
    for lag in range(lags):
        window = counts[:, lag : lag + steps * len(chips)].reshape(2, len(chips), steps).sum(2)
        signed, seen = window[1] - window[0], window.sum()
        fit = np.where(due, signed * chips, np.minimum(signed * chips, 0)).sum()
        if seen >= min_events and fit > 0:
            rho[lag] = min(fit / seen, fit / np.linalg.norm(signed) / np.sqrt(due.sum()))
    return rho


def events_of(
    chips, rng, start_us=5000.0, ppm=0.0, delay_us=(20.0, 45.0), missing_off=0.0, per_edge=2, jitter_us=4.0
):
    """(times, polarities) of clusters that blink as `chips` (n, K): each edge sends a few late events."""
    edges = np.diff(chips.astype(int), axis=0, prepend=0)
    when, cluster = (np.repeat(v, per_edge) for v in np.nonzero(edges))
    p = (edges[when, cluster] > 0).astype(np.uint8)
    late = (
        np.where(p, *delay_us) + 12 * (np.arange(len(when)) % per_edge) + rng.normal(0, jitter_us, len(when))
    )
    t = np.floor(start_us + when * CHIP_US * (1 + ppm * 1e-6) + late).astype(np.int64)
    keep = (p > 0) | (rng.random(len(t)) >= missing_off)
    order = np.argsort(t[keep], kind="stable")
    return t[keep][order], p[keep][order]


def answers_of(chips, slow):
    """Negative and positive events by chip, (2, n), of clusters that blink as `chips` (n, K), by plain loops.

    A pixel answers an edge by ln((k + 2) / (k + 1)) events in the k-th chip behind it, or at once.
    """
    counts = np.zeros((2, len(chips)))
    for lit in chips.T:
        k = 0
        for n, on in enumerate(lit):
            k = 0 if n == 0 or on != lit[n - 1] else k + 1
            counts[on, n] += np.log((k + 2) / (k + 1)) if slow else float(k == 0)
    return counts
