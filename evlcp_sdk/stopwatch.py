"""How fast work goes: recorded time against processor time, compiling and loading of kernels left out."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager

from evlcp_sdk.kernels import COMPILE_TIMER


def times_real_time(recorded_s: float, processor_s: float) -> float:
    """Recorded time over the processor time of what was done with it; NaN where either is 0.

    From 1 on, one core that does nothing else keeps up with a camera.

    Args:
        recorded_s: From the first event to the last, s.
        processor_s: As a `Stopwatch` measures it, s.

    >>> times_real_time(3.0, 2.0)
    1.5
    """
    return recorded_s / processor_s if recorded_s and processor_s else math.nan


class Stopwatch:
    """Adds up the time of what runs while it is running.

    Attributes:
        processor_s: Processor time of this process, without that for kernels, s.
        elapsed_s: Time on the clock, without that for kernels, s.
        kernels_s: Time on the clock in which kernels were compiled or loaded, s. It is spent once in a
            process, whatever the length of a recording, and says nothing of the receiver's speed.
    """

    def __init__(self) -> None:
        self.processor_s = self.elapsed_s = self.kernels_s = 0.0

    @contextmanager
    def running(self) -> Iterator[None]:
        """Count while inside."""
        processor_s = time.process_time() - COMPILE_TIMER.processor_s
        elapsed_s, kernels_s = time.perf_counter() - COMPILE_TIMER.elapsed_s, COMPILE_TIMER.elapsed_s
        try:
            yield
        finally:
            self.processor_s += time.process_time() - COMPILE_TIMER.processor_s - processor_s
            self.elapsed_s += time.perf_counter() - COMPILE_TIMER.elapsed_s - elapsed_s
            self.kernels_s += COMPILE_TIMER.elapsed_s - kernels_s
