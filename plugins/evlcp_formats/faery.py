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
        self._pieces = self._read(iter(stream))

    def _read(self, packets: Iterator[Any]) -> Iterator[Events]:
        row = 1
        try:
            for packet in packets:
                row += len(packet)
                columns = (packet["t"], packet["x"], packet["y"], packet["on"])
                # Copies, as faery may reuse the packet.
                yield from self._sieve.sift(Events.of(*map(np.array, columns)))
        except Exception as error:
            raise InputError(f"{self.path}: at event {row}: {error}") from error
        yield from self._sieve.close()

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """Return the next packet of the file, of any size, or None at the end."""
        events = next(self._pieces, None)
        return None if events is None else (events, Triggers.empty())

    def close(self) -> None:
        """Close the file."""
        self._pieces = iter(())
