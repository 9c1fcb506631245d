"""Rate and format of the characters of a light of which nothing is known, and what speaks for them.

Bits are read without a format: edges are whole bits apart, a line in their spectrum, and the light is learned
by bits of which any may follow any. What a format has fixed (parity, stop bits, a start bit behind these) is
then right by chance in half of the cases, or it is the light's.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from evlcp_sdk.clock import TimeGrain
from evlcp_uart.characters import Characters, Parity
from evlcp_uart.light import CONTEXTS, OUTLIER, TICKS, Floats, Light, Ticks, guesses

_BAND_HZ = 250.0, 30_000.0
"""Rates that are looked for."""

_BIN_US, _MOST_BINS = 16, 1 << 18
"""Bins of the spectrum, 4 s of them."""

_LINES, _HALF = 4, 0.5
"""Lines that are tried, of half the highest at least: where bursts are as wide as a bit, those of start and
stop bits may be higher than that of all bits."""

_AS_HIGH = 0.75
"""Share of a line's height that the one of which it is a multiple has: all but what lies between two bins."""

_LEARN_BITS, _MOST_BITS, _LEAST_BITS = 256, 2048, 64
"""Bits that the light is learned from, that are read, and without which nothing is told."""

_TRIED, _ROUNDS = 4, 5
"""Guesses of the light that are followed, and how often each is learned anew."""

_EDGES = np.arange(CONTEXTS) % 4 % 3 > 0
"""Contexts whose last two bits differ."""

_PAUSE_BITS = 16
"""Bits beside an edge that are known by it; one edge of some hundred is not seen."""

_LEAST = 1e-3
"""Least probability of a bit: however clear it is, a character may be spoiled."""

_AT_ONCE = 0.9
"""Share of characters that are expected to follow another at once."""

_SURE_BITS = 23.0
"""What must speak for a format. By random bits a ratio of likelihoods is above 2^n less often than 2^-n: of
240 that are tried of each of three lights, one in ten thousand recordings."""

_NEAR = 0.9
"""Share of what speaks for the best format from which on another may be it: one that has a fixed bit less has
three quarters at the most, and a character that is lost where a pause ends costs what some others say."""

_COMMON = np.isin(np.arange(512), [0x20, *range(0x61, 0x7B)])
"""Blanks and small letters are most of any text."""


@dataclass(frozen=True)
class _Inferred:
    """A format, and what speaks for it.

    Attributes:
        form: It.
        rate_hz: Bits a second.
        idle: What the light does in pauses.
        worth: How much likelier the bits are by it than any, log2.
        bits: That of pairs of characters that are new: a pattern that repeats itself fits again and again.
        framed: Characters with parity and stop bits right, of all, and of zeros that are of none.
        pauses: No character follows another at once.
        common: How many of them are usual in text.
    """

    form: Characters
    rate_hz: float
    idle: str
    worth: float
    bits: float
    framed: tuple[int, int]
    pauses: bool
    common: int

    def __str__(self) -> str:
        name = f"{self.form.data_bits}{self.form.parity[0].upper()}{self.form.stop_bits}"
        framed = f"{self.framed[0]} of {self.framed[1]} characters framed"
        return f"{name}, idle {self.idle}, {framed}, {round(self.bits)} bits of evidence"


def infer(t_us: Ticks, p: NDArray[np.uint8]) -> tuple[dict[str, Any], str]:
    """What a link has to say of a light, by `table.key`, nothing where it sends no characters; and why."""
    none = "no asynchronous light found: "
    ranked = max(_rank_formats(t_us, p), key=lambda formats: formats[0].bits, default=[])
    if not ranked:
        return {}, f"{none}{len(t_us)} events are too few"
    if ranked[0].bits < _SURE_BITS:
        return {}, f"{none}at best {ranked[0].rate_hz:g} baud, {ranked[0]}, {_SURE_BITS:g} needed"
    # Text of eight bits fits either way round, but is text in one.
    near = [one for one in ranked if one.worth >= _NEAR * ranked[0].worth]
    best = max(near, key=lambda one: one.common)
    other = ranked[1] if best is ranked[0] else ranked[0]
    form = best.form
    stops = f"{'at least ' * best.pauses}{form.stop_bits} stop bit{'s' * (form.stop_bits > 1)}"
    said = (
        f"an asynchronous light, {best.rate_hz:g} baud, {form.data_bits} data bits {form.first} first,"
        f" {form.parity.replace('none', 'no')} parity, {stops}: {best};"
        f" {'not told from' if len(near) > 1 else 'next best'} {other}"
    )
    framing: dict[str, Any] = {"data_bits": form.data_bits, "parity": form.parity, "idle": best.idle}
    framing |= {"stop_bits": form.stop_bits, "first_bit": form.first}
    return {"air.chip_rate_hz": best.rate_hz} | {f"framing.{key}": v for key, v in framing.items()}, said


def _rank_formats(t_us: Ticks, p: NDArray[np.uint8]) -> Iterator[list[_Inferred]]:
    """All formats at each rate that bits may have, the best first, by the stretch with most events."""
    for rate_hz in _find_rates(t_us, p):
        counts = _count((t_us - t_us[0]) * (1e-6 * TICKS * rate_hz), p, _LEARN_BITS * TICKS)
        blocks = counts.reshape(2, -1, _LEARN_BITS * TICKS).swapaxes(0, 1)
        many = _MOST_BITS // _LEARN_BITS
        first = int(np.convolve(blocks.sum((1, 2)), np.ones(many))[many - 1 :].argmax())
        ones = np.clip(_read(blocks[first : first + many]), _LEAST, 1 - _LEAST)
        if len(ones) >= _LEAST_BITS:
            formats = [
                _judge(Characters(*form), float(f"{rate_hz:.4g}"), idle, marks)
                for idle, marks in (("on", ones), ("off", 1 - ones))
                for form in product(range(5, 10), get_args(Parity), (1, 2))
            ]
            yield sorted(formats, key=lambda one: -one.worth)


def _count(at: Floats, p: NDArray[np.uint8], block: int) -> NDArray[np.int32]:
    """Events at each whole number, OFF and ON, whole blocks of them, int32 (2, n)."""
    whole = at.astype(np.int64)
    size = (int(whole[-1]) // block + 1) * block
    return np.stack([np.bincount(whole[p == on], minlength=size) for on in (0, 1)]).astype(np.int32)


def _find_rates(t_us: Ticks, p: NDArray[np.uint8]) -> Iterator[float]:
    """The lowest frequencies of which the highest lines in the spectrum of edges are multiples, Hz."""
    step_us = max(TimeGrain().update(t_us).step_us, 1)
    # Whole steps: others would beat with them.
    bin_us = step_us * max(_BIN_US // step_us, 1)
    counts = _count((t_us - t_us[0]) / bin_us, p, 2)[:, :_MOST_BINS]
    power = (np.abs(np.fft.rfft(counts - counts.mean(1, keepdims=True), 2 * counts.shape[1])) ** 2).sum(0)
    each_hz = 1e6 / (2 * counts.shape[1] * bin_us)
    hz = np.arange(len(power)) * each_hz
    left = np.where((hz > _BAND_HZ[0]) & (hz < min(_BAND_HZ[1], 0.4e6 / bin_us)), power, 0.0)
    least = _HALF * left.max()
    for _ in range(_LINES):
        top = int(left.argmax())
        if left[top] <= 0 or left[top] < least:
            return
        for part in range(int(hz[top] / _BAND_HZ[0]), 0, -1):
            near = round(top / part) + np.arange(-2, 3)
            line = int(near[left[near].argmax()])
            if left[line] >= _AS_HIGH * left[top]:
                break
        before, here, after = power[line - 1 : line + 2]
        bend = before - 2 * here + after
        rate_hz = each_hz * (line + (0.5 * (before - after) / bend if bend < 0 else 0.0))
        yield rate_hz
        multiples = np.maximum(np.rint(hz / rate_hz), 1)
        left[np.abs(hz - multiples * rate_hz) <= np.maximum(4 * each_hz, 0.003 * hz)] = 0


def _read(blocks: NDArray[np.int32]) -> Floats:
    """How likely the light is on in each bit, float64 (n,), by events of ticks, int32 (blocks, 2, ticks)."""
    busy = blocks[int(blocks.sum((1, 2)).argmax())]
    learned = []
    for light in _best_first(busy, guesses(busy, True))[:_TRIED]:
        for _ in range(_ROUNDS):
            begin, _, contexts = _follow(_logs(busy, light))
            light = light.learn(_windows(busy)[begin::TICKS], contexts, 0.0, 1.0)
        learned.append(light)
    light = _best_first(busy, learned)[0]
    # Pauses need not be whole bits: each block's begin where they tell most.
    every = [_logs(block, light) for block in blocks]
    contexts = _follow(np.concatenate([logs[:, [_follow(logs)[0]]] for logs in every]))[2]
    # Of a long pause it is not known whether it is on.
    is_edge = contexts[:, _EDGES].sum(1) > 0.5
    ones: Floats = contexts[:, 1::2].sum(1)[maximum_filter1d(is_edge, 2 * _PAUSE_BITS + 1)]
    return ones


def _best_first(counts: NDArray[np.int32], lights: Iterable[Light]) -> list[Light]:
    """Lights by how well they explain events, beside one another where an event counts the same."""
    lights = list(lights)
    least = min(light.share for light in lights)
    return sorted(lights, key=lambda one: -_follow(_logs(counts, replace(one, most=least)))[1])


def _windows(counts: NDArray[np.int32]) -> Floats:
    """Events of a bit that begins at each tick, float64 (n, 2, TICKS)."""
    padded = np.pad(counts, ((0, 0), (0, TICKS - 1))).astype(np.float64)
    return np.lib.stride_tricks.sliding_window_view(padded, TICKS, 1).transpose(1, 0, 2)


def _logs(counts: NDArray[np.int32], light: Light) -> Floats:
    """Log-likelihood of each context of bits by the tick that they begin with, float64 (n, TICKS, C)."""
    logs: Floats = np.logaddexp(light.beside_mean(_windows(counts)), np.log(OUTLIER))
    return logs.reshape(-1, TICKS, CONTEXTS)


def _follow(logs: Floats) -> tuple[int, float, Floats]:
    """Bits of which any follows any: where they begin, their log-likelihood, and their contexts, (n, C).

    Args:
        logs: Log-likelihood of each context of each bit for the places where bits may begin, (n, places, C).
    """
    top = logs.max(2, keepdims=True)
    likely, worth = np.exp(logs - top), top.sum((0, 2))
    state, known = np.full(likely.shape[1:], 1 / CONTEXTS), np.empty_like(likely)
    for k, now in enumerate(likely):
        # The oldest bit is forgotten.
        state = 0.5 * np.repeat(state[:, : CONTEXTS // 2] + state[:, CONTEXTS // 2 :], 2, 1) * now
        total = state.sum(1, keepdims=True)
        worth += np.log(total[:, 0])
        known[k] = state = state / total
    best = int(worth.argmax())
    contexts, later = known[:, best], np.ones(CONTEXTS)
    for k in range(len(contexts) - 1, -1, -1):
        contexts[k] *= later / (contexts[k] @ later)
        later = np.tile((likely[k, best] * later).reshape(-1, 2).sum(1), 2)
        later /= later.sum()
    return best, float(worth[best]), contexts


def _judge(form: Characters, rate_hz: float, idle: str, marks: Floats) -> _Inferred:
    """What speaks for a format, by how likely each bit is a mark, float64 (n,)."""
    from evlcp_uart import _kernels

    bits, places = form.bits, np.arange(form.data_bits)
    words = np.lib.stride_tricks.sliding_window_view(marks, bits)
    fixed = np.log(2 * words[:, bits - form.stop_bits :]).sum(1)
    if form.parity != "none":
        balance = (1 - 2 * words[:, 1 : 2 + form.data_bits]).prod(1)
        fixed += np.log(np.maximum(1 + balance * (1 if form.parity == "even" else -1), _LEAST))
    # In pauses each bit may be a start bit. At either end characters are cut.
    pause = np.log(marks)
    pause[:bits] = pause[-bits:] = 0
    scores = fixed + np.log(2 - 2 * words[:, 0]) - np.convolve(pause, np.ones(bits), "valid")
    tails, costs = np.full(len(marks), np.log(2 - 2 * _AT_ONCE)), (np.log(2), -np.log(_AT_ONCE), 0.0)
    starts, worth = _kernels.best_path(scores, tails, bits, 0, 0, *costs, 0, 0.0)
    stray = marks < 0.5
    stray[(starts[:, None] + np.arange(bits)).ravel()] = stray[:bits] = stray[-bits:] = False
    data = words[starts, 1 : 1 + form.data_bits] > 0.5
    values, turned = data @ (1 << places), data @ (1 << places[::-1])
    pairs = np.unique(512 * values[:-1] + values[1:], return_counts=True)[1]
    new = pairs.sum() / (pairs @ pairs) if len(pairs) else 0.0
    common, other = int(_COMMON[values].sum()), int(_COMMON[turned].sum())
    return _Inferred(
        replace(form, first="highest") if other > max(common, len(values) / 2) else form,
        rate_hz,
        idle,
        worth := (worth + pause.sum()) / np.log(2),
        worth * new,
        (int((fixed[starts] > 0).sum()), len(starts) + int(stray.sum())),
        not (np.diff(starts) == bits).any(),
        max(common, other),
    )
