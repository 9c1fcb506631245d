"""Sources that may wait for ever, as streams of silent senders, opened and read until a request to stop."""

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

from evlcp_sdk.io.open import open_source
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.signals import Stopped, waiting
from evlcp_sdk.values import Events, Triggers


def open_until(source: EventSource | str | Path, registry: Registry, stopped: Stopped) -> EventSource:
    """Open a source, or give one that is open; a request to stop ends the wait for a sender.

    A file is there at once, and is opened whatever was asked: who reads it ends when he asks.

    Raises:
        InputError: It cannot be opened.
        KeyboardInterrupt: It was asked to stop, and the source is no file.
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


def pieces_until(source: EventSource, stopped: Stopped) -> Iterator[tuple[Events, Triggers]]:
    """What a source streams; of one without a size, which may wait for ever, until it is asked to stop.

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
