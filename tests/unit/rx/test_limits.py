"""What the receiver holds at the most: each limit with a stream that would take more, and any split of it."""

import math
import tracemalloc
from itertools import product

import numpy as np
import pytest
from rx_streams import LINK, lit, noise_events, steps

from evlcp_sdk.clock import Timeline
from evlcp_sdk.link.sections import RegionSpec
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.rx.regions import EVENT_BYTES, PIECE_BYTES, RhythmTracker
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.testing.recordings import merge_events
from evlcp_sdk.values import Events

SPEC = RegionSpec(step_us=1000)
KEEP_US = 20_000


def blobs(columns, rows, until_us):
    """Blobs of 9 px in a grid of 60 px, each with a code of its own."""
    places = product(range(15, 60 * columns, 60), range(15, 60 * rows, 60))
    small = {"cluster_px": 9 / 16, "width_px": 3, "start_us": 0}
    found = merge_events(*(lit(4, k, x_px=x, y_px=y, **small)[1] for k, (x, y) in enumerate(places)))
    return found[: found.t_us.searchsorted(until_us)]


def step_tracker(events, until_us, **limits):
    """A tracker with these limits after each step of a stream."""
    regions = RhythmTracker(SPEC, CameraModel(), LINK.packet.chip_us, None, KEEP_US, Limits(**limits))
    for start_us, part in steps(events, until_us):
        regions.step(start_us, part)
        yield regions


def bytes_of(pieces):
    """Counted anew."""
    return sum(PIECE_BYTES + EVENT_BYTES * len(events) for _, events in pieces)


@pytest.mark.parametrize("size", [7, 1000, 10**6])
def test_a_step_takes_its_first_events(size):
    events = noise_events(3e6, 3000)
    timeline = Timeline(1000, 1280, 720, 2000)
    pieces = (events[a : a + size] for a in range(0, len(events), size))
    steps = [s for piece in pieces for s in timeline.feed(piece, lambda: True, lambda: math.inf)]
    steps += timeline.close()
    times = events.t_us - events.t_us[0]
    for n, step in enumerate(steps):
        mine = np.flatnonzero(times // 1000 == n)[:2000]
        assert np.array_equal(step.events.t_us, times[mine])
        assert np.array_equal(step.events.x, events.x[mine])
    assert timeline.dropped == len(events) - sum(len(s.events) for s in steps) > 2000


def test_small_pieces_of_a_step_take_the_memory_of_their_events():
    events = Events.of(np.zeros(20_000, np.int64), *np.ones((3, 20_000), np.int64))
    timeline = Timeline(1000, 1280, 720, 10**6)
    tracemalloc.start()
    for k in range(len(events)):
        list(timeline.feed(events[k : k + 1], lambda: True, lambda: math.inf))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # 700 bytes a piece would be 14 MB.
    assert peak < 4e6
    (step,) = timeline.close()
    assert len(step.events) == 20_000


def test_the_whole_image_is_forgotten_sooner_where_it_takes_too_much():
    events = noise_events(6.6e6, 30_000)
    for regions in step_tracker(events, 30_000, recent_bytes=400_000):
        assert bytes_of(regions._recent) <= 400_000
    assert regions.counts["steps_forgotten"] > 0
    *_, free = step_tracker(events, 30_000)
    assert bytes_of(free._recent) > 1_000_000
    assert free.counts["steps_forgotten"] == 0


def test_the_oldest_events_of_regions_are_forgotten():
    events = blobs(5, 4, 40_000)
    for regions in step_tracker(events, 40_000, region_bytes=150_000):
        held = [bytes_of(one.pieces) for one in regions.alive]
        # What came in the last step is checked at its end.
        assert sum(held) <= 150_000 + 20 * (PIECE_BYTES + 1000 * EVENT_BYTES)
        assert [one.memory_bytes for one in regions.alive] == held
    assert regions.counts["dropped_no_room"] > 0
    cut = [one for one in regions.alive if one.forgotten_until_us is not None]
    assert cut
    assert all(one.pieces[0][0] == one.forgotten_until_us == one.first_us for one in cut)
    free = [(sum(bytes_of(one.pieces) for one in r.alive), r.counts) for r in step_tracker(events, 40_000)]
    assert max(held for held, _ in free) > 400_000
    assert free[-1][1]["dropped_no_room"] == 0


def test_a_region_that_had_its_time_gives_way():
    events = blobs(6, 3, 60_000)
    seen = set()
    for regions in step_tracker(events, 60_000, regions=7):
        assert len(regions.alive) <= 7
        seen |= {one.id for one in regions.alive}
    assert regions.counts["regions_gave_way"] > 0
    assert regions.counts["regions_left_out"] > 0
    # Every blob had its turn.
    assert len(seen) >= 18
    *_, free = step_tracker(events, 60_000)
    assert len(free.alive) == 18


def test_the_memory_of_a_receiver_is_bounded():
    """Many events, at the limits that take a tenth of the memory, and at the defaults, which take it all."""
    events = noise_events(66e6, 60_000)
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
