"""What a framer is, which finds packets in regions and reads them, and what it is told of the stream."""

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any, ClassVar

from evlcp_sdk.clock import CameraClock, TimeStep
from evlcp_sdk.errors import EvlcpError, PluginError
from evlcp_sdk.rx.guard import fault_text
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.rx.regions import Followed
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.utc import ClockZero
from evlcp_sdk.values import Frame, Region, SyncLock, replace_fields

_MOST_LIT = 1024
"""Transmitters that are remembered: those seen last."""


def note_lit(lit: dict[int, tuple[float, float]], number: int, first_us: float, start_us: float) -> None:
    """Remember of a transmitter its first and its last frame in which its light was there.

    `lit` are their starts by number, camera clock, us; `first_us` is the first one's if it is new there.

    >>> lit = {}
    >>> note_lit(lit, 3, 500.0, 500.0)
    >>> note_lit(lit, 3, 500.0, 3700.0)
    >>> lit
    {3: (500.0, 3700.0)}
    """
    first_us, _ = lit.pop(number, (first_us, start_us))
    lit[number] = (first_us, start_us)
    if len(lit) > _MOST_LIT:
        del lit[next(iter(lit))]


def on_camera(value: Any, camera_us: Callable[[float], float]) -> Any:
    """What a stage gives, with the times of the camera's clock."""
    match value:
        case Region():
            return replace_fields(value, t_us=camera_us(value.t_us))
        case SyncLock():
            return replace_fields(value, packet_t_us=camera_us(value.packet_t_us))
    return value


class Announcer:
    """Says of each finished stage what it gave, in times of the camera's clock, and how long it took."""

    def __init__(self, hook: Callable[..., Any], camera_us: Callable[[float], float]) -> None:
        self._hook, self._camera_us = hook, camera_us
        self.start()

    def start(self) -> None:
        """Start the clock."""
        self._start_s = self._lap_s = time.perf_counter()

    def lap(self, stage: str, value: object) -> None:
        """Announce what took the time since the last lap."""
        now = time.perf_counter()
        elapsed_s, self._lap_s = now - self._lap_s, now
        self._say(stage, value, elapsed_s)

    def frame(self, frame: Frame) -> None:
        """Announce a frame, which took all laps since the start together."""
        self._say("frame", frame, self._lap_s - self._start_s)

    def _say(self, stage: str, value: object, elapsed_s: float) -> None:
        try:
            self._hook(stage=stage, value=on_camera(value, self._camera_us), elapsed_s=elapsed_s)
        except EvlcpError:
            raise
        except (Exception, SystemExit) as fault:
            raise PluginError(f"evlcp_stage_finished() of a plugin: {fault_text(fault)}") from fault


@dataclass(frozen=True)
class StreamContext:
    """A stream of events, and what is known of it.

    Attributes:
        clock: Its clock.
        attitude_at: What is known of the camera's attitude at a time.
        clock_zero: UTC of the camera clock's 0; None if it is not known.
        announcer: Announces finished stages; None where nobody listens.
        limits: How much each link holds at the most.
        numbers: Where the numbers of transmitters come from.
        bars: Decoders of a link's known bars, by its name, see `reading.Bars`; None for this process.
    """

    clock: CameraClock
    attitude_at: Callable[[float], Attitude | None]
    clock_zero: ClockZero = None
    announcer: Announcer | None = None
    limits: Limits = LIMITS
    numbers: Iterator[int] = field(default_factory=count)
    bars: Callable[[str], Sequence[Any]] | None = None


class Framer(ABC):
    """The events of regions to frames, time step by time step.

    Attributes:
        counts: What was found and dropped so far.
        lit: When the light of its transmitters was there: see `note_lit`.
        ranging_every: See `Receiver`.
        due_us: When the next frame can be decoded, us; infinite where that waits for the end of a time step.
        patience_us: How late a frame may be given, us.
        cut_by_the_end: Frames whose late events the stream's end cuts off are not given.
    """

    cut_by_the_end: ClassVar[bool]
    counts: dict[str, int]
    lit: dict[int, tuple[float, float]]
    ranging_every: int
    due_us: float = math.inf
    patience_us: float

    @abstractmethod
    def step(self, regions: list[Followed], step: TimeStep) -> None:
        """Receive and decode what the regions of a time step send."""

    def catch_up(self, start_us: int) -> None:
        """Apply what was decoded some time steps before, at the start of a time step, us."""
        return

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
