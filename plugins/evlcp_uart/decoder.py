"""Decode characters from the events of a group of pixels by a receiver that learns the light.

An edge of the light triggers a burst of events of one polarity, late and with a tail; a light that moves or
shimmers triggers events of both as long as it is on. The receiver learns from the stream itself, without
training: the number of events of either polarity in each sixteenth of a bit, by the bit and the three before
it; the spread of the strength of bits; the error of the clock, and the frequency of pauses. That gives each
tick of the stream a log-likelihood of each context of a bit; the score of a character is that of its bits,
and the best sequence of characters and pauses is found as a whole.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.clock import TimeGrain
from evlcp_uart.acquire import acquire_light
from evlcp_uart.light import EARLY, TICKS, Floats, Light, Ticks
from evlcp_uart.reader import MIN_CHARACTERS, NEAR, TAIL, CharacterReader, Stretch

_BLOCK = 32
"""Characters of a block without pauses; a stretch of blocks is decoded at once."""

_DIM_BLOCKS, _CLEAR_QUALITY = 4, 0.95
"""Blocks of a stretch if the mean quality of one block is lower than this: dim light takes long to learn."""

_BEFORE_FIRST = TICKS
"""Ticks before a stream's first event that are known by it, as it may be of an edge."""

_MIN_LAST_QUALITY = 0.95
"""Least quality of a last character that extends beyond the last event."""

_LOOKAHEAD = 4
"""Characters of lookahead: only those after it tell where one starts."""

_MIN_EVENTS = 24
"""Least events of a stretch for a search for light."""

_MIN_FIRST_QUALITY = 0.85
"""Least mean quality of the first characters if they are few before a pause."""

_MEMORY = 0.97
"""Weight of earlier learning after a block."""

_SEARCH_PERIOD = 8
"""Stretches from one search for light to the next, if there is none."""

_BUNCH_EVENTS, _BUNCH_TICKS = 6.0, TICKS // 2
"""Least weighted events per tick of bunches of a readout, and their largest spacing, less than of edges."""

_MAX_EMPTY = 8
"""Stretches with events and without a character after which the light is learned again."""


@dataclass(frozen=True, eq=False)
class Character:
    """A received character.

    Attributes:
        t_us: Start of its start bit by its earliest events, us.
        value: The likeliest value, from 0.
        llr: LLRs ln P(0) / P(1) of its bits, most significant first, float32 (data_bits,).
        quality: Probability that it is right, by the edges alone.
        wrong_parity: Whether other bits are likelier without the parity.
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
    """The state of decoding a stream; without arguments that before the first event.

    Attributes:
        first: Tick of the stream at which `counts` starts.
        counts: Events of each tick, OFF and ON, int32 (2, n); n is 0 before the first event.
        start: Tick before which no character may start: the end of the last one.
        known_from: First tick whose events are known; a character may start before it.
        light: The light, once it is learned.
        empty_stretches: Stretches with events and without a character since the last one.
        grain: Resolution of times.
        spread: Ticks to spread the events of a tick over, by the resolution of their times.
        tried: Stretches with events without light, searched or not.
        blocks: Blocks of the next stretch.
        tally: Counts so far.
    """

    first: int = 0
    counts: NDArray[np.int32] = field(default_factory=lambda: np.zeros((2, 0), np.int32))
    start: int = 0
    known_from: int = 0
    light: Light | None = None
    empty_stretches: int = 0
    grain: TimeGrain = field(default_factory=TimeGrain)
    spread: int = 1
    tried: int = 0
    blocks: int = 1
    tally: dict[str, int] = field(
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
    """Decodes characters from times and polarities, step by step.

    Attributes:
        reader: The reader of a stretch.
        bit_us: Nominal length of a bit, us.
        mark_on: Whether the light is on for a mark, which is 1 and idle.
    """

    reader: CharacterReader
    bit_us: float
    mark_on: bool

    def step(
        self, state: CharacterState, t_us: Ticks, p: NDArray[np.uint8], until_us: float
    ) -> tuple[CharacterState, list[Character]]:
        """Count the events before `until_us`, and decode what is certain by then.

        `t_us` are ascending times, int64 (n,), `p` polarities, uint8 (n,). The given state is not changed.
        """
        state = self._count_events(state, t_us, p, until_us)
        found: list[Character] = []
        while state.counts.shape[1] >= state.blocks * self._block_ticks + self._lookahead_ticks:
            state, more = self._decode_stretch(state, state.blocks * self._block_ticks)
            found += more
        return state, found

    def close(self, state: CharacterState) -> tuple[CharacterState, list[Character]]:
        """End the stream; return the characters that are left."""
        n = state.counts.shape[1]
        if not n:
            return state, []
        return self._decode_stretch(state, n, last=True)

    @property
    def _block_ticks(self) -> int:
        return _BLOCK * self.reader.length

    @property
    def _lookahead_ticks(self) -> int:
        return _LOOKAHEAD * self.reader.length + TAIL

    def _count_events(
        self, state: CharacterState, t_us: Ticks, p: NDArray[np.uint8], until_us: float
    ) -> CharacterState:
        """Count events by tick, on a grid fixed in time."""
        first, known = state.first, state.counts.shape[1]
        tick_us = self.bit_us / TICKS
        if not known:
            if not len(t_us):
                return state
            # A character may have started before its first event.
            known_from = int(t_us[0] // tick_us) - _BEFORE_FIRST
            first = known_from - self.reader.length - TICKS
            state = replace(state, start=first, known_from=known_from)
        ticks = np.floor_divide(t_us, tick_us).astype(np.int64) - first
        end = max(int(np.floor(until_us / tick_us)) - first, known, int(ticks[-1]) + 1 if len(ticks) else 0)
        counts = np.zeros((2, end), np.int32)
        counts[:, :known] = state.counts
        inside = ticks >= 0
        np.add.at(counts, (p[inside].astype(np.int64), ticks[inside]), 1)
        return replace(state, first=first, counts=counts, grain=state.grain.update(t_us))

    def _decode_stretch(
        self, state: CharacterState, due: int, last: bool = False
    ) -> tuple[CharacterState, list[Character]]:
        """Decode the first `due` ticks, with lookahead unless they are the last ones."""
        stretch, spread = self._prepare_stretch(state, due, last)
        enough = int(stretch.counts[:, :due].sum()) >= _MIN_EVENTS
        after = replace(
            state,
            first=state.first + due,
            # A copy releases the memory of what is done.
            counts=state.counts[:, due:].copy(),
            start=state.first + stretch.start,
            spread=spread,
        )
        if state.light is None and enough:
            # A search takes long, so it becomes rarer the longer there is no light.
            light, other, tried = None, False, state.tried
            if tried & (tried - 1) == 0 or tried % _SEARCH_PERIOD == 0:
                light, other = acquire_light(self.reader, self.mark_on, stretch)
            if light is None and not other and state.blocks == 1 and not last:
                return replace(state, blocks=_DIM_BLOCKS), []
            tried = 0 if light is not None else max(tried, _SEARCH_PERIOD // 2 if other else 0) + 1
            after = replace(after, light=light, tried=tried)
        if after.light is None:
            return replace(after, tally=_add_counts(state.tally, stretches_without_light=int(enough))), []
        after, found, sure = self._read_characters(after, stretch, due, last, is_new=state.light is None)
        if state.light is None and sure < _CLEAR_QUALITY and state.blocks == 1 and not last:
            return replace(state, blocks=_DIM_BLOCKS), []
        if after.start == state.first + stretch.start and enough:
            # No character started.
            lost = state.empty_stretches + 1 >= _MAX_EMPTY
            light, empty_stretches = (None, 0) if lost else (after.light, state.empty_stretches + 1)
            after = replace(after, light=light, empty_stretches=empty_stretches)
        return replace(after, blocks=1 if sure >= _CLEAR_QUALITY else _DIM_BLOCKS), found

    def _prepare_stretch(self, state: CharacterState, due: int, last: bool) -> tuple[Stretch, int]:
        """Return the stretch for the first `due` ticks, and over how many ticks its events are spread."""
        # With the same lookahead any split of the stream gives the same result.
        counts, spread = state.counts[:, : due + self._lookahead_ticks], state.spread
        if state.light is None:
            spread = _find_bunch_spacing(counts[:, :due])
            # A resolution that becomes known later is not used yet, in whatever pieces events come.
            grain = state.grain
            if grain.known_us is not None and grain.known_us * TICKS // self.bit_us < state.first + due:
                spread = max(spread, round(grain.step_us * TICKS / self.bit_us))
        counts = _spread_events(counts, min(spread, TICKS))
        end = counts.shape[1] - (0 if last else TAIL)
        # A character may extend beyond the known events.
        counts = np.pad(counts, ((0, 0), (0, self.reader.length + 2 * TAIL)))
        start, known_from = max(state.start - state.first, 0), max(state.known_from - state.first, 0)
        return Stretch(counts, start, known_from, end), spread

    def _read_characters(
        self, after: CharacterState, stretch: Stretch, due: int, last: bool, is_new: bool
    ) -> tuple[CharacterState, list[Character], float]:
        """Read the characters of the first `due` ticks of a stretch with the light of `after`.

        Returns:
            The state after them, the characters, and their mean quality, 1 without any.
        """
        assert after.light is not None
        # The stretch is read with the light that it teaches itself.
        starts, evidence, _ = self.reader.find_path(stretch, after.light, False)
        memory = _MEMORY ** (due / self._block_ticks)
        light = self.reader.learn_light(stretch, after.light, starts, evidence, memory)
        starts, evidence, score = self.reader.find_path(stretch, light, False)
        starts = starts[starts < due]
        kept = starts[starts + EARLY >= stretch.known_from]
        first = after.first - due
        found = self._make_characters(first, kept, evidence, light)
        if last and found:
            # The last edge of a character may be that before its first stop bit.
            needs = int(kept[-1]) + (self.reader.characters.bits - self.reader.characters.stop_bits) * TICKS
            if needs >= stretch.end and (found[-1].quality < _MIN_LAST_QUALITY or found[-1].wrong_parity):
                found.pop()
        by_chance, ambiguous = 0, 0
        if is_new:
            ambiguous = self.reader.count_ambiguous(stretch, light, kept, evidence, score)
            clear = found[ambiguous:]
            found = _drop_chance_characters(clear)
            by_chance = len(clear) - len(found)
        tally = _add_counts(
            after.tally,
            characters=len(found),
            characters_by_chance=by_chance,
            characters_ambiguous=ambiguous,
            characters_wrong_parity=sum(one.wrong_parity for one in found),
            frames_inverted=len(found) * light.inverted,
        )
        after = replace(after, light=light, tally=tally)
        if len(starts):
            start = first + int(starts[-1]) + round(self.reader.length * light.rate) - NEAR
            after = replace(after, start=start, empty_stretches=0)
        return after, found, float(np.mean([one.quality for one in found])) if found else 1.0

    def _make_characters(self, first: int, starts: Ticks, evidence: Floats, light: Light) -> list[Character]:
        at = evidence[starts[:, None] + self.reader.bit_offsets(light)]
        values, llr, quality = self.reader.characters.decide(self.reader.characters.likelihoods(at))
        wrong = self.reader.characters.has_wrong_parity(at)
        t_us = (first + starts + EARLY) * (self.bit_us / TICKS)
        columns = (t_us.tolist(), values.tolist(), llr, quality.tolist(), wrong.tolist())
        return [Character(*row, self.bit_us * light.rate) for row in zip(*columns, strict=True)]


def _add_counts(tally: dict[str, int], **more: int) -> dict[str, int]:
    return tally | {name: tally[name] + count for name, count in more.items()}


def _find_bunch_spacing(counts: NDArray[np.int32]) -> int:
    """Return the spacing in ticks of the bunches in which a camera reads events out; 1 without bunches."""
    total = counts.sum(0)
    at = np.flatnonzero(total)
    many, gaps = total[at], np.diff(at)
    near = gaps <= _BUNCH_TICKS
    if not near.any() or (many * many).sum() < _BUNCH_EVENTS * many.sum():
        return 1
    weights = np.minimum(many[:-1], many[1:])[near]
    return int(np.quantile(gaps[near], 0.5, weights=weights, method="inverted_cdf"))


def _spread_events(counts: NDArray[np.int32], ticks: int) -> NDArray[np.int32]:
    """Spread the events of each tick evenly over some ticks around it, as whole events, int32 (2, n)."""
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
    # Events beyond the ends stay inside.
    until[:, -1] = total[:, -1]
    return np.diff(until, axis=1, prepend=0).astype(np.int32)


def _drop_chance_characters(found: list[Character]) -> list[Character]:
    """Drop first characters that are few before a pause and of low quality, as noise gives them."""
    gaps = np.diff([one.t_us for one in found])
    length = float(np.median(gaps)) if len(gaps) else np.inf
    paused = np.flatnonzero(gaps > 1.5 * length) + 1
    if len(paused) and (few := int(paused[0])) < MIN_CHARACTERS:
        sure = float(np.mean([one.quality for one in found[:few]]))
        return found[few:] if sure < _MIN_FIRST_QUALITY else found
    return found
