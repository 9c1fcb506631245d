"""Time that is counted: the processor's, without what kernels take before they can be called."""

import time
from types import SimpleNamespace

import numpy as np

from evlcp_sdk.kernels import COMPILING, njit
from evlcp_sdk.stopwatch import Stopwatch


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

    def compile_(_sig: object) -> None:
        busy(0.05)

    stats = SimpleNamespace(cache_misses={})
    inner = COMPILING.watched(SimpleNamespace(compile=compile_, stats=stats))
    outer = COMPILING.watched(SimpleNamespace(compile=lambda sig: (busy(0.05), inner(sig)), stats=stats))
    with watch.running():
        began_s = time.perf_counter()
        outer(None)
        took_s = time.perf_counter() - began_s
        busy(0.02)
    # The inner one's time is in the outer's, and counts once.
    assert 0.1 <= watch.kernels_s <= took_s
    assert 0.02 <= watch.processor_s < 0.05


def test_a_kernel_s_time_is_counted_once() -> None:
    @njit
    def summed(values: np.ndarray) -> float:  # type: ignore[type-arg]
        return float((values**2).sum())

    before = COMPILING.elapsed_s
    assert summed(np.ones(3)) == 3
    after = COMPILING.elapsed_s
    assert after > before
    assert summed(np.ones(3)) == 3
    assert COMPILING.elapsed_s == after
