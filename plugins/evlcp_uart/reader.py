"""Read the characters of a stretch with a known light, and learn from them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evlcp_uart import _kernels
from evlcp_uart.characters import Characters
from evlcp_uart.light import CONTEXTS, EARLY, LOG_GAINS, OUTLIER, TICKS, Floats, Light, Ticks, log_sum_exp

_JITTER, NEAR = 0.7, 2
"""Cost of a tick by which a character follows another early or late, and how many such ticks there may be."""

_PAUSE_TICKS = 5.0
"""Spread of the length of stated pauses, ticks, twice: half of all pauses are taken to have it, with
`_JITTER` for each tick early or late; others may end at any tick."""

CLOCK_SHARE = 0.025
"""Most relative error of the clock."""

_RATES = np.linspace(-0.012, 0.012, 13)
"""Clock errors to try around the known one."""

_MIN_SPACINGS = 6
"""Least spacings of successive characters to measure the clock by."""

TAIL = 2 * TICKS
"""Ticks after a character that the windows of its bits may need."""

MIN_CHARACTERS = 3
"""Least characters to learn a light from."""

_MIN_MARGIN = 3.0
"""Nats by which a stream's first characters must be likelier than the best path without them, odds of twenty:
the bits before the first event are unknown, and any 0 may be a start bit."""

_NEIGHBOURS = 6
"""Successive characters on either side that help to align the start of one."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """A stretch of a stream.

    Attributes:
        counts: Events of each tick, OFF and ON, int32 (2, n).
        start: Tick before which no character may start.
        known_from: First tick whose events are known.
        end: End of the known ticks.
    """

    counts: NDArray[np.int32]
    start: int
    known_from: int
    end: int

    @property
    def windows(self) -> NDArray[np.int32]:
        """The events of a bit that starts at each tick, int32 (n - TICKS + 1, 2, TICKS), a view."""
        return np.lib.stride_tricks.sliding_window_view(self.counts, TICKS, 1).transpose(1, 0, 2)


@dataclass(frozen=True)
class CharacterReader:
    """Reads characters of one format, with a pause before each packet; `pause_bits` is 0 if it is unknown."""

    characters: Characters
    pause_bits: int = 0

    @property
    def length(self) -> int:
        """Ticks of a character."""
        return self.characters.bits * TICKS

    def bit_offsets(self, light: Light) -> Ticks:
        """Return the ticks from a character's start to each of its bits."""
        ticks: Ticks = np.rint(np.arange(self.characters.bits) * (TICKS * light.rate)).astype(np.int64)
        return ticks

    def compute_evidence(self, stretch: Stretch, light: Light) -> Floats:
        """Return log-likelihoods of the contexts of a bit at every tick, float64 (n, C), 0 for all mark."""
        counts = stretch.counts
        found = np.empty((counts.shape[1] - TICKS + 1, CONTEXTS))
        logs = np.ascontiguousarray(light.share * light.logs.transpose(1, 2, 0))
        _kernels.compute_bit_evidence(counts, logs, LOG_GAINS, light.means, light.share, OUTLIER, found)
        # There is no evidence before the first event and after the last.
        found[: max(stretch.known_from - EARLY, 0)] = 0
        found[max(stretch.end, 0) :] = 0
        return found

    def find_path(self, stretch: Stretch, light: Light, likeliest: bool) -> tuple[Ticks, Floats, float]:
        """Return the starts of the characters, the evidence at every tick, and the score of the path."""
        evidence = self.compute_evidence(stretch, light)
        scores = self._score_characters(evidence, light, likeliest)
        starts, score = self._find_best_path(scores, evidence, stretch, light)
        return self._align_starts(stretch, light, starts, evidence), evidence, score

    def _score_characters(self, evidence: Floats, light: Light, likeliest: bool) -> Floats:
        """Return the log-likelihood ratio of a character and none at every tick, float64 (n,)."""
        places = self.bit_offsets(light)
        scores = np.empty(max(len(evidence) - int(places[-1]), 0))
        parity = ("none", "odd", "even").index(self.characters.parity)
        _kernels.score_characters(evidence, places, self.characters.data_bits, parity, likeliest, scores)
        return scores

    def _find_best_path(
        self, scores: Floats, evidence: Floats, stretch: Stretch, light: Light
    ) -> tuple[Ticks, float]:
        length = round(self.length * light.rate)
        pause = round(self.pause_bits * TICKS * light.rate)
        after_idle, after_one = light.costs
        after_pause = after_idle - (np.log(pause / _PAUSE_TICKS) if pause else 0.0)
        # Before the first bit of a pause there are stop bits, and any bits before these.
        contexts = np.arange((2 << self.characters.stop_bits) - 1, CONTEXTS, 2 << self.characters.stop_bits)
        tails = log_sum_exp(evidence[:, contexts]) - np.log(len(contexts))
        starts, score = _kernels.find_best_path(
            scores, tails, length, stretch.start, NEAR, after_idle, after_one, _JITTER, pause, after_pause
        )
        return starts, float(score)

    def count_ambiguous(
        self, stretch: Stretch, light: Light, starts: Ticks, evidence: Floats, score: float
    ) -> int:
        """Count the first characters without which the best path explains a stretch nearly as well.

        They are a few at most; the quality of later ones shows if light is dim.
        """
        scores = self._score_characters(evidence, light, False)
        most = min(len(starts), MIN_CHARACTERS - 1)
        for many, start in enumerate(starts[:most].tolist()):
            # Beyond half a bit it is another character.
            other = scores.copy()
            other[max(start - TICKS // 2, 0) : start + TICKS // 2 + 1] = -np.inf
            if score - self._find_best_path(other, evidence, stretch, light)[1] >= _MIN_MARGIN:
                return many
        return most

    def _align_starts(self, stretch: Stretch, light: Light, starts: Ticks, evidence: Floats) -> Ticks:
        """Align starts by the events of each character and its successive neighbours.

        The evidence shows the word of a character, but hardly its start, as it is limited by outliers.
        """
        if not len(starts):
            return starts
        length = self.length * light.rate
        most = stretch.counts.shape[1] - TICKS - 1
        places = self.bit_offsets(light)
        values = self.characters.likelihoods(evidence[starts[:, None] + places]).argmax(1)
        logs = light.logs - np.log(light.rates.mean((0, 2)))[None, :, None]
        logs = logs[self.characters.contexts[values]]
        found = starts.copy()
        breaks = np.flatnonzero(np.abs(np.diff(starts) - length) > NEAR + 1) + 1
        shifts = np.arange(-NEAR - 1, NEAR + 2)
        for run in np.split(np.arange(len(starts)), breaks):
            phases = starts[run] - length * np.arange(len(run))
            mean = _sum_neighbours(phases[:, None])[:, 0] / _sum_neighbours(np.ones((len(run), 1)))[:, 0]
            at = np.rint(mean + length * np.arange(len(run))).astype(np.int64)[:, None] + shifts
            windows = stretch.windows[np.clip(at[:, :, None] + places, 0, most)]
            windows = windows.reshape(len(run), len(shifts), -1)
            fit = (windows @ logs[run].reshape(len(run), -1, 1))[..., 0]
            best = at[np.arange(len(run)), _sum_neighbours(fit).argmax(1)]
            found[run] = np.clip(best, 0, len(evidence) - 1 - int(places[-1]))
        return found

    def learn_light(
        self, stretch: Stretch, light: Light, starts: Ticks, evidence: Floats, memory: float
    ) -> Light:
        """Return the light with what these characters teach."""
        if len(starts) < MIN_CHARACTERS:
            return light
        rate = self._estimate_rate(light, starts, evidence, memory)
        windows, contexts = self.extract_bits(
            stretch, light, starts, self.estimate_contexts(light, starts, evidence)
        )
        light = light.learn(windows, contexts, memory, rate)
        gaps = np.diff(starts) - self.length * light.rate
        late = gaps[(np.abs(gaps) > NEAR + 1) & (gaps < 2 * self.length)]
        paused = len(late), float(late.sum()), len(gaps)
        sums = [memory * old + new for old, new in zip(light.paused, paused, strict=True)]
        return replace(light, paused=(sums[0], sums[1], sums[2]))

    def estimate_contexts(self, light: Light, starts: Ticks, evidence: Floats) -> Floats:
        """Return how likely each bit of these characters is of each context, float64 (bits, C)."""
        likelihoods = self.characters.likelihoods(evidence[starts[:, None] + self.bit_offsets(light)])
        weights = np.exp(likelihoods - likelihoods.max(1, keepdims=True))
        weights /= weights.sum(1, keepdims=True)
        of_words = self.characters.contexts
        contexts = np.stack([weights @ (of_words == context) for context in range(CONTEXTS)], 2)
        return contexts.reshape(-1, CONTEXTS)

    def extract_bits(
        self, stretch: Stretch, light: Light, starts: Ticks, contexts: Floats, shift: int = 0
    ) -> tuple[Floats, Floats]:
        """Return the known bits of these characters, `shift` ticks later.

        Returns:
            Their events, float64 (n, 2, TICKS), and how likely each is of each context, float64 (n, C).
        """
        at = (starts[:, None] + self.bit_offsets(light) + shift).ravel()
        inside = (at >= 0) & (at + TICKS <= stretch.end) & (at + EARLY >= stretch.known_from)
        windows = stretch.windows[at[inside]].astype(np.float64)
        return windows, contexts[inside]

    def _estimate_rate(self, light: Light, starts: Ticks, evidence: Floats, memory: float) -> float:
        weight = memory * light.learned_bits
        gaps = np.diff(starts)
        at_once = np.abs(gaps - self.length * light.rate) <= NEAR + 1
        if (many := int(at_once.sum())) >= _MIN_SPACINGS:
            # Their spacing shows the clock better than their edges do.
            runs = np.cumsum(~at_once)[at_once]
            spacings, ticks = np.bincount(runs), np.bincount(runs, gaps[at_once])
            rate = float(spacings @ ticks / (spacings @ spacings * self.length))
            gain = 4 * many / (4 * many + weight / 12)
        else:
            many = self.characters.bits * len(starts)
            gain = many / (many + weight)
            rate = self._find_likeliest_rate(
                light, starts, evidence, light.rate + _RATES * (1.0 if gain > 0.5 else 0.3)
            )
        return float(np.clip(light.rate + gain * (rate - light.rate), 1 - CLOCK_SHARE, 1 + CLOCK_SHARE))

    def _find_likeliest_rate(self, light: Light, starts: Ticks, evidence: Floats, rates: Floats) -> float:
        """Return the likeliest of some rates, refined by a parabola."""
        at = np.clip(starts[:, None] + self.bit_offsets(light), 0, len(evidence) - 1)
        contexts = self.characters.contexts[self.characters.likelihoods(evidence[at]).argmax(1)]
        score = []
        for rate in rates:
            places = self.bit_offsets(replace(light, rate=float(rate)))
            best = np.full(len(starts), -np.inf)
            for early in (-1, 0, 1):
                at = np.clip(starts[:, None] + places + early, 0, len(evidence) - 1)
                best = np.maximum(best, evidence[at, contexts].sum(1))
            score.append(float(best.sum()))
        top = int(np.argmax(score))
        rate = float(rates[top])
        if 0 < top < len(rates) - 1:
            left, here, right = score[top - 1 : top + 2]
            if (curvature := left - 2 * here + right) < 0:
                rate += 0.5 * (left - right) / curvature * float(rates[1] - rates[0])
        return rate


def _sum_neighbours(values: Floats) -> Floats:
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, 0)])
    k = np.arange(len(values))
    found: Floats = (
        total[np.minimum(k + _NEIGHBOURS + 1, len(values))] - total[np.maximum(k - _NEIGHBOURS, 0)]
    )
    return found
