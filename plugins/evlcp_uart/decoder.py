"""Characters from the events of a group of pixels: a maximum-likelihood receiver that learns its light.

An edge of the light wakes a burst of events of one polarity, late by a latency that is different for each and
has a tail. What is learned from the stream itself, without training: how late, and how many, events of either
polarity come, how many there are without an edge, and how far the clock is off. With that every tick of the
stream, a sixteenth of a bit, has a log-likelihood ratio for a rise and one for a fall; a character is worth
what its edges say, and the best sequence of characters and pauses is found as a whole.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from evlcp_uart.characters import Characters

__all__ = ["Character", "CharacterDecoder", "CharacterState", "Light"]

TICKS = 16
"""Ticks of a bit."""

_REACH = 2 * TICKS
"""Ticks after an edge in which its events come: rises are two bits apart at the least, and so are falls."""

_EARLY = 3
"""Tick after an edge at which the first events come: where an edge is, only events tell."""

_BLOCK = 32
"""Characters of a stretch that is decoded at once, if they follow one another."""

_AHEAD = 4
"""Characters that are looked ahead: where one starts is known only by those after it."""

_STRENGTHS = np.array([0.25, 0.5, 1.0, 2.0])
_SHARES = np.array([0.15, 0.3, 0.4, 0.15])
"""Bursts are unlike in strength: by their mean, and how likely each is."""

_ENOUGH = 30.0
"""Events of a burst that tell all that it says: of more, each counts less, as pixels share light and motion,
and the tail of a burst is no Poisson noise."""

_LEFT = 0.3
"""Share of the events after an edge that may be taken for what bursts leave behind."""

_AFTER_IDLE, _AFTER_ONE, _JITTER, _NEAR = 12.0, 1.0, 0.7, 2
"""What a character costs after a pause and at once after another, and a tick early or late."""

_CLOCK = 0.025
"""Share by which the clock may be off."""

_RATES = np.linspace(-0.012, 0.012, 13)
"""Clocks that are tried about the one that is known."""

_LEAST_SPACINGS = 6
"""Characters that follow another at once by which the clock is told."""

_LEAST_EVENTS = 24
_LEAST_CHARACTERS = 3
_LEAST_WORTH = 6.0
"""Events of a stretch in which light is looked for; characters that it must show, and what each is worth."""

_MEMORY = 0.8
"""Weight of what was learned before against a stretch that is as full."""

_SELDOM = 8
"""Stretches in one of which light is looked for where there is none."""

_LOST = 8
"""Stretches with events and without a character after which the light is learned anew."""


@dataclass(frozen=True, eq=False)
class Light:
    """What is known of the light and of the pixels that see it.

    Attributes:
        kernels: How many of a burst's events come at each tick after an edge, rows for OFF and ON, float64
            (2, ticks); each sums up to 1.
        events: Events of a burst, OFF and ON, float64 (2,).
        noise: Events a tick without an edge, OFF and ON, float64 (2,).
        rate: Length of a bit against the nominal one.
        unseen: Share of edges without a burst.
        learned: Edges that it was learned from, with those long ago counting less.
    """

    kernels: NDArray[np.float64]
    events: NDArray[np.float64]
    noise: NDArray[np.float64]
    rate: float = 1.0
    unseen: float = 0.02
    learned: float = 0.0


@dataclass(frozen=True, eq=False)
class Character:
    """A character that was received.

    Attributes:
        t_us: Start of its start bit as the earliest events show it, us.
        value: The likeliest one, from 0.
        llr: LLRs ln P(0) / P(1) of its bits, most significant first, float32 (data_bits,).
        quality: Probability that it is right, by the edges alone.
        wrong_parity: Without the parity, other bits would be likelier.
        bit_us: Length of a bit, us.
    """

    t_us: float
    value: int
    llr: NDArray[np.float32]
    quality: float
    wrong_parity: bool
    bit_us: float


@dataclass(frozen=True, eq=False)
class CharacterState:
    """What a decoder knows of a stream.

    Attributes:
        first: Tick of the stream at which `counts` starts; None before the first event.
        counts: Events of each tick, OFF and ON, int32 (2, n).
        start: Tick before which no character may start: the last one's end.
        seen: First tick of which is known whether it has events; one before that may be a character's.
        light: What is known of the light; None before that.
        dark: Stretches with events and without a character since the last one.
        tried: Stretches with events in which light was looked for, or might have been, in vain.
        given: What was counted so far.
    """

    first: int | None = None
    counts: NDArray[np.int32] = field(default_factory=lambda: np.zeros((2, 0), np.int32))
    start: int = 0
    seen: int = 0
    light: Light | None = None
    dark: int = 0
    tried: int = 0
    given: dict[str, int] = field(
        default_factory=lambda: {"characters": 0, "characters_wrong_parity": 0, "stretches_without_light": 0}
    )


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


@dataclass(frozen=True)
class CharacterDecoder:
    """Reads characters from times and polarities, step by step.

    Args:
        characters: Their format.
        bit_us: Nominal length of a bit, us.
        mark_on: The light is on for a mark, which is 1 and idle.
    """

    characters: Characters
    bit_us: float
    mark_on: bool = True

    def init(self) -> CharacterState:
        """State before the first event."""
        return CharacterState()

    def step(
        self, state: CharacterState, t_us: NDArray[np.int64], p: NDArray[np.uint8], until_us: float
    ) -> tuple[CharacterState, list[Character]]:
        """Take the events up to a time; give the characters that are certain by then.

        Args:
            state: What `init` or the last `step` gave; not changed.
            t_us: Event times, ascending, int64 (n,).
            p: Polarities, uint8 (n,).
            until_us: All events before this time have been given.
        """
        state = self._take(state, t_us, p, until_us)
        found: list[Character] = []
        while state.counts.shape[1] >= self._block + self._ahead:
            state, more = self._decode(state, self._block)
            found += more
        return state, found

    def close(self, state: CharacterState) -> tuple[CharacterState, list[Character]]:
        """End the stream: give the characters that are left."""
        n = state.counts.shape[1]
        if state.first is None or not n:
            return state, []
        return self._decode(state, n, last=True)

    @property
    def _length(self) -> int:
        return self.characters.bits * TICKS

    @property
    def _block(self) -> int:
        return _BLOCK * self._length

    @property
    def _ahead(self) -> int:
        return _AHEAD * self._length + _REACH

    def _take(
        self, state: CharacterState, t_us: NDArray[np.int64], p: NDArray[np.uint8], until_us: float
    ) -> CharacterState:
        """Count events by tick, on a grid that stands still."""
        first = state.first
        tick_us = self.bit_us / TICKS
        if first is None:
            if not len(t_us):
                return state
            # A character may have begun before its first event.
            seen = int(t_us[0] // tick_us)
            first = seen - self._length - TICKS
            state = replace(state, seen=seen)
        ticks = np.floor_divide(t_us, tick_us).astype(np.int64) - first
        known = state.counts.shape[1]
        end = max(int(np.floor(until_us / tick_us)) - first, known, int(ticks[-1]) + 1 if len(ticks) else 0)
        counts = np.zeros((2, end), np.int32)
        counts[:, :known] = state.counts
        # Times rise: none is before the grid.
        inside = ticks >= 0
        np.add.at(counts, (p[inside].astype(np.int64), ticks[inside]), 1)
        return replace(state, first=first, counts=counts)

    def _decode(
        self, state: CharacterState, due: int, last: bool = False
    ) -> tuple[CharacterState, list[Character]]:
        """Decode the first `due` ticks, with the help of some behind; nothing comes behind the last ones."""
        assert state.first is not None
        first, light = state.first, state.light
        # No more than that, however much there is: any split of the stream gives the same.
        counts = state.counts[:, : due + self._ahead]
        end = counts.shape[1] - (TICKS if last else _REACH)
        # A character may go on behind what is known.
        counts = np.pad(counts, ((0, 0), (0, self._length + 2 * _REACH)))
        events = int(counts[:, :due].sum())
        given = dict(state.given)
        found: list[Character] = []
        start, dark = max(state.start - first, 0), state.dark
        stretch = Stretch(counts, start, max(state.seen - first, 0), end)
        tried = state.tried
        if light is None and events >= _LEAST_EVENTS:
            # Looking takes long: the less often, the longer there was none.
            if tried & (tried - 1) == 0 or tried % _SELDOM == 0:
                light = self._acquire(stretch)
            tried = 0 if light is not None else tried + 1
        if light is None:
            given["stretches_without_light"] += events >= _LEAST_EVENTS
        else:
            # Where a stretch tells much of the light, it is read by that.
            starts, values = self._read(stretch, light)[:2]
            light = self._learned(stretch, light, starts, values)
            starts, _, falls, rises = self._read(stretch, light)
            kept = (starts < due) & (starts + _EARLY >= stretch.seen)
            if last:
                kept &= starts + (self.characters.edges - 1) * TICKS < end
            ahead = starts[starts < due]
            starts, falls, rises = starts[kept], falls[kept], rises[kept]
            found = list(self._given(first, starts, falls, rises, light))
            given["characters"] += len(found)
            given["characters_wrong_parity"] += sum(c.wrong_parity for c in found)
            if len(ahead):
                start = int(ahead[-1]) + round(self._length * light.rate) - _NEAR
                dark = 0
            elif events >= _LEAST_EVENTS:
                dark += 1
                if dark >= _LOST:
                    light, dark = None, 0
        # A copy, so that what is done is not held.
        rest = state.counts[:, due:].copy()
        return CharacterState(first + due, rest, first + start, state.seen, light, dark, tried, given), found

    def _places(self, light: Light) -> NDArray[np.int64]:
        """Ticks from a character's start to each place of an edge."""
        places = np.arange(self.characters.edges) * (TICKS * light.rate)
        ticks: NDArray[np.int64] = np.rint(places).astype(np.int64)
        return ticks

    def _evidence(self, stretch: "Stretch", light: Light) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Evidence of a fall from mark and of a rise to it at every tick, float64 (n,) each."""
        from evlcp_uart import _kernels

        counts = stretch.counts
        found = np.empty((2, counts.shape[1] - _REACH + 1))
        for polarity in (0, 1):
            means = light.events[polarity] * _STRENGTHS
            gains = np.log1p(means[:, None] * light.kernels[polarity] / light.noise[polarity])
            share = min(1.0, _ENOUGH / float(light.events[polarity]))
            gains, means = gains * share, means * share
            _kernels.edge_evidence(counts[polarity], gains, means, _SHARES, light.unseen, found[polarity])
        # Whether there was an edge before the first event, or behind the last, nothing tells.
        found[:, : max(stretch.seen - _EARLY, 0)] = 0
        found[:, max(stretch.end, 0) :] = 0
        off, on = found
        return (off, on) if self.mark_on else (on, off)

    def _read(
        self, stretch: "Stretch", light: Light, *, likeliest: bool = False
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Starts of characters, their values, and the evidence at their places."""
        starts, falls, rises, _ = self._path(stretch, light, likeliest)
        at = starts[:, None] + self._places(light)
        fell, rose = falls[at], rises[at]
        values = self.characters.likelihoods(fell, rose).argmax(1) if len(starts) else np.empty(0, np.int64)
        return starts, values, fell, rose

    def _path(
        self, stretch: "Stretch", light: Light, likeliest: bool
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], float]:
        from evlcp_uart import _kernels

        falls, rises = self._evidence(stretch, light)
        places = self._places(light)
        scores = np.empty(max(len(falls) - int(places[-1]), 0))
        parity = ("none", "odd", "even").index(self.characters.parity)
        _kernels.character_scores(falls, rises, places, self.characters.data_bits, parity, likeliest, scores)
        length = round(self._length * light.rate)
        starts, worth = _kernels.best_path(
            scores, length, stretch.start, _NEAR, _AFTER_IDLE, _AFTER_ONE, _JITTER
        )
        return starts, falls, rises, worth

    def _given(
        self,
        first: int,
        starts: NDArray[np.int64],
        falls: NDArray[np.float64],
        rises: NDArray[np.float64],
        light: Light,
    ) -> Iterator[Character]:
        likelihoods = self.characters.likelihoods(falls, rises)
        values, llr, quality = self.characters.soft(likelihoods)
        wrong = self.characters.wrong_parity(falls, rises)
        tick_us = self.bit_us / TICKS
        for k, start in enumerate(starts.tolist()):
            t_us = (first + start + _EARLY) * tick_us
            yield Character(
                t_us, int(values[k]), llr[k], float(quality[k]), bool(wrong[k]), self.bit_us * light.rate
            )

    def _edges_of(
        self, starts: NDArray[np.int64], values: NDArray[np.int64], light: Light
    ) -> tuple[tuple[NDArray[np.int64], NDArray[np.int64]], tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Of OFF and ON edges of characters: their ticks, and the number of their place, int64 (m,) each."""
        at = starts[:, None] + self._places(light)
        place = np.broadcast_to(np.arange(at.shape[1]), at.shape)
        fell, rose = self.characters.falling[values] > 0, self.characters.rising[values] > 0
        down, up = (at[fell], place[fell]), (at[rose], place[rose])
        return (down, up) if self.mark_on else (up, down)

    def _learned(
        self,
        stretch: "Stretch",
        light: Light,
        starts: NDArray[np.int64],
        values: NDArray[np.int64],
        memory: float = _MEMORY,
    ) -> Light:
        """What characters that were read teach of the light."""
        if len(starts) < _LEAST_CHARACTERS:
            return light
        counts = stretch.counts
        n = counts.shape[1]
        weight = memory * light.learned
        kernels, events, noise = light.kernels.copy(), light.events.copy(), light.noise.copy()
        edges = self._edges_of(starts, values, light)
        seen = blank = 0
        for polarity, (at, place) in enumerate(edges):
            inside = at + _REACH <= n
            at, place = at[inside], place[inside]
            if not len(at):
                continue
            windows = counts[polarity][at[:, None] + np.arange(_REACH)]
            found = windows.sum(0).astype(np.float64)
            away = np.ones(n, np.bool_)
            away[(at[:, None] + np.arange(_REACH)).ravel()] = False
            # Outside the characters there may be no light at all: noise is that of the pauses within them.
            between = away[starts[0] : starts[-1] + self._length]
            quiet = counts[polarity][starts[0] : starts[-1] + self._length][between]
            if len(quiet) >= _REACH:
                # What a burst leaves behind for long is noise to the edges after it.
                left = min(float(found[-_REACH // 4 :].mean()), _LEFT * float(found.mean())) / len(at)
                level = max(float(quiet.mean()), left)
                noise[polarity] += (level - noise[polarity]) * len(quiet) / (len(quiet) + weight * TICKS)
            noise[polarity] = max(noise[polarity], 1e-4, 1e-4 * events[polarity])
            burst = np.maximum(found - noise[polarity] * len(at), 0.0)
            total = float(burst.sum())
            share = len(at) / (len(at) + weight)
            events[polarity] += (max(total / len(at), 0.5) - events[polarity]) * share
            if total > 0:
                shape = np.convolve(np.pad(burst, 1, mode="edge"), (0.25, 0.5, 0.25), "valid")
                shape = shape + 0.01 * shape.sum() / _REACH
                kernels[polarity] += (shape / shape.sum() - kernels[polarity]) * share
                kernels[polarity] /= kernels[polarity].sum()
            strong = windows.sum(1)
            seen += len(at)
            blank += int((strong <= 0.05 * events[polarity] + 2 * noise[polarity] * _REACH).sum())
        unseen = (blank + 0.02 * 50 + light.unseen * weight) / (seen + 50 + weight)
        light = replace(light, rate=self._rate(stretch, light, starts, values, weight))
        return replace(
            light,
            kernels=kernels,
            events=events,
            noise=noise,
            unseen=float(np.clip(unseen, 1e-3, 0.3)),
            learned=weight + seen,
        )

    def _rate(
        self,
        stretch: "Stretch",
        light: Light,
        starts: NDArray[np.int64],
        values: NDArray[np.int64],
        weight: float,
    ) -> float:
        """The length of a bit by which the characters that were read are likeliest."""
        apart = np.diff(starts)
        at_once = np.abs(apart - self._length * light.rate) <= _NEAR + 1
        if (many := int(at_once.sum())) >= _LEAST_SPACINGS:
            # One behind the other they tell the clock better than their edges do.
            runs = np.split(apart, np.flatnonzero(~at_once))
            spans = [
                (len(run), int(run.sum()))
                for run in (r[np.abs(r - self._length * light.rate) <= _NEAR + 1] for r in runs)
            ]
            rate = sum(m * span for m, span in spans) / (sum(m * m for m, _ in spans) * self._length)
            gain = 4 * many / (4 * many + weight / 4)
            return float(np.clip(light.rate + gain * (rate - light.rate), 1 - _CLOCK, 1 + _CLOCK))
        falls, rises = self._evidence(stretch, light)
        fell, rose = self.characters.falling[values], self.characters.rising[values]
        gain = 8 * len(starts) / (8 * len(starts) + weight)
        rates = light.rate + _RATES * (1.0 if gain > 0.5 else 0.3)
        worth = []
        for rate in rates:
            places = self._places(replace(light, rate=float(rate)))
            best = np.full(len(starts), -np.inf)
            for early in (-1, 0, 1):
                at = np.clip(starts[:, None] + places + early, 0, len(falls) - 1)
                best = np.maximum(best, (falls[at] * fell + rises[at] * rose).sum(1))
            worth.append(float(best.sum()))
        top = int(np.argmax(worth))
        rate = float(rates[top])
        if 0 < top < len(rates) - 1:
            left, here, right = worth[top - 1 : top + 2]
            if (bend := left - 2 * here + right) < 0:
                rate += 0.5 * (left - right) / bend * float(rates[1] - rates[0])
        return float(np.clip(light.rate + gain * (rate - light.rate), 1 - _CLOCK, 1 + _CLOCK))

    def _acquire(self, stretch: "Stretch") -> Light | None:
        """Learn the light from a stretch of which nothing is known; None where it shows no characters."""
        tried: list[tuple[float, Light]] = []
        for light in _guesses(stretch.counts):
            worth = self._path(stretch, light, True)[3]
            tried.append((worth, light))
        tried.sort(key=lambda one: -one[0])
        best, best_worth = None, 0.0
        for _, light in tried[:4]:
            for _ in range(5):
                starts, values = self._read(stretch, light, likeliest=True)[:2]
                light = self._learned(stretch, _centred(light), starts, values, 0.0)
            starts, _, _, worth = self._path(stretch, light, False)
            if len(starts) >= _LEAST_CHARACTERS and worth > max(best_worth, _LEAST_WORTH * len(starts)):
                best, best_worth = light, worth
        return best


def _guesses(counts: NDArray[np.int32]) -> Iterator[Light]:
    """What the light may be like, before anything is known."""
    n = counts.shape[1]
    ticks = np.arange(_REACH)
    total = counts.sum(1) + 1.0
    # A rise in four bits or so.
    events = np.maximum(total / (n / TICKS / 4), 1.0)
    noise = np.maximum(0.2 * total / n, 1e-3)
    for width in (0.12, 0.5):
        for later in (-0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75):
            kernels = []
            for shift in (max(-later, 0.0), max(later, 0.0)):
                after = (ticks - _EARLY) / TICKS - shift
                shape = np.where(after >= 0, np.exp(-np.maximum(after, 0) / width), np.exp(after / 0.05))
                kernels.append(shape / shape.sum())
            for off in (-0.02, -0.01, 0.0, 0.01, 0.02):
                yield Light(np.array(kernels), events, noise, 1 + off)


def _centred(light: Light) -> Light:
    """The light with its events as early after an edge as they may come: only events tell where edges are."""
    first = min(int(np.searchsorted(np.cumsum(kernel), 0.03)) for kernel in light.kernels)
    shift = first - _EARLY
    if not shift:
        return light
    kernels = np.roll(light.kernels, -shift, 1)
    if shift > 0:
        kernels[:, -shift:] = kernels.min()
    else:
        kernels[:, :-shift] = kernels.min()
    return replace(light, kernels=kernels / kernels.sum(1, keepdims=True))
