"""What finds and follows the regions of a stream, for a framer."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx.followed import Followed
from evlcp_sdk.values import Events, Region

Pair = tuple[float, float]


class RegionTracker(ABC):
    """Regions of a stream with their events, followed from time step to time step.

    Attributes:
        alive: Those that are followed.
        counts: What was left out for want of room.
        goes_ahead: Whether frames can be decoded before their time step is over.
    """

    goes_ahead: ClassVar[bool]
    alive: list[Followed]
    counts: dict[str, int]

    @abstractmethod
    def step(self, start_us: int, events: Events, taken: Sequence[Region] = ()) -> list[Followed]:
        """Take the events of a time step; give the regions that are alive or ended in it.

        What is in places that are `taken` by others is left out.
        """

    @abstractmethod
    def ahead(
        self, start_us: int, until_us: int, events: Events, meant: Collection[int]
    ) -> AbstractContextManager[None]:
        """Have what came of a step so far in the regions that are `meant`, by id, until the context ends."""

    @abstractmethod
    def skip(self) -> None:
        """Pass over a gap in time, with no region alive."""

    @abstractmethod
    def close(self) -> None:
        """End the stream: forget all events."""

    @abstractmethod
    def drop(self, followed: Followed) -> None:
        """Let a region go at once."""

    @abstractmethod
    def shape(self, followed: Followed, t_us: float, centre_px: Pair, size_px: Pair) -> float:
        """Set a region right by a bar that a frame showed; give how far it was off, px."""

    @abstractmethod
    def light(
        self, followed: Followed, lit_px: Pair | None, strips_px: NDArray[np.float64] | None = None
    ) -> None:
        """Note which part of a bar a frame showed."""

    @abstractmethod
    def gather(self, followed: Followed, from_us: float = -np.inf, until_us: float = np.inf) -> None:
        """Take a region's events once more, where it is now known to be."""

    @abstractmethod
    def unite(self, followed: Followed, other: Followed) -> None:
        """Take another region into one."""

    @abstractmethod
    def has_room(self) -> bool:
        """Whether a framer may open another region."""

    @abstractmethod
    def beside(self, like: Followed, t_us: float, centre_px: Pair, size_px: Pair) -> Followed:
        """Open a region for another image in that of a bar."""
