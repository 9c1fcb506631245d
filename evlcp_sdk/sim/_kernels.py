"""Pixels and readout, compiled.

Every random number is a hash of (seed, pixel, number of the draw, purpose). What runs pixels may round the
sum of a product once instead of twice (`contract`), which takes half as many instructions.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]

ON_FACTOR, OFF_FACTOR, U_BASE, REFERENCE, T_READY, T_LAST_OUT, LIGHT, FOLLOWER = range(8)
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

PIXEL_STEP, DRAW_STEP = 0x9E3779B97F4A7C15, 0xD1B54A32D192ED03
"""By how much the keys of two pixels, and of two draws of a pixel, differ before they are scattered."""


@njit(inline="always")
def mix(z: Any) -> Any:
    """Return the finalizer of splitmix64: a bijection of 64-bit words that scatters them."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(inline="always")
def _table_at(table: Array, share: float) -> float:
    """Linear interpolation in a table of quantiles, `share` in [0, 1)."""
    z = share * (table.size - 1)
    i = int(z)
    # An index without a sign is not looked at for being negative.
    k = np.uint64(i)
    return float(table[k] + (z - i) * (table[k + np.uint64(1)] - table[k]))


@njit
def hash_normal(seed: Any, pixel: int, draw: Any, purpose: int, quantiles: Array) -> float:
    """Normal number of one (seed, pixel, draw, purpose), cut off at `NOISE_LIMIT`, from its quantiles."""
    key = mix(seed + np.uint64(pixel) * np.uint64(PIXEL_STEP))
    z = mix(key + np.uint64(draw) * np.uint64(DRAW_STEP) + np.uint64(purpose))
    return float(_table_at(quantiles, float(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)))


LANES = 192
"""Most pixels that pass through time together: what is done for each is a loop of vector instructions."""

_EVEN = 4
"""Lanes are filled up to a multiple of this, the numbers in a vector, so that no loop has a rest: with the
last of them again, of which nothing is taken."""

# A batch's room: rows of LANES numbers, each of which begins here. Rows with constant places in one array are
# what the compiler knows to be apart. Of every pixel, and with _M_ of those that may fire in a piece of time:
_X, _Y, _NOW, _U, _REFERENCE, _READY, _LAST_OUT, _ON, _OFF, _FOLLOWER, _ARMED = range(0, 11 * LANES, LANES)
_REST, _END, _NEW, _AROUND, _TOTAL = range(11 * LANES, 16 * LANES, LANES)
_ALONG, _ACROSS, _ROW_PART, _NODE_PART = range(16 * LANES, 20 * LANES, LANES)
_M_U, _M_REST, _M_END, _M_REFERENCE, _M_READY, _M_LAST_OUT = range(20 * LANES, 26 * LANES, LANES)
_M_ON, _M_OFF, _M_AGE, _M_SHIFT, _M_FATE, _M_SPARE = range(26 * LANES, 32 * LANES, LANES)
_M_LATER, _M_LEVEL, _M_REQUEST, _ROOM = range(32 * LANES, 36 * LANES, LANES)


class Batch(NamedTuple):
    """Pixels that pass through time together, at most `LANES`.

    Attributes:
        f: Rows of numbers, float64 (_ROOM,).
        key: Of each one's random numbers, uint64 (LANES,).
        draw: Number of its draw, int64 (LANES,).
        code: That of its OFF events, int64 (LANES,).
        kind: Room, int64 (LANES,).
        which: Lanes of those that may fire, int64 (LANES,).
        again: Lanes of those that see again, int64 (LANES,).
    """

    f: Array
    key: Array
    draw: Array
    code: Array
    kind: Array
    which: Array
    again: Array


class PixelModel(NamedTuple):
    """What pixels have in common.

    Attributes:
        seed: Of their random numbers.
        sensor: As of `sensor_vector`.
        quantiles: Of the normal distribution.
        shifts: Of the factor by which noise moves both thresholds.
    """

    seed: Any
    sensor: Array
    quantiles: Array
    shifts: Array


class Requests(NamedTuple):
    """The events that pixels ask for.

    Attributes:
        t_us: When, float64 (n,).
        code: Of pixel and polarity, int32 (n,).
        made: How many there are, int64 (1,).
    """

    t_us: Array
    code: Array
    made: Array


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


@njit
def _follow(
    y_from: float, y_to: float, z: float, length: float, low: float, high: float, tau: float
) -> tuple[float, float]:
    """Let a low-pass filter follow a ramp of `length` us until its output is at one of two levels.

    Returns:
        After how long, to a millionth of the ramp, and its output.
    """
    slope = (y_to - y_from) / length
    end = y_from + slope * (length - tau) + (z - y_from + slope * tau) * math.exp(-length / tau)
    if low < end < high:
        return length, end
    level = high if end >= high else low
    before, after = 0.0, length
    for _ in range(20):
        guess = 0.5 * (before + after)
        there = y_from + slope * (guess - tau) + (z - y_from + slope * tau) * math.exp(-guess / tau)
        if (there >= level) == (z < level):
            after = guess
        else:
            before = guess
    return after, level


@njit
def _run_filtered(i: int, t_us: float, until: float, batch: Batch, model: PixelModel, out: Requests) -> None:
    """Let a pixel see its light, as in `_run_piece`, with a low-pass filter between receptor and comparator.

    The receptor is exact; between its values, as near to one another as they must be for a ramp to hit the
    middle between them to 0.002, the filter is solved for ramps. Its reference and its output are log
    signals.
    """
    f, sensor, tau = batch.f, model.sensor, model.sensor[12]
    light, u_base = f[_NOW + i], f[_U + i]
    threshold_on, threshold_off = -math.log(f[_ON + i]), math.log(f[_OFF + i])
    rest, settled, rate = 1.0 / light, math.log(light), light / sensor[0]
    t, y, z, length = t_us, -math.log(u_base), f[_FOLLOWER + i], 0.25 * tau
    # Of a word of random bits a draw, the upper half decides on the noise, the lower on whether the event
    # goes missing.
    drawn, word, noise = np.int64(-1), np.uint64(0), 0.0
    while True:
        if batch.draw[i] != drawn:
            drawn = batch.draw[i]
            word = mix(batch.key[i] + np.uint64(drawn) * np.uint64(DRAW_STEP))
            noise = math.log(_table_at(model.shifts, float(word >> np.uint64(32)) * 2.3283064365386963e-10))
        high = f[_REFERENCE + i] + threshold_on - noise
        low = f[_REFERENCE + i] - threshold_off - noise
        if f[_ARMED + i] > 0.0 and (z >= high or z <= low):
            on = z >= high
            noisy = sensor[4] * hash_normal(batch.key[i], 0, drawn, 2, model.quantiles)
            late = max(sensor[3 - int(on)] + noisy, 0.0)
            request = max(t + late, f[_LAST_OUT + i] + sensor[1])
            f[_ARMED + i], f[_READY + i], f[_LAST_OUT + i] = 0.0, t + sensor[1], request
            if float(word & np.uint64(0xFFFFFFFF)) * 2.3283064365386963e-10 >= sensor[6 - int(on)]:
                out.t_us[out.made[0]], out.code[out.made[0]] = request, batch.code[i] + int(on)
                out.made[0] += 1
        elif f[_ARMED + i] == 0.0 and t >= f[_READY + i]:
            f[_REFERENCE + i], f[_ARMED + i] = z, 1.0
            batch.draw[i] += 1
            continue
        if t >= until:
            break
        armed = f[_ARMED + i] > 0.0
        limit = until if armed else min(until, f[_READY + i])
        if abs(y - settled) < 1e-5 and abs(z - settled) < 1e-5:
            t = limit
            continue
        whole = min(length, limit - t)
        last = whole == limit - t
        middle = -math.log(rest + (u_base - rest) * math.exp(-rate * (t + 0.5 * whole - t_us)))
        end = -math.log(rest + (u_base - rest) * math.exp(-rate * (t + whole - t_us)))
        if abs(middle - 0.5 * (y + end)) > 2e-3 and whole > 1e-3:
            length = 0.5 * whole
            continue
        length = min(2.0 * whole, tau)
        half = 0.5 * whole
        then = limit if last else t + whole
        if not armed:
            low, high = -math.inf, math.inf
        for k in range(2):
            y_to = middle if k == 0 else end
            part, z_to = _follow(y, y_to, z, half, low, high, tau)
            if part < half:
                then = t + (k * half + part)
                y, z = -math.log(rest + (u_base - rest) * math.exp(-rate * (then - t_us))), z_to
                break
            y, z = y_to, z_to
        t = then
    f[_U + i] = rest + (u_base - rest) * math.exp(-rate * (until - t_us))
    f[_FOLLOWER + i] = z


@njit(inline="always")
def _see_again(blind: int, m: int, t_us: float, batch: Batch, sensor: Array) -> int:
    """Take the light that `blind` lanes of `again` see as their reference; add those that may fire to `m` of
    `which`; how many these are then.
    """
    f, kind, which, again, draw = batch.f, batch.kind, batch.which, batch.again, batch.draw
    per_charge, widest = 1.0 / sensor[0], sensor[8]
    # Those that see again in this piece, and of them those that may fire.
    even = (blind + _EVEN - 1) // _EVEN * _EVEN
    for a in range(even):
        i = again[min(a, blind - 1)]
        f[_M_U + a], f[_M_REST + a] = f[np.uint64(_U + i)], f[np.uint64(_REST + i)]
        f[_M_END + a], f[_M_READY + a] = f[np.uint64(_END + i)], f[np.uint64(_READY + i)]
        f[_M_ON + a], f[_M_OFF + a] = f[np.uint64(_ON + i)], f[np.uint64(_OFF + i)]
        f[_M_AGE + a] = f[np.uint64(_NOW + i)]
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
    return m


@njit(inline="always")
def _draw_fates(m: int, batch: Batch, shifts: Array) -> int:
    """Draw the noise of `m` lanes of `which`; those that fire by it move to the front; how many there are.

    Of a word of random bits a draw, the upper half decides on the noise, the lower on whether the event goes
    missing.
    """
    f, kind, which, draw, key = batch.f, batch.kind, batch.which, batch.draw, batch.key
    bits = f.view(np.int64)
    even = (m + _EVEN - 1) // _EVEN * _EVEN
    for a in range(even):
        k = np.uint64(which[min(a, m - 1)])
        word = mix(key[k] + np.uint64(draw[k]) * np.uint64(DRAW_STEP))
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
    for a in range(even):
        i = which[min(a, m - 1)]
        f[_M_REFERENCE + a], f[_M_END + a] = f[np.uint64(_REFERENCE + i)], f[np.uint64(_END + i)]
        f[_M_ON + a], f[_M_OFF + a] = f[np.uint64(_ON + i)], f[np.uint64(_OFF + i)]
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
    return fires


@njit(inline="always")
def _fire_together(
    fires: int, t_us: float, until: float, batch: Batch, model: PixelModel, out: Requests
) -> int:
    """Let lanes of `which` fire, together; those that see again in the piece are `again`: how many."""
    f, kind, which, again, draw, key = batch.f, batch.kind, batch.which, batch.again, batch.draw, batch.key
    code, sensor = batch.code, model.sensor
    charge, refractory, delay_on, delay_off, jitter = sensor[0], sensor[1], sensor[2], sensor[3], sensor[4]
    miss_on, miss_off = sensor[5], sensor[6]
    out_t, out_code, n = out.t_us, out.code, out.made[0]
    even = (fires + _EVEN - 1) // _EVEN * _EVEN
    for a in range(even):
        i = which[min(a, fires - 1)]
        f[_M_U + a], f[_M_REST + a] = f[np.uint64(_U + i)], f[np.uint64(_REST + i)]
        f[_M_READY + a], f[_M_LAST_OUT + a] = f[np.uint64(_READY + i)], f[np.uint64(_LAST_OUT + i)]
    if jitter > 0.0:
        for a in range(fires):
            k = np.uint64(which[a])
            f[_M_LATER + a] = jitter * hash_normal(key[k], 0, draw[k], 2, model.quantiles)
    for a in range(even):
        u, rest, level = f[_M_U + a], f[_M_REST + a], f[_M_LEVEL + a]
        ready, on = f[_M_READY + a], f[_M_ON + a] > 0.0
        # Where it is beyond the threshold from the first, there is no way to it.
        beyond = (u <= level) if on else (u >= level)
        tau = 0.0 if beyond else charge * rest
        # The way's natural logarithm, any value where it is not positive, without a branch or a call, as
        # `_decay`: the exponent as the lowest bits of 2^52, and a series of the mantissa.
        way = np.float64((u - rest) / (level - rest)).view(np.int64)
        raised = np.int64((way >> 52) & 0x7FF | 0x4330000000000000).view(np.float64)
        mantissa = np.int64(way & 0xFFFFFFFFFFFFF | 0x3FF0000000000000).view(np.float64)
        power = raised - (4503599627370496.0 + 1023.0)
        above = mantissa > 1.4142135623730951
        mantissa = 0.5 * mantissa if above else mantissa
        power = power + 1.0 if above else power
        s = (mantissa - 1.0) / (mantissa + 1.0)
        z = s * s
        p = 2.0 / 15.0
        p = p * z + 2.0 / 13.0
        p = p * z + 2.0 / 11.0
        p = p * z + 2.0 / 9.0
        p = p * z + 2.0 / 7.0
        p = p * z + 2.0 / 5.0
        p = p * z + 2.0 / 3.0
        p = p * z + 2.0
        log = power * 0.693147180369123816490 + (power * 1.90821492927058770002e-10 + p * s)
        t = min(max(t_us + log * tau, max(ready, t_us)), until)
        late = max((delay_on if on else delay_off) + f[_M_LATER + a], 0.0)
        ready = t + refractory
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
        n += (what >> 1) & 1
        again[np.uint64(blind)] = i
        blind += what >> 2
    out.made[0] = n
    return blind


@njit(fastmath={"contract"})
def _run_piece(lanes: int, t_us: float, until: float, batch: Batch, model: PixelModel, out: Requests) -> None:
    """Let pixels see their light from `t_us` to `until`, and fire.

    With u = exp(-y) the receptor is u(t) = 1/I + (u0 - 1/I) exp(-I t / Q), which is monotonic; so a threshold
    is crossed in a piece when u at its end lies beyond, and the time follows from one logarithm. A pixel is
    blind as long as `_READY` is not past. Those that see again are picked, those that may fire for the noise
    that is the most, and of them those that do; their next events are computed together, until there are
    none.
    """
    f, kind, sensor = batch.f, batch.kind, model.sensor
    if sensor[12] > 0.0:
        for i in range(lanes):
            _run_filtered(i, t_us, until, batch, model, out)
        return
    per_charge, widest, span = 1.0 / sensor[0], sensor[8], until - t_us
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
        batch.which[np.uint64(m)] = i
        m += kind[i] & 1
    for i in range(lanes):
        batch.again[np.uint64(blind)] = i
        blind += kind[i] >> 1
    while m + blind > 0:
        m = _see_again(blind, m, t_us, batch, sensor)
        fires = _draw_fates(m, batch, model.shifts) if m else 0
        m, blind = 0, 0
        if fires:
            blind = _fire_together(fires, t_us, until, batch, model, out)
    for i in range(lanes):
        f[_U + i] = f[_END + i]


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


class TimeLine(NamedTuple):
    """When something changes in a block, in order; the light on a pixel is constant in between.

    Attributes:
        t_us: When, the first where the block begins, float64 (entries,).
        kind: What: the image moves (-2), the share of all light that passes or the background changes (-1),
            or the source of this number switches.
        pose: The image's pose from then on.
        shade: Share of all light that passes from then on.
        step: How many times the background has changed until then.
        row: Row of the levels that each source shows from then on, (sources, entries).
    """

    t_us: Array
    kind: Array
    pose: Array
    shade: Array
    step: Array
    row: Array


class Strips(NamedTuple):
    """Where the strips of the sources are, and how they shine.

    Attributes:
        levels: Light of each cluster as a share of full light, (rows, clusters).
        origin: A strip's first end, px, (2, sources, poses).
        axis: The unit vector along it, (2, sources, poses).
        bounds: Where its clusters start and end along it, px, (sources, clusters + 1, poses).
        width_px: Its width, (sources, poses).
        clusters: How many it has, (sources,).
        gain: Its full light, W/m2, (sources,).
    """

    levels: Array
    origin: Array
    axis: Array
    bounds: Array
    width_px: Array
    clusters: Array
    gain: Array


class Halos(NamedTuple):
    """Light that the lens spreads far, in several widths.

    Attributes:
        light: That of a row of levels on a grid along the strip, as a share of full light, (halos, rows, n).
        first: Where the grid begins, px, (halos,).
        per_px: Its nodes in a px, (halos,).
        share: Of the light that is in each halo, (halos,).
        every: After how many poses it follows the strip; 0: it stands where that is in the middle, (halos,).
        table: Share of a pixel lit around each one's blurred edge, (halos, m).
        table_per_px: Nodes of that in a px, (halos,).
    """

    light: Array
    first: Array
    per_px: Array
    share: Array
    every: Array
    table: Array
    table_per_px: Array


class Near(NamedTuple):
    """The rest of the image of a point.

    Attributes:
        share: Of the light that is in it.
        tables: Of each source, as of `strip_table`.
        scale: Of these, px, (sources,).
        reach: How far they are followed, px, (sources,).
    """

    share: float
    tables: Array
    scale: Array
    reach: Array


class Scenery(NamedTuple):
    """What shines beside the sources.

    Attributes:
        turn_px: How far the texture has moved, (poses, 2).
        every: After how many poses it is looked up.
        field: The texture, periodic, its size a power of two.
        light: Dark current as light, and irradiance on the sensor after each number of changes, W/m2.
    """

    turn_px: Array
    every: int
    field: Array
    light: Array


class _Shining(NamedTuple):
    """Room for what is known of each source that shines on a batch: one row a source.

    Attributes:
        clusters: The first within reach, the one after the last, and the row of levels, int64 (sources, 3).
        weight: Light of these on each pixel, W/m2, cluster by cluster, (sources, LANES * clusters).
        part: Light of the source on each pixel, W/m2, (sources, LANES).
        halo: Of each halo: its light on each pixel, that if all shone, and the part of a node beyond `node`.
        node: Its node on the grid.
        nodes: Room of `_take_clusters`, int32 (2, LANES).
        beside: Likewise, (LANES * (clusters + 1),).
    """

    clusters: Array
    weight: Array
    part: Array
    halo: Array
    node: Array
    nodes: Array
    beside: Array


@njit(fastmath={"contract"})
def _take_clusters(
    a: int, g: int, pose: int, size: tuple[int, int], f: Array, strips: Strips, near: Near, room: _Shining
) -> None:
    """Find which of a source's clusters light some of `size` (lanes, pixels), and how much each does: weight
    of row `a`.
    """
    lanes, count = size
    x, y = strips.origin[0, g, pose], strips.origin[1, g, pose]
    axis_x, axis_y = strips.axis[0, g, pose], strips.axis[1, g, pose]
    for i in range(lanes):
        dx, dy = f[_X + i] - x, f[_Y + i] - y
        f[_ALONG + i], f[_ACROSS + i] = dx * axis_x + dy * axis_y, dx * axis_y - dy * axis_x
    nearest = furthest = f[_ALONG]
    beyond, reach, strip_px = False, near.reach[g], strips.width_px[g, pose]
    for i in range(count):
        nearest, furthest = min(nearest, f[_ALONG + i]), max(furthest, f[_ALONG + i])
        beyond |= abs(f[_ACROSS + i]) < reach + 0.5 * strip_px
    bounds, b = strips.bounds[g], 0
    while b < strips.clusters[g] and bounds[b + 1, pose] <= nearest - reach:
        b += 1
    m = b
    while beyond and m < strips.clusters[g] and bounds[m, pose] < furthest + reach:
        m += 1
    room.clusters[a, 0], room.clusters[a, 1] = b, m
    if m == b:
        return
    table, scale = near.tables[g], near.scale[g]
    edges, gain = bounds[b : m + 1, pose], strips.gain[g] * near.share
    rows, nodes, beside, weight = room.nodes[0], room.nodes[1], room.beside, room.weight[a]
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
    for c in range(edges.size):
        # Apart, the first loop is one of vector instructions.
        edge = edges[c]
        for i in range(lanes):
            z = f[_ALONG + i] - edge
            at = half + half * z / (abs(z) + scale)
            node = min(np.int32(at), np.int32(columns - 2))
            f[_NODE_PART + i] = at - node
            nodes[i] = rows[i] + node
        first = np.uint64(c * LANES)
        for i in range(lanes):
            k = np.uint64(nodes[i])
            low = flat[k] + f[_NODE_PART + i] * (flat[k + one] - flat[k])
            k += below
            high = flat[k] + f[_NODE_PART + i] * (flat[k + one] - flat[k])
            beside[first + np.uint64(i)] = low + f[_ROW_PART + i] * (high - low)
    for c in range(edges.size - 1):
        first, behind = np.uint64(c * LANES), np.uint64((c + 1) * LANES)
        for i in range(lanes):
            seen = (
                (f[_ALONG + i] > edges[c] - reach)
                & (f[_ALONG + i] < edges[c + 1] + reach)
                & (abs(f[_ACROSS + i]) < reach + 0.5 * strip_px)
            )
            share = beside[first + np.uint64(i)] - beside[behind + np.uint64(i)]
            weight[first + np.uint64(i)] = gain * share if seen else 0.0


@njit(fastmath={"contract"})
def _shine(
    a: int,
    g: int,
    poses: tuple[int, int, int],
    size: tuple[int, int],
    f: Array,
    scene: tuple[Strips, Halos],
    near: Near,
    room: _Shining,
) -> None:
    """Have the light of source g, which shows a row of levels, on each pixel: part of row `a`.

    `poses` are the one before, -1 for none, that of now, and the one that shows where the sources are; the
    row is -1 - row where it has just been switched.
    """
    strips, halos = scene
    before, pose, here = poses
    lanes, _ = size
    row = room.clusters[a, 2]
    switched = row < 0
    row = -1 - row if switched else row
    room.clusters[a, 2] = row
    stale = switched
    for h in range(halos.share.size):
        every = halos.every[h]
        follows = before < 0 or (every > 0 and pose // every != before // every)
        if follows:
            at = strips.axis.shape[2] // 2 if every == 0 else here
            x, y = strips.origin[0, g, at], strips.origin[1, g, at]
            axis_x, axis_y = strips.axis[0, g, at], strips.axis[1, g, at]
            half, table, per_px = 0.5 * strips.width_px[g, at], halos.table[h], halos.table_per_px[h]
            for i in range(lanes):
                dx, dy = f[_X + i] - x, f[_Y + i] - y
                across_px = dx * axis_y - dy * axis_x
                across = _step(table, per_px, across_px + half) - _step(table, per_px, across_px - half)
                room.halo[a, h, 1, i] = strips.gain[g] * halos.share[h] * across
                node = (dx * axis_x + dy * axis_y - halos.first[h]) * halos.per_px[h]
                node = min(max(node, 0.0), halos.light.shape[2] - 1.001)
                room.node[a, h, i] = int(node)
                room.halo[a, h, 2, i] = node - int(node)
        if follows or switched:
            stale = True
            light = halos.light[h, row]
            for i in range(lanes):
                k = np.uint64(room.node[a, h, i])
                left, right = light[k], light[k + np.uint64(1)]
                between = room.halo[a, h, 2, i]
                room.halo[a, h, 0, i] = room.halo[a, h, 1, i] * (left + between * (right - left))
    if pose != before:
        _take_clusters(a, g, here, size, f, strips, near, room)
        stale = True
    if not stale:
        return
    part, weight = room.part[a], room.weight[a]
    for i in range(lanes):
        part[i] = 0.0
    first = room.clusters[a, 0]
    for b in range(first, room.clusters[a, 1]):
        level = strips.levels[row, b]
        if level != 0.0:
            of = np.uint64((b - first) * LANES)
            for i in range(lanes):
                part[i] += weight[of + np.uint64(i)] * level
    for h in range(halos.share.size):
        for i in range(lanes):
            part[i] += room.halo[a, h, 0, i]


@njit(fastmath={"contract"})
def _run_batch(
    size: tuple[int, int],
    of_batch: tuple[Any, int],
    end_us: float,
    world: tuple[TimeLine, Strips, Halos, Near, Scenery],
    room: tuple[_Shining, Array, Array],
    batch: Batch,
    model: PixelModel,
    out: Requests,
) -> None:
    """Run a batch of `size` (lanes, pixels) through a block; `of_batch` are its mask and its stride."""
    line, strips, halos, near, scenery = world
    shining, lit, mine = room
    lanes, _ = size
    mask, stride = of_batch
    f, poses, many = batch.f, scenery.turn_px.shape[0], 0
    field, last = scenery.field, scenery.field.shape[0] - 1
    for g in range(strips.gain.size):
        lit[many], shining.clusters[many, 2] = g, -1
        many += int((mask >> np.uint64(g)) & np.uint64(1))
    # The entries that it sees: of its sources, and every so many poses.
    own, pose, looked, dark = 0, -1, -1, scenery.light[0]
    for e in range(line.t_us.size):
        what = line.kind[e]
        is_own = (mask >> np.uint64(max(what, 0))) & np.uint64(what >= 0)
        mine[own] = e
        own += int(is_own) | (what == -1) | ((what == -2) & (line.pose[e] % stride == 0))
    for q in range(own):
        e = mine[q]
        t_us, until = line.t_us[e], line.t_us[mine[q + 1]] if q + 1 < own else end_us
        before, pose = pose, line.pose[e] // stride * stride
        # Where the sources are in the middle of these poses.
        here = min(pose + stride // 2, poses - 1)
        around = line.step[e] * poses + pose // scenery.every
        if around != looked:
            looked = around
            # The light of the background and the dark current: bilinear in the periodic texture.
            for i in range(lanes):
                u, v = f[_X + i] + scenery.turn_px[pose, 0], f[_Y + i] + scenery.turn_px[pose, 1]
                below, right = math.floor(v), math.floor(u)
                down, aside = v - below, u - right
                i0, j0 = int(below) & last, int(right) & last
                i1, j1 = (i0 + 1) & last, (j0 + 1) & last
                top = field[i0, j0] + aside * (field[i0, j1] - field[i0, j0])
                low = field[i1, j0] + aside * (field[i1, j1] - field[i1, j0])
                f[_AROUND + i] = dark + scenery.light[1 + line.step[e]] * (top + down * (low - top))
        for i in range(lanes):
            f[_TOTAL + i] = f[_AROUND + i]
        for a in range(many):
            row = line.row[lit[a], e]
            if row != shining.clusters[a, 2]:
                shining.clusters[a, 2] = -1 - row
            _shine(a, lit[a], (before, pose, here), size, f, (strips, halos), near, shining)
            for i in range(lanes):
                f[_TOTAL + i] += shining.part[a, i]
        shade = line.shade[e]
        if shade != 1.0:
            for i in range(lanes):
                f[_TOTAL + i] = dark + shade * (f[_TOTAL + i] - dark)
        if q == 0:
            # Pixels that were not active before are at rest in their light, and armed.
            for i in range(size[1]):
                if f[_NEW + i] > 0.0:
                    now = f[_TOTAL + i]
                    f[_NOW + i], f[_U + i], f[_FOLLOWER + i] = now, 1.0 / now, math.log(now)
                    f[_READY + i], f[_ARMED + i] = -1e18, 1.0
                    f[_REFERENCE + i] = f[_FOLLOWER + i] if model.sensor[12] > 0.0 else f[_U + i]
                    batch.draw[i] += 1
        redraw = int(line.kind[e] >= 0)
        for i in range(lanes):
            total, now = f[_TOTAL + i], f[_NOW + i]
            changes = abs(total - now) > LIGHT_STEP * now
            f[_NOW + i] = total if changes else now
            batch.draw[i] += redraw * changes
        if until > t_us:
            _run_piece(lanes, t_us, until, batch, model, out)


class ActivePixels(NamedTuple):
    """A block of time, and the pixels that are active in it.

    Attributes:
        number: Its number.
        end_us: When it ends.
        pixels: Their numbers, batch by batch.
        batches: Where in `pixels` each batch begins, and the last ends; `LANES` at the most.
        masks: Bit i says that source i lights a batch.
        strides: A batch sees where the sources are anew in every so many poses only.
        at_px: Column and row at which each pixel's light would be without what bends it, (2, pixels).
    """

    number: int
    end_us: float
    pixels: Array
    batches: Array
    masks: Array
    strides: Array
    at_px: Array


@njit
def run_pixels(
    first: int,
    last: int,
    block: ActivePixels,
    store: tuple[Array, Array, int],
    world: tuple[TimeLine, Strips, Halos, Near, Scenery],
    model: PixelModel,
    most_events: int,
    out: Requests,
) -> int:
    """Run batches [first, last) of pixels through a block of time; return the next batch.

    It ends early, at a batch for which the output might have no room: `most_events` of each pixel. `store`
    are the states and counters of all pixels, and the columns of the image.
    """
    line, strips, halos, _, _ = world
    sources, many, most = strips.gain.size, halos.share.size, strips.levels.shape[1]
    states, counters, width = store
    rows = np.zeros((5, LANES), np.int64)
    batch = Batch(np.zeros(_ROOM), np.zeros(LANES, np.uint64), rows[0], rows[1], rows[2], rows[3], rows[4])
    f, sensor, quantiles = batch.f, model.sensor, model.quantiles
    shining = _Shining(
        np.empty((sources, 3), np.int64),
        np.empty((sources, LANES * most)),
        np.empty((sources, LANES)),
        np.empty((sources, many, 3, LANES)),
        np.empty((sources, many, LANES), np.int64),
        np.empty((2, LANES), np.int32),
        np.empty(LANES * (most + 1)),
    )
    room = shining, np.empty(sources, np.int64), np.empty(line.t_us.size + 1, np.int64)
    for j in range(first, last):
        if out.made[0] + LANES * most_events > out.t_us.size:
            return j
        begin = block.batches[j]
        pixels = block.pixels[begin : block.batches[j + 1]]
        for i, pixel in enumerate(pixels):
            s, c = states[pixel], counters[pixel]
            batch.code[i] = ((pixel // width) << COLUMN_BITS | (pixel % width)) << 1
            batch.key[i], batch.draw[i] = mix(model.seed + np.uint64(pixel) * np.uint64(PIXEL_STEP)), c[DRAW]
            f[_X + i], f[_Y + i] = block.at_px[0, begin + i], block.at_px[1, begin + i]
            f[_ON + i], f[_OFF + i], f[_LAST_OUT + i] = s[ON_FACTOR], s[OFF_FACTOR], s[T_LAST_OUT]
            f[_U + i], f[_REFERENCE + i], f[_READY + i] = s[U_BASE], s[REFERENCE], s[T_READY]
            f[_NOW + i], f[_FOLLOWER + i], f[_ARMED + i] = s[LIGHT], s[FOLLOWER], float(c[ARMED])
            # Those that were not active in the block before are new.
            f[_NEW + i] = 1.0 if c[BLOCK] != block.number + 1 else 0.0
            if s[ON_FACTOR] == 0.0:
                on = sensor[9] * (1.0 + sensor[11] * hash_normal(model.seed, pixel, 0, 3, quantiles))
                off = sensor[10] * (1.0 + sensor[11] * hash_normal(model.seed, pixel, 0, 4, quantiles))
                f[_ON + i], f[_OFF + i], f[_LAST_OUT + i] = math.exp(-on), math.exp(off), -1e18
        # Lanes behind them, to a multiple of `_EVEN`, hold pixels that never fire.
        lanes = (pixels.size + _EVEN - 1) // _EVEN * _EVEN
        for i in range(pixels.size, lanes):
            f[_X + i] = f[_Y + i] = f[_NEW + i] = f[_ARMED + i] = f[_FOLLOWER + i] = 0.0
            f[_NOW + i] = f[_U + i] = f[_REFERENCE + i] = 1.0
            f[_READY + i], f[_LAST_OUT + i], f[_ON + i], f[_OFF + i] = 1e300, -1e18, 1e-300, 1e300
            batch.key[i], batch.draw[i], batch.code[i] = np.uint64(0), 0, 0
        of_batch = block.masks[j], block.strides[j]
        _run_batch((lanes, pixels.size), of_batch, block.end_us, world, room, batch, model, out)
        for i, pixel in enumerate(pixels):
            s, c = states[pixel], counters[pixel]
            s[ON_FACTOR], s[OFF_FACTOR] = f[_ON + i], f[_OFF + i]
            s[U_BASE], s[REFERENCE] = f[_U + i], f[_REFERENCE + i]
            s[T_READY], s[T_LAST_OUT] = f[_READY + i], f[_LAST_OUT + i]
            s[LIGHT], s[FOLLOWER] = f[_NOW + i], f[_FOLLOWER + i]
            c[DRAW], c[ARMED], c[BLOCK] = batch.draw[i], int(f[_ARMED + i]), block.number + 2
    return last


@njit(inline="always")
def _parts_of(word: int) -> tuple[float, Any, Any]:
    """A request's ticks since its block began, its row and its column."""
    # An index without a sign is not looked at for being negative.
    row, column = word >> (COLUMN_BITS + 1), word >> 1
    most = (1 << COLUMN_BITS) - 1
    return np.float64(word >> CODE_BITS), np.uint64(row & most), np.uint64(column & most)


@njit
def drop_blind(words: Array, begin_us: float, blind_us: Array, width: int, refractory_us: float) -> int:
    """Drop, in place, requests of pixels that are blind until `blind_us`; return how many stay."""
    kept = 0
    for i in range(words.size):
        word = words[i]
        ticks, row, column = _parts_of(word)
        pixel, t = row * np.uint64(width) + column, begin_us + ticks * (1.0 / TICKS)
        # What is dropped is written over.
        words[np.uint64(kept)] = word
        if t >= blind_us[pixel]:
            # The smallest part of a us stands for the rounding of both times to ticks.
            blind_us[pixel] = t + (refractory_us - 1e-6)
            kept += 1
    return kept


@njit
def _take_row(waits: Array, row: int) -> int:
    """The next row whose bit of `waits` is set, from `row` on and then from 0; it is cleared."""
    place = row >> 6
    bits = waits[place] >> np.uint64(row & 63) << np.uint64(row & 63)
    while bits == np.uint64(0):
        place = place + 1 if place + 1 < waits.size else 0
        bits = waits[place]
    lowest = bits & (~bits + np.uint64(1))
    waits[place] ^= lowest
    return place << 6 | int(_PLACES[(lowest * np.uint64(0x03F79D71B4CB0A89)) >> np.uint64(58)])


@njit
def _keep_waiting(words: Array, follow: Array, seen: int, pending: Array) -> int:
    """Move the words that are not served, or not seen yet, to the front; how many these are."""
    left = 0
    for m in range(words.size):
        if m >= seen or follow[m] != _SERVED:
            if pending.size > 0:
                _, y, x = _parts_of(words[m])
                pending[y, x] = False
            words[left] = words[m]
            left += 1
    return left


@njit
def read_out(
    words: Array,
    times_us: tuple[float, float, float],
    height: int,
    limit: tuple[int, int],
    memory: Array,
    pending: Array,
    out: tuple[Array, Array, Array, Array],
) -> tuple[int, int, int, int]:
    """Serve requests row by row; what is not served yet moves to the front of `words`.

    `times_us` are (when the words' times begin, what a row takes, until when). One row is served at a time,
    which takes all its requests along; the next is the next one below with a request, and after the last row
    the first. Of `limit` (events, window in us), more events in a window are dropped; 0 for none. `words` are
    sorted; `memory` holds (time when free, last row, number of the window, events in it) and is updated.
    Where `pending`, bool (rows, columns), all False, has any room, a pixel sends nothing while a request of
    its waits.

    Returns:
        (events written, events over the cap, requests of waiting pixels, requests left).
    """
    begin_us, row_us, safe_us = times_us
    cap, cap_window_us = limit
    out_t, out_x, out_y, out_p = out
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
    due = begin_us + _parts_of(words[0])[0] * (1.0 / TICKS) if size else math.inf
    while True:
        if waiting == 0:
            if i >= size:
                break
            free = max(free, due)
        if free >= safe_us:
            break
        while due <= free:
            k = np.uint64(i)
            _, y, x = _parts_of(words[k])
            if hold and pending[y, x]:
                follow[k] = _SERVED
                held += 1
            else:
                if hold:
                    pending[y, x] = True
                follow[np.uint64(tail[y])] = i
                follow[k] = -1
                tail[y] = i
                waits[y >> np.uint64(6)] |= np.uint64(1) << (y & np.uint64(63))
                waiting += 1
            i += 1
            due = begin_us + _parts_of(words[np.uint64(i)])[0] * (1.0 / TICKS) if i < size else math.inf
        if waiting == 0:
            continue
        at_row = _take_row(waits, at_row + 1)
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
            _, _, x = _parts_of(what)
            waiting -= 1
            if hold:
                pending[y, x] = False
            if cap > 0 and used >= cap:
                dropped += 1
                continue
            used += 1
            # By column, then in the order in which they came; without a branch, which could not be foreseen.
            it = np.int64(x) << 32 | (n - begin) << 1 | what & 1
            for j in range(begin, n):
                other = together[np.uint64(j)]
                together[np.uint64(j)] = min(other, it)
                it = max(other, it)
            last = np.uint64(n)
            together[last], out_t[last], out_y[last] = it, stamp, at_row
            n += 1
    for j in range(n):
        out_x[j], out_p[j] = together[j] >> 32, together[j] & 1
    left = _keep_waiting(words, follow, i, pending)
    memory[0], memory[1], memory[2], memory[3] = free, at_row, window, used
    return n, dropped, held, left
