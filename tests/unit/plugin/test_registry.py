"""Plugins found by name: what is refused and how it is said, and what listing them must not import."""

import json
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import entry_points
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest

from evlcp_sdk.errors import PluginError, PluginWarning, UnknownAlgorithmError
from evlcp_sdk.plugin.hooks import Algorithm, hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import ROLES
from tests.conftest import Brings


def ranging(name: str, target: str = "nowhere:Nothing") -> Algorithm:
    return Algorithm("ranging", name, target, 1, "a test")


@pytest.mark.parametrize(
    ("role", "name", "message"),
    [
        ("ranging", "pco", "named 'pco'; did you mean 'poc'? (installed: centroid, poc)"),
        ("ranging", "time-of-flight", "named 'time-of-flight' (installed: centroid, poc)"),
        ("pilots", "wh", "named 'wh' (installed: none)"),
    ],
)
def test_one_wrong_id_has_one_answer(role: str, name: str, message: str) -> None:
    registry = Registry(Brings(ranging("poc"), ranging("centroid")))
    with pytest.raises(UnknownAlgorithmError) as caught:
        registry.find(role, name)
    assert str(caught.value) == f"no {role} algorithm {message}"


class Owner(NamedTuple):
    """A distribution."""

    name: str
    version: str = "1.0"


def install(
    monkeypatch: pytest.MonkeyPatch, *found: tuple[str, str, Callable[[], object]], beside: bool = False
) -> None:
    """Let entry points be these, or they beside the installed ones: name, distribution, what loads it."""
    points: list[Any] = list(entry_points(group="evlcp")) if beside else []
    points += [
        SimpleNamespace(name=name, value=f"{owner}:it", load=load, dist=Owner(owner))
        for name, owner, load in found
    ]
    monkeypatch.setattr("evlcp_sdk.plugin.registry.entry_points", lambda group: points)


def test_two_algorithms_with_one_name_are_reported_when_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    both = {"evlcp-sdk": Brings(ranging("poc"), ranging("centroid")), "evlcp-fast": Brings(ranging("poc"))}
    install(monkeypatch, *((owner, owner, partial(both.get, owner)) for owner in both))
    registry = Registry.load()
    assert registry.find("ranging", "centroid").distribution == "evlcp-sdk"
    assert len(registry.list_algorithms("ranging")) == 3
    with pytest.raises(PluginError, match=r"^two ranging algorithms named 'poc': one of ") as caught:
        registry.find("ranging", "poc")
    assert all(owner in str(caught.value) for owner in both)
    assert caught.value.exit_code == 2


def plugin(**hooks: Callable[..., Any]) -> object:
    """One with these hooks."""
    return SimpleNamespace(**{name: hookimpl(hook) for name, hook in hooks.items()})


def failing() -> Iterator[Algorithm]:
    yield ranging("early")
    raise ZeroDivisionError("by design")


def brings_mine() -> Iterator[Algorithm]:
    yield ranging("mine")


def missing() -> object:
    with warnings.catch_warnings():  # as libraries do, which makes Python forget what it has shown
        pass
    raise ModuleNotFoundError("No module named 'camera_driver'")


BROKEN: dict[str, tuple[Callable[[], object], str]] = {
    "import": (missing, "cannot be imported: ModuleNotFoundError: No module named 'camera_driver'"),
    "role": (
        lambda: Brings(ranging("mine"), Algorithm("rangin", "x", "a:B", 1, "")),
        "algorithm 'x' has role 'rangin', expected one of detection, framing, pilots, ",
    ),
    "target": (lambda: Brings(Algorithm("ranging", "mine", 3, 1, "")), "target = 3, expected text"),
    "revision": (
        lambda: Brings(Algorithm("ranging", "mine", "a:B", "1", "")),
        "revision = '1', expected a whole",
    ),
    "record": (lambda: Brings(ranging("mine"), "poc"), "evlcp_algorithms() gave something else than Alg"),
    "fails": (
        lambda: plugin(evlcp_algorithms=failing),
        "evlcp_algorithms() fails: ZeroDivisionError: by design",
    ),
    "typo": (
        lambda: plugin(evlcp_algorithms=brings_mine, evlcp_algoritms=lambda: None),
        "has the hook 'evlcp_algoritms', which this SDK does not have",
    ),
    "unmarked": (
        lambda: SimpleNamespace(evlcp_algorithms=list),
        "evlcp_algorithms is not marked with",
    ),
    "arguments": (
        lambda: plugin(evlcp_algorithms=brings_mine, evlcp_stage_finished=lambda stage, nothing: None),
        "nothing",
    ),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_plugin_is_left_out_and_reported(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    load, reason = BROKEN[fault]
    install(monkeypatch, ("good", "evlcp-sdk", lambda: Brings(ranging("poc"))), ("bad", "evlcp-cam", load))
    with pytest.warns(PluginWarning, match="plugin bad of evlcp-cam 1.0 is broken and left out: ") as warned:
        entry = (registry := Registry.load()).find("ranging", "poc")
    assert len(warned) == 1
    assert entry.distribution == "evlcp-sdk"
    (broken,) = registry.broken
    assert (broken.plugin, broken.distribution) == ("bad", "evlcp-cam 1.0")
    assert reason in broken.reason
    assert "\n" not in str(broken)
    assert [e.algorithm.id for e in registry.list_algorithms()] == ["poc"]
    assert registry.plugins_with_hook("evlcp_stage_finished") == []
    with pytest.raises((PluginError, UnknownAlgorithmError)) as asked:
        registry.find("ranging", "mine")
    assert "plugin bad of evlcp-cam 1.0 is broken and left out" in str(asked.value)
    assert asked.value.exit_code == 2


def test_a_plugin_that_fails_when_asked_is_left_out_from_then_on() -> None:
    def fail(url: str) -> None:
        raise SystemExit(0)

    bad = plugin(evlcp_open_events=fail, evlcp_stage_finished=lambda stage: None)
    registry = Registry(bad, plugin(evlcp_open_events=lambda url: f"source of {url}"))
    with pytest.warns(PluginWarning, match=r"plugin \S+ is .*: evlcp_open_events\(\) fails: SystemExit: 0"):
        answers = registry.call_hook("evlcp_open_events", url="cam:0")
    assert [answer for _, answer in answers] == ["source of cam:0"]
    with pytest.raises(PluginError, match=r"^plugin 'my_cam': expected an object with a method marked"):
        Registry("my_cam")
    assert registry.plugins_with_hook("evlcp_stage_finished") == []
    assert registry.call_hook("evlcp_open_events", url="cam:0") == answers


def adding(command: Callable[..., None], fails: bool = False) -> Callable[[], object]:
    """A plugin that adds a command, and may fail behind that."""

    def add(app: Any) -> None:
        app.command()(command)
        assert not fails, "by design"

    return lambda: plugin(evlcp_register_commands=add)


def mine() -> None:
    print("done")


def receive() -> None: ...


def odd(x: "Nothing") -> None: ...  # type: ignore[name-defined]  # noqa: F821


@pytest.mark.parametrize(
    ("stranger", "reason"),
    [
        (missing, "cannot be imported: ModuleNotFoundError"),
        (adding(mine, fails=True), "evlcp_register_commands() fails: AssertionError: by design"),
        (adding(odd), "its commands cannot be built: NameError"),
        (adding(receive), "has the command 'receive', which is there already"),
    ],
)
def test_the_command_line_goes_on_without_a_broken_plugin(stranger, reason, monkeypatch, evlcp) -> None:
    install(monkeypatch, ("stranger", "evlcp-stranger", stranger), beside=True)
    message = f"evlcp: warning: plugin stranger of evlcp-stranger 1.0 is broken and left out: {reason}"
    for command in ("--help", "plugins"):
        done = evlcp(command)
        assert done.code == 0
        assert done.err.startswith(message)
        assert done.err.count("\n") == 1
    assert f"\nbroken: plugin stranger of evlcp-stranger 1.0: {reason}" in done.out
    assert "mine" not in evlcp("--help").out
    asked = evlcp("config", "--set", "ranging.id=mine")
    assert asked.code == 2
    fault = asked.err.splitlines()[-1]
    assert "no ranging algorithm named 'mine'" in fault
    # A plugin whose commands alone are broken still brings its algorithms.
    assert ("is broken and left out" in fault) == (stranger is missing)


def test_a_strangers_command_that_raises_is_no_fault_of_evlcp(monkeypatch, evlcp) -> None:
    def boom(number: int) -> None:
        raise KeyError(number)

    install(monkeypatch, ("stranger", "evlcp-stranger", lambda: adding(boom)()), beside=True)
    done = evlcp("boom", "3")
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith(
        "evlcp: command 'boom' of plugin stranger: KeyError: 3 (test_registry.py, line"
    )


def test_broken_and_conflicting_plugins_are_listed(monkeypatch: pytest.MonkeyPatch, evlcp: Any) -> None:
    owners = ("evlcp-sdk", "evlcp-fast")
    both = [(owner, owner, lambda: Brings(ranging("poc"))) for owner in owners]
    lost = ("lost", "evlcp-lost", lambda: Brings(ranging("lost", "json:JSONDecoder")))
    install(monkeypatch, *both, ("cam", "evlcp-cam", missing), lost)
    done = evlcp("plugins")
    assert done.code == 0
    assert [line[:6] for line in done.out.splitlines() if line[2:5] == "poc"] == ["! poc "] * 2
    assert "ranging: a decoded frame's image -> distance\n" in done.out
    assert "\nbroken: ranging algorithm 'lost' of evlcp-lost: json:JSONDecoder is not a Ranging" in done.out
    assert done.out.endswith("broken: plugin cam of evlcp-cam 1.0: " + BROKEN["import"][1] + "\n")
    table = json.loads(evlcp("plugins", "--json").out)
    assert [a["conflict"] for a in table["algorithms"]] == [False, True, True]
    assert table["broken"][0]["plugin"] == "cam"
    assert {"role": "ranging", "verb": ROLES["ranging"].verb, "default": "joint-scale"} in table["roles"]
