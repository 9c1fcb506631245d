"""The light of a stretch of which nothing is known, learned from its own characters."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from evlcp_uart.light import CONTEXTS, OUTLIER, TICKS, Floats, Light, Ticks, guesses, log_sums
from evlcp_uart.reader import CLOCK_SHARE, LEAST_CHARACTERS, TAIL, CharacterReader, Stretch

_LEAST_WORTH = 0.5
"""By how much each of half of a stretch's characters is to be likelier than without."""

_INVERTED_BITS = 10.0
"""How much more must speak for a light the other way round: one link of a thousand errs."""

_INVERTED_KINDS = 3
"""Characters of so many kinds at least show which way round the light is: where one or two come again and
again, pulses are of a length or two, and falls that come a bit late explain the other way, too."""

_CLEAR = 0.8
"""Share of what data bits could say from which on characters are clear: a light that is hardly seen says
little by its start, parity and stop bits, too, and cannot be distinguished from another."""

_FRAMED = 0.6
"""Share of what their start, parity and stop bits would say, were they as clear as the data bits, that these
have to say of clear characters: 1 but for misread bits, 0.8 where one bit in seven is wrong. Of another code,
in which characters are sought where they fit, it is a tenth in the mean."""

_NEXT_FRAMED = 0.9
"""The same of a light that explains less than the best: it is one of several tries."""

_REST_FRAMED = 0.4
"""The same of characters from which the light was not learned: dim light that is true may have 0.6, another
code has what chance gives."""

_UNFRAMED_BITS = 10.0
"""How much may speak against the start, parity and stop bits of characters: one of a thousand by chance."""

_LEARN_EVENTS, _LEARN_CHARACTERS = 2400, 16
"""Events and characters that tell what a light is like: more of a bright one take longer, and say no more.
The events are 30 an edge, `_ENOUGH` of a window, of five edges a character."""

_TRIED, _ROUNDS = 4, 5
"""Guesses of the light that are followed, and how often each is learned anew."""

_CLOCKS = (-0.015, 0.015)
"""Clocks by which those are tried, too, where there is no line in the spectrum: within a character, no bit is
off by a quarter of itself then."""

_LINE = 8.5
"""By how much the line of bits is above the median of the spectrum about it: of two polarities' noise, at a
hundred frequencies, once in a thousand stretches."""

_FINE = 4
"""Frequencies that are looked at for one that a stretch distinguishes."""

_SHIFTS, _AS_GOOD = range(-14, 15, 2), 0.01
"""Ticks by which bits are tried to begin elsewhere, as a burst should be within its bit's window: the latest
that tells as much, but for a share."""


def acquire(reader: CharacterReader, mark_on: bool, stretch: Stretch) -> tuple[Light | None, bool]:
    """Learn the light from a stretch of which nothing is known.

    The light is the other way round where its characters have their start, parity and stop bits clearly
    more often so: only text of few kinds without a pause has them both ways.

    Returns:
        The light, None where the stretch shows no characters; and whether it clearly shows another code.
    """
    light, other = _find(reader, mark_on, part := _informative(reader, stretch))
    if part is stretch:
        return light, other
    if light is None:
        # Of some light more must be seen.
        return (None, True) if other else _find(reader, mark_on, stretch)
    # The rest, of which it has learned nothing, must be of these characters, too.
    rest = Stretch(stretch.counts, part.end, stretch.seen, stretch.end)
    # By themselves, a few of them might be read from another bit on.
    starts = reader.path(stretch, light, False)[0]
    starts = starts[starts >= part.end]
    if len(starts) >= LEAST_CHARACTERS:
        found, other = _best(reader, rest, [(light, starts)], _REST_FRAMED)
        if found is None:
            return None, other
    # A few characters may fit by chance: those that do not fit well must go on to.
    starts = reader.path(part, light, False)[0]
    found, _ = _best(reader, part, [(light, starts)], _NEXT_FRAMED)
    return _find(reader, mark_on, stretch) if found is None else (light, False)


def _informative(reader: CharacterReader, stretch: Stretch) -> Stretch:
    """As much of it as tells what its light is like."""
    known = int(np.searchsorted(np.cumsum(stretch.counts.sum(0)), _LEARN_EVENTS))
    end = max(known, max(stretch.start, stretch.seen) + _LEARN_CHARACTERS * reader.length)
    if end >= stretch.end:
        return stretch
    counts = np.ascontiguousarray(stretch.counts[:, : end + reader.length + 2 * TAIL])
    return Stretch(counts, stretch.start, stretch.seen, end)


def _find(reader: CharacterReader, mark_on: bool, stretch: Stretch) -> tuple[Light | None, bool]:
    """The light of a stretch as `acquire` gives it, whatever it costs."""
    upright, of_another = _best(reader, stretch, _candidates(reader, mark_on, stretch, inverted=False))
    other, _ = _best(reader, stretch, _candidates(reader, mark_on, stretch, inverted=True))
    if other is not None and other[1] > (upright[1] if upright else 0.0) + _INVERTED_BITS:
        return other[0], False
    return (None, of_another) if upright is None else (upright[0], False)


def _best(
    reader: CharacterReader,
    stretch: Stretch,
    learned: list[tuple[Light, Ticks]],
    least_framed: float = _FRAMED,
) -> tuple[tuple[Light, float] | None, bool]:
    """The light that explains most, and how much speaks for its characters' fixed bits, bits.

    Returns:
        None where none fits; and whether the one that explains most is clearly of another code.
    """
    if not learned:
        return None, False
    # Beside one another only where an event counts the same.
    least = min(light.share for light, _ in learned)
    explained = [_explained(reader, stretch, replace(light, most=least), at) for light, at in learned]
    both = bool(stretch.counts.any(1).all())
    # Light a bit off explains events of text, too, but not its stop bits: then another may, and clearly.
    of_another, dim = False, None
    for rank, k in enumerate(np.argsort(explained)[::-1].tolist()):
        light, starts = learned[k]
        evidence = reader.evidence(stretch, light)[starts[:, None] + reader.places(light)]
        if light.inverted:
            kinds = np.unique(reader.characters.likelihoods(evidence).argmax(1))
            if len(kinds) < _INVERTED_KINDS:
                continue
        framed = float(reader.characters.framed(evidence).sum() / np.log(2))
        clearness = reader.characters.clearness(evidence)
        fixed = (reader.characters.bits - reader.characters.data_bits) * len(evidence)
        # Of rises alone, or falls, none tells: what the others would say is missing.
        clear = both and clearness > _CLEAR
        unframed = clear and framed < (_NEXT_FRAMED if rank else least_framed) * clearness * fixed
        # However dim it is, characters are never that much less likely than bits without a frame.
        unframed |= both and framed < -_UNFRAMED_BITS
        if clear and not unframed:
            return (light, framed), False
        if rank == 0:
            of_another, dim = unframed, None if unframed else (light, framed)
    # One that tells little is taken where none is clear.
    return dim, of_another


def _candidates(
    reader: CharacterReader, mark_on: bool, stretch: Stretch, inverted: bool
) -> list[tuple[Light, Ticks]]:
    """What the light may be like, as the link has it or the other way round, and its characters."""
    tried: list[tuple[float, Light]] = []

    def explain(light: Light) -> None:
        starts = reader.path(stretch, light, True)[0]
        tried.append((_explained(reader, stretch, light, starts), light))
        tried.sort(key=lambda one: -one[0])

    line = _find_clock(stretch.counts)
    for light in guesses(stretch.counts, mark_on != inverted):
        explain(replace(light, inverted=inverted, rate=line or 1.0))
    for _, light in tried[:_TRIED]:
        for off in () if line else _CLOCKS:
            explain(replace(light, rate=1 + off))
    learned = []
    for _, light in tried[:_TRIED]:
        for turn in range(_ROUNDS):
            starts, evidence, _ = reader.path(stretch, light, True)
            if turn in (0, 2):
                light = _begun(reader, stretch, light, starts, evidence)
                starts, evidence, _ = reader.path(stretch, light, True)
            light = reader.learn(stretch, light, starts, evidence, 0.0)
        starts, _, worth = reader.path(stretch, light, False)
        if worth > 0 and _cross_explained(reader, stretch, light) > 0:
            learned.append((light, starts))
    return learned


def _find_clock(counts: NDArray[np.int32]) -> float | None:
    """Length of a bit by the line in the spectrum of edges, which are whole bits apart; None without one."""
    size = _FINE * counts.shape[1]
    power = (np.abs(np.fft.rfft(counts, size)) ** 2).sum(0)
    first, last = (int(size / (TICKS * (1 + off))) for off in (CLOCK_SHARE, -CLOCK_SHARE))
    band = power[first : last + 1]
    top = int(band.argmax())
    return size / (TICKS * (first + top)) if band[top] > _LINE * np.median(band) else None


def _begun(reader: CharacterReader, stretch: Stretch, light: Light, starts: Ticks, evidence: Floats) -> Light:
    """The light where bits begin so that events tell most of them: a burst is in its bit's window."""
    if len(starts) < LEAST_CHARACTERS:
        return light
    found = []
    known = reader.contexts(light, starts, evidence)
    for shift in _SHIFTS:
        windows, contexts = reader.bits(stretch, light, starts, known, shift)
        learned = light.learn(windows, contexts, 0.0, light.rate)
        found.append((learned.explained(windows, contexts), learned))
    most = max(worth for worth, _ in found)
    most -= _AS_GOOD * abs(most)
    return [learned for worth, learned in found if worth >= most][-1]


def _cross_explained(reader: CharacterReader, stretch: Stretch, light: Light) -> float:
    """How much of each half of a stretch the light explains that the other one teaches."""
    starts, evidence, _ = reader.path(stretch, light, False)
    half = len(starts) // 2
    if half < LEAST_CHARACTERS:
        return -np.inf
    middle = int(starts[half])
    total = -_LEAST_WORTH * len(starts)
    parts = (starts[:half], middle, stretch.end), (starts[half:], stretch.start, middle)
    for known, begin, end in parts:
        learned = reader.learn(stretch, light, known, evidence, 0.0)
        part = Stretch(stretch.counts, begin, stretch.seen, end)
        total += _explained(reader, part, learned, reader.path(part, learned, False)[0])
    return total


def _explained(reader: CharacterReader, stretch: Stretch, light: Light, starts: Ticks) -> float:
    """How much likelier the events are with the characters that start there than with no bits at all."""
    bits, begin = reader.characters.bits, max(stretch.start, stretch.seen)
    starts = starts[starts + bits * TICKS <= stretch.end]
    marks = np.arange(begin, stretch.end - TICKS, TICKS)
    before = np.searchsorted(starts, marks + TICKS) - 1
    if len(starts):
        marks = marks[(before < 0) | (marks >= starts[before] + reader.length * light.rate)]
    places = (starts[:, None] + reader.places(light)).ravel()
    at = np.concatenate([places, marks])
    windows = stretch.windows[at].astype(np.float64)
    beside = np.logaddexp(light.beside_mean(windows), np.log(OUTLIER))
    words = beside[: len(places)].reshape(len(starts), bits, CONTEXTS)
    worth = log_sums(reader.characters.likelihoods(words)) - reader.characters.data_bits * np.log(2)
    return float(worth.sum() + beside[len(places) :, -1].sum())
