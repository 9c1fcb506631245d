"""What receives a link's packets: a tracker finds regions, a framer finds packets in them and reads them."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import ClassVar

import pluggy

from evlcp_sdk.clock import CameraClock
from evlcp_sdk.rx.followed import Followed
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.rx.timeline import TimeStep
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.utc import ClockZero
from evlcp_sdk.values import Events, Region

_MOST_LIT = 1024
"""Transmitters that are remembered: those seen last."""


class LitTimes:
    """Remembers of each transmitter its first and its last frame in which its light was there.

    Attributes:
        by_number: Transmitter number to start of the first and of the last such frame, camera clock, us.

    >>> lit = LitTimes()
    >>> lit.note(3, 500.0, 500.0)
    >>> lit.note(3, 500.0, 3700.0)
    >>> lit.by_number
    {3: (500.0, 3700.0)}
    """

    def __init__(self) -> None:
        self.by_number: dict[int, tuple[float, float]] = {}

    def note(self, number: int, first_us: float, start_us: float) -> None:
        """Take a frame: when it starts, and when the first one did if the transmitter is new."""
        first_us, _ = self.by_number.pop(number, (first_us, start_us))
        self.by_number[number] = (first_us, start_us)
        if len(self.by_number) > _MOST_LIT:
            del self.by_number[next(iter(self.by_number))]


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


class RegionTracker(ABC):
    """Regions of a stream with their events, followed from time step to time step.

    Attributes:
        alive: Those that are followed.
        counts: What was left out for want of room.
    """

    alive: list[Followed]
    counts: dict[str, int]

    @abstractmethod
    def step(self, start_us: int, events: Events, taken: Sequence[Region] = ()) -> list[Followed]:
        """Take the events of a time step; give the regions that are alive or ended in it.

        Args:
            start_us: Start of the step, us.
            events: Those in it, in order.
            taken: Places that are others': no region is opened there, nor reaches into them.
        """

    @abstractmethod
    def skip(self) -> None:
        """Pass over a gap in time, with no region alive."""

    def close(self) -> None:
        """End the stream: forget all events."""
        self.skip()
        self.alive = []

    def drop(self, followed: Followed) -> None:
        """Let a region go at once."""
        followed.released = True
        self.alive = [other for other in self.alive if other is not followed]


class Framer(ABC):
    """The events of regions to frames, time step by time step.

    Attributes:
        counts: What was found and dropped so far.
        lit: When the light of its transmitters was there.
        ranging_every: See `Receiver`.
        patience_us: How late a frame may be given, us.
        cut_by_the_end: Frames whose late events the stream's end cuts off are not given.
    """

    cut_by_the_end: ClassVar[bool]
    counts: dict[str, int]
    lit: LitTimes
    ranging_every: int
    patience_us: float

    @abstractmethod
    def step(self, regions: list[Followed], step: TimeStep) -> None:
        """Receive and decode what the regions of a time step send."""

    @property
    def due_us(self) -> float:
        """When the next frame can be decoded, us; infinite where that waits for the end of a time step."""
        return math.inf

    def ahead(self, step: TimeStep) -> None:
        """Decode the frames that are due in the part so far of a time step, if there can be any."""
        return

    @abstractmethod
    def number_of(self, region: Followed) -> int | None:
        """Number of a region's transmitter; None before its first frame."""

    @abstractmethod
    def let_go(self, region: Followed) -> None:
        """Forget a region that is no more followed, as its place is another's."""

    def discard(self, *, place: Region | None = None, number: int | None = None) -> int:
        """Count no frame that was not read where another link's packet was; return how many they were.

        Args:
            place: The packet's place; None for that of the transmitter that is another link's.
            number: Its number.
        """
        return 0

    @abstractmethod
    def close(self) -> None:
        """End the stream: decode what the regions still show."""
