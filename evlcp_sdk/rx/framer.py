"""What a framer is, which turns the events of regions into frames, and the context of its stream."""

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any, ClassVar

from evlcp_sdk.clock import CameraClock, TimeStep
from evlcp_sdk.errors import blame
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.rx.limits import LIMITS, Limits
from evlcp_sdk.rx.reflections import ReflectionQueue
from evlcp_sdk.rx.regions import TrackedRegion
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.utc import ClockZero
from evlcp_sdk.values import Frame, Region, SyncLock, replace_fields

_MAX_REMEMBERED = 1024
"""Transmitters that are remembered, those seen last."""


def record_light(
    spans_us: dict[int, tuple[float, float]], number: int, first_us: float, start_us: float
) -> None:
    """Record the start of a frame in which a transmitter's light was there.

    `spans_us` are starts of the first and the last such frame by number, camera clock, us; `first_us` is the
    first one's if the transmitter is new there.

    >>> spans_us = {}
    >>> record_light(spans_us, 3, 500.0, 500.0)
    >>> record_light(spans_us, 3, 500.0, 3700.0)
    >>> spans_us
    {3: (500.0, 3700.0)}
    """
    first_us, _ = spans_us.pop(number, (first_us, start_us))
    spans_us[number] = (first_us, start_us)
    if len(spans_us) > _MAX_REMEMBERED:
        del spans_us[next(iter(spans_us))]


def to_camera_time(value: Any, camera_us: Callable[[float], float]) -> Any:
    """A stage's value with its times on the camera's clock."""
    match value:
        case Region():
            return replace_fields(value, t_us=camera_us(value.t_us))
        case SyncLock():
            return replace_fields(value, packet_t_us=camera_us(value.packet_t_us))
    return value


class Announcer:
    """Announces to a hook what each finished stage gave, on the camera's clock, and how long it took.

    Without a hook it announces nothing.

    Attributes:
        is_silent: There is no hook: what runs in every time step need not call it.
    """

    def __init__(
        self, hook: Callable[..., Any] | None = None, camera_us: Callable[[float], float] = float
    ) -> None:
        self.is_silent = hook is None
        self._hook, self._camera_us = hook, camera_us
        self.start_clock()

    def start_clock(self) -> None:
        """Start the clock of a frame."""
        self._start_s = self._lap_s = time.perf_counter()

    def announce(self, stage: str, value: object) -> None:
        """Announce what took the time since the last announcement."""
        now = time.perf_counter()
        elapsed_s, self._lap_s = now - self._lap_s, now
        self._call_hook(stage, value, elapsed_s)

    def announce_frame(self, frame: Frame) -> None:
        """Announce a frame, which took all the time since the start."""
        self._call_hook("frame", frame, self._lap_s - self._start_s)

    def _call_hook(self, stage: str, value: object, elapsed_s: float) -> None:
        if self._hook is None:
            return
        with blame("evlcp_stage_finished() of a plugin"):
            self._hook(stage=stage, value=to_camera_time(value, self._camera_us), elapsed_s=elapsed_s)


@dataclass(frozen=True)
class StreamContext:
    """A stream of events, and what is known of it.

    Attributes:
        clock: Its clock.
        attitude_at: The camera's attitude at a time, as far as it is known.
        clock_zero: UTC of the camera clock's 0; None if it is not known.
        announcer: Announces finished stages.
        limits: How much each link holds at most.
        numbers: Where the numbers of transmitters come from.
        bar_decoders: Decoders of a link's bars (`BarDecoder`), by its name; None for those of this process.
    """

    clock: CameraClock
    attitude_at: Callable[[float], Attitude | None]
    clock_zero: ClockZero = None
    announcer: Announcer = field(default_factory=Announcer)
    limits: Limits = LIMITS
    numbers: Iterator[int] = field(default_factory=count)
    bar_decoders: Callable[[str], Sequence[Any]] | None = None


class Framer(ABC):
    """Turns the events of regions into frames, time step by time step.

    Attributes:
        counts: What was found and dropped so far.
        light_spans_us: When the light of its transmitters was there, see `record_light`.
        ranging_every: See `Receiver`.
        due_us: When the next frame can be decoded, us; infinite where that waits for the end of a time step.
        patience_us: How late a frame may be given, us.
        drops_frames_at_end: Frames whose late events the stream's end cuts off are not given.
    """

    drops_frames_at_end: ClassVar[bool]
    due_us: float = math.inf
    patience_us: float

    def __init__(
        self,
        link: Link,
        name: str,
        stream: StreamContext,
        queue: ReflectionQueue,
        on_frame: Callable[[Frame], None] | None,
        counts: Iterable[str],
    ) -> None:
        self._packet, self._step_us = link.packet, link.regions.step_us
        self._clock, self._announcer = stream.clock, stream.announcer
        self._name, self._numbers, self._queue, self._on_frame = name, stream.numbers, queue, on_frame
        self.counts = dict.fromkeys(counts, 0)
        self.light_spans_us: dict[int, tuple[float, float]] = {}
        self.ranging_every = 1

    @abstractmethod
    def step(self, regions: list[TrackedRegion], step: TimeStep) -> None:
        """Decode what the regions of a time step send."""

    def apply_pending(self, start_us: int) -> None:
        """Apply what was decoded some time steps before, at the start of a time step, us."""
        return

    def decode_early(self, step: TimeStep) -> None:
        """Decode the frames that are due in the part of a time step that is there so far, if any can be."""
        return

    @abstractmethod
    def number_of(self, region: TrackedRegion) -> int | None:
        """Number of a region's transmitter; None before its first frame."""

    @abstractmethod
    def forget_region(self, region: TrackedRegion) -> None:
        """Forget a region that is no longer followed, as its place is another's."""

    def discard_misses(self, *, place: Region | None = None, number: int | None = None) -> int:
        """Discard the misses counted where another link's packet was; return how many.

        Those at its `place`, or those of the transmitter of this `number`, which belongs to the other link.
        """
        return 0

    @abstractmethod
    def close(self) -> None:
        """End the stream: decode what the regions still show."""
