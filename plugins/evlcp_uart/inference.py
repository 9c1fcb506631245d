"""Infer rate and format of the characters of an unknown light, and the evidence for them.

Bits are decoded without a format: edges are whole bits apart, which is a line in their spectrum, and the
light is learned from bits of any order. The fixed bits of a format (parity, stop bits, the next start bit)
are then right by chance in half of the cases, or it is the format of the light.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from evlcp_sdk.clock import TimeGrain
from evlcp_uart import _kernels
from evlcp_uart.characters import Characters, Parity
from evlcp_uart.light import CONTEXTS, TICKS, Floats, Light, Ticks, guess_lights

_BAND_HZ = 250.0, 30_000.0
"""Range of rates."""

_BIN_US, _MAX_BINS = 16, 1 << 18
"""Width of a bin for the spectrum, and most bins, 4 s."""

_LINES, _MIN_LINE_SHARE = 4, 0.5
"""Lines to try, and their least height as a share of the highest: if bursts are as wide as a bit, the lines
of start and stop bits may be higher than that of all bits."""

_MIN_FUNDAMENTAL = 0.75
"""Least height of a fundamental line relative to its multiple; a line between bins is lower."""

_LEARN_BITS, _MAX_BITS, _MIN_BITS = 256, 2048, 64
"""Bits to learn the light from, most bits to decode, and least bits for a result."""

_TRIED, _ROUNDS = 4, 5
"""Guesses of the light to refine, and how often each is learned again."""

_EDGES = np.arange(CONTEXTS) % 4 % 3 > 0
"""Contexts whose last two bits differ."""

_PAUSE_BITS = 16
"""Bits next to an edge that are known by it; one of some hundred edges is missed."""

_MIN_PROBABILITY = 1e-3
"""Least probability of a bit: even a clear one may be of a damaged character."""

_SUCCESSIVE_SHARE = 0.9
"""Expected share of characters that follow another without a pause."""

_MIN_EVIDENCE_BITS = 23.0
"""Least evidence for a format, bits. With random bits a likelihood ratio is above 2^n less often than 2^-n:
with 240 formats for each of three rates, in one of ten thousand recordings."""

_ALTERNATIVE_SHARE = 0.9
"""Least evidence for an alternative format, as a share of that for the best: a format with a fixed bit less
has three quarters at most, and a character lost at the end of a pause costs some."""

_TEXT_CODES = np.isin(np.arange(512), [0x20, *range(0x61, 0x7B)])
"""Blanks and small letters, most of any text."""


@dataclass(frozen=True)
class _RatedFormat:
    """A format, and the evidence for it.

    Attributes:
        form: The format.
        rate_hz: Bits a second.
        idle: The state of the light in pauses.
        score: Log2 of the likelihood ratio of the bits by this format and of free bits.
        bits: The part of that from new pairs of characters, as a repeated pattern fits again and again.
        framed: Characters with the right parity and stop bits, of all of them and stray zeros.
        pauses: Whether a pause follows each character.
        common: Number of characters common in text.
    """

    form: Characters
    rate_hz: float
    idle: str
    score: float
    bits: float
    framed: tuple[int, int]
    pauses: bool
    common: int

    def __str__(self) -> str:
        name = f"{self.form.data_bits}{self.form.parity[0].upper()}{self.form.stop_bits}"
        framed = f"{self.framed[0]} of {self.framed[1]} characters framed"
        return f"{name}, idle {self.idle}, {framed}, {round(self.bits)} bits of evidence"


def infer_format(t_us: Ticks, p: NDArray[np.uint8]) -> tuple[dict[str, Any], str]:
    """Infer the settings of a light's link by `table.key`, none if it sends no characters; and the reason."""
    none = "no asynchronous light found: "
    ranked = max(_rank_formats(t_us, p), key=lambda formats: formats[0].bits, default=[])
    if not ranked:
        return {}, f"{none}{len(t_us)} events are too few"
    if ranked[0].bits < _MIN_EVIDENCE_BITS:
        return {}, f"{none}at best {ranked[0].rate_hz:g} baud, {ranked[0]}, {_MIN_EVIDENCE_BITS:g} needed"
    # Text of eight bits fits in either order of bits, but reads as text in one.
    near = [one for one in ranked if one.score >= _ALTERNATIVE_SHARE * ranked[0].score]
    best = max(near, key=lambda one: one.common)
    other = ranked[1] if best is ranked[0] else ranked[0]
    form = best.form
    stops = f"{'at least ' * best.pauses}{form.stop_bits} stop bit{'s' * (form.stop_bits > 1)}"
    summary = (
        f"an asynchronous light, {best.rate_hz:g} baud, {form.data_bits} data bits {form.first} first,"
        f" {form.parity.replace('none', 'no')} parity, {stops}: {best};"
        f" {'not told from' if len(near) > 1 else 'next best'} {other}"
    )
    framing: dict[str, Any] = {"data_bits": form.data_bits, "parity": form.parity, "idle": best.idle}
    framing |= {"stop_bits": form.stop_bits, "first_bit": form.first}
    return {"air.chip_rate_hz": best.rate_hz} | {f"framing.{key}": v for key, v in framing.items()}, summary


def _rank_formats(t_us: Ticks, p: NDArray[np.uint8]) -> Iterator[list[_RatedFormat]]:
    """Yield all formats, the best first, for each possible rate, by the stretch with most events."""
    for rate_hz in _find_rates(t_us, p):
        counts = _count_events((t_us - t_us[0]) * (1e-6 * TICKS * rate_hz), p, _LEARN_BITS * TICKS)
        blocks = counts.reshape(2, -1, _LEARN_BITS * TICKS).swapaxes(0, 1)
        many = _MAX_BITS // _LEARN_BITS
        first = int(np.convolve(blocks.sum((1, 2)), np.ones(many))[many - 1 :].argmax())
        ones = np.clip(_estimate_marks(blocks[first : first + many]), _MIN_PROBABILITY, 1 - _MIN_PROBABILITY)
        if len(ones) >= _MIN_BITS:
            formats = [
                _assess_format(Characters(*form), float(f"{rate_hz:.4g}"), idle, marks)
                for idle, marks in (("on", ones), ("off", 1 - ones))
                for form in product(range(5, 10), get_args(Parity), (1, 2))
            ]
            yield sorted(formats, key=lambda one: -one.score)


def _count_events(at: Floats, p: NDArray[np.uint8], block: int) -> NDArray[np.int32]:
    """Count OFF and ON events in unit bins, padded to whole blocks, int32 (2, n)."""
    bins = at.astype(np.int64)
    size = (int(bins[-1]) // block + 1) * block
    return np.stack([np.bincount(bins[p == on], minlength=size) for on in (0, 1)]).astype(np.int32)


def _find_rates(t_us: Ticks, p: NDArray[np.uint8]) -> Iterator[float]:
    """Yield the fundamental frequencies of the highest lines in the spectrum of edges, Hz."""
    step_us = max(TimeGrain().update(t_us).step_us, 1)
    # Bins of whole steps do not beat with them.
    bin_us = step_us * max(_BIN_US // step_us, 1)
    counts = _count_events((t_us - t_us[0]) / bin_us, p, 2)[:, :_MAX_BINS]
    power = (np.abs(np.fft.rfft(counts - counts.mean(1, keepdims=True), 2 * counts.shape[1])) ** 2).sum(0)
    step_hz = 1e6 / (2 * counts.shape[1] * bin_us)
    hz = np.arange(len(power)) * step_hz
    remaining = np.where((hz > _BAND_HZ[0]) & (hz < min(_BAND_HZ[1], 0.4e6 / bin_us)), power, 0.0)
    least = _MIN_LINE_SHARE * remaining.max()
    for _ in range(_LINES):
        top = int(remaining.argmax())
        if remaining[top] <= 0 or remaining[top] < least:
            return
        for part in range(int(hz[top] / _BAND_HZ[0]), 0, -1):
            near = round(top / part) + np.arange(-2, 3)
            line = int(near[remaining[near].argmax()])
            if remaining[line] >= _MIN_FUNDAMENTAL * remaining[top]:
                break
        before, here, after = power[line - 1 : line + 2]
        curvature = before - 2 * here + after
        rate_hz = step_hz * (line + (0.5 * (before - after) / curvature if curvature < 0 else 0.0))
        yield rate_hz
        multiples = np.maximum(np.rint(hz / rate_hz), 1)
        remaining[np.abs(hz - multiples * rate_hz) <= np.maximum(4 * step_hz, 0.003 * hz)] = 0


def _estimate_marks(blocks: NDArray[np.int32]) -> Floats:
    """Return how likely each bit is a mark, float64 (n,), by events per tick, int32 (blocks, 2, ticks)."""
    busy = blocks[int(blocks.sum((1, 2)).argmax())]
    learned = []
    for light in _rank_lights(busy, guess_lights(busy, True))[:_TRIED]:
        for _ in range(_ROUNDS):
            begin, _, contexts = _decode_bits(_log_likelihoods(busy, light))
            light = light.learn(_get_windows(busy)[begin::TICKS], contexts, 0.0, 1.0)
        learned.append(light)
    light = _rank_lights(busy, learned)[0]
    # Pauses need not be whole bits, so each block has its own phase.
    every = [_log_likelihoods(block, light) for block in blocks]
    contexts = _decode_bits(np.concatenate([logs[:, [_decode_bits(logs)[0]]] for logs in every]))[2]
    # In a long pause the light may be on or off.
    is_edge = contexts[:, _EDGES].sum(1) > 0.5
    ones: Floats = contexts[:, 1::2].sum(1)[maximum_filter1d(is_edge, 2 * _PAUSE_BITS + 1)]
    return ones


def _rank_lights(counts: NDArray[np.int32], lights: Iterable[Light]) -> list[Light]:
    """Sort lights by how well they explain events, with the same weight of an event for all."""
    lights = list(lights)
    least = min(light.share for light in lights)
    return sorted(
        lights, key=lambda one: -_decode_bits(_log_likelihoods(counts, replace(one, most=least)))[1]
    )


def _get_windows(counts: NDArray[np.int32]) -> Floats:
    """Return the events of a bit that starts at each tick, float64 (n, 2, TICKS)."""
    padded = np.pad(counts, ((0, 0), (0, TICKS - 1))).astype(np.float64)
    return np.lib.stride_tricks.sliding_window_view(padded, TICKS, 1).transpose(1, 0, 2)


def _log_likelihoods(counts: NDArray[np.int32], light: Light) -> Floats:
    """Return log-likelihoods of each context of bits that start at each tick, float64 (n, TICKS, C)."""
    return light.likelihood_ratios(_get_windows(counts)).reshape(-1, TICKS, CONTEXTS)


def _decode_bits(logs: Floats) -> tuple[int, float, Floats]:
    """Decode bits of any order by log-likelihoods of their contexts for each phase, (n, phases, C).

    Returns their phase, their log-likelihood, and their contexts, (n, C).
    """
    top = logs.max(2, keepdims=True)
    likely, score = np.exp(logs - top), top.sum((0, 2))
    state, known = np.full(likely.shape[1:], 1 / CONTEXTS), np.empty_like(likely)
    for k, now in enumerate(likely):
        # Sum over the oldest bit.
        state = 0.5 * np.repeat(state[:, : CONTEXTS // 2] + state[:, CONTEXTS // 2 :], 2, 1) * now
        total = state.sum(1, keepdims=True)
        score += np.log(total[:, 0])
        known[k] = state = state / total
    best = int(score.argmax())
    contexts, later = known[:, best], np.ones(CONTEXTS)
    for k in range(len(contexts) - 1, -1, -1):
        contexts[k] *= later / (contexts[k] @ later)
        later = np.tile((likely[k, best] * later).reshape(-1, 2).sum(1), 2)
        later /= later.sum()
    return best, float(score[best]), contexts


def _assess_format(form: Characters, rate_hz: float, idle: str, marks: Floats) -> _RatedFormat:
    """Return the evidence for a format by how likely each bit is a mark, float64 (n,)."""
    bits, places = form.bits, np.arange(form.data_bits)
    words = np.lib.stride_tricks.sliding_window_view(marks, bits)
    fixed = np.log(2 * words[:, bits - form.stop_bits :]).sum(1)
    if form.parity != "none":
        balance = (1 - 2 * words[:, 1 : 2 + form.data_bits]).prod(1)
        fixed += np.log(np.maximum(1 + balance * (1 if form.parity == "even" else -1), _MIN_PROBABILITY))
    # In pauses each bit may be a start bit. Characters at both ends are cut.
    pause = np.log(marks)
    pause[:bits] = pause[-bits:] = 0
    scores = fixed + np.log(2 - 2 * words[:, 0]) - np.convolve(pause, np.ones(bits), "valid")
    tails = np.full(len(marks), np.log(2 - 2 * _SUCCESSIVE_SHARE))
    costs = np.log(2), -np.log(_SUCCESSIVE_SHARE), 0.0
    starts, score = _kernels.find_best_path(scores, tails, bits, 0, 0, *costs, 0, 0.0)
    stray = marks < 0.5
    stray[(starts[:, None] + np.arange(bits)).ravel()] = stray[:bits] = stray[-bits:] = False
    data = words[starts, 1 : 1 + form.data_bits] > 0.5
    values, turned = data @ (1 << places), data @ (1 << places[::-1])
    pairs = np.unique(512 * values[:-1] + values[1:], return_counts=True)[1]
    new = pairs.sum() / (pairs @ pairs) if len(pairs) else 0.0
    common, other = int(_TEXT_CODES[values].sum()), int(_TEXT_CODES[turned].sum())
    return _RatedFormat(
        replace(form, first="highest") if other > max(common, len(values) / 2) else form,
        rate_hz,
        idle,
        score := (score + pause.sum()) / np.log(2),
        score * new,
        (int((fixed[starts] > 0).sum()), len(starts) + int(stray.sum())),
        not (np.diff(starts) == bits).any(),
        max(common, other),
    )
