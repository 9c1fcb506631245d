"""Characters from the events of a group of pixels: a maximum-likelihood receiver that learns its light.

An edge of the light wakes a burst of events of one polarity, late and with a tail; a light that moves or
shimmers wakes events of both as long as it is on. What is learned from the stream itself, without training:
how many events of either polarity come in each sixteenth of a bit, by the bit and the three before it; how
unlike in strength bits are; how far the clock is off, and how often characters pause. With that every tick of
the stream has a log-likelihood of each context of a bit; a character is worth what its bits say, and the best
sequence of characters and pauses is found as a whole.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from evlcp_uart.characters import Characters
from evlcp_uart.light import CONTEXTS, EARLY, LOG_GAINS, OUTLIER, TICKS, Light, guesses, log_sums

_BLOCK = 32
"""Characters of a stretch that is decoded at once, if they follow one another."""

_TAIL = 2 * TICKS
"""Ticks behind a character that its bits' windows may need."""

_MORE, _SURE = 4, 0.95
"""Blocks of a stretch where the characters of one are not that sure on the average: dim light takes long to
learn."""

_BEFORE_FIRST = TICKS
"""Ticks before a stream's first event of which that event tells: it may be an edge's, which is late."""

_LAST_SURE = 0.95
"""How sure the last character must be that goes on behind the last event: its rest may not have been seen."""

_AHEAD = 4
"""Characters that are looked ahead: where one starts is known only by those after it."""

_JITTER, _NEAR = 0.7, 2
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

_LEAST_EVENTS = 24
_LEAST_CHARACTERS = 3
_LEAST_WORTH = 0.5
"""Events of a stretch in which light is looked for; characters that half of it must show; and by how much
each is to be likelier than without."""

DOUBTFUL = 0.85
"""How sure the first characters are on the average, where they are fewer than that before a pause."""

_OTHERWISE = 3.0
"""Nats by which a stream's first characters must be likelier than the best reading without them, odds of
twenty: what was on air before the first event is unknown, and any bit that is 0 may be a start bit."""

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
"""Clocks by which those are tried, too: within a character, no bit is off by a quarter of itself then."""

_SHIFTS, _AS_GOOD = range(-14, 15, 2), 0.01
"""Ticks by which bits are tried to begin elsewhere, as a burst should be within its bit's window: the latest
that tells as much, but for a share."""

_STEADY = 6
"""Characters before and behind one that tell when it starts, where they follow one another at once."""

_MEMORY = 0.97
"""Weight of what was learned before, after a block."""

_SELDOM = 8
"""Stretches in one of which light is looked for where there is none."""

_BUNCH_EVENTS, _BUNCH_TICKS = 6.0, TICKS // 2
"""Events of a tick from which on those of ticks some way apart are bunches of a readout, and how far these
are apart at the most: edges are further."""

_GRAINS = 24
"""Differences of times that show how coarse these are: those of finer ones are all even in 1e-7 of cases."""

_LOST = 8
"""Stretches with events and without a character after which the light is learned anew."""


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
        grain_us: Greatest common divisor of what the first times differ by, us: 1 but for coarse ones.
        grains: Differences of which that is known.
        grain_at: Tick of the last of them; None as long as there are too few.
        last_us: Time of the last event; None before the first.
        spread: Ticks over which the events of one are spread, as their times are no better known.
        tried: Stretches with events in which light was looked for, or might have been, in vain.
        blocks: Blocks of the next stretch.
        given: What was counted so far.
    """

    first: int | None = None
    counts: NDArray[np.int32] = field(default_factory=lambda: np.zeros((2, 0), np.int32))
    start: int = 0
    seen: int = 0
    light: Light | None = None
    dark: int = 0
    grain_us: int = 0
    grains: int = 0
    grain_at: int | None = None
    last_us: int | None = None
    spread: int = 1
    tried: int = 0
    blocks: int = 1
    given: dict[str, int] = field(
        default_factory=lambda: {
            "characters": 0,
            "characters_by_chance": 0,
            "characters_ambiguous": 0,
            "characters_wrong_parity": 0,
            "frames_inverted": 0,
            "stretches_without_light": 0,
        }
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

    @property
    def windows(self) -> NDArray[np.int32]:
        """The events of a bit that begins at each tick, int32 (n - TICKS + 1, 2, TICKS), a view."""
        return np.lib.stride_tricks.sliding_window_view(self.counts, TICKS, 1).transpose(1, 0, 2)


@dataclass(frozen=True)
class CharacterDecoder:
    """Reads characters from times and polarities, step by step.

    Args:
        characters: Their format.
        bit_us: Nominal length of a bit, us.
        mark_on: The light is on for a mark, which is 1 and idle.
        pause_bits: Pause that is sent before a packet, by which characters are numbered where a recording
            begins within one; 0 where nothing is known of it.
    """

    characters: Characters
    bit_us: float
    mark_on: bool = True
    pause_bits: int = 0

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
        while state.counts.shape[1] >= state.blocks * self._block + self._ahead:
            state, more = self._decode(state, state.blocks * self._block)
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
        return _AHEAD * self._length + _TAIL

    def _take(
        self, state: CharacterState, t_us: NDArray[np.int64], p: NDArray[np.uint8], until_us: float
    ) -> CharacterState:
        """Count events by tick, on a grid that stands still."""
        first = state.first
        tick_us = self.bit_us / TICKS
        if first is None:
            if not len(t_us):
                return state
            # A character may have begun before its first event, wherever that is in time.
            seen = int(t_us[0] // tick_us) - _BEFORE_FIRST
            first = seen - self._length - TICKS
            state = replace(state, start=first, seen=seen)
        ticks = np.floor_divide(t_us, tick_us).astype(np.int64) - first
        known = state.counts.shape[1]
        end = max(int(np.floor(until_us / tick_us)) - first, known, int(ticks[-1]) + 1 if len(ticks) else 0)
        counts = np.zeros((2, end), np.int32)
        counts[:, :known] = state.counts
        # Times rise: none is before the grid.
        inside = ticks >= 0
        np.add.at(counts, (p[inside].astype(np.int64), ticks[inside]), 1)
        state = replace(state, first=first, counts=counts)
        return self._grained(state, t_us) if len(t_us) and state.grain_at is None else state

    def _grained(self, state: CharacterState, t_us: NDArray[np.int64]) -> CharacterState:
        """With how coarse times are."""
        apart = np.diff(t_us, prepend=t_us[0] if state.last_us is None else state.last_us)
        steps = np.flatnonzero(apart)[: _GRAINS - state.grains]
        grain_us = math.gcd(state.grain_us, int(np.gcd.reduce(apart[steps])) if len(steps) else 0)
        grains = state.grains + len(steps)
        at = int(t_us[steps[-1]] * TICKS // self.bit_us) if grains == _GRAINS else None
        return replace(state, grain_us=grain_us, grains=grains, grain_at=at, last_us=int(t_us[-1]))

    def _decode(
        self, state: CharacterState, due: int, last: bool = False
    ) -> tuple[CharacterState, list[Character]]:
        """Decode the first `due` ticks, with the help of some behind; nothing comes behind the last ones."""
        assert state.first is not None
        stretch, spread = self._prepare(state, due, last)
        enough = int(stretch.counts[:, :due].sum()) >= _LEAST_EVENTS
        after = replace(
            state,
            first=state.first + due,
            # A copy, so that what is done is not held.
            counts=state.counts[:, due:].copy(),
            start=state.first + stretch.start,
            spread=spread,
        )
        if state.light is None and enough:
            # Looking takes long: the less often, the longer there was none.
            light, other, tried = None, False, state.tried
            if tried & (tried - 1) == 0 or tried % _SELDOM == 0:
                light, other = self._acquire(stretch)
            if light is None and not other and state.blocks == 1 and not last:
                return replace(state, blocks=_MORE), []
            tried = 0 if light is not None else max(tried, _SELDOM // 2 if other else 0) + 1
            after = replace(after, light=light, tried=tried)
        if after.light is None:
            return replace(after, given=_added(state.given, stretches_without_light=int(enough))), []
        after, found, sure = self._read(after, stretch, due, last, is_new=state.light is None)
        if state.light is None and sure < _SURE and state.blocks == 1 and not last:
            return replace(state, blocks=_MORE), []
        if after.start == state.first + stretch.start and enough:
            # No character began.
            lost = state.dark + 1 >= _LOST
            light, dark = (None, 0) if lost else (after.light, state.dark + 1)
            after = replace(after, light=light, dark=dark)
        return replace(after, blocks=1 if sure >= _SURE else _MORE), found

    def _prepare(self, state: CharacterState, due: int, last: bool) -> tuple[Stretch, int]:
        """The stretch that tells of the first `due` ticks, and over how many ticks its events are spread."""
        assert state.first is not None
        # No more than that, however much there is: any split of the stream gives the same.
        counts, spread = state.counts[:, : due + self._ahead], state.spread
        if state.light is None:
            spread = _bunches(counts[:, :due])
            # What is known only later, is not known yet in whatever pieces events come.
            if state.grain_at is not None and state.grain_at < state.first + due:
                spread = max(spread, round(state.grain_us * TICKS / self.bit_us))
        counts = _spread(counts, min(spread, TICKS))
        end = counts.shape[1] - (0 if last else _TAIL)
        # A character may go on behind what is known.
        counts = np.pad(counts, ((0, 0), (0, self._length + 2 * _TAIL)))
        start, seen = max(state.start - state.first, 0), max(state.seen - state.first, 0)
        return Stretch(counts, start, seen, end), spread

    def _read(
        self, after: CharacterState, stretch: Stretch, due: int, last: bool, is_new: bool
    ) -> tuple[CharacterState, list[Character], float]:
        """The characters of the first `due` ticks of a stretch, of whose light `after` knows.

        Returns:
            The state behind them, the characters, and how sure they are on the average, 1 without any.
        """
        assert after.first is not None
        assert after.light is not None
        # Where a stretch tells much of the light, it is read by that.
        starts, evidence, _ = self._path(stretch, after.light, False)
        light = self._learned(stretch, after.light, starts, evidence, _MEMORY ** (due / self._block))
        starts, evidence, _ = self._path(stretch, light, False)
        starts = starts[starts < due]
        kept = starts[starts + EARLY >= stretch.seen]
        first = after.first - due
        found = list(self._given(first, kept, evidence, light))
        if last and found:
            # Its last edge may be that before the first stop bit.
            needs = int(kept[-1]) + (self.characters.bits - self.characters.stop_bits) * TICKS
            if needs >= stretch.end and (found[-1].quality < _LAST_SURE or found[-1].wrong_parity):
                found.pop()
        by_chance, ambiguous = 0, 0
        if is_new:
            ambiguous = self._ambiguous(stretch, light, kept)
            clear = found[ambiguous:]
            found = _without_chance(clear)
            by_chance = len(clear) - len(found)
        given = _added(
            after.given,
            characters=len(found),
            characters_by_chance=by_chance,
            characters_ambiguous=ambiguous,
            characters_wrong_parity=sum(one.wrong_parity for one in found),
            frames_inverted=len(found) * light.inverted,
        )
        after = replace(after, light=light, given=given)
        if len(starts):
            start = first + int(starts[-1]) + round(self._length * light.rate) - _NEAR
            after = replace(after, start=start, dark=0)
        return after, found, float(np.mean([one.quality for one in found])) if found else 1.0

    def _places(self, light: Light) -> NDArray[np.int64]:
        """Ticks from a character's start to each of its bits."""
        ticks: NDArray[np.int64] = np.rint(np.arange(self.characters.bits) * (TICKS * light.rate)).astype(
            np.int64
        )
        return ticks

    def _evidence(self, stretch: "Stretch", light: Light) -> NDArray[np.float64]:
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

    def _path(
        self, stretch: "Stretch", light: Light, likeliest: bool
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], float]:
        """Starts of the characters, the evidence at every tick, and what the path is worth."""
        evidence = self._evidence(stretch, light)
        scores = self._scores(evidence, light, likeliest)
        starts, worth = self._best_path(scores, evidence, stretch, light)
        return self._steadied(stretch, light, starts, evidence), evidence, worth

    def _scores(self, evidence: NDArray[np.float64], light: Light, likeliest: bool) -> NDArray[np.float64]:
        """How much likelier a character is at every tick than none, float64 (n,)."""
        from evlcp_uart import _kernels

        places = self._places(light)
        scores = np.empty(max(len(evidence) - int(places[-1]), 0))
        parity = ("none", "odd", "even").index(self.characters.parity)
        _kernels.character_scores(evidence, places, self.characters.data_bits, parity, likeliest, scores)
        return scores

    def _best_path(
        self, scores: NDArray[np.float64], evidence: NDArray[np.float64], stretch: "Stretch", light: Light
    ) -> tuple[NDArray[np.int64], float]:
        """Starts of the characters that explain a stretch best, and what that is worth."""
        from evlcp_uart import _kernels

        length = round(self._length * light.rate)
        pause = round(self.pause_bits * TICKS * light.rate)
        after_idle, after_one = light.costs
        after_pause = after_idle - (np.log(pause / _PAUSE_TICKS) if pause else 0.0)
        # The first bit of a pause has the stop bits before it, and any before these.
        contexts = np.arange((2 << self.characters.stop_bits) - 1, CONTEXTS, 2 << self.characters.stop_bits)
        tails = log_sums(evidence[:, contexts]) - np.log(len(contexts))
        starts, worth = _kernels.best_path(
            scores, tails, length, stretch.start, _NEAR, after_idle, after_one, _JITTER, pause, after_pause
        )
        return starts, float(worth)

    def _ambiguous(self, stretch: "Stretch", light: Light, starts: NDArray[np.int64]) -> int:
        """How many of the first characters, that start there, a reading without them explains nearly as well.

        Some at most: where light is so dim that more do not stand out, their quality says so.
        """
        evidence = self._evidence(stretch, light)
        scores = self._scores(evidence, light, False)
        _, worth = self._best_path(scores, evidence, stretch, light)
        most = min(len(starts), _LEAST_CHARACTERS - 1)
        for many, start in enumerate(starts[:most].tolist()):
            # Half a bit from here a character is another one.
            other = scores.copy()
            other[max(start - TICKS // 2, 0) : start + TICKS // 2 + 1] = -np.inf
            if worth - self._best_path(other, evidence, stretch, light)[1] >= _OTHERWISE:
                return many
        return most

    def _steadied(
        self, stretch: "Stretch", light: Light, starts: NDArray[np.int64], evidence: NDArray[np.float64]
    ) -> NDArray[np.int64]:
        """Starts as their events and those of the characters around tell them, where these follow at once.

        The evidence of a bit knows its word, and hardly when it begins: it is bounded by what else may come.
        """
        if not len(starts):
            return starts
        length = self._length * light.rate
        most = stretch.counts.shape[1] - TICKS - 1
        places = self._places(light)
        values = self.characters.likelihoods(evidence[starts[:, None] + places]).argmax(1)
        logs = light.logs - np.log(light.rates.mean((0, 2)))[None, :, None]
        logs = logs[self.characters.contexts[values]]
        seen = stretch.windows
        found = starts.copy()
        breaks = np.flatnonzero(np.abs(np.diff(starts) - length) > _NEAR + 1) + 1
        shifts = np.arange(-_NEAR - 1, _NEAR + 2)
        for run in np.split(np.arange(len(starts)), breaks):
            begun = starts[run] - length * np.arange(len(run))
            mean = _around(begun[:, None])[:, 0] / _around(np.ones((len(run), 1)))[:, 0]
            at = np.rint(mean + length * np.arange(len(run))).astype(np.int64)[:, None] + shifts
            windows = seen[np.clip(at[:, :, None] + places, 0, most)].reshape(len(run), len(shifts), -1)
            fit = (windows @ logs[run].reshape(len(run), -1, 1))[..., 0]
            best = at[np.arange(len(run)), _around(fit).argmax(1)]
            found[run] = np.clip(best, 0, len(evidence) - 1 - int(places[-1]))
        return found

    def _given(
        self, first: int, starts: NDArray[np.int64], evidence: NDArray[np.float64], light: Light
    ) -> Iterator[Character]:
        at = evidence[starts[:, None] + self._places(light)]
        values, llr, quality = self.characters.soft(self.characters.likelihoods(at))
        wrong = self.characters.wrong_parity(at)
        tick_us = self.bit_us / TICKS
        for k, start in enumerate(starts.tolist()):
            t_us = (first + start + EARLY) * tick_us
            yield Character(
                t_us, int(values[k]), llr[k], float(quality[k]), bool(wrong[k]), self.bit_us * light.rate
            )

    def _learned(
        self,
        stretch: "Stretch",
        light: Light,
        starts: NDArray[np.int64],
        evidence: NDArray[np.float64],
        memory: float,
    ) -> Light:
        """What characters that were read teach of the light."""
        if len(starts) < _LEAST_CHARACTERS:
            return light
        rate = self._rate(light, starts, evidence, memory)
        windows, contexts = self._bits(stretch, light, starts, self._contexts(light, starts, evidence))
        light = light.learn(windows, contexts, memory, rate)
        apart = np.diff(starts) - self._length * light.rate
        late = apart[(np.abs(apart) > _NEAR + 1) & (apart < 2 * self._length)]
        paused = len(late), float(late.sum()), len(apart)
        sums = [memory * old + new for old, new in zip(light.paused, paused, strict=True)]
        return replace(light, paused=(sums[0], sums[1], sums[2]))

    def _contexts(
        self, light: Light, starts: NDArray[np.int64], evidence: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """How likely each bit of characters that were read is of each context, float64 (bits, C)."""
        likelihoods = self.characters.likelihoods(evidence[starts[:, None] + self._places(light)])
        weights = np.exp(likelihoods - likelihoods.max(1, keepdims=True))
        weights /= weights.sum(1, keepdims=True)
        of_words = self.characters.contexts
        contexts = np.stack([weights @ (of_words == context) for context in range(CONTEXTS)], 2)
        return contexts.reshape(-1, CONTEXTS)

    def _bits(
        self,
        stretch: "Stretch",
        light: Light,
        starts: NDArray[np.int64],
        contexts: NDArray[np.float64],
        shift: int = 0,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The bits of characters that were read, of known contexts, `shift` ticks later than they were.

        Returns:
            Their events, float64 (n, 2, TICKS), and how likely each is of each context, float64 (n, C).
        """
        at = (starts[:, None] + self._places(light) + shift).ravel()
        inside = (at >= 0) & (at + TICKS <= stretch.end) & (at + EARLY >= stretch.seen)
        windows = stretch.windows[at[inside]].astype(np.float64)
        return windows, contexts[inside]

    def _begun(
        self, stretch: "Stretch", light: Light, starts: NDArray[np.int64], evidence: NDArray[np.float64]
    ) -> Light:
        """The light where bits begin so that events tell most of them: a burst is in its bit's window."""
        if len(starts) < _LEAST_CHARACTERS:
            return light
        found = []
        known = self._contexts(light, starts, evidence)
        for shift in _SHIFTS:
            windows, contexts = self._bits(stretch, light, starts, known, shift)
            learned = light.learn(windows, contexts, 0.0, light.rate)
            found.append((learned.explained(windows, contexts), learned))
        most = max(worth for worth, _ in found)
        most -= _AS_GOOD * abs(most)
        return [learned for worth, learned in found if worth >= most][-1]

    def _rate(
        self, light: Light, starts: NDArray[np.int64], evidence: NDArray[np.float64], memory: float
    ) -> float:
        """The length of a bit by which the characters that were read are likeliest."""
        weight = memory * light.learned
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
            gain = 4 * many / (4 * many + weight / 12)
            return float(np.clip(light.rate + gain * (rate - light.rate), 1 - CLOCK_SHARE, 1 + CLOCK_SHARE))
        contexts = self.characters.contexts
        at = np.clip(starts[:, None] + self._places(light), 0, len(evidence) - 1)
        values = self.characters.likelihoods(evidence[at]).argmax(1)
        bits = self.characters.bits
        gain = bits * len(starts) / (bits * len(starts) + weight)
        rates = light.rate + _RATES * (1.0 if gain > 0.5 else 0.3)
        worth = []
        for rate in rates:
            places = self._places(replace(light, rate=float(rate)))
            best = np.full(len(starts), -np.inf)
            for early in (-1, 0, 1):
                at = np.clip(starts[:, None] + places + early, 0, len(evidence) - 1)
                best = np.maximum(best, evidence[at, contexts[values]].sum(1))
            worth.append(float(best.sum()))
        top = int(np.argmax(worth))
        rate = float(rates[top])
        if 0 < top < len(rates) - 1:
            left, here, right = worth[top - 1 : top + 2]
            if (bend := left - 2 * here + right) < 0:
                rate += 0.5 * (left - right) / bend * float(rates[1] - rates[0])
        return float(np.clip(light.rate + gain * (rate - light.rate), 1 - CLOCK_SHARE, 1 + CLOCK_SHARE))

    def _acquire(self, stretch: "Stretch") -> tuple[Light | None, bool]:
        """Learn the light from a stretch of which nothing is known.

        The light is the other way round where its characters have their start, parity and stop bits clearly
        more often so: only text of few kinds without a pause has them both ways.

        Returns:
            The light, None where the stretch shows no characters; and whether it clearly shows another code.
        """
        light, other = self._found(part := self._informative(stretch))
        if part is stretch:
            return light, other
        if light is None:
            # Of some light more must be seen.
            return (None, True) if other else self._found(stretch)
        # The rest, of which it has learned nothing, must be of these characters, too.
        rest = Stretch(stretch.counts, part.end, stretch.seen, stretch.end)
        starts, _, _ = self._path(rest, light, False)
        if len(starts) >= _LEAST_CHARACTERS:
            found, other = self._best(rest, [(light, starts)], _REST_FRAMED)
            if found is None:
                return None, other
        # A few characters may fit by chance: those that do not fit well must go on to.
        starts, _, _ = self._path(part, light, False)
        found, _ = self._best(part, [(light, starts)], _NEXT_FRAMED)
        return self._found(stretch) if found is None else (light, False)

    def _informative(self, stretch: "Stretch") -> "Stretch":
        """As much of it as tells what its light is like."""
        known = int(np.searchsorted(np.cumsum(stretch.counts.sum(0)), _LEARN_EVENTS))
        end = max(known, max(stretch.start, stretch.seen) + _LEARN_CHARACTERS * self._length)
        if end >= stretch.end:
            return stretch
        counts = np.ascontiguousarray(stretch.counts[:, : end + self._length + 2 * _TAIL])
        return Stretch(counts, stretch.start, stretch.seen, end)

    def _found(self, stretch: "Stretch") -> tuple[Light | None, bool]:
        """The light of a stretch as `_acquire` gives it, whatever it costs."""
        upright, of_another = self._best(stretch, self._candidates(stretch, inverted=False))
        other, _ = self._best(stretch, self._candidates(stretch, inverted=True))
        if other is None or (upright is not None and upright[1] + _INVERTED_BITS >= other[1]):
            return (None, of_another) if upright is None else (upright[0], False)
        return (other[0], False) if upright is not None or other[1] >= _INVERTED_BITS else (None, of_another)

    def _best(
        self,
        stretch: "Stretch",
        learned: list[tuple[Light, NDArray[np.int64]]],
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
        explained = [
            self._explained(stretch, replace(light, most=least), starts) for light, starts in learned
        ]
        both = bool(stretch.counts.any(1).all())
        # Light a bit off explains events of text, too, but not its stop bits: then another may, and clearly.
        of_another, dim = False, None
        for rank, k in enumerate(np.argsort(explained)[::-1].tolist()):
            light, starts = learned[k]
            evidence = self._evidence(stretch, light)[starts[:, None] + self._places(light)]
            if light.inverted:
                kinds = np.unique(self.characters.likelihoods(evidence).argmax(1))
                if len(kinds) < _INVERTED_KINDS:
                    continue
            framed = float(self.characters.framed(evidence).sum() / np.log(2))
            clearness, fixed = (
                self.characters.clearness(evidence),
                self.characters.bits - self.characters.data_bits,
            )
            # Of rises alone, or falls, none tells: what the others would say is missing.
            clear = both and clearness > _CLEAR
            wanted = _NEXT_FRAMED if rank else least_framed
            unframed = clear and framed < wanted * clearness * fixed * len(evidence)
            # However dim it is, characters are never that much less likely than bits without a frame.
            unframed |= both and framed < -_UNFRAMED_BITS
            if not unframed and clear:
                return (light, framed), False
            if not unframed and rank == 0:
                dim = light, framed
            of_another |= unframed and rank == 0
        # One that tells little is taken where none is clear.
        return dim, of_another

    def _candidates(self, stretch: "Stretch", inverted: bool) -> list[tuple[Light, NDArray[np.int64]]]:
        """What the light may be like, as the link has it or the other way round, and its characters."""
        tried: list[tuple[float, Light]] = []

        def explain(light: Light) -> None:
            starts = self._path(stretch, light, True)[0]
            tried.append((self._explained(stretch, light, starts), light))
            tried.sort(key=lambda one: -one[0])

        for light in guesses(stretch.counts, self.mark_on != inverted):
            explain(replace(light, inverted=inverted))
        for _, light in tried[:_TRIED]:
            for off in _CLOCKS:
                explain(replace(light, rate=1 + off))
        learned = []
        for _, light in tried[:_TRIED]:
            for turn in range(_ROUNDS):
                starts, evidence, _ = self._path(stretch, light, True)
                if turn in (0, 2):
                    light = self._begun(stretch, light, starts, evidence)
                    starts, evidence, _ = self._path(stretch, light, True)
                light = self._learned(stretch, light, starts, evidence, 0.0)
            starts, _, worth = self._path(stretch, light, False)
            if worth > 0 and self._cross_explained(stretch, light) > 0:
                learned.append((light, starts))
        return learned

    def _cross_explained(self, stretch: "Stretch", light: Light) -> float:
        """How much of each half of a stretch the light explains that the other one teaches."""
        starts, evidence, _ = self._path(stretch, light, False)
        half = len(starts) // 2
        if half < _LEAST_CHARACTERS:
            return -np.inf
        middle = int(starts[half])
        total = -_LEAST_WORTH * len(starts)
        for known, begin, end in (
            (starts[:half], middle, stretch.end),
            (starts[half:], stretch.start, middle),
        ):
            learned = self._learned(stretch, light, known, evidence, 0.0)
            part = Stretch(stretch.counts, begin, stretch.seen, end)
            total += self._explained(part, learned, self._path(part, learned, False)[0])
        return total

    def _explained(self, stretch: "Stretch", light: Light, starts: NDArray[np.int64]) -> float:
        """How much likelier the events are with the characters that start there than with no bits at all."""
        bits, begin = self.characters.bits, max(stretch.start, stretch.seen)
        starts = starts[starts + bits * TICKS <= stretch.end]
        marks = np.arange(begin, stretch.end - TICKS, TICKS)
        before = np.searchsorted(starts, marks + TICKS) - 1
        if len(starts):
            marks = marks[(before < 0) | (marks >= starts[before] + self._length * light.rate)]
        places = (starts[:, None] + self._places(light)).ravel()
        at = np.concatenate([places, marks])
        windows = stretch.windows[at].astype(np.float64)
        beside = np.logaddexp(light.beside_mean(windows), np.log(OUTLIER))
        words = beside[: len(places)].reshape(len(starts), bits, CONTEXTS)
        worth = log_sums(self.characters.likelihoods(words)) - self.characters.data_bits * np.log(2)
        return float(worth.sum() + beside[len(places) :, -1].sum())


def _added(given: dict[str, int], **more: int) -> dict[str, int]:
    return given | {name: given[name] + count for name, count in more.items()}


def _bunches(counts: NDArray[np.int32]) -> int:
    """How many ticks the bunches are apart in which a camera reads events out; 1 where it does not.

    Args:
        counts: Events of each tick, OFF and ON, int32 (2, n).
    """
    total = counts.sum(0)
    at = np.flatnonzero(total)
    many, apart = total[at], np.diff(at)
    near = apart <= _BUNCH_TICKS
    if not near.any() or (many * many).sum() < _BUNCH_EVENTS * many.sum():
        return 1
    weights = np.minimum(many[:-1], many[1:])[near]
    order = np.argsort(apart[near], kind="stable")
    half = np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)
    return int(apart[near][order][half])


def _spread(counts: NDArray[np.int32], ticks: int) -> NDArray[np.int32]:
    """Events of each tick spread evenly over so many about it, as whole ones; int32 (2, n)."""
    if ticks < 2:
        return counts
    n = counts.shape[1]
    total = np.pad(np.cumsum(counts, 1, dtype=np.int64), ((0, 0), (ticks, ticks)), mode="edge")
    total[:, :ticks] = 0
    means = np.cumsum(np.pad(total, ((0, 0), (1, 0))), 1)
    later = ticks // 2 + ticks
    until = (
        means[:, later + 1 : later + 1 + n] - means[:, later + 1 - ticks : later + 1 - ticks + n]
    ) // ticks
    # What would lie beyond the ends stays inside.
    until[:, -1] = total[:, -1]
    found: NDArray[np.int32] = np.diff(until, axis=1, prepend=0).astype(np.int32)
    return found


def _around(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of rows and of those near them, float64 (n, m)."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, 0)])
    k = np.arange(len(values))
    found: NDArray[np.float64] = (
        total[np.minimum(k + _STEADY + 1, len(values))] - total[np.maximum(k - _STEADY, 0)]
    )
    return found


def _without_chance(found: list[Character]) -> list[Character]:
    """Characters without those at the start that are few and not sure before a pause: noise, too."""
    apart = np.diff([one.t_us for one in found])
    length = float(np.median(apart)) if len(apart) else np.inf
    paused = np.flatnonzero(apart > 1.5 * length) + 1
    if len(paused) and (few := int(paused[0])) < _LEAST_CHARACTERS:
        sure = float(np.mean([one.quality for one in found[:few]]))
        return found[few:] if sure < DOUBTFUL else found
    return found
