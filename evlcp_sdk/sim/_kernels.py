"""Pixels and readout, compiled.

Every random number is a hash of (seed, pixel, number of the draw, purpose).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]

ON_FACTOR, OFF_FACTOR, U_BASE, T_BASE, REFERENCE, T_READY, T_LAST_OUT, LIGHT, FOLLOWER = range(9)
"""Columns of a pixel's state: its thresholds as factors, the receptor, the comparator, the light on it, and
the log signal behind the source follower, where that has a time constant."""

DRAW, ARMED, BLOCK = range(3)
"""Columns of a pixel's counters."""

LIGHT_STEP = 1e-3
"""Relative change of a pixel's light that is not worth a new piece: the light stays until it is more."""

COLUMN_BITS = 12
"""A request's code is (row << COLUMN_BITS | column) << 1 | polarity."""

_PLACES = np.empty(64, np.int64)
"""Place of the only bit of a word, by the upper bits of its product with a de Bruijn sequence."""
_PLACES[[(0x03F79D71B4CB0A89 << k & (1 << 64) - 1) >> 58 for k in range(64)]] = np.arange(64)

_AHEAD = 16
"""Draws made together: a pixel takes some sixty in a block of time, and needs the noise of every second."""

NOISE_LIMIT = 4.0
"""Where the normal distribution of every draw is cut off, standard deviations."""


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _mix(z: Any) -> Any:
    """Return the finalizer of splitmix64: a bijection of 64-bit words that scatters them."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _key_of(seed: Any, pixel: int) -> Any:
    """Key of a pixel's random numbers."""
    return _mix(seed + np.uint64(pixel) * np.uint64(0x9E3779B97F4A7C15))


@njit(cache=True, nogil=True, error_model="numpy")
def hash_uniform(seed: Any, pixel: int, draw: int, purpose: int) -> float:
    """Uniform number in [0, 1) of one (seed, pixel, draw, purpose)."""
    z = _mix(_key_of(seed, pixel) + np.uint64(draw) * np.uint64(0xD1B54A32D192ED03) + np.uint64(purpose))
    return float(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _table_at(table: Array, share: float) -> float:
    """Linear interpolation in a table of quantiles, `share` in [0, 1)."""
    z = share * (table.size - 1)
    i = int(z)
    # An index without a sign is not looked at for being negative.
    k = np.uint64(i)
    return float(table[k] + (z - i) * (table[k + np.uint64(1)] - table[k]))


@njit(cache=True, nogil=True, error_model="numpy")
def hash_normal(seed: Any, pixel: int, draw: int, purpose: int, quantiles: Array) -> float:
    """Normal number, cut off at `NOISE_LIMIT`, from a table of the quantiles."""
    return float(_table_at(quantiles, hash_uniform(seed, pixel, draw, purpose)))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _receptor(u_base: float, rest: float, ages: float) -> float:
    """Receptor after so many time constants; at rest after 60, when nothing of the difference is left."""
    return rest if ages > 60.0 else rest + (u_base - rest) * math.exp(-ages)


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(y_from: float, y_to: float, z: float, whole: float, part: float, tau: float) -> float:
    """Return a low-pass filter's output after `part` of a ramp of `whole` us from y_from to y_to."""
    slope = (y_to - y_from) / whole
    return y_from + slope * (part - tau) + (z - y_from + slope * tau) * math.exp(-part / tau)


@njit(cache=True, nogil=True, error_model="numpy")
def _run_piece_followed(
    until: float,
    light: float,
    u_base: float,
    t_base: float,
    z: float,
    reference: float,
    t_ready: float,
    t_last_out: float,
    armed: int,
    draw: int,
    on_factor: float,
    off_factor: float,
    code: int,
    key: Any,
    quantiles: Array,
    shifts: Array,
    sensor: Array,
    out_t: Array,
    out_code: Array,
    out_cross: Array,
    n: int,
) -> tuple[float, float, float, float, float, int, int, int]:
    """Do as `_run_pieces` in one piece, with a low-pass filter between receptor and comparator.

    The receptor is exact; between its values, as near to one another as they must be for a ramp to hit the
    middle between them to 0.002, the filter is solved for ramps. `reference` and `z` are log signals.
    """
    charge, refractory = sensor[0], sensor[1]
    delay_on, delay_off, jitter = sensor[2], sensor[3], sensor[4]
    miss_on, miss_off, tau = sensor[5], sensor[6], sensor[12]
    threshold_on, threshold_off = -math.log(on_factor), math.log(off_factor)
    rest = 1.0 / light
    settled = math.log(light)
    rate = light / charge
    t = t_base
    y = -math.log(u_base)
    length = 0.25 * tau
    word = _mix(key + np.uint64(draw) * np.uint64(0xD1B54A32D192ED03))
    noise = math.log(_table_at(shifts, float(word >> np.uint64(32)) * 2.3283064365386963e-10))
    fire = 0
    while True:
        if armed == 1:
            if z >= reference + threshold_on - noise:
                fire = 1
            elif z <= reference - threshold_off - noise:
                fire = -1
            if fire != 0:
                armed = 0
                t_ready = t + refractory
                late = delay_on if fire > 0 else delay_off
                if jitter > 0.0:
                    late = max(0.0, late + jitter * hash_normal(key, 0, draw, 2, quantiles))
                request = max(t + late, t_last_out + refractory)
                t_last_out = request
                missed = float(word & np.uint64(0xFFFFFFFF)) * 2.3283064365386963e-10
                if missed >= (miss_on if fire > 0 else miss_off):
                    out_t[n] = request
                    out_code[n] = code + int(fire > 0)
                    if out_cross.size:
                        out_cross[n] = t
                    n += 1
                fire = 0
        elif t >= t_ready:
            reference = z
            armed = 1
            draw += 1
            word = _mix(key + np.uint64(draw) * np.uint64(0xD1B54A32D192ED03))
            noise = math.log(_table_at(shifts, float(word >> np.uint64(32)) * 2.3283064365386963e-10))
        if t >= until:
            break
        limit = until if armed == 1 else min(until, t_ready)
        if abs(y - settled) < 1e-5 and abs(z - settled) < 1e-5:
            t = limit
            continue
        whole = min(length, limit - t)
        last = whole == limit - t
        middle = -math.log(_receptor(u_base, rest, rate * (t + 0.5 * whole - t_base)))
        end = -math.log(_receptor(u_base, rest, rate * (t + whole - t_base)))
        if abs(middle - 0.5 * (y + end)) > 2e-3 and whole > 1e-3:
            length = 0.5 * whole
            continue
        length = min(2.0 * whole, tau)
        half = 0.5 * whole
        y_from, z_from, crossed = y, z, False
        for k in range(2):
            y_to = middle if k == 0 else end
            z_to = _follow(y_from, y_to, z_from, half, half, tau)
            if armed == 1:
                high, low = reference + threshold_on - noise, reference - threshold_off - noise
                if z_to >= high or z_to <= low:
                    level = high if z_to >= high else low
                    rising = z_to >= high
                    before, after = 0.0, half
                    for _ in range(20):
                        guess = 0.5 * (before + after)
                        beyond = _follow(y_from, y_to, z_from, half, guess, tau) >= level
                        if beyond == rising:
                            after = guess
                        else:
                            before = guess
                    t += k * half + after
                    z = level
                    y = -math.log(_receptor(u_base, rest, rate * (t - t_base)))
                    crossed = True
                    break
            y_from, z_from = y_to, z_to
        if not crossed:
            t = limit if last else t + whole
            y, z = end, z_from
    u_end = _receptor(u_base, rest, rate * (until - t_base))
    return u_end, z, reference, t_ready, t_last_out, armed, draw, n


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _decay(ages: Array, bits: Array, out: Array, n: int) -> None:
    """Write exp(-age) for the first `n` ages, 0 beyond 60, so that the loop is one of vector instructions.

    `bits` is an int64 view of `out`. Accurate to some units of the last place.
    """
    # Adding this puts the nearest integer into the lowest bits of a float64.
    magic = 6755399441055744.0
    for i in range(n):
        out[i] = min(ages[i], 700.0) * 1.4426950408889634 + magic
    for i in range(n):
        age = min(ages[i], 700.0)
        k = out[i] - magic
        r = (k * 0.693147180369123816490 - age) + k * 1.90821492927058770002e-10
        p = 1.0 / 6227020800.0
        p = p * r + 1.0 / 479001600.0
        p = p * r + 1.0 / 39916800.0
        p = p * r + 1.0 / 3628800.0
        p = p * r + 1.0 / 362880.0
        p = p * r + 1.0 / 40320.0
        p = p * r + 1.0 / 5040.0
        p = p * r + 1.0 / 720.0
        p = p * r + 1.0 / 120.0
        p = p * r + 1.0 / 24.0
        p = p * r + 1.0 / 6.0
        p = p * r + 0.5
        p = p * r + 1.0
        p = p * r + 1.0
        ages[i] = p if age <= 60.0 else 0.0
    for i in range(n):
        bits[i] = (1023 << 52) - (bits[i] << 52)
    for i in range(n):
        out[i] *= ages[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_ahead(key: Any, draw: int, shifts: Array, shift: Array, fate: Array) -> None:
    """Write what draws from this one on give: the factor of noise, and the number that may lose an event."""
    first = key + np.uint64(draw) * np.uint64(0xD1B54A32D192ED03)
    for i in range(shift.size):
        word = _mix(first + np.uint64(i) * np.uint64(0xD1B54A32D192ED03))
        shift[i] = _table_at(shifts, float(word >> np.uint64(32)) * 2.3283064365386963e-10)
        fate[i] = float(word & np.uint64(0xFFFFFFFF)) * 2.3283064365386963e-10


@njit(cache=True, nogil=True, error_model="numpy")
def _run_pieces(
    pieces: int,
    t_us: Array,
    light: Array,
    draws: Array,
    room: Array,
    room_bits: Array,
    ahead: Array,
    s: Array,
    c: Array,
    code: int,
    key: Any,
    quantiles: Array,
    shifts: Array,
    sensor: Array,
    out_t: Array,
    out_code: Array,
    out_cross: Array,
    n: int,
) -> int:
    """Let one pixel see light[i] from t_us[i] to t_us[i + 1]; write its events, return how many there are.

    With u = exp(-y) the receptor is u(t) = 1/I + (u0 - 1/I) exp(-I t / Q), which is monotonic; so a threshold
    is crossed in a piece when u at its end lies beyond, and the time follows from one logarithm. `shifts`
    are the quantiles of the factor by which noise moves both thresholds. One word of random bits a draw, from
    the pixel's `key`: the upper half decides on the noise, the lower on whether the event goes missing.
    `draws[i]` draws pass as piece i begins. `room` float64 (3, pieces or more) is overwritten, `room_bits` is
    its int64 view; `ahead` float64 (2, n) is room for n draws, which are made together by vector
    instructions. `s` and `c` are the pixel's state and counters.
    """
    charge, refractory = sensor[0], sensor[1]
    delay_on, delay_off, jitter = sensor[2], sensor[3], sensor[4]
    miss_on, miss_off = sensor[5], sensor[6]
    on_factor, off_factor = s[ON_FACTOR], s[OFF_FACTOR]
    widest_on = on_factor * sensor[8]
    widest_off = off_factor / sensor[8]
    u_base, reference = s[U_BASE], s[REFERENCE]
    t_ready, t_last_out = s[T_READY], s[T_LAST_OUT]
    draw, armed = c[DRAW], c[ARMED]
    if sensor[12] > 0.0:
        z = s[FOLLOWER]
        for i in range(pieces):
            draw += draws[i]
            if t_us[i + 1] > t_us[i]:
                u_base, z, reference, t_ready, t_last_out, armed, draw, n = _run_piece_followed(
                    t_us[i + 1], light[i], u_base, t_us[i], z, reference, t_ready, t_last_out, armed, draw,
                    on_factor, off_factor, code, key, quantiles, shifts, sensor, out_t, out_code,
                    out_cross, n,
                )  # fmt: skip
        s[FOLLOWER] = z
        pieces = 0
    per_charge = 1.0 / charge
    shift_ahead, fate_ahead = ahead[0], ahead[1]
    drawn = draw - shift_ahead.size
    ages, kept = room[0], room[1]
    for i in range(pieces):
        ages[i] = light[i] * per_charge * (t_us[i + 1] - t_us[i])
    _decay(ages, room_bits[1], kept, pieces)
    rests = room[2]
    for i in range(pieces):
        rests[i] = 1.0 / light[i]
    for i in range(pieces):
        rest = rests[i]
        draw += draws[i]
        u_end = rest + (u_base - rest) * kept[i]
        if armed != 0 and u_end > reference * widest_on and u_end < reference * widest_off:
            u_base = u_end
            continue
        t_base, until = t_us[i], t_us[i + 1]
        tau = charge * rest
        blind = u_event = -1.0
        while until > t_base:
            if armed == 0:
                if t_ready >= until:
                    break
                # An event's delay may outlast a piece, never their order: t_ready is not before t_base.
                if u_event >= 0.0:
                    if blind < 0.0:
                        blind = math.exp(-min(refractory / tau, 700.0))
                    reference = rest + (u_event - rest) * blind
                else:
                    ages_ready = (t_ready - t_base) / tau
                    reference = rest if ages_ready > 60.0 else rest + (u_base - rest) * math.exp(-ages_ready)
                armed = 1
                draw += 1
            if u_end > reference * widest_on and u_end < reference * widest_off:
                break
            k = draw - drawn
            if k >= shift_ahead.size:
                drawn, k = draw, 0
                _draw_ahead(key, draw, shifts, shift_ahead, fate_ahead)
            shift = shift_ahead[np.uint64(k)]
            low = reference * on_factor * shift
            high = reference * off_factor * shift
            t = max(t_base, t_ready)
            level = -1.0
            if u_end <= low:
                on = 1
                if u_base > low:
                    level = low
            elif u_end >= high:
                on = 0
                if u_base < high:
                    level = high
            else:
                break
            u_event = -1.0
            if level >= 0.0:
                crossed = t_base + math.log((u_base - rest) / (level - rest)) * tau
                if crossed >= t:
                    t = crossed
                    u_event = level
            t = min(t, until)
            armed = 0
            t_ready = t + refractory
            late = delay_on if on else delay_off
            if jitter > 0.0:
                late = max(0.0, late + jitter * hash_normal(key, 0, draw, 2, quantiles))
            request = max(t + late, t_last_out + refractory)
            t_last_out = request
            # What is missed is written over; that is quicker than a branch which cannot be foreseen.
            out_t[n] = request
            out_code[n] = code + on
            if out_cross.size:
                out_cross[n] = t
            n += int(fate_ahead[np.uint64(k)] >= (miss_on if on else miss_off))
        u_base = u_end
    s[U_BASE], s[REFERENCE] = u_base, reference
    s[T_READY], s[T_LAST_OUT] = t_ready, t_last_out
    c[DRAW], c[ARMED] = draw, armed
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def pixel_factors(seed: Any, pixel: int, sensor: Array, quantiles: Array) -> tuple[float, float]:
    """exp(-threshold) for ON and exp(threshold) for OFF of one pixel, with its spread."""
    on = sensor[9] * (1.0 + sensor[11] * hash_normal(seed, pixel, 0, 3, quantiles))
    off = sensor[10] * (1.0 + sensor[11] * hash_normal(seed, pixel, 0, 4, quantiles))
    return math.exp(-on), math.exp(off)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _rest(light: float, t_us: float, followed: bool, s: Array, c: Array) -> None:
    """Put a pixel at rest in a light, armed."""
    s[U_BASE], s[LIGHT], s[FOLLOWER], s[T_READY] = 1.0 / light, light, math.log(light), t_us
    s[REFERENCE] = s[FOLLOWER] if followed else s[U_BASE]
    c[ARMED] = 1


@njit(cache=True, nogil=True, error_model="numpy")
def run_given_light(
    pixel: int,
    edge_us: Array,
    light: Array,
    end_us: float,
    seed: Any,
    quantiles: Array,
    shifts: Array,
    sensor: Array,
    out_t: Array,
    out_code: Array,
    out_cross: Array,
) -> int:
    """Run one pixel, at rest in light[0], through light[i] from edge_us[i] on; return how many events."""
    pieces = light.size
    s, c = np.empty(9), np.zeros(3, np.int64)
    s[ON_FACTOR], s[OFF_FACTOR] = pixel_factors(seed, pixel, sensor, quantiles)
    _rest(light[0], edge_us[0], sensor[12] > 0.0, s, c)
    s[T_LAST_OUT] = -1e18
    key = _key_of(seed, pixel)
    t_us = np.empty(pieces + 1)
    t_us[:pieces] = edge_us[:pieces]
    t_us[pieces] = end_us
    draws = np.ones(pieces, np.int64)
    room = np.empty((3, pieces))
    return int(
        _run_pieces(
            pieces, t_us, light, draws, room, room.view(np.int64), np.empty((2, _AHEAD)), s, c, 0, key,
            quantiles, shifts, sensor, out_t, out_code, out_cross, 0,
        )
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _step(table: Array, per_px: float, z: float) -> float:
    """Share of a pixel at `z` px beyond a blurred edge: 0 far before, 1 far behind; linear between nodes."""
    half = 0.5 * (table.size - 1)
    at = z * per_px + half
    if at <= 0.0:
        return 0.0
    if at >= table.size - 1:
        return 1.0
    i = int(at)
    return float(table[i] + (at - i) * (table[i + 1] - table[i]))


@njit(cache=True, nogil=True, error_model="numpy")
def texture_at(field: Array, u: float, v: float) -> float:
    """Bilinear value of the periodic texture (size a power of two) at column u, row v."""
    size = field.shape[0]
    i, j = math.floor(v), math.floor(u)
    a, b = v - i, u - j
    i0, j0 = int(i) & (size - 1), int(j) & (size - 1)
    i1, j1 = (i0 + 1) & (size - 1), (j0 + 1) & (size - 1)
    top = field[i0, j0] + b * (field[i0, j1] - field[i0, j0])
    low = field[i1, j0] + b * (field[i1, j1] - field[i1, j0])
    return float(top + a * (low - top))


@njit(cache=True, nogil=True, error_model="numpy")
def _place(x: float, y: float, origin: Array, axis: Array, along: Array, across: Array) -> None:
    """Write where a pixel is from a strip's first end, along it and to its right, in each pose, px."""
    for p in range(along.size):
        dx, dy = x - origin[0, p], y - origin[1, p]
        along[p] = dx * axis[0, p] + dy * axis[1, p]
        across[p] = dx * axis[1, p] - dy * axis[0, p]


@njit(cache=True, nogil=True, error_model="numpy")
def _near_weights(
    along: Array,
    across: Array,
    strip_px: Array,
    edges: Array,
    gain: float,
    table: Array,
    scale: float,
    reach: float,
    rows: Array,
    row_part: Array,
    nodes: Array,
    node_part: Array,
    beside: Array,
    weight: Array,
) -> None:
    """Write how much light each of a strip's clusters gives a pixel in each pose, when it shines.

    `edges` (clusters + 1, poses) are where they start and end along it, px; `table` is that of `strip_table`,
    followed for `reach` px. `rows` and `nodes`, int32, `row_part` and `node_part`, all (poses,), and `beside`
    (clusters + 1, poses) are overwritten; `weight` (clusters, poses) is the result, W/m2.
    """
    poses = along.size
    columns = table.shape[1]
    flat = table.reshape(-1)
    most = table.shape[0] - 1
    for p in range(poses):
        aside = abs(across[p])
        side = most * aside / (aside + scale)
        row = min(np.int32(side), np.int32(most - 1))
        row_part[p] = side - row
        rows[p] = row * columns
    half = 0.5 * (columns - 1)
    below = np.uint64(columns)
    one = np.uint64(1)
    for b in range(edges.shape[0]):
        # Apart, the first loop is one of vector instructions.
        for p in range(poses):
            z = along[p] - edges[b, p]
            at = half + half * z / (abs(z) + scale)
            node = min(np.int32(at), np.int32(columns - 2))
            node_part[p] = at - node
            nodes[p] = rows[p] + node
        for p in range(poses):
            k = np.uint64(nodes[p])
            low = flat[k] + node_part[p] * (flat[k + one] - flat[k])
            k += below
            high = flat[k] + node_part[p] * (flat[k + one] - flat[k])
            beside[b, p] = low + row_part[p] * (high - low)
    for b in range(weight.shape[0]):
        for p in range(poses):
            seen = (
                (edges[b + 1, p] > along[p] - reach)
                & (edges[b, p] < along[p] + reach)
                & (abs(across[p]) < reach + 0.5 * strip_px[p])
            )
            weight[b, p] = gain * (beside[b, p] - beside[b + 1, p]) if seen else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _add_near(weight: Array, levels: Array, pose: Array, light: Array) -> None:
    """Add the light of clusters (clusters, entries) that weigh (clusters, poses), each entry in its pose."""
    for b in range(weight.shape[0]):
        for j in range(light.size):
            light[j] += weight[b, np.uint64(pose[j])] * levels[b, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_halo(far: float, low: Array, high: Array, between: float, light: Array) -> None:
    """Add the light of a halo between two places of its grid."""
    for j in range(light.size):
        light[j] += far * (low[j] + between * (high[j] - low[j]))


@njit(cache=True, nogil=True, error_model="numpy")
def _find_pieces(
    t: Array, total: Array, switched: Array, first: int, t_us: Array, light: Array, draws: Array
) -> int:
    """Write when the light changes by more than `LIGHT_STEP`, from entry `first` on; return the last piece.

    The first piece is there; a change at the time of a piece's begin is its own.
    """
    piece = 0
    now = light[0]
    begin = t_us[0]
    for j in range(first, t.size):
        if abs(total[j] - now) <= LIGHT_STEP * now:
            continue
        now = total[j]
        if t[j] > begin:
            piece += 1
            begin = t_us[piece] = t[j]
            draws[piece] = 0
        light[piece] = now
        draws[piece] += switched[j]
    return piece


@njit(cache=True, nogil=True, error_model="numpy")
def run_pixels(
    first: int,
    last: int,
    pixels: Array,
    masks: Array,
    width: int,
    state: Array,
    counters: Array,
    block: int,
    begin_us: float,
    end_us: float,
    own_first: Array,
    own_t: Array,
    own_pose: Array,
    own_switched: Array,
    own_shade: Array,
    own_begins: Array,
    levels: Array,
    halo: Array,
    line_t: Array,
    line_pose: Array,
    line_switched: Array,
    line_shade: Array,
    line_own: Array,
    origin: Array,
    axis: Array,
    bounds: Array,
    strip_px: Array,
    clusters: Array,
    gain: Array,
    halo_first: Array,
    halo_per_px: Array,
    halo_share: Array,
    halo_every: Array,
    near_share: float,
    near_tables: Array,
    near_scale: Array,
    near_reach: Array,
    wide_table: Array,
    wide_per_px: Array,
    wiped: bool,
    turn_px: Array,
    texture_every: int,
    field: Array,
    background: Array,
    seed: Any,
    quantiles: Array,
    shifts: Array,
    sensor: Array,
    out_t: Array,
    out_code: Array,
    most_events: int,
) -> tuple[int, int]:
    """Run pixels [first, last) through one block of time; return (next pixel, number of events).

    It ends early, at a pixel for which the output might have no room. Bit i of `masks[j]` says that source i
    lights pixel j.

    The light on a pixel is constant between the entries of a time line, the first at `begin_us`. A source has
    one of its own, entries [own_first[i], own_first[i + 1]) of the flat `own_` arrays: when the image moves,
    when the share of all light that passes changes, and when it switches. `own_pose` is the image's pose from
    then on, `own_shade` that share, `own_switched` 1 where it is a switch; `levels` (clusters, entries) are
    those of its clusters, `halo` (halos, places, entries) is the light of each halo on a grid along the
    strip, as a share of full light. `own_begins` (sources + 1, poses + 1) is the entry with which a pose
    begins, from the source's first. The last line is one without a source. The `line_` arrays are one line of
    all entries, `line_own` (sources, entries) the entry of each source's own line, from its first, that holds
    then.

    (source, pose) arrays say where each strip is: `origin` (2, sources, poses), its first end, px; `axis`,
    the unit vector along it; `bounds` (sources, clusters + 1, poses), where its clusters start and end along
    it, px; `strip_px`, its width; `turn_px` is how far the texture has moved, looked up every `texture_every`
    poses. `halo_share` of the light is in each halo and `near_share` in the rest of the image of a point,
    which `near_tables` hold, from `strip_table`, followed for `near_reach` px. A halo stands where the strip
    is in the pose in the middle, or follows it every `halo_every[q]` poses where that is not 0. `background`
    is (irradiance on the sensor, dark current as light), W/m2; `sensor` comes from `sensor_vector`.
    """
    sources = gain.size
    halos = halo_share.size
    poses = turn_px.shape[0]
    halfway = poses // 2
    followed = sensor[12] > 0.0
    none = np.empty(0)
    along, across = np.empty((sources, poses)), np.empty((sources, poses))
    rows, row_part = np.empty(poses, np.int32), np.empty(poses)
    nodes, node_part = np.empty(poses, np.int32), np.empty(poses)
    beside = np.empty((levels.shape[0] + 1, poses))
    weight = np.empty((levels.shape[0], poses))
    around = np.empty(poses)
    part = np.empty(own_t.size)
    lit = np.zeros(sources + 1, np.int64)
    room = np.empty((3, line_t.size + 1))
    room_bits = room.view(np.int64)
    ahead = np.empty((2, _AHEAD))
    total = np.empty(line_t.size)
    t_us, light = np.empty(line_t.size + 2), np.empty(line_t.size + 1)
    draws = np.empty(line_t.size + 1, np.int64)
    lowest, highest = np.empty((sources, levels.shape[0] + 1)), np.empty((sources, levels.shape[0] + 1))
    for g in range(sources):
        for b in range(clusters[g] + 1):
            lowest[g, b], highest[g, b] = bounds[g, b].min(), bounds[g, b].max()
    n = 0
    for j in range(first, last):
        if n + most_events > out_t.size:
            return j, n
        pixel = pixels[j]
        mask = masks[j]
        code = ((pixel // width) << COLUMN_BITS | (pixel % width)) << 1
        y = float(pixel // width)
        x = float(pixel % width)
        s = state[pixel]
        c = counters[pixel]
        new = c[BLOCK] != block - 1
        c[BLOCK] = block
        if new and s[ON_FACTOR] == 0.0:
            s[ON_FACTOR], s[OFF_FACTOR] = pixel_factors(seed, pixel, sensor, quantiles)
            s[T_LAST_OUT] = -1e18
        shining = 0
        for g in range(sources):
            if (mask >> np.uint64(g)) & np.uint64(1):
                lit[shining] = g
                shining += 1
        now = 0.0
        for p in range(poses):
            if p % texture_every == 0:
                now = background[1] + background[0] * texture_at(field, x + turn_px[p, 0], y + turn_px[p, 1])
            around[p] = now
        for a in range(shining):
            g = lit[a]
            begin, end = own_first[g], own_first[g + 1]
            mine = part[begin:end]
            mine[:] = 0.0
            _place(x, y, origin[:, g], axis[:, g], along[g], across[g])
            reach = near_reach[g]
            nearest, furthest, beyond = along[g, 0], along[g, 0], False
            for p in range(poses):
                nearest, furthest = min(nearest, along[g, p]), max(furthest, along[g, p])
                beyond |= abs(across[g, p]) < reach + 0.5 * strip_px[g, p]
            if beyond:
                k = 0
                while k < clusters[g] and highest[g, k + 1] <= nearest - reach:
                    k += 1
                m = k
                while m < clusters[g] and lowest[g, m] < furthest + reach:
                    m += 1
                if m > k:
                    _near_weights(
                        along[g], across[g], strip_px[g], bounds[g, k : m + 1], gain[g] * near_share,
                        near_tables[g], near_scale[g], reach, rows, row_part, nodes, node_part,
                        beside[: m - k + 1],
                        weight[: m - k],
                    )  # fmt: skip
                    _add_near(weight[: m - k], levels[k:m, begin:end], own_pose[begin:end], mine)
            for q in range(halos):
                every = poses if halo_every[q] == 0 else halo_every[q]
                for pose in range(0, poses, every):
                    seen = halfway if halo_every[q] == 0 else pose
                    half = 0.5 * strip_px[g, seen]
                    far = (
                        gain[g]
                        * halo_share[q]
                        * (
                            _step(wide_table[q], wide_per_px[q], across[g, seen] + half)
                            - _step(wide_table[q], wide_per_px[q], across[g, seen] - half)
                        )
                    )
                    at = (along[g, seen] - halo_first[q]) * halo_per_px[q]
                    at = min(max(at, 0.0), halo.shape[1] - 1.001)
                    i = int(at)
                    start, stop = own_begins[g, pose], own_begins[g, min(pose + every, poses)]
                    _add_halo(
                        far, halo[q, i, begin + start : begin + stop],
                        halo[q, i + 1, begin + start : begin + stop], at - i, mine[start:stop],
                    )  # fmt: skip
        # The pieces of time in which its light stays as it is.
        if shining > 1:
            entries = line_t.size
            when, switched, pose_of, shade = line_t, line_switched, line_pose, line_shade
            for e in range(entries):
                total[e] = around[np.uint64(line_pose[e])]
            for a in range(shining):
                g = lit[a]
                begin = own_first[g]
                for e in range(entries):
                    total[e] += part[np.uint64(begin + line_own[g, e])]
        else:
            g = lit[0] if shining == 1 else sources
            begin, end = own_first[g], own_first[g + 1]
            entries = end - begin
            when, switched = own_t[begin:end], own_switched[begin:end]
            pose_of, shade = own_pose[begin:end], own_shade[begin:end]
            if shining == 1:
                for e in range(entries):
                    total[e] = around[np.uint64(pose_of[e])] + part[np.uint64(begin + e)]
            else:
                for e in range(entries):
                    total[e] = around[np.uint64(pose_of[e])]
        if wiped:
            for e in range(entries):
                if shade[e] != 1.0:
                    total[e] = background[1] + shade[e] * (total[e] - background[1])
        t_us[0], light[0], draws[0] = begin_us, s[LIGHT], 0
        if new:
            _rest(total[0], begin_us, followed, s, c)
            light[0], draws[0] = total[0], 1
        piece = _find_pieces(when, total, switched, int(new), t_us, light, draws)
        t_us[piece + 1] = end_us
        n = _run_pieces(
            piece + 1, t_us, light, draws, room, room_bits, ahead, s, c, code, _key_of(seed, pixel),
            quantiles, shifts, sensor, out_t, out_code, none, n,
        )  # fmt: skip
        s[T_BASE], s[LIGHT] = end_us, light[piece]
    return last, n


@njit(cache=True, nogil=True, error_model="numpy")
def background_events(
    begin_us: float,
    end_us: float,
    rate_hz: float,
    hot: Array,
    hot_rate_hz: float,
    width: int,
    height: int,
    slot: int,
    seed: Any,
    out_t: Array,
    out_code: Array,
) -> int:
    """Poisson events of all pixels (`rate_hz` together), then of the hot ones; return how many.

    Ends early when the output is full: the caller gives room enough.
    """
    n = 0
    for kind in range(2):
        total = (rate_hz if kind == 0 else hot_rate_hz) * 1e-6
        if total <= 0.0:
            continue
        t = begin_us
        k = 0
        while n < out_t.size:
            t -= math.log(1.0 - hash_uniform(seed, slot, k, 10 + 3 * kind)) / total
            if t >= end_us:
                break
            which = hash_uniform(seed, slot, k, 11 + 3 * kind)
            pixel = int(which * (width * height)) if kind == 0 else hot[int(which * hot.size)]
            on = int(hash_uniform(seed, slot, k, 12 + 3 * kind) < 0.5)
            out_t[n] = t
            out_code[n] = ((pixel // width) << COLUMN_BITS | (pixel % width)) << 1 | on
            n += 1
            k += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def find_hot_pixels(pixels: int, share: float, seed: Any, out: Array) -> int:
    """Mark the hot pixels, each by its own hash; return how many."""
    n = 0
    for pixel in range(pixels):
        if hash_uniform(seed, pixel, 0, 9) < share:
            out[n] = pixel
            n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def sort_events(t: Array, code: Array, out_t: Array, out_code: Array) -> None:
    """Sort by (time, pixel): by 22 bits of the time in two rounds, then insertion of what is left."""
    n = t.size
    if n == 0:
        return
    first = t[0]
    last = t[0]
    for i in range(n):
        first = min(first, t[i])
        last = max(last, t[i])
    scale = 4194303.0 / max(last - first, 1e-9)
    low = np.zeros(2049, np.int64)
    high = np.zeros(2049, np.int64)
    for i in range(n):
        key = int((t[i] - first) * scale)
        low[(key & 2047) + 1] += 1
        high[(key >> 11) + 1] += 1
    for b in range(2047):
        low[b + 1] += low[b]
        high[b + 1] += high[b]
    half_t, half_code = np.empty(n, t.dtype), np.empty(n, code.dtype)
    for i in range(n):
        b = int((t[i] - first) * scale) & 2047
        half_t[low[b]] = t[i]
        half_code[low[b]] = code[i]
        low[b] += 1
    for i in range(n):
        b = int((half_t[i] - first) * scale) >> 11
        out_t[high[b]] = half_t[i]
        out_code[high[b]] = half_code[i]
        high[b] += 1
    for i in range(1, n):
        when, what = out_t[i], out_code[i]
        if out_t[i - 1] < when:
            continue
        j = i
        while j > 0 and (out_t[j - 1] > when or (out_t[j - 1] == when and out_code[j - 1] > what)):
            out_t[j] = out_t[j - 1]
            out_code[j] = out_code[j - 1]
            j -= 1
        out_t[j] = when
        out_code[j] = what


@njit(cache=True, nogil=True, error_model="numpy")
def drop_blind(t: Array, code: Array, last_us: Array, width: int, refractory_us: float) -> int:
    """Drop, in place, events of pixels that are still blind from their last one; return how many stay."""
    kept = 0
    for i in range(t.size):
        pixel = (code[i] >> (COLUMN_BITS + 1)) * width + ((code[i] >> 1) & ((1 << COLUMN_BITS) - 1))
        # The smallest part of a us stands for the rounding of sums.
        if t[i] - last_us[pixel] >= refractory_us - 1e-6:
            last_us[pixel] = t[i]
            t[kept] = t[i]
            code[kept] = code[i]
            kept += 1
    return kept


@njit(cache=True, nogil=True, error_model="numpy")
def read_out(
    t: Array,
    code: Array,
    height: int,
    row_us: float,
    safe_us: float,
    cap: int,
    cap_window_us: int,
    memory: Array,
    pending: Array,
    out_t: Array,
    out_x: Array,
    out_y: Array,
    out_p: Array,
) -> tuple[int, int, int, int]:
    """Serve requests row by row until `safe_us`; what is not served yet moves to the front of `t` and `code`.

    One row is served at a time, which takes `row_us` and takes all its requests along; the next is the next
    one below with a request, and after the last row the first. More than `cap` events in a window of
    `cap_window_us` are dropped. `t` is sorted; `memory` holds (time when free, last row, number of the
    window, events in it) and is updated. Where `pending`, bool (rows, columns), all False, has any room, a
    pixel sends nothing while a request of its waits.

    Returns:
        (events written, events over the cap, requests of waiting pixels, requests left).
    """
    head = np.full(height, -1, np.int64)
    tail = np.full(height, -1, np.int64)
    follow = np.full(t.size, -1, np.int64)
    served = np.zeros(t.size, np.bool_)
    # One bit a row that waits.
    waits = np.zeros((height >> 6) + 1, np.uint64)
    free, at_row = memory[0], int(memory[1])
    window, used = int(memory[2]), int(memory[3])
    window_end = (window + 1) * cap_window_us
    n = 0
    dropped = 0
    held = 0
    waiting = 0
    i = 0
    while True:
        if waiting == 0:
            if i >= t.size:
                break
            free = max(free, t[i])
        if free >= safe_us:
            break
        while i < t.size and t[i] <= free:
            y = code[i] >> (COLUMN_BITS + 1)
            if pending.size:
                x = (code[i] >> 1) & ((1 << COLUMN_BITS) - 1)
                if pending[y, x]:
                    served[i] = True
                    held += 1
                    i += 1
                    continue
                pending[y, x] = True
            if head[y] < 0:
                head[y] = i
                waits[y >> 6] |= np.uint64(1) << np.uint64(y & 63)
            else:
                follow[tail[y]] = i
            tail[y] = i
            waiting += 1
            i += 1
        at_row += 1
        word = at_row >> 6
        bits = waits[word] >> np.uint64(at_row & 63) << np.uint64(at_row & 63)
        while bits == np.uint64(0):
            word = word + 1 if word + 1 < waits.size else 0
            bits = waits[word]
        lowest = bits & (~bits + np.uint64(1))
        at_row = word << 6 | _PLACES[(lowest * np.uint64(0x03F79D71B4CB0A89)) >> np.uint64(58)]
        free += row_us
        stamp = math.floor(free)
        if stamp >= window_end:
            window = stamp // cap_window_us
            window_end = (window + 1) * cap_window_us
            used = 0
        begin = n
        k = head[at_row]
        head[at_row] = -1
        waits[word] ^= lowest
        while k >= 0:
            waiting -= 1
            served[k] = True
            if pending.size:
                pending[at_row, (code[k] >> 1) & ((1 << COLUMN_BITS) - 1)] = False
            if cap > 0 and used >= cap:
                dropped += 1
            else:
                used += 1
                x = (code[k] >> 1) & ((1 << COLUMN_BITS) - 1)
                j = n
                while j > begin and out_x[j - 1] > x:
                    out_t[j], out_x[j], out_y[j], out_p[j] = stamp, out_x[j - 1], at_row, out_p[j - 1]
                    j -= 1
                out_t[j], out_x[j], out_y[j], out_p[j] = stamp, x, at_row, code[k] & 1
                n += 1
            k = follow[k]
    left = 0
    for k in range(t.size):
        if not served[k]:
            if pending.size:
                pending[code[k] >> (COLUMN_BITS + 1), (code[k] >> 1) & ((1 << COLUMN_BITS) - 1)] = False
            t[left] = t[k]
            code[left] = code[k]
            left += 1
    memory[0], memory[1], memory[2], memory[3] = free, at_row, window, used
    return n, dropped, held, left
