"""Successive-cancellation list decoding, compiled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]

FROZEN, REPEATED, FREE = 0, 1, 2
"""Kinds of nodes: inputs that are all 0; all 0 but the last; all information."""


@njit
def _fork_paths(metric: Array, penalty: Array, limit: float, alive: Array, rows: Array, fork: Array) -> int:
    """Continue each path by bit 0 and bit 1, and keep the best that have room; return how many.

    `penalty` (2, size) is what the bits add to the metric. Where both continuations of a path stay, that by 1
    gets a free row, and shares `rows`; `fork` (2, size) takes the path each row continues, and the bit.
    """
    size, origin, bit = len(metric), fork[0], fork[1]
    cost, which = np.empty(2 * size), np.empty(2 * size, np.int64)
    found = 0
    # Bit 1 of `kept` stands for the continuation by 0, bit 2 for that by 1.
    kept = np.empty(size, np.int64)
    for path in range(size):
        kept[path] = 0
        if alive[path]:
            for value in range(2):
                c = metric[path] + penalty[value, path]
                # Insertion: equal ones keep their order, so that the result is determined.
                i = found
                while i > 0 and cost[i - 1] > c:
                    cost[i] = cost[i - 1]
                    which[i] = which[i - 1]
                    i -= 1
                cost[i] = c
                which[i] = 2 * path + value
                found += 1
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
            metric[free] = metric[path] + penalty[1, path]
            bit[free] = 1
            for s in range(rows.shape[2]):
                rows[0, free, s], rows[1, free, s] = rows[0, path, s], rows[1, path, s]
        if kept[path]:
            value = 0 if kept[path] & 1 else 1
            metric[path] += penalty[value, path]
            bit[path] = value
    return count


@njit
def _decide_node(
    stage: int,
    repeated: bool,
    alpha: Array,
    rows: Array,
    limit: float,
    metric: Array,
    alive: Array,
    penalty: Array,
    fork: Array,
    codewords: Array,
) -> int:
    """Decide a node in the first code bits of each path; return the number of paths kept.

    If its inputs are all 0 but the last (`repeated`), its code bits are all the same. Else they are all free:
    of `size` paths none goes against more than the `size - 1` weakest signs.
    """
    size, length = len(metric), 1 << stage
    splits = 0 if repeated else min(size - 1, length)
    weakest = np.empty((size, splits), np.int64)
    count = 0
    for path in range(size):
        if not alive[path]:
            continue
        count += 1
        values, found, many = alpha[rows[0, path, stage], length:], weakest[path], 0
        penalty[0, path] = penalty[1, path] = 0.0
        for i in range(length):
            codewords[path, i] = values[i] < 0
            if repeated:
                penalty[int(values[i] >= 0), path] += abs(values[i])
            # The places of the values next to 0, the nearest first.
            at = min(many, splits - 1)
            if splits == 0 or (at < many and not abs(values[i]) < abs(values[found[at]])):
                continue
            while at > 0 and abs(values[i]) < abs(values[found[at - 1]]):
                found[at] = found[at - 1]
                at -= 1
            found[at] = i
            many = min(many + 1, splits)
    if repeated:
        count = _fork_paths(metric, penalty, limit, alive, rows, fork)
        for path in range(size):
            if alive[path]:
                for i in range(length):
                    codewords[path, i] = fork[1, path]
    for split in range(splits):
        for path in range(size):
            if alive[path]:
                penalty[0, path] = 0.0
                penalty[1, path] = abs(alpha[rows[0, path, stage], length + weakest[path, split]])
        count = _fork_paths(metric, penalty, limit, alive, rows, fork)
        for path in range(size):
            other = fork[0, path]
            if alive[path] and other != path:
                for i in range(splits):
                    weakest[path, i] = weakest[other, i]
                for i in range(length):
                    codewords[path, i] = codewords[other, i]
        for path in range(size):
            if alive[path] and fork[1, path]:
                codewords[path, weakest[path, split]] ^= 1
    return count


@njit
def list_decode(llr: Array, nodes: Array, size: int, limit: float, codewords: Array, metric: Array) -> int:
    """Successive-cancellation list decoding; returns the number of paths, 0 if all exceed the limit.

    Tal and Vardy (2015), by LLRs and min-sum (Balatsoukas-Stimming et al. 2015): the metric of a whole path
    is the total of |llr| where its codeword differs from the sign of the LLR, and only grows along the path.
    Nodes whose inputs are all 0, or all but the last, or all free, are decided at once (Hashemi et al. 2016).

    `nodes` are (first input, stage, kind) of each, int64 (nodes, 3), of a code of float32 LLRs (N,). A path
    whose metric exceeds `limit` is dropped, and `size` at most are kept, 1 for successive cancellation.
    `codewords`, uint8 (size, N), and `metric`, float64 (size,), take code bits and metric of each path.
    """
    n, stages = len(llr), 0
    while 1 << stages < n:
        stages += 1
    # Stage s of a path lies at [2**s, 2**(s + 1)) of a row. All paths write a stage at one time, and read
    # only the stages above (LLRs) or below (partial sums), so that a clone can share rows with its parent:
    # `rows` of `alpha` and of `beta`.
    alpha, beta = np.empty((size, 2 * n), np.float32), np.empty((size, n), np.uint8)
    rows, alive = np.zeros((2, size, stages + 1), np.int64), np.empty(size, np.bool_)
    penalty, fork = np.empty((2, size)), np.empty((2, size), np.int64)
    for i in range(n):
        alpha[0, n + i] = llr[i]
    for path in range(size):
        alive[path], metric[path] = path == 0, 0.0
    for node in range(len(nodes)):
        first, stage, kind = nodes[node, 0], nodes[node, 1], nodes[node, 2]
        top = stages - 1
        if first:
            top = 0
            while not first >> top & 1:
                top += 1
        for path in range(size):
            for s in range(top, stage - 1 if alive[path] else top, -1):
                half = 1 << s
                up, out = alpha[rows[0, path, s + 1]], alpha[path, half : 2 * half]
                one, other = up[2 * half : 3 * half], up[3 * half : 4 * half]
                known = beta[rows[1, path, s], half : 2 * half]
                for i in range(half):
                    a, b = one[i], other[i]
                    if s == top and first:
                        # A bit seen twice, once added to a known one.
                        out[i] = b - a if known[i] else b + a
                    else:
                        # The sum of two bits, min-sum.
                        least = min(abs(a), abs(b))
                        out[i] = -least if (a < 0) != (b < 0) else least
                rows[0, path, s] = path
        count = 0
        if kind != FROZEN:
            repeated = kind == REPEATED
            count = _decide_node(stage, repeated, alpha, rows, limit, metric, alive, penalty, fork, codewords)
        else:
            for path in range(size):
                if alive[path]:
                    row, zero = alpha[rows[0, path, stage]], 0.0
                    for i in range(1 << stage):
                        zero -= min(row[(1 << stage) + i], 0.0)
                        codewords[path, i] = 0
                    metric[path] += zero
                    alive[path] = metric[path] <= limit
                    count += int(alive[path])
        if count == 0:
            return 0
        for path in range(size):
            if not alive[path]:
                continue
            s = stage
            while first >> s & 1:
                half = 1 << s
                left = beta[rows[1, path, s]]
                for i in range(half):
                    codewords[path, half + i] = codewords[path, i]
                    codewords[path, i] ^= left[half + i]
                s += 1
            if s < stages:
                for i in range(1 << s):
                    beta[path, (1 << s) + i] = codewords[path, i]
                rows[1, path, s] = path
    at = 0
    for path in range(size):
        if alive[path]:
            for i in range(n):
                codewords[at, i] = codewords[path, i]
            metric[at] = metric[path]
            at += 1
    return at
