"""Read AEDAT4, DAT and Event Stream files by the optional package `faery`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from evlcp_sdk.errors import InputError, import_extra
from evlcp_sdk.io._sieve import Sieve
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.values import Events, Triggers

_FORMATS: Final = {
    ".aedat4": ("AEDAT4", "aedat"),
    ".aedat": ("AEDAT4", "aedat"),
    ".dat": ("DAT", "dat"),
    ".es": ("ES", "es"),
}
"""Name of a format, and its name in `faery`, by suffix."""

UNKNOWN_SIZE = (0xFFFF, 0xFFFF)


class FaerySource(EventSource):
    """Reads a file by `faery`, its suffix the format; contrast-detection events only, no triggers.

    What `faery` skips silently, such as the rest of a DAT file cut within an event, is in no loss.

    Raises:
        InputError: `faery` is not installed, or cannot read the file.
    """

    def __init__(self, path: Path | str) -> None:
        target = Path(path)
        name, kind = _FORMATS[target.suffix.lower()]
        faery = import_extra("faery", "faery", str(path), InputError)
        try:
            stream = faery.events_stream_from_file(target, dimensions_fallback=UNKNOWN_SIZE, file_type=kind)
            size = stream.dimensions()
        except Exception as error:
            raise InputError(f"{path}: found no {name} file, expected one ({error})") from error
        width, height = (None, None) if size == UNKNOWN_SIZE else size
        self._sieve = Sieve("row", 1, width, height)
        super().__init__(target, name, width, height, None, target.stat().st_size, self._sieve)
        self._packets: Iterator[Any] = iter(stream)
        self._row = 1

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """Return the next packet of the file, of any size, or None at the end."""
        try:
            packet = next(self._packets, None)
        except Exception as error:
            raise InputError(f"{self.path}: at event {self._row}: {error}") from error
        if packet is None:
            events = self._sieve.close()
            return (events, Triggers.empty()) if len(events) else None
        self._row += len(packet)
        columns = (packet["t"], packet["x"], packet["y"], packet["on"])
        events = Events.of(*(np.array(column) for column in columns))  # copies: faery may reuse the packet
        return self._sieve.sift(events), Triggers.empty()

    def close(self) -> None:
        """Close the file."""
        self._packets = iter(())
