"""A replay gives out a recording at its own pace, changed in nothing else."""

import numpy as np
import pytest

from evlcp_sdk.io import ReplaySource, open_source, write_events
from evlcp_sdk.values import Events, Triggers


class Clock:
    """A clock that only sleeping moves."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture
def recording(tmp_path):
    events = Events.of([500, 700, 1499, 1500, 2600, 9000], range(6), [0] * 6, [1] * 6)
    write_events(tmp_path / "a.npz", events, 640, 480, Triggers.of([400, 2700, 12_000], [1, 2, 3], [1, 1, 1]))
    return tmp_path / "a.npz"


def test_each_slice_comes_when_its_time_is_over(recording):
    clock = Clock()
    got = []
    with ReplaySource(open_source(recording), speed=2.0, clock=clock, sleep=clock.sleep) as source:
        for events, triggers in source.stream():
            got.append((round((clock.now - 100) * 2e6), events.t_us.tolist(), triggers.t_us.tolist()))
        assert (source.format, source.width, source.height) == ("NPZ", 640, 480)
        assert source.counts == {"events": 6, "triggers": 3}
        assert source.position_bytes == source.size_bytes
        assert source.losses == {}
    assert got == [
        (1000, [500, 700], [400]),
        (2000, [1499, 1500], []),
        (3000, [2600], [2700]),
        (9000, [9000], []),
        (12_000, [], [12_000]),
    ]


def test_a_clock_that_restarts_keeps_its_pace(tmp_path):
    t_us = np.tile(np.arange(0, 50_000, 20), 2)
    np.savez(tmp_path / "a.npz", t_us=t_us, x=t_us % 9, y=t_us % 9, p=t_us % 2)
    clock = Clock()
    with ReplaySource(open_source(tmp_path / "a.npz"), clock=clock, sleep=clock.sleep) as source:
        assert sum(map(len, source.chunks())) == len(t_us)
        assert [clock.now, source.clock_s(50_000.0)] == pytest.approx([100.1, 100.1], abs=1e-3)
