"""The fit of a pose to image points, compiled: normal equations, Levenberg-Marquardt, what each part says.

The unknowns, in this order, are GLOBAL = 14: the position, m; a small turn of the camera about east, north
and up, radians; a focal length that is other than said, in sigmas of `fault`, which is free in no fit but
whose column says what such a fault would do; and the camera's seven errors in their own sigmas. Beside them
each bar has LOCAL = 9: a shift of its image to the right and down, errors of its length, of its place to the
east, north and up, and of its attitude about these; all in their own sigmas. These are eliminated bar by bar.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk._kernels import inverted, rooted, substituted
from evlcp_sdk.kernels import njit

Array = NDArray[Any]

POSE, FAULT, LENS, GLOBAL, LOCAL = 6, 6, 7, 14, 9

_GOLDEN = (math.sqrt(5) - 1) / 2

_ROUNDING = 1e-14
"""Share of a diagonal that rounding may leave of nothing."""

_HALVINGS = 12
"""Steps of a golden section: from 10 degrees to a 30th of one."""


@njit
def normal(
    points: Array, bar: Array, bar_sigma: Array, lens: Array, lens_root: Array, fault: float,
    felt: Array, heading: float, known: int, white: Array, huber: float,
    position: Array, rotation: Array, local: Array, error: Array,
    info: Array, right: Array, gain: Array, step: Array, cost: Array, rows: Array, miss: Array, pixel: Array,
) -> float:  # fmt: skip
    """Normal equations at a point; twice the robust cost, or NaN where a point is behind the camera.

    In: `points` (n, 10) of place, arm from the bar's centre, m, image, px, 1 / sigma, and the share of its
    variance that stands; `bar` (n,), rising; `bar_sigma` (bars, 9), as of `shared`; `lens` (8,) of focal
    length, px, principal point, k1, k2, p1, p2, k3; `lens_root` (7, 7), a root of the covariance of the first
    seven; `felt` (3,) up in the camera's axes, `heading`, radians, `known` rows of these, and `white` (3, 3),
    which whitens them. The point: `position` (3,), `rotation` (3, 3), `local` (bars, 9), `error` (7,).

    Out, bar by bar with its local unknowns eliminated: `info` (bars, 14, 14), `right` (bars, 14), `gain`
    (bars, 9, 14) and `step` (bars, 9), by which the local unknowns follow, `cost` (bars,), and, unless it is
    empty, `pixel` (bars, 14, 14), the information that counts errors of pixels only. `rows` (3, 14) and
    `miss` (3,) are those of the attitude.
    """
    n, bars = len(points), len(cost)
    wide = max(_unknowns(lens_root), LENS)
    asked = len(pixel) > 0
    now = lens.copy()
    for i in range(7):
        for j in range(i + 1):
            now[i] += lens_root[i, j] * error[j]
    f, cx, cy, k1, k2, p1, p2, k3 = now
    scale_f = fault * lens[0]
    # Of a bar's points: what is its own, the unknowns of all, the miss; first all columns, then all rows.
    row, stays = np.zeros((LOCAL + GLOBAL + 1, 2 * n)), np.zeros(2 * n)
    sums = np.zeros((LOCAL + GLOBAL + 1, LOCAL + GLOBAL + 1))
    slow = np.zeros((LOCAL + GLOBAL + 1, LOCAL + GLOBAL + 1))
    by_lens = np.zeros((2, 7))
    total = 0.0
    at = 0
    for b in range(bars):
        sp, st, sl, sxx, sxy, syy, gxx, gxy, gyy = bar_sigma[b]
        tall = LOCAL if sp > 0 or st > 0 else 3
        last = tall + wide
        sum_ = 0.0
        for i in range(LOCAL):
            sum_ += local[b, i] ** 2
        wx, wy, wz = st * local[b, 6], st * local[b, 7], st * local[b, 8]
        grow = sl * local[b, 2]
        count, k = 0, 0
        while at + count < n and bar[at + count] == b:
            count += 1
        while k < count:
            ax, ay, az = points[at, 3], points[at, 4], points[at, 5]
            ox = points[at, 0] - position[0] + sp * local[b, 3] + grow * ax + wy * az - wz * ay
            oy = points[at, 1] - position[1] + sp * local[b, 4] + grow * ay + wz * ax - wx * az
            oz = points[at, 2] - position[2] + sp * local[b, 5] + grow * az + wx * ay - wy * ax
            x = rotation[0, 0] * ox + rotation[1, 0] * oy + rotation[2, 0] * oz
            y = rotation[0, 1] * ox + rotation[1, 1] * oy + rotation[2, 1] * oz
            z = rotation[0, 2] * ox + rotation[1, 2] * oy + rotation[2, 2] * oz
            if not z > 0:
                return math.nan
            u, v = x / z, y / z
            r2 = u * u + v * v
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            growth = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
            bent_u = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
            bent_v = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
            w = points[at, 8]
            px = (points[at, 6] - (cx + f * bent_u) - sxx * local[b, 0] - sxy * local[b, 1]) * w
            py = (points[at, 7] - (cy + f * bent_v) - sxy * local[b, 0] - syy * local[b, 1]) * w
            mx, my = gxx * px + gxy * py, gxy * px + gyy * py
            size = math.sqrt(mx * mx + my * my)
            weight = 1.0
            if size > huber:
                weight = huber / size
                sum_ += huber * (2 * size - huber)
            else:
                sum_ += size * size
            stays[k] = stays[count + k] = points[at, 9] * weight
            weight = math.sqrt(weight)
            w *= weight
            row[last, k], row[last, count + k] = mx * weight, my * weight
            cross = u * v * growth + 2 * p1 * u + 2 * p2 * v
            uu = radial + u * u * growth + 2 * p1 * v + 6 * p2 * u
            vv = radial + v * v * growth + 6 * p1 * v + 2 * p2 * u
            for i in range(2):
                a = k + i * count
                gx, gy = (gxx, gxy) if i == 0 else (gxy, gyy)
                by_u, by_v = f * w / z * (gx * uu + gy * cross), f * w / z * (gx * cross + gy * vv)
                by_z = -(by_u * u + by_v * v)
                e = by_u * rotation[0, 0] + by_v * rotation[0, 1] + by_z * rotation[0, 2]
                no = by_u * rotation[1, 0] + by_v * rotation[1, 1] + by_z * rotation[1, 2]
                up = by_u * rotation[2, 0] + by_v * rotation[2, 1] + by_z * rotation[2, 2]
                row[2, a] = (e * ax + no * ay + up * az) * sl
                if tall == LOCAL:
                    row[3, a], row[4, a], row[5, a] = e * sp, no * sp, up * sp
                    row[6, a] = (ay * up - az * no) * st
                    row[7, a] = (az * e - ax * up) * st
                    row[8, a] = (ax * no - ay * e) * st
                row[tall, a], row[tall + 1, a], row[tall + 2, a] = -e, -no, -up
                row[tall + 3, a] = no * oz - up * oy
                row[tall + 4, a] = up * ox - e * oz
                row[tall + 5, a] = e * oy - no * ox
            row[0, k], row[0, count + k] = (gxx * sxx + gxy * sxy) * w, (gxy * sxx + gyy * sxy) * w
            row[1, k], row[1, count + k] = (gxx * sxy + gxy * syy) * w, (gxy * sxy + gyy * syy) * w
            row[tall + FAULT, k] = (gxx * bent_u + gxy * bent_v) * scale_f * w
            row[tall + FAULT, count + k] = (gxy * bent_u + gyy * bent_v) * scale_f * w
            if wide > LENS:
                by_lens[0, 0], by_lens[1, 0] = bent_u, bent_v
                by_lens[0, 1] = by_lens[1, 2] = 1
                by_lens[0, 2] = by_lens[1, 1] = 0
                by_lens[0, 3], by_lens[1, 3] = f * u * r2, f * v * r2
                by_lens[0, 4], by_lens[1, 4] = f * u * r2 * r2, f * v * r2 * r2
                by_lens[0, 5], by_lens[1, 5] = 2 * f * u * v, f * (r2 + 2 * v * v)
                by_lens[0, 6], by_lens[1, 6] = f * (r2 + 2 * u * u), 2 * f * u * v
                for j in range(wide - LENS):
                    by_x = by_y = 0.0
                    for i in range(j, 7):
                        by_x += by_lens[0, i] * lens_root[i, j]
                        by_y += by_lens[1, i] * lens_root[i, j]
                    row[tall + LENS + j, k] = (gxx * by_x + gxy * by_y) * w
                    row[tall + LENS + j, count + k] = (gxy * by_x + gyy * by_y) * w
            at += 1
            k += 1
        _products(row, row, last + 1, 2 * count, sums)
        if asked:
            shared = row[:last] * stays
            _products(shared, row, last, 2 * count, slow)
        for i in range(tall):
            sums[i, i] += 1
            sums[i, last] -= local[b, i]
        # Cholesky as far as what is the bar's own, which leaves the rest with it eliminated.
        for k in range(tall):
            inverse = 1 / math.sqrt(sums[k, k])
            for j in range(k, last + 1):
                sums[k, j] *= inverse
            for i in range(k + 1, last + 1):
                share = sums[k, i]
                for j in range(i, last + 1):
                    sums[i, j] -= share * sums[k, j]
        cost[b] = sum_
        for k in range(tall):
            cost[b] -= sums[k, last] ** 2
        for i in range(GLOBAL):
            right[b, i] = sums[tall + i, last] if i < wide else 0.0
            for j in range(i, GLOBAL):
                info[b, i, j] = info[b, j, i] = sums[tall + i, tall + j] if j < wide else 0.0
        for i in range(LOCAL - 1, -1, -1):
            step[b, i] = 0
            for j in range(GLOBAL):
                gain[b, i, j] = 0
            if i < tall:
                inverse = 1 / sums[i, i]
                value = sums[i, last]
                for j in range(wide):
                    gain[b, i, j] = sums[i, tall + j]
                for k in range(i + 1, tall):
                    share = sums[i, k]
                    value -= share * step[b, k]
                    for j in range(wide):
                        gain[b, i, j] -= share * gain[b, k, j]
                step[b, i] = value * inverse
                for j in range(wide):
                    gain[b, i, j] *= inverse
        if asked:
            _followed(slow, gain[b], tall, wide, pixel[b])
        total += sum_
    for i in range(7):
        total += error[i] ** 2
    total += _attitude(felt, heading, known, white, rotation, rows, miss)
    return total


@njit
def _unknowns(lens_root: Array) -> int:
    """How many unknowns points depend on: the first ones, as far as errors of the camera have a sigma."""
    number = POSE
    for i in range(7):
        for j in range(i + 1):
            if lens_root[i, j] != 0:
                number = max(number, LENS + j + 1)
    return number


# In any order, so that several are added at once: six times as fast.
@njit(fastmath={"reassoc", "nsz"})
def _products(left: Array, right: Array, wide: int, n: int, out: Array) -> None:
    """Products of the first `n` columns, summed: the upper half of `out` (wide, wide)."""
    for i in range(wide):
        one = left[i]
        for j in range(i, wide):
            two = right[j]
            value = 0.0
            for k in range(n):
                value += one[k] * two[k]
            out[i, j] = value


@njit
def _followed(sums: Array, gain: Array, tall: int, wide: int, out: Array) -> None:
    """Products of the rows once the first `tall` unknowns follow the others: `out` (14, 14)."""
    for i in range(tall + wide):
        for j in range(i):
            sums[i, j] = sums[j, i]
    out[:] = 0
    for i in range(tall + wide):
        for k in range(tall):
            share = sums[i, k]
            for j in range(wide):
                sums[i, tall + j] -= share * gain[k, j]
    for i in range(wide):
        for j in range(wide):
            out[i, j] = sums[tall + i, tall + j]
    for k in range(tall):
        for i in range(wide):
            share = gain[k, i]
            for j in range(wide):
                out[i, j] -= share * sums[k, tall + j]


@njit
def _attitude(
    felt: Array, heading: float, known: int, white: Array, rotation: Array, rows: Array, miss: Array
) -> float:
    """Said minus seen pitch, roll and heading, whitened, and what the turns do to the seen ones."""
    raw = np.zeros(3)
    by_turn = np.zeros((3, 3))
    east, north, high = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    level = max(east * east + north * north, 1e-12)
    size = math.sqrt(level)
    fe, fn = east / size, north / size
    # Up as the sensor felt it, turned as the camera is: level if the rotation is right.
    up = rotation @ felt
    raw[0] = up[0] * fe + up[1] * fn
    by_turn[0, 0], by_turn[0, 1], by_turn[0, 2] = up[2] * fn, -up[2] * fe, up[1] * fe - up[0] * fn
    raw[1] = up[1] * fe - up[0] * fn
    by_turn[1, 0], by_turn[1, 1], by_turn[1, 2] = up[2] * fe, up[2] * fn, -up[0] * fe - up[1] * fn
    if known == 3:
        off = heading - math.atan2(east, north)
        raw[2] = off - 2 * math.pi * round(off / (2 * math.pi))
        by_turn[2, 0], by_turn[2, 1], by_turn[2, 2] = east * high / level, north * high / level, -1.0
    total = 0.0
    for i in range(3):
        miss[i] = 0
        for j in range(GLOBAL):
            rows[i, j] = 0
        if i < known:
            for k in range(known):
                miss[i] += white[i, k] * raw[k]
                for j in range(3):
                    rows[i, 3 + j] += white[i, k] * by_turn[k, j]
            total += miss[i] ** 2
    return total


@njit
def summed(
    info: Array, right: Array, rows: Array, miss: Array, error: Array, free: Array, whole: Array, side: Array
) -> None:
    """Add the bars, the attitude and what is known of the camera: `whole` (m, m), `side` (m,).

    Of the first m unknowns; those that are not `free` (14,) are held.
    """
    bars, n = len(info), len(side)
    for i in range(n):
        side[i] = 0
        for b in range(bars):
            side[i] += right[b, i]
        for a in range(3):
            side[i] += rows[a, i] * miss[a]
        if i >= LENS:
            side[i] -= error[i - LENS]
        for j in range(n):
            value = 1.0 if i == j and i >= LENS else 0.0
            for b in range(bars):
                value += info[b, i, j]
            for a in range(3):
                value += rows[a, i] * rows[a, j]
            whole[i, j] = value
    for i in range(n):
        if not free[i]:
            side[i] = 0
            for j in range(n):
                whole[i, j] = whole[j, i] = 0
            whole[i, i] = 1


@njit
def solved(whole: Array, side: Array, damping: float, move: Array) -> bool:
    """Solve the damped equations; False where they are singular."""
    n = len(side)
    scale, low = np.zeros(n), np.zeros((n, n))
    if not rooted(whole, damping, _ROUNDING, scale, low):
        return False
    substituted(low, scale, side, move)
    return True


@njit
def eigen(matrix: Array, values: Array, axes: Array) -> None:
    """Eigenvalues of a symmetric matrix, in no order, and its axes as columns, by Jacobi's turns.

    For the few rows here a fraction of what LAPACK takes. The matrix, of which the upper half counts, is
    overwritten.
    """
    n = len(values)
    axes[:] = 0
    for i in range(n):
        axes[i, i] = 1
    for _ in range(30):
        off = size = 0.0
        for i in range(n):
            size += matrix[i, i] ** 2
            for j in range(i + 1, n):
                off += matrix[i, j] ** 2
        if not off > 1e-31 * size:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                both = matrix[p, q]
                if both == 0:
                    continue
                half = (matrix[q, q] - matrix[p, p]) / (2 * both)
                t = math.copysign(1 / (abs(half) + math.sqrt(half * half + 1)), half)
                c = 1 / math.sqrt(t * t + 1)
                s = t * c
                matrix[p, p] -= t * both
                matrix[q, q] += t * both
                matrix[p, q] = 0
                for k in range(p):
                    one, two = matrix[k, p], matrix[k, q]
                    matrix[k, p], matrix[k, q] = c * one - s * two, s * one + c * two
                for k in range(p + 1, q):
                    one, two = matrix[p, k], matrix[k, q]
                    matrix[p, k], matrix[k, q] = c * one - s * two, s * one + c * two
                for k in range(q + 1, n):
                    one, two = matrix[p, k], matrix[q, k]
                    matrix[p, k], matrix[q, k] = c * one - s * two, s * one + c * two
                # Rows, which are next to each other, until the end.
                for k in range(n):
                    one, two = axes[p, k], axes[q, k]
                    axes[p, k], axes[q, k] = c * one - s * two, s * one + c * two
    for i in range(n):
        values[i] = matrix[i, i]
        for j in range(i):
            axes[i, j], axes[j, i] = axes[j, i], axes[i, j]


@njit
def stepped(
    move: Array, gain: Array, step: Array, centre: Array,
    position: Array, rotation: Array, local: Array, error: Array,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """A point with its unknowns moved; what is a bar's own follows.

    A turn takes the camera about the bars' `centre` (3,), to first order along the straight line: their image
    hardly changes on that arc, so that long steps hold.
    """
    angle = math.sqrt(move[3] ** 2 + move[4] ** 2 + move[5] ** 2)
    turn = np.zeros((3, 3))
    turn[0, 0] = turn[1, 1] = turn[2, 2] = 1.0
    if angle > 0:
        x, y, z = move[3] / angle, move[4] / angle, move[5] / angle
        # Rodrigues.
        c, s = math.cos(angle), math.sin(angle)
        axis = (x, y, z)
        for i in range(3):
            for j in range(3):
                turn[i, j] = (1 - c) * axis[i] * axis[j]
            turn[i, i] += c
        turn[0, 1] -= s * z
        turn[0, 2] += s * y
        turn[1, 0] += s * z
        turn[1, 2] -= s * x
        turn[2, 0] -= s * y
        turn[2, 1] += s * x
    turned, there = np.zeros((3, 3)), np.zeros(3)
    east, north, up = position[0] - centre[0], position[1] - centre[1], position[2] - centre[2]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                turned[i, j] += turn[i, k] * rotation[k, j]
        there[i] = centre[i] + move[i] + turn[i, 0] * east + turn[i, 1] * north + turn[i, 2] * up
    there[0] -= move[4] * up - move[5] * north
    there[1] -= move[5] * east - move[3] * up
    there[2] -= move[3] * north - move[4] * east
    own = local.copy()
    for b in range(len(local)):
        for i in range(LOCAL):
            own[b, i] += step[b, i]
            for j in range(GLOBAL):
                own[b, i] -= gain[b, i, j] * move[j]
    off = error.copy()
    for i in range(len(off)):
        off[i] += move[LENS + i]
    return there, turned, own, off


@njit
def fitted(
    points: Array, bar: Array, bar_sigma: Array, lens: Array, lens_root: Array, fault: float,
    felt: Array, heading: float, known: int, white: Array, huber: float, free: Array, steps: int,
    hopeless: float, position: Array, rotation: Array, local: Array, error: Array,
) -> tuple[bool, float, Array, Array, Array, Array]:  # fmt: skip
    """Levenberg-Marquardt from a point; whether it settled, twice the cost, and the point.

    The damping follows how much of what the equations promise a step wins (Nielsen 1999). A cost above
    `hopeless` that four steps in a row hardly lower, and that a step without damping would leave above it, is
    one where it has settled.
    """
    bars = len(bar_sigma)
    info, right, cost = np.zeros((bars, GLOBAL, GLOBAL)), np.zeros((bars, GLOBAL)), np.zeros(bars)
    gain, step = np.zeros((bars, LOCAL, GLOBAL)), np.zeros((bars, LOCAL))
    rows, miss, pixel = np.zeros((3, GLOBAL)), np.zeros(3), np.zeros((0, GLOBAL, GLOBAL))
    # What no bar depends on stays as it is.
    n = _unknowns(lens_root)
    whole, side, move = np.zeros((n, n)), np.zeros(n), np.zeros(GLOBAL)
    centre = np.zeros(3)
    for i in range(3):
        centre[i] = points[:, i].mean()
    best = normal(
        points, bar, bar_sigma, lens, lens_root, fault, felt, heading, known, white, huber,
        position, rotation, local, error, info, right, gain, step, cost, rows, miss, pixel,
    )  # fmt: skip
    if math.isnan(best):
        return False, best, position, rotation, local, error
    summed(info, right, rows, miss, error, free, whole, side)
    gain_here, step_here = gain.copy(), step.copy()
    surveyed, still = bar_sigma[:, :2].max() > 0, np.zeros(GLOBAL)
    damping, growth, stalled = 1e-4, 4.0, 0
    for _ in range(steps):
        if not solved(whole, side, damping, move[:n]):
            return False, best, position, rotation, local, error
        there, turned, own, off = stepped(
            move, gain_here, step_here, centre, position, rotation, local, error
        )
        found = normal(
            points, bar, bar_sigma, lens, lens_root, fault, felt, heading, known, white, huber,
            there, turned, own, off, info, right, gain, step, cost, rows, miss, pixel,
        )  # fmt: skip
        if surveyed and found > best:
            # What a long turn leaves of second order, errors of the sites take up where they are large.
            there, turned, own, off = stepped(still, gain, step, centre, there, turned, own, off)
            found = normal(
                points, bar, bar_sigma, lens, lens_root, fault, felt, heading, known, white, huber,
                there, turned, own, off, info, right, gain, step, cost, rows, miss, pixel,
            )  # fmt: skip
        # What the damped step promises to win; what is a bar's own follows anyway.
        promise = hoped = 0.0
        for i in range(n):
            promise += side[i] * move[i]
            hoped += move[i] * (side[i] + damping * whole[i, i] * move[i])
        stalled = 0 if found < 0.7 * best else stalled + 1
        if found <= best:
            won = best - found
            position, rotation, local, error, best = there, turned, own, off, found
            summed(info, right, rows, miss, error, free, whole, side)
            gain_here, step_here = gain.copy(), step.copy()
            ratio = won / hoped if hoped > 0 else 1.0
            damping = min(max(damping * max(0.1, 1 - (2 * ratio - 1) ** 3), 1e-12), 1e12)
            growth = 4.0
            # What misses so far is refused, wherever exactly it ends; what is not robust is a start only.
            near = 1e-3 if found > 20 * len(points) else 1e-4 if math.isinf(huber) else 1e-6
            if won <= max(near, 1e-6) * (1 + found) and abs(promise) < near * (100 + found):
                return True, best, position, rotation, local, error
        else:
            damping *= growth
            growth *= 2
            if damping > 1e12 or abs(promise) < 1e-9:
                # No step is an improvement any more: rounding decides.
                return promise < 1e-3, best, position, rotation, local, error
        if stalled == 4 and best > hopeless:
            stalled, least = 0, best
            if solved(whole, side, 1e-9, move[:n]):
                for i in range(n):
                    least -= side[i] * move[i]
            if least > hopeless:
                return True, best, position, rotation, local, error
    return False, best, position, rotation, local, error


@njit
def tested(
    information: Array, column: Array, side: Array, spread: Array, bound: Array, least: float
) -> tuple[float, int, Array, Array]:
    """What a fault that shifts some observations would do: a mean-shift test, and the position without them.

    Args:
        information: Of the fault's parameters by these observations, (m, m).
        column: The same between the unknowns and these parameters, (14, m).
        side: Right-hand side of these parameters at the solution, (m,).
        spread: Covariance of the unknowns, (14, 14).
        bound: Inverse covariance of how large such a fault may be, (m, m); 0: any size.
        least: Redundancy below which a direction cannot be tested.

    Returns:
        Test value, its degrees of freedom, what the fault adds to the position's covariance once it is free,
        (3, 3), and the covariance by which the position may have moved unnoticed, in units of the test
        value, (3, 3).
    """
    m, n = len(side), len(spread)
    added, unseen = np.zeros((3, 3)), np.zeros((3, 3))
    scale, values, axes = np.zeros(m), np.zeros(m), np.zeros((m, m))
    left, basis = np.zeros((m, m)), np.zeros((m, m))
    for i in range(m):
        scale[i] = 1 / math.sqrt(information[i, i]) if information[i, i] > 0 else 0.0
    for i in range(m):
        for j in range(m):
            left[i, j] = information[i, j] * scale[i] * scale[j]
    eigen(left, values, axes)
    rank = 0
    for i in range(m):
        if values[i] > 1e-9:
            for j in range(m):
                basis[j, rank] = scale[j] * axes[j, i] / math.sqrt(values[i])
            rank += 1
    if rank == 0:
        return 0.0, 0, added, unseen
    # In this basis the fault's own information is 1; what is left of it where the unknowns may follow.
    shared, follow = np.zeros((n, rank)), np.zeros((n, rank))
    for i in range(n):
        for k in range(m):
            one = column[i, k]
            for j in range(rank):
                shared[i, j] += one * basis[k, j]
    for i in range(n):
        for k in range(n):
            one = spread[i, k]
            for j in range(rank):
                follow[i, j] += one * shared[k, j]
    left, turn, share = np.zeros((rank, rank)), np.zeros((rank, rank)), np.zeros(rank)
    for i in range(rank):
        left[i, i] = 1
    for k in range(n):
        for i in range(rank):
            one = shared[k, i]
            for j in range(i, rank):
                left[i, j] -= one * follow[k, j]
    for i in range(rank):
        for j in range(i):
            left[i, j] = left[j, i]
    if _above(left, least):
        return _redundant(left, basis, follow, side, bound)
    eigen(left, share, turn)
    turned, moved, along = np.zeros((m, rank)), np.zeros((3, rank)), np.zeros(rank)
    for k in range(rank):
        for i in range(m):
            for j in range(rank):
                turned[i, j] += basis[i, k] * turn[k, j]
        for i in range(3):
            for j in range(rank):
                moved[i, j] += follow[i, k] * turn[k, j]
    value, freedom = 0.0, 0
    for i in range(m):
        for j in range(rank):
            along[j] += turned[i, j] * side[i]
    for j in range(rank):
        if share[j] > least:
            value += along[j] ** 2 / share[j]
            freedom += 1
        else:
            # What is not tested may be of any size, or of as much as the bound allows.
            share[j] = 1e-12
    moves = np.zeros((3, rank))
    if bound.any():
        known, inverse = np.zeros((rank, rank)), np.zeros((rank, rank))
        for i in range(rank):
            for j in range(rank):
                for k in range(m):
                    for p in range(m):
                        known[i, j] += turned[k, i] * bound[k, p] * turned[p, j]
            known[i, i] += share[i]
        if not inverted(known, _ROUNDING, inverse):
            return 0.0, 0, added + math.inf, unseen + math.inf
        for i in range(3):
            for k in range(rank):
                for j in range(rank):
                    moves[i, j] += moved[i, k] * inverse[k, j]
    else:
        for i in range(3):
            for j in range(rank):
                moves[i, j] = moved[i, j] / share[j]
    for i in range(3):
        for j in range(3):
            for k in range(rank):
                added[i, j] += moves[i, k] * moved[j, k]
                unseen[i, j] += moves[i, k] * share[k] * moves[j, k]
    return value, freedom, added, unseen


@njit
def _above(matrix: Array, least: float) -> bool:
    """Whether all eigenvalues are above `least`: what is left without it has a root."""
    n = len(matrix)
    left = matrix.copy()
    for i in range(n):
        left[i, i] -= least
    return bool(rooted(left, 0.0, 0.0, np.empty(n), np.zeros((n, n))))


@njit
def _redundant(
    left: Array, basis: Array, follow: Array, side: Array, bound: Array
) -> tuple[float, int, Array, Array]:
    """`tested` where each direction is redundant enough, `left` (rank, rank): by inverses, without axes."""
    m, rank = len(side), len(left)
    added, unseen = np.zeros((3, 3)), np.zeros((3, 3))
    inverse, along = np.zeros((rank, rank)), np.zeros(rank)
    inverted(left, _ROUNDING, inverse)
    value = 0.0
    for i in range(rank):
        for k in range(m):
            along[i] += basis[k, i] * side[k]
        for j in range(i):
            value += 2 * along[i] * inverse[i, j] * along[j]
        value += along[i] ** 2 * inverse[i, i]
    if bound.any():
        known, half = left.copy(), np.zeros((m, rank))
        for k in range(m):
            for p in range(m):
                one = bound[k, p]
                for j in range(rank):
                    half[k, j] += one * basis[p, j]
        for k in range(m):
            for i in range(rank):
                for j in range(rank):
                    known[i, j] += basis[k, i] * half[k, j]
        if not inverted(known, _ROUNDING, inverse):
            return 0.0, 0, added + math.inf, unseen + math.inf
    moves, spare = np.zeros((3, rank)), np.zeros((3, rank))
    for i in range(3):
        for k in range(rank):
            for j in range(rank):
                moves[i, j] += follow[i, k] * inverse[k, j]
        for k in range(rank):
            for j in range(rank):
                spare[i, j] += moves[i, k] * left[k, j]
    for i in range(3):
        for j in range(3):
            for k in range(rank):
                added[i, j] += moves[i, k] * follow[j, k]
                unseen[i, j] += spare[i, k] * moves[j, k]
    return value, rank, added, unseen


@njit
def weighed(
    points: Array, bar: Array, bar_sigma: Array, lens: Array, lens_root: Array, fault: float,
    felt: Array, heading: float, known: int, white: Array, huber: float, free: Array, said: Array,
    position: Array, rotation: Array, local: Array, error: Array, cost: float,
    attitude_fault: float, focal_bound: float, bar_fault: float, bar_turn: float, limits: Array, least: float,
    most_sigma: float, flat: float, high: float, rarely: float, larger: float, little: float,
) -> tuple[Any, ...]:  # fmt: skip
    """What a settled fit is worth: covariance and its causes, tests of each part, protection levels.

    Args, beside those of `normal` and `fitted`: `said` (3, 4), what moves the angles as they are said, by its
    sigmas; how large a fault may be (sigma), `attitude_fault`, radians, and `bar_fault`, m, 0 for any amount,
    with `bar_turn`, radians, and of the focal length the inverse square of that, in units of `fault`,
    `focal_bound`; `limits` (7,) of a test by its degrees of freedom; `flat` and `high`, sigmas to the
    risk, horizontal and vertical; `rarely` and `larger` as in `doubted`; `little`, a share of the position's
    variance below which a doubt counts as none.

    Returns:
        Whether the equations are regular; sigma of the least certain direction, m; the larger of the ratios,
        or of their inverses, of the true and the expected growth of the cost two sigmas away along it to both
        sides, and of one and the square of how far the way there, an arc about the bars, is from that axis,
        in sigmas - infinite, and then nothing after it is of use, where the sigma is above `most_sigma`;
        covariance of the unknowns that count, which come first; of each part - bars, focal length, attitude,
        heading as far as there are - the test's value and its degrees of freedom, (parts,); horizontal and
        vertical protection level, m: for each fault, how far the solution may have moved with the test just
        passed, and how far one that does without the part may be off at the risk; what doubt adds (6, 6); the
        covariance's causes: noise and slow, (3, 3), moves by the camera (3, 7), by the attitude (3, 4), by
        what is each bar's (bars, 3, 7); the least certain direction, (3,), and how these moves change with
        the position along it, a metre, in the same shapes: the mean slope within two sigmas; `hidden` of
        `_parts`.
    """
    bars = len(bar_sigma)
    info, right, bar_cost = np.zeros((bars, GLOBAL, GLOBAL)), np.zeros((bars, GLOBAL)), np.zeros(bars)
    gain, step = np.zeros((bars, LOCAL, GLOBAL)), np.zeros((bars, LOCAL))
    rows, miss, pixel = np.zeros((3, GLOBAL)), np.zeros(3), np.zeros((bars, GLOBAL, GLOBAL))
    # What no bar depends on is as known as before, and moves nothing.
    n = _unknowns(lens_root)
    whole, side, spread = np.zeros((n, n)), np.zeros(n), np.zeros((n, n))
    turns = known > 0 and (free[3] or free[4] or free[5])
    parts = bars + 1
    if turns:
        parts += 2 if known == 3 else 1
    values, freedom = np.zeros(parts), np.zeros(parts, np.int64)
    by_camera, by_attitude, by_bar = np.zeros((3, 7)), np.zeros((3, 4)), np.zeros((bars, 3, 7))
    slopes = np.zeros((3, 7)), np.zeros((3, 4)), np.zeros((bars, 3, 7))
    noise, slow, doubt = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((6, 6))
    along, hidden = np.zeros(3), np.zeros(3)
    wide, bent, levels = 0.0, math.inf, (math.inf, math.inf)
    given = (points, bar, bar_sigma, lens, lens_root, fault, felt, heading, known, white, huber)
    point = (position, rotation, local, error)
    normal(*given, *point, info, right, gain, step, bar_cost, rows, miss, pixel)
    summed(info, right, rows, miss, error, free, whole, side)
    size, axes = np.zeros(3), np.zeros((3, 3))
    regular = inverted(whole, _ROUNDING, spread)
    _hold(free, spread)
    if regular:
        eigen(spread[:3, :3].copy(), size, axes)
        wide = math.sqrt(max(size.max(), 0.0))
    if regular and wide <= most_sigma:
        along[:] = axes[:, np.argmax(size)]
        bent = _bent(given, point, free, said, gain, step, cost, spread, size, axes, *slopes)
        bounds = np.zeros((bars, 6, 6))
        if bar_fault > 0:
            _bar_bounds(points, bar, position, bar_fault, bar_turn, bounds)
        levels = _parts(
            info, right, rows, miss, white, known, free, turns, spread,
            attitude_fault, focal_bound, bounds, limits, least, flat, high, values, freedom, hidden,
        )  # fmt: skip
        _moves(spread, rows, known, said, gain, 1.0, by_camera, by_attitude, by_bar)
        _rest(spread, pixel, by_camera, by_attitude, by_bar, noise, slow)
        if turns:
            doubted(spread, rows[:known, :n].copy(), miss[:known].copy(), rarely, larger, doubt)
            whole_of = spread[0, 0] + spread[1, 1] + spread[2, 2]
            if doubt[0, 0] + doubt[1, 1] + doubt[2, 2] < little * whole_of:
                doubt[:] = 0
    return (
        regular, wide, bent, spread, values, freedom, levels[0], levels[1],
        doubt, noise, slow, by_camera, by_attitude, by_bar, along, slopes[0], slopes[1], slopes[2], hidden,
    )  # fmt: skip


@njit
def _bent(
    given: tuple[Any, ...], point: tuple[Any, ...], free: Array, said: Array, gain: Array, step: Array,
    cost: float, spread: Array, size: Array, axes: Array, by_camera: Array, by_attitude: Array, by_bar: Array,
) -> float:  # fmt: skip
    """How far the cost is from its parabola, and the way from its axis, two sigmas away: see `weighed`.

    To `by_camera`, `by_attitude` and `by_bar` it adds how the moves by errors that stay change on that way.
    """
    points, position, known = given[0], point[0], given[8]
    bars, n = len(gain), len(spread)
    whole, side, spread_there = np.zeros((n, n)), np.zeros(n), np.zeros((n, n))
    most = int(np.argmax(size))
    wide = math.sqrt(size[most])
    info, right, bar_cost = np.zeros((bars, GLOBAL, GLOBAL)), np.zeros((bars, GLOBAL)), np.zeros(bars)
    gain_there, step_there = np.zeros((bars, LOCAL, GLOBAL)), np.zeros((bars, LOCAL))
    rows, miss, pixel = np.zeros((3, GLOBAL)), np.zeros(3), np.zeros((0, GLOBAL, GLOBAL))
    move, still, centre = np.zeros(GLOBAL), np.zeros(GLOBAL), np.zeros(3)
    for i in range(3):
        centre[i] = points[:, i].mean()
    bent = 1.0
    for way in (-2 / wide, 2 / wide):
        for i in range(len(spread)):
            move[i] = 0
            for j in range(3):
                move[i] += way * spread[i, j] * axes[j, most]
        there = stepped(move, gain, step, centre, *point)
        found = 0.0
        for again in range(2):
            found = normal(  # type: ignore[call-arg]
                *given, *there, info, right, gain_there, step_there, bar_cost, rows, miss, pixel
            )
            if again or not found - cost > 12:
                break
            # Errors of sites take up what is left of second order.
            there = stepped(still, gain_there, step_there, centre, *there)
        growth = 1e-9 if math.isnan(found) else max((found - cost) / 4, 1e-9)
        square = 0.0
        for i in range(3):
            along = 0.0
            for j in range(3):
                along += axes[j, i] * (there[0][j] - position[j] - move[j])
            square += along**2 / max(size[i], 1e-15 * size[most])
        bent = max(bent, growth, 1 / growth, 1 + square)
        if math.isnan(found):
            continue
        summed(info, right, rows, miss, there[3], free, whole, side)
        if inverted(whole, _ROUNDING, spread_there):
            _hold(free, spread_there)
            share = math.copysign(1 / (4 * wide), way)
            _moves(spread_there, rows, known, said, gain_there, share, by_camera, by_attitude, by_bar)
    return bent


@njit
def _hold(free: Array, spread: Array) -> None:
    """Nothing moves the unknowns that are not free."""
    for i in range(len(spread)):
        if not free[i]:
            spread[i, :] = 0
            spread[:, i] = 0


@njit
def _parts(
    info: Array, right: Array, rows: Array, miss: Array, white: Array, known: int, free: Array, turns: bool,
    spread: Array, attitude_fault: float, focal_bound: float, bounds: Array, limits: Array, least: float,
    flat: float, high: float, values: Array, freedom: Array, hidden: Array,
) -> tuple[float, float]:  # fmt: skip
    """Each part's test, `values` and `freedom` (parts,), and both protection levels: see `weighed`.

    `hidden` (3,): how far east, north and up the position may have moved with the test just passed.
    """
    bars, n = len(info), len(spread)
    hpl, vpl = flat * _widest(spread), high * math.sqrt(max(spread[2, 2], 0.0))
    own, columns, mean = np.zeros((6, 6)), np.zeros((n, 6)), np.zeros(6)
    for part in range(bars):
        for j in range(6):
            mean[j] = right[part, j]
            for i in range(n):
                columns[i, j] = info[part, i, j] if free[i] else 0.0
            for i in range(6):
                own[i, j] = info[part, i, j]
        found = tested(own, columns, mean, spread, bounds[part], least)
        values[part], freedom[part] = found[0], found[1]
        hpl, vpl = _widened(hpl, vpl, found[2], found[3], spread, limits[found[1]], flat, high, hidden)
    one, by_one, off = np.zeros((1, 1)), np.zeros((n, 1)), np.zeros(1)
    for b in range(bars):
        off[0] += right[b, FAULT]
        one[0, 0] += info[b, FAULT, FAULT]
        for i in range(n):
            by_one[i, 0] += info[b, i, FAULT] if free[i] else 0.0
    found = tested(one, by_one, off, spread, np.full((1, 1), focal_bound), least)
    values[bars], freedom[bars] = found[0], found[1]
    hpl, vpl = _widened(hpl, vpl, found[2], found[3], spread, limits[found[1]], flat, high, hidden)
    if turns:
        bound = _attitude_bound(white, known, attitude_fault)
        for part in range(bars + 1, len(values)):
            first = 2 if part == bars + 2 else 0
            angles = np.zeros((n, known - first))
            for i in range(n):
                for j in range(first, known):
                    angles[i, j - first] = rows[j, i] if free[i] else 0.0
            alone = np.eye(known - first)
            found = tested(
                alone, angles, miss[first:known].copy(), spread, bound[first:, first:].copy(), least
            )
            values[part], freedom[part] = found[0], found[1]
            # A heading that is off is an attitude that is.
            if not first:
                hpl, vpl = _widened(
                    hpl, vpl, found[2], found[3], spread, limits[found[1]], flat, high, hidden
                )
    return hpl, vpl


@njit
def _widened(
    hpl: float, vpl: float, added: Array, unseen: Array, spread: Array, limit: float,
    flat: float, high: float, hidden: Array,
) -> tuple[float, float]:  # fmt: skip
    """Protection levels that hold with one fault more, whose test just passed, and what that may hide."""
    for i in range(3):
        hidden[i] = max(hidden[i], math.sqrt(limit * max(unseen[i, i], 0.0)))
        for j in range(3):
            added[i, j] += spread[i, j]
    level = math.sqrt(limit) * _widest(unseen) + flat * _widest(added)
    height = math.sqrt(limit * max(unseen[2, 2], 0.0)) + high * math.sqrt(max(added[2, 2], 0.0))
    return max(hpl, level), max(vpl, height)


@njit
def _moves(
    spread: Array, rows: Array, known: int, said: Array, gain: Array, share: float,
    by_camera: Array, by_attitude: Array, by_bar: Array,
) -> None:  # fmt: skip
    """Add `share` of the position's moves by the errors that stay: see `weighed`."""
    bars, n = len(gain), len(spread)
    for i in range(3):
        for j in range(LENS, n):
            by_camera[i, j - LENS] -= share * spread[i, j]
        for a in range(known):
            value = 0.0
            for j in range(n):
                value += spread[i, j] * rows[a, j]
            for j in range(4):
                by_attitude[i, j] += share * value * said[a, j]
        for b in range(bars):
            for k in range(7):
                value = 0.0
                for j in range(n):
                    value += spread[i, j] * gain[b, k + 2, j]
                by_bar[b, i, k] += share * value


@njit
def _rest(
    spread: Array, pixel: Array, by_camera: Array, by_attitude: Array, by_bar: Array,
    noise: Array, slow: Array,
) -> None:  # fmt: skip
    """What the position's covariance is made of beside the errors that stay: see `weighed`."""
    bars, n = len(pixel), len(spread)
    by_pixel = np.zeros((3, n))
    for b in range(bars):
        by_pixel[:] = 0
        for i in range(3):
            for k in range(n):
                share = spread[i, k]
                for j in range(n):
                    by_pixel[i, j] += share * pixel[b, k, j]
        for i in range(3):
            for j in range(3):
                for k in range(n):
                    slow[i, j] += by_pixel[i, k] * spread[j, k]
    rest, size, axes = np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            rest[i, j] = spread[i, j] - (slow[i, j] + slow[j, i]) / 2
            for k in range(7):
                rest[i, j] -= by_camera[i, k] * by_camera[j, k]
                for b in range(bars):
                    rest[i, j] -= by_bar[b, i, k] * by_bar[b, j, k]
            for k in range(4):
                rest[i, j] -= by_attitude[i, k] * by_attitude[j, k]
    # What Huber's weights leave of the points' share may be less than nothing.
    eigen(rest, size, axes)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                noise[i, j] += axes[i, k] * max(size[k], 1e-12) * axes[j, k]


@njit
def doubted(spread: Array, rows: Array, miss: Array, rarely: float, larger: float, out: Array) -> None:
    """What the doubt adds to a covariance whether the attitude's errors are larger than their sigmas say.

    The mean over both hypotheses, by their odds after the fit: as said, or `larger` times as large, which is
    so `rarely`. What is no likelier after the fit than before is in the sigmas already.

    Args:
        spread: Covariance of the unknowns, (14, 14).
        rows: What the unknowns do to the angles, whitened, (k, 14).
        miss: Said minus seen angles, whitened, (k,).
        rarely: How rarely.
        larger: How much.
        out: What is added to the covariance of position and turn, (6, 6).
    """
    k, n = len(miss), len(spread)
    follow, redundant, whole = np.zeros((6, k)), np.zeros((k, k)), np.zeros((k, k))
    more = larger**2 - 1
    for a in range(k):
        by = np.zeros(n)
        for i in range(n):
            for j in range(n):
                by[i] += spread[i, j] * rows[a, j]
        for i in range(6):
            follow[i, a] = by[i]
        for b in range(k):
            redundant[a, b] = 1.0 if a == b else 0.0
            for i in range(n):
                redundant[a, b] -= rows[b, i] * by[i]
    for a in range(k):
        for b in range(k):
            whole[a, b] = more * redundant[a, b] + (1.0 if a == b else 0.0)
    inverse, axes, values = np.zeros((k, k)), np.zeros((k, k)), np.zeros(k)
    if not inverted(whole, _ROUNDING, inverse):
        return
    eigen(whole, values, axes)
    evidence = math.log(rarely / (1 - rarely))
    off = np.zeros(k)
    for a in range(k):
        evidence -= 0.5 * math.log(values[a])
        for b in range(k):
            off[a] += more * inverse[a, b] * miss[b]
        evidence += 0.5 * miss[a] * off[a]
    weight = 1 / (1 + math.exp(-evidence))
    moved = np.zeros(6)
    for i in range(6):
        for a in range(k):
            moved[i] += follow[i, a] * off[a]
    for i in range(6):
        for j in range(6):
            wider = 0.0
            for a in range(k):
                for b in range(k):
                    wider += follow[i, a] * more * inverse[a, b] * follow[j, b]
            out[i, j] = max(weight - rarely, 0.0) * wider + weight * moved[i] * moved[j]


@njit
def _widest(covariance: Array) -> float:
    """Sigma of the horizontal direction that is the least certain."""
    a, b, c = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    return math.sqrt(max((a + c) / 2 + math.hypot((a - c) / 2, b), 0.0))


@njit
def _bar_bounds(points: Array, bar: Array, position: Array, place: float, turn: float, out: Array) -> None:
    """Inverse covariance of each bar's fault, as a move and a turn of the camera that it alone sees.

    A bar that is `place` off to each side, m, and turned by `turn` about its centre, radians: `out` (bars, 6,
    6).
    """
    away, half = np.zeros(3), np.zeros((6, 6))
    last = -1
    for i in range(len(bar)):
        b = bar[i]
        if b == last:
            continue
        last = b
        for j in range(3):
            away[j] = points[i, j] - points[i, 3 + j] - position[j]
        # Rows: the move to the east, north and up, and the turn about these, in their sigmas.
        half[:] = 0
        for j in range(3):
            half[j, j] = 1 / place
            half[3 + j, 3 + j] = 1 / turn
        half[0, 4], half[0, 5] = away[2] / place, -away[1] / place
        half[1, 3], half[1, 5] = -away[2] / place, away[0] / place
        half[2, 3], half[2, 4] = away[1] / place, -away[0] / place
        for j in range(6):
            for k in range(6):
                out[b, j, k] = 0
                for m in range(6):
                    out[b, j, k] += half[m, j] * half[m, k]


@njit
def _attitude_bound(white: Array, known: int, fault: float) -> Array:
    """Inverse covariance of the attitude's fault, as whitened, (known, known); 0 where it is of any size."""
    covariance, out = np.zeros((known, known)), np.zeros((known, known))
    if fault == 0:
        return out
    for i in range(known):
        for j in range(known):
            for k in range(known):
                covariance[i, j] += fault**2 * white[i, k] * white[j, k]
    inverted(covariance, _ROUNDING, out)
    return out


@njit
def whole(points_px: Array, sigma_px: Array, width: int, height: int, out: Array) -> int:
    """Which clusters of a bar count, `out` (K,), and how many: seen, with a sigma, and not cut off.

    Of a cluster that touches the image's edge only a part is seen. It is as long as the spacing of
    neighbours; three quarters of that and a pixel of blur must be free.
    """
    first = last = -1
    for i in range(len(points_px)):
        if math.isfinite(points_px[i, 0]):
            first = i if first < 0 else first
            last = i
    edge = 0.5
    if last > first:
        dx, dy = points_px[last, 0] - points_px[first, 0], points_px[last, 1] - points_px[first, 1]
        edge += 0.75 * math.hypot(dx, dy) / (last - first)
    number = 0
    for i in range(len(points_px)):
        x, y = points_px[i, 0], points_px[i, 1]
        inside = x >= edge and y >= edge and x <= width - 1 - edge and y <= height - 1 - edge
        out[i] = inside and sigma_px[i] > 0 and sigma_px[i] < math.inf
        number += out[i]
    return number


@njit
def flatness(points: Array, bar: Array, bars: int) -> float:
    """How far the bars' centres spread across the line that fits them best, against along it."""
    centres, count, mean = np.zeros((bars, 3)), np.zeros(bars), np.zeros(3)
    for i in range(len(bar)):
        count[bar[i]] += 1
        for j in range(3):
            centres[bar[i], j] += points[i, j]
    for b in range(bars):
        for j in range(3):
            centres[b, j] /= count[b]
            mean[j] += centres[b, j] / bars
    spread, values, axes = np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))
    for b in range(bars):
        for j in range(3):
            for k in range(3):
                spread[j, k] += (centres[b, j] - mean[j]) * (centres[b, k] - mean[k])
    eigen(spread, values, axes)
    values.sort()
    return math.sqrt(max(values[1], 0.0) / values[2]) if values[2] > 0 else 0.0


@njit
def gathered(
    enu_m: Array, points_px: Array, sigma_px: Array, pixel: float, width: int, height: int, usual: Array,
    least: int, number: int, at: int, points: Array, bar: Array, sigma: Array,
) -> int:  # fmt: skip
    """A bar's whole clusters as rows of a `Problem`, where they are `least` or more; how many they are.

    From row `at`, `points` (n, 10) and `bar` (n,). `pixel` is the sigma of a point that its pixel leaves, px;
    `usual` (5,) and `sigma` (9,) are as of `shared`.
    """
    count = len(enu_m)
    seen = np.zeros(count, np.bool_)
    many = whole(points_px, sigma_px, width, height, seen)
    if many < least:
        return many
    shared(enu_m, points_px, seen, usual, sigma)
    x = y = z = 0.0
    for i in range(count):
        x, y, z = x + enu_m[i, 0] / count, y + enu_m[i, 1] / count, z + enu_m[i, 2] / count
    for i in range(count):
        if seen[i]:
            points[at, 0], points[at, 1], points[at, 2] = enu_m[i, 0], enu_m[i, 1], enu_m[i, 2]
            # From the whole bar's centre: errors of its attitude turn it about that, whatever is seen of it.
            points[at, 3], points[at, 4], points[at, 5] = enu_m[i, 0] - x, enu_m[i, 1] - y, enu_m[i, 2] - z
            points[at, 6], points[at, 7] = points_px[i, 0], points_px[i, 1]
            points[at, 8] = 1 / sigma_px[i]
            points[at, 9] = min((pixel / sigma_px[i]) ** 2, 1.0)
            bar[at] = number
            at += 1
    return many


@njit
def shared(enu_m: Array, points_px: Array, seen: Array, usual: Array, sigma: Array) -> None:
    """What a bar's points share, and how they err across it, by those `seen` (K,), into `sigma` (9,).

    The first three are its survey's, place, m, turn, radians, and length, a share, to which is added by how
    much it looks too long, `usual[3]`; the next are of a root of the covariance of its image's shift, px: of
    columns, of both, of rows. Its sigma is `usual[0]` across the bar, and along it `usual[1]` with a share of
    the length, `usual[2]`; of a layout that is no line, the latter in all directions. The whole is as long
    as from one of its clusters to the farthest other, and a cluster's own part; its image is so by what is
    seen of it. The last, of columns, of both, of rows, make a point's errors even in all directions and of
    sigma 1, where those across a line are `usual[4]` of those along it; of no line, all are, if that is more.
    """
    everything = np.ones(len(seen), np.bool_)
    i, j = _ends(enu_m, seen)
    first, last = _ends(enu_m, everything)
    share = _apart(enu_m, first, last) / _apart(enu_m, i, j) * len(seen) / (len(seen) - 1)
    dx, dy = points_px[j, 0] - points_px[i, 0], points_px[j, 1] - points_px[i, 1]
    size = math.hypot(dx, dy)
    along = math.hypot(usual[1], usual[2] * size * share)
    ax, ay = (dx / size, dy / size) if size > 0 else (1.0, 0.0)
    # Half a cluster beside the line from end to end is no error of a point in it.
    aside, line = 0.5 * size * share / len(seen), size > 0
    for k in range(len(seen)):
        if seen[k]:
            off = (points_px[k, 0] - points_px[i, 0]) * ay - (points_px[k, 1] - points_px[i, 1]) * ax
            line = line and abs(off) <= aside
    across = usual[0] if line else along
    # Of a layout that is no line, what is shown of one direction holds for all.
    sideways = 1 / usual[4] if line else 1 / max(usual[4], 1.0)
    longways = 1.0 if line else sideways
    sigma[2] = math.hypot(sigma[2], usual[3])
    sigma[3] = across + (along - across) * ax * ax
    sigma[4] = (along - across) * ax * ay
    sigma[5] = across + (along - across) * ay * ay
    sigma[6] = sideways + (longways - sideways) * ax * ax
    sigma[7] = (longways - sideways) * ax * ay
    sigma[8] = sideways + (longways - sideways) * ay * ay


@njit
def _apart(places: Array, i: int, j: int) -> float:
    total = 0.0
    for k in range(3):
        total += (places[j, k] - places[i, k]) ** 2
    return math.sqrt(total)


@njit
def _ends(places: Array, counts: Array) -> tuple[int, int]:
    """Two of the places (n, 3) that count, as far apart as any: the farthest from the farthest from one."""
    one = 0
    while not counts[one]:
        one += 1
    other = one
    for _ in range(2):
        one, farthest = other, -1.0
        for i in range(len(places)):
            if counts[i] and _apart(places, one, i) > farthest:
                other, farthest = i, _apart(places, one, i)
    return one, other


@njit
def whitening(causes: Array, least: float, out: Array) -> None:
    """What makes errors independent and of sigma 1: the inverse of the lower root, `out` (3, 3).

    Their covariance is that of `causes` (3, k) and `least`, a variance, on the diagonal.
    """
    low = np.zeros((3, 3))
    for i in range(3):
        for j in range(i + 1):
            value = least if i == j else 0.0
            for k in range(causes.shape[1]):
                value += causes[i, k] * causes[j, k]
            for k in range(j):
                value -= low[i, k] * low[j, k]
            low[i, j] = math.sqrt(value) if i == j else value / low[j, j]
    for j in range(3):
        for i in range(3):
            value = 1.0 if i == j else 0.0
            for k in range(i):
                value -= low[i, k] * out[k, j]
            out[i, j] = value / low[i, i]


@njit
def sights(flat: Array, out: Array) -> int:
    """Unit vectors towards directions (n, 2): `out` (n, 3); NaN of NaN; how many are none."""
    found = 0
    for i in range(len(flat)):
        size = math.sqrt(flat[i, 0] ** 2 + flat[i, 1] ** 2 + 1)
        out[i, 0], out[i, 1], out[i, 2] = flat[i, 0] / size, flat[i, 1] / size, 1 / size
        found += math.isfinite(size)
    return found


@njit
def halved(points: Array, bar: Array, out: Array, out_bar: Array) -> int:
    """Means of the halves of each bar's points, as precise as they are together: `out` (2 bars, 10)."""
    at = found = 0
    while at < len(bar):
        count = 0
        while at + count < len(bar) and bar[at + count] == bar[at]:
            count += 1
        for begin, end in ((at, at + count // 2), (at + count // 2, at + count)):
            if begin == end:
                continue
            total = 0.0
            out[found] = 0
            for i in range(begin, end):
                weight = points[i, 8] ** 2
                total += weight
                for j in range(8):
                    out[found, j] += weight * points[i, j]
            for j in range(8):
                out[found, j] /= total
            out[found, 8] = math.sqrt(total)
            out_bar[found] = bar[at]
            found += 1
        at += count
    return found


@njit
def halves(points: Array, bar: Array, sights: Array, enu: Array, mean: Array) -> int:
    """Mean places and sights of the halves of each bar, `enu` and `mean` (2 bars, 3), and how many.

    `sights` (n, 3); NaN where there is none.
    """
    rows, at, found = np.zeros(len(bar), np.int64), 0, 0
    while at < len(bar):
        number, count = bar[at], 0
        while at < len(bar) and bar[at] == number:
            if math.isfinite(sights[at, 0]):
                rows[count] = at
                count += 1
            at += 1
        for half in range(2):
            begin, end = (0, count // 2) if half == 0 else (count // 2, count)
            if begin == end:
                continue
            for j in range(3):
                enu[found, j] = mean[found, j] = 0
                for i in range(begin, end):
                    enu[found, j] += points[rows[i], j] / (end - begin)
                    mean[found, j] += sights[rows[i], j]
            size = math.sqrt(mean[found, 0] ** 2 + mean[found, 1] ** 2 + mean[found, 2] ** 2)
            for j in range(3):
                mean[found, j] /= size
            found += 1
    return found


@njit
def nearest_to_sights(enu: Array, sights: Array, rotations: Array, positions: Array, costs: Array) -> None:
    """The point nearest to all lines through `enu` (n, 3) along `sights` (n, 3), for each of `rotations`.

    `positions` (r, 3), and `costs` (r,): the sum of 1 - cosine of the angles by which the lines miss them,
    large where lines lead there from behind, infinite where it is not determined.
    """
    n = len(enu)
    here, a, right = np.zeros((n, 3)), np.zeros((3, 3)), np.zeros(3)
    for r in range(len(rotations)):
        a[:] = 0
        right[:] = 0
        for i in range(n):
            for j in range(3):
                here[i, j] = (
                    rotations[r, j, 0] * sights[i, 0]
                    + rotations[r, j, 1] * sights[i, 1]
                    + rotations[r, j, 2] * sights[i, 2]
                )
            along = here[i, 0] * enu[i, 0] + here[i, 1] * enu[i, 1] + here[i, 2] * enu[i, 2]
            for j in range(3):
                right[j] += enu[i, j] - here[i, j] * along
                a[j, j] += 1
                for k in range(3):
                    a[j, k] -= here[i, j] * here[i, k]
        c0 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
        c1 = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
        c2 = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
        size = a[0, 0] * c0 + a[0, 1] * c1 + a[0, 2] * c2
        costs[r] = np.inf
        # Of n unit lines the determinant is at most (2 n / 3)^3; what they leave open makes it vanish.
        if not size > 1e-12 * n**3:
            continue
        x = (right[0] * c0 + right[1] * (a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2])
             + right[2] * (a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1])) / size  # fmt: skip
        y = (right[0] * c1 + right[1] * (a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0])
             + right[2] * (a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2])) / size  # fmt: skip
        z = (right[0] * c2 + right[1] * (a[0, 1] * a[2, 0] - a[0, 0] * a[2, 1])
             + right[2] * (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0])) / size  # fmt: skip
        positions[r, 0], positions[r, 1], positions[r, 2] = x, y, z
        cost = 0.0
        for i in range(n):
            dx, dy, dz = enu[i, 0] - x, enu[i, 1] - y, enu[i, 2] - z
            far = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-9)
            cost += 1 - (dx * here[i, 0] + dy * here[i, 1] + dz * here[i, 2]) / far
        costs[r] = cost


@njit
def level_starts(
    enu: Array, sights: Array, level: Array, headings: int, positions: Array, rotations: Array
) -> int:
    """Places by gravity alone: `positions` (m, 3) and `rotations` (m, 3, 3), the likeliest first; how many.

    The nearest points for so many headings, evenly apart; a start from each valley of what they miss.
    """
    turned, places, costs = np.zeros((headings, 3, 3)), np.zeros((headings, 3)), np.zeros(headings)
    step = 2 * math.pi / headings
    for r in range(headings):
        _turned(level, r * step, turned[r])
    nearest_to_sights(enu, sights, turned, places, costs)
    found = 0
    for r in np.argsort(costs):
        low = costs[r] <= costs[r - 1] and costs[r] <= costs[(r + 1) % headings] and costs[r] < np.inf
        if not low or found == len(positions):
            continue
        # The golden section of the valley.
        near, far = (r - 1) * step, (r + 1) * step
        place, cost = np.zeros((2, 3)), np.zeros(2)
        both = np.zeros((2, 3, 3))
        for _ in range(_HALVINGS):
            one, two = far - _GOLDEN * (far - near), near + _GOLDEN * (far - near)
            _turned(level, one, both[0])
            _turned(level, two, both[1])
            nearest_to_sights(enu, sights, both, place, cost)
            if cost[0] < cost[1]:
                far = two
            else:
                near = one
        best = 0 if cost[0] < cost[1] else 1
        if cost[best] < costs[r]:
            positions[found], rotations[found] = place[best], both[best]
        else:
            positions[found], rotations[found] = places[r], turned[r]
        found += 1
    return found


@njit
def _turned(level: Array, angle: float, out: Array) -> None:
    """Axes (3, 3) turned about up."""
    c, s = math.cos(angle), math.sin(angle)
    for j in range(3):
        out[0, j] = c * level[0, j] - s * level[1, j]
        out[1, j] = s * level[0, j] + c * level[1, j]
        out[2, j] = level[2, j]


@njit
def widest_three(points: Array, bar: Array, sights: Array, bars: int, enu: Array, mean: Array) -> None:
    """Centres of the three bars that span the largest triangle, `enu` (3, 3), and sights of them, `mean`."""
    centres, seen, count = np.zeros((bars, 3)), np.zeros((bars, 3)), np.zeros(bars)
    for i in range(len(bar)):
        count[bar[i]] += 1
        for j in range(3):
            centres[bar[i], j] += points[i, j]
            if math.isfinite(sights[i, j]):
                seen[bar[i], j] += sights[i, j]
    for b in range(bars):
        centres[b] /= count[b]
        seen[b] /= max(math.sqrt((seen[b] ** 2).sum()), 1e-12)
    largest = -1.0
    for i in range(bars):
        for j in range(i + 1, bars):
            for k in range(j + 1, bars):
                area = np.cross(centres[j] - centres[i], centres[k] - centres[i])
                size = (area**2).sum()
                if size > largest:
                    largest = size
                    for row, b in enumerate((i, j, k)):
                        enu[row], mean[row] = centres[b], seen[b]


@njit
def three_points(p: Array, sights: Array, positions: Array, rotations: Array) -> int:
    """Grunert's solutions: `positions` (4, 3) and `rotations` (4, 3, 3), and how many there are.

    In the notation of Haralick et al., IJCV 13 (1994), 331. Complex roots, as noise makes of double ones,
    count with their real part.

    Args:
        p: The points, m, (3, 3).
        sights: Unit vectors towards them in the camera's axes, (3, 3).
        positions: Where the camera is, m.
        rotations: Its axes as columns in ENU.
    """
    a2, b2, c2 = ((p[1] - p[2]) ** 2).sum(), ((p[0] - p[2]) ** 2).sum(), ((p[0] - p[1]) ** 2).sum()
    ca, cb, cg = (sights[1] * sights[2]).sum(), (sights[0] * sights[2]).sum(), (sights[0] * sights[1]).sum()
    q, r, s = (a2 - c2) / b2, (a2 + c2) / b2, c2 / b2
    quartic = np.array([
        (q - 1) ** 2 - 4 * s * ca**2,
        4 * (q * (1 - q) * cb - (1 - r) * ca * cg + 2 * s * ca**2 * cb),
        2 * (q**2 - 1 + 2 * q**2 * cb**2 + 2 * (b2 - c2) / b2 * ca**2 - 4 * r * ca * cb * cg
             + 2 * (b2 - a2) / b2 * cg**2),
        4 * (-q * (1 + q) * cb + 2 * a2 / b2 * cg**2 * cb - (1 - r) * ca * cg),
        (1 + q) ** 2 - 4 * a2 / b2 * cg**2,
    ])  # fmt: skip
    stands, seen, there = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    _triad(p, stands)
    found = 0
    for root in np.roots(quartic + 0j):
        # Of a conjugate pair, the real part counts once.
        if root.imag < -1e-9 * abs(root):
            continue
        v = root.real
        bottom = 2 * (cg - v * ca)
        if v <= 0 or abs(bottom) < 1e-15:
            continue
        u = ((-1 + q) * v**2 - 2 * q * cb * v + 1 + q) / bottom
        square = 1 + v * v - 2 * v * cb
        if u <= 0 or square <= 0 or found == len(positions):
            continue
        first = math.sqrt(b2 / square)
        there[0], there[1], there[2] = first * sights[0], u * first * sights[1], v * first * sights[2]
        _triad(there, seen)
        # Turns the triangle as it is seen onto the one that stands there.
        for i in range(3):
            for j in range(3):
                rotations[found, i, j] = (stands[:, i] * seen[:, j]).sum()
        for i in range(3):
            positions[found, i] = 0
            for k in range(3):
                positions[found, i] += p[k, i] / 3
                for j in range(3):
                    positions[found, i] -= rotations[found, i, j] * there[k, j] / 3
        found += 1
    return found


@njit
def _triad(points: Array, out: Array) -> None:
    """Axes of a triangle (3, 3), as rows: along its first side, across that in its plane, and upright."""
    one, two = points[1] - points[0], points[2] - points[0]
    out[0] = one / max(math.sqrt((one**2).sum()), 1e-300)
    upright = np.cross(one, two)
    out[2] = upright / max(math.sqrt((upright**2).sum()), 1e-300)
    out[1] = np.cross(out[2], out[0])


@njit
def missed(points: Array, sights: Array, positions: Array, rotations: Array, costs: Array) -> None:
    """The sum of squares of the angles between the points and where they are seen, for each place."""
    for r in range(len(costs)):
        costs[r] = 0
        for i in range(len(points)):
            if not math.isfinite(sights[i, 0]):
                continue
            along = far = 0.0
            for j in range(3):
                away = points[i, j] - positions[r, j]
                far += away * away
                for k in range(3):
                    along += away * rotations[r, j, k] * sights[i, k]
            costs[r] += max(2 - 2 * along / math.sqrt(max(far, 1e-18)), 0.0)
