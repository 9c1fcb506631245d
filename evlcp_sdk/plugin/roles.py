"""The roles: one abstract class each, filled by plugins.

An algorithm is a frozen dataclass whose fields are its parameters, each with a default, a unit in its name
and a description. Pydantic checks the fields when a configuration is loaded; the dataclass itself stays
plain, picklable and JSON-round-trippable. `compile` precomputes and returns a pure function over arrays; the
state of detection, framing, synchronization and tracking is explicit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

if TYPE_CHECKING:
    # Commands that only list the roles need no NumPy.
    import numpy as np
    from numpy.typing import NDArray

    from evlcp_sdk.air.codebook import Codebook
    from evlcp_sdk.air.frames import PacketFormat
    from evlcp_sdk.scene.bar import BarLayout
    from evlcp_sdk.scene.camera import CameraModel
    from evlcp_sdk.values import (
        DecodedFrame,
        Events,
        FrameView,
        PresenceMap,
        Range,
        Region,
        SoftSymbols,
        SyncLock,
    )


class Separate(Protocol):
    """What `Separation.compile` returns."""

    def __call__(self, pilot: NDArray[np.int16], /) -> PresenceMap:
        """Chip-aligned polarity sums of a pilot, int16 (chips, height, width) -> presence."""


class Decode(Protocol):
    """What `Decoding.compile` returns."""

    def __call__(
        self, presence: PresenceMap, sums: NDArray[np.int16], /, *around: Any, **none: Any
    ) -> SoftSymbols:
        """Presence and a frame's polarity sums, pilot then info, int16 (chips, height, width) -> symbols.

        For codes that are no pair codes two more arguments follow: the chip that each cluster sends before
        the info segment and the one after it, int8 (K,) each, -1 where it is not known; and `sums` has the
        chip after it, too, behind the edge that ends its last chip. In a pair code these edges say nothing
        new.
        """


class Measure(Protocol):
    """What `Ranging.compile` returns."""

    def __call__(self, view: FrameView, /) -> Range:
        """A decoded frame's image -> distance."""


class Detector(Protocol):
    """What `Detection.compile` returns: a step function over explicit state."""

    def init(self) -> Any:
        """State before the first event."""

    def step(self, state: Any, start_us: int, events: Events) -> tuple[Any, list[Region]]:
        """Take the events of a time step; return the regions of transmitters at its end.

        Args:
            state: From `init` or the last `step`; not changed.
            start_us: Start of the step, us; steps without events are left out while there is no region.
            events: Those of the whole image.

        Returns:
            The new state, and a region for each transmitter, with the same `id` as long as it is the same;
            a region that is missing has ended.
        """


class Detection(ABC):
    """Events of the image to regions that blink, followed.

    Attributes:
        rhythmic: Whether the receiver itself follows what blinks at the chip rate; then nothing is compiled.
    """

    rhythmic: ClassVar[bool] = False

    @abstractmethod
    def compile(self, camera: CameraModel, codebook: Codebook, packet: PacketFormat) -> Detector:
        """Precompute for a camera and a link's codes."""


class Deframer(Protocol):
    """What `Framing.compile` returns: a step function over explicit state."""

    def init(self) -> Any:
        """State before a region's first event."""

    def step(self, state: Any, events: Events, until_us: int) -> tuple[Any, list[DecodedFrame]]:
        """Take a region's events up to `until_us`; return the frames that are certain by then, in order.

        Args:
            state: From `init` or the last `step`; not changed.
            events: Those of the region, in order.
            until_us: All events before this time have been given.
        """

    def close(self, state: Any) -> tuple[Any, list[DecodedFrame]]:
        """End the region; return the new state and the remaining frames."""

    def counts(self, state: Any) -> Mapping[str, int]:
        """Counts of what was found and rejected so far, by name."""


class Framing(ABC):
    """The chips of a packet on air, and a region's events to packets.

    A packet is a preamble and frames; a frame is a pilot and a codeword of each cluster. Any of these codes
    may have any length, the pilots none at all.

    Attributes:
        roles: The roles that do its steps; of those in `STEPS` a link has tables of these only. If it has all
            of them, the receiver reads packets by them, and the framing itself is not compiled.
        detection: Id of the detection of a link that names none; empty for the role's default.
        characters_on_air: Whether a symbol is the code of a character, so that packets without a block are
            text.
        clock_share: Largest share by which a transmitter's clock may be off and still be read; 0: unknown.
    """

    roles: ClassVar[frozenset[str]] = frozenset()
    detection: ClassVar[str] = ""
    characters_on_air: ClassVar[bool] = False
    clock_share: ClassVar[float] = 0.0

    @abstractmethod
    def codebook(self, clusters: int) -> Codebook | None:
        """The codes on air; None if the roles `pilots` and `modulation` give them.

        Raises:
            ConfigError: It has no codes for so many clusters.
        """

    @abstractmethod
    def compile(self, codebook: Codebook, packet: PacketFormat) -> Deframer:
        """Precompute for codes and a packet format."""

    def infer(self, events: Events) -> tuple[Mapping[str, Any], str]:
        """The link settings that read an unknown light, `table.key` to value, and the reason.

        No settings if it is no light of this framing, with its best description; no settings and no reason if
        the framing cannot tell.
        """
        return {}, ""

    def rest(self) -> int | None:
        """State of the LEDs while nothing is sent, 1 on, 0 off; None if any pattern may be shown."""
        return None


class Pilots(ABC):
    """Codes that find time and identify clusters."""

    @abstractmethod
    def preamble(self) -> NDArray[np.uint8]:
        """The code that finds time, chips, uint8 (P,)."""

    @abstractmethod
    def codes(self, clusters: int) -> NDArray[np.uint8]:
        """One code a cluster, chips, uint8 (clusters, N).

        Raises:
            ConfigError: The family has fewer codes.
        """


class Modulation(ABC):
    """Bits to codewords."""

    @abstractmethod
    def codewords(self) -> NDArray[np.uint8]:
        """One codeword a symbol, chips, uint8 (S, M).

        With m the integer part of log2 S, row s < 2**m carries the m bits of s, msb first; further rows are
        symbols that messages do not use.
        """


class Synchronizer(Protocol):
    """What `Synchronization.compile` returns: a step function over explicit state."""

    def init(self) -> Any:
        """State before the first event."""

    def step(
        self, state: Any, t_us: NDArray[np.int64], p: NDArray[np.uint8], until_us: int
    ) -> tuple[Any, list[SyncLock]]:
        """Take a region's events up to `until_us`; return one lock for each packet with a detected preamble.

        Args:
            state: From `init` or the last `step`; not changed.
            t_us: Event times, ascending, int64 (n,).
            p: Polarities, uint8 (n,).
            until_us: All events before this time have been given.
        """


class Synchronization(ABC):
    """Region events to packet timing and clock rate, step by step."""

    @abstractmethod
    def compile(self, codebook: Codebook, packet: PacketFormat) -> Synchronizer:
        """Precompute for a codebook's preamble and a packet format."""


class Separation(ABC):
    """Chip-aligned polarity sums to presence probability of each cluster."""

    @abstractmethod
    def compile(self, codebook: Codebook) -> Separate:
        """Precompute for a codebook's pilots."""


class Decoding(ABC):
    """Presence and a frame's chips to soft symbols."""

    @abstractmethod
    def compile(self, codebook: Codebook) -> Decode:
        """Precompute for a codebook's codewords."""


class Ranging(ABC):
    """A decoded frame's image to distance.

    Attributes:
        measures: Whether it measures distances at all.
    """

    measures: ClassVar[bool] = True

    @abstractmethod
    def compile(self, camera: CameraModel, bar: BarLayout, codebook: Codebook) -> Measure:
        """Precompute for a camera, a bar and its codes.

        Raises:
            ConfigError: The parameters do not fit the bar.
        """


class Filter(ABC):
    """Follows values that change smoothly, step by step, over explicit state."""

    @abstractmethod
    def init(self) -> Any:
        """State before the first measurement."""

    @abstractmethod
    def predict(self, state: Any, t_us: float) -> tuple[NDArray[np.float64], float] | None:
        """Expected values, float64 (n,), and sigma at a time; None before the first measurement."""

    @abstractmethod
    def step(
        self, state: Any, t_us: float, value: NDArray[np.float64], sigma: float
    ) -> tuple[Any, NDArray[np.float64], float]:
        """Take a measurement, float64 (n,); return the new state, the filtered values and their sigma.

        The given state is not changed.
        """


@dataclass(frozen=True)
class Tracker:
    """The filters that `Tracking.compile` returns; None leaves a quantity as measured.

    Attributes:
        position: Of a region's centre (column, row), px, at every time step.
        distance: Of a transmitter's distance, m, at every frame.
    """

    position: Filter | None
    distance: Filter | None


class Tracking(ABC):
    """Distance and image position over time."""

    @abstractmethod
    def compile(self) -> Tracker:
        """Make the filters."""


@dataclass(frozen=True, eq=False)
class Corrected:
    """A decoded block.

    Attributes:
        bits: Message bits, uint8 (message_bits,); the best guess if the check fails.
        ok: Whether the check against undetected errors passes.
        flipped: Number of received bits (the signs of the LLRs) that differ from the decoded block's.
    """

    bits: NDArray[np.uint8]
    ok: bool
    flipped: int


class Code(Protocol):
    """What `ErrorCorrection.compile` returns: message bits to coded bits and back."""

    @property
    def message_bits(self) -> int:
        """Message bits of a block."""

    @property
    def coded_bits(self) -> int:
        """Bits of the block on air."""

    def encode(self, bits: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Message bits uint8 (message_bits,), 0 or 1 -> coded bits uint8 (coded_bits,).

        Raises:
            ConfigError: Bits of another number.
        """

    def decode(self, llr: NDArray[np.float32]) -> Corrected:
        """LLRs ln P(bit 0) / P(bit 1) of the coded bits, float32 (coded_bits,), 0 for a bit not received.

        Raises:
            ConfigError: LLRs of another number.
        """


class ErrorCorrection(ABC):
    """Message bits to coded bits and back, with a check against undetected errors."""

    @abstractmethod
    def compile(self, coded_bits: int) -> Code:
        """Precompute for blocks of so many bits on air.

        Raises:
            ConfigError: The block is too short to carry anything.
        """


@dataclass(frozen=True)
class Role:
    """A step of the link that exactly one algorithm does.

    Attributes:
        name: The table that selects the algorithm in `link.toml`.
        abstract: The class that its algorithms derive from.
        default: Id of the algorithm if the link names none.
        verb: What it does, in one line.
        default_unpaired: Id of the default for codes that are not pair codes; None if `default` takes them.
        by_layout: Gives the default for a bar and the names of its codes that are not pair codes; None if it
            does not depend on the bar.
    """

    name: str
    abstract: type[ABC]
    default: str
    verb: str
    default_unpaired: str | None = None
    by_layout: Callable[[BarLayout, Collection[str]], str] | None = None

    def default_for(self, bar: BarLayout | None, unpaired_codes: Collection[str] = ()) -> str:
        """Id of the algorithm if the link names none.

        Args:
            bar: The link's bar; None if unknown.
            unpaired_codes: Names of its codes that are not pair codes, see `Codebook.unpaired_codes`.

        >>> from evlcp_sdk.scene.bar import BarLayout, LedGrid
        >>> [ROLES["ranging"].default_for(BarLayout(LedGrid(96, columns))) for columns in (1, 2)]
        ['joint-scale', 'joint-scale']
        """
        if bar is not None and self.by_layout is not None:
            return self.by_layout(bar, unpaired_codes)
        return self.default_unpaired if unpaired_codes and self.default_unpaired is not None else self.default

    def suggest_for(self, bar: BarLayout, unpaired_codes: Collection[str]) -> str:
        """What an algorithm that refuses a layout suggests instead."""
        return f"use '{self.default_for(bar, unpaired_codes)}' for this layout"


_MAX_RELATIVE_WIDTH = 2.0
"""Widest layout, in heights of its columns, whose columns measure the distance better than its width."""


def _choose_ranging(bar: BarLayout, unpaired_codes: Collection[str]) -> str:
    if not bar.has_distinct_centres:
        return "none"
    # `joint-scale` ignores the width, which matters most for low columns far apart.
    high_m = max((len(clusters) * pitch_m for clusters, pitch_m in bar.even_columns), default=0.0)
    if "pilots" not in unpaired_codes and high_m > 0 and bar.width_m <= _MAX_RELATIVE_WIDTH * high_m:
        return "joint-scale"
    usual = int(bar.has_usual_sides.sum())
    if usual >= 2 and bar.has_equal_clusters:
        return "poc"
    return "centroid" if usual >= 3 else "none"


ROLES: Mapping[str, Role] = MappingProxyType(
    {
        role.name: role
        for role in (
            Role("detection", Detection, "rhythm", "events -> regions that blink, followed"),
            Role("framing", Framing, "packets", "what a packet is on air; a region's events -> packets"),
            Role("pilots", Pilots, "wh", "codes that find time and tell clusters apart"),
            Role("modulation", Modulation, "wh4x2", "bits of a symbol <-> its codeword"),
            Role("synchronization", Synchronization, "barker", "a region's events -> packet timing"),
            Role(
                "separation",
                Separation,
                "wh-correlation",
                "a pilot's image -> where each cluster is",
                "edges",
            ),
            Role("decoding", Decoding, "motion-feedback", "a frame's image -> soft symbols", "edges"),
            Role(
                "ranging",
                Ranging,
                "joint-scale",
                "a decoded frame's image -> distance",
                by_layout=_choose_ranging,
            ),
            Role("tracking", Tracking, "none", "distance and image position over time"),
            Role("error-correction", ErrorCorrection, "polar", "message bits <-> coded bits, soft input"),
        )
    }
)
"""Every role by its name, in the order of the signal's flow."""

STEPS = frozenset({"pilots", "modulation", "synchronization", "separation", "decoding", "ranging"})
"""Roles that are steps of a framing: those of the built-in one."""
