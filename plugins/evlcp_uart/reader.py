"""Characters of a stretch by a light that is known, and what they teach of it."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evlcp_uart.characters import Characters
from evlcp_uart.light import CONTEXTS, EARLY, LOG_GAINS, OUTLIER, TICKS, Floats, Light, Ticks, log_sums

_JITTER, NEAR = 0.7, 2
"""What a tick early or late costs a character that follows another at once, and how many that may be."""

_PAUSE_TICKS = 5.0
"""Ticks over which a pause of the length that is sent is spread, twice: half of all pauses are taken as such,
each tick early or late as likely as `_JITTER` says. The others may end at any tick."""

CLOCK_SHARE = 0.025
"""Share by which the clock may be off."""

_RATES = np.linspace(-0.012, 0.012, 13)
"""Clocks that are tried about the one that is known."""

_LEAST_SPACINGS = 6
"""Characters that follow another at once, from which the clock is measured."""

TAIL = 2 * TICKS
"""Ticks behind a character that its bits' windows may need."""

LEAST_CHARACTERS = 3
"""Fewer tell nothing of a light."""

_OTHERWISE = 3.0
"""Nats by which a stream's first characters must be likelier than the best reading without them, odds of
twenty: what was on air before the first event is unknown, and any bit that is 0 may be a start bit."""

_STEADY = 6
"""Characters before and behind one that tell when it starts, where they follow one another at once."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Some of a stream.

    Attributes:
        counts: Events of each tick, OFF and ON, int32 (2, n).
        start: Tick before which no character may start.
        seen: Tick before which nothing is known.
        end: The same behind it.
    """

    counts: NDArray[np.int32]
    start: int
    seen: int
    end: int

    @property
    def windows(self) -> NDArray[np.int32]:
        """The events of a bit that begins at each tick, int32 (n - TICKS + 1, 2, TICKS), a view."""
        return np.lib.stride_tricks.sliding_window_view(self.counts, TICKS, 1).transpose(1, 0, 2)


@dataclass(frozen=True)
class CharacterReader:
    """Reads characters of one format.

    Args:
        characters: Their format.
        pause_bits: Pause that is sent before a packet; 0 where nothing is known of it.
    """

    characters: Characters
    pause_bits: int = 0

    @property
    def length(self) -> int:
        """Ticks of a character."""
        return self.characters.bits * TICKS

    def places(self, light: Light) -> Ticks:
        """Ticks from a character's start to each of its bits."""
        ticks: Ticks = np.rint(np.arange(self.characters.bits) * (TICKS * light.rate)).astype(np.int64)
        return ticks

    def evidence(self, stretch: Stretch, light: Light) -> Floats:
        """Log-likelihood of each context of a bit at every tick, float64 (n, C), 0 for mark throughout."""
        from evlcp_uart import _kernels

        counts = stretch.counts
        found = np.empty((counts.shape[1] - TICKS + 1, CONTEXTS))
        logs = np.ascontiguousarray(light.share * light.logs.transpose(1, 2, 0))
        _kernels.bit_evidence(counts, logs, LOG_GAINS, light.means, light.share, OUTLIER, found)
        # What there was before the first event, or behind the last, nothing tells.
        found[: max(stretch.seen - EARLY, 0)] = 0
        found[max(stretch.end, 0) :] = 0
        return found

    def path(self, stretch: Stretch, light: Light, likeliest: bool) -> tuple[Ticks, Floats, float]:
        """Starts of the characters, the evidence at every tick, and what the path is worth."""
        evidence = self.evidence(stretch, light)
        scores = self._scores(evidence, light, likeliest)
        starts, worth = self._best_path(scores, evidence, stretch, light)
        return self._steadied(stretch, light, starts, evidence), evidence, worth

    def _scores(self, evidence: Floats, light: Light, likeliest: bool) -> Floats:
        """How much likelier a character is at every tick than none, float64 (n,)."""
        from evlcp_uart import _kernels

        places = self.places(light)
        scores = np.empty(max(len(evidence) - int(places[-1]), 0))
        parity = ("none", "odd", "even").index(self.characters.parity)
        _kernels.character_scores(evidence, places, self.characters.data_bits, parity, likeliest, scores)
        return scores

    def _best_path(
        self, scores: Floats, evidence: Floats, stretch: Stretch, light: Light
    ) -> tuple[Ticks, float]:
        """Starts of the characters that explain a stretch best, and what that is worth."""
        from evlcp_uart import _kernels

        length = round(self.length * light.rate)
        pause = round(self.pause_bits * TICKS * light.rate)
        after_idle, after_one = light.costs
        after_pause = after_idle - (np.log(pause / _PAUSE_TICKS) if pause else 0.0)
        # The first bit of a pause has the stop bits before it, and any before these.
        contexts = np.arange((2 << self.characters.stop_bits) - 1, CONTEXTS, 2 << self.characters.stop_bits)
        tails = log_sums(evidence[:, contexts]) - np.log(len(contexts))
        starts, worth = _kernels.best_path(
            scores, tails, length, stretch.start, NEAR, after_idle, after_one, _JITTER, pause, after_pause
        )
        return starts, float(worth)

    def count_ambiguous(
        self, stretch: Stretch, light: Light, starts: Ticks, evidence: Floats, worth: float
    ) -> int:
        """How many of the first characters, that start there, a reading without them explains nearly as well.

        Some at most: where light is so dim that more do not stand out, their quality says so.
        """
        scores = self._scores(evidence, light, False)
        most = min(len(starts), LEAST_CHARACTERS - 1)
        for many, start in enumerate(starts[:most].tolist()):
            # Half a bit from here a character is another one.
            other = scores.copy()
            other[max(start - TICKS // 2, 0) : start + TICKS // 2 + 1] = -np.inf
            if worth - self._best_path(other, evidence, stretch, light)[1] >= _OTHERWISE:
                return many
        return most

    def _steadied(self, stretch: Stretch, light: Light, starts: Ticks, evidence: Floats) -> Ticks:
        """Starts as their events and those of the characters around tell them, where these follow at once.

        The evidence of a bit knows its word, and hardly when it begins: it is bounded by what else may come.
        """
        if not len(starts):
            return starts
        length = self.length * light.rate
        most = stretch.counts.shape[1] - TICKS - 1
        places = self.places(light)
        values = self.characters.likelihoods(evidence[starts[:, None] + places]).argmax(1)
        logs = light.logs - np.log(light.rates.mean((0, 2)))[None, :, None]
        logs = logs[self.characters.contexts[values]]
        seen = stretch.windows
        found = starts.copy()
        breaks = np.flatnonzero(np.abs(np.diff(starts) - length) > NEAR + 1) + 1
        shifts = np.arange(-NEAR - 1, NEAR + 2)
        for run in np.split(np.arange(len(starts)), breaks):
            begun = starts[run] - length * np.arange(len(run))
            mean = _around(begun[:, None])[:, 0] / _around(np.ones((len(run), 1)))[:, 0]
            at = np.rint(mean + length * np.arange(len(run))).astype(np.int64)[:, None] + shifts
            windows = seen[np.clip(at[:, :, None] + places, 0, most)].reshape(len(run), len(shifts), -1)
            fit = (windows @ logs[run].reshape(len(run), -1, 1))[..., 0]
            best = at[np.arange(len(run)), _around(fit).argmax(1)]
            found[run] = np.clip(best, 0, len(evidence) - 1 - int(places[-1]))
        return found

    def learn(self, stretch: Stretch, light: Light, starts: Ticks, evidence: Floats, memory: float) -> Light:
        """What characters that were read teach of the light."""
        if len(starts) < LEAST_CHARACTERS:
            return light
        rate = self._rate(light, starts, evidence, memory)
        windows, contexts = self.bits(stretch, light, starts, self.contexts(light, starts, evidence))
        light = light.learn(windows, contexts, memory, rate)
        apart = np.diff(starts) - self.length * light.rate
        late = apart[(np.abs(apart) > NEAR + 1) & (apart < 2 * self.length)]
        paused = len(late), float(late.sum()), len(apart)
        sums = [memory * old + new for old, new in zip(light.paused, paused, strict=True)]
        return replace(light, paused=(sums[0], sums[1], sums[2]))

    def contexts(self, light: Light, starts: Ticks, evidence: Floats) -> Floats:
        """How likely each bit of characters that were read is of each context, float64 (bits, C)."""
        likelihoods = self.characters.likelihoods(evidence[starts[:, None] + self.places(light)])
        weights = np.exp(likelihoods - likelihoods.max(1, keepdims=True))
        weights /= weights.sum(1, keepdims=True)
        of_words = self.characters.contexts
        contexts = np.stack([weights @ (of_words == context) for context in range(CONTEXTS)], 2)
        return contexts.reshape(-1, CONTEXTS)

    def bits(
        self, stretch: Stretch, light: Light, starts: Ticks, contexts: Floats, shift: int = 0
    ) -> tuple[Floats, Floats]:
        """The bits of characters that were read, of known contexts, `shift` ticks later than they were.

        Returns:
            Their events, float64 (n, 2, TICKS), and how likely each is of each context, float64 (n, C).
        """
        at = (starts[:, None] + self.places(light) + shift).ravel()
        inside = (at >= 0) & (at + TICKS <= stretch.end) & (at + EARLY >= stretch.seen)
        windows = stretch.windows[at[inside]].astype(np.float64)
        return windows, contexts[inside]

    def _rate(self, light: Light, starts: Ticks, evidence: Floats, memory: float) -> float:
        """The length of a bit by which the characters that were read are likeliest."""
        weight = memory * light.learned
        apart = np.diff(starts)
        at_once = np.abs(apart - self.length * light.rate) <= NEAR + 1
        if (many := int(at_once.sum())) >= _LEAST_SPACINGS:
            # One behind the other they tell the clock better than their edges do.
            runs = np.cumsum(~at_once)[at_once]
            spacings, ticks = np.bincount(runs), np.bincount(runs, apart[at_once])
            rate = float(spacings @ ticks / (spacings @ spacings * self.length))
            gain = 4 * many / (4 * many + weight / 12)
        else:
            many = self.characters.bits * len(starts)
            gain = many / (many + weight)
            rate = self._likeliest_rate(
                light, starts, evidence, light.rate + _RATES * (1.0 if gain > 0.5 else 0.3)
            )
        return float(np.clip(light.rate + gain * (rate - light.rate), 1 - CLOCK_SHARE, 1 + CLOCK_SHARE))

    def _likeliest_rate(self, light: Light, starts: Ticks, evidence: Floats, rates: Floats) -> float:
        """That of some, or between them, by which the characters are likeliest."""
        at = np.clip(starts[:, None] + self.places(light), 0, len(evidence) - 1)
        contexts = self.characters.contexts[self.characters.likelihoods(evidence[at]).argmax(1)]
        worth = []
        for rate in rates:
            places = self.places(replace(light, rate=float(rate)))
            best = np.full(len(starts), -np.inf)
            for early in (-1, 0, 1):
                at = np.clip(starts[:, None] + places + early, 0, len(evidence) - 1)
                best = np.maximum(best, evidence[at, contexts].sum(1))
            worth.append(float(best.sum()))
        top = int(np.argmax(worth))
        rate = float(rates[top])
        if 0 < top < len(rates) - 1:
            left, here, right = worth[top - 1 : top + 2]
            if (bend := left - 2 * here + right) < 0:
                rate += 0.5 * (left - right) / bend * float(rates[1] - rates[0])
        return rate


def _around(values: Floats) -> Floats:
    """Sums of rows and of those near them, float64 (n, m)."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, 0)])
    k = np.arange(len(values))
    found: Floats = total[np.minimum(k + _STEADY + 1, len(values))] - total[np.maximum(k - _STEADY, 0)]
    return found
