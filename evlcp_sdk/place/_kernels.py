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

from evlcp_sdk.kernels import njit

Array = NDArray[Any]

POSE, FAULT, LENS, GLOBAL, LOCAL = 6, 6, 7, 14, 9


@njit(cache=True, nogil=True)
def normal(
    points: Array, bar: Array, bar_sigma: Array, lens: Array, lens_root: Array, fault: float,
    felt: Array, heading: float, known: int, white: Array, huber: float,
    position: Array, rotation: Array, local: Array, error: Array,
    info: Array, right: Array, gain: Array, step: Array, cost: Array, rows: Array, miss: Array, pixel: Array,
) -> float:  # fmt: skip
    """Normal equations at a point; twice the robust cost, or NaN where a point is behind the camera.

    In: `points` (n, 10) of place, arm from the bar's centre, m, image, px, 1 / sigma, and the share of its
    variance that stands; `bar` (n,), rising; `bar_sigma` (bars, 4) of the image's shift, px, place, m, turn,
    radians, and length, a share; `lens` (8,) of focal length, px, principal point, k1, k2, p1, p2, k3;
    `lens_root` (7, 7), a root of the covariance of the first seven; `felt` (3,) up in the camera's axes,
    `heading`, radians, `known` rows of these, and `white` (3, 3), which whitens them. The point: `position`
    (3,), `rotation` (3, 3), `local` (bars, 9), `error` (7,).

    Out, bar by bar with its local unknowns eliminated: `info` (bars, 14, 14), `right` (bars, 14), `gain`
    (bars, 9, 14) and `step` (bars, 9), by which the local unknowns follow, `cost` (bars,), `pixel`
    (bars, 14, 14), the information that counts errors of pixels only. `rows` (3, 14) and `miss` (3,) are
    those of the attitude.
    """
    n, bars = len(points), len(cost)
    errors = False
    for i in range(7):
        errors = errors or lens_root[i, i] != 0
    wide = GLOBAL if errors else LENS
    now = lens.copy()
    for i in range(7):
        for j in range(i + 1):
            now[i] += lens_root[i, j] * error[j]
    f, cx, cy, k1, k2, p1, p2, k3 = now
    scale_f = fault * lens[0]
    row = np.zeros((2, GLOBAL))
    inner = np.zeros((2, LOCAL))
    own = np.zeros((LOCAL, LOCAL))
    own_right = np.zeros(LOCAL)
    mixed = np.zeros((LOCAL, GLOBAL))
    slope = np.zeros((2, 3))
    by_lens = np.zeros((2, 7))
    keep = np.zeros((n, 2, GLOBAL))
    keep_inner = np.zeros((n, 2, LOCAL))
    keep_weight = np.zeros(n)
    total = 0.0
    at = 0
    for b in range(bars):
        sh, sp, st, sl = bar_sigma[b]
        tall = LOCAL if sp > 0 or st > 0 else 3
        for i in range(GLOBAL):
            right[b, i] = 0
            for j in range(GLOBAL):
                info[b, i, j] = 0
                pixel[b, i, j] = 0
        sum_ = 0.0
        for i in range(LOCAL):
            own_right[i] = -local[b, i]
            sum_ += local[b, i] ** 2
            for j in range(LOCAL):
                own[i, j] = 1.0 if i == j else 0.0
            for j in range(GLOBAL):
                mixed[i, j] = 0
        wx, wy, wz = st * local[b, 6], st * local[b, 7], st * local[b, 8]
        grow = sl * local[b, 2]
        begin = at
        while at < n and bar[at] == b:
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
            mx = (points[at, 6] - (cx + f * bent_u) - sh * local[b, 0]) * w
            my = (points[at, 7] - (cy + f * bent_v) - sh * local[b, 1]) * w
            cross = u * v * growth + 2 * p1 * u + 2 * p2 * v
            uu = radial + u * u * growth + 2 * p1 * v + 6 * p2 * u
            vv = radial + v * v * growth + 6 * p1 * v + 2 * p2 * u
            for j in range(3):
                du = (rotation[j, 0] - u * rotation[j, 2]) / z
                dv = (rotation[j, 1] - v * rotation[j, 2]) / z
                slope[0, j] = f * w * (uu * du + cross * dv)
                slope[1, j] = f * w * (cross * du + vv * dv)
            for a in range(2):
                e, no, up = slope[a, 0], slope[a, 1], slope[a, 2]
                row[a, 0], row[a, 1], row[a, 2] = -e, -no, -up
                row[a, 3] = no * oz - up * oy
                row[a, 4] = up * ox - e * oz
                row[a, 5] = e * oy - no * ox
                inner[a, 2] = (e * ax + no * ay + up * az) * sl
                inner[a, 3], inner[a, 4], inner[a, 5] = e * sp, no * sp, up * sp
                inner[a, 6] = (ay * up - az * no) * st
                inner[a, 7] = (az * e - ax * up) * st
                inner[a, 8] = (ax * no - ay * e) * st
            inner[0, 0] = inner[1, 1] = sh * w
            inner[0, 1] = inner[1, 0] = 0
            row[0, FAULT], row[1, FAULT] = bent_u * scale_f * w, bent_v * scale_f * w
            if errors:
                by_lens[0, 0], by_lens[1, 0] = bent_u, bent_v
                by_lens[0, 1] = by_lens[1, 2] = 1
                by_lens[0, 2] = by_lens[1, 1] = 0
                by_lens[0, 3], by_lens[1, 3] = f * u * r2, f * v * r2
                by_lens[0, 4], by_lens[1, 4] = f * u * r2 * r2, f * v * r2 * r2
                by_lens[0, 5], by_lens[1, 5] = 2 * f * u * v, f * (r2 + 2 * v * v)
                by_lens[0, 6], by_lens[1, 6] = f * (r2 + 2 * u * u), 2 * f * u * v
                for a in range(2):
                    for j in range(7):
                        value = 0.0
                        for i in range(j, 7):
                            value += by_lens[a, i] * lens_root[i, j]
                        row[a, LENS + j] = value * w
            size = math.sqrt(mx * mx + my * my)
            weight = 1.0
            if size > huber:
                weight = huber / size
                sum_ += huber * (2 * size - huber)
            else:
                sum_ += size * size
            keep_weight[at] = weight
            for a in range(2):
                m = mx if a == 0 else my
                for i in range(wide):
                    keep[at, a, i] = row[a, i]
                    value = weight * row[a, i]
                    right[b, i] += value * m
                    for j in range(i + 1):
                        info[b, i, j] += value * row[a, j]
                    for j in range(tall):
                        mixed[j, i] += value * inner[a, j]
                for i in range(tall):
                    keep_inner[at, a, i] = inner[a, i]
                    value = weight * inner[a, i]
                    own_right[i] += value * m
                    for j in range(i + 1):
                        own[i, j] += value * inner[a, j]
            at += 1
        # Cholesky of what is the bar's own, and the bar's own unknowns eliminated.
        for i in range(tall):
            for j in range(i + 1):
                value = own[i, j]
                for k in range(j):
                    value -= own[i, k] * own[j, k]
                own[i, j] = math.sqrt(value) if i == j else value / own[j, j]
        for i in range(tall):
            value = own_right[i]
            for k in range(i):
                value -= own[i, k] * own_right[k]
            own_right[i] = value / own[i, i]
            for j in range(wide):
                value = mixed[i, j]
                for k in range(i):
                    value -= own[i, k] * mixed[k, j]
                mixed[i, j] = value / own[i, i]
        cost[b] = sum_
        for i in range(tall):
            cost[b] -= own_right[i] ** 2
        for i in range(wide):
            for k in range(tall):
                right[b, i] -= mixed[k, i] * own_right[k]
            for j in range(i + 1):
                value = info[b, i, j]
                for k in range(tall):
                    value -= mixed[k, i] * mixed[k, j]
                info[b, i, j] = value
                info[b, j, i] = value
        for i in range(tall - 1, -1, -1):
            value = own_right[i]
            for k in range(i + 1, tall):
                value -= own[k, i] * step[b, k]
            step[b, i] = value / own[i, i]
            for j in range(wide):
                value = mixed[i, j]
                for k in range(i + 1, tall):
                    value -= own[k, i] * gain[b, k, j]
                gain[b, i, j] = value / own[i, i]
        for i in range(tall, LOCAL):
            step[b, i] = 0
            for j in range(GLOBAL):
                gain[b, i, j] = 0
        for p in range(begin, at):
            share = points[p, 9] * keep_weight[p] ** 2
            for a in range(2):
                for i in range(wide):
                    value = keep[p, a, i]
                    for k in range(tall):
                        value -= keep_inner[p, a, k] * gain[b, k, i]
                    row[a, i] = value
                for i in range(wide):
                    for j in range(wide):
                        pixel[b, i, j] += share * row[a, i] * row[a, j]
        total += sum_
    for i in range(7):
        total += error[i] ** 2
    total += _attitude(felt, heading, known, white, rotation, rows, miss)
    return total


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def summed(
    info: Array, right: Array, rows: Array, miss: Array, error: Array, free: Array, whole: Array, side: Array
) -> None:
    """Add the bars, the attitude and what is known of the camera: `whole` (14, 14), `side` (14,).

    Unknowns that are not `free` (14,) are held.
    """
    bars = len(info)
    for i in range(GLOBAL):
        side[i] = 0
        for b in range(bars):
            side[i] += right[b, i]
        for a in range(3):
            side[i] += rows[a, i] * miss[a]
        if i >= LENS:
            side[i] -= error[i - LENS]
        for j in range(GLOBAL):
            value = 1.0 if i == j and i >= LENS else 0.0
            for b in range(bars):
                value += info[b, i, j]
            for a in range(3):
                value += rows[a, i] * rows[a, j]
            whole[i, j] = value
    for i in range(GLOBAL):
        if not free[i]:
            side[i] = 0
            for j in range(GLOBAL):
                whole[i, j] = whole[j, i] = 0
            whole[i, i] = 1


@njit(cache=True, nogil=True)
def solved(whole: Array, side: Array, damping: float, move: Array) -> bool:
    """Solve the damped equations by Cholesky, scaled to a unit diagonal; False where they are singular."""
    n = len(side)
    scale = np.zeros(n)
    low = np.zeros((n, n))
    for i in range(n):
        if not whole[i, i] > 0:
            return False
        scale[i] = 1 / math.sqrt(whole[i, i])
    for i in range(n):
        for j in range(i + 1):
            value = whole[i, j] * scale[i] * scale[j]
            if i == j:
                value = 1 + damping
            for k in range(j):
                value -= low[i, k] * low[j, k]
            if i == j:
                if not value > 0:
                    return False
                low[i, i] = math.sqrt(value)
            else:
                low[i, j] = value / low[j, j]
    for i in range(n):
        value = side[i] * scale[i]
        for k in range(i):
            value -= low[i, k] * move[k]
        move[i] = value / low[i, i]
    for i in range(n - 1, -1, -1):
        value = move[i]
        for k in range(i + 1, n):
            value -= low[k, i] * move[k]
        move[i] = value / low[i, i]
    for i in range(n):
        move[i] *= scale[i]
    return True


@njit(cache=True, nogil=True)
def stepped(
    move: Array, gain: Array, step: Array, centre: Array,
    position: Array, rotation: Array, local: Array, error: Array,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """A point with its unknowns moved; what is a bar's own follows.

    A turn takes the camera about the bars' `centre` (3,), to first order along the straight line: their image
    hardly changes on that arc, so that long steps hold.
    """
    angle = math.sqrt(move[3] ** 2 + move[4] ** 2 + move[5] ** 2)
    turn = np.eye(3)
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
    turned = turn @ rotation
    out = position - centre
    there = position + move[:3] + turn @ out - out
    there[0] -= move[4] * out[2] - move[5] * out[1]
    there[1] -= move[5] * out[0] - move[3] * out[2]
    there[2] -= move[3] * out[1] - move[4] * out[0]
    own = local.copy()
    for b in range(len(local)):
        for i in range(LOCAL):
            own[b, i] += step[b, i]
            for j in range(GLOBAL):
                own[b, i] -= gain[b, i, j] * move[j]
    return there, turned, own, error + move[LENS:]


@njit(cache=True, nogil=True)
def fitted(
    points: Array, bar: Array, bar_sigma: Array, lens: Array, lens_root: Array, fault: float,
    felt: Array, heading: float, known: int, white: Array, huber: float, free: Array, steps: int,
    position: Array, rotation: Array, local: Array, error: Array,
) -> tuple[bool, float, Array, Array, Array, Array]:  # fmt: skip
    """Levenberg-Marquardt from a point; whether it settled, twice the cost, and the point."""
    bars = len(bar_sigma)
    info, right, cost = np.zeros((bars, GLOBAL, GLOBAL)), np.zeros((bars, GLOBAL)), np.zeros(bars)
    gain, step = np.zeros((bars, LOCAL, GLOBAL)), np.zeros((bars, LOCAL))
    rows, miss, pixel = np.zeros((3, GLOBAL)), np.zeros(3), np.zeros((bars, GLOBAL, GLOBAL))
    whole, side, move = np.zeros((GLOBAL, GLOBAL)), np.zeros(GLOBAL), np.zeros(GLOBAL)
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
    surveyed, still = bar_sigma[:, 1:3].max() > 0, np.zeros(GLOBAL)
    damping = 1e-4
    for _ in range(steps):
        if not solved(whole, side, damping, move):
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
        promise = 0.0
        for i in range(GLOBAL):
            promise += side[i] * move[i]
        if found <= best:
            won = best - found
            position, rotation, local, error, best = there, turned, own, off, found
            summed(info, right, rows, miss, error, free, whole, side)
            gain_here, step_here = gain.copy(), step.copy()
            damping = max(damping / 10, 1e-12)
            if won <= 1e-6 * (1 + found) and abs(promise) < 1e-5:
                return True, best, position, rotation, local, error
        else:
            damping *= 10
            if damping > 1e12 or abs(promise) < 1e-9:
                # No step is an improvement any more: rounding decides.
                return promise < 1e-3, best, position, rotation, local, error
    return False, best, position, rotation, local, error


@njit(cache=True, nogil=True)
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
    m = len(side)
    scale = np.zeros(m)
    for i in range(m):
        scale[i] = 1 / math.sqrt(information[i, i]) if information[i, i] > 0 else 0.0
    values, axes = np.linalg.eigh(information * scale * scale.reshape(m, 1))
    basis = np.zeros((m, m))
    rank = 0
    for i in range(m):
        if values[i] > 1e-9:
            basis[:, rank] = scale * axes[:, i] / math.sqrt(values[i])
            rank += 1
    if rank == 0:
        return 0.0, 0, np.zeros((3, 3)), np.zeros((3, 3))
    basis = np.ascontiguousarray(basis[:, :rank])
    shared = np.ascontiguousarray(column) @ basis
    seen = shared.T @ (spread @ shared)
    left, turned = np.linalg.eigh(np.eye(rank) - (seen + seen.T) / 2)
    turned = np.ascontiguousarray(turned)
    along = turned.T @ (basis.T @ side)
    value, freedom = 0.0, 0
    for i in range(rank):
        if left[i] > least:
            value += along[i] ** 2 / left[i]
            freedom += 1
        else:
            # What is not tested may be of any size, or of as much as the bound allows.
            left[i] = 1e-12
    basis = basis @ turned
    moved = np.ascontiguousarray(spread[:3]) @ (shared @ turned)
    inverse = np.linalg.inv(np.diag(left) + basis.T @ (np.ascontiguousarray(bound) @ basis))
    moves = moved @ inverse
    unseen = moves * left @ np.ascontiguousarray(moves.T)
    return value, freedom, moves @ np.ascontiguousarray(moved.T), unseen


@njit(cache=True, nogil=True)
def nearest_to_sights(enu: Array, sights: Array, rotations: Array, positions: Array, costs: Array) -> None:
    """The point nearest to all lines through `enu` (n, 3) along `sights` (n, 3), for each of `rotations`.

    `positions` (r, 3), and `costs` (r,): the sum of 1 - cosine of the angles by which the lines miss them,
    large where lines lead there from behind, infinite where it is not determined.
    """
    n = len(enu)
    for r in range(len(rotations)):
        sights_here = sights @ rotations[r].T
        a = np.zeros((3, 3))
        right = np.zeros(3)
        for i in range(n):
            s = sights_here[i]
            along = s[0] * enu[i, 0] + s[1] * enu[i, 1] + s[2] * enu[i, 2]
            for j in range(3):
                right[j] += enu[i, j] - s[j] * along
                a[j, j] += 1
                for k in range(3):
                    a[j, k] -= s[j] * s[k]
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
            s = sights_here[i]
            cost += 1 - (dx * s[0] + dy * s[1] + dz * s[2]) / far
        costs[r] = cost
