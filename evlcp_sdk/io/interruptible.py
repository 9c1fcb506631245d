"""Open and read sources that may wait forever, as a silent stream does, until a request to stop."""

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

from evlcp_sdk.io.open import open_source
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.signals import Stopped, waiting
from evlcp_sdk.values import Events, Triggers


def open_until_stopped(source: EventSource | str | Path, registry: Registry, stopped: Stopped) -> EventSource:
    """Open a source, or return one that is open already; a request to stop ends the wait for a sender.

    A file never waits, so it is opened even after a request to stop; its reader then ends.

    Raises:
        InputError: It cannot be opened.
        KeyboardInterrupt: A stop was requested, and the source is not a file.
    """
    if isinstance(source, EventSource):
        return source
    with nullcontext() if _is_file(source) else waiting(stopped):
        return open_source(source, registry)


def _is_file(source: str | Path) -> bool:
    try:
        return Path(source).is_file()
    except OSError:
        return False


def stream_until_stopped(source: EventSource, stopped: Stopped) -> Iterator[tuple[Events, Triggers]]:
    """Yield what a source streams; a request to stop ends the wait for one without a size.

    Raises:
        InputError: It cannot be read on.
    """
    stream, endless = source.stream(), source.size_bytes is None
    while True:
        try:
            with waiting(stopped) if endless else nullcontext():
                piece = next(stream, None)
        except KeyboardInterrupt:
            if not (endless and stopped()):
                raise
            return
        if piece is None:
            return
        yield piece
