"""Sinks: a format is one file and one hook; what fails is named, and leaves nothing."""

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evlcp_sdk.errors import ConfigError, PluginError
from evlcp_sdk.plugin.hooks import SinkRecord, hookimpl
from evlcp_sdk.plugin.records import installed_sinks
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.run import receive, receive_to_folder
from evlcp_sdk.values import Packet
from tests.unit.results import distances


def test_the_built_in_formats_come_by_the_same_hook() -> None:
    sinks = installed_sinks(Registry.load())
    assert {name for name, sink in sinks.items() if sink.record.default} == {
        *("frames", "packets", "fixes", "track", "geojson", "nmea"),
    }
    assert {"parquet", "figures", "mcap"} <= sinks.keys()
    for sink in sinks.values():
        if sink.distribution == "evlcp-sdk":
            assert issubclass(sink.load_class(), Sink)


def test_a_format_is_one_file_and_one_hook(demo_raw: Path, tmp_path: Path) -> None:
    registry = Registry.load(distances)
    table = receive_to_folder(demo_raw, tmp_path, registry=registry, sinks=["distances"])
    with (tmp_path / "frames.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["distance_m"]]
    lines = (tmp_path / "distances.line").read_text().splitlines()
    found = [line.split() for line in lines]
    assert [value for _, value, _ in found] == [f"depth_m={row['distance_m']}" for row in rows]
    assert [float(t_ns) * 1e-3 for _, _, t_ns in found] == pytest.approx(
        [float(row["t_us"]) for row in rows], abs=0.006
    )
    assert table["sinks"] == {"distances": {"lines": len(rows), "frames_watched": len(rows)}}
    assert json.loads((tmp_path / "summary.json").read_text()) == table
    # Asked no more, it is dropped with the rest of the earlier result.
    table = receive_to_folder(demo_raw, tmp_path, registry=registry)
    assert "sinks" not in table
    assert {p.name for p in tmp_path.iterdir()} == {"frames.csv", "packets.jsonl", "summary.json"}


class Failing(Sink):
    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        folder.open("failing.txt")

    def packet(self, packet: Packet) -> None:
        raise KeyError("boom")


class Stray(Sink):
    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        folder.open("stray.txt")


class Twice(Sink):
    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        folder.open("failing.txt")
        folder.open_binary("failing.txt")


class NoSink:
    pass


def bring(name: str, target: str, *files: str, **more: Any) -> object:
    """A plugin with one format."""

    class Plugin:
        @hookimpl
        def evlcp_sinks(self) -> Iterator[SinkRecord]:
            yield SinkRecord(name, target, files, "a test", **more)

    return Plugin()


@pytest.mark.parametrize(
    ("name", "target", "told"),
    [
        ("fails", f"{__name__}:Failing", r"sink 'fails' of .*: KeyError: 'boom' \(test_sinks.py, line \d+\)"),
        (
            "objects",
            f"{__name__}:Unsayable",
            r"sink 'objects' of .*: TypeError: Object of type object is not",
        ),
        ("nan", f"{__name__}:Nan", r"sink 'nan' of .*: ValueError: Out of range float values are not JSON"),
        ("counts", f"{__name__}:Counting", r"sink 'counts' of .*: finish\(\) gave int, expected a mapping"),
        (
            "watches",
            f"{__name__}:Watching",
            r"evlcp_stage_finished\(\) of a plugin: KeyError: '.*' \(test_sinks.py, line \d+\)",
        ),
        ("strays", f"{__name__}:Stray", r"sink 'strays' of .*: 'stray.txt' is not among the files"),
        ("twice", f"{__name__}:Twice", r"sink 'twice' of .*: ValueError: 'failing.txt' was opened before"),
        ("none", f"{__name__}:NoSink", r"sink 'none' of .*: .*:NoSink is not a Sink"),
        ("away", f"{__name__}:Away", r"sink 'away' of .*: cannot import .*:Away"),
        ("gone", "no_such_module:Sink", r"sink 'gone' of .*: cannot import no_such_module:Sink"),
    ],
)
def test_what_fails_is_named_and_leaves_nothing(
    name: str, target: str, told: str, demo_raw: Path, tmp_path: Path
) -> None:
    registry = Registry.load(bring(name, target, "failing.txt"))
    with pytest.raises(PluginError, match=told) as caught:
        receive_to_folder(demo_raw, tmp_path, registry=registry, sinks=[name])
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_format_that_is_not_there(demo_raw: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no sink named 'parquett'; did you mean 'parquet'"):
        receive_to_folder(demo_raw, tmp_path / "out", sinks=["parquett"])
    missing = bring("far", f"{__name__}:Failing", "a.txt", packages=("no_such_package",))
    with pytest.raises(ConfigError, match=r"sink 'far' of .* needs no_such_package, or leave --sink far out"):
        receive_to_folder(demo_raw, tmp_path / "out", registry=Registry.load(missing), sinks=["far"])
    assert not (tmp_path / "out").exists()


class Unsayable(Sink):
    def finish(self) -> dict[str, Any]:
        return {"what": object()}


class Nan(Sink):
    def finish(self) -> dict[str, Any]:
        return {"mean": float("nan")}


class Counting(Sink):
    def finish(self) -> Any:
        return 5


class Watching(Sink):
    @hookimpl
    def evlcp_stage_finished(self, stage: str) -> None:
        raise KeyError(stage)


def test_the_command_line_asks_for_formats(evlcp: Any, demo_raw: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
    assert evlcp("receive", demo_raw, "-o", tmp_path, "--sink", "parquet").code == 0
    assert (tmp_path / "frames.parquet").exists()
    done = evlcp("receive", demo_raw, "-o", tmp_path / "out", "--sink", "mcap")
    assert (done.code, done.err) == (2, "evlcp: sink 'mcap' needs --sites: it writes positions\n")
    assert not (tmp_path / "out").exists()


def test_the_summary_counts_what_the_iterator_counts(demo_raw: Path, tmp_path: Path) -> None:
    reception = receive(demo_raw)
    list(reception)
    assert receive_to_folder(demo_raw, tmp_path)["counts"] == reception.counts
