"""Pixels and readout, compiled.

Every random number is a hash of (seed, pixel, number of the draw, purpose). What runs pixels may round the
sum of a product once instead of twice (`contract`), which takes half as many instructions.
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
"""Columns of a pixel's counters; BLOCK is 2 more than the last block in which it was active, 0 for none."""

LIGHT_STEP = 1e-3
"""Relative change of a pixel's light that is not worth a new piece: the light stays until it is more."""

COLUMN_BITS = 13
"""A request's code is (row << COLUMN_BITS | column) << 1 | polarity."""

CODE_BITS = 2 * COLUMN_BITS + 1
"""A request is a word that sorts as a number: its ticks since a block began << CODE_BITS | its code."""

TICKS = float(1 << 20)
"""Ticks a us: of 1 ps, so that a word holds times of up to 65 ms before and after."""

_SERVED = -2
"""Instead of a request's follower: it waits no longer."""

_PLACES = np.empty(64, np.int64)
"""Place of the only bit of a word, by the upper bits of its product with a de Bruijn sequence."""
_PLACES[[(0x03F79D71B4CB0A89 << k & (1 << 64) - 1) >> 58 for k in range(64)]] = np.arange(64)

_NEAREST = 6755399441055744.0
"""Adding this puts the nearest integer into the lowest bits of a float64."""

NOISE_LIMIT = 4.0
"""Where the normal distribution of every draw is cut off, standard deviations."""


@njit(inline="always")
def _mix(z: Any) -> Any:
    """Return the finalizer of splitmix64: a bijection of 64-bit words that scatters them."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(inline="always")
def _key_of(seed: Any, pixel: int) -> Any:
    """Key of a pixel's random numbers."""
    return _mix(seed + np.uint64(pixel) * np.uint64(0x9E3779B97F4A7C15))


@njit
def hash_uniform(seed: Any, pixel: int, draw: int, purpose: int) -> float:
    """Uniform number in [0, 1) of one (seed, pixel, draw, purpose)."""
    z = _mix(_key_of(seed, pixel) + np.uint64(draw) * np.uint64(0xD1B54A32D192ED03) + np.uint64(purpose))
    return float(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(inline="always")
def _table_at(table: Array, share: float) -> float:
    """Linear interpolation in a table of quantiles, `share` in [0, 1)."""
    z = share * (table.size - 1)
    i = int(z)
    # An index without a sign is not looked at for being negative.
    k = np.uint64(i)
    return float(table[k] + (z - i) * (table[k + np.uint64(1)] - table[k]))


@njit
def hash_normal(seed: Any, pixel: int, draw: int, purpose: int, quantiles: Array) -> float:
    """Normal number, cut off at `NOISE_LIMIT`, from a table of the quantiles."""
    return float(_table_at(quantiles, hash_uniform(seed, pixel, draw, purpose)))


@njit(inline="always")
def _receptor(u_base: float, rest: float, ages: float) -> float:
    """Receptor after so many time constants; at rest after 60, when nothing of the difference is left."""
    return rest if ages > 60.0 else rest + (u_base - rest) * math.exp(-ages)


@njit
def _follow(y_from: float, y_to: float, z: float, whole: float, part: float, tau: float) -> float:
    """Return a low-pass filter's output after `part` of a ramp of `whole` us from y_from to y_to."""
    slope = (y_to - y_from) / whole
    return y_from + slope * (part - tau) + (z - y_from + slope * tau) * math.exp(-part / tau)


@njit
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
    """Let one pixel see a light, as in `_run_piece`, with a low-pass filter between receptor and comparator.

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


LANES = 192
"""Most pixels that pass through time together: what is done for each is a loop of vector instructions."""

_EVEN = 4
"""Lanes are filled up to a multiple of this, the numbers in a vector, so that no loop has a rest."""

# A batch's room: rows of LANES numbers, each of which begins here. Rows with constant places in one array are
# what the compiler knows to be apart. Of every pixel, and with _M_ of those that may fire in a piece of time:
_X, _Y, _NOW, _U, _REFERENCE, _READY, _LAST_OUT, _ON, _OFF, _FOLLOWER, _ARMED = range(0, 11 * LANES, LANES)
_REST, _END, _NEW, _AROUND, _TOTAL = range(11 * LANES, 16 * LANES, LANES)
_ALONG, _ACROSS, _ROW_PART, _NODE_PART = range(16 * LANES, 20 * LANES, LANES)
_M_U, _M_REST, _M_END, _M_REFERENCE, _M_READY, _M_LAST_OUT = range(20 * LANES, 26 * LANES, LANES)
_M_ON, _M_OFF, _M_AGE, _M_SHIFT, _M_FATE, _M_SPARE = range(26 * LANES, 32 * LANES, LANES)
_M_LATER, _M_CROSS, _M_LEVEL, _M_REQUEST, _ROOM = range(32 * LANES, 37 * LANES, LANES)


@njit(inline="always")
def _decay(age: float) -> float:
    """exp(-age) to 1e-14, 0 beyond 60; no branch, no call, so a loop of it is one of vector instructions."""
    within = min(age, 700.0)
    whole = within * 1.4426950408889634 + _NEAREST
    k = whole - _NEAREST
    r = (k * 0.693147180369123816490 - within) + k * 1.90821492927058770002e-10
    p = 1.0 / 39916800.0
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
    power = np.int64((1023 << 52) - (np.float64(whole).view(np.int64) << 52)).view(np.float64)
    return (p if age <= 60.0 else 0.0) * power


@njit(inline="always")
def _logarithm(of: float) -> float:
    """Natural logarithm, any value where `of` is not positive; without a branch or a call, as `_decay`."""
    bits = np.float64(of).view(np.int64)
    # The exponent as the lowest bits of 2^52.
    raised = np.int64((bits >> 52) & 0x7FF | 0x4330000000000000).view(np.float64)
    m = np.int64(bits & 0xFFFFFFFFFFFFF | 0x3FF0000000000000).view(np.float64)
    k = raised - (4503599627370496.0 + 1023.0)
    above = m > 1.4142135623730951
    m = 0.5 * m if above else m
    k = k + 1.0 if above else k
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    p = 2.0 / 15.0
    p = p * z + 2.0 / 13.0
    p = p * z + 2.0 / 11.0
    p = p * z + 2.0 / 9.0
    p = p * z + 2.0 / 7.0
    p = p * z + 2.0 / 5.0
    p = p * z + 2.0 / 3.0
    p = p * z + 2.0
    return k * 0.693147180369123816490 + (k * 1.90821492927058770002e-10 + p * s)


@njit(inline="always")
def _fill(which: Array, n: int) -> int:
    """Repeat the first of `n` lanes until there are a multiple of `_EVEN`; return how many are then."""
    even = (n + _EVEN - 1) // _EVEN * _EVEN
    for a in range(n, even):
        which[a] = which[0]
    return even


@njit(inline="always")
def _take(f: Array, row: int, which: Array, n: int, out: int) -> None:
    """Write the numbers of `n` lanes in a row side by side."""
    for a in range(n):
        f[out + a] = f[np.uint64(row + which[a])]


@njit(fastmath={"contract"})
def _run_piece(
    lanes: int,
    t_us: float,
    until: float,
    f: Array,
    bits: Array,
    key: Array,
    draw: Array,
    code: Array,
    which: Array,
    again: Array,
    kind: Array,
    quantiles: Array,
    shifts: Array,
    sensor: Array,
    out_t: Array,
    out_code: Array,
    out_cross: Array,
    n: int,
) -> int:
    """Let pixels see their light from `t_us` to `until`; write their events behind `n`, return how many then.

    With u = exp(-y) the receptor is u(t) = 1/I + (u0 - 1/I) exp(-I t / Q), which is monotonic; so a threshold
    is crossed in a piece when u at its end lies beyond, and the time follows from one logarithm. A pixel is
    blind as long as `_READY` is not past. Those that see again are picked, those that may fire for the noise
    that is the most, and of them those that do; their next events are computed together, until there are
    none. `shifts` are the quantiles of the factor by which
    noise moves both thresholds. One word of random bits a draw, from the pixel's key: the upper half decides
    on the noise, the lower on whether the event goes missing.

    `f` holds the rows of a batch, `bits` is its int64 view; `which`, `again` and `kind`, int64 (LANES,), are
    room.
    """
    charge, refractory = sensor[0], sensor[1]
    delay_on, delay_off, jitter = sensor[2], sensor[3], sensor[4]
    miss_on, miss_off, widest = sensor[5], sensor[6], sensor[8]
    if sensor[12] > 0.0:
        for i in range(lanes):
            (
                f[_U + i], f[_FOLLOWER + i], f[_REFERENCE + i], f[_READY + i], f[_LAST_OUT + i], armed,
                draw[i], n,
            ) = _run_piece_followed(
                until, f[_NOW + i], f[_U + i], t_us, f[_FOLLOWER + i], f[_REFERENCE + i], f[_READY + i],
                f[_LAST_OUT + i], int(f[_ARMED + i]), draw[i], f[_ON + i], f[_OFF + i], code[i], key[i],
                quantiles, shifts, sensor, out_t, out_code, out_cross, n,
            )  # fmt: skip
            f[_ARMED + i] = armed
        return n
    per_charge = 1.0 / charge
    span = until - t_us
    for i in range(lanes):
        now = f[_NOW + i]
        rest = 1.0 / now
        end = rest + (f[_U + i] - rest) * _decay(now * per_charge * span)
        f[_REST + i], f[_END + i] = rest, end
        reference, ready = f[_REFERENCE + i], f[_READY + i]
        on = end <= reference * f[_ON + i] * widest
        off = end * widest >= reference * f[_OFF + i]
        kind[i] = 1 if (ready < t_us) & (on | off) else (2 if (ready >= t_us) & (ready < until) else 0)
    m = blind = 0
    for i in range(lanes):
        which[np.uint64(m)] = i
        m += kind[i] & 1
    for i in range(lanes):
        again[np.uint64(blind)] = i
        blind += kind[i] >> 1
    while True:
        # Those that see again in this piece, and of them those that may fire.
        even = _fill(again, blind)
        _take(f, _U, again, even, _M_U)
        _take(f, _REST, again, even, _M_REST)
        _take(f, _END, again, even, _M_END)
        _take(f, _ON, again, even, _M_ON)
        _take(f, _OFF, again, even, _M_OFF)
        _take(f, _READY, again, even, _M_READY)
        _take(f, _NOW, again, even, _M_AGE)
        for a in range(even):
            rest, end = f[_M_REST + a], f[_M_END + a]
            kept = _decay((f[_M_READY + a] - t_us) * per_charge * f[_M_AGE + a])
            reference = rest + (f[_M_U + a] - rest) * kept
            f[_M_REFERENCE + a] = reference
            on = end <= reference * f[_M_ON + a] * widest
            off = end * widest >= reference * f[_M_OFF + a]
            kind[a] = 1 if on | off else 0
        for a in range(blind):
            i = again[a]
            f[np.uint64(_REFERENCE + i)] = f[_M_REFERENCE + a]
            draw[np.uint64(i)] += 1
            which[np.uint64(m)] = i
            m += kind[a]
        if m == 0:
            break
        even = _fill(which, m)
        for a in range(even):
            k = np.uint64(which[a])
            word = _mix(key[k] + np.uint64(draw[k]) * np.uint64(0xD1B54A32D192ED03))
            bits[_M_SPARE + a] = np.int64(word)
        # Half a word becomes the lowest bits of 2^52.
        for a in range(even):
            bits[_M_SHIFT + a] = (bits[_M_SPARE + a] >> 32) & 0xFFFFFFFF | 0x4330000000000000
            bits[_M_FATE + a] = bits[_M_SPARE + a] & 0xFFFFFFFF | 0x4330000000000000
        for a in range(even):
            f[_M_SHIFT + a] = (f[_M_SHIFT + a] - 4503599627370496.0) * 2.3283064365386963e-10
            f[_M_FATE + a] = (f[_M_FATE + a] - 4503599627370496.0) * 2.3283064365386963e-10
        # By itself, so that many parts of the table are on their way at once.
        for a in range(even):
            f[_M_SHIFT + a] = _table_at(shifts, f[_M_SHIFT + a])
        _take(f, _REFERENCE, which, even, _M_REFERENCE)
        _take(f, _END, which, even, _M_END)
        _take(f, _ON, which, even, _M_ON)
        _take(f, _OFF, which, even, _M_OFF)
        for a in range(even):
            end = f[_M_END + a]
            level = f[_M_REFERENCE + a] * f[_M_SHIFT + a]
            low, high = level * f[_M_ON + a], level * f[_M_OFF + a]
            on = end <= low
            f[_M_LEVEL + a] = low if on else high
            f[_M_ON + a] = 1.0 if on else 0.0
            kind[a] = 1 if on | (end >= high) else 0
        # Those that fire move to the front.
        fires = 0
        for a in range(m):
            k = np.uint64(fires)
            f[np.uint64(_M_LEVEL) + k] = f[_M_LEVEL + a]
            f[np.uint64(_M_ON) + k] = f[_M_ON + a]
            f[np.uint64(_M_FATE) + k] = f[_M_FATE + a]
            which[k] = which[a]
            fires += kind[a]
        if fires == 0:
            break
        even = _fill(which, fires)
        _take(f, _U, which, even, _M_U)
        _take(f, _REST, which, even, _M_REST)
        _take(f, _READY, which, even, _M_READY)
        _take(f, _LAST_OUT, which, even, _M_LAST_OUT)
        if jitter > 0.0:
            for a in range(fires):
                k = np.uint64(which[a])
                f[_M_LATER + a] = jitter * hash_normal(key[k], 0, draw[k], 2, quantiles)
        for a in range(even):
            u, rest, level = f[_M_U + a], f[_M_REST + a], f[_M_LEVEL + a]
            ready, on = f[_M_READY + a], f[_M_ON + a] > 0.0
            # Where it is beyond the threshold from the first, there is no way to it.
            beyond = (u <= level) if on else (u >= level)
            tau = 0.0 if beyond else charge * rest
            t = max(ready, t_us)
            t = min(max(t_us + _logarithm((u - rest) / (level - rest)) * tau, t), until)
            late = max((delay_on if on else delay_off) + f[_M_LATER + a], 0.0)
            ready = t + refractory
            f[_M_CROSS + a] = t
            f[_M_REQUEST + a] = max(t + late, f[_M_LAST_OUT + a] + refractory)
            f[_M_READY + a] = ready
            sent = f[_M_FATE + a] >= (miss_on if on else miss_off)
            kind[a] = (1 if on else 0) | (2 if sent else 0) | (4 if ready < until else 0)
        blind = 0
        for a in range(fires):
            i, what = which[a], kind[a]
            f[np.uint64(_READY + i)] = f[_M_READY + a]
            f[np.uint64(_LAST_OUT + i)] = f[_M_REQUEST + a]
            # What is missed is written over; that is quicker than a branch which cannot be foreseen.
            out_t[np.uint64(n)] = f[_M_REQUEST + a]
            out_code[np.uint64(n)] = code[np.uint64(i)] + (what & 1)
            if out_cross.size:
                out_cross[np.uint64(n)] = f[_M_CROSS + a]
            n += (what >> 1) & 1
            again[np.uint64(blind)] = i
            blind += what >> 2
        m = 0
        if blind == 0:
            break
    for i in range(lanes):
        f[_U + i] = f[_END + i]
    return n


@njit
def pixel_factors(seed: Any, pixel: int, sensor: Array, quantiles: Array) -> tuple[float, float]:
    """exp(-threshold) for ON and exp(threshold) for OFF of one pixel, with its spread."""
    on = sensor[9] * (1.0 + sensor[11] * hash_normal(seed, pixel, 0, 3, quantiles))
    off = sensor[10] * (1.0 + sensor[11] * hash_normal(seed, pixel, 0, 4, quantiles))
    return math.exp(-on), math.exp(off)


@njit(inline="always")
def _rest(light: float, followed: bool, f: Array, i: int) -> None:
    """Put a pixel at rest in a light, armed."""
    f[_NOW + i], f[_U + i], f[_FOLLOWER + i] = light, 1.0 / light, math.log(light)
    f[_READY + i], f[_ARMED + i] = -1e18, 1.0
    f[_REFERENCE + i] = f[_FOLLOWER + i] if followed else f[_U + i]


@njit(inline="always")
def _leave_empty(begin: int, end: int, f: Array, key: Array, draw: Array, code: Array) -> None:
    """Fill lanes without a pixel with one that never fires."""
    for i in range(begin, end):
        f[_X + i] = f[_Y + i] = f[_NEW + i] = 0.0
        f[_NOW + i] = f[_U + i] = f[_REFERENCE + i] = f[_ARMED + i] = 1.0
        f[_READY + i] = f[_LAST_OUT + i] = -1e18
        f[_ON + i], f[_OFF + i], f[_FOLLOWER + i] = 0.0, 1e300, 0.0
        key[i], draw[i], code[i] = np.uint64(0), 0, 0


@njit(fastmath={"contract"})
def run_given_light(
    first: int,
    last: int,
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
    """Run pixels [first, last), at most `LANES`, at rest in light[0], through light[i] from edge_us[i] on.

    Returns how many events there are; a code is the pixel's number << 1 | polarity.
    """
    f = np.zeros(_ROOM)
    bits = f.view(np.int64)
    key, draw = np.empty(LANES, np.uint64), np.empty(LANES, np.int64)
    code, kind = np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    which, again = np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    followed = sensor[12] > 0.0
    lanes = last - first
    if not followed:
        lanes = (lanes + _EVEN - 1) // _EVEN * _EVEN
    _leave_empty(last - first, lanes, f, key, draw, code)
    for i in range(last - first):
        key[i], draw[i], code[i] = _key_of(seed, first + i), 0, (first + i) << 1
        f[_ON + i], f[_OFF + i] = pixel_factors(seed, first + i, sensor, quantiles)
        f[_LAST_OUT + i] = -1e18
        _rest(light[0], followed, f, i)
    n = 0
    for j in range(light.size):
        until = edge_us[j + 1] if j + 1 < light.size else end_us
        for i in range(lanes):
            f[_NOW + i] = light[j]
            draw[i] += 1
        if until > edge_us[j]:
            n = _run_piece(
                lanes, edge_us[j], until, f, bits, key, draw, code, which, again, kind, quantiles, shifts,
                sensor, out_t, out_code, out_cross, n,
            )  # fmt: skip
    return n


@njit(inline="always")
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


@njit
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


@njit(inline="always")
def _place(lanes: int, f: Array, x: float, y: float, axis_x: float, axis_y: float) -> None:
    """Write where pixels are from a strip's first end (x, y), along it and to its right, px."""
    for i in range(lanes):
        dx, dy = f[_X + i] - x, f[_Y + i] - y
        f[_ALONG + i] = dx * axis_x + dy * axis_y
        f[_ACROSS + i] = dx * axis_y - dy * axis_x


@njit(fastmath={"contract"})
def _near_weights(
    lanes: int,
    f: Array,
    strip_px: float,
    edges: Array,
    gain: float,
    table: Array,
    scale: float,
    reach: float,
    rows: Array,
    nodes: Array,
    beside: Array,
    weight: Array,
) -> None:
    """Write how much light each of a strip's clusters gives each pixel, when it shines.

    `edges` (clusters + 1,) are where they start and end along it, px; `table` is that of `strip_table`,
    followed for `reach` px. `rows` and `nodes`, int32 (LANES,), and `beside`, float64
    (LANES * (clusters + 1),), are overwritten; `weight` is the result, W/m2, cluster by cluster float64
    (LANES * clusters,).
    """
    columns = table.shape[1]
    flat = table.reshape(-1)
    most = table.shape[0] - 1
    for i in range(lanes):
        aside = abs(f[_ACROSS + i])
        side = most * aside / (aside + scale)
        row = min(np.int32(side), np.int32(most - 1))
        f[_ROW_PART + i] = side - row
        rows[i] = row * columns
    half = 0.5 * (columns - 1)
    below = np.uint64(columns)
    one = np.uint64(1)
    for b in range(edges.size):
        # Apart, the first loop is one of vector instructions.
        edge = edges[b]
        for i in range(lanes):
            z = f[_ALONG + i] - edge
            at = half + half * z / (abs(z) + scale)
            node = min(np.int32(at), np.int32(columns - 2))
            f[_NODE_PART + i] = at - node
            nodes[i] = rows[i] + node
        first = np.uint64(b * LANES)
        for i in range(lanes):
            k = np.uint64(nodes[i])
            low = flat[k] + f[_NODE_PART + i] * (flat[k + one] - flat[k])
            k += below
            high = flat[k] + f[_NODE_PART + i] * (flat[k + one] - flat[k])
            beside[first + np.uint64(i)] = low + f[_ROW_PART + i] * (high - low)
    for b in range(edges.size - 1):
        first, behind = np.uint64(b * LANES), np.uint64((b + 1) * LANES)
        for i in range(lanes):
            seen = (
                (f[_ALONG + i] > edges[b] - reach)
                & (f[_ALONG + i] < edges[b + 1] + reach)
                & (abs(f[_ACROSS + i]) < reach + 0.5 * strip_px)
            )
            share = beside[first + np.uint64(i)] - beside[behind + np.uint64(i)]
            weight[first + np.uint64(i)] = gain * share if seen else 0.0


@njit(fastmath={"contract"})
def run_pixels(
    first: int,
    last: int,
    pixels: Array,
    batches: Array,
    masks: Array,
    strides: Array,
    width: int,
    state: Array,
    counters: Array,
    block: int,
    end_us: float,
    line_t: Array,
    line_kind: Array,
    line_pose: Array,
    line_shade: Array,
    line_row: Array,
    levels: Array,
    halo: Array,
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
    """Run batches [first, last) of pixels through one block of time; return (next batch, number of events).

    It ends early, at a batch for which the output might have no room. Batch j is pixels[batches[j]] up to
    pixels[batches[j + 1]], `LANES` at the most; bit i of `masks[j]` says that source i lights them, and they
    see where the sources are anew in every `strides[j]`-th pose only.

    The light on a pixel is constant between the entries of a time line, the first where the block begins:
    when the image moves (`line_kind` -2), when the share of all light that passes changes (-1), and when the
    source of this number switches. `line_pose` is the image's pose from then on, `line_shade` that share,
    `line_row` (sources, entries) the row of `levels` (rows, clusters) that a source shows; `halo` (halos,
    rows, places) is its light in each halo on a grid along the strip, as a share of full light.

    (source, pose) arrays say where each strip is: `origin` (2, sources, poses), its first end, px; `axis`,
    the unit vector along it; `bounds` (sources, clusters + 1, poses), where its clusters start and end along
    it, px; `strip_px`, its width; `turn_px` is how far the texture has moved, looked up every `texture_every`
    poses. `halo_share` of the light is in each halo and `near_share` in the rest of the image of a point,
    which `near_tables` hold, from `strip_table`, followed for `near_reach` px. A halo stands where the strip
    is in the pose in the middle, or follows it every `halo_every[q]` poses where that is not 0. `background`
    is (irradiance on the sensor, dark current as light), W/m2; `sensor` comes from `sensor_vector`.
    """
    sources, halos, poses = gain.size, halo_share.size, turn_px.shape[0]
    most = levels.shape[1]
    entries = line_t.size
    followed = sensor[12] > 0.0
    f = np.zeros(_ROOM)
    bits = f.view(np.int64)
    key, draw = np.empty(LANES, np.uint64), np.empty(LANES, np.int64)
    code, kind = np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    which, again = np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    rows, nodes = np.empty(LANES, np.int32), np.empty(LANES, np.int32)
    beside = np.empty(LANES * (most + 1))
    none = np.empty(0)
    mine = np.empty(entries + 1, np.int64)
    lit = np.empty(sources, np.int64)
    # Of each source that shines: its clusters within reach, their weights, and its light on the pixels.
    low, high, shown = np.empty(sources, np.int64), np.empty(sources, np.int64), np.empty(sources, np.int64)
    weight = np.empty((sources, LANES * most))
    part = np.empty((sources, LANES))
    far, between = np.empty((sources, halos, LANES)), np.empty((sources, halos, LANES))
    place = np.empty((sources, halos, LANES), np.int64)
    wide = np.empty((sources, halos, LANES))
    n = 0
    for j in range(first, last):
        if n + LANES * most_events > out_t.size:
            return j, n
        begin, count, mask, stride = batches[j], batches[j + 1] - batches[j], masks[j], strides[j]
        lanes = count if followed else (count + _EVEN - 1) // _EVEN * _EVEN
        _leave_empty(count, lanes, f, key, draw, code)
        for i in range(count):
            pixel = pixels[begin + i]
            s, c = state[pixel], counters[pixel]
            code[i] = ((pixel // width) << COLUMN_BITS | (pixel % width)) << 1
            key[i] = _key_of(seed, pixel)
            f[_X + i], f[_Y + i] = pixel % width, pixel // width
            new = c[BLOCK] != block + 1
            f[_NEW + i] = 1.0 if new else 0.0
            if new and s[ON_FACTOR] == 0.0:
                s[ON_FACTOR], s[OFF_FACTOR] = pixel_factors(seed, pixel, sensor, quantiles)
                s[T_LAST_OUT] = -1e18
            f[_ON + i], f[_OFF + i], f[_LAST_OUT + i] = s[ON_FACTOR], s[OFF_FACTOR], s[T_LAST_OUT]
            f[_U + i], f[_REFERENCE + i], f[_READY + i] = s[U_BASE], s[REFERENCE], s[T_READY]
            f[_NOW + i], f[_FOLLOWER + i], f[_ARMED + i] = s[LIGHT], s[FOLLOWER], float(c[ARMED])
            draw[i] = c[DRAW]
        shining = 0
        for g in range(sources):
            if (mask >> np.uint64(g)) & np.uint64(1):
                lit[shining] = g
                shining += 1
        own = 0
        for e in range(entries):
            what = line_kind[e]
            if what == -2:
                takes = line_pose[e] % stride == 0
            else:
                takes = what == -1 or (mask >> np.uint64(what)) & np.uint64(1) != np.uint64(0)
            if takes:
                mine[own] = e
                own += 1
        pose = -1
        for q in range(own):
            e = mine[q]
            t_us = line_t[e]
            until = line_t[mine[q + 1]] if q + 1 < own else end_us
            before = pose
            pose = line_pose[e] // stride * stride
            moved = pose != before
            # Where the sources are in the middle of these poses.
            here = min(pose + stride // 2, poses - 1)
            if before < 0 or pose // texture_every != before // texture_every:
                for i in range(lanes):
                    now = texture_at(field, f[_X + i] + turn_px[pose, 0], f[_Y + i] + turn_px[pose, 1])
                    f[_AROUND + i] = background[1] + background[0] * now
            for i in range(lanes):
                f[_TOTAL + i] = f[_AROUND + i]
            for a in range(shining):
                g = lit[a]
                row = line_row[g, e]
                switched = q == 0 or row != shown[a]
                shown[a] = row
                stale = switched
                for h in range(halos):
                    every = halo_every[h]
                    follows = before < 0 or (every > 0 and pose // every != before // every)
                    if follows:
                        at = poses // 2 if every == 0 else here
                        _place(lanes, f, origin[0, g, at], origin[1, g, at], axis[0, g, at], axis[1, g, at])
                        half = 0.5 * strip_px[g, at]
                        for i in range(lanes):
                            across = _step(wide_table[h], wide_per_px[h], f[_ACROSS + i] + half)
                            across -= _step(wide_table[h], wide_per_px[h], f[_ACROSS + i] - half)
                            far[a, h, i] = gain[g] * halo_share[h] * across
                            node = (f[_ALONG + i] - halo_first[h]) * halo_per_px[h]
                            node = min(max(node, 0.0), halo.shape[2] - 1.001)
                            place[a, h, i] = int(node)
                            between[a, h, i] = node - int(node)
                    if follows or switched:
                        stale = True
                        for i in range(lanes):
                            k = np.uint64(place[a, h, i])
                            left, right = halo[h, row, k], halo[h, row, k + np.uint64(1)]
                            wide[a, h, i] = far[a, h, i] * (left + between[a, h, i] * (right - left))
                if moved:
                    _place(
                        lanes, f, origin[0, g, here], origin[1, g, here], axis[0, g, here], axis[1, g, here]
                    )
                    nearest = furthest = f[_ALONG]
                    beyond = False
                    reach = near_reach[g]
                    for i in range(count):
                        nearest, furthest = min(nearest, f[_ALONG + i]), max(furthest, f[_ALONG + i])
                        beyond |= abs(f[_ACROSS + i]) < reach + 0.5 * strip_px[g, here]
                    b = 0
                    while b < clusters[g] and bounds[g, b + 1, here] <= nearest - reach:
                        b += 1
                    m = b
                    while beyond and m < clusters[g] and bounds[g, m, here] < furthest + reach:
                        m += 1
                    low[a], high[a] = b, m
                    if m > b:
                        _near_weights(
                            lanes, f, strip_px[g, here], bounds[g, b : m + 1, here], gain[g] * near_share,
                            near_tables[g], near_scale[g], reach, rows, nodes, beside, weight[a],
                        )  # fmt: skip
                if moved or stale:
                    for i in range(lanes):
                        part[a, i] = 0.0
                    for b in range(low[a], high[a]):
                        level = levels[row, b]
                        if level != 0.0:
                            of = np.uint64((b - low[a]) * LANES)
                            for i in range(lanes):
                                part[a, i] += weight[a, of + np.uint64(i)] * level
                    for h in range(halos):
                        for i in range(lanes):
                            part[a, i] += wide[a, h, i]
                for i in range(lanes):
                    f[_TOTAL + i] += part[a, i]
            shade = line_shade[e]
            if shade != 1.0:
                for i in range(lanes):
                    f[_TOTAL + i] = background[1] + shade * (f[_TOTAL + i] - background[1])
            if q == 0:
                for i in range(count):
                    if f[_NEW + i] > 0.0:
                        _rest(f[_TOTAL + i], followed, f, i)
                        draw[i] += 1
            redraw = int(line_kind[e] >= 0)
            for i in range(lanes):
                total, now = f[_TOTAL + i], f[_NOW + i]
                changes = abs(total - now) > LIGHT_STEP * now
                f[_NOW + i] = total if changes else now
                draw[i] += redraw if changes else 0
            if until > t_us:
                n = _run_piece(
                    lanes, t_us, until, f, bits, key, draw, code, which, again, kind, quantiles, shifts,
                    sensor, out_t, out_code, none, n,
                )  # fmt: skip
        for i in range(count):
            pixel = pixels[begin + i]
            s, c = state[pixel], counters[pixel]
            s[U_BASE], s[T_BASE], s[REFERENCE] = f[_U + i], end_us, f[_REFERENCE + i]
            s[T_READY], s[T_LAST_OUT] = f[_READY + i], f[_LAST_OUT + i]
            s[LIGHT], s[FOLLOWER] = f[_NOW + i], f[_FOLLOWER + i]
            c[DRAW], c[ARMED], c[BLOCK] = draw[i], int(f[_ARMED + i]), block + 2
    return last, n


@njit
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


@njit
def as_words(t: Array, code: Array, begin_us: float, words: Array) -> None:
    """Write requests as words, their times since `begin_us` to the nearest tick."""
    for i in range(t.size):
        ticks = np.float64((t[i] - begin_us) * TICKS + _NEAREST).view(np.int64)
        words[i] = ticks << CODE_BITS | np.int64(code[i])


@njit(inline="always")
def _us_of(word: int, begin_us: float) -> float:
    """When a request is, us."""
    return begin_us + np.float64(word >> CODE_BITS) * (1.0 / TICKS)


@njit(inline="always")
def _row_of(word: int) -> Any:
    """Row of a request; without a sign it is not looked at for being negative."""
    return np.uint64(word >> (COLUMN_BITS + 1) & ((1 << COLUMN_BITS) - 1))


@njit(inline="always")
def _column_of(word: int) -> Any:
    """Column of a request."""
    return np.uint64(word >> 1 & ((1 << COLUMN_BITS) - 1))


@njit
def sort_words(words: Array, out: Array) -> None:
    """Sort int64 words: by 22 bits of their range in two rounds, then insertion of what is left."""
    n = words.size
    if n == 0:
        return
    first = last = words[0]
    for i in range(n):
        first, last = min(first, words[i]), max(last, words[i])
    drop = 0
    while (last - first) >> drop >= 1 << 22:
        drop += 1
    shift, eleven, part = np.uint64(drop), np.uint64(11), np.uint64(2047)
    low, high = np.zeros(2049, np.int64), np.zeros(2049, np.int64)
    for i in range(n):
        key = np.uint64(words[i] - first) >> shift
        low[(key & part) + np.uint64(1)] += 1
        high[(key >> eleven) + np.uint64(1)] += 1
    for b in range(2047):
        low[b + 1] += low[b]
        high[b + 1] += high[b]
    half = np.empty(n, words.dtype)
    for i in range(n):
        key = np.uint64(words[i] - first) >> shift & part
        half[np.uint64(low[key])] = words[i]
        low[key] += 1
    for i in range(n):
        key = np.uint64(half[i] - first) >> (shift + eleven)
        out[np.uint64(high[key])] = half[i]
        high[key] += 1
    before = out[0]
    for i in range(1, n):
        word = out[i]
        if word >= before:
            before = word
            continue
        j = i
        while j > 0 and out[j - 1] > word:
            out[j] = out[j - 1]
            j -= 1
        out[j] = word


@njit
def drop_blind(words: Array, begin_us: float, blind_us: Array, width: int, refractory_us: float) -> int:
    """Drop, in place, requests of pixels that are blind until `blind_us`; return how many stay."""
    kept = 0
    for i in range(words.size):
        word = words[i]
        pixel = _row_of(word) * np.uint64(width) + _column_of(word)
        t = _us_of(word, begin_us)
        # What is dropped is written over.
        words[np.uint64(kept)] = word
        if t >= blind_us[pixel]:
            # The smallest part of a us stands for the rounding of both times to ticks.
            blind_us[pixel] = t + (refractory_us - 1e-6)
            kept += 1
    return kept


@njit
def read_out(
    words: Array,
    begin_us: float,
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
    """Serve requests row by row until `safe_us`; what is not served yet moves to the front of `words`.

    One row is served at a time, which takes `row_us` and takes all its requests along; the next is the next
    one below with a request, and after the last row the first. More than `cap` events in a window of
    `cap_window_us` are dropped. `words` are sorted, their times since `begin_us`; `memory` holds (time when
    free, last row, number of the window, events in it) and is updated. Where `pending`, bool (rows, columns),
    all False, has any room, a pixel sends nothing while a request of its waits.

    Returns:
        (events written, events over the cap, requests of waiting pixels, requests left).
    """
    size = words.size
    # Behind each request the next one of its row that waits; a row's first stands behind the requests, and
    # `tail` is where its next belongs.
    follow, tail = np.empty(size + height, np.int32), np.empty(height, np.int32)
    for i in range(height):
        tail[i], follow[size + i] = size + i, -1
    # What is read out: column, number in its row, polarity.
    together = np.empty(size, np.int64)
    # One bit a row that waits.
    waits = np.zeros((height >> 6) + 1, np.uint64)
    hold = pending.size > 0
    free, at_row = memory[0], int(memory[1])
    window, used = int(memory[2]), int(memory[3])
    window_end = (window + 1) * cap_window_us
    n = dropped = held = waiting = i = 0
    due = _us_of(words[0], begin_us) if size else math.inf
    while True:
        if waiting == 0:
            if i >= size:
                break
            free = max(free, due)
        if free >= safe_us:
            break
        while due <= free:
            k = np.uint64(i)
            y = _row_of(words[k])
            if hold and pending[y, _column_of(words[k])]:
                follow[k] = _SERVED
                held += 1
            else:
                if hold:
                    pending[y, _column_of(words[k])] = True
                follow[np.uint64(tail[y])] = i
                follow[k] = -1
                tail[y] = i
                waits[y >> np.uint64(6)] |= np.uint64(1) << (y & np.uint64(63))
                waiting += 1
            i += 1
            due = _us_of(words[np.uint64(i)], begin_us) if i < size else math.inf
        if waiting == 0:
            continue
        at_row += 1
        place = at_row >> 6
        bits = waits[place] >> np.uint64(at_row & 63) << np.uint64(at_row & 63)
        while bits == np.uint64(0):
            place = place + 1 if place + 1 < waits.size else 0
            bits = waits[place]
        lowest = bits & (~bits + np.uint64(1))
        waits[place] ^= lowest
        at_row = place << 6 | _PLACES[(lowest * np.uint64(0x03F79D71B4CB0A89)) >> np.uint64(58)]
        free += row_us
        stamp = math.floor(free)
        if stamp >= window_end:
            window = stamp // cap_window_us
            window_end = (window + 1) * cap_window_us
            used = 0
        y = np.uint64(at_row)
        next_one = int(follow[np.uint64(size) + y])
        tail[y], follow[np.uint64(size) + y] = size + at_row, -1
        begin = n
        while next_one >= 0:
            k = np.uint64(next_one)
            next_one = int(follow[k])
            follow[k] = _SERVED
            what = words[k]
            waiting -= 1
            if hold:
                pending[y, _column_of(what)] = False
            if cap > 0 and used >= cap:
                dropped += 1
                continue
            used += 1
            # By column, then in the order in which they came; without a branch, which could not be foreseen.
            it = np.int64(_column_of(what)) << 32 | (n - begin) << 1 | what & 1
            for j in range(begin, n):
                other = together[np.uint64(j)]
                together[np.uint64(j)] = min(other, it)
                it = max(other, it)
            last = np.uint64(n)
            together[last], out_t[last], out_y[last] = it, stamp, at_row
            n += 1
    for j in range(n):
        out_x[j], out_p[j] = together[j] >> 32, together[j] & 1
    left = 0
    for m in range(size):
        if m >= i or follow[m] != _SERVED:
            if hold:
                pending[_row_of(words[m]), _column_of(words[m])] = False
            words[left] = words[m]
            left += 1
    memory[0], memory[1], memory[2], memory[3] = free, at_row, window, used
    return n, dropped, held, left
