"""Drop what no receiver may see, for the formats that are not decoded word by word."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from evlcp_sdk.clock import CameraClock
from evlcp_sdk.plugin.source import Loss
from evlcp_sdk.values import Events

_LOSSES: Final = {
    "outside_sensor": ("dropped_off_sensor", "events outside the sensor; dropped"),
    "time_backward": ("dropped_time_backward", "events earlier than the one before; dropped"),
    "time_doubtful": (
        "dropped_time_doubtful",
        "events at times that no others agree with; dropped",
    ),
}


class Sieve:
    """Drops and counts events outside the sensor, out of order, or at times that no others agree with.

    The camera's clock may leap or restart: see `CameraClock`.

    Args:
        unit: The unit of positions in `losses`: `line` or `row`.
        first: The line or row of the first event, as a heading is none.
        width: Columns of the sensor, or None if unknown.
        height: Rows of the sensor, or None.
    """

    def __init__(self, unit: str, first: int, width: int | None, height: int | None) -> None:
        self._unit, self._first = unit, first
        self._clock = CameraClock(width or 1 << 16, height or 1 << 16, is_sparse=True)

    def sift(self, events: Events) -> Iterator[Events]:
        """Yield those of the next events to keep, and earlier ones whose times are now confirmed.

        No piece goes on over a restart of the clock. The columns stay the caller's.
        """
        return self._restore_times(self._clock.feed(events))

    def close(self) -> Iterator[Events]:
        """End the stream; yield the events still held back that nothing contradicts."""
        return self._restore_times(self._clock.close())

    def _restore_times(self, pieces: list[Events]) -> Iterator[Events]:
        for piece in pieces:
            first_us = int(piece.t_us[0])
            offset_us = int(self._clock.camera_us(first_us)) - first_us
            yield Events(piece.t_us + np.int64(offset_us), piece.x, piece.y, piece.p)

    @property
    def counts(self) -> dict[str, int]:
        """Confirmed restarts of the clock, if there were any; a long pause is none."""
        restarts = self._clock.counts["clock_restarts"]
        return {"clock_restarts": restarts} if restarts else {}

    @property
    def losses(self) -> dict[str, Loss]:
        """As `EventSource.losses`."""
        counts, firsts = self._clock.counts, self._clock.firsts
        return {
            name: Loss(counts[count], self._first + firsts[count], self._unit, meaning)
            for name, (count, meaning) in _LOSSES.items()
            if counts[count]
        }
