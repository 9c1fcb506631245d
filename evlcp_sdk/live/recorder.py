"""Records events and triggers, started and stopped during a run."""

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

_MAX_WAITING: Final = 4096
"""Pieces that may wait for the disk, some seconds; beyond, the oldest are dropped."""

_MIN_FREE_BYTES: Final = 100_000_000
"""Free bytes on the disk below which a recording ends: enough for some seconds of a camera, and the result
of the run."""


class Recorder:
    """Writes a sensor's events and triggers to a RAW file in a thread of its own, from `start` to `stop`.

    Files in the folder, created if need be, are named by the time of their start.
    """

    def __init__(self, publisher: Publisher, folder: Path, width: int, height: int) -> None:
        self._publisher, self._folder = publisher, folder
        self._size = width, height
        self._subscription: Subscription | None = None
        self._thread: threading.Thread | None = None
        self._path: Path | None = None
        self._events = 0
        self._fault = ""

    @property
    def state(self) -> dict[str, Any]:
        """Whether it records, the file, its events, dropped pieces, and the fault that ended it."""
        return {
            "recording": self._thread is not None and self._thread.is_alive(),
            "file": None if self._path is None else self._path.name,
            "events": self._events,
            "dropped": 0 if self._subscription is None else self._subscription.dropped,
            "fault": self._fault,
        }

    def start(self) -> None:
        """Start a file, if none is being written."""
        if self.state["recording"]:
            return
        self._path = self._folder / f"live-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}.raw"
        self._events, self._fault = 0, ""
        self._subscription = self._publisher.subscribe({"events", "triggers"}, most=_MAX_WAITING)
        self._thread = threading.Thread(
            target=self._write, args=(self._path, self._subscription), name="evlcp-recorder", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """End the file, which is complete when its thread ends."""
        if self._subscription is not None:
            self._publisher.unsubscribe(self._subscription)

    def close(self) -> None:
        """End the file, and wait for it."""
        self.stop()
        if self._thread is not None:
            self._thread.join(30.0)

    def _write(self, path: Path, subscription: Subscription) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with open_writer(path, *self._size) as writer:
                self._write_news(writer, subscription)
        except EvlcpError as fault:
            self._fault = str(fault)
        except OSError as fault:
            self._fault = f"{path.parent}: cannot be made: {fault.strerror}"
        finally:
            self._publisher.unsubscribe(subscription)

    def _write_news(self, writer: EventWriter, subscription: Subscription) -> None:
        """Write news until the subscription ends or writing fails; what is written stays."""
        triggers = Triggers.empty()
        while not subscription.ended:
            for news in subscription.take(0.5):
                if news.kind == "triggers":
                    triggers = Triggers.concat([triggers, news.value])
                    continue
                # Triggers precede the events of their piece in the queue.
                try:
                    writer.write(news.value, triggers)
                except StreamError as fault:
                    # The camera's clock has restarted.
                    self._fault = str(fault)
                    return
                self._events += len(news.value)
                triggers = Triggers.empty()
            free = shutil.disk_usage(writer.path.parent).free
            if free < _MIN_FREE_BYTES:
                expected = f"expected {_MIN_FREE_BYTES / 1e6:.0f}"
                self._fault = f"{writer.path}: {free / 1e6:.0f} MB are left on the disk: {expected}"
                return
        writer.write(Events.empty(), triggers)
