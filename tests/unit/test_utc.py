"""UTC by pulses: against a clock of known rate, with pulses missing, strays and leaps."""

import math
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.utc import PulseClock, clock_zero_at, to_utc_ns
from evlcp_sdk.values import Triggers

BEGIN = datetime(2026, 3, 1, 12, 0, 0, tzinfo=UTC)


def edges(t_us: list[float], channel: int = 0) -> Triggers:
    """A rising edge at each time, and the falling one 100 ms later."""
    times = np.sort(np.concatenate([np.rint(t_us), np.rint(t_us) + 100_000]).astype(np.int64))
    rising = np.isin(times, np.rint(t_us).astype(np.int64))
    return Triggers.of(times, np.full(len(times), channel), rising.astype(np.uint8))


def camera_us(second: float, ppm: float, begin_us: float = 345_678.0) -> float:
    """What a clock that is too fast shows at a second of UTC after `BEGIN`."""
    return begin_us + second * 1e6 * (1 + ppm * 1e-6)


@pytest.mark.parametrize("ppm", [-80.0, 0.0, 35.0])
@pytest.mark.parametrize("near_s", [-0.4, 0.0, 0.4])
def test_utc_is_that_of_the_pulses(ppm: float, near_s: float) -> None:
    near = BEGIN - timedelta(microseconds=345_678) + timedelta(seconds=near_s)
    clock = PulseClock(near=near)
    # The third is missing, and the other channel says nothing.
    pulses = [camera_us(second, ppm) for second in (0, 1, 3, 4, 5)]
    clock.add(edges(pulses[:2]), 0.0, 0.0)
    clock.add(edges([camera_us(1.3, ppm)], channel=1), 0.0, 0.0)
    clock.add(edges(pulses[2:]), 0.0, 0.0)
    assert clock.counts == {"pulses": 5, "pulses_rejected": 0}
    assert clock.rate_ppm == pytest.approx(ppm, abs=2.1)
    for second in (1.5, 2.99, 3.0, 4.7, 5.0, 5.9, 9.0):
        t_us = camera_us(second, ppm)
        zero = clock_zero_at(clock, t_us)
        assert zero is not None
        told_s = (zero + timedelta(microseconds=t_us) - BEGIN).total_seconds()
        # Times of pulses are whole us: so is the rate's doubt, and it grows behind the last one.
        assert told_s == pytest.approx(second, abs=2e-6 * (1 + max(second - 5, 1.0)))
        assert to_utc_ns(clock, t_us) / 1e9 - BEGIN.timestamp() == pytest.approx(told_s, abs=1.1e-6)
    # Before the first pulse, what is known beforehand.
    early = clock_zero_at(clock, 0.0)
    assert early is not None
    assert abs((early - near).total_seconds()) < 1e-6


def test_what_was_called_a_time_is_called_it_still() -> None:
    """No later pulse changes what a time is called."""
    clock, expected = PulseClock(near=BEGIN), []
    rng = np.random.default_rng(5)
    seconds = [camera_us(s, 20.0) + rng.integers(-3, 4) for s in range(40)]
    for t_us in seconds:
        clock.add(edges([t_us]), 0.0, 0.0)
        expected.append((t_us + 5e5, clock.utc_s(t_us + 5e5)))
    assert [clock.utc_s(t_us) for t_us, _ in expected] == [utc_s for _, utc_s in expected]


def test_strays_are_left_out_and_counted_and_a_leap_is_believed() -> None:
    clock = PulseClock(near=BEGIN)
    clock.add(edges([camera_us(s, 0.0) for s in (0, 1, 1.4, 2, 2.2, 3)]), 0.0, 0.0)
    assert clock.counts == {"pulses": 4, "pulses_rejected": 2}
    assert clock.utc_s(camera_us(3.5, 0.0)) == pytest.approx(BEGIN.timestamp() + 3.5, abs=1e-5)
    # The camera's clock leaps by 0.3 s: three pulses agree, and the second is the nearest again.
    for second in (4, 5, 6, 7):
        clock.add(edges([camera_us(second, 0.0) + 300_000]), 0.0, 0.0)
    assert clock.counts == {"pulses": 8, "pulses_rejected": 2}
    assert clock.utc_s(camera_us(7.25, 0.0) + 300_000) == pytest.approx(BEGIN.timestamp() + 7.25, abs=1e-5)
    # It restarts before second 8, whose pulse is at 0.3 s: UTC goes on.
    clock.add(edges([300_000, 1_300_000, 2_300_000]), 0.0, 0.0)
    assert [clock.utc_s(t_us) for t_us in (0, 2_800_000)] == [BEGIN.timestamp() + s for s in (7.7, 10.5)]


def test_the_computers_clock_says_which_second_it_is() -> None:
    clock = PulseClock()
    assert clock_zero_at(clock, 0.0) is None
    assert to_utc_ns(clock, 5.0) == 5000
    # What came last was at 10.7 s, and just now: 0.2 s late.
    clock.add(edges([10_000_000.0]), BEGIN.timestamp() + 0.9, 10_700_000.0)
    assert clock.utc_s(10_000_000) == BEGIN.timestamp()
    assert math.isclose(clock.utc_s(10_250_000) or 0.0, BEGIN.timestamp() + 0.25)
    assert clock.rate_ppm is None


def test_it_keeps_few_of_many_pulses() -> None:
    clock = PulseClock(near=BEGIN)
    clock.add(edges([camera_us(s, 3.0) for s in range(5000)]), 0.0, 0.0)
    assert len(clock._t_us) < 2048
    assert clock.utc_s(camera_us(4999.5, 3.0)) == pytest.approx(BEGIN.timestamp() + 4999.5, abs=2e-6)


def test_a_channel_is_a_number_of_one() -> None:
    with pytest.raises(ConfigError, match="pulses on channel 256: expected 0 to 255"):
        PulseClock(256)
