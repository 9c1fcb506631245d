"""Open a source again when it is gone: a camera that was unplugged, a stream whose sender left."""

import time
from collections.abc import Callable, Mapping
from typing import Final

from evlcp_sdk.errors import InputError
from evlcp_sdk.io.replay import WrappingSource
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.signals import Stopped
from evlcp_sdk.values import Events, Triggers

_RETRY_S: Final = 0.5


class ReconnectingSource(WrappingSource):
    """A live source that is reopened whenever it ends or fails, until stopped.

    Its clock may start anew each time; to a receiver that is a restart of the camera's clock.

    Raises:
        InputError: It cannot be opened the first time.
    """

    live = True

    def __init__(
        self, opener: Callable[[], EventSource], stopped: Stopped, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        super().__init__(opener())
        self._opener, self._stopped, self._sleep = opener, stopped, sleep
        self._reconnects = 0
        self._closed = False

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """As `EventSource.take`; waits while the source is gone."""
        while True:
            try:
                piece = next(self._source.stream(max_events), None)
            except InputError:
                piece = None
            if piece is not None or not self._reconnect():
                return piece

    def _reconnect(self) -> bool:
        while not self._stopped() and not self._closed:
            try:
                self._reopen(self._opener)
            except InputError:
                self._sleep(_RETRY_S)
                continue
            self._reconnects += 1
            return True
        return False

    @property
    def health(self) -> Mapping[str, float | int | str]:
        """The health of the source, with `reconnects`."""
        return {**self._source.health, "reconnects": self._reconnects}

    @property
    def counts(self) -> dict[str, int]:
        """As `EventSource.counts`, with `reconnects`."""
        return super().counts | {"reconnects": self._reconnects}

    def close(self) -> None:
        """Close the source and stop reopening it."""
        self._closed = True
        super().close()
