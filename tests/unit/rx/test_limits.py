"""What the receiver holds at the most: each limit with a stream that would take more, and any split of it."""

import tracemalloc
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.link.sections import RegionSpec
from evlcp_sdk.rx.detection import RegionFollower
from evlcp_sdk.rx.limits import EVENT_BYTES, LIMITS, PIECE_BYTES, Limits
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.rx.timeline import Timeline
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, merged, random_symbols
from evlcp_sdk.values import Events, Packet

LINK = load_link()
SPEC = RegionSpec(step_us=1000)
KEEP_US = 20_000


def noise(many: int, until_us: int, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, until_us, many))
    return Events.of(t, rng.integers(0, 1280, many), rng.integers(0, 720, many), rng.integers(0, 2, many))


def blobs(columns: int, rows: int, until_us: int, x0: int = 10) -> Events:
    """Blobs of 9 px in a grid of 60 px, each with a code of its own at the chips of the link."""
    rng = np.random.default_rng(1)
    chip_us = round(LINK.packet.chip_us)
    found = []
    for u in range(columns):
        for v in range(rows):
            t = np.cumsum(rng.integers(2, 5, until_us // (2 * chip_us))) * chip_us
            t = t[t < until_us - chip_us]
            edges = np.concatenate([t, t + 40])
            edges, p = np.repeat(edges, 18), np.repeat(np.repeat([1, 0], len(t)), 18)
            x = x0 + 60 * u + np.tile([0, 1, 2] * 6, len(t) * 2)
            y = 10 + 60 * v + np.tile([0, 0, 0, 1, 1, 1, 2, 2, 2] * 2, len(t) * 2)
            order = np.argsort(edges, kind="stable")
            found.append(Events.of(edges[order], x[order], y[order], p[order]))
    return merged(*found)


def stepped(follower: RegionFollower, events: Events, until_us: int) -> Iterator[int]:
    bounds = np.searchsorted(events.t_us, np.arange(0, until_us + 1, SPEC.step_us)).tolist()
    for n, (a, b) in enumerate(pairwise(bounds)):
        follower.step(n * SPEC.step_us, events[a:b])
        yield n


def follower(**limits: int) -> RegionFollower:
    return RegionFollower(SPEC, CameraModel(), LINK.packet.chip_us, None, KEEP_US, Limits(**limits))


def kept_bytes(regions: RegionFollower) -> int:
    """Of all regions, counted anew."""
    return sum(PIECE_BYTES + EVENT_BYTES * len(e) for one in regions.alive for _, e in one.pieces)


@pytest.mark.parametrize("size", [7, 1000, 10**6])
def test_a_step_takes_its_first_events(size: int) -> None:
    events = noise(9000, 3000)
    timeline = Timeline(1000, 1280, 720, Limits(step_events=2000))
    steps = [s for a in range(0, 9000, size) for s in timeline.feed(events[a : a + size], lambda: True)]
    steps += timeline.close()
    times = events.t_us - events.t_us[0]
    for n, step in enumerate(steps):
        mine = np.flatnonzero(times // 1000 == n)[:2000]
        assert np.array_equal(step.events.t_us, times[mine])
        assert np.array_equal(step.events.x, events.x[mine])
    assert timeline.dropped == 9000 - sum(len(s.events) for s in steps) > 2000


def test_small_pieces_of_a_step_take_the_memory_of_their_events() -> None:
    events = Events.of(np.zeros(20_000, np.int64), *np.ones((3, 20_000), np.int64))
    timeline = Timeline(1000, 1280, 720)
    tracemalloc.start()
    for k in range(len(events)):
        list(timeline.feed(events[k : k + 1], lambda: True))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # 700 bytes a piece would be 14 MB.
    assert peak < 4e6
    (step,) = timeline.close()
    assert len(step.events) == 20_000


def test_the_whole_image_is_forgotten_sooner_where_it_takes_too_much() -> None:
    events = noise(200_000, 30_000)
    regions = follower(recent_bytes=400_000)
    for _ in stepped(regions, events, 30_000):
        recent = sum(PIECE_BYTES + EVENT_BYTES * len(e) for _, e in regions._recent)
        assert recent <= 400_000
    assert regions.counts["steps_forgotten"] > 0
    free = follower()
    for _ in stepped(free, events, 30_000):
        pass
    assert sum(EVENT_BYTES * len(e) for _, e in free._recent) > 1_000_000
    assert free.counts["steps_forgotten"] == 0


def test_the_oldest_events_of_regions_are_forgotten() -> None:
    events = blobs(5, 4, 40_000)
    regions, free = follower(region_bytes=150_000), follower()
    most = 0
    for _ in stepped(regions, events, 40_000):
        # What came in the last step is checked at its end.
        assert kept_bytes(regions) <= 150_000 + 20 * (PIECE_BYTES + 1000 * EVENT_BYTES)
        assert all(one.held_bytes == kept for one, kept in zip(regions.alive, _each(regions), strict=True))
    for _ in stepped(free, events, 40_000):
        most = max(most, kept_bytes(free))
    assert most > 400_000
    assert regions.counts["dropped_no_room"] > 0
    cut = [one for one in regions.alive if one.cut_us is not None]
    assert cut
    assert all(one.pieces[0][0] >= one.cut_us == one.first_us for one in cut if one.cut_us is not None)
    assert free.counts["dropped_no_room"] == 0


def _each(regions: RegionFollower) -> list[int]:
    return [sum(PIECE_BYTES + EVENT_BYTES * len(e) for _, e in one.pieces) for one in regions.alive]


def test_a_region_that_had_its_time_gives_way() -> None:
    events = blobs(6, 3, 60_000)
    regions = follower(regions=7)
    seen = set()
    for _ in stepped(regions, events, 60_000):
        assert len(regions.alive) <= 7
        seen |= {one.id for one in regions.alive}
    assert regions.counts["regions_gave_way"] > 0
    assert regions.counts["regions_left_out"] > 0
    # Every blob had its turn.
    assert len(seen) >= 18
    free = follower()
    for _ in stepped(free, events, 60_000):
        pass
    assert len(free.alive) == 18


def test_of_many_areas_those_with_the_most_rises_are_looked_at() -> None:
    dim = blobs(8, 5, 40_000)
    dim = dim[np.random.default_rng(2).random(len(dim)) < 0.6]
    bar = ideal_events(LINK, IdealBar(random_symbols(LINK, 2), x_px=900))
    events = merged(dim, bar[: np.searchsorted(bar.t_us, 40_000)])
    regions = follower(areas=4)
    for _ in stepped(regions, events, 40_000):
        pass
    assert regions.counts["areas_left_out"] > 0
    assert any(abs(one.latest.x_px - 900) < 5 for one in regions.alive)


SMALL = Limits(22_000, 1_500_000, 700_000, 6, 5, 4)
CROWD = merged(
    blobs(2, 4, 120_000),
    ideal_events(LINK, IdealBar(random_symbols(LINK, 3, 1), x_px=700)),
    noise(200_000, 120_000, seed=5),
)


def told(size: int, limits: Limits) -> tuple[list[tuple[Any, ...]], dict[str, int]]:
    receiver = Receiver(LINK, limits=limits)
    packets: list[Packet] = []
    for a in range(0, len(CROWD), size):
        packets += receiver.feed(CROWD[a : a + size])
    packets += receiver.close()
    frames = [(f.transmitter, f.t_us, f.soft.symbols.tobytes(), f.range) for p in packets for f in p.frames]
    return frames, receiver.counts


def test_any_split_gives_the_same_within_limits() -> None:
    whole, counts = told(len(CROWD), SMALL)
    for size in (900, 20_011):
        assert told(size, SMALL) == (whole, counts)
    names = ("dropped_crowded", "steps_forgotten", "dropped_no_room", "regions_gave_way", "areas_left_out")
    assert all(counts[name] > 0 for name in names), counts
    assert len(whole) >= 5


def test_a_stream_that_has_ended_takes_no_memory() -> None:
    receiver = Receiver(LINK)
    receiver.feed(CROWD)
    assert receiver._receivers[0]._regions._recent
    receiver.close()
    assert not receiver._receivers[0]._regions._recent
    assert not receiver._receivers[0]._regions.alive
    assert receiver.counts["events"] == len(CROWD)


def test_within_the_defaults_nothing_is_left_out() -> None:
    frames, counts = told(len(CROWD), LIMITS)
    assert len(frames) >= 10
    names = ("dropped_crowded", "steps_forgotten", "dropped_no_room", "regions_left_out", "areas_left_out")
    assert [counts[name] for name in (*names, "regions_gave_way", "frames_cut")] == [0] * 7


def test_the_memory_of_a_receiver_is_bounded() -> None:
    """Many events, at the limits that take a tenth of the memory, and at the defaults, which take it all."""
    events = noise(4_000_000, 60_000)
    peaks = []
    for limits in (Limits(step_events=1 << 17, recent_bytes=6 << 20), LIMITS):
        receiver = Receiver(LINK, limits=limits)
        receiver.feed(events[:1000])
        tracemalloc.start()
        for a in range(1000, len(events), 65_536):
            receiver.feed(events[a : a + 65_536])
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[0] < 20e6
    assert peaks[1] > 40e6
