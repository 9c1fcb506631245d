"""Limits of what the receiver holds, whatever it is fed.

What exceeds a limit is left out and counted; what and when depends on the events alone, not on the pieces
in which they come. The defaults keep `evlcp receive` below 500 MB, of which the interpreter with its compiled
kernels takes 200; `benchmarks/memory.py` measures it. A camera of 60 million events a second stays below all
of them.
"""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Limits:
    """The most that is held at a time.

    Attributes:
        step_events: Events of a time step; the first ones count, the others are dropped.
        recent_bytes: Size of the events of the whole image, from which those of a region are gathered again;
            the oldest steps are forgotten.
        region_bytes: Size of the events of all regions together; the oldest steps are forgotten.
        regions: Tracked regions; one that has shown no frame for long gives way to a new one, or else the new
            one is left out.
        areas: Blinking areas that are measured in a time step: those with the most rises.
        remembered: Transmitters out of sight that may come back: the newest ones.
    """

    step_events: int = 1 << 21
    recent_bytes: int = 64 << 20
    region_bytes: int = 48 << 20
    regions: int = 256
    areas: int = 256
    remembered: int = 256


LIMITS: Final = Limits()
