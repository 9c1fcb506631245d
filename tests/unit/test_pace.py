"""Time that is counted: the processor's, without what kernels take before they can be called."""

import math
import time

import numba
import numpy as np
import pytest
from numba.core.event import end_event, start_event

from evlcp_sdk.pace import Stopwatch, times_real_time


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


def test_time_for_kernels_is_left_out() -> None:
    watch = Stopwatch()
    with watch.running():
        start_event("numba:compiler_lock")
        busy(0.05)
        start_event("numba:compiler_lock")
        busy(0.05)
        end_event("numba:compiler_lock")
        end_event("numba:compiler_lock")
        busy(0.02)
    assert watch.kernels_s >= 0.1
    assert 0.02 <= watch.processor_s < 0.05


def test_a_kernel_compiles_under_the_lock() -> None:
    watch = Stopwatch()
    kernel = numba.njit(lambda values: (values**2).sum())
    with watch.running():
        kernel(np.ones(3))
    first_s, watch.processor_s = watch.kernels_s, 0.0
    assert first_s > 0.01
    with watch.running():
        kernel(np.ones(3))
    assert watch.kernels_s == first_s
    assert 0 < watch.processor_s < first_s


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
