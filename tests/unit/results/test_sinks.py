"""Sinks: what fails is named, and leaves nothing; `examples/third_party_formats` has one that does not."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from evlcp_sdk.errors import ConfigError, PluginError, PluginWarning
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.hooks import SinkRecord, hookimpl
from evlcp_sdk.plugin.records import find_sinks
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.values import Packet
from tests.unit.results.test_outputs import result
from tests.unit.results.test_positions import packets


def test_the_built_in_formats_come_by_the_same_hook() -> None:
    sinks = find_sinks(Registry.load())
    assert {name for name, sink in sinks.items() if sink.record.default} == {
        *("frames", "packets", "fixes", "track", "geojson", "nmea")
    }
    assert {"parquet", "figures", "mcap"} <= sinks.keys()
    for sink in sinks.values():
        if sink.distribution == "evlcp-sdk":
            assert issubclass(sink.load_class(), Sink)


def opens(*names: str) -> Callable[..., None]:
    def init(self: Sink, folder: ResultFolder, run: Run) -> None:
        for name in names:
            folder.open(name)

    return init


def fails(self: Sink, packet: Packet) -> None:
    raise KeyError("boom")


@hookimpl
def fails_at_a_stage(self: Sink, stage: str) -> None:
    raise KeyError(stage)


Failing = type("Failing", (Sink,), {"__init__": opens("failing.txt"), "packet": fails})
Stray = type("Stray", (Sink,), {"__init__": opens("stray.txt")})
Twice = type("Twice", (Sink,), {"__init__": opens("failing.txt", "failing.txt")})
Unsayable = type("Unsayable", (Sink,), {"finish": lambda _: {"what": object()}})
Counting = type("Counting", (Sink,), {"finish": lambda _: 5})
Watching = type("Watching", (Sink,), {"evlcp_stage_finished": fails_at_a_stage})


def bring(name: str, target: str, **more: Any) -> Registry:
    """A plugin with one format."""
    sink = SinkRecord(name, target, ("failing.txt",), "a test", **more)
    return Registry.load(SimpleNamespace(evlcp_sinks=hookimpl(lambda: iter((sink,)))))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Failing", r"sink 'it' of .*: KeyError: 'boom' \(test_sinks.py, line \d+\)"),
        ("Unsayable", r"sink 'it' of .*: TypeError: Object of type object is not"),
        ("Counting", r"sink 'it' of .*: finish\(\) gave int, expected a mapping"),
        ("Stray", r"sink 'it' of .*: 'stray.txt' is not among the files"),
        ("Twice", r"sink 'it' of .*: ValueError: 'failing.txt' was opened before"),
        ("Path", r"sink 'it' of .*: .*:Path is not a Sink"),
        ("no_such_module:Sink", r"sink 'it' of .*: cannot import no_such_module:Sink"),
    ],
)
def test_what_fails_is_named_and_leaves_nothing(name: str, message: str, tmp_path: Path) -> None:
    registry = bring("it", name if ":" in name else f"{__name__}:{name}")

    with pytest.raises(PluginError, match=message) as caught:
        result(tmp_path / "out", *packets(1), link=load_link(), registry=registry, sinks=["it"])
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("wrong", "fault"),
    [
        ({"files": ("a/b",)}, r"files = \('a/b',\), expected names of files"),
        ({"files": ("summary.json",)}, "summary.json is the summary's file"),
        ({"packages": "pandas"}, "packages = 'pandas', expected names of modules"),
    ],
)
def test_a_record_that_is_no_sink_s_is_left_out(wrong, fault):
    record = replace(SinkRecord("it", "it:It", ("it.txt",), "a test"), **wrong)
    with pytest.warns(PluginWarning, match=fault):
        assert not find_sinks(Registry(SimpleNamespace(evlcp_sinks=hookimpl(lambda: [record]))))


def test_a_sink_that_fails_at_a_stage_is_named(demo_raw: Path, tmp_path: Path) -> None:
    registry = bring("it", f"{__name__}:Watching")
    message = r"evlcp_stage_finished\(\) of a plugin: KeyError: '.*' \(test_sinks.py, line \d+\)"
    with pytest.raises(PluginError, match=message):
        receive_to_folder(demo_raw, tmp_path, registry=registry, sinks=["it"])
    assert not list(tmp_path.iterdir())


def test_a_format_that_is_not_there(demo_raw: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no sink named 'parquett'; did you mean 'parquet'"):
        receive_to_folder(demo_raw, tmp_path / "out", sinks=["parquett"])
    for more, message in (
        ({}, r"sink 'far' of .* needs no_such_package, or leave --sink far out"),
        ({"extra": "evlcp-sdk[far]"}, r"needs the extra: pip install 'evlcp-sdk\[far\]'"),
    ):
        missing = bring("far", f"{__name__}:Failing", packages=("no_such_package",), **more)
        with pytest.raises(ConfigError, match=message):
            receive_to_folder(demo_raw, tmp_path / "out", registry=missing, sinks=["far"])
    assert not (tmp_path / "out").exists()


def test_a_format_of_positions_needs_sites(evlcp: Any, demo_raw: Path, tmp_path: Path) -> None:
    done = evlcp("receive", demo_raw, "-o", tmp_path / "out", "--sink", "mcap")
    assert (done.code, done.err) == (2, "evlcp: sink 'mcap' needs --sites: it writes positions\n")
    assert not (tmp_path / "out").exists()
