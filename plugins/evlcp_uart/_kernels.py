"""Kernels: the evidence of bits and characters at every tick, and the best path of characters."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Column = NDArray[Any]

_NEGLIGIBLE = 30.0
"""Nats below the likeliest context at which others are neglected: 1e-13, with outliers of a thousandth."""

_GROUP_TICKS = 64
"""Ticks whose words are scored together, in vector instructions."""


@njit
def compute_bit_evidence(
    counts: Column, logs: Column, gains: Column, means: Column, share: float, outlier: float, out: Column
) -> None:
    """Compute the log-likelihood of the window after every tick for each context, minus that of the last one.

    Args:
        counts: Events of each tick, OFF and ON, int32 (2, n).
        logs: Logarithm of the mean events of each tick of a window, weighted by `share`, by polarity, tick
            and context, float64 (2, W, C).
        gains: Logarithms of the gains of a window, float64 (J,).
        means: Cost of a window by context and gain: its mean events, weighted by `share`, minus the logarithm
            of the gain's share, float64 (C, J).
        share: Weight of an event.
        outlier: Probability that a window is of no context.
        out: The log-likelihoods, float64 (n - W + 1, C).
    """
    _, width, contexts = logs.shape
    # The effect of gains depends on the number of events, not on their times.
    many = np.zeros(len(out), np.int64)
    for m in range(width):
        many += counts[0, m : m + len(out)] + counts[1, m : m + len(out)]
    of_gains = np.empty((many.max() + 1 if len(out) else 0, contexts))
    is_known = np.zeros(len(of_gains), np.bool_)
    loglik = np.empty(contexts)
    least = math.log(outlier)
    for s in range(len(out)):
        events = many[s]
        if s and not events and not many[s - 1]:
            out[s] = out[s - 1]
            continue
        for c in range(0 if is_known[events] else contexts):
            # The logarithm of the sum over gains for this number of events.
            most, total = -np.inf, 0.0
            for j in range(len(gains)):
                most = max(most, share * events * gains[j] - means[c, j])
            for j in range(len(gains)):
                total += math.exp(share * events * gains[j] - means[c, j] - most)
            of_gains[events, c] = most + math.log(total)
        is_known[events] = True
        for c in range(contexts):
            loglik[c] = of_gains[events, c]
        for polarity in range(2):
            for m in range(width):
                k = counts[polarity, s + m]
                if k:
                    for c in range(contexts):
                        loglik[c] += k * logs[polarity, m, c]
        top = loglik[0]
        for c in range(contexts):
            top = max(top, loglik[c])
        for c in range(contexts):
            # Lower ones are negligible against an outlier.
            near = loglik[c] > top - _NEGLIGIBLE
            out[s, c] = math.log((1 - outlier) * math.exp(loglik[c] - top) + outlier) if near else least
        last = out[s, contexts - 1]
        for c in range(contexts):
            out[s, c] -= last


@njit
def score_characters(
    evidence: Column, places: Column, bits: int, parity: int, likeliest: bool, out: Column
) -> None:
    """Compute the log-likelihood ratio of any character that starts at a tick and of a constant light.

    The light may stay at mark or at space: a long pause has less noise than the marks after an edge, and is
    no character for that.

    Args:
        evidence: Log-likelihoods of every tick and context, float64 (n, C).
        places: Ticks from the start of a character to each of its bits, int64 (bits on air,).
        bits: Data bits.
        parity: Parity of the ones: 0 none, 1 odd, 2 even.
        likeliest: Whether to take the likeliest bits instead of the mean over all.
        out: The ratios, float64 (m,), with m + the last place <= n.
    """
    fair = -bits * math.log(2.0)
    n, contexts = evidence.shape
    by_context = np.ascontiguousarray(evidence.T)
    # Likelihoods are scaled to at most 1 per tick, so that no sum underflows.
    tops = np.empty(0 if likeliest else n)
    likely = np.empty((contexts, len(tops)))
    for s in range(len(tops)):
        tops[s] = evidence[s].max()
        for c in range(contexts):
            likely[c, s] = math.exp(evidence[s, c] - tops[s])
    # A state is the parity of the ones so far, and the last bits.
    states = np.empty((2, 2, contexts // 2, _GROUP_TICKS))
    sums = np.empty(_GROUP_TICKS)
    for first in range(0, len(out), _GROUP_TICKS):
        some = out[first : first + _GROUP_TICKS]
        _score_words(by_context, places, bits, parity, True, first, states, some)
        # The mean over all words matters only if a character is possible.
        if not likeliest and some.max() > 0:
            _score_words(likely, places, bits, parity, False, first, states, sums[: len(some)])
            for k in range(len(some)):
                if some[k] > 0:
                    some[k] = math.log(sums[k])
                    for place in places:
                        some[k] += tops[first + k + place]
        for k in range(len(some)):
            still = 0.0
            for place in places:
                still += by_context[0, first + k + place]
            some[k] += fair - max(still, 0.0)


@njit
def _score_words(
    by_context: Column,
    places: Column,
    bits: int,
    parity: int,
    likeliest: bool,
    first: int,
    states: Column,
    out: Column,
) -> None:
    """Score the likeliest word at some ticks by log-likelihoods, or sum the likelihoods of all words.

    Args:
        by_context: Log-likelihoods or likelihoods of every context and tick, float64 (C, n).
        places: Ticks from the start of a character to each of its bits, int64 (bits on air,).
        bits: Data bits.
        parity: 0 none, 1 odd, 2 even.
        likeliest: Whether to score the likeliest word, or else the sum.
        first: The first of the ticks.
        states: Room, float64 (2, 2, C / 2, >= m).
        out: The scores, float64 (m,).
    """
    known = states.shape[2]
    n = len(out)
    none = -np.inf if likeliest else 0.0
    states[0] = none
    # There is mark before the start bit.
    states[0, 0, known - 2, :n] = by_context[2 * known - 2, first : first + n]
    now = 0
    for b in range(1, len(places)):
        at = first + places[b]
        for odd in range(2):
            for to in range(known):
                new = states[1 - now, odd, to, :n]
                bit = to & 1
                if b > bits and bit != ((odd + parity) & 1 if parity and b == bits + 1 else 1):
                    new[:] = none
                    continue
                was = odd ^ bit if b <= bits else odd
                one, other = states[now, was, to >> 1, :n], states[now, was, (to + known) >> 1, :n]
                of_one, of_other = by_context[to, at : at + n], by_context[to + known, at : at + n]
                if likeliest:
                    for k in range(n):
                        new[k] = max(one[k] + of_one[k], other[k] + of_other[k])
                else:
                    for k in range(n):
                        new[k] = one[k] * of_one[k] + other[k] * of_other[k]
        now = 1 - now
    out[:] = none
    for odd in range(2):
        for state in range(known):
            for k in range(n):
                value = states[now, odd, state, k]
                out[k] = max(out[k], value) if likeliest else out[k] + value


@njit
def find_best_path(
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
    """Find the characters that explain a stretch best.

    Args:
        scores: Score of a character that starts at each tick, float64 (n,).
        tails: Score of a pause that starts at each tick, with the tails of edges before it, float64 (>= n,).
        length: Ticks from a character's start to the end of its last stop bit.
        first: The first tick at which one may start.
        near: Most ticks by which a successive character is early or late.
        after_idle: Cost of a character after a pause.
        after_one: Cost of a successive character.
        jitter: Cost of a tick early or late.
        pause: Ticks of the stated pause; 0 without one.
        after_pause: Cost of a character after just that pause.

    Returns:
        The starts, int64 (m,), and the score of the path relative to that of no characters.
    """
    n = len(scores)
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
            if e >= 0:
                follows = ended[e] - after_one - jitter * abs(d)
                if follows > value:
                    value, origin = follows, e - length
            e -= pause
            if pause and e >= 0:
                follows = ended[e] + tails[e] - after_pause - jitter * abs(d)
                if follows > value:
                    value, origin = follows, e - length
        value += scores[s]
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
