"""Successive-cancellation list decoding and the plausibility of its result: compiled."""

from math import exp, inf, log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]


@njit
def transform(bits: Array) -> None:
    """Multiply by the Kronecker power of [[1, 0], [1, 1]], in place; its own inverse."""
    half = 1
    while half < len(bits):
        for start in range(0, len(bits), 2 * half):
            for i in range(start, start + half):
                bits[i] ^= bits[i + half]
        half *= 2


@njit
def crc_holds(bits: Array, polynomial: int) -> bool:
    """Whether a message followed by its 24 check bits leaves nothing over."""
    register = 0xFFFFFF
    for i in range(len(bits)):
        feedback = (register >> 23) ^ bits[i]
        register = (register << 1) & 0xFFFFFF
        if feedback:
            register ^= polynomial
    return register == 0


@njit
def discrepancy_limit(weight: Array, log_share: float) -> float:
    """Largest total of flipped weights that is not an accident; negative if any total may be one.

    A word of random signs lies within D of a given codeword with a probability of at most
    exp(z D) prod((1 + exp(-z w)) / 2) for every z > 0 (Chernoff). The D is found at which the least of these
    is exp(`log_share`), or a little less. The bound falls with z, and D is the mean of the tilted weights.
    """
    total, received = 0.0, 0
    for w in weight:
        if w > 0.0:
            total += w
            received += 1
    if received * log(2.0) <= -log_share:
        return -1.0
    low, high = 0.0, inf
    z = 2.0 * received / total
    for _ in range(100):
        d, bound, slope, product = 0.0, -received * log(2.0), 0.0, 1.0
        for w in weight:
            if w > 0.0:
                e = exp(-z * w)
                p = e / (1.0 + e)
                d += w * p
                slope += w * w * p * (1.0 - p)
                product *= 1.0 + e
                if product > 1e250:
                    bound += log(product)
                    product = 1.0
        bound += log(product) + z * d
        if bound > log_share:
            low = z
        elif bound > log_share - 0.05:
            return d
        else:
            high = z
        z += (bound - log_share + 0.02) / (z * slope) if slope > 0.0 else inf
        if not low < z < high:
            z = (low + high) / 2 if high < inf else 2.0 * low
    return -1.0


FROZEN, REPEATED, FREE = 0, 1, 2
"""Kinds of nodes: inputs that are all 0; all 0 but the last; all information."""


@njit
def schedule(information: Array, nodes: Array) -> int:
    """Split the inputs into the largest nodes that are decided at once; their number.

    Args:
        information: Which inputs carry information, bool (N,).
        nodes: Filled with (first input, stage, kind) of each, int64 (N, 3).
    """
    n, at, first = len(information), 0, 0
    while first < n:
        stage = 0
        kind = REPEATED if information[first] else FROZEN
        while first >> stage & 1 == 0 and first + (2 << stage) <= n:
            size = 2 << stage
            inside = 0
            for i in range(first, first + size):
                inside += information[i]
            if inside == 0:
                kind = FROZEN
            elif inside == 1 and information[first + size - 1]:
                kind = REPEATED
            elif inside == size:
                kind = FREE
            else:
                break
            stage += 1
        nodes[at, 0], nodes[at, 1], nodes[at, 2] = first, stage, kind
        at += 1
        first += 1 << stage
    return at


@njit
def _either(first: Array, second: Array, out: Array) -> None:
    """LLR of the sum of two bits, min-sum."""
    for i in range(len(out)):
        a, b = first[i], second[i]
        least = min(abs(a), abs(b))
        out[i] = -least if (a < 0) != (b < 0) else least


@njit
def _both(first: Array, second: Array, known: Array, out: Array) -> None:
    """LLR of a bit seen twice, once added to a known one."""
    for i in range(len(out)):
        a, b = first[i], second[i]
        out[i] = b - a if known[i] else b + a


@njit
def _find_weakest(values: Array, found: Array) -> None:
    """Fill `found` with the places of the values next to 0, the nearest first."""
    count = 0
    for i in range(len(values)):
        at = min(count, len(found) - 1)
        if at < count and not abs(values[i]) < abs(values[found[at]]):
            continue
        while at > 0 and abs(values[i]) < abs(values[found[at - 1]]):
            found[at] = found[at - 1]
            at -= 1
        found[at] = i
        count = min(count + 1, len(found))


@njit
def _fork(
    metric: Array,
    zero: Array,
    one: Array,
    limit: float,
    alive: Array,
    bit: Array,
    origin: Array,
    cost: Array,
    which: Array,
) -> int:
    """Continue each path by bit 0 and bit 1, keep the best that have room; their number.

    `zero` and `one` are what the bits add to the metric. Where both continuations of a path stay, that by 1
    gets a free row; `origin` says of which path each row is the continuation.
    """
    size = len(metric)
    found = 0
    for path in range(size):
        if alive[path]:
            for value in range(2):
                c = metric[path] + (one[path] if value else zero[path])
                # Insertion: equal ones keep their order, so that the result is determined.
                i = found
                while i > 0 and cost[i - 1] > c:
                    cost[i] = cost[i - 1]
                    which[i] = which[i - 1]
                    i -= 1
                cost[i] = c
                which[i] = 2 * path + value
                found += 1
    # Bit 1 of `kept` stands for the continuation by 0, bit 2 for that by 1.
    kept = np.zeros(size, np.uint8)
    count = 0
    while count < min(found, size) and cost[count] <= limit:
        kept[which[count] >> 1] |= 1 << (which[count] & 1)
        count += 1
    for path in range(size):
        alive[path] = kept[path] > 0
        origin[path] = path
    free = 0
    for path in range(size):
        if kept[path] == 3:
            while alive[free]:
                free += 1
            alive[free] = True
            origin[free] = path
            metric[free] = metric[path] + one[path]
            bit[free] = 1
        if kept[path] & 1:
            metric[path] += zero[path]
            bit[path] = 0
        elif kept[path]:
            metric[path] += one[path]
            bit[path] = 1
    return count


@njit
def list_decode(llr: Array, nodes: Array, size: int, limit: float, codewords: Array, metric: Array) -> int:
    """Successive-cancellation list decoding; the paths kept, none if all exceed the limit.

    Tal and Vardy (2015), by LLRs and min-sum (Balatsoukas-Stimming et al. 2015): the metric of a whole path
    is the total of |llr| where its codeword differs from the sign of the LLR, and only grows along the path.
    Nodes whose inputs are all 0, or all but the last, or all free, are decided at once (Hashemi et al. 2016),
    with the same result.

    Args:
        llr: LLRs of the N code bits, float32.
        nodes: What `schedule` gives, int64 (nodes, 3).
        size: Most paths; 1 is successive cancellation.
        limit: A path whose metric exceeds it is dropped.
        codewords: Filled with each path's code bits, uint8 (size, N).
        metric: Filled with each path's metric, float64 (size,).
    """
    n = len(llr)
    stages = 0
    while 1 << stages < n:
        stages += 1
    # Stage s of a path lies at [2**s, 2**(s + 1)) of a row. All paths write a stage at one time, and read
    # only the stages above (LLRs) or below (partial sums), so that a clone can share rows with its parent.
    alpha = np.empty((size, 2 * n), np.float32)
    beta = np.empty((size, n), np.uint8)
    alpha_row = np.zeros((size, stages + 1), np.int64)
    beta_row = np.zeros((size, stages + 1), np.int64)
    for i in range(n):
        alpha[0, n + i] = llr[i]
    alive = np.zeros(size, np.bool_)
    alive[0] = True
    count = 1
    zero, one = np.zeros(size), np.zeros(size)
    bit = np.zeros(size, np.uint8)
    cost = np.empty(2 * size, np.float64)
    which = np.empty(2 * size, np.int64)
    origin = np.empty(size, np.int64)
    weakest = np.empty((size, size), np.int64)
    for path in range(size):
        metric[path] = 0.0
    for node in range(len(nodes)):
        first, stage, kind = nodes[node, 0], nodes[node, 1], nodes[node, 2]
        length = 1 << stage
        top = stages - 1
        if first:
            top = 0
            while not first >> top & 1:
                top += 1
        for path in range(size):
            if not alive[path]:
                continue
            for s in range(top, stage - 1, -1):
                half = 1 << s
                up = alpha[alpha_row[path, s + 1]]
                a, b = up[2 * half : 3 * half], up[3 * half : 4 * half]
                out = alpha[path, half : 2 * half]
                if s == top and first:
                    _both(a, b, beta[beta_row[path, s], half : 2 * half], out)
                else:
                    _either(a, b, out)
                alpha_row[path, s] = path
            row = alpha_row[path, stage]
            zero[path], one[path] = 0.0, 0.0
            if kind != FREE:
                for i in range(length, 2 * length):
                    value = alpha[row, i]
                    if value < 0:
                        zero[path] -= value
                    else:
                        one[path] += value
        if kind == FROZEN:
            count = 0
            for path in range(size):
                if alive[path]:
                    bit[path] = 0
                    metric[path] += zero[path]
                    alive[path] = metric[path] <= limit
                    count += alive[path]
        elif kind == REPEATED:
            count = _fork(metric, zero, one, limit, alive, bit, origin, cost, which)
            for path in range(size):
                if alive[path] and origin[path] != path:
                    for s in range(stages + 1):
                        alpha_row[path, s] = alpha_row[origin[path], s]
                        beta_row[path, s] = beta_row[origin[path], s]
        else:
            # Of `size` paths none goes against more than the `size - 1` weakest signs of such a node.
            splits = min(size - 1, length)
            for path in range(size):
                if alive[path]:
                    row = alpha_row[path, stage]
                    for i in range(length):
                        codewords[path, i] = alpha[row, length + i] < 0
                    if splits:
                        _find_weakest(alpha[row, length : 2 * length], weakest[path, :splits])
            for split in range(splits):
                for path in range(size):
                    if alive[path]:
                        row = alpha_row[path, stage]
                        zero[path], one[path] = 0.0, abs(alpha[row, length + weakest[path, split]])
                count = _fork(metric, zero, one, limit, alive, bit, origin, cost, which)
                for path in range(size):
                    if alive[path] and origin[path] != path:
                        other = origin[path]
                        for s in range(stages + 1):
                            alpha_row[path, s] = alpha_row[other, s]
                            beta_row[path, s] = beta_row[other, s]
                        for s in range(size):
                            weakest[path, s] = weakest[other, s]
                        for i in range(length):
                            codewords[path, i] = codewords[other, i]
                for path in range(size):
                    if alive[path] and bit[path]:
                        codewords[path, weakest[path, split]] ^= 1
        if count == 0:
            return 0
        for path in range(size):
            if not alive[path]:
                continue
            if kind != FREE:
                for i in range(length):
                    codewords[path, i] = bit[path]
            s = stage
            while first >> s & 1:
                half = 1 << s
                row = beta_row[path, s]
                for i in range(half):
                    codewords[path, half + i] = codewords[path, i]
                    codewords[path, i] ^= beta[row, half + i]
                s += 1
            if s < stages:
                for i in range(1 << s):
                    beta[path, (1 << s) + i] = codewords[path, i]
                beta_row[path, s] = path
    at = 0
    for path in range(size):
        if alive[path]:
            for i in range(n):
                codewords[at, i] = codewords[path, i]
            metric[at] = metric[path]
            at += 1
    return at
