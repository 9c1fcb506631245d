"""Compiled loops over grid cells, pixels and the times of events, and Cholesky's root of a few unknowns."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]


@njit
def update_posterior(observed: Array, prior: Array, out: Array) -> None:
    """Update the probability of each cluster in each cell by Bayes' rule: `out`.

    `observed` is the probability by the evidence alone, `prior` that by the place alone; all are (K, rows,
    columns). The evidence is as likely without a cluster as with each one at equal priors, and neither a cell
    that fits a code in all its values nor a place is sure to show a cluster.
    """
    clusters, rows, columns = prior.shape
    # Flat, cells go side by side.
    cells = rows * columns
    observed_of = np.ascontiguousarray(observed).reshape(clusters, cells)
    prior_of = np.ascontiguousarray(prior).reshape(clusters, cells)
    out_of = out.reshape(clusters, cells)
    place, share = np.zeros(cells), np.zeros(cells)
    out[:] = 0
    for k in range(clusters):
        for j in range(cells):
            place[j] += prior_of[k, j]
            share[j] += observed_of[k, j]
    for j in range(cells):
        if place[j] == 0:
            continue
        odds = clusters / max(1 - share[j], 1e-6)
        unobserved = 0.0 if share[j] > 0 else 1.0
        total = max(1 - place[j], 1e-6)
        for k in range(clusters):
            if prior_of[k, j] != 0:
                total += prior_of[k, j] * (observed_of[k, j] * odds + unobserved)
        for k in range(clusters):
            if prior_of[k, j] != 0:
                out_of[k, j] = prior_of[k, j] * (observed_of[k, j] * odds + unobserved) / total


@njit
def convert_ordered(
    t_us: Array, x: Array, y: Array, width: int, height: int, origin_us: int, out: Array
) -> bool:
    """Convert times to those since an origin; False if an event is off the sensor or before its predecessor.

    Without a branch, so that it is quick.
    """
    backward = False
    if t_us.size:
        out[0] = t_us[0] - origin_us
    for i in range(1, t_us.size):
        backward |= t_us[i] < t_us[i - 1]
        out[i] = t_us[i] - origin_us
    # The farthest of many small numbers is found in a fraction of the time in which each is compared.
    right, low = np.uint16(0), np.uint16(0)
    for i in range(x.size):
        right = max(right, x[i])
    for i in range(y.size):
        low = max(low, y[i])
    return not (backward or (t_us.size > 0 and (right >= width or low >= height)))


@njit
def judge_events(
    t_us: Array,
    x: Array,
    y: Array,
    width: int,
    height: int,
    limits: tuple[int, int, int, int, int, int, int],
    state: Array,
    verdicts: Array,
) -> tuple[int, bool]:
    """Judge events one by one: 0 before its predecessor, 1 off the sensor, 2 doubtful, 3 kept, 4 held.

    Args:
        t_us: Camera clock, int64 (n,).
        x: Columns, uint16 (n,).
        y: Rows, uint16 (n,).
        width: Columns of the sensor.
        height: Its rows.
        limits: (longest pause; longest pause among held events; longest setback; events that confirm a leap,
            and the time they span; most held events; farthest time).
        state: Time of the last kept event, of the first and the last held one, number of held ones; int64
            (4,), updated. The number becomes -1 where an event confirms those held: it is the last one
            judged.
        verdicts: Takes the verdicts, uint8 (n,).

    Returns:
        (events judged, whether those held from earlier calls have become doubtful).
    """
    pause_us, held_pause_us, setback_us, agree_events, agree_us, most_held, farthest_us = limits
    last, first_held, last_held, held = state[0], state[1], state[2], state[3]
    since, lost, done = 0, False, t_us.size
    for i in range(t_us.size):
        t = t_us[i]
        is_next = last <= t <= last + pause_us
        if x[i] >= width or y[i] >= height:
            verdicts[i] = 1
        elif t > farthest_us or t < -farthest_us:
            verdicts[i] = 2
        elif not is_next and (
            last - setback_us <= t < last or (held and last_held - setback_us <= t < last_held)
        ):
            verdicts[i] = 0
        else:
            if held and (is_next or not last_held <= t <= last_held + held_pause_us):
                lost = lost or since == 0
                for k in range(since, i):
                    verdicts[k] = 2 if verdicts[k] == 4 else verdicts[k]
                held = 0
            if is_next:
                verdicts[i] = 3
                last = t
                continue
            if not held:
                first_held = t
                since = i
            verdicts[i] = 4
            last_held = t
            held += 1
            if (held >= agree_events and t - first_held >= agree_us) or held >= most_held:
                held = -1
                done = i + 1
                break
    state[0], state[1], state[2], state[3] = last, first_held, last_held, held
    return done, lost


@njit
def median(values: Array, n: int) -> float:
    """Median of the first n values; that of NumPy takes three seconds to compile."""
    some, middle, first, last = np.empty(n), n // 2, 0, n - 1
    for i in range(n):
        some[i] = values[i]
    # Hoare's selection: in the end, none before the middle is larger than it, and none behind it smaller.
    while first < last:
        pivot, low, high = some[(first + last) // 2], first, last
        while low <= high:
            while some[low] < pivot:
                low += 1
            while some[high] > pivot:
                high -= 1
            if low <= high:
                some[low], some[high] = some[high], some[low]
                low, high = low + 1, high - 1
        if high < middle < low:
            break
        first, last = (first, high) if middle <= high else (low, last)
    below = some[middle]
    if n % 2 == 0:
        below = some[0]
        for i in range(1, middle):
            below = max(below, some[i])
    return float((below + some[middle]) / 2)


@njit
def pair_values(first: Array, second: Array, out: Array) -> None:
    """Values of pairs of polarity sums, `out` int8 (n,): the second's sign, else the opposite of the first's.

    Long loops over flat arrays run on many pixels at once; those over a bar's few columns do not.
    """
    for j in range(out.size):
        a, b = first[j], second[j]
        up = np.int8(b > 0) - np.int8(b < 0)
        down = np.int8(a < 0) - np.int8(a > 0)
        out[j] = up + down * np.int8(b == 0)


@njit
def correlate_code(code: Array, values: Array, begin: int, out: Array) -> None:
    """Agreement of values (n, pixels), from `begin` on, with a code (n,), `out` int16: alike less unlike."""
    for j in range(out.size):
        out[j] = 0
    for i in range(code.size):
        value = values[i, begin:]
        if code[i] > 0:
            for j in range(out.size):
                out[j] = np.int16(out[j] + value[j])
        elif code[i] < 0:
            for j in range(out.size):
                out[j] = np.int16(out[j] - value[j])


@njit
def factor_cholesky(matrix: Array, damping: float, least: float, scale: Array, low: Array) -> bool:
    """Factor a symmetric matrix, scaled to a diagonal of 1 + `damping`, by Cholesky; False if it has no root.

    `low` (n, n) takes the root, on and below its diagonal, of the matrix scaled by `scale` (n,) on both
    sides. There is none where less than `least` of a diagonal of 1 is left: that much is rounding.
    """
    n = len(scale)
    for i in range(n):
        if not matrix[i, i] > 0:
            return False
        scale[i] = 1 / np.sqrt(matrix[i, i])
    for i in range(n):
        for j in range(i + 1):
            value = matrix[i, j] * scale[i] * scale[j]
            if i == j:
                value = 1 + damping
            for k in range(j):
                value -= low[i, k] * low[j, k]
            if i == j:
                if not value > least:
                    return False
                low[i, i] = np.sqrt(value)
            else:
                low[i, j] = value / low[j, j]
    return True


@njit
def solve_cholesky(low: Array, scale: Array, side: Array, out: Array) -> None:
    """Solve the equations that `factor_cholesky` has factored for a right-hand side: `out` (n,)."""
    n = len(side)
    for i in range(n):
        value = side[i] * scale[i]
        for k in range(i):
            value -= low[i, k] * out[k]
        out[i] = value / low[i, i]
    for i in range(n - 1, -1, -1):
        value = out[i]
        for k in range(i + 1, n):
            value -= low[k, i] * out[k]
        out[i] = value / low[i, i]
    for i in range(n):
        out[i] *= scale[i]


@njit
def invert_matrix(matrix: Array, least: float, out: Array) -> bool:
    """Invert a positive definite matrix; False if it is singular, see `factor_cholesky`."""
    n = len(matrix)
    scale, low = np.zeros(n), np.zeros((n, n))
    if not factor_cholesky(matrix, 0.0, least, scale, low):
        return False
    for k in range(n):
        side = np.zeros(n)
        side[k] = 1.0
        solve_cholesky(low, scale, side, out[k])
    return True
