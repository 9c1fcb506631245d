"""Kernels: evidence of a bit and of a character at every tick, and the best path through them."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

__all__ = ["best_path", "bit_evidence", "character_scores"]

Column = NDArray[Any]

_NOTHING = 30.0
"""Nats by which what is less likely is left out: 1e-13 of it, against a doubt of a thousandth."""


@njit(cache=True, nogil=True)
def _log_sum(a: float, b: float) -> float:
    """The logarithm of the sum of two numbers, from their logarithms."""
    if a < b:
        a, b = b, a
    if b < a - 40 or b == -np.inf:
        return a
    return a + math.log1p(math.exp(b - a))


@njit(cache=True, nogil=True)
def bit_evidence(
    counts: Column, logs: Column, gains: Column, means: Column, share: float, doubt: float, out: Column
) -> None:
    """Log-likelihood of the window behind every tick for each context of a bit, less that of the last one.

    Args:
        counts: Events of each tick, OFF and ON, int32 (2, n).
        logs: Logarithm of the mean events of each tick of a window, by context, float64 (C, 2, W).
        gains: Logarithms of the gains that a window may have, float64 (J,).
        means: What a window costs by context and gain: its mean events, each counted as `share`, less the
            logarithm of the gain's share, float64 (C, J).
        share: What an event counts.
        doubt: Probability that a window is of no context.
        out: Of each tick that has W of them before the end, float64 (n - W + 1, C).
    """
    contexts, _, width = logs.shape
    strengths = len(gains)
    alike = np.empty(contexts)
    said = np.empty((contexts, strengths))
    least = math.log(doubt)
    for s in range(len(out)):
        alike[:] = 0.0
        events = 0
        for polarity in range(2):
            for m in range(width):
                k = counts[polarity, s + m]
                if k:
                    events += k
                    for c in range(contexts):
                        alike[c] += k * logs[c, polarity, m]
        for c in range(contexts):
            for j in range(strengths):
                said[c, j] = share * (alike[c] + events * gains[j]) - means[c, j]
        top = said[0, 0]
        for c in range(contexts):
            for j in range(strengths):
                top = max(top, said[c, j])
        largest = 0.0
        for c in range(contexts):
            total = 0.0
            for j in range(strengths):
                # What is less is nothing beside the doubt; most gains of a bright light are.
                if said[c, j] > top - _NOTHING:
                    total += math.exp(said[c, j] - top)
            out[s, c] = total
            largest = max(largest, total)
        for c in range(contexts):
            out[s, c] = math.log((1 - doubt) * out[s, c] / largest + doubt) if out[s, c] > 0.0 else least
        last = out[s, contexts - 1]
        for c in range(contexts):
            out[s, c] -= last


@njit(cache=True, nogil=True)
def character_scores(
    evidence: Column, places: Column, bits: int, parity: int, likeliest: bool, out: Column
) -> None:
    """Log-likelihood ratio of a character that starts at a tick, of any bits, against a light that stands.

    It may stand as for a mark, or as for a space: a long pause is less noisy than the marks that follow an
    edge, and is no character for that.

    Args:
        evidence: Of every tick and context, whose binary digits are the bits before and that of the window,
            float64 (n, C).
        places: Ticks from the start of a character to each of its bits, int64 (bits on air,).
        bits: Data bits.
        parity: 0 none, 1 odd, 2 even: the parity bit makes the number of ones so.
        likeliest: Take the likeliest bits alone instead of the mean over all.
        out: Of every tick, float64 (m,), with m + the last place <= n.
    """
    fair = -bits * math.log(2.0)
    states = np.empty((2, evidence.shape[1] // 2, 2))
    for s in range(len(out)):
        total = _character_score(evidence, places, bits, parity, True, s, states)
        # The mean over all words matters only where a character may be.
        if not likeliest and total > 0:
            total = _character_score(evidence, places, bits, parity, False, s, states)
        still = 0.0
        for b in range(len(places)):
            still += evidence[s + places[b], 0]
        out[s] = total + fair - max(still, 0.0)


@njit(cache=True, nogil=True)
def _character_score(
    evidence: Column, places: Column, bits: int, parity: int, likeliest: bool, s: int, states: Column
) -> float:
    """The likeliest word, or the sum over all, at one tick; `states` is room to work in."""
    # A state is the last bits and the parity of the ones so far; before the start bit there was mark.
    known_bits = states.shape[1]
    states[:] = -np.inf
    states[0, known_bits - 2, 0] = evidence[s, 2 * known_bits - 2]
    now = 0
    for b in range(1, len(places)):
        at = s + places[b]
        is_data = b <= bits
        is_parity = parity > 0 and b == bits + 1
        for state in range(known_bits):
            for odd in range(2):
                states[1 - now, state, odd] = -np.inf
        for state in range(known_bits):
            for odd in range(2):
                before = states[now, state, odd]
                if before == -np.inf:
                    continue
                for bit in range(2):
                    if not is_data and bit != (((odd + parity) & 1) if is_parity else 1):
                        continue
                    context = 2 * state + bit
                    value = before + evidence[at, context]
                    to, ones = context & (known_bits - 1), (odd ^ bit) if is_data else odd
                    known = states[1 - now, to, ones]
                    states[1 - now, to, ones] = max(known, value) if likeliest else _log_sum(known, value)
        now = 1 - now
    total = -np.inf
    for state in range(known_bits):
        for odd in range(2):
            value = states[now, state, odd]
            total = max(total, value) if likeliest else _log_sum(total, value)
    return total


@njit(cache=True, nogil=True)
def best_path(
    scores: Column,
    tails: Column,
    length: int,
    first: int,
    near: int,
    after_idle: float,
    after_one: float,
    jitter: float,
    pause: int,
    after_pause: float,
) -> tuple[Column, float]:
    """Starts of the characters that explain a stretch best, and how much better than none.

    Args:
        scores: Of a character that starts at each tick, float64 (n,).
        tails: What a pause that begins at each tick is worth: edges before it go on into it, float64 (>= n,).
        length: Ticks from a character's start to the end of its last stop bit.
        first: The first tick at which one may start.
        near: Ticks by which one may follow another early or late and still count as following it at once.
        after_idle: What a character costs that follows a pause.
        after_one: What one costs that follows another at once.
        jitter: What a tick early or late costs.
        pause: Ticks between the end of one and the start of another behind the pause that is sent; 0: none.
        after_pause: What one costs behind just that pause.

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
            if ended[s] + tails[s] > idle[s]:
                idle[s], of_idle[s] = ended[s] + tails[s], s - length
        if s < first:
            continue
        value, origin = idle[s] - after_idle, of_idle[s]
        for d in range(-near, near + 1):
            e = s - d
            if 0 <= e < len(ended) and ended[e] > -np.inf:
                follows = ended[e] - after_one - jitter * abs(d)
                if follows > value:
                    value, origin = follows, e - length
            e -= pause
            if pause and e >= 0 and ended[e] > -np.inf:
                follows = ended[e] + tails[e] - after_pause - jitter * abs(d)
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
