"""What a source of a plugin gives is checked before any kernel sees it, and the source is named."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from evlcp_sdk.errors import InputError, PluginError
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.values import Events, Triggers


class Strange(EventSource):
    """A source whose one piece is what a function gives."""

    def __init__(self, gives: Callable[[], Any]) -> None:
        super().__init__(Path("strange:0"), "STRANGE", 1280, 720)
        self._gives: list[Callable[[], Any]] = [gives]

    def take(self, max_events: int) -> Any:
        return self._gives.pop()() if self._gives else None

    def close(self) -> None:
        pass


def raises(fault: BaseException) -> Any:
    raise fault


EVENTS = Events.of([1, 2], [3, 4], [5, 6], [1, 7])


@pytest.mark.parametrize(
    ("gives", "message"),
    [
        (lambda: 5, r"gave \(int\), expected \(Events, Triggers\)"),
        (lambda: (EVENTS,), r"gave \(Events\), expected .*"),
        (lambda: (EVENTS, None), r"gave \(Events, NoneType\), expected .*"),
        (lambda: (EVENTS, Triggers.empty()), "gave polarity 7, expected 0 or 1"),
        (lambda: raises(KeyError("boom")), r"KeyError: 'boom' \(test_source.py, line \d+\)"),
        (lambda: raises(SystemExit(0)), r"SystemExit: 0 \(test_source.py, line \d+\)"),
    ],
)
def test_what_no_receiver_can_take_is_named(gives: Callable[[], Any], message: str) -> None:
    with pytest.raises(PluginError, match=f"^strange:0: source Strange: {message}$"):
        Strange(gives).read()


class Stuck(Strange):
    """One that cannot be closed."""

    def close(self) -> None:
        raise RuntimeError("stuck")


def test_a_source_that_cannot_be_closed_is_named_unless_something_failed_before() -> None:
    with (
        pytest.raises(
            PluginError, match=r"^strange:0: source Stuck: RuntimeError: stuck \(test_source.py, line"
        ),
        Stuck(lambda: None),
    ):
        pass
    with pytest.raises(InputError, match="lens cap"), Stuck(lambda: None):
        raise InputError("the lens cap is on")
