"""The base of all writers of recordings."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import EvlcpError, StreamError, blame_class
from evlcp_sdk.files import Outputs, writing
from evlcp_sdk.values import Events, Triggers, span_us

LAST_TIME_US = 10**18 - 1
"""Latest time in a table, us, of 18 digits; its negative is the earliest."""


class EventWriter(ABC):
    """A recording that is written piece by piece; a context manager.

    The file appears under its name only when it is complete: until then it is a hidden one beside it, which
    an exception in the `with` block removes. A pipe or other special file is written directly.

    Args:
        path: The file; an existing one is replaced.
        width: Columns of the sensor, or None if unknown; no event may lie outside.
        height: Rows of the sensor, or None.
        outputs: The files that are committed together with it; None to commit it alone when it is closed.

    Raises:
        OutputError: The file cannot be written.
    """

    times_us = (-LAST_TIME_US, LAST_TIME_US)
    """Earliest and latest time that can be written, us."""
    channels = 256
    """Trigger inputs that can be written."""

    def __init__(
        self, path: Path | str, width: int | None, height: int | None, outputs: Outputs | None = None
    ) -> None:
        self.path = Path(path)
        self.width = width
        self.height = height
        self._last_us: int | None = None
        self._alone = outputs is None
        self._outputs = Outputs() if outputs is None else outputs
        with writing(self.path):
            self._file = self._outputs.open_binary(self.path)
        try:
            with blame_class(self, f"{self.path}: writer"), writing(self.path):
                self._begin()
        except EvlcpError:
            self.discard()
            raise

    def write(self, events: Events, triggers: Triggers | None = None) -> None:
        """Append events and triggers, each sorted by time and not earlier than those already written.

        Raises:
            OutputError: The file cannot be written.
            StreamError: Times run backward, or the file cannot hold a value; nothing is written then.
        """
        if triggers is None:
            triggers = Triggers.empty()
        if self._file.closed:
            raise StreamError(f"{self.path}: written to after it was closed")
        self._check_times(events.t_us, "event")
        self._check_times(triggers.t_us, "trigger")
        self._check_column("event", "x", events.x, self.width)
        self._check_column("event", "y", events.y, self.height)
        self._check_column("event", "p", events.p, 2)
        self._check_column("trigger", "channel", triggers.channel, self.channels)
        self._check_column("trigger", "value", triggers.value, 2)
        with blame_class(self, f"{self.path}: writer"), writing(self.path):
            self._write(events, triggers)
        if len(events) or len(triggers):
            self._last_us = span_us(events, triggers)[1]

    def _begin(self) -> None:  # noqa: B027
        """Write the beginning of the file to `_file`."""

    @abstractmethod
    def _write(self, events: Events, triggers: Triggers) -> None:
        """Append checked events and triggers to `_file`."""

    def _finish(self) -> None:  # noqa: B027
        """Append the end of the file."""

    def close(self) -> None:
        """Complete the file and give it its name; a second call does nothing.

        Raises:
            OutputError: The file cannot be written.
        """
        if self._file.closed:
            return
        try:
            with blame_class(self, f"{self.path}: writer"), writing(self.path):
                self._finish()
                self._file.close()
            if self._alone:
                self._outputs.commit()
        except EvlcpError:
            self.discard()
            raise

    def discard(self) -> None:
        """Remove what has been written; a file that had the name before stays as it was."""
        self._outputs.discard()

    def _check_times(self, t_us: NDArray[np.int64], what: str) -> None:
        if not len(t_us):
            return
        before = np.append(t_us[0] if self._last_us is None else self._last_us, t_us[:-1])
        if (back := t_us < before).any():
            k = int(back.argmax())
            found = f"{what} at {t_us[k]} us after {before[k]} us"
            raise StreamError(f"{self.path}: {found}, expected sorted times")
        first, last = self.times_us
        for t in (t_us[0], t_us[-1]):
            if not first <= t <= last:
                raise StreamError(f"{self.path}: {what} at {t} us, expected {first} to {last} us")

    def _check_column(self, what: str, name: str, column: NDArray[Any], size: int | None) -> None:
        if size is None or not len(column) or column.max() < size:
            return
        k = int((column >= size).argmax())
        raise StreamError(f"{self.path}: {what} {k}: {name} is {column[k]}, expected 0 to {size - 1}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        if error is None:
            self.close()
        else:
            self.discard()
