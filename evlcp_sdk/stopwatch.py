"""How fast work goes: recorded time against processor time, compiling and loading of kernels left out."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager

from evlcp_sdk.kernels import count_loaded

__all__ = ["Stopwatch", "times_real_time"]


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
    """Adds up the time of laps; those in which a kernel is compiled or loaded stand for themselves.

    Attributes:
        events: What the laps took in; to be counted by whoever runs them.
        elapsed_s: Time on the clock, without laps with kernels, s.
        kernels_s: Time on the clock of laps with kernels, s. It is spent once in a process, whatever the
            length of a recording, and says nothing of the receiver's speed.
    """

    def __init__(self) -> None:
        self.events = 0
        self.elapsed_s = self.kernels_s = 0.0
        self._processor_s = self._with_kernels_s = 0.0
        self._counted = 0

    @contextmanager
    def running(self) -> Iterator[None]:
        """Count while inside: a lap."""
        loaded, events = count_loaded(), self.events
        processor_s, elapsed_s = time.process_time(), time.perf_counter()
        try:
            yield
        finally:
            processor_s, elapsed_s = time.process_time() - processor_s, time.perf_counter() - elapsed_s
            if count_loaded() == loaded:
                self._processor_s += processor_s
                self.elapsed_s += elapsed_s
                self._counted += self.events - events
            else:
                self._with_kernels_s += processor_s
                self.kernels_s += elapsed_s

    @property
    def processor_s(self) -> float:
        """Processor time for all events, by that of laps without kernels if there are any, s."""
        if self._counted:
            return self._processor_s * self.events / self._counted
        return self._processor_s + self._with_kernels_s
