"""Learn an unknown light from the characters of a stretch."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from evlcp_uart.light import CONTEXTS, TICKS, Floats, Light, Ticks, guess_lights, log_sum_exp
from evlcp_uart.reader import CLOCK_SHARE, MIN_CHARACTERS, TAIL, CharacterReader, Stretch

_MIN_WORTH = 0.5
"""Least mean log-likelihood ratio of a character by the light learned from the other half of a stretch."""

_INVERTED_BITS = 10.0
"""Further evidence needed for an inverted light, bits: one link of a thousand errs."""

_INVERTED_KINDS = 3
"""Least kinds of characters that show the polarity of a light: with one or two repeated ones pulses have a
length or two, and falls a bit later explain the other polarity, too."""

_CLEAR = 0.8
"""Least clearness of data bits for a decision: the start, parity and stop bits of a dim light tell too little
to distinguish it from another code."""

_FRAMED = 0.6
"""Least evidence of the start, parity and stop bits of clear characters, as a share of that of equally clear
data bits: it is 1 but for misread bits, and 0.8 if one bit in seven is wrong. With another code, in which
characters are searched where they fit, its mean is a tenth."""

_NEXT_FRAMED = 0.9
"""The same for a light that explains less than the best, as one of several tries."""

_REST_FRAMED = 0.4
"""The same for characters that the light was not learned from: a true dim light may have 0.6, another code is
at chance level."""

_UNFRAMED_BITS = 10.0
"""Most evidence against the start, parity and stop bits of characters, bits: one of a thousand by chance."""

_LEARN_EVENTS, _LEARN_CHARACTERS = 2400, 16
"""Events and characters to learn a light from; more of a bright one take longer and add nothing. The events
are 30 an edge, `_MAX_EVENTS` of a window, with five edges a character."""

_TRIED, _ROUNDS = 4, 5
"""Guesses of the light to refine, and how often each is learned again."""

_CLOCKS = (-0.015, 0.015)
"""Clock errors to try without a line in the spectrum: within a character no bit is then off by a quarter."""

_LINE = 8.5
"""Least ratio of the line of bits to the median of the spectrum around it: noise of two polarities, at a
hundred frequencies, reaches it in one of a thousand stretches."""

_OVERSAMPLING = 4
"""Frequencies per resolution of a stretch."""

_SHIFTS, _SHIFT_TOLERANCE = range(-14, 15, 2), 0.01
"""Shifts of bits to try, ticks, as a burst should lie within the window of its bit: the latest is taken that
tells as much, but for this share."""


def acquire_light(reader: CharacterReader, mark_on: bool, stretch: Stretch) -> tuple[Light | None, bool]:
    """Learn an unknown light from a stretch.

    The light is inverted if its characters then clearly have better start, parity and stop bits; only text of
    few kinds of characters without a pause fits both ways.

    Returns:
        The light, None if the stretch shows no characters; and whether it clearly shows another code.
    """
    light, other = _search_light(reader, mark_on, part := _select_informative(reader, stretch))
    if part is stretch:
        return light, other
    if light is None:
        # Some light takes the whole stretch.
        return (None, True) if other else _search_light(reader, mark_on, stretch)
    # The rest, which taught it nothing, must have such characters, too.
    rest = Stretch(stretch.counts, part.end, stretch.known_from, stretch.end)
    # Read alone, they might start at another bit.
    starts = reader.find_path(stretch, light, False)[0]
    starts = starts[starts >= part.end]
    if len(starts) >= MIN_CHARACTERS:
        found, other = _choose_light(reader, rest, [(light, starts)], _REST_FRAMED)
        if found is None:
            return None, other
    # A few characters may fit by chance: bad ones are searched in the whole stretch.
    starts = reader.find_path(part, light, False)[0]
    found, _ = _choose_light(reader, part, [(light, starts)], _NEXT_FRAMED)
    return _search_light(reader, mark_on, stretch) if found is None else (light, False)


def _select_informative(reader: CharacterReader, stretch: Stretch) -> Stretch:
    """Return the start of a stretch that is enough to learn its light from."""
    enough = int(np.searchsorted(np.cumsum(stretch.counts.sum(0)), _LEARN_EVENTS))
    end = max(enough, max(stretch.start, stretch.known_from) + _LEARN_CHARACTERS * reader.length)
    if end >= stretch.end:
        return stretch
    counts = np.ascontiguousarray(stretch.counts[:, : end + reader.length + 2 * TAIL])
    return Stretch(counts, stretch.start, stretch.known_from, end)


def _search_light(reader: CharacterReader, mark_on: bool, stretch: Stretch) -> tuple[Light | None, bool]:
    """Search a stretch for its light, in both polarities; return as `acquire_light`."""
    direct, is_other_code = _choose_light(
        reader, stretch, _learn_candidates(reader, mark_on, stretch, inverted=False)
    )
    other, _ = _choose_light(reader, stretch, _learn_candidates(reader, mark_on, stretch, inverted=True))
    if other is not None and other[1] > (direct[1] if direct else 0.0) + _INVERTED_BITS:
        return other[0], False
    return (None, is_other_code) if direct is None else (direct[0], False)


def _choose_light(
    reader: CharacterReader,
    stretch: Stretch,
    learned: list[tuple[Light, Ticks]],
    least_framed: float = _FRAMED,
) -> tuple[tuple[Light, float] | None, bool]:
    """Choose the light that explains most and has characters of the format.

    Returns:
        The light and the evidence for its characters' fixed bits, bits, None if no light fits; and whether
        the one that explains most is clearly of another code.
    """
    if not learned:
        return None, False
    # Lights are compared with the same weight of an event.
    least = min(light.share for light, _ in learned)
    scores = [_score_light(reader, stretch, replace(light, most=least), at) for light, at in learned]
    both = bool(stretch.counts.any(1).all())
    # A light shifted by a bit explains the events of text, but not its stop bits, as another clearly may.
    is_other_code, dim = False, None
    for rank, k in enumerate(np.argsort(scores)[::-1].tolist()):
        light, starts = learned[k]
        evidence = reader.compute_evidence(stretch, light)[starts[:, None] + reader.bit_offsets(light)]
        if light.inverted:
            kinds = np.unique(reader.characters.likelihoods(evidence).argmax(1))
            if len(kinds) < _INVERTED_KINDS:
                continue
        frame_bits = float(reader.characters.frame_evidence(evidence).sum() / np.log(2))
        clearness = reader.characters.clearness(evidence)
        fixed = (reader.characters.bits - reader.characters.data_bits) * len(evidence)
        # Rises or falls alone do not tell: the evidence of the others is missing.
        is_clear = both and clearness > _CLEAR
        is_unframed = is_clear and frame_bits < (_NEXT_FRAMED if rank else least_framed) * clearness * fixed
        # Even of a dim light, characters are never that much less likely than unframed bits.
        is_unframed |= both and frame_bits < -_UNFRAMED_BITS
        if is_clear and not is_unframed:
            return (light, frame_bits), False
        if rank == 0:
            is_other_code, dim = is_unframed, None if is_unframed else (light, frame_bits)
    # A dim light is taken if none is clear.
    return dim, is_other_code


def _learn_candidates(
    reader: CharacterReader, mark_on: bool, stretch: Stretch, inverted: bool
) -> list[tuple[Light, Ticks]]:
    """Learn candidates for the light, with the polarity of the link or inverted, and their characters."""
    tried: list[tuple[float, Light]] = []

    def try_light(light: Light) -> None:
        starts = reader.find_path(stretch, light, True)[0]
        tried.append((_score_light(reader, stretch, light, starts), light))
        tried.sort(key=lambda one: -one[0])

    line = _find_clock(stretch.counts)
    for light in guess_lights(stretch.counts, mark_on != inverted):
        try_light(replace(light, inverted=inverted, rate=line or 1.0))
    for _, light in tried[:_TRIED]:
        for off in () if line else _CLOCKS:
            try_light(replace(light, rate=1 + off))
    learned = []
    for _, light in tried[:_TRIED]:
        for turn in range(_ROUNDS):
            starts, evidence, _ = reader.find_path(stretch, light, True)
            if turn in (0, 2):
                light = _align_bursts(reader, stretch, light, starts, evidence)
                starts, evidence, _ = reader.find_path(stretch, light, True)
            light = reader.learn_light(stretch, light, starts, evidence, 0.0)
        starts, _, score = reader.find_path(stretch, light, False)
        if score > 0 and _cross_validate(reader, stretch, light) > 0:
            learned.append((light, starts))
    return learned


def _find_clock(counts: NDArray[np.int32]) -> float | None:
    """Return the length of a bit by the line in the spectrum of edges, None without one."""
    size = _OVERSAMPLING * counts.shape[1]
    power = (np.abs(np.fft.rfft(counts, size)) ** 2).sum(0)
    first, last = (int(size / (TICKS * (1 + off))) for off in (CLOCK_SHARE, -CLOCK_SHARE))
    band = power[first : last + 1]
    top = int(band.argmax())
    return size / (TICKS * (first + top)) if band[top] > _LINE * np.median(band) else None


def _align_bursts(
    reader: CharacterReader, stretch: Stretch, light: Light, starts: Ticks, evidence: Floats
) -> Light:
    """Shift the start of bits so that events tell most of them, with each burst in the window of its bit."""
    if len(starts) < MIN_CHARACTERS:
        return light
    found = []
    known = reader.estimate_contexts(light, starts, evidence)
    for shift in _SHIFTS:
        windows, contexts = reader.extract_bits(stretch, light, starts, known, shift)
        learned = light.learn(windows, contexts, 0.0, light.rate)
        found.append((learned.mutual_information(windows, contexts), learned))
    most = max(score for score, _ in found)
    most -= _SHIFT_TOLERANCE * abs(most)
    return [learned for score, learned in found if score >= most][-1]


def _cross_validate(reader: CharacterReader, stretch: Stretch, light: Light) -> float:
    """Return the score of each half of a stretch by the light learned from the other, summed."""
    starts, evidence, _ = reader.find_path(stretch, light, False)
    half = len(starts) // 2
    if half < MIN_CHARACTERS:
        return -np.inf
    middle = int(starts[half])
    total = -_MIN_WORTH * len(starts)
    parts = (starts[:half], middle, stretch.end), (starts[half:], stretch.start, middle)
    for known, begin, end in parts:
        learned = reader.learn_light(stretch, light, known, evidence, 0.0)
        part = Stretch(stretch.counts, begin, stretch.known_from, end)
        total += _score_light(reader, part, learned, reader.find_path(part, learned, False)[0])
    return total


def _score_light(reader: CharacterReader, stretch: Stretch, light: Light, starts: Ticks) -> float:
    """Return the log-likelihood ratio of the events with these characters and without any bits."""
    bits, begin = reader.characters.bits, max(stretch.start, stretch.known_from)
    starts = starts[starts + bits * TICKS <= stretch.end]
    marks = np.arange(begin, stretch.end - TICKS, TICKS)
    before = np.searchsorted(starts, marks + TICKS) - 1
    if len(starts):
        marks = marks[(before < 0) | (marks >= starts[before] + reader.length * light.rate)]
    places = (starts[:, None] + reader.bit_offsets(light)).ravel()
    at = np.concatenate([places, marks])
    windows = stretch.windows[at].astype(np.float64)
    ratios = light.likelihood_ratios(windows)
    words = ratios[: len(places)].reshape(len(starts), bits, CONTEXTS)
    score = log_sum_exp(reader.characters.likelihoods(words)) - reader.characters.data_bits * np.log(2)
    return float(score.sum() + ratios[len(places) :, -1].sum())
