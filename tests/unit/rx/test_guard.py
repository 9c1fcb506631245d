"""An algorithm that fails is told by name, in one line."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.errors import ConfigError, PluginError
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.plugin.roles import Filter, Tracker
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, random_symbols
from evlcp_sdk.values import SoftSymbols

LINK = load_link(overrides=["tracking.id=kalman"])
EVENTS = ideal_events(LINK, IdealBar(random_symbols(LINK, 2)))
ROLES = ("synchronization", "separation", "decoding", "ranging", "tracking")


def fails(*_args: object) -> Any:
    raise KeyError("boom")


class FailingFilter(Filter):
    predict = step = fails  # type: ignore[assignment]

    def init(self) -> None:
        return None


FAILING: dict[str, Any] = {
    "synchronization": SimpleNamespace(init=lambda: None, step=fails),
    "tracking": Tracker(None, FailingFilter()),
}


def link_with(role: str, compiled: Callable[..., Any]) -> Link:
    return LINK.with_algorithm(role, SimpleNamespace(compile=compiled), id="mine")


def received(link: Link) -> None:
    receiver = Receiver(link)
    receiver.feed(EVENTS)
    receiver.close()


@pytest.mark.parametrize("role", ROLES)
def test_what_fails_in_a_frame_is_named(role: str) -> None:
    with pytest.raises(PluginError) as told:
        received(link_with(role, lambda *_: FAILING.get(role, fails)))
    assert str(told.value).startswith(f"{role} algorithm 'mine': KeyError: 'boom' (test_guard.py, line ")
    assert str(told.value).endswith(f"; try: evlcp check {role} mine")
    assert isinstance(told.value.__cause__, KeyError)


@pytest.mark.parametrize("role", ROLES)
def test_what_fails_to_compile_is_named(role: str) -> None:
    with pytest.raises(PluginError, match=f"{role} algorithm 'mine': KeyError"):
        Receiver(link_with(role, fails))


def test_what_the_sdk_says_itself_is_left_as_it_is() -> None:
    def refuses(*_args: object) -> None:
        raise ConfigError("ranging.clusters = [99]: expected 0 to 15")

    with pytest.raises(ConfigError, match=r"^ranging\.clusters"):
        Receiver(link_with("ranging", refuses))


@pytest.mark.parametrize(
    ("role", "gives", "says"),
    [
        ("separation", None, "gave NoneType, expected PresenceMap"),
        ("ranging", 50.0, "gave float, expected Range"),
        ("decoding", "text", "gave str, expected SoftSymbols"),
        (
            "decoding",
            SoftSymbols(np.zeros(3, np.int64), np.zeros((16, 6), np.float32), 1.0),
            r"gave symbols of shape \(3,\), expected \(16,\)",
        ),
        (
            "decoding",
            SoftSymbols(np.zeros(16, np.int64), np.zeros((16, 4), np.float32), 1.0),
            r"gave llr of shape \(16, 4\), expected \(16, 6\)",
        ),
    ],
)
def test_what_gives_another_thing_is_named(role: str, gives: object, says: str) -> None:
    with pytest.raises(PluginError, match=f"^{role} algorithm 'mine': {says}; try: evlcp check"):
        received(link_with(role, lambda *_: lambda *_: gives))


def test_a_filter_of_places_that_fails_is_named() -> None:
    with pytest.raises(PluginError, match=r"^tracking algorithm 'mine': KeyError: 'boom'"):
        received(link_with("tracking", lambda *_: Tracker(FailingFilter(), None)))


def test_a_synchronization_that_gives_no_locks_is_named() -> None:
    gives = SimpleNamespace(init=lambda: None, step=lambda *_: (None, [(0.0, 100.0)]))
    with pytest.raises(
        PluginError, match=r"^synchronization algorithm 'mine': gave tuple, expected SyncLock"
    ):
        received(link_with("synchronization", lambda *_: gives))


def test_the_command_line_tells_it_in_one_line(
    evlcp: Callable[..., Any], demo_raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from evlcp_joint.ranging import JointScaleRanging

    monkeypatch.setattr(JointScaleRanging, "compile", lambda *_: fails)
    done = evlcp("receive", demo_raw, "-o", tmp_path / "out")
    assert done.code == 2
    assert done.err.startswith(
        "evlcp: ranging algorithm 'joint-scale': KeyError: 'boom' (test_guard.py, line "
    )
    assert done.err.count("\n") == 1
    assert list((tmp_path / "out").iterdir()) == []
