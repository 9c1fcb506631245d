"""Kernels: evidence of an edge and of a character at every tick, and the best path through them."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

__all__ = ["best_path", "character_scores", "edge_evidence"]

Column = NDArray[Any]


@njit(cache=True, nogil=True)
def _log_sum(a: float, b: float) -> float:
    """The logarithm of the sum of two numbers, from their logarithms."""
    if a < b:
        a, b = b, a
    if b == -np.inf:
        return a
    return a + math.log1p(math.exp(b - a))


@njit(cache=True, nogil=True)
def edge_evidence(
    counts: Column, gains: Column, means: Column, shares: Column, unseen: float, out: Column
) -> None:
    """Log-likelihood ratio of an edge at every tick against none, from the counts of one polarity.

    Args:
        counts: Events of each tick, int32 (n,).
        gains: What an event at each tick after an edge says, for each strength of a burst, float64 (J, K).
        means: Events of a burst of each strength, float64 (J,).
        shares: How likely each strength is, float64 (J,).
        unseen: Probability that an edge has no burst.
        out: Of each tick that has K of them before the end, float64 (n - K + 1,).
    """
    strengths, length = gains.shape
    said = np.empty(strengths)
    for s in range(len(out)):
        said[:] = 0.0
        for m in range(length):
            c = counts[s + m]
            if c:
                for j in range(strengths):
                    said[j] += c * gains[j, m]
        burst = -np.inf
        for j in range(strengths):
            burst = _log_sum(burst, said[j] - means[j] + math.log(shares[j]))
        out[s] = _log_sum(math.log(unseen), math.log(1 - unseen) + burst)


@njit(cache=True, nogil=True)
def character_scores(
    falls: Column, rises: Column, places: Column, bits: int, parity: int, likeliest: bool, out: Column
) -> None:
    """Log-likelihood ratio of a character that starts at a tick, of any bits, against no edge at all.

    Args:
        falls: Evidence of an edge from mark to space at every tick, float64 (n,).
        rises: The same from space to mark.
        places: Ticks from the start of a character to that of each bit, the start bit's and the first stop
            bit's included, int64 (bits + 2 or 3,).
        bits: Data bits.
        parity: 0 none, 1 odd, 2 even: the parity bit makes the number of ones so.
        likeliest: Take the likeliest bits alone instead of the mean over all.
        out: Of every tick whose last edge is within n, float64 (m,).
    """
    # A state is the level of the last bit and the parity of the ones so far.
    here, then = np.empty((2, 2)), np.empty((2, 2))
    fair = -bits * math.log(2.0)
    for s in range(len(out)):
        here[:] = -np.inf
        here[0, 0] = falls[s]
        for b in range(bits):
            fall, rise = falls[s + places[b + 1]], rises[s + places[b + 1]]
            for odd in range(2):
                zero0, zero1 = here[0, odd], here[1, odd] + fall
                one0, one1 = here[0, 1 - odd] + rise, here[1, 1 - odd]
                if likeliest:
                    then[0, odd], then[1, odd] = max(zero0, zero1), max(one0, one1)
                else:
                    then[0, odd], then[1, odd] = _log_sum(zero0, zero1), _log_sum(one0, one1)
            here, then = then, here
        stop = places[bits + 1]
        if parity:
            fall, rise = falls[s + stop], rises[s + stop]
            for odd in range(2):
                one = odd if parity == 2 else 1 - odd
                if one:
                    up0, up1 = here[0, odd] + rise, here[1, odd]
                    then[1, odd] = max(up0, up1) if likeliest else _log_sum(up0, up1)
                    then[0, odd] = -np.inf
                else:
                    down0, down1 = here[0, odd], here[1, odd] + fall
                    then[0, odd] = max(down0, down1) if likeliest else _log_sum(down0, down1)
                    then[1, odd] = -np.inf
            here, then = then, here
            stop = places[bits + 2]
        rise = rises[s + stop]
        total = -np.inf
        for odd in range(2):
            if likeliest:
                total = max(total, here[0, odd] + rise, here[1, odd])
            else:
                total = _log_sum(total, _log_sum(here[0, odd] + rise, here[1, odd]))
        out[s] = total + fair


@njit(cache=True, nogil=True)
def best_path(
    scores: Column, length: int, first: int, near: int, after_idle: float, after_one: float, jitter: float
) -> tuple[Column, float]:
    """Starts of the characters that explain a stretch best, and how much better than none.

    Args:
        scores: Of a character that starts at each tick, float64 (n,).
        length: Ticks from a character's start to the end of its last stop bit.
        first: The first tick at which one may start.
        near: Ticks by which one may follow another early or late and still count as following it at once.
        after_idle: What a character costs that follows a pause.
        after_one: What one costs that follows another at once.
        jitter: What a tick early or late costs.

    Returns:
        The starts, int64 (m,), and the score of the path.
    """
    n = len(scores)
    # Ends of characters lie up to `length` and the nearness behind the last start.
    idle = np.zeros(n + 1)
    ended = np.full(n + length + 1, -np.inf)
    of_idle = np.full(n + 1, -1, np.int64)
    before = np.full(n, -1, np.int64)
    best_end, best = -1, 0.0
    for s in range(n):
        if s:
            idle[s], of_idle[s] = idle[s - 1], of_idle[s - 1]
            if ended[s] > idle[s]:
                idle[s], of_idle[s] = ended[s], s - length
        if s < first:
            continue
        value, origin = idle[s] - after_idle, of_idle[s]
        for d in range(-near, near + 1):
            e = s - d
            if 0 <= e < len(ended) and ended[e] > -np.inf:
                follows = ended[e] - after_one - jitter * abs(d)
                if follows > value:
                    value, origin = follows, e - length
        value += scores[s]
        if value > ended[s + length]:
            ended[s + length] = value
            before[s] = origin
            if value > best:
                best, best_end = value, s
    starts = np.empty(n, np.int64)
    k = 0
    at = best_end
    while at >= 0:
        starts[k] = at
        k += 1
        at = before[at]
    return starts[:k][::-1].copy(), best
