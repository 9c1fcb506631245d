"""Time that is counted: the processor's, without what kernels take before they can be called."""

import math
import time

import pytest

from evlcp_sdk.stopwatch import Stopwatch, times_real_time


def busy(seconds: float) -> None:
    until = time.process_time() + seconds
    while time.process_time() < until:
        pass


def test_waiting_is_no_work() -> None:
    watch = Stopwatch()
    for _ in range(2):
        with watch.running():
            busy(0.02)
            time.sleep(0.05)
        busy(0.05)
    assert 0.04 <= watch.processor_s < 0.07
    assert watch.elapsed_s >= 0.14
    assert watch.kernels_s == 0


def test_laps_with_kernels_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = [0]
    monkeypatch.setattr("evlcp_sdk.stopwatch.count_loaded", lambda: loaded[0])
    watch = Stopwatch()
    with watch.running():
        loaded[0] = 1
        busy(0.05)
        watch.events += 100
    assert watch.processor_s >= 0.05
    with watch.running():
        busy(0.02)
        watch.events += 300
    assert watch.kernels_s >= 0.05
    # The other hundred at the same pace.
    assert 0.02 * 4 / 3 <= watch.processor_s < 0.05


def test_what_ends_by_a_fault_is_counted() -> None:
    watch = Stopwatch()

    def fail() -> None:
        with watch.running():
            busy(0.01)
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert watch.processor_s >= 0.01


def test_times_real_time() -> None:
    assert times_real_time(3.0, 1.5) == 2
    assert math.isnan(times_real_time(0.0, 1.5))
    assert math.isnan(times_real_time(3.0, 0.0))
