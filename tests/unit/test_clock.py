"""The clock that the receiver believes, against a loop over single events."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from evlcp_sdk.clock import LEAP_US, CameraClock
from evlcp_sdk.values import Events


def twin_clock(rows, width, height):
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
        if row[1] >= width or row[2] >= height:
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


WIDTH, HEIGHT = 8, 6
NAMES = {
    "backward": "dropped_time_backward",
    "off": "dropped_off_sensor",
    "doubtful": "dropped_time_doubtful",
    "leaps": "clock_leaps",
    "restarts": "clock_restarts",
}


def stream(seed: int, parts: int = 12) -> Events:
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
    times = np.array(t, np.int64)
    n = len(times)
    return Events.of(times, rng.integers(0, WIDTH + 1, n), rng.integers(0, HEIGHT, n), rng.integers(0, 2, n))


def rows(events: Events) -> list[tuple[int, ...]]:
    return list(zip(*(c.tolist() for c in (events.t_us, events.x, events.y, events.p)), strict=True))


def taken(events: Events, cuts: list[int]) -> tuple[list[tuple[int, ...]], CameraClock]:
    clock = CameraClock(WIDTH, HEIGHT)
    pieces = [e for a, b in pairwise([0, *cuts, len(events)]) for e in clock.take(events[a:b])]
    clock.close()
    return [row for e in pieces for row in rows(e)], clock


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 10_000), st.lists(st.integers(0, 300), max_size=30))
def test_any_split_is_judged_event_by_event(seed: int, cuts: list[int]) -> None:
    events = stream(seed)
    want, counts, firsts = twin_clock(rows(events), WIDTH, HEIGHT)
    got, clock = taken(events, sorted(min(cut, len(events)) for cut in cuts))
    assert got == want
    assert {name: clock.counts[told] for name, told in NAMES.items()} == counts
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
    got, clock = taken(Events.concat([one, other]), [100, 2100])
    assert len(got) == len(one) + len(other)
    assert clock.counts["clock_restarts" if leap_us < 0 else "clock_leaps"] == 1
    assert [clock.camera_us(float(row[0])) for row in got] == [*one.t_us, *other.t_us]


@pytest.mark.parametrize("leap_us", [-(10**9), LEAP_US + 1, 2**50, 2**63 - 1 - 10**12])
@pytest.mark.parametrize("many", [1, 15])
def test_a_clock_that_few_agree_on_costs_its_own_events(leap_us: int, many: int) -> None:
    events = even(10**12)
    events.t_us[700 : 700 + many] += leap_us
    got, clock = taken(events, [705])
    assert len(got) == len(events) - many
    assert clock.counts["dropped_time_doubtful"] == many
    assert clock.counts["clock_leaps"] == clock.counts["clock_restarts"] == 0


def test_what_is_held_is_bounded() -> None:
    clock = CameraClock(WIDTH, HEIGHT)
    clock.take(even(10**12))
    still = Events.of(np.full(1 << 19, 7), *np.zeros((3, 1 << 19)))
    assert clock.take(still) == []
    assert sum(map(len, clock.take(still))) == 1 << 20
    assert clock.counts["clock_restarts"] == 1
