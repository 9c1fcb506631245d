"""Successive-cancellation list decoding and the plausibility of its result: compiled."""

from math import exp, log, log1p
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]


@njit(cache=True, nogil=True)
def transform(bits: Array) -> None:
    """Multiply by the Kronecker power of [[1, 0], [1, 1]], in place; its own inverse."""
    half = 1
    while half < len(bits):
        for start in range(0, len(bits), 2 * half):
            for i in range(start, start + half):
                bits[i] ^= bits[i + half]
        half *= 2


@njit(cache=True, nogil=True)
def crc_holds(bits: Array, polynomial: int) -> bool:
    """Whether a message followed by its 24 check bits leaves nothing over."""
    register = 0xFFFFFF
    for i in range(len(bits)):
        feedback = (register >> 23) ^ bits[i]
        register = (register << 1) & 0xFFFFFF
        if feedback:
            register ^= polynomial
    return register == 0


@njit(cache=True, nogil=True)
def discrepancy_limit(weight: Array, log_share: float) -> float:
    """Largest total of flipped weights that is no accident; negative if any total may be one.

    A word of random signs lies within D of a given codeword with a probability of at most
    exp(z D) prod((1 + exp(-z w)) / 2) for every z > 0 (Chernoff). The D is found at which the least of these
    is exp(`log_share`). The bound falls with z, and D is the mean of the tilted weights there.
    """
    total, received = 0.0, 0
    for w in weight:
        if w > 0.0:
            total += w
            received += 1
    if received * log(2.0) <= -log_share:
        return -1.0
    low, high = 0.0, 0.0
    z = received / total
    for _ in range(60):
        d, bound, slope = 0.0, 0.0, 0.0
        for w in weight:
            if w > 0.0:
                e = exp(-z * w)
                p = e / (1.0 + e)
                d += w * p
                bound += log1p(e)
                slope += w * w * p * (1.0 - p)
        bound += z * d - received * log(2.0)
        if bound > log_share:
            low = z
        else:
            high = z
        if abs(bound - log_share) < 1e-3:
            break
        z += (bound - log_share) / (z * slope) if slope > 0.0 else -z
        if z <= low or (high > 0.0 and z >= high):
            z = (low + high) / 2 if high > 0.0 else 2 * low
    return d


@njit(cache=True, nogil=True)
def list_decode(
    llr: Array, information: Array, size: int, limit: float, codewords: Array, inputs: Array, metric: Array
) -> int:
    """Successive-cancellation list decoding (Tal and Vardy 2015), min-sum, metric by LLRs; the paths kept.

    Args:
        llr: LLRs of the N code bits, float32.
        information: Which of the N inputs carry information, bool; the others are 0.
        size: Most paths; 1 is successive cancellation.
        limit: A path whose metric exceeds it is dropped; none may be left.
        codewords: Filled with each path's code bits, uint8 (size, N).
        inputs: Filled with each path's information bits, uint8 (size, K).
        metric: Filled with each path's metric, the total of |llr| where its codeword differs from the sign of
            the LLR, float64 (size,).
    """
    n = len(llr)
    stages = 0
    while 1 << stages < n:
        stages += 1
    # Stage s of a path lies at [2**s, 2**(s + 1)) of a row. All paths write a stage at one time, and read
    # only the stages above (LLRs) or below (partial sums), so that a clone can share rows with its parent.
    alpha = np.empty((size, n), np.float32)
    beta = np.empty((size, n), np.uint8)
    alpha_row = np.zeros((size, stages + 1), np.int64)
    beta_row = np.zeros((size, stages + 1), np.int64)
    alive = np.zeros(size, np.bool_)
    alive[0] = True
    count = 1
    k = inputs.shape[1]
    parent = np.empty((k, size), np.uint8)
    choice = np.empty((k, size), np.uint8)
    decided = 0
    bit = np.zeros(size, np.uint8)
    cost = np.empty(2 * size, np.float64)
    which = np.empty(2 * size, np.int64)
    keep = np.empty((size, 2), np.bool_)
    metric[:] = 0.0
    for phi in range(n):
        top = stages - 1
        if phi:
            top = 0
            while not phi >> top & 1:
                top += 1
        for path in range(size):
            if not alive[path]:
                continue
            for s in range(top, -1, -1):
                half = 1 << s
                above = llr if s + 1 == stages else alpha[alpha_row[path, s + 1], 2 * half : 4 * half]
                out = alpha[path, half : 2 * half]
                if s == top and phi:
                    left = beta[beta_row[path, s], half : 2 * half]
                    for i in range(half):
                        out[i] = above[half + i] - above[i] if left[i] else above[half + i] + above[i]
                else:
                    for i in range(half):
                        a, b = above[i], above[half + i]
                        least = min(abs(a), abs(b))
                        out[i] = -least if (a < 0) != (b < 0) else least
                alpha_row[path, s] = path
        if not information[phi]:
            for path in range(size):
                if alive[path]:
                    bit[path] = 0
                    leaf = alpha[path, 1]
                    if leaf < 0:
                        metric[path] -= leaf
        else:
            found = 0
            for path in range(size):
                if alive[path]:
                    leaf = alpha[path, 1]
                    bit[path] = leaf < 0
                    for other in range(2):
                        c = metric[path] + (abs(leaf) if other else 0.0)
                        # Insertion: equal ones keep their order, so that the result is determined.
                        i = found
                        while i > 0 and cost[i - 1] > c:
                            cost[i] = cost[i - 1]
                            which[i] = which[i - 1]
                            i -= 1
                        cost[i] = c
                        which[i] = 2 * path + other
                        found += 1
            keep[:] = False
            for i in range(min(found, size)):
                if cost[i] <= limit:
                    keep[which[i] >> 1, which[i] & 1] = True
            count = 0
            for path in range(size):
                alive[path] = alive[path] and (keep[path, 0] or keep[path, 1])
                parent[decided, path] = path
            free = 0
            for path in range(size):
                if not (keep[path, 0] or keep[path, 1]):
                    continue
                count += keep[path, 0]
                count += keep[path, 1]
                if keep[path, 0] and keep[path, 1]:
                    while alive[free]:
                        free += 1
                    alive[free] = True
                    alpha_row[free] = alpha_row[path]
                    beta_row[free] = beta_row[path]
                    metric[free] = metric[path] + abs(alpha[path, 1])
                    bit[free] = 1 - bit[path]
                    parent[decided, free] = path
                elif keep[path, 1]:
                    metric[path] += abs(alpha[path, 1])
                    bit[path] = 1 - bit[path]
            choice[decided] = bit
            decided += 1
        if size == 1 and metric[0] > limit:
            return 0
        if count == 0:
            return 0
        for path in range(size):
            if not alive[path]:
                continue
            x = codewords[path]
            x[0] = bit[path]
            s = 0
            while phi >> s & 1:
                left = beta[beta_row[path, s], 1 << s : 2 << s]
                for i in range(1 << s):
                    x[(1 << s) + i] = x[i]
                    x[i] ^= left[i]
                s += 1
            if s < stages:
                for i in range(1 << s):
                    beta[path, (1 << s) + i] = x[i]
                beta_row[path, s] = path
    # Traced back into other rows only after every path's codeword is complete.
    at = 0
    for path in range(size):
        if not alive[path] or metric[path] > limit:
            continue
        row = path
        for i in range(k - 1, -1, -1):
            inputs[at, i] = choice[i, row]
            row = parent[i, row]
        codewords[at] = codewords[path]
        metric[at] = metric[path]
        at += 1
    return at
