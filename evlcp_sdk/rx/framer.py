"""What finds the packets of regions and reads their frames, for a link's listener."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from typing import ClassVar

from evlcp_sdk.rx.followed import Followed
from evlcp_sdk.rx.lit import LitTimes
from evlcp_sdk.rx.timeline import TimeStep
from evlcp_sdk.values import Region


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
    @abstractmethod
    def due_us(self) -> float:
        """When the next frame can be decoded, us; infinite where that waits for the end of a time step."""

    @abstractmethod
    def ahead(self, step: TimeStep) -> None:
        """Decode the frames that are due in the part so far of a time step."""

    @property
    @abstractmethod
    def places(self) -> dict[int, Region]:
        """Where the transmitters are that have a number and are in sight, by number."""

    @abstractmethod
    def leave(self, taken: Sequence[Region], owning: Collection[int]) -> None:
        """Let regions go in places that are others', but for those of transmitters that hold theirs."""

    @abstractmethod
    def discard_place(self, place: Region) -> int:
        """Count no frame that was not read in a place that is another link's; return how many they were."""

    @abstractmethod
    def discard_packet(self, number: int) -> int:
        """Count no frame that was not read where a packet was another link's; return how many they were."""

    @abstractmethod
    def close(self) -> None:
        """End the stream: decode what the regions still show."""
