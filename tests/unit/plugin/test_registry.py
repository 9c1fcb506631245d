"""Plugins found by name: what is refused and how it is said, and what listing them must not import."""

import importlib.metadata
import json
import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pluggy
import pytest

from evlcp_sdk.errors import PluginError, UnknownAlgorithmError
from evlcp_sdk.link.resolve import DEFAULT_IDS
from evlcp_sdk.plugin import hooks as hookspecs
from evlcp_sdk.plugin.hooks import ROLE_NAMES, Algorithm, hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import ROLES, Ranging


class Brings:
    """A plugin with these records."""

    def __init__(self, *records: Any) -> None:
        self.records = records

    @hookimpl
    def evlcp_algorithms(self) -> Iterator[Algorithm]:
        yield from self.records


def registry_of(*plugins: object) -> Registry:
    manager = pluggy.PluginManager(hookspecs.ENTRY_POINT_GROUP)
    manager.add_hookspecs(hookspecs)
    for i, plugin in enumerate(plugins):
        manager.register(plugin, name=f"plugin{i}")
    return Registry(manager)


def ranging(name: str, target: str = "nowhere:Nothing") -> Algorithm:
    return Algorithm("ranging", name, target, 1, "a test")


def test_one_wrong_id_has_one_answer() -> None:
    registry = registry_of(Brings(ranging("poc"), ranging("centroid")))
    with pytest.raises(UnknownAlgorithmError) as caught:
        registry.find("ranging", "pco")
    expected = "no ranging algorithm named 'pco'; did you mean 'poc'? (installed: centroid, poc)"
    assert str(caught.value) == expected
    with pytest.raises(UnknownAlgorithmError) as far:
        registry.find("ranging", "time-of-flight")
    assert str(far.value) == "no ranging algorithm named 'time-of-flight' (installed: centroid, poc)"
    with pytest.raises(UnknownAlgorithmError, match=r"no pilots algorithm named 'wh' \(installed: none\)"):
        registry.find("pilots", "wh")


def test_two_plugins_with_one_name_are_both_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def entry(distribution: str, plugin: object) -> Any:
        dist = SimpleNamespace(
            metadata={"name": distribution}, version="1.0", entry_points=[], name=distribution
        )
        point = SimpleNamespace(name=distribution, group="evlcp", load=lambda: plugin)
        dist.entry_points = [point]
        return dist

    found = [entry("evlcp-sdk", Brings(ranging("poc"))), entry("evlcp-fast-poc", Brings(ranging("poc")))]
    monkeypatch.setattr(importlib.metadata, "distributions", lambda: found)
    monkeypatch.setattr("evlcp_sdk.plugin.registry.entry_points", lambda group: [])
    with pytest.raises(PluginError) as caught:
        Registry.load()
    assert str(caught.value) == (
        "two ranging algorithms named 'poc': one of evlcp-sdk, one of evlcp-fast-poc; uninstall one"
    )
    assert caught.value.exit_code == 2


def test_two_entry_points_with_one_name_are_both_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def found(**given: str) -> Any:
        names = ("evlcp-sdk", "evlcp-fast-poc")
        return [SimpleNamespace(name="poc", dist=SimpleNamespace(name=name)) for name in names]

    monkeypatch.setattr("evlcp_sdk.plugin.registry.entry_points", found)
    with pytest.raises(PluginError) as caught:
        Registry.load()
    assert str(caught.value) == (
        "two plugins with an entry point named 'poc': one of evlcp-sdk, one of evlcp-fast-poc;"
        " rename or uninstall one"
    )


def test_a_role_that_does_not_exist() -> None:
    with pytest.raises(
        PluginError, match=r"plugin plugin0: algorithm 'x' has role 'rangin', expected one of"
    ):
        registry_of(Brings(Algorithm("rangin", "x", "a:B", 1, "")))


def test_a_record_that_is_none() -> None:
    with pytest.raises(PluginError, match=r"plugin plugin0: evlcp_algorithms\(\) gave 'poc', expected an"):
        registry_of(Brings("poc"))


def test_a_plugin_that_fails_is_named() -> None:
    class Broken:
        @hookimpl
        def evlcp_algorithms(self) -> Iterator[Algorithm]:
            raise ZeroDivisionError("by design")

    with pytest.raises(PluginError, match=r"plugin plugin0: evlcp_algorithms\(\) fails: by design"):
        registry_of(Broken())


def test_a_hook_that_does_not_exist() -> None:
    class Typo:
        @hookimpl
        def evlcp_algoritms(self) -> None: ...

    with pytest.raises(PluginError, match="hook not known to this SDK: unknown hook 'evlcp_algoritms'"):
        Registry.load(Typo())


def test_a_hook_with_other_arguments() -> None:
    class Other:
        @hookimpl
        def evlcp_stage_finished(self, stage: str, nothing: str) -> None: ...

    with pytest.raises(PluginError, match=r"plugin Other fails to load: (.|\n)*nothing"):
        Registry.load(Other())


def test_a_package_that_cannot_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    def load() -> object:
        raise ModuleNotFoundError("No module named 'camera_driver'")

    point = SimpleNamespace(name="cam", group="evlcp", load=load, dist=SimpleNamespace(name="evlcp-cam"))
    dist = SimpleNamespace(metadata={"name": "evlcp-cam"}, version="1", entry_points=[point])
    monkeypatch.setattr(importlib.metadata, "distributions", lambda: [dist])
    monkeypatch.setattr("evlcp_sdk.plugin.registry.entry_points", lambda group: [point])
    with pytest.raises(PluginError, match="plugin cam of evlcp-cam fails to load: No module named"):
        Registry.load()


@pytest.mark.parametrize(
    ("target", "told"),
    [
        ("nowhere:Nothing", "cannot import nowhere:Nothing: No module named 'nowhere'"),
        ("json:Nothing", "cannot import json:Nothing"),
        ("json", "cannot import json"),
        ("", "cannot import : "),
        ("json:JSONDecoder", "json:JSONDecoder is no Ranging"),
        ("json:loads", "json:loads is no Ranging"),
    ],
)
def test_a_target_that_cannot_be_used(target: str, told: str) -> None:
    registry = registry_of(Brings(ranging("x", target)))
    with pytest.raises(PluginError, match=r"^ranging algorithm 'x' of plugin0: ") as caught:
        registry.load_class("ranging", "x")
    assert told in str(caught.value)


def test_the_built_in_algorithms_fill_every_role() -> None:
    registry = Registry.load()
    assert tuple(ROLES) == ROLE_NAMES == tuple(DEFAULT_IDS)
    for role, name in DEFAULT_IDS.items():
        assert registry.find(role, name).distribution == "evlcp-sdk"
    for entry in registry.installed():
        cls = registry.load_class(entry.algorithm.role, entry.algorithm.id)
        assert issubclass(cls, ROLES[entry.algorithm.role])
        assert entry.algorithm.revision >= 1
        assert cls() == cls(), f"{cls.__name__}: every parameter needs a default"
    assert [e.algorithm.role for e in registry.installed("ranging")] == ["ranging"] * len(
        registry.installed("ranging")
    )
    assert ROLES["ranging"] is Ranging


def test_listing_plugins_imports_no_kernel() -> None:
    code = (
        "import sys, json\n"
        "from evlcp_sdk.cli.main import main\n"
        "sys.argv = ['evlcp', 'plugins', '--json']\n"
        "try:\n    main()\n"
        "except SystemExit as end:\n    assert not end.code, end\n"
        "heavy = {'numba', 'numpy', 'scipy', 'matplotlib', 'llvmlite'} & set(sys.modules)\n"
        "print(json.dumps(sorted(heavy)), file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stderr) == []
    assert {row["role"] for row in json.loads(done.stdout)} == set(ROLE_NAMES)
