"""Characters from the events of a group of pixels: a maximum-likelihood receiver that learns its light.

An edge of the light wakes a burst of events of one polarity, late and with a tail; a light that moves or
shimmers wakes events of both as long as it is on. What is learned from the stream itself, without training:
how many events of either polarity come in each sixteenth of a bit, by the bit and the three before it; how
unlike in strength bits are; how far the clock is off, and how often characters pause. With that every tick of
the stream has a log-likelihood of each context of a bit; a character is worth what its bits say, and the best
sequence of characters and pauses is found as a whole.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.clock import TimeGrain
from evlcp_uart.acquire import acquire
from evlcp_uart.light import EARLY, TICKS, Floats, Light, Ticks
from evlcp_uart.reader import LEAST_CHARACTERS, NEAR, TAIL, CharacterReader, Stretch

_BLOCK = 32
"""Characters of a stretch that is decoded at once, if they follow one another."""

_MORE, _SURE = 4, 0.95
"""Blocks of a stretch where the characters of one are not that sure on the average: dim light takes long to
learn."""

_BEFORE_FIRST = TICKS
"""Ticks before a stream's first event of which that event tells: it may be an edge's, which is late."""

_LAST_SURE = 0.95
"""How sure the last character must be that goes on behind the last event: its rest may not have been seen."""

_AHEAD = 4
"""Characters that are looked ahead: where one starts is known only by those after it."""

_LEAST_EVENTS = 24
"""Events of a stretch in which light is looked for."""

DOUBTFUL = 0.85
"""How sure the first characters are on the average, where they are fewer than that before a pause."""

_MEMORY = 0.97
"""Weight of what was learned before, after a block."""

_SELDOM = 8
"""Stretches in one of which light is looked for where there is none."""

_BUNCH_EVENTS, _BUNCH_TICKS = 6.0, TICKS // 2
"""Events of a tick from which on those of ticks some way apart are bunches of a readout, and how far these
are apart at the most: edges are further."""

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
        grain: How coarse times are.
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
    grain: TimeGrain = field(default_factory=TimeGrain)
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


@dataclass(frozen=True)
class CharacterDecoder:
    """Reads characters from times and polarities, step by step.

    Args:
        reader: Reads those of a stretch.
        bit_us: Nominal length of a bit, us.
        mark_on: The light is on for a mark, which is 1 and idle.
    """

    reader: CharacterReader
    bit_us: float
    mark_on: bool

    def init(self) -> CharacterState:
        """State before the first event."""
        return CharacterState()

    def step(
        self, state: CharacterState, t_us: Ticks, p: NDArray[np.uint8], until_us: float
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
    def _block(self) -> int:
        return _BLOCK * self.reader.length

    @property
    def _ahead(self) -> int:
        return _AHEAD * self.reader.length + TAIL

    def _take(
        self, state: CharacterState, t_us: Ticks, p: NDArray[np.uint8], until_us: float
    ) -> CharacterState:
        """Count events by tick, on a grid that stands still."""
        first = state.first
        tick_us = self.bit_us / TICKS
        if first is None:
            if not len(t_us):
                return state
            # A character may have begun before its first event, wherever that is in time.
            seen = int(t_us[0] // tick_us) - _BEFORE_FIRST
            first = seen - self.reader.length - TICKS
            state = replace(state, start=first, seen=seen)
        ticks = np.floor_divide(t_us, tick_us).astype(np.int64) - first
        known = state.counts.shape[1]
        end = max(int(np.floor(until_us / tick_us)) - first, known, int(ticks[-1]) + 1 if len(ticks) else 0)
        counts = np.zeros((2, end), np.int32)
        counts[:, :known] = state.counts
        # Times rise: none is before the grid.
        inside = ticks >= 0
        np.add.at(counts, (p[inside].astype(np.int64), ticks[inside]), 1)
        return replace(state, first=first, counts=counts, grain=state.grain.update(t_us))

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
                light, other = acquire(self.reader, self.mark_on, stretch)
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
            grain = state.grain
            if grain.known_us is not None and grain.known_us * TICKS // self.bit_us < state.first + due:
                spread = max(spread, round(grain.step_us * TICKS / self.bit_us))
        counts = _spread(counts, min(spread, TICKS))
        end = counts.shape[1] - (0 if last else TAIL)
        # A character may go on behind what is known.
        counts = np.pad(counts, ((0, 0), (0, self.reader.length + 2 * TAIL)))
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
        starts, evidence, _ = self.reader.path(stretch, after.light, False)
        light = self.reader.learn(stretch, after.light, starts, evidence, _MEMORY ** (due / self._block))
        starts, evidence, worth = self.reader.path(stretch, light, False)
        starts = starts[starts < due]
        kept = starts[starts + EARLY >= stretch.seen]
        first = after.first - due
        found = self._given(first, kept, evidence, light)
        if last and found:
            # Its last edge may be that before the first stop bit.
            needs = int(kept[-1]) + (self.reader.characters.bits - self.reader.characters.stop_bits) * TICKS
            if needs >= stretch.end and (found[-1].quality < _LAST_SURE or found[-1].wrong_parity):
                found.pop()
        by_chance, ambiguous = 0, 0
        if is_new:
            ambiguous = self.reader.count_ambiguous(stretch, light, kept, evidence, worth)
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
            start = first + int(starts[-1]) + round(self.reader.length * light.rate) - NEAR
            after = replace(after, start=start, dark=0)
        return after, found, float(np.mean([one.quality for one in found])) if found else 1.0

    def _given(self, first: int, starts: Ticks, evidence: Floats, light: Light) -> list[Character]:
        at = evidence[starts[:, None] + self.reader.places(light)]
        values, llr, quality = self.reader.characters.soft(self.reader.characters.likelihoods(at))
        wrong = self.reader.characters.wrong_parity(at)
        t_us = (first + starts + EARLY) * (self.bit_us / TICKS)
        columns = (t_us.tolist(), values.tolist(), llr, quality.tolist(), wrong.tolist())
        return [Character(*row, self.bit_us * light.rate) for row in zip(*columns, strict=True)]


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


def _without_chance(found: list[Character]) -> list[Character]:
    """Characters without those at the start that are few and not sure before a pause: noise, too."""
    apart = np.diff([one.t_us for one in found])
    length = float(np.median(apart)) if len(apart) else np.inf
    paused = np.flatnonzero(apart > 1.5 * length) + 1
    if len(paused) and (few := int(paused[0])) < LEAST_CHARACTERS:
        sure = float(np.mean([one.quality for one in found[:few]]))
        return found[few:] if sure < DOUBTFUL else found
    return found
