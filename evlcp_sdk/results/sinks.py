"""All sinks of one run as one, with the name of the one that fails."""

import json
from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

from evlcp_sdk.errors import PluginError, blame
from evlcp_sdk.files import writing
from evlcp_sdk.plugin.records import InstalledSink
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink


def load_sinks(sinks: Sequence[InstalledSink]) -> list[tuple[InstalledSink, type[Sink]]]:
    """Import the classes of sinks.

    Raises:
        ConfigError: A package that one needs is not installed.
        PluginError: One cannot be imported, or is not a sink.
    """
    classes = []
    for installed in sinks:
        cls = installed.load_class()
        if not issubclass(cls, Sink):
            raise PluginError(f"{installed}: {installed.record.target} is not a Sink")
        classes.append((installed, cls))
    return classes


class Sinks:
    """The sinks of a run, in the order in which they are called.

    An exception of a sink becomes a `PluginError` that names it, or an `OutputError` where a file cannot be
    written.
    """

    def __init__(self) -> None:
        self._folder = Path()
        self._sinks: list[tuple[InstalledSink, Sink]] = []

    def open(
        self, classes: Sequence[tuple[InstalledSink, type[Sink]]], folder: ResultFolder, run: Run
    ) -> None:
        """Create sinks of these classes.

        Raises:
            OutputError: A file cannot be opened.
        """
        self._folder = folder.folder
        for installed, cls in classes:
            with blame(str(installed)), writing(self._folder):
                self._sinks.append((installed, cls(folder, run)))

    @property
    def all(self) -> tuple[Sink, ...]:
        """The sinks."""
        return tuple(sink for _, sink in self._sinks)

    def call(self, method: str, *arguments: Any) -> None:
        """Call a method of each sink."""
        for installed, sink in self._sinks:
            with blame(str(installed)), writing(self._folder):
                getattr(sink, method)(*arguments)

    def finish(self) -> dict[str, Mapping[str, Any]]:
        """Finish the sinks; return their parts of the summary, by name."""
        parts: dict[str, Mapping[str, Any]] = {}
        for installed, sink in self._sinks:
            with blame(str(installed)), writing(self._folder):
                part: object = sink.finish()
                if part is not None and not isinstance(part, Mapping):
                    raise PluginError(f"{installed}: finish() gave {type(part).__name__}, expected a mapping")
                if part:
                    # A value that is not JSON is the sink's fault, not the summary's.
                    json.dumps(dict(part), allow_nan=False)
                    parts[installed.record.name] = dict(part)
        return parts

    def conclude(self, summary: Mapping[str, Any]) -> None:
        """Pass on the summary, to each a copy, so that none can change `summary.json`."""
        for installed, sink in self._sinks:
            with blame(str(installed)), writing(self._folder):
                sink.conclude(deepcopy(dict(summary)))
