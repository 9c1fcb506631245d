"""A recording of what comes, started and stopped while a run goes on."""

import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from evlcp_sdk.errors import EvlcpError
from evlcp_sdk.io.open import open_writer
from evlcp_sdk.live.outlet import Outlet, Subscription

__all__ = ["Recorder"]

_MOST_WAITING: Final = 4096
"""Pieces that wait for the disk, some seconds; the oldest go, counted."""


class Recorder:
    """Writes events to a RAW file in a thread of its own, from `start` to `stop`.

    Args:
        outlet: Where events come from.
        folder: Where files go, named by the time of their start.
        width: Columns of the sensor.
        height: Its rows.
    """

    def __init__(self, outlet: Outlet, folder: Path, width: int, height: int) -> None:
        self._outlet, self._folder = outlet, folder
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
        self._mine = self._outlet.subscribe({"events"}, most=_MOST_WAITING)
        self._thread = threading.Thread(
            target=self._write, args=(self._path, self._mine), name="evlcp-recorder", daemon=True
        )
        self._thread.start()

    def stop(self, timeout_s: float = 30.0) -> None:
        """End the file: all that has come is in it."""
        if self._mine is not None and self._thread is not None:
            self._outlet.leave(self._mine)
            self._thread.join(timeout_s)

    def _write(self, path: Path, mine: Subscription) -> None:
        try:
            with open_writer(path, *self._size) as writer:
                while not mine.ended:
                    for news in mine.take(0.5):
                        writer.write(news.value)
                        self._events += len(news.value)
        except EvlcpError as fault:
            self._fault = str(fault)
        finally:
            self._outlet.leave(mine)
