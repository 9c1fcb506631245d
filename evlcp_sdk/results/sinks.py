"""All sinks of one run as one, and whose fault it is when one of them fails."""

from __future__ import annotations

import json
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evlcp_sdk.errors import EvlcpError, PluginError
from evlcp_sdk.files import writing
from evlcp_sdk.plugin.records import InstalledSink
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.values import Events, Packet

if TYPE_CHECKING:
    from evlcp_sdk.place.navigator import Placed, Settled


def load_sinks(chosen: Sequence[InstalledSink]) -> list[tuple[InstalledSink, type[Sink]]]:
    """Import the classes of sinks.

    Raises:
        ConfigError: A package that one needs is not installed.
        PluginError: One cannot be imported, or is not a sink.
    """
    classes = []
    for installed in chosen:
        cls = installed.load_class()
        if not issubclass(cls, Sink):
            raise PluginError(f"{installed}: {installed.record.target} is not a Sink")
        classes.append((installed, cls))
    return classes


class Sinks:
    """Hands on what a run finds to each of its sinks.

    What a sink raises becomes a `PluginError` that names it, or an `OutputError` where the disk refuses.
    """

    def __init__(self) -> None:
        self._folder = Path()
        self._sinks: list[tuple[InstalledSink, Sink]] = []

    def open(
        self, classes: Sequence[tuple[InstalledSink, type[Sink]]], folder: ResultFolder, run: Run
    ) -> None:
        """Make sinks of their classes, in the order in which they are called.

        Raises:
            OutputError: A file cannot be opened.
        """
        self._folder = folder.folder
        for installed, cls in classes:
            with self._blame(installed):
                self._sinks.append((installed, cls(folder, run)))

    @property
    def all(self) -> tuple[Sink, ...]:
        """The sinks themselves."""
        return tuple(sink for _, sink in self._sinks)

    def events(self, events: Events) -> None:
        """Hand on events."""
        self._each(lambda sink: sink.events(events))

    def packet(self, packet: Packet) -> None:
        """Hand on a packet."""
        self._each(lambda sink: sink.packet(packet))

    def placed(self, placed: Placed) -> None:
        """Hand on a fix, and what it settles."""
        self._each(lambda sink: sink.fix(placed.fix, placed.filtered))
        if placed.settled:
            self.settle(placed.settled)

    def settle(self, settled: Sequence[Settled]) -> None:
        """Hand on fixes that are settled."""
        self._each(lambda sink: sink.settle(settled))

    def finish(self) -> dict[str, Mapping[str, Any]]:
        """End the sinks; return what they say, by name."""
        found: dict[str, Mapping[str, Any]] = {}
        for installed, sink in self._sinks:
            with self._blame(installed):
                part: object = sink.finish()
                if part is not None and not isinstance(part, Mapping):
                    raise PluginError(f"{installed}: finish() gave {type(part).__name__}, expected a mapping")
                if part:
                    # What JSON cannot say is the sink's fault, not the summary's.
                    json.dumps(dict(part), allow_nan=False)
                    found[installed.record.name] = dict(part)
        return found

    def conclude(self, summary: Mapping[str, Any]) -> None:
        """Hand on the summary, all but its `files`."""
        # A copy: what a sink changes in it would be missing in summary.json.
        self._each(lambda sink: sink.conclude(deepcopy(dict(summary))))

    def _each(self, call: Callable[[Sink], None]) -> None:
        for installed, sink in self._sinks:
            with self._blame(installed):
                call(sink)

    @contextmanager
    def _blame(self, installed: InstalledSink) -> Iterator[None]:
        try:
            with writing(self._folder):
                yield
        except EvlcpError:
            raise
        except (Exception, SystemExit) as fault:
            last = traceback.extract_tb(fault.__traceback__)[-1]
            what = f"{type(fault).__name__}: {fault}".splitlines()[0]
            where = f"{Path(last.filename).name}, line {last.lineno}"
            raise PluginError(f"{installed}: {what} ({where})") from fault
