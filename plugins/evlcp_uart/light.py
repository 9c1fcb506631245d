"""A model of the light and of the pixels that see it: events by the bits around them."""

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
"""Earlier bits that the events of a bit depend on."""

CONTEXTS = 2 << BEFORE
"""Contexts of a bit: the number of the bits before it and the bit itself as binary digits, 1 for mark."""

EARLY = 3
"""Tick of a bit with the first events of its edge; only events show where an edge is."""

GAINS = np.array([0.02, 0.25, 0.5, 1.0, 2.0, 4.0])
LOG_GAINS = np.log(GAINS)
_SHARES = np.array([0.02, 0.12, 0.2, 0.4, 0.2, 0.06])
"""Strengths of the windows of a context relative to its mean, and their prior probabilities."""

OUTLIER = 2e-3
"""Probability that the events of a bit have another cause."""

_PRIOR_WINDOWS, _PRIOR_GAINS = 3.0, 12.0
"""Weights, in windows of a context, of those with the same last bits, and of the prior shares."""

_MAX_EVENTS = 30.0
"""Events of a window that tell all; of more, each has less weight, as pixels share the light."""

_MAX_WEIGHT = 0.85
"""Most weight of an event: light is learned from the bits that are read with it, and the events of a pixel
are correlated."""

_FLOOR = 0.004
"""Share of the mean events of a tick that may come in any."""

_BLUR = np.array([1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0]) / 16
"""Kernel to smooth rates over ticks: cameras read events out in bursts, and a character's start is known to a
tick or two. Without it bits would be distinguished by the readout times of their events."""

_QUARTER, _STEADY_SHARE = TICKS // 4, 0.4
"""Ticks of a quarter of a bit, and the share of quarters that are surely without a burst, only with noise."""

_PAUSES = 6.0
"""Weight of the prior without pauses, in characters."""


@dataclass(frozen=True, eq=False)
class Light:
    """The model, as sums over the bits read so far, older ones with less weight.

    Attributes:
        events: Events of each context, by polarity and tick, OFF and ON, float64 (C, 2, TICKS).
        windows: Bits of each context, weighted by their gains, float64 (C,).
        gains: Bits of each context and gain, float64 (C, J).
        rate: Length of a bit relative to the nominal one.
        paused: Number of characters after a pause, the sum of the pauses in ticks, and number of characters.
        most: Most weight of an event.
        inverted: Whether it is on when the link has it off, and off when on.
    """

    events: Floats
    windows: Floats
    gains: Floats
    rate: float = 1.0
    paused: tuple[float, float, float] = (0.0, 0.0, 0.0)
    most: float = _MAX_WEIGHT
    inverted: bool = False

    @property
    def learned_bits(self) -> float:
        """Number of bits that it was learned from."""
        return float(self.windows.sum())

    @cached_property
    def rates(self) -> Floats:
        """Mean events of each context, by polarity and tick, at a gain of one, float64 (C, 2, TICKS)."""
        mean = self.events.sum(0) / max(float(self.windows.sum()), 1.0)
        bits = self.gains.sum(1)
        found = mean[None]
        for depth in range(1, BEFORE + 2):
            # Contexts of one more bit, with those of one less as their prior.
            events = self.events.reshape(-1, 1 << depth, 2, TICKS).sum(0)
            windows = self.windows.reshape(-1, 1 << depth).sum(0)
            many = bits.reshape(-1, 1 << depth).sum(0)
            # Windows count by their gain; if bits are mostly silent, those of the prior do so, too.
            known = _PRIOR_WINDOWS * np.where(many > 0, windows / np.maximum(many, 1e-9), 1.0)
            known = np.maximum(known, _PRIOR_WINDOWS * GAINS[0])
            prior = np.tile(found, (2, 1, 1))
            found = (events + known[:, None, None] * prior) / (windows + known)[:, None, None]
        floor = _FLOOR * float(mean.mean()) + 1e-5
        padded = np.pad(found, ((0, 0), (0, 0), (len(_BLUR) // 2,) * 2), mode="edge")
        return np.lib.stride_tricks.sliding_window_view(padded, len(_BLUR), 2) @ _BLUR + floor

    @cached_property
    def share(self) -> float:
        """Weight of an event."""
        # Events of all contexts have other causes than the light.
        informative = self.rates - self.rates.min(0)
        return min(self.most, _MAX_EVENTS / max(float(informative.sum((1, 2)).max()), 1e-9))

    @cached_property
    def logs(self) -> Floats:
        """Logarithm of the rates, float64 (C, 2, TICKS)."""
        return np.log(self.rates)

    @cached_property
    def means(self) -> Floats:
        """Cost of a window by context and gain: its mean events, weighted, and the gain, float64 (C, J)."""
        shares = self.gains + _PRIOR_GAINS * _SHARES
        shares /= shares.sum(1, keepdims=True)
        found: Floats = self.rates.sum((1, 2))[:, None] * GAINS * self.share - np.log(shares)
        return found

    @property
    def costs(self) -> tuple[float, float]:
        """Costs of a character after a pause, and of one that follows another."""
        paused, ticks, many = self.paused
        share = (paused + 0.02) / (many + _PAUSES)
        length = (ticks + 4 * TICKS) / (paused + 1)
        after_idle = float(np.clip(np.log(length / share), 10.0, 12.0))
        return after_idle, float(np.clip(-np.log(1 - share), 0.1, 3.0)) if many else 1.0

    def context_likelihoods(self, windows: Floats) -> tuple[Floats, Floats, Ticks]:
        """Return log-likelihoods of windows by context, summed over gains, and the probability of each gain.

        The effect of gains depends on the number of events of a window, not on their times.

        Args:
            windows: Whole numbers of events, float64 (n, 2, TICKS).

        Returns:
            Log-likelihoods, float64 (n, C); for each number of events the probability of each gain, by
            context, float64 (m, C, J); and the index of that number for each window, int64 (n,).
        """
        flat = windows.reshape(len(windows), -1)
        events, which = np.unique(flat.sum(1), return_inverse=True)
        score = events[:, None, None] * (self.share * LOG_GAINS) - self.means
        over = log_sum_exp(score)
        alike = np.einsum("nk,ck->nc", flat, self.share * self.logs.reshape(CONTEXTS, -1))
        return alike + over[which], np.exp(score - over[..., None]), which

    def likelihood_ratios(self, windows: Floats) -> Floats:
        """Return log-likelihood ratios of windows (n, 2, TICKS) by context and as noise, float64 (n, C).

        They are limited by outliers.
        """
        share = self.windows / self.windows.sum()
        mean = np.einsum("c,cpt->p", share, self.rates)[:, None] / TICKS * np.ones(TICKS)
        gains = self.gains.sum(0) + _PRIOR_GAINS * _SHARES
        costs = mean.sum() * GAINS * self.share - np.log(gains / gains.sum())
        flat = windows.reshape(len(windows), -1)
        alike = np.einsum("nk,k->n", flat, np.log(mean).ravel())
        score = self.share * (alike[:, None] + flat.sum(1)[:, None] * LOG_GAINS) - costs
        ratios = self.context_likelihoods(windows)[0] - log_sum_exp(score)[:, None]
        return np.logaddexp(ratios, np.log(OUTLIER))

    def mutual_information(self, windows: Floats, contexts: Floats) -> float:
        """Return the mutual information of the events (n, 2, TICKS) and contexts (n, C) of bits, nats."""
        likely = _normalize_likelihoods(self.context_likelihoods(windows)[0])
        any_of = likely @ contexts.mean(0)
        found: float = (contexts * np.log(likely + 1e-300)).sum() - np.log(any_of + 1e-300).sum()
        return found

    def learn(self, windows: Floats, contexts: Floats, memory: float, rate: float) -> "Light":
        """Return the model with more bits.

        Args:
            windows: Events of each bit, float64 (n, 2, TICKS).
            contexts: Probability of each context of a bit, float64 (n, C).
            memory: Weight of all earlier bits.
            rate: Length of a bit relative to the nominal one.
        """
        logs, gains, which = self.context_likelihoods(windows)
        likely = _normalize_likelihoods(logs)
        # A window that is likelier an outlier teaches nothing of a context.
        fits = (1 - OUTLIER) * likely
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


def guess_lights(counts: NDArray[np.int32], mark_on: bool) -> Iterator[Light]:
    """Yield guesses of a light, on or off for a mark, by events of each tick, OFF and ON, int32 (2, n)."""
    n = counts.shape[1]
    ticks = np.arange(2 * TICKS)
    total = counts.sum(1) + 1.0
    # Half of the quarters of bits have no burst, whatever is sent.
    quarters = counts[:, : n - n % _QUARTER].reshape(2, -1, _QUARTER).sum(2)
    steady = np.quantile(quarters, _STEADY_SHARE, axis=1) / _QUARTER
    noise = np.maximum(np.maximum(0.2 * total / n, steady), 1e-3)
    # About one rise in four bits.
    events = np.maximum((total - np.maximum(steady - 0.2 * total / n, 0.0) * n) / (n / TICKS / 4), 1.0)
    shares = np.tile(2 * _SHARES, (CONTEXTS, 1))
    for glow, trail, delays in (
        (0.0, 0.0, (-1.0, -0.5, 0.0, 0.5, 1.0)),
        (0.4, 0.0, (-0.5, 0.0, 0.5)),
        (0.0, 0.25, (-0.5, 0.0, 0.5)),
    ):
        for width in (0.12, 0.5):
            for delay in delays:
                rates = np.empty((CONTEXTS, 2, TICKS))
                for on, shift in enumerate((max(-delay, 0.0), max(delay, 0.0))):
                    after = (ticks - EARLY) / TICKS - shift
                    burst = np.where(after >= 0, np.exp(-np.maximum(after, 0) / width), 0.02)
                    burst *= events[on] / burst.sum()
                    for context in range(CONTEXTS):
                        bits = [
                            bit if mark_on else 1 - bit
                            for bit in (context >> 2 & 1, context >> 1 & 1, context & 1)
                        ]
                        rates[context, on] = noise[on]
                        if bits[2] == on and bits[1] != on:
                            rates[context, on] += burst[:TICKS]
                        elif bits == [1 - on, on, on]:
                            rates[context, on] += burst[TICKS:]
                        # A light that moves or shimmers triggers events of both polarities while it is on.
                        rates[context, on] += glow * bits[2] * events[on] / TICKS
                        # Bright pixels send more events long after an edge.
                        rates[context, on] += trail * (bits[2] == bits[1] == on) * events[on] / TICKS
                yield Light(2 * rates, np.full(CONTEXTS, 2.0), shares)


def log_sum_exp(logs: Floats) -> Floats:
    """Return logarithms of sums along the last axis, from logarithms, at least one of them finite."""
    top = logs.max(-1, keepdims=True)
    found: Floats = np.log(np.einsum("...j->...", np.exp(logs - top))) + top[..., 0]
    return found


def _normalize_likelihoods(logs: Floats) -> Floats:
    """Return likelihoods from their logarithms, the greatest of each window 1, float64 (n, C)."""
    likely: Floats = np.exp(logs - logs.max(1, keepdims=True))
    return likely
