"""A recording of what comes, started and stopped while a run goes on."""

import shutil
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from evlcp_sdk.errors import EvlcpError, StreamError
from evlcp_sdk.io.open import open_writer
from evlcp_sdk.live.publisher import Publisher, Subscription
from evlcp_sdk.plugin.writer import EventWriter
from evlcp_sdk.values import Events, Triggers

_MOST_WAITING: Final = 4096
"""Pieces that wait for the disk, some seconds; the oldest go, counted."""

_LEAST_FREE: Final = 100_000_000
"""Bytes of the disk below which a recording ends, while it can still be completed: some seconds of a camera,
and what the result of the run needs."""


class Recorder:
    """Writes events and triggers to a RAW file in a thread of its own, from `start` to `stop`.

    Args:
        publisher: Where they come from.
        folder: Where files go, named by the time of their start; made if need be.
        width: Columns of the sensor.
        height: Its rows.
    """

    def __init__(self, publisher: Publisher, folder: Path, width: int, height: int) -> None:
        self._publisher, self._folder = publisher, folder
        self._size = width, height
        self._mine: Subscription | None = None
        self._thread: threading.Thread | None = None
        self._path: Path | None = None
        self._events = 0
        self._fault = ""

    @property
    def state(self) -> dict[str, Any]:
        """Whether it records, the file, the events in it, pieces that were dropped, and what went wrong."""
        return {
            "recording": self._thread is not None and self._thread.is_alive(),
            "file": None if self._path is None else self._path.name,
            "events": self._events,
            "dropped": 0 if self._mine is None else self._mine.dropped,
            "fault": self._fault,
        }

    def start(self) -> None:
        """Begin a file; nothing where one is being written."""
        if self.state["recording"]:
            return
        self._path = self._folder / f"live-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}.raw"
        self._events, self._fault = 0, ""
        self._mine = self._publisher.subscribe({"events", "triggers"}, most=_MOST_WAITING)
        self._thread = threading.Thread(
            target=self._write, args=(self._path, self._mine), name="evlcp-recorder", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """End the file, which is there once all that has come is in it."""
        if self._mine is not None:
            self._publisher.leave(self._mine)

    def close(self) -> None:
        """End the file, and wait for it."""
        self.stop()
        if self._thread is not None:
            self._thread.join(30.0)

    def _write(self, path: Path, mine: Subscription) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with open_writer(path, *self._size) as writer:
                self._fill(writer, mine)
        except EvlcpError as fault:
            self._fault = str(fault)
        except OSError as fault:
            self._fault = f"{path.parent}: cannot be made: {fault.strerror}"
        finally:
            self._publisher.leave(mine)

    def _fill(self, writer: EventWriter, mine: Subscription) -> None:
        """Write what comes; what is written stays where no more can be."""
        held = Triggers.empty()
        while not mine.ended:
            for news in mine.take(0.5):
                if news.kind == "triggers":
                    held = Triggers.concat([held, news.value])
                    continue
                # Those of the same piece stand before it in the queue.
                try:
                    writer.write(news.value, held)
                except StreamError as fault:
                    # The camera's clock has begun anew.
                    self._fault = str(fault)
                    return
                self._events += len(news.value)
                held = Triggers.empty()
            free = shutil.disk_usage(writer.path.parent).free
            if free < _LEAST_FREE:
                expected = f"expected {_LEAST_FREE / 1e6:.0f}"
                self._fault = f"{writer.path}: {free / 1e6:.0f} MB are left on the disk: {expected}"
                return
        writer.write(Events.empty(), held)
