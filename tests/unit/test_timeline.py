"""Time steps of a stream: the laws of the grid, against a loop over single events."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from evlcp_sdk.clock import Timeline, TimeStep
from evlcp_sdk.values import Events

STEP_US, WIDTH, HEIGHT = 100, 8, 6


def stream(seed: int, n: int = 300) -> Events:
    """Some in disorder, some off the sensor, with gaps of a few steps and of many."""
    rng = np.random.default_rng(seed)
    gaps = rng.choice([0, 1, 7, 150, 2000, 50_000], n, p=[0.2, 0.35, 0.3, 0.1, 0.04, 0.01])
    t = 12_345 + np.cumsum(gaps) - rng.choice([0, 0, 0, 40], n)
    return Events.of(t, rng.integers(0, WIDTH + 1, n), rng.integers(0, HEIGHT + 1, n), rng.integers(0, 2, n))


def kept(events: Events) -> tuple[list[tuple[int, ...]], int, int]:
    """The events that are taken, one by one; and how many lie off the sensor, or else before one of those."""
    found: list[tuple[int, ...]] = []
    backward = off = 0
    for row in rows(events):
        if row[1] >= WIDTH or row[2] >= HEIGHT:
            off += 1
        elif found and row[0] < found[-1][0]:
            backward += 1
        else:
            found.append(row)
    return found, backward, off


def rows(events: Events) -> list[tuple[int, ...]]:
    return list(zip(*(c.tolist() for c in (events.t_us, events.x, events.y, events.p)), strict=True))


def steps_of(events: Events, cuts: list[int], *, waits: int) -> tuple[list[TimeStep], Timeline]:
    """The steps of a stream in pieces; after one with events, `waits` empty ones are waited for."""
    timeline = Timeline(STEP_US, WIDTH, HEIGHT, 10**6)
    steps: list[TimeStep] = []

    def waiting() -> bool:
        return any(len(s.events) for s in steps[-waits:]) if waits else False

    for a, b in pairwise([0, *cuts, len(events)]):
        for step in timeline.feed(events[a:b], waiting, lambda: math.inf):
            steps.append(step)
    return steps + list(timeline.close()), timeline


def plain(steps: list[TimeStep]) -> list[tuple[object, ...]]:
    return [(s.start_us, s.end_us, s.after_gap, rows(s.events)) for s in steps]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("waits", [0, 1, 3])
def test_every_event_is_in_its_step_once(seed: int, waits: int) -> None:
    events = stream(seed)
    want, backward, off = kept(events)
    steps, timeline = steps_of(events, [], waits=waits)
    first = want[0][0]
    assert [(first + t, *row) for s in steps for t, *row in rows(s.events)] == want
    assert all(s.start_us % STEP_US == 0 for s in steps)
    assert all(s.start_us <= t < s.start_us + STEP_US for s in steps for t in s.events.t_us)
    assert [s.end_us for s in steps[:-1]] == [s.start_us + STEP_US for s in steps[:-1]]
    assert steps[-1].end_us == timeline.clock.last_us == want[-1][0] - first
    assert backward
    assert off
    counts = timeline.clock.counts
    assert counts["events"] == len(events)
    assert (counts["dropped_time_backward"], counts["dropped_off_sensor"]) == (backward, off)


@pytest.mark.parametrize("waits", [0, 1, 3])
def test_a_gap_is_left_out_as_soon_as_nobody_waits(waits: int) -> None:
    steps, _ = steps_of(stream(7), [], waits=waits)
    assert not steps[0].after_gap
    empty = 0
    for before, after in pairwise(steps):
        empty = 0 if len(before.events) else empty + 1
        assert after.after_gap == (after.start_us > before.start_us + STEP_US)
        assert empty <= waits
        if after.after_gap:
            assert empty == waits
            assert len(after.events)
    assert any(s.after_gap for s in steps)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 20), st.lists(st.integers(0, 300), max_size=40), st.sampled_from([0, 1, 3]))
def test_any_split_of_the_stream_gives_the_same_steps(seed: int, cuts: list[int], waits: int) -> None:
    events = stream(seed)
    whole, timeline = steps_of(events, [], waits=waits)
    pieces, other = steps_of(events, sorted(cuts), waits=waits)
    assert plain(pieces) == plain(whole)
    assert other.clock.counts == timeline.clock.counts


def parts_of(events: Events, cuts: list[int], dues_us: list[int]) -> list[TimeStep]:
    """Steps and parts of a stream in pieces, where something is due at times inside."""
    timeline = Timeline(STEP_US, WIDTH, HEIGHT, 10**6)
    steps: list[TimeStep] = []

    def due_us() -> float:
        now_us = steps[-1].end_us if steps else 0
        return min((due - 0.5 for due in dues_us if due > now_us), default=float("inf"))

    for a, b in pairwise([0, *cuts, len(events)]):
        for step in timeline.feed(events[a:b], lambda: False, due_us):
            steps.append(step)
    return steps + list(timeline.close())


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 20), st.lists(st.integers(0, 300), max_size=40), st.sets(st.integers(1, 20_000)))
def test_a_part_of_a_step_comes_when_it_is_due(seed: int, cuts: list[int], dues: set[int]) -> None:
    events = stream(seed)
    starts_us = {step.start_us for step in steps_of(events, [], waits=0)[0]}
    # Nothing is due in a gap, in which nobody waits.
    dues_us = sorted(due for due in dues if due // STEP_US * STEP_US in starts_us)
    given_ = parts_of(events, sorted(cuts), dues_us)
    assert plain([s for s in given_ if s.whole]) == plain(steps_of(events, [], waits=0)[0])
    found = [(s.start_us, s.end_us, rows(s.events)) for s in given_ if not s.whole]
    # One by one: the last step ends with the stream, and may have parts, too.
    want = []
    for step in (s for s in given_ if s.whole):
        within = rows(step.events)
        for due in dues_us:
            if step.start_us < due < step.start_us + STEP_US and any(t >= due for t, *_ in within):
                want.append((step.start_us, due, [row for row in within if row[0] < due]))
    assert found == want


def test_a_stream_without_events_has_no_steps() -> None:
    off = Events.of([5, 6], [WIDTH, 0], [0, HEIGHT], [1, 1])
    steps, timeline = steps_of(Events.concat([Events.empty(), off]), [0, 1], waits=1)
    assert steps == []
    assert timeline.clock.counts["events"] == timeline.clock.counts["dropped_off_sensor"] == 2
