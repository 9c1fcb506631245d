"""The clock that the receiver believes, and time steps on it: both against loops over single events."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from evlcp_sdk.clock import LEAP_US, CameraClock, Timeline, TimeStep
from evlcp_sdk.values import Events

Row = tuple[int, ...]
STEP_US, WIDTH, HEIGHT = 100, 8, 6
CUTS = st.lists(st.integers(0, 300), max_size=40)


def twin_clock(rows):
    """What `CameraClock` keeps of events (t, x, y, p): rows inside, its counts, and first drops."""
    leap, setback, far = 1_000_000, 10_000, 2**62
    kept, held, last, offset = [], [], None, 0
    counts = dict.fromkeys(("backward", "off", "doubtful", "leaps", "restarts"), 0)
    firsts = {}

    def drop(name, *numbers):
        counts[name] += len(numbers)
        firsts[name] = min([*numbers, firsts.get(name, len(rows))])

    for number, row in enumerate(rows):
        t = row[0]
        if row[1] >= WIDTH or row[2] >= HEIGHT:
            drop("off", number)
            continue
        if abs(t) > far:
            drop("doubtful", number)
            continue
        if last is None:
            last = offset = t
        if last <= t <= last + leap:
            drop("doubtful", *(k for k, _ in held))
            held, last = [], t
            kept.append((t - offset, *row[1:]))
        elif last - setback <= t < last or (held and held[-1][1][0] - setback <= t < held[-1][1][0]):
            drop("backward", number)
        else:
            if held and not held[-1][1][0] <= t <= held[-1][1][0] + leap:
                drop("doubtful", *(k for k, _ in held))
                held = []
            held.append((number, row))
            begin = held[0][1][0]
            if len(held) >= 16 and t - begin >= 10_000:
                counts["leaps" if begin > last else "restarts"] += 1
                offset = begin - (kept[-1][0] + 4_000_000)
                kept += [(h[0] - offset, *h[1:]) for _, h in held]
                held, last = [], t
    drop("doubtful", *(k for k, _ in held))
    return kept, counts, {name: first for name, first in firsts.items() if counts[name]}


NAMES = {
    "backward": "dropped_time_backward",
    "off": "dropped_off_sensor",
    "doubtful": "dropped_time_doubtful",
    "leaps": "clock_leaps",
    "restarts": "clock_restarts",
}


def leaping(seed: int, parts: int = 12) -> Events:
    """Stretches of a clock that leaps both ways, some too short to be believed, with lone events between."""
    rng = np.random.default_rng(seed)
    t: list[int] = []
    now = int(rng.choice([0, -(10**6), 1_700_000_000_000_000]))
    for _ in range(parts):
        many = int(rng.choice([1, 3, 15, 16, 17, 60]))
        t += (now + np.cumsum(rng.choice([0, 1, 300, 1500, 40_000], many))).tolist()
        now = t[-1] + int(
            rng.choice([10, -50, -9_000, -20_000, LEAP_US, LEAP_US + 1, -(10**12), 10**13, -(2**40), 2**34])
        )
        if rng.random() < 0.2:
            t.append(int(rng.choice([2**63 - 1, -(2**63), 2**62, 0])))
    return anywhere(np.array(t, np.int64), rng)


def anywhere(t_us: np.ndarray, rng: np.random.Generator) -> Events:
    """Events at these times, some off the sensor."""
    n = len(t_us)
    places = rng.integers(0, WIDTH + 1, n), rng.integers(0, HEIGHT + 1, n)
    return Events.of(t_us, *places, rng.integers(0, 2, n))


def rows(events: Events) -> list[Row]:
    return list(zip(*(c.tolist() for c in (events.t_us, events.x, events.y, events.p)), strict=True))


def take_in_pieces(events: Events, cuts: list[int]) -> tuple[list[Row], CameraClock]:
    clock = CameraClock(WIDTH, HEIGHT)
    pieces = [e for a, b in pairwise([0, *cuts, len(events)]) for e in clock.feed(events[a:b])]
    clock.close()
    return [row for e in pieces for row in rows(e)], clock


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 10_000), CUTS)
def test_any_split_is_assessed_event_by_event(seed: int, cuts: list[int]) -> None:
    events = leaping(seed)
    want, counts, firsts = twin_clock(rows(events))
    got, clock = take_in_pieces(events, sorted(min(cut, len(events)) for cut in cuts))
    assert got == want
    assert {name: clock.counts[expected] for name, expected in NAMES.items()} == counts
    assert clock.firsts == {NAMES[name]: first for name, first in firsts.items()}
    dropped = sum(counts[name] for name in ("backward", "off", "doubtful"))
    assert clock.counts["events"] == len(events) == len(got) + dropped
    assert all(a[0] <= b[0] for a, b in pairwise(got))


def even(start_us: int, n: int = 2000, step_us: int = 50) -> Events:
    t = start_us + np.arange(n) * step_us
    return Events.of(t, t * 0, t * 0, t * 0)


@pytest.mark.parametrize("leap_us", [-90_000, -(10**12), LEAP_US + 1, 2**40])
def test_a_clock_that_others_agree_on_is_believed_and_nothing_is_lost(leap_us: int) -> None:
    one = even(10**12)
    other = even(int(one.t_us[-1]) + leap_us)
    got, clock = take_in_pieces(Events.concat([one, other]), [100, 2100])
    assert len(got) == len(one) + len(other)
    assert clock.counts["clock_restarts" if leap_us < 0 else "clock_leaps"] == 1
    assert [clock.camera_us(float(row[0])) for row in got] == [*one.t_us, *other.t_us]


def test_what_is_held_is_bounded() -> None:
    clock = CameraClock(WIDTH, HEIGHT)
    clock.feed(even(10**12))
    still = Events.of(np.full(1 << 19, 7), *np.zeros((3, 1 << 19)))
    assert clock.feed(still) == []
    assert sum(map(len, clock.feed(still))) == 1 << 20
    assert clock.counts["clock_restarts"] == 1


def with_gaps(seed: int, n: int = 300) -> Events:
    """Some in disorder, with gaps of a few steps and of many."""
    rng = np.random.default_rng(seed)
    gaps = rng.choice([0, 1, 7, 150, 2000, 50_000], n, p=[0.2, 0.35, 0.3, 0.1, 0.04, 0.01])
    return anywhere(12_345 + np.cumsum(gaps) - rng.choice([0, 0, 0, 40], n), rng)


def steps_of(
    events: Events, cuts: list[int], *, waits: int = 0, dues_us: list[int] | None = None
) -> tuple[list[TimeStep], Timeline]:
    """The steps of a stream in pieces; after one with events, `waits` empty ones are waited for.

    Where something is due at times inside, parts of steps, too.
    """
    timeline = Timeline(STEP_US, WIDTH, HEIGHT, 10**6)
    steps: list[TimeStep] = []

    def waiting() -> bool:
        return any(len(s.events) for s in steps[-waits:]) if waits else False

    def due_us() -> float:
        now_us = steps[-1].end_us if steps else 0
        return min((due - 0.5 for due in dues_us or () if due > now_us), default=math.inf)

    for a, b in pairwise([0, *sorted(cuts), len(events)]):
        # One by one: what is due depends on the last.
        for step in timeline.feed(events[a:b], waiting, due_us):
            steps.append(step)
    return steps + list(timeline.close()), timeline


def plain(steps: list[TimeStep]) -> list[tuple[object, ...]]:
    return [(s.start_us, s.end_us, s.after_gap, rows(s.events)) for s in steps]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("waits", [0, 1, 3])
def test_every_event_is_in_its_step_once_and_gaps_are_left_out(seed: int, waits: int) -> None:
    events = with_gaps(seed)
    want, counts, _ = twin_clock(rows(events))
    steps, timeline = steps_of(events, [], waits=waits)
    assert [row for s in steps for row in rows(s.events)] == want
    assert all(s.start_us % STEP_US == 0 for s in steps)
    assert all(s.start_us <= t < s.start_us + STEP_US for s in steps for t in s.events.t_us)
    assert [s.end_us for s in steps[:-1]] == [s.start_us + STEP_US for s in steps[:-1]]
    assert steps[-1].end_us == timeline.clock.last_us == want[-1][0]
    assert {name: timeline.clock.counts[expected] for name, expected in NAMES.items()} == counts
    assert min(counts["backward"], counts["off"]) > 0
    assert timeline.clock.counts["events"] == len(events)
    # A gap is left out as soon as nobody waits.
    assert not steps[0].after_gap
    empty = 0
    for before, after in pairwise(steps):
        empty = 0 if len(before.events) else empty + 1
        assert after.after_gap == (after.start_us > before.start_us + STEP_US)
        assert empty <= waits
        assert not after.after_gap or (empty == waits and len(after.events))
    assert any(s.after_gap for s in steps)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 20), CUTS, st.sampled_from([0, 1, 3]))
def test_any_split_of_the_stream_gives_the_same_steps(seed: int, cuts: list[int], waits: int) -> None:
    events = with_gaps(seed)
    whole, timeline = steps_of(events, [], waits=waits)
    pieces, other = steps_of(events, cuts, waits=waits)
    assert plain(pieces) == plain(whole)
    assert other.clock.counts == timeline.clock.counts


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 20), CUTS, st.sets(st.integers(1, 20_000)))
def test_a_part_of_a_step_comes_when_it_is_due(seed: int, cuts: list[int], dues: set[int]) -> None:
    events = with_gaps(seed)
    steps, _ = steps_of(events, [])
    starts_us = {step.start_us for step in steps}
    # Nothing is due in a gap, in which nobody waits.
    dues_us = sorted(due for due in dues if due // STEP_US * STEP_US in starts_us)
    given_, _ = steps_of(events, cuts, dues_us=dues_us)
    assert plain([s for s in given_ if s.is_whole]) == plain(steps)
    # The last step ends with the stream, and may have parts, too.
    want = []
    for step in steps:
        within = rows(step.events)
        for due in dues_us:
            if step.start_us < due < step.start_us + STEP_US and any(t >= due for t, *_ in within):
                want.append((step.start_us, due, [row for row in within if row[0] < due]))
    assert [(s.start_us, s.end_us, rows(s.events)) for s in given_ if not s.is_whole] == want


def test_a_stream_without_events_has_no_steps() -> None:
    off = Events.of([5, 6], [WIDTH, 0], [0, HEIGHT], [1, 1])
    steps, timeline = steps_of(Events.concat([Events.empty(), off]), [0, 1], waits=1)
    assert steps == []
    assert timeline.clock.counts["events"] == timeline.clock.counts["dropped_off_sensor"] == 2
