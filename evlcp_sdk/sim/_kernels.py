"""Compiled pixels and readout.

Every random number is a hash of (seed, pixel, number of the draw, purpose). Kernels that run pixels may round
the sum of a product once instead of twice (`contract`), which takes half as many instructions.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.kernels import njit

Array = NDArray[Any]

ON_FACTOR, OFF_FACTOR, U_BASE, REFERENCE, T_READY, T_LAST_OUT, LIGHT, FOLLOWER = range(8)
"""Columns of a pixel's state: its thresholds as factors, the receptor, the comparator, the light on it, and
the log signal after the source follower, if that has a time constant."""

DRAW, ARMED, BLOCK = range(3)
"""Columns of a pixel's counters; BLOCK is 2 more than its last active block, or 0."""

LIGHT_STEP = 1e-3
"""Relative change below which the light on a pixel stays as it is."""

COLUMN_BITS = 13
"""The code of a request is (row << COLUMN_BITS | column) << 1 | polarity."""

CODE_BITS = 2 * COLUMN_BITS + 1
"""A request is a sortable word: its ticks since the start of a block << CODE_BITS | its code."""

TICKS = float(1 << 20)
"""Ticks of 1 ps per us, so that a word holds times of up to 65 ms before and after."""

_SERVED = -2
"""Follower of a request that no longer waits."""

_BIT_INDEX = np.empty(64, np.int64)
"""Index of the only bit of a word, by the upper bits of its product with a de Bruijn sequence."""
_BIT_INDEX[[(0x03F79D71B4CB0A89 << k & (1 << 64) - 1) >> 58 for k in range(64)]] = np.arange(64)

_ROUNDING = 6755399441055744.0
"""Added to a float64, it puts the nearest integer into the lowest bits."""

NOISE_LIMIT = 4.0
"""Cut-off of all normal distributions, standard deviations."""

PIXEL_STEP, DRAW_STEP = 0x9E3779B97F4A7C15, 0xD1B54A32D192ED03
"""Steps between the keys of pixels, and between the draws of a pixel, before they are mixed."""


@njit(inline="always")
def mix_bits(z: Any) -> Any:
    """Mix a 64-bit word by the finalizer of splitmix64, a bijection."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(inline="always")
def _interpolate(table: Array, share: float) -> float:
    """Interpolate linearly in a table of quantiles, at a `share` in [0, 1)."""
    z = share * (table.size - 1)
    i = int(z)
    # An unsigned index needs no test for negative ones.
    k = np.uint64(i)
    return float(table[k] + (z - i) * (table[k + np.uint64(1)] - table[k]))


@njit
def hash_normal(seed: Any, pixel: int, draw: Any, purpose: int, quantiles: Array) -> float:
    """Return the normal number of a (seed, pixel, draw, purpose), cut off at `NOISE_LIMIT`."""
    key = mix_bits(seed + np.uint64(pixel) * np.uint64(PIXEL_STEP))
    z = mix_bits(key + np.uint64(draw) * np.uint64(DRAW_STEP) + np.uint64(purpose))
    return float(_interpolate(quantiles, float(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)))


LANES = 192
"""Most pixels that are run together, in loops of vector instructions."""

_VECTOR = 4
"""Numbers in a vector; lanes are filled up to a multiple of it, so that no loop has a rest."""

# Rows of LANES numbers in the room of a batch. Constant places in one array let the compiler see that rows do
# not overlap. Rows of every pixel, and with _M_ of those that may fire in a piece of time:
_X, _Y, _NOW, _U, _REFERENCE, _READY, _LAST_OUT, _ON, _OFF, _FOLLOWER, _ARMED = range(0, 11 * LANES, LANES)
_REST, _END, _NEW, _BACKGROUND, _TOTAL = range(11 * LANES, 16 * LANES, LANES)
_ALONG, _ACROSS, _ROW_PART, _NODE_PART = range(16 * LANES, 20 * LANES, LANES)
_M_U, _M_REST, _M_END, _M_REFERENCE, _M_READY, _M_LAST_OUT = range(20 * LANES, 26 * LANES, LANES)
_M_ON, _M_OFF, _M_AGE, _M_SHIFT, _M_MISS, _M_SPARE = range(26 * LANES, 32 * LANES, LANES)
_M_JITTER, _M_LEVEL, _M_REQUEST, _ROOM = range(32 * LANES, 36 * LANES, LANES)


class Batch(NamedTuple):
    """Pixels that are run together, at most `LANES`.

    Attributes:
        f: Rows of numbers, float64 (_ROOM,).
        key: Keys of their random numbers, uint64 (LANES,).
        draw: Numbers of their draws, int64 (LANES,).
        code: Codes of their OFF events, int64 (LANES,).
        kind: Room, int64 (LANES,).
        candidates: Lanes that may fire, int64 (LANES,).
        rearmed: Lanes that are armed again, int64 (LANES,).
    """

    f: Array
    key: Array
    draw: Array
    code: Array
    kind: Array
    candidates: Array
    rearmed: Array


class PixelModel(NamedTuple):
    """What all pixels have in common.

    Attributes:
        seed: Seed of their random numbers.
        sensor: Parameters of `pack_sensor`.
        quantiles: Quantiles of the normal distribution.
        shifts: Quantiles of the factor by which noise moves both thresholds.
    """

    seed: Any
    sensor: Array
    quantiles: Array
    shifts: Array


class Requests(NamedTuple):
    """Requests of pixels for the readout.

    Attributes:
        t_us: Times, float64 (n,).
        code: Codes of pixel and polarity, int32 (n,).
        made: Number of requests, int64 (1,).
    """

    t_us: Array
    code: Array
    made: Array


@njit(inline="always")
def _decay(age: float) -> float:
    """Return exp(-age) to 1e-14, 0 beyond 60; without a branch or a call, for vector instructions."""
    within = min(age, 700.0)
    whole = within * 1.4426950408889634 + _ROUNDING
    k = whole - _ROUNDING
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
def _follow_ramp(
    y_from: float, y_to: float, z: float, length: float, low: float, high: float, tau: float
) -> tuple[float, float]:
    """Let a low-pass filter follow a ramp of `length` us until its output reaches one of two levels.

    Returns:
        The time, to a millionth of the ramp, and the output.
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
    """Run a pixel as `_run_piece` does, with a low-pass filter between receptor and comparator.

    The receptor is exact; between its values, close enough for a ramp to meet the middle between them to
    0.002, the filter is solved for ramps. Its reference and its output are log signals.
    """
    f, sensor, tau = batch.f, model.sensor, model.sensor[12]
    light, u_base = f[_NOW + i], f[_U + i]
    threshold_on, threshold_off = -math.log(f[_ON + i]), math.log(f[_OFF + i])
    rest, settled, rate = 1.0 / light, math.log(light), light / sensor[0]
    t, y, z, length = t_us, -math.log(u_base), f[_FOLLOWER + i], 0.25 * tau
    # The upper half of a draw's random word is for the noise, the lower for missing events.
    drawn, word, noise = np.int64(-1), np.uint64(0), 0.0
    while True:
        if batch.draw[i] != drawn:
            drawn = batch.draw[i]
            word = mix_bits(batch.key[i] + np.uint64(drawn) * np.uint64(DRAW_STEP))
            noise = math.log(
                _interpolate(model.shifts, float(word >> np.uint64(32)) * 2.3283064365386963e-10)
            )
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
        piece = min(length, limit - t)
        last = piece == limit - t
        middle = -math.log(rest + (u_base - rest) * math.exp(-rate * (t + 0.5 * piece - t_us)))
        end = -math.log(rest + (u_base - rest) * math.exp(-rate * (t + piece - t_us)))
        if abs(middle - 0.5 * (y + end)) > 2e-3 and piece > 1e-3:
            length = 0.5 * piece
            continue
        length = min(2.0 * piece, tau)
        half = 0.5 * piece
        then = limit if last else t + piece
        if not armed:
            low, high = -math.inf, math.inf
        for k in range(2):
            y_to = middle if k == 0 else end
            part, z_to = _follow_ramp(y, y_to, z, half, low, high, tau)
            if part < half:
                then = t + (k * half + part)
                y, z = -math.log(rest + (u_base - rest) * math.exp(-rate * (then - t_us))), z_to
                break
            y, z = y_to, z_to
        t = then
    f[_U + i] = rest + (u_base - rest) * math.exp(-rate * (until - t_us))
    f[_FOLLOWER + i] = z


@njit(inline="always")
def _rearm_lanes(blind: int, m: int, t_us: float, batch: Batch, sensor: Array) -> int:
    """Set the reference of `blind` lanes of `rearmed`; add those that may fire to the `m` candidates.

    Returns the number of candidates.
    """
    f, kind, candidates, rearmed, draw = batch.f, batch.kind, batch.candidates, batch.rearmed, batch.draw
    per_charge, widest = 1.0 / sensor[0], sensor[8]
    even = (blind + _VECTOR - 1) // _VECTOR * _VECTOR
    for a in range(even):
        i = rearmed[min(a, blind - 1)]
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
        i = rearmed[a]
        f[np.uint64(_REFERENCE + i)] = f[_M_REFERENCE + a]
        draw[np.uint64(i)] += 1
        candidates[np.uint64(m)] = i
        m += kind[a]
    return m


@njit(inline="always")
def _draw_noise(m: int, batch: Batch, shifts: Array) -> int:
    """Draw the noise of `m` candidates; move those that fire to the front, and return their number.

    The upper half of a draw's random word is for the noise, the lower for missing events.
    """
    f, kind, candidates, draw, key = batch.f, batch.kind, batch.candidates, batch.draw, batch.key
    bits = f.view(np.int64)
    even = (m + _VECTOR - 1) // _VECTOR * _VECTOR
    for a in range(even):
        k = np.uint64(candidates[min(a, m - 1)])
        word = mix_bits(key[k] + np.uint64(draw[k]) * np.uint64(DRAW_STEP))
        bits[_M_SPARE + a] = np.int64(word)
    # Put half a word into the lowest bits of 2^52.
    for a in range(even):
        bits[_M_SHIFT + a] = (bits[_M_SPARE + a] >> 32) & 0xFFFFFFFF | 0x4330000000000000
        bits[_M_MISS + a] = bits[_M_SPARE + a] & 0xFFFFFFFF | 0x4330000000000000
    for a in range(even):
        f[_M_SHIFT + a] = (f[_M_SHIFT + a] - 4503599627370496.0) * 2.3283064365386963e-10
        f[_M_MISS + a] = (f[_M_MISS + a] - 4503599627370496.0) * 2.3283064365386963e-10
    # A loop of its own fetches many parts of the table at once.
    for a in range(even):
        f[_M_SHIFT + a] = _interpolate(shifts, f[_M_SHIFT + a])
    for a in range(even):
        i = candidates[min(a, m - 1)]
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
    fires = 0
    for a in range(m):
        k = np.uint64(fires)
        f[np.uint64(_M_LEVEL) + k] = f[_M_LEVEL + a]
        f[np.uint64(_M_ON) + k] = f[_M_ON + a]
        f[np.uint64(_M_MISS) + k] = f[_M_MISS + a]
        candidates[k] = candidates[a]
        fires += kind[a]
    return fires


@njit(inline="always")
def _fire_lanes(fires: int, t_us: float, until: float, batch: Batch, model: PixelModel, out: Requests) -> int:
    """Let candidates fire; those that are armed again in this piece become `rearmed`; return their number."""
    f, kind, candidates, rearmed, draw, key = (
        batch.f,
        batch.kind,
        batch.candidates,
        batch.rearmed,
        batch.draw,
        batch.key,
    )
    code, sensor = batch.code, model.sensor
    charge, refractory, delay_on, delay_off, jitter = sensor[0], sensor[1], sensor[2], sensor[3], sensor[4]
    miss_on, miss_off = sensor[5], sensor[6]
    out_t, out_code, n = out.t_us, out.code, out.made[0]
    even = (fires + _VECTOR - 1) // _VECTOR * _VECTOR
    for a in range(even):
        i = candidates[min(a, fires - 1)]
        f[_M_U + a], f[_M_REST + a] = f[np.uint64(_U + i)], f[np.uint64(_REST + i)]
        f[_M_READY + a], f[_M_LAST_OUT + a] = f[np.uint64(_READY + i)], f[np.uint64(_LAST_OUT + i)]
    if jitter > 0.0:
        for a in range(fires):
            k = np.uint64(candidates[a])
            f[_M_JITTER + a] = jitter * hash_normal(key[k], 0, draw[k], 2, model.quantiles)
    for a in range(even):
        u, rest, level = f[_M_U + a], f[_M_REST + a], f[_M_LEVEL + a]
        ready, on = f[_M_READY + a], f[_M_ON + a] > 0.0
        # A signal that starts beyond the threshold crosses it at once.
        beyond = (u <= level) if on else (u >= level)
        tau = 0.0 if beyond else charge * rest
        # The natural logarithm, of any value if not positive, without a branch or a call: the exponent in the
        # lowest bits of 2^52, and a series of the mantissa.
        ratio = np.float64((u - rest) / (level - rest)).view(np.int64)
        raised = np.int64((ratio >> 52) & 0x7FF | 0x4330000000000000).view(np.float64)
        mantissa = np.int64(ratio & 0xFFFFFFFFFFFFF | 0x3FF0000000000000).view(np.float64)
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
        late = max((delay_on if on else delay_off) + f[_M_JITTER + a], 0.0)
        ready = t + refractory
        f[_M_REQUEST + a] = max(t + late, f[_M_LAST_OUT + a] + refractory)
        f[_M_READY + a] = ready
        sent = f[_M_MISS + a] >= (miss_on if on else miss_off)
        kind[a] = (1 if on else 0) | (2 if sent else 0) | (4 if ready < until else 0)
    blind = 0
    for a in range(fires):
        i, what = candidates[a], kind[a]
        f[np.uint64(_READY + i)] = f[_M_READY + a]
        f[np.uint64(_LAST_OUT + i)] = f[_M_REQUEST + a]
        # Missing events are overwritten, which is faster than a branch that cannot be predicted.
        out_t[np.uint64(n)] = f[_M_REQUEST + a]
        out_code[np.uint64(n)] = code[np.uint64(i)] + (what & 1)
        n += (what >> 1) & 1
        rearmed[np.uint64(blind)] = i
        blind += what >> 2
    out.made[0] = n
    return blind


@njit(fastmath={"contract"})
def _run_piece(lanes: int, t_us: float, until: float, batch: Batch, model: PixelModel, out: Requests) -> None:
    """Run pixels in constant light from `t_us` to `until`.

    With u = exp(-y) the receptor is u(t) = 1/I + (u0 - 1/I) exp(-I t / Q), which is monotonic; so a threshold
    is crossed in a piece if u is beyond it at the end, and the time follows from one logarithm. A pixel is
    blind until `_READY`. Pixels that are armed again, then those that may fire by the most noise, and of
    these those that do, are picked; their next events are computed together, until there are none.
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
        batch.candidates[np.uint64(m)] = i
        m += kind[i] & 1
    for i in range(lanes):
        batch.rearmed[np.uint64(blind)] = i
        blind += kind[i] >> 1
    while m + blind > 0:
        m = _rearm_lanes(blind, m, t_us, batch, sensor)
        fires = _draw_noise(m, batch, model.shifts) if m else 0
        m, blind = 0, 0
        if fires:
            blind = _fire_lanes(fires, t_us, until, batch, model, out)
    for i in range(lanes):
        f[_U + i] = f[_END + i]


@njit(inline="always")
def _edge_share(table: Array, per_px: float, z: float) -> float:
    """Return the share of a pixel lit at `z` px beyond a blurred edge, by its table."""
    half = 0.5 * (table.size - 1)
    at = z * per_px + half
    if at <= 0.0:
        return 0.0
    if at >= table.size - 1:
        return 1.0
    i = int(at)
    return float(table[i] + (at - i) * (table[i + 1] - table[i]))


class TimeLine(NamedTuple):
    """Changes of light in a block, in order; the light on a pixel is constant in between.

    Attributes:
        t_us: Times, the first that of the block's start, float64 (entries,).
        kind: Kinds: the image moves (-2), the share of all light that passes or the background changes (-1),
            or the source of this number switches.
        pose: Pose of the image from then on.
        shade: Share of all light that passes from then on.
        step: Number of changes of the background until then.
        row: Row of the levels of each source from then on, (sources, entries).
    """

    t_us: Array
    kind: Array
    pose: Array
    shade: Array
    step: Array
    row: Array


class Strips(NamedTuple):
    """Places and light of the strips of the sources.

    Attributes:
        levels: Light of each cluster as a share of full light, (rows, clusters).
        origin: First end of a strip, px, (2, sources, poses).
        axis: Unit vector along it, (2, sources, poses).
        bounds: Where its clusters start and end along it, px, (sources, clusters + 1, poses).
        width_px: Its width, (sources, poses).
        clusters: Number of its clusters, (sources,).
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
        light: Light of a row of levels on a grid along the strip, as a share of full light, (halos, rows, n).
        first: Start of the grid, px, (halos,).
        per_px: Its nodes per px, (halos,).
        share: Share of the light in each halo, (halos,).
        every: Poses after which it follows the strip; 0: it stays at the middle pose, (halos,).
        table: Share of a pixel lit around its blurred edge, (halos, m).
        table_per_px: Nodes of the table per px, (halos,).
    """

    light: Array
    first: Array
    per_px: Array
    share: Array
    every: Array
    table: Array
    table_per_px: Array


class Cores(NamedTuple):
    """The image of a point without its halos.

    Attributes:
        share: Share of the light in it.
        tables: Tables of `tabulate_strip` of each source.
        scale: Scales of these, px, (sources,).
        reach: How far they are used, px, (sources,).
    """

    share: float
    tables: Array
    scale: Array
    reach: Array


class Background(NamedTuple):
    """The background.

    Attributes:
        turn_px: Motion of the texture, (poses, 2).
        every: Poses after which the texture is sampled again.
        field: The texture, periodic, its size a power of two.
        light: Dark current as light, and irradiance on the sensor after each number of changes, W/m2.
    """

    turn_px: Array
    every: int
    field: Array
    light: Array


class _SourceLight(NamedTuple):
    """Room for the light of each source on a batch, one row a source.

    Attributes:
        clusters: The first within reach, the one after the last, and the row of levels, int64 (sources, 3).
        weight: Light of these on each pixel, W/m2, cluster by cluster, (sources, LANES * clusters).
        part: Light of the source on each pixel, W/m2, (sources, LANES).
        halo: Of each halo: its light on each pixel, that of full light, and the part of a node beyond `node`.
        node: Node of each pixel on the grid of a halo.
        nodes: Room of `_weigh_clusters`, int32 (2, LANES).
        edge_shares: Likewise, (LANES * (clusters + 1),).
    """

    clusters: Array
    weight: Array
    part: Array
    halo: Array
    node: Array
    nodes: Array
    edge_shares: Array


@njit(fastmath={"contract"})
def _weigh_clusters(
    a: int,
    g: int,
    pose: int,
    size: tuple[int, int],
    f: Array,
    strips: Strips,
    near: Cores,
    room: _SourceLight,
) -> None:
    """Find the clusters of a source that light some of `size` (lanes, pixels), and the weight of row `a`."""
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
    rows, nodes, shares, weight = room.nodes[0], room.nodes[1], room.edge_shares, room.weight[a]
    columns = table.shape[1]
    flat = table.reshape(-1)
    most = table.shape[0] - 1
    for i in range(lanes):
        across = abs(f[_ACROSS + i])
        side = most * across / (across + scale)
        row = min(np.int32(side), np.int32(most - 1))
        f[_ROW_PART + i] = side - row
        rows[i] = row * columns
    half = 0.5 * (columns - 1)
    below = np.uint64(columns)
    one = np.uint64(1)
    for c in range(edges.size):
        # Separate loops, so that the first becomes vector instructions.
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
            shares[first + np.uint64(i)] = low + f[_ROW_PART + i] * (high - low)
    for c in range(edges.size - 1):
        first, behind = np.uint64(c * LANES), np.uint64((c + 1) * LANES)
        for i in range(lanes):
            is_near = (
                (f[_ALONG + i] > edges[c] - reach)
                & (f[_ALONG + i] < edges[c + 1] + reach)
                & (abs(f[_ACROSS + i]) < reach + 0.5 * strip_px)
            )
            share = shares[first + np.uint64(i)] - shares[behind + np.uint64(i)]
            weight[first + np.uint64(i)] = gain * share if is_near else 0.0


@njit(fastmath={"contract"})
def _update_light(
    a: int,
    g: int,
    poses: tuple[int, int, int],
    size: tuple[int, int],
    f: Array,
    scene: tuple[Strips, Halos],
    near: Cores,
    room: _SourceLight,
) -> None:
    """Update the light of source g with its row of levels on each pixel: part of row `a`.

    `poses` are the one before, -1 for none, the present one, and the one of the sources' places; a row of
    levels that has just been switched is given as -1 - row.
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
                across = _edge_share(table, per_px, across_px + half) - _edge_share(
                    table, per_px, across_px - half
                )
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
        _weigh_clusters(a, g, here, size, f, strips, near, room)
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
    world: tuple[TimeLine, Strips, Halos, Cores, Background],
    room: tuple[_SourceLight, Array, Array],
    batch: Batch,
    model: PixelModel,
    out: Requests,
) -> None:
    """Run a batch of `size` (lanes, pixels), with its mask and its stride in `of_batch`, through a block."""
    line, strips, halos, near, scenery = world
    shining, lit, entries = room
    lanes, _ = size
    mask, stride = of_batch
    f, poses, many = batch.f, scenery.turn_px.shape[0], 0
    field, last = scenery.field, scenery.field.shape[0] - 1
    for g in range(strips.gain.size):
        lit[many], shining.clusters[many, 2] = g, -1
        many += int((mask >> np.uint64(g)) & np.uint64(1))
    # The changes for this batch: those of its sources, and every stride of poses.
    count, pose, sampled, dark = 0, -1, -1, scenery.light[0]
    for e in range(line.t_us.size):
        what = line.kind[e]
        is_own = (mask >> np.uint64(max(what, 0))) & np.uint64(what >= 0)
        entries[count] = e
        count += int(is_own) | (what == -1) | ((what == -2) & (line.pose[e] % stride == 0))
    for q in range(count):
        e = entries[q]
        t_us, until = line.t_us[e], line.t_us[entries[q + 1]] if q + 1 < count else end_us
        before, pose = pose, line.pose[e] // stride * stride
        # The places of the sources are those in the middle of these poses.
        here = min(pose + stride // 2, poses - 1)
        sample = line.step[e] * poses + pose // scenery.every
        if sample != sampled:
            sampled = sample
            # The light of the background and the dark current: bilinear in the periodic texture.
            for i in range(lanes):
                u, v = f[_X + i] + scenery.turn_px[pose, 0], f[_Y + i] + scenery.turn_px[pose, 1]
                row, column = math.floor(v), math.floor(u)
                down, right = v - row, u - column
                i0, j0 = int(row) & last, int(column) & last
                i1, j1 = (i0 + 1) & last, (j0 + 1) & last
                top = field[i0, j0] + right * (field[i0, j1] - field[i0, j0])
                low = field[i1, j0] + right * (field[i1, j1] - field[i1, j0])
                f[_BACKGROUND + i] = dark + scenery.light[1 + line.step[e]] * (top + down * (low - top))
        for i in range(lanes):
            f[_TOTAL + i] = f[_BACKGROUND + i]
        for a in range(many):
            levels_row = line.row[lit[a], e]
            if levels_row != shining.clusters[a, 2]:
                shining.clusters[a, 2] = -1 - levels_row
            _update_light(a, lit[a], (before, pose, here), size, f, (strips, halos), near, shining)
            for i in range(lanes):
                f[_TOTAL + i] += shining.part[a, i]
        shade = line.shade[e]
        if shade != 1.0:
            for i in range(lanes):
                f[_TOTAL + i] = dark + shade * (f[_TOTAL + i] - dark)
        if q == 0:
            # Newly active pixels have settled in their light, and are armed.
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
        number: Number of the block.
        end_us: End of the block.
        pixels: Numbers of the pixels, batch by batch.
        batches: Start of each batch in `pixels`, and the end of the last; at most `LANES` pixels each.
        masks: Bit mask of the sources that light a batch.
        strides: Poses after which a batch follows the sources.
        at_px: Column and row of each pixel's light without raindrops, (2, pixels).
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
    world: tuple[TimeLine, Strips, Halos, Cores, Background],
    model: PixelModel,
    most_events: int,
    out: Requests,
) -> int:
    """Run batches [first, last) of pixels through a block of time; return the next batch.

    It ends early at a batch for which the output might have no room, with `most_events` of each pixel.
    `store` has the states and counters of all pixels, and the columns of the image.
    """
    line, strips, halos, _, _ = world
    sources, many, most = strips.gain.size, halos.share.size, strips.levels.shape[1]
    states, counters, width = store
    rows = np.zeros((5, LANES), np.int64)
    batch = Batch(np.zeros(_ROOM), np.zeros(LANES, np.uint64), rows[0], rows[1], rows[2], rows[3], rows[4])
    f, sensor, quantiles = batch.f, model.sensor, model.quantiles
    shining = _SourceLight(
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
            batch.key[i], batch.draw[i] = (
                mix_bits(model.seed + np.uint64(pixel) * np.uint64(PIXEL_STEP)),
                c[DRAW],
            )
            f[_X + i], f[_Y + i] = block.at_px[0, begin + i], block.at_px[1, begin + i]
            f[_ON + i], f[_OFF + i], f[_LAST_OUT + i] = s[ON_FACTOR], s[OFF_FACTOR], s[T_LAST_OUT]
            f[_U + i], f[_REFERENCE + i], f[_READY + i] = s[U_BASE], s[REFERENCE], s[T_READY]
            f[_NOW + i], f[_FOLLOWER + i], f[_ARMED + i] = s[LIGHT], s[FOLLOWER], float(c[ARMED])
            f[_NEW + i] = 1.0 if c[BLOCK] != block.number + 1 else 0.0
            if s[ON_FACTOR] == 0.0:
                on = sensor[9] * (1.0 + sensor[11] * hash_normal(model.seed, pixel, 0, 3, quantiles))
                off = sensor[10] * (1.0 + sensor[11] * hash_normal(model.seed, pixel, 0, 4, quantiles))
                f[_ON + i], f[_OFF + i], f[_LAST_OUT + i] = math.exp(-on), math.exp(off), -1e18
        # The rest of the lanes, to a multiple of `_VECTOR`, have pixels that never fire.
        lanes = (pixels.size + _VECTOR - 1) // _VECTOR * _VECTOR
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
def _split_request(word: int) -> tuple[float, Any, Any]:
    """Split a request into its ticks since the start of its block, its row and its column."""
    row, column = word >> (COLUMN_BITS + 1), word >> 1
    most = (1 << COLUMN_BITS) - 1
    return np.float64(word >> CODE_BITS), np.uint64(row & most), np.uint64(column & most)


@njit
def drop_blind_requests(
    words: Array, begin_us: float, blind_us: Array, width: int, refractory_us: float
) -> int:
    """Drop, in place, requests of pixels that are blind until `blind_us`; return how many remain."""
    kept = 0
    for i in range(words.size):
        word = words[i]
        ticks, row, column = _split_request(word)
        pixel, t = row * np.uint64(width) + column, begin_us + ticks * (1.0 / TICKS)
        # Dropped requests are overwritten.
        words[np.uint64(kept)] = word
        if t >= blind_us[pixel]:
            # A millionth of a us allows for the rounding of both times to ticks.
            blind_us[pixel] = t + (refractory_us - 1e-6)
            kept += 1
    return kept


@njit
def _pop_row(waits: Array, row: int) -> int:
    """Return the next row whose bit of `waits` is set, from `row` on and then from 0; clear its bit."""
    place = row >> 6
    bits = waits[place] >> np.uint64(row & 63) << np.uint64(row & 63)
    while bits == np.uint64(0):
        place = place + 1 if place + 1 < waits.size else 0
        bits = waits[place]
    lowest = bits & (~bits + np.uint64(1))
    waits[place] ^= lowest
    return place << 6 | int(_BIT_INDEX[(lowest * np.uint64(0x03F79D71B4CB0A89)) >> np.uint64(58)])


@njit
def _compact_requests(words: Array, follow: Array, seen: int, pending: Array) -> int:
    """Move words that are not served, or not yet queued, to the front; return their number."""
    left = 0
    for m in range(words.size):
        if m >= seen or follow[m] != _SERVED:
            if pending.size > 0:
                _, y, x = _split_request(words[m])
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
    """Serve sorted requests row by row; move those that are left to the front of `words`.

    `times_us` are (origin of the words' times, time to read a row, end). A row is served with all its
    requests; then comes the next row below with a request, and after the last row the first. `limit` is (most
    events in a window, 0 for any, window in us). `memory` is (time of the next readout, last row, number of
    the window, events in it) and is updated. If `pending` has any size, bool (rows, columns), all False, a
    pixel sends nothing while one of its requests waits.

    Returns:
        (events written, events over the limit, requests of waiting pixels, requests left).
    """
    begin_us, row_us, safe_us = times_us
    cap, cap_window_us = limit
    out_t, out_x, out_y, out_p = out
    size = words.size
    # `follow` has the next waiting request of the same row, and after the requests the first of each row;
    # `tail` is where the next one of a row belongs.
    follow, tail = np.empty(size + height, np.int32), np.empty(height, np.int32)
    for i in range(height):
        tail[i], follow[size + i] = size + i, -1
    # Events as words: column, number in the row, polarity.
    row_events = np.empty(size, np.int64)
    # One bit for each waiting row.
    waits = np.zeros((height >> 6) + 1, np.uint64)
    hold = pending.size > 0
    free, at_row = memory[0], int(memory[1])
    window, used = int(memory[2]), int(memory[3])
    window_end = (window + 1) * cap_window_us
    n = dropped = held = waiting = i = 0
    due = begin_us + _split_request(words[0])[0] * (1.0 / TICKS) if size else math.inf
    while True:
        if waiting == 0:
            if i >= size:
                break
            free = max(free, due)
        if free >= safe_us:
            break
        while due <= free:
            k = np.uint64(i)
            _, y, x = _split_request(words[k])
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
            due = begin_us + _split_request(words[np.uint64(i)])[0] * (1.0 / TICKS) if i < size else math.inf
        if waiting == 0:
            continue
        at_row = _pop_row(waits, at_row + 1)
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
            _, _, x = _split_request(what)
            waiting -= 1
            if hold:
                pending[y, x] = False
            if cap > 0 and used >= cap:
                dropped += 1
                continue
            used += 1
            # Sorted by column, then by arrival; without a branch, which could not be predicted.
            event = np.int64(x) << 32 | (n - begin) << 1 | what & 1
            for j in range(begin, n):
                other = row_events[np.uint64(j)]
                row_events[np.uint64(j)] = min(other, event)
                event = max(other, event)
            last = np.uint64(n)
            row_events[last], out_t[last], out_y[last] = event, stamp, at_row
            n += 1
    for j in range(n):
        out_x[j], out_p[j] = row_events[j] >> 32, row_events[j] & 1
    left = _compact_requests(words, follow, i, pending)
    memory[0], memory[1], memory[2], memory[3] = free, at_row, window, used
    return n, dropped, held, left
