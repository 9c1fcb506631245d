"""Speed of processing: recorded time against processor time, without compiling and loading of kernels."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager

from evlcp_sdk.kernels import COMPILE_TIMER


def times_real_time(recorded_s: float, processor_s: float) -> float:
    """Recorded time over the processor time of its processing; NaN where either is 0.

    From 1 on, one core that does nothing else keeps up with a camera.

    Args:
        recorded_s: From the first event to the last, s.
        processor_s: Processor time, as a `Stopwatch` measures it, s.

    >>> times_real_time(3.0, 2.0)
    1.5
    """
    return recorded_s / processor_s if recorded_s and processor_s else math.nan


class Stopwatch:
    """Adds up the time spent in `measure`.

    Attributes:
        processor_s: Processor time of this process, without that for kernels, s.
        elapsed_s: Elapsed time, without that for kernels, s.
        kernels_s: Elapsed time in which kernels were compiled or loaded, s: spent once in a process, whatever
            the length of a recording, and no part of the receiver's speed.
    """

    def __init__(self) -> None:
        self.processor_s = self.elapsed_s = self.kernels_s = 0.0

    @contextmanager
    def measure(self) -> Iterator[None]:
        """Measure the block."""
        processor_s = time.process_time() - COMPILE_TIMER.processor_s
        elapsed_s, kernels_s = time.perf_counter() - COMPILE_TIMER.elapsed_s, COMPILE_TIMER.elapsed_s
        try:
            yield
        finally:
            self.processor_s += time.process_time() - COMPILE_TIMER.processor_s - processor_s
            self.elapsed_s += time.perf_counter() - COMPILE_TIMER.elapsed_s - elapsed_s
            self.kernels_s += COMPILE_TIMER.elapsed_s - kernels_s
