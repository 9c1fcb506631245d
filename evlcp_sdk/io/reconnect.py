"""A source that is opened again when it is gone: a camera that was unplugged, a stream whose sender left."""

import time
from collections.abc import Callable, Mapping
from typing import Final

from evlcp_sdk.errors import InputError
from evlcp_sdk.plugin.source import EventSource, Loss
from evlcp_sdk.signals import Stopped
from evlcp_sdk.values import Events, Triggers

_EVERY_S: Final = 0.5
"""How often it is tried."""


class ReconnectingSource(EventSource):
    """A live source, opened again and again when it ends or fails, until stopped.

    Its clock may begin anew with each opening; a receiver takes that for a restart of the camera's clock.

    Args:
        opened: Opens it.
        stopped: Whether to give up.
        sleep: Waits, s.

    Attributes:
        reconnects: How often it was opened again.

    Raises:
        InputError: It cannot be opened the first time.
    """

    live = True

    def __init__(
        self,
        opened: Callable[[], EventSource],
        stopped: Stopped = lambda: False,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._opened = opened
        self._stopped = stopped
        self._sleep = sleep
        self._source = source = opened()
        super().__init__(source.path, source.format, source.width, source.height, source.header)
        self.guessed = source.guessed
        self.reconnects = 0
        self._closed = False
        self._lost: dict[str, Loss] = {}

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """As of the source; waits while it is gone."""
        while True:
            try:
                piece = next(self._source.stream(max_events), None)
            except InputError:
                piece = None
            if piece is not None:
                return piece
            if not self._again():
                return None

    def _again(self) -> bool:
        self._lost = self.losses
        self._source.close()
        while not self._stopped() and not self._closed:
            try:
                source = self._opened()
            except InputError:
                self._sleep(_EVERY_S)
                continue
            self._source = source
            self.reconnects += 1
            return True
        return False

    def clock_s(self, t_us: float) -> float | None:
        """As of the source."""
        return self._source.clock_s(t_us)

    @property
    def health(self) -> Mapping[str, float | int | str]:
        """As of the source, with `reconnects`."""
        return {**self._source.health, "reconnects": self.reconnects}

    @property
    def losses(self) -> dict[str, Loss]:
        """As of the source, those of earlier openings too."""
        return Loss.added(self._lost, self._source.losses)

    @property
    def counts(self) -> dict[str, int]:
        """As `EventSource.counts`, with `reconnects`."""
        return super().counts | {"reconnects": self.reconnects}

    def close(self) -> None:
        """Open it no more, and let it go."""
        self._closed = True
        self._source.close()
