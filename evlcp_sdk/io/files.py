"""Open and save recordings, whatever their format."""

from pathlib import Path

from evlcp_sdk.io.raw import RawSource
from evlcp_sdk.io.sources import EventSource
from evlcp_sdk.types import Events

__all__ = ["open_events", "read_events"]


def open_events(path: Path | str) -> EventSource:
    """Open a recording; a context manager.

    Raises:
        InputError: The file cannot be opened or is of no known format.
    """
    return RawSource(path)


def read_events(path: Path | str) -> Events:
    """Return all events of a recording.

    Raises:
        InputError: The file cannot be read.
    """
    with open_events(path) as source:
        return source.read()[0]
