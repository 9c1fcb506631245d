"""The interface of every output format: a sink, which takes packets and positions as they come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.utc import ClockZero
from evlcp_sdk.values import Events, Fix, Packet

if TYPE_CHECKING:
    from evlcp_sdk.place.navigator import Navigator, Place, PositionPlan, Settled


@dataclass(frozen=True, eq=False)
class Run:
    """The run whose results a sink writes.

    Attributes:
        name: Name of the recording, for titles.
        link: The receiver's configuration; the first of several.
        plan: What positions are computed from; None where none are computed.
        navigator: Computes them, and knows at the end where the bars stand; None where none are computed.
        clock_zero: UTC of the camera clock's 0, or pulses that give it, see `utc.clock_zero_at`. None where
            it is not known.
        links: Where there are several, all of them by name.
    """

    name: str
    link: Link
    plan: PositionPlan | None = None
    navigator: Navigator | None = None
    clock_zero: ClockZero = None
    links: Mapping[str, Link] = field(default_factory=dict)

    def link_of(self, name: str) -> Link:
        """The link of a frame, packet or message, by its name."""
        return self.links.get(name, self.link)

    @property
    def filtered(self) -> bool:
        """Whether any link filters distances, so that there are columns for them."""
        from evlcp_sdk.rx.guard import compile_tracker

        links = self.links.values() or [self.link]
        return any(compile_tracker(link).distance is not None for link in links)


class Sink:
    """One output format: a derived class takes what it needs and writes it as it comes, in constant memory.

    A method that is not overridden does nothing. A sink with a method `evlcp_stage_finished`, marked with
    `@hookimpl`, observes the receiver's stages, too.

    Args:
        folder: Opens its files; they are moved into place together when the run ends.
        run: The run whose results it writes.
    """

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        self.folder = folder
        self.run = run

    def events(self, events: Events) -> None:
        """Take events as they are read, in pieces of any size."""

    def packet(self, packet: Packet) -> None:
        """Take the next packet, with its frames and messages."""

    def fix(self, fix: Fix, filtered: Place | None) -> None:
        """Take the next fix, given or refused, and the filtered place at its time; None for a refused one."""

    def settle(self, settled: Sequence[Settled]) -> None:
        """Take the next smoothed fixes: all that are given, in order of time, many at a time."""

    def finish(self) -> Mapping[str, Any] | None:
        """Write the rest; return this sink's part of the summary's `sinks`, as JSON values, or None."""

    def conclude(self, summary: Mapping[str, Any]) -> None:
        """Take the summary, all but its `files`, and write what depends on it; called last."""
