"""Kernels: evidence of a bit and of a character at every tick, and the best path through them."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Column = NDArray[Any]

_NOTHING = 30.0
"""Nats by which what is less likely is left out: 1e-13 of it, against an outlier of a thousandth."""

_AT_ONCE = 64
"""Ticks of which words are followed side by side, as a processor adds several numbers at once."""


@njit
def bit_evidence(
    counts: Column, logs: Column, gains: Column, means: Column, share: float, outlier: float, out: Column
) -> None:
    """Log-likelihood of the window behind every tick for each context of a bit, less that of the last one.

    Args:
        counts: Events of each tick, OFF and ON, int32 (2, n).
        logs: Logarithm of the mean events of each tick of a window, by polarity, tick and context, each
            counted as `share`, float64 (2, W, C).
        gains: Logarithms of the gains that a window may have, float64 (J,).
        means: What a window costs by context and gain: its mean events, each counted as `share`, less the
            logarithm of the gain's share, float64 (C, J).
        share: What an event counts.
        outlier: Probability that a window is of no context.
        out: Of each tick that has W of them before the end, float64 (n - W + 1, C).
    """
    _, width, contexts = logs.shape
    # What the gains make of a context depends on how many events there are, not on when they come.
    many = np.zeros(len(out), np.int64)
    for m in range(width):
        many += counts[0, m : m + len(out)] + counts[1, m : m + len(out)]
    of_gains = np.empty((many.max() + 1 if len(out) else 0, contexts))
    is_known = np.zeros(len(of_gains), np.bool_)
    worth = np.empty(contexts)
    least = math.log(outlier)
    for s in range(len(out)):
        events = many[s]
        if s and not events and not many[s - 1]:
            out[s] = out[s - 1]
            continue
        for c in range(0 if is_known[events] else contexts):
            # The logarithm of the sum over gains of what they make of so many events.
            most, total = -np.inf, 0.0
            for j in range(len(gains)):
                most = max(most, share * events * gains[j] - means[c, j])
            for j in range(len(gains)):
                total += math.exp(share * events * gains[j] - means[c, j] - most)
            of_gains[events, c] = most + math.log(total)
        is_known[events] = True
        for c in range(contexts):
            worth[c] = of_gains[events, c]
        for polarity in range(2):
            for m in range(width):
                k = counts[polarity, s + m]
                if k:
                    for c in range(contexts):
                        worth[c] += k * logs[polarity, m, c]
        top = worth[0]
        for c in range(contexts):
            top = max(top, worth[c])
        for c in range(contexts):
            # What is less is nothing beside an outlier.
            near = worth[c] > top - _NOTHING
            out[s, c] = math.log((1 - outlier) * math.exp(worth[c] - top) + outlier) if near else least
        last = out[s, contexts - 1]
        for c in range(contexts):
            out[s, c] -= last


@njit
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
    n, contexts = evidence.shape
    by_context = np.ascontiguousarray(evidence.T)
    # Sums are of likelihoods, of which the greatest of a tick is 1: of no word they are too small.
    tops = np.empty(0 if likeliest else n)
    likely = np.empty((contexts, len(tops)))
    for s in range(len(tops)):
        tops[s] = evidence[s].max()
        for c in range(contexts):
            likely[c, s] = math.exp(evidence[s, c] - tops[s])
    # A state is the parity of the ones so far and the last bits.
    states = np.empty((2, 2, contexts // 2, _AT_ONCE))
    sums = np.empty(_AT_ONCE)
    for first in range(0, len(out), _AT_ONCE):
        some = out[first : first + _AT_ONCE]
        _words(by_context, places, bits, parity, True, first, states, some)
        # The mean over all words matters only where a character may be.
        if not likeliest and some.max() > 0:
            _words(likely, places, bits, parity, False, first, states, sums[: len(some)])
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
def _words(
    by_context: Column,
    places: Column,
    bits: int,
    parity: int,
    likeliest: bool,
    first: int,
    states: Column,
    out: Column,
) -> None:
    """The likeliest word at some ticks by log-likelihoods, or the sum of all words' likelihoods.

    Args:
        by_context: Of every context and tick, float64 (C, n).
        places: Ticks from the start of a character to each of its bits, int64 (bits on air,).
        bits: Data bits.
        parity: 0 none, 1 odd, 2 even.
        likeliest: The likeliest word, not the sum.
        first: The first of the ticks.
        states: Room to work in, float64 (2, 2, C / 2, >= m).
        out: Of each of the ticks, float64 (m,).
    """
    known = states.shape[2]
    n = len(out)
    none = -np.inf if likeliest else 0.0
    states[0] = none
    # Before the start bit there was mark.
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
