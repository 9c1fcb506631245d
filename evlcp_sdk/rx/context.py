"""What the links of a receiver share."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count

import pluggy

from evlcp_sdk.clock import CameraClock
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.utc import ClockZero


@dataclass(frozen=True)
class StreamContext:
    """A stream of events, and what is known of it.

    Attributes:
        clock: Its clock.
        attitude_at: What is known of the camera's attitude at a time.
        clock_zero: UTC of the camera clock's 0; None if it is not known.
        hook: Where finished stages are announced; None for nowhere.
        limits: How much each link holds at the most.
        numbers: Where the numbers of transmitters come from.
    """

    clock: CameraClock
    attitude_at: Callable[[float], Attitude | None]
    clock_zero: ClockZero = None
    hook: pluggy.HookRelay | None = None
    limits: Limits = LIMITS
    numbers: Iterator[int] = field(default_factory=count)
