"""Hold back what no receiver may see, for the formats that are not decoded word by word."""

from typing import Final

import numpy as np

from evlcp_sdk.clock import CameraClock
from evlcp_sdk.plugin.source import Loss
from evlcp_sdk.values import Events

MEANINGS: Final = {
    "outside_sensor": ("dropped_off_sensor", "events outside the sensor; dropped"),
    "time_backward": ("dropped_time_backward", "events earlier than the one before; dropped"),
    "time_doubtful": (
        "dropped_time_doubtful",
        "events at times that no others agree with; dropped",
    ),
}


class Sieve:
    """Drops and counts events outside the sensor, in disorder, or on a clock that no others agree on.

    The camera's clock may leap or restart as a receiver's stream may: see `CameraClock`.

    Args:
        unit: What `losses` count positions in: `line` or `row`.
        width: Columns of the sensor, or None if unknown.
        height: Rows of the sensor, or None.
    """

    def __init__(self, unit: str, width: int | None, height: int | None) -> None:
        self._unit = unit
        self._clock = CameraClock(width or 1 << 16, height or 1 << 16, sparse=True)
        self._firsts: dict[str, int] = {}
        self._ahead = 0

    def sift(self, events: Events, first: int) -> Events:
        """Return the events to keep, and those held before that have become believed.

        Args:
            events: The next ones; the columns are the caller's.
            first: Line or row of the first of them.
        """
        # Lines are ahead of numbers, by a heading and by those that are empty.
        self._ahead = first - self._clock.counts["events"]
        return self._given(self._clock.take(events))

    def close(self) -> Events:
        """End the stream: return what is still held, where nothing contradicts it."""
        return self._given(self._clock.close())

    def _given(self, pieces: list[Events]) -> Events:
        for name, number in self._clock.firsts.items():
            self._firsts.setdefault(name, number + self._ahead)
        kept = [self._on_camera(piece) for piece in pieces]
        return kept[0] if len(kept) == 1 else Events.concat(kept)

    def _on_camera(self, piece: Events) -> Events:
        """A piece with the times that it came with."""
        inside_us = int(piece.t_us[0])
        offset_us = int(self._clock.camera_us(inside_us)) - inside_us
        return Events(piece.t_us + np.int64(offset_us), piece.x, piece.y, piece.p)

    @property
    def counts(self) -> dict[str, int]:
        """Restarts of the clock that were believed, where there were any; a long pause is none."""
        restarts = self._clock.counts["clock_restarts"]
        return {"clock_restarts": restarts} if restarts else {}

    @property
    def losses(self) -> dict[str, Loss]:
        """As `EventSource.losses`."""
        counts = self._clock.counts
        return {
            name: Loss(counts[count], self._firsts[count], self._unit, meaning)
            for name, (count, meaning) in MEANINGS.items()
            if counts[count]
        }
