"""What a decoder knows of the light and of the pixels that see it: events by the bits around them."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ticks = NDArray[np.int64]

TICKS = 16
"""Ticks of a bit."""

BEFORE = 3
"""Bits before one that its events depend on."""

CONTEXTS = 2 << BEFORE
"""Contexts of a bit: the number whose binary digits are those before it and the bit itself, 1 for mark."""

EARLY = 3
"""Tick of a bit at which the first events of its edge come: where an edge is, only events tell."""

GAINS = np.array([0.02, 0.25, 0.5, 1.0, 2.0, 4.0])
LOG_GAINS = np.log(GAINS)
_SHARES = np.array([0.02, 0.12, 0.2, 0.4, 0.2, 0.06])
"""Windows of a context are unlike in strength: by its mean, and how likely each is before any are seen."""

OUTLIER = 2e-3
"""Probability that the events of a bit are of something else."""

_PRIOR_WINDOWS, _PRIOR_GAINS = 3.0, 12.0
"""Windows of a context for which those with the same last bits stand, and for which the shares do."""

_ENOUGH = 30.0
"""Events of a window that tell all that it says: of more, each counts less, as pixels share the light."""

_COUNTED = 0.85
"""What an event counts at most: light is learned from the very bits that are read by it, and a pixel's events
hang together."""

_FLOOR = 0.004
"""Share of the mean events of a tick that may come in any."""

_BLUR = np.array([1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0]) / 16
"""What is learned of a tick tells of those beside it: cameras read events out in bursts, and a character's
start is known to a tick or two. Without it bits would be distinguished by when their events were read out."""

_QUARTER, _STEADY_SHARE = TICKS // 4, 0.4
"""Ticks of a quarter of a bit, and the share of these that are surely without a burst: what comes in them is
of something else."""

_PAUSES = 6.0
"""Characters for which a stream without pauses stands."""


@dataclass(frozen=True, eq=False)
class Light:
    """What is known, as sums over the bits that were read, those long ago counting less.

    Attributes:
        events: Events of each context, by polarity and tick, OFF and ON, float64 (C, 2, TICKS).
        windows: Bits of each context, each by its gain, float64 (C,).
        gains: Bits of each context and gain, float64 (C, J).
        rate: Length of a bit against the nominal one.
        paused: Characters behind a pause, their ticks of pause in all, and characters.
        most: What an event counts at most.
        inverted: It is on when the link has it off, and off when on.
    """

    events: Floats
    windows: Floats
    gains: Floats
    rate: float = 1.0
    paused: tuple[float, float, float] = (0.0, 0.0, 0.0)
    most: float = _COUNTED
    inverted: bool = False

    @property
    def learned(self) -> float:
        """Bits that it was learned from."""
        return float(self.windows.sum())

    @cached_property
    def rates(self) -> Floats:
        """Mean events of each context, by polarity and tick, at a gain of one, float64 (C, 2, TICKS)."""
        mean = self.events.sum(0) / max(float(self.windows.sum()), 1.0)
        bits = self.gains.sum(1)
        found = mean[None]
        for depth in range(1, BEFORE + 2):
            # Those with one more bit before, where there are too few of them stand those without.
            events = self.events.reshape(-1, 1 << depth, 2, TICKS).sum(0)
            windows = self.windows.reshape(-1, 1 << depth).sum(0)
            many = bits.reshape(-1, 1 << depth).sum(0)
            # Windows count by their gain: where bits are silent as a rule, those of the prior do, too.
            known = _PRIOR_WINDOWS * np.where(many > 0, windows / np.maximum(many, 1e-9), 1.0)
            known = np.maximum(known, _PRIOR_WINDOWS * GAINS[0])
            prior = np.tile(found, (2, 1, 1))
            found = (events + known[:, None, None] * prior) / (windows + known)[:, None, None]
        floor = _FLOOR * float(mean.mean()) + 1e-5
        rates: Floats = _smooth(found) + floor
        return rates

    @cached_property
    def share(self) -> float:
        """What an event counts."""
        # What comes in every context is of something else than the light.
        informative = self.rates - self.rates.min(0)
        return min(self.most, _ENOUGH / max(float(informative.sum((1, 2)).max()), 1e-9))

    @cached_property
    def logs(self) -> Floats:
        """Logarithm of the rates, float64 (C, 2, TICKS)."""
        found: Floats = np.log(self.rates)
        return found

    @cached_property
    def means(self) -> Floats:
        """What a window costs by context and gain: its mean events, by what they count, and the gain.

        float64 (C, J).
        """
        shares = self.gains + _PRIOR_GAINS * _SHARES
        shares /= shares.sum(1, keepdims=True)
        found: Floats = self.rates.sum((1, 2))[:, None] * GAINS * self.share - np.log(shares)
        return found

    @property
    def costs(self) -> tuple[float, float]:
        """What a character costs after a pause and at once after another."""
        paused, ticks, many = self.paused
        share = (paused + 0.02) / (many + _PAUSES)
        length = (ticks + 4 * TICKS) / (paused + 1)
        after_idle = float(np.clip(np.log(length / share), 10.0, 12.0))
        return after_idle, float(np.clip(-np.log(1 - share), 0.1, 3.0)) if many else 1.0

    def of_context(self, windows: Floats) -> tuple[Floats, Floats, Ticks]:
        """Log-likelihood of windows by context, over gains, and how likely each gain is.

        What the gains make of a window depends on how many events it has, not on when they come.

        Args:
            windows: Whole numbers of events, float64 (n, 2, TICKS).

        Returns:
            Log-likelihoods, float64 (n, C); of each number of events how likely each gain is, by context,
            float64 (m, C, J); and which of these numbers a window has, int64 (n,).
        """
        flat = windows.reshape(len(windows), -1)
        events, which = np.unique(flat.sum(1), return_inverse=True)
        worth = events[:, None, None] * (self.share * LOG_GAINS) - self.means
        over = log_sums(worth)
        alike = np.einsum("nk,ck->nc", flat, self.share * self.logs.reshape(CONTEXTS, -1))
        return alike + over[which], np.exp(worth - over[..., None]), which

    def beside_mean(self, windows: Floats) -> Floats:
        """Log-likelihood of windows, float64 (n, 2, TICKS), of each context beside steady events, (n, C)."""
        share = self.windows / self.windows.sum()
        mean = np.einsum("c,cpt->p", share, self.rates)[:, None] / TICKS * np.ones(TICKS)
        gains = self.gains.sum(0) + _PRIOR_GAINS * _SHARES
        costs = mean.sum() * GAINS * self.share - np.log(gains / gains.sum())
        flat = windows.reshape(len(windows), -1)
        alike = np.einsum("nk,k->n", flat, np.log(mean).ravel())
        worth = self.share * (alike[:, None] + flat.sum(1)[:, None] * LOG_GAINS) - costs
        return self.of_context(windows)[0] - log_sums(worth)[:, None]

    def explained(self, windows: Floats, contexts: Floats) -> float:
        """How much the events of bits tell of their contexts, in all: their mutual information.

        Args:
            windows: Events of each bit, float64 (n, 2, TICKS).
            contexts: How likely each is of each context, float64 (n, C).
        """
        likely = _likely(self.of_context(windows)[0])
        any_of = likely @ contexts.mean(0)
        found: float = (contexts * np.log(likely + 1e-300)).sum() - np.log(any_of + 1e-300).sum()
        return found

    def learn(self, windows: Floats, contexts: Floats, memory: float, rate: float) -> "Light":
        """With what more bits teach.

        Args:
            windows: Events of each bit, float64 (n, 2, TICKS).
            contexts: How likely each is of each context, float64 (n, C).
            memory: What all before counts.
            rate: Length of a bit against the nominal one.
        """
        logs, gains, which = self.of_context(windows)
        likely = _likely(logs)
        # What is rather something else than a bit of that context teaches nothing of it.
        fits = (1 - OUTLIER) * likely / likely.max(1, keepdims=True)
        contexts = contexts * fits / (fits + OUTLIER)
        at = (which[:, None] * CONTEXTS + np.arange(CONTEXTS)).ravel()
        by_events = np.bincount(at, contexts.ravel(), len(gains) * CONTEXTS).reshape(-1, CONTEXTS)
        of_gains = np.einsum("mc,mcj->cj", by_events, gains)
        return Light(
            memory * self.events + np.einsum("nc,npt->cpt", contexts, windows),
            memory * self.windows + of_gains @ GAINS,
            memory * self.gains + of_gains,
            rate,
            self.paused,
            inverted=self.inverted,
        )


def guesses(counts: NDArray[np.int32], mark_on: bool) -> Iterator[Light]:
    """What the light may be like, before anything is known.

    Args:
        counts: Events of each tick, OFF and ON, int32 (2, n).
        mark_on: The light is on for a mark.
    """
    n = counts.shape[1]
    ticks = np.arange(2 * TICKS)
    total = counts.sum(1) + 1.0
    # In half of the quarters of bits there is no edge's burst, whatever is sent.
    quarters = counts[:, : n - n % _QUARTER].reshape(2, -1, _QUARTER).sum(2)
    steady = np.quantile(quarters, _STEADY_SHARE, axis=1) / _QUARTER
    noise = np.maximum(np.maximum(0.2 * total / n, steady), 1e-3)
    # A rise in four bits or so.
    events = np.maximum((total - np.maximum(steady - 0.2 * total / n, 0.0) * n) / (n / TICKS / 4), 1.0)
    shares = np.tile(2 * _SHARES, (CONTEXTS, 1))
    for glow, trail, lates in (
        (0.0, 0.0, (-1.0, -0.5, 0.0, 0.5, 1.0)),
        (0.4, 0.0, (-0.5, 0.0, 0.5)),
        (0.0, 0.25, (-0.5, 0.0, 0.5)),
    ):
        for width in (0.12, 0.5):
            for later in lates:
                rates = np.empty((CONTEXTS, 2, TICKS))
                for on, shift in enumerate((max(-later, 0.0), max(later, 0.0))):
                    after = (ticks - EARLY) / TICKS - shift
                    burst = np.where(after >= 0, np.exp(-np.maximum(after, 0) / width), 0.02)
                    burst *= events[on] / burst.sum()
                    for context in range(CONTEXTS):
                        bits = [
                            bit if mark_on else 1 - bit
                            for bit in (context >> 2, context >> 1 & 1, context & 1)
                        ]
                        rates[context, on] = noise[on]
                        if bits[2] == on and bits[1] != on:
                            rates[context, on] += burst[:TICKS]
                        elif bits == [1 - on, on, on]:
                            rates[context, on] += burst[TICKS:]
                        # A light that moves, or shimmers, wakes events of both polarities while it is on.
                        rates[context, on] += glow * bits[2] * events[on] / TICKS
                        # Bright pixels go on and on after an edge.
                        rates[context, on] += trail * (bits[2] == bits[1] == on) * events[on] / TICKS
                yield Light(2 * rates, np.full(CONTEXTS, 2.0), shares)


def log_sums(logs: Floats) -> Floats:
    """Logarithms of sums along the last axis, from logarithms, of which one at least is finite."""
    top = logs.max(-1, keepdims=True)
    found: Floats = np.log(np.einsum("...j->...", np.exp(logs - top))) + top[..., 0]
    return found


def _likely(logs: Floats) -> Floats:
    """Likelihoods from their logarithms, float64 (n, C), the greatest of each window 1."""
    likely: Floats = np.exp(logs - logs.max(1, initial=-np.inf, keepdims=True))
    return likely


def _smooth(rates: Floats) -> Floats:
    padded = np.pad(rates, ((0, 0), (0, 0), (len(_BLUR) // 2,) * 2), mode="edge")
    found: Floats = np.lib.stride_tricks.sliding_window_view(padded, len(_BLUR), 2) @ _BLUR
    return found
