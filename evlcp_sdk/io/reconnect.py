"""A source that is opened again when it is gone: a camera that was unplugged, a stream whose sender left."""

import time
from collections.abc import Callable, Mapping
from typing import Final

from evlcp_sdk.errors import InputError
from evlcp_sdk.io.replay import WrappingSource
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.signals import Stopped
from evlcp_sdk.values import Events, Triggers

_EVERY_S: Final = 0.5
"""How often it is tried."""


class ReconnectingSource(WrappingSource):
    """A live source, opened again and again when it ends or fails, until stopped.

    Its clock may begin anew with each opening; a receiver takes that for a restart of the camera's clock.

    Args:
        opened: Opens it.
        stopped: Whether to give up.
        sleep: Waits, s.

    Raises:
        InputError: It cannot be opened the first time.
    """

    live = True

    def __init__(
        self, opened: Callable[[], EventSource], stopped: Stopped, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        super().__init__(opened())
        self._opened, self._stopped, self._sleep = opened, stopped, sleep
        self._reconnects = 0
        self._closed = False

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """As of the source; waits while it is gone."""
        while True:
            try:
                piece = next(self._source.stream(max_events), None)
            except InputError:
                piece = None
            if piece is not None or not self._is_back():
                return piece

    def _is_back(self) -> bool:
        while not self._stopped() and not self._closed:
            try:
                self._replace(self._opened)
            except InputError:
                self._sleep(_EVERY_S)
                continue
            self._reconnects += 1
            return True
        return False

    @property
    def health(self) -> Mapping[str, float | int | str]:
        """As of the source, with `reconnects`."""
        return {**self._source.health, "reconnects": self._reconnects}

    @property
    def counts(self) -> dict[str, int]:
        """As `EventSource.counts`, with `reconnects`."""
        return super().counts | {"reconnects": self._reconnects}

    def close(self) -> None:
        """Open it no more, and let it go."""
        self._closed = True
        super().close()
